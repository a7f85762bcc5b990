//! Inverse-compositional Gauss–Newton for one point (Pan, Li & Tong, Exp. Mech. 53 (2013) 1277;
//! second order: Gao et al., Opt. Lasers Eng. 65 (2015) 73), criterion ZNSSD or ZSSD.

use crate::damped::descend;
use crate::domain::{Coverage, Cut, Domain, extent};
use crate::kernel::{Sampling, Sums, sweep};
use crate::noise::NoiseGain;
use crate::normal::{EXPONENTS, MAX, Normal};
use crate::plane::PAD;
use crate::point::{SolvedBy, Status};
use crate::prepared::{Reference, Target};
use crate::scalar;
use crate::settings::{Criterion, Interpolation, Settings};
use crate::shape::{Shape, Warp};
use crate::simd::dispatch;
use crate::subset::{Layout, Subset};
use fearless_simd::{Level, prelude::*};
use fearless_simd_macros::simd;

/// How far, in pixels, the iteration may overhang the deformed image before it is given up; the
/// padding holds mirrored grey levels there.
pub(crate) const OVERHANG: f64 = (PAD - 12) as f64;
/// How far a converged subset may overhang: half a pixel, so that noise does not decide on
/// subsets which touch the border.
pub(crate) const BORDER: f64 = 0.5;

/// Share of noise in the energy of the gradients above which it is taken out of the normal matrix.
const EXCESS: f64 = 0.1;
/// Largest such share that can be told from all of it.
pub(crate) const MOST_EXCESS: f64 = 0.8;

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
    fn cut(&self, x: i32, y: i32, cut: &mut Cut) -> bool {
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

    /// Whether the subset around (x, y), displaced by `warp`, clearly leaves the deformed image.
    pub(crate) fn leaves(&self, x: i32, y: i32, warp: &Warp) -> bool {
        let r = self.layout.radius as f64;
        let mut cut = Cut::new();
        self.cut(x, y, &mut cut);
        let used = if cut.is_empty() { [-r, r, -r, r] } else { extent(&cut, self.layout.radius) };
        !self.inside(x, y, used, warp, 2.0)
    }

    /// Whether the warped subset, of which the box `[ξ0, ξ1, η0, η1]` is used, stays within `margin`
    /// pixels of the deformed image.
    pub(crate) fn inside(
        &self,
        x: i32,
        y: i32,
        [x0, x1, y0, y1]: [f64; 4],
        warp: &Warp,
        margin: f64,
    ) -> bool {
        let w = self.target.image.width() as f64 - 1.0 + margin;
        let h = self.target.image.height() as f64 - 1.0 + margin;
        let r = self.layout.radius as f64;
        // most subsets are far from every edge
        let reach = |c: &[f64; 6]| {
            let [_, a, b, d, e, f] = c.map(f64::abs);
            r * (1.0 + a + b + r * (d + e + f))
        };
        let place = |p: i32, d: f64, reach: f64, size: f64| {
            let p = f64::from(p) + d;
            p - reach >= -margin && p + reach <= size
        };
        let [u, v] = &warp.0;
        if place(x, u[0], reach(u), w) && place(y, v[0], reach(v), h) {
            return true;
        }
        [y0, 0.5 * (y0 + y1), y1].iter().all(|&eta| {
            [x0, 0.5 * (x0 + x1), x1].iter().all(|&xi| {
                let d = warp.at(xi, eta);
                let (px, py) = (f64::from(x) + xi + d[0], f64::from(y) + eta + d[1]);
                px >= -margin && py >= -margin && px <= w && py <= h
            })
        })
    }

    /// ZNCC that unrelated speckles of the subset's size reach only with the chosen significance.
    fn threshold(&self, independent: f64) -> f64 {
        // small subsets would need more than noise leaves them: their neighbours judge them
        significant(self.settings.significance, independent).min(0.9).max(self.settings.min_zncc)
    }

    /// Whether a ZNCC reaches [`Solver::threshold`].
    #[inline(always)]
    pub(crate) fn clears(&self, zncc: f64, independent: f64) -> bool {
        // tanh x < x saves nearly all points the function
        let above = zncc >= self.settings.min_zncc;
        let x2 = self.settings.significance.powi(2) / (independent - 3.0).max(1.0);
        (above && zncc > 0.0 && zncc * zncc >= x2) || zncc >= self.threshold(independent)
    }

    /// Judges a converged subset by itself: independent speckles and standard uncertainties where it
    /// is accepted.
    #[inline(always)]
    pub(crate) fn verdict(
        &self,
        (x, y): (i32, i32),
        warp: &Warp,
        numbers: &Numbers,
    ) -> Result<Accepted, Status> {
        let independent = self.independent(numbers);
        if !self.inside(x, y, numbers.extent, warp, BORDER) {
            Err(Status::OutOfImage)
        } else if !self.clears(numbers.zncc, independent) {
            Err(Status::LowCorrelation)
        } else if !warp.stretches_less(self.settings.max_log_stretch) {
            Err(Status::Distorted)
        } else {
            let (sigma, excess) = self.sigma(warp, numbers);
            Ok(Accepted { independent, sigma, excess })
        }
    }

    /// Number of independent speckles in the subset: two unrelated fields of correlation lengths s
    /// (autocorrelation exp(−d²/2s²) each, s² = Σf²/Σf_x²) have a ZNCC of variance π s_x s_y / n
    /// over n pixels.
    fn independent(&self, numbers: &Numbers) -> f64 {
        let n = numbers.count;
        let [gxx, gyy] = numbers.energy.map(|e| e.max(f64::MIN_POSITIVE));
        n * (gxx * gyy).sqrt() / (std::f64::consts::PI * numbers.sff)
    }

    /// Standard uncertainties of u and v; the offset of the grey levels is free, and so is their gain
    /// unless the criterion fixes it.
    fn sigma(&self, warp: &Warp, numbers: &Numbers) -> ([f32; 2], f64) {
        let n = numbers.count;
        let r = self.layout.radius as f64;
        let Numbers { energy, variance, gain, .. } = *numbers;
        let gain2 = gain * gain;
        // share of the noise that the interpolation of the deformed image lets through
        let passed = self.noise.interpolated_over(warp, r);
        let noise = self.noise_variance(numbers, passed);
        let mut out = [f32::NAN; 2];
        let mut largest = 0.0f64;
        for (c, o) in out.iter_mut().enumerate() {
            // Noise in the gradients makes the normal matrix H look better than it is: the true one is
            // H₀ = H (1 − excess). The right-hand side is Σ G (n_f − gain n_g). The reference's own
            // product of noise and gradient noise sums to nothing, which leaves s² H₀. The deformed
            // image's noise meets true gradients, which lie where the spline passes all, and those of
            // noise, of which it passes what it passes of white noise (to 0.3 % of it; cubic: 6 %).
            let excess = (n * self.noise.gradient * noise / energy[c]).min(MOST_EXCESS);
            largest = largest.max(excess);
            let honest = 1.0 - excess;
            let right = honest + gain2 * (honest + excess * passed);
            *o = (noise * variance[c] * right).max(0.0).sqrt() as f32 / honest as f32;
        }
        (out, largest)
    }

    /// Variance of the noise of one image, the same in both; `passed` is the share of it that the
    /// interpolation lets through.
    fn noise_variance(&self, numbers: &Numbers, passed: f64) -> f64 {
        match self.settings.noise {
            Some(s) => s * s,
            None => {
                let spread = 1.0 + numbers.gain * numbers.gain * passed;
                numbers.left.max(0.0) / self.freedom(numbers.count) / spread
            }
        }
    }

    /// Degrees of freedom of the residuals of a subset of `count` pixels.
    pub(crate) fn freedom(&self, count: f64) -> f64 {
        let m = self.settings.shape.parameters_per_component();
        // offset, and gain where it is free
        let levels = if self.settings.criterion == Criterion::Znssd { 2.0 } else { 1.0 };
        (count - levels - 2.0 * m as f64).max(1.0)
    }

    /// As [`Solver::sigma`] where noise makes up so much of the gradients that its part of the normal
    /// matrix, Γ s² Φ, cannot be treated as a small share of each element: it is taken out of the
    /// matrix itself. Φ are the moments of the monomials, Γ the gradient filter's noise gain.
    /// `None` where next to nothing is left of it.
    fn sigma_in_noise(
        &self,
        subset: &Subset,
        warp: &Warp,
        offset: [f64; 2],
        numbers: &Numbers,
    ) -> Option<[f32; 2]> {
        let n = numbers.count;
        let r = self.layout.radius as f64;
        let m = self.settings.shape.parameters_per_component();
        let gain2 = numbers.gain * numbers.gain;
        let passed = self.noise.interpolated_over(warp, r);
        let noise = self.noise_variance(numbers, passed);
        let moments = self.moments(subset);
        let mut true_matrix = Normal::matrix(subset, m, n);
        let mut of_noise = [[0.0; MAX]; MAX];
        for a in 0..m {
            for b in 0..=a {
                let ((ia, ja), (ib, jb)) = (EXPONENTS[a], EXPONENTS[b]);
                let phi = self.noise.gradient * noise * moments[ia + ib][ja + jb];
                for c in 0..2 {
                    true_matrix[c * m + a][c * m + b] -= phi;
                    of_noise[c * m + a][c * m + b] = phi;
                    of_noise[c * m + b][c * m + a] = phi;
                }
            }
        }
        let normal = Normal::factor(true_matrix, 2 * m)?;
        // next to nothing left of a combination of parameters: what is left is chance itself
        if normal.least_part_of(&Normal::new(subset, m, n)?) < 1.0 - MOST_EXCESS {
            return None;
        }
        let variance = self.variance(subset, &normal, offset);
        let basis = self.basis(offset);
        let mut out = [f32::NAN; 2];
        for (c, o) in out.iter_mut().enumerate() {
            let mut b = [0.0; MAX];
            b[c * m..c * m + m].copy_from_slice(&basis[..m]);
            let x = normal.solve(b);
            let met: f64 =
                (0..2 * m).map(|i| x[i] * (0..2 * m).map(|k| of_noise[i][k] * x[k]).sum::<f64>()).sum();
            *o = (noise * ((1.0 + gain2) * variance[c] + gain2 * passed * met)).max(0.0).sqrt() as f32;
        }
        Some(out)
    }

    /// Σ ξ^i η^j over the pixels used, in units of the radius.
    fn moments(&self, subset: &Subset) -> [[f64; 5]; 5] {
        let r = self.layout.radius as i32;
        let mut cut = Cut::new();
        if let Some((x, y)) = subset.centre {
            self.cut(x, y, &mut cut);
        }
        let powers = |x: i32| -> [f64; 5] {
            let x = f64::from(x) / f64::from(r);
            std::array::from_fn(|i| x.powi(i as i32))
        };
        let mut sums = [[0.0; 5]; 5];
        for (j, eta) in (-r..=r).enumerate() {
            let mut row = [0.0; 5];
            for (i, xi) in (-r..=r).enumerate() {
                if cut.is_empty() || cut[j * self.layout.width + i] {
                    row.iter_mut().zip(powers(xi)).for_each(|(s, p)| *s += p);
                }
            }
            let eta = powers(eta);
            for i in 0..5 {
                for k in 0..5 {
                    sums[i][k] += row[i] * eta[k];
                }
            }
        }
        sums
    }

    /// Monomials at an offset from the centre.
    fn basis(&self, offset: [f64; 2]) -> [f64; 6] {
        let r = self.layout.radius as f64;
        let (dx, dy) = (offset[0] / r, offset[1] / r);
        [1.0, dx, dy, dx * dx, dx * dy, dy * dy]
    }

    /// Variances of u and v at an offset from the centre per unit of residual variance, from the
    /// inverse normal matrix; the offset of the grey levels is free, and so is their gain unless the
    /// criterion fixes it.
    fn variance(&self, subset: &Subset, normal: &Normal, offset: [f64; 2]) -> [f64; 2] {
        let m = self.settings.shape.parameters_per_component();
        let basis = self.basis(offset);
        let mut slopes_f = [0.0; MAX];
        slopes_f[..m].copy_from_slice(&subset.slopes_f[0][..m]);
        slopes_f[m..2 * m].copy_from_slice(&subset.slopes_f[1][..m]);
        let coupled = normal.solve(slopes_f);
        [0, 1].map(|c| {
            let mut b = [0.0; MAX];
            b[c * m..c * m + m].copy_from_slice(&basis[..m]);
            let own = normal.quadratic_form(b);
            let through_gain: f64 = b.iter().zip(&coupled).map(|(a, e)| a * e).sum();
            match self.settings.criterion {
                Criterion::Znssd => own + through_gain * through_gain / subset.sff,
                Criterion::Zssd => own,
            }
        })
    }
}

/// What is known of a subset that is accepted by itself.
pub(crate) struct Accepted {
    /// Independent speckles.
    pub(crate) independent: f64,
    /// Standard uncertainties of u and v.
    pub(crate) sigma: [f32; 2],
    /// Share of noise in the energy of the gradients, the larger one of x and y.
    pub(crate) excess: f64,
}

/// What a verdict on a subset rests on.
pub(crate) struct Numbers {
    /// Pixels used, and their bounding box: smallest and largest ξ and η.
    pub(crate) count: f64,
    pub(crate) extent: [f64; 4],
    /// Σ (f − mean)².
    pub(crate) sff: f64,
    /// Σ fx², Σ fy².
    pub(crate) energy: [f64; 2],
    /// Variances of u and v per unit of residual variance.
    pub(crate) variance: [f64; 2],
    pub(crate) zncc: f64,
    /// From deformed to reference grey levels.
    pub(crate) gain: f64,
    /// Σ of the squared residuals.
    pub(crate) left: f64,
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
    let Scratch { subset, normal, warped, fit, .. } = scratch;
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
                    out.sigma = solver.sigma_in_noise(subset, &warp, offset, &numbers).unwrap_or(a.sigma);
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

/// ZNCC that lies `sigmas` standard deviations above chance (Fisher's z).
pub(crate) fn significant(sigmas: f64, independent: f64) -> f64 {
    (sigmas / (independent - 3.0).max(1.0).sqrt()).tanh()
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
