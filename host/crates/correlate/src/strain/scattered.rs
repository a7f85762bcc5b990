//! The fit where points are missing in the window: normal equations of the points that are there.

use super::StrainStatus;
use super::error_correlation::ErrorCorrelation;
use super::fit::{Gradient, Links, Stretch};

/// Most terms of the polynomial.
const TERMS: usize = 6;
/// Smallest pivot, relative to its diagonal element, that counts as determined: how much of a term is not
/// explained by the ones before it. A quadratic seen from the edge of half a window has 0.03, from the
/// corner of a quarter 0.01; points on one line too few have 0.
const LEAST_PIVOT: f64 = 1e-4;

/// What does not depend on the point.
pub(crate) struct Scattered<'a> {
    pub(crate) links: &'a Links<'a>,
    pub(crate) correlation: &'a ErrorCorrelation,
    pub(crate) quadratic: bool,
    /// Half side of the window in grid steps, by which coordinates are divided.
    pub(crate) half: f64,
    /// Fewest points.
    pub(crate) least: f64,
}

/// Memory of one thread.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    reached: Vec<bool>,
    stack: Vec<(usize, usize)>,
    weights: [Vec<f64>; 2],
    sums: Vec<f64>,
}

impl Scattered<'_> {
    /// Marks the nodes of the window that are linked to the point; returns how many.
    fn reach(&self, x: Stretch, y: Stretch, scratch: &mut Scratch) -> usize {
        let columns = self.links.field.columns;
        let node = |i: usize, j: usize| (y.start + j) * columns + x.start + i;
        scratch.reached.clear();
        scratch.reached.resize(x.len * y.len, false);
        scratch.reached[y.at * x.len + x.at] = true;
        scratch.stack.push((x.at, y.at));
        let mut count = 0;
        while let Some((i, j)) = scratch.stack.pop() {
            count += 1;
            let around = [(i.wrapping_sub(1), j), (i + 1, j), (i, j.wrapping_sub(1)), (i, j + 1)];
            for (a, b) in around {
                if a < x.len
                    && b < y.len
                    && !scratch.reached[b * x.len + a]
                    && self.links.linked(node(i, j), node(a, b))
                {
                    scratch.reached[b * x.len + a] = true;
                    scratch.stack.push((a, b));
                }
            }
        }
        count
    }

    fn basis(&self, i: usize, j: usize, x: Stretch, y: Stretch) -> [f64; TERMS] {
        let s = (i as f64 - x.at as f64) / self.half;
        let t = (j as f64 - y.at as f64) / self.half;
        [1.0, s, t, s * s, s * t, t * t]
    }

    pub(crate) fn fit(&self, x: Stretch, y: Stretch, scratch: &mut Scratch) -> Gradient {
        let field = self.links.field;
        let used = self.reach(x, y, scratch);
        let terms = if self.quadratic { TERMS } else { 3 };
        if (used as f64) < self.least || used < terms {
            return Gradient::failed(StrainStatus::TooFewPoints, used as u32);
        }
        let node = |i: usize, j: usize| (y.start + j) * field.columns + x.start + i;
        let mut normal = [[0.0; TERMS]; TERMS];
        let mut right = [[0.0; TERMS]; 2];
        let mut variance = [0.0; 2];
        for j in 0..y.len {
            for i in 0..x.len {
                if !scratch.reached[j * x.len + i] {
                    continue;
                }
                let (phi, n) = (self.basis(i, j, x, y), node(i, j));
                for a in 0..terms {
                    for b in 0..=a {
                        normal[a][b] += phi[a] * phi[b];
                    }
                    right[0][a] += phi[a] * field.u[n];
                    right[1][a] += phi[a] * field.v[n];
                }
                variance[0] += square_of_sigma(field.sigma_u[n]);
                variance[1] += square_of_sigma(field.sigma_v[n]);
            }
        }
        let Some(factor) = cholesky(&normal, terms) else {
            return Gradient::failed(StrainStatus::IllConditioned, used as u32);
        };
        let per_step = self.half * field.step;
        // rows of the inverse: value, slope along x, slope along y
        let rows: [[f64; TERMS]; 3] = std::array::from_fn(|k| column_of_inverse(&factor, terms, k));
        let dot = |a: &[f64; TERMS], b: &[f64; TERMS]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
        for (weights, row) in scratch.weights.iter_mut().zip(&rows[1..]) {
            weights.clear();
            weights.extend((0..x.len * y.len).map(|k| match scratch.reached[k] {
                true => dot(row, &self.basis(k % x.len, k / x.len, x, y)),
                false => 0.0,
            }));
        }
        let [wx, wy] = &scratch.weights;
        let sums = &mut scratch.sums;
        let factors = [(wx, wx), (wy, wy), (wx, wy)]
            .map(|(a, b)| self.correlation.quadratic_form(a, b, x.len, sums) / (per_step * per_step));
        Gradient {
            status: StrainStatus::Ok,
            used: used as u32,
            displacement: [dot(&rows[0], &right[0]), dot(&rows[0], &right[1])],
            gradient: right.map(|r| [dot(&rows[1], &r) / per_step, dot(&rows[2], &r) / per_step]),
            covariance: variance.map(|sum| factors.map(|f| f * sum / used as f64)),
        }
    }
}

/// σ², NaN for what is no uncertainty.
fn square_of_sigma(sigma: f64) -> f64 {
    if sigma.is_finite() && sigma >= 0.0 { sigma * sigma } else { f64::NAN }
}

/// Lower factor; `None` where a pivot is too small.
fn cholesky(normal: &[[f64; TERMS]; TERMS], terms: usize) -> Option<[[f64; TERMS]; TERMS]> {
    let mut l = [[0.0; TERMS]; TERMS];
    for a in 0..terms {
        for b in 0..=a {
            let sum = normal[a][b] - (0..b).map(|k| l[a][k] * l[b][k]).sum::<f64>();
            if a == b {
                if sum.is_nan() || sum <= LEAST_PIVOT * normal[a][a] {
                    return None;
                }
                l[a][a] = sum.sqrt();
            } else {
                l[a][b] = sum / l[b][b];
            }
        }
    }
    Some(l)
}

/// Column k of (L Lᵀ)⁻¹.
fn column_of_inverse(l: &[[f64; TERMS]; TERMS], terms: usize, k: usize) -> [f64; TERMS] {
    let mut x = [0.0; TERMS];
    for a in 0..terms {
        let unit = if a == k { 1.0 } else { 0.0 };
        x[a] = (unit - (0..a).map(|b| l[a][b] * x[b]).sum::<f64>()) / l[a][a];
    }
    for a in (0..terms).rev() {
        x[a] = (x[a] - (a + 1..terms).map(|b| l[b][a] * x[b]).sum::<f64>()) / l[a][a];
    }
    x
}
