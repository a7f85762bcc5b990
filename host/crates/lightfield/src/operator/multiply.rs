//! Products of the stored blocks with spectra.

use super::blocks::{Blocks, Table};
use super::engine::{Engine, Port};
use super::gemm::{Element, VECTORS};
use crate::simd::{Kernel as Work, LANES, V, transposed};
use fearless_simd::prelude::*;

/// Spectra that one product takes: two vectors each.
const JOBS: usize = VECTORS / 2;

#[inline(always)]
fn part<S: Simd>(s: S, values: &[f32], at: usize) -> V<S> {
    V::from_slice(s, &values[at..at + LANES])
}

impl Table {
    /// Lanes of a spectrum [re|im][channel], whose channels are in the block's order, as vectors of the block.
    #[inline(always)]
    fn apply<S: Simd>(&self, s: S, from: &[f32], at: usize, sign: V<S>) -> [V<S>; 2] {
        let (re, im) = (part(s, from, at), part(s, from, from.len() / 2 + at));
        let [a, b] = [part(s, &self.turn[0], at), part(s, &self.turn[1], at)];
        // of a and b one is zero, the other ±1: nothing is rounded
        [a.mul_add(re, b * im), sign * a.mul_sub(im, b * re)]
    }

    /// A spectrum's channels in the block's order, in `turned` if they have to be moved.
    #[inline(always)]
    fn ordered<'a, S: Simd>(&self, s: S, from: &'a [f32], turned: &'a mut [f32]) -> &'a [f32] {
        let Some(list) = &self.from else { return from };
        let c = from.len() / 2;
        let (re, im) = turned.split_at_mut(c);
        let (from_re, from_im) = from.split_at(c);
        let channels = list.len() * self.run;
        re[channels..].fill(0.0);
        im[channels..].fill(0.0);
        if self.run == 1 {
            for ((re, im), &at) in re.iter_mut().zip(im).zip(list) {
                (*re, *im) = (from_re[at as usize], from_im[at as usize]);
            }
            return turned;
        }
        for ((re, im), &at) in re.chunks_exact_mut(self.run).zip(im.chunks_exact_mut(self.run)).zip(list) {
            let at = at as usize..at as usize + self.run;
            copy(s, &from_re[at.clone()], re);
            copy(s, &from_im[at], im);
        }
        turned
    }

    /// The way back, times `scale`. `turned`: as long.
    #[inline(always)]
    pub(super) fn undo<S: Simd>(&self, s: S, from: &[f32], to: &mut [f32], turned: &mut [f32], scale: f32) {
        let c = from.len() / 2;
        let moved = self.from.is_some();
        let turned = &mut turned[..2 * c];
        let (re, im) = if moved { &mut *turned } else { &mut *to }.split_at_mut(c);
        let (f, g) = (V::splat(s, scale), V::splat(s, scale * self.sign));
        for at in (0..c).step_by(LANES) {
            let (u, v) = (part(s, from, at) * f, part(s, from, c + at) * g);
            let [a, b] = [part(s, &self.turn[0], at), part(s, &self.turn[1], at)];
            a.mul_sub(u, b * v).store_slice(&mut re[at..at + LANES]);
            a.mul_add(v, b * u).store_slice(&mut im[at..at + LANES]);
        }
        let Some(list) = &self.from else { return };
        let (re, im) = turned.split_at(c);
        let (to_re, to_im) = to.split_at_mut(c);
        // the padding is zero
        let channels = list.len() * self.run;
        to_re[channels..].fill(0.0);
        to_im[channels..].fill(0.0);
        if self.run == 1 {
            for ((re, im), &at) in re.iter().zip(im).zip(list) {
                (to_re[at as usize], to_im[at as usize]) = (*re, *im);
            }
            return;
        }
        for ((re, im), &at) in re.chunks_exact(self.run).zip(im.chunks_exact(self.run)).zip(list) {
            let at = at as usize..at as usize + self.run;
            copy(s, re, &mut to_re[at.clone()]);
            copy(s, im, &mut to_im[at]);
        }
    }
}

/// Copies a few numbers, which a call would take longer for.
#[inline(always)]
fn copy<S: Simd>(s: S, from: &[f32], to: &mut [f32]) {
    let n = from.len();
    if n < LANES {
        to.iter_mut().zip(from).for_each(|(t, f)| *t = *f);
        return;
    }
    for (from, to) in from.as_chunks::<LANES>().0.iter().zip(to.as_chunks_mut::<LANES>().0) {
        V::from_slice(s, from).store_slice(to);
    }
    // overlaps what was copied before
    part(s, from, n - LANES).store_slice(&mut to[n - LANES..n]);
}

/// Vectors of a block, in and out.
#[derive(Default)]
pub(super) struct BlockScratch {
    /// [spectrum][re|im][channel].
    turned: Vec<f32>,
    x: Vec<f32>,
    y: Vec<f32>,
}

/// Products of a run of orbits with the spectra of all frames.
pub(super) struct Multiply<'a, 'b, T> {
    pub(super) engine: &'a Engine,
    pub(super) blocks: &'a Blocks<T>,
    pub(super) from: &'a Port,
    pub(super) to: &'a Port,
    pub(super) adjoint: bool,
    /// Of each frame.
    pub(super) planes: &'a [&'b [f32]],
    /// The first orbit.
    pub(super) first: usize,
    /// Where the products of each orbit go: of all members, frame by frame.
    pub(super) parts: &'a mut [Vec<&'b mut [f32]>],
    pub(super) scratch: &'a mut BlockScratch,
}

impl<T: Element> Work for Multiply<'_, '_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, blocks, from, to, adjoint, planes, first, parts, scratch } = self;
        let block = &blocks.block;
        let (c, c_to) = (from.side.padded, to.side.padded);
        let tall = block.padded_rows();
        let BlockScratch { turned, x, y } = scratch;
        let most = VECTORS * tall.max(block.columns.next_multiple_of(LANES));
        turned.resize((VECTORS * c).max(2 * c_to), 0.0);
        x.resize(most, 0.0);
        y.resize(most, 0.0);
        for (i, products) in parts.iter_mut().enumerate() {
            let members = &engine.orbits.orbits[first + i].members;
            let a = &blocks.data[(first + i) * block.len()..][..block.len()];
            let jobs = planes.len() * members.len();
            for begin in (0..jobs).step_by(JOBS) {
                let count = JOBS.min(jobs - begin);
                // (frame, member)
                let job = |j: usize| ((begin + j) / members.len(), (begin + j) % members.len());
                let mut spectra: [&[f32]; JOBS] = [&[]; JOBS];
                let mut tables = [&from.tables[0]; JOBS];
                for (j, turned) in turned.chunks_exact_mut(2 * c).enumerate().take(count) {
                    let (f, m) = job(j);
                    let at = (members[m].kx * engine.grid[0] + members[m].ky) * 2 * c;
                    tables[j] = &from.tables[members[m].step];
                    spectra[j] = tables[j].ordered(s, &planes[f][at..at + 2 * c], turned);
                }
                let signs = tables.map(|t| V::splat(s, t.sign));
                let (upper, lower) = x.split_at_mut(VECTORS * c);
                for channel in (0..c).step_by(LANES) {
                    let mut rows = [V::splat(s, 0.0); VECTORS];
                    for j in 0..count {
                        let [re, im] = tables[j].apply(s, spectra[j], channel, signs[j]);
                        (rows[2 * j], rows[2 * j + 1]) = (re, im);
                    }
                    store(s, rows, &mut upper[channel * VECTORS..]);
                    if adjoint && !blocks.real {
                        // above (re, im), below (im, −re): the products' parts come out added up
                        for pair in rows.as_chunks_mut::<2>().0 {
                            *pair = [pair[1], -pair[0]];
                        }
                        store(s, rows, &mut lower[channel * VECTORS..]);
                    }
                }
                if adjoint {
                    block.multiply_transposed(s, a, x, y);
                } else {
                    block.multiply(s, a, x, y, 2 * count);
                }
                if adjoint {
                    for channel in (0..c_to).step_by(LANES) {
                        let mut rows = [V::splat(s, 0.0); VECTORS];
                        for (r, row) in rows.iter_mut().enumerate() {
                            *row = part(s, y, (channel + r) * VECTORS);
                        }
                        let rows = transposed(s, rows);
                        for (v, row) in rows.iter().enumerate().take(2 * count) {
                            row.store_slice(&mut x[v * c_to + channel..][..LANES]);
                        }
                    }
                }
                for j in 0..count {
                    let out = &mut products[begin + j];
                    let table = &to.tables[members[job(j).1].step];
                    if adjoint {
                        table.undo(s, &x[2 * j * c_to..][..2 * c_to], out, turned, blocks.scale);
                        continue;
                    }
                    let y = &mut y[2 * j * tall..][..2 * tall];
                    if !blocks.real {
                        let (u, v) = y.split_at_mut(tall);
                        for n in 0..c_to {
                            (u[n], u[c_to + n]) = (u[n] - v[c_to + n], u[c_to + n] + v[n]);
                        }
                    }
                    table.undo(s, &y[..2 * c_to], out, turned, blocks.scale);
                }
            }
        }
    }
}

/// Eight vectors' lanes, channel by channel.
#[inline(always)]
fn store<S: Simd>(s: S, rows: [V<S>; VECTORS], to: &mut [f32]) {
    for (row, to) in transposed(s, rows).iter().zip(to.as_chunks_mut::<VECTORS>().0) {
        row.store_slice(to);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::operator::basis::Cell;
    use crate::operator::blocks::{Orbits, Reduction};
    use crate::simd::{levels, run};

    struct ThereAndBack<'a>(&'a Table, &'a [f32], usize);

    impl Work for ThereAndBack<'_> {
        /// The vector, and what it becomes again, times 2.
        type Output = [Vec<f32>; 2];

        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> Self::Output {
            let Self(table, spectrum, c) = self;
            let (mut vector, mut back) = (vec![0f32; 2 * c], vec![f32::NAN; 2 * c]);
            let mut turned = vec![9f32; 2 * c];
            let ordered = table.ordered(s, spectrum, &mut turned).to_vec();
            for at in (0..c).step_by(LANES) {
                let [re, im] = table.apply(s, &ordered, at, V::splat(s, table.sign));
                re.store_slice(&mut vector[at..at + LANES]);
                im.store_slice(&mut vector[c + at..c + at + LANES]);
            }
            table.undo(s, &vector, &mut back, &mut turned, 2.0);
            [vector, back]
        }
    }

    /// Spectra become vectors and spectra again, nothing rounded, the padding zero; no step but the first is
    /// the same as another.
    #[test]
    fn steps_are_undone() {
        let reductions = [
            (Reduction::Complex, false),
            (Reduction::ComplexMirrorX, false),
            (Reduction::ComplexMirrorY, false),
            (Reduction::Real, true),
            (Reduction::RealMirrors, true),
            (Reduction::RealSquare, true),
        ];
        for (reduction, real) in reductions {
            for (n, inner) in [(3, 17), (4, 2), (5, 1), (2, 9), (3, 1), (15, 1)] {
                let cell = Cell { n: [n, n], inner };
                let c = cell.channels().next_multiple_of(LANES);
                let mut spectrum: Vec<f32> = (0..2 * c).map(|i| (i as f32 * 0.9).sin()).collect();
                for part in spectrum.chunks_exact_mut(c) {
                    part[cell.channels()..].fill(0.0);
                }
                let mut seen: Vec<Vec<f32>> = Vec::new();
                let twice: Vec<f32> = spectrum.iter().map(|v| 2.0 * v).collect();
                for table in Orbits::new([12, 12], reduction).tables(&cell, c, real) {
                    let mut vector = Vec::new();
                    for level in levels() {
                        let back;
                        [vector, back] = run(level, ThereAndBack(&table, &spectrum, c));
                        assert_eq!(back, twice, "{level:?} {reduction:?} {cell:?}");
                    }
                    assert!(!seen.contains(&vector), "{reduction:?} {cell:?}");
                    seen.push(vector);
                }
            }
        }
    }
}
