//! Points of interest: a regular grid over a region, or a scattered list; and who neighbours whom.

use crate::domain::{Coverage, Domain};
use crate::image::Mask;
use std::sync::Arc;
use thiserror::Error;

/// Rectangle of pixels: columns `x..x + width`, rows `y..y + height`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rectangle {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// Region of interest in the reference image.
///
/// The rectangle limits the *centres* of the subsets, the mask limits their *pixels*. With
/// [`Points::grid`] a subset is used only if all of it lies in the image and in the mask; with
/// [`Points::grid_cut`] what is inside is used.
#[derive(Debug, Clone, Copy, Default)]
pub struct Roi<'a> {
    /// Where subset centres may lie; `None`: the whole image.
    pub rectangle: Option<Rectangle>,
    /// Which pixels subsets may use; `None`: all.
    pub mask: Option<&'a Mask>,
}

/// Why no points of interest could be laid out.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PointsError {
    /// The grid step is zero.
    #[error("the grid step must be at least one pixel")]
    ZeroStep,
    /// The region reaches beyond the image.
    #[error(
        "the region of interest (columns {}..{}, rows {}..{}) is not inside the image of {width}×{height} pixels",
        roi.x, roi.x.saturating_add(roi.width), roi.y, roi.y.saturating_add(roi.height)
    )]
    RoiOutside {
        /// Region given.
        roi: Rectangle,
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
    },
    /// The mask has another size than the image.
    #[error("the mask has {mask_width}×{mask_height} pixels, the image {width}×{height}")]
    MaskSize {
        /// Columns of the mask.
        mask_width: usize,
        /// Rows of the mask.
        mask_height: usize,
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
    },
    /// No subset fits into the region.
    #[error("no subset of {subset} pixels fits into the region of interest")]
    Empty {
        /// Subset given.
        subset: usize,
    },
    /// A scattered point has no usable position.
    #[error("point {index} is not at a finite position within ±{limit} pixels")]
    Position {
        /// Index in the list.
        index: usize,
        /// Largest coordinate accepted.
        limit: f64,
    },
    /// The share of a subset that must be inside is none.
    #[error("the share of a subset that must be inside, {value}, is outside {min}..=1")]
    MinInside {
        /// Value given.
        value: f64,
        /// Smallest accepted.
        min: f64,
    },
    /// More points than can be indexed.
    #[error("{count} points are more than the {limit} that can be treated at once")]
    TooMany {
        /// Points asked for.
        count: usize,
        /// Most accepted.
        limit: usize,
    },
}

/// Shape of a regular grid. Its nodes that have a valid subset are points.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grid {
    /// Column of the first node's pixel.
    pub x0: usize,
    /// Row of the first node's pixel.
    pub y0: usize,
    /// Distance between nodes in pixels.
    pub step: usize,
    /// Nodes along x.
    pub columns: usize,
    /// Nodes along y.
    pub rows: usize,
    index: Vec<u32>,
}

impl Grid {
    /// Index of the point at node (column i, row j), if there is one.
    pub fn point(&self, i: usize, j: usize) -> Option<usize> {
        if i >= self.columns || j >= self.rows {
            return None;
        }
        match self.index[j * self.columns + i] {
            NONE => None,
            k => Some(k as usize),
        }
    }
}

const NONE: u32 = u32::MAX;
/// Neighbours kept per point.
const RING: usize = 8;

/// Points of interest in the reference image and their neighbourhood.
#[derive(Debug, Clone)]
pub struct Points {
    xy: Vec<[f64; 2]>,
    grid: Option<Grid>,
    starts: Vec<u32>,
    neighbours: Vec<u32>,
    domain: Option<Arc<Domain>>,
}

/// What a grid does with subsets that are not all inside.
#[derive(Clone, Copy, PartialEq)]
enum Edge {
    Whole,
    Cut(f64),
}

impl Points {
    /// Most points in one run.
    pub const MAX: usize = 1 << 28;

    /// Pixels at the image's edge that subsets of a grid stay clear of: there the spline rests on
    /// mirrored grey levels, and points are several thousandths of a pixel off (on the golden
    /// translation the outermost row had twice the scatter of the inner ones).
    pub const BORDER: usize = 4;

    /// Regular grid in an image of `width` × `height` pixels. The first node is the first pixel of
    /// the rectangle from which a subset stays [`Points::BORDER`] clear of the image's edge, i.e. at
    /// column max(rectangle.x, subset / 2 + BORDER), and likewise for the row; nodes follow every `step` pixels.
    /// Nodes whose subset leaves the image or the mask are no points.
    ///
    /// # Errors
    /// [`PointsError`].
    pub fn grid(
        width: usize,
        height: usize,
        subset: usize,
        step: usize,
        roi: &Roi<'_>,
    ) -> Result<Self, PointsError> {
        let points = Self::lay_out(width, height, subset, step, roi, Edge::Whole)?;
        // whole subsets need no mask any more
        Ok(Self { domain: None, ..points })
    }

    /// Smallest share of a subset that [`Points::grid_cut`] and [`Points::within`] accept.
    pub const MIN_INSIDE: f64 = 0.1;

    /// As [`Points::grid`], with subsets that are cut: of a subset only the pixels in the mask and at
    /// least [`Points::BORDER`] clear of the image's edge are used. Nodes whose centre pixel may be
    /// used, and at least the share `min_inside` (0.1 to 1) of all pixels of their subset, are
    /// points. The nodes are those of [`Points::grid`], and more around them.
    ///
    /// # Errors
    /// [`PointsError`].
    pub fn grid_cut(
        width: usize,
        height: usize,
        subset: usize,
        step: usize,
        roi: &Roi<'_>,
        min_inside: f64,
    ) -> Result<Self, PointsError> {
        Self::lay_out(width, height, subset, step, roi, Edge::Cut(min_inside))
    }

    /// Lets subsets use only the pixels of a mask: subsets are cut by it and by the image's edge, as
    /// in [`Points::grid_cut`]. Points that keep less than `min_inside` of their subset come back as
    /// [`Status::OutOfImage`](crate::Status::OutOfImage).
    ///
    /// # Errors
    /// [`PointsError::MinInside`].
    pub fn within(self, mask: &Mask, min_inside: f64) -> Result<Self, PointsError> {
        let domain = Some(Arc::new(Domain::new(clear_of_edge(mask), checked(min_inside)?)));
        Ok(Self { domain, ..self })
    }

    fn lay_out(
        width: usize,
        height: usize,
        subset: usize,
        step: usize,
        roi: &Roi<'_>,
        edge: Edge,
    ) -> Result<Self, PointsError> {
        if step == 0 {
            return Err(PointsError::ZeroStep);
        }
        let all = Rectangle { x: 0, y: 0, width, height };
        let rect = roi.rectangle.unwrap_or(all);
        let fits = |start: usize, len: usize, size: usize| {
            len > 0 && start.checked_add(len).is_some_and(|end| end <= size)
        };
        if !fits(rect.x, rect.width, width) || !fits(rect.y, rect.height, height) {
            return Err(PointsError::RoiOutside { roi: rect, width, height });
        }
        if let Some(m) = roi.mask
            && (m.width(), m.height()) != (width, height)
        {
            return Err(PointsError::MaskSize {
                mask_width: m.width(),
                mask_height: m.height(),
                width,
                height,
            });
        }
        let r = subset / 2;
        let whole = r + Self::BORDER;
        let (reach, min_inside) = match edge {
            Edge::Whole => (whole, 1.0),
            Edge::Cut(min_inside) => (Self::BORDER, checked(min_inside)?),
        };
        let nodes = |start: usize, len: usize, size: usize| {
            let mut first = start.max(reach);
            if first < whole {
                // the nodes of whole subsets are among those of cut ones
                first += (start.max(whole) - first) % step;
            }
            let end = (start + len).min(size.saturating_sub(reach));
            (first, end.saturating_sub(first).div_ceil(step))
        };
        let (x0, columns) = nodes(rect.x, rect.width, width);
        let (y0, rows) = nodes(rect.y, rect.height, height);
        let domain = match (edge, roi.mask) {
            (Edge::Whole, None) => None,
            (Edge::Whole, Some(m)) => Some(Domain::new(m.clone(), min_inside)),
            (Edge::Cut(_), Some(m)) => Some(Domain::new(clear_of_edge(m), min_inside)),
            (Edge::Cut(_), None) => {
                let all = Mask::from_parts(width, height, vec![true; width * height]);
                Some(Domain::new(clear_of_edge(&all), min_inside))
            }
        };
        let mut xy = Vec::new();
        let mut index = vec![NONE; columns * rows];
        for j in 0..rows {
            for i in 0..columns {
                let (x, y) = (x0 + i * step, y0 + j * step);
                let coverage = |d: &Domain| d.coverage(x as i32, y as i32, r as i32);
                if domain.as_ref().is_none_or(|d| coverage(d) != Coverage::Outside) {
                    index[j * columns + i] = xy.len() as u32;
                    xy.push([x as f64, y as f64]);
                }
            }
        }
        if xy.is_empty() {
            return Err(PointsError::Empty { subset });
        }
        let grid = Grid { x0, y0, step, columns, rows, index };
        let mut starts = vec![0u32];
        let mut neighbours = Vec::with_capacity(xy.len() * RING);
        for j in 0..rows {
            for i in 0..columns {
                if grid.point(i, j).is_none() {
                    continue;
                }
                for (b, a) in around(i, j) {
                    if let Some(k) = grid.point(b, a) {
                        neighbours.push(k as u32);
                    }
                }
                starts.push(neighbours.len() as u32);
            }
        }
        Ok(Self { xy, grid: Some(grid), starts, neighbours, domain: domain.map(Arc::new) })
    }

    /// Scattered points at any sub-pixel positions. The subset of a point is centred at the nearest
    /// pixel; the fitted shape function is evaluated at the point itself, at most half a pixel
    /// away along each axis. Points whose subset leaves the image are kept and come back as
    /// [`Status::OutOfImage`](crate::Status::OutOfImage).
    ///
    /// # Errors
    /// [`PointsError::Position`] for coordinates that are not finite or beyond 2²⁰,
    /// [`PointsError::TooMany`].
    pub fn scattered(xy: Vec<[f64; 2]>) -> Result<Self, PointsError> {
        let limit = f64::from(1 << 20);
        if xy.len() > Self::MAX {
            return Err(PointsError::TooMany { count: xy.len(), limit: Self::MAX });
        }
        if let Some(index) = xy.iter().position(|p| !p.iter().all(|c| c.is_finite() && c.abs() <= limit)) {
            return Err(PointsError::Position { index, limit });
        }
        let (starts, neighbours) = nearest(&xy);
        Ok(Self { xy, grid: None, starts, neighbours, domain: None })
    }

    /// Some of the points, with neighbours of their own.
    pub(crate) fn selected(&self, which: &[usize]) -> Self {
        let xy: Vec<[f64; 2]> = which.iter().map(|&k| self.xy[k]).collect();
        let (starts, neighbours) = nearest(&xy);
        Self { xy, grid: None, starts, neighbours, domain: self.domain.clone() }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.xy.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.xy.is_empty()
    }

    /// Positions.
    pub fn positions(&self) -> &[[f64; 2]] {
        &self.xy
    }

    /// The grid, where the points form one.
    pub fn as_grid(&self) -> Option<&Grid> {
        self.grid.as_ref()
    }

    /// Indices of the points around point k: up to eight, on a grid the adjacent nodes.
    pub fn neighbours(&self, k: usize) -> &[u32] {
        &self.neighbours[self.starts[k] as usize..self.starts[k + 1] as usize]
    }

    /// Pixels that subsets may use, where subsets are cut.
    pub(crate) fn domain(&self) -> Option<&Domain> {
        self.domain.as_deref()
    }

    /// Centre pixel of the subset of point k and the offset of the point from it.
    pub(crate) fn centre(&self, k: usize) -> ((i32, i32), [f64; 2]) {
        let [x, y] = self.xy[k];
        if self.grid.is_some() {
            return ((x as i32, y as i32), [0.0, 0.0]);
        }
        let (cx, cy) = (x.round(), y.round());
        ((cx as i32, cy as i32), [x - cx, y - cy])
    }
}

fn checked(min_inside: f64) -> Result<f64, PointsError> {
    if (Points::MIN_INSIDE..=1.0).contains(&min_inside) {
        Ok(min_inside)
    } else {
        Err(PointsError::MinInside { value: min_inside, min: Points::MIN_INSIDE })
    }
}

/// The mask without the image's outermost pixels.
fn clear_of_edge(mask: &Mask) -> Mask {
    let (w, h) = (mask.width(), mask.height());
    let b = Points::BORDER;
    let inside = (0..w * h)
        .map(|k| {
            let (x, y) = (k % w, k / w);
            mask.pixels()[k] && x >= b && y >= b && x + b < w && y + b < h
        })
        .collect();
    Mask::from_parts(w, h, inside)
}

/// Nodes adjacent to (i, j), the four nearest first.
fn around(i: usize, j: usize) -> impl Iterator<Item = (usize, usize)> {
    const D: [(isize, isize); RING] = [(0, -1), (-1, 0), (1, 0), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)];
    D.into_iter().filter_map(move |(a, b)| Some((i.checked_add_signed(a)?, j.checked_add_signed(b)?)))
}

/// The nearest points of each (up to eight, within three times the mean spacing) by a bucket grid;
/// ties go to the lower index.
fn nearest(xy: &[[f64; 2]]) -> (Vec<u32>, Vec<u32>) {
    let n = xy.len();
    if n == 0 {
        return (vec![0], Vec::new());
    }
    let (mut lo, mut hi) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for p in xy {
        for c in 0..2 {
            lo[c] = lo[c].min(p[c]);
            hi[c] = hi[c].max(p[c]);
        }
    }
    let area = ((hi[0] - lo[0]).max(1.0)) * ((hi[1] - lo[1]).max(1.0));
    // at most about two buckets per point, also where all points lie on one line
    let cell =
        (area / n as f64).sqrt().max((hi[0] - lo[0]).max(hi[1] - lo[1]) / (2.0 * n as f64)).max(1e-3) * 1.5;
    let columns = ((hi[0] - lo[0]) / cell) as usize + 1;
    let rows = ((hi[1] - lo[1]) / cell) as usize + 1;
    let bucket = |p: &[f64; 2]| {
        let i = (((p[0] - lo[0]) / cell) as usize).min(columns - 1);
        let j = (((p[1] - lo[1]) / cell) as usize).min(rows - 1);
        (i, j)
    };
    let mut counts = vec![0u32; columns * rows + 1];
    for p in xy {
        let (i, j) = bucket(p);
        counts[j * columns + i + 1] += 1;
    }
    for k in 1..counts.len() {
        counts[k] += counts[k - 1];
    }
    let mut fill = counts.clone();
    let mut order = vec![0u32; n];
    for (k, p) in xy.iter().enumerate() {
        let (i, j) = bucket(p);
        let at = &mut fill[j * columns + i];
        order[*at as usize] = k as u32;
        *at += 1;
    }
    let reach = 2.0 * cell;
    let mut starts = vec![0u32];
    let mut neighbours = Vec::with_capacity(n * RING);
    let mut near: Vec<(f64, u32)> = Vec::new();
    for (k, p) in xy.iter().enumerate() {
        near.clear();
        let (i, j) = bucket(p);
        for b in j.saturating_sub(2)..(j + 3).min(rows) {
            for a in i.saturating_sub(2)..(i + 3).min(columns) {
                let c = b * columns + a;
                for &m in &order[counts[c] as usize..counts[c + 1] as usize] {
                    let q = xy[m as usize];
                    let d = (p[0] - q[0]).powi(2) + (p[1] - q[1]).powi(2);
                    if m as usize != k && d <= reach * reach {
                        near.push((d, m));
                    }
                }
            }
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        neighbours.extend(near.iter().take(RING).map(|e| e.1));
        starts.push(neighbours.len() as u32);
    }
    (starts, neighbours)
}
