//! From the field behind the lenslets to the light in the pixels.

use crate::optics::Propagation;
use rayon::prelude::*;
use rustfft::num_complex::Complex64;
use rustfft::{Fft, FftPlannerScalar};
use std::sync::Arc;

/// A periodic window of the lenslet plane, with what is needed to propagate fields on it.
pub(crate) struct Propagator {
    size: [usize; 2],
    forward: [Arc<dyn Fft<f64>>; 2],
    inverse: [Arc<dyn Fft<f64>>; 2],
    /// Separable transfer functions along y and x, 1/n of the transforms included.
    separable: Option<[Vec<Complex64>; 2]>,
    /// Transfer function, `[x][y]`.
    full: Vec<Complex64>,
}

/// Angular frequencies of a transform of `n` samples at distance `d`.
fn frequencies(n: usize, d: f64) -> Vec<f64> {
    let step = std::f64::consts::TAU / (n as f64 * d);
    (0..n).map(|i| if i <= (n - 1) / 2 { i as f64 } else { i as f64 - n as f64 } * step).collect()
}

impl Propagator {
    pub(crate) fn new(
        size: [usize; 2],
        spacing: [f64; 2],
        wavelength_um: f64,
        gap_um: f64,
        kind: Propagation,
    ) -> Self {
        // vector instructions gain nothing at these lengths and take long to compile
        let mut planner = FftPlannerScalar::new();
        let forward = size.map(|n| planner.plan_fft_forward(n));
        let inverse = size.map(|n| planner.plan_fft_inverse(n));
        let omega = [0, 1].map(|a| frequencies(size[a], spacing[a]));
        let scale = 1.0 / (size[0] * size[1]) as f64;
        let (mut separable, mut full) = (None, Vec::new());
        match kind {
            Propagation::Fresnel => {
                separable = Some([0, 1].map(|a| {
                    let n = 1.0 / size[a] as f64;
                    omega[a]
                        .iter()
                        .map(|w| {
                            let phase = -wavelength_um * gap_um * w * w / (4.0 * std::f64::consts::PI);
                            Complex64::from_polar(n, phase)
                        })
                        .collect()
                }));
            }
            Propagation::AngularSpectrum => {
                let k0 = std::f64::consts::TAU / wavelength_um;
                full = omega[1]
                    .iter()
                    .flat_map(|wx| omega[0].iter().map(move |wy| k0 * k0 - wx * wx - wy * wy))
                    .map(|square| {
                        if square > 0.0 {
                            Complex64::from_polar(scale, gap_um * (square.sqrt() - k0))
                        } else {
                            Complex64::new(0.0, 0.0)
                        }
                    })
                    .collect();
            }
        }
        Self { size, forward, inverse, separable, full }
    }

    /// Propagates `field` (`[y][x]`, overwritten) and returns |field|² of the columns `keep`, transposed:
    /// `[x][y]`, all rows.
    pub(crate) fn intensity(&self, field: &mut [Complex64], keep: std::ops::Range<usize>) -> Vec<f64> {
        let [ny, nx] = self.size;
        let mut scratch = vec![
            Complex64::default();
            self.forward[1]
                .get_inplace_scratch_len()
                .max(self.forward[0].get_inplace_scratch_len())
                .max(self.inverse[1].get_inplace_scratch_len())
                .max(self.inverse[0].get_inplace_scratch_len())
        ];
        if let Some([ty, tx]) = &self.separable {
            for row in field.chunks_exact_mut(nx) {
                self.forward[1].process_with_scratch(row, &mut scratch);
                for (v, t) in row.iter_mut().zip(tx) {
                    *v *= t;
                }
                self.inverse[1].process_with_scratch(row, &mut scratch);
            }
            let mut columns = transpose(field, ny, nx, keep);
            for column in columns.chunks_exact_mut(ny) {
                self.forward[0].process_with_scratch(column, &mut scratch);
                for (v, t) in column.iter_mut().zip(ty) {
                    *v *= t;
                }
                self.inverse[0].process_with_scratch(column, &mut scratch);
            }
            return columns.iter().map(Complex64::norm_sqr).collect();
        }
        for row in field.chunks_exact_mut(nx) {
            self.forward[1].process_with_scratch(row, &mut scratch);
        }
        let mut columns = transpose(field, ny, nx, 0..nx);
        for (column, t) in columns.chunks_exact_mut(ny).zip(self.full.chunks_exact(ny)) {
            self.forward[0].process_with_scratch(column, &mut scratch);
            for (v, t) in column.iter_mut().zip(t) {
                *v *= t;
            }
            self.inverse[0].process_with_scratch(column, &mut scratch);
        }
        let mut rows = transpose(&columns, nx, ny, 0..ny);
        for row in rows.chunks_exact_mut(nx) {
            self.inverse[1].process_with_scratch(row, &mut scratch);
        }
        let kept = transpose(&rows, ny, nx, keep);
        kept.iter().map(Complex64::norm_sqr).collect()
    }
}

/// Columns `keep` of a matrix of `rows` × `columns`, as rows.
fn transpose(m: &[Complex64], rows: usize, columns: usize, keep: std::ops::Range<usize>) -> Vec<Complex64> {
    const TILE: usize = 16;
    let mut out = vec![Complex64::default(); keep.len() * rows];
    for y in (0..rows).step_by(TILE) {
        for x in (0..keep.len()).step_by(TILE) {
            for b in x..(x + TILE).min(keep.len()) {
                for a in y..(y + TILE).min(rows) {
                    out[b * rows + a] = m[a * columns + keep.start + b];
                }
            }
        }
    }
    out
}

/// Runs `work` for each item in parallel, results in order.
pub(crate) fn each<T: Sync, R: Send>(items: &[T], work: impl Fn(&T) -> R + Sync + Send) -> Vec<R> {
    items.par_iter().map(work).collect()
}
