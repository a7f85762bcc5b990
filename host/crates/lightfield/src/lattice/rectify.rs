//! Frames on the lattice: dark and vignetting taken off, resampled once.

use super::Lattice;
use crate::error::LatticeError;
use rayon::prelude::*;

/// Resamples frames of one camera onto whole cells of a lattice.
#[derive(Debug, Clone)]
pub struct Rectifier {
    lattice: Lattice,
    /// Pixels (y, x) of a cell.
    pixels: [usize; 2],
    /// Cells (first, last) along x and y.
    range: [[isize; 2]; 2],
    dark: Option<Vec<f32>>,
    gain: Option<Vec<f32>>,
}

/// A frame on the lattice.
#[derive(Debug, Clone, PartialEq)]
pub struct Rectified {
    /// Cells (y, x).
    pub cells: [usize; 2],
    /// Light of each pixel, `[y][x]`: what the camera's pixels hold, per area of the new pixels.
    pub values: Vec<f32>,
    /// 0 where a bad pixel took part, else 1.
    pub weights: Vec<f32>,
}

impl Rectifier {
    /// For `pixels` (y, x) a cell. The white image gives the gain of each cell ([`cell_gains`]).
    ///
    /// # Errors
    /// [`LatticeError::Size`], [`LatticeError::Dark`].
    pub fn new(
        lattice: &Lattice,
        pixels: [usize; 2],
        white: Option<&[f32]>,
        dark: Option<&[f32]>,
    ) -> Result<Self, LatticeError> {
        let [width, height] = lattice.size_px;
        for (what, image) in [("the white image", white), ("the dark image", dark)] {
            if let Some(image) = image {
                size(what, image, width, height)?;
            }
        }
        let gain = white.map(|w| cell_gains(lattice, w, dark)).transpose()?;
        Ok(Self {
            lattice: lattice.clone(),
            pixels,
            range: lattice.whole_cells(),
            dark: dark.map(<[f32]>::to_vec),
            gain,
        })
    }

    /// Keeps only `cells` (y, x) cells, from `first` (y, x) on.
    pub fn crop(&mut self, first: [usize; 2], cells: [usize; 2]) {
        for (axis, k) in [(1, 0), (0, 1)] {
            let [low, high] = self.range[axis];
            let start = low + first[k] as isize;
            self.range[axis] =
                [start.min(high), (start + cells[k] as isize - 1).clamp(start.min(high), high)];
        }
    }

    /// Cells (y, x).
    pub fn cells(&self) -> [usize; 2] {
        [1, 0].map(|a| (self.range[a][1] - self.range[a][0] + 1) as usize)
    }

    /// Rectifies a frame. `bad`: pixels (of the camera) that are not to be used.
    ///
    /// Cubic convolution (Keys, a = −½), times the area of a new pixel, so that sums of light are kept.
    ///
    /// # Errors
    /// [`LatticeError::Size`] if the frame has another size than the calibration's.
    pub fn apply(&self, frame: &[f32], bad: Option<&[bool]>) -> Result<Rectified, LatticeError> {
        let [width, height] = self.lattice.size_px;
        size("the frame", frame, width, height)?;
        let corrected: Vec<f32> = (0..frame.len())
            .map(|i| {
                let v = frame[i] - self.dark.as_ref().map_or(0.0, |d| d[i]);
                v / self.gain.as_ref().map_or(1.0, |g| g[i])
            })
            .collect();
        let cells = self.cells();
        let [ny, nx] = self.pixels;
        let columns = cells[1] * nx;
        let area = (self.lattice.cell_area() / (ny * nx) as f64) as f32;
        let rows: Vec<(Vec<f32>, Vec<f32>)> = (0..cells[0] * ny)
            .into_par_iter()
            .map(|row| {
                let v = self.range[1][0] as f64 + (row as f64 + 0.5) / ny as f64 - 0.5;
                (0..columns)
                    .map(|column| {
                        let u = self.range[0][0] as f64 + (column as f64 + 0.5) / nx as f64 - 0.5;
                        let (value, good) = sample(&corrected, bad, width, height, self.lattice.at(u, v));
                        (value * area, f32::from(u8::from(good)))
                    })
                    .unzip()
            })
            .collect();
        let (values, weights): (Vec<_>, Vec<_>) = rows.into_iter().unzip();
        Ok(Rectified { cells, values: values.concat(), weights: weights.concat() })
    }
}

fn size(what: &'static str, image: &[f32], width: usize, height: usize) -> Result<(), LatticeError> {
    if image.len() == width * height {
        return Ok(());
    }
    let (found_width, found_height) = (image.len() / height.max(1), height);
    Err(LatticeError::Size { what, found_width, found_height, width, height })
}

/// Keys' cubic convolution at a position; whether no bad pixel took part.
fn sample(image: &[f32], bad: Option<&[bool]>, width: usize, height: usize, p: [f64; 2]) -> (f32, bool) {
    let weights = |t: f64| {
        let near = |d: f64| (1.5 * d - 2.5) * d * d + 1.0;
        let far = |d: f64| ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0;
        [far(1.0 + t), near(t), near(1.0 - t), far(2.0 - t)]
    };
    let (fx, fy) = (p[0].floor(), p[1].floor());
    let (wx, wy) = (weights(p[0] - fx), weights(p[1] - fy));
    let clamp = |v: f64, n: usize| v.clamp(0.0, (n - 1) as f64) as usize;
    let (mut sum, mut good) = (0.0, true);
    for (j, wy) in wy.into_iter().enumerate() {
        let y = clamp(fy + j as f64 - 1.0, height);
        for (i, wx) in wx.into_iter().enumerate() {
            let at = y * width + clamp(fx + i as f64 - 1.0, width);
            if bad.is_some_and(|b| b[at]) {
                good = false;
            }
            sum += wx * wy * f64::from(image[at]);
        }
    }
    (sum as f32, good)
}

/// Gain of every pixel: the mean of white minus dark over its cell, relative to the median cell, bilinear
/// between cell centres.
///
/// The pattern within a cell belongs to the optics and is not divided out: it is in the point spread function.
///
/// # Errors
/// [`LatticeError::Dark`] if white is not brighter than dark.
pub fn cell_gains(lattice: &Lattice, white: &[f32], dark: Option<&[f32]>) -> Result<Vec<f32>, LatticeError> {
    let [width, height] = lattice.size_px;
    let place = |i: usize| lattice.cell_of([(i % width) as f64, (i / width) as f64]);
    let corners = [0, width - 1, (height - 1) * width, height * width - 1].map(place);
    let least = [0, 1].map(|k| corners.iter().map(|c| c[k]).fold(f64::INFINITY, f64::min).floor() - 1.0);
    let most = [0, 1].map(|k| corners.iter().map(|c| c[k]).fold(f64::NEG_INFINITY, f64::max).ceil() + 1.0);
    let count = [0, 1].map(|k| (most[k] - least[k]) as usize + 1);
    let light: Vec<f32> = (0..width * height).map(|i| white[i] - dark.map_or(0.0, |d| d[i])).collect();
    // places spread evenly over a cell: counting whole pixels would weigh the dark rim by chance
    let steps = [0, 1].map(|k| (2.0 * lattice.pitch_px[k].value).ceil().max(1.0) as usize);
    let mean = |cell: usize| -> Option<f64> {
        let (u, v) = ((cell % count[0]) as f64 + least[0], (cell / count[0]) as f64 + least[1]);
        let mut sum = 0.0;
        for j in 0..steps[1] {
            for i in 0..steps[0] {
                let [s, t] = [(i, steps[0]), (j, steps[1])].map(|(i, n)| (i as f64 + 0.5) / n as f64 - 0.5);
                let p = lattice.at(u + s, v + t);
                // cells cut by the border take the mean of their neighbours
                if p[0] < 0.0 || p[1] < 0.0 || p[0] > (width - 1) as f64 || p[1] > (height - 1) as f64 {
                    return None;
                }
                sum += f64::from(sample(&light, None, width, height, p).0);
            }
        }
        (sum > 0.0).then(|| sum / (steps[0] * steps[1]) as f64)
    };
    let mut means: Vec<Option<f64>> = (0..count[0] * count[1]).into_par_iter().map(mean).collect();
    let mut sorted: Vec<f64> = means.iter().flatten().copied().collect();
    sorted.sort_by(f64::total_cmp);
    let median = *sorted.get(sorted.len() / 2).ok_or(LatticeError::Dark)?;
    for _ in 0..count[0].max(count[1]) {
        if means.iter().all(Option::is_some) {
            break;
        }
        let old = means.clone();
        for y in 0..count[1] {
            for x in 0..count[0] {
                if old[y * count[0] + x].is_some() {
                    continue;
                }
                let near: Vec<f64> = (y.saturating_sub(1)..(y + 2).min(count[1]))
                    .flat_map(|b| (x.saturating_sub(1)..(x + 2).min(count[0])).map(move |a| (a, b)))
                    .filter_map(|(a, b)| old[b * count[0] + a])
                    .collect();
                if !near.is_empty() {
                    means[y * count[0] + x] = Some(near.iter().sum::<f64>() / near.len() as f64);
                }
            }
        }
    }
    let at = |x: usize, y: usize| {
        means[y.min(count[1] - 1) * count[0] + x.min(count[0] - 1)].unwrap_or(median) / median
    };
    let gains = (0..width * height).into_par_iter().map(|i| {
        let [u, v] = place(i);
        let (u, v) = (u - least[0], v - least[1]);
        let (x, y) = (u.floor() as usize, v.floor() as usize);
        let (s, t) = (u - u.floor(), v - v.floor());
        let gain = (1.0 - t) * ((1.0 - s) * at(x, y) + s * at(x + 1, y))
            + t * ((1.0 - s) * at(x, y + 1) + s * at(x + 1, y + 1));
        // a cell without light must not make noise of it
        gain.max(0.05) as f32
    });
    Ok(gains.collect())
}
