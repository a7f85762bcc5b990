//! Waiting for a trigger.

use crate::inputs::InputLog;
use daic_protocol::channels;
use daic_protocol::program::{Condition, Timeout};

/// A wait under way.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wait {
    pub(crate) input: u8,
    pub(crate) condition: Condition,
    pub(crate) skip: u32,
    pub(crate) delay: u32,
    /// It began at this tick.
    pub(crate) since: u64,
    /// Last tick at which a trigger counts.
    pub(crate) deadline: Option<u64>,
    pub(crate) on_timeout: Timeout,
    /// The trigger came at this tick.
    pub(crate) fired: Option<u64>,
}

/// What lets triggers through: an input and its level.
pub(crate) type Gate = Option<(u8, bool)>;

/// Triggers count while the gate is open.
pub(crate) fn is_open(gate: Gate, inputs: &InputLog) -> bool {
    gate.is_none_or(|(input, high)| inputs.is_high(channels::trigger_input(input)) == high)
}

impl Wait {
    /// A wait for a level: is it there at `tick`?
    pub(crate) fn look(&mut self, gate: Gate, tick: u64, inputs: &InputLog) {
        let high = inputs.is_high(channels::trigger_input(self.input));
        let there = match self.condition {
            Condition::High => high,
            Condition::Low => !high,
            Condition::Rising | Condition::Falling => false,
        };
        let late = self.deadline.is_some_and(|deadline| tick > deadline);
        if there && self.fired.is_none() && !late && is_open(gate, inputs) {
            self.fired = Some(tick);
        }
    }

    /// An edge of its input at `tick`; false if nothing came of it.
    pub(crate) fn edge(&mut self, tick: u64, rising: bool) -> bool {
        let matches = match self.condition {
            Condition::Rising | Condition::High => rising,
            Condition::Falling | Condition::Low => !rising,
        };
        let late = self.deadline.is_some_and(|deadline| tick > deadline);
        if !matches || self.fired.is_some() || tick < self.since || late {
            return false;
        }
        match self.skip.checked_sub(1) {
            Some(left) => self.skip = left,
            None => self.fired = Some(tick),
        }
        true
    }
}
