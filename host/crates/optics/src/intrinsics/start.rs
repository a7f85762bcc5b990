//! Where the adjustment of a camera begins: homographies, the focal length from them (Zhang 2000),
//! poses.

use nalgebra::{DMatrix, Matrix3, Rotation3, SymmetricEigen, Vector3};

use super::{BoardPoint, Pose};
use crate::camera::Camera;

/// The homography from board to image by the normalised direct linear transformation. Nothing if
/// the points lie on a line or are less than four.
pub(crate) fn homography(pairs: &[([f64; 2], [f64; 2])]) -> Option<Matrix3<f64>> {
    if pairs.len() < 4 {
        return None;
    }
    let (from_norm, from) = normalised(pairs.iter().map(|p| p.0))?;
    let (to_norm, to) = normalised(pairs.iter().map(|p| p.1))?;
    let mut a = DMatrix::<f64>::zeros(9, 9);
    for ([x, y], [u, v]) in from.into_iter().zip(to) {
        for row in
            [[x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u], [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v]]
        {
            for i in 0..9 {
                for j in 0..9 {
                    a[(i, j)] += row[i] * row[j];
                }
            }
        }
    }
    let eigen = SymmetricEigen::new(a);
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]));
    // A second null vector: the points do not fix a homography.
    if !(eigen.eigenvalues[order[1]] > 1e-9 * eigen.eigenvalues[order[8]]) {
        return None;
    }
    let h = eigen.eigenvectors.column(order[0]);
    let h = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    Some(to_norm.try_inverse()? * h * from_norm)
}

/// Points moved and scaled to mean 0 and mean square 2, and the map that does it.
fn normalised(points: impl Iterator<Item = [f64; 2]> + Clone) -> Option<(Matrix3<f64>, Vec<[f64; 2]>)> {
    let n = points.clone().count() as f64;
    let sum = points.clone().fold([0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]]);
    let mean = sum.map(|s| s / n);
    let square: f64 = points.clone().map(|p| (p[0] - mean[0]).powi(2) + (p[1] - mean[1]).powi(2)).sum();
    let scale = (2.0 * n / square).sqrt();
    let norm = Matrix3::new(scale, 0.0, -scale * mean[0], 0.0, scale, -scale * mean[1], 0.0, 0.0, 1.0);
    scale.is_finite().then(|| (norm, points.map(|p| [0, 1].map(|l| (p[l] - mean[l]) * scale)).collect()))
}

/// F from the condition that the board's axes are perpendicular and equally long in every view,
/// with the principal point known. Nothing if the views say nothing about it (board parallel to
/// the sensor) or contradict.
pub(crate) fn focal(homographies: &[Matrix3<f64>], principal_point: [f64; 2], side: f64) -> Option<f64> {
    let to_centre = Matrix3::new(
        1.0 / side,
        0.0,
        -principal_point[0] / side,
        0.0,
        1.0 / side,
        -principal_point[1] / side,
        0.0,
        0.0,
        1.0,
    );
    // Least squares of p w + q = 0 over w = 1/F².
    let (mut pq, mut pp) = (0.0, 0.0);
    for h in homographies {
        let h = to_centre * h;
        let (a, b) = (h.column(0), h.column(1));
        let size = a.norm() * b.norm();
        for (p, q) in [
            (a[0] * b[0] + a[1] * b[1], a[2] * b[2]),
            (a[0] * a[0] + a[1] * a[1] - b[0] * b[0] - b[1] * b[1], a[2] * a[2] - b[2] * b[2]),
        ] {
            pq += p * q / (size * size);
            pp += p * p / (size * size);
        }
    }
    let w = -pq / pp;
    // F between a tenth of the image's side and a thousand times it.
    (w > 1e-6 && w < 100.0).then(|| side / w.sqrt())
}

/// The pose of a board seen by a camera without regard to its distortion.
pub(crate) fn pose(camera: &Camera, h: &Matrix3<f64>) -> Option<Pose> {
    let [cx, cy] = camera.principal_point_px;
    let f = camera.focal_px;
    let inverse = Matrix3::new(1.0 / f, 0.0, -cx / f, 0.0, 1.0 / f, -cy / f, 0.0, 0.0, 1.0);
    let m = inverse * h;
    let scale = 1.0 / (m.column(0).norm() * m.column(1).norm()).sqrt();
    let sign = if m[(2, 2)] < 0.0 { -scale } else { scale };
    let [a, b, t]: [Vector3<f64>; 3] = [0, 1, 2].map(|k| m.column(k) * sign);
    let near = Matrix3::from_columns(&[a, b, a.cross(&b)]);
    let svd = near.svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    let finite = rotation.iter().chain(t.iter()).all(|v| v.is_finite());
    (finite && t.z > 0.0)
        .then(|| Pose { rotation: Rotation3::from_matrix_unchecked(rotation), translation: t })
}

/// Pairs of board and image points; the image points as a camera without distortion sees them
/// where the start knows a distortion.
pub(crate) fn pairs(points: &[BoardPoint], camera: Option<&Camera>) -> Vec<([f64; 2], [f64; 2])> {
    points
        .iter()
        .map(|p| {
            let ideal = camera.and_then(|c| c.undistort_px(p.pixel_px).ok());
            (p.board_mm, ideal.unwrap_or(p.pixel_px))
        })
        .collect()
}
