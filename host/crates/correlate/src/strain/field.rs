//! A displacement field on a regular grid.

use super::StrainError;
use crate::correlate::Correlation;
use crate::points::Points;
use crate::shape::Shape;

/// Displacements at the nodes of a regular grid: node (column i, row j) is number j · columns + i and
/// lies at (x0 + i · step, y0 + j · step); lengths in pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    /// Nodes along x.
    pub columns: usize,
    /// Nodes along y.
    pub rows: usize,
    /// Column of the first node in the image.
    pub x0: f64,
    /// Row of the first node in the image.
    pub y0: f64,
    /// Distance of adjacent nodes.
    pub step: f64,
    /// Side of the subsets.
    pub subset: usize,
    /// Shape function of the subsets; with side and step it says how the errors of adjacent points are
    /// correlated.
    pub shape: Shape,
    /// Displacement along x.
    pub u: Vec<f64>,
    /// Displacement along y.
    pub v: Vec<f64>,
    /// Standard uncertainty of u; NaN where unknown.
    pub sigma_u: Vec<f64>,
    /// Standard uncertainty of v; NaN where unknown.
    pub sigma_v: Vec<f64>,
    /// Whether the node has a displacement. Nodes whose u or v is not finite never count.
    pub valid: Vec<bool>,
}

impl Field {
    /// A field without any result.
    pub fn empty(
        columns: usize,
        rows: usize,
        origin: [f64; 2],
        step: f64,
        subset: usize,
        shape: Shape,
    ) -> Self {
        let none = vec![f64::NAN; columns * rows];
        Self {
            columns,
            rows,
            x0: origin[0],
            y0: origin[1],
            step,
            subset,
            shape,
            u: none.clone(),
            v: none.clone(),
            sigma_u: none.clone(),
            sigma_v: none,
            valid: vec![false; columns * rows],
        }
    }

    /// The field of a correlation on a grid; points count where their status is ok.
    ///
    /// # Errors
    /// [`StrainError::Scattered`], [`StrainError::Count`].
    pub fn of(
        points: &Points,
        found: &Correlation,
        subset: usize,
        shape: Shape,
    ) -> Result<Self, StrainError> {
        let grid = points.as_grid().ok_or(StrainError::Scattered)?;
        if found.points.len() != points.len() {
            return Err(StrainError::Count { results: found.points.len(), points: points.len() });
        }
        let origin = [grid.x0 as f64, grid.y0 as f64];
        let mut field = Self::empty(grid.columns, grid.rows, origin, grid.step as f64, subset, shape);
        for j in 0..grid.rows {
            for i in 0..grid.columns {
                if let Some(k) = grid.point(i, j) {
                    let (node, p) = (j * grid.columns + i, &found.points[k]);
                    field.u[node] = p.u;
                    field.v[node] = p.v;
                    field.sigma_u[node] = f64::from(p.sigma_u);
                    field.sigma_v[node] = f64::from(p.sigma_v);
                    field.valid[node] = p.status.is_ok();
                }
            }
        }
        Ok(field)
    }

    /// Checks that the arrays fit the grid, that the step is positive and the subset is not empty.
    ///
    /// # Errors
    /// [`StrainError::Length`], [`StrainError::Range`].
    pub fn validate(&self) -> Result<(), StrainError> {
        let (columns, rows) = (self.columns, self.rows);
        let lengths = [
            ("u", self.u.len()),
            ("v", self.v.len()),
            ("sigma_u", self.sigma_u.len()),
            ("sigma_v", self.sigma_v.len()),
            ("valid", self.valid.len()),
        ];
        let wanted = columns.checked_mul(rows);
        if let Some((name, found)) = lengths.into_iter().find(|(_, n)| Some(*n) != wanted) {
            return Err(StrainError::Length { name, found, columns, rows });
        }
        for (name, value, min, max) in [
            ("step", self.step, 1e-6, 1e6),
            ("subset", self.subset as f64, 1.0, 1e4),
            ("x0", self.x0, -1e9, 1e9),
            ("y0", self.y0, -1e9, 1e9),
        ] {
            if !(min..=max).contains(&value) {
                return Err(StrainError::Range { name, value, min, max });
            }
        }
        Ok(())
    }

    /// Whether a node has a displacement.
    pub fn is_valid(&self, node: usize) -> bool {
        self.valid[node] && self.u[node].is_finite() && self.v[node].is_finite()
    }

    /// Position of a node in the image.
    pub fn position(&self, node: usize) -> [f64; 2] {
        let (i, j) = (node % self.columns, node / self.columns);
        [self.x0 + i as f64 * self.step, self.y0 + j as f64 * self.step]
    }

    /// Number of nodes with a displacement.
    pub fn count(&self) -> usize {
        (0..self.valid.len()).filter(|&node| self.is_valid(node)).count()
    }
}
