//! The two first-order views of one specimen in one frame.
//!
//! Behind the grating the specimen appears twice, textured and lit, on a dark and even background:
//! order −1 on the left, order +1 on the right of the sensor.

use crate::image::{Image, Mask};
use crate::points::Rectangle;
use thiserror::Error;

/// Side of the blocks in which texture is measured, pixels.
const BLOCK: usize = 4;
/// Blocks to each side of a block that share its measure of texture.
const REACH: usize = 2;
/// How much more texture the specimens must have than the background.
const CONTRAST: f64 = 3.0;
/// Regions smaller than this part of the frame are dust.
const DUST: f64 = 0.005;
/// Regions smaller than this part of the largest are reflections and shadows.
const MINOR: f64 = 0.1;

/// One view: its pixels and their bounding box.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct View {
    /// Pixels of the specimen in this view.
    pub mask: Mask,
    /// Smallest rectangle that holds them.
    pub bounds: Rectangle,
}

/// Both first-order views of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Views {
    /// Order −1, on the left of the sensor.
    pub minus: View,
    /// Order +1, on the right.
    pub plus: View,
}

/// Why the two views were not found.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ViewsError {
    /// The frame is too small to measure texture in it.
    #[error("a frame of {width}×{height} pixels is too small to hold two views: at least {min}×{min}")]
    TooSmall {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Smallest side.
        min: usize,
    },
    /// Nothing textured stands out of the background.
    #[error(
        "no textured region stands out of the background: lit specimens must have {required} times its grey-level variation, here it is {found:.2}"
    )]
    NoRegion {
        /// Ratio of texture between the frame's two classes of pixels.
        found: f64,
        /// Ratio required.
        required: f64,
    },
    /// A single region, which does not fall into two at a dark or narrow column near the centre.
    #[error(
        "only one textured region was found (columns {}..{}, rows {}..{}) and it does not split near the centre column",
        bounds.x, bounds.x + bounds.width, bounds.y, bounds.y + bounds.height
    )]
    OneRegion {
        /// Its bounding box.
        bounds: Rectangle,
    },
    /// More than two regions.
    #[error("{} textured regions were found where two views are expected", bounds.len())]
    ManyRegions {
        /// Their bounding boxes, largest region first.
        bounds: Vec<Rectangle>,
    },
    /// Both regions lie on the same side of the centre column.
    #[error("both textured regions lie on the same side of the centre column {centre}")]
    SameSide {
        /// Centre column of the sensor.
        centre: f64,
        /// Bounding boxes, from left to right.
        bounds: [Rectangle; 2],
    },
}

/// Blocks of the frame with their local standard deviation.
struct Texture {
    columns: usize,
    rows: usize,
    /// Over the window around each block.
    deviation: Vec<f64>,
    /// Over the block alone.
    own: Vec<f64>,
}

impl Texture {
    fn new(image: &Image) -> Self {
        let (columns, rows) = (image.width() / BLOCK, image.height() / BLOCK);
        let mut sums = vec![(0.0f64, 0.0f64); columns * rows];
        let shift = image.mean();
        for y in 0..rows * BLOCK {
            let line = &mut sums[y / BLOCK * columns..][..columns];
            for (s, c) in line.iter_mut().zip(image.row(y).chunks_exact(BLOCK)) {
                for g in c {
                    let g = f64::from(g - shift);
                    s.0 += g;
                    s.1 += g * g;
                }
            }
        }
        let mut deviation = vec![0.0; columns * rows];
        for j in 0..rows {
            for i in 0..columns {
                let (mut s, mut q, mut n) = (0.0, 0.0, 0.0);
                for b in j.saturating_sub(REACH)..(j + REACH + 1).min(rows) {
                    for a in i.saturating_sub(REACH)..(i + REACH + 1).min(columns) {
                        let c = sums[b * columns + a];
                        s += c.0;
                        q += c.1;
                        n += (BLOCK * BLOCK) as f64;
                    }
                }
                deviation[j * columns + i] = ((q - s * s / n) / n).max(0.0).sqrt();
            }
        }
        let n = (BLOCK * BLOCK) as f64;
        let own = sums.iter().map(|(s, q)| ((q - s * s / n) / n).max(0.0).sqrt()).collect();
        Self { columns, rows, deviation, own }
    }

    /// Threshold between background and specimens (Otsu on the logarithm) and the ratio of the
    /// two classes' texture.
    fn threshold(&self) -> (f64, f64) {
        const BINS: usize = 256;
        let largest = self.deviation.iter().copied().fold(0.0, f64::max);
        if largest <= 0.0 {
            return (0.0, 1.0);
        }
        // a noiseless background counts as one thousandth of the largest
        let log = |d: f64| (d.max(1e-3 * largest) / largest).ln();
        let scale = (BINS - 1) as f64 / -(1e-3f64.ln());
        let mut histogram = [0.0f64; BINS];
        for &d in &self.deviation {
            histogram[((log(d) - 1e-3f64.ln()) * scale) as usize] += 1.0;
        }
        let total: f64 = histogram.iter().sum();
        let moment: f64 = histogram.iter().enumerate().map(|(k, h)| k as f64 * h).sum();
        let (mut n0, mut m0) = (0.0, 0.0);
        let mut best = (-1.0, 0usize, 1.0);
        for (k, h) in histogram.iter().enumerate().take(BINS - 1) {
            n0 += h;
            m0 += k as f64 * h;
            let n1 = total - n0;
            if n0 == 0.0 || n1 == 0.0 {
                continue;
            }
            let apart = (moment - m0) / n1 - m0 / n0;
            let between = n0 * n1 * apart * apart;
            if between > best.0 {
                best = (between, k, (apart / scale).exp());
            }
        }
        let edge = (best.1 + 1) as f64 / scale + 1e-3f64.ln();
        (edge.exp() * largest, best.2)
    }
}

/// Finds the two first-order views in a frame.
///
/// Texture is the standard deviation of the grey levels over 20 × 20 pixels; it is separated from
/// the background by Otsu's threshold, the margin that the window adds is taken off again, holes
/// are filled, and what is connected makes a region. The masks follow the specimens' edges to
/// about one block of 4 pixels, from the inside.
///
/// # Errors
/// [`ViewsError`] where there are not exactly two regions, one on either side of the centre.
pub fn find_views(image: &Image) -> Result<Views, ViewsError> {
    let (width, height) = (image.width(), image.height());
    let min = BLOCK * (4 * REACH + 2);
    if width < min || height < min {
        return Err(ViewsError::TooSmall { width, height, min });
    }
    let texture = Texture::new(image);
    let (columns, rows) = (texture.columns, texture.rows);
    let (threshold, found) = texture.threshold();
    if found < CONTRAST {
        return Err(ViewsError::NoRegion { found, required: CONTRAST });
    }
    let mut lit: Vec<bool> = texture.deviation.iter().map(|&d| d > threshold).collect();
    erode(&mut lit, columns, rows, REACH);
    fill_holes(&mut lit, columns, rows);
    let (mut labels, mut sizes) = components(&lit, columns, rows);
    let least = |sizes: &[usize]| {
        let largest = sizes.iter().copied().max().unwrap_or(0) as f64;
        (MINOR * largest).max(DUST * (columns * rows) as f64)
    };
    let limit = least(&sizes);
    let mut large: Vec<usize> = (0..sizes.len()).filter(|&k| sizes[k] as f64 >= limit).collect();
    if large.len() == 1 && split(&texture, &mut labels, large[0], sizes.len()) {
        large.push(sizes.len());
        let right = labels.iter().filter(|&&l| l == sizes.len()).count();
        sizes[large[0]] -= right;
        sizes.push(right);
    }
    large.sort_by(|&a, &b| sizes[b].cmp(&sizes[a]).then(a.cmp(&b)));
    let view = |label: usize| view(image, &labels, columns, label);
    match large[..] {
        [] => Err(ViewsError::NoRegion { found, required: CONTRAST }),
        [one] => Err(ViewsError::OneRegion { bounds: view(one).bounds }),
        [a, b] => {
            let (mut minus, mut plus) = (view(a), view(b));
            let middle = |v: &View| v.bounds.x as f64 + 0.5 * (v.bounds.width as f64 - 1.0);
            if middle(&minus) > middle(&plus) {
                std::mem::swap(&mut minus, &mut plus);
            }
            let centre = 0.5 * (width as f64 - 1.0);
            if middle(&minus) >= centre || middle(&plus) <= centre {
                return Err(ViewsError::SameSide { centre, bounds: [minus.bounds, plus.bounds] });
            }
            Ok(Views { minus, plus })
        }
        _ => Err(ViewsError::ManyRegions { bounds: large.iter().map(|&k| view(k).bounds).collect() }),
    }
}

/// Takes `reach` blocks off every edge; the frame's border is no edge.
fn erode(lit: &mut [bool], columns: usize, rows: usize, reach: usize) {
    let before = lit.to_vec();
    for j in 0..rows {
        for i in 0..columns {
            let whole = (j.saturating_sub(reach)..(j + reach + 1).min(rows)).all(|b| {
                let line = &before[b * columns..(b + 1) * columns];
                line[i.saturating_sub(reach)..(i + reach + 1).min(columns)].iter().all(|&l| l)
            });
            lit[j * columns + i] = whole;
        }
    }
}

/// Dark blocks that the background does not reach belong to the specimen.
fn fill_holes(lit: &mut [bool], columns: usize, rows: usize) {
    let dark: Vec<bool> = lit.iter().map(|&l| !l).collect();
    let (labels, sizes) = components(&dark, columns, rows);
    let mut open = vec![false; sizes.len()];
    for j in 0..rows {
        for i in 0..columns {
            let border = i == 0 || j == 0 || i == columns - 1 || j == rows - 1;
            let l = labels[j * columns + i];
            if border && l != usize::MAX {
                open[l] = true;
            }
        }
    }
    for (b, &l) in lit.iter_mut().zip(&labels) {
        if l != usize::MAX && !open[l] {
            *b = true;
        }
    }
}

/// Labels of the 4-connected components of the blocks that are set, and their sizes.
fn components(set: &[bool], columns: usize, rows: usize) -> (Vec<usize>, Vec<usize>) {
    let mut labels = vec![usize::MAX; set.len()];
    let mut sizes = Vec::new();
    let mut stack = Vec::new();
    for start in 0..set.len() {
        if !set[start] || labels[start] != usize::MAX {
            continue;
        }
        let label = sizes.len();
        let mut size = 0;
        labels[start] = label;
        stack.push(start);
        while let Some(k) = stack.pop() {
            size += 1;
            let (i, j) = (k % columns, k / columns);
            let mut visit = |n: usize| {
                if set[n] && labels[n] == usize::MAX {
                    labels[n] = label;
                    stack.push(n);
                }
            };
            if i > 0 {
                visit(k - 1);
            }
            if i + 1 < columns {
                visit(k + 1);
            }
            if j > 0 {
                visit(k - columns);
            }
            if j + 1 < rows {
                visit(k + columns);
            }
        }
        sizes.push(size);
    }
    (labels, sizes)
}

/// Two views that touch: cuts the region at its narrowest or least textured column in the middle
/// third of the frame, if that is clearly a valley; the right part gets the label `fresh`.
fn split(texture: &Texture, labels: &mut [usize], label: usize, fresh: usize) -> bool {
    let columns = texture.columns;
    let mut count = vec![0.0f64; columns];
    let mut strength = vec![0.0f64; columns];
    for (k, &l) in labels.iter().enumerate() {
        if l == label {
            count[k % columns] += 1.0;
            strength[k % columns] += texture.own[k];
        }
    }
    let median = |v: &[f64]| {
        let mut s: Vec<f64> = v.iter().copied().filter(|&c| c > 0.0).collect();
        s.sort_by(f64::total_cmp);
        s.get(s.len() / 2).copied().unwrap_or(0.0)
    };
    let (from, to) = (columns / 3, columns - columns / 3);
    for (profile, depth) in [(&count, 0.7), (&strength, 0.6)] {
        let middle = columns as f64 / 2.0;
        let valley = (from..to).min_by(|&a, &b| {
            let off = |c: usize| (c as f64 + 0.5 - middle).abs();
            profile[a].total_cmp(&profile[b]).then(off(a).total_cmp(&off(b)))
        });
        let Some(valley) = valley else {
            return false;
        };
        let sides = median(&profile[..valley]).min(median(&profile[valley + 1..]));
        let right = count[valley + 1..].iter().sum::<f64>();
        let left = count[..valley].iter().sum::<f64>();
        // each view must hold a good part of the region
        let balanced = left.min(right) >= 0.2 * (left + right);
        if balanced && profile[valley] <= depth * sides {
            for (k, l) in labels.iter_mut().enumerate() {
                if *l == label && k % columns >= valley {
                    // the valley's own column belongs to neither
                    *l = if k % columns == valley { usize::MAX } else { fresh };
                }
            }
            return true;
        }
    }
    false
}

/// Pixels of one region. Blocks at the right and lower border are stretched over the rest of the
/// frame.
fn view(image: &Image, labels: &[usize], columns: usize, label: usize) -> View {
    let (width, height) = (image.width(), image.height());
    let rows = labels.len() / columns;
    let mut inside = vec![false; width * height];
    let (mut x0, mut y0, mut x1, mut y1) = (width, height, 0, 0);
    for y in 0..height {
        let line = &labels[(y / BLOCK).min(rows - 1) * columns..][..columns];
        for x in 0..width {
            if line[(x / BLOCK).min(columns - 1)] == label {
                inside[y * width + x] = true;
                (x0, y0) = (x0.min(x), y0.min(y));
                (x1, y1) = (x1.max(x + 1), y1.max(y + 1));
            }
        }
    }
    let bounds = Rectangle {
        x: x0.min(x1),
        y: y0.min(y1),
        width: x1.saturating_sub(x0),
        height: y1.saturating_sub(y0),
    };
    View { mask: Mask::from_parts(width, height, inside), bounds }
}
