//! Discrete orthogonal polynomials of an equidistant stretch of points, after Gram.

/// Polynomials p₀…p_n, orthogonal over t_k = (k − (L − 1)/2) / half, k = 0…L − 1, by the recurrence
/// p_{a+1}(t) = t p_a(t) − β_a p_{a−1}(t).
#[derive(Debug, Clone)]
pub(crate) struct Gram {
    half: f64,
    centre: f64,
    /// p_a(t_k).
    pub(crate) values: Vec<Vec<f64>>,
    /// Σ_k p_a(t_k)².
    pub(crate) norms: Vec<f64>,
    beta: Vec<f64>,
}

/// Most polynomials: degree 4.
pub(crate) const MOST: usize = 5;

impl Gram {
    /// Polynomials up to `degree` over `length` points; `None` if there are too few points.
    pub(crate) fn new(length: usize, degree: usize) -> Option<Self> {
        if length <= degree {
            return None;
        }
        let centre = (length as f64 - 1.0) / 2.0;
        let half = centre.max(0.5);
        let t = |k: usize| (k as f64 - centre) / half;
        let mut values = vec![vec![1.0; length]];
        let mut norms = vec![length as f64];
        let mut beta = vec![0.0];
        for a in 0..degree {
            let next: Vec<f64> = (0..length)
                .map(|k| t(k) * values[a][k] - if a == 0 { 0.0 } else { beta[a] * values[a - 1][k] })
                .collect();
            let norm: f64 = next.iter().map(|p| p * p).sum();
            beta.push(norm / norms[a]);
            norms.push(norm);
            values.push(next);
        }
        Some(Self { half, centre, values, norms, beta })
    }

    /// Values and slopes (per point of the grid) at point k, divided by the norms: what turns the
    /// moments Σ p_a f into the fitted value and slope.
    pub(crate) fn at(&self, k: usize) -> ([f64; MOST], [f64; MOST]) {
        let t = (k as f64 - self.centre) / self.half;
        let (mut p, mut d) = ([0.0; MOST], [0.0; MOST]);
        p[0] = 1.0;
        for a in 0..self.norms.len() - 1 {
            let (before, slope_before) = if a == 0 { (0.0, 0.0) } else { (p[a - 1], d[a - 1]) };
            p[a + 1] = t * p[a] - self.beta[a] * before;
            d[a + 1] = p[a] + t * d[a] - self.beta[a] * slope_before;
        }
        for a in 0..self.norms.len() {
            p[a] /= self.norms[a];
            d[a] /= self.norms[a] * self.half;
        }
        (p, d)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orthogonal_and_exact_on_polynomials() {
        for length in [2usize, 3, 5, 6, 15, 41] {
            for degree in 0..=4.min(length - 1) {
                let g = Gram::new(length, degree).unwrap();
                for a in 0..=degree {
                    for b in 0..a {
                        let dot: f64 = (0..length).map(|k| g.values[a][k] * g.values[b][k]).sum();
                        assert!(dot.abs() < 1e-12 * (g.norms[a] * g.norms[b]).sqrt(), "{length} {a} {b}");
                    }
                }
                // (k + 1)^degree and its derivative come back at every point
                for k in 0..length {
                    let (p, d) = g.at(k);
                    let f = |k: f64| (k + 1.0).powi(degree as i32);
                    let moment =
                        |a: usize| -> f64 { (0..length).map(|k| g.values[a][k] * f(k as f64)).sum() };
                    let value: f64 = (0..=degree).map(|a| p[a] * moment(a)).sum();
                    let slope: f64 = (0..=degree).map(|a| d[a] * moment(a)).sum();
                    let truth = f(k as f64);
                    let scale = f(length as f64);
                    assert!((value - truth).abs() < 1e-11 * scale, "{length} {degree} {k}");
                    let truth = degree as f64 * (k as f64 + 1.0).powi(degree as i32 - 1);
                    assert!((slope - truth).abs() < 1e-10 * scale, "{length} {degree} {k}: {slope} {truth}");
                }
            }
        }
        assert!(Gram::new(4, 4).is_none());
    }
}
