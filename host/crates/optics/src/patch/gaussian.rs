//! A bright spot: an elliptic Gaussian on a background that changes linearly.

use super::ellipse::{Form, quadratic};
use super::fit::{Fitted, Pixel, least_squares};

/// A fitted spot.
#[derive(Clone, Debug)]
pub(crate) struct GaussianSpot {
    pub(crate) centre: [f64; 2],
    pub(crate) sigma: [f64; 2],
    /// Of the exponent −dᵀ A d / 2.
    pub(crate) form: Form,
    pub(crate) peak: f64,
    pub(crate) noise: f64,
}

/// x, y, a11, a12, a22, peak, background, its gradient along x, y.
fn model(p: &[f64; 9], at: [f64; 2]) -> (f64, [f64; 9]) {
    let d = [at[0] - p[0], at[1] - p[1]];
    let e = (-0.5 * quadratic([p[2], p[3], p[4]], d)).exp();
    let v = p[5] * e;
    let g = [
        v * (p[2] * d[0] + p[3] * d[1]),
        v * (p[3] * d[0] + p[4] * d[1]),
        -0.5 * v * d[0] * d[0],
        -v * d[0] * d[1],
        -0.5 * v * d[1] * d[1],
        e,
        1.0,
        at[0],
        at[1],
    ];
    (v + p[6] + p[7] * at[0] + p[8] * at[1], g)
}

/// Fits a spot to pixels given relative to `origin`; pixels where it is saturated are to be left
/// out by the caller.
pub(crate) fn fit(
    pixels: &[Pixel],
    origin: [f64; 2],
    form: Form,
    peak: f64,
    background: f64,
    reach: f64,
) -> Option<GaussianSpot> {
    let start = [0.0, 0.0, form[0], form[1], form[2], peak, background, 0.0, 0.0];
    let valid = |p: &[f64; 9]| {
        p[0].hypot(p[1]) < reach && p[2] > 0.0 && p[2] * p[4] > p[3] * p[3] && p[2].max(p[4]) < 20.0
    };
    let Fitted { parameters: p, covariance, noise } = least_squares(pixels, start, model, valid)?;
    Some(GaussianSpot {
        centre: [origin[0] + p[0], origin[1] + p[1]],
        sigma: [covariance[(0, 0)].sqrt(), covariance[(1, 1)].sqrt()],
        form: [p[2], p[3], p[4]],
        peak: p[5],
        noise,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::patch::fit::tests::gradient_error;

    #[test]
    fn gradient_matches_finite_differences() {
        let p = [0.3, -0.2, 0.1, 0.02, 0.15, 900.0, 55.0, 0.3, -0.2];
        let at: Vec<[f64; 2]> =
            (0..25).map(|k| [f64::from(k % 5) * 2.1 - 4.0, f64::from(k / 5) * 1.9 - 4.1]).collect();
        let worst = gradient_error(model, p, &at);
        // Rounding of the differences.
        assert!(worst < 1e-6, "{worst}");
    }
}
