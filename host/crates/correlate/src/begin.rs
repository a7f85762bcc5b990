//! Where a run begins: first displacements at a few points, from which the others are reached.

use crate::correlate::Guess;
use crate::features::match_within;
use crate::fft::{Window, global_shifts};
use crate::icgn::{Outcome, Scratch};
use crate::point::{ShapeParameters, Status};
use crate::propagate::{BATCH, DOUBTFUL, Propagation, Task};
use crate::shape::Warp;
use crate::start::{FeatureStart, RejectedSeed, Seed, StartAttempt, StartMethod};
use rayon::prelude::*;

/// Reach of the local searches around a predicted displacement, pixels.
const LOCAL_REACH: i32 = 47;
/// Points per seed, and the most seeds.
const POINTS_PER_SEED: usize = 1500;
const MAX_SEEDS: usize = 25;
/// Seeds that may search the whole deformed image when nothing else has worked.
const WIDE_SEEDS: usize = 4;
/// Sides, in pixels, to which whole images are reduced for their cross-correlation. The second is
/// for fine speckles, which average out in the first.
const SIDES: [usize; 2] = [256, 512];
/// Shifts of the whole image that are followed up.
const SHIFTS: usize = 3;
/// Tiles along each side of the region that get a seed from features.
const FEATURE_TILES: usize = 6;
/// A user's seed is also tried off its place, in steps of this many pixels ...
const SEED_STEP: i32 = 3;
/// ... as many to each side.
const SEED_STEPS: i32 = 3;
/// Side of the cells in which the pixels used by the points are kept.
const CELL: usize = 8;
/// Part of the points that may be lost before features are asked to find them.
const LOST: f64 = 0.25;

impl Propagation<'_> {
    /// First displacements; returns the points accepted.
    pub(crate) fn start(&mut self, guess: &Guess<'_>) -> Vec<usize> {
        match guess {
            Guess::Given(list) => {
                let tasks: Vec<Task> = list
                    .iter()
                    .enumerate()
                    .filter_map(|(point, g)| g.map(|[u, v]| Task::translation(point, u, v)))
                    .collect();
                let found = self.solve(&tasks);
                self.note(StartMethod::Given, tasks.len(), found)
            }
            Guess::Search { u, v } => {
                let seeds = self.seeds();
                let found = self.search(&seeds, &[Window::range(*u, *v)]);
                self.note(StartMethod::Search, seeds.len(), found)
            }
            Guess::Seeds(list) => self.by_seeds(list),
            Guess::Shapes(list) => self.by_shapes(list),
            Guess::Features => self.by_features(),
            Guess::Fft => {
                let found = self.by_fft();
                if found.is_empty() { self.by_wide_search() } else { found }
            }
            Guess::Auto => {
                let mut found = self.by_fft();
                if found.is_empty() {
                    found = self.by_features();
                }
                if found.is_empty() { self.by_wide_search() } else { found }
            }
        }
    }

    /// Every point from its own displacement and derivatives.
    fn by_shapes(&mut self, list: &[Option<ShapeParameters>]) -> Vec<usize> {
        let tasks: Vec<Task> = list
            .iter()
            .enumerate()
            .filter_map(|(point, shape)| {
                let (_, offset) = self.points.centre(point);
                let warp = Warp::of(shape.as_ref()?).moved(-offset[0], -offset[1]);
                Some(Task { point, warp })
            })
            .collect();
        let found = self.solve(&tasks);
        let found = self.note(StartMethod::Shapes, tasks.len(), found);
        if found.is_empty() || 2 * found.len() < tasks.len() {
            self.outcomes.fill(None);
            self.done = 0;
            return self.start(&Guess::default());
        }
        // neighbours may have a better idea of the points that failed
        for o in &mut self.outcomes {
            if o.is_some_and(|o| {
                !matches!(o.status, Status::Converged | Status::LowTexture | Status::Singular)
            }) {
                *o = None;
                self.done -= 1;
            }
        }
        let middle = |c: usize| {
            let mut values: Vec<f64> = tasks.iter().map(|t| t.warp.0[c][0]).collect();
            let half = values.len() / 2;
            *values.select_nth_unstable_by(half, f64::total_cmp).1
        };
        self.globals = vec![[middle(0), middle(1)]];
        found
    }

    fn note(&mut self, method: StartMethod, tried: usize, found: Vec<usize>) -> Vec<usize> {
        self.report.attempts.push(StartAttempt { method, tried, accepted: found.len() });
        found
    }

    /// Local searches around the shifts of the whole image, at a finer scale if need be.
    fn by_fft(&mut self) -> Vec<usize> {
        let (a, b) = (&self.solver.reference.image, &self.solver.target.image);
        let seeds = self.seeds();
        let mut found = Vec::new();
        let mut side_before = 0;
        for side in SIDES {
            let side = side.min(a.width().max(a.height()));
            if side == side_before || self.observer.cancelled() {
                break;
            }
            side_before = side;
            let shifts = global_shifts(a, b, SHIFTS, side, LOCAL_REACH / 2);
            let fresh: Vec<[f64; 2]> = shifts.into_iter().filter(|s| !self.followed(s)).collect();
            let windows = if self.globals.is_empty() {
                self.globals = fresh;
                self.local_windows()
            } else {
                let windows = fresh.iter().map(|s| Window::around(s[0], s[1], LOCAL_REACH)).collect();
                self.globals.extend(fresh);
                windows
            };
            if windows.is_empty() {
                continue;
            }
            found = self.search(&seeds, &windows);
            if !found.is_empty() {
                break;
            }
        }
        self.note(StartMethod::Fft, seeds.len(), found)
    }

    /// Whether the neighbourhood of a shift has been searched already.
    fn followed(&self, shift: &[f64; 2]) -> bool {
        let near = f64::from(LOCAL_REACH / 2);
        self.globals.iter().any(|g| (g[0] - shift[0]).abs() < near && (g[1] - shift[1]).abs() < near)
    }

    /// A few subsets are searched over half the image in each direction.
    fn by_wide_search(&mut self) -> Vec<usize> {
        let a = &self.solver.reference.image;
        let (w, h) = (a.width() as i32, a.height() as i32);
        let whole = Window { u: (-w / 2, w / 2), v: (-h / 2, h / 2) };
        let seeds = self.seeds();
        let spread = seeds.len().div_ceil(WIDE_SEEDS).max(1);
        let few: Vec<usize> = seeds.iter().copied().step_by(spread).collect();
        let found = self.search(&few, &[whole]);
        self.note(StartMethod::Fft, few.len(), found)
    }

    pub(crate) fn local_windows(&self) -> Vec<Window> {
        let mut windows: Vec<Window> =
            self.globals.iter().map(|g| Window::around(g[0], g[1], LOCAL_REACH)).collect();
        let zero = Window::around(0.0, 0.0, LOCAL_REACH);
        if !windows.contains(&zero) {
            windows.push(zero);
        }
        windows
    }

    /// Whether the subset of point k lies in the reference image.
    fn fits(&self, k: usize) -> bool {
        let ((x, y), _) = self.points.centre(k);
        self.solver.fits(x, y)
    }

    /// Points spread over the region: those nearest to the centres of equal tiles.
    fn seeds(&self) -> Vec<usize> {
        let xy = self.points.positions();
        let n = xy.len();
        let side = ((n as f64 / POINTS_PER_SEED as f64).sqrt().ceil() as usize).clamp(2, MAX_SEEDS.isqrt());
        let tiles = Tiles::around(xy.iter(), side);
        let mut best = vec![(f64::INFINITY, usize::MAX); side * side];
        for (k, p) in xy.iter().enumerate() {
            if !self.fits(k) {
                continue;
            }
            let (tile, distance) = tiles.of(p);
            let b = &mut best[tile];
            if distance < b.0 {
                *b = (distance, k);
            }
        }
        best.into_iter().map(|b| b.1).filter(|&k| k < n).collect()
    }

    /// The user's seeds at the points nearest to them; where a seed is not confirmed as it stands,
    /// also somewhat off its place.
    fn by_seeds(&mut self, list: &[Seed]) -> Vec<usize> {
        let nearest: Vec<Option<usize>> = list.iter().map(|s| self.nearest_point([s.x, s.y])).collect();
        let task = |seed: &Seed, point: usize, (du, dv): (i32, i32)| {
            let ((x, y), _) = self.points.centre(point);
            let mut warp = seed.warp(f64::from(x), f64::from(y));
            warp.0[0][0] += f64::from(du);
            warp.0[1][0] += f64::from(dv);
            Task { point, warp }
        };
        let tasks: Vec<Task> =
            list.iter().zip(&nearest).filter_map(|(s, p)| Some(task(s, (*p)?, (0, 0)))).collect();
        let off: Vec<Vec<Task>> = list
            .iter()
            .zip(&nearest)
            .map(|(s, p)| {
                let place = |k: i32| SEED_STEP * (k - SEED_STEPS);
                let side = 2 * SEED_STEPS + 1;
                let all = (0..side * side).map(|k| (place(k % side), place(k / side)));
                p.map_or(Vec::new(), |p| all.filter(|&d| d != (0, 0)).map(|d| task(s, p, d)).collect())
            })
            .collect();
        let mut accepted = self.solve(&tasks);
        for around in &off {
            if around.first().is_some_and(|t| !self.accepted(t.point)) {
                accepted.extend(self.best_of(around));
            }
        }
        for (index, p) in nearest.iter().enumerate() {
            let status = match *p {
                None => Status::OutOfImage,
                Some(k) if self.accepted(k) => continue,
                Some(k) => self.outcomes[k].map_or(Status::NoGuess, |o| o.status),
            };
            self.report.rejected.push(RejectedSeed { index, point: *p, status });
        }
        accepted.sort_unstable();
        self.note(StartMethod::Seeds, list.len(), accepted)
    }

    /// The point nearest to a position among those with a subset in the reference image.
    fn nearest_point(&self, at: [f64; 2]) -> Option<usize> {
        let distance = |p: &[f64; 2]| (p[0] - at[0]).powi(2) + (p[1] - at[1]).powi(2);
        (0..self.points.len()).filter(|&k| self.fits(k)).min_by(|&a, &b| {
            let xy = self.points.positions();
            distance(&xy[a]).total_cmp(&distance(&xy[b]))
        })
    }

    /// Tries one point from several guesses and keeps the best outcome; returns it if accepted.
    fn best_of(&mut self, tasks: &[Task]) -> Option<usize> {
        let (solver, points, observer) = (self.solver, self.points, self.observer);
        let results: Vec<Option<Outcome>> = tasks
            .par_iter()
            .map_init(Scratch::default, |scratch, t| {
                if observer.cancelled() {
                    return None;
                }
                let (centre, offset) = points.centre(t.point);
                Some(solver.solve(scratch, centre, offset, &t.warp))
            })
            .collect();
        let point = tasks.first()?.point;
        let best = results
            .into_iter()
            .flatten()
            .filter(|o| o.status == Status::Converged)
            .reduce(|a, b| if b.zncc > a.zncc { b } else { a })?;
        self.keep(point, best).then_some(point)
    }

    /// Points near matched features, from the affine map around them.
    fn by_features(&mut self) -> Vec<usize> {
        let open: Vec<usize> =
            (0..self.points.len()).filter(|&k| !self.accepted(k) && self.fits(k)).collect();
        if self.features.is_none() {
            let (a, b) = (&self.solver.reference.image, &self.solver.target.image);
            let cover = Cover::new(self, &open, a.width(), a.height());
            let found = match_within(a, b, cover.area(), &|x, y| cover.contains(x, y));
            let summary = FeatureStart { matches: found.matches.len(), groups: found.groups.clone() };
            self.report.features = Some(summary);
            self.features = Some(found);
        }
        let seeds = self.feature_seeds(&open);
        let found = self.near_features(&seeds);
        self.note(StartMethod::Features, seeds.len(), found)
    }

    /// In every tile of the region the point nearest to a match near the tile's centre.
    fn feature_seeds(&self, open: &[usize]) -> Vec<usize> {
        let Some(features) = &self.features else {
            return Vec::new();
        };
        let xy = self.points.positions();
        let tiles = Tiles::around(open.iter().map(|&k| &xy[k]), FEATURE_TILES);
        let mut best = vec![(f64::INFINITY, [0.0; 2]); FEATURE_TILES * FEATURE_TILES];
        for m in features.matches.iter().filter(|m| m.group.is_some()) {
            let (tile, distance) = tiles.of(&m.reference);
            if distance < best[tile].0 {
                best[tile] = (distance, m.reference);
            }
        }
        let mut seeds: Vec<usize> = best
            .iter()
            .filter(|b| b.0.is_finite())
            .filter_map(|b| {
                let distance = |k: usize| (xy[k][0] - b.1[0]).powi(2) + (xy[k][1] - b.1[1]).powi(2);
                open.iter().copied().min_by(|&p, &q| distance(p).total_cmp(&distance(q)))
            })
            .collect();
        seeds.sort_unstable();
        seeds.dedup();
        seeds
    }

    /// Starts points from the affine map of the features around them; returns those accepted. Where
    /// next to none of many succeeds the rest is not tried.
    pub(crate) fn near_features(&mut self, seeds: &[usize]) -> Vec<usize> {
        let mut accepted = Vec::new();
        let mut tried = 0;
        for batch in seeds.chunks(BATCH) {
            let Some(features) = self.features.as_ref().filter(|f| !f.groups.is_empty()) else {
                break;
            };
            let points = self.points;
            let tasks: Vec<Task> = batch
                .par_iter()
                .filter_map(|&point| {
                    let ((x, y), _) = points.centre(point);
                    let (x, y) = (f64::from(x), f64::from(y));
                    let map = features.local(x, y)?;
                    let [u, v] = map.displacement(x, y);
                    Some(Task { point, warp: Seed { x, y, u, v, gradient: Some(map.gradient()) }.warp(x, y) })
                })
                .collect();
            accepted.extend(self.solve(&tasks));
            tried += batch.len();
            if self.observer.cancelled() || (tried >= 2 * BATCH && accepted.len() * 20 < tried) {
                break;
            }
        }
        accepted
    }

    /// Whether cross-correlation has failed where features succeeded: the material has turned, and
    /// further searches would be in vain.
    pub(crate) fn turned(&self) -> bool {
        let accepted = |method| {
            let own = self.report.attempts.iter().filter(move |a| a.method == method);
            own.map(|a| a.accepted).sum::<usize>()
        };
        accepted(StartMethod::Fft) == 0 && accepted(StartMethod::Features) > 0
    }

    /// Where many points have been lost, features may know where they are; returns whether they
    /// were asked. Points not found again keep the verdict they had.
    pub(crate) fn rescue(&mut self) -> bool {
        if self.features.is_some() || self.observer.cancelled() {
            return false;
        }
        let all = 0..self.points.len();
        let lost = |o: &Outcome| {
            matches!(o.status, Status::NotConverged | Status::LowCorrelation | Status::Distorted)
        };
        let count = all.clone().filter(|&k| self.outcomes[k].as_ref().is_none_or(lost)).count();
        if (count as f64) <= LOST * self.points.len() as f64 {
            return false;
        }
        // among many lost points, a doubtful one may be a chance match
        let doubtful = |o: &Outcome| o.status == Status::Converged && o.zncc < DOUBTFUL;
        let lost: Vec<usize> =
            all.filter(|&k| self.outcomes[k].as_ref().is_none_or(|o| lost(o) || doubtful(o))).collect();
        let verdicts: Vec<Option<Outcome>> = lost.iter().map(|&k| self.outcomes[k].take()).collect();
        self.count();
        let found = self.by_features();
        self.spread(found);
        for (&k, verdict) in lost.iter().zip(verdicts) {
            if !self.accepted(k) && verdict.is_some() {
                self.outcomes[k] = verdict;
            }
        }
        self.count();
        true
    }
}

/// Equal tiles over the bounding box of some positions.
struct Tiles {
    lo: [f64; 2],
    size: [f64; 2],
    side: usize,
}

impl Tiles {
    fn around<'p>(positions: impl Iterator<Item = &'p [f64; 2]>, side: usize) -> Self {
        let (mut lo, mut hi) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for p in positions {
            for c in 0..2 {
                lo[c] = lo[c].min(p[c]);
                hi[c] = hi[c].max(p[c]);
            }
        }
        let size = [0, 1].map(|c| (hi[c] - lo[c]).max(1.0) / side as f64);
        Self { lo, size, side }
    }

    /// Tile of a position (the nearest one outside the box), and the squared distance from its
    /// centre.
    fn of(&self, p: &[f64; 2]) -> (usize, f64) {
        let mut tile = [0usize; 2];
        let mut distance = 0.0;
        for c in 0..2 {
            tile[c] = (((p[c] - self.lo[c]) / self.size[c]) as usize).min(self.side - 1);
            distance += (p[c] - self.lo[c] - (tile[c] as f64 + 0.5) * self.size[c]).powi(2);
        }
        (tile[1] * self.side + tile[0], distance)
    }
}

/// Pixels that the subsets of some points use, in cells.
struct Cover {
    columns: usize,
    set: Vec<bool>,
}

impl Cover {
    fn new(run: &Propagation<'_>, points: &[usize], width: usize, height: usize) -> Self {
        let (columns, rows) = (width.div_ceil(CELL), height.div_ceil(CELL));
        let mut set = vec![false; columns * rows];
        let r = run.solver.layout.radius as i32;
        let cell = |c: i32, count: usize| (c.max(0) as usize / CELL).min(count - 1);
        for &k in points {
            let ((x, y), _) = run.points.centre(k);
            let (i0, i1) = (cell(x - r, columns), cell(x + r, columns));
            for j in cell(y - r, rows)..=cell(y + r, rows) {
                set[j * columns + i0..=j * columns + i1].fill(true);
            }
        }
        Self { columns, set }
    }

    fn contains(&self, x: usize, y: usize) -> bool {
        self.set.get(y / CELL * self.columns + x / CELL).is_some_and(|&s| s)
    }

    fn area(&self) -> f64 {
        (self.set.iter().filter(|&&s| s).count() * CELL * CELL) as f64
    }
}
