//! From a recorded dataset to results: calibration, profile, displacements, summary, report.
//!
//! Everything comes from the recorded frames and events alone. Each frame's results are complete or
//! absent, and belong to a key over settings and input: a second run does what the first left.

mod calibration;
mod microscope;
mod report;
mod summary;

pub(crate) use report::check_table;
pub use summary::{
    CalibratedParameter, CalibrationSummary, Check, FailedFrame, FieldSummary, FrameCounts, FrameSummary,
    ProfileSummary, Summary,
};

use crate::error::Error;
use crate::expand;
use crate::exposure::{ExposureSummary, Exposures, Stated};
use crate::measure::{self, Displacement, Instrument, ObjectOptions, Profile, Reference, spread};
use crate::optics_file::CalibratedOptics;
use crate::optics_section;
use crate::progress::Progress;
use calibration::Calibrated;
use daic_dataset::{Damage, Dataset, FrameRecord, FrameRole, Verdict, atomic, result_key};
use daic_optics::{OpticalModel, Optics};
use daic_protocol::program::Instruction;
use daic_rig::experiment::{Covariance, Experiment, OpticsFile};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Name of the manifest's field that holds the program played, as hexadecimal text.
pub const PROGRAM: &str = "program";
/// Name of the manifest's field that holds the axes' steps at the begin of the run.
pub const START_STEPS: &str = "start_steps";
/// Folder of the figures, in the folder of the results.
const FIGURES: &str = "figures";

/// What `results/<reference>/result.json` holds.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct ReferenceResult {
    profile: ProfileSummary,
    /// x, y, width, height of the −1 view.
    minus: [usize; 4],
    /// The same of the +1 view.
    plus: [usize; 4],
}

/// What was done, and what a careful user wants to know about the dataset.
#[derive(Debug)]
pub struct Processed {
    /// The numbers, as in `summary.json`.
    pub summary: Summary,
    /// Wall time of a demo that the dataset's old summary knew.
    pub wall_s: Option<f64>,
    /// Frames whose results were there already.
    pub resumed: usize,
}

/// Measures every paired frame of the dataset in `root`.
///
/// `fresh` measures anew what has been measured already. With `optics` points are decoded with these, with their covariance,
/// maps and volume, and nothing is calibrated.
///
/// # Errors
/// A dataset without paired frames, or anything that [`crate::Error`] names.
pub fn process(
    root: &Path,
    fresh: bool,
    optics: Option<&CalibratedOptics>,
    progress: &dyn Progress,
) -> Result<Processed, Error> {
    let dataset = Dataset::open(root)?;
    let experiment_path = root.join("experiment.toml");
    let experiment = Experiment::parse(&dataset.experiment_toml()?, &experiment_path)?;
    let wall_s =
        dataset.summary::<serde_json::Value>().ok().flatten().and_then(|s| s.get("wall_s")?.as_f64());
    let (records, damage) = judged(&dataset, &experiment)?;
    let paired: Vec<&FrameRecord> = records.iter().filter(|f| f.verdict == Verdict::Paired).collect();
    let reference_record = reference_of(&records)
        .ok_or_else(|| Error::NoPairedFrame { root: root.to_owned(), frames: records.len() })?;

    let settings = crate::settings::measure_settings(&experiment);
    let mut run = Run {
        dataset: &dataset,
        experiment: &experiment,
        settings,
        reference: None,
        reference_record,
        fresh,
        progress,
        resumed: 0,
        failed: Vec::new(),
    };
    let (source, calibration) = match (&experiment.microscope, optics) {
        (Some(_), Some(optics)) => {
            return Err(Error::NotForMicroscope { optics: optics.path().to_owned(), root: root.to_owned() });
        }
        (None, Some(optics)) => {
            let decoder = crate::settings::decoder(experiment.processing.decoder);
            let source =
                Source::Stated { key: optics.key()?, instrument: Box::new(optics.instrument(decoder)?) };
            (source, None)
        }
        (Some(_), None) => {
            let (model, calibration) = run.calibrated_microscope(&paired)?;
            (Source::Microscope(model), Some(calibration))
        }
        (None, None) => {
            let section = optics_section::of(&experiment)?;
            let calibrated = run.calibrated(&paired, &optics_section::from_section(section)?)?;
            write_optics(&dataset.results(), section, &calibrated)?;
            let summary = calibrated.summary.clone();
            (Source::Macro(calibrated), summary)
        }
    };
    let reference = run.profile(&source)?;
    let mut measured = Vec::new();
    for record in paired.iter().filter(|r| r.role == FrameRole::Measurement) {
        match run.displacement(record, &source) {
            Ok(result) => measured.push(result),
            // one bad frame does not stop a series
            Err(error @ (Error::Dataset(_) | Error::NothingMeasured { .. } | Error::Correlate(_))) => {
                run.failed.push(failed(record, &error));
            }
            Err(error) => return Err(error),
        }
    }
    let failed = std::mem::take(&mut run.failed);
    let resumed = run.resumed;

    let (edge_error, edges_compared) = edge_error(&dataset)?;
    let last = measured.last();
    let summary = Summary {
        daic: env!("CARGO_PKG_VERSION").to_owned(),
        seed: dataset.manifest().seed,
        frames: count(&records),
        commanded_um: last.and_then(|f| f.commanded_um),
        measured_um: last.map(|f| f.field.measured_um),
        rms_um: last.and_then(|f| f.rms_um),
        sigma_um: last.map(|f| f.field.sigma_um),
        edge_error_ticks_max: edge_error,
        edges_compared,
        exposure: exposure(&dataset, &experiment)?,
        calibration,
        profile: reference.profile,
        measured,
        failed,
        damage: damage.iter().map(Damage::to_string).collect(),
    };
    dataset.write_summary(&summary)?;
    progress.stage("writing the report", 0);
    write_report(&dataset, &summary, None)?;
    Ok(Processed { summary, wall_s, resumed })
}

/// The frames with their verdicts. Where the recording was interrupted before it judged them, or its last lines are
/// torn, they are judged now, from the events and the frames' own times.
fn judged(dataset: &Dataset, experiment: &Experiment) -> Result<(Vec<FrameRecord>, Vec<Damage>), Error> {
    let contents = dataset.frames()?;
    let events = dataset.events()?;
    let (mut records, mut damage) = (contents.records, contents.damage);
    damage.extend(events.damage);
    if records.iter().any(|r| r.verdict == Verdict::Pending) {
        let manifest = dataset.manifest();
        let mask = daic_protocol::channels::camera(experiment.rig.camera.line).unwrap_or(0);
        let tick_hz = manifest.tick_hz.map_or(daic_protocol::limits::TICK_HZ, |hz| hz as u32);
        let stated = Stated::of(experiment, tick_hz);
        crate::verdicts::from_events(&mut records, &events.records, &manifest.plan, mask, &stated)?;
    }
    Ok((records, damage))
}

/// What the box saw of the exposures.
fn exposure(dataset: &Dataset, experiment: &Experiment) -> Result<Option<ExposureSummary>, Error> {
    let tick_hz = dataset.manifest().tick_hz.map_or(daic_protocol::limits::TICK_HZ, |hz| hz as u32);
    let stated = Stated::of(experiment, tick_hz);
    Ok(Exposures::of(&dataset.events()?.records, stated.line).summary(&stated))
}

fn failed(record: &FrameRecord, error: &Error) -> FailedFrame {
    FailedFrame { id: record.id, name: record.name.clone(), reason: format!("{}: {error}", record.name) }
}

/// Writes `report.html` of a dataset that has been measured, and its figures to `results/figures`;
/// `checks` go to its top.
///
/// # Errors
/// If results are missing or a figure cannot be drawn.
pub fn write_report(dataset: &Dataset, summary: &Summary, checks: Option<&[Check]>) -> Result<(), Error> {
    let experiment = Experiment::parse(&dataset.experiment_toml()?, &dataset.root().join("experiment.toml"))?;
    let report = report::report(dataset, &experiment, summary, checks)?;
    let figures = dataset.results().join(FIGURES);
    for figure in report.sections.iter().flat_map(|s| &s.figures) {
        // a figure that is more than a drawing lives on the page alone
        if figure.body.as_str().starts_with("<svg") {
            let path = figures.join(format!("{}.svg", figure.id));
            atomic::write_bytes(&path, figure.body.as_str().as_bytes())?;
        }
    }
    Ok(atomic::write_bytes(&dataset.report_path(), report.render()?.as_bytes())?)
}

/// The frame that displacements count from: the reference, or else the first that is paired.
fn reference_of(records: &[FrameRecord]) -> Option<&FrameRecord> {
    let paired = || records.iter().filter(|f| f.verdict == Verdict::Paired);
    paired().find(|f| f.role == FrameRole::Reference).or_else(|| paired().next())
}

fn count(records: &[FrameRecord]) -> FrameCounts {
    let of = |verdict| records.iter().filter(|f| f.verdict == verdict).count();
    FrameCounts {
        paired: of(Verdict::Paired),
        missing: of(Verdict::Missing),
        extra: of(Verdict::Extra),
        ambiguous: of(Verdict::Ambiguous),
    }
}

/// What makes points of pixel pairs.
enum Source {
    /// Optics of the experiment, perhaps calibrated by the dataset's moves.
    Macro(Calibrated),
    /// An optics file.
    Stated {
        /// All of it that results depend on.
        key: String,
        /// Ready to decode.
        instrument: Box<Instrument>,
    },
    /// A microscope, calibrated by the dataset's moves.
    Microscope(crate::microscope::CalibratedModel),
}

impl Source {
    /// All that its results depend on.
    fn settings(&self) -> Result<serde_json::Value, Error> {
        let value = match self {
            Self::Macro(calibrated) => serde_json::to_value((&calibrated.optics, &calibrated.covariance)),
            Self::Stated { key, .. } => serde_json::to_value(key),
            Self::Microscope(model) => serde_json::to_value(model),
        };
        value.map_err(|source| Error::Unwritable { path: "key".into(), reason: source.to_string() })
    }
}

struct Run<'a> {
    dataset: &'a Dataset,
    experiment: &'a Experiment,
    settings: measure::Settings,
    /// Found and matched at first need: a resumed run may need it for nothing.
    reference: Option<Reference>,
    reference_record: &'a FrameRecord,
    fresh: bool,
    progress: &'a dyn Progress,
    resumed: usize,
    failed: Vec<FailedFrame>,
}

/// What `results/calibration.json` holds.
#[derive(Serialize, Deserialize)]
struct StoredCalibration {
    key: String,
    summary: CalibrationSummary,
    optics: Optics,
    covariance: Option<Covariance>,
}

/// A frame, the specimen's move from the reference in millimetres, and the reference's points in it.
type Followed<'f> = (&'f FrameRecord, [f64; 3], measure::Tracks);

impl Run<'_> {
    /// Matches the reference once. The search range comes from the experiment's own optics, so that
    /// the match does not depend on the calibration that follows.
    fn reference(&mut self) -> Result<&Reference, Error> {
        if self.reference.is_none() {
            let frame = self.dataset.read_frame(self.reference_record)?;
            let found = if let Some(microscope) = &self.experiment.microscope {
                Reference::by_outlines(&frame, microscope.search.px(), &self.settings, self.progress)?
            } else {
                let optics = optics_section::from_section(optics_section::of(self.experiment)?)?;
                Reference::new(&frame, &OpticalModel::new(&optics)?, &self.settings, self.progress)?
            };
            self.reference = Some(found);
        }
        self.reference.as_ref().ok_or(Error::Gratings)
    }

    fn key(&self, optics: &impl Serialize, records: &[&FrameRecord]) -> Result<String, Error> {
        let files: Vec<_> = records
            .iter()
            .filter_map(|r| Some(self.dataset.root().join(r.file.as_ref()?)))
            // a file that is gone has its own error where it is read
            .filter(|file| file.exists())
            .collect();
        let commanded: Vec<_> = records.iter().map(|r| r.commanded_um).collect();
        let bayer = self.experiment.rig.camera.bayer;
        let settings = (&self.experiment.processing, optics, commanded, bayer);
        Ok(result_key(env!("CARGO_PKG_VERSION"), &settings, &files)?)
    }

    /// Position of a frame relative to the reference, micrometres.
    fn moved_um(&self, record: &FrameRecord) -> Option<[f64; 3]> {
        let (to, from) = (record.commanded_um?, self.reference_record.commanded_um?);
        Some([0, 1, 2].map(|i| to[i] - from[i]))
    }

    /// The calibration frames whose position relative to the reference is known, with it in micrometres.
    fn calibration_frames<'f>(&self, paired: &[&'f FrameRecord]) -> Vec<(&'f FrameRecord, [f64; 3])> {
        let of_role = paired.iter().filter(|f| f.role == FrameRole::Calibration);
        of_role.filter_map(|f| Some((*f, self.moved_um(f)?))).collect()
    }

    /// The reference's points in each of the frames that can be read, with its move in millimetres; the others may
    /// still determine everything, and if not, the calibration says so.
    fn followed<'f>(&mut self, frames: &[(&'f FrameRecord, [f64; 3])]) -> Result<Vec<Followed<'f>>, Error> {
        let mut moved = Vec::new();
        for (record, move_um) in frames {
            let image = match self.dataset.read_frame(record) {
                Ok(image) => image,
                Err(error) => {
                    self.failed.push(failed(record, &error.into()));
                    continue;
                }
            };
            let progress = self.progress;
            let tracks = self.reference()?.track(&image, progress)?;
            moved.push((*record, move_um.map(|um| um * 1e-3), tracks));
        }
        Ok(moved)
    }

    fn calibrated(&mut self, paired: &[&FrameRecord], start: &Optics) -> Result<Calibrated, Error> {
        let as_stated = Calibrated { optics: *start, covariance: None, summary: None };
        let frames = self.calibration_frames(paired);
        if frames.is_empty() || !self.experiment.processing.calibrate {
            return Ok(as_stated);
        }
        let mut inputs = vec![self.reference_record];
        inputs.extend(frames.iter().map(|f| f.0));
        let key = self.key(start, &inputs)?;
        let path = self.dataset.results().join("calibration.json");
        if !self.fresh
            && let Some(stored) = read_json::<StoredCalibration>(&path)
            && stored.key == key
        {
            self.resumed += 1;
            let StoredCalibration { optics, covariance, summary, .. } = stored;
            return Ok(Calibrated { optics, covariance, summary: Some(summary) });
        }
        let moved = self.followed(&frames)?;
        let moved: Vec<calibration::Moved> = moved
            .into_iter()
            .map(|(_, displacement_mm, tracks)| calibration::Moved { displacement_mm, tracks })
            .collect();
        self.progress.stage("calibrating", 0);
        let axis_height_mm = self.experiment.processing.axis_height.mm();
        let shared = self.settings.points_per_measurement();
        let matches = &self.reference()?.matches;
        let found = calibration::run(start, matches, &moved, axis_height_mm, shared)?;
        if let Some(summary) = found.summary.clone() {
            let covariance = found.covariance.clone();
            write_json(&path, &StoredCalibration { key, summary, optics: found.optics, covariance })?;
        }
        Ok(found)
    }

    fn instrument(&self, calibrated: &Calibrated) -> Result<Instrument, Error> {
        let model = OpticalModel::new(&calibrated.optics)?;
        let decoder = crate::settings::decoder(self.experiment.processing.decoder);
        let mut instrument = Instrument::new(model, decoder);
        let path = self.dataset.results().join("optics.toml");
        if let Some(covariance) = &calibrated.covariance {
            instrument.calibration = Some(optics_section::covariance_of(covariance, &path)?);
        }
        Ok(instrument)
    }

    fn object(&self) -> ObjectOptions {
        ObjectOptions { step_mm: None, overlap: self.settings.overlap() }
    }

    fn profile(&mut self, source: &Source) -> Result<ReferenceResult, Error> {
        let record = self.reference_record;
        let key = self.key(&source.settings()?, &[record])?;
        let directory = self.dataset.frame_results(record.id);
        if !self.fresh
            && self.dataset.is_done(record.id, &key)
            && let Some(done) = read_json(&directory.join("result.json"))
        {
            self.resumed += 1;
            return Ok(done);
        }
        let (object, shared) = (self.object(), self.settings.points_per_measurement());
        let profile = match source {
            Source::Macro(calibrated) => {
                let instrument = self.instrument(calibrated)?;
                let reference = self.reference()?;
                measure::profile(&reference.grid, &reference.matches, &instrument)
            }
            Source::Stated { instrument, .. } => {
                let reference = self.reference()?;
                measure::profile(&reference.grid, &reference.matches, instrument)
            }
            Source::Microscope(model) => {
                let reference = self.reference()?;
                crate::microscope::profile(&reference.grid, &reference.matches, &model.instrument()?)
            }
        }
        .with_points()?;
        let reference = self.reference()?;
        let corners = |r: measure::Rectangle| [r.x, r.y, r.width, r.height];
        let result = ReferenceResult {
            profile: profile_summary(&profile, shared),
            minus: corners(reference.minus),
            plus: corners(reference.plus),
        };
        let directory = self.dataset.begin_results(record.id)?;
        measure::write_profile(&directory, &profile, &object)?;
        write_json(&directory.join("result.json"), &result)?;
        self.dataset.mark_done(record.id, &key)?;
        Ok(result)
    }

    fn displacement(&mut self, record: &FrameRecord, source: &Source) -> Result<FrameSummary, Error> {
        let key = self.key(&source.settings()?, &[self.reference_record, record])?;
        let directory = self.dataset.frame_results(record.id);
        if !self.fresh
            && self.dataset.is_done(record.id, &key)
            && let Some(done) = read_json(&directory.join("result.json"))
        {
            self.resumed += 1;
            return Ok(done);
        }
        let image = self.dataset.read_frame(record)?;
        let object = self.object();
        let commanded_um = self.moved_um(record);
        let (progress, settings) = (self.progress, self.settings.clone());
        let reference = self.reference()?;
        let tracks = reference.track(&image, progress)?;
        let displacement = match source {
            Source::Macro(calibrated) => {
                let instrument = self.instrument(calibrated)?;
                let Reference { grid, matches, .. } = self.reference()?;
                measure::displacement(grid, matches, &tracks, &instrument, settings.height_mm)
            }
            Source::Stated { instrument, .. } => {
                let Reference { grid, matches, .. } = self.reference()?;
                measure::displacement(grid, matches, &tracks, instrument, settings.height_mm)
            }
            Source::Microscope(model) => {
                let Reference { grid, matches, .. } = self.reference()?;
                crate::microscope::displacement(grid, matches, &tracks, &model.instrument()?)
            }
        }
        .with_points()?;
        let shared = settings.points_per_measurement();
        let result = frame_summary(record, commanded_um, &displacement, shared);
        let directory = self.dataset.begin_results(record.id)?;
        measure::write_displacement(&directory, &displacement, None, &object)?;
        write_json(&directory.join("result.json"), &result)?;
        self.dataset.mark_done(record.id, &key)?;
        Ok(result)
    }
}

/// A profile in numbers; `shared` points have one independent measurement between them
/// ([`measure::Settings::points_per_measurement`]).
pub fn profile_summary(profile: &Profile, shared: f64) -> ProfileSummary {
    let ok = || profile.points.iter().filter(|p| p.status.is_ok());
    ProfileSummary {
        points: profile.points.len(),
        ok: ok().count(),
        mean_h_mm: spread(ok().map(|p| p.point_mm[2])).mean,
        sigma_h_um: 1e3 * spread(ok().map(|p| p.sigma_mm()[2])).rms,
        sigma_h_cal_um: profile.states_common.then(|| 1e3 * spread(ok().map(|p| p.common_sigma_mm()[2])).rms),
        gap: profile.gap_summary(shared),
    }
}

/// A displacement field in numbers; `shared` as in [`profile_summary`].
pub fn field_summary(displacement: &Displacement, shared: f64) -> FieldSummary {
    let ok = || displacement.points.iter().filter(|p| p.status.is_ok());
    let axis = |i: usize| spread(ok().map(|p| 1e3 * p.displacement_mm[i]));
    FieldSummary {
        measured_um: [0, 1, 2].map(|i| axis(i).mean),
        std_um: [0, 1, 2].map(|i| axis(i).std),
        sigma_um: [0, 1, 2].map(|i| 1e3 * spread(ok().map(|p| p.sigma_mm()[i])).rms),
        sigma_cal_um: displacement
            .states_common
            .then(|| [0, 1, 2].map(|i| 1e3 * spread(ok().map(|p| p.common_sigma_mm()[i])).rms)),
        gap: displacement.gap_summary(shared),
        points: displacement.points.len(),
        ok: ok().count(),
    }
}

fn frame_summary(
    record: &FrameRecord,
    commanded_um: Option<[f64; 3]>,
    displacement: &Displacement,
    shared: f64,
) -> FrameSummary {
    let ok = || displacement.points.iter().filter(|p| p.status.is_ok());
    let against =
        |c: [f64; 3]| [0, 1, 2].map(|i| spread(ok().map(|p| 1e3 * p.displacement_mm[i] - c[i])).rms);
    FrameSummary {
        id: record.id,
        name: record.name.clone(),
        commanded_um,
        rms_um: commanded_um.map(against),
        field: field_summary(displacement, shared),
    }
}

/// Largest difference between played and expected edges, and how many were compared.
pub(crate) fn edge_error(dataset: &Dataset) -> Result<(Option<u64>, usize), Error> {
    let Some(played) = dataset.edges()? else { return Ok((None, 0)) };
    let Some((program, position)) = stored_program(dataset) else { return Ok((None, 0)) };
    let expected = expand::expand(&program, position)?;
    // ticks of the record count from the boot of the box, those of the expansion from the begin of the run
    let begin = run_begin(dataset)?.unwrap_or(0);
    let played: Vec<(u64, u32)> =
        played.into_iter().filter(|e| e.0 >= begin).map(|(tick, word)| (tick - begin, word)).collect();
    Ok((expand::largest_error(&expected, &played), expected.len()))
}

fn stored_program(dataset: &Dataset) -> Option<(Vec<Instruction>, [i32; 6])> {
    let extra = &dataset.manifest().extra;
    let text = extra.get(PROGRAM)?.as_str()?;
    let bytes: Option<Vec<u8>> =
        (0..text.len()).step_by(2).map(|i| u8::from_str_radix(text.get(i..i + 2)?, 16).ok()).collect();
    let position = serde_json::from_value(extra.get(START_STEPS)?.clone()).ok()?;
    let instructions: Result<Vec<Instruction>, _> =
        daic_protocol::program::decode(&bytes?).map(|(_, instruction)| instruction).collect();
    Some((instructions.ok()?, position))
}

/// Tick of the begin of the (last) run, from the events.
fn run_begin(dataset: &Dataset) -> Result<Option<u64>, Error> {
    let events = dataset.events()?.records;
    Ok(events.iter().rev().find(|e| e.kind == "RunStarted").map(|e| e.tick))
}

fn write_optics(
    directory: &Path,
    section: &daic_rig::experiment::Optics,
    calibrated: &Calibrated,
) -> Result<(), Error> {
    let provenance = calibrated.summary.as_ref().map_or_else(
        || "as in the experiment file, not calibrated".to_owned(),
        |c| format!("focal, distances calibrated from {} points, residual {:.4} px RMS", c.points, c.rms_px),
    );
    let file = OpticsFile {
        format: Some(OpticsFile::FORMAT.to_owned()),
        provenance: Some(provenance),
        date: Some(crate::camera_file::now()),
        covariance: calibrated.covariance.clone(),
        maps: None,
        volume: None,
        optics: optics_section::with_calibrated(section, &calibrated.optics),
    };
    let path = directory.join("optics.toml");
    let text = file
        .to_toml()
        .map_err(|source| Error::Unwritable { path: path.clone(), reason: source.to_string() })?;
    std::fs::create_dir_all(directory)
        .map_err(|source| Error::Folder { path: directory.to_owned(), source })?;
    Ok(atomic::write_bytes(&path, text.as_bytes())?)
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Option<T> {
    serde_json::from_slice(&std::fs::read(path).ok()?).ok()
}

pub(crate) fn write_json(path: &Path, value: &impl Serialize) -> Result<(), Error> {
    if let Some(directory) = path.parent() {
        std::fs::create_dir_all(directory)
            .map_err(|source| Error::Folder { path: directory.to_owned(), source })?;
    }
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|source| Error::Unwritable { path: path.to_owned(), reason: source.to_string() })?;
    text.push('\n');
    Ok(atomic::write_bytes(path, text.as_bytes())?)
}
