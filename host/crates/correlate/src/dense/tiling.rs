//! How overlapping subsets share their sums: the image is cut into tiles of one grid step, moments
//! are summed once per tile, and the sums of a subset are put together from its tiles.
//!
//! A subset of 2r + 1 = q·step + rem pixels covers q whole tiles and the first `rem` columns (rows)
//! of the next. Tile sums never subtract, so nothing cancels.

/// Most grid columns in one task: its rows of tile sums stay in the second-level cache.
const TASK_COLUMNS: usize = 128;
/// Most grid rows in one task.
const TASK_ROWS: usize = 96;
/// Highest degree of a moment: products of the gradients with a second-order shape function.
pub(crate) const DEGREES: usize = 5;

pub(crate) use crate::subset::{LANES, monomial};

/// Number of monomials ξ^i η^j up to a degree.
pub(crate) const fn moments(degree: usize) -> usize {
    (degree + 1) * (degree + 2) / 2
}

/// A regular grid of subsets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Tiling {
    /// Pixel of node (0, 0).
    pub(crate) x0: usize,
    pub(crate) y0: usize,
    pub(crate) step: usize,
    pub(crate) radius: usize,
    /// Nodes along x and y.
    pub(crate) columns: usize,
    pub(crate) rows: usize,
}

/// Rectangle of grid nodes that is treated as a whole. The division depends on the grid alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Task {
    /// First node.
    pub(crate) column: usize,
    pub(crate) row: usize,
    /// Nodes.
    pub(crate) columns: usize,
    pub(crate) rows: usize,
    /// Nodes along x, filled up to whole vectors.
    pub(crate) width: usize,
    /// Tiles along x, filled up to whole vectors.
    pub(crate) tiles: usize,
}

impl Tiling {
    /// Whole tiles in a subset, and pixels left over.
    pub(crate) fn whole(&self) -> (usize, usize) {
        let width = 2 * self.radius + 1;
        (width / self.step, width % self.step)
    }

    /// Tiles that a subset touches, less one.
    pub(crate) fn last(&self) -> usize {
        let (q, rem) = self.whole();
        if rem > 0 { q } else { q - 1 }
    }

    /// Nodes beyond the grid that the field needs on each side so that it covers all subsets.
    pub(crate) fn margin(&self) -> usize {
        self.radius.div_ceil(self.step)
    }

    /// Pixels from the node at the margin to the first pixel of the first subset.
    pub(crate) fn lead(&self) -> usize {
        self.margin() * self.step - self.radius
    }

    /// Powers up to the fourth of the tile-local coordinate, in units of the radius.
    pub(crate) fn powers(&self, pixel: usize) -> [f32; DEGREES] {
        let x = (pixel as f64 - 0.5 * (self.step as f64 - 1.0)) / self.radius as f64;
        std::array::from_fn(|k| x.powi(k as i32) as f32)
    }

    /// Coefficients that carry tile-local moments to the subset's centre, for its tile `m`:
    /// (ξ_m + x)^i = Σ_k c[i][k] x^k.
    pub(crate) fn shift(&self, m: usize) -> [[f32; DEGREES]; DEGREES] {
        let centre = (m * self.step) as f64 + 0.5 * (self.step as f64 - 1.0) - self.radius as f64;
        let xi = centre / self.radius as f64;
        let mut c = [[0.0; DEGREES]; DEGREES];
        for i in 0..DEGREES {
            let mut binomial = 1.0;
            for k in 0..=i {
                c[i][k] = (binomial * xi.powi((i - k) as i32)) as f32;
                binomial = binomial * (i - k) as f64 / (k + 1) as f64;
            }
        }
        c
    }

    pub(crate) fn tasks(&self) -> Vec<Task> {
        let columns = even(self.columns, TASK_COLUMNS, LANES);
        let rows = even(self.rows, TASK_ROWS, 1);
        let mut tasks = Vec::new();
        for row in (0..self.rows).step_by(rows) {
            for column in (0..self.columns).step_by(columns) {
                let n = columns.min(self.columns - column);
                let width = n.next_multiple_of(LANES);
                tasks.push(Task {
                    column,
                    row,
                    columns: n,
                    rows: rows.min(self.rows - row),
                    width,
                    tiles: (width + self.last()).next_multiple_of(LANES),
                });
            }
        }
        tasks
    }
}

/// Size of equal parts of at most `most`, a multiple of `unit`.
fn even(n: usize, most: usize, unit: usize) -> usize {
    n.div_ceil(n.div_ceil(most).max(1)).next_multiple_of(unit).max(unit)
}
