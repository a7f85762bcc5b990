//! What a run leaves behind, and its checks against the plan.

use super::AcquireOptions;
use crate::camera::CameraStats;
use crate::clock::{ClockModel, HostTime};
use crate::compile::{Plan, PlannedFrame};
use crate::error::RigError;
use crate::link::LinkStats;
use crate::pairing::{Arrival, Pairing, Stamp, StrobePulse, Trigger, Verdict, pair};
use daic_protocol::channels::LED_MASK;
use daic_protocol::message::{Event, EventKind, Hello};
use std::time::Duration;

/// A trigger as it was played.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TriggerRecord {
    /// Tick of the rising edge since boot, and the strobe.
    pub trigger: Trigger,
    /// Host time of the edge, from the link's zero, if the clock model allows one.
    pub host: Option<HostTime>,
}

/// A frame that arrived.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameRecord {
    /// The camera's number, the camera's time, the host's time.
    pub stamp: Stamp,
    /// What became of it.
    pub verdict: Verdict,
    /// Index of the planned frame, if paired.
    pub planned: Option<usize>,
}

/// A finished run.
#[derive(Debug, Clone)]
pub struct Run {
    /// The box.
    pub hello: Hello,
    /// Hash of the program played.
    pub program: u32,
    /// Number of the run since boot.
    pub run: u32,
    /// Tick at which the run began.
    pub begin_tick: u64,
    /// Every event of the run.
    pub events: Vec<Event>,
    /// Triggers in order; the n-th is that of the n-th planned frame.
    pub triggers: Vec<TriggerRecord>,
    /// Frames in order of arrival.
    pub frames: Vec<FrameRecord>,
    /// Verdicts and counts.
    pub pairing: Pairing,
    /// Numbers of frames that came incomplete and were thrown away.
    pub incomplete: Vec<u64>,
    /// Model of the box's clock, if one was asked for and holds.
    pub clock: Option<ClockModel>,
    /// Counters of the link.
    pub link: LinkStats,
    /// Counters of the camera.
    pub camera: CameraStats,
}

pub(super) struct Parts<'a> {
    pub hello: Hello,
    pub program: u32,
    pub plan: &'a Plan,
    pub options: &'a AcquireOptions,
    pub events: Vec<Event>,
    pub stamps: Vec<Stamp>,
    pub incomplete: Vec<u64>,
    pub clock: Option<ClockModel>,
    pub link: LinkStats,
    pub camera: CameraStats,
}

pub(super) fn count_triggers(events: &[Event], camera_mask: u32) -> usize {
    events
        .iter()
        .filter(|e| matches!(e.kind, EventKind::Edge { changed, word } if changed & word & camera_mask != 0))
        .count()
}

/// Rising edges of the camera line in `camera_mask`, each with the first LED pulse that begins at
/// or after it and before the next one.
pub fn triggers_of(events: &[Event], camera_mask: u32) -> Vec<Trigger> {
    let mut triggers: Vec<Trigger> = Vec::new();
    let mut lit: Option<(u8, u64)> = None;
    for event in events {
        let EventKind::Edge { changed, word } = event.kind else { continue };
        if changed & word & camera_mask != 0 {
            lit = None;
            triggers.push(Trigger { tick: event.tick, strobe: None });
        }
        let Some(current) = triggers.last_mut() else { continue };
        if current.strobe.is_some() {
            continue;
        }
        match lit {
            None => {
                let rising = changed & word & LED_MASK;
                // Eight LED bits: the number of zeros below the lowest one fits easily.
                lit = (rising != 0).then(|| (rising.trailing_zeros() as u8, event.tick));
            }
            Some((led, on)) => {
                if changed & !word & (1 << led) != 0 {
                    current.strobe = Some(StrobePulse { led, on, off: event.tick });
                    lit = None;
                }
            }
        }
    }
    triggers
}

pub(super) fn assemble(parts: Parts<'_>) -> Result<Run, RigError> {
    let (run, begin_tick) = check_totals(&parts.events)?;
    let triggers = triggers_of(&parts.events, parts.plan.camera_mask);
    check_plan(&triggers, parts.plan, begin_tick)?;

    let times: Vec<Option<HostTime>> = triggers
        .iter()
        .map(|t| parts.clock.as_ref().and_then(|clock| clock.host_time(t.tick).ok()))
        .collect();
    let arrival = arrival(&times, parts.options);
    let pairing = pair(&triggers, &parts.stamps, &parts.options.pairing, arrival.as_ref());
    let frames = parts
        .stamps
        .iter()
        .zip(&pairing.frames)
        .map(|(&stamp, &verdict)| {
            let planned = match verdict {
                Verdict::Paired { trigger, .. } => Some(trigger),
                Verdict::Extra | Verdict::Ambiguous => None,
            };
            FrameRecord { stamp, verdict, planned }
        })
        .collect();
    let triggers =
        triggers.into_iter().zip(times).map(|(trigger, host)| TriggerRecord { trigger, host }).collect();
    Ok(Run {
        hello: parts.hello,
        program: parts.program,
        run,
        begin_tick,
        events: parts.events,
        triggers,
        frames,
        pairing,
        incomplete: parts.incomplete,
        clock: parts.clock,
        link: parts.link,
        camera: parts.camera,
    })
}

/// Evidence from arrival, if every trigger has a host time.
fn arrival(times: &[Option<HostTime>], options: &AcquireOptions) -> Option<Arrival> {
    let latency = options.latency?;
    let times: Vec<HostTime> = times.iter().copied().collect::<Option<_>>()?;
    let ns = |d: Duration| d.as_secs_f64() * 1e9;
    Some(Arrival {
        trigger_ns: times.iter().map(|t| t.ns).collect(),
        bound_ns: times.iter().fold(0.0, |worst: f64, t| worst.max(t.bound_ns)),
        min_latency_ns: ns(latency.min),
        quickest_ns: ns(latency.quickest),
        max_latency_ns: ns(latency.max),
    })
}

/// Number and first tick of the run; the box's own count of events must be met.
fn check_totals(events: &[Event]) -> Result<(u32, u64), RigError> {
    let mut received = 0u32;
    let mut begin_tick = None;
    for event in events {
        if matches!(event.kind, EventKind::RunStarted { .. }) {
            (received, begin_tick) = (0, Some(event.tick));
        }
        received = received.saturating_add(1);
        if let (EventKind::RunDone { run, events: announced, .. }, Some(begin_tick)) =
            (event.kind, begin_tick)
        {
            return if announced == received {
                Ok((run, begin_tick))
            } else {
                Err(RigError::TotalsDiffer { announced, received })
            };
        }
    }
    Err(RigError::TotalsDiffer { announced: 0, received })
}

/// Every trigger and every strobe must have been played as planned, to the tick.
fn check_plan(triggers: &[Trigger], plan: &Plan, begin_tick: u64) -> Result<(), RigError> {
    let otherwise = |frame, what, planned, played| {
        if planned == played {
            Ok(())
        } else {
            Err(RigError::PlayedOtherwise { frame, what, planned, played })
        }
    };
    for (frame, (trigger, planned)) in triggers.iter().zip(&plan.frames).enumerate() {
        let PlannedFrame { strobe, trigger_offset, .. } = planned;
        if let Some(offset) = trigger_offset {
            otherwise(frame, "trigger offset (ticks)", *offset, trigger.tick.wrapping_sub(begin_tick))?;
        }
        let Some(pulse) = trigger.strobe else {
            return otherwise(frame, "number of strobes", 1, 0);
        };
        otherwise(frame, "LED", u64::from(strobe.led), u64::from(pulse.led))?;
        otherwise(frame, "strobe delay (ticks)", strobe.delay_ticks, pulse.on - trigger.tick)?;
        otherwise(frame, "strobe width (ticks)", strobe.width_ticks, pulse.off - pulse.on)?;
    }
    let (planned, played) = (plan.frames.len() as u64, triggers.len() as u64);
    otherwise(planned.min(played) as usize, "number of triggers", planned, played)
}
