//! Laying points upon points.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::Pose;

/// Fewest points that hold a plate.
pub(super) const FEWEST: usize = 6;

/// The rotation and translation that lay `from` upon `to` best, without those that lie off by far.
pub(super) fn lay(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<Pose> {
    let mut kept: Vec<usize> = (0..from.len()).collect();
    let mut pose = None;
    for _ in 0..3 {
        if kept.len() < FEWEST {
            return None;
        }
        let found = lay_all(&kept, from, to)?;
        let rotation = found.rotation();
        let off = |i: usize| (rotation * from[i] + Vector3::from(found.translation_mm) - to[i]).norm();
        let mut sizes: Vec<f64> = kept.iter().map(|i| off(*i)).collect();
        let half = sizes.len() / 2;
        // The starting values may bend the plate: only what is far out of line counts as wrong.
        let limit = 6.0 * *sizes.select_nth_unstable_by(half, f64::total_cmp).1 + 1e-6;
        pose = Some(found);
        kept.retain(|i| off(*i) <= limit);
    }
    pose
}

/// As [`lay`], by the points numbered in `kept`.
pub(super) fn lay_all(kept: &[usize], from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<Pose> {
    let n = kept.len() as f64;
    let mean = |v: &[Vector3<f64>]| kept.iter().map(|i| v[*i]).sum::<Vector3<f64>>() / n;
    let (a, b) = (mean(from), mean(to));
    let mut cross = Matrix3::zeros();
    for i in kept {
        cross += (to[*i] - b) * (from[*i] - a).transpose();
    }
    if !cross.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = cross.svd(true, true);
    // Points on a line leave the rotation about it open.
    let mut values: Vec<f64> = svd.singular_values.iter().copied().collect();
    values.sort_by(f64::total_cmp);
    if !(values[1] > 1e-6 * values[2]) {
        return None;
    }
    let (u, vt) = (svd.u?, svd.v_t?);
    let mut turn = Matrix3::identity();
    // The third direction of a plane is free in sign: that of a rotation.
    let weakest = (0..3).fold(0, |w, i| if svd.singular_values[i] < svd.singular_values[w] { i } else { w });
    turn[(weakest, weakest)] = (u * vt).determinant().signum();
    let rotation = Rotation3::from_matrix_unchecked(u * turn * vt);
    let (x, y, z) = rotation.euler_angles();
    Some(Pose { rotation_rad: [x, y, z], translation_mm: (b - rotation * a).into() })
}

/// Coefficients of h = a + b·x + c·y.
pub(super) fn plane(points: &[Vector3<f64>]) -> Option<Vector3<f64>> {
    let (mut normal, mut rhs) = (Matrix3::zeros(), Vector3::zeros());
    for p in points {
        let row = Vector3::new(1.0, p.x, p.y);
        normal += row * row.transpose();
        rhs += row * p.z;
    }
    normal.cholesky().map(|c| c.solve(&rhs))
}
