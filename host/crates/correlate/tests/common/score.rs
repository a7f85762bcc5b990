//! Truth of the golden displacement fields and the measures taken on them: bias and scatter, and the
//! period at which a wave of the star is attenuated by a tenth.
#![allow(dead_code)] // each user takes its own part

/// Displacement (u, v), in pixels, of the material at (x, y) of the reference image of `size` ×
/// `size` pixels; `None` for an unknown field.
pub fn truth(field: &str, size: usize, x: f64, y: f64) -> Option<(f64, f64)> {
    let tau = std::f64::consts::TAU;
    let centre = 0.5 * (size as f64 - 1.0);
    let (dx, dy) = (x - centre, y - centre);
    Some(match field {
        "t02" => (0.2, 0.0),
        "t05" => (0.5, 0.0),
        "aff1" => (0.01 * dx + 0.002 * dy, 0.002 * dx - 0.003 * dy),
        "quad" => {
            let (a, b, c) = (4e-5, 1e-5, -2e-5);
            (a * dx * dx + b * dx * dy + c * dy * dy, 0.5 * (a * dy * dy + b * dx * dy + c * dx * dx))
        }
        "sin60" => (0.5 * (tau * x / 60.0).sin(), 0.5 * (tau * y / 60.0).sin()),
        "star" => (0.0, 0.5 * (tau * dy / star_period(size, x)).cos()),
        "step" => (if dy > 0.0 { 1.0 } else { -1.0 }, 0.0),
        _ => return None,
    })
}

/// Period of the star's wave at column x.
pub fn star_period(size: usize, x: f64) -> f64 {
    (10.0 + 140.0 * x / (size as f64 - 1.0)).max(10.0)
}

/// Errors above this are counted as outliers and left out of bias and scatter, pixels.
pub const OUTLIER: f64 = 0.5;

/// Errors of the accepted points, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Points.
    pub points: usize,
    /// Points that claim to be right.
    pub ok: usize,
    /// Those of them that are off by more than [`OUTLIER`].
    pub outliers: usize,
    /// Mean error of u and of v.
    pub bias: [f64; 2],
    /// Standard deviation of the error of u and of v.
    pub scatter: [f64; 2],
}

impl Score {
    /// Bias and scatter in words.
    pub fn line(&self) -> String {
        let ([bu, bv], [su, sv]) = (self.bias, self.scatter);
        format!("u {bu:.2e} ± {su:.3e}, v {bv:.2e} ± {sv:.3e} px")
    }
}

/// Scores points (x, y, u, v, accepted).
pub fn score(field: &str, size: usize, points: &[([f64; 4], bool)]) -> Option<Score> {
    let mut errors = Vec::with_capacity(points.len());
    let mut ok = 0;
    for &([x, y, u, v], accepted) in points {
        if accepted && u.is_finite() && v.is_finite() {
            ok += 1;
            let t = truth(field, size, x, y)?;
            let e = [u - t.0, v - t.1];
            if e[0].hypot(e[1]) <= OUTLIER {
                errors.push(e);
            }
        }
    }
    let n = errors.len() as f64;
    let mean = |f: &dyn Fn(&[f64; 2]) -> f64| errors.iter().map(f).sum::<f64>() / n;
    let bias = [0, 1].map(|c| mean(&|e| e[c]));
    let scatter = [0, 1].map(|c| mean(&|e| (e[c] - bias[c]).powi(2)).sqrt());
    Some(Score { points: points.len(), ok, outliers: ok - errors.len(), bias, scatter })
}

/// Longest period of the star at which the measured amplitude of the row of points nearest the
/// centre, smoothed over seven points, is below nine tenths of the true one; the shortest period
/// looked at where none is. NaN without enough points.
pub fn star_period_at_tenth(size: usize, points: &[([f64; 4], bool)]) -> f64 {
    const SMOOTHED: usize = 7;
    let centre = 0.5 * (size as f64 - 1.0);
    let ok = || points.iter().filter(|p| p.1).map(|p| p.0);
    let Some(row) = ok().map(|p| p[1]).min_by(|a, b| (a - centre).abs().total_cmp(&(b - centre).abs()))
    else {
        return f64::NAN;
    };
    let mut line: Vec<(f64, f64)> = ok()
        .filter(|p| p[1] == row)
        .map(|[x, y, _, v]| {
            let true_v = truth("star", size, x, y).map_or(f64::NAN, |t| t.1);
            (star_period(size, x), v / true_v)
        })
        .collect();
    line.sort_by(|a, b| a.0.total_cmp(&b.0));
    // the windows that lie whole in the row, without the seven points at either end
    let half = SMOOTHED / 2;
    let smooth: Vec<(f64, f64)> = (SMOOTHED..line.len().saturating_sub(SMOOTHED))
        .map(|k| {
            let sum: f64 = line[k - half..=k + half].iter().map(|p| p.1).sum();
            (line[k].0, sum / SMOOTHED as f64)
        })
        .collect();
    let attenuated = smooth.iter().rev().find(|p| p.1 < 0.9);
    attenuated.or(smooth.first()).map_or(f64::NAN, |p| p.0)
}
