//! The dense form of the correlation: a regular grid of overlapping subsets solved together.
//!
//! Sparse points, solved by their own iteration, give a field; two passes ([`pass`]) warp the
//! deformed image once with the field and solve every subset from window sums. What is linearised is
//! the difference between the field and a subset's own polynomial; where that is large (steps,
//! cracks, strong curvature), or the equations are not safe, the point is left to the exact form.

mod collect;
mod glance;
mod nodes;
mod pass;
mod reference;
mod sums;
mod tiling;
mod warp;

use crate::correlate::Observer;
use crate::icgn::{Outcome, Solver};
use crate::per_thread::PerThread;
use crate::point::Status;
use crate::points::{Grid, Points};
use crate::prepared::Reference;
use crate::settings::Settings;
use crate::shape::Warp;
use nodes::Nodes;
use pass::{Buffers, DISTANCE, Pass, ZNCC, outputs};
use rayon::prelude::*;
use reference::{Layout, Prepared};
use tiling::{LANES, Task, Tiling, moments};

/// Passes over the image, at most: the second brings the field of the first to within its own square; a
/// third changes nothing.
const PASSES: usize = 2;
/// Error left by the first pass that needs no second, in pixels, or as part of the point's own
/// uncertainty.
const SETTLED_PX: f32 = 2e-5;
const SETTLED: f32 = 0.05;
/// Share of the points that may be above it: for so few the exact form is cheaper than another pass.
const UNSETTLED: f32 = 0.02;
/// Largest distance, in pixels, between a subset's polynomial and the common field at which the dense
/// form is used at all.
const LINEAR: f32 = 0.1;
/// Error of a displacement per square of that distance, 1/pixel: what a jump next to 21-pixel subsets
/// was seen to do (3e-3 px at 0.1 px).
const CURVATURE: f64 = 0.33;
/// That error may be this part of the point's own uncertainty, or this many pixels.
const NEGLIGIBLE: f64 = 0.2;
/// Share of noise in the energy of the gradients above which a point is left to the exact form: the
/// dense form's fixed point is drawn towards the field by about this share, and its scatter with it.
const NOISY: f64 = 0.05;
const NEGLIGIBLE_PX: f64 = 1e-4;
/// Distance up to which a point's result is good enough to carry the field for the next pass.
const CARRIES: f32 = 2.0;
/// Distance between sparse points, in subset widths.
const SPARSE: f64 = 1.6;
/// Whole tiles in a subset from which sharing sums pays.
pub(crate) const OVERLAP: usize = 2;

/// What stays the same while reference, grid, subset and shape function do.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Key {
    reference: u64,
    tiling: Tiling,
    order: usize,
}

/// One task's memory.
struct Share {
    task: Task,
    prepared: Prepared,
    out: Vec<f32>,
    /// Passes that `out` has come from, this time.
    passes: usize,
    /// Whether another pass would change nothing that matters.
    settled: bool,
}

impl Share {
    fn new(task: Task) -> Self {
        Self { task, prepared: Prepared::default(), out: Vec::new(), passes: 0, settled: false }
    }

    /// Whether the last pass came close enough at nearly all points; `is_point` says which of the
    /// tiling's nodes are points.
    fn has_settled(&self, tiling: &Tiling, order: usize, is_point: impl Fn(usize, usize) -> bool) -> bool {
        let (m, layout) = (moments(order), Layout::new(order));
        let (size, block) = (outputs(order) * LANES, layout.len() * LANES);
        let width = (2 * tiling.radius + 1) as f32;
        let share = SETTLED * SETTLED / (width * width);
        let vectors = self.task.width / LANES;
        let (mut above, mut all) = (0, 0);
        let rows =
            self.out.chunks_exact(vectors * size).zip(self.prepared.constants.chunks_exact(vectors * block));
        for (row, (out, constants)) in rows.enumerate() {
            for (k, (q, c)) in out.chunks_exact(size).zip(constants.chunks_exact(block)).enumerate() {
                let used = LANES.min(self.task.columns.saturating_sub(k * LANES));
                let q = &q[2 * m * LANES..];
                let at = |values: &[f32], plane: usize, lane: usize| values[plane * LANES + lane];
                for lane in 0..used {
                    if !is_point(self.task.column + k * LANES + lane, self.task.row + row) {
                        continue;
                    }
                    all += 1;
                    let distance = at(q, DISTANCE, lane);
                    let error = CURVATURE as f32 * distance * distance;
                    let residual = 2.0 * at(c, layout.sff(), lane) * (1.0 - at(q, ZNCC, lane)).max(0.0);
                    let variance = at(c, layout.variance(0), lane).min(at(c, layout.variance(1), lane))
                        * residual
                        * share;
                    let close = error <= SETTLED_PX || error * error <= variance;
                    above += usize::from(!(close && distance < LINEAR));
                }
            }
        }
        above as f32 <= UNSETTLED * all as f32
    }
}

/// Memory of the dense form, used again from image to image.
#[derive(Default)]
pub(crate) struct Dense {
    key: Option<Key>,
    /// Grid node of the tiling's first.
    first: (usize, usize),
    shares: Vec<Share>,
    nodes: Nodes,
    buffers: PerThread<Buffers>,
}

fn order(settings: &Settings) -> usize {
    match settings.shape.parameters_per_component() {
        1 => 0,
        3 => 1,
        _ => 2,
    }
}

/// The part of a grid whose subsets lie wholly in the image, as tiles; and its first node. Nothing
/// where subsets overlap too little for the dense form to pay.
fn tiling(reference: &Reference, grid: &Grid, settings: &Settings) -> Option<(Tiling, (usize, usize))> {
    let r = settings.radius();
    let range = |start: usize, n: usize, size: usize| {
        let first = r.saturating_sub(start).div_ceil(grid.step);
        let end = (size.checked_sub(start + r)?).div_ceil(grid.step).min(n);
        (end > first + 3).then_some((first, end - first))
    };
    let (i, columns) = range(grid.x0, grid.columns, reference.image.width())?;
    let (j, rows) = range(grid.y0, grid.rows, reference.image.height())?;
    let tiling = Tiling {
        x0: grid.x0 + i * grid.step,
        y0: grid.y0 + j * grid.step,
        step: grid.step,
        radius: r,
        columns,
        rows,
    };
    (tiling.whole().0 >= OVERLAP).then_some((tiling, (i, j)))
}

/// Sparse points of a grid.
pub(crate) struct Sparse {
    columns: Vec<usize>,
    rows: Vec<usize>,
    /// Per node of the sparse lattice: which sparse point stands for it.
    which: Vec<Option<usize>>,
    /// Grid points used.
    pub(crate) points: Vec<usize>,
}

impl Dense {
    /// Makes the memory ready; whether the dense form can be used at all.
    pub(crate) fn prepare(&mut self, solver: &Solver<'_>, points: &Points) -> bool {
        let Some(grid) = points.as_grid() else {
            return false;
        };
        let Some((tiling, first)) = tiling(solver.reference, grid, solver.settings) else {
            return false;
        };
        let order = order(solver.settings);
        let key = Key { reference: solver.reference.id, tiling, order };
        self.buffers.prepare();
        self.first = first;
        if self.key == Some(key) {
            return true;
        }
        if self.key.map(|k| k.tiling) != Some(tiling) {
            let tasks = tiling.tasks();
            self.shares.truncate(tasks.len());
            for (share, task) in self.shares.iter_mut().zip(&tasks) {
                share.task = *task;
            }
            for task in &tasks[self.shares.len()..] {
                self.shares.push(Share::new(*task));
            }
        }
        self.key = Some(key);
        let buffers = &self.buffers;
        self.shares.par_iter_mut().for_each(|share| {
            buffers.with(|b| {
                share.prepared.fill(
                    solver.level,
                    &tiling,
                    &share.task,
                    solver.reference,
                    order,
                    (&mut b.sums, &mut b.line),
                )
            });
        });
        true
    }

    /// Points from which the field starts.
    pub(crate) fn sparse(&self, points: &Points) -> Option<Sparse> {
        let (key, grid) = (self.key?, points.as_grid()?);
        let t = key.tiling;
        let width = (2 * t.radius + 1) as f64;
        let every = ((SPARSE * width / t.step as f64).round() as usize).max(1);
        let list = |n: usize| -> Vec<usize> {
            let mut l: Vec<usize> = (0..n).step_by(every).collect();
            // the last one stands for the edge; one very near before it is not needed
            if let Some(&last) = l.last()
                && last + 1 < n
            {
                if l.len() > 1 && n - 1 - last < every / 2 {
                    l.pop();
                }
                l.push(n - 1);
            }
            l
        };
        let (columns, rows) = (list(t.columns), list(t.rows));
        let mut which = Vec::with_capacity(columns.len() * rows.len());
        let mut chosen = Vec::new();
        for &j in &rows {
            for &i in &columns {
                let near = nearest(grid, self.first.0 + i, self.first.1 + j, every / 2);
                which.push(near.map(|_| chosen.len()));
                chosen.extend(near);
            }
        }
        (!chosen.is_empty()).then_some(Sparse { columns, rows, which, points: chosen })
    }

    /// Two passes from the sparse outcomes, in the order of [`Sparse::points`]. Accepted points are
    /// written to `outcomes`, if `accept`; others that have a usable result get it as a proposal. Nothing happens
    /// where no sparse point was accepted.
    #[allow(clippy::too_many_arguments)]
    pub(crate) fn solve(
        &mut self,
        solver: &Solver<'_>,
        points: &Points,
        sparse: &Sparse,
        start: &[Option<Outcome>],
        outcomes: &mut [Option<Outcome>],
        accept: bool,
        observer: &dyn Observer,
    ) -> Vec<(usize, Warp)> {
        let (Some(Key { tiling, order, .. }), Some(grid)) = (self.key, points.as_grid()) else {
            return Vec::new();
        };
        let Some(known) = self.lattice(points, sparse, start) else {
            return Vec::new();
        };
        self.nodes.through_sparse(&tiling, &sparse.columns, &sparse.rows, &known);
        for share in &mut self.shares {
            (share.passes, share.settled) = (0, false);
        }
        for number in 0..PASSES {
            if self.shares.iter().all(|s| s.settled) {
                break;
            }
            if number > 0 {
                self.carry(&tiling, order);
            }
            let pass = Pass {
                tiling: &tiling,
                reference: solver.reference,
                nodes: &self.nodes,
                plane: &solver.target.coefficients,
                criterion: solver.settings.criterion,
                interpolation: solver.target.interpolation,
                order,
            };
            let (buffers, first) = (&self.buffers, self.first);
            self.shares.par_iter_mut().filter(|s| !s.settled).for_each(|share| {
                if !observer.cancelled() {
                    buffers.with(|b| pass.run(solver.level, &share.task, &share.prepared, b, &mut share.out));
                    share.passes = number + 1;
                    share.settled = share
                        .has_settled(&tiling, order, |i, j| grid.point(first.0 + i, first.1 + j).is_some());
                }
            });
            observer.points(points.len() * (number + 1) / (PASSES + 1), points.len());
            if observer.cancelled() || self.shares.iter().any(|s| s.passes == 0) {
                return Vec::new();
            }
        }
        self.collect(solver, points, &tiling, order, accept, outcomes)
    }

    /// The sparse lattice without gaps: nodes without an accepted point take what their neighbours
    /// predict.
    fn lattice(&self, points: &Points, sparse: &Sparse, start: &[Option<Outcome>]) -> Option<Vec<Warp>> {
        let t = self.key?.tiling;
        let (nx, ny) = (sparse.columns.len(), sparse.rows.len());
        let position = |k: usize| {
            let x = (t.x0 + sparse.columns[k % nx] * t.step) as f64;
            let y = (t.y0 + sparse.rows[k / nx] * t.step) as f64;
            [x, y]
        };
        let mut known: Vec<Option<Warp>> = (0..nx * ny)
            .map(|k| {
                let p = sparse.which[k]?;
                let o = start[p].filter(|o| o.status == Status::Converged)?;
                let [x, y] = position(k);
                let at = points.positions()[sparse.points[p]];
                Some(o.warp.moved(x - at[0], y - at[1]))
            })
            .collect();
        if known.iter().all(Option::is_none) {
            return None;
        }
        while known.iter().any(Option::is_none) {
            let before = known.clone();
            for k in 0..nx * ny {
                if before[k].is_some() {
                    continue;
                }
                let [x, y] = position(k);
                let (mut n, mut mean) = (0.0, [[0.0; 6]; 2]);
                let (i, j) = (k % nx, k / nx);
                for (a, b) in [(-1i64, 0i64), (1, 0), (0, -1), (0, 1)] {
                    let (a, b) = (i as i64 + a, j as i64 + b);
                    if a < 0 || b < 0 || a >= nx as i64 || b >= ny as i64 {
                        continue;
                    }
                    let from = b as usize * nx + a as usize;
                    if let Some(w) = before[from] {
                        let [fx, fy] = position(from);
                        let moved = w.moved(x - fx, y - fy);
                        n += 1.0;
                        for c in 0..2 {
                            for e in 0..6 {
                                mean[c][e] += moved.0[c][e];
                            }
                        }
                    }
                }
                if n > 0.0 {
                    known[k] = Some(Warp(mean.map(|c| c.map(|e| e / n))));
                }
            }
        }
        known.into_iter().collect()
    }

    /// The field for the next pass from what the last one left.
    fn carry(&mut self, tiling: &Tiling, order: usize) {
        let Self { shares, nodes, .. } = self;
        let m = moments(order);
        let size = outputs(order) * LANES;
        let affine = nodes.affine;
        let [[a, b], [c, d]] = affine.matrix();
        let base = nodes.base.map(f64::from);
        for share in shares.iter() {
            let t = &share.task;
            for (row, out) in share.out.chunks_exact(t.width / LANES * size).enumerate() {
                let j = t.row + row;
                for k in 0..t.columns {
                    let lane = &out[k / LANES * size + k % LANES..];
                    let at = |p: usize| f64::from(lane[p * LANES]);
                    let zncc = lane[(2 * m + ZNCC) * LANES];
                    if lane[(2 * m + DISTANCE) * LANES] < CARRIES && zncc > 0.3 {
                        let i = t.column + k;
                        let x = (i * tiling.step) as f64;
                        let [u, v] = affine.at(x, (j * tiling.step) as f64);
                        let (q, s) = (at(0), at(m));
                        nodes.set(tiling, i, j, base[0] + u + a * q + b * s, base[1] + v + c * q + d * s);
                    }
                }
            }
        }
        let r = tiling.radius as f64;
        let tasks = tiling.tasks();
        let (columns, rows) = tasks.first().map_or((1, 1), |t| (t.columns, t.rows));
        let across = tiling.columns.div_ceil(columns);
        nodes.finish(tiling, |i, j| {
            let share = shares.get(j / rows * across + i / columns)?;
            let t = &share.task;
            let (k, row) = (i.checked_sub(t.column)?, j.checked_sub(t.row)?);
            let lane = share.out.get((row * t.width / LANES + k / LANES) * size + k % LANES..)?;
            let at = |p: usize| f64::from(lane[p * LANES]) / r;
            let usable = lane[(2 * m + DISTANCE) * LANES] < CARRIES;
            let g = if m > 1 && usable { [at(1), at(2), at(m + 1), at(m + 2)] } else { [0.0; 4] };
            Some([
                affine.u[1] + a * g[0] + b * g[2],
                affine.u[2] + a * g[1] + b * g[3],
                affine.v[1] + c * g[0] + d * g[2],
                affine.v[2] + c * g[1] + d * g[3],
            ])
        });
    }
}

/// The grid's point nearest to node (i, j), at most `reach` nodes away along each axis.
fn nearest(grid: &Grid, i: usize, j: usize, reach: usize) -> Option<usize> {
    if let Some(k) = grid.point(i, j) {
        return Some(k);
    }
    for ring in 1..=reach {
        let (left, right) = (i.saturating_sub(ring), i + ring);
        let (top, bottom) = (j.saturating_sub(ring), j + ring);
        for b in top..=bottom {
            for a in left..=right {
                if (a == left || a == right || b == top || b == bottom)
                    && let Some(k) = grid.point(a, b)
                {
                    return Some(k);
                }
            }
        }
    }
    None
}
