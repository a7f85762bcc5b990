//! Projections in the form in which they are computed: channels innermost, rows of cells in parallel.
//!
//! One direction is: rows of cells → transform along x → along y → blocks → back along y → rows. The steps of
//! an iteration that work on pixels or voxels are done while a row is in the cache ([`Engine::turn`]). Every
//! number is computed by one task in one order: results do not depend on the number of threads.

use super::basis::Cell;
use super::blocks::{Blocks, Orbits, Table};
use super::fft::{C, Plan, result};
use super::gemm::{Element, VECTORS};
use crate::simd::{Kernel as Work, LANES, V, run};
use fearless_simd::prelude::*;
use rayon::prelude::*;

/// i modulo n for i below 2 n; a division would cost as much as the transform.
#[inline(always)]
fn wrapped(i: usize, n: usize) -> usize {
    if i >= n { i - n } else { i }
}

#[inline(always)]
fn part<S: Simd>(s: S, values: &[f32], at: usize) -> V<S> {
    V::from_slice(s, &values[at..at + LANES])
}

/// Volume or sensor.
#[derive(Debug, Clone)]
pub(crate) struct Side {
    pub(crate) cell: Cell,
    /// Channels, a multiple of the lanes.
    pub(crate) padded: usize,
    /// Cells (y, x).
    pub(crate) cells: [usize; 2],
    /// Grid position of the first cell, modulo the grid.
    pub(crate) origin: [usize; 2],
}

impl Side {
    pub(crate) fn new(cell: Cell, cells: [usize; 2], origin: isize, grid: [usize; 2]) -> Self {
        let origin = grid.map(|p| origin.rem_euclid(p as isize) as usize);
        Self { cell, padded: cell.channels().next_multiple_of(LANES), cells, origin }
    }

    /// Numbers of a row of cells.
    pub(crate) fn row(&self) -> usize {
        self.cells[1] * self.padded
    }

    /// Numbers of all cells.
    pub(crate) fn len(&self) -> usize {
        self.cells[0] * self.row()
    }

    /// The cell at grid position `g` of an axis, if there is one.
    #[inline(always)]
    fn cell_at(&self, axis: usize, g: usize, grid: usize) -> Option<usize> {
        let i = wrapped(g + grid - self.origin[axis], grid);
        (i < self.cells[axis]).then_some(i)
    }
}

/// Spectra of one frame on the way through.
#[derive(Default)]
pub(crate) struct Spectra {
    /// Transforms of rows, [row][kx][re|im][channel].
    pub(crate) rows: Vec<f32>,
    /// [kx][ky][re|im][channel].
    plane: Vec<f32>,
    /// Products, [orbit][member][re|im][channel].
    products: Vec<f32>,
    /// Back along y, [kx][row][re|im][channel].
    columns: Vec<f32>,
}

/// Work on a row of cells: (row, its numbers, its part of the state).
type RowWork<'a> = dyn Fn(usize, &mut [f32], &mut [f32]) + Sync + 'a;

/// Everything but the blocks.
pub(crate) struct Engine {
    pub(crate) grid: [usize; 2],
    plans: [Plan; 2],
    pub(crate) real: bool,
    pub(crate) orbits: Orbits,
    level: fearless_simd::Level,
}

/// A side with the tables of its orbits.
pub(crate) struct Port {
    pub(crate) side: Side,
    pub(crate) tables: Vec<Table>,
}

impl Engine {
    pub(crate) fn new(grid: [usize; 2], real: bool, orbits: Orbits) -> Self {
        Self { grid, plans: grid.map(Plan::new), real, orbits, level: fearless_simd::Level::new() }
    }

    fn half(&self) -> usize {
        self.grid[1] / 2 + 1
    }

    pub(crate) fn port(&self, side: Side) -> Port {
        let tables = self.orbits.tables(&side.cell, side.padded, self.real);
        Port { side, tables }
    }

    /// Numbers that the spectra of one frame take.
    pub(crate) fn spectra_len(&self, a: &Side, b: &Side) -> usize {
        let (most, tall) = (a.padded.max(b.padded), a.cells[0].max(b.cells[0]));
        2 * most * (self.half() * (2 * tall + self.grid[0]) + self.orbits.orbits.len() * self.orbits.slots)
    }

    /// Rows of cells: what comes back from the spectrum (`columns`, if given) is handed to `work` with the
    /// row's number and its part of `state`; what `work` leaves in it is transformed into `rows`, if wanted.
    pub(crate) fn turn(
        &self,
        side: &Side,
        spectra: &mut Spectra,
        back: bool,
        forth: bool,
        state: &mut [f32],
        work: &RowWork<'_>,
    ) {
        let row = side.row();
        let spectrum = self.half() * 2 * side.padded;
        if forth {
            // every number that is read later is written first
            spectra.rows.resize(side.cells[0] * spectrum, 0.0);
        }
        let Spectra { rows, columns, .. } = spectra;
        let columns: &[f32] = if back { columns } else { &[] };
        let task = |pair: usize, rows: &mut [f32], state: &mut [f32], values: &mut Vec<f32>| {
            let first = 2 * pair;
            let count = (side.cells[0] - first).min(2);
            values.resize(2 * row, 0.0);
            if back {
                run(self.level, RowBack { engine: self, side, columns, values, first, count });
                if self.real {
                    butterflies(self.level, side, values);
                }
            }
            for i in 0..count {
                let own = state.get_mut(i * row..(i + 1) * row).unwrap_or_default();
                work(first + i, &mut values[i * row..(i + 1) * row], own);
            }
            if forth {
                if self.real {
                    butterflies(self.level, side, values);
                }
                run(self.level, RowForth { engine: self, side, values, rows, count });
            }
        };
        let pairs = side.cells[0].div_ceil(2);
        // parallel over pairs of rows; what is not wanted is an empty slice
        let mut row_parts: Vec<&mut [f32]> = if forth {
            rows.chunks_mut(2 * spectrum).take(pairs).collect()
        } else {
            (0..pairs).map(|_| Default::default()).collect()
        };
        let mut state_parts: Vec<&mut [f32]> = if state.is_empty() {
            (0..pairs).map(|_| Default::default()).collect()
        } else {
            state.chunks_mut(2 * row).collect()
        };
        row_parts
            .par_iter_mut()
            .zip(state_parts.par_iter_mut())
            .enumerate()
            .for_each_init(Vec::new, |values, (pair, (rows, state))| task(pair, rows, state, values));
    }

    /// From the transformed rows of `from` to the columns of `to`, for several frames; `adjoint` applies the
    /// blocks' transposes, from the rows of the blocks to their columns.
    pub(crate) fn apply<T: Element>(
        &self,
        blocks: &Blocks<T>,
        from: &Port,
        to: &Port,
        adjoint: bool,
        frames: &mut [Spectra],
    ) {
        let (half, py) = (self.half(), self.grid[0]);
        let (wide, wide_to) = (2 * from.side.padded, 2 * to.side.padded);
        for f in frames.iter_mut() {
            f.plane.resize(half * py * wide, 0.0);
            let Spectra { rows, plane, .. } = f;
            let rows: &[f32] = rows;
            plane.par_chunks_mut(py * wide).enumerate().for_each_init(Vec::new, |scratch, (kx, out)| {
                run(self.level, ColumnForth { engine: self, side: &from.side, rows, out, kx, scratch });
            });
        }
        let slot = self.orbits.slots * wide_to;
        let count = self.orbits.orbits.len();
        for f in frames.iter_mut() {
            f.products.resize(count * slot, 0.0);
        }
        let (planes, mut products): (Vec<&[f32]>, Vec<_>) = frames
            .iter_mut()
            .map(|Spectra { plane, products, .. }| (&**plane, products.chunks_mut(slot)))
            .unzip();
        // products of an orbit, of all frames
        let mut parts: Vec<Vec<&mut [f32]>> =
            (0..count).map(|_| products.iter_mut().filter_map(|p| p.next()).collect()).collect();
        let chunk = count.div_ceil(64).max(1);
        parts.par_chunks_mut(chunk).enumerate().for_each_init(
            BlockScratch::default,
            |scratch, (c, parts)| {
                let first = c * chunk;
                run(
                    self.level,
                    Multiply {
                        engine: self,
                        blocks,
                        from,
                        to,
                        adjoint,
                        planes: &planes,
                        first,
                        parts,
                        scratch,
                    },
                );
            },
        );
        for f in frames.iter_mut() {
            let rows = to.side.cells[0];
            f.columns.resize(half * rows * wide_to, 0.0);
            let Spectra { products, columns, .. } = f;
            let products: &[f32] = products;
            columns.par_chunks_mut(rows * wide_to).enumerate().for_each_init(
                Vec::new,
                |scratch, (kx, out)| {
                    run(
                        self.level,
                        ColumnBack {
                            engine: self,
                            port: to,
                            products,
                            out,
                            kx,
                            scratch,
                            scale: blocks.scale,
                        },
                    );
                },
            );
        }
    }
}

struct Butterflies<'a> {
    side: &'a Side,
    values: &'a mut [f32],
}

impl Work for Butterflies<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for cell in self.values.chunks_exact_mut(self.side.padded) {
            self.side.cell.butterfly(cell);
        }
    }
}

fn butterflies(level: fearless_simd::Level, side: &Side, values: &mut [f32]) {
    run(level, Butterflies { side, values });
}

/// Two real rows of cells as one complex row, transformed along x.
struct RowForth<'a> {
    engine: &'a Engine,
    side: &'a Side,
    values: &'a [f32],
    rows: &'a mut [f32],
    count: usize,
}

impl Work for RowForth<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, side, values, rows, count } = self;
        let (plan, c, n) = (&engine.plans[1], side.padded, engine.grid[1]);
        let (first, second) = values.split_at(side.row());
        let mut scratch = vec![0f32; plan.scratch()];
        let half = V::splat(s, 0.5);
        let half_row = engine.half() * 2 * c;
        for channel in (0..c).step_by(LANES) {
            plan.run::<S, false>(
                s,
                &mut scratch,
                #[inline(always)]
                |g| match side.cell_at(1, g, n) {
                    Some(x) => {
                        let at = x * c + channel;
                        let im = if count > 1 { part(s, second, at) } else { V::splat(s, 0.0) };
                        C { re: part(s, first, at), im }
                    }
                    None => C::zero(s),
                },
            );
            for k in 0..engine.half() {
                let (a, b) = (result(s, &scratch, k), result(s, &scratch, wrapped(n - k, n)));
                let at = k * 2 * c + channel;
                ((a.re + b.re) * half).store_slice(&mut rows[at..at + LANES]);
                ((a.im - b.im) * half).store_slice(&mut rows[at + c..at + c + LANES]);
                if count > 1 {
                    let at = at + half_row;
                    ((a.im + b.im) * half).store_slice(&mut rows[at..at + LANES]);
                    ((b.re - a.re) * half).store_slice(&mut rows[at + c..at + c + LANES]);
                }
            }
        }
    }
}

/// Two rows back from the spectrum.
struct RowBack<'a> {
    engine: &'a Engine,
    side: &'a Side,
    columns: &'a [f32],
    values: &'a mut [f32],
    first: usize,
    count: usize,
}

impl Work for RowBack<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, side, columns, values, first, count } = self;
        let (plan, c, n) = (&engine.plans[1], side.padded, engine.grid[1]);
        let column = side.cells[0] * 2 * c;
        let (one, two) = values.split_at_mut(side.row());
        let mut scratch = vec![0f32; plan.scratch()];
        let zero = V::splat(s, 0.0);
        for channel in (0..c).step_by(LANES) {
            plan.run::<S, true>(
                s,
                &mut scratch,
                #[inline(always)]
                |g| {
                    let mirrored = g > n / 2;
                    let k = if mirrored { n - g } else { g };
                    let at = k * column + first * 2 * c + channel;
                    let (a, mut b) = (part(s, columns, at), part(s, columns, at + c));
                    let (mut p, mut q) = (zero, zero);
                    if count > 1 {
                        p = part(s, columns, at + 2 * c);
                        q = part(s, columns, at + 3 * c);
                    }
                    if mirrored {
                        b = -b;
                        q = -q;
                    } else if k == 0 || 2 * k == n {
                        // real rows have real coefficients here
                        b = zero;
                        q = zero;
                    }
                    C { re: a - q, im: b + p }
                },
            );
            for x in 0..side.cells[1] {
                let v = result(s, &scratch, wrapped(x + side.origin[1], n));
                let at = x * c + channel;
                v.re.store_slice(&mut one[at..at + LANES]);
                v.im.store_slice(&mut two[at..at + LANES]);
            }
        }
    }
}

/// One frequency k_x along y.
struct ColumnForth<'a> {
    engine: &'a Engine,
    side: &'a Side,
    rows: &'a [f32],
    out: &'a mut [f32],
    kx: usize,
    scratch: &'a mut Vec<f32>,
}

impl Work for ColumnForth<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, side, rows, out, kx, scratch } = self;
        let (plan, c, n) = (&engine.plans[0], side.padded, engine.grid[0]);
        let row = engine.half() * 2 * c;
        scratch.resize(plan.scratch(), 0.0);
        for channel in (0..c).step_by(LANES) {
            plan.run::<S, false>(
                s,
                scratch,
                #[inline(always)]
                |g| match side.cell_at(0, g, n) {
                    Some(y) => {
                        let at = y * row + kx * 2 * c + channel;
                        C { re: part(s, rows, at), im: part(s, rows, at + c) }
                    }
                    None => C::zero(s),
                },
            );
            for k in 0..n {
                let v = result(s, scratch, k);
                let at = k * 2 * c + channel;
                v.re.store_slice(&mut out[at..at + LANES]);
                v.im.store_slice(&mut out[at + c..at + c + LANES]);
            }
        }
    }
}

/// One frequency k_x back along y, from the products of the orbits.
struct ColumnBack<'a> {
    engine: &'a Engine,
    port: &'a Port,
    products: &'a [f32],
    out: &'a mut [f32],
    kx: usize,
    scratch: &'a mut Vec<f32>,
    scale: f32,
}

impl Work for ColumnBack<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, port, products, out, kx, scratch, scale } = self;
        let side = &port.side;
        let (plan, c, n) = (&engine.plans[0], side.padded, engine.grid[0]);
        let wide = 2 * c;
        scratch.resize(plan.scratch() + n * wide, 0.0);
        let (scratch, column) = scratch.split_at_mut(plan.scratch());
        for ky in 0..n {
            let (orbit, member) = engine.orbits.place[kx * n + ky];
            let step = engine.orbits.orbits[orbit as usize].members[member as usize].step;
            let table = &port.tables[step];
            let from = &products[(orbit as usize * engine.orbits.slots + member as usize) * wide..][..wide];
            let to = &mut column[ky * wide..][..wide];
            let (re, im) = from.split_at(c);
            for (((place, sign), re), im) in table.from.iter().zip(&table.sign).zip(re).zip(im) {
                to[place[0] as usize] = scale * sign[0] * re;
                to[place[1] as usize] = scale * sign[1] * im;
            }
        }
        for channel in (0..c).step_by(LANES) {
            plan.run::<S, true>(
                s,
                scratch,
                #[inline(always)]
                |k| {
                    let at = k * wide + channel;
                    C { re: part(s, column, at), im: part(s, column, at + c) }
                },
            );
            for y in 0..side.cells[0] {
                let v = result(s, scratch, wrapped(y + side.origin[0], n));
                let at = y * wide + channel;
                v.re.store_slice(&mut out[at..at + LANES]);
                v.im.store_slice(&mut out[at + c..at + c + LANES]);
            }
        }
    }
}

/// Vectors of a block, in and out, and a decoded panel.
#[derive(Default)]
struct BlockScratch {
    x: Vec<f32>,
    y: Vec<f32>,
    panel: Vec<f32>,
}

/// Products of a run of orbits with the spectra of all frames.
struct Multiply<'a, 'b, T> {
    engine: &'a Engine,
    blocks: &'a Blocks<T>,
    from: &'a Port,
    to: &'a Port,
    adjoint: bool,
    planes: &'a [&'b [f32]],
    first: usize,
    parts: &'a mut [Vec<&'b mut [f32]>],
    scratch: &'a mut BlockScratch,
}

impl<T: Element> Work for Multiply<'_, '_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { engine, blocks, from, to, adjoint, planes, first, parts, scratch } = self;
        let block = &blocks.block;
        let (channels, wide) = (from.side.cell.channels(), 2 * from.side.padded);
        let (channels_to, padded_to) = (to.side.cell.channels(), to.side.padded);
        let BlockScratch { x, y, panel } = scratch;
        let tall = block.padded_rows();
        x.resize(VECTORS * tall.max(block.columns), 0.0);
        y.resize(VECTORS * tall.max(block.columns), 0.0);
        panel.resize(block.panel(), 0.0);
        for (i, part) in parts.iter_mut().enumerate() {
            let orbit = &engine.orbits.orbits[first + i];
            let a = &blocks.data[(first + i) * block.len()..][..block.len()];
            let jobs: Vec<(usize, usize)> =
                (0..planes.len()).flat_map(|f| (0..orbit.members.len()).map(move |m| (f, m))).collect();
            for group in jobs.chunks(VECTORS / 2) {
                if adjoint || 2 * group.len() < VECTORS {
                    // unused vectors and the padding of the rows
                    x.fill(0.0);
                }
                for (j, &(f, m)) in group.iter().enumerate() {
                    let member = orbit.members[m];
                    let table = &from.tables[member.step];
                    let spectrum = &planes[f][(member.kx * engine.grid[0] + member.ky) * wide..][..wide];
                    if adjoint && !blocks.real {
                        // (yr, yi) for the real part of Hᴴy, (yi, −yr) for the imaginary one
                        let (upper, lower) = x.split_at_mut(channels * VECTORS);
                        let rows = upper.chunks_exact_mut(VECTORS).zip(lower.chunks_exact_mut(VECTORS));
                        for ((place, sign), (u, l)) in table.from.iter().zip(&table.sign).zip(rows) {
                            let re = sign[0] * spectrum[place[0] as usize];
                            let im = sign[1] * spectrum[place[1] as usize];
                            u[2 * j] = re;
                            u[2 * j + 1] = im;
                            l[2 * j] = im;
                            l[2 * j + 1] = -re;
                        }
                    } else {
                        let cells = x.chunks_exact_mut(VECTORS);
                        for ((place, sign), v) in table.from.iter().zip(&table.sign).zip(cells) {
                            v[2 * j] = sign[0] * spectrum[place[0] as usize];
                            v[2 * j + 1] = sign[1] * spectrum[place[1] as usize];
                        }
                    }
                }
                if adjoint {
                    block.multiply_transposed(s, a, x, y, panel);
                } else {
                    block.multiply(s, a, x, y, 2 * group.len(), panel);
                }
                for (j, &(f, m)) in group.iter().enumerate() {
                    let out = &mut part[f][m * 2 * padded_to..][..2 * padded_to];
                    let (re, im) = out.split_at_mut(padded_to);
                    if adjoint {
                        for ((re, im), v) in
                            re.iter_mut().zip(im).take(channels_to).zip(y.chunks_exact(VECTORS))
                        {
                            *re = v[2 * j];
                            *im = v[2 * j + 1];
                        }
                    } else {
                        let (u, v) = (&y[2 * j * tall..][..tall], &y[(2 * j + 1) * tall..][..tall]);
                        if blocks.real {
                            re[..channels_to].copy_from_slice(&u[..channels_to]);
                            im[..channels_to].copy_from_slice(&v[..channels_to]);
                        } else {
                            for n in 0..channels_to {
                                re[n] = u[n] - v[channels_to + n];
                                im[n] = u[channels_to + n] + v[n];
                            }
                        }
                    }
                }
            }
        }
    }
}
