//! When frames were really exposed, as the box saw it on the camera's exposure-active line.

use crate::measure::{Spread, spread};
use daic_dataset::{EventRecord, FrameRecord};
use daic_protocol::channels;
use daic_protocol::message::Hello;
use daic_protocol::program::Instruction;
use daic_rig::compile::CompileError;
use daic_rig::experiment::Experiment;
use daic_rig::units::Time;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// Trigger-to-exposure delay and exposure of a camera. Times in microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExposureSummary {
    /// Exposures that followed a trigger.
    pub exposures: usize,
    /// Triggers without an exposure.
    pub missing: usize,
    /// Exposures that no trigger had asked for.
    pub unasked: usize,
    /// Trigger to exposure; none where no trigger was followed by one.
    pub delay_us: Option<Times>,
    /// What the experiment says of it.
    pub stated_delay_us: f64,
    /// Length of the exposures; none where no end was seen.
    pub length_us: Option<Times>,
    /// What the experiment says of it.
    pub stated_length_us: f64,
}

/// Times of several exposures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Times {
    /// Mean.
    pub mean: f64,
    /// Standard deviation: the jitter.
    pub std: f64,
    /// Shortest.
    pub min: f64,
    /// Longest.
    pub max: f64,
}

/// What is known of exposures before they are seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stated {
    /// Trigger to exposure, nanoseconds.
    pub delay_ns: f64,
    /// Length, nanoseconds.
    pub length_ns: f64,
    /// Camera line of the box.
    pub line: u8,
    /// Ticks per second of the box.
    pub tick_hz: u32,
}

impl Stated {
    /// As the experiment has it.
    pub fn of(experiment: &Experiment, tick_hz: u32) -> Self {
        let camera = &experiment.rig.camera;
        Self {
            delay_ns: camera.exposure_delay.ns(),
            length_ns: camera.exposure.ns(),
            line: camera.line,
            tick_hz,
        }
    }

    fn us(&self, ticks: u64) -> f64 {
        ticks as f64 * 1e6 / f64::from(self.tick_hz)
    }

    fn ticks(&self, ns: f64) -> u64 {
        (ns * f64::from(self.tick_hz) * 1e-9).round() as u64
    }
}

/// A program that triggers the experiment's camera `count` times, as often as it can.
///
/// # Errors
/// A camera line that the box does not have.
pub fn program(experiment: &Experiment, hello: &Hello, count: u32) -> Result<Vec<Instruction>, CompileError> {
    let camera = &experiment.rig.camera;
    let missing = CompileError::NoSuchCamera { line: camera.line, cameras: hello.cameras };
    let line = channels::camera(camera.line).filter(|_| camera.line < hello.cameras).ok_or(missing)?;
    let ticks = |time: Time| u32::try_from(time.ticks(hello.tick_hz)).unwrap_or(u32::MAX);
    let width = ticks(camera.trigger_width).max(hello.min_step_ticks);
    let parts = [camera.exposure_delay, camera.exposure, camera.rolling(), camera.readout];
    // a delay that is not known yet may be longer than what the experiment says
    let busy = parts.into_iter().fold(hello.tick_hz / 100, |sum, part| sum.saturating_add(ticks(part)));
    Ok(vec![
        Instruction::LoopBegin { count },
        Instruction::Edge { mask: line, value: line, after: hello.min_step_ticks },
        Instruction::Edge { mask: line, value: 0, after: width },
        Instruction::Delay { ticks: busy },
        Instruction::LoopEnd,
    ])
}

/// One exposure: tick of its begin, and its length in ticks where its end was seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Seen {
    begin: u64,
    length: Option<u64>,
}

/// The exposures of one camera.
#[derive(Debug, Clone, Default)]
pub struct Exposures {
    by_trigger: HashMap<u64, Seen>,
    missing: usize,
    unasked: usize,
}

impl Exposures {
    /// Picks the exposures of a camera line out of a run's events.
    pub fn of(events: &[EventRecord], line: u8) -> Self {
        let mut all = Self::default();
        let mut open = None;
        for event in events {
            let number = |key: &str| event.data.get(key).and_then(serde_json::Value::as_u64);
            if number("camera") != Some(u64::from(line)) {
                continue;
            }
            match event.kind.as_str() {
                "ExposureBegan" => match number("after") {
                    // the box knows of no trigger
                    None => {}
                    Some(after) if after == u64::from(u32::MAX) => all.unasked += 1,
                    Some(after) => {
                        let trigger = event.tick.saturating_sub(after);
                        all.by_trigger.insert(trigger, Seen { begin: event.tick, length: None });
                        open = Some(trigger);
                    }
                },
                "ExposureEnded" => {
                    let trigger = open.take();
                    if let Some(seen) = trigger.and_then(|trigger| all.by_trigger.get_mut(&trigger)) {
                        seen.length = number("length");
                    }
                }
                "ExposureMissing" => all.missing += 1,
                _ => {}
            }
        }
        all
    }

    /// The numbers; none if the box saw nothing of the camera.
    pub fn summary(&self, stated: &Stated) -> Option<ExposureSummary> {
        if self.by_trigger.is_empty() && self.unasked == 0 {
            return None;
        }
        let delays: Vec<f64> = self.by_trigger.iter().map(|(t, seen)| stated.us(seen.begin - t)).collect();
        let lengths: Vec<f64> =
            self.by_trigger.values().filter_map(|seen| Some(stated.us(seen.length?))).collect();
        Some(ExposureSummary {
            exposures: self.by_trigger.len(),
            missing: self.missing,
            unasked: self.unasked,
            delay_us: times(&delays),
            stated_delay_us: stated.delay_ns * 1e-3,
            length_us: times(&lengths),
            stated_length_us: stated.length_ns * 1e-3,
        })
    }

    /// Notes when a triggered frame was exposed: as seen, or else as stated. A strobe outside of an exposure that was
    /// seen is remarked.
    pub fn note(&self, record: &mut FrameRecord, stated: &Stated) {
        let Some(trigger) = record.trigger_tick else { return };
        let stated_begin = trigger.saturating_add(stated.ticks(stated.delay_ns));
        record.exposure_tick = Some(self.by_trigger.get(&trigger).map_or(stated_begin, |seen| seen.begin));
        let Some(seen) = self.by_trigger.get(&trigger) else { return };
        let length = seen.length.unwrap_or_else(|| stated.ticks(stated.length_ns));
        let end = seen.begin.saturating_add(length);
        let outside = record.strobes.iter().any(|s| s.on_tick < seen.begin || s.off_tick > end);
        if outside && record.note.is_empty() {
            record.note = format!(
                "a strobe lies outside the exposure, which the box saw from {:.3} to {:.3} µs after the trigger",
                stated.us(seen.begin - trigger),
                stated.us(end - trigger)
            );
        }
    }
}

fn times(values: &[f64]) -> Option<Times> {
    if values.is_empty() {
        return None;
    }
    let Spread { mean, std, .. } = spread(values.iter().copied());
    let (min, max) =
        values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(*v), b.max(*v)));
    Some(Times { mean, std, min, max })
}
