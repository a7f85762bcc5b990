//! From the last pass to outcomes: which points the dense form answers for.

use super::glance::{EXCESS, Glance, INDEPENDENT, SEEN, SIGMA};
use super::pass::{DISTANCE, GAIN, ZNCC, outputs};
use super::reference::Layout;
use super::tiling::{LANES, Tiling, moments};
use super::{CARRIES, CURVATURE, Dense, LINEAR, NEGLIGIBLE, NEGLIGIBLE_PX, NOISY, Share};
use crate::domain::Coverage;
use crate::icgn::{Outcome, Solver};
use crate::point::{SolvedBy, Status};
use crate::points::Points;
use crate::shape::Warp;
use crate::verdict::{Accepted, BORDER, Numbers};
use rayon::prelude::*;

impl Dense {
    /// Outcomes of the last pass; and, for points it does not answer for, where to begin.
    pub(super) fn collect(
        &self,
        solver: &Solver<'_>,
        points: &Points,
        tiling: &Tiling,
        order: usize,
        accept: bool,
        outcomes: &mut [Option<Outcome>],
    ) -> Vec<(usize, Warp)> {
        let Some(grid) = points.as_grid() else {
            return Vec::new();
        };
        // a grid row's points follow each other
        let mut rows = Vec::with_capacity(tiling.rows);
        let mut rest = outcomes;
        let mut done = 0;
        for j in 0..tiling.rows {
            let of_row = |i: &usize| grid.point(self.first.0 + i, self.first.1 + j);
            let Some(first) = (0..tiling.columns).find_map(|i| of_row(&i)) else {
                continue;
            };
            let last = (0..tiling.columns).rev().find_map(|i| of_row(&i)).unwrap_or(first);
            let (row, after) = rest.split_at_mut(first - done).1.split_at_mut(last + 1 - first);
            rows.push((j, first, row));
            rest = after;
            done = last + 1;
        }
        let (columns, task_rows) = self.shares.first().map_or((1, 1), |s| (s.task.columns, s.task.rows));
        let across = tiling.columns.div_ceil(columns);
        let glance = Glance::new(solver, tiling, order);
        let left: Vec<Vec<(usize, Warp)>> = rows
            .into_par_iter()
            .map(|(j, first, row)| {
                let mut proposals = Vec::new();
                let mut glances = Vec::new();
                for i in 0..tiling.columns {
                    let share = &self.shares[j / task_rows * across + i / columns];
                    let (column, line) = (i - share.task.column, j - share.task.row);
                    if column == 0 {
                        glance.along(solver.level, &self.nodes.affine, share, line, &mut glances);
                    }
                    let Some(k) = grid.point(self.first.0 + i, self.first.1 + j) else {
                        continue;
                    };
                    let seen = &glances[column / LANES * SEEN * LANES..][column % LANES..];
                    let judged = self.outcome(solver, tiling, share, order, accept, (column, line), seen);
                    match judged {
                        (Some(o), _) => row[k - first] = Some(o),
                        (None, Some(w)) => proposals.push((k, w)),
                        (None, None) => {}
                    }
                }
                proposals
            })
            .collect();
        left.into_iter().flatten().collect()
    }

    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    fn outcome(
        &self,
        solver: &Solver<'_>,
        tiling: &Tiling,
        share: &Share,
        order: usize,
        accept: bool,
        (column, row): (usize, usize),
        seen: &[f32],
    ) -> (Option<Outcome>, Option<Warp>) {
        let layout = Layout::new(order);
        let m = moments(order);
        let t = &share.task;
        let vector = row * t.width / LANES + column / LANES;
        let out = &share.out[vector * outputs(order) * LANES..][column % LANES..];
        let constants = &share.prepared.constants[vector * layout.len() * LANES..][column % LANES..];
        let q = |p: usize| f64::from(out[p * LANES]);
        let constant = |c: usize| constants[c * LANES];
        let (zncc, gain, distance) = (q(2 * m + ZNCC), q(2 * m + GAIN), out[(2 * m + DISTANCE) * LANES]);
        if !(distance < CARRIES && zncc > 0.3) {
            return (None, None);
        }
        let a = &self.nodes.affine;
        let base = self.nodes.base.map(f64::from);
        let [[ma, mb], [mc, md]] = a.matrix();
        let r = tiling.radius as f64;
        let (i, j) = (t.column + column, t.row + row);
        let at = a.at((i * tiling.step) as f64, (j * tiling.step) as f64);
        let mut warp = Warp([
            [base[0] + at[0], a.u[1], a.u[2], 0.0, 0.0, 0.0],
            [base[1] + at[1], a.v[1], a.v[2], 0.0, 0.0, 0.0],
        ]);
        let scale = [1.0, 1.0 / r, 1.0 / r, 1.0 / (r * r), 1.0 / (r * r), 1.0 / (r * r)];
        for k in 0..m {
            let (x, y) = (q(k) * scale[k], q(m + k) * scale[k]);
            warp.0[0][k] += ma * x + mb * y;
            warp.0[1][k] += mc * x + md * y;
        }
        if m == 1 {
            // order 0 has no gradients of its own
            warp = warp.restricted(solver.settings.shape);
        }
        let sff = f64::from(constant(layout.sff()));
        let energy = [f64::from(constant(layout.energy(0))), f64::from(constant(layout.energy(1)))];
        if !(accept && distance < LINEAR && sff > 0.0) {
            return (None, Some(warp));
        }
        let variance = [f64::from(constant(layout.variance(0))), f64::from(constant(layout.variance(1)))];
        let centre = ((tiling.x0 + i * tiling.step) as i32, (tiling.y0 + j * tiling.step) as i32);
        let r = solver.layout.radius as f64;
        if !matches!(solver.coverage(centre.0, centre.1), Coverage::Whole) {
            return (None, Some(warp));
        }
        let accepted = self.at_a_glance(solver, centre, &warp, zncc, seen).map_or_else(
            || {
                let numbers = Numbers {
                    count: solver.layout.count() as f64,
                    extent: [-r, r, -r, r],
                    sff,
                    energy,
                    variance,
                    zncc,
                    gain,
                    left: 2.0 * sff * (1.0 - zncc),
                };
                solver.verdict(centre, &warp, &numbers)
            },
            Ok,
        );
        match accepted {
            Ok(a) if a.excess > NOISY || !negligible(distance, a.sigma) => (None, Some(warp)),
            Ok(Accepted { independent, sigma, .. }) => {
                let o = Outcome {
                    warp,
                    zncc,
                    independent,
                    iterations: share.passes as u16,
                    status: Status::Converged,
                    solver: SolvedBy::Dense,
                    sigma,
                };
                (Some(o), None)
            }
            Err(_) => (None, Some(warp)),
        }
    }

    /// The verdict where it is beyond doubt and in favour of the point.
    #[inline(always)]
    fn at_a_glance(
        &self,
        solver: &Solver<'_>,
        centre: (i32, i32),
        warp: &Warp,
        zncc: f64,
        seen: &[f32],
    ) -> Option<Accepted> {
        let at = |plane: usize| seen[plane * LANES];
        let r = solver.layout.radius as f64;
        let independent = f64::from(at(INDEPENDENT));
        let fine = solver.clears(zncc, independent)
            && solver.inside(centre.0, centre.1, [-r, r, -r, r], warp, BORDER)
            && warp.stretches_less(solver.settings.max_log_stretch);
        let sigma = SIGMA.map(at);
        fine.then_some(Accepted { independent, sigma, excess: f64::from(at(EXCESS)) })
    }
}

/// Whether what the dense form neglects at a point does not matter beside its uncertainty.
fn negligible(distance: f32, sigma: [f32; 2]) -> bool {
    let error = CURVATURE * f64::from(distance).powi(2);
    error <= (NEGLIGIBLE * f64::from(sigma[0].min(sigma[1]))).max(NEGLIGIBLE_PX)
}
