//! Complex demodulation: multiplication with a carrier, then a separable window.

use super::window::Window;
use crate::image::Image;
use crate::simd::dispatch;
use fearless_simd::{Level, f32x8, prelude::*};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Lanes treated together.
const BLOCK: usize = 32;
/// Rows that one task convolves down the columns.
const BAND: usize = 32;

/// Two real planes that share their way through the window: real and imaginary part.
#[derive(Debug, Clone)]
pub(super) struct Pair {
    stride: usize,
    re: Vec<f32>,
    im: Vec<f32>,
}

impl Pair {
    fn new(width: usize, height: usize) -> Self {
        let mut stride = width.next_multiple_of(BLOCK);
        // rows a power of two apart would fight for the same lines of the cache
        if stride.is_multiple_of(512) {
            stride += BLOCK;
        }
        Self { stride, re: vec![0.0; stride * height], im: vec![0.0; stride * height] }
    }

    /// Real and imaginary part of row y, at least `width` long.
    pub(super) fn row(&self, y: usize) -> (&[f32], &[f32]) {
        let at = y * self.stride;
        (&self.re[at..at + self.stride], &self.im[at..at + self.stride])
    }
}

/// Convolves two planes with the window. `fill` writes row y of both planes, the width of the image
/// long. Outside the image there is zero.
pub(super) fn convolve(
    image: &Image,
    window: &Window,
    fill: impl Fn(usize, &mut [f32], &mut [f32]) + Sync,
) -> Pair {
    let level = Level::new();
    let (width, height) = (image.width(), image.height());
    let mut rows = Pair::new(width, height);
    let stride = rows.stride;
    let (r, weights) = (window.radius(), window.weights());
    rows.re.par_chunks_mut(stride).zip(rows.im.par_chunks_mut(stride)).enumerate().for_each_init(
        || (vec![0.0f32; stride + 2 * r], vec![0.0f32; stride + 2 * r]),
        |(a, b), (y, (re, im))| {
            fill(y, &mut a[r..r + width], &mut b[r..r + width]);
            dispatch!(level, s => along_row(s, weights, a, re));
            dispatch!(level, s => along_row(s, weights, b, im));
        },
    );
    let mut out = Pair::new(width, height);
    let size = stride * BAND;
    out.re.par_chunks_mut(size).zip(out.im.par_chunks_mut(size)).enumerate().for_each(|(k, (re, im))| {
        dispatch!(level, s => down_columns(s, weights, &rows.re, stride, k * BAND, re));
        dispatch!(level, s => down_columns(s, weights, &rows.im, stride, k * BAND, im));
    });
    out
}

/// out[x] = Σ w[k] src[x + k].
#[simd]
fn along_row<S: Simd>(s: S, weights: &[f32], src: &[f32], out: &mut [f32]) {
    for (b, o) in out.chunks_exact_mut(BLOCK).enumerate() {
        let src = &src[b * BLOCK..b * BLOCK + BLOCK + weights.len() - 1];
        let mut acc = [f32x8::splat(s, 0.0); 4];
        for (k, &w) in weights.iter().enumerate() {
            let w = f32x8::splat(s, w);
            let at = &src[k..k + BLOCK];
            for i in 0..4 {
                acc[i] = w.mul_add(f32x8::from_slice(s, &at[8 * i..8 * i + 8]), acc[i]);
            }
        }
        for i in 0..4 {
            acc[i].store_slice(&mut o[8 * i..8 * i + 8]);
        }
    }
}

/// Rows `first…` of the plane, as many as `out` holds, a strip of columns at a time so that what a
/// window reaches stays in the first cache.
#[simd]
fn down_columns<S: Simd>(s: S, weights: &[f32], plane: &[f32], stride: usize, first: usize, out: &mut [f32]) {
    let height = plane.len() / stride;
    let r = weights.len() / 2;
    for x in (0..stride).step_by(BLOCK) {
        for (d, row) in out.chunks_exact_mut(stride).enumerate() {
            let y = first + d;
            let (from, to) = (y.saturating_sub(r), (y + r + 1).min(height));
            let mut acc = [f32x8::splat(s, 0.0); 4];
            for (line, &w) in
                plane[from * stride..to * stride].chunks_exact(stride).zip(&weights[from + r - y..])
            {
                let w = f32x8::splat(s, w);
                let at = &line[x..x + BLOCK];
                for i in 0..4 {
                    acc[i] = w.mul_add(f32x8::from_slice(s, &at[8 * i..8 * i + 8]), acc[i]);
                }
            }
            let o = &mut row[x..x + BLOCK];
            for i in 0..4 {
                acc[i].store_slice(&mut o[8 * i..8 * i + 8]);
            }
        }
    }
}

/// The reference implementation: one pixel in double precision.
#[cfg(test)]
pub(super) fn scalar(
    image: &Image,
    window: &Window,
    value: impl Fn(usize, usize) -> f64,
    x: usize,
    y: usize,
) -> f64 {
    let r = window.radius() as i64;
    let mut sum = 0.0;
    for j in -r..=r {
        for i in -r..=r {
            let (a, b) = (x as i64 + i, y as i64 + j);
            if a >= 0 && b >= 0 && (a as usize) < image.width() && (b as usize) < image.height() {
                let w = |k: i64| f64::from(window.weights()[(k + r) as usize]);
                sum += w(i) * w(j) * value(a as usize, b as usize);
            }
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::super::settings::WindowKind;
    use super::*;

    #[test]
    fn vector_kernel_agrees_with_the_scalar_one() {
        let (w, h) = (77, 45);
        let grey: Vec<f32> = (0..w * h).map(|k| ((k * 7919) % 251) as f32 - 125.0).collect();
        let image = Image::from_f32(w, h, grey).unwrap();
        let window = Window::new(WindowKind::Gaussian, 3.7);
        let factor = |x: usize, y: usize| (0.7 * x as f64 - 0.2 * y as f64).cos();
        let got = convolve(&image, &window, |y, re, im| {
            for x in 0..w {
                re[x] = image.row(y)[x] * factor(x, y) as f32;
                im[x] = image.row(y)[x];
            }
        });
        for (x, y) in [(0, 0), (76, 44), (40, 20), (31, 32), (32, 31), (5, 43)] {
            let grey = |x: usize, y: usize| f64::from(image.row(y)[x]);
            let re = scalar(&image, &window, |x, y| grey(x, y) * factor(x, y), x, y);
            let im = scalar(&image, &window, grey, x, y);
            let (a, b) = got.row(y);
            // single precision: 1e-7 of 125 times the root of 27 taps
            assert!((f64::from(a[x]) - re).abs() < 1e-4 && (f64::from(b[x]) - im).abs() < 1e-4);
        }
    }
}
