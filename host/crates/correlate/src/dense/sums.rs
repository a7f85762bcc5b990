//! From tile sums to subset sums, along the rows and then down the columns.

use super::tiling::{DEGREES, LANES, Task, Tiling, moments, monomial};
use crate::sampler::V;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

/// Calls `$batch!(degree, planes)` for all lines of all groups.
macro_rules! each_batch {
    ($groups:expr, |$i:ident, $e:ident| $moment:expr, $batch:ident) => {{
        let mut plane = 0;
        for g in $groups {
            let step = moments(g.degree);
            for $i in 0..=g.degree {
                for first in (0..g.count).step_by(BATCH) {
                    match g.degree - $i {
                        0 => $batch!(0, planes(plane, step, first, g.count, |$e| $moment)),
                        1 => $batch!(1, planes(plane, step, first, g.count, |$e| $moment)),
                        2 => $batch!(2, planes(plane, step, first, g.count, |$e| $moment)),
                        3 => $batch!(3, planes(plane, step, first, g.count, |$e| $moment)),
                        _ => $batch!(4, planes(plane, step, first, g.count, |$e| $moment)),
                    }
                }
            }
            plane += g.planes();
        }
    }};
}

/// `count` quantities whose moments up to `degree` are summed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Group {
    pub(crate) count: usize,
    pub(crate) degree: usize,
}

impl Group {
    pub(crate) fn planes(self) -> usize {
        self.count * moments(self.degree)
    }
}

/// Working memory of one thread.
#[derive(Default)]
pub(crate) struct SumBuffers {
    /// Sums of the current row of tiles: whole tiles, then their first `rem` columns. The first row of
    /// pixels replaces what is there.
    pub(crate) tiles: Vec<f32>,
    /// The last q rows of tiles summed along x, and the partial row after them.
    ring: Vec<f32>,
    /// Sums of one row of subsets.
    pub(crate) subsets: Vec<f32>,
    shifts: Vec<Shift>,
    /// The shifts in the order of the ring.
    turned: Vec<Shift>,
}

type Shift = [[f32; DEGREES]; DEGREES];

impl SumBuffers {
    /// Makes room for `planes` moments.
    pub(crate) fn prepare(&mut self, tiling: &Tiling, task: &Task, planes: usize) {
        let (q, rem) = tiling.whole();
        self.tiles.resize(2 * planes * task.tiles, 0.0);
        self.ring.resize((q + usize::from(rem > 0)) * planes * task.width, 0.0);
        self.subsets.resize(planes * task.width, 0.0);
        self.shifts.clear();
        self.shifts.extend((0..=tiling.last()).map(|m| tiling.shift(m)));
        self.turned.clone_from(&self.shifts);
    }

    /// Takes what the first `rem` rows of row of tiles `b` have given; the sums of the row of subsets
    /// that ends there follow.
    #[inline(always)]
    pub(crate) fn part<S: Simd>(&mut self, s: S, tiling: &Tiling, task: &Task, groups: &[Group], b: usize) {
        let (q, rem) = tiling.whole();
        if rem > 0 && b >= tiling.last() {
            let slot = self.subsets.len();
            along_x(s, tiling, task, groups, &self.shifts, &self.tiles, &mut self.ring[q * slot..]);
            down(s, self, tiling, task, groups, b);
        }
    }

    /// Closes row of tiles `b`, of which only the first rows were summed unless `whole`; whether the
    /// sums of a row of subsets are there.
    #[inline(always)]
    pub(crate) fn close<S: Simd>(
        &mut self,
        s: S,
        tiling: &Tiling,
        task: &Task,
        groups: &[Group],
        b: usize,
        whole: bool,
    ) -> bool {
        let (q, rem) = tiling.whole();
        let slot = self.subsets.len();
        let full = b >= tiling.last();
        if whole {
            let at = b % q * slot;
            along_x(s, tiling, task, groups, &self.shifts, &self.tiles, &mut self.ring[at..at + slot]);
        }
        if rem == 0 && full {
            down(s, self, tiling, task, groups, b);
        }
        full
    }
}

/// Lines of moments that are summed together.
const BATCH: usize = 4;

/// Planes of `BATCH` lines from quantity `first` on; lines beyond `count` repeat the last one.
#[inline(always)]
fn planes<const N: usize>(
    plane: usize,
    step: usize,
    first: usize,
    count: usize,
    moment: impl Fn(usize) -> usize,
) -> [[usize; BATCH]; N] {
    let mut p = [[0; BATCH]; N];
    for (e, row) in p.iter_mut().enumerate() {
        for (l, plane_of) in row.iter_mut().enumerate() {
            *plane_of = plane + (first + l).min(count - 1) * step + moment(e);
        }
    }
    p
}

/// Adds the moment of degree `e` of one tile to those of degree e..=N of the subset.
#[inline(always)]
fn add<S: Simd, const N: usize>(s: S, acc: &mut [V<S>; DEGREES], c: &Shift, e: usize, t: V<S>) {
    acc[e] += t;
    for i in e + 1..=N {
        acc[i] = V::splat(s, c[i][e]).mul_add(t, acc[i]);
    }
}

/// Sums of the subsets whose last row of tiles is `b`.
#[simd]
fn down<S: Simd>(s: S, buffers: &mut SumBuffers, tiling: &Tiling, task: &Task, groups: &[Group], b: usize) {
    let q = tiling.whole().0;
    let first = b - tiling.last();
    for m in 0..q {
        buffers.turned[(first + m) % q] = buffers.shifts[m];
    }
    let (w, slot) = (task.width, buffers.subsets.len());
    let SumBuffers { ring, subsets, turned, .. } = buffers;
    // a batch of lines shares the loop over the tiles
    macro_rules! batch {
        ($n:literal, $planes:expr) => {{
            let planes: [[usize; BATCH]; $n + 1] = $planes;
            for k in (0..w).step_by(LANES) {
                let mut acc = [[V::splat(s, 0.0); DEGREES]; BATCH];
                for (row, c) in ring.chunks_exact(slot).zip(turned.iter()) {
                    for e in 0..=$n {
                        for l in 0..BATCH {
                            let o = planes[e][l] * w + k;
                            add::<S, $n>(s, &mut acc[l], c, e, V::from_slice(s, &row[o..o + LANES]));
                        }
                    }
                }
                for e in 0..=$n {
                    for l in 0..BATCH {
                        let o = planes[e][l] * w + k;
                        acc[l][e].store_slice(&mut subsets[o..o + LANES]);
                    }
                }
            }
        }};
    }
    each_batch!(groups, |i, e| monomial(i, e), batch);
}

#[simd]
fn along_x<S: Simd>(
    s: S,
    tiling: &Tiling,
    task: &Task,
    groups: &[Group],
    shifts: &[Shift],
    tiles: &[f32],
    out: &mut [f32],
) {
    let (q, rem) = tiling.whole();
    let (whole, part) = tiles.split_at(tiles.len() / 2);
    let (width, stride) = (task.width, task.tiles);
    macro_rules! batch {
        ($n:literal, $planes:expr) => {{
            let planes: [[usize; BATCH]; $n + 1] = $planes;
            for k in (0..width).step_by(LANES) {
                let mut acc = [[V::splat(s, 0.0); DEGREES]; BATCH];
                // all windows have one length: one comparison serves the loads of a tile
                let length = q - 1 + LANES;
                for e in 0..=$n {
                    let rows: [&[f32]; BATCH] = planes[e].map(|p| &whole[p * stride + k..][..length]);
                    for (m, c) in shifts[..q].iter().enumerate() {
                        for l in 0..BATCH {
                            add::<S, $n>(s, &mut acc[l], c, e, V::from_slice(s, &rows[l][m..m + LANES]));
                        }
                    }
                    if rem > 0 {
                        for l in 0..BATCH {
                            let o = planes[e][l] * stride + k + q;
                            let t = V::from_slice(s, &part[o..o + LANES]);
                            add::<S, $n>(s, &mut acc[l], &shifts[q], e, t);
                        }
                    }
                }
                for e in 0..=$n {
                    for l in 0..BATCH {
                        let o = planes[e][l] * width + k;
                        acc[l][e].store_slice(&mut out[o..o + LANES]);
                    }
                }
            }
        }};
    }
    each_batch!(groups, |j, e| monomial(e, j), batch);
}

/// Adds the sums over one row of pixels, x-powers in `acc`, to the planes of one quantity; the `first`
/// row replaces what was there.
#[inline(always)]
pub(crate) fn flush<S: Simd, const D: usize>(
    s: S,
    first: bool,
    acc: &[V<S>],
    y: &[f32; DEGREES],
    planes: &mut [f32],
    stride: usize,
    k: usize,
) {
    for i in 0..=D {
        for j in 0..=D - i {
            let at = monomial(i, j) * stride + k;
            let p = &mut planes[at..at + LANES];
            let old = if first { V::splat(s, 0.0) } else { V::from_slice(s, p) };
            let new = if j == 0 { old + acc[i] } else { V::splat(s, y[j]).mul_add(acc[i], old) };
            new.store_slice(p);
        }
    }
}
