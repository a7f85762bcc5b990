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

/// (a re + b im, c re + d im) f
#[inline(always)]
fn rotate<S: Simd>(s: S, [a, b, c, d]: [&[f32]; 4], from: &[f32], to: &mut [f32], f: f32) {
    let f = V::splat(s, f);
    let (from_re, from_im) = from.split_at(from.len() / 2);
    let (to_re, to_im) = to.split_at_mut(to.len() / 2);
    for at in (0..to_re.len()).step_by(LANES) {
        let (re, im) = (part(s, from_re, at) * f, part(s, from_im, at) * f);
        // of each pair of factors one is zero: nothing is rounded
        part(s, a, at).mul_add(re, part(s, b, at) * im).store_slice(&mut to_re[at..at + LANES]);
        part(s, c, at).mul_add(re, part(s, d, at) * im).store_slice(&mut to_im[at..at + LANES]);
    }
}

impl Table {
    /// A spectrum [re|im][channel] as a vector of the block. `turned`: as long.
    #[inline(always)]
    fn apply<S: Simd>(&self, s: S, from: &[f32], to: &mut [f32], turned: &mut [f32]) {
        let c = from.len() / 2;
        let [rr, ri, ir, ii] = &self.mix;
        let mix = [&**rr, &**ri, &**ir, &**ii];
        let Some(list) = &self.from else { return rotate(s, mix, from, to, 1.0) };
        let (re, im) = turned.split_at_mut(c);
        let (from_re, from_im) = from.split_at(c);
        for ((re, im), &at) in re.iter_mut().zip(im).zip(list) {
            (*re, *im) = (from_re[at as usize], from_im[at as usize]);
        }
        rotate(s, mix, turned, to, 1.0);
    }

    /// The way back, times `scale`.
    #[inline(always)]
    pub(super) fn undo<S: Simd>(&self, s: S, from: &[f32], to: &mut [f32], turned: &mut [f32], scale: f32) {
        let c = from.len() / 2;
        let [rr, ri, ir, ii] = &self.mix;
        let mix = [&**rr, &**ir, &**ri, &**ii];
        let Some(list) = &self.from else { return rotate(s, mix, from, to, scale) };
        rotate(s, mix, from, turned, scale);
        let (re, im) = turned.split_at(c);
        let (to_re, to_im) = to.split_at_mut(c);
        for ((re, im), &at) in re.iter().zip(im).zip(list) {
            (to_re[at as usize], to_im[at as usize]) = (*re, *im);
        }
    }
}

/// Vectors of a block, in and out.
#[derive(Default)]
pub(super) struct BlockScratch {
    /// [vector][channel]: re and im of one spectrum after the other.
    vectors: Vec<f32>,
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
    /// Products of each orbit and frame.
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
        let BlockScratch { vectors, turned, x, y } = scratch;
        let most = VECTORS * tall.max(block.columns.next_multiple_of(LANES));
        vectors.resize(VECTORS * c, 0.0);
        turned.resize(2 * c, 0.0);
        x.resize(most, 0.0);
        y.resize(most, 0.0);
        for (i, part) in parts.iter_mut().enumerate() {
            let members = &engine.orbits.orbits[first + i].members;
            let a = &blocks.data[(first + i) * block.len()..][..block.len()];
            let jobs = planes.len() * members.len();
            for begin in (0..jobs).step_by(JOBS) {
                let count = JOBS.min(jobs - begin);
                // (frame, member)
                let job = |j: usize| ((begin + j) / members.len(), (begin + j) % members.len());
                for (j, to) in vectors.chunks_exact_mut(2 * c).enumerate() {
                    if j >= count {
                        to.fill(0.0);
                        continue;
                    }
                    let (f, m) = job(j);
                    let at = (members[m].kx * engine.grid[0] + members[m].ky) * 2 * c;
                    from.tables[members[m].step].apply(s, &planes[f][at..at + 2 * c], to, turned);
                }
                let (upper, lower) = x.split_at_mut(VECTORS * c);
                for channel in (0..c).step_by(LANES) {
                    let mut rows = [V::splat(s, 0.0); VECTORS];
                    for (v, row) in rows.iter_mut().enumerate() {
                        *row = V::from_slice(s, &vectors[v * c + channel..][..LANES]);
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
                            *row = V::from_slice(s, &y[(channel + r) * VECTORS..][..LANES]);
                        }
                        let rows = transposed(s, rows);
                        for j in 0..count {
                            let (f, m) = job(j);
                            let out = &mut part[f][m * 2 * c_to + channel..];
                            rows[2 * j].store_slice(&mut out[..LANES]);
                            rows[2 * j + 1].store_slice(&mut out[c_to..c_to + LANES]);
                        }
                    }
                    continue;
                }
                for j in 0..count {
                    let (f, m) = job(j);
                    let out = &mut part[f][m * 2 * c_to..][..2 * c_to];
                    let y = &y[2 * j * tall..][..2 * tall];
                    if blocks.real {
                        out.copy_from_slice(y);
                        continue;
                    }
                    let (re, im) = out.split_at_mut(c_to);
                    let (u, v) = y.split_at(tall);
                    for n in 0..c_to {
                        re[n] = u[n] - v[c_to + n];
                        im[n] = u[c_to + n] + v[n];
                    }
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
