//! Products of a stored block with up to eight real vectors.
//!
//! A block of `rows` × `columns` is stored in panels of `T::height()` rows: [panel][column][row]. The vectors
//! lie interleaved, eight numbers for each index, so that both directions read the same storage in order.

use crate::simd::{LANES, V};
use fearless_simd::prelude::*;

/// Vectors that one call takes.
pub(crate) const VECTORS: usize = 8;

/// How a block's numbers are stored.
pub(crate) trait Element: Copy + Send + Sync + Default + 'static {
    /// Bytes of one.
    const BYTES: usize;
    /// Nearest storable number.
    fn of(value: f32) -> Self;
    /// The numbers of a panel as 32-bit numbers, in `scratch` if they have to be converted.
    fn decode<'a>(panel: &'a [Self], scratch: &'a mut [f32]) -> &'a [f32];
}

impl Element for f32 {
    const BYTES: usize = 4;

    fn of(value: f32) -> Self {
        value
    }

    #[inline(always)]
    fn decode<'a>(panel: &'a [Self], _: &'a mut [f32]) -> &'a [f32] {
        panel
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
    fn decode<'a>(panel: &'a [Self], scratch: &'a mut [f32]) -> &'a [f32] {
        let out = &mut scratch[..panel.len()];
        // exponents are re-biased by the multiplication: 2^(127−15)
        let rebias = f32::from_bits((127 + 112) << 23);
        for (o, h) in out.iter_mut().zip(panel) {
            let bits = u32::from(h.0);
            let magnitude = f32::from_bits((bits & 0x7fff) << 13) * rebias;
            *o = f32::from_bits(magnitude.to_bits() | ((bits & 0x8000) << 16));
        }
        out
    }
}

/// Shape of a block and its panels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Block {
    pub(crate) rows: usize,
    pub(crate) columns: usize,
    /// Vectors of lanes in a panel: 3, or 2 where that pads less.
    pub(crate) tall: usize,
}

impl Block {
    pub(crate) fn new(rows: usize, columns: usize) -> Self {
        let padded = |tall: usize| rows.next_multiple_of(tall * LANES);
        Self { rows, columns, tall: if padded(3) <= padded(2) { 3 } else { 2 } }
    }

    pub(crate) fn height(&self) -> usize {
        self.tall * LANES
    }

    pub(crate) fn padded_rows(&self) -> usize {
        self.rows.next_multiple_of(self.height())
    }

    pub(crate) fn len(&self) -> usize {
        self.padded_rows() * self.columns
    }

    /// Numbers of a panel.
    pub(crate) fn panel(&self) -> usize {
        self.height() * self.columns
    }

    /// Where (row, column) lies.
    pub(crate) fn index(&self, row: usize, column: usize) -> usize {
        let h = self.height();
        (row / h * self.columns + column) * h + row % h
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
        scratch: &mut [f32],
    ) {
        let stride = self.padded_rows();
        for (p, panel) in a.chunks_exact(self.panel()).enumerate() {
            let panel = T::decode(panel, scratch);
            let mut j = 0;
            while j < vectors {
                let at = j * stride + p * self.height();
                match (self.tall, vectors - j) {
                    (3, 1 | 2) => tile::<S, 3, 2>(s, panel, x, j, &mut y[at..], stride),
                    (3, _) => tile::<S, 3, 4>(s, panel, x, j, &mut y[at..], stride),
                    (_, 1 | 2) => tile::<S, 2, 2>(s, panel, x, j, &mut y[at..], stride),
                    _ => tile::<S, 2, 4>(s, panel, x, j, &mut y[at..], stride),
                }
                j += 4;
            }
        }
    }

    /// y = Aᵀ x. `x`: [padded row][8]; `y`: [column][8], overwritten.
    #[inline(always)]
    pub(crate) fn multiply_transposed<S: Simd, T: Element>(
        &self,
        s: S,
        a: &[T],
        x: &[f32],
        y: &mut [f32],
        scratch: &mut [f32],
    ) {
        let h = self.height();
        y[..self.columns * VECTORS].fill(0.0);
        for (panel, x) in a.chunks_exact(self.panel()).zip(x.chunks_exact(h * VECTORS)) {
            let panel = T::decode(panel, scratch);
            let mut c = 0;
            while c + 12 <= self.columns {
                columns::<S, 12>(s, &panel[c * h..][..12 * h], h, x, &mut y[c * VECTORS..][..12 * VECTORS]);
                c += 12;
            }
            while c + 3 <= self.columns {
                columns::<S, 3>(s, &panel[c * h..][..3 * h], h, x, &mut y[c * VECTORS..][..3 * VECTORS]);
                c += 3;
            }
            while c < self.columns {
                columns::<S, 1>(s, &panel[c * h..][..h], h, x, &mut y[c * VECTORS..][..VECTORS]);
                c += 1;
            }
        }
    }
}

/// One panel, `T` lanes-high, times `N` vectors from the j-th on.
#[inline(always)]
fn tile<S: Simd, const T: usize, const N: usize>(
    s: S,
    panel: &[f32],
    x: &[f32],
    j: usize,
    y: &mut [f32],
    stride: usize,
) {
    let mut sum = [[V::splat(s, 0.0); N]; T];
    for (a, x) in panel.chunks_exact(T * LANES).zip(x.chunks_exact(VECTORS)) {
        let mut column = [V::splat(s, 0.0); T];
        for t in 0..T {
            column[t] = V::from_slice(s, &a[t * LANES..][..LANES]);
        }
        let x = &x[j..j + N];
        for n in 0..N {
            let b = V::splat(s, x[n]);
            for t in 0..T {
                sum[t][n] = column[t].mul_add(b, sum[t][n]);
            }
        }
    }
    for n in 0..N {
        for t in 0..T {
            sum[t][n].store_slice(&mut y[n * stride + t * LANES..][..LANES]);
        }
    }
}

/// `N` columns of a panel, transposed, times all eight vectors, added to y.
#[inline(always)]
fn columns<S: Simd, const N: usize>(s: S, a: &[f32], h: usize, x: &[f32], y: &mut [f32]) {
    let mut sum = [V::splat(s, 0.0); N];
    for n in 0..N {
        sum[n] = V::from_slice(s, &y[n * VECTORS..][..VECTORS]);
    }
    // columns one by one as slices of equal length, which spares checks
    let mut column: [&[f32]; N] = [&[]; N];
    for n in 0..N {
        column[n] = &a[n * h..][..h];
    }
    for (r, x) in x[..h * VECTORS].chunks_exact(VECTORS).enumerate() {
        let x = V::from_slice(s, x);
        for n in 0..N {
            sum[n] = V::splat(s, column[n][r]).mul_add(x, sum[n]);
        }
    }
    for n in 0..N {
        sum[n].store_slice(&mut y[n * VECTORS..][..VECTORS]);
    }
}
