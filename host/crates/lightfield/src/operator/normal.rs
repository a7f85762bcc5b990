//! The stored normal matrix HᵀH, or G₊ᵀG₊ + G₋ᵀG₋ of two orders.
//!
//! Where the sensor catches all light it is block-circulant itself, of twice the radius, with square blocks of
//! the voxels of a cell; one pass through it replaces projection and back-projection.

use super::basis::Cell;
use super::blocks::{Kernel, Orbits, Reduction, pack};
use super::engine::{Engine, Port, Side, Spectra};
use super::fft::good_length;
use super::symmetry::Symmetries;
use super::{Storage, Store};
use crate::psf::Psf;
use crate::simd::{Kernel as Work, run};
use fearless_simd::Simd;

/// A stored normal matrix for volumes of a given number of cells.
pub struct Normal {
    pub(crate) engine: Engine,
    pub(crate) volume: Port,
    store: Store,
    bytes: u64,
    reduction: Reduction,
}

impl Normal {
    /// Builds the matrix for `cells` (y, x) cells. `orders`: 1, or 2 for the sum over a view and its mirror
    /// image in x.
    ///
    /// `None` where two orders are asked for and the point spread function has no mirror in y.
    pub fn new(psf: &Psf, cells: [usize; 2], storage: Storage, orders: usize) -> Option<Self> {
        let shape = psf.shape();
        let symmetries = Symmetries::of(&shape, &psf.values);
        let both = orders == 2 && !(symmetries.mirror_x && symmetries.mirror_y);
        if both && !symmetries.mirror_y {
            return None;
        }
        let grid = cells.map(|c| good_length(c + 2 * shape.radius));
        let largest = grid[0].max(grid[1]);
        let square = Reduction::of(symmetries, true) == Reduction::RealSquare
            && (grid[0] == grid[1] || largest * largest < 2 * grid[0] * grid[1]);
        let grid = if square { [largest; 2] } else { grid };
        let own = Reduction::of(symmetries, square);
        let reduction = if both { Reduction::RealMirrors } else { own };
        let (from_real, real) = (own.is_real(), reduction.is_real());
        let orbits = Orbits::new(grid, reduction);
        let kernel = Kernel::of_psf(&shape, &psf.values, from_real);
        let (rows, cell) = (kernel.rows, kernel.columns);
        let level = fearless_simd::Level::new();
        // rows of the parity basis have length √weight
        let weights: Vec<f32> =
            (0..rows.channels()).map(|n| if from_real { rows.weight(n) } else { 1.0 }).collect();
        let columns = cell.channels();
        let factor = if orders == 2 && !both { 2.0 } else { 1.0 };
        let matrices = kernel.at_orbits(grid, &orbits, from_real, |_, re, im| {
            let weights: Vec<f32> = weights.iter().map(|w| w * factor).collect();
            let (mut re, mut im) = gram(level, re, if from_real { &[] } else { im }, &weights, columns);
            if both {
                re = add_mirrored(&cell, &re, &im);
                im = Vec::new();
            }
            (re, im)
        });
        let store = match storage {
            Storage::F32 => Store::Full(pack(&matrices, columns, columns, grid, real)),
            Storage::F16 => Store::Half(pack(&matrices, columns, columns, grid, real)),
        };
        let bytes = match &store {
            Store::Full(b) => 4 * b.data.len() as u64,
            Store::Half(b) => 2 * b.data.len() as u64,
        };
        let engine = Engine::new(grid, real, orbits);
        let volume = engine.port(Side::new(cell, cells, 0, grid));
        Some(Self { engine, volume, store, bytes, reduction })
    }

    /// Bytes of the blocks.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// What the symmetry allows.
    pub fn reduction(&self) -> Reduction {
        self.reduction
    }

    /// Rows of volumes in the spectra → columns of volumes.
    pub(crate) fn apply(&self, frames: &mut [Spectra]) {
        match &self.store {
            Store::Full(b) => self.engine.apply(b, &self.volume, &self.volume, false, frames),
            Store::Half(b) => self.engine.apply(b, &self.volume, &self.volume, false, frames),
        }
    }
}

/// Σₙ wₙ conj(h[n, i]) h[n, j].
struct Gram<'a> {
    re: &'a [f32],
    im: &'a [f32],
    weights: &'a [f32],
    columns: usize,
}

impl Work for Gram<'_> {
    type Output = (Vec<f32>, Vec<f32>);

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> Self::Output {
        let k = self.columns;
        let mut re = vec![0f32; k * k];
        let mut im = vec![0f32; if self.im.is_empty() { 0 } else { k * k }];
        for (n, w) in self.weights.iter().enumerate() {
            let a = &self.re[n * k..][..k];
            if self.im.is_empty() {
                for i in 0..k {
                    let f = w * a[i];
                    for (o, v) in re[i * k + i..(i + 1) * k].iter_mut().zip(&a[i..]) {
                        *o = f.mul_add(*v, *o);
                    }
                }
                continue;
            }
            let b = &self.im[n * k..][..k];
            for i in 0..k {
                let (f, g) = (w * a[i], w * b[i]);
                let rows = re[i * k + i..(i + 1) * k].iter_mut().zip(&mut im[i * k + i..(i + 1) * k]);
                for ((r, m), (p, q)) in rows.zip(a[i..].iter().zip(&b[i..])) {
                    *r = f.mul_add(*p, g.mul_add(*q, *r));
                    *m = f.mul_add(*q, (-g).mul_add(*p, *m));
                }
            }
        }
        for i in 0..k {
            for j in 0..i {
                re[i * k + j] = re[j * k + i];
                if !im.is_empty() {
                    im[i * k + j] = -im[j * k + i];
                }
            }
        }
        (re, im)
    }
}

fn gram(
    level: fearless_simd::Level,
    re: &[f32],
    im: &[f32],
    weights: &[f32],
    columns: usize,
) -> (Vec<f32>, Vec<f32>) {
    run(level, Gram { re, im, weights, columns })
}

/// A + J conj(A) J with J the turn of a cell by 180°, as the real block of the parity basis.
fn add_mirrored(cell: &Cell, re: &[f32], im: &[f32]) -> Vec<f32> {
    let k = cell.channels();
    let turned = |c: usize| {
        let (y, x, i) = cell.split(c);
        cell.at(cell.n[0] - 1 - y, cell.n[1] - 1 - x, i)
    };
    let mut parts = [re.to_vec(), im.to_vec()];
    for i in 0..k {
        for j in 0..k {
            let from = turned(i) * k + turned(j);
            parts[0][i * k + j] = re[i * k + j] + re[from];
            parts[1][i * k + j] = im[i * k + j] - im[from];
        }
    }
    let odd: Vec<bool> = (0..k)
        .map(|c| {
            let (y, x, _) = cell.split(c);
            cell.parity(0, y) * cell.parity(1, x) < 0.0
        })
        .collect();
    let weights: Vec<f32> = (0..k).map(|c| cell.weight(c)).collect();
    for part in &mut parts {
        let mut column = vec![0f32; k];
        for j in 0..k {
            for i in 0..k {
                column[i] = part[i * k + j];
            }
            cell.butterfly(&mut column);
            for i in 0..k {
                part[i * k + j] = column[i] / weights[i];
            }
        }
        for row in part.chunks_exact_mut(k) {
            cell.butterfly(row);
            for (v, w) in row.iter_mut().zip(&weights) {
                *v /= w;
            }
        }
    }
    let [mut real, imaginary] = parts;
    for i in 0..k {
        for j in 0..k {
            // φᵢ N/φⱼ with φ = −i on odd channels
            match (odd[i], odd[j]) {
                (true, false) => real[i * k + j] = imaginary[i * k + j],
                (false, true) => real[i * k + j] = -imaginary[i * k + j],
                _ => {}
            }
        }
    }
    real
}
