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
        self.part.resize(2 * planes * task.tiles, 0.0);
        self.ring.resize((q + usize::from(rem > 0)) * planes * task.width, 0.0);
        self.subsets.resize(planes * task.width, 0.0);
        self.shifts.clear();
        self.shifts.extend((0..=tiling.last()).map(|m| tiling.shift(m)));
        self.turned.clone_from(&self.shifts);
    }

    /// Begins a row of tiles.
    pub(crate) fn begin(&mut self) {
        self.tiles.fill(0.0);
    }

    /// Keeps what the first `rem` rows of the tiles have given.
    pub(crate) fn keep_part(&mut self) {
        self.part.copy_from_slice(&self.tiles);
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
        if rem > 0 && full {
            let out = &mut self.ring[q * slot..];
            along_x(s, tiling, task, groups, &self.shifts, &self.part, out);
            self.down(s, tiling, task, groups, b);
        }
        if whole {
            let at = b % q * slot;
            along_x(s, tiling, task, groups, &self.shifts, &self.tiles, &mut self.ring[at..at + slot]);
        }
        if rem == 0 && full {
            self.down(s, tiling, task, groups, b);
        }
        full
    }

    /// Sums of the subsets whose last row of tiles is `b`.
    #[inline(always)]
    fn down<S: Simd>(&mut self, s: S, tiling: &Tiling, task: &Task, groups: &[Group], b: usize) {
        let q = tiling.whole().0;
        let first = b - tiling.last();
        for m in 0..q {
            self.turned[(first + m) % q] = self.shifts[m];
        }
        let (w, slot) = (task.width, self.subsets.len());
        let mut plane = 0;
        for g in groups {
            for _ in 0..g.count {
                for i in 0..=g.degree {
                    let at: [usize; DEGREES] = std::array::from_fn(|e| (plane + monomial(i, e)) * w);
                    macro_rules! line {
                        ($n:literal) => {
                            for k in (0..w).step_by(LANES) {
                                let mut acc = [V::splat(s, 0.0); DEGREES];
                                for (row, c) in self.ring.chunks_exact(slot).zip(&self.turned) {
                                    for e in 0..=$n {
                                        let t = V::from_slice(s, &row[at[e] + k..at[e] + k + LANES]);
                                        add::<S, $n>(s, &mut acc, c, e, t);
                                    }
                                }
                                store::<S, $n>(&acc, &mut self.subsets, &at, k);
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

/// Adds the moment of degree `e` of one tile to those of degree e..=N of the subset.
#[inline(always)]
fn add<S: Simd, const N: usize>(s: S, acc: &mut [V<S>; DEGREES], c: &Shift, e: usize, t: V<S>) {
    acc[e] += t;
    for i in e + 1..=N {
        acc[i] = V::splat(s, c[i][e]).mul_add(t, acc[i]);
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
    shifts: &[Shift],
    tiles: &[f32],
    out: &mut [f32],
) {
    let (q, rem) = tiling.whole();
    let (whole, part) = tiles.split_at(tiles.len() / 2);
    let mut plane = 0;
    for g in groups {
        for _ in 0..g.count {
            for j in 0..=g.degree {
                let from: [usize; DEGREES] = std::array::from_fn(|e| (plane + monomial(e, j)) * task.tiles);
                let to: [usize; DEGREES] = std::array::from_fn(|e| (plane + monomial(e, j)) * task.width);
                macro_rules! line {
                    ($n:literal) => {
                        for k in (0..task.width).step_by(LANES) {
                            let mut acc = [V::splat(s, 0.0); DEGREES];
                            for e in 0..=$n {
                                let row = &whole[from[e] + k..from[e] + k + q - 1 + LANES];
                                for (t, c) in row.windows(LANES).zip(shifts) {
                                    add::<S, $n>(s, &mut acc, c, e, V::from_slice(s, t));
                                }
                                if rem > 0 {
                                    let t = &part[from[e] + k + q..from[e] + k + q + LANES];
                                    add::<S, $n>(s, &mut acc, &shifts[q], e, V::from_slice(s, t));
                                }
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
