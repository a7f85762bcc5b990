//! The whole instrument against the simulated rig: a commanded move comes back as a measured one.

use crate::error::Error;
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

/// What `daic demo` is asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
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
    let truth = optics_section::from_section(&experiment.optics)?;
    experiment.seed = options.seed;
    let [x, y, z] = options.move_mm.map(|mm| Some(Length::new(mm)));
    replace_measured_move(&mut experiment.sequence, MoveStep { x, y, z });

    let mut believed = truth;
    if options.calibrate {
        believed.camera.focal_px *= 1.0 + START_ERROR;
        believed.pinhole_to_grating_mm *= 1.0 - START_ERROR;
        believed.grating_to_reference_mm *= 1.0 + START_ERROR;
    }
    experiment.optics = optics_section::with_calibrated(&experiment.optics, &believed);
    if let Some(grating) = &mut experiment.optics.grating {
        grating.pitch = Some(Length::new(truth.minus.pitch_mm * options.pitch_factor));
        grating.lines = None;
    }
    experiment.processing.calibrate = options.calibrate;
    experiment.processing.axis_height = Length::new(simulated::demo_height_mm(0.0, 0.0));
    Ok((experiment, truth))
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
    let (experiment, truth) = experiment(options)?;
    let config = simulated::configuration(&experiment, &truth, simulated::demo_specimen());
    record(&experiment, config, &options.out, Existing::ReplaceKind(DEMO), progress)?;
    let mut processed = process::process(&options.out, false, progress)?;
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
    let profile_rms_um = profile_error_um(&dataset)?;
    let checks = checks(&processed.summary, profile_rms_um);
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
    let truth = optics_section::from_section(&experiment.optics)?;
    let mut config = simulated::configuration(experiment, &truth, simulated::demo_specimen());
    if let Some(path) = scene {
        config = SimConfig { seed: experiment.seed, ..simulated::load_scene(path)? };
    }
    Ok(record(experiment, config, out, existing, progress)?.1)
}

/// Starts a rig on a PTY, records, and notes the edges that were really played.
fn record(
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

/// RMS over the field of measured height minus the specimen's formula at the measured place.
fn profile_error_um(dataset: &Dataset) -> Result<f64, Error> {
    let records = dataset.frames()?.records;
    let reference = records.iter().find(|f| f.role == daic_dataset::FrameRole::Reference);
    let Some(reference) = reference else { return Ok(f64::NAN) };
    let path = dataset.frame_results(reference.id).join("points.csv");
    let table = Table::read_csv(&path)?;
    let [x, y, h] = ["x_mm", "y_mm", "h_mm"].map(|name| table.numbers(name, &path));
    let (x, y, h) = (x?, y?, h?);
    let status = table.texts("status", &path)?;
    let errors = (0..status.len())
        .filter(|&k| status[k] == "ok")
        .map(|k| 1e3 * (h[k] - simulated::demo_height_mm(x[k], y[k])));
    Ok(crate::measure::spread(errors).rms)
}

fn checks(summary: &Summary, profile_rms_um: f64) -> Vec<Check> {
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
    for ((axis, value), limit) in ["x", "y", "h"].into_iter().zip(rms).zip(MOVE_LIMIT_UM) {
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
        limit: format!("{PROFILE_LIMIT_UM} µm"),
        passed: profile_rms_um <= PROFILE_LIMIT_UM,
    });
    checks
}
