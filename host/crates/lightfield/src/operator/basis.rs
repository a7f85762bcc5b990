//! Even and odd parts of the pixels of a cell, and of its voxels.

use crate::simd::{LANES, V, reversed};
use fearless_simd::prelude::*;

/// Channels of a cell: two axes of sub-positions, and what lies innermost (planes).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Cell {
    /// Sub-positions (y, x).
    pub(crate) n: [usize; 2],
    /// Innermost extent.
    pub(crate) inner: usize,
}

impl Cell {
    pub(crate) fn channels(&self) -> usize {
        self.n[0] * self.n[1] * self.inner
    }

    pub(crate) fn at(&self, y: usize, x: usize, i: usize) -> usize {
        (y * self.n[1] + x) * self.inner + i
    }

    /// (y, x, i) of a channel.
    pub(crate) fn split(&self, c: usize) -> (usize, usize, usize) {
        (c / self.inner / self.n[1], c / self.inner % self.n[1], c % self.inner)
    }

    /// +1 for the even channels of an axis in the parity basis, −1 for the odd ones.
    pub(crate) fn parity(&self, axis: usize, u: usize) -> f32 {
        if u < self.n[axis] - self.n[axis] / 2 { 1.0 } else { -1.0 }
    }

    /// Square of the length of a channel's basis vector: 2 for each axis on which it is one of a pair.
    pub(crate) fn weight(&self, c: usize) -> f32 {
        let (y, x, _) = self.split(c);
        let of = |n: usize, u: usize| if n % 2 == 1 && u == n / 2 { 1.0 } else { 2.0 };
        of(self.n[0], y) * of(self.n[1], x)
    }

    /// To and from the parity basis, in place: of positions j and n−1−j the first becomes the sum, the
    /// second the difference. Its own transpose; twice it multiplies by [`Cell::weight`].
    pub(crate) fn butterfly(&self, values: &mut [f32]) {
        self.halves(values, pair, |row| {
            for j in 0..row.len() / 2 {
                both(row, j);
            }
        });
    }

    /// [`Cell::butterfly`] with vectors: the same numbers.
    #[inline(always)]
    pub(crate) fn butterfly_with<S: Simd>(&self, s: S, values: &mut [f32]) {
        self.halves(
            values,
            #[inline(always)]
            |a, b| pairs(s, a, b),
            #[inline(always)]
            |row| folded(s, row),
        );
    }

    /// `pair` for halves that lie apart, `row` for rows of single numbers.
    #[inline(always)]
    fn halves(&self, values: &mut [f32], pair: impl Fn(&mut [f32], &mut [f32]), fold: impl Fn(&mut [f32])) {
        let [ny, nx] = self.n;
        let row = nx * self.inner;
        for j in 0..ny / 2 {
            let (a, b) = values.split_at_mut((ny - 1 - j) * row);
            pair(&mut a[j * row..][..row], &mut b[..row]);
        }
        if nx < 2 {
            return;
        }
        for r in values[..ny * row].chunks_exact_mut(row) {
            if self.inner == 1 {
                fold(r);
                continue;
            }
            for j in 0..nx / 2 {
                let (a, b) = r.split_at_mut((nx - 1 - j) * self.inner);
                pair(&mut a[j * self.inner..][..self.inner], &mut b[..self.inner]);
            }
        }
    }
}

fn pair(a: &mut [f32], b: &mut [f32]) {
    for (a, b) in a.iter_mut().zip(b) {
        (*a, *b) = (*a + *b, *a - *b);
    }
}

/// Positions j and n−1−j.
#[inline(always)]
fn both(row: &mut [f32], j: usize) {
    let k = row.len() - 1 - j;
    (row[j], row[k]) = (row[j] + row[k], row[j] - row[k]);
}

#[inline(always)]
fn pairs<S: Simd>(s: S, a: &mut [f32], b: &mut [f32]) {
    let n = a.len();
    if n < LANES {
        return pair(a, b);
    }
    // the last lanes overlap the ones before: read first, written last
    let last = n - LANES;
    let (u, v) = (V::from_slice(s, &a[last..]), V::from_slice(s, &b[last..n]));
    for (a, b) in a.as_chunks_mut::<LANES>().0.iter_mut().zip(b.as_chunks_mut::<LANES>().0) {
        let (u, v) = (V::from_slice(s, a), V::from_slice(s, b));
        (u + v).store_slice(a);
        (u - v).store_slice(b);
    }
    (u + v).store_slice(&mut a[last..]);
    (u - v).store_slice(&mut b[last..n]);
}

#[inline(always)]
fn folded<S: Simd>(s: S, row: &mut [f32]) {
    let n = row.len();
    let mut j = 0;
    while j < n / 2 {
        if n - 2 * j + 1 < 2 * LANES {
            both(row, j);
            j += 1;
            continue;
        }
        // the vectors share the middle of an odd row at most, which stays
        let (low, high) = (j..j + LANES, n - j - LANES..n - j);
        let middle = row[j + LANES - 1];
        let (u, v) = (V::from_slice(s, &row[low.clone()]), reversed(s, V::from_slice(s, &row[high.clone()])));
        (u + v).store_slice(&mut row[low]);
        reversed(s, u - v).store_slice(&mut row[high]);
        if n - 2 * j < 2 * LANES {
            row[j + LANES - 1] = middle;
        }
        j += LANES;
    }
}

#[cfg(test)]
mod tests {
    use super::Cell;
    use crate::simd::{Kernel, levels, run};
    use fearless_simd::Simd;

    struct With<'a>(Cell, &'a mut [f32]);

    impl Kernel for With<'_> {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self, s: S) {
            self.0.butterfly_with(s, self.1);
        }
    }

    #[test]
    fn vectors_give_the_same_numbers() {
        for (ny, nx, inner) in (1..36).flat_map(|n| [(n, n, 1), (3, n, 1), (n, 3, 5), (3, 4, n)]) {
            let cell = Cell { n: [ny, nx], inner };
            let values: Vec<f32> = (0..cell.channels()).map(|i| (i as f32 * 0.7).sin()).collect();
            let mut plain = values.clone();
            cell.butterfly(&mut plain);
            for level in levels() {
                let mut vectors = values.clone();
                run(level, With(cell, &mut vectors));
                assert_eq!(plain, vectors, "{level:?} {cell:?}");
            }
            cell.butterfly(&mut plain);
            for (c, (twice, v)) in plain.iter().zip(&values).enumerate() {
                assert!((twice - cell.weight(c) * v).abs() < 1e-6, "{cell:?} {c}");
            }
        }
    }
}
