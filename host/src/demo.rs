//! The whole instrument against the simulated rig: a commanded move comes back as a measured one.

use crate::error::Error;
use crate::measure::Spread;
use crate::optics_section;
use crate::process::{self, Check, FrameCounts, Summary};
use crate::progress::Progress;
use crate::recording::{self, Destination};
use crate::simulated::{self, SimCamera};
use daic_dataset::{Dataset, Existing, Table};
use daic_hil_sim::config::SimConfig;
use daic_hil_sim::rig::SimRig;
use daic_hil_sim::transport::Transport;
use daic_optics::Optics;
use daic_optics::microscope::RayMicroscope;
use daic_rig::acquire::AcquireOptions;
use daic_rig::experiment::{self, Experiment, MoveStep, Role, Step};
use daic_rig::link::Link;
use daic_rig::units::Length;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// How wrong the distances and F are that the demo starts from.
const START_ERROR: f64 = 0.01;
/// Limits of the demo's checks: measured minus commanded, RMS over the field (x, y, h).
const MOVE_LIMIT_UM: [f64; 3] = [1.0, 1.0, 2.0];
/// Measured height minus the specimen's formula, RMS over the field. Noise leaves half of this; a pitch
/// that is 0.1 % wrong gives 150.
const PROFILE_LIMIT_UM: f64 = 1.0;

/// Limits under the microscope: measured minus commanded displacement, RMS over the field (x, y, h).
const MICROSCOPE_MOVE_LIMIT_UM: [f64; 3] = [0.01, 0.01, 0.03];
/// Measured height minus the specimen's formula, both from their means, RMS over the field.
const MICROSCOPE_PROFILE_LIMIT_UM: f64 = 0.02;
/// β₁ and β₂ against those of the simulated geometry.
const BETA_LIMIT: f64 = 2e-3;

/// What is simulated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Scene {
    /// The macro set-up: one camera behind a grating.
    #[default]
    Macro,
    /// The microscope.
    Microscope,
}

/// What `daic demo` is asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// What is simulated.
    pub scene: Scene,
    /// Folder of the dataset.
    pub out: PathBuf,
    /// Seed of speckle and noise.
    pub seed: u64,
    /// Stage move (x, y, h) in millimetres.
    pub move_mm: [f64; 3],
    /// Pitch that the host believes over the true one.
    pub pitch_factor: f64,
    /// Whether to calibrate; without, the host believes the true distances and F.
    pub calibrate: bool,
}

/// `summary.json` of the demo: the measurement's own summary and what is only known in a simulation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DemoSummary {
    /// As of any dataset.
    #[serde(flatten)]
    pub measurement: Summary,
    /// Height of the reference minus the specimen's formula, RMS over the field.
    pub profile_rms_um: f64,
    /// What was checked.
    pub checks: Vec<Check>,
    /// Whether every check held.
    pub passed: bool,
    /// Wall time from the start of the rig to the end of the measurement.
    pub wall_s: Option<f64>,
}

/// The demo's experiment: the template with this seed and move, and optics that are wrong on purpose.
fn experiment(options: &Options) -> Result<(Experiment, Optics), Error> {
    let mut experiment = Experiment::parse(experiment::template(), Path::new("the built-in template"))?;
    let section = optics_section::of(&experiment)?;
    let truth = optics_section::from_section(section)?;
    let mut believed = truth;
    if options.calibrate {
        believed.camera.focal_px *= 1.0 + START_ERROR;
        believed.pinhole_to_grating_mm *= 1.0 - START_ERROR;
        believed.grating_to_reference_mm *= 1.0 + START_ERROR;
    }
    let mut section = optics_section::with_calibrated(section, &believed);
    if let Some(grating) = &mut section.grating {
        grating.pitch = Some(Length::new(truth.minus.pitch_mm * options.pitch_factor));
        grating.lines = None;
    }
    experiment.optics = Some(section);
    command(&mut experiment, options);
    experiment.processing.calibrate = options.calibrate;
    experiment.processing.axis_height = Length::new(simulated::demo_height_mm(0.0, 0.0));
    Ok((experiment, truth))
}

/// The demo's experiment under the microscope: the template with this seed and move.
fn microscope_experiment(options: &Options) -> Result<Experiment, Error> {
    let path = Path::new("the built-in template");
    let mut experiment = Experiment::parse(experiment::microscope_template(), path)?;
    command(&mut experiment, options);
    Ok(experiment)
}

/// Seed and move as the user wants them.
fn command(experiment: &mut Experiment, options: &Options) {
    experiment.seed = options.seed;
    let [x, y, z] = options.move_mm.map(|mm| Some(Length::new(mm)));
    replace_measured_move(&mut experiment.sequence, MoveStep { x, y, z });
}

/// The move before the frame to be measured is the one that the demo is about.
fn replace_measured_move(sequence: &mut [Step], wanted: MoveStep) {
    let measured = sequence.iter().position(|s| matches!(s, Step::Frame(f) if f.role == Role::Deformed));
    let before = measured.and_then(|end| sequence.get_mut(..end)).unwrap_or_default();
    if let Some(Step::Move(step)) = before.iter_mut().rev().find(|s| matches!(s, Step::Move(_))) {
        *step = wanted;
    }
}

/// Runs the demo; the dataset, `summary.json` and `report.html` are in `options.out` afterwards. An
/// earlier demo there is replaced.
///
/// # Errors
/// Whatever keeps the chain from running to its end; a check that fails is no error.
pub fn run(options: &Options, progress: &dyn Progress) -> Result<DemoSummary, Error> {
    let begin = Instant::now();
    let (experiment, config) = match options.scene {
        Scene::Macro => {
            let (experiment, truth) = experiment(options)?;
            let config = simulated::macro_scene(&experiment, &truth, simulated::demo_specimen());
            (experiment, config)
        }
        Scene::Microscope => {
            let experiment = microscope_experiment(options)?;
            let config = simulated::microscope(&experiment);
            (experiment, config)
        }
    };
    record(&experiment, config, &options.out, Existing::ReplaceKind(DEMO), progress)?;
    let mut processed = process::process(&options.out, false, None, progress)?;
    processed.wall_s = Some(begin.elapsed().as_secs_f64());
    complete(&options.out, &processed)?.ok_or(Error::NoResult { path: options.out.join("dataset.json") })
}

/// Kind of the demo's datasets: one demo may replace another, never a measurement.
const DEMO: &str = "demo";

fn is_demo(dataset: &Dataset) -> bool {
    dataset.manifest().kind.as_deref() == Some(DEMO)
}

/// Adds to the summary and report of a processed demo what only a demo knows; `None` for other datasets.
///
/// # Errors
/// If results cannot be read or summary and report cannot be written.
pub fn complete(root: &Path, processed: &process::Processed) -> Result<Option<DemoSummary>, Error> {
    let dataset = Dataset::open(root)?;
    if !is_demo(&dataset) {
        return Ok(None);
    }
    let path = root.join("experiment.toml");
    let experiment = Experiment::parse(&dataset.experiment_toml()?, &path)?;
    let microscope = experiment.microscope.is_some();
    let height_mm = if microscope { simulated::microscope_height_mm } else { simulated::demo_height_mm };
    let profile = profile_error_um(&dataset, height_mm)?;
    // under the microscope heights count from the mean of the surface
    let profile_rms_um = if microscope { profile.std } else { profile.rms };
    let mut checks = checks(&processed.summary, profile_rms_um, microscope);
    if microscope {
        checks.extend(beta_checks(&processed.summary, &experiment)?);
    }
    let summary = DemoSummary {
        passed: checks.iter().all(|c| c.passed),
        measurement: processed.summary.clone(),
        profile_rms_um,
        checks,
        wall_s: processed.wall_s,
    };
    dataset.write_summary(&summary)?;
    process::write_report(&dataset, &summary.measurement, Some(&summary.checks))?;
    Ok(Some(summary))
}

/// Runs an experiment on the simulated rig. `scene` replaces the rig that the experiment describes.
///
/// # Errors
/// An experiment or scene that cannot be played, or a folder that cannot be written.
pub fn simulate(
    experiment: &Experiment,
    scene: Option<&Path>,
    out: &Path,
    existing: Existing,
    progress: &dyn Progress,
) -> Result<FrameCounts, Error> {
    let mut config = simulated::configuration(experiment)?;
    if let Some(path) = scene {
        config = SimConfig { seed: experiment.seed, ..simulated::load_scene(path)? };
    }
    Ok(record(experiment, config, out, existing, progress)?.1)
}

/// Starts a rig on a PTY, records, and notes the edges that were really played.
pub(crate) fn record(
    experiment: &Experiment,
    config: SimConfig,
    out: &Path,
    existing: Existing,
    progress: &dyn Progress,
) -> Result<(Dataset, FrameCounts), Error> {
    progress.stage("starting the simulated rig", 0);
    let mut rig = SimRig::start(config.clone(), transport())?;
    let frames = rig.take_frames().ok_or(Error::FramesTaken)?;
    let mut camera = SimCamera::new(&config, frames);
    let mut link = open(&rig, experiment)?;
    let tick_hz = link.hello().tick_hz;
    let options = AcquireOptions {
        // rendering a frame takes its time on a small machine
        frame_timeout: std::time::Duration::from_secs(60),
        size_px: Some(recording::size_px(experiment)),
        ..AcquireOptions::new(tick_hz)
    };
    let destination = Destination { out, existing, seed: Some(experiment.seed) };
    let (dataset, counts) =
        recording::record(experiment, &mut link, &mut camera, &options, &destination, progress)?;
    drop(link);
    dataset.write_edges(&crate::expand::changes(&rig.played()))?;
    rig.stop();
    Ok((dataset, counts))
}

/// A real serial line where there are pseudo-terminals, else TCP on this machine.
fn transport() -> Transport {
    if cfg!(unix) {
        Transport::Pty { link: None }
    } else {
        Transport::Tcp { address: "127.0.0.1:0".to_owned() }
    }
}

fn open(rig: &SimRig, experiment: &Experiment) -> Result<Link, Error> {
    Ok(Link::open(rig.port(), recording::link_options(experiment)).map_err(daic_rig::RigError::from)?)
}

/// Measured height minus the specimen's formula at the measured place, over the field.
fn profile_error_um(dataset: &Dataset, height_mm: fn(f64, f64) -> f64) -> Result<Spread, Error> {
    let records = dataset.frames()?.records;
    let reference = records.iter().find(|f| f.role == daic_dataset::FrameRole::Reference);
    let Some(reference) = reference else { return Ok(crate::measure::spread(std::iter::empty::<f64>())) };
    let path = dataset.frame_results(reference.id).join("points.csv");
    let table = Table::read_csv(&path)?;
    let [x, y, h] = ["x_mm", "y_mm", "h_mm"].map(|name| table.numbers(name, &path));
    let (x, y, h) = (x?, y?, h?);
    let status = table.texts("status", &path)?;
    let errors =
        (0..status.len()).filter(|&k| status[k] == "ok").map(|k| 1e3 * (h[k] - height_mm(x[k], y[k])));
    Ok(crate::measure::spread(errors))
}

/// β₁ and β₂ of the calibration against the derivatives of the simulated geometry.
fn beta_checks(summary: &Summary, experiment: &Experiment) -> Result<Vec<Check>, Error> {
    let config = simulated::microscope(experiment);
    let Some(microscope) = &config.scene.microscope else { return Ok(Vec::new()) };
    let geometry = microscope.geometry(config.camera.width, config.camera.height);
    let truth = RayMicroscope::new(&geometry)?.parameters().map(|(parameters, _)| parameters);
    let Ok(truth) = truth else { return Ok(Vec::new()) };
    let found = |name: &str| {
        let of = summary.calibration.as_ref()?.parameters.iter().find(|p| p.name.starts_with(name))?;
        Some(1e-3 * of.value)
    };
    let both = [("beta1", truth.beta1_mm_per_px), ("beta2", truth.beta2_mm_per_px)];
    Ok(both
        .into_iter()
        .map(|(name, truth)| {
            let relative = found(name).map_or(f64::NAN, |value| value / truth - 1.0);
            Check {
                name: format!("{name} of the calibration, relative to the simulated geometry"),
                found: format!("{:+.3} %", 100.0 * relative),
                limit: format!("{} %", 100.0 * BETA_LIMIT),
                passed: relative.abs() <= BETA_LIMIT,
            }
        })
        .collect())
}

fn checks(summary: &Summary, profile_rms_um: f64, microscope: bool) -> Vec<Check> {
    let (move_limit_um, profile_limit_um) = if microscope {
        (MICROSCOPE_MOVE_LIMIT_UM, MICROSCOPE_PROFILE_LIMIT_UM)
    } else {
        (MOVE_LIMIT_UM, PROFILE_LIMIT_UM)
    };
    let frames = &summary.frames;
    let all_paired = frames.paired > 0 && frames.missing + frames.extra + frames.ambiguous == 0;
    let mut checks = vec![
        Check {
            name: "frames paired with their strobes".to_owned(),
            found: format!("{} of {}", frames.paired, frames.paired + frames.missing),
            limit: "all, none extra or ambiguous".to_owned(),
            passed: all_paired,
        },
        Check {
            name: "edges as the program says".to_owned(),
            found: summary
                .edge_error_ticks_max
                .map_or_else(|| "other words were played".to_owned(), |ticks| format!("{ticks} ticks off")),
            limit: "0 ticks".to_owned(),
            passed: summary.edge_error_ticks_max == Some(0),
        },
    ];
    let rms = summary.rms_um.unwrap_or([f64::NAN; 3]);
    for ((axis, value), limit) in ["x", "y", "h"].into_iter().zip(rms).zip(move_limit_um) {
        checks.push(Check {
            name: format!("move along {axis}, RMS of measured minus commanded"),
            found: format!("{value:.3} µm"),
            limit: format!("{limit} µm"),
            passed: value <= limit,
        });
    }
    checks.push(Check {
        name: "height, RMS of measured minus the specimen's formula".to_owned(),
        found: format!("{profile_rms_um:.3} µm"),
        limit: format!("{profile_limit_um} µm"),
        passed: profile_rms_um <= profile_limit_um,
    });
    checks
}
