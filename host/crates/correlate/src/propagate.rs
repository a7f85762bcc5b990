//! Reliability-guided propagation in waves.
//!
//! Accepted points hand their shape function to the neighbours that have not been treated; all
//! points reached in one wave are solved independently, each from the neighbour of highest ZNCC.
//! What a wave contains depends on earlier results alone, so any number of threads gives the same
//! answer. Points that fail hand on nothing.

use crate::correlate::{Guess, Observer};
use crate::features::FeatureMatches;
use crate::fft::{Search, Window};
use crate::icgn::{Outcome, Scratch, Solver};
use crate::point::{SolvedBy, Status};
use crate::points::Points;
use crate::shape::{Shape, Warp};
use crate::start::{StartMethod, StartReport};
use rayon::prelude::*;
use std::collections::HashSet;

/// Reach of the search at points which failed although their neighbours succeeded.
const RETRY_REACH: i32 = 7;
/// Rounds of second attempts after the first.
const RETRIES: usize = 8;
/// ZNCC below which an accepted seed is also searched in the other windows: periodic textures match
/// in many places, but better in one.
pub(crate) const DOUBTFUL: f64 = 0.75;
/// Difference in ZNCC by which a neighbour must be better to cast doubt on an accepted point.
const CLEARLY: f64 = 0.1;
/// Seeds that are searched before it is asked whether searching pays.
pub(crate) const BATCH: usize = 64;

/// Points that one thread looks through at a time.
pub(crate) const SCAN: usize = 2048;

/// State of a run.
pub(crate) struct Propagation<'a> {
    pub(crate) solver: &'a Solver<'a>,
    pub(crate) points: &'a Points,
    pub(crate) observer: &'a dyn Observer,
    pub(crate) outcomes: Vec<Option<Outcome>>,
    pub(crate) done: usize,
    /// The dense form has come first.
    dense: bool,
    /// Shifts of the whole image.
    pub(crate) globals: Vec<[f64; 2]>,
    /// Matched features, where they were needed.
    pub(crate) features: Option<FeatureMatches>,
    /// What the run began with.
    pub(crate) report: StartReport,
}

pub(crate) struct Task {
    pub(crate) point: usize,
    pub(crate) warp: Warp,
}

impl Task {
    pub(crate) fn translation(point: usize, u: f64, v: f64) -> Self {
        Self { point, warp: Warp::translation(u, v) }
    }
}

impl<'a> Propagation<'a> {
    pub(crate) fn new(solver: &'a Solver<'a>, points: &'a Points, observer: &'a dyn Observer) -> Self {
        Self {
            solver,
            points,
            observer,
            outcomes: vec![None; points.len()],
            done: 0,
            dense: false,
            globals: Vec::new(),
            features: None,
            report: StartReport::default(),
        }
    }

    /// Tells the observer; a run that began with the dense form has announced a part already.
    pub(crate) fn tell(&self) {
        let announced = if self.dense { self.points.len() * 2 / 3 } else { 0 };
        self.observer.points(self.done.max(announced), self.points.len());
    }

    /// Points treated so far.
    pub(crate) fn done(&self) -> usize {
        self.done
    }

    pub(crate) fn accepted(&self, k: usize) -> bool {
        self.outcomes[k].is_some_and(|o| o.status == Status::Converged)
    }

    /// The start that a guess holds for one point.
    pub(crate) fn given(&self, guess: &Guess<'_>, point: usize) -> Option<Warp> {
        match guess {
            Guess::Given(list) => list[point].map(|[u, v]| Warp::translation(u, v)),
            Guess::Shapes(list) => {
                let (_, offset) = self.points.centre(point);
                Some(Warp::of(list[point].as_ref()?).moved(-offset[0], -offset[1]))
            }
            _ => None,
        }
    }

    /// Tries each seed in each window until one is accepted; returns those accepted. Where next to
    /// none of many seeds succeeds there is nothing to be found, and the rest is not tried.
    pub(crate) fn search(&mut self, seeds: &[usize], windows: &[Window]) -> Vec<usize> {
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
                left.retain(|&k| !self.accepted(k) || self.zncc(k) < DOUBTFUL);
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

    fn zncc(&self, k: usize) -> f64 {
        self.outcomes[k].map_or(f64::NEG_INFINITY, |o| o.zncc)
    }

    /// Stores an outcome unless the point has a better one; whether it was newly accepted.
    pub(crate) fn keep(&mut self, k: usize, o: Outcome) -> bool {
        let ok = o.status == Status::Converged;
        match &self.outcomes[k] {
            Some(old) if old.status == Status::Converged => {
                // a doubtful match gives way to a better one
                if ok && old.zncc < DOUBTFUL && o.zncc > old.zncc {
                    self.outcomes[k] = Some(o);
                }
                return false;
            }
            Some(_) if !ok => return false,
            Some(_) => {}
            None => self.done += 1,
        }
        self.outcomes[k] = Some(o);
        ok
    }

    /// Solves independent points; returns those accepted, in the order given.
    pub(crate) fn solve(&mut self, tasks: &[Task]) -> Vec<usize> {
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
        self.tell();
        accepted
    }

    /// Waves from the given points until nothing more is reached.
    pub(crate) fn spread(&mut self, mut front: Vec<usize>) {
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

    /// Takes over what the start of a run over some of the points (`chosen`) has found.
    pub(crate) fn inherit(&mut self, other: Propagation<'_>, chosen: &[usize]) {
        self.globals = other.globals;
        self.features = other.features;
        self.report = other.report;
        for seed in &mut self.report.rejected {
            seed.point = seed.point.and_then(|k| chosen.get(k).copied());
        }
    }

    /// Solves what the dense form has left: first the points for which it proposes a start.
    pub(crate) fn complete(&mut self, proposals: &[(usize, Warp)], guess: &Guess<'_>) {
        self.dense = true;
        self.count();
        let settled =
            |o: &Option<Outcome>| o.is_some_and(|o| o.status == Status::Converged && o.zncc >= DOUBTFUL);
        if self.outcomes.par_iter().with_min_len(SCAN).all(settled) {
            self.tell();
            return;
        }
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
        self.tell();
    }

    /// Propagation, second attempts, and new seeds where propagation has not come.
    pub(crate) fn finish(&mut self, seeds: Vec<usize>, guess: &Guess<'_>) {
        let fell_back = || self.report.attempts.iter().any(|a| a.method == StartMethod::Fft);
        let automatic = match guess {
            Guess::Auto => true,
            Guess::Shapes(_) => fell_back(),
            _ => false,
        };
        self.spread(seeds);
        self.leaving();
        for apart in [4, 1] {
            let fresh = self.reseed(apart, guess);
            let nothing = fresh.is_empty();
            self.spread(fresh);
            let rescued = automatic && self.rescue();
            if nothing && !rescued {
                break;
            }
        }
        let mut again = self.retry(0..self.points.len());
        for _ in 0..RETRIES {
            if again.is_empty() {
                break;
            }
            // those beside what has just been accepted have a better guess now
            let mut beside: Vec<usize> =
                again.iter().flat_map(|&k| self.points.neighbours(k)).map(|&c| c as usize).collect();
            beside.sort_unstable();
            beside.dedup();
            self.spread(again);
            again = self.retry(beside.into_iter());
        }
        self.spread(again);
        self.leaving();
    }

    /// Names the points that have no place in one of the images: those whose subset leaves the
    /// reference, and those that the displacement of the accepted points next to them carries out
    /// of the deformed image.
    fn leaving(&mut self) {
        let mut front: Vec<usize> = Vec::new();
        let mut open = false;
        for k in 0..self.points.len() {
            if self.accepted(k) {
                continue;
            }
            let ((x, y), _) = self.points.centre(k);
            if !self.solver.fits(x, y) {
                let nowhere = Warp::translation(0.0, 0.0);
                self.outcomes[k] = Some(Outcome::failed(Status::OutOfImage, nowhere));
                continue;
            }
            let outside = self.outcomes[k].is_some_and(|o| o.status == Status::OutOfImage);
            let own = self.outcomes[k].is_none_or(|o| o.status == Status::NotConverged);
            open |= own;
            if own || outside {
                let near = self.points.neighbours(k).iter().map(|&c| c as usize);
                front.extend(near.filter(|&c| self.accepted(c)));
            }
        }
        if !open {
            front.clear();
        }
        front.sort_unstable();
        front.dedup();
        let mut passed = vec![false; if front.is_empty() { 0 } else { self.points.len() }];
        while !front.is_empty() {
            let mut next = Vec::new();
            for &k in &front {
                for &c in self.points.neighbours(k) {
                    let c = c as usize;
                    let outside = self.outcomes[c].is_some_and(|o| o.status == Status::OutOfImage);
                    let open = outside || self.outcomes[c].is_none_or(|o| o.status == Status::NotConverged);
                    if !open || passed[c] {
                        continue;
                    }
                    // far away, higher terms lead anywhere
                    let Some(warp) = self.predicted(k, c).map(|w| w.restricted(Shape::Affine)) else {
                        continue;
                    };
                    let ((x, y), _) = self.points.centre(c);
                    if outside || self.solver.leaves(x, y, &warp) {
                        passed[c] = true;
                        self.outcomes[c] = Some(Outcome::failed(Status::OutOfImage, warp));
                        next.push(c);
                    }
                }
            }
            front = next;
        }
        self.count();
    }

    pub(crate) fn count(&mut self) {
        self.done = self.outcomes.iter().filter(|o| o.is_some()).count();
    }

    /// Points that failed beside accepted ones get a second attempt: from what their neighbour of
    /// highest ZNCC predicts (they may have begun elsewhere), then from the median of what all
    /// neighbours predict, after a search of the nearest whole pixels. `candidates` is ascending.
    fn retry(&mut self, candidates: impl Iterator<Item = usize>) -> Vec<usize> {
        use Status::{Converged, Distorted, LowCorrelation, NotConverged, OutOfImage};
        let mut tasks = Vec::new();
        for k in candidates {
            let Some(own) = self.outcomes[k] else {
                continue;
            };
            let doubtful = own.status == Converged && own.zncc < DOUBTFUL;
            if !doubtful && !matches!(own.status, NotConverged | LowCorrelation | Distorted | OutOfImage) {
                continue;
            }
            let near = self.points.neighbours(k).iter().map(|&c| c as usize).filter(|&c| self.accepted(c));
            let best = near.reduce(|a, b| if self.zncc(b) > self.zncc(a) { b } else { a });
            // where its neighbours are so much better it may be a chance match
            if doubtful && best.is_none_or(|b| self.zncc(b) <= own.zncc + CLEARLY) {
                continue;
            }
            let ((x, y), _) = self.points.centre(k);
            if let Some(warp) = best.and_then(|b| self.predicted(b, k))
                && !self.solver.leaves(x, y, &warp)
            {
                tasks.push(Task { point: k, warp });
            }
        }
        let mut found = self.solve(&tasks);
        let still: Vec<usize> = tasks.iter().map(|t| t.point).filter(|&k| !self.accepted(k)).collect();
        found.extend(self.retry_search(&still));
        found.sort_unstable();
        found
    }

    /// Searches around the median displacement that the accepted neighbours predict; `failed` is
    /// ascending.
    fn retry_search(&mut self, failed: &[usize]) -> Vec<usize> {
        let mut seeds = Vec::new();
        let mut predictions = Vec::new();
        for &k in failed {
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
        let mut found = self.near_features(&seeds);
        seeds.retain(|&k| !self.accepted(k));
        let windows = match guess {
            Guess::Search { u, v } => vec![Window::range(*u, *v)],
            Guess::Features => Vec::new(),
            _ if self.turned() => Vec::new(),
            _ => self.local_windows(),
        };
        found.extend(self.search(&seeds, &windows));
        found
    }
}
