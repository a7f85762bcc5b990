//! Phase between pixels.

use super::map::PhaseMap;

/// Phase and its gradient at a position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sample {
    pub(super) phase: f64,
    /// Radians per pixel along x and y.
    pub(super) gradient: [f64; 2],
}

/// Weights and slopes of the cubic convolution (Keys 1981) at −1, 0, 1, 2 for 0 ≤ t ≤ 1; exact for
/// quadratics, and phases are smooth over the window, which is wider than a pitch.
fn keys(t: f64) -> ([f64; 4], [f64; 4]) {
    let (t2, t3) = (t * t, t * t * t);
    let value = [
        -0.5 * t + t2 - 0.5 * t3,
        1.0 - 2.5 * t2 + 1.5 * t3,
        0.5 * t + 2.0 * t2 - 1.5 * t3,
        -0.5 * t2 + 0.5 * t3,
    ];
    let slope = [-0.5 + 2.0 * t - 1.5 * t2, -5.0 * t + 4.5 * t2, 0.5 + 4.0 * t - 4.5 * t2, -t + 1.5 * t2];
    (value, slope)
}

impl PhaseMap {
    /// Phase at (x, y) among the pixels of part `label` of a map `width` pixels wide; `None` where
    /// one of the 4 × 4 pixels around does not belong to it.
    pub(super) fn sample(&self, width: usize, x: f64, y: f64, label: u32) -> Option<Sample> {
        let height = self.phase.len() / width;
        let (fx, fy) = (x.floor(), y.floor());
        // not-a-number is refused too
        let inside = fx >= 1.0 && fy >= 1.0 && fx + 2.0 < width as f64 && fy + 2.0 < height as f64;
        if !inside || label == 0 {
            return None;
        }
        let ((wx, sx), (wy, sy)) = (keys(x - fx), keys(y - fy));
        let first = (fy as usize - 1) * width + fx as usize - 1;
        let (mut phase, mut gx, mut gy) = (0.0, 0.0, 0.0);
        for j in 0..4 {
            let at = first + j * width;
            let row = &self.phase[at..at + 4];
            if self.label[at..at + 4].iter().any(|&l| l != label) {
                return None;
            }
            let (mut value, mut slope) = (0.0, 0.0);
            for i in 0..4 {
                value += wx[i] * row[i];
                slope += sx[i] * row[i];
            }
            phase += wy[j] * value;
            gx += wy[j] * slope;
            gy += sy[j] * value;
        }
        Some(Sample { phase, gradient: [gx, gy] })
    }

    /// Pixel nearest to (x, y).
    pub(super) fn pixel(&self, width: usize, x: f64, y: f64) -> Option<usize> {
        let height = self.phase.len() / width;
        let (i, j) = (x.round(), y.round());
        let inside = i >= 0.0 && j >= 0.0 && i < width as f64 && j < height as f64;
        inside.then(|| j as usize * width + i as usize)
    }
}

/// Solves G d = e for the 2 × 2 matrix whose rows are the gradients; returns the inverse.
pub(super) fn inverse(g: [[f64; 2]; 2]) -> Option<[[f64; 2]; 2]> {
    let d = g[0][0] * g[1][1] - g[0][1] * g[1][0];
    let size = g[0][0].hypot(g[0][1]) * g[1][0].hypot(g[1][1]);
    // directions closer than 6° do not determine a displacement
    if d.is_nan() || d.abs() <= 0.1 * size {
        return None;
    }
    Some([[g[1][1] / d, -g[0][1] / d], [-g[1][0] / d, g[0][0] / d]])
}
