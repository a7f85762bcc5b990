//! Finding a home switch.

use crate::Sink;
use crate::board::Homing;
use crate::motion::{DIR_DELAY, DIR_SETUP, STEP_PULSE};
use crate::outputs::{Outputs, axis_bit};
use daic_protocol::channels;
use daic_protocol::limits::TICK_HZ;
use daic_protocol::message::{EventKind, FaultCause};
use daic_protocol::program::Instruction;

/// What homing came to at some tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Found {
    /// Not yet.
    Searching,
    /// The axis is home since this tick.
    Home(u64),
    /// It cannot be found.
    Failed(FaultCause),
}

#[derive(Debug, Clone, Copy)]
enum Line {
    Direction(u64),
    Rise(u64),
    Fall(u64),
}

/// A search under way.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Search {
    axis: u8,
    homing: Homing,
    /// Away from the switch again.
    back: bool,
    left: u32,
    next: Line,
}

/// Ticks from one step to the next.
fn interval(rate: u32) -> u64 {
    u64::from(TICK_HZ.checked_div(rate.max(1)).unwrap_or(TICK_HZ)).max(STEP_PULSE.saturating_mul(2))
}

/// The longest that homing can take, in ticks.
pub(crate) fn longest(homing: &Homing) -> u64 {
    // One step more on each way, at which the switch is looked at for the last time.
    let travel = u64::from(homing.travel).saturating_add(1);
    let there = travel.saturating_mul(interval(homing.rate));
    let back = travel.saturating_mul(interval(homing.rate_back()));
    // The first word may have to wait for the last step of a move before.
    there.saturating_add(back).saturating_add(3 * DIR_DELAY + 2 * DIR_SETUP)
}

/// The shortest: the switch is pressed and lets go at the first step.
pub(crate) const SHORTEST: u64 = 2 * DIR_SETUP;

impl Search {
    /// A search whose first word, the direction, comes at `tick`.
    pub(crate) fn new(tick: u64, axis: u8, homing: Homing) -> Self {
        Self { axis, homing, back: false, left: homing.travel, next: Line::Direction(tick) }
    }

    pub(crate) fn axis(&self) -> u8 {
        self.axis
    }

    /// Tick of the next word or decision.
    pub(crate) fn due(&self) -> u64 {
        match self.next {
            Line::Direction(t) | Line::Rise(t) | Line::Fall(t) => t,
        }
    }

    /// Whether the next thing depends on the switch.
    pub(crate) fn decides(&self) -> bool {
        matches!(self.next, Line::Rise(_))
    }

    fn positive(&self) -> bool {
        self.homing.high_end != self.back
    }

    /// Does the next thing at `tick`. `None`: the plan is broken.
    pub(crate) fn advance(&mut self, tick: u64, out: &mut Outputs, sink: &mut dyn Sink) -> Option<Found> {
        let step = channels::step(self.axis)?;
        match self.next {
            Line::Direction(_) => {
                let line = channels::direction(self.axis)?;
                let word = if self.positive() { out.word | line } else { out.word & !line };
                out.put(tick, word, sink);
                self.next = Line::Rise(tick.checked_add(DIR_SETUP)?);
            }
            Line::Fall(planned) => {
                out.put(tick, out.word & !step, sink);
                let rate = if self.back { self.homing.rate_back() } else { self.homing.rate };
                let rise = planned.checked_sub(STEP_PULSE)?;
                self.next = Line::Rise(rise.checked_add(interval(rate))?);
            }
            Line::Rise(_) => {
                let pressed = out.inputs.at_limit(self.axis, self.homing.high_end);
                if !self.back && pressed {
                    self.back = true;
                    self.left = self.homing.travel;
                    self.next = Line::Direction(out.earliest(tick));
                    return Some(Found::Searching);
                }
                if self.back && !pressed {
                    let correction = self.homing.position.saturating_sub(out.axis(self.axis));
                    out.set_axis(self.axis, self.homing.position);
                    out.set_homed(self.axis, true);
                    out.note(tick, EventKind::Homed { axis: self.axis, correction });
                    return Some(Found::Home(tick));
                }
                if out.inputs.at_limit(self.axis, self.positive()) && self.back {
                    return Some(Found::Failed(FaultCause::LimitSwitch { axis: self.axis }));
                }
                let Some(left) = self.left.checked_sub(1) else {
                    return Some(Found::Failed(FaultCause::HomingFailed { axis: self.axis }));
                };
                self.left = left;
                out.step(self.axis, self.positive());
                out.put(tick, out.word | step, sink);
                self.next = Line::Fall(tick.checked_add(STEP_PULSE)?);
            }
        }
        Some(Found::Searching)
    }
}

/// The axis that an instruction moves although it does not know where it is; `homed` are the axes that do, a bit each.
pub(crate) fn unhomed(homed: &mut u8, instruction: &Instruction) -> Option<u8> {
    match *instruction {
        Instruction::Home { axis } => {
            *homed |= axis_bit(axis);
            None
        }
        Instruction::Move { axis, .. }
        | Instruction::Go { axis, .. }
        | Instruction::Capture { axis, .. }
        | Instruction::Join { axis, .. } => (*homed & axis_bit(axis) == 0).then_some(axis),
        _ => None,
    }
}
