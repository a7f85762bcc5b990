//! 2D-DIC of two images: what `daic correlate` does.

use crate::area::Area;
use crate::error::Error;
use crate::measure::image_of;
use crate::progress::Progress;
use crate::usage::{Clock, Seconds};
use daic_correlate::{
    EulerianPoint, Guess, Observer, Point, Points, Reference, Settings, Stage, StartReport, Target,
};
use daic_dataset::{Column, GreyImage, Table};
use std::sync::Mutex;

/// Points of a pair of images and what they cost.
#[derive(Debug)]
pub struct PairResult {
    /// One entry per point of interest, row by row.
    pub points: Vec<Point>,
    /// Where they were laid out.
    pub layout: Points,
    /// Where the first displacements came from.
    pub start: StartReport,
    /// Images to coefficients and gradients.
    pub prepare: Seconds,
    /// First displacements.
    pub init: Seconds,
    /// All points.
    pub solve: Seconds,
    /// Together.
    pub total: Seconds,
}

impl PairResult {
    /// Points with a result.
    pub fn converged(&self) -> usize {
        self.points.iter().filter(|p| p.status.is_ok()).count()
    }

    /// [`table`] of the points.
    ///
    /// # Errors
    /// Only if two columns had one name.
    pub fn table(&self) -> Result<Table, Error> {
        table(&self.points)
    }

    /// [`eulerian_table`] at the same positions of the deformed image.
    ///
    /// # Errors
    /// Only if two columns had one name.
    pub fn eulerian_table(&self) -> Result<Table, Error> {
        let field = daic_correlate::eulerian(&self.layout, &self.points, self.layout.positions());
        eulerian_table(&self.layout, &self.points, &field)
    }
}

/// `x,y,u,v,sigma_u,sigma_v,zncc,iterations,status,solver`, pixels, a row per point.
///
/// # Errors
/// Only if two columns had one name.
pub fn table(points: &[Point]) -> Result<Table, Error> {
    let status = points.iter().map(|p| p.status.name().to_owned()).collect();
    with_status(points, status)
}

/// The same columns for positions in the deformed image; ZNCC and iterations are those of the point
/// nearest to the material, the status is `ok` or `no_material`.
///
/// # Errors
/// Only if two columns had one name.
pub fn eulerian_table(
    layout: &Points,
    points: &[Point],
    field: &[Option<EulerianPoint>],
) -> Result<Table, Error> {
    let rows: Vec<Point> = layout
        .positions()
        .iter()
        .zip(field)
        .zip(points)
        .map(|((&[x, y], found), point)| match found {
            Some(e) => {
                Point { x, y, u: e.u, v: e.v, sigma_u: e.sigma_u, sigma_v: e.sigma_v, ..points[e.nearest] }
            }
            None => Point {
                x,
                y,
                u: f64::NAN,
                v: f64::NAN,
                sigma_u: f32::NAN,
                sigma_v: f32::NAN,
                zncc: f32::NAN,
                iterations: 0,
                ..*point
            },
        })
        .collect();
    let status = field.iter().map(|e| if e.is_some() { "ok" } else { "no_material" }.to_owned()).collect();
    with_status(&rows, status)
}

fn with_status(points: &[Point], status: Vec<String>) -> Result<Table, Error> {
    let column = |f: &dyn Fn(&Point) -> f64| Column::F64(points.iter().map(f).collect());
    let iterations = points.iter().map(|p| i64::from(p.iterations)).collect();
    Ok(Table::new()
        .with("x", column(&|p| p.x))?
        .with("y", column(&|p| p.y))?
        .with("u", column(&|p| p.u))?
        .with("v", column(&|p| p.v))?
        .with("sigma_u", column(&|p| f64::from(p.sigma_u)))?
        .with("sigma_v", column(&|p| f64::from(p.sigma_v)))?
        .with("zncc", column(&|p| f64::from(p.zncc)))?
        .with("iterations", Column::I64(iterations))?
        .with("status", Column::Text(status))?
        .with("solver", Column::Text(points.iter().map(|p| p.solver.name().to_owned()).collect()))?)
}

/// Watches the stages to time them, and hands the progress on.
struct Watch<'a> {
    progress: &'a dyn Progress,
    clock: Clock,
    begin_of_solve: Mutex<Seconds>,
}

impl Observer for Watch<'_> {
    fn stage(&self, stage: Stage) {
        match stage {
            Stage::Init => self.progress.stage("finding first displacements", 0),
            Stage::Solve => {
                if let Ok(mut begin) = self.begin_of_solve.lock() {
                    *begin = self.clock.elapsed();
                }
            }
        }
    }

    fn points(&self, done: usize, total: usize) {
        if done == 0 {
            self.progress.stage("correlating", total as u64);
        }
        self.progress.advance(done as u64);
    }
}

/// Correlates `deformed` with `reference` on a grid of `step` pixels over `area`, beginning with
/// `guess`.
///
/// # Errors
/// A setting, a guess or an area that cannot be used.
pub fn correlate(
    reference: &GreyImage,
    deformed: &GreyImage,
    settings: &Settings,
    guess: &Guess<'_>,
    step: usize,
    area: &Area,
    progress: &dyn Progress,
) -> Result<PairResult, Error> {
    let clock = Clock::start();
    let (a, b) = (image_of(reference)?, image_of(deformed)?);
    settings.validate_for(a.width(), a.height())?;
    let points = area.grid(a.width(), a.height(), settings.subset, step)?;
    progress.stage("preparing the images", 0);
    let (subsets, target) = rayon::join(|| Reference::new(a), || Target::new(b, settings.interpolation));
    let prepare = clock.elapsed();
    let watch = Watch { progress, clock, begin_of_solve: Mutex::default() };
    let found = daic_correlate::correlate(&subsets, &target, &points, guess, settings, &watch)?;
    let total = clock.elapsed();
    let begin = watch.begin_of_solve.into_inner().unwrap_or_default();
    let between = |from: Seconds, to: Seconds| Seconds { cpu: to.cpu - from.cpu, wall: to.wall - from.wall };
    Ok(PairResult {
        points: found.points,
        layout: points,
        start: found.start,
        prepare,
        init: between(prepare, begin),
        solve: between(begin, total),
        total,
    })
}
