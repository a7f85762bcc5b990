//! From tile sums to subset sums, along the rows and then down the columns.

use super::tiling::{DEGREES, LANES, Task, Tiling, moments, monomial};
use crate::sampler::V;
use fearless_simd::prelude::*;

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
    /// Sums of the current row of tiles: whole tiles, then their first `rem` columns.
    pub(crate) tiles: Vec<f32>,
    /// The same after the first `rem` rows of the tiles.
    part: Vec<f32>,
    /// Rows of tiles summed along x, the last ones needed.
    ring: Vec<f32>,
    /// The same for the partial row.
    ring_part: Vec<f32>,
    /// Sums of one row of subsets.
    pub(crate) subsets: Vec<f32>,
    shifts: Vec<[[f32; DEGREES]; DEGREES]>,
}

impl SumBuffers {
    /// Makes room for `planes` moments.
    pub(crate) fn prepare(&mut self, tiling: &Tiling, task: &Task, planes: usize) {
        let resize = |v: &mut Vec<f32>, n: usize| {
            v.clear();
            v.resize(n, 0.0);
        };
        resize(&mut self.tiles, 2 * planes * task.tiles);
        resize(&mut self.part, 2 * planes * task.tiles);
        resize(&mut self.ring, (tiling.last() + 1) * planes * task.width);
        resize(&mut self.ring_part, planes * task.width);
        resize(&mut self.subsets, planes * task.width);
        self.shifts.clear();
        self.shifts.extend((0..=tiling.last()).map(|m| tiling.shift(m)));
    }

    /// Begins a row of tiles.
    pub(crate) fn begin(&mut self) {
        self.tiles.fill(0.0);
    }

    /// Keeps what the first `rem` rows of the tiles have given.
    pub(crate) fn keep_part(&mut self) {
        self.part.copy_from_slice(&self.tiles);
    }

    /// Closes row of tiles `b`; `whole` unless only its first rows were summed.
    #[inline(always)]
    pub(crate) fn close<S: Simd>(
        &mut self,
        s: S,
        tiling: &Tiling,
        task: &Task,
        groups: &[Group],
        b: usize,
        whole: bool,
    ) {
        let slot = self.ring.len() / (tiling.last() + 1);
        if whole {
            let at = b % (tiling.last() + 1) * slot;
            let out = &mut self.ring[at..at + slot];
            along_x(s, tiling, task, groups, &self.shifts, &self.tiles, out);
        }
        if tiling.whole().1 > 0 && b >= tiling.last() {
            along_x(s, tiling, task, groups, &self.shifts, &self.part, &mut self.ring_part);
        }
    }

    /// Sums of the subsets whose last row of tiles is `b`.
    #[inline(always)]
    pub(crate) fn subsets<S: Simd>(
        &mut self,
        s: S,
        tiling: &Tiling,
        task: &Task,
        groups: &[Group],
        b: usize,
    ) {
        let (q, rem) = tiling.whole();
        let slots = tiling.last() + 1;
        let slot = self.ring.len() / slots;
        let first = b - tiling.last();
        let w = task.width;
        let mut plane = 0;
        for g in groups {
            for _ in 0..g.count {
                for i in 0..=g.degree {
                    let at = std::array::from_fn(|e| (plane + monomial(i, e)) * w);
                    let row = |m: usize| {
                        if m < q {
                            &self.ring[(first + m) % slots * slot..][..slot]
                        } else {
                            &self.ring_part[..]
                        }
                    };
                    let out = &mut self.subsets;
                    let tiles = q + usize::from(rem > 0);
                    macro_rules! line {
                        ($n:literal) => {
                            for k in (0..w).step_by(LANES) {
                                let mut acc = [V::splat(s, 0.0); DEGREES];
                                for m in 0..tiles {
                                    add::<S, $n>(s, &mut acc, &self.shifts[m], row(m), &at, k);
                                }
                                store::<S, $n>(&acc, out, &at, k);
                            }
                        };
                    }
                    match g.degree - i {
                        0 => line!(0),
                        1 => line!(1),
                        2 => line!(2),
                        3 => line!(3),
                        _ => line!(4),
                    }
                }
                plane += moments(g.degree);
            }
        }
    }
}

/// Adds one tile's moments of degree 0..=N, carried to the subset's centre.
#[inline(always)]
fn add<S: Simd, const N: usize>(
    s: S,
    acc: &mut [V<S>; DEGREES],
    c: &[[f32; DEGREES]; DEGREES],
    planes: &[f32],
    at: &[usize; DEGREES],
    k: usize,
) {
    for e in 0..=N {
        let o = at[e] + k;
        let t = V::from_slice(s, &planes[o..o + LANES]);
        acc[e] += t;
        for i in e + 1..=N {
            acc[i] = V::splat(s, c[i][e]).mul_add(t, acc[i]);
        }
    }
}

#[inline(always)]
fn store<S: Simd, const N: usize>(acc: &[V<S>; DEGREES], out: &mut [f32], at: &[usize; DEGREES], k: usize) {
    for e in 0..=N {
        let o = at[e] + k;
        acc[e].store_slice(&mut out[o..o + LANES]);
    }
}

#[inline(always)]
fn along_x<S: Simd>(
    s: S,
    tiling: &Tiling,
    task: &Task,
    groups: &[Group],
    shifts: &[[[f32; DEGREES]; DEGREES]],
    tiles: &[f32],
    out: &mut [f32],
) {
    let (q, rem) = tiling.whole();
    let (whole, part) = tiles.split_at(tiles.len() / 2);
    let mut plane = 0;
    for g in groups {
        for _ in 0..g.count {
            for j in 0..=g.degree {
                let from = std::array::from_fn(|e| (plane + monomial(e, j)) * task.tiles);
                let to = std::array::from_fn(|e| (plane + monomial(e, j)) * task.width);
                macro_rules! line {
                    ($n:literal) => {
                        for k in (0..task.width).step_by(LANES) {
                            let mut acc = [V::splat(s, 0.0); DEGREES];
                            for m in 0..q {
                                add::<S, $n>(s, &mut acc, &shifts[m], whole, &from, k + m);
                            }
                            if rem > 0 {
                                add::<S, $n>(s, &mut acc, &shifts[q], part, &from, k + q);
                            }
                            store::<S, $n>(&acc, out, &to, k);
                        }
                    };
                }
                match g.degree - j {
                    0 => line!(0),
                    1 => line!(1),
                    2 => line!(2),
                    3 => line!(3),
                    _ => line!(4),
                }
            }
            plane += moments(g.degree);
        }
    }
}

/// Adds the sums over one row of pixels, x-powers in `acc`, to the planes of one quantity.
#[inline(always)]
pub(crate) fn flush<S: Simd, const D: usize>(
    s: S,
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
            let old = V::from_slice(s, p);
            let new = if j == 0 { old + acc[i] } else { V::splat(s, y[j]).mul_add(acc[i], old) };
            new.store_slice(p);
        }
    }
}
