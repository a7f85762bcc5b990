//! Derivatives at the middle of a window by least squares.

use nalgebra::{DMatrix, Matrix2};

use super::{NoStrain, Order, Settings};

/// Derivatives along columns and rows as weighted sums over points.
pub(super) struct Derivative {
    /// Index of a point, and its weights in ∂/∂a and ∂/∂b.
    pub(super) weights: Vec<(usize, [f64; 2])>,
    /// Covariance of both derivatives of a quantity whose errors have variance 1.
    pub(super) noise: Matrix2<f64>,
}

pub(super) struct Window {
    half: isize,
    order: Order,
    needed: usize,
    overlap: f64,
    /// Weights and noise of the whole window: most points have it.
    whole: Option<(Vec<[f64; 2]>, Matrix2<f64>)>,
}

impl Window {
    pub(super) fn new(s: &Settings) -> Self {
        let terms = match s.order {
            Order::Plane => 3,
            Order::Quadratic => 6,
        };
        let share = (s.min_fraction * (s.window * s.window) as f64).ceil() as usize;
        let half = (s.window / 2) as isize;
        let mut window =
            Self { half, order: s.order, needed: share.max(terms), overlap: s.overlap, whole: None };
        let places: Vec<[f64; 2]> =
            (-half..=half).flat_map(|b| (-half..=half).map(move |a| [a as f64, b as f64])).collect();
        window.whole = window.fit(&places).map(|w| {
            let noise = window.noise(&places, &w);
            (w, noise)
        });
        window
    }

    /// Weights of the points at `places`, relative to the middle, or nothing if they leave a term open.
    fn fit(&self, places: &[[f64; 2]]) -> Option<Vec<[f64; 2]>> {
        let scale = self.half as f64;
        let terms = match self.order {
            Order::Plane => 3,
            Order::Quadratic => 6,
        };
        let design = DMatrix::from_fn(places.len(), terms, |k, t| {
            let [a, b] = places[k].map(|v| v / scale);
            [1.0, a, b, a * a, a * b, b * b][t]
        });
        let normal = design.transpose() * &design;
        let inverse = normal.clone().cholesky()?.inverse();
        // relative to a full window the smallest pivot is about 1/10; 1e-6 is as good as none
        let condition = (0..terms).map(|t| normal[(t, t)] * inverse[(t, t)]).fold(0.0, f64::max);
        if !(condition < 1e6) {
            return None;
        }
        let solve = inverse * design.transpose();
        Some((0..places.len()).map(|k| [solve[(1, k)] / scale, solve[(2, k)] / scale]).collect())
    }

    /// Σ ρ_kl w_k w_lᵀ with the correlation ρ of overlapping subsets.
    fn noise(&self, places: &[[f64; 2]], weights: &[[f64; 2]]) -> Matrix2<f64> {
        let near = |d: f64| if self.overlap > 0.0 { 1.0 - d.abs() / self.overlap } else { 0.0 };
        let mut sum = Matrix2::zeros();
        for (k, (p, w)) in places.iter().zip(weights).enumerate() {
            for (l, (q, v)) in places.iter().zip(weights).enumerate() {
                let shared = near(p[0] - q[0]).max(0.0) * near(p[1] - q[1]).max(0.0);
                let rho = if k == l { 1.0 } else { shared };
                sum += Matrix2::new(w[0] * v[0], w[0] * v[1], w[1] * v[0], w[1] * v[1]) * rho;
            }
        }
        sum
    }

    pub(super) fn around(
        &self,
        columns: usize,
        rows: usize,
        column: usize,
        row: usize,
        there: impl Fn(usize) -> bool,
    ) -> Result<Derivative, NoStrain> {
        let mut indices = Vec::new();
        let mut places = Vec::new();
        for b in -self.half..=self.half {
            for a in -self.half..=self.half {
                let (Some(x), Some(y)) = (column.checked_add_signed(a), row.checked_add_signed(b)) else {
                    continue;
                };
                if x < columns && y < rows && there(y * columns + x) {
                    indices.push(y * columns + x);
                    places.push([a as f64, b as f64]);
                }
            }
        }
        if indices.len() < self.needed {
            return Err(NoStrain::TooFew { found: indices.len(), needed: self.needed });
        }
        let (weights, noise) = match &self.whole {
            Some((weights, noise)) if weights.len() == indices.len() => (weights.clone(), *noise),
            _ => {
                let weights = self.fit(&places).ok_or(NoStrain::Degenerate)?;
                let noise = self.noise(&places, &weights);
                (weights, noise)
            }
        };
        Ok(Derivative { weights: indices.into_iter().zip(weights).collect(), noise })
    }
}
