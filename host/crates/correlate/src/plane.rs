//! Image planes padded by mirroring, B-spline coefficients and gradients.

use crate::image::Image;
use crate::settings::Interpolation;
use crate::simd::dispatch;
use fearless_simd::{Level, f32x8, prelude::*};
use fearless_simd_macros::simd;

/// Pixels added on every side. The slowest pole (0.43) has died out to 2e-12 over this distance,
/// so the recursions may start from a constant, and warped subsets may overhang a little.
pub(crate) const PAD: usize = 32;
/// Rows that one horizontal recursion treats together: two groups of eight lanes hide its latency.
const STRIP: usize = 16;
const LANES: usize = 8;

/// A padded plane of single-precision values; `stride` and `rows` are multiples of 32.
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
    fn resize(&mut self, stride: usize, rows: usize) {
        self.stride = stride;
        self.rows = rows;
        self.data.resize(stride * rows, 0.0);
    }

    /// Takes the image's grey levels minus a constant, mirrored at the borders.
    pub(crate) fn load(&mut self, image: &Image, minus: f32) {
        let (w, h) = (image.width(), image.height());
        self.resize((w + 2 * PAD).next_multiple_of(32), (h + 2 * PAD).next_multiple_of(32));
        for (y, out) in self.data.chunks_exact_mut(self.stride).enumerate() {
            let src = image.row(mirror(y, h));
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

/// Coefficients of the interpolating B-spline of the plane, in place.
pub(crate) fn coefficients(level: Level, plane: &mut Plane, kind: Interpolation) {
    let z = poles(kind);
    dispatch!(level, s => filter_rows(s, plane, z, false));
    dispatch!(level, s => filter_columns(s, plane, z));
}

/// d/dx, in place: the derivative of the interpolating quintic at the pixel centres.
pub(crate) fn gradient_x(level: Level, plane: &mut Plane) {
    dispatch!(level, s => filter_rows(s, plane, poles(Interpolation::Quintic), true));
}

/// d/dy, in place.
pub(crate) fn gradient_y(level: Level, plane: &mut Plane) {
    dispatch!(level, s => filter_columns(s, plane, poles(Interpolation::Quintic)));
    dispatch!(level, s => difference_columns(s, plane));
}

/// Recursive prefilter down the columns. Both poles share one sweep down and one up.
#[simd]
fn filter_columns<S: Simd>(s: S, plane: &mut Plane, z: [f32; 2]) {
    let (stride, rows) = (plane.stride, plane.rows);
    let v = |a: f32| f32x8::splat(s, a);
    let (z1, z2) = (v(z[0]), v(z[1]));
    let (i1, i2) = (v(1.0 / (1.0 - z[0])), v(1.0 / (1.0 - z[1])));
    let gain = v(((1.0 - z[0]) * (1.0 - z[1])).powi(2));
    for x in (0..stride).step_by(32) {
        let mut a = [v(0.0); 4];
        let mut b = [v(0.0); 4];
        for k in 0..4 {
            a[k] = f32x8::from_slice(s, &plane.data[x + LANES * k..][..LANES]) * i1;
            b[k] = a[k] * i2;
        }
        for y in 0..rows {
            let row = &mut plane.data[y * stride + x..][..32];
            for k in 0..4 {
                let p = &mut row[LANES * k..LANES * k + LANES];
                a[k] = z1.mul_add(a[k], f32x8::from_slice(s, p));
                b[k] = z2.mul_add(b[k], a[k]);
                b[k].store_slice(p);
            }
        }
        for k in 0..4 {
            a[k] = b[k] * i1;
            b[k] = a[k] * i2;
        }
        for y in (0..rows).rev() {
            let row = &mut plane.data[y * stride + x..][..32];
            for k in 0..4 {
                let p = &mut row[LANES * k..LANES * k + LANES];
                a[k] = z1.mul_add(a[k], f32x8::from_slice(s, p));
                b[k] = z2.mul_add(b[k], a[k]);
                (b[k] * gain).store_slice(p);
            }
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

/// Recursive prefilter along the rows: a strip of rows is transposed so that a lane is a row,
/// filtered, differentiated where asked, and transposed back.
#[simd]
fn filter_rows<S: Simd>(s: S, plane: &mut Plane, z: [f32; 2], gradient: bool) {
    let (stride, rows) = (plane.stride, plane.rows);
    let v = |a: f32| f32x8::splat(s, a);
    let (z1, z2) = (v(z[0]), v(z[1]));
    let (i1, i2) = (v(1.0 / (1.0 - z[0])), v(1.0 / (1.0 - z[1])));
    let gain = v(((1.0 - z[0]) * (1.0 - z[1])).powi(2));
    let mut strip = vec![0.0f32; stride * STRIP];
    let mut slope = vec![0.0f32; if gradient { stride * STRIP } else { 0 }];
    for y in (0..rows).step_by(STRIP) {
        for h in 0..2 {
            for x in (0..stride).step_by(LANES) {
                let mut m = [v(0.0); 8];
                for i in 0..8 {
                    m[i] = f32x8::from_slice(s, &plane.data[(y + 8 * h + i) * stride + x..][..LANES]);
                }
                let m = transpose8(m);
                for i in 0..8 {
                    m[i].store_slice(&mut strip[(x + i) * STRIP + 8 * h..][..LANES]);
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
            for h in 0..2 {
                let p = &mut c[8 * h..8 * h + LANES];
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
            for h in 0..2 {
                let p = &mut c[8 * h..8 * h + LANES];
                a[h] = z1.mul_add(a[h], f32x8::from_slice(s, p));
                b[h] = z2.mul_add(b[h], a[h]);
                (b[h] * gain).store_slice(p);
            }
        }
        if gradient {
            let (k1, k2) = (v(10.0 / 24.0), v(1.0 / 24.0));
            for x in 2..stride - 2 {
                for h in 0..2 {
                    let w = &strip[(x - 2) * STRIP..(x + 3) * STRIP];
                    let at = 8 * h;
                    let a = f32x8::from_slice(s, &w[at..at + 8]);
                    let b = f32x8::from_slice(s, &w[at + STRIP..at + STRIP + 8]);
                    let d = f32x8::from_slice(s, &w[at + 3 * STRIP..at + 3 * STRIP + 8]);
                    let e = f32x8::from_slice(s, &w[at + 4 * STRIP..at + 4 * STRIP + 8]);
                    ((e - a) * k2 + (d - b) * k1).store_slice(&mut slope[x * STRIP + at..][..LANES]);
                }
            }
        }
        let src = if gradient { &slope } else { &strip };
        for h in 0..2 {
            for x in (0..stride).step_by(LANES) {
                let mut m = [v(0.0); 8];
                for i in 0..8 {
                    m[i] = f32x8::from_slice(s, &src[(x + i) * STRIP + 8 * h..][..LANES]);
                }
                let m = transpose8(m);
                for i in 0..8 {
                    m[i].store_slice(&mut plane.data[(y + 8 * h + i) * stride + x..][..LANES]);
                }
            }
        }
    }
}

/// Derivative of the quintic spline down the columns, from coefficients, in place: the four rows
/// still needed are kept in a ring.
#[simd]
fn difference_columns<S: Simd>(s: S, plane: &mut Plane) {
    let (stride, rows) = (plane.stride, plane.rows);
    let (k1, k2) = (f32x8::splat(s, 10.0 / 24.0), f32x8::splat(s, 1.0 / 24.0));
    let zero = f32x8::splat(s, 0.0);
    for x in (0..stride).step_by(LANES) {
        let mut w = [zero; 5];
        for k in 0..4 {
            w[k + 1] = f32x8::from_slice(s, &plane.data[k * stride + x..][..LANES]);
        }
        for y in 2..rows - 2 {
            for k in 0..4 {
                w[k] = w[k + 1];
            }
            w[4] = f32x8::from_slice(s, &plane.data[(y + 2) * stride + x..][..LANES]);
            ((w[4] - w[0]) * k2 + (w[3] - w[1]) * k1).store_slice(&mut plane.data[y * stride + x..][..LANES]);
        }
    }
}
