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

    /// Propagates the field of the buffers (`[y][x]`, overwritten) and hands the columns `keep` of the result to
    /// `column`, each as (place in `keep`, samples of all rows).
    pub(crate) fn propagate(
        &self,
        buffers: &mut Buffers,
        keep: std::ops::Range<usize>,
        mut column: impl FnMut(usize, &[Complex64]),
    ) {
        let [ny, nx] = self.size;
        let Buffers { field, band, scratch } = buffers;
        let plans = self.forward.iter().chain(&self.inverse);
        let needed = plans.map(|p| p.get_inplace_scratch_len()).max().unwrap_or(0);
        scratch.resize(needed, Complex64::default());
        band.resize(BAND * ny, Complex64::default());
        let convolve =
            |a: usize, line: &mut [Complex64], transfer: &[Complex64], scratch: &mut [Complex64]| {
                self.forward[a].process_with_scratch(line, scratch);
                for (v, t) in line.iter_mut().zip(transfer) {
                    *v *= t;
                }
                self.inverse[a].process_with_scratch(line, scratch);
            };
        if let Some([ty, tx]) = &self.separable {
            for row in field.chunks_exact_mut(nx) {
                convolve(1, row, tx, scratch);
            }
            for first in keep.clone().step_by(BAND) {
                let count = BAND.min(keep.end - first);
                cut(field, nx, first, count, band);
                for (i, line) in band.chunks_exact_mut(ny).take(count).enumerate() {
                    convolve(0, line, ty, scratch);
                    column(first + i - keep.start, line);
                }
            }
            return;
        }
        for row in field.chunks_exact_mut(nx) {
            self.forward[1].process_with_scratch(row, scratch);
        }
        for first in (0..nx).step_by(BAND) {
            let count = BAND.min(nx - first);
            cut(field, nx, first, count, band);
            for (i, line) in band.chunks_exact_mut(ny).take(count).enumerate() {
                convolve(0, line, &self.full[(first + i) * ny..][..ny], scratch);
            }
            for (y, row) in field.chunks_exact_mut(nx).enumerate() {
                for (i, v) in row[first..first + count].iter_mut().enumerate() {
                    *v = band[i * ny + y];
                }
            }
        }
        for row in field.chunks_exact_mut(nx) {
            self.inverse[1].process_with_scratch(row, scratch);
        }
        for first in keep.clone().step_by(BAND) {
            let count = BAND.min(keep.end - first);
            cut(field, nx, first, count, band);
            for (i, line) in band.chunks_exact(ny).take(count).enumerate() {
                column(first + i - keep.start, line);
            }
        }
    }
}

/// Columns worked on together.
const BAND: usize = 16;

/// Buffers of a thread: fields are large, and new memory for each would cost more than its transforms.
#[derive(Default)]
pub(crate) struct Buffers {
    /// The field, `[y][x]`.
    pub(crate) field: Vec<Complex64>,
    band: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

/// Copies columns of a matrix, one after the other, into a band.
fn cut(field: &[Complex64], width: usize, first: usize, count: usize, band: &mut [Complex64]) {
    let height = band.len() / BAND;
    for (y, row) in field.chunks_exact(width).enumerate() {
        for (i, v) in row[first..first + count].iter().enumerate() {
            band[i * height + y] = *v;
        }
    }
}

/// Runs `work` for each item in parallel, results in order; a thread's buffers serve many items.
pub(crate) fn each<T: Sync, R: Send>(
    items: &[T],
    work: impl Fn(&mut Buffers, &T) -> R + Sync + Send,
) -> Vec<R> {
    items.par_iter().map_init(Buffers::default, work).collect()
}
