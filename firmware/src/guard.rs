//! The LED limits while running: a second net under the verifier's proof.

use crate::board::LedLimits;
use daic_protocol::channels;

/// Light and rest of one LED.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Lamp {
    /// Since when it is lit.
    since: Option<u64>,
    /// Rest owed at tick `at`.
    owed: u64,
    at: u64,
    max_pulse: u64,
    cycle: u64,
    window: u64,
}

impl Lamp {
    pub(crate) const fn new() -> Self {
        Self { since: None, owed: 0, at: 0, max_pulse: u64::MAX, cycle: 1, window: u64::MAX }
    }

    /// Takes the limits of a level; only while dark.
    pub(crate) fn set_level(&mut self, limits: &LedLimits, level: u16) {
        let (pulse, cycle) = limits.at(level);
        self.max_pulse = u64::from(pulse);
        self.cycle = u64::from(cycle.max(1));
        self.window = u64::from(limits.window);
    }

    /// Rest owed at `tick`.
    pub(crate) fn owed(&self, tick: u64) -> u64 {
        let passed = tick.saturating_sub(self.at);
        if self.since.is_some() {
            self.owed.saturating_add(passed.saturating_mul(self.cycle.saturating_sub(1)))
        } else {
            self.owed.saturating_sub(passed)
        }
    }

    /// The line goes up or down at `tick`.
    pub(crate) fn switch(&mut self, tick: u64, on: bool) {
        if on == self.since.is_some() {
            return;
        }
        self.owed = self.owed(tick);
        self.at = tick;
        self.since = on.then_some(tick);
    }

    /// Last tick at which it may still be lit.
    pub(crate) fn deadline(&self) -> Option<u64> {
        let since = self.since?;
        let by_pulse = since.saturating_add(self.max_pulse);
        let left = self.window.saturating_sub(self.owed);
        let by_duty =
            left.checked_div(self.cycle.saturating_sub(1)).map(|ticks| self.at.saturating_add(ticks));
        Some(by_duty.map_or(by_pulse, |t| t.min(by_pulse)))
    }
}

/// The lamp whose time runs out first, and when.
pub(crate) fn first_deadline(lamps: &[Lamp]) -> Option<(u64, u8)> {
    (0u8..channels::LEDS).zip(lamps).filter_map(|(led, lamp)| lamp.deadline().map(|t| (t, led))).min()
}
