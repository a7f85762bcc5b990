//! Cholesky factor of a symmetric banded matrix.

/// Lower half of a symmetric matrix, `reach` entries left of the diagonal.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Banded {
    n: usize,
    reach: usize,
    /// Row by row, entry (i, j) at `i * (reach + 1) + (j + reach - i)`.
    values: Vec<f64>,
}

/// L of L·Lᵀ.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Factor(Banded);

impl Banded {
    pub(crate) fn new(n: usize, reach: usize) -> Self {
        Self { n, reach, values: vec![0.0; n * (reach + 1)] }
    }

    #[inline]
    fn at(&self, i: usize, j: usize) -> usize {
        i * (self.reach + 1) + (j + self.reach - i)
    }

    /// Adds to entry (i, j), j ≤ i ≤ j + reach.
    #[inline]
    pub(crate) fn add(&mut self, i: usize, j: usize, value: f64) {
        let at = self.at(i, j);
        self.values[at] += value;
    }

    /// The factor, or nothing if the matrix is not positive definite to working precision.
    pub(crate) fn cholesky(mut self) -> Option<Factor> {
        for i in 0..self.n {
            let first = i.saturating_sub(self.reach);
            let whole = self.values[self.at(i, i)];
            for j in first..=i {
                let from = first.max(j.saturating_sub(self.reach));
                let (a, b) = (self.at(i, from), self.at(j, from));
                let len = j - from;
                let dot: f64 =
                    self.values[a..a + len].iter().zip(&self.values[b..b + len]).map(|(x, y)| x * y).sum();
                let at = self.at(i, j);
                let rest = self.values[at] - dot;
                if j < i {
                    self.values[at] = rest / self.values[self.at(j, j)];
                } else if rest > 1e-13 * whole {
                    self.values[at] = rest.sqrt();
                } else {
                    return None;
                }
            }
        }
        Some(Factor(self))
    }
}

impl Factor {
    /// L⁻¹ r
    fn forward(&self, mut r: Vec<f64>, start: usize) -> Vec<f64> {
        let m = &self.0;
        for i in start..m.n {
            let first = i.saturating_sub(m.reach).max(start);
            let a = m.at(i, first);
            let dot: f64 = m.values[a..a + i - first].iter().zip(&r[first..i]).map(|(x, y)| x * y).sum();
            r[i] = (r[i] - dot) / m.values[m.at(i, i)];
        }
        r
    }

    /// Solution of the system.
    pub(crate) fn solve(&self, rhs: Vec<f64>) -> Vec<f64> {
        let m = &self.0;
        let mut x = self.forward(rhs, 0);
        for i in (0..m.n).rev() {
            x[i] /= m.values[m.at(i, i)];
            let first = i.saturating_sub(m.reach);
            let a = m.at(i, first);
            let xi = x[i];
            for (x, l) in x[first..i].iter_mut().zip(&m.values[a..a + i - first]) {
                *x -= l * xi;
            }
        }
        x
    }

    /// rᵀ A⁻¹ r of a sparse vector r.
    pub(crate) fn variance(&self, r: &[(usize, f64)]) -> f64 {
        let mut full = vec![0.0; self.0.n];
        let mut start = self.0.n;
        for (i, v) in r {
            full[*i] += v;
            start = start.min(*i);
        }
        self.forward(full, start).iter().map(|x| x * x).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    #[test]
    fn agrees_with_a_dense_inverse() {
        let (n, reach) = (23, 4);
        let entry = |i: usize, j: usize| {
            if i == j { 9.0 } else { ((i * 7 + j * 3) % 5) as f64 / 5.0 - 0.4 }
        };
        let mut banded = Banded::new(n, reach);
        let mut dense = DMatrix::zeros(n, n);
        for i in 0..n {
            for j in i.saturating_sub(reach)..=i {
                banded.add(i, j, entry(i, j));
                dense[(i, j)] = entry(i, j);
                dense[(j, i)] = entry(i, j);
            }
        }
        let inverse = dense.try_inverse().unwrap();
        let factor = banded.cholesky().unwrap();
        let r = DVector::from_fn(n, |i, _| (i as f64 * 0.7).sin());
        let x = factor.solve(r.iter().copied().collect());
        let expected = &inverse * &r;
        assert!((0..n).all(|i| (x[i] - expected[i]).abs() < 1e-14));
        let v = factor.variance(&[(7, 0.5), (12, -1.5)]);
        let expected = 0.25 * inverse[(7, 7)] + 2.25 * inverse[(12, 12)] - 1.5 * inverse[(7, 12)];
        assert!((v - expected).abs() < 1e-15);
    }

    #[test]
    fn a_singular_matrix_has_no_factor() {
        let mut m = Banded::new(3, 1);
        for (i, j) in [(0, 0), (1, 0), (1, 1), (2, 2)] {
            m.add(i, j, 1.0);
        }
        assert!(m.cholesky().is_none());
    }
}
