//! Projections in the form in which they are computed: channels innermost, rows of cells in parallel.
//!
//! One direction is: rows of cells → transform along x → along y → blocks → back along y → rows. The steps of
//! an iteration that work on pixels or voxels are done while a row is in the cache ([`Engine::turn`]). Every
//! number is computed by one task in one order: results do not depend on the number of threads.

use super::axes::{ColumnBack, ColumnForth, RowBack, RowForth};
use super::basis::Cell;
use super::blocks::{Blocks, Orbits, Table};
use super::fft::Plan;
use super::gemm::Element;
use super::multiply::{BlockScratch, Multiply};
use crate::simd::{Kernel as Work, LANES, run};
use fearless_simd::Simd;
use rayon::prelude::*;

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
}

/// Spectra of one frame on the way through.
#[derive(Default)]
pub(crate) struct Spectra {
    /// Transforms of rows, [row][kx][re|im][channel].
    pub(crate) rows: Vec<f32>,
    /// [kx][ky][re|im][channel].
    plane: Vec<f32>,
    /// Products, in the same order.
    products: Vec<f32>,
    /// Back along y, as the rows' transforms want it: [kx][pair of rows][kx|−kx][re|im][channel].
    columns: Vec<f32>,
}

/// The first `n` numbers of a buffer that grows when it has to: volumes and sensors take turns.
fn room(buffer: &mut Vec<f32>, n: usize) -> &mut [f32] {
    if buffer.len() < n {
        // fresh memory is zero without being written
        *buffer = vec![0.0; n];
    }
    &mut buffer[..n]
}

/// Work on a row of cells: (row, its numbers, its part of the state).
type RowWork<'a> = dyn Fn(usize, &mut [f32], &mut [f32]) + Sync + 'a;

/// Everything but the blocks.
pub(crate) struct Engine {
    pub(crate) grid: [usize; 2],
    pub(crate) plans: [Plan; 2],
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

    /// Frequencies of half an axis.
    pub(crate) fn half(&self) -> usize {
        self.grid[1] / 2 + 1
    }

    pub(crate) fn port(&self, side: Side) -> Port {
        let tables = self.orbits.tables(&side.cell, side.padded, self.real);
        Port { side, tables }
    }

    /// Numbers that the spectra of one frame take.
    pub(crate) fn spectra_len(&self, a: &Side, b: &Side) -> usize {
        let (most, tall) = (a.padded.max(b.padded), a.cells[0].max(b.cells[0]));
        2 * most * self.half() * (2 * tall + 1 + 2 * self.grid[0])
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
        let Spectra { rows, columns, .. } = spectra;
        // every number that is read later is written first
        let rows = room(rows, if forth { side.cells[0] * spectrum } else { 0 });
        let columns: &[f32] = if back { columns } else { &[] };
        let task = |pair: usize, rows: &mut [f32], state: &mut [f32], local: &mut [Vec<f32>; 2]| {
            let [values, scratch] = local;
            let first = 2 * pair;
            let count = (side.cells[0] - first).min(2);
            values.resize(2 * row, 0.0);
            if back {
                run(self.level, RowBack { engine: self, side, columns, values, pair, scratch });
                if self.real {
                    butterflies(self.level, side, values);
                }
            }
            for i in 0..count {
                let own = state.get_mut(i * row..(i + 1) * row).unwrap_or_default();
                work(first + i, &mut values[i * row..(i + 1) * row], own);
            }
            if forth {
                values[count * row..].fill(0.0);
                if self.real {
                    butterflies(self.level, side, values);
                }
                run(self.level, RowForth { engine: self, side, values, rows, count, scratch });
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
            .for_each_init(Default::default, |local, (pair, (rows, state))| task(pair, rows, state, local));
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
            let Spectra { rows, plane, .. } = f;
            let rows: &[f32] = rows;
            let plane = room(plane, half * py * wide);
            plane.par_chunks_mut(py * wide).enumerate().for_each_init(Vec::new, |scratch, (kx, out)| {
                run(self.level, ColumnForth { engine: self, side: &from.side, rows, out, kx, scratch });
            });
        }
        // products of an orbit: of all members, frame by frame
        let count = self.orbits.orbits.len();
        let batch = frames.len();
        let mut parts: Vec<Vec<&mut [f32]>> = self
            .orbits
            .orbits
            .iter()
            .map(|o| (0..batch * o.members.len()).map(|_| Default::default()).collect())
            .collect();
        let mut planes: Vec<&[f32]> = Vec::with_capacity(batch);
        for (f, Spectra { plane, products, .. }) in frames.iter_mut().enumerate() {
            planes.push(plane);
            let products = room(products, half * py * wide_to).chunks_mut(wide_to);
            for (product, &(orbit, member)) in products.zip(&self.orbits.place) {
                let part = &mut parts[orbit as usize];
                let members = part.len() / batch;
                part[f * members + member as usize] = product;
            }
        }
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
            let column = to.side.cells[0].div_ceil(2) * 2 * wide_to;
            let Spectra { products, columns, .. } = f;
            let products: &[f32] = products;
            let columns = room(columns, half * column);
            columns.par_chunks_mut(column).enumerate().for_each_init(Vec::new, |scratch, (kx, out)| {
                run(self.level, ColumnBack { engine: self, side: &to.side, products, out, kx, scratch });
            });
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
    fn run<S: Simd>(self, s: S) {
        for cell in self.values.chunks_exact_mut(self.side.padded) {
            self.side.cell.butterfly_with(s, cell);
        }
    }
}

fn butterflies(level: fearless_simd::Level, side: &Side, values: &mut [f32]) {
    run(level, Butterflies { side, values });
}
