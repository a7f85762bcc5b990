//! Products of a stored block with up to eight real vectors.
//!
//! A block of `rows` × `columns` is stored in panels of eight rows: [panel][column][row]. The vectors lie
//! interleaved, eight numbers for each index, so that both directions read the same storage once and in order.
//! Reading it is what takes time: it is asked for ahead of its use.

use crate::simd::{LANES, V, widen};
use fearless_simd::prelude::*;
use prefetch_index::prefetch_index;

/// Vectors that one call takes.
pub(crate) const VECTORS: usize = 8;
/// How far ahead of its use storage is asked for, in bytes; from 2 to 8 KiB are equally good. A product of blocks
/// of 31 MiB takes a fifth less time with it (docs/performance.md).
const AHEAD: usize = 4096;
/// Columns between two requests.
const GROUP: usize = 4;
/// Columns of a panel that are summed at a time in the transposed product: with the eight rows all registers
/// of AVX2.
const SUMS: usize = 6;
/// Columns that are converted at a time.
const CONVERTED: usize = 4 * SUMS;

/// How a block's numbers are stored.
pub(crate) trait Element: Copy + Send + Sync + Default + 'static {
    /// Bytes of one.
    const BYTES: usize;
    /// Nearest storable number.
    fn of(value: f32) -> Self;
    /// Eight numbers.
    fn lanes<S: Simd>(s: S, from: &[Self; LANES]) -> V<S>;
    /// The numbers as 32-bit numbers, in `scratch` if they have to be converted.
    fn plain<'a, S: Simd>(s: S, from: &'a [Self], scratch: &'a mut [f32]) -> &'a [f32];
}

impl Element for f32 {
    const BYTES: usize = 4;

    fn of(value: f32) -> Self {
        value
    }

    #[inline(always)]
    fn lanes<S: Simd>(s: S, from: &[Self; LANES]) -> V<S> {
        V::from_slice(s, from)
    }

    #[inline(always)]
    fn plain<'a, S: Simd>(_: S, from: &'a [Self], _: &'a mut [f32]) -> &'a [f32] {
        from
    }
}

/// Half precision; what is too small for a normal number is zero.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Half(u16);

impl Element for Half {
    const BYTES: usize = 2;

    fn of(value: f32) -> Self {
        let bits = half::f16::from_f32(value).to_bits();
        Self(if bits & 0x7c00 == 0 { 0 } else { bits })
    }

    #[inline(always)]
    fn lanes<S: Simd>(s: S, from: &[Self; LANES]) -> V<S> {
        widen(s, from.map(|h| h.0))
    }

    #[inline(always)]
    fn plain<'a, S: Simd>(s: S, from: &'a [Self], scratch: &'a mut [f32]) -> &'a [f32] {
        for (h, o) in from.as_chunks::<LANES>().0.iter().zip(scratch.as_chunks_mut::<LANES>().0) {
            Self::lanes(s, h).store_slice(o);
        }
        &scratch[..from.len()]
    }
}

/// Shape of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Block {
    pub(crate) rows: usize,
    pub(crate) columns: usize,
}

impl Block {
    pub(crate) fn padded_rows(&self) -> usize {
        self.rows.next_multiple_of(LANES)
    }

    pub(crate) fn len(&self) -> usize {
        self.padded_rows() * self.columns
    }

    /// Where (row, column) lies.
    pub(crate) fn index(&self, row: usize, column: usize) -> usize {
        (row / LANES * self.columns + column) * LANES + row % LANES
    }

    /// y = A x. `x`: [column][8]; `y`: [8][padded row], of which `vectors` are computed.
    #[inline(always)]
    pub(crate) fn multiply<S: Simd, T: Element>(
        &self,
        s: S,
        a: &[T],
        x: &[f32],
        y: &mut [f32],
        vectors: usize,
    ) {
        let x = &x[..self.columns * VECTORS];
        match vectors {
            1 | 2 => self.tiles::<S, T, 2, 4>(s, a, x, y),
            3 | 4 => self.tiles::<S, T, 4, 2>(s, a, x, y),
            _ => self.tiles::<S, T, 8, 1>(s, a, x, y),
        }
    }

    /// All rows times `N` vectors, `P` panels at a time: enough sums that additions need not wait for each
    /// other. Each sum has one order, whatever `N` and `P`.
    #[inline(always)]
    fn tiles<S: Simd, T: Element, const N: usize, const P: usize>(
        &self,
        s: S,
        a: &[T],
        x: &[f32],
        y: &mut [f32],
    ) {
        let stride = self.padded_rows();
        let panel = LANES * self.columns;
        let together = a.chunks_exact(P * panel);
        let (rest, done) = (together.remainder(), together.len() * P);
        for (p, a) in together.enumerate() {
            tile::<S, T, N, P>(s, a, x, &mut y[p * P * LANES..], stride);
        }
        for (p, a) in rest.chunks_exact(panel).enumerate() {
            tile::<S, T, N, 1>(s, a, x, &mut y[(done + p) * LANES..], stride);
        }
    }

    /// y = Aᵀ x. `x`: [padded row][8]; `y`: [column][8], overwritten.
    #[inline(always)]
    pub(crate) fn multiply_transposed<S: Simd, T: Element>(&self, s: S, a: &[T], x: &[f32], y: &mut [f32]) {
        let y = &mut y[..self.columns * VECTORS];
        y.fill(0.0);
        let mut scratch = [0f32; CONVERTED * LANES];
        let panels = a.chunks_exact(LANES * self.columns);
        for (panel, x) in panels.zip(x.as_chunks::<{ LANES * VECTORS }>().0) {
            let mut rows = [V::splat(s, 0.0); LANES];
            for (row, x) in rows.iter_mut().zip(x.as_chunks::<VECTORS>().0) {
                *row = V::from_slice(s, x);
            }
            let parts = panel.chunks(CONVERTED * LANES).zip(y.chunks_mut(CONVERTED * VECTORS));
            for (a, y) in parts {
                ahead(a);
                let plain = T::plain(s, a, &mut scratch);
                let (groups, rest) = plain.as_chunks::<{ SUMS * LANES }>();
                let (y_groups, y_rest) = y.as_chunks_mut::<{ SUMS * VECTORS }>();
                for (a, y) in groups.iter().zip(y_groups) {
                    columns::<S, SUMS>(s, a, &rows, y);
                }
                for (a, y) in rest.chunks_exact(LANES).zip(y_rest.chunks_exact_mut(VECTORS)) {
                    columns::<S, 1>(s, a, &rows, y);
                }
            }
        }
    }
}

/// Asks for what lies [`AHEAD`] of `part`.
#[inline(always)]
fn ahead<T: Element>(part: &[T]) {
    const LINE: usize = 64;
    for at in (0..part.len()).step_by(LINE / T::BYTES) {
        prefetch_index(part, at + AHEAD / T::BYTES);
    }
}

/// `P` panels times `N` vectors.
#[inline(always)]
fn tile<S: Simd, T: Element, const N: usize, const P: usize>(
    s: S,
    a: &[T],
    x: &[f32],
    y: &mut [f32],
    stride: usize,
) {
    let panel = a.len() / P;
    let mut columns: [&[[T; LANES]]; P] = [&[]; P];
    for (p, c) in columns.iter_mut().enumerate() {
        *c = a[p * panel..(p + 1) * panel].as_chunks::<LANES>().0;
    }
    let mut sum = [[V::splat(s, 0.0); N]; P];
    let (groups, rest) = x.as_chunks::<{ GROUP * VECTORS }>();
    for (g, x) in groups.iter().enumerate() {
        for p in 0..P {
            let a = &columns[p][g * GROUP..(g + 1) * GROUP];
            ahead(a.as_flattened());
            for (a, x) in a.iter().zip(x.as_chunks::<VECTORS>().0) {
                add::<S, T, N>(s, a, x, &mut sum[p]);
            }
        }
    }
    for p in 0..P {
        for (a, x) in columns[p][groups.len() * GROUP..].iter().zip(rest.as_chunks::<VECTORS>().0) {
            add::<S, T, N>(s, a, x, &mut sum[p]);
        }
        for n in 0..N {
            sum[p][n].store_slice(&mut y[n * stride + p * LANES..][..LANES]);
        }
    }
}

/// Adds a column of a panel times the first `N` of eight numbers.
#[inline(always)]
fn add<S: Simd, T: Element, const N: usize>(s: S, a: &[T; LANES], x: &[f32; VECTORS], sum: &mut [V<S>; N]) {
    let a = T::lanes(s, a);
    for n in 0..N {
        sum[n] = a.mul_add(V::splat(s, x[n]), sum[n]);
    }
}

/// `N` columns of a panel, transposed, times its eight rows of all vectors, added to y.
#[inline(always)]
fn columns<S: Simd, const N: usize>(s: S, a: &[f32], rows: &[V<S>; LANES], y: &mut [f32]) {
    let (a, y) = (&a.as_chunks::<LANES>().0[..N], &mut y.as_chunks_mut::<VECTORS>().0[..N]);
    let mut sum = [V::splat(s, 0.0); N];
    for n in 0..N {
        sum[n] = V::from_slice(s, &y[n]);
    }
    for r in 0..LANES {
        for n in 0..N {
            sum[n] = V::splat(s, a[n][r]).mul_add(rows[r], sum[n]);
        }
    }
    for n in 0..N {
        sum[n].store_slice(&mut y[n]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Kernel, levels, run};
    use fearless_simd::Level;

    struct Product<'a, T> {
        block: Block,
        a: &'a [T],
        x: &'a [f32],
        vectors: usize,
        transposed: bool,
    }

    impl<T: Element> Kernel for Product<'_, T> {
        type Output = Vec<f32>;

        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> Vec<f32> {
            let mut y = vec![f32::NAN; VECTORS * self.block.padded_rows().max(self.block.columns)];
            if self.transposed {
                self.block.multiply_transposed(s, self.a, self.x, &mut y);
            } else {
                self.block.multiply(s, self.a, self.x, &mut y, self.vectors);
            }
            y
        }
    }

    /// Sums with whole numbers, which are exact in any order, over sizes with all kinds of remainders.
    fn products<T: Element>(level: Level) {
        for rows in [1, 7, 8, 9, 24, 31, 41] {
            for columns in [1, 3, 4, 5, 6, 11, 24, 25, 31, 50] {
                let block = Block { rows, columns };
                let value = |r: usize, c: usize| ((r * 7 + c * 3) % 11) as f32 - 5.0;
                let mut a = vec![T::default(); block.len()];
                for r in 0..rows {
                    for c in 0..columns {
                        a[block.index(r, c)] = T::of(value(r, c));
                    }
                }
                let tall = block.padded_rows();
                let x: Vec<f32> =
                    (0..VECTORS * tall.max(columns)).map(|i| ((i * 5) % 17) as f32 - 8.0).collect();
                for vectors in 1..=VECTORS {
                    let y = run(level, Product { block, a: &a, x: &x, vectors, transposed: false });
                    for (r, v) in (0..rows).flat_map(|r| (0..vectors).map(move |v| (r, v))) {
                        let sum: f32 = (0..columns).map(|c| value(r, c) * x[c * VECTORS + v]).sum();
                        assert_eq!(y[v * tall + r], sum, "{block:?}, {vectors} vectors, row {r} of {v}");
                    }
                    let padding = (rows..tall).flat_map(|r| (0..vectors).map(move |v| v * tall + r));
                    assert!(padding.into_iter().all(|i| y[i] == 0.0), "{block:?}: padding");
                }
                let y = run(level, Product { block, a: &a, x: &x, vectors: 8, transposed: true });
                for (c, v) in (0..columns).flat_map(|c| (0..VECTORS).map(move |v| (c, v))) {
                    let sum: f32 = (0..rows).map(|r| value(r, c) * x[r * VECTORS + v]).sum();
                    assert_eq!(y[c * VECTORS + v], sum, "{block:?}, transposed, column {c} of {v}");
                }
            }
        }
    }

    #[test]
    fn products_are_the_sums() {
        for level in levels() {
            products::<f32>(level);
            products::<Half>(level);
        }
    }

    /// Numbers that round: each vector's result is the same whichever others go with it.
    #[test]
    fn vectors_do_not_know_each_other() {
        let block = Block { rows: 45, columns: 29 };
        let a: Vec<f32> = (0..block.len()).map(|i| (i as f32 * 0.37).sin()).collect();
        let x: Vec<f32> = (0..VECTORS * 48).map(|i| (i as f32 * 0.73).cos()).collect();
        let y = |vectors| run(Level::new(), Product { block, a: &a, x: &x, vectors, transposed: false });
        let all = y(VECTORS);
        for vectors in 1..VECTORS {
            let some = y(vectors);
            let n = vectors * block.padded_rows();
            assert_eq!(some[..n], all[..n], "{vectors} vectors");
        }
    }
}
