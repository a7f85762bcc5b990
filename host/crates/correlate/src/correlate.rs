//! The run over all points: checks, initial guesses, propagation, verdicts.

use crate::consistency;
use crate::dense::{self, Dense};
use crate::discontinuity;
use crate::domain::Domain;
use crate::icgn::{Outcome, Solver};
use crate::point::{Point, ShapeParameters, SolvedBy, Status};
use crate::points::Points;
use crate::prepared::{Reference, Target};
use crate::propagate::{Propagation, SCAN};
use crate::settings::{Criterion, Interpolation, Settings, SettingsError, SolverChoice};
use crate::simd::dispatch;
use crate::start::{Seed, StartReport};
use fearless_simd::{Level, Simd};
use rayon::prelude::*;
use std::time::{Duration, Instant};
use thiserror::Error;

/// Where the first displacements come from.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Guess<'a> {
    /// Cross-correlation by FFT, and where it does not lead to most of the points, features.
    #[default]
    Auto,
    /// Whole-image and local cross-correlation by FFT; shifts up to half the image, rotations of a
    /// few degrees.
    Fft,
    /// Matched features alone (see [`match_features`](crate::match_features)): any rotation, scales
    /// of 0.6–1.6.
    Features,
    /// Whole-pixel search over a range of displacements, e.g. along the diffraction direction when
    /// one view is matched to the other in the same frame.
    Search {
        /// Smallest and largest u, pixels.
        u: (f64, f64),
        /// Smallest and largest v, pixels.
        v: (f64, f64),
    },
    /// A displacement (u, v) for every point, good to about two pixels. Points with `None`, and
    /// those that fail from their guess, are reached from their neighbours.
    Given(&'a [Option<[f64; 2]>]),
    /// Displacement and derivatives at every point, as the frame before left them. Where more than
    /// half of them fail the frame has moved on too far, and the default guess is used instead;
    /// otherwise points with `None`, and those that fail, are reached from their neighbours.
    Shapes(&'a [Option<ShapeParameters>]),
    /// Displacements of a few places, with gradients where the material has turned: the point
    /// nearest to each is started there, the rest is reached from these. Seeds that are not
    /// confirmed are named in the [`StartReport`].
    Seeds(&'a [Seed]),
}

/// Stage of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Stage {
    /// Initial guesses and seeds.
    Init,
    /// Optimisation of all points.
    Solve,
}

/// Told how far a run has come; may stop it.
pub trait Observer: Sync {
    /// A stage has begun. Called from the thread that called [`correlate`].
    fn stage(&self, stage: Stage) {
        let _ = stage;
    }

    /// `done` of `total` points have been treated.
    fn points(&self, done: usize, total: usize) {
        let _ = (done, total);
    }

    /// Whether the run should stop; asked often, from any thread.
    fn cancelled(&self) -> bool {
        false
    }
}

/// Says nothing, stops nothing.
impl Observer for () {}

/// Why a run did not take place or did not end.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CorrelateError {
    /// A setting is unusable.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The images differ in size.
    #[error(
        "the reference image has {reference_width}×{reference_height} pixels, the deformed image {target_width}×{target_height}"
    )]
    ImageSize {
        /// Columns of the reference image.
        reference_width: usize,
        /// Rows of the reference image.
        reference_height: usize,
        /// Columns of the deformed image.
        target_width: usize,
        /// Rows of the deformed image.
        target_height: usize,
    },
    /// The deformed image was prepared for another interpolation.
    #[error(
        "the deformed image was prepared for {prepared:?} interpolation, the settings ask for {wanted:?}"
    )]
    Interpolation {
        /// Interpolation of the prepared image.
        prepared: Interpolation,
        /// Interpolation in the settings.
        wanted: Interpolation,
    },
    /// The mask of the points has another size than the images.
    #[error("the mask has {mask_width}×{mask_height} pixels, the images {width}×{height}")]
    MaskSize {
        /// Columns of the mask.
        mask_width: usize,
        /// Rows of the mask.
        mask_height: usize,
        /// Columns of the images.
        width: usize,
        /// Rows of the images.
        height: usize,
    },
    /// The list of guesses does not belong to the points.
    #[error("{guesses} initial guesses were given for {points} points")]
    GuessCount {
        /// Guesses given.
        guesses: usize,
        /// Points.
        points: usize,
    },
    /// A guess, a seed or a search range is not a number, or too large.
    #[error("the initial guess {index} is not made of finite numbers within ±{limit} pixels")]
    GuessValue {
        /// Index in the list; 0 for a search range.
        index: usize,
        /// Largest displacement accepted.
        limit: f64,
    },
    /// The search range is empty or too large to be searched.
    #[error("the search range u {u:?}, v {v:?} must be ascending and at most {limit} shifts")]
    SearchRange {
        /// Range of u.
        u: (f64, f64),
        /// Range of v.
        v: (f64, f64),
        /// Most shifts accepted.
        limit: f64,
    },
    /// The dense form alone was asked for where there is none.
    #[error(
        "the dense form needs the criterion ZNSSD and a regular grid of at least 4 × 4 points, {least_overlap} or more steps to a subset; `auto` and `exact` take any"
    )]
    NoDenseForm {
        /// Steps that must fit into a subset.
        least_overlap: usize,
    },
    /// The observer asked to stop.
    #[error("the correlation was cancelled after {done} of {total} points")]
    Cancelled {
        /// Points treated.
        done: usize,
        /// Points in all.
        total: usize,
    },
}

/// Wall time of the stages of a run. Preparation of the images is timed by whoever prepares them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Timing {
    /// Initial guesses.
    pub init: Duration,
    /// Optimisation and verdicts.
    pub solve: Duration,
}

/// Result of a run: one entry per point, in the points' order.
#[derive(Debug, Clone, Default)]
pub struct Correlation {
    /// Results.
    pub points: Vec<Point>,
    /// Wall times.
    pub timing: Timing,
    /// What the initial guesses came from, and how far they reached.
    pub start: StartReport,
}

impl Correlation {
    /// Number of points with [`Status::Converged`].
    pub fn converged(&self) -> usize {
        self.points.iter().filter(|p| p.status.is_ok()).count()
    }
}

/// Largest displacement that may be asked for.
const LIMIT: f64 = 65536.0;
/// Most shifts searched at one seed.
const MAX_SHIFTS: f64 = 16e6;

/// Memory that is used again from one run to the next. A series of images with one reference and one
/// grid needs it once; results are those of [`correlate`].
#[derive(Default)]
pub struct Workspace {
    dense: Dense,
}

impl Workspace {
    /// An empty workspace; memory is taken when it is needed.
    pub fn new() -> Self {
        Self::default()
    }

    /// As [`correlate`], with this memory.
    ///
    /// # Errors
    /// As [`correlate`].
    pub fn correlate(
        &mut self,
        reference: &Reference,
        target: &Target,
        points: &Points,
        guess: &Guess<'_>,
        settings: &Settings,
        observer: &dyn Observer,
    ) -> Result<Correlation, CorrelateError> {
        check(reference, target, points, guess, settings)?;
        let start = Instant::now();
        observer.stage(Stage::Init);
        let mut solver = Solver::new(reference, target, settings, Level::new());
        solver.domain = points.domain();
        let mut run = Propagation::new(&solver, points, observer);
        // the window sums know a free gain alone
        let plain = settings.criterion == Criterion::Znssd;
        let possible = plain && self.dense.prepare(&solver, points);
        let sparse = if possible { self.dense.sparse(points) } else { None };
        let Some(sparse) = sparse else {
            if settings.solver == SolverChoice::Dense {
                return Err(CorrelateError::NoDenseForm { least_overlap: dense::OVERLAP });
            }
            return run_exact(run, guess, start);
        };
        let loose = Settings { tolerance: settings.tolerance.max(LOOSE), ..settings.clone() };
        let mut solver_sparse = Solver::new(reference, target, &loose, Level::new());
        solver_sparse.domain = points.domain();
        let few = points.selected(&sparse.points);
        let quiet = Quiet(observer);
        let mut first = Propagation::new(&solver_sparse, &few, &quiet);
        let (given, shapes) = few_guesses(guess, &sparse.points);
        let guess_sparse = match guess {
            Guess::Given(_) => Guess::Given(&given),
            Guess::Shapes(_) => Guess::Shapes(&shapes),
            other => *other,
        };
        let seeds = first.start(&guess_sparse);
        first.finish(seeds, &guess_sparse);
        // a sparse point at a wrong place would bend the field of all around it
        consistency::judge(&solver_sparse, &few, &mut first.outcomes);
        let init = start.elapsed();
        observer.stage(Stage::Solve);
        let proposals = self.dense.solve(
            &solver,
            points,
            &sparse,
            &first.outcomes,
            &mut run.outcomes,
            settings.solver != SolverChoice::Exact,
            observer,
        );
        run.inherit(first, &sparse.points);
        if settings.solver == SolverChoice::Dense {
            run.give_up(&proposals);
        } else {
            run.complete(&proposals, guess);
        }
        finished(run, start, init)
    }
}

/// Edge motion, in pixels, at which the sparse points of the dense form stop: its passes do the rest.
const LOOSE: f64 = 0.02;

/// Passes on whether to stop, nothing else.
struct Quiet<'a>(&'a dyn Observer);

impl Observer for Quiet<'_> {
    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }
}

/// Guesses of the chosen points, where there is one for every point.
fn few_guesses(guess: &Guess<'_>, few: &[usize]) -> (Vec<Option<[f64; 2]>>, Vec<Option<ShapeParameters>>) {
    match guess {
        Guess::Given(list) => (few.iter().map(|&k| list[k]).collect(), Vec::new()),
        Guess::Shapes(list) => (Vec::new(), few.iter().map(|&k| list[k]).collect()),
        _ => (Vec::new(), Vec::new()),
    }
}

/// Correlates the deformed image `target` with `reference` at `points`.
///
/// Runs on the current rayon thread pool; the result does not depend on its size.
///
/// # Errors
/// [`CorrelateError`]; failures at single points are reported by their [`Status`].
pub fn correlate(
    reference: &Reference,
    target: &Target,
    points: &Points,
    guess: &Guess<'_>,
    settings: &Settings,
    observer: &dyn Observer,
) -> Result<Correlation, CorrelateError> {
    Workspace::new().correlate(reference, target, points, guess, settings, observer)
}

/// As [`correlate`], with the scalar double-precision reference implementation of the inner loops and
/// every point by its own iteration: some hundred times slower, for checking.
///
/// # Errors
/// As [`correlate`].
pub fn correlate_scalar(
    reference: &Reference,
    target: &Target,
    points: &Points,
    guess: &Guess<'_>,
    settings: &Settings,
    observer: &dyn Observer,
) -> Result<Correlation, CorrelateError> {
    check(reference, target, points, guess, settings)?;
    let start = Instant::now();
    observer.stage(Stage::Init);
    let mut solver = Solver::new(reference, target, settings, Level::new());
    solver.scalar = true;
    solver.domain = points.domain();
    run_exact(Propagation::new(&solver, points, observer), guess, start)
}

fn run_exact(
    mut run: Propagation<'_>,
    guess: &Guess<'_>,
    start: Instant,
) -> Result<Correlation, CorrelateError> {
    let seeds = run.start(guess);
    let init = start.elapsed();
    run.observer.stage(Stage::Solve);
    run.finish(seeds, guess);
    finished(run, start, init)
}

fn finished(run: Propagation<'_>, start: Instant, init: Duration) -> Result<Correlation, CorrelateError> {
    let points = run.points;
    if run.observer.cancelled() {
        return Err(CorrelateError::Cancelled { done: run.done(), total: points.len() });
    }
    let mut outcomes = run.outcomes;
    let mut report = run.report;
    if run.solver.settings.discontinuities {
        discontinuity::resolve(run.solver, points, &mut outcomes, run.observer);
        if run.observer.cancelled() {
            return Err(CorrelateError::Cancelled { done: points.len(), total: points.len() });
        }
    }
    consistency::judge(run.solver, points, &mut outcomes);
    let points: Vec<Point> = outcomes
        .par_iter()
        .with_min_len(SCAN)
        .enumerate()
        .map(|(k, o)| point(points, k, o.as_ref()))
        .collect();
    let settings = run.solver.settings;
    report.close(&points, settings.shape, settings.radius());
    Ok(Correlation { points, timing: Timing { init, solve: start.elapsed() - init }, start: report })
}

/// Name of the SIMD instruction set that the kernels use on this machine.
pub fn simd_level() -> String {
    let name = format!("{:?}", dispatch!(Level::new(), s => s.level()));
    name.split(['(', ' ', '{']).next().unwrap_or_default().to_owned()
}

fn check(
    reference: &Reference,
    target: &Target,
    points: &Points,
    guess: &Guess<'_>,
    settings: &Settings,
) -> Result<(), CorrelateError> {
    let (a, b) = (&reference.image, &target.image);
    if (a.width(), a.height()) != (b.width(), b.height()) {
        return Err(CorrelateError::ImageSize {
            reference_width: a.width(),
            reference_height: a.height(),
            target_width: b.width(),
            target_height: b.height(),
        });
    }
    settings.validate_for(a.width(), a.height())?;
    if let Some((mask_width, mask_height)) = points.domain().map(Domain::size)
        && (mask_width, mask_height) != (a.width(), a.height())
    {
        let (width, height) = (a.width(), a.height());
        return Err(CorrelateError::MaskSize { mask_width, mask_height, width, height });
    }
    if target.interpolation != settings.interpolation {
        return Err(CorrelateError::Interpolation {
            prepared: target.interpolation,
            wanted: settings.interpolation,
        });
    }
    let usable = |c: f64| c.is_finite() && c.abs() <= LIMIT;
    match guess {
        Guess::Auto | Guess::Fft | Guess::Features => {}
        Guess::Search { u, v } => {
            if ![u.0, u.1, v.0, v.1].into_iter().all(usable) {
                return Err(CorrelateError::GuessValue { index: 0, limit: LIMIT });
            }
            let shifts = (u.1 - u.0 + 1.0) * (v.1 - v.0 + 1.0);
            if u.1 < u.0 || v.1 < v.0 || shifts > MAX_SHIFTS {
                return Err(CorrelateError::SearchRange { u: *u, v: *v, limit: MAX_SHIFTS });
            }
        }
        Guess::Given(list) => {
            if list.len() != points.len() {
                return Err(CorrelateError::GuessCount { guesses: list.len(), points: points.len() });
            }
            if let Some(index) = list.iter().position(|g| g.is_some_and(|d| !d.into_iter().all(usable))) {
                return Err(CorrelateError::GuessValue { index, limit: LIMIT });
            }
        }
        Guess::Seeds(list) => {
            if let Some(index) = list.iter().position(|s| !s.numbers().all(usable)) {
                return Err(CorrelateError::GuessValue { index, limit: LIMIT });
            }
        }
        Guess::Shapes(list) => {
            if list.len() != points.len() {
                return Err(CorrelateError::GuessCount { guesses: list.len(), points: points.len() });
            }
            let all = |s: &ShapeParameters| s.u.iter().chain(&s.v).all(|&c| usable(f64::from(c)));
            if let Some(index) = list.iter().position(|g| g.as_ref().is_some_and(|s| !all(s))) {
                return Err(CorrelateError::GuessValue { index, limit: LIMIT });
            }
        }
    }
    Ok(())
}

fn point(points: &Points, k: usize, outcome: Option<&Outcome>) -> Point {
    let [x, y] = points.positions()[k];
    let mut p = Point {
        x,
        y,
        u: f64::NAN,
        v: f64::NAN,
        sigma_u: f32::NAN,
        sigma_v: f32::NAN,
        zncc: f32::NAN,
        iterations: 0,
        status: Status::NoGuess,
        solver: SolvedBy::Exact,
        shape: ShapeParameters::default(),
    };
    let Some(o) = outcome else {
        return p;
    };
    p.status = o.status;
    p.solver = o.solver;
    p.iterations = o.iterations;
    if o.iterations == 0 {
        return p;
    }
    p.zncc = o.zncc as f32;
    let (_, offset) = points.centre(k);
    [p.u, p.v] = o.warp.at(offset[0], offset[1]);
    [p.sigma_u, p.sigma_v] = o.sigma;
    p.shape = o.warp.parameters();
    p
}
