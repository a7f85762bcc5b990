//! A specimen whose heights come from an image.
//!
//! The image gives the *geometry* only; the texture stays analytic. Between the pixels the height
//! is the interpolating cubic B-spline, smooth to the second derivative.

use std::path::Path;

use crate::error::ConfigError;
use crate::scene::surface::Line;

/// Heights on a regular grid, centred on the origin; beyond the image its mirror follows.
#[derive(Debug)]
pub struct HeightMap {
    width: usize,
    height: usize,
    pixel_mm: f64,
    coefficients: Vec<f64>,
    range: [f64; 2],
    /// Upper bound of |∇h|.
    steepest: f64,
}

impl HeightMap {
    /// Reads the image; grey value 0 is `black_mm`, full scale `white_mm`.
    pub fn read(path: &Path, pixel_mm: f64, black_mm: f64, white_mm: f64) -> Result<Self, ConfigError> {
        let image = image::ImageReader::open(path)
            .map_err(image::ImageError::IoError)
            .and_then(|r| r.with_guessed_format().map_err(image::ImageError::IoError)?.decode())
            .map_err(|cause| ConfigError::HeightMap { path: path.to_owned(), cause })?;
        let (width, height) = (image.width(), image.height());
        if width < 4 || height < 4 {
            return Err(ConfigError::HeightMapTooSmall { path: path.to_owned(), width, height });
        }
        let grey = image.into_luma16();
        let heights =
            grey.pixels().map(|p| black_mm + (white_mm - black_mm) * f64::from(p.0[0]) / 65_535.0).collect();
        Ok(Self::from_heights(width as usize, height as usize, heights, pixel_mm))
    }

    /// The spline through `heights` (row by row, at least 4 × 4).
    pub fn from_heights(width: usize, height: usize, heights: Vec<f64>, pixel_mm: f64) -> Self {
        let mut c = heights;
        for row in c.chunks_exact_mut(width) {
            prefilter(row);
        }
        let mut column = vec![0.0; height];
        for x in 0..width {
            for (y, v) in column.iter_mut().enumerate() {
                *v = c[y * width + x];
            }
            prefilter(&mut column);
            for (y, v) in column.iter().enumerate() {
                c[y * width + x] = *v;
            }
        }
        // A B-spline lies within the hull of its coefficients, its slope within that of their differences.
        let range = c.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], &v| [l.min(v), h.max(v)]);
        let mut steepest: [f64; 2] = [0.0; 2];
        for y in 0..height {
            for x in 0..width {
                let here = c[y * width + x];
                if x + 1 < width {
                    steepest[0] = steepest[0].max((c[y * width + x + 1] - here).abs());
                }
                if y + 1 < height {
                    steepest[1] = steepest[1].max((c[(y + 1) * width + x] - here).abs());
                }
            }
        }
        let steepest = steepest[0].hypot(steepest[1]) / pixel_mm;
        Self { width, height, pixel_mm, coefficients: c, range, steepest }
    }

    /// Bounds of the height.
    pub fn range(&self) -> [f64; 2] {
        self.range
    }

    /// Height at (`x`, `y`).
    pub fn height(&self, x: f64, y: f64) -> f64 {
        self.height_and_slope(x, y).0
    }

    #[inline]
    fn height_and_slope(&self, x: f64, y: f64) -> (f64, [f64; 2]) {
        let (ix, wx, gx) = weights(x / self.pixel_mm + (self.width - 1) as f64 / 2.0);
        let (iy, wy, gy) = weights(y / self.pixel_mm + (self.height - 1) as f64 / 2.0);
        let columns = [0, 1, 2, 3].map(|k| mirror(ix + k, self.width));
        let (mut h, mut sx, mut sy) = (0.0, 0.0, 0.0);
        for k in 0..4 {
            let row = &self.coefficients[mirror(iy + k as i64, self.height) * self.width..][..self.width];
            let (mut v, mut g) = (0.0, 0.0);
            for m in 0..4 {
                v += wx[m] * row[columns[m]];
                g += gx[m] * row[columns[m]];
            }
            h += wy[k] * v;
            sx += wy[k] * g;
            sy += gy[k] * v;
        }
        (h, [sx / self.pixel_mm, sy / self.pixel_mm])
    }

    /// First point of the surface on the line.
    pub fn first_hit(&self, line: &Line) -> Option<[f64; 3]> {
        let fall = -line.direction[2];
        if fall <= 0.0 {
            return None;
        }
        let lean = [line.direction[0] / fall, line.direction[1] / fall];
        let [mut low, mut high] = self.range;
        // Height of the line above the surface where the line has height h; falls through 0 at a hit.
        let above = |h: f64| {
            let [x, y] = line.at_height(h);
            let (surface, slope) = self.height_and_slope(x, y);
            (h - surface, 1.0 + slope[0] * lean[0] + slope[1] * lean[1])
        };
        let sideways = lean[0].hypot(lean[1]);
        if self.steepest * sideways >= 0.95 {
            // The line may meet the surface several times: walk down in steps too small to miss one.
            let stride = (0.25 * self.pixel_mm / sideways).min(high - low).max((high - low) * 1e-4);
            let mut h = high;
            while h > low {
                h = (h - stride).max(low);
                if above(h).0 <= 0.0 {
                    low = h;
                    break;
                }
                high = h;
            }
        }
        let mut h = 0.5 * (low + high);
        // Newton, kept inside the bracket; quadratic, so 1e-13 mm² follows from 1e-7 mm.
        for _ in 0..60 {
            let (gap, rate) = above(h);
            if gap > 0.0 {
                high = h;
            } else {
                low = h;
            }
            let next = h - gap / rate;
            let next = if next >= low && next <= high { next } else { 0.5 * (low + high) };
            let change = (next - h).abs();
            h = next;
            if change < 1e-12 {
                break;
            }
        }
        let [x, y] = line.at_height(h);
        Some([x, y, h])
    }
}

fn mirror(index: i64, length: usize) -> usize {
    let period = 2 * (length as i64 - 1);
    let m = index.rem_euclid(period);
    m.min(period - m) as usize
}

/// First of the four coefficients, their weights, and the derivatives of these.
#[inline]
fn weights(position: f64) -> (i64, [f64; 4], [f64; 4]) {
    let cell = position.floor();
    let t = position - cell;
    let s = 1.0 - t;
    let value = [
        s * s * s / 6.0,
        2.0 / 3.0 - t * t * (1.0 - t / 2.0),
        2.0 / 3.0 - s * s * (1.0 - s / 2.0),
        t * t * t / 6.0,
    ];
    let slope = [-s * s / 2.0, t * (1.5 * t - 2.0), s * (2.0 - 1.5 * s), t * t / 2.0];
    (cell as i64 - 1, value, slope)
}

/// Samples to cubic B-spline coefficients, mirrored at both ends (Unser, Aldroubi & Eden 1993).
fn prefilter(samples: &mut [f64]) {
    let pole = 3.0_f64.sqrt() - 2.0;
    let n = samples.len();
    let period = 2 * (n - 1);
    let mut first = 0.0;
    let mut power = 1.0;
    // |pole|^40 is below 2e-23.
    for k in 0..40.max(n) {
        let m = k % period;
        first += power * samples[m.min(period - m)];
        power *= pole;
    }
    samples[0] = first;
    for k in 1..n {
        samples[k] += pole * samples[k - 1];
    }
    samples[n - 1] = pole / (pole * pole - 1.0) * (samples[n - 1] + pole * samples[n - 2]);
    for k in (0..n - 1).rev() {
        samples[k] = pole * (samples[k + 1] - samples[k]);
    }
    for v in samples {
        *v *= 6.0;
    }
}
