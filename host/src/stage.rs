//! A stage axis calibrated against the image: steps per millimetre, direction, backlash.
//!
//! The axis visits positions counting up and counting down, several times, each leg begun from beyond its first
//! position. Displacements d against one of the frames follow
//!
//! > d = a + u s ± v
//!
//! with s the position by the experiment's own steps per millimetre and + on the way up. |u| is how far the stage
//! goes for a commanded millimetre, u/|u| its direction, and −2 v·u/|u| the backlash.

use crate::error::Error;
use crate::optics_file::CalibratedOptics;
use crate::process::{self, FrameSummary, Summary};
use crate::progress::Progress;
use daic_dataset::Existing;
use daic_rig::experiment::{Approach, Axis, CameraSource, Experiment, FrameStep, MoveStep, Role, Step};
use daic_rig::units::{Length, Time};
use nalgebra::{DMatrix, Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Parts of the travel that are added beyond its ends, where the legs turn.
const BEYOND: f64 = 0.25;
/// Time for the stage to come to rest.
const SETTLE: Time = Time::new(100e6);
/// File of the result, beside the dataset's own.
const RESULT: &str = "stage.json";

/// What is asked for.
#[derive(Debug, Clone)]
pub struct Options {
    /// 0, 1, 2 for x, y, z.
    pub axis: usize,
    /// Between the lowest and the highest position.
    pub travel: Length,
    /// Middle of the positions.
    pub centre: Length,
    /// Positions of a leg, at least 2.
    pub positions: u32,
    /// Legs up and as many down, at least 1.
    pub passes: u32,
    /// Optics that are known otherwise than from moves of this stage; without, the experiment's own.
    pub optics: Option<PathBuf>,
    /// Folder of the dataset.
    pub out: PathBuf,
    /// Whether an earlier dataset may be replaced.
    pub existing: Existing,
    /// Box, if not the experiment's.
    pub port: Option<String>,
    /// Frames of a real camera, if not the experiment's.
    pub frames: Option<PathBuf>,
    /// Scene of the simulated rig.
    pub scene: Option<PathBuf>,
}

/// What was found. Lengths in micrometres.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageSummary {
    /// Name of the axis.
    pub axis: String,
    /// Frames that count.
    pub frames: usize,
    /// What the experiment says.
    pub steps_per_mm_before: f64,
    /// What the image says.
    pub steps_per_mm: f64,
    /// Standard deviation of the last from the scatter of the frames.
    pub steps_per_mm_sigma: f64,
    /// The same from what is not known of the optics; none where that is not known.
    pub steps_per_mm_sigma_cal: Option<f64>,
    /// Direction of a positive move: x right, y down, h towards the camera, length 1.
    pub direction: [f64; 3],
    /// Angle between this and the nominal axis, degrees.
    pub angle_deg: f64,
    /// Play of the drive.
    pub backlash_um: f64,
    /// Its standard deviation.
    pub backlash_sigma_um: f64,
    /// Direction of approach that repeats better.
    pub approach: Approach,
    /// Standard deviation of arriving at one position, for counting up and counting down; none with one pass.
    pub repeatability_um: Option<[f64; 2]>,
    /// RMS of the residuals along the axis.
    pub rms_um: f64,
    /// Each frame: position by the experiment (µm), whether counting up, residual along the axis.
    pub residuals: Vec<Residual>,
}

/// One frame of the calibration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Residual {
    /// Commanded position against the reference.
    pub commanded_um: f64,
    /// Counting up.
    pub up: bool,
    /// Measured along the axis, against the reference.
    pub measured_um: f64,
    /// Measured minus fitted.
    pub residual_um: f64,
}

/// Moves, records, measures and fits.
///
/// # Errors
/// Travel that the axis does not have or that the backlash uses up, too few frames, and whatever keeps a run from its end.
pub fn calibrate(
    experiment: &Experiment,
    options: &Options,
    progress: &dyn Progress,
) -> Result<StageSummary, Error> {
    let optics = options.optics.as_deref().map(CalibratedOptics::load).transpose()?;
    let (name, axis) = described(experiment, options.axis)?;
    let experiment = moves(experiment, options, name, &axis)?;
    let port = options.port.as_ref().unwrap_or(&experiment.rig.port);
    if port == "sim" {
        simulate(&experiment, options, progress)?;
    } else {
        let frames = match (&options.frames, &experiment.rig.camera.source) {
            (Some(folder), _) | (None, CameraSource::Folder(folder)) => folder,
            (None, CameraSource::Sim) => return Err(Error::NoFrames),
        };
        let (out, existing) = (&options.out, options.existing);
        crate::recording::run_at_port(&experiment, port, frames, out, existing, progress)?;
    }
    let processed = process::process(&options.out, false, optics.as_ref(), progress)?;
    let summary = evaluate(&processed.summary, options.axis, name, axis.steps_per_mm)?;
    let beyond_um = 1e3 * BEYOND * options.travel.mm();
    if summary.backlash_um.abs() > beyond_um {
        return Err(Error::StageTravelTooShort { backlash_um: summary.backlash_um, beyond_um });
    }
    process::write_json(&result_path(&options.out), &summary)?;
    Ok(summary)
}

#[cfg(feature = "sim")]
fn simulate(experiment: &Experiment, options: &Options, progress: &dyn Progress) -> Result<(), Error> {
    crate::demo::simulate(experiment, options.scene.as_deref(), &options.out, options.existing, progress)?;
    Ok(())
}

#[cfg(not(feature = "sim"))]
fn simulate(_: &Experiment, _: &Options, _: &dyn Progress) -> Result<(), Error> {
    Err(Error::NoFrames)
}

fn described(experiment: &Experiment, axis: usize) -> Result<(&'static str, Axis), Error> {
    let (name, described) = experiment.rig.axes.named().get(axis).copied().unwrap_or(("?", None));
    let described = described.ok_or(Error::StageAxis { axis: name })?;
    Ok((name, *described))
}

/// The experiment with the calibration's own sequence, and without any correction of what is to be found.
fn moves(
    experiment: &Experiment,
    options: &Options,
    name: &'static str,
    axis: &Axis,
) -> Result<Experiment, Error> {
    let [travel, centre] = [options.travel.mm(), options.centre.mm()];
    let ends = [-1.0, 1.0].map(|side| centre + side * (0.5 + BEYOND) * travel);
    let [positions, passes] = [options.positions.max(2), options.passes.max(1)];
    if travel.is_nan() || travel <= 0.0 || ends[0] < axis.min.mm() || ends[1] > axis.max.mm() {
        let limits_mm = [axis.min.mm(), axis.max.mm()];
        return Err(Error::StageTravel { axis: name, needs_mm: ends, limits_mm });
    }
    let mut experiment = experiment.clone();
    experiment.processing.calibrate = false;
    let axes = &mut experiment.rig.axes;
    if let Some(axis) =
        [&mut axes.x, &mut axes.y, &mut axes.z].into_iter().nth(options.axis).and_then(Option::as_mut)
    {
        axis.backlash = Length::new(0.0);
    }
    let go = |mm: f64| {
        let mut targets = [None; 3];
        if let Some(target) = targets.get_mut(options.axis) {
            *target = Some(Length::new(mm));
        }
        let [x, y, z] = targets;
        Step::Move(MoveStep { x, y, z })
    };
    let mut sequence = Vec::new();
    for pass in 0..passes {
        for up in [true, false] {
            sequence.push(go(ends[usize::from(!up)]));
            for k in 0..positions {
                let part = f64::from(k) / f64::from(positions - 1) - 0.5;
                sequence.push(go(centre + if up { part } else { -part } * travel));
                sequence.push(Step::Settle(SETTLE));
                // displacements count from the middle of the first leg
                let role =
                    if pass == 0 && up && k == positions / 2 { Role::Reference } else { Role::Deformed };
                let leg = if up { "up" } else { "down" };
                sequence.push(Step::Frame(FrameStep {
                    name: format!("{leg}-{pass}-{k}"),
                    role,
                    strobe: None,
                }));
            }
        }
    }
    experiment.sequence = sequence;
    Ok(experiment)
}

/// Fits steps per millimetre, direction and backlash to measured displacements.
///
/// # Errors
/// Fewer than six frames.
fn evaluate(summary: &Summary, axis: usize, name: &str, steps_per_mm: f64) -> Result<StageSummary, Error> {
    // the reference itself counts as well: it has not moved against itself
    let mut rows = vec![(0.0, true, Vector3::zeros())];
    for frame in &summary.measured {
        let Some(commanded) = frame.commanded_um else { continue };
        let up = frame.name.starts_with("up");
        rows.push((commanded[axis], up, Vector3::from(frame.field.measured_um)));
    }
    let n = rows.len();
    let scatter_of = 3;
    if n < 2 * scatter_of || !rows.iter().any(|r| !r.1) {
        return Err(Error::StageFrames { frames: n, least: 2 * scatter_of });
    }
    let sign = |up: bool| if up { 1.0 } else { -1.0 };
    let design = DMatrix::from_fn(n, 3, |i, j| [1.0, rows[i].0, sign(rows[i].1)][j]);
    let observed = DMatrix::from_fn(n, 3, |i, j| rows[i].2[j]);
    let inverse = (design.transpose() * &design).try_inverse();
    let covariance = inverse.ok_or(Error::StageFrames { frames: n, least: 2 * scatter_of })?;
    let fitted: Matrix3<f64> =
        Matrix3::from_iterator((&covariance * design.transpose() * observed).iter().copied());
    let (travel, play) = (fitted.row(1).transpose(), fitted.row(2).transpose());
    let scale = travel.norm();
    let along = travel / scale;
    let residuals: Vec<Residual> = rows
        .iter()
        .map(|&(s, up, d)| {
            let model = fitted.row(0).transpose() + travel * s + play * sign(up);
            Residual { commanded_um: s, up, measured_um: d.dot(&along), residual_um: (d - model).dot(&along) }
        })
        .collect();
    let squares: f64 = residuals.iter().map(|r| r.residual_um.powi(2)).sum();
    let variance = squares / (n - scatter_of) as f64;
    let scale_sigma = (variance * covariance[(1, 1)]).sqrt();
    let found = steps_per_mm / scale;
    let repeatability_um = repeatability(&residuals);
    let approach = match repeatability_um {
        Some([up, down]) if down < up => Approach::Negative,
        _ => Approach::Positive,
    };
    let mut nominal = Vector3::zeros();
    nominal[axis] = 1.0;
    Ok(StageSummary {
        axis: name.to_owned(),
        frames: n,
        steps_per_mm_before: steps_per_mm,
        steps_per_mm: found,
        steps_per_mm_sigma: found * scale_sigma / scale,
        steps_per_mm_sigma_cal: optics_sigma(&summary.measured, &along).map(|relative| found * relative),
        direction: along.into(),
        angle_deg: along.angle(&nominal).to_degrees(),
        backlash_um: -2.0 * play.dot(&along),
        backlash_sigma_um: 2.0 * (variance * covariance[(2, 2)]).sqrt(),
        approach,
        repeatability_um,
        rms_um: (squares / n as f64).sqrt(),
        residuals,
    })
}

/// Standard deviation of the displacement along the axis that comes from the optics, over the displacement, at the
/// longest one.
fn optics_sigma(measured: &[FrameSummary], along: &Vector3<f64>) -> Option<f64> {
    let longest = measured.iter().max_by(|a, b| {
        let length = |f: &FrameSummary| Vector3::from(f.field.measured_um).norm();
        length(a).total_cmp(&length(b))
    })?;
    let sigma = Vector3::from(longest.field.sigma_cal_um?).dot(&along.abs());
    Some(sigma / Vector3::from(longest.field.measured_um).norm())
}

/// Standard deviation about the mean of each position, for both directions; none if no position was visited twice.
fn repeatability(residuals: &[Residual]) -> Option<[f64; 2]> {
    let of = |up: bool| {
        let mut groups: Vec<(f64, Vec<f64>)> = Vec::new();
        for r in residuals.iter().filter(|r| r.up == up) {
            // positions are whole steps: the same one is the same to rounding
            match groups.iter_mut().find(|g| (g.0 - r.commanded_um).abs() < 1e-6) {
                Some(group) => group.1.push(r.residual_um),
                None => groups.push((r.commanded_um, vec![r.residual_um])),
            }
        }
        let (mut squares, mut freedom) = (0.0, 0);
        for (_, values) in &groups {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            squares += values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
            freedom += values.len() - 1;
        }
        (freedom > 0).then(|| (squares / freedom as f64).sqrt())
    };
    Some([of(true)?, of(false)?])
}

/// Where the result of a calibration stands.
pub fn result_path(out: &Path) -> PathBuf {
    out.join("results").join(RESULT)
}
