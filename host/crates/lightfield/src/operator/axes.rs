//! Transforms of the cells' channels along the two axes of the lenslet grid.

use super::engine::{Engine, Side};
use super::fft::{C, NOTHING, Source, result};
use crate::simd::{Kernel as Work, LANES, V};
use fearless_simd::prelude::*;

/// i modulo n for i below 2 n; a division would cost as much as the transform.
#[inline(always)]
fn wrapped(i: usize, n: usize) -> usize {
    if i >= n { i - n } else { i }
}

/// Offsets of the cells of an axis, `stride` apart, at their positions on the grid.
fn offsets(side: &Side, axis: usize, n: usize, first: usize, stride: usize) -> Vec<usize> {
    let mut out = vec![NOTHING; n];
    for cell in 0..side.cells[axis] {
        out[wrapped(cell + side.origin[axis], n)] = first + cell * stride;
    }
    out
}

#[inline(always)]
fn put<S: Simd>(c: C<S>, values: &mut [f32], at: usize, imaginary: usize) {
    c.re.store_slice(&mut values[at..at + LANES]);
    c.im.store_slice(&mut values[at + imaginary..at + imaginary + LANES]);
}

/// Two real rows of cells as one complex row, transformed along x.
pub(super) struct RowForth<'a> {
    pub(super) engine: &'a Engine,
    pub(super) side: &'a Side,
    /// Both rows; the second is zero where there is only one.
    pub(super) values: &'a [f32],
    /// Their half spectra, [row][kx][re|im][channel].
    pub(super) rows: &'a mut [f32],
    pub(super) count: usize,
    pub(super) scratch: &'a mut Vec<f32>,
}

impl Work for RowForth<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, side, values, rows, count, scratch } = self;
        let (plan, c, n) = (&engine.plans[1], side.padded, engine.grid[1]);
        scratch.resize(plan.scratch(), 0.0);
        let offsets = offsets(side, 1, n, 0, c);
        let source = Source { values, offsets: &offsets, imaginary: side.row() };
        let half = V::splat(s, 0.5);
        let half_row = engine.half() * 2 * c;
        for channel in (0..c).step_by(LANES) {
            plan.run::<S, false>(s, scratch, source, channel);
            for k in 0..engine.half() {
                let (a, b) = (result(s, scratch, k), result(s, scratch, wrapped(n - k, n)));
                let at = k * 2 * c + channel;
                put(C { re: (a.re + b.re) * half, im: (a.im - b.im) * half }, rows, at, c);
                if count > 1 {
                    put(C { re: (a.im + b.im) * half, im: (b.re - a.re) * half }, rows, half_row + at, c);
                }
            }
        }
    }
}

/// Two rows back from the spectrum.
pub(super) struct RowBack<'a> {
    pub(super) engine: &'a Engine,
    pub(super) side: &'a Side,
    pub(super) columns: &'a [f32],
    /// Both rows.
    pub(super) values: &'a mut [f32],
    pub(super) pair: usize,
    pub(super) scratch: &'a mut Vec<f32>,
}

impl Work for RowBack<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, side, columns, values, pair, scratch } = self;
        let (plan, c, n) = (&engine.plans[1], side.padded, engine.grid[1]);
        scratch.resize(plan.scratch(), 0.0);
        let column = side.cells[0].div_ceil(2) * 4 * c;
        let offsets: Vec<usize> = (0..n)
            .map(|g| {
                let mirrored = g > n / 2;
                let k = if mirrored { n - g } else { g };
                k * column + pair * 4 * c + usize::from(mirrored) * 2 * c
            })
            .collect();
        let source = Source { values: columns, offsets: &offsets, imaginary: c };
        for channel in (0..c).step_by(LANES) {
            plan.run::<S, true>(s, scratch, source, channel);
            for x in 0..side.cells[1] {
                let v = result(s, scratch, wrapped(x + side.origin[1], n));
                put(v, values, x * c + channel, side.row());
            }
        }
    }
}

/// One frequency k_x along y.
pub(super) struct ColumnForth<'a> {
    pub(super) engine: &'a Engine,
    pub(super) side: &'a Side,
    pub(super) rows: &'a [f32],
    pub(super) out: &'a mut [f32],
    pub(super) kx: usize,
    pub(super) scratch: &'a mut Vec<f32>,
}

impl Work for ColumnForth<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, side, rows, out, kx, scratch } = self;
        let (plan, c, n) = (&engine.plans[0], side.padded, engine.grid[0]);
        scratch.resize(plan.scratch(), 0.0);
        let offsets = offsets(side, 0, n, kx * 2 * c, engine.half() * 2 * c);
        let source = Source { values: rows, offsets: &offsets, imaginary: c };
        for channel in (0..c).step_by(LANES) {
            plan.run::<S, false>(s, scratch, source, channel);
            for k in 0..n {
                put(result(s, scratch, k), out, k * 2 * c + channel, c);
            }
        }
    }
}

/// One frequency k_x back along y.
pub(super) struct ColumnBack<'a> {
    pub(super) engine: &'a Engine,
    pub(super) side: &'a Side,
    pub(super) products: &'a [f32],
    pub(super) out: &'a mut [f32],
    pub(super) kx: usize,
    pub(super) scratch: &'a mut Vec<f32>,
}

impl Work for ColumnBack<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, side, products, out, kx, scratch } = self;
        let (plan, c, n) = (&engine.plans[0], side.padded, engine.grid[0]);
        let wide = 2 * c;
        scratch.resize(plan.scratch(), 0.0);
        let offsets: Vec<usize> = (0..n).map(|k| (kx * n + k) * wide).collect();
        let source = Source { values: products, offsets: &offsets, imaginary: c };
        // real rows have real coefficients here
        let real = kx == 0 || 2 * kx == engine.grid[1];
        let zero = V::splat(s, 0.0);
        let y = |i: usize| wrapped(i + side.origin[0], n);
        for channel in (0..c).step_by(LANES) {
            plan.run::<S, true>(s, scratch, source, channel);
            for (pair, out) in out.chunks_exact_mut(2 * wide).enumerate() {
                let mut a = result(s, scratch, y(2 * pair));
                let mut b = C::zero(s);
                if 2 * pair + 1 < side.cells[0] {
                    b = result(s, scratch, y(2 * pair + 1));
                }
                if real {
                    (a.im, b.im) = (zero, zero);
                }
                // both rows as one complex row, at k_x and at −k_x
                put(C { re: a.re - b.im, im: a.im + b.re }, out, channel, c);
                put(C { re: a.re + b.im, im: b.re - a.im }, out, wide + channel, c);
            }
        }
    }
}
