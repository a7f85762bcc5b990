//! An ellipse of uniform brightness with a blurred edge.

use super::fit::{Fitted, Pixel, least_squares};

/// Index of the parameters; positions relative to the patch.
pub(crate) const X: usize = 0;
pub(crate) const Y: usize = 1;
/// Entries of the form A of the ellipse dᵀ A d = 1.
const A11: usize = 2;
const A12: usize = 3;
const A22: usize = 4;
/// Width of the edge.
const EDGE: usize = 5;
/// Grey values outside and inside.
pub(crate) const OUTSIDE: usize = 6;
pub(crate) const INSIDE: usize = 7;
/// Relative gradient of the light along x, y.
const GX: usize = 8;
const GY: usize = 9;

/// A symmetric 2×2 form [a11, a12, a22].
pub(crate) type Form = [f64; 3];

pub(crate) fn quadratic(a: Form, d: [f64; 2]) -> f64 {
    a[0] * d[0] * d[0] + 2.0 * a[1] * d[0] * d[1] + a[2] * d[1] * d[1]
}

/// A fitted ellipse.
#[derive(Clone, Debug)]
pub(crate) struct Ellipse {
    pub(crate) centre: [f64; 2],
    pub(crate) sigma: [f64; 2],
    pub(crate) form: Form,
    /// Inside minus outside, grey levels.
    pub(crate) contrast: f64,
    /// Standard deviation of the residuals, grey levels.
    pub(crate) noise: f64,
}

impl Ellipse {
    /// Semi-axes, the larger first.
    pub(crate) fn semi_axes(form: Form) -> [f64; 2] {
        let mean = 0.5 * (form[0] + form[2]);
        let half = (0.25 * (form[0] - form[2]).powi(2) + form[1] * form[1]).sqrt();
        [1.0 / (mean - half).max(1e-12).sqrt(), 1.0 / (mean + half).sqrt()]
    }
}

/// Brightness at `at` and its derivatives.
fn model(p: &[f64; 10], at: [f64; 2]) -> (f64, [f64; 10]) {
    let d = [at[0] - p[X], at[1] - p[Y]];
    let m = [p[A11] * d[0] + p[A12] * d[1], p[A12] * d[0] + p[A22] * d[1]];
    let q = d[0] * m[0] + d[1] * m[1];
    let light = 1.0 + p[GX] * at[0] + p[GY] * at[1];
    let range = p[INSIDE] - p[OUTSIDE];
    let mut g = [0.0; 10];
    let mut cover = 1.0;
    // At the very centre the distance to the edge has no gradient, and does not matter.
    if q > 1e-6 {
        let root = q.sqrt();
        let norm = (m[0] * m[0] + m[1] * m[1]).sqrt();
        // Distance to the edge to first order (Sampson).
        let distance = (q - root) / norm;
        let t = (distance / p[EDGE]).tanh();
        cover = 0.5 * (1.0 - t);
        let by_distance = -0.5 * (1.0 - t * t) / p[EDGE] * light * range;
        let by_q = (1.0 - 0.5 / root) / norm * by_distance;
        let by_m = |n: [f64; 2]| -distance * (m[0] * n[0] + m[1] * n[1]) / (norm * norm) * by_distance;
        g[X] = -2.0 * m[0] * by_q + by_m([-p[A11], -p[A12]]);
        g[Y] = -2.0 * m[1] * by_q + by_m([-p[A12], -p[A22]]);
        g[A11] = d[0] * d[0] * by_q + by_m([d[0], 0.0]);
        g[A12] = 2.0 * d[0] * d[1] * by_q + by_m([d[1], d[0]]);
        g[A22] = d[1] * d[1] * by_q + by_m([0.0, d[1]]);
        g[EDGE] = -distance / p[EDGE] * by_distance;
    }
    let level = p[OUTSIDE] + range * cover;
    g[OUTSIDE] = light * (1.0 - cover);
    g[INSIDE] = light * cover;
    g[GX] = level * at[0];
    g[GY] = level * at[1];
    (light * level, g)
}

/// Fits the model to pixels given relative to `origin`, which is near the centre.
pub(crate) fn fit(pixels: &[Pixel], origin: [f64; 2], form: Form, levels: [f64; 2]) -> Option<Ellipse> {
    let [outside, inside] = levels;
    let start = [0.0, 0.0, form[0], form[1], form[2], 1.0, outside, inside, 0.0, 0.0];
    let [long, short] = Ellipse::semi_axes(form);
    let valid = |p: &[f64; 10]| {
        let [a, b] = Ellipse::semi_axes([p[A11], p[A12], p[A22]]);
        p[A11] * p[A22] > p[A12] * p[A12]
            && p[A11] > 0.0
            && p[X].hypot(p[Y]) < short
            && a < 2.0 * long
            && b > 0.5 * short
            && p[EDGE] > 0.05
            && p[EDGE] < 2.0 * long
    };
    let Fitted { parameters: p, covariance, noise } = least_squares(pixels, start, model, valid)?;
    Some(Ellipse {
        centre: [origin[0] + p[X], origin[1] + p[Y]],
        sigma: [covariance[(X, X)].sqrt(), covariance[(Y, Y)].sqrt()],
        form: [p[A11], p[A12], p[A22]],
        contrast: p[INSIDE] - p[OUTSIDE],
        noise,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::patch::fit::tests::gradient_error;

    #[test]
    fn gradient_matches_finite_differences() {
        let p = [0.3, -0.2, 0.04, 0.01, 0.07, 0.9, 150.0, 40.0, 0.003, -0.002];
        let at: Vec<[f64; 2]> =
            (0..25).map(|k| [f64::from(k % 5) * 2.1 - 4.0, f64::from(k / 5) * 1.9 - 4.1]).collect();
        let worst = gradient_error(model, p, &at);
        // Measured 1.1e-7: rounding of the differences (step 1e-8 on the form's entries).
        assert!(worst < 1e-5, "{worst}");
    }
}
