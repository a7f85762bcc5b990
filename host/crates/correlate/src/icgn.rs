//! Inverse-compositional Gauss–Newton for one point (Pan, Li & Tong, Exp. Mech. 53 (2013) 1277;
//! second order: Gao et al., Opt. Lasers Eng. 65 (2015) 73), criterion ZNSSD or ZSSD.

use crate::damped::descend;
use crate::domain::{Coverage, Cut, Domain};
use crate::kernel::{Sampling, Sums, sweep};
use crate::noise::NoiseGain;
use crate::normal::{MAX, Normal};
use crate::plane::PAD;
use crate::point::{SolvedBy, Status};
use crate::prepared::{Reference, Target};
use crate::scalar;
use crate::settings::{Criterion, Interpolation, Settings};
use crate::shape::{Shape, Warp};
use crate::simd::dispatch;
use crate::subset::{Layout, Subset};
use crate::uncertainty::EXCESS;
use crate::verdict::Numbers;
use fearless_simd::{Level, prelude::*};
use fearless_simd_macros::simd;

/// How far, in pixels, the iteration may overhang the deformed image before it is given up; the
/// padding holds mirrored grey levels there.
pub(crate) const OVERHANG: f64 = (PAD - 12) as f64;
/// All that is common to the points of one run.
pub(crate) struct Solver<'a> {
    pub(crate) reference: &'a Reference,
    pub(crate) target: &'a Target,
    pub(crate) settings: &'a Settings,
    pub(crate) layout: Layout,
    pub(crate) noise: &'static NoiseGain,
    pub(crate) level: Level,
    /// Uses the scalar reference implementation instead of the vector kernels.
    pub(crate) scalar: bool,
    /// Pixels that subsets may use; `None`: all of the image, and whole subsets only.
    pub(crate) domain: Option<&'a Domain>,
}

/// Memory of one thread, used again for every point.
#[derive(Default)]
pub(crate) struct Scratch {
    pub(crate) subset: Subset,
    normal: Option<Normal>,
    pub(crate) warped: Vec<f32>,
    cut: Cut,
    /// How the last subset fitted.
    pub(crate) fit: Fit,
}

/// What the iteration left.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Outcome {
    pub(crate) warp: Warp,
    pub(crate) zncc: f64,
    /// Independent speckles in the reference subset.
    pub(crate) independent: f64,
    pub(crate) iterations: u16,
    /// Converged, or why not; neighbours have not been asked.
    pub(crate) status: Status,
    pub(crate) solver: SolvedBy,
    /// Standard uncertainties of u and v at the asked offset from the centre.
    pub(crate) sigma: [f32; 2],
}

impl Outcome {
    pub(crate) fn failed(status: Status, warp: Warp) -> Self {
        Self {
            warp,
            zncc: f64::NAN,
            independent: f64::NAN,
            iterations: 0,
            status,
            solver: SolvedBy::Exact,
            sigma: [f32::NAN; 2],
        }
    }
}

impl<'a> Solver<'a> {
    pub(crate) fn new(
        reference: &'a Reference,
        target: &'a Target,
        settings: &'a Settings,
        level: Level,
    ) -> Self {
        Self {
            reference,
            target,
            settings,
            layout: Layout::new(settings.radius()),
            noise: NoiseGain::of(target.interpolation),
            level,
            scalar: false,
            domain: None,
        }
    }

    /// How much of the subset around (x, y) may be used.
    pub(crate) fn coverage(&self, x: i32, y: i32) -> Coverage {
        let r = self.layout.radius as i32;
        if let Some(domain) = self.domain {
            return domain.coverage(x, y, r);
        }
        let (w, h) = (self.reference.image.width(), self.reference.image.height());
        let whole = x >= r && y >= r && x + r < w as i32 && y + r < h as i32;
        if whole { Coverage::Whole } else { Coverage::Outside }
    }

    /// Whether the subset around (x, y), or enough of it, lies where it may.
    pub(crate) fn fits(&self, x: i32, y: i32) -> bool {
        self.coverage(x, y) != Coverage::Outside
    }

    /// Fills in which pixels of the subset around (x, y) are used; whether there are enough.
    pub(crate) fn cut(&self, x: i32, y: i32, cut: &mut Cut) -> bool {
        cut.clear();
        let coverage = self.coverage(x, y);
        if let (Coverage::Cut, Some(domain)) = (coverage, self.domain) {
            domain.cut(x, y, self.layout.radius as i32, cut);
        }
        coverage != Coverage::Outside
    }

    /// Optimises the subset around pixel (x, y) from `guess`; uncertainties are stated at
    /// `offset` from that pixel.
    pub(crate) fn solve(
        &self,
        scratch: &mut Scratch,
        (x, y): (i32, i32),
        offset: [f64; 2],
        guess: &Warp,
    ) -> Outcome {
        if !self.cut(x, y, &mut scratch.cut) {
            return Outcome::failed(Status::OutOfImage, *guess);
        }
        self.optimise(scratch, (x, y), offset, guess)
    }

    /// As [`Solver::solve`] with a part of the subset, given row by row.
    pub(crate) fn solve_part(
        &self,
        scratch: &mut Scratch,
        (x, y): (i32, i32),
        offset: [f64; 2],
        guess: &Warp,
        part: &[bool],
    ) -> Outcome {
        if !self.cut(x, y, &mut scratch.cut) {
            return Outcome::failed(Status::OutOfImage, *guess);
        }
        if scratch.cut.is_empty() {
            scratch.cut.extend_from_slice(part);
        } else {
            scratch.cut.iter_mut().zip(part).for_each(|(c, p)| *c &= p);
        }
        // the scratch knows subsets by their centre alone
        scratch.subset.centre = None;
        let out = self.optimise(scratch, (x, y), offset, guess);
        scratch.subset.centre = None;
        out
    }

    /// Warps the subset around (x, y) without optimising; the scratch keeps it and the interpolated
    /// grey levels. Nothing where it does not lie in the images or is flat.
    pub(crate) fn look(&self, scratch: &mut Scratch, (x, y): (i32, i32), warp: &Warp) -> Option<Fit> {
        if !self.cut(x, y, &mut scratch.cut) {
            return None;
        }
        use Interpolation::{Cubic, Quintic, Septic};
        use Shape::{Affine, Quadratic, Translation};
        let l = self.level;
        macro_rules! run {
            ($n:literal, $n1:literal, $o:literal) => {
                dispatch!(l, s => look::<_, $n, $n1, $o>(s, self, scratch, x, y, warp))
            };
        }
        match (self.target.interpolation, self.settings.shape) {
            (Septic, Translation) => run!(8, 9, 0),
            (Septic, Affine) => run!(8, 9, 1),
            (Septic, Quadratic) => run!(8, 9, 2),
            (Quintic, Translation) => run!(6, 7, 0),
            (Quintic, Affine) => run!(6, 7, 1),
            (Quintic, Quadratic) => run!(6, 7, 2),
            (Cubic, Translation) => run!(4, 5, 0),
            (Cubic, Affine) => run!(4, 5, 1),
            (Cubic, Quadratic) => run!(4, 5, 2),
        }
    }

    fn optimise(&self, scratch: &mut Scratch, (x, y): (i32, i32), offset: [f64; 2], guess: &Warp) -> Outcome {
        use Interpolation::{Cubic, Quintic, Septic};
        use Shape::{Affine, Quadratic, Translation};
        let l = self.level;
        macro_rules! run {
            ($n:literal, $n1:literal, $o:literal) => {
                dispatch!(l, s => attempt::<_, $n, $n1, $o>(s, self, scratch, x, y, offset, guess))
            };
        }
        match (self.target.interpolation, self.settings.shape) {
            (Septic, Translation) => run!(8, 9, 0),
            (Septic, Affine) => run!(8, 9, 1),
            (Septic, Quadratic) => run!(8, 9, 2),
            (Quintic, Translation) => run!(6, 7, 0),
            (Quintic, Affine) => run!(6, 7, 1),
            (Quintic, Quadratic) => run!(6, 7, 2),
            (Cubic, Translation) => run!(4, 5, 0),
            (Cubic, Affine) => run!(4, 5, 1),
            (Cubic, Quadratic) => run!(4, 5, 2),
        }
    }

    /// Packs the subset around (x, y) into the scratch without iterating.
    pub(crate) fn load(&self, scratch: &mut Scratch, x: i32, y: i32) {
        if scratch.subset.centre == Some((x, y)) {
            return;
        }
        self.cut(x, y, &mut scratch.cut);
        dispatch!(self.level, s => load_translation(s, self, scratch, x, y));
        // only the moments of order 0 were summed: the iteration must load again
        scratch.normal = None;
        scratch.subset.centre = None;
    }
}

#[simd]
fn load_translation<S: Simd>(s: S, solver: &Solver<'_>, scratch: &mut Scratch, x: i32, y: i32) {
    scratch.subset.load::<S, 0>(s, &solver.layout, solver.reference, x, y, &scratch.cut);
}

/// Packs the subset around (x, y) with its normal matrix, unless the scratch holds it already.
#[simd]
fn load<S: Simd, const O: usize>(s: S, solver: &Solver<'_>, scratch: &mut Scratch, x: i32, y: i32) {
    if scratch.subset.centre == Some((x, y)) {
        return;
    }
    let Scratch { subset, cut, .. } = scratch;
    if solver.scalar {
        scalar::load(subset, &solver.layout, solver.reference, x, y, O, cut);
    } else {
        subset.load::<S, O>(s, &solver.layout, solver.reference, x, y, cut);
    }
    let m = solver.settings.shape.parameters_per_component();
    scratch.normal = Normal::new(subset, m, subset.count as f64);
}

#[simd]
fn look<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    solver: &Solver<'_>,
    scratch: &mut Scratch,
    x: i32,
    y: i32,
    warp: &Warp,
) -> Option<Fit> {
    load::<S, O>(s, solver, scratch, x, y);
    let Scratch { subset, warped, .. } = scratch;
    let warp = warp.restricted(solver.settings.shape);
    if !solver.inside(x, y, subset.extent, &warp, OVERHANG) {
        return None;
    }
    let sums = residuals::<S, N, N1, O>(s, solver, subset, warped, x, y, &warp);
    Fit::new(subset, &sums, solver.settings.criterion)
}

/// Gauss–Newton, and from the same guess Levenberg–Marquardt and Gauss–Newton where it diverges.
#[simd]
fn attempt<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    solver: &Solver<'_>,
    scratch: &mut Scratch,
    x: i32,
    y: i32,
    offset: [f64; 2],
    guess: &Warp,
) -> Outcome {
    let plain = iterate::<S, N, N1, O>(s, solver, scratch, x, y, offset, guess);
    let diverged = match plain.status {
        Status::NotConverged | Status::Distorted => true,
        Status::OutOfImage => plain.iterations > 0,
        _ => false,
    };
    if !(diverged && solver.settings.fallback) {
        return plain;
    }
    let Some((near, sweeps)) = descend::<S, N, N1, O>(s, solver, scratch, x, y, guess) else {
        return plain;
    };
    let mut again = iterate::<S, N, N1, O>(s, solver, scratch, x, y, offset, &near);
    again.iterations += sweeps;
    if again.status == Status::Converged { again } else { plain }
}

#[simd]
fn iterate<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    solver: &Solver<'_>,
    scratch: &mut Scratch,
    x: i32,
    y: i32,
    offset: [f64; 2],
    guess: &Warp,
) -> Outcome {
    let settings = solver.settings;
    let layout = &solver.layout;
    let m = settings.shape.parameters_per_component();
    let r = layout.radius as f64;
    let mut warp = guess.restricted(settings.shape);
    load::<S, O>(s, solver, scratch, x, y);
    let Scratch { subset, normal, warped, fit, cut } = scratch;
    // rounding of single precision over the subset's grey range
    let floor = 1e-10 * subset.count as f64 * subset.mean * subset.mean;
    if subset.sff <= floor {
        return Outcome::failed(Status::LowTexture, warp);
    }
    let Some(normal) = normal else {
        return Outcome::failed(Status::Singular, warp);
    };
    let mut out = Outcome::failed(Status::NotConverged, warp);
    *fit = Fit::default();
    while u32::from(out.iterations) < settings.max_iterations {
        if !solver.inside(x, y, subset.extent, &warp, OVERHANG) {
            out.status = Status::OutOfImage;
            break;
        }
        let far = (warp.0[0][0] - guess.0[0][0]).abs().max((warp.0[1][0] - guess.0[1][0]).abs());
        if far > r {
            break;
        }
        let sums = residuals::<S, N, N1, O>(s, solver, subset, warped, x, y, &warp);
        let Some(f) = Fit::new(subset, &sums, settings.criterion) else {
            break;
        };
        let increment = increment(subset, normal, &sums, &f, m, r);
        *fit = f;
        out.zncc = f.zncc;
        out.iterations += 1;
        let Some(next) = warp.updated(&increment) else {
            break;
        };
        warp = next;
        if edge_motion(&increment, r) < settings.tolerance {
            out.status = Status::Converged;
            break;
        }
    }
    out.warp = warp;
    if out.status == Status::Converged {
        let numbers = Numbers {
            count: subset.count as f64,
            extent: subset.extent,
            sff: subset.sff,
            energy: [subset.products[0][0], subset.products[2][0]],
            variance: solver.variance(subset, normal, offset),
            zncc: fit.zncc,
            gain: fit.gain,
            left: fit.energy,
        };
        match solver.verdict((x, y), &warp, &numbers) {
            Ok(a) => {
                (out.independent, out.sigma) = (a.independent, a.sigma);
                if a.excess > EXCESS {
                    out.sigma =
                        solver.sigma_in_noise((subset, cut), &warp, offset, &numbers).unwrap_or(a.sigma);
                }
            }
            Err(status) => out.status = status,
        }
    }
    out
}

/// Sums of the residual with the subset warped.
#[simd]
pub(crate) fn residuals<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    solver: &Solver<'_>,
    subset: &Subset,
    warped: &mut Vec<f32>,
    x: i32,
    y: i32,
    warp: &Warp,
) -> Sums {
    let base = [warp.0[0][0].round(), warp.0[1][0].round()];
    let mut at = Sampling {
        x: x + base[0] as i32,
        y: y + base[1] as i32,
        u: warp.0[0],
        v: warp.0[1],
        mean: (subset.mean - f64::from(solver.target.offset)) as f32,
    };
    at.u[0] -= base[0];
    at.v[0] -= base[1];
    let plane = &solver.target.coefficients;
    if solver.scalar {
        scalar::sweep(&solver.layout, subset, plane, &at, N, O, warped)
    } else {
        sweep::<S, N, N1, O>(s, &solver.layout, subset, plane, &at, warped)
    }
}

/// How well the warped subset fits, and the grey levels that fit it best.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Fit {
    pub(crate) zncc: f64,
    /// From deformed to reference grey levels.
    pub(crate) gain: f64,
    /// Mean of the residual f − g.
    pub(crate) mean: f64,
    /// Σ (f − f̄ − gain (g − ḡ))²: what is minimised, in grey levels.
    pub(crate) energy: f64,
}

impl Fit {
    /// `None` where the warped subset is flat.
    pub(crate) fn new(subset: &Subset, sums: &Sums, criterion: Criterion) -> Option<Self> {
        let mean = sums.q / subset.count as f64;
        let sff = subset.sff;
        let sfg = sff - sums.fq;
        let sqq = sums.qq - sums.q * mean;
        let sgg = sff - 2.0 * sums.fq + sqq;
        if !(sgg > 1e-9 * sff && sgg.is_finite()) {
            return None;
        }
        let zncc = sfg / (sff * sgg).sqrt();
        Some(match criterion {
            // Ratio of the standard deviations, not the regression of f on g: noise in g biases the
            // latter.
            Criterion::Znssd => {
                Self { zncc, gain: (sff / sgg).sqrt(), mean, energy: 2.0 * sff * (1.0 - zncc) }
            }
            Criterion::Zssd => Self { zncc, gain: 1.0, mean, energy: sqq },
        })
    }
}

/// Increment in pixels.
pub(crate) fn increment(subset: &Subset, normal: &Normal, sums: &Sums, fit: &Fit, m: usize, r: f64) -> Warp {
    let Fit { gain, mean, .. } = *fit;
    let mut b = [0.0; MAX];
    for c in 0..2 {
        for k in 0..m {
            b[c * m + k] = (1.0 - gain) * subset.slopes_f[c][k]
                + gain * (sums.slopes[c][k] - mean * subset.slopes[c][k]);
        }
    }
    let d = normal.solve(b);
    // residual f − g = −Gᵀ Δp; back from ξ/r to ξ
    let scale = [1.0, r, r, r * r, r * r, r * r];
    let mut w = [[0.0; 6]; 2];
    for c in 0..2 {
        for k in 0..m {
            w[c][k] = -d[c * m + k] / scale[k];
        }
    }
    Warp(w)
}

/// Norm of an increment as a motion of the subset's edge.
pub(crate) fn edge_motion(increment: &Warp, r: f64) -> f64 {
    let scale = [1.0, r, r, r * r, r * r, r * r];
    increment.0.iter().flat_map(|c| c.iter().zip(&scale).map(|(a, s)| (a * s).powi(2))).sum::<f64>().sqrt()
}
