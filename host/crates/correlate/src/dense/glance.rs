//! What noise and texture say of the subsets, eight at a time: the formulas of [`Solver::verdict`] in
//! single precision.

use super::Share;
use super::nodes::Affine;
use super::pass::{GAIN, ZNCC, outputs};
use super::reference::Layout;
use super::tiling::{LANES, Tiling, moments};
use crate::icgn::Solver;
use crate::sampler::V;
use crate::simd::dispatch;
use crate::uncertainty::MOST_EXCESS;
use fearless_simd::{Level, prelude::*};
use fearless_simd_macros::simd;

/// Planes per eight subsets: number of independent speckles, σ of u and v, largest share of noise in
/// the energy of the gradients.
pub(super) const INDEPENDENT: usize = 0;
pub(super) const SIGMA: [usize; 2] = [1, 2];
pub(super) const EXCESS: usize = 3;
pub(super) const SEEN: usize = 4;

/// All that is common to the points of a run.
pub(super) struct Glance {
    order: usize,
    step: f32,
    radius: f32,
    count: f32,
    /// Variance of the noise, where it is given; and the degrees of freedom from which it is
    /// estimated where not.
    noise: Option<f32>,
    freedom: f32,
    gradient: f32,
    series: [f32; 4],
}

impl Glance {
    pub(super) fn new(solver: &Solver<'_>, tiling: &Tiling, order: usize) -> Self {
        Self {
            order,
            step: tiling.step as f32,
            radius: tiling.radius as f32,
            count: solver.layout.count() as f32,
            noise: solver.settings.noise.map(|s| (s * s) as f32),
            freedom: solver.freedom(solver.layout.count() as f64) as f32,
            gradient: solver.noise.gradient as f32,
            series: solver.noise.series.map(|a| a as f32),
        }
    }

    /// One row of a share's subsets.
    pub(super) fn along(
        &self,
        level: Level,
        affine: &Affine,
        share: &Share,
        line: usize,
        seen: &mut Vec<f32>,
    ) {
        let vectors = share.task.width / LANES;
        seen.resize(vectors * SEEN * LANES, 0.0);
        let size = vectors * outputs(self.order) * LANES;
        let block = vectors * Layout::new(self.order).len() * LANES;
        let out = &share.out[line * size..(line + 1) * size];
        let constants = &share.prepared.constants[line * block..(line + 1) * block];
        let at = [share.task.column as f32 * self.step, (share.task.row + line) as f32 * self.step];
        dispatch!(level, s => look(s, self, affine, at, out, constants, seen));
    }
}

#[simd]
fn look<S: Simd>(
    s: S,
    glance: &Glance,
    affine: &Affine,
    [x, y]: [f32; 2],
    out: &[f32],
    constants: &[f32],
    seen: &mut [f32],
) {
    let (m, layout) = (moments(glance.order), Layout::new(glance.order));
    let (size, block) = (outputs(glance.order) * LANES, layout.len() * LANES);
    let k = |v: f64| v as f32;
    let [[ma, mb], [mc, md]] = affine.matrix();
    let (a, b) = (affine.u.map(k), affine.v.map(k));
    let matrix = [[k(ma), k(mb)], [k(mc), k(md)]];
    let steps: [f32; LANES] = std::array::from_fn(|l| l as f32 * glance.step);
    let steps = V::from_slice(s, &steps);
    let one = V::splat(s, 1.0);
    let zero = V::splat(s, 0.0);
    let blocks =
        out.chunks_exact(size).zip(constants.chunks_exact(block)).zip(seen.chunks_exact_mut(SEEN * LANES));
    for (group, ((q, c), seen)) in blocks.enumerate() {
        macro_rules! q {
            ($p:expr) => {{
                let o = ($p) * LANES;
                V::from_slice(s, &q[o..o + LANES])
            }};
        }
        macro_rules! constant {
            ($p:expr) => {{
                let o = ($p) * LANES;
                V::from_slice(s, &c[o..o + LANES])
            }};
        }
        let at = steps + V::splat(s, x + (group * LANES) as f32 * glance.step);
        // share of the noise that the interpolation of the deformed image lets through
        let mut passed = one;
        for (own, row) in [a, b].into_iter().zip(matrix) {
            let (r0, r1) = (V::splat(s, row[0]), V::splat(s, row[1]));
            let start = at.mul_add(V::splat(s, own[1]), V::splat(s, own[0] + own[2] * y));
            let d = q!(0).mul_add(r0, q!(m).mul_add(r1, start));
            // over half a subset, the way gradients of parameters in units of the radius are
            let mut slopes = [zero; 2];
            // order 0 has no gradients of its own
            if m > 1 {
                slopes = [V::splat(s, own[1] * glance.radius), V::splat(s, own[2] * glance.radius)];
                for e in 0..2 {
                    slopes[e] = q!(1 + e).mul_add(r0, q!(m + 1 + e).mul_add(r1, slopes[e]));
                }
            }
            passed *= over(s, &glance.series, d, slopes);
        }
        let (sff, zncc, gain) = (constant!(layout.sff()), q!(2 * m + ZNCC), q!(2 * m + GAIN));
        let energy = [constant!(layout.energy(0)), constant!(layout.energy(1))];
        let tiny = V::splat(s, f32::MIN_POSITIVE);
        let texture = (energy[0].max(tiny) * energy[1].max(tiny)).sqrt();
        let independent = texture * V::splat(s, glance.count / std::f32::consts::PI) / sff;
        let gain2 = gain * gain;
        let noise = match glance.noise {
            Some(v) => V::splat(s, v),
            None => {
                let left = (sff + sff) * (one - zncc).max(zero);
                left / (V::splat(s, glance.freedom) * gain2.mul_add(passed, one))
            }
        };
        let mut largest = zero;
        for i in 0..2 {
            let excess = (noise * V::splat(s, glance.count * glance.gradient) / energy[i])
                .min(V::splat(s, MOST_EXCESS as f32));
            largest = largest.max(excess);
            let honest = one - excess;
            let right = gain2.mul_add(excess.mul_add(passed, honest), honest);
            let sigma = (noise * constant!(layout.variance(i)) * right).max(zero).sqrt() / honest;
            sigma.store_slice(&mut seen[SIGMA[i] * LANES..][..LANES]);
        }
        independent.store_slice(&mut seen[INDEPENDENT * LANES..][..LANES]);
        largest.store_slice(&mut seen[EXCESS * LANES..][..LANES]);
    }
}

/// Mean of the series in cos 2πk(c + aξ + bη) over the square |ξ|, |η| ≤ 1.
#[inline(always)]
fn over<S: Simd>(s: S, series: &[f32; 4], c: V<S>, slopes: [V<S>; 2]) -> V<S> {
    let one = cosine(s, c);
    let (mut last, mut now) = (V::splat(s, 1.0), one);
    let mut sum = V::splat(s, series[0]);
    for k in 1..4 {
        let turn = V::splat(s, std::f32::consts::TAU * k as f32);
        let spread = sinc(s, turn * slopes[0]) * sinc(s, turn * slopes[1]);
        sum = (V::splat(s, series[k]) * now).mul_add(spread, sum);
        let next = (one + one).mul_add(now, V::splat(s, 0.0) - last);
        last = now;
        now = next;
    }
    sum
}

/// cos 2πt.
#[inline(always)]
fn cosine<S: Simd>(s: S, t: V<S>) -> V<S> {
    let f = t - t.floor();
    let turn = (V::splat(s, 0.25) - f.min(V::splat(s, 1.0) - f)) * V::splat(s, std::f32::consts::TAU);
    turn * odd(s, turn * turn)
}

/// sin x / x up to |x| = 3, where it is 0.05; nothing beyond: a subset over which the phase of the
/// interpolation turns that often sees the mean.
#[inline(always)]
fn sinc<S: Simd>(s: S, x: V<S>) -> V<S> {
    let q = x * x;
    q.simd_le(V::splat(s, 9.0)).select(odd(s, q), V::splat(s, 0.0))
}

/// sin √q / √q by its Taylor series.
#[inline(always)]
fn odd<S: Simd>(s: S, q: V<S>) -> V<S> {
    let mut p = V::splat(s, -1.0 / 39_916_800.0);
    for c in [1.0 / 362_880.0, -1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0, 1.0] {
        p = p.mul_add(q, V::splat(s, c));
    }
    p
}
