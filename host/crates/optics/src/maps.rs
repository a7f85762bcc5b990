//! Dense distortion maps: image distortion as a smooth function of the pixel.
//!
//! A map gives e in observed = ideal + e at the *observed* pixel, so ideal = observed − e(observed)
//! is explicit and the forward direction takes a few steps of Newton's iteration. Each component
//! is a uniform cubic B-spline over a grid of nodes: twice continuously differentiable, with exact
//! derivatives from the same sixteen coefficients. Beyond the outermost nodes there is no map.

use std::sync::Arc;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use crate::banded::{Banded, Factor};
use crate::real::{Real, solve2};
use crate::setup::View;

/// Where a map's nodes lie.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapGrid {
    /// Pixel of the first node (x, y).
    pub origin_px: [f64; 2],
    /// Distance between nodes along x and y in pixels.
    pub step_px: [f64; 2],
    /// Number of nodes along x and y, at least 4 each.
    pub nodes: [usize; 2],
}

/// Most nodes along one axis.
const MOST_NODES: usize = 1024;

impl MapGrid {
    /// The grid of about `step_px` between nodes that covers the pixels from `from` to `to`.
    pub fn covering(from: [f64; 2], to: [f64; 2], step_px: f64) -> Self {
        let cells = [0, 1].map(|i| ((to[i] - from[i]) / step_px).ceil().clamp(3.0, (MOST_NODES - 1) as f64));
        Self {
            origin_px: from,
            step_px: [0, 1].map(|i| (to[i] - from[i]) / cells[i]),
            nodes: cells.map(|c| c as usize + 1),
        }
    }

    /// Pixel of node (i, j).
    pub fn node_px(&self, i: usize, j: usize) -> [f64; 2] {
        [self.origin_px[0] + i as f64 * self.step_px[0], self.origin_px[1] + j as f64 * self.step_px[1]]
    }

    /// Whether the map covers the pixel.
    pub fn contains(&self, pixel_px: [f64; 2]) -> bool {
        (0..2).all(|i| {
            let at = (pixel_px[i] - self.origin_px[i]) / self.step_px[i];
            // Rounding of a coordinate on the rim itself.
            at >= -1e-9 && at <= (self.nodes[i] - 1) as f64 + 1e-9
        })
    }

    /// The node nearest to a pixel, row by row, or nothing outside the grid.
    pub fn nearest(&self, pixel_px: [f64; 2]) -> Option<usize> {
        let place =
            |i: usize| ((pixel_px[i] - self.origin_px[i]) / self.step_px[i]).round().max(0.0) as usize;
        self.contains(pixel_px)
            .then(|| place(1).min(self.nodes[1] - 1) * self.nodes[0] + place(0).min(self.nodes[0] - 1))
    }

    fn coefficients(&self) -> [usize; 2] {
        self.nodes.map(|n| n + 2)
    }

    fn check(&self) -> Result<(), MapError> {
        for (field, v) in [("origin_px", self.origin_px), ("step_px", self.step_px)] {
            for value in v {
                let positive = field != "step_px" || value > 0.0;
                if !(value.is_finite() && positive) {
                    return Err(MapError::Field { field, value });
                }
            }
        }
        if let Some(n) = self.nodes.into_iter().find(|n| !(4..=MOST_NODES).contains(n)) {
            return Err(MapError::Nodes { found: n });
        }
        Ok(())
    }

    /// Cell, and the four weights of the spline and of its derivative (per pixel), along one axis.
    #[inline]
    fn weights(&self, axis: usize, coordinate: f64) -> (usize, [f64; 4], [f64; 4]) {
        let at = (coordinate - self.origin_px[axis]) / self.step_px[axis];
        let cell = at.floor().clamp(0.0, (self.nodes[axis] - 2) as f64);
        let t = at - cell;
        let (t2, u) = (t * t, 1.0 - t);
        let w = [u * u * u, 3.0 * t2 * t - 6.0 * t2 + 4.0, 3.0 * (t + t2 - t2 * t) + 1.0, t2 * t]
            .map(|w| w / 6.0);
        let k = 0.5 / self.step_px[axis];
        let d = [-u * u * k, (3.0 * t2 - 4.0 * t) * k, (1.0 + 2.0 * t - 3.0 * t2) * k, t2 * k];
        (cell as usize, w, d)
    }
}

/// A distortion map, see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Raw", into = "Raw")]
pub struct DistortionMap {
    grid: MapGrid,
    /// B-spline coefficients of (e_x, e_y), row by row, two more than nodes along each axis.
    coefficients: Vec<[f64; 2]>,
}

#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Raw {
    grid: MapGrid,
    coefficients_px: Vec<[f64; 2]>,
}

impl From<DistortionMap> for Raw {
    fn from(m: DistortionMap) -> Self {
        Self { grid: m.grid, coefficients_px: m.coefficients }
    }
}

impl TryFrom<Raw> for DistortionMap {
    type Error = MapError;
    fn try_from(r: Raw) -> Result<Self, MapError> {
        Self::from_coefficients(r.grid, r.coefficients_px)
    }
}

/// One measured value of the distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapSample {
    /// The observed pixel.
    pub pixel_px: [f64; 2],
    /// (e_x, e_y) there, pixels.
    pub e_px: [f64; 2],
    /// Standard deviation of either component, pixels, above 0.
    pub sigma_px: f64,
}

/// A map fitted to samples.
#[derive(Clone, Debug, PartialEq)]
pub struct MapFit {
    /// The map.
    pub map: DistortionMap,
    /// RMS of (e_x, e_y) left at the samples, pixels.
    pub rms_px: [f64; 2],
    factor: Factor,
}

impl MapFit {
    /// Standard deviation (px) of either component of the map at a pixel, from the samples' noise
    /// and the smoothness assumed; nothing outside the grid.
    pub fn sigma_px(&self, pixel_px: [f64; 2]) -> Option<f64> {
        let grid = &self.map.grid;
        grid.contains(pixel_px).then(|| self.factor.variance(&basis(grid, pixel_px)).sqrt())
    }

    /// How the map at a pixel of the grid depends on the samples.
    pub(crate) fn influence(&self, pixel_px: [f64; 2]) -> Influence<'_> {
        let grid = &self.map.grid;
        let [nx, ny] = grid.coefficients();
        let mut row = vec![0.0; nx * ny];
        let basis = basis(grid, pixel_px);
        for (a, v) in basis {
            row[a] += v;
        }
        let by_coefficient = self.factor.solve(row);
        let variance = basis.iter().map(|(a, v)| v * by_coefficient[*a]).sum();
        Influence { grid, by_coefficient, variance }
    }
}

/// How a fitted map at one pixel depends on the samples.
pub(crate) struct Influence<'a> {
    grid: &'a MapGrid,
    by_coefficient: Vec<f64>,
    variance: f64,
}

impl Influence<'_> {
    /// Square of [`MapFit::sigma_px`].
    pub(crate) fn variance(&self) -> f64 {
        self.variance
    }

    /// Change of the map per change of the sample's value.
    pub(crate) fn weight(&self, sample: &MapSample) -> f64 {
        let sum: f64 =
            basis(self.grid, sample.pixel_px).iter().map(|(a, v)| v * self.by_coefficient[*a]).sum();
        sum / (sample.sigma_px * sample.sigma_px)
    }
}

/// Why there is no map.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MapError {
    /// A number of the grid is out of its limits.
    #[error("{field} of the map's grid is {value}: it must be finite, and above 0 for step_px")]
    Field {
        /// Which one.
        field: &'static str,
        /// Its value.
        value: f64,
    },
    /// Number of nodes.
    #[error("a map has 4 to 1024 nodes along each axis, not {found}")]
    Nodes {
        /// Nodes found.
        found: usize,
    },
    /// Not as many values as the grid has.
    #[error("the map's grid needs {expected} values, {found} are given")]
    Count {
        /// Needed.
        expected: usize,
        /// Given.
        found: usize,
    },
    /// A value is not finite, or a standard deviation not above 0.
    #[error("value {index} of the map is not finite, or its standard deviation is not above 0")]
    Value {
        /// Which one.
        index: usize,
    },
    /// A sample lies outside the grid.
    #[error("sample {index} at ({:.2}, {:.2}) px lies outside the map's grid", pixel_px[0], pixel_px[1])]
    Outside {
        /// Which one.
        index: usize,
        /// Its pixel.
        pixel_px: [f64; 2],
    },
    /// The samples leave coefficients of the spline open.
    #[error("{samples} samples do not determine the map: use a coarser grid or more samples")]
    Undetermined {
        /// Samples given.
        samples: usize,
    },
    /// The setting is not above 0.
    #[error("bend_px is {value}, it must be above 0")]
    Bend {
        /// Its value.
        value: f64,
    },
}

impl DistortionMap {
    /// From B-spline coefficients (e_x, e_y), row by row, `(nodes[0] + 2) × (nodes[1] + 2)`.
    ///
    /// # Errors
    /// See [`MapError`].
    pub fn from_coefficients(grid: MapGrid, coefficients: Vec<[f64; 2]>) -> Result<Self, MapError> {
        grid.check()?;
        let [nx, ny] = grid.coefficients();
        check_values(nx * ny, &coefficients)?;
        Ok(Self { grid, coefficients })
    }

    /// The spline through the values `e_px` at the nodes, row by row; its third derivative is
    /// continuous at the nodes next to the rim (not-a-knot), so cubic polynomials are reproduced.
    ///
    /// # Errors
    /// See [`MapError`].
    pub fn interpolate(grid: MapGrid, e_px: &[[f64; 2]]) -> Result<Self, MapError> {
        grid.check()?;
        let [nx, ny] = grid.nodes;
        check_values(nx * ny, e_px)?;
        let undetermined = MapError::Undetermined { samples: e_px.len() };
        let (along_x, along_y) = (not_a_knot(nx), not_a_knot(ny));
        let mut out = vec![[0.0; 2]; (nx + 2) * (ny + 2)];
        for c in 0..2 {
            // Rows first: right-hand sides are the rows of values with the two conditions 0.
            let mut rhs = DMatrix::zeros(nx + 2, ny);
            for j in 0..ny {
                for i in 0..nx {
                    rhs[(i + 1, j)] = e_px[j * nx + i][c];
                }
            }
            let rows = along_x.solve(&rhs).ok_or_else(|| undetermined.clone())?;
            let mut rhs = DMatrix::zeros(ny + 2, nx + 2);
            for j in 0..ny {
                for i in 0..nx + 2 {
                    rhs[(j + 1, i)] = rows[(i, j)];
                }
            }
            let all = along_y.solve(&rhs).ok_or_else(|| undetermined.clone())?;
            for j in 0..ny + 2 {
                for i in 0..nx + 2 {
                    out[j * (nx + 2) + i][c] = all[(j, i)];
                }
            }
        }
        Self::from_coefficients(grid, out)
    }

    /// The map that fits scattered samples best: weighted least squares with a penalty on bending.
    /// `bend_px` is how much the distortion's slope may be expected to change from one cell of the
    /// grid to the next (one standard deviation of the spline's second differences, pixels).
    ///
    /// # Errors
    /// See [`MapError`].
    pub fn fit(grid: MapGrid, samples: &[MapSample], bend_px: f64) -> Result<MapFit, MapError> {
        grid.check()?;
        if !(bend_px > 0.0 && bend_px.is_finite()) {
            return Err(MapError::Bend { value: bend_px });
        }
        let [nx, ny] = grid.coefficients();
        let n = nx * ny;
        let mut normal = Banded::new(n, 3 * nx + 3);
        let mut rhs = [vec![0.0; n], vec![0.0; n]];
        let mut seen = vec![false; n];
        for (index, s) in samples.iter().enumerate() {
            let finite = s.pixel_px.iter().chain(&s.e_px).all(|v| v.is_finite());
            if !(finite && s.sigma_px.is_finite() && s.sigma_px > 0.0) {
                return Err(MapError::Value { index });
            }
            if !grid.contains(s.pixel_px) {
                return Err(MapError::Outside { index, pixel_px: s.pixel_px });
            }
            let row = basis(&grid, s.pixel_px);
            let w = 1.0 / (s.sigma_px * s.sigma_px);
            for (a, va) in row {
                seen[a] = true;
                for (rhs, e) in rhs.iter_mut().zip(s.e_px) {
                    rhs[a] += w * va * e;
                }
                for (b, vb) in row.into_iter().filter(|(b, _)| *b <= a) {
                    normal.add(a, b, w * va * vb);
                }
            }
        }
        let w = 1.0 / (bend_px * bend_px);
        let mut bend = |indices: [usize; 3]| {
            for (a, va) in indices.into_iter().zip([1.0, -2.0, 1.0]) {
                for (b, vb) in indices.into_iter().zip([1.0, -2.0, 1.0]) {
                    if b <= a {
                        normal.add(a, b, w * va * vb);
                    }
                }
            }
        };
        for j in 0..ny {
            for i in 0..nx {
                let at = j * nx + i;
                if i + 2 < nx {
                    bend([at, at + 1, at + 2]);
                }
                if j + 2 < ny {
                    bend([at, at + nx, at + 2 * nx]);
                }
            }
        }
        let undetermined = || MapError::Undetermined { samples: samples.len() };
        // The penalty leaves planes and the twist x·y free: four samples apart at least.
        if seen.iter().filter(|s| **s).count() < 17 {
            return Err(undetermined());
        }
        let factor = normal.cholesky().ok_or_else(undetermined)?;
        let [cx, cy] = rhs.map(|r| factor.solve(r));
        let map = Self::from_coefficients(grid, cx.into_iter().zip(cy).map(|(x, y)| [x, y]).collect())?;
        let mut square = [0.0; 2];
        for s in samples {
            let (e, _) = map.at(s.pixel_px);
            for c in 0..2 {
                square[c] += (s.e_px[c] - e[c]).powi(2) / samples.len() as f64;
            }
        }
        Ok(MapFit { map, rms_px: square.map(f64::sqrt), factor })
    }

    /// Its grid.
    pub fn grid(&self) -> &MapGrid {
        &self.grid
    }

    /// (e_x, e_y) in pixels at an observed pixel, or nothing outside the grid.
    pub fn e_px(&self, pixel_px: [f64; 2]) -> Option<[f64; 2]> {
        self.grid.contains(pixel_px).then(|| self.at(pixel_px).0)
    }

    /// e and its derivatives ∂e_i/∂x_j; outside the grid the polynomials of the rim go on.
    #[inline]
    pub(crate) fn at(&self, pixel: [f64; 2]) -> ([f64; 2], [[f64; 2]; 2]) {
        let (i, wx, dx) = self.grid.weights(0, pixel[0]);
        let (j, wy, dy) = self.grid.weights(1, pixel[1]);
        let stride = self.grid.nodes[0] + 2;
        let (mut e, mut d) = ([0.0; 2], [[0.0; 2]; 2]);
        for r in 0..4 {
            let row = &self.coefficients[(j + r) * stride + i..][..4];
            let (mut v, mut s) = ([0.0; 2], [0.0; 2]);
            for (k, c) in row.iter().enumerate() {
                for a in 0..2 {
                    v[a] += wx[k] * c[a];
                    s[a] += dx[k] * c[a];
                }
            }
            for a in 0..2 {
                e[a] += wy[r] * v[a];
                d[a][0] += wy[r] * s[a];
                d[a][1] += dy[r] * v[a];
            }
        }
        (e, d)
    }
}

fn check_values(expected: usize, values: &[[f64; 2]]) -> Result<(), MapError> {
    if values.len() != expected {
        return Err(MapError::Count { expected, found: values.len() });
    }
    match values.iter().position(|v| !v.iter().all(|v| v.is_finite())) {
        Some(index) => Err(MapError::Value { index }),
        None => Ok(()),
    }
}

/// The sixteen coefficients that a pixel depends on, and how.
fn basis(grid: &MapGrid, pixel: [f64; 2]) -> [(usize, f64); 16] {
    let (i, wx, _) = grid.weights(0, pixel[0]);
    let (j, wy, _) = grid.weights(1, pixel[1]);
    let stride = grid.nodes[0] + 2;
    std::array::from_fn(|k| {
        let (a, b) = (k % 4, k / 4);
        ((j + b) * stride + i + a, wx[a] * wy[b])
    })
}

/// Values at `n` nodes from coefficients, with the two end conditions as first and last row.
fn not_a_knot(n: usize) -> nalgebra::LU<f64, nalgebra::Dyn, nalgebra::Dyn> {
    let mut m = DMatrix::zeros(n + 2, n + 2);
    for (k, v) in [1.0, -4.0, 6.0, -4.0, 1.0].into_iter().enumerate() {
        m[(0, k)] = v;
        m[(n + 1, n + 1 - k)] = v;
    }
    for i in 0..n {
        for (k, v) in [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0].into_iter().enumerate() {
            m[(i + 1, i + k)] = v;
        }
    }
    m.lu()
}

/// The maps of a set-up: one for the whole sensor, one for each view, any of them absent. What is
/// present adds up, all taken at the observed pixel; Brown's terms act on what remains, so a map
/// may stand alone or on top of them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DistortionMaps {
    /// For every pixel, whichever view it belongs to.
    pub sensor: Option<Arc<DistortionMap>>,
    /// For pixels of the −1 view, for instance taken through the grating.
    pub minus: Option<Arc<DistortionMap>>,
    /// For pixels of the +1 view.
    pub plus: Option<Arc<DistortionMap>>,
}

impl DistortionMaps {
    /// No map.
    pub const NONE: Self = Self { sensor: None, minus: None, plus: None };

    fn of(&self, view: View) -> impl Iterator<Item = &DistortionMap> {
        let own = match view {
            View::Minus => &self.minus,
            View::Plus => &self.plus,
        };
        self.sensor.iter().chain(own).map(Arc::as_ref)
    }

    /// Whether a pixel of `view` lies on every map that applies to it.
    pub fn contain(&self, view: View, pixel_px: [f64; 2]) -> bool {
        self.of(view).all(|m| m.grid.contains(pixel_px))
    }

    fn at(&self, view: View, pixel: [f64; 2]) -> ([f64; 2], [[f64; 2]; 2]) {
        let (mut e, mut d) = ([0.0; 2], [[0.0; 2]; 2]);
        for m in self.of(view) {
            let (em, dm) = m.at(pixel);
            for a in 0..2 {
                e[a] += em[a];
                for b in 0..2 {
                    d[a][b] += dm[a][b];
                }
            }
        }
        (e, d)
    }

    /// observed − e(observed), or nothing outside a map or where it folds over.
    #[inline]
    pub(crate) fn remove<T: Real>(&self, view: View, observed: [T; 2]) -> Option<[T; 2]> {
        if *self == Self::NONE {
            return Some(observed);
        }
        let at = observed.map(T::value);
        if !self.contain(view, at) {
            return None;
        }
        let (e, d) = self.at(view, at);
        if !one_to_one(&d) {
            return None;
        }
        let k = T::constant;
        let off = [observed[0] - k(at[0]), observed[1] - k(at[1])];
        Some([0, 1].map(|i| observed[i] - k(e[i]) - off[0] * k(d[i][0]) - off[1] * k(d[i][1])))
    }

    /// The observed pixel of an ideal one, or nothing if that is outside a map.
    #[inline]
    pub(crate) fn add<T: Real>(&self, view: View, ideal: [T; 2]) -> Option<[T; 2]> {
        if *self == Self::NONE {
            return Some(ideal);
        }
        let target = ideal.map(T::value);
        let mut o = target;
        for _ in 0..30 {
            let (e, d) = self.at(view, o);
            let m = [[1.0 - d[0][0], -d[0][1]], [-d[1][0], 1.0 - d[1][1]]];
            let miss = [0, 1].map(|i| o[i] - e[i] - target[i]);
            let step = solve2(m, miss)?;
            let [sx, sy] = step;
            o = [o[0] - sx, o[1] - sy];
            // Quadratic convergence: the error after a step of 1e-6 px is below rounding.
            if sx.abs() + sy.abs() < 1e-6 {
                let (e, d) = self.at(view, o);
                if !(self.contain(view, o) && one_to_one(&d)) {
                    return None;
                }
                // The last step in the caller's scalar brings in its derivatives.
                let m = [[1.0 - d[0][0], -d[0][1]], [-d[1][0], 1.0 - d[1][1]]];
                let miss = [0, 1].map(|i| T::constant(o[i] - e[i]) - ideal[i]);
                let step = solve2(m, miss)?;
                return Some([0, 1].map(|i| T::constant(o[i]) - step[i]));
            }
        }
        None
    }
}

fn one_to_one(d: &[[f64; 2]; 2]) -> bool {
    d[0][0] < 1.0 && (1.0 - d[0][0]) * (1.0 - d[1][1]) - d[0][1] * d[1][0] > 0.0
}
