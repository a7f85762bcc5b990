//! Root mean squares and registration.

use nalgebra::{Matrix6, Rotation3, SymmetricEigen, Vector3, Vector6};

/// Root of the mean square; NaN of nothing.
pub fn rms(values: impl IntoIterator<Item = f64>) -> f64 {
    let (n, sum) = values.into_iter().fold((0u64, 0.0), |(n, sum), v| (n + 1, sum + v * v));
    (sum / n as f64).sqrt()
}

/// Largest magnitude; 0 of nothing.
pub fn largest(values: impl IntoIterator<Item = f64>) -> f64 {
    values.into_iter().fold(0.0, |m, v| m.max(v.abs()))
}

/// A quadratic in x and y.
#[derive(Clone, Copy, Debug)]
pub struct Quadratic {
    centre: [f64; 2],
    scale: f64,
    terms: Vector6<f64>,
}

impl Quadratic {
    /// How many coefficients it has.
    pub const TERMS: usize = 6;

    /// Least squares; none if the places do not determine it.
    pub fn fit(at: &[[f64; 2]], values: &[f64]) -> Option<Self> {
        let n = at.len() as f64;
        let centre = [0, 1].map(|i| at.iter().map(|p| p[i]).sum::<f64>() / n);
        let scale = rms(at.iter().map(|p| (p[0] - centre[0]).hypot(p[1] - centre[1])));
        let mut found = Self { centre, scale, terms: Vector6::zeros() };
        let mut normal = Matrix6::zeros();
        let mut right = Vector6::zeros();
        for (p, value) in at.iter().zip(values) {
            let by = found.basis(*p);
            normal += by * by.transpose();
            right += by * *value;
        }
        found.terms = normal.cholesky()?.solve(&right);
        found.terms.iter().all(|t| t.is_finite()).then_some(found)
    }

    fn basis(&self, at: [f64; 2]) -> Vector6<f64> {
        let [x, y] = [0, 1].map(|i| (at[i] - self.centre[i]) / self.scale);
        Vector6::new(1.0, x, y, x * x, x * y, y * y)
    }

    /// Its value.
    pub fn at(&self, at: [f64; 2]) -> f64 {
        self.basis(at).dot(&self.terms)
    }
}

/// Steps of the registration: quadratic convergence from a few tenths of the field.
const STEPS: usize = 8;
/// Motions that change the heights this much less than others (as a square) are left alone: a cylinder
/// cannot be shifted along its axis.
const LEAST: f64 = 1e-6;

/// The rigid motion q = R (p − c) + c + t that lays measured points upon a surface.
#[derive(Clone, Copy, Debug)]
pub struct Registration {
    rotation: Rotation3<f64>,
    centre: Vector3<f64>,
    translation: Vector3<f64>,
}

impl Registration {
    /// The rigid motion that minimises the squared height differences of the points to `surface`, as
    /// the thesis registers its profiles. Motions that the surface does not show are left out.
    pub fn of(points: &[[f64; 3]], surface: &dyn Fn(f64, f64) -> f64) -> Self {
        let n = points.len() as f64;
        let centre = points.iter().map(|p| Vector3::from(*p)).sum::<Vector3<f64>>() / n;
        let reach = rms(points.iter().map(|p| (p[0] - centre.x).hypot(p[1] - centre.y)));
        let mut found = Self { rotation: Rotation3::identity(), centre, translation: Vector3::zeros() };
        for _ in 0..STEPS {
            let mut normal = Matrix6::zeros();
            let mut right = Vector6::zeros();
            for p in points {
                let q = found.of_point(*p);
                let (residual, slope) = difference(q, surface, 1e-3 * reach);
                let arm = (Vector3::from(q) - centre - found.translation) / reach;
                // derivatives of h − H(x, y) by rotations ω × arm and translations, all in millimetres
                let by = Vector6::new(
                    arm.y + slope[1] * arm.z,
                    -arm.x - slope[0] * arm.z,
                    slope[0] * arm.y - slope[1] * arm.x,
                    -slope[0],
                    -slope[1],
                    1.0,
                );
                normal += by * by.transpose();
                right += by * residual;
            }
            let eigen = SymmetricEigen::new(normal);
            let limit = LEAST * eigen.eigenvalues.max();
            let mut step = Vector6::zeros();
            for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
                if *value > limit {
                    step -= vector * (vector.dot(&right) / value);
                }
            }
            let turn = Vector3::new(step[0], step[1], step[2]) / reach;
            found.rotation = Rotation3::new(turn) * found.rotation;
            found.translation += Vector3::new(step[3], step[4], step[5]);
        }
        found
    }

    /// A point after the motion.
    pub fn of_point(&self, p: [f64; 3]) -> [f64; 3] {
        (self.rotation * (Vector3::from(p) - self.centre) + self.centre + self.translation).into()
    }
}

/// h − H(x, y) and the slope of H by central differences.
fn difference(p: [f64; 3], surface: &dyn Fn(f64, f64) -> f64, step: f64) -> (f64, [f64; 2]) {
    let [x, y, h] = p;
    let slope = [
        (surface(x + step, y) - surface(x - step, y)) / (2.0 * step),
        (surface(x, y + step) - surface(x, y - step)) / (2.0 * step),
    ];
    (h - surface(x, y), slope)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of a sphere that were shifted and turned come back to it; the turn about its centre
    /// cannot be seen and is left alone.
    #[test]
    fn registration_undoes_a_rigid_motion() {
        let sphere = |x: f64, y: f64| (0.34f64.powi(2) - x * x - y * y).sqrt() - 0.34;
        let turn = Rotation3::from_euler_angles(0.02, -0.01, 0.03);
        let points: Vec<[f64; 3]> = (0..400)
            .map(|k| {
                let (x, y) = (0.015 * f64::from(k % 20) - 0.14, 0.014 * f64::from(k / 20) - 0.13);
                (turn * Vector3::new(x, y, sphere(x, y)) + Vector3::new(0.004, -0.003, 0.005)).into()
            })
            .collect();
        let found = Registration::of(&points, &sphere);
        let left = largest(points.iter().map(|p| {
            let [x, y, h] = found.of_point(*p);
            h - sphere(x, y)
        }));
        assert!(left < 1e-12, "{left}");
    }
}
