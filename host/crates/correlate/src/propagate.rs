//! Reliability-guided propagation in waves.
//!
//! Accepted points hand their shape function to the neighbours that have not been treated; all
//! points reached in one wave are solved independently, each from the neighbour of highest ZNCC.
//! What a wave contains depends on earlier results alone, so any number of threads gives the same
//! answer. Points that fail hand on nothing.

use crate::correlate::{Guess, Observer};
use crate::fft::{Search, Window, global_shifts};
use crate::icgn::{Outcome, Scratch, Solver};
use crate::point::{ShapeParameters, SolvedBy, Status};
use crate::points::Points;
use crate::shape::Warp;
use rayon::prelude::*;
use std::collections::HashSet;

/// Reach of the local searches around a predicted displacement, pixels.
const LOCAL_REACH: i32 = 47;
/// Reach of the search at points which failed although their neighbours succeeded.
const RETRY_REACH: i32 = 7;
/// Points per seed, and the most seeds.
const POINTS_PER_SEED: usize = 1500;
const MAX_SEEDS: usize = 25;
/// Seeds that may search the whole deformed image when nothing else has worked.
const WIDE_SEEDS: usize = 4;

/// Seeds that are searched before it is asked whether searching pays.
const BATCH: usize = 64;

/// State of a run.
pub(crate) struct Propagation<'a> {
    pub(crate) solver: &'a Solver<'a>,
    pub(crate) points: &'a Points,
    pub(crate) observer: &'a dyn Observer,
    pub(crate) outcomes: Vec<Option<Outcome>>,
    done: usize,
    /// The dense form has come first.
    dense: bool,
    globals: Vec<[f64; 2]>,
}

struct Task {
    point: usize,
    warp: Warp,
}

impl<'a> Propagation<'a> {
    pub(crate) fn new(solver: &'a Solver<'a>, points: &'a Points, observer: &'a dyn Observer) -> Self {
        Self { solver, points, observer, outcomes: vec![None; points.len()], done: 0, dense: false, globals: Vec::new() }
    }

    /// Tells the observer; a run that began with the dense form has announced a part already.
    fn report(&mut self) {
        let announced = if self.dense { self.points.len() * 2 / 3 } else { 0 };
        self.observer.points(self.done.max(announced), self.points.len());
    }

    /// Points treated so far.
    pub(crate) fn done(&self) -> usize {
        self.done
    }

    fn accepted(&self, k: usize) -> bool {
        self.outcomes[k].is_some_and(|o| o.status == Status::Converged)
    }

    /// First displacements; returns the points accepted.
    pub(crate) fn start(&mut self, guess: &Guess<'_>) -> Vec<usize> {
        match guess {
            Guess::Given(list) => {
                let tasks: Vec<Task> = list
                    .iter()
                    .enumerate()
                    .filter_map(|(point, g)| g.map(|[u, v]| Task { point, warp: Warp::translation(u, v) }))
                    .collect();
                self.solve(&tasks)
            }
            Guess::Shapes(list) => self.start_from(list),
            Guess::Search { u, v } => {
                let window = Window {
                    u: (u.0.floor() as i32, u.1.ceil() as i32),
                    v: (v.0.floor() as i32, v.1.ceil() as i32),
                };
                let seeds = self.seeds();
                self.search(&seeds, &[window])
            }
            Guess::Fft => {
                let (a, b) = (&self.solver.reference.image, &self.solver.target.image);
                self.globals = global_shifts(a, b, 2);
                let seeds = self.seeds();
                let windows = self.local_windows();
                let found = self.search(&seeds, &windows);
                if !found.is_empty() {
                    return found;
                }
                let (w, h) = (a.width() as i32, a.height() as i32);
                let whole = Window { u: (-w / 2, w / 2), v: (-h / 2, h / 2) };
                let spread = seeds.len().div_ceil(WIDE_SEEDS).max(1);
                let few: Vec<usize> = seeds.iter().copied().step_by(spread).collect();
                self.search(&few, &[whole])
            }
        }
    }

    /// The start that a guess holds for one point.
    fn given(&self, guess: &Guess<'_>, point: usize) -> Option<Warp> {
        match guess {
            Guess::Given(list) => list[point].map(|[u, v]| Warp::translation(u, v)),
            Guess::Shapes(list) => {
                let (_, offset) = self.points.centre(point);
                Some(Warp::of(list[point].as_ref()?).moved(-offset[0], -offset[1]))
            }
            _ => None,
        }
    }

    /// Every point from its own displacement and derivatives.
    fn start_from(&mut self, list: &[Option<ShapeParameters>]) -> Vec<usize> {
        let tasks: Vec<Task> = list
            .iter()
            .enumerate()
            .filter_map(|(point, _)| Some(Task { point, warp: self.given(&Guess::Shapes(list), point)? }))
            .collect();
        let found = self.solve(&tasks);
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

    fn local_windows(&self) -> Vec<Window> {
        let mut windows: Vec<Window> =
            self.globals.iter().map(|g| Window::around(g[0], g[1], LOCAL_REACH)).collect();
        let zero = Window::around(0.0, 0.0, LOCAL_REACH);
        if !windows.contains(&zero) {
            windows.push(zero);
        }
        windows
    }

    /// Points spread over the region: those nearest to the centres of equal tiles.
    fn seeds(&self) -> Vec<usize> {
        let xy = self.points.positions();
        let n = xy.len();
        let side = ((n as f64 / POINTS_PER_SEED as f64).sqrt().ceil() as usize).clamp(2, MAX_SEEDS.isqrt());
        let (mut lo, mut hi) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for p in xy {
            for c in 0..2 {
                lo[c] = lo[c].min(p[c]);
                hi[c] = hi[c].max(p[c]);
            }
        }
        let mut best = vec![(f64::INFINITY, usize::MAX); side * side];
        for (k, p) in xy.iter().enumerate() {
            let (centre, _) = self.points.centre(k);
            if !self.solver.fits(centre.0, centre.1) {
                continue;
            }
            let mut tile = [0usize; 2];
            let mut distance = 0.0;
            for c in 0..2 {
                let size = (hi[c] - lo[c]).max(1.0) / side as f64;
                tile[c] = (((p[c] - lo[c]) / size) as usize).min(side - 1);
                distance += (p[c] - lo[c] - (tile[c] as f64 + 0.5) * size).powi(2);
            }
            let b = &mut best[tile[1] * side + tile[0]];
            if distance < b.0 {
                *b = (distance, k);
            }
        }
        best.into_iter().map(|b| b.1).filter(|&k| k < n).collect()
    }

    /// Tries each seed in each window until one is accepted; returns those accepted. Where next to
    /// none of many seeds succeeds there is nothing to be found, and the rest is not tried.
    fn search(&mut self, seeds: &[usize], windows: &[Window]) -> Vec<usize> {
        let mut accepted = Vec::new();
        let searches: Vec<Search> = windows.iter().map(|w| Search::new(&self.solver.layout, w)).collect();
        let mut tried = 0;
        for batch in seeds.chunks(BATCH) {
            let mut left = batch.to_vec();
            for (window, search) in windows.iter().zip(&searches) {
                if left.is_empty() || self.observer.cancelled() {
                    break;
                }
                accepted.extend(self.search_each(&left, search, |_| *window));
                left.retain(|&k| !self.accepted(k));
            }
            tried += batch.len();
            if tried >= 2 * BATCH && accepted.len() * 20 < tried {
                break;
            }
        }
        accepted.sort_unstable();
        accepted
    }

    fn search_each(
        &mut self,
        seeds: &[usize],
        search: &Search,
        window: impl Fn(usize) -> Window + Sync,
    ) -> Vec<usize> {
        let (solver, points, observer) = (self.solver, self.points, self.observer);
        let results: Vec<Option<Outcome>> = seeds
            .par_iter()
            .map_init(Scratch::default, |scratch, &k| {
                if observer.cancelled() {
                    return None;
                }
                let (centre, offset) = points.centre(k);
                let (u, v, _) = search.best(solver, scratch, centre, &window(k))?;
                let guess = Warp::translation(f64::from(u), f64::from(v));
                Some(solver.solve(scratch, centre, offset, &guess))
            })
            .collect();
        let mut accepted = Vec::new();
        for (&k, r) in seeds.iter().zip(results) {
            if let Some(o) = r
                && self.keep(k, o)
            {
                accepted.push(k);
            }
        }
        accepted
    }

    /// Stores an outcome unless the point has a better one; whether it was newly accepted.
    fn keep(&mut self, k: usize, o: Outcome) -> bool {
        let ok = o.status == Status::Converged;
        match &self.outcomes[k] {
            Some(old) if old.status == Status::Converged || !ok => return false,
            Some(_) => {}
            None => self.done += 1,
        }
        self.outcomes[k] = Some(o);
        ok
    }

    /// Solves independent points; returns those accepted, in the order given.
    fn solve(&mut self, tasks: &[Task]) -> Vec<usize> {
        let (solver, points, observer) = (self.solver, self.points, self.observer);
        let results: Vec<Option<Outcome>> = tasks
            .par_iter()
            .with_min_len(8)
            .map_init(Scratch::default, |scratch, task| {
                if observer.cancelled() {
                    return None;
                }
                let (centre, offset) = points.centre(task.point);
                Some(solver.solve(scratch, centre, offset, &task.warp))
            })
            .collect();
        let mut accepted = Vec::new();
        for (task, r) in tasks.iter().zip(results) {
            if let Some(o) = r
                && self.keep(task.point, o)
            {
                accepted.push(task.point);
            }
        }
        self.report();
        accepted
    }

    /// Waves from the given points until nothing more is reached.
    fn spread(&mut self, mut front: Vec<usize>) {
        let mut source: Vec<u32> = Vec::new();
        while !front.is_empty() && !self.observer.cancelled() {
            let mut reached: Vec<usize> = Vec::new();
            source.resize(self.points.len(), u32::MAX);
            for &k in &front {
                let z = self.outcomes[k].map_or(f64::NEG_INFINITY, |o| o.zncc);
                for &c in self.points.neighbours(k) {
                    let c = c as usize;
                    if self.outcomes[c].is_some() {
                        continue;
                    }
                    let best = &mut source[c];
                    if *best == u32::MAX {
                        reached.push(c);
                        *best = k as u32;
                    } else if self.outcomes[*best as usize].is_some_and(|o| z > o.zncc) {
                        *best = k as u32;
                    }
                }
            }
            // in the order of the points: neighbours share their cache lines
            reached.sort_unstable();
            let tasks: Vec<Task> = reached
                .iter()
                .filter_map(|&c| {
                    let from = source[c] as usize;
                    let warp = self.predicted(from, c)?;
                    Some(Task { point: c, warp })
                })
                .collect();
            for &c in &reached {
                source[c] = u32::MAX;
            }
            front = self.solve(&tasks);
        }
    }

    /// Shape function of point `from`, seen from point `to`.
    fn predicted(&self, from: usize, to: usize) -> Option<Warp> {
        let ((xa, ya), _) = self.points.centre(from);
        let ((xb, yb), _) = self.points.centre(to);
        let o = self.outcomes[from]?;
        Some(o.warp.moved(f64::from(xb - xa), f64::from(yb - ya)))
    }

    /// Solves what the dense form has left: first the points for which it proposes a start.
    pub(crate) fn complete(
        &mut self,
        proposals: &[(usize, Warp)],
        guess: &Guess<'_>,
        sparse: Propagation<'_>,
    ) {
        self.globals = sparse.globals;
        self.dense = true;
        self.done = self.outcomes.iter().filter(|o| o.is_some()).count();
        let mut tasks: Vec<Task> = proposals.iter().map(|&(point, warp)| Task { point, warp }).collect();
        let proposed: HashSet<usize> = proposals.iter().map(|p| p.0).collect();
        for point in 0..self.points.len() {
            if self.outcomes[point].is_none()
                && !proposed.contains(&point)
                && let Some(warp) = self.given(guess, point)
            {
                tasks.push(Task { point, warp });
            }
        }
        tasks.sort_by_key(|t| t.point);
        self.solve(&tasks);
        let mut front: Vec<usize> = (0..self.points.len())
            .filter(|&k| self.outcomes[k].is_none())
            .flat_map(|k| self.points.neighbours(k).iter().map(|&c| c as usize))
            .filter(|&c| self.accepted(c))
            .collect();
        front.sort_unstable();
        front.dedup();
        self.finish(front, guess);
    }

    /// Marks the points that the dense form does not answer for.
    pub(crate) fn give_up(&mut self, proposals: &[(usize, Warp)]) {
        let mut warps = proposals.iter().peekable();
        for (k, outcome) in self.outcomes.iter_mut().enumerate() {
            let proposed = warps.next_if(|p| p.0 == k).map(|p| p.1);
            if outcome.is_none() {
                let warp = proposed.unwrap_or(Warp::translation(0.0, 0.0));
                let mut o = Outcome::failed(Status::NotConverged, warp);
                o.solver = SolvedBy::Dense;
                *outcome = Some(o);
            }
        }
        self.done = self.outcomes.len();
        self.report();
    }

    /// Propagation, second attempts, and new seeds where propagation has not come.
    pub(crate) fn finish(&mut self, seeds: Vec<usize>, guess: &Guess<'_>) {
        self.spread(seeds);
        self.leaving();
        for apart in [4, 1] {
            let fresh = self.reseed(apart, guess);
            if fresh.is_empty() {
                break;
            }
            self.spread(fresh);
        }
        let again = self.retry();
        self.spread(again);
        self.leaving();
    }

    /// Names the points that have no place in one of the images: those whose subset leaves the
    /// reference, and those that the displacement of the accepted points next to them carries out
    /// of the deformed image.
    fn leaving(&mut self) {
        let mut front: Vec<usize> = Vec::new();
        for k in 0..self.points.len() {
            if self.accepted(k) {
                continue;
            }
            let ((x, y), _) = self.points.centre(k);
            if !self.solver.fits(x, y) {
                let nowhere = Warp::translation(0.0, 0.0);
                self.outcomes[k] = Some(Outcome::failed(Status::OutOfImage, nowhere));
            } else if self.outcomes[k].is_none_or(|o| o.status == Status::NotConverged) {
                let near = self.points.neighbours(k).iter().map(|&c| c as usize);
                front.extend(near.filter(|&c| self.accepted(c)));
            }
        }
        front.sort_unstable();
        front.dedup();
        while !front.is_empty() {
            let mut next = Vec::new();
            for &k in &front {
                let Some(from) = self.outcomes[k] else {
                    continue;
                };
                for &c in self.points.neighbours(k) {
                    let c = c as usize;
                    let open = self.outcomes[c].is_none_or(|o| o.status == Status::NotConverged);
                    let ((x, y), _) = self.points.centre(c);
                    if open && self.solver.leaves(x, y, &from.warp) {
                        self.outcomes[c] = Some(Outcome::failed(Status::OutOfImage, from.warp));
                        next.push(c);
                    }
                }
            }
            front = next;
        }
        self.done = self.outcomes.iter().filter(|o| o.is_some()).count();
    }

    /// Points that failed beside accepted ones get a second attempt: from the median of what the
    /// neighbours predict, after a search of the nearest whole pixels.
    fn retry(&mut self) -> Vec<usize> {
        let mut seeds = Vec::new();
        let mut predictions = Vec::new();
        for k in 0..self.points.len() {
            let failed = self.outcomes[k].is_some_and(|o| {
                matches!(o.status, Status::NotConverged | Status::LowCorrelation | Status::Distorted)
            });
            if !failed {
                continue;
            }
            let mut near: Vec<[f64; 2]> = self
                .points
                .neighbours(k)
                .iter()
                .filter(|&&c| self.accepted(c as usize))
                .filter_map(|&c| self.predicted(c as usize, k))
                .map(|w| [w.0[0][0], w.0[1][0]])
                .collect();
            if near.is_empty() {
                continue;
            }
            let middle = near.len() / 2;
            let mut median = |c: usize| {
                near.sort_by(|a, b| a[c].total_cmp(&b[c]));
                near[middle][c]
            };
            predictions.push([median(0), median(1)]);
            seeds.push(k);
        }
        if seeds.is_empty() {
            return Vec::new();
        }
        let window = Window::around(0.0, 0.0, RETRY_REACH);
        let search = Search::new(&self.solver.layout, &window);
        let at = |k: usize| {
            // seeds are ascending
            let p = seeds.binary_search(&k).map_or([0.0; 2], |i| predictions[i]);
            Window::around(p[0], p[1], RETRY_REACH)
        };
        self.search_each(&seeds, &search, at)
    }

    /// Own searches at untreated points, none nearer than `apart` steps of neighbourhood to the
    /// next.
    fn reseed(&mut self, apart: usize, guess: &Guess<'_>) -> Vec<usize> {
        let n = self.points.len();
        let mut covered = vec![false; n];
        let mut seeds = Vec::new();
        let mut ring: Vec<usize> = Vec::new();
        for k in 0..n {
            if covered[k] || self.outcomes[k].is_some() {
                continue;
            }
            seeds.push(k);
            covered[k] = true;
            ring.clear();
            ring.push(k);
            for _ in 0..apart {
                let mut next = Vec::new();
                for &a in &ring {
                    for &c in self.points.neighbours(a) {
                        let c = c as usize;
                        if !covered[c] {
                            covered[c] = true;
                            next.push(c);
                        }
                    }
                }
                ring = next;
            }
        }
        if seeds.is_empty() {
            return Vec::new();
        }
        let windows = match guess {
            Guess::Search { u, v } => vec![Window {
                u: (u.0.floor() as i32, u.1.ceil() as i32),
                v: (v.0.floor() as i32, v.1.ceil() as i32),
            }],
            _ => self.local_windows(),
        };
        self.search(&seeds, &windows)
    }
}
