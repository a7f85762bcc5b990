//! Which frame belongs to which trigger, as the dataset has it.
//!
//! Used when a run ends, and again when a dataset is processed whose recording was interrupted before that.

use crate::error::Error;
use crate::exposure::{Exposures, Stated};
use daic_dataset::{EventRecord, FrameRecord, FrameRole, StrobeRecord, Verdict};
use daic_protocol::message::{Event, EventKind};
use daic_rig::acquire::triggers_of;
use daic_rig::compile::Plan;
use daic_rig::experiment::Role;
use daic_rig::pairing::{self, Pairing, PairingOptions, Stamp, Trigger};
use serde::{Deserialize, Serialize};

/// What the manifest's plan says of one frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlannedRecord {
    /// Name in the experiment.
    pub name: String,
    /// What it is for.
    pub role: FrameRole,
    /// Stage position asked for, millimetres.
    pub asked_mm: [f64; 3],
    /// Stage position played: a stage can only stand on whole steps.
    pub position_mm: [f64; 3],
    /// The same in steps.
    pub position_steps: [i32; 3],
    /// Level of the strobe, 0 to 1.
    pub level: f64,
}

/// The plan as the manifest keeps it.
pub fn planned(plan: &Plan) -> Vec<PlannedRecord> {
    plan.frames
        .iter()
        .map(|frame| PlannedRecord {
            name: frame.name.clone(),
            role: match frame.role {
                Role::Calibration => FrameRole::Calibration,
                Role::Reference => FrameRole::Reference,
                Role::Deformed | Role::Series => FrameRole::Measurement,
            },
            asked_mm: frame.asked_mm,
            position_mm: frame.position_mm,
            position_steps: frame.position_steps,
            level: f64::from(frame.strobe.level) / f64::from(u16::MAX),
        })
        .collect()
}

/// Writes verdict, plan and strobes into `records`; triggers without a frame get records of their own.
pub fn apply(
    records: &mut Vec<FrameRecord>,
    pairing: &Pairing,
    triggers: &[Trigger],
    plan: &[PlannedRecord],
    exposure: (&Exposures, &Stated),
) {
    for (record, verdict) in records.iter_mut().zip(&pairing.frames) {
        match *verdict {
            pairing::Verdict::Paired { trigger, .. } => {
                record.verdict = Verdict::Paired;
                record.exposure_ns = Some(exposure.1.length_ns.round() as u64);
                name(record, triggers.get(trigger), plan.get(trigger));
                exposure.0.note(record, exposure.1);
            }
            pairing::Verdict::Extra => record.verdict = Verdict::Extra,
            pairing::Verdict::Ambiguous => record.verdict = Verdict::Ambiguous,
        }
    }
    let next = records.iter().map(|r| r.id + 1).max().unwrap_or(0);
    let missing = pairing.triggers.iter().enumerate().filter(|(_, frame)| frame.is_none());
    for (id, (trigger, _)) in (next..).zip(missing) {
        let mut record = FrameRecord::new(id, "missing", FrameRole::Unplanned);
        record.verdict = Verdict::Missing;
        name(&mut record, triggers.get(trigger), plan.get(trigger));
        records.push(record);
    }
}

fn name(record: &mut FrameRecord, trigger: Option<&Trigger>, plan: Option<&PlannedRecord>) {
    if let Some(plan) = plan {
        plan.name.clone_into(&mut record.name);
        record.role = plan.role;
        record.commanded_um = Some(plan.position_mm.map(|mm| mm * 1e3));
    }
    if let Some(trigger) = trigger {
        record.trigger_tick = Some(trigger.tick);
        let level = plan.map_or(f64::NAN, |p| p.level);
        record.strobes = trigger
            .strobe
            .iter()
            .map(|pulse| StrobeRecord { led: pulse.led, on_tick: pulse.on, off_tick: pulse.off, level })
            .collect();
    }
}

/// Verdicts for a recording that never got so far: from its events, its frames' own times and the plan.
///
/// # Errors
/// If the manifest's plan cannot be read.
pub fn from_events(
    records: &mut Vec<FrameRecord>,
    events: &[EventRecord],
    plan: &serde_json::Value,
    camera_mask: u32,
    stated: &Stated,
) -> Result<(), Error> {
    let plan: Vec<PlannedRecord> =
        serde_json::from_value(plan.clone()).map_err(|source| Error::Plan { reason: source.to_string() })?;
    let triggers = triggers_of(&edges(events), camera_mask);
    // records that stand for triggers without a frame are made anew
    records.retain(|r| r.file.is_some());
    let stamps: Vec<Stamp> = records
        .iter()
        .map(|r| Stamp {
            id: r.camera_frame.unwrap_or(r.id),
            camera_ns: r.camera_ns.and_then(|ns| u64::try_from(ns).ok()),
            host_ns: None,
        })
        .collect();
    let pairing = pairing::pair(&triggers, &stamps, &PairingOptions::new(stated.tick_hz), None);
    let exposures = Exposures::of(events, stated.line);
    apply(records, &pairing, &triggers, &plan, (&exposures, stated));
    Ok(())
}

fn edges(events: &[EventRecord]) -> Vec<Event> {
    let number = |e: &EventRecord, key| u32::try_from(e.data.get(key)?.as_u64()?).ok();
    events
        .iter()
        .filter(|e| e.kind == "Edge")
        .filter_map(|e| {
            let kind = EventKind::Edge { changed: number(e, "changed")?, word: number(e, "word")? };
            Some(Event { seq: e.seq, tick: e.tick, kind })
        })
        .collect()
}
