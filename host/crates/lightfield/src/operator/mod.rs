//! Projections H g and back-projections Hᵀ f.

mod axes;
mod basis;
mod blocks;
mod direct;
mod engine;
mod fft;
mod gemm;
mod multiply;
mod normal;
mod symmetry;
mod tiles;

pub use blocks::Reduction;
pub use direct::Direct;
pub use normal::Normal;
pub use symmetry::Symmetries;

use crate::error::OperatorError;
use crate::psf::{Psf, PsfShape};
use basis::Cell;
use blocks::{Blocks, Kernel, Orbits, block_of, pack};
pub(crate) use engine::Spectra;
use engine::{Engine, Port, Side};
use fft::good_length;
use gemm::Half;
use serde::{Deserialize, Serialize};
use tiles::Tiles;

/// Most cells of a side.
const MOST_CELLS: usize = 4096;

/// Volume and sensor, in cells.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Geometry {
    pub(crate) shape: PsfShape,
    pub(crate) cells: [usize; 2],
    pub(crate) margin: isize,
    pub(crate) sensor: [usize; 2],
}

impl Geometry {
    pub(crate) fn new(shape: PsfShape, cells: [usize; 2], margin: isize) -> Result<Self, OperatorError> {
        let mut sensor = [0; 2];
        for axis in 0..2 {
            let found = cells[axis];
            if !(1..=MOST_CELLS).contains(&found) {
                return Err(OperatorError::Lenslets { found, most: MOST_CELLS });
            }
            let n = found as isize + 2 * margin.clamp(-(MOST_CELLS as isize), MOST_CELLS as isize);
            if n < 1 {
                return Err(OperatorError::Margin { margin, cells: found });
            }
            sensor[axis] = n as usize;
        }
        Ok(Self { shape, cells, margin, sensor })
    }

    /// (planes, rows, columns) of the volume.
    pub(crate) fn volume(&self) -> [usize; 3] {
        let v = self.shape.voxels;
        [self.shape.planes, self.cells[0] * v[0], self.cells[1] * v[1]]
    }

    /// (rows, columns) of the image.
    pub(crate) fn image(&self) -> [usize; 2] {
        [0, 1].map(|a| self.sensor[a] * self.shape.pixels[a])
    }

    pub(crate) fn check_volume(&self, found: usize) -> Result<(), OperatorError> {
        let expected = self.volume().iter().product();
        if found == expected {
            Ok(())
        } else {
            Err(OperatorError::Length { what: "a volume", found, expected })
        }
    }

    pub(crate) fn check_image(&self, found: usize) -> Result<(), OperatorError> {
        let expected = self.image().iter().product();
        if found == expected {
            Ok(())
        } else {
            Err(OperatorError::Length { what: "an image", found, expected })
        }
    }

    /// Frequencies of a grid on which nothing that wraps around is seen.
    fn grid(&self) -> [usize; 2] {
        let r = self.shape.radius as isize;
        [0, 1].map(|a| {
            let (v, m) = (self.cells[a] as isize, self.margin);
            // light from cell 0 … v−1 reaches −r … v−1+r; cells −m … v−1+m are read
            let needed = (v + r + m.min(r)).max(v + 2 * m).max(v);
            good_length(needed.max(1) as usize)
        })
    }
}

/// How the blocks are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Storage {
    /// 32-bit numbers.
    #[default]
    F32,
    /// 16-bit numbers, computed with in 32 bits: half the memory, results change by 1e-4.
    F16,
}

/// How an operator is built.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OperatorSettings {
    /// Cells (y, x) of the volume.
    pub cells: [usize; 2],
    /// By how many cells the sensor is larger on every side; negative: smaller.
    pub margin: isize,
    /// Storage.
    pub storage: Storage,
    /// Whether symmetries of the point spread function are looked for and used.
    pub use_symmetry: bool,
    /// Bytes that blocks and spectra may take; beyond, the lenslet grid is cut into tiles.
    pub memory_limit: Option<u64>,
}

impl OperatorSettings {
    /// Volume and sensor of the same cells, 32 bits, with symmetry, no limit.
    pub fn new(cells: [usize; 2]) -> Self {
        Self { cells, margin: 0, storage: Storage::F32, use_symmetry: true, memory_limit: None }
    }
}

/// What an operator takes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MemoryEstimate {
    /// Bytes of the blocks.
    pub blocks: u64,
    /// Bytes of the spectra of one frame.
    pub spectra: u64,
    /// Bytes while the blocks are made: the kernel over the lenslets and unpacked blocks.
    pub building: u64,
    /// Cells of a tile, where the limit makes tiles necessary.
    pub tile: Option<[usize; 2]>,
    /// What the symmetry allows.
    #[serde(skip)]
    pub reduction: Reduction,
    /// Lenslet frequencies (y, x).
    pub grid: [usize; 2],
}

impl MemoryEstimate {
    /// Bytes at the worst time.
    pub fn peak(&self) -> u64 {
        self.blocks + self.spectra.max(self.building)
    }
}

pub(crate) enum Store {
    Full(Blocks<f32>),
    Half(Blocks<Half>),
}

/// The block-circulant operator of one view.
///
/// Volumes are `[z][y][x]` with S voxels a cell, images `[y][x]` with N pixels a cell; the sensor may be larger
/// or smaller than the volume by `margin` cells on every side. Light that falls outside the sensor is lost.
/// [`Operator::back_project`] is the exact adjoint of [`Operator::project`]: both use the same stored numbers.
pub struct Operator {
    pub(crate) geometry: Geometry,
    symmetries: Symmetries,
    estimate: MemoryEstimate,
    pub(crate) form: Form,
}

pub(crate) enum Form {
    Whole(Box<Whole>),
    Tiled(Box<Tiles>),
}

/// An operator without tiles.
pub(crate) struct Whole {
    pub(crate) engine: Engine,
    pub(crate) volume: Port,
    pub(crate) sensor: Port,
    pub(crate) store: Store,
}

/// Sizes of one form of the operator.
fn plan(geometry: &Geometry, symmetries: Symmetries, storage: Storage) -> MemoryEstimate {
    let grid = geometry.grid();
    let shape = &geometry.shape;
    let largest = grid[0].max(grid[1]);
    // two unequal axes may still be worth the same grid: half the blocks
    let square = Reduction::of(symmetries, true) == Reduction::RealSquare
        && (grid[0] == grid[1] || largest * largest < 2 * grid[0] * grid[1]);
    let grid = if square { [largest; 2] } else { grid };
    let reduction = Reduction::of(symmetries, square);
    let orbits = Orbits::new(grid, reduction);
    let rows = shape.pixels[0] * shape.pixels[1];
    let columns = shape.voxels[0] * shape.voxels[1] * shape.planes;
    let count = orbits.orbits.len() as u64;
    let block = block_of(rows, columns, reduction.is_real());
    let bytes = if storage == Storage::F16 { 2 } else { 4 };
    let engine = Engine::new(grid, reduction.is_real(), orbits);
    let [volume, sensor] = sides(geometry, grid);
    let complex = if reduction.is_real() { 1 } else { 2 };
    MemoryEstimate {
        blocks: count * block.len() as u64 * bytes,
        spectra: 4 * engine.spectra_len(&volume, &sensor) as u64,
        building: 4 * (shape.len() as u64 + count * (rows * columns) as u64 * complex),
        tile: None,
        reduction,
        grid,
    }
}

fn sides(geometry: &Geometry, grid: [usize; 2]) -> [Side; 2] {
    let shape = &geometry.shape;
    let voxels = Cell { n: shape.voxels, inner: shape.planes };
    let pixels = Cell { n: shape.pixels, inner: 1 };
    [Side::new(voxels, geometry.cells, 0, grid), Side::new(pixels, geometry.sensor, -geometry.margin, grid)]
}

impl Whole {
    fn new(psf: &Psf, geometry: &Geometry, estimate: &MemoryEstimate, storage: Storage) -> Self {
        let real = estimate.reduction.is_real();
        let grid = estimate.grid;
        let orbits = Orbits::new(grid, estimate.reduction);
        let kernel = Kernel::of_psf(&geometry.shape, &psf.values, real);
        let matrices = kernel.at_orbits(grid, &orbits, real, |_, re, im| {
            (re.to_vec(), if real { Vec::new() } else { im.to_vec() })
        });
        let (rows, columns) = (kernel.rows.channels(), kernel.columns.channels());
        let store = match storage {
            Storage::F32 => Store::Full(pack(&matrices, rows, columns, grid, real)),
            Storage::F16 => Store::Half(pack(&matrices, rows, columns, grid, real)),
        };
        let engine = Engine::new(grid, real, orbits);
        let [volume, sensor] = sides(geometry, grid);
        let (volume, sensor) = (engine.port(volume), engine.port(sensor));
        Self { engine, volume, sensor, store }
    }

    /// Rows of volumes in the spectra → columns of images.
    pub(crate) fn forward(&self, frames: &mut [Spectra]) {
        match &self.store {
            Store::Full(b) => self.engine.apply(b, &self.volume, &self.sensor, false, frames),
            Store::Half(b) => self.engine.apply(b, &self.volume, &self.sensor, false, frames),
        }
    }

    /// Rows of images in the spectra → columns of volumes.
    pub(crate) fn backward(&self, frames: &mut [Spectra]) {
        match &self.store {
            Store::Full(b) => self.engine.apply(b, &self.sensor, &self.volume, true, frames),
            Store::Half(b) => self.engine.apply(b, &self.sensor, &self.volume, true, frames),
        }
    }

    /// Cell by cell from `from` to what comes out, for several frames.
    fn through(&self, inputs: &[&[f32]], forward: bool) -> Vec<Vec<f32>> {
        let (from, to) = if forward { (&self.volume, &self.sensor) } else { (&self.sensor, &self.volume) };
        let mut frames: Vec<Spectra> = Vec::new();
        for input in inputs {
            let mut s = Spectra::default();
            let row = from.side.row();
            self.engine.turn(&from.side, &mut s, false, true, &mut [], &|y, values, _| {
                values.copy_from_slice(&input[y * row..][..row]);
            });
            frames.push(s);
        }
        if forward {
            self.forward(&mut frames);
        } else {
            self.backward(&mut frames);
        }
        frames
            .iter_mut()
            .map(|s| {
                let mut out = vec![0f32; to.side.len()];
                self.engine.turn(&to.side, s, true, false, &mut out, &|_, values, out| {
                    out.copy_from_slice(values);
                });
                out
            })
            .collect()
    }
}

impl Operator {
    /// What an operator would take, and whether in tiles.
    ///
    /// # Errors
    /// [`OperatorError`]: an impossible grid, or a limit that even the smallest tiles exceed.
    pub fn estimate(psf: &Psf, settings: &OperatorSettings) -> Result<MemoryEstimate, OperatorError> {
        let geometry = Geometry::new(psf.shape(), settings.cells, settings.margin)?;
        Self::estimate_for(&geometry, symmetries_of(psf, settings), settings)
    }

    fn estimate_for(
        geometry: &Geometry,
        symmetries: Symmetries,
        settings: &OperatorSettings,
    ) -> Result<MemoryEstimate, OperatorError> {
        let whole = plan(geometry, symmetries, settings.storage);
        let Some(limit) = settings.memory_limit else { return Ok(whole) };
        if whole.peak() <= limit {
            return Ok(whole);
        }
        // the largest square tile that fits
        let mut best: Option<MemoryEstimate> = None;
        let mut smallest = whole.peak();
        for t in 1..=geometry.cells[0].max(geometry.cells[1]) {
            let cells = geometry.cells.map(|c| c.min(t));
            let tile = Geometry::new(geometry.shape, cells, geometry.shape.radius as isize)?;
            let estimate = plan(&tile, symmetries, settings.storage);
            smallest = smallest.min(estimate.peak());
            if estimate.peak() > limit {
                break;
            }
            best = Some(MemoryEstimate { tile: Some(cells), ..estimate });
        }
        best.ok_or(OperatorError::Memory { needed_mib: smallest.div_ceil(1 << 20), limit_mib: limit >> 20 })
    }

    /// Builds the operator.
    ///
    /// # Errors
    /// As [`Operator::estimate`].
    pub fn new(psf: &Psf, settings: &OperatorSettings) -> Result<Self, OperatorError> {
        let geometry = Geometry::new(psf.shape(), settings.cells, settings.margin)?;
        let symmetries = symmetries_of(psf, settings);
        let estimate = Self::estimate_for(&geometry, symmetries, settings)?;
        let form = match estimate.tile {
            None => Form::Whole(Box::new(Whole::new(psf, &geometry, &estimate, settings.storage))),
            Some(cells) => {
                let tile = Geometry::new(geometry.shape, cells, geometry.shape.radius as isize)?;
                let whole = Whole::new(psf, &tile, &estimate, settings.storage);
                Form::Tiled(Box::new(Tiles::new(whole, tile, &geometry)))
            }
        };
        Ok(Self { geometry, symmetries, estimate, form })
    }

    /// Symmetries that were found (none if they were not looked for).
    pub fn symmetries(&self) -> Symmetries {
        self.symmetries
    }

    /// What it takes.
    pub fn memory(&self) -> MemoryEstimate {
        self.estimate
    }

    /// Below which estimates of pixels, relative to the largest, are not told from rounding noise: 1e-7, in half
    /// precision 1e-5 (from 1e-6 to 5e-5 it makes no difference to reconstructions).
    pub fn rounding(&self) -> f32 {
        let whole = match &self.form {
            Form::Whole(whole) => whole,
            Form::Tiled(tiles) => tiles.whole(),
        };
        match whole.store {
            Store::Full(_) => 1e-7,
            Store::Half(_) => 1e-5,
        }
    }

    /// (planes, rows, columns) of a volume.
    pub fn volume_shape(&self) -> [usize; 3] {
        self.geometry.volume()
    }

    /// (rows, columns) of an image.
    pub fn image_shape(&self) -> [usize; 2] {
        self.geometry.image()
    }

    /// H g of several volumes at once: the blocks are read once for all.
    ///
    /// # Errors
    /// [`OperatorError::Length`], [`OperatorError::NoFrame`].
    pub fn project(&self, volumes: &[&[f32]]) -> Result<Vec<Vec<f32>>, OperatorError> {
        if volumes.is_empty() {
            return Err(OperatorError::NoFrame);
        }
        for v in volumes {
            self.geometry.check_volume(v.len())?;
        }
        let [volume, sensor] = self.layouts();
        let inputs: Vec<Vec<f32>> = volumes.iter().map(|v| volume.pack(v)).collect();
        let inputs: Vec<&[f32]> = inputs.iter().map(Vec::as_slice).collect();
        Ok(self.through(&inputs, true).iter().map(|v| sensor.unpack(v)).collect())
    }

    /// Hᵀ f of several images at once.
    ///
    /// # Errors
    /// [`OperatorError::Length`], [`OperatorError::NoFrame`].
    pub fn back_project(&self, images: &[&[f32]]) -> Result<Vec<Vec<f32>>, OperatorError> {
        if images.is_empty() {
            return Err(OperatorError::NoFrame);
        }
        for v in images {
            self.geometry.check_image(v.len())?;
        }
        let [volume, sensor] = self.layouts();
        let inputs: Vec<Vec<f32>> = images.iter().map(|v| sensor.pack(v)).collect();
        let inputs: Vec<&[f32]> = inputs.iter().map(Vec::as_slice).collect();
        Ok(self.through(&inputs, false).iter().map(|v| volume.unpack(v)).collect())
    }

    /// Cell by cell, in the packed form of [`Layout`].
    pub(crate) fn through(&self, inputs: &[&[f32]], forward: bool) -> Vec<Vec<f32>> {
        match &self.form {
            Form::Whole(whole) => whole.through(inputs, forward),
            Form::Tiled(tiles) => inputs.iter().map(|i| tiles.through(i, forward)).collect(),
        }
    }

    /// Layouts of volume and sensor.
    pub(crate) fn layouts(&self) -> [Layout; 2] {
        let s = &self.geometry.shape;
        [
            Layout::new(Cell { n: s.voxels, inner: s.planes }, self.geometry.cells),
            Layout::new(Cell { n: s.pixels, inner: 1 }, self.geometry.sensor),
        ]
    }
}

fn symmetries_of(psf: &Psf, settings: &OperatorSettings) -> Symmetries {
    if settings.use_symmetry { Symmetries::of(&psf.shape(), &psf.values) } else { Symmetries::default() }
}

/// From `[z][y][x]` to cell by cell with the channels of a cell innermost, and back.
#[derive(Debug, Clone)]
pub(crate) struct Layout {
    pub(crate) cell: Cell,
    pub(crate) cells: [usize; 2],
    pub(crate) padded: usize,
}

impl Layout {
    pub(crate) fn new(cell: Cell, cells: [usize; 2]) -> Self {
        Self { cell, cells, padded: cell.channels().next_multiple_of(crate::simd::LANES) }
    }

    /// Numbers of a row of cells.
    pub(crate) fn row(&self) -> usize {
        self.cells[1] * self.padded
    }

    pub(crate) fn len(&self) -> usize {
        self.cells[0] * self.row()
    }

    /// Runs `work(packed place, place in [z][y][x], numbers)` for what follows each other in both.
    fn each(&self, mut work: impl FnMut(usize, usize, usize)) {
        let [ny, nx] = self.cell.n;
        let (height, width) = (self.cells[0] * ny, self.cells[1] * nx);
        for cy in 0..self.cells[0] {
            for cx in 0..self.cells[1] {
                let first = (cy * self.cells[1] + cx) * self.padded;
                for y in 0..ny {
                    let plain = (cy * ny + y) * width + cx * nx;
                    if self.cell.inner == 1 {
                        work(first + self.cell.at(y, 0, 0), plain, nx);
                        continue;
                    }
                    for x in 0..nx {
                        for i in 0..self.cell.inner {
                            work(first + self.cell.at(y, x, i), i * height * width + plain + x, 1);
                        }
                    }
                }
            }
        }
    }

    pub(crate) fn pack(&self, values: &[f32]) -> Vec<f32> {
        let mut out = vec![0f32; self.len()];
        self.each(|to, from, n| out[to..to + n].copy_from_slice(&values[from..from + n]));
        out
    }

    pub(crate) fn unpack(&self, packed: &[f32]) -> Vec<f32> {
        let mut out = vec![0f32; self.cells[0] * self.cells[1] * self.cell.channels()];
        self.each(|from, to, n| out[to..to + n].copy_from_slice(&packed[from..from + n]));
        out
    }

    /// Mirrors a row of cells in x.
    pub(crate) fn mirror_row(&self, row: &[f32], out: &mut [f32]) {
        let [ny, nx] = self.cell.n;
        let inner = self.cell.inner;
        for (from, to) in row.chunks_exact(self.padded).rev().zip(out.chunks_exact_mut(self.padded)) {
            for y in 0..ny {
                for x in 0..nx {
                    let (a, b) = (self.cell.at(y, nx - 1 - x, 0), self.cell.at(y, x, 0));
                    to[b..b + inner].copy_from_slice(&from[a..a + inner]);
                }
            }
        }
    }
}
