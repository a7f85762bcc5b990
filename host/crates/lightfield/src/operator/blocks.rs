//! The blocks of a block-circulant operator, one for each set of lenslet frequencies that symmetry connects.
//!
//! Over the lenslet grid a projection is a convolution whose "pixels" are vectors: at each frequency k it is
//! one dense matrix H(k). For real light H(−k) = conj H(k), so half of the plane is enough. In the basis of
//! even and odd sub-positions a turn of 180° makes H(k) real (with a factor −i on channels of odd parity), a
//! mirror a change of signs, the exchange of the axes a permutation: H at (±a, ±b) and (±b, ±a) is one block.

use super::basis::Cell;
use super::gemm::{Block, Element};
use super::symmetry::Symmetries;
use crate::simd::LANES;
use rayon::prelude::*;

/// What the symmetry allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reduction {
    /// Complex blocks, one for each frequency.
    Complex,
    /// Complex blocks, shared by (k_y, k_x) and (−k_y, k_x): a mirror in y.
    ComplexMirrorY,
    /// The same with the conjugate: a mirror in x.
    ComplexMirrorX,
    /// Real blocks in the parity basis: a turn of 180°.
    Real,
    /// Real blocks, shared by (±k_y, k_x): two mirrors.
    RealMirrors,
    /// Real blocks, shared by (±k_y, k_x) and (±k_x, k_y): the symmetry of a square.
    RealSquare,
}

impl Reduction {
    /// Blocks are real and channels in the parity basis.
    pub fn is_real(self) -> bool {
        matches!(self, Self::Real | Self::RealMirrors | Self::RealSquare)
    }

    /// The largest reduction that the symmetries allow; `square_grid`: both axes have as many frequencies.
    pub(crate) fn of(symmetries: Symmetries, square_grid: bool) -> Self {
        let s = symmetries;
        match (s.mirror_y, s.mirror_x) {
            (true, true) if s.exchange && square_grid => Self::RealSquare,
            (true, true) => Self::RealMirrors,
            _ if s.turn => Self::Real,
            (true, false) => Self::ComplexMirrorY,
            (false, true) => Self::ComplexMirrorX,
            _ => Self::Complex,
        }
    }
}

/// How the spectrum at a member of an orbit becomes a vector of the orbit's block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Step {
    exchange: bool,
    mirror_y: bool,
    /// Mirror in x, and the conjugate.
    conjugate_x: bool,
}

/// [`Step`] channel by channel.
#[derive(Debug, Clone)]
pub(crate) struct Table {
    /// Channels that stay together, beginning where a multiple of `run` does.
    pub(crate) run: usize,
    /// The channel from which the first of each run comes, unless all stay.
    pub(crate) from: Option<Vec<u32>>,
    /// Cosine a and sine b of a turn by a multiple of 90°, for all padded channels: re′ = a re + b im,
    /// im′ = ±(a im − b re).
    pub(crate) turn: [Vec<f32>; 2],
    /// The sign of im′.
    pub(crate) sign: f32,
}

impl Table {
    fn new(cell: &Cell, padded: usize, real: bool, step: Step) -> Self {
        let run = cell.inner;
        let mut from: Vec<u32> = Vec::new();
        let mut turn = [(); 2].map(|()| vec![0f32; padded]);
        for c in 0..cell.channels() {
            let (y, x, i) = cell.split(c);
            let (mut sy, mut sx) = if step.exchange { (x, y) } else { (y, x) };
            let mut f = 1.0;
            if real {
                if step.mirror_y {
                    f = cell.parity(0, sy);
                }
            } else {
                if step.mirror_y {
                    sy = cell.n[0] - 1 - sy;
                }
                if step.conjugate_x {
                    sx = cell.n[1] - 1 - sx;
                }
            }
            if i == 0 {
                from.push(cell.at(sy, sx, 0) as u32);
            }
            if real && cell.parity(0, y) * cell.parity(1, x) < 0.0 {
                // times −i
                turn[1][c] = f;
            } else {
                turn[0][c] = f;
            }
        }
        let moved = from.iter().enumerate().any(|(r, f)| r * run != *f as usize);
        Self { run, from: moved.then_some(from), turn, sign: if step.conjugate_x { -1.0 } else { 1.0 } }
    }
}

/// One frequency of an orbit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Member {
    pub(crate) ky: usize,
    pub(crate) kx: usize,
    /// Which of the tables.
    pub(crate) step: usize,
}

/// Frequencies that share a block; the first is the block's own.
#[derive(Debug, Clone, Default)]
pub(crate) struct Orbit {
    pub(crate) members: Vec<Member>,
}

/// Orbits of a grid, and where each frequency of the half plane is found.
#[derive(Debug, Clone)]
pub(crate) struct Orbits {
    pub(crate) orbits: Vec<Orbit>,
    /// (orbit, member) of frequency [kx][ky].
    pub(crate) place: Vec<(u32, u32)>,
    steps: Vec<Step>,
}

impl Orbits {
    pub(crate) fn new(grid: [usize; 2], reduction: Reduction) -> Self {
        let [py, px] = grid;
        let half = px / 2 + 1;
        let plain = Step::default();
        let steps = match reduction {
            Reduction::Complex | Reduction::Real => vec![plain],
            Reduction::ComplexMirrorX => vec![plain, Step { conjugate_x: true, ..plain }],
            Reduction::ComplexMirrorY | Reduction::RealMirrors => {
                vec![plain, Step { mirror_y: true, ..plain }]
            }
            Reduction::RealSquare => vec![
                plain,
                Step { mirror_y: true, ..plain },
                Step { exchange: true, ..plain },
                Step { exchange: true, mirror_y: true, ..plain },
            ],
        };
        let mut orbits: Vec<Orbit> = Vec::new();
        let mut place = vec![(u32::MAX, 0); half * py];
        for kx in 0..half {
            for ky in 0..py {
                if place[kx * py + ky].0 != u32::MAX {
                    continue;
                }
                let mut orbit = Orbit::default();
                for (step, s) in steps.iter().enumerate() {
                    let (mut y, x) = if s.exchange { (kx, ky) } else { (ky, kx) };
                    if s.mirror_y || s.conjugate_x {
                        y = (py - y) % py;
                    }
                    // the first of an orbit that is met has k_y, k_x in 0…P/2: none leaves the half plane
                    if place[x * py + y].0 == u32::MAX {
                        place[x * py + y] = (orbits.len() as u32, orbit.members.len() as u32);
                        orbit.members.push(Member { ky: y, kx: x, step });
                    }
                }
                orbits.push(orbit);
            }
        }
        Self { orbits, place, steps }
    }

    pub(crate) fn tables(&self, cell: &Cell, padded: usize, real: bool) -> Vec<Table> {
        self.steps.iter().map(|&s| Table::new(cell, padded, real, s)).collect()
    }
}

/// The stored blocks.
pub(crate) struct Blocks<T> {
    pub(crate) block: Block,
    pub(crate) real: bool,
    /// Factor of every product: 1/(P_y P_x), and what the storage was scaled by.
    pub(crate) scale: f32,
    pub(crate) data: Vec<T>,
}

/// A kernel over the lenslet grid: `values[(dy·D + dx)·rows·columns + row·columns + column]`, D = 2 radius + 1.
pub(crate) struct Kernel {
    pub(crate) radius: usize,
    pub(crate) rows: Cell,
    pub(crate) columns: Cell,
    pub(crate) values: Vec<f32>,
}

impl Kernel {
    /// From a point spread function; in the parity basis if `real`.
    pub(crate) fn of_psf(shape: &crate::psf::PsfShape, psf: &[f32], real: bool) -> Self {
        let rows = Cell { n: shape.pixels, inner: 1 };
        let columns = Cell { n: shape.voxels, inner: shape.planes };
        let (r, c) = (rows.channels(), columns.channels());
        let cells = shape.side() * shape.side();
        let mut values = vec![0f32; cells * r * c];
        values.par_chunks_mut(r * c).enumerate().for_each(|(d, out)| {
            for z in 0..shape.planes {
                for s in 0..shape.voxels[0] * shape.voxels[1] {
                    let from = &psf[((z * shape.voxels[0] * shape.voxels[1] + s) * cells + d) * r..][..r];
                    for (n, v) in from.iter().enumerate() {
                        out[n * c + s * shape.planes + z] = *v;
                    }
                }
            }
            if real {
                let mut row = vec![0f32; r];
                for j in 0..c {
                    for n in 0..r {
                        row[n] = out[n * c + j];
                    }
                    rows.butterfly(&mut row);
                    for n in 0..r {
                        out[n * c + j] = row[n] / rows.weight(n);
                    }
                }
                for line in out.chunks_exact_mut(c) {
                    columns.butterfly(line);
                    for (j, v) in line.iter_mut().enumerate() {
                        *v /= columns.weight(j);
                    }
                }
            }
        });
        Self { radius: shape.radius, rows, columns, values }
    }

    /// Blocks at the orbits of a grid, one after the other, by `finish(orbit, real parts, imaginary parts)`;
    /// real blocks come as real parts alone.
    pub(crate) fn at_orbits<R: Send>(
        &self,
        grid: [usize; 2],
        orbits: &Orbits,
        real: bool,
        finish: impl Fn(usize, &[f32], &[f32]) -> R + Sync,
    ) -> Vec<R> {
        let [py, px] = grid;
        let side = 2 * self.radius + 1;
        let size = self.rows.channels() * self.columns.channels();
        let odd = |cell: &Cell| -> Vec<bool> {
            (0..cell.channels())
                .map(|c| {
                    let (y, x, _) = cell.split(c);
                    cell.parity(0, y) * cell.parity(1, x) < 0.0
                })
                .collect()
        };
        let (odd_rows, odd_columns) = (odd(&self.rows), odd(&self.columns));
        // orbits by their kx, so that the sums along x are shared
        let mut by_kx: Vec<Vec<usize>> = vec![Vec::new(); px / 2 + 1];
        for (o, orbit) in orbits.orbits.iter().enumerate() {
            by_kx[orbit.members[0].kx].push(o);
        }
        let phase = |k: usize, d: usize, p: usize| {
            let turn = ((k * (d + p * (self.radius / p + 1) - self.radius)) % p) as f64 / p as f64;
            let (sin, cos) = (-std::f64::consts::TAU * turn).sin_cos();
            (cos as f32, sin as f32)
        };
        let mut done: Vec<(usize, R)> = by_kx
            .par_iter()
            .enumerate()
            .flat_map_iter(|(kx, list)| {
                let mut sums =
                    vec![(vec![0f32; size], vec![0f32; size]); if list.is_empty() { 0 } else { side }];
                for (dy, (re, im)) in sums.iter_mut().enumerate() {
                    for dx in 0..side {
                        let (cos, sin) = phase(kx, dx, px);
                        let from = &self.values[(dy * side + dx) * size..][..size];
                        for ((re, im), v) in re.iter_mut().zip(im.iter_mut()).zip(from) {
                            *re += cos * v;
                            *im += sin * v;
                        }
                    }
                }
                let (mut re, mut im) = (vec![0f32; size], vec![0f32; size]);
                let mut out = Vec::with_capacity(list.len());
                for &o in list {
                    re.fill(0.0);
                    im.fill(0.0);
                    for (dy, (from_re, from_im)) in sums.iter().enumerate() {
                        let (cos, sin) = phase(orbits.orbits[o].members[0].ky, dy, py);
                        for i in 0..size {
                            re[i] += cos * from_re[i] - sin * from_im[i];
                            im[i] += cos * from_im[i] + sin * from_re[i];
                        }
                    }
                    if real {
                        // φ_row H/φ_column with φ = −i on odd channels
                        let columns = self.columns.channels();
                        for (n, row_odd) in odd_rows.iter().enumerate() {
                            for (c, column_odd) in odd_columns.iter().enumerate() {
                                let i = n * columns + c;
                                match (row_odd, column_odd) {
                                    (true, false) => re[i] = im[i],
                                    (false, true) => re[i] = -im[i],
                                    _ => {}
                                }
                            }
                        }
                    }
                    out.push((o, finish(o, &re, &im)));
                }
                out
            })
            .collect();
        done.sort_by_key(|(o, _)| *o);
        done.into_iter().map(|(_, r)| r).collect()
    }
}

/// Shape of a stored block of `rows` × `columns` numbers; imaginary parts lie below real ones, from the next
/// multiple of the lanes on.
pub(crate) fn block_of(rows: usize, columns: usize, real: bool) -> Block {
    Block { rows: if real { rows } else { rows.next_multiple_of(LANES) + rows }, columns }
}

/// Packs blocks given as (real parts, imaginary parts), `rows` × `columns`, into panels.
pub(crate) fn pack<T: Element>(
    matrices: &[(Vec<f32>, Vec<f32>)],
    rows: usize,
    columns: usize,
    grid: [usize; 2],
    real: bool,
) -> Blocks<T> {
    let block = block_of(rows, columns, real);
    let below = block.rows - rows;
    let mut scale = 1.0 / (grid[0] * grid[1]) as f32;
    let mut factor = 1.0f32;
    if T::BYTES == 2 {
        // the largest number of half precision is 65504
        let largest =
            matrices.iter().flat_map(|(a, b)| a.iter().chain(b)).fold(0.0f32, |m, v| m.max(v.abs()));
        if largest > 0.0 {
            factor = 2f32.powi((16384.0 / largest).log2().floor() as i32);
            scale /= factor;
        }
    }
    let mut data = vec![T::default(); matrices.len() * block.len()];
    data.par_chunks_mut(block.len()).zip(matrices).for_each(|(out, (re, im))| {
        for row in 0..rows {
            for column in 0..columns {
                out[block.index(row, column)] = T::of(factor * re[row * columns + column]);
                if !real {
                    out[block.index(below + row, column)] = T::of(factor * im[row * columns + column]);
                }
            }
        }
    });
    Blocks { block, real, scale, data }
}
