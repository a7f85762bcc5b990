//! Regions of interest drawn as rectangles, circles, ellipses and polygons with holes.
//!
//! A pixel belongs to a region if its centre lies inside. Outlines shared by two polygons or
//! rectangles part the pixels between them: a centre exactly on the left or upper outline is
//! inside, on the right or lower one outside; circles and ellipses hold their outline. Coordinates
//! are pixels, pixel (0, 0) has its centre at (0, 0).

use crate::image::{Image, Mask};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// What a region does to those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Effect {
    /// Its pixels are added.
    #[default]
    Add,
    /// Its pixels are taken away.
    Remove,
}

/// One region. Parts outside the image do not matter, as long as some of it is inside.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum Region {
    /// x ≤ column < x + width, y ≤ row < y + height.
    Rectangle {
        /// Left.
        x: f64,
        /// Top.
        y: f64,
        /// Extent along x.
        width: f64,
        /// Extent along y.
        height: f64,
        /// Added or taken away.
        #[serde(default)]
        effect: Effect,
    },
    /// Disc.
    Circle {
        /// Centre (x, y).
        centre: [f64; 2],
        /// Radius.
        radius: f64,
        /// Added or taken away.
        #[serde(default)]
        effect: Effect,
    },
    /// Ellipse.
    Ellipse {
        /// Centre (x, y).
        centre: [f64; 2],
        /// Semi-axes: along x, and along y before it is turned.
        semi_axes: [f64; 2],
        /// Degrees by which the first axis is turned from x towards y.
        #[serde(default)]
        angle: f64,
        /// Added or taken away.
        #[serde(default)]
        effect: Effect,
    },
    /// Area inside one closed outline and outside all holes. An outline that crosses itself holds
    /// what an odd number of crossings leads to.
    Polygon {
        /// Corners (x, y) in order; the last is joined to the first.
        points: Vec<[f64; 2]>,
        /// Outlines of holes.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        holes: Vec<Vec<[f64; 2]>>,
        /// Added or taken away.
        #[serde(default)]
        effect: Effect,
    },
}

/// Regions in order: each adds its pixels or takes them away. A list that begins by taking away
/// begins with the whole image.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Regions {
    /// The regions.
    pub region: Vec<Region>,
}

/// Why regions cannot be used; `index` counts them from 0.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum RegionError {
    /// There is none.
    #[error("no region is given")]
    None,
    /// A number is not finite or too large.
    #[error("region[{index}].{field} = {value} is not a number within ±{limit}")]
    Number {
        /// Which region.
        index: usize,
        /// Which field.
        field: &'static str,
        /// Value given.
        value: f64,
        /// Largest accepted.
        limit: f64,
    },
    /// A length that must be positive is not.
    #[error("region[{index}].{field} = {value} must be more than 0")]
    Length {
        /// Which region.
        index: usize,
        /// Which field.
        field: &'static str,
        /// Value given.
        value: f64,
    },
    /// An outline with fewer than three corners.
    #[error("region[{index}].{field} has {found} corners, an outline needs at least 3")]
    Corners {
        /// Which region.
        index: usize,
        /// Which field.
        field: &'static str,
        /// Corners given.
        found: usize,
    },
    /// An outline whose corners lie on one line.
    #[error("region[{index}].{field} encloses no area")]
    Area {
        /// Which region.
        index: usize,
        /// Which field.
        field: &'static str,
    },
    /// The region holds no pixel of the image.
    #[error("region[{index}] holds no pixel of the image of {width}×{height} pixels")]
    NoPixel {
        /// Which region.
        index: usize,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// Nothing is left when all have been applied.
    #[error("the regions together leave no pixel of the image")]
    Nothing,
    /// The image has no content or is too large.
    #[error("regions cannot be drawn on {width}×{height} pixels")]
    Size {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
}

/// Largest coordinate accepted.
const LIMIT: f64 = 1e6;

impl Region {
    /// Added or taken away.
    pub fn effect(&self) -> Effect {
        match self {
            Region::Rectangle { effect, .. }
            | Region::Circle { effect, .. }
            | Region::Ellipse { effect, .. }
            | Region::Polygon { effect, .. } => *effect,
        }
    }

    fn check(&self, index: usize) -> Result<(), RegionError> {
        let number = |field: &'static str, value: f64| {
            if value.is_finite() && value.abs() <= LIMIT {
                Ok(())
            } else {
                Err(RegionError::Number { index, field, value, limit: LIMIT })
            }
        };
        let length = |field: &'static str, value: f64| {
            number(field, value)?;
            if value > 0.0 { Ok(()) } else { Err(RegionError::Length { index, field, value }) }
        };
        match self {
            Region::Rectangle { x, y, width, height, .. } => {
                number("x", *x)?;
                number("y", *y)?;
                length("width", *width)?;
                length("height", *height)
            }
            Region::Circle { centre, radius, .. } => {
                centre.iter().try_for_each(|&c| number("centre", c))?;
                length("radius", *radius)
            }
            Region::Ellipse { centre, semi_axes, angle, .. } => {
                centre.iter().try_for_each(|&c| number("centre", c))?;
                semi_axes.iter().try_for_each(|&a| length("semi_axes", a))?;
                number("angle", *angle)
            }
            Region::Polygon { points, holes, .. } => {
                let outlines = holes.iter().map(|h| ("holes", h));
                for (field, outline) in std::iter::once(("points", points)).chain(outlines) {
                    if outline.len() < 3 {
                        return Err(RegionError::Corners { index, field, found: outline.len() });
                    }
                    outline.iter().flatten().try_for_each(|&c| number(field, c))?;
                    if flat(outline) {
                        return Err(RegionError::Area { index, field });
                    }
                }
                Ok(())
            }
        }
    }

    /// Calls `span` with a row and the columns `from..to` inside, for all rows; spans of one row do
    /// not overlap.
    fn spans(&self, width: usize, height: usize, mut span: impl FnMut(usize, usize, usize)) {
        // columns whose centres c have from ≤ c < to
        let columns = |from: f64, to: f64| {
            let edge = |c: f64| c.ceil().clamp(0.0, width as f64) as usize;
            (edge(from), edge(to))
        };
        match self {
            Region::Rectangle { x, y, width: w, height: h, .. } => {
                let edge = |c: f64| c.ceil().clamp(0.0, height as f64) as usize;
                let (a, b) = columns(*x, x + w);
                (edge(*y)..edge(y + h)).for_each(|row| span(row, a, b));
            }
            Region::Circle { centre, radius, .. } => {
                ellipse(width, height, *centre, [*radius; 2], 0.0, span);
            }
            Region::Ellipse { centre, semi_axes, angle, .. } => {
                ellipse(width, height, *centre, *semi_axes, *angle, span);
            }
            Region::Polygon { points, holes, .. } => {
                let mut inside = vec![false; width];
                for row in 0..height {
                    let crossings = crossings(points, row as f64);
                    if crossings.is_empty() {
                        continue;
                    }
                    inside.fill(false);
                    for pair in crossings.chunks_exact(2) {
                        let (a, b) = columns(pair[0], pair[1]);
                        inside[a..b.max(a)].fill(true);
                    }
                    for hole in holes {
                        for pair in self::crossings(hole, row as f64).chunks_exact(2) {
                            let (a, b) = columns(pair[0], pair[1]);
                            inside[a..b.max(a)].fill(false);
                        }
                    }
                    let mut at = 0;
                    for run in inside.chunk_by(|a, b| a == b) {
                        if run[0] {
                            span(row, at, at + run.len());
                        }
                        at += run.len();
                    }
                }
            }
        }
    }
}

/// Whether all corners lie on one line.
fn flat(outline: &[[f64; 2]]) -> bool {
    let a = outline[0];
    let away = |p: &&[f64; 2]| (p[0] - a[0]).hypot(p[1] - a[1]);
    let Some(b) = outline.iter().max_by(|p, q| away(p).total_cmp(&away(q))) else {
        return true;
    };
    let length = away(&b);
    outline.iter().all(|p| {
        ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])).abs() <= 1e-9 * length * length
    })
}

/// Columns where an outline crosses a row, ascending; corners on the row count with what lies below.
fn crossings(outline: &[[f64; 2]], y: f64) -> Vec<f64> {
    let ends = outline.iter().zip(outline.iter().cycle().skip(1));
    let mut x: Vec<f64> = ends
        .filter(|(a, b)| (a[1] <= y) != (b[1] <= y))
        .map(|(a, b)| a[0] + (y - a[1]) * (b[0] - a[0]) / (b[1] - a[1]))
        .collect();
    x.sort_by(f64::total_cmp);
    x
}

fn ellipse(
    width: usize,
    height: usize,
    [cx, cy]: [f64; 2],
    [a, b]: [f64; 2],
    angle: f64,
    mut span: impl FnMut(usize, usize, usize),
) {
    let (s, c) = angle.to_radians().sin_cos();
    // p x² + 2 q x y + r y² ≤ 1 about the centre
    let (ia, ib) = (1.0 / (a * a), 1.0 / (b * b));
    let (p, q, r) = (c * c * ia + s * s * ib, s * c * (ia - ib), s * s * ia + c * c * ib);
    for row in 0..height {
        let y = row as f64 - cy;
        let middle = -q * y / p;
        let half = middle * middle - (r * y * y - 1.0) / p;
        // a rounding error must not lose a centre that lies on the outline
        if half < -1e-9 {
            continue;
        }
        let half = half.max(0.0).sqrt() + 1e-9;
        let first = (cx + middle - half).ceil().max(0.0);
        let last = (cx + middle + half).floor().min(width as f64 - 1.0);
        if first <= last {
            span(row, first as usize, last as usize + 1);
        }
    }
}

impl Regions {
    /// Checks everything that does not depend on the image.
    ///
    /// # Errors
    /// The first [`RegionError`] found.
    pub fn validate(&self) -> Result<(), RegionError> {
        if self.region.is_empty() {
            return Err(RegionError::None);
        }
        self.region.iter().enumerate().try_for_each(|(index, r)| r.check(index))
    }

    /// The pixels of an image of `width` × `height` that the regions hold.
    ///
    /// # Errors
    /// [`RegionError`], also where a region holds no pixel or nothing is left.
    pub fn mask(&self, width: usize, height: usize) -> Result<Mask, RegionError> {
        self.validate()?;
        if width == 0 || height == 0 || width > Image::MAX_SIDE || height > Image::MAX_SIDE {
            return Err(RegionError::Size { width, height });
        }
        let all = self.region[0].effect() == Effect::Remove;
        let mut inside = vec![all; width * height];
        for (index, region) in self.region.iter().enumerate() {
            let mut pixels = 0;
            let value = region.effect() == Effect::Add;
            region.spans(width, height, |row, from, to| {
                if from < to {
                    inside[row * width + from..row * width + to].fill(value);
                    pixels += to - from;
                }
            });
            if pixels == 0 {
                return Err(RegionError::NoPixel { index, width, height });
            }
        }
        if !inside.contains(&true) {
            return Err(RegionError::Nothing);
        }
        Ok(Mask::from_parts(width, height, inside))
    }
}
