//! Analytic speckle images, shared data, statistics.
#![allow(dead_code)] // each test binary uses its own part

use daic_correlate::{Image, Point};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::PathBuf;

/// Sum of Gaussian blobs: known at any position, so that nothing is ever interpolated.
pub struct Speckles {
    blobs: Vec<[f64; 4]>,
    buckets: Vec<Vec<usize>>,
    columns: usize,
    rows: usize,
}

const CELL: f64 = 16.0;
/// Blobs extend beyond the image so that displaced images are covered too.
const MARGIN: f64 = 64.0;

impl Speckles {
    /// Blobs of standard deviation 1.6–2.4 px on `width` × `height` pixels.
    pub fn new(seed: u64, width: usize, height: usize) -> Self {
        println!("speckle seed {seed}");
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (w, h) = (width as f64 + 2.0 * MARGIN, height as f64 + 2.0 * MARGIN);
        let columns = (w / CELL) as usize + 1;
        let rows = (h / CELL) as usize + 1;
        let count = (w * h / 30.0) as usize;
        let mut s = Self {
            blobs: Vec::with_capacity(count),
            buckets: vec![Vec::new(); columns * rows],
            columns,
            rows,
        };
        for k in 0..count {
            let (x, y) = (rng.random_range(0.0..w), rng.random_range(0.0..h));
            let size = rng.random_range(1.6..2.4);
            let grey = rng.random_range(-60.0..60.0);
            s.buckets[(y / CELL) as usize * columns + (x / CELL) as usize].push(k);
            s.blobs.push([x - MARGIN, y - MARGIN, 0.5 / (size * size), grey]);
        }
        s
    }

    /// Grey level at (x, y).
    pub fn at(&self, x: f64, y: f64) -> f64 {
        let (i, j) = (((x + MARGIN) / CELL).floor() as i64, ((y + MARGIN) / CELL).floor() as i64);
        let mut g = 128.0;
        for b in j - 1..=j + 1 {
            for a in i - 1..=i + 1 {
                if a < 0 || b < 0 || a >= self.columns as i64 || b >= self.rows as i64 {
                    continue;
                }
                for &k in &self.buckets[b as usize * self.columns + a as usize] {
                    let [cx, cy, c, grey] = self.blobs[k];
                    let d = (x - cx) * (x - cx) + (y - cy) * (y - cy);
                    g += grey * (-d * c).exp();
                }
            }
        }
        g
    }

    /// Image of the material after the Lagrangian displacement `u`.
    pub fn image(&self, width: usize, height: usize, u: impl Fn(f64, f64) -> (f64, f64)) -> Vec<f64> {
        let mut out = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let (x, y) = (x as f64, y as f64);
                // X + u(X) = x by fixed point
                let (mut a, mut b) = (x, y);
                for _ in 0..60 {
                    let d = u(a, b);
                    (a, b) = (x - d.0, y - d.1);
                }
                out.push(self.at(a, b));
            }
        }
        out
    }
}

pub fn image(width: usize, height: usize, grey: &[f64]) -> Image {
    Image::from_f32(width, height, grey.iter().map(|&g| g as f32).collect()).unwrap()
}

/// Adds Gaussian noise.
pub fn noisy(grey: &[f64], sigma: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
    grey.iter()
        .map(|g| {
            let (a, b): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
            g + sigma * (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
        })
        .collect()
}

/// Folder of the shared images, or a loud remark that a test does not run.
pub fn shared(test: &str, sub: &str) -> Option<PathBuf> {
    let root = std::env::var_os("DAIC_SHARED")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../../shared"), PathBuf::from);
    let path = root.join(sub);
    if path.exists() {
        return Some(path);
    }
    eprintln!("SKIPPED {test}: {sub} is not among the shared data");
    None
}

/// Reads an image; palette TIFFs (which the image crate refuses) by hand, their palettes are grey.
pub fn load(path: &std::path::Path) -> Image {
    let bytes = std::fs::read(path).unwrap();
    if let Ok(i) = image::load_from_memory(&bytes) {
        let i = i.to_luma8();
        return Image::from_u8(i.width() as usize, i.height() as usize, i.as_raw()).unwrap();
    }
    let short = |o: usize| usize::from(u16::from_le_bytes([bytes[o], bytes[o + 1]]));
    let long = |o: usize| u32::from_le_bytes(bytes[o..o + 4].try_into().unwrap()) as usize;
    let directory = long(4);
    let (mut width, mut height) = (0, 0);
    let (mut offsets, mut counts) = (Vec::new(), Vec::new());
    for k in 0..short(directory) {
        let entry = directory + 2 + 12 * k;
        let (kind, n) = (short(entry + 2), long(entry + 4));
        let size = if kind == 3 { 2 } else { 4 };
        let base = if n * size <= 4 { entry + 8 } else { long(entry + 8) };
        let value = |i: usize| {
            if kind == 3 { short(base + 2 * i) } else { long(base + 4 * i) }
        };
        match short(entry) {
            256 => width = value(0),
            257 => height = value(0),
            273 => offsets = (0..n).map(value).collect(),
            279 => counts = (0..n).map(value).collect(),
            _ => {}
        }
    }
    let mut grey: Vec<u8> = Vec::new();
    for (o, c) in offsets.iter().zip(&counts) {
        grey.extend_from_slice(&bytes[*o..o + c]);
    }
    grey.truncate(width * height);
    Image::from_u8(width, height, &grey).unwrap()
}

/// Left upper part of an image.
pub fn crop(image: &Image, width: usize, height: usize) -> Image {
    let grey = (0..height).flat_map(|y| image.row(y)[..width].to_vec()).collect();
    Image::from_f32(width, height, grey).unwrap()
}

/// Mean and standard deviation.
pub fn mean_std(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let var = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    (mean, var.sqrt())
}

/// Errors of u and v of the accepted points against a truth.
pub fn errors(points: &[Point], truth: impl Fn(f64, f64) -> (f64, f64)) -> (Vec<f64>, Vec<f64>) {
    points
        .iter()
        .filter(|p| p.status.is_ok())
        .map(|p| {
            let t = truth(p.x, p.y);
            (p.u - t.0, p.v - t.1)
        })
        .unzip()
}

/// Runs in a pool of its own.
pub fn with_threads<T: Send>(threads: usize, f: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(f)
}
