//! A run of the rig into a dataset, written as it comes in.

use crate::error::Error;
use crate::folder_camera::FolderCamera;
use crate::process::{FrameCounts, PROGRAM, START_STEPS};
use crate::progress::Progress;
use daic_dataset::{
    Dataset, EventRecord, Existing, FrameRecord, FrameRole, GreyImage, Manifest, Recording, StrobeRecord,
    Verdict,
};
use daic_protocol::message::{Event, EventKind};
use daic_rig::acquire::{self, AcquireOptions, FrameSink, Run, SinkError};
use daic_rig::camera::{Camera, CameraSettings, Frame};
use daic_rig::compile::{Compiled, PlannedFrame, compile};
use daic_rig::experiment::{Experiment, Role};
use daic_rig::link::{Link, LinkOptions};
use daic_rig::pairing;
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

fn event_record(event: &Event) -> EventRecord {
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
    let recording = Dataset::create(destination.out, manifest, &text, destination.existing)?;
    let mut writer = Writer { recording, next: 0 };
    let settings = CameraSettings {
        exposure: experiment.rig.camera.exposure,
        bits: experiment.rig.camera.bits,
        hardware_trigger: true,
    };
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
    manifest.plan = compiled
        .plan
        .frames
        .iter()
        .map(|f| {
            json!({
                "index": f.index,
                "name": f.name,
                "role": format!("{:?}", f.role).to_lowercase(),
                "asked_mm": f.asked_mm,
                "position_mm": f.position_mm,
                "position_steps": f.position_steps,
            })
        })
        .collect();
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
    let exposure_ns = experiment.rig.camera.exposure.ns().round() as u64;
    for (record, frame) in records.iter_mut().zip(&run.frames) {
        match frame.verdict {
            pairing::Verdict::Paired { trigger, .. } => {
                record.verdict = Verdict::Paired;
                planned(record, compiled.plan.frames.get(trigger), run, trigger);
                record.exposure_ns = Some(exposure_ns);
            }
            pairing::Verdict::Extra => record.verdict = Verdict::Extra,
            pairing::Verdict::Ambiguous => record.verdict = Verdict::Ambiguous,
        }
        recording.revise_frame(record)?;
    }
    let next = records.len() as u64;
    let missing = run.pairing.triggers.iter().enumerate().filter(|(_, frame)| frame.is_none());
    for (id, (trigger, _)) in (next..).zip(missing) {
        let mut record = FrameRecord::new(id, "missing", FrameRole::Unplanned);
        record.verdict = Verdict::Missing;
        planned(&mut record, compiled.plan.frames.get(trigger), run, trigger);
        recording.append_frame(record, None)?;
    }
    Ok(())
}

fn planned(record: &mut FrameRecord, plan: Option<&PlannedFrame>, run: &Run, trigger: usize) {
    let Some(plan) = plan else { return };
    plan.name.clone_into(&mut record.name);
    record.role = match plan.role {
        Role::Calibration => FrameRole::Calibration,
        Role::Reference => FrameRole::Reference,
        Role::Deformed | Role::Series => FrameRole::Measurement,
    };
    // a stage can only stand on whole steps: that is what was really commanded
    record.commanded_um = Some(plan.position_mm.map(|mm| mm * 1e3));
    if let Some(played) = run.triggers.get(trigger) {
        record.trigger_tick = Some(played.trigger.tick);
        record.strobes = played
            .trigger
            .strobe
            .iter()
            .map(|pulse| StrobeRecord {
                led: pulse.led,
                on_tick: pulse.on,
                off_tick: pulse.off,
                level: f64::from(plan.strobe.level) / f64::from(u16::MAX),
            })
            .collect();
    }
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
    progress: &dyn Progress,
) -> Result<FrameCounts, Error> {
    let sensor = [experiment.rig.camera.width, experiment.rig.camera.height];
    let mut camera = FolderCamera::new(frames, sensor);
    progress.stage("asking the box who it is", 0);
    let mut link = Link::open(port, link_options(experiment)).map_err(daic_rig::RigError::from)?;
    let options = AcquireOptions {
        frame_timeout: experiment.rig.frame_timeout.duration(),
        ..AcquireOptions::new(link.hello().tick_hz)
    };
    let destination = Destination { out, existing: Existing::Refuse, seed: None };
    Ok(record(experiment, &mut link, &mut camera, &options, &destination, progress)?.1)
}
