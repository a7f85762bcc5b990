//! Analytic speckle: a sum of smooth blobs hashed onto a grid of cells.
//!
//! Nothing is interpolated from an image. The value at a point is computed from the blobs around it,
//! so that a rigid shift of the specimen shifts the pattern exactly.

use crate::config::TextureConfig;
use crate::hash::{mix, unit};

/// Radius of the kernel (1 − r²)⁴ over its full width at half maximum: 1 / (2·√(1 − 2^(−1/4))).
const RADIUS_PER_FWHM: f64 = 1.253_820_9;

#[derive(Debug, Clone, Copy)]
struct Blob {
    u: f64,
    v: f64,
    amplitude: f64,
}

/// Reflectance of the specimen over its own (material) coordinates.
#[derive(Debug)]
pub struct Texture {
    cell_mm: f64,
    first: (i64, i64),
    columns: usize,
    rows: usize,
    /// Start of each cell in `blobs`; the cells of a row follow each other, so that three
    /// neighbours are one range.
    starts: Vec<u32>,
    blobs: Vec<Blob>,
    mean: f64,
    amplitude: f64,
}

impl Texture {
    /// Texture of seed `seed` for material points with |X| ≤ `half_width_mm`, |Y| ≤ `half_height_mm`.
    ///
    /// The blobs of a cell depend on seed and cell alone: a larger specimen shows the same pattern.
    pub fn new(config: &TextureConfig, seed: u64, half_width_mm: f64, half_height_mm: f64) -> Self {
        let cell_mm = config.speckle_mm * RADIUS_PER_FWHM;
        // One ring of neighbours, and one more for points on the rim.
        let reach = |half: f64| (half / cell_mm).ceil() as i64 + 2;
        let (rx, ry) = (reach(half_width_mm), reach(half_height_mm));
        let (columns, rows) = ((2 * rx + 1) as usize, (2 * ry + 1) as usize);
        let mut starts = Vec::with_capacity(columns * rows + 1);
        let mut blobs = Vec::new();
        starts.push(0);
        for j in -ry..=ry {
            for i in -rx..=rx {
                let cell = mix(mix(mix(seed ^ 0x7465_7874_7572_6521) ^ i as u64) ^ j as u64);
                // Almost the same number everywhere leaves no large bare areas.
                let count = (config.density + unit(cell)).floor() as u64;
                for k in 0..count {
                    let h = mix(cell ^ (k + 1));
                    let (h2, h3) = (mix(h ^ 1), mix(h ^ 2));
                    let size = config.strength * (0.6 + 0.8 * unit(h3));
                    blobs.push(Blob {
                        u: i as f64 + unit(h),
                        v: j as f64 + unit(h2),
                        amplitude: if h3 & 1 == 0 { size } else { -size },
                    });
                }
                starts.push(blobs.len() as u32);
            }
        }
        Self {
            cell_mm,
            first: (-rx, -ry),
            columns,
            rows,
            starts,
            blobs,
            mean: config.mean_reflectance,
            amplitude: config.contrast,
        }
    }

    /// Reflectance at the material point (`x_mm`, `y_mm`), between mean − contrast and mean + contrast.
    ///
    /// Beyond the table (outside the specimen) the mean is returned.
    #[inline]
    pub fn reflectance(&self, x_mm: f64, y_mm: f64) -> f64 {
        let (u, v) = (x_mm / self.cell_mm, y_mm / self.cell_mm);
        let (i, j) = (u.floor() as i64 - self.first.0, v.floor() as i64 - self.first.1);
        if i < 1 || j < 1 || i + 1 >= self.columns as i64 || j + 1 >= self.rows as i64 {
            return self.mean;
        }
        let (i, j) = (i as usize, j as usize);
        let mut sum = 0.0;
        for row in j - 1..=j + 1 {
            let at = row * self.columns + i;
            let range = self.starts[at - 1] as usize..self.starts[at + 2] as usize;
            for blob in &self.blobs[range] {
                let (du, dv) = (u - blob.u, v - blob.v);
                let t = (1.0 - du * du - dv * dv).max(0.0);
                let t2 = t * t;
                sum += blob.amplitude * t2 * t2;
            }
        }
        // Paint saturates: overlapping blobs do not add without limit.
        self.mean + self.amplitude * sum / (1.0 + sum * sum).sqrt()
    }
}
