//! Points whose subset straddles a step, a crack or the edge of an object: found by the structure of
//! their residual, and solved again with the part of the subset on their own side.
//!
//! After the subset splitting of Poissant & Barthelat (Exp. Mech. 50 (2010) 353), with the sides
//! taken from the neighbourhood: a point whose residual is far above that of points a subset away is
//! looked at with the shape functions of the nearest undisturbed points around it. If two of them,
//! each on its side of a straight line, leave no more than noise, or one of them does and nothing
//! explains the rest, the point's own side (less a strip along the line, where the spline mixes both)
//! is solved by itself. A real jump is asked for: both sides are solved, and they must disagree on the
//! line, which those of a smooth field do not.

use crate::correlate::Observer;
use crate::halves::{Halves, Line};
use crate::icgn::{Fit, Outcome, Scratch, Solver};
use crate::point::{SolvedBy, Status};
use crate::points::Points;
use crate::propagate::SCAN;
use crate::shape::Warp;
use rayon::prelude::*;

/// How far above its surroundings' a point's 1 − ZNCC must lie for a closer look.
const SUSPECT: f32 = 3.0;
/// How far above that of the best quarter of all points its surroundings' may lie: more is no
/// matter of contrast any more.
const DISTURBED: f32 = 8.0;
/// Shape functions further apart than this at the point, pixels, are different sides.
const APART: f64 = 0.2;
/// Sides looked at.
const SIDES: usize = 3;
/// 1 − ZNCC that quantisation to 8 bits leaves at good contrast; less is never judged.
const QUANTISED: f32 = 2e-5;
/// Half the strip left out along the line, pixels: there the spline mixes both sides; and where that
/// is not enough, because the edge is not straight or the far side has moved over this one. From the
/// second on, pixels in places that the side does not explain are left out too.
const GUARDS: [f64; 3] = [3.5, 3.5, 7.0];
/// Variance, in that of undisturbed points, that a side's own solution may leave.
const EXPLAINED: f64 = 3.0;
/// Share of the contrast that the spline's ringing along the line adds, and what of it is left beyond
/// the strip.
const RINGING: f64 = 2e-3;
const FADED: f64 = 0.1;
/// Smallest jump between two solved sides, pixels, and how much it must exceed the difference of the
/// gradients of the sides: a smooth field curved enough has gradients that differ by κ times the
/// distance of the sides' middles, and two straight pieces of it miss each other by a multiple.
const JUMP: f64 = 0.15;
const CURVED: f64 = 10.0;
/// The same where the far side is extrapolated from a subset away.
const FAR_JUMP: f64 = 0.5;
const FAR_CURVED: f64 = 30.0;
/// Share of the subset that a side must keep to be solved.
const MIN_SHARE: f64 = 0.2;
/// Directions in which undisturbed points are looked for.
const RAYS: [(isize, isize); 8] = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)];

/// One side of a possible discontinuity, as an undisturbed point near by saw it.
struct Side {
    warp: Warp,
    /// Mean grey levels f̄ and ḡ there, and the gain between them.
    levels: [f64; 3],
    /// Variance of its residual.
    variance: f64,
    /// Residual that it leaves at every pixel of the subset in question.
    map: Vec<f32>,
}

/// Solves again, or marks, the points at discontinuities; the others stay as they are.
pub(crate) fn resolve(
    solver: &Solver<'_>,
    points: &Points,
    outcomes: &mut [Option<Outcome>],
    observer: &dyn Observer,
) {
    let deficits: Vec<f32> = outcomes.par_iter().with_min_len(SCAN).map(deficit).collect();
    let Some(suspect) = suspects(solver, points, &deficits, outcomes) else {
        return;
    };
    let which: Vec<usize> = (0..suspect.len()).filter(|&k| suspect[k]).collect();
    let seen: &[Option<Outcome>] = outcomes;
    let found: Vec<Option<Outcome>> = which
        .par_iter()
        .with_min_len(4)
        .map_init(
            || (Scratch::default(), Halves::default()),
            |(scratch, halves), &k| {
                if observer.cancelled() {
                    return None;
                }
                Look { solver, points, outcomes: seen, suspect: &suspect }.at(scratch, halves, k)
            },
        )
        .collect();
    for (k, o) in which.into_iter().zip(found) {
        if o.is_some() {
            outcomes[k] = o;
        }
    }
}

/// 1 − ZNCC of an accepted point, infinite for any other.
fn deficit(o: &Option<Outcome>) -> f32 {
    match o {
        Some(o) if o.status == Status::Converged => (1.0 - o.zncc).max(0.0) as f32,
        _ => f32::INFINITY,
    }
}

/// Nodes of the grid to a full subset's width.
fn reach(solver: &Solver<'_>, step: usize) -> isize {
    (solver.layout.width + 1).div_ceil(step) as isize
}

/// Which points deserve a closer look; `None` if there is none.
fn suspects(
    solver: &Solver<'_>,
    points: &Points,
    deficits: &[f32],
    outcomes: &[Option<Outcome>],
) -> Option<Vec<bool>> {
    let mut sorted: Vec<f32> = deficits.iter().copied().filter(|d| d.is_finite()).collect();
    if sorted.is_empty() {
        return None;
    }
    let quarter = sorted.len() / 4;
    let usual = sorted.select_nth_unstable_by(quarter, f32::total_cmp).1.max(QUANTISED);
    let mut suspect = vec![false; deficits.len()];
    let judge = |k: usize, level: f32| match outcomes[k].map(|o| o.status) {
        Some(Status::Converged) => deficits[k] > SUSPECT * level,
        None | Some(Status::NotConverged | Status::LowCorrelation | Status::Distorted | Status::NoGuess) => {
            true
        }
        _ => false,
    };
    match points.as_grid() {
        None => suspect.iter_mut().enumerate().for_each(|(k, s)| *s = judge(k, usual)),
        Some(grid) => {
            let away = reach(solver, grid.step);
            let of_row = |j: usize| {
                let mut found = Vec::new();
                for i in 0..grid.columns {
                    let Some(k) = grid.point(i, j) else {
                        continue;
                    };
                    if deficits[k] <= usual {
                        continue;
                    }
                    // the second lowest around: one may be chance
                    let mut low = [f32::INFINITY; 2];
                    for (a, b) in RAYS {
                        let node = i.checked_add_signed(a * away).zip(j.checked_add_signed(b * away));
                        let Some(c) = node.and_then(|(i, j)| grid.point(i, j)) else {
                            continue;
                        };
                        let d = deficits[c];
                        if d < low[0] {
                            low = [d, low[0]];
                        } else if d < low[1] {
                            low[1] = d;
                        }
                    }
                    if judge(k, low[1].clamp(QUANTISED, DISTURBED * usual)) {
                        found.push(k);
                    }
                }
                found
            };
            let found: Vec<usize> = (0..grid.rows).into_par_iter().flat_map_iter(of_row).collect();
            found.into_iter().for_each(|k| suspect[k] = true);
        }
    }
    suspect.contains(&true).then_some(suspect)
}

/// All that a closer look needs.
struct Look<'a> {
    solver: &'a Solver<'a>,
    points: &'a Points,
    outcomes: &'a [Option<Outcome>],
    suspect: &'a [bool],
}

impl Look<'_> {
    /// A new outcome for point k, or nothing where there is no discontinuity.
    fn at(&self, scratch: &mut Scratch, halves: &mut Halves, k: usize) -> Option<Outcome> {
        let near = self.undisturbed(k);
        let mut sides = self.sides(scratch, k, &near);
        if sides.is_empty() {
            return None;
        }
        let (centre, _) = self.points.centre(k);
        for side in &mut sides {
            self.solver.look(scratch, centre, &side.warp)?;
            side.map = self.residuals(scratch, side);
        }
        let ringing = RINGING * scratch.subset.sff / scratch.subset.count as f64;
        halves.prepare(self.solver.layout.radius);
        let mut best: Option<(usize, Option<usize>, Line)> = None;
        for a in 0..sides.len() {
            for b in a + 1..sides.len() {
                let variance = sides[a].variance.max(sides[b].variance).max(ringing);
                if let Some(line) = halves.between(&sides[a].map, &sides[b].map, variance)
                    && best.as_ref().is_none_or(|o| line.energy < o.2.energy)
                {
                    // the point's own side first
                    best = Some(if line.offset > 0.0 {
                        (a, Some(b), line)
                    } else {
                        (b, Some(a), line.turned())
                    });
                }
            }
        }
        if let [side] = sides.as_slice() {
            let line = halves.beyond(&side.map, side.variance.max(ringing))?;
            best = Some((0, None, line));
        }
        let (own, other, line) = best?;
        let other = other.map(|o| &sides[o]);
        self.split(scratch, halves, k, &sides[own], other, &line, ringing)
    }

    /// Solves the point's side of a line, and the other one to see whether there is a jump.
    #[allow(clippy::too_many_arguments)]
    fn split(
        &self,
        scratch: &mut Scratch,
        halves: &Halves,
        k: usize,
        own: &Side,
        other: Option<&Side>,
        line: &Line,
        ringing: f64,
    ) -> Option<Outcome> {
        let solver = self.solver;
        let (centre, offset) = self.points.centre(k);
        let variance = other.map_or(own.variance, |o| own.variance.max(o.variance));
        let mut solve = |line: &Line, side: &Side| {
            GUARDS.iter().enumerate().find_map(|(tried, &guard)| {
                let mut part = halves.part(line, guard);
                if tried > 0 {
                    halves.keep_quiet(&mut part, &side.map, variance.max(ringing));
                }
                if share(&part) < MIN_SHARE {
                    return None;
                }
                let o = solver.solve_part(scratch, centre, offset, &side.warp, &part);
                let n = scratch.subset.count as f64;
                let explained = scratch.fit.energy <= n * (EXPLAINED * variance + FADED * ringing);
                (o.status == Status::Converged && explained).then_some(o)
            })
        };
        let solved = solve(line, own);
        let foot = [line.offset * line.normal[0], line.offset * line.normal[1]];
        let jump = |a: &Warp, b: &Warp, least: f64, curved: f64| {
            let (p, q) = (a.moved(foot[0], foot[1]).0, b.moved(foot[0], foot[1]).0);
            let norm = |range: std::ops::Range<usize>| {
                range.flat_map(|k| [p[0][k] - q[0][k], p[1][k] - q[1][k]]).map(|d| d * d).sum::<f64>().sqrt()
            };
            norm(0..1) > least + curved * norm(1..3)
        };
        let mine = solved.as_ref().map_or(own.warp, |o| o.warp);
        let far = other.map(|o| (o, solve(&line.turned(), o)));
        let real = match (&solved, far) {
            (Some(o), Some((_, Some(far)))) => jump(&o.warp, &far.warp, JUMP, CURVED),
            (Some(o), far) => {
                // a far side large enough that cannot be solved: the own one must end at the line
                let large = |l: &Line| share(&halves.part(l, GUARDS[0])) >= MIN_SHARE;
                let ends = if far.is_some() && !large(&line.turned()) {
                    true
                } else {
                    solver.look(scratch, centre, &o.warp)?;
                    halves.unexplained(&self.residuals(scratch, own), line, variance.max(ringing))
                };
                ends && far.is_none_or(|(side, _)| jump(&o.warp, &side.warp, FAR_JUMP, FAR_CURVED))
            }
            (None, Some((side, _))) => {
                halves.explained(&own.map, line, GUARDS[0], variance + FADED * ringing)
                    && jump(&own.warp, &side.warp, FAR_JUMP, FAR_CURVED)
            }
            (None, None) => false,
        };
        if !real {
            return None;
        }
        match solved {
            Some(o) if line.sure() => Some(Outcome { solver: SolvedBy::Split, ..o }),
            _ => {
                let old = self.outcomes[k].unwrap_or(Outcome::failed(Status::NoGuess, mine));
                Some(Outcome { status: Status::Discontinuous, ..old })
            }
        }
    }

    /// The nearest undisturbed points around point k, in all directions.
    fn undisturbed(&self, k: usize) -> Vec<usize> {
        let good =
            |c: usize| !self.suspect[c] && self.outcomes[c].is_some_and(|o| o.status == Status::Converged);
        let xy = self.points.positions();
        if let Some(grid) = self.points.as_grid() {
            let (i, j) =
                ((xy[k][0] as usize - grid.x0) / grid.step, (xy[k][1] as usize - grid.y0) / grid.step);
            let away = reach(self.solver, grid.step) + 1;
            let along = |&(a, b): &(isize, isize)| {
                (1..=away).find_map(|n| {
                    let (i, j) = (i.checked_add_signed(a * n)?, j.checked_add_signed(b * n)?);
                    grid.point(i, j).filter(|&c| good(c))
                })
            };
            return RAYS.iter().filter_map(along).collect();
        }
        // scattered: neighbours of neighbours, the nearest in each octant
        let limit = 1.5 * (self.solver.layout.width + 1) as f64;
        let mut nearest = [(f64::INFINITY, usize::MAX); 8];
        let mut seen = vec![k];
        let mut next = 0;
        while next < seen.len() && seen.len() < 600 {
            let at = seen[next];
            next += 1;
            for &c in self.points.neighbours(at) {
                let c = c as usize;
                let (dx, dy) = (xy[c][0] - xy[k][0], xy[c][1] - xy[k][1]);
                let d = dx.hypot(dy);
                if d > limit || seen.contains(&c) {
                    continue;
                }
                seen.push(c);
                let octant = ((dy.atan2(dx) / std::f64::consts::FRAC_PI_4).round() as i32).rem_euclid(8);
                let best = &mut nearest[octant as usize];
                if good(c) && d < best.0 {
                    *best = (d, c);
                }
            }
        }
        nearest.into_iter().filter(|n| n.0.is_finite()).map(|n| n.1).collect()
    }

    /// The different shape functions among undisturbed points, the nearest of each kind.
    fn sides(&self, scratch: &mut Scratch, k: usize, near: &[usize]) -> Vec<Side> {
        let ((x, y), _) = self.points.centre(k);
        let mut order: Vec<(i64, usize)> = near
            .iter()
            .map(|&c| {
                let ((a, b), _) = self.points.centre(c);
                let (dx, dy) = (i64::from(a - x), i64::from(b - y));
                (dx * dx + dy * dy, c)
            })
            .collect();
        order.sort_unstable();
        let mut sides: Vec<Side> = Vec::new();
        for (_, c) in order {
            let Some(o) = self.outcomes[c] else {
                continue;
            };
            let (at, _) = self.points.centre(c);
            let warp = o.warp.moved(f64::from(x - at.0), f64::from(y - at.1));
            let known =
                |s: &Side| (s.warp.0[0][0] - warp.0[0][0]).hypot(s.warp.0[1][0] - warp.0[1][0]) <= APART;
            if sides.len() == SIDES || sides.iter().any(known) {
                continue;
            }
            let Some(fit) = self.solver.look(scratch, at, &o.warp) else {
                continue;
            };
            let n = scratch.subset.count as f64;
            let mean = scratch.subset.mean;
            let Fit { gain, energy, mean: q, .. } = fit;
            let variance = energy.max(2.0 * f64::from(QUANTISED) * scratch.subset.sff) / n;
            sides.push(Side { warp, levels: [mean, mean - q, gain], variance, map: Vec::new() });
        }
        sides
    }

    /// Residual of every pixel of the subset last looked at, row by row, with a side's grey levels;
    /// NaN for pixels that are not used.
    fn residuals(&self, scratch: &Scratch, side: &Side) -> Vec<f32> {
        let layout = &self.solver.layout;
        let subset = &scratch.subset;
        let [f, g, gain] = side.levels;
        let (df, dg) = (subset.mean - f, f64::from(self.solver.target.offset) - g);
        let mut out = Vec::with_capacity(layout.count());
        for d in 0..layout.width {
            for i in 0..layout.width {
                let k = layout.place(i, d);
                let used = subset.cut.get(k) != Some(&0.0);
                let e = f64::from(subset.f[k]) + df - gain * (f64::from(scratch.warped[k]) + dg);
                out.push(if used { e as f32 } else { f32::NAN });
            }
        }
        out
    }
}

/// Share of a subset that is in a part.
fn share(part: &[bool]) -> f64 {
    part.iter().filter(|&&p| p).count() as f64 / part.len() as f64
}
