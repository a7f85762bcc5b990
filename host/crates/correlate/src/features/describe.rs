//! Orientation and description of blobs: histograms of gradient directions (Lowe, IJCV 60 (2004)
//! 91), free of brightness, contrast, rotation and scale.

use super::scale::{Blob, Layer, Octave};
use std::f32::consts::TAU;

/// Numbers in a description: 4 × 4 cells of 8 directions.
pub(super) const LENGTH: usize = CELLS * CELLS * DIRECTIONS;
const CELLS: usize = 4;
const DIRECTIONS: usize = 8;
/// Samples along each side of the described square.
const SAMPLES: usize = 4 * CELLS;
/// Side of a cell in units of the blob's scale.
const CELL: f32 = 3.0;
/// Standard deviation of the orientation's window in units of the blob's scale. Round speckles have
/// no orientation of their own: their neighbours must give it.
const WINDOW: f32 = 2.5;
/// Bins of the orientation histogram.
const BINS: usize = 36;
/// A second orientation counts from this part of the strongest on.
const SECOND: f32 = 0.8;
/// Most orientations of one blob.
const MOST: usize = 3;
/// One direction may not make up more than this of the description (changes of lighting).
const CLIP: f32 = 0.2;

/// A described blob.
#[derive(Debug, Clone)]
pub(super) struct Feature {
    /// Position in pixels of the image.
    pub(super) x: f32,
    pub(super) y: f32,
    /// Scale in pixels of the image.
    pub(super) scale: f32,
    /// Orientation in radians, from x towards y.
    pub(super) angle: f32,
    pub(super) description: [f32; LENGTH],
}

/// Features of one blob, one per orientation.
pub(super) fn describe(octaves: &[Octave], blob: &Blob) -> Vec<Feature> {
    let octave = &octaves[blob.octave];
    let layer = &octave.levels[blob.level];
    orientations(layer, blob)
        .into_iter()
        .filter_map(|angle| {
            Some(Feature {
                x: blob.x * octave.spacing,
                y: blob.y * octave.spacing,
                scale: blob.scale * octave.spacing,
                angle,
                description: description(layer, blob, angle)?,
            })
        })
        .collect()
}

/// Central differences at a pixel; `None` at the border.
fn gradient(layer: &Layer, x: i32, y: i32) -> Option<(f32, f32)> {
    let (w, h) = (layer.width as i32, layer.height as i32);
    if x < 1 || y < 1 || x >= w - 1 || y >= h - 1 {
        return None;
    }
    let k = y as usize * layer.width + x as usize;
    let d = &layer.data;
    Some((d[k + 1] - d[k - 1], d[k + layer.width] - d[k - layer.width]))
}

/// Peaks of the histogram of gradient directions around a blob.
fn orientations(layer: &Layer, blob: &Blob) -> Vec<f32> {
    let sigma = WINDOW * blob.scale;
    let reach = (2.5 * sigma).ceil() as i32;
    let (cx, cy) = (blob.x.round() as i32, blob.y.round() as i32);
    let mut histogram = [0.0f32; BINS];
    let falloff: Vec<f32> = (0..=reach).map(|d| (-0.5 * (d as f32 / sigma).powi(2)).exp()).collect();
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            if dx * dx + dy * dy > reach * reach {
                continue;
            }
            let Some((gx, gy)) = gradient(layer, cx + dx, cy + dy) else {
                continue;
            };
            let weight = falloff[dx.unsigned_abs() as usize] * falloff[dy.unsigned_abs() as usize];
            let bin = gy.atan2(gx).rem_euclid(TAU) / TAU * BINS as f32;
            let low = bin.floor();
            let part = bin - low;
            let (a, b) = (low as usize % BINS, (low as usize + 1) % BINS);
            let m = weight * (gx * gx + gy * gy).sqrt();
            histogram[a] += m * (1.0 - part);
            histogram[b] += m * part;
        }
    }
    for _ in 0..3 {
        let h = histogram;
        for k in 0..BINS {
            histogram[k] = (h[(k + BINS - 1) % BINS] + h[k] + h[(k + 1) % BINS]) / 3.0;
        }
    }
    let top = histogram.iter().copied().fold(0.0, f32::max);
    let mut peaks: Vec<(f32, f32)> = Vec::new();
    for k in 0..BINS {
        let (l, c, r) = (histogram[(k + BINS - 1) % BINS], histogram[k], histogram[(k + 1) % BINS]);
        if c > 0.0 && c >= SECOND * top && c > l && c >= r {
            let shift = 0.5 * (l - r) / (l - 2.0 * c + r);
            peaks.push((c, (k as f32 + shift) / BINS as f32 * TAU));
        }
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    peaks.truncate(MOST);
    peaks.into_iter().map(|p| p.1).collect()
}

/// Unit vector of gradient histograms over a square turned to the orientation; `None` without
/// texture.
fn description(layer: &Layer, blob: &Blob, angle: f32) -> Option<[f32; LENGTH]> {
    let (s, c) = angle.sin_cos();
    let pitch = CELL * blob.scale * CELLS as f32 / SAMPLES as f32;
    let mut out = [0.0f32; LENGTH];
    let middle = 0.5 * (SAMPLES as f32 - 1.0);
    for j in 0..SAMPLES {
        for i in 0..SAMPLES {
            let (p, q) = (i as f32 - middle, j as f32 - middle);
            let (dx, dy) = (pitch * (c * p - s * q), pitch * (s * p + c * q));
            let Some((gx, gy)) = between(layer, blob.x + dx, blob.y + dy) else {
                continue;
            };
            let (gp, gq) = (c * gx + s * gy, c * gy - s * gx);
            // half the square's side is the window's standard deviation
            let r = 2.0 / SAMPLES as f32;
            let weight = (-0.5 * r * r * (p * p + q * q)).exp();
            let m = weight * (gp * gp + gq * gq).sqrt();
            let place = |k: usize| (k as f32 + 0.5) / SAMPLES as f32 * CELLS as f32 - 0.5;
            let direction = gq.atan2(gp).rem_euclid(TAU) / TAU * DIRECTIONS as f32;
            share(&mut out, place(i), place(j), direction, m);
        }
    }
    let norm = |v: &[f32; LENGTH]| v.iter().map(|a| a * a).sum::<f32>().sqrt();
    for _ in 0..2 {
        let n = norm(&out);
        if !(n > f32::MIN_POSITIVE && n.is_finite()) {
            return None;
        }
        out.iter_mut().for_each(|a| *a = (*a / n).min(CLIP));
    }
    let n = norm(&out);
    out.iter_mut().for_each(|a| *a /= n);
    Some(out)
}

/// Gradient between pixels, linearly interpolated.
fn between(layer: &Layer, x: f32, y: f32) -> Option<(f32, f32)> {
    let (fx, fy) = (x.floor(), y.floor());
    let (a, b) = (x - fx, y - fy);
    let (i, j) = (fx as i32, fy as i32);
    let (p, q) = (gradient(layer, i, j)?, gradient(layer, i + 1, j)?);
    let (r, s) = (gradient(layer, i, j + 1)?, gradient(layer, i + 1, j + 1)?);
    let mix =
        |p: f32, q: f32, r: f32, s: f32| (1.0 - b) * ((1.0 - a) * p + a * q) + b * ((1.0 - a) * r + a * s);
    Some((mix(p.0, q.0, r.0, s.0), mix(p.1, q.1, r.1, s.1)))
}

/// Shares a value among the cells and directions around a position.
fn share(out: &mut [f32; LENGTH], x: f32, y: f32, direction: f32, value: f32) {
    let (fx, fy, fd) = (x.floor(), y.floor(), direction.floor());
    for (j, wy) in [(fy as i32, 1.0 - (y - fy)), (fy as i32 + 1, y - fy)] {
        for (i, wx) in [(fx as i32, 1.0 - (x - fx)), (fx as i32 + 1, x - fx)] {
            if i < 0 || j < 0 || i >= CELLS as i32 || j >= CELLS as i32 {
                continue;
            }
            let cell = (j as usize * CELLS + i as usize) * DIRECTIONS;
            let d = fd as usize;
            let part = direction - fd;
            out[cell + d % DIRECTIONS] += value * wx * wy * (1.0 - part);
            out[cell + (d + 1) % DIRECTIONS] += value * wx * wy * part;
        }
    }
}
