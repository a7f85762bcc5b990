//! What neighbours say about a point, and whether a group of points can be chance.

use crate::icgn::{Outcome, Solver};
use crate::point::{SolvedBy, Status};
use crate::points::Points;
use crate::verdict::significant;

/// Groups that confirm each other but cover less than this many subsets may be one chance match:
/// overlapping subsets share their pixels.
const GROUP_SUBSETS: f64 = 9.0;
/// How much more significant than usual the best point of such a group must be.
const GROUP_FACTOR: f64 = 1.5;
/// ZNCC that suffices for it in any case.
const GROUP_CAP: f64 = 0.96;
/// Subsets' areas that dense points must cover to be no chance.
const ANCHOR: f64 = 36.0;

/// Judges accepted points by their neighbours: those which are contradicted become
/// [`Status::Inconsistent`], small groups that may be chance [`Status::LowCorrelation`].
pub(crate) fn judge(solver: &Solver<'_>, points: &Points, outcomes: &mut [Option<Outcome>]) {
    let tolerance = solver.settings.consistency;
    let contradicted: Vec<usize> = (0..outcomes.len())
        .filter(|&k| {
            // a dense point has been held against the field around it, a split one has been confirmed
            // by its own side
            if !accepted(&outcomes[k]) || dense(&outcomes[k]) || split(&outcomes[k]) {
                return false;
            }
            let (mut asked, mut agree) = (0, 0);
            for &c in points.neighbours(k) {
                let c = c as usize;
                if accepted(&outcomes[c]) {
                    asked += 1;
                    agree += usize::from(agrees(points, outcomes, k, c, tolerance));
                }
            }
            // a lone point cannot be confirmed; a discontinuity leaves half of the neighbours
            4 * agree < asked
        })
        .collect();
    mark(outcomes, &contradicted, Status::Inconsistent);
    if solver.settings.significance > 0.0 {
        let chance = chance_groups(solver, points, outcomes, tolerance);
        mark(outcomes, &chance, Status::LowCorrelation);
    }
    let alone = unsupported(points, outcomes, tolerance);
    mark(outcomes, &alone, Status::Discontinuous);
}

/// Split points that no whole subset confirms, neither directly nor through other split points: part
/// of a subset alone proves too little.
fn unsupported(points: &Points, outcomes: &[Option<Outcome>], tolerance: f64) -> Vec<usize> {
    let is_split = |k: usize| accepted(&outcomes[k]) && split(&outcomes[k]);
    let open: Vec<usize> = (0..outcomes.len()).filter(|&k| is_split(k)).collect();
    let mut confirmed = vec![false; if open.is_empty() { 0 } else { outcomes.len() }];
    let mut front: Vec<usize> = open.clone();
    while !front.is_empty() {
        let found: Vec<usize> = front
            .iter()
            .copied()
            .filter(|&k| {
                !confirmed[k]
                    && points.neighbours(k).iter().any(|&c| {
                        let c = c as usize;
                        let supports = accepted(&outcomes[c]) && (!split(&outcomes[c]) || confirmed[c]);
                        supports && agrees(points, outcomes, k, c, tolerance)
                    })
            })
            .collect();
        front.clear();
        for &k in &found {
            confirmed[k] = true;
        }
        for &k in &found {
            front.extend(
                points.neighbours(k).iter().map(|&c| c as usize).filter(|&c| is_split(c) && !confirmed[c]),
            );
        }
        front.sort_unstable();
        front.dedup();
    }
    open.into_iter().filter(|&k| !confirmed[k]).collect()
}

fn split(outcome: &Option<Outcome>) -> bool {
    outcome.is_some_and(|o| o.solver == SolvedBy::Split)
}

fn accepted(outcome: &Option<Outcome>) -> bool {
    outcome.is_some_and(|o| o.status == Status::Converged)
}

fn dense(outcome: &Option<Outcome>) -> bool {
    outcome.is_some_and(|o| o.solver == SolvedBy::Dense)
}

fn mark(outcomes: &mut [Option<Outcome>], which: &[usize], status: Status) {
    for &k in which {
        if let Some(o) = &mut outcomes[k] {
            o.status = status;
        }
    }
}

/// Points of groups which confirm each other, are small, and hold no point of high significance.
fn chance_groups(
    solver: &Solver<'_>,
    points: &Points,
    outcomes: &[Option<Outcome>],
    tolerance: f64,
) -> Vec<usize> {
    let width = solver.settings.subset as f64;
    // Dense points that cover far more than a chance group could stand for each other, and for every
    // group that joins them.
    let mut seen: Vec<bool> = outcomes.iter().map(|o| accepted(o) && dense(o)).collect();
    let step = points.as_grid().map_or(1.0, |g| g.step as f64);
    let anchored = seen.iter().filter(|&&s| s).count() as f64 * step * step > ANCHOR * width * width;
    if anchored {
        if outcomes.iter().all(|o| !accepted(o) || dense(o)) {
            return Vec::new();
        }
    } else {
        seen.fill(false);
    }
    let mut chance = Vec::new();
    let mut group: Vec<usize> = Vec::new();
    for start in 0..outcomes.len() {
        if seen[start] || !accepted(&outcomes[start]) {
            continue;
        }
        seen[start] = true;
        group.clear();
        group.push(start);
        let (mut lo, mut hi) = (points.positions()[start], points.positions()[start]);
        let mut next = 0;
        let mut best = f64::NEG_INFINITY;
        let mut joins = false;
        while let Some(&k) = group.get(next) {
            next += 1;
            let p = points.positions()[k];
            for c in 0..2 {
                lo[c] = lo[c].min(p[c]);
                hi[c] = hi[c].max(p[c]);
            }
            if let Some(o) = outcomes[k].filter(|o| o.solver != SolvedBy::Split) {
                // above what chance alone would need
                let bar =
                    significant(GROUP_FACTOR * solver.settings.significance, o.independent).min(GROUP_CAP);
                best = best.max(o.zncc - bar);
            }
            for &c in points.neighbours(k) {
                let c = c as usize;
                joins |= anchored && dense(&outcomes[c]) && agrees(points, outcomes, k, c, tolerance);
                if !seen[c] && accepted(&outcomes[c]) && agrees(points, outcomes, k, c, tolerance) {
                    seen[c] = true;
                    group.push(c);
                }
            }
        }
        let covered = (hi[0] - lo[0] + width) * (hi[1] - lo[1] + width) / (width * width);
        if !joins && covered < GROUP_SUBSETS && best < 0.0 {
            chance.extend_from_slice(&group);
        }
    }
    chance
}

/// Whether two points, each extrapolated to the middle between them, agree.
fn agrees(points: &Points, outcomes: &[Option<Outcome>], a: usize, b: usize, tolerance: f64) -> bool {
    let (Some(oa), Some(ob)) = (&outcomes[a], &outcomes[b]) else {
        return false;
    };
    let ((xa, ya), _) = points.centre(a);
    let ((xb, yb), _) = points.centre(b);
    let (dx, dy) = (0.5 * f64::from(xb - xa), 0.5 * f64::from(yb - ya));
    let p = oa.warp.at(dx, dy);
    let q = ob.warp.at(-dx, -dy);
    let (u, v) = (p[0] - q[0], p[1] - q[1]);
    u * u + v * v <= tolerance * tolerance
}
