//! Normal equations of parameters and poses, unknown plate points eliminated by the Schur
//! complement, and what they leave open.

use nalgebra::{DMatrix, DVector, Matrix2, SymmetricEigen, Vector2};

use super::{Component, WeakCombination};
use crate::parameter::Parameter;

/// One unknown plate point's part of the normal equations.
pub(super) struct Block {
    pub(super) point: usize,
    /// Point by point.
    pub(super) c: Matrix2<f64>,
    pub(super) rhs: Vector2<f64>,
    /// Column by point, for the columns that the point's residuals depend on.
    pub(super) by: Vec<(usize, Vector2<f64>)>,
}

/// Normal equations of the remaining columns; the parameters come first.
pub(super) struct Normal {
    /// From the data and what is known of poses; lower triangle.
    pub(super) a: DMatrix<f64>,
    /// Information of the parameters' priors, for the diagonal.
    pub(super) prior: DVector<f64>,
    pub(super) rhs: DVector<f64>,
    /// Scale of each column; damping acts on steps in these units.
    pub(super) unit: DVector<f64>,
    pub(super) blocks: Vec<Block>,
}

/// Steps of the columns and of the unknown points.
pub(super) struct Step {
    pub(super) columns: DVector<f64>,
    pub(super) points: Vec<(usize, Vector2<f64>)>,
}

/// Factor of a symmetric matrix scaled to a unit diagonal: F and s differ by so little that the
/// scaling decides whether the factor exists.
struct Scaled {
    factor: nalgebra::Cholesky<f64, nalgebra::Dyn>,
    scale: DVector<f64>,
}

impl Scaled {
    fn new(m: &DMatrix<f64>) -> Option<Self> {
        let scale = m.diagonal().map(|d| 1.0 / d.sqrt());
        if !scale.iter().all(|s| s.is_finite()) {
            return None;
        }
        let scaled = DMatrix::from_fn(m.nrows(), m.ncols(), |i, j| m[(i, j)] * scale[i] * scale[j]);
        Some(Self { factor: scaled.cholesky()?, scale })
    }

    fn solve(&self, rhs: &DVector<f64>) -> DVector<f64> {
        self.factor.solve(&rhs.component_mul(&self.scale)).component_mul(&self.scale)
    }

    fn inverse(&self) -> DMatrix<f64> {
        let mut inverse = self.factor.inverse();
        for j in 0..inverse.ncols() {
            for i in 0..inverse.nrows() {
                inverse[(i, j)] *= self.scale[i] * self.scale[j];
            }
        }
        inverse
    }
}

impl Normal {
    pub(super) fn new(columns: usize) -> Self {
        Self {
            a: DMatrix::zeros(columns, columns),
            prior: DVector::zeros(columns),
            rhs: DVector::zeros(columns),
            unit: DVector::from_element(columns, 0.1),
            blocks: Vec::new(),
        }
    }

    /// Adds the residual `r` with its derivatives (columns in rising order) and weight.
    #[inline]
    pub(super) fn add(&mut self, row: &[(usize, f64)], r: f64, weight: f64) {
        for (k, (i, gi)) in row.iter().enumerate() {
            let w = weight * gi;
            self.rhs[*i] += w * r;
            for (j, gj) in &row[..=k] {
                self.a[(*i, *j)] += w * gj;
            }
        }
    }

    /// Both triangles of the data's part with the points eliminated, and the right-hand side.
    fn eliminated(&self, damping: f64) -> Option<(DMatrix<f64>, DVector<f64>)> {
        let mut schur = self.a.clone();
        let mut rhs = self.rhs.clone();
        for block in &self.blocks {
            let inverse = block.inverse(damping)?;
            for (k, (i, bi)) in block.by.iter().enumerate() {
                let row = inverse * bi;
                rhs[*i] -= row.dot(&block.rhs);
                for (j, bj) in &block.by[..=k] {
                    schur[(*i, *j)] -= row.dot(bj);
                }
            }
        }
        schur.fill_upper_triangle_with_lower_triangle();
        Some((schur, rhs))
    }

    fn whole(&self, damping: f64) -> Option<(DMatrix<f64>, DVector<f64>)> {
        let (mut schur, rhs) = self.eliminated(damping)?;
        for i in 0..self.rhs.len() {
            schur[(i, i)] += self.prior[i] + damping / (self.unit[i] * self.unit[i]);
        }
        Some((schur, rhs))
    }

    pub(super) fn step(&self, damping: f64) -> Option<Step> {
        let (schur, rhs) = self.whole(damping)?;
        let columns = Scaled::new(&schur)?.solve(&rhs);
        if !columns.iter().all(|x| x.is_finite()) {
            return None;
        }
        let mut points = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let mut rhs = block.rhs;
            for (i, b) in &block.by {
                rhs -= b * columns[*i];
            }
            points.push((block.point, block.inverse(damping)? * rhs));
        }
        Some(Step { columns, points })
    }

    /// Covariance of all columns.
    pub(super) fn covariance(&self) -> Option<DMatrix<f64>> {
        Some(Scaled::new(&self.whole(0.0)?.0)?.inverse())
    }

    /// What the data say about the parameters alone, in units `scale`, whatever the poses are.
    fn of_parameters(&self, scale: &[f64]) -> Option<DMatrix<f64>> {
        let p = scale.len();
        let rest = self.rhs.len() - p;
        let (schur, _) = self.eliminated(0.0)?;
        let mut own = schur.view((0, 0), (p, p)).into_owned();
        if rest > 0 {
            let others = Scaled::new(&schur.view((p, p), (rest, rest)).into_owned())?;
            let cross = schur.view((p, 0), (rest, p)).into_owned();
            for j in 0..p {
                let solved = others.solve(&cross.column(j).into_owned());
                for i in 0..p {
                    own[(i, j)] -= cross.column(i).dot(&solved);
                }
            }
        }
        Some(DMatrix::from_fn(p, p, |i, j| 0.5 * (own[(i, j)] + own[(j, i)]) * scale[i] * scale[j]))
    }

    /// Combinations of which the data know less than the priors, weakest first. `Err` holds the
    /// one that nothing fixes, or nothing if the poses themselves are open.
    pub(super) fn weak(
        &self,
        parameters: &[Parameter],
        scale: &[f64],
    ) -> Result<Vec<WeakCombination>, Vec<Component>> {
        let p = parameters.len();
        let data = self.of_parameters(scale).ok_or_else(Vec::new)?;
        let with = DMatrix::from_fn(p, p, |i, j| {
            let prior = if i == j { self.prior[i] * scale[i] * scale[i] } else { 0.0 };
            data[(i, j)] + prior
        });
        let eigen = SymmetricEigen::new(with);
        let largest = eigen.eigenvalues.max();
        let least = (0..p).fold(0, |w, j| if eigen.eigenvalues[j] < eigen.eigenvalues[w] { j } else { w });
        // Less than 1/1000 of the usual standard deviation, or what rounding leaves of a zero.
        if p > 0 && !(eigen.eigenvalues[least] > 1e-6_f64.max(1e-15 * largest)) {
            return Err(components(parameters, &eigen.eigenvectors.column(least).into_owned()));
        }
        let eigen = SymmetricEigen::new(data);
        let mut weak: Vec<WeakCombination> = (0..p)
            .filter(|j| eigen.eigenvalues[*j] < 1.0)
            .map(|j| WeakCombination {
                components: components(parameters, &eigen.eigenvectors.column(j).into_owned()),
                data_sigma: 1.0 / eigen.eigenvalues[j].max(1e-15 * largest).sqrt(),
            })
            .collect();
        weak.sort_by(|a, b| b.data_sigma.total_cmp(&a.data_sigma));
        Ok(weak)
    }
}

fn components(parameters: &[Parameter], vector: &DVector<f64>) -> Vec<Component> {
    let mut all: Vec<Component> = parameters
        .iter()
        .zip(vector.iter())
        .filter(|(_, w)| w.abs() > 0.1)
        .map(|(p, w)| Component { parameter: *p, weight: *w })
        .collect();
    all.sort_by(|a, b| b.weight.abs().total_cmp(&a.weight.abs()));
    // The sign of an eigenvector is arbitrary: the largest share counts as positive.
    if all.first().is_some_and(|c| c.weight < 0.0) {
        all.iter_mut().for_each(|c| c.weight = -c.weight);
    }
    all
}

impl Block {
    fn inverse(&self, damping: f64) -> Option<Matrix2<f64>> {
        let mut c = self.c;
        for i in 0..2 {
            c[(i, i)] += damping;
        }
        c.try_inverse()
    }
}
