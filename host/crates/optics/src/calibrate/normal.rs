//! Normal equations of parameters and points, the points eliminated by the Schur complement.

use nalgebra::{DMatrix, DVector, Matrix3, SymmetricEigen, Vector3};

/// Most parameters of the normal equations: all but grating_to_reference, which the moves do not
/// touch and which follows from the datum.
pub(super) const FREE: usize = 2;

/// One point's part of the normal equations.
pub(super) struct Block {
    pub(super) point: usize,
    /// Point by point.
    pub(super) c: Matrix3<f64>,
    /// Parameter by point.
    pub(super) b: [Vector3<f64>; FREE],
    pub(super) rhs: Vector3<f64>,
}

/// Normal equations, parameters by parameters and a block for each point.
pub(super) struct Normal {
    pub(super) a: DMatrix<f64>,
    pub(super) rhs: DVector<f64>,
    pub(super) blocks: Vec<Block>,
}

impl Normal {
    /// Schur complement and right-hand side with the points eliminated.
    pub(super) fn reduced(&self, damping: f64) -> Option<(DMatrix<f64>, DVector<f64>)> {
        let n = self.rhs.len();
        let mut schur = self.a.clone();
        for j in 0..n {
            schur[(j, j)] *= 1.0 + damping;
        }
        let mut rhs = self.rhs.clone();
        for block in &self.blocks {
            let inverse = block.inverse(damping)?;
            for j in 0..n {
                let row = inverse * block.b[j];
                rhs[j] -= row.dot(&block.rhs);
                for l in 0..n {
                    schur[(j, l)] -= row.dot(&block.b[l]);
                }
            }
        }
        Some((schur, rhs))
    }

    /// Steps of the parameters and of the points.
    pub(super) fn step(&self, damping: f64) -> Option<(DVector<f64>, Vec<Vector3<f64>>)> {
        let n = self.rhs.len();
        let by = if n == 0 {
            DVector::zeros(0)
        } else {
            let (schur, rhs) = self.reduced(damping)?;
            schur.lu().solve(&rhs).filter(|x| x.iter().all(|x| x.is_finite()))?
        };
        let mut points = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let mut rhs = block.rhs;
            for j in 0..n {
                rhs -= block.b[j] * by[j];
            }
            points.push(block.inverse(damping)? * rhs);
        }
        Some((by, points))
    }

    /// Covariance of the parameters, or the number of the one the data leave open.
    pub(super) fn covariance(&self) -> Result<DMatrix<f64>, usize> {
        let n = self.rhs.len();
        if n == 0 {
            return Ok(DMatrix::zeros(0, 0));
        }
        // Where a point's block is singular nothing can be said of any parameter.
        let schur = self.reduced(0.0).map_or_else(|| DMatrix::zeros(n, n), |(schur, _)| schur);
        // In units of each parameter's information with the points known.
        let scale: Vec<f64> = (0..n).map(|j| self.a[(j, j)].sqrt()).collect();
        let scaled = DMatrix::from_fn(n, n, |i, j| {
            let d = scale[i] * scale[j];
            if d > 0.0 { schur[(i, j)] / d } else { 0.0 }
        });
        let eigen = SymmetricEigen::new(scaled.clone());
        let values = &eigen.eigenvalues;
        let weakest = (1..n).fold(0, |w, j| if values[j] < values[w] { j } else { w });
        match scaled.try_inverse() {
            // 1e-13: what rounding leaves of a zero after eliminating the points.
            Some(inverse) if values[weakest] > 1e-13 => {
                Ok(DMatrix::from_fn(n, n, |i, j| inverse[(i, j)] / (scale[i] * scale[j])))
            }
            _ => {
                let part = |j: usize| eigen.eigenvectors[(j, weakest)].abs();
                Err((1..n).fold(0, |w, j| if part(j) > part(w) { j } else { w }))
            }
        }
    }

    /// Of minus the mean height of the points: derivatives by the parameters, and the variance it
    /// has from the points' own noise.
    pub(super) fn mean_height(&self) -> (Vec<f64>, f64) {
        let n = self.rhs.len();
        let count = self.blocks.len() as f64;
        let mut by = vec![0.0; n];
        let mut variance = 0.0;
        for block in &self.blocks {
            if let Some(inverse) = block.inverse(0.0) {
                variance += inverse[(2, 2)] / (count * count);
                for (j, by) in by.iter_mut().enumerate() {
                    *by += (inverse * block.b[j]).z / count;
                }
            }
        }
        (by, variance)
    }
}

impl Block {
    fn inverse(&self, damping: f64) -> Option<Matrix3<f64>> {
        let mut c = self.c;
        for i in 0..3 {
            c[(i, i)] *= 1.0 + damping;
        }
        c.try_inverse()
    }
}
