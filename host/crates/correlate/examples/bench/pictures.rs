//! Images: read from files, or rendered.
//!
//! The rendered pair is a sum of Gaussian blobs under an affine displacement field, evaluated in
//! closed form at every pixel of both images (nothing is interpolated) and rounded to 8 bits. The
//! gradients are those of the golden `aff1` at 1024 pixels and smaller in proportion for larger
//! images, so that the displacement at the edge (5–6 px) and with it the search does not grow.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::Path;

/// An 8-bit image.
pub struct Grey {
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<u8>,
}

pub fn read(path: &Path) -> Result<Grey, String> {
    let image = image::open(path).map_err(|e| format!("{}: {e}", path.display()))?.into_luma8();
    let (width, height) = (image.width() as usize, image.height() as usize);
    Ok(Grey { width, height, pixels: image.into_raw() })
}

/// u_x, u_y, v_x, v_y of an image of 1024 pixels.
const GRADIENT: [f64; 4] = [0.01, 0.002, 0.002, -0.003];

/// Writes `ref.png` and `def.png` of `size` × `size` pixels.
pub fn write_pair(size: usize, out: &Path) -> Result<(), String> {
    std::fs::create_dir_all(out).map_err(|e| format!("{}: {e}", out.display()))?;
    let scale = 1024.0 / size as f64;
    for (name, gradient) in [("ref", [0.0; 4]), ("def", GRADIENT.map(|g| g * scale))] {
        let pixels = render(size, gradient);
        // whole or not at all: a later run takes what it finds
        let (path, part) = (out.join(format!("{name}.png")), out.join(format!("{name}.part.png")));
        let save = || -> Result<(), String> {
            image::save_buffer(&part, &pixels, size as u32, size as u32, image::ExtendedColorType::L8)
                .map_err(|e| e.to_string())?;
            std::fs::rename(&part, &path).map_err(|e| e.to_string())
        };
        save().map_err(|e| format!("{}: {e}", path.display()))?;
    }
    Ok(())
}

/// The material displaced by u = [g0, g1]·(X − c), v = [g2, g3]·(X − c) about the centre c.
fn render(size: usize, g: [f64; 4]) -> Vec<u8> {
    const REACH: f64 = 12.0;
    let mut rng = ChaCha8Rng::seed_from_u64(size as u64);
    let n = size as f64;
    let c = 0.5 * (n - 1.0);
    // blobs outside the image move into it
    let (lo, hi) = (-32.0, n + 32.0);
    let count = ((hi - lo) * (hi - lo) / 30.0) as usize;
    let (a, b, d, e) = (1.0 + g[0], g[1], g[2], 1.0 + g[3]);
    let det = a * e - b * d;
    let inverse = [e / det, -b / det, -d / det, a / det];
    let mut grey = vec![128.0f32; size * size];
    for _ in 0..count {
        let (x, y): (f64, f64) = (rng.random_range(lo..hi), rng.random_range(lo..hi));
        let width: f64 = rng.random_range(1.6..2.4);
        let height: f64 = rng.random_range(-60.0..60.0);
        let k = 0.5 / (width * width);
        // where the blob's centre has gone
        let (px, py) = (c + a * (x - c) + b * (y - c), c + d * (x - c) + e * (y - c));
        let first = |p: f64| (p - REACH).ceil().max(0.0) as usize;
        let end = |p: f64| ((p + REACH).floor() + 1.0).clamp(0.0, n) as usize;
        let (x0, x1) = (first(px), end(px));
        for row in first(py)..end(py) {
            if x0 >= x1 {
                break;
            }
            let (dx, dy) = (x0 as f64 - px, row as f64 - py);
            // material position relative to the blob, and its change by one pixel along the row
            let (mx, my) = (inverse[0] * dx + inverse[1] * dy, inverse[2] * dx + inverse[3] * dy);
            let (sx, sy) = (inverse[0], inverse[2]);
            // exp(−k |m + i s|²) by its ratios: exact, without an exponential per pixel
            let mut value = height * (-k * (mx * mx + my * my)).exp();
            let mut ratio = (-k * (2.0 * (mx * sx + my * sy) + sx * sx + sy * sy)).exp();
            let change = (-2.0 * k * (sx * sx + sy * sy)).exp();
            for p in &mut grey[row * size + x0..row * size + x1] {
                *p += value as f32;
                value *= ratio;
                ratio *= change;
            }
        }
    }
    grey.iter().map(|&p| p.round().clamp(0.0, 255.0) as u8).collect()
}
