//! Normal equations of a subset: at most twelve unknowns, in double precision.

use crate::subset::{Subset, monomial};

/// Parameters of the largest shape function.
pub(crate) const MAX: usize = 12;

/// Cholesky factor of the normal matrix.
#[derive(Debug, Clone)]
pub(crate) struct Normal {
    n: usize,
    /// Lower triangle, diagonal inverted.
    l: [[f64; MAX]; MAX],
}

/// Exponents of the monomials of one displacement component.
pub(crate) const EXPONENTS: [(usize, usize); 6] = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)];

impl Normal {
    /// Normal matrix of a subset, m parameters per component, mean removed; `None` where it is not
    /// safely positive definite.
    pub(crate) fn new(subset: &Subset, m: usize, pixels: f64) -> Option<Self> {
        Self::factor(Self::matrix(subset, m, pixels), 2 * m)
    }

    /// Lower triangle of that matrix.
    pub(crate) fn matrix(subset: &Subset, m: usize, pixels: f64) -> [[f64; MAX]; MAX] {
        let n = 2 * m;
        let mut h = [[0.0; MAX]; MAX];
        for a in 0..n {
            for b in 0..=a {
                let ((ia, ja), (ib, jb)) = (EXPONENTS[a % m], EXPONENTS[b % m]);
                let (ca, cb) = (a / m, b / m);
                h[a][b] = subset.products[ca + cb][monomial(ia + ib, ja + jb)]
                    - subset.slopes[ca][a % m] * subset.slopes[cb][b % m] / pixels;
            }
        }
        h
    }

    /// Cholesky factor of the first n rows and columns; `None` where they are not safely positive
    /// definite.
    pub(crate) fn factor(mut l: [[f64; MAX]; MAX], n: usize) -> Option<Self> {
        for j in 0..n {
            let original = l[j][j];
            let mut d = original;
            for k in 0..j {
                d -= l[j][k] * l[j][k];
            }
            // single-precision sums: a pivot below 1e-5 of its diagonal is rounding
            if !(d.is_finite() && d > 1e-5 * original) {
                return None;
            }
            let inv = 1.0 / d.sqrt();
            for i in j + 1..n {
                let mut t = l[i][j];
                for k in 0..j {
                    t -= l[i][k] * l[j][k];
                }
                l[i][j] = t * inv;
            }
            l[j][j] = inv;
        }
        Some(Self { n, l })
    }

    /// Least ratio of a pivot to the same of another matrix.
    pub(crate) fn least_part_of(&self, other: &Self) -> f64 {
        // the inverted diagonals are the roots of the pivots' inverses
        (0..self.n).map(|j| (other.l[j][j] / self.l[j][j]).powi(2)).fold(f64::INFINITY, f64::min)
    }

    /// Solves H x = b.
    pub(crate) fn solve(&self, mut b: [f64; MAX]) -> [f64; MAX] {
        let (n, l) = (self.n, &self.l);
        for i in 0..n {
            for j in 0..i {
                b[i] -= l[i][j] * b[j];
            }
            b[i] *= l[i][i];
        }
        for i in (0..n).rev() {
            for j in i + 1..n {
                b[i] -= l[j][i] * b[j];
            }
            b[i] *= l[i][i];
        }
        b
    }

    /// cᵀ H⁻¹ c.
    pub(crate) fn quadratic_form(&self, c: [f64; MAX]) -> f64 {
        let x = self.solve(c);
        x.iter().zip(&c).map(|(a, b)| a * b).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_what_was_multiplied() {
        let n = MAX;
        let mut h = [[0.0; MAX]; MAX];
        for (i, row) in h.iter_mut().enumerate() {
            for (j, e) in row.iter_mut().enumerate() {
                *e = 1.0 / (1.0 + i.abs_diff(j) as f64) + if i == j { 2.0 } else { 0.0 };
            }
        }
        let x: [f64; MAX] = std::array::from_fn(|i| (i as f64 - 4.5) * 0.7);
        let mut b = [0.0; MAX];
        for i in 0..n {
            for j in 0..n {
                b[i] += h[i][j] * x[j];
            }
        }
        let normal = Normal::factor(h, n).unwrap();
        for (a, e) in normal.solve(b).iter().zip(&x) {
            assert!((a - e).abs() < 1e-12);
        }
        let expected: f64 = b.iter().zip(&x).map(|(a, e)| a * e).sum();
        assert!((normal.quadratic_form(b) - expected).abs() < 1e-9);
    }

    #[test]
    fn singular_matrix_is_refused() {
        let mut h = [[0.0; MAX]; MAX];
        h[0][0] = 1.0;
        h[1][0] = 1.0;
        h[0][1] = 1.0;
        h[1][1] = 1.0;
        assert!(Normal::factor(h, 2).is_none());
    }
}
