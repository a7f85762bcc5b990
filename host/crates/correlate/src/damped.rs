//! Levenberg–Marquardt where Gauss–Newton diverges (Marquardt, SIAM J. Appl. Math. 11 (1963) 431; for
//! subsets: Chen et al., Opt. Lasers Eng. 88 (2017) 207).
//!
//! Far from the answer the deformation parameters fit anything but the deformation, so they are
//! damped more than the displacement. Steps that do not lower the criterion are not taken. It
//! only brings a point near its answer: Gauss–Newton ends the work, so both have the same fixed
//! point.

use crate::icgn::{Fit, OVERHANG, Scratch, Solver, edge_motion, increment, residuals};
use crate::normal::Normal;
use crate::shape::Warp;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

/// First damping, relative to the diagonal of the normal matrix, and its change after a step that
/// was taken and one that was not.
const START: f64 = 0.1;
const EASIER: f64 = 0.25;
const HARDER: f64 = 4.0;
/// Damping beyond which nothing can be gained any more.
const STUCK: f64 = 1e4;
/// How much more the deformation parameters are damped.
const DEFORMATION: f64 = 20.0;
/// Motion of the subset's edge, pixels, below which Gauss–Newton takes over.
const NEAR: f64 = 0.1;

/// Descends from `guess`; the loaded subset must be that around (x, y). Returns where it got and the
/// sweeps it took, or nothing where the criterion could not be lowered.
#[simd]
pub(crate) fn descend<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    solver: &Solver<'_>,
    scratch: &mut Scratch,
    x: i32,
    y: i32,
    guess: &Warp,
) -> Option<(Warp, u16)> {
    let settings = solver.settings;
    let m = settings.shape.parameters_per_component();
    let r = solver.layout.radius as f64;
    let Scratch { subset, warped, .. } = scratch;
    let n = subset.count as f64;
    let matrix = Normal::matrix(subset, m, n);
    let mut warp = guess.restricted(settings.shape);
    if !solver.inside(x, y, subset.extent, &warp, OVERHANG) {
        return None;
    }
    let mut sums = residuals::<S, N, N1, O>(s, solver, subset, warped, x, y, &warp);
    let mut fit = Fit::new(subset, &sums, settings.criterion)?;
    let first = fit.energy;
    let mut damping = START;
    let mut sweeps = 1;
    while u32::from(sweeps) < settings.max_iterations && damping < STUCK {
        let mut h = matrix;
        for c in 0..2 {
            for k in 0..m {
                h[c * m + k][c * m + k] *= 1.0 + damping * if k == 0 { 1.0 } else { DEFORMATION };
            }
        }
        let Some(normal) = Normal::factor(h, 2 * m) else {
            damping *= HARDER;
            continue;
        };
        let step = increment(subset, &normal, &sums, &fit, m, r);
        let next = warp.updated(&step).filter(|w| {
            let far = (w.0[0][0] - guess.0[0][0]).abs().max((w.0[1][0] - guess.0[1][0]).abs());
            far <= r && solver.inside(x, y, subset.extent, w, OVERHANG)
        });
        let tried = next.and_then(|w| {
            let sums = residuals::<S, N, N1, O>(s, solver, subset, warped, x, y, &w);
            Some((w, sums, Fit::new(subset, &sums, settings.criterion)?))
        });
        sweeps += u16::from(next.is_some());
        match tried {
            Some((w, q, f)) if f.energy < fit.energy => {
                (warp, sums, fit) = (w, q, f);
                damping *= EASIER;
                if edge_motion(&step, r) < NEAR {
                    break;
                }
            }
            _ => damping *= HARDER,
        }
    }
    (fit.energy < first).then_some((warp, sweeps))
}
