//! A run of the rig into a dataset, written as it comes in.

use crate::error::Error;
use crate::exposure::{Exposures, Stated};
use crate::folder_camera::FolderCamera;
use crate::process::{FrameCounts, PROGRAM, START_STEPS};
use crate::progress::Progress;
use crate::verdicts;
use daic_dataset::{Dataset, EventRecord, Existing, FrameRecord, FrameRole, GreyImage, Manifest, Recording};
use daic_protocol::message::{Event, EventKind};
use daic_rig::acquire::{self, AcquireOptions, FrameSink, Run, SinkError};
use daic_rig::camera::{Camera, CameraSettings, Frame};
use daic_rig::compile::{Compiled, compile};
use daic_rig::experiment::Experiment;
use daic_rig::link::{Link, LinkOptions};
use serde_json::{Value, json};
use std::path::Path;

/// Writes frames and events into a dataset while they arrive.
struct Writer {
    recording: Recording,
    next: u64,
}

impl FrameSink for Writer {
    fn frame(&mut self, frame: &Frame) -> Result<(), SinkError> {
        let mut record = FrameRecord::new(self.next, &format!("frame {}", self.next), FrameRole::Unplanned);
        self.next += 1;
        record.camera_frame = Some(frame.id);
        record.camera_ns = frame.camera_ns.and_then(|ns| i64::try_from(ns).ok());
        let image = GreyImage {
            width: frame.width,
            height: frame.height,
            container_bits: if frame.bits > 8 { 16 } else { 8 },
            significant_bits: frame.bits,
            data: frame.data.clone(),
        };
        self.recording.append_frame(record, Some(&image))?;
        Ok(())
    }

    fn events(&mut self, events: &[Event]) -> Result<(), SinkError> {
        let records: Vec<EventRecord> = events.iter().map(event_record).collect();
        Ok(self.recording.append_events(&records)?)
    }
}

/// An event as it stands in datasets and JSON answers.
pub fn event_record(event: &Event) -> EventRecord {
    let (kind, data) = match event.kind {
        EventKind::RunStarted { run, program } => ("RunStarted", json!({ "run": run, "program": program })),
        EventKind::Edge { changed, word } => ("Edge", json!({ "changed": changed, "word": word })),
        EventKind::Level { led, level } => ("Level", json!({ "led": led, "level": level })),
        EventKind::Mark { id } => ("Mark", json!({ "id": id })),
        EventKind::MoveStarted { axis, target } => ("MoveStarted", json!({ "axis": axis, "target": target })),
        EventKind::MoveDone { axis, position } => ("MoveDone", json!({ "axis": axis, "position": position })),
        EventKind::Settled => ("Settled", Value::Null),
        EventKind::RunDone { run, words, events } => {
            ("RunDone", json!({ "run": run, "words": words, "events": events }))
        }
        EventKind::Faulted { cause, instruction } => {
            ("Faulted", json!({ "cause": format!("{cause:?}"), "instruction": instruction }))
        }
        EventKind::Triggered { input, missed } => ("Triggered", json!({ "input": input, "missed": missed })),
        EventKind::TimedOut { input } => ("TimedOut", json!({ "input": input })),
        EventKind::ExposureBegan { camera, after } => {
            ("ExposureBegan", json!({ "camera": camera, "after": after }))
        }
        EventKind::ExposureEnded { camera, length } => {
            ("ExposureEnded", json!({ "camera": camera, "length": length }))
        }
        EventKind::ExposureMissing { camera, after } => {
            ("ExposureMissing", json!({ "camera": camera, "after": after }))
        }
        EventKind::Homed { axis, correction } => ("Homed", json!({ "axis": axis, "correction": correction })),
        EventKind::StreamLead { ticks } => ("StreamLead", json!({ "ticks": ticks })),
    };
    EventRecord { seq: event.seq, tick: event.tick, kind: kind.to_owned(), data }
}

/// Where a run goes and what else is noted of it.
pub struct Destination<'a> {
    /// Folder of the dataset.
    pub out: &'a Path,
    /// Whether a dataset that is there may be replaced.
    pub existing: Existing,
    /// Seed, if the rig is simulated.
    pub seed: Option<u64>,
}

/// Plays the experiment's sequence on the box behind `link`, collects and pairs, writes the dataset.
///
/// # Errors
/// [`Error::Rig`] for everything that the rig does, dataset errors for the folder.
pub fn record(
    experiment: &Experiment,
    link: &mut Link,
    camera: &mut dyn Camera,
    options: &AcquireOptions,
    destination: &Destination<'_>,
    progress: &dyn Progress,
) -> Result<(Dataset, FrameCounts), Error> {
    let start = link.status().map_err(daic_rig::RigError::from)?.position;
    let compiled = compile(experiment, link.hello(), start).map_err(daic_rig::RigError::from)?;
    let text = toml::to_string(experiment).map_err(|source| Error::Unwritable {
        path: destination.out.join("experiment.toml"),
        reason: source.to_string(),
    })?;
    let manifest = manifest(&compiled, link, camera, start, destination.seed);
    let settings = CameraSettings {
        exposure: experiment.rig.camera.exposure,
        bits: experiment.rig.camera.bits,
        hardware_trigger: true,
    };
    // a camera that refuses does so before anything is written
    camera.configure(&settings).map_err(daic_rig::RigError::from)?;
    let recording = Dataset::create(destination.out, manifest, &text, destination.existing)?;
    let mut writer = Writer { recording, next: 0 };
    let planned = compiled.plan.frames.len() as u64;
    progress.stage("recording", planned);
    let mut report = |state| match state {
        acquire::Progress::Running { frames, .. } | acquire::Progress::Collecting { frames, .. } => {
            progress.advance(frames as u64);
        }
        acquire::Progress::FaultCleared(_) | acquire::Progress::Armed => {}
    };
    let run = acquire::acquire(
        link,
        &compiled,
        camera,
        &settings,
        options,
        &mut writer,
        &mut report,
        progress.stop_requested(),
    )?;
    judge(&mut writer.recording, experiment, &compiled, &run)?;
    let counts = run.pairing.counts;
    let dataset = writer.recording.finish()?;
    let counts = FrameCounts {
        paired: counts.paired,
        missing: counts.missing,
        extra: counts.extra,
        ambiguous: counts.ambiguous,
    };
    Ok((dataset, counts))
}

fn manifest(
    compiled: &Compiled,
    link: &Link,
    camera: &dyn Camera,
    start: [i32; 6],
    seed: Option<u64>,
) -> Manifest {
    let mut manifest = Manifest::new("daic", env!("CARGO_PKG_VERSION"));
    let hello = link.hello();
    manifest.seed = seed;
    manifest.tick_hz = Some(f64::from(hello.tick_hz));
    manifest.plan = json!(verdicts::planned(&compiled.plan));
    let program: String = compiled.program.iter().map(|byte| format!("{byte:02x}")).collect();
    let info = camera.info();
    manifest.extra.insert(PROGRAM.to_owned(), program.into());
    manifest.extra.insert(START_STEPS.to_owned(), json!(start));
    manifest.extra.insert("board".to_owned(), hello.board.as_str().into());
    manifest.extra.insert("firmware".to_owned(), hello.firmware.as_str().into());
    manifest
        .extra
        .insert("camera".to_owned(), format!("{} {} {}", info.vendor, info.model, info.serial).into());
    manifest
}

/// Writes the verdicts: frames that arrived are revised, triggers without a frame are added.
fn judge(
    recording: &mut Recording,
    experiment: &Experiment,
    compiled: &Compiled,
    run: &Run,
) -> Result<(), Error> {
    let mut records = recording.dataset().frames()?.records;
    let arrived = records.len();
    let triggers: Vec<_> = run.triggers.iter().map(|t| t.trigger).collect();
    let plan = verdicts::planned(&compiled.plan);
    let stated = Stated::of(experiment, compiled.plan.tick_hz);
    let exposures = Exposures::of(&recording.dataset().events()?.records, stated.line);
    verdicts::apply(&mut records, &run.pairing, &triggers, &plan, (&exposures, &stated));
    for (k, record) in records.into_iter().enumerate() {
        if k < arrived {
            recording.revise_frame(&record)?;
        } else {
            recording.append_frame(record, None)?;
        }
    }
    Ok(())
}

/// Columns and rows of every frame.
pub fn size_px(experiment: &Experiment) -> [u32; 2] {
    [experiment.rig.camera.width, experiment.rig.camera.height]
}

/// Link settings of an experiment.
pub fn link_options(experiment: &Experiment) -> LinkOptions {
    LinkOptions {
        baud: experiment.rig.baud,
        timeout: experiment.rig.reply_timeout.duration(),
        ..LinkOptions::default()
    }
}

/// Runs an experiment on the box at `port`, with a camera that writes into `frames`.
///
/// # Errors
/// As [`record`], and what is wrong with the port.
pub fn run_at_port(
    experiment: &Experiment,
    port: &str,
    frames: &Path,
    out: &Path,
    existing: Existing,
    progress: &dyn Progress,
) -> Result<FrameCounts, Error> {
    let mut camera = FolderCamera::new(frames, size_px(experiment));
    progress.stage("asking the box who it is", 0);
    let mut link = Link::open(port, link_options(experiment)).map_err(daic_rig::RigError::from)?;
    let options = AcquireOptions {
        frame_timeout: experiment.rig.frame_timeout.duration(),
        size_px: Some(size_px(experiment)),
        ..AcquireOptions::new(link.hello().tick_hz)
    };
    let destination = Destination { out, existing, seed: None };
    Ok(record(experiment, &mut link, &mut camera, &options, &destination, progress)?.1)
}
