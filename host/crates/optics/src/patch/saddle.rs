//! The corner at which four squares of a checkerboard meet.

use super::fit::{Fitted, Pixel, least_squares};

const X: usize = 0;
const Y: usize = 1;
/// Directions of the normals of the two edges, radians.
const N1: usize = 2;
const N2: usize = 3;
/// Width of the edges.
const EDGE: usize = 4;
/// Mean grey value and half the contrast.
const MEAN: usize = 5;
const HALF: usize = 6;
/// Relative gradient of the light along x, y.
const GX: usize = 7;
const GY: usize = 8;

/// A fitted corner.
#[derive(Clone, Debug)]
pub(crate) struct Corner {
    pub(crate) centre: [f64; 2],
    pub(crate) sigma: [f64; 2],
    /// Half the difference of bright and dark, grey levels.
    pub(crate) half: f64,
    /// Standard deviation of the residuals, grey levels.
    pub(crate) noise: f64,
}

/// Product of two blurred edges, under light with a gradient.
fn model(p: &[f64; 9], at: [f64; 2]) -> (f64, [f64; 9]) {
    let d = [at[0] - p[X], at[1] - p[Y]];
    let edge = |angle: f64| {
        let (s, c) = angle.sin_cos();
        let across = c * d[0] + s * d[1];
        let t = (across / p[EDGE]).tanh();
        let slope = (1.0 - t * t) / p[EDGE];
        // value; derivatives by x, y of the centre, angle, width
        (t, [-c * slope, -s * slope, (-s * d[0] + c * d[1]) * slope, -across / p[EDGE] * slope])
    };
    let ((t1, g1), (t2, g2)) = (edge(p[N1]), edge(p[N2]));
    let light = 1.0 + p[GX] * at[0] + p[GY] * at[1];
    let level = p[MEAN] + p[HALF] * t1 * t2;
    let k = light * p[HALF];
    let g = [
        k * (g1[0] * t2 + t1 * g2[0]),
        k * (g1[1] * t2 + t1 * g2[1]),
        k * g1[2] * t2,
        k * t1 * g2[2],
        k * (g1[3] * t2 + t1 * g2[3]),
        light,
        light * t1 * t2,
        level * at[0],
        level * at[1],
    ];
    (light * level, g)
}

/// Fits a corner to pixels given relative to `origin`; `edges` are the directions *along* the two
/// edges, `width` the expected width of the edges, `levels` mean and half contrast, the latter
/// positive where the sector between the two directions is bright.
pub(crate) fn fit(
    pixels: &[Pixel],
    origin: [f64; 2],
    edges: [[f64; 2]; 2],
    width: f64,
    levels: [f64; 2],
    reach: f64,
) -> Option<Corner> {
    // The normals such that the sector between both directions is positive for both edges.
    let [a, b] = edges;
    let turn = a[0] * b[1] - a[1] * b[0];
    let normal_a = if turn > 0.0 { [-a[1], a[0]] } else { [a[1], -a[0]] };
    let normal_b = if turn > 0.0 { [b[1], -b[0]] } else { [-b[1], b[0]] };
    let angle = |n: [f64; 2]| n[1].atan2(n[0]);
    let start = [0.0, 0.0, angle(normal_a), angle(normal_b), width, levels[0], levels[1], 0.0, 0.0];
    let valid = |p: &[f64; 9]| p[X].hypot(p[Y]) < reach && p[EDGE] > 0.05 && p[EDGE] < 20.0;
    let Fitted { parameters: p, covariance, noise } = least_squares(pixels, start, model, valid)?;
    Some(Corner {
        centre: [origin[0] + p[X], origin[1] + p[Y]],
        sigma: [covariance[(X, X)].sqrt(), covariance[(Y, Y)].sqrt()],
        half: p[HALF],
        noise,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::patch::fit::tests::gradient_error;

    #[test]
    fn gradient_matches_finite_differences() {
        let p = [0.3, -0.2, 0.4, 1.7, 1.1, 120.0, 55.0, 0.003, -0.002];
        let at: Vec<[f64; 2]> =
            (0..25).map(|k| [f64::from(k % 5) * 2.1 - 4.0, f64::from(k / 5) * 1.9 - 4.1]).collect();
        let worst = gradient_error(model, p, &at);
        // Rounding of the differences.
        assert!(worst < 1e-6, "{worst}");
    }
}
