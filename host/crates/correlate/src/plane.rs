//! Image planes padded by mirroring, B-spline coefficients and gradients.

use crate::image::Image;
use crate::settings::Interpolation;
use crate::simd::dispatch;
use fearless_simd::{Level, f32x8, prelude::*};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Pixels added on every side. The slowest pole (0.43) has died out to 2e-12 over this distance,
/// so the recursions may start from a constant, and warped subsets may overhang a little.
pub(crate) const PAD: usize = 32;
/// Rows that one horizontal recursion treats together: two groups of eight lanes hide its latency.
const STRIP: usize = 16;
/// Columns filtered together.
const COLUMNS: usize = 32;
/// Rows of which a filter down the columns is responsible at a time, and rows it runs in: the poles'
/// memory has died out to 2e-9 by then, far below the rounding of single precision.
const SLAB: usize = 128;
const RUN_IN: usize = 24;
const LANES: usize = 8;

/// A padded plane of single-precision values; `stride` and `rows` are multiples of [`COLUMNS`].
#[derive(Clone, Default)]
pub(crate) struct Plane {
    pub(crate) stride: usize,
    pub(crate) rows: usize,
    pub(crate) data: Vec<f32>,
}

fn mirror(i: usize, n: usize) -> usize {
    if n == 1 {
        return 0;
    }
    let k = (i as i64 - PAD as i64).rem_euclid(2 * n as i64 - 2) as usize;
    if k < n { k } else { 2 * n - 2 - k }
}

impl Plane {
    fn resize(&mut self, image: &Image) {
        self.stride = (image.width() + 2 * PAD).next_multiple_of(COLUMNS);
        self.rows = (image.height() + 2 * PAD).next_multiple_of(COLUMNS);
        self.data.resize(self.stride * self.rows, 0.0);
    }

    /// Index of a pixel that may lie outside the padding: such an index is out of range, or that of
    /// another pixel of the plane.
    #[inline(always)]
    pub(crate) fn signed_index(&self, x: i32, y: i32) -> usize {
        (y.wrapping_add(PAD as i32) as isize)
            .wrapping_mul(self.stride as isize)
            .wrapping_add(x.wrapping_add(PAD as i32) as isize) as usize
    }

    /// Index of pixel (x, y) of the image.
    #[inline(always)]
    pub(crate) fn index(&self, x: i32, y: i32) -> usize {
        (y + PAD as i32) as usize * self.stride + (x + PAD as i32) as usize
    }
}

/// Poles of the B-spline prefilter; the cubic spline has one, so its second is zero.
fn poles(kind: Interpolation) -> [f32; 2] {
    match kind {
        Interpolation::Cubic => [-0.267_949_2, 0.0],
        Interpolation::Quintic => [-0.430_575_35, -0.043_096_29],
    }
}

/// Coefficients of the interpolating B-spline of an image less `minus`; `between` is memory for the
/// work.
pub(crate) fn coefficients(
    level: Level,
    image: &Image,
    minus: f32,
    kind: Interpolation,
    between: &mut Plane,
    out: &mut Plane,
) {
    let z = poles(kind);
    along_rows(level, image, minus, z, false, between);
    along_columns(level, &Source::Plane(between), image, z, false, out);
}

/// d/dx of the interpolating quintic at the pixel centres.
pub(crate) fn gradient_x(level: Level, image: &Image, minus: f32, out: &mut Plane) {
    along_rows(level, image, minus, poles(Interpolation::Quintic), true, out);
}

/// d/dy of the interpolating quintic at the pixel centres.
pub(crate) fn gradient_y(level: Level, image: &Image, minus: f32, out: &mut Plane) {
    along_columns(level, &Source::Image(minus), image, poles(Interpolation::Quintic), true, out);
}

/// One image row less a constant, mirrored at both ends.
fn load_row(src: &[f32], minus: f32, out: &mut [f32]) {
    let w = src.len();
    for (x, o) in out[..PAD].iter_mut().enumerate() {
        *o = src[mirror(x, w)] - minus;
    }
    for (o, &v) in out[PAD..PAD + w].iter_mut().zip(src) {
        *o = v - minus;
    }
    for (x, o) in out.iter_mut().enumerate().skip(PAD + w) {
        *o = src[mirror(x, w)] - minus;
    }
}

fn along_rows(level: Level, image: &Image, minus: f32, z: [f32; 2], gradient: bool, out: &mut Plane) {
    out.resize(image);
    let stride = out.stride;
    let memory = || vec![0.0f32; 2 * stride * STRIP];
    let strips = out.data.par_chunks_mut(stride * STRIP).enumerate();
    strips.for_each_init(memory, |memory, (k, rows)| {
        for (i, row) in rows.chunks_exact_mut(stride).enumerate() {
            load_row(image.row(mirror(k * STRIP + i, image.height())), minus, row);
        }
        dispatch!(level, s => filter_rows(s, stride, rows, z, gradient, memory));
    });
}

/// What a filter down the columns reads.
enum Source<'a> {
    /// The image, less a constant.
    Image(f32),
    Plane(&'a Plane),
}

impl Source<'_> {
    /// Columns x..x + COLUMNS of row y; rows beyond the padding repeat the last one.
    fn read(&self, image: &Image, rows: usize, x: usize, y: i64, out: &mut [f32]) {
        let y = y.clamp(0, rows as i64 - 1) as usize;
        match self {
            Source::Plane(p) => out.copy_from_slice(&p.data[y * p.stride + x..][..COLUMNS]),
            Source::Image(minus) => {
                let src = image.row(mirror(y, image.height()));
                let w = src.len();
                if x >= PAD && x + COLUMNS <= PAD + w {
                    for (o, &v) in out.iter_mut().zip(&src[x - PAD..]) {
                        *o = v - minus;
                    }
                } else {
                    for (i, o) in out.iter_mut().enumerate() {
                        *o = src[mirror(x + i, w)] - minus;
                    }
                }
            }
        }
    }
}

/// Slabs of rows are filtered by themselves, each from [`RUN_IN`] rows before it to as many after: the
/// result does not depend on who filters which, and a slab's columns stay in the first-level cache.
fn along_columns(
    level: Level,
    source: &Source<'_>,
    image: &Image,
    z: [f32; 2],
    difference: bool,
    out: &mut Plane,
) {
    out.resize(image);
    let (stride, rows) = (out.stride, out.rows);
    let memory = || vec![0.0f32; COLUMNS * (SLAB + 2 * RUN_IN)];
    let slabs = out.data.par_chunks_mut(stride * SLAB).enumerate();
    slabs.for_each_init(memory, |memory, (k, slab)| {
        for x in (0..stride).step_by(COLUMNS) {
            let first = (k * SLAB) as i64 - RUN_IN as i64;
            for (i, row) in memory.chunks_exact_mut(COLUMNS).enumerate() {
                source.read(image, rows, x, first + i as i64, row);
            }
            dispatch!(level, s => filter_columns(s, memory, z, difference));
            for (i, row) in slab.chunks_exact_mut(stride).enumerate() {
                let at = (i + RUN_IN) * COLUMNS;
                row[x..x + COLUMNS].copy_from_slice(&memory[at..at + COLUMNS]);
            }
        }
    });
}

/// Recursive prefilter down [`COLUMNS`] columns. Both poles share one sweep down and one up; the
/// derivative, where asked for, follows the sweep up.
#[simd]
fn filter_columns<S: Simd>(s: S, data: &mut [f32], z: [f32; 2], difference: bool) {
    const VECTORS: usize = COLUMNS / LANES;
    let v = |a: f32| f32x8::splat(s, a);
    let (z1, z2) = (v(z[0]), v(z[1]));
    let (i1, i2) = (v(1.0 / (1.0 - z[0])), v(1.0 / (1.0 - z[1])));
    let gain = v(((1.0 - z[0]) * (1.0 - z[1])).powi(2));
    let mut a = [v(0.0); VECTORS];
    let mut b = [v(0.0); VECTORS];
    for k in 0..VECTORS {
        a[k] = f32x8::from_slice(s, &data[LANES * k..][..LANES]) * i1;
        b[k] = a[k] * i2;
    }
    for row in data.chunks_exact_mut(COLUMNS) {
        for (k, p) in row.chunks_exact_mut(LANES).enumerate() {
            a[k] = z1.mul_add(a[k], f32x8::from_slice(s, p));
            b[k] = z2.mul_add(b[k], a[k]);
            b[k].store_slice(p);
        }
    }
    for k in 0..VECTORS {
        a[k] = b[k] * i1;
        b[k] = a[k] * i2;
    }
    for row in data.chunks_exact_mut(COLUMNS).rev() {
        for (k, p) in row.chunks_exact_mut(LANES).enumerate() {
            a[k] = z1.mul_add(a[k], f32x8::from_slice(s, p));
            b[k] = z2.mul_add(b[k], a[k]);
            (b[k] * gain).store_slice(p);
        }
    }
    if !difference {
        return;
    }
    let (k1, k2) = (v(10.0 / 24.0), v(1.0 / 24.0));
    for x in (0..COLUMNS).step_by(LANES) {
        let mut w = [v(0.0); 5];
        for k in 0..4 {
            w[k + 1] = f32x8::from_slice(s, &data[k * COLUMNS + x..][..LANES]);
        }
        for y in 2..data.len() / COLUMNS - 2 {
            for k in 0..4 {
                w[k] = w[k + 1];
            }
            w[4] = f32x8::from_slice(s, &data[(y + 2) * COLUMNS + x..][..LANES]);
            ((w[4] - w[0]) * k2 + (w[3] - w[1]) * k1).store_slice(&mut data[y * COLUMNS + x..][..LANES]);
        }
    }
}

/// Transpose of 8×8 values in registers: three rounds of perfect shuffles.
#[inline(always)]
pub(crate) fn transpose8<S: Simd>(mut a: [f32x8<S>; 8]) -> [f32x8<S>; 8] {
    for _ in 0..3 {
        let b = a;
        for i in 0..4 {
            a[2 * i] = b[i].zip_low(b[i + 4]);
            a[2 * i + 1] = b[i].zip_high(b[i + 4]);
        }
    }
    a
}

/// Recursive prefilter along a strip of rows: transposed so that a lane is a row, filtered,
/// differentiated where asked, and transposed back.
#[simd]
fn filter_rows<S: Simd>(
    s: S,
    stride: usize,
    rows: &mut [f32],
    z: [f32; 2],
    gradient: bool,
    memory: &mut [f32],
) {
    let v = |a: f32| f32x8::splat(s, a);
    let (z1, z2) = (v(z[0]), v(z[1]));
    let (i1, i2) = (v(1.0 / (1.0 - z[0])), v(1.0 / (1.0 - z[1])));
    let gain = v(((1.0 - z[0]) * (1.0 - z[1])).powi(2));
    let (strip, slope) = memory.split_at_mut(stride * STRIP);
    for h in 0..2 {
        let eight = &rows[8 * h * stride..8 * (h + 1) * stride];
        for (x, columns) in strip.chunks_exact_mut(LANES * STRIP).enumerate() {
            let mut m = [v(0.0); 8];
            for i in 0..8 {
                m[i] = f32x8::from_slice(s, &eight[i * stride + x * LANES..][..LANES]);
            }
            let m = transpose8(m);
            for (m, c) in m.iter().zip(columns.chunks_exact_mut(STRIP)) {
                m.store_slice(&mut c[8 * h..8 * h + LANES]);
            }
        }
    }
    let mut a = [v(0.0); 2];
    let mut b = [v(0.0); 2];
    for h in 0..2 {
        a[h] = f32x8::from_slice(s, &strip[8 * h..][..LANES]) * i1;
        b[h] = a[h] * i2;
    }
    for c in strip.chunks_exact_mut(STRIP) {
        for (h, p) in c.chunks_exact_mut(LANES).enumerate() {
            a[h] = z1.mul_add(a[h], f32x8::from_slice(s, p));
            b[h] = z2.mul_add(b[h], a[h]);
            b[h].store_slice(p);
        }
    }
    for h in 0..2 {
        a[h] = b[h] * i1;
        b[h] = a[h] * i2;
    }
    for c in strip.chunks_exact_mut(STRIP).rev() {
        for (h, p) in c.chunks_exact_mut(LANES).enumerate() {
            a[h] = z1.mul_add(a[h], f32x8::from_slice(s, p));
            b[h] = z2.mul_add(b[h], a[h]);
            (b[h] * gain).store_slice(p);
        }
    }
    if gradient {
        let (k1, k2) = (v(10.0 / 24.0), v(1.0 / 24.0));
        for (w, o) in strip.windows(5 * STRIP).step_by(STRIP).zip(slope[2 * STRIP..].chunks_exact_mut(STRIP))
        {
            for h in 0..2 {
                let at = |k: usize| f32x8::from_slice(s, &w[k * STRIP + 8 * h..][..LANES]);
                ((at(4) - at(0)) * k2 + (at(3) - at(1)) * k1).store_slice(&mut o[8 * h..8 * h + LANES]);
            }
        }
    }
    let from: &[f32] = if gradient { slope } else { strip };
    for h in 0..2 {
        let eight = &mut rows[8 * h * stride..8 * (h + 1) * stride];
        for (x, columns) in from.chunks_exact(LANES * STRIP).enumerate() {
            let mut m = [v(0.0); 8];
            for (m, c) in m.iter_mut().zip(columns.chunks_exact(STRIP)) {
                *m = f32x8::from_slice(s, &c[8 * h..8 * h + LANES]);
            }
            let m = transpose8(m);
            for i in 0..8 {
                m[i].store_slice(&mut eight[i * stride + x * LANES..][..LANES]);
            }
        }
    }
}
