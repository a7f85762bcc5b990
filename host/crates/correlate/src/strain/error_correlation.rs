//! How the errors of neighbouring points are correlated: overlapping subsets share pixels and with them
//! noise.
//!
//! To first order the error of the displacement at the centre of a subset is Σ w(p) f_x(p) n(p) / Σ w f_x²,
//! with w the weights with which the shape function's value at the centre follows from the pixels: constant
//! for order 0 and 1, the quadratic smoothing kernel for order 2. Over many speckles the correlation of two
//! subsets d apart is the autocorrelation of w: for order 0 and 1 the overlapping part of the area,
//! (1 − |d_x|/S)(1 − |d_y|/S).

use crate::shape::Shape;

/// Correlation ρ(i, j) between nodes i columns and j rows apart, as Σ_t x_t(|i|) y_t(|j|).
#[derive(Debug, Clone)]
pub(crate) struct ErrorCorrelation {
    /// Pairs of functions of the lag in nodes; zero beyond their ends.
    pub(crate) terms: Vec<(Vec<f64>, Vec<f64>)>,
}

/// Σ_x f(x) g(x + lag) for functions of the pixels of a subset, linear between whole pixels.
fn overlap(f: &[f64], g: &[f64], lag: f64) -> f64 {
    let whole = |lag: usize| -> f64 { f.iter().zip(g.iter().skip(lag)).map(|(a, b)| a * b).sum() };
    let (low, part) = (lag.floor() as usize, lag - lag.floor());
    if part == 0.0 { whole(low) } else { (1.0 - part) * whole(low) + part * whole(low + 1) }
}

/// The weights with which the value of the shape function at the centre follows from the pixels of a
/// square of side S, as k(x) + k(y); for a constant kernel k = 1/2.
fn kernel(subset: usize, shape: Shape) -> Vec<f64> {
    let s = subset as f64;
    if shape != Shape::Quadratic || subset < 3 {
        return vec![0.5; subset];
    }
    let x = |k: usize| k as f64 - (s - 1.0) / 2.0;
    let mean = (0..subset).map(|k| x(k) * x(k)).sum::<f64>() / s;
    let norm: f64 = (0..subset).map(|k| (x(k) * x(k) - mean).powi(2)).sum();
    // 1/S² + p₂(0) p₂(x)/(N₂ S) + the same of y, times S²
    (0..subset).map(|k| 0.5 - s * mean * (x(k) * x(k) - mean) / norm).collect()
}

impl ErrorCorrelation {
    pub(crate) fn new(subset: usize, shape: Shape, step: f64) -> Self {
        let k = kernel(subset, shape);
        let one = vec![1.0; subset];
        let lags = ((subset as f64 / step).ceil() as usize).min(subset.max(1));
        let along = |f: &[f64], g: &[f64]| -> Vec<f64> {
            (0..=lags).map(|n| overlap(f, g, n as f64 * step)).collect()
        };
        let (p, q, c) = (along(&k, &k), along(&one, &one), along(&k, &one));
        let at_zero = 2.0 * (p[0] * q[0] + c[0] * c[0]);
        let scaled =
            |v: &[f64], factor: f64| -> Vec<f64> { v.iter().map(|x| x * factor / at_zero).collect() };
        let terms = if shape == Shape::Quadratic {
            vec![(scaled(&p, 1.0), q.clone()), (scaled(&q, 1.0), p), (scaled(&c, 2.0), c)]
        } else {
            // the three terms of a constant kernel are one
            let triangle: Vec<f64> = q.iter().map(|x| x / q[0]).collect();
            vec![(triangle.clone(), triangle)]
        };
        Self { terms }
    }

    /// Correlation at a lag in nodes.
    pub(crate) fn at(&self, i: usize, j: usize) -> f64 {
        let get = |v: &[f64], n: usize| v.get(n).copied().unwrap_or(0.0);
        self.terms.iter().map(|(x, y)| get(x, i) * get(y, j)).sum()
    }

    /// Σ_kl w_k w_l ρ_kl for weights of `width` columns, row by row; `scratch` is used and overwritten.
    pub(crate) fn quadratic_form(&self, a: &[f64], b: &[f64], width: usize, scratch: &mut Vec<f64>) -> f64 {
        let height = a.len() / width;
        let mut total = 0.0;
        for (along_x, along_y) in &self.terms {
            scratch.clear();
            scratch.resize(a.len(), 0.0);
            for (row, out) in a.chunks_exact(width).zip(scratch.chunks_exact_mut(width)) {
                for (i, out) in out.iter_mut().enumerate() {
                    let mut sum = along_x[0] * row[i];
                    for (n, r) in along_x.iter().enumerate().skip(1) {
                        if i >= n {
                            sum += r * row[i - n];
                        }
                        if i + n < width {
                            sum += r * row[i + n];
                        }
                    }
                    *out = sum;
                }
            }
            for j in 0..height {
                let b_row = &b[j * width..(j + 1) * width];
                for (n, r) in along_y.iter().enumerate() {
                    let dot = |m: usize| -> f64 {
                        scratch[m * width..(m + 1) * width].iter().zip(b_row).map(|(x, y)| x * y).sum()
                    };
                    if j >= n {
                        total += r * dot(j - n);
                    }
                    if n > 0 && j + n < height {
                        total += r * dot(j + n);
                    }
                }
            }
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangle_for_affine_and_unit_at_zero() {
        let r = ErrorCorrelation::new(33, Shape::Affine, 5.0);
        assert!((r.at(0, 0) - 1.0).abs() < 1e-12);
        assert!((r.at(2, 3) - (1.0 - 10.0 / 33.0) * (1.0 - 15.0 / 33.0)).abs() < 1e-12);
        assert_eq!(r.at(7, 0), 0.0);
        let r = ErrorCorrelation::new(33, Shape::Quadratic, 4.0);
        assert!((r.at(0, 0) - 1.0).abs() < 1e-12);
        // the definition, pixel by pixel
        let k = kernel(33, Shape::Quadratic);
        let w = |x: usize, y: usize| k[x] + k[y];
        let at = |dx: usize, dy: usize| -> f64 {
            (0..33 - dx)
                .flat_map(|x| (0..33 - dy).map(move |y| (x, y)))
                .map(|(x, y)| w(x, y) * w(x + dx, y + dy))
                .sum()
        };
        assert!((r.at(3, 2) - at(12, 8) / at(0, 0)).abs() < 1e-12);
        // the kernel reproduces constants and ignores curvature
        let sum: f64 = (0..33).flat_map(|x| (0..33).map(move |y| (x, y))).map(|(x, y)| w(x, y)).sum();
        let bent: f64 = (0..33)
            .flat_map(|x| (0..33).map(move |y| (x, y)))
            .map(|(x, y)| w(x, y) * (x as f64 - 16.0).powi(2))
            .sum();
        assert!((sum / (33.0 * 33.0) - 1.0).abs() < 1e-12 && bent.abs() < 1e-6, "{sum} {bent}");
    }

    #[test]
    fn quadratic_form_is_the_double_sum() {
        for shape in [Shape::Affine, Shape::Quadratic] {
            let r = ErrorCorrelation::new(21, shape, 5.0);
            let (width, height) = (7usize, 5usize);
            let a: Vec<f64> = (0..35).map(|k| f64::from(k * k % 11) - 4.0).collect();
            let b: Vec<f64> = (0..35).map(|k| f64::from(k * 7 % 13) - 5.0).collect();
            let mut sum = 0.0;
            for k in 0..width * height {
                for l in 0..width * height {
                    let (i, j) = ((k % width).abs_diff(l % width), (k / width).abs_diff(l / width));
                    sum += a[k] * b[l] * r.at(i, j);
                }
            }
            let found = r.quadratic_form(&a, &b, width, &mut Vec::new());
            assert!((found - sum).abs() < 1e-9 * sum.abs().max(1.0), "{found} {sum}");
        }
    }
}
