//! The adjustment of camera and poses.

use nalgebra::{DMatrix, Matrix2x3, Matrix3, Matrix6, Rotation3, SMatrix, SVector, SymmetricEigen, Vector3};

use super::start;
use super::{
    BoardPoint, CameraCalibration, CameraError, CameraEstimate, CameraParameter, CameraSettings, Pose,
    PoseFit, ViewFit,
};
use crate::camera::{Camera, distort_jacobian};

type Matrix8 = SMatrix<f64, 8, 8>;
type Vector8 = SVector<f64, 8>;
type Vector6 = SVector<f64, 6>;

/// Camera and poses.
#[derive(Clone)]
struct State {
    camera: Camera,
    poses: Vec<Pose>,
}

/// Pixel of a board point, its derivatives by the eight parameters of the camera and by the pose
/// (rotation vector applied from the left, translation). Nothing behind the camera.
fn project(
    camera: &Camera,
    pose: &Pose,
    board: [f64; 2],
) -> Option<([f64; 2], SMatrix<f64, 2, 8>, SMatrix<f64, 2, 6>)> {
    let turned = pose.rotation * Vector3::new(board[0], board[1], 0.0);
    let p = turned + pose.translation;
    if !(p.z > 1e-9) {
        return None;
    }
    let [x, y] = [p.x / p.z, p.y / p.z];
    let ([dx, dy], by_q) = distort_jacobian(&camera.brown.coefficients(), [x, y]);
    let f = camera.focal_px;
    let [cx, cy] = camera.principal_point_px;
    let r2 = x * x + y * y;
    let (r4, r6) = (r2 * r2, r2 * r2 * r2);
    let rows = [
        [dx, 1.0, 0.0, f * x * r2, f * x * r4, f * x * r6, f * 2.0 * x * y, f * (r2 + 2.0 * x * x)],
        [dy, 0.0, 1.0, f * y * r2, f * y * r4, f * y * r6, f * (r2 + 2.0 * y * y), f * 2.0 * x * y],
    ];
    let by_camera = SMatrix::<f64, 2, 8>::from_fn(|l, k| rows[l][k]);
    let q_by_p = Matrix2x3::new(1.0, 0.0, -x, 0.0, 1.0, -y) / p.z;
    let by_q = nalgebra::Matrix2::new(by_q[0][0], by_q[0][1], by_q[1][0], by_q[1][1]) * f;
    let by_p = by_q * q_by_p;
    // ∂(ω × R X) = −[R X]ₓ ∂ω
    let cross = Matrix3::new(0.0, turned.z, -turned.y, -turned.z, 0.0, turned.x, turned.y, -turned.x, 0.0);
    let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
    by_pose.fixed_view_mut::<2, 3>(0, 0).copy_from(&(by_p * cross));
    by_pose.fixed_view_mut::<2, 3>(0, 3).copy_from(&by_p);
    Some(([f * dx + cx, f * dy + cy], by_camera, by_pose))
}

/// A pose after a small rotation and shift.
pub(crate) fn moved(pose: &Pose, by: &[f64; 6]) -> Pose {
    let rotation = Rotation3::new(Vector3::new(by[0], by[1], by[2])) * pose.rotation;
    Pose { rotation, translation: pose.translation + Vector3::new(by[3], by[4], by[5]) }
}

/// Normal equations, one block for each view.
struct Normal {
    camera: Matrix8,
    rhs: Vector8,
    views: Vec<(Matrix6<f64>, SMatrix<f64, 8, 6>, Vector6)>,
    cost: f64,
}

struct Problem<'a> {
    views: &'a [Vec<BoardPoint>],
    active: Vec<Vec<bool>>,
    free: [bool; 8],
    max_iterations: usize,
}

impl Problem<'_> {
    fn cost(&self, state: &State) -> Option<f64> {
        let mut cost = 0.0;
        for ((points, active), pose) in self.views.iter().zip(&self.active).zip(&state.poses) {
            for (p, _) in points.iter().zip(active).filter(|(_, a)| **a) {
                let t = pose.rotation * Vector3::new(p.board_mm[0], p.board_mm[1], 0.0) + pose.translation;
                if !(t.z > 1e-9) {
                    return None;
                }
                let pixel = state.camera.pixel([t.x / t.z, t.y / t.z]);
                cost += (0..2).map(|l| ((p.pixel_px[l] - pixel[l]) / p.sigma_px[l]).powi(2)).sum::<f64>();
            }
        }
        cost.is_finite().then_some(cost)
    }

    fn linearise(&self, state: &State) -> Option<Normal> {
        let mut normal =
            Normal { camera: Matrix8::zeros(), rhs: Vector8::zeros(), views: Vec::new(), cost: 0.0 };
        for ((points, active), pose) in self.views.iter().zip(&self.active).zip(&state.poses) {
            let (mut v, mut w, mut b) = (Matrix6::zeros(), SMatrix::<f64, 8, 6>::zeros(), Vector6::zeros());
            for (p, _) in points.iter().zip(active).filter(|(_, a)| **a) {
                let (pixel, mut by_camera, mut by_pose) = project(&state.camera, pose, p.board_mm)?;
                let mut r = nalgebra::Vector2::zeros();
                for l in 0..2 {
                    let weight = 1.0 / p.sigma_px[l];
                    r[l] = (p.pixel_px[l] - pixel[l]) * weight;
                    by_camera.row_mut(l).scale_mut(weight);
                    by_pose.row_mut(l).scale_mut(weight);
                }
                for k in (0..8).filter(|&k| !self.free[k]) {
                    by_camera.column_mut(k).fill(0.0);
                }
                normal.cost += r.norm_squared();
                normal.camera += by_camera.transpose() * by_camera;
                normal.rhs += by_camera.transpose() * r;
                w += by_camera.transpose() * by_pose;
                v += by_pose.transpose() * by_pose;
                b += by_pose.transpose() * r;
            }
            normal.views.push((v, w, b));
        }
        // Parameters held fixed stay where they are.
        for k in (0..8).filter(|&k| !self.free[k]) {
            normal.camera[(k, k)] = 1.0;
        }
        Some(normal)
    }

    /// Minimises; returns the linearisations made.
    fn minimise(&self, state: &mut State) -> Result<usize, CameraError> {
        let failed = |iterations| CameraError::NotConverged { iterations };
        let mut damping = 1e-4;
        for iteration in 1..=self.max_iterations {
            let normal = self.linearise(state).ok_or(failed(iteration))?;
            loop {
                let step = normal.step(damping);
                let next = step.as_ref().and_then(|(camera, poses)| {
                    let mut next = state.clone();
                    for (k, p) in CameraParameter::ALL.iter().enumerate().filter(|(k, _)| self.free[*k]) {
                        p.add(&mut next.camera, camera[k]);
                    }
                    for (pose, by) in next.poses.iter_mut().zip(poses) {
                        *pose = moved(pose, &[by[0], by[1], by[2], by[3], by[4], by[5]]);
                    }
                    let cost = (next.camera.focal_px > 0.0).then(|| self.cost(&next))??;
                    Some((next, cost))
                });
                // What the linear model promises of the step.
                let promise = step.map_or(f64::INFINITY, |(camera, poses)| {
                    let views: f64 = normal.views.iter().zip(&poses).map(|(v, s)| v.2.dot(s)).sum();
                    camera.dot(&normal.rhs) + views
                });
                let rounding = 1e-12 * normal.cost + 1e-16;
                let small = promise <= 1e-8 + rounding && damping < 1e-2;
                if let Some((next, cost)) = next
                    && (cost <= normal.cost || small)
                {
                    if cost <= normal.cost {
                        *state = next;
                    }
                    damping = (damping * 0.1_f64).max(1e-12);
                    if small {
                        return Ok(iteration);
                    }
                    break;
                }
                damping *= 10.0;
                if damping > 1e10 {
                    return Err(failed(iteration));
                }
            }
        }
        Err(failed(self.max_iterations))
    }

    /// Largest residual of a point in standard deviations; all points, also those left out.
    fn residuals(&self, state: &State) -> Vec<Vec<[f64; 2]>> {
        self.views
            .iter()
            .zip(&state.poses)
            .map(|(points, pose)| {
                points
                    .iter()
                    .map(|p| match project(&state.camera, pose, p.board_mm) {
                        Some((pixel, ..)) => [0, 1].map(|l| p.pixel_px[l] - pixel[l]),
                        None => [f64::NAN; 2],
                    })
                    .collect()
            })
            .collect()
    }

    /// Marks points beyond the limit; whether something changed.
    fn select(&mut self, state: &State, limit: f64) -> bool {
        let size =
            |p: &BoardPoint, r: [f64; 2]| (r[0] / p.sigma_px[0]).abs().max((r[1] / p.sigma_px[1]).abs());
        let residuals = self.residuals(state);
        let mut all: Vec<f64> = Vec::new();
        for (points, rs) in self.views.iter().zip(&residuals) {
            for (p, r) in points.iter().zip(rs) {
                all.extend((0..2).map(|l| (r[l] / p.sigma_px[l]).abs()));
            }
        }
        let half = all.len() / 2;
        let spread = 1.4826 * *all.select_nth_unstable_by(half, f64::total_cmp).1;
        let bound = limit * spread.max(1.0);
        let mut changed = false;
        for ((points, rs), active) in self.views.iter().zip(&residuals).zip(&mut self.active) {
            for ((p, r), a) in points.iter().zip(rs).zip(active) {
                let keep = size(p, *r) <= bound;
                changed |= keep != *a;
                *a = keep;
            }
        }
        changed
    }
}

impl Normal {
    /// What is left for the camera when the poses are eliminated.
    fn reduced(&self, damping: f64) -> Option<(Matrix8, Vector8, Vec<Matrix6<f64>>)> {
        let (mut s, mut r) = (self.camera, self.rhs);
        for k in 0..8 {
            s[(k, k)] *= 1.0 + damping;
        }
        let mut inverses = Vec::with_capacity(self.views.len());
        for (v, w, b) in &self.views {
            let mut v = *v;
            for k in 0..6 {
                v[(k, k)] *= 1.0 + damping;
            }
            let inverse = v.cholesky()?.inverse();
            s -= w * inverse * w.transpose();
            r -= w * inverse * b;
            inverses.push(inverse);
        }
        Some((s, r, inverses))
    }

    fn step(&self, damping: f64) -> Option<(Vector8, Vec<Vector6>)> {
        let (s, r, inverses) = self.reduced(damping)?;
        let camera = s.cholesky()?.solve(&r);
        let poses = self
            .views
            .iter()
            .zip(&inverses)
            .map(|((_, w, b), inverse)| inverse * (b - w.transpose() * camera))
            .collect();
        camera.iter().all(|v| v.is_finite()).then_some((camera, poses))
    }

    /// Covariance of the camera's parameters, or the parameter that is worst determined.
    fn covariance(&self, free: &[bool; 8]) -> Result<Matrix8, usize> {
        let worst_free = free.iter().position(|f| *f).unwrap_or(0);
        let (s, ..) = self.reduced(0.0).ok_or(worst_free)?;
        // In units in which the diagonal before elimination is 1.
        let scale = Vector8::from_fn(|k, _| 1.0 / self.camera[(k, k)].max(1e-300).sqrt());
        let scaled = Matrix8::from_fn(|i, j| s[(i, j)] * scale[i] * scale[j]);
        let eigen = SymmetricEigen::new(scaled);
        let least = eigen.eigenvalues.imin();
        // Elimination leaves rounding of some 1e-15 of the diagonal.
        if !(eigen.eigenvalues[least] > 1e-13) {
            return Err(eigen.eigenvectors.column(least).iamax());
        }
        let inverse = scaled.cholesky().ok_or(worst_free)?.inverse();
        Ok(Matrix8::from_fn(|i, j| inverse[(i, j)] * scale[i] * scale[j]))
    }
}

fn begin(views: &[Vec<BoardPoint>], camera: &Camera) -> Result<State, CameraError> {
    let mut poses = Vec::with_capacity(views.len());
    for (view, points) in views.iter().enumerate() {
        let degenerate = CameraError::DegenerateView { view, points: points.len() };
        let h = start::homography(&start::pairs(points, Some(camera))).ok_or(degenerate.clone())?;
        poses.push(start::pose(camera, &h).ok_or(degenerate)?);
    }
    Ok(State { camera: *camera, poses })
}

fn spread(poses: &[Pose]) -> f64 {
    let mut most = 0.0_f64;
    for (k, a) in poses.iter().enumerate() {
        for b in &poses[..k] {
            let (n, m) = (a.normal(), b.normal());
            most = most.max(n.cross(&m).norm().atan2(n.dot(&m)));
        }
    }
    most
}

/// Boards whose normals agree to this (radians) are one orientation.
const PARALLEL: f64 = 0.02;

pub(super) fn calibrate(
    views: &[Vec<BoardPoint>],
    settings: &CameraSettings,
) -> Result<CameraCalibration, CameraError> {
    let side = settings.image_px[0].max(settings.image_px[1]).max(1) as f64;
    let middle = settings.image_px.map(|n| (n.max(1) - 1) as f64 / 2.0);
    let guess = |focal_px: f64| Camera { focal_px, principal_point_px: middle, brown: Default::default() };
    let starts: Vec<Camera> = match settings.start {
        Some(camera) => vec![camera],
        None => {
            let mut homographies = Vec::with_capacity(views.len());
            for (view, points) in views.iter().enumerate() {
                let degenerate = CameraError::DegenerateView { view, points: points.len() };
                homographies.push(start::homography(&start::pairs(points, None)).ok_or(degenerate)?);
            }
            let found = start::focal(&homographies, middle, side);
            // Weak perspective and strong distortion mislead the estimate: others stand by.
            found.into_iter().chain([1.0, 4.0, 16.0].map(|k| k * side)).map(guess).collect()
        }
    };
    let free = CameraParameter::ALL.map(|p| settings.free.contains(&p));
    let active: Vec<Vec<bool>> = views.iter().map(|v| vec![true; v.len()]).collect();
    let mut problem = Problem { views, active, free, max_iterations: settings.max_iterations };
    let mut result = Err(CameraError::NotConverged { iterations: 0 });
    let mut last = None;
    for camera in starts {
        result = begin(views, &camera).and_then(|mut state| {
            let made = problem.minimise(&mut state);
            last = Some(spread(&state.poses));
            made.map(|n| (state, n))
        });
        if result.is_ok() {
            break;
        }
    }
    let both = settings.free.iter().filter(|p| !p.is_distortion()).count() > 1;
    let parallel = |spread: f64| CameraError::ParallelViews { spread_deg: spread.to_degrees() };
    let (mut state, mut iterations) = match (result, last) {
        (Err(CameraError::NotConverged { .. }), Some(spread)) if spread < PARALLEL && both => {
            return Err(parallel(spread));
        }
        (result, _) => result?,
    };
    let points: usize = views.iter().map(Vec::len).sum();
    let limit = (settings.max_outlier_fraction * points as f64) as usize;
    for _ in 0..6 {
        if !problem.select(&state, settings.outlier_limit) {
            break;
        }
        let rejected = points - problem.active.iter().flatten().filter(|a| **a).count();
        if rejected > limit {
            return Err(CameraError::TooManyOutliers { rejected, points, limit });
        }
        iterations += problem.minimise(&mut state)?;
    }
    let normals_spread_rad = spread(&state.poses);
    if normals_spread_rad < PARALLEL && both {
        return Err(parallel(normals_spread_rad));
    }
    finish(&problem, state, settings, iterations, normals_spread_rad)
}

fn finish(
    problem: &Problem<'_>,
    state: State,
    settings: &CameraSettings,
    iterations: usize,
    normals_spread_rad: f64,
) -> Result<CameraCalibration, CameraError> {
    let failed = CameraError::NotConverged { iterations };
    let normal = problem.linearise(&state).ok_or(failed.clone())?;
    let used = problem.active.iter().flatten().filter(|a| **a).count();
    let unknowns = settings.free.len() + 6 * state.poses.len();
    let degrees_of_freedom = (2 * used).checked_sub(unknowns).filter(|n| *n > 0).ok_or(failed)?;
    let chi_square_reduced = normal.cost / degrees_of_freedom as f64;
    let limit = settings.max_relative_sigma * state.camera.focal_px;
    let undetermined = |parameter, sigma| CameraError::Undetermined { parameter, sigma, limit };
    let full =
        normal.covariance(&problem.free).map_err(|k| undetermined(CameraParameter::ALL[k], f64::INFINITY))?
            * chi_square_reduced.max(1.0);
    let position = |p: CameraParameter| CameraParameter::ALL.iter().position(|q| *q == p).unwrap_or(0);
    let covariance = DMatrix::from_fn(settings.free.len(), settings.free.len(), |i, j| {
        full[(position(settings.free[i]), position(settings.free[j]))]
    });
    let residuals = problem.residuals(&state);
    // How far out the points reach, in normalised coordinates.
    let [cx, cy] = state.camera.principal_point_px;
    let reach = problem
        .views
        .iter()
        .flatten()
        .map(|p| (p.pixel_px[0] - cx).hypot(p.pixel_px[1] - cy) / state.camera.focal_px)
        .fold(0.0, f64::max);
    let mut estimates = Vec::with_capacity(settings.free.len());
    for (k, &parameter) in settings.free.iter().enumerate() {
        let value = parameter.get(&state.camera);
        let sigma = covariance[(k, k)].sqrt();
        let power = match parameter {
            CameraParameter::K1 => 3,
            CameraParameter::K2 => 5,
            CameraParameter::K3 => 7,
            _ => 2,
        };
        let determined = if parameter.is_distortion() {
            sigma * reach.powi(power) * state.camera.focal_px < 1.0 && value.abs() > 2.0 * sigma
        } else {
            if !(sigma <= limit) {
                return Err(undetermined(parameter, sigma));
            }
            true
        };
        estimates.push(CameraEstimate { parameter, value, sigma, determined });
    }
    let rms = |sum: f64, n: usize| (sum / (2 * n).max(1) as f64).sqrt();
    let mut total = 0.0;
    let mut views = Vec::with_capacity(state.poses.len());
    for ((pose, residuals_px), active) in state.poses.iter().zip(residuals).zip(&problem.active) {
        let kept = residuals_px.iter().zip(active).filter(|(_, a)| **a);
        let square: f64 = kept.map(|(r, _)| r[0] * r[0] + r[1] * r[1]).sum();
        total += square;
        let rejected: Vec<usize> = (0..active.len()).filter(|&k| !active[k]).collect();
        let rms_px = rms(square, active.len() - rejected.len());
        views.push(ViewFit { pose: *pose, rms_px, residuals_px, rejected });
    }
    Ok(CameraCalibration {
        camera: state.camera,
        estimates,
        covariance,
        views,
        rms_px: rms(total, used),
        chi_square_reduced,
        degrees_of_freedom,
        normals_spread_rad,
        iterations,
    })
}

pub(super) fn pose(
    camera: &Camera,
    views: &[Vec<BoardPoint>],
    settings: &CameraSettings,
) -> Result<PoseFit, CameraError> {
    let active = vec![vec![true; views[0].len()]];
    let problem = Problem { views, active, free: [false; 8], max_iterations: settings.max_iterations };
    let mut state = begin(views, camera)?;
    let iterations = problem.minimise(&mut state)?;
    let failed = CameraError::NotConverged { iterations };
    let normal = problem.linearise(&state).ok_or(failed.clone())?;
    let coordinates = 2 * views[0].len();
    let freedom = coordinates.saturating_sub(6).max(1) as f64;
    let covariance = normal.views[0].0.cholesky().ok_or(failed)?.inverse() * (normal.cost / freedom).max(1.0);
    let square: f64 = problem.residuals(&state)[0].iter().flatten().map(|r| r * r).sum();
    Ok(PoseFit { pose: state.poses[0], covariance, rms_px: (square / coordinates as f64).sqrt() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Brown;

    #[test]
    fn derivatives_match_finite_differences() {
        let camera = Camera {
            focal_px: 1200.0,
            principal_point_px: [400.0, 300.0],
            brown: Brown { k1: -0.3, k2: 0.2, k3: -0.1, p1: 2e-3, p2: -1e-3 },
        };
        let pose = Pose {
            rotation: Rotation3::from_euler_angles(0.3, -0.4, 0.8),
            translation: Vector3::new(-12.0, 7.0, 100.0),
        };
        let board = [23.0, 17.0];
        let (_, by_camera, by_pose) = project(&camera, &pose, board).unwrap();
        let e = 1e-6;
        for (k, p) in CameraParameter::ALL.iter().enumerate() {
            let at = |by: f64| {
                let mut c = camera;
                p.add(&mut c, by);
                project(&c, &pose, board).unwrap().0
            };
            let (up, down) = (at(e), at(-e));
            for l in 0..2 {
                let d = (up[l] - down[l]) / (2.0 * e);
                // Rounding of 400 px over 2e-6.
                assert!((d - by_camera[(l, k)]).abs() < 2e-6 * (1.0 + d.abs()), "{p:?} {l}");
            }
        }
        for k in 0..6 {
            let at = |by: f64| {
                let mut v = [0.0; 6];
                v[k] = by;
                project(&camera, &moved(&pose, &v), board).unwrap().0
            };
            let (up, down) = (at(e), at(-e));
            for l in 0..2 {
                let d = (up[l] - down[l]) / (2.0 * e);
                assert!((d - by_pose[(l, k)]).abs() < 2e-6 * (1.0 + d.abs()), "pose {k} {l}");
            }
        }
    }
}
