//! Scale space and its blobs: extrema of differences of Gaussians (Lowe, IJCV 60 (2004) 91).
//! Speckles are blobs, and so are their clusters: every octave of a speckle image is full of them.

use rayon::prelude::*;

/// Levels per octave.
const LEVELS: usize = 3;
/// Smoothing of the first level of an octave, in its pixels.
const BASE: f32 = 1.6;
/// Smoothing that the camera is taken to have done already.
const CAMERA: f32 = 0.5;
/// Octaves are made down to this many pixels on the shorter side.
const SMALLEST: usize = 24;
/// Pixels at the border of an octave without features.
const BORDER: usize = 5;
/// Largest ratio of principal curvatures: edges are located along one axis alone.
const EDGE: f32 = 10.0;

/// Grey levels of one level.
#[derive(Clone)]
pub(super) struct Layer {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) data: Vec<f32>,
}

/// Smoothed images of one octave; level k has the smoothing `BASE · 2^(k / LEVELS)`.
pub(super) struct Octave {
    /// Pixels of the given image per pixel of this octave.
    pub(super) spacing: f32,
    pub(super) levels: Vec<Layer>,
}

/// One blob.
#[derive(Debug, Clone, Copy)]
pub(super) struct Blob {
    pub(super) octave: usize,
    pub(super) level: usize,
    /// Position in pixels of the octave.
    pub(super) x: f32,
    pub(super) y: f32,
    /// Smoothing at which the blob stands out most, in pixels of the octave.
    pub(super) scale: f32,
    /// Difference of Gaussians there.
    pub(super) response: f32,
}

impl Layer {
    fn at(&self, x: usize, y: usize) -> f32 {
        self.data[y * self.width + x]
    }

    /// Convolution with a Gaussian, borders continued.
    fn smoothed(&self, sigma: f32) -> Layer {
        let reach = (3.5 * sigma).ceil() as usize;
        let mut kernel: Vec<f32> =
            (0..=2 * reach).map(|k| (-0.5 * ((k as f32 - reach as f32) / sigma).powi(2)).exp()).collect();
        let sum: f32 = kernel.iter().sum();
        kernel.iter_mut().for_each(|k| *k /= sum);
        let (w, h) = (self.width, self.height);
        let mut across = vec![0.0f32; w * h];
        across.par_chunks_mut(w).zip(self.data.par_chunks(w)).for_each_init(
            || vec![0.0f32; w + 2 * reach],
            |padded, (out, row)| {
                padded[..reach].fill(row[0]);
                padded[reach..reach + w].copy_from_slice(row);
                padded[reach + w..].fill(row[w - 1]);
                for (k, tap) in kernel.iter().enumerate() {
                    for (o, g) in out.iter_mut().zip(&padded[k..k + w]) {
                        *o += tap * g;
                    }
                }
            },
        );
        let mut data = vec![0.0f32; w * h];
        data.par_chunks_mut(w).enumerate().for_each(|(y, out)| {
            for (k, tap) in kernel.iter().enumerate() {
                let from = (y + k).saturating_sub(reach).min(h - 1);
                for (o, g) in out.iter_mut().zip(&across[from * w..(from + 1) * w]) {
                    *o += tap * g;
                }
            }
        });
        Layer { width: w, height: h, data }
    }

    /// Every second pixel.
    fn halved(&self) -> Layer {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            data.extend((0..width).map(|x| self.at(2 * x, 2 * y)));
        }
        Layer { width, height, data }
    }
}

/// Scale space of an image; nothing where it is too small.
pub(super) fn octaves(image: Layer) -> Vec<Octave> {
    let mut out = Vec::new();
    if image.width.min(image.height) < SMALLEST {
        return out;
    }
    let mut first = image.smoothed((BASE * BASE - CAMERA * CAMERA).sqrt());
    let mut spacing = 1.0;
    let sigma = |k: usize| BASE * 2f32.powf(k as f32 / LEVELS as f32);
    loop {
        let mut levels = vec![first];
        for k in 1..LEVELS + 3 {
            let add = (sigma(k).powi(2) - sigma(k - 1).powi(2)).sqrt();
            levels.push(levels[k - 1].smoothed(add));
        }
        let next = levels[LEVELS].halved();
        out.push(Octave { spacing, levels });
        if next.width.min(next.height) < SMALLEST {
            return out;
        }
        first = next;
        spacing *= 2.0;
    }
}

/// Blobs of all octaves, octave after octave, level after level, row after row.
pub(super) fn blobs(octaves: &[Octave]) -> Vec<Blob> {
    let mut out = Vec::new();
    for (o, octave) in octaves.iter().enumerate() {
        let differences: Vec<Layer> = octave
            .levels
            .windows(2)
            .map(|pair| Layer {
                data: pair[0].data.iter().zip(&pair[1].data).map(|(a, b)| b - a).collect(),
                ..pair[0]
            })
            .collect();
        for k in 1..=LEVELS {
            let cube = [&differences[k - 1], &differences[k], &differences[k + 1]];
            let h = cube[1].height;
            let rows: Vec<Vec<Blob>> =
                (BORDER..h.saturating_sub(BORDER)).into_par_iter().map(|y| row(&cube, y, o, k)).collect();
            out.extend(rows.into_iter().flatten());
        }
    }
    out
}

fn row(cube: &[&Layer; 3], y: usize, octave: usize, level: usize) -> Vec<Blob> {
    let w = cube[1].width;
    let mut out = Vec::new();
    for x in BORDER..w.saturating_sub(BORDER) {
        let c = cube[1].at(x, y);
        let (left, right) = (cube[1].at(x - 1, y), cube[1].at(x + 1, y));
        let high = c > 0.0 && c > left && c > right;
        let low = c < 0.0 && c < left && c < right;
        if !(high || low) {
            continue;
        }
        let stands_out = cube.iter().enumerate().all(|(k, layer)| {
            (y - 1..=y + 1).all(|b| {
                (x - 1..=x + 1).all(|a| {
                    let own = k == 1 && a == x && b == y;
                    own || if high { layer.at(a, b) < c } else { layer.at(a, b) > c }
                })
            })
        });
        if stands_out && let Some(blob) = refined(cube, x, y, octave, level) {
            out.push(blob);
        }
    }
    out
}

/// Vertex of the paraboloid through the neighbours; `None` for edges and where it is far away.
fn refined(cube: &[&Layer; 3], x: usize, y: usize, octave: usize, level: usize) -> Option<Blob> {
    let at =
        |k: usize, dx: isize, dy: isize| cube[k].at(x.saturating_add_signed(dx), y.saturating_add_signed(dy));
    let c = at(1, 0, 0);
    let gx = 0.5 * (at(1, 1, 0) - at(1, -1, 0));
    let gy = 0.5 * (at(1, 0, 1) - at(1, 0, -1));
    let gs = 0.5 * (at(2, 0, 0) - at(0, 0, 0));
    let xx = at(1, 1, 0) + at(1, -1, 0) - 2.0 * c;
    let yy = at(1, 0, 1) + at(1, 0, -1) - 2.0 * c;
    let ss = at(2, 0, 0) + at(0, 0, 0) - 2.0 * c;
    let xy = 0.25 * (at(1, 1, 1) + at(1, -1, -1) - at(1, 1, -1) - at(1, -1, 1));
    let (trace, det) = (xx + yy, xx * yy - xy * xy);
    if !(det > 0.0 && trace * trace * EDGE < (EDGE + 1.0).powi(2) * det) {
        return None;
    }
    let (dx, dy) = ((xy * gy - yy * gx) / det, (xy * gx - xx * gy) / det);
    let ds = if ss == 0.0 { 0.0 } else { (-gs / ss).clamp(-0.5, 0.5) };
    if !(dx.abs() <= 0.8 && dy.abs() <= 0.8) {
        return None;
    }
    Some(Blob {
        octave,
        level,
        x: x as f32 + dx,
        y: y as f32 + dy,
        scale: BASE * 2f32.powf((level as f32 + ds) / LEVELS as f32),
        response: c + 0.5 * (gx * dx + gy * dy),
    })
}
