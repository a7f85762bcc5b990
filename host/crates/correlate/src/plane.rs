//! Image planes padded by mirroring, B-spline coefficients and gradients.

use crate::image::Image;
use crate::per_thread::PerThread;
use crate::settings::Interpolation;
use crate::simd::dispatch;
use fearless_simd::{Level, f32x8, prelude::*};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Pixels added on every side. The slowest poles (0.43 quintic, 0.54 septic) have died out to 2e-12
/// and 2e-9 over this distance, so the recursions may start from a constant, and warped subsets may
/// overhang a little.
pub(crate) const PAD: usize = 32;
/// Rows that one horizontal recursion treats together: two groups of eight lanes hide its latency.
const STRIP: usize = 16;
/// Columns filtered together.
const COLUMNS: usize = 32;
/// Rows of which a filter down the columns is responsible at a time.
const SLAB: usize = 128;
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
        resize(&mut self.data, self.stride * self.rows);
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

/// Sets the length; new memory comes zeroed from the system, without being written.
pub(crate) fn resize(data: &mut Vec<f32>, len: usize) {
    if data.capacity() < len {
        // never both at once
        *data = Vec::new();
        *data = vec![0.0; len];
    } else {
        data.resize(len, 0.0);
    }
}

/// A B-spline of degree 2P + 1.
#[derive(Clone, Copy)]
struct Spline<const P: usize> {
    /// Poles of the prefilter.
    poles: [f32; P],
    /// Derivative of the B-spline at −1, −2, …
    slope: [f32; P],
    /// Rows that a filter down the columns runs in: the slowest pole's memory has died out to 2e-9
    /// by then, far below the rounding of single precision.
    run_in: usize,
}

const CUBIC: Spline<1> = Spline { poles: [-0.267_949_2], slope: [1.0 / 2.0], run_in: 16 };
const QUINTIC: Spline<2> =
    Spline { poles: [-0.430_575_35, -0.043_096_29], slope: [10.0 / 24.0, 1.0 / 24.0], run_in: 24 };
const SEPTIC: Spline<3> = Spline {
    poles: [-0.535_280_4, -0.122_554_615, -0.009_148_695],
    slope: [49.0 / 144.0, 7.0 / 90.0, 1.0 / 720.0],
    run_in: 32,
};

impl<const P: usize> Spline<P> {
    /// Gain of the prefilter at zero frequency, undone.
    fn gain(&self) -> f32 {
        self.poles.iter().map(|z| 1.0 - z).product::<f32>().powi(2)
    }
}

/// Working memory of the filters: two pieces for each thread.
pub(crate) type Work = PerThread<[Vec<f32>; 2]>;

/// Coefficients of the interpolating B-spline of an image less `minus`.
pub(crate) fn coefficients(
    level: Level,
    image: &Image,
    minus: f32,
    kind: Interpolation,
    work: &mut Work,
    out: &mut Plane,
) {
    work.prepare();
    match kind {
        Interpolation::Cubic => along_both(level, image, minus, &CUBIC, work, out),
        Interpolation::Quintic => along_both(level, image, minus, &QUINTIC, work, out),
        Interpolation::Septic => along_both(level, image, minus, &SEPTIC, work, out),
    }
}

/// d/dx and d/dy of the interpolating quintic at the pixel centres.
pub(crate) fn gradients(level: Level, image: &Image, minus: f32, work: &mut Work, [x, y]: [&mut Plane; 2]) {
    work.prepare();
    let work = &*work;
    rayon::join(
        || along_rows(level, image, minus, &QUINTIC, work, x),
        || along_columns(level, image, minus, &QUINTIC, work, y),
    );
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

/// d/dx, some rows at a time.
fn along_rows<const P: usize>(
    level: Level,
    image: &Image,
    minus: f32,
    spline: &Spline<P>,
    work: &Work,
    out: &mut Plane,
) {
    out.resize(image);
    let stride = out.stride;
    out.data.par_chunks_mut(stride * STRIP).enumerate().for_each(|(k, rows)| {
        for (i, row) in rows.chunks_exact_mut(stride).enumerate() {
            load_row(image.row(mirror(k * STRIP + i, image.height())), minus, row);
        }
        work.with(|[memory, _]| {
            resize(memory, 2 * stride * STRIP);
            dispatch!(level, s => filter_rows::<_, P>(s, stride, rows, spline, true, memory));
        });
    });
}

/// Slabs of rows are filtered by themselves, each from `run_in` rows before it to as many after: the
/// result does not depend on who filters which. The rows go through the filter along them first, in
/// memory that is no larger than a slab.
fn along_both<const P: usize>(
    level: Level,
    image: &Image,
    minus: f32,
    spline: &Spline<P>,
    work: &Work,
    out: &mut Plane,
) {
    out.resize(image);
    let (stride, rows) = (out.stride, out.rows);
    out.data.par_chunks_mut(stride * SLAB).enumerate().for_each(|(k, slab)| {
        work.with(|[between, strip]| {
            resize(between, stride * (SLAB + 2 * spline.run_in));
            resize(strip, 2 * stride * STRIP);
            let first = (k * SLAB) as i64 - spline.run_in as i64;
            for (i, lines) in between.chunks_exact_mut(stride * STRIP).enumerate() {
                for (j, row) in lines.chunks_exact_mut(stride).enumerate() {
                    let y = (first + (i * STRIP + j) as i64).clamp(0, rows as i64 - 1) as usize;
                    load_row(image.row(mirror(y, image.height())), minus, row);
                }
                dispatch!(level, s => filter_rows::<_, P>(s, stride, lines, spline, false, strip));
            }
            dispatch!(level, s => filter_columns::<_, P>(s, between, stride, spline));
            let used = spline.run_in * stride;
            slab.copy_from_slice(&between[used..used + slab.len()]);
        });
    });
}

/// d/dy, a slab at a time as in [`along_both`], and of a slab as many columns as stay in the first-level
/// cache.
fn along_columns<const P: usize>(
    level: Level,
    image: &Image,
    minus: f32,
    spline: &Spline<P>,
    work: &Work,
    out: &mut Plane,
) {
    out.resize(image);
    let (stride, rows) = (out.stride, out.rows);
    out.data.par_chunks_mut(stride * SLAB).enumerate().for_each(|(k, slab)| {
        work.with(|[memory, _]| {
            resize(memory, COLUMNS * (SLAB + 2 * spline.run_in));
            for x in (0..stride).step_by(COLUMNS) {
                let first = (k * SLAB) as i64 - spline.run_in as i64;
                for (i, row) in memory.chunks_exact_mut(COLUMNS).enumerate() {
                    let y = (first + i as i64).clamp(0, rows as i64 - 1) as usize;
                    read(image.row(mirror(y, image.height())), minus, x, row);
                }
                dispatch!(level, s => {
                    filter_columns::<_, P>(s, memory, COLUMNS, spline);
                    difference::<_, P>(s, memory, spline);
                });
                for (i, row) in slab.chunks_exact_mut(stride).enumerate() {
                    let at = (i + spline.run_in) * COLUMNS;
                    row[x..x + COLUMNS].copy_from_slice(&memory[at..at + COLUMNS]);
                }
            }
        });
    });
}

/// Columns x..x + COLUMNS of a padded row.
fn read(src: &[f32], minus: f32, x: usize, out: &mut [f32]) {
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

/// Recursive prefilter down the columns of a plane, [`COLUMNS`] at a time. All poles share one sweep
/// down and one up.
#[simd]
fn filter_columns<S: Simd, const P: usize>(s: S, data: &mut [f32], stride: usize, spline: &Spline<P>) {
    const VECTORS: usize = COLUMNS / LANES;
    let v = |a: f32| f32x8::splat(s, a);
    let gain = v(spline.gain());
    let recursion = Recursion::new(s, spline);
    for x in (0..stride).step_by(COLUMNS) {
        let mut a = [[v(0.0); P]; VECTORS];
        for k in 0..VECTORS {
            a[k] = recursion.settled(f32x8::from_slice(s, &data[x + LANES * k..][..LANES]));
        }
        let mut last = [v(0.0); VECTORS];
        for row in data.chunks_exact_mut(stride) {
            for (k, p) in row[x..x + COLUMNS].chunks_exact_mut(LANES).enumerate() {
                last[k] = recursion.next(&mut a[k], f32x8::from_slice(s, p));
                last[k].store_slice(p);
            }
        }
        for k in 0..VECTORS {
            a[k] = recursion.settled(last[k]);
        }
        for row in data.chunks_exact_mut(stride).rev() {
            for (k, p) in row[x..x + COLUMNS].chunks_exact_mut(LANES).enumerate() {
                (recursion.next(&mut a[k], f32x8::from_slice(s, p)) * gain).store_slice(p);
            }
        }
    }
}

/// Derivative down [`COLUMNS`] columns of coefficients.
#[simd]
fn difference<S: Simd, const P: usize>(s: S, data: &mut [f32], spline: &Spline<P>) {
    let v = |a: f32| f32x8::splat(s, a);
    let slope = spline.slope.map(v);
    for x in (0..COLUMNS).step_by(LANES) {
        let mut w = [v(0.0); MAX_SLOPE];
        for k in 0..2 * P {
            w[k + 1] = f32x8::from_slice(s, &data[k * COLUMNS + x..][..LANES]);
        }
        for y in P..data.len() / COLUMNS - P {
            for k in 0..2 * P {
                w[k] = w[k + 1];
            }
            w[2 * P] = f32x8::from_slice(s, &data[(y + P) * COLUMNS + x..][..LANES]);
            let mut g = (w[2 * P] - w[0]) * slope[P - 1];
            for k in 1..P {
                g += (w[2 * P - k] - w[k]) * slope[P - 1 - k];
            }
            g.store_slice(&mut data[y * COLUMNS + x..][..LANES]);
        }
    }
}

/// Most taps of a derivative.
const MAX_SLOPE: usize = 7;

/// One sweep's first-order recursions, one behind the other.
#[derive(Clone, Copy)]
struct Recursion<S: Simd, const P: usize> {
    poles: [f32x8<S>; P],
    /// Gains at zero frequency.
    gains: [f32x8<S>; P],
}

impl<S: Simd, const P: usize> Recursion<S, P> {
    #[inline(always)]
    fn new(s: S, spline: &Spline<P>) -> Self {
        let v = |a: f32| f32x8::splat(s, a);
        Self { poles: spline.poles.map(v), gains: spline.poles.map(|z| v(1.0 / (1.0 - z))) }
    }

    /// State after a constant has gone on for ever.
    #[inline(always)]
    fn settled(&self, mut x: f32x8<S>) -> [f32x8<S>; P] {
        let mut state = self.gains;
        for k in 0..P {
            x *= self.gains[k];
            state[k] = x;
        }
        state
    }

    #[inline(always)]
    fn next(&self, state: &mut [f32x8<S>; P], mut x: f32x8<S>) -> f32x8<S> {
        for k in 0..P {
            x = self.poles[k].mul_add(state[k], x);
            state[k] = x;
        }
        x
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
fn filter_rows<S: Simd, const P: usize>(
    s: S,
    stride: usize,
    rows: &mut [f32],
    spline: &Spline<P>,
    gradient: bool,
    memory: &mut [f32],
) {
    let v = |a: f32| f32x8::splat(s, a);
    let gain = v(spline.gain());
    let recursion = Recursion::new(s, spline);
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
    let mut a = [[v(0.0); P]; 2];
    for h in 0..2 {
        a[h] = recursion.settled(f32x8::from_slice(s, &strip[8 * h..][..LANES]));
    }
    let mut last = [v(0.0); 2];
    for c in strip.chunks_exact_mut(STRIP) {
        for (h, p) in c.chunks_exact_mut(LANES).enumerate() {
            last[h] = recursion.next(&mut a[h], f32x8::from_slice(s, p));
            last[h].store_slice(p);
        }
    }
    for h in 0..2 {
        a[h] = recursion.settled(last[h]);
    }
    for c in strip.chunks_exact_mut(STRIP).rev() {
        for (h, p) in c.chunks_exact_mut(LANES).enumerate() {
            (recursion.next(&mut a[h], f32x8::from_slice(s, p)) * gain).store_slice(p);
        }
    }
    if gradient {
        let weights = spline.slope.map(v);
        let windows = strip.windows((2 * P + 1) * STRIP).step_by(STRIP);
        for (w, o) in windows.zip(slope[P * STRIP..].chunks_exact_mut(STRIP)) {
            for h in 0..2 {
                let at = |k: usize| f32x8::from_slice(s, &w[k * STRIP + 8 * h..][..LANES]);
                let mut g = (at(2 * P) - at(0)) * weights[P - 1];
                for k in 1..P {
                    g += (at(2 * P - k) - at(k)) * weights[P - 1 - k];
                }
                g.store_slice(&mut o[8 * h..8 * h + LANES]);
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
