//! What a stretch of instructions asks of its neighbours.

use super::{MAX_RUN_TICKS, int, violation};
use crate::board::LedLimits;
use crate::outputs::LEDS;
use daic_protocol::channels;
use daic_protocol::limits::MIN_STEP_TICKS;
use daic_protocol::message::{Rule, Violation};

/// Limits that show only between instructions.
#[derive(Clone, Copy)]
pub(super) struct Limits<'a> {
    pub(super) leds: &'a [LedLimits],
}

/// A tick counted from the beginning of the block, and the instruction that acts there.
type At = (u64, u16);

/// One LED in a block. The line's state at the beginning of the block is not known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Led {
    /// Shortest time to the first switching on that no `Level` in the block precedes.
    on: Option<At>,
    /// Shortest time from the last `Level` to the end of the block.
    level: Option<u64>,
    /// First `Level` that no edge of this LED in the block precedes: the LED must be off before.
    level_first: Option<u16>,
    /// Longest time to the first switching off.
    off: Option<At>,
    /// If the LED was off at the beginning and is on at the end: the longest time it has been on.
    lit: Option<u64>,
}

/// A stretch of instructions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Block {
    /// Shortest and longest duration.
    low: u64,
    high: u64,
    /// Shortest time to the first word, if there can be one.
    first: Option<At>,
    /// Shortest time from the last word to the end, if there can be one.
    last: Option<u64>,
    /// Shortest duration without any word, if that can be.
    silent: Option<u64>,
    /// Lines that edges have set, and to what.
    mask: u32,
    value: u32,
    leds: [Led; LEDS],
}

const UNTOUCHED: Led = Led { on: None, level: None, level_first: None, off: None, lit: None };

/// Shortest times are never above longest ones, and those are checked against [`MAX_RUN_TICKS`].
fn plus(a: u64, b: u64) -> u64 {
    a.saturating_add(b)
}

fn earlier(a: Option<u64>, b: Option<u64>) -> Option<u64> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a.min(b)),
        (a, b) => a.or(b),
    }
}

fn bounded(ticks: Option<u64>, index: u16) -> Result<u64, Violation> {
    ticks
        .filter(|&t| t <= MAX_RUN_TICKS)
        .ok_or_else(|| violation(index, Rule::TooLong, int(ticks.unwrap_or(u64::MAX)), int(MAX_RUN_TICKS)))
}

impl Block {
    /// Nothing at all.
    pub(super) const EMPTY: Self = Self {
        low: 0,
        high: 0,
        first: None,
        last: None,
        silent: Some(0),
        mask: 0,
        value: 0,
        leds: [UNTOUCHED; LEDS],
    };

    pub(super) fn edge(index: u16, mask: u32, value: u32, after: u32) -> Self {
        let ticks = u64::from(after);
        let mut block = Self {
            low: ticks,
            high: ticks,
            first: Some((ticks, index)),
            last: Some(0),
            silent: None,
            mask,
            value,
            ..Self::EMPTY
        };
        for (led, l) in (0u8..).zip(&mut block.leds) {
            let bit = channels::led(led).unwrap_or(0);
            if mask & value & bit != 0 {
                (l.on, l.lit) = (Some((ticks, index)), Some(0));
            } else if mask & bit != 0 {
                l.off = Some((ticks, index));
            }
        }
        block
    }

    pub(super) fn pause(ticks: u32) -> Self {
        let ticks = u64::from(ticks);
        Self { low: ticks, high: ticks, silent: Some(ticks), ..Self::EMPTY }
    }

    /// A move that takes `low` … `high` ticks, 0 only without steps; its first word comes after `lead`.
    pub(super) fn motion(index: u16, low: u64, high: u64, lead: u64) -> Self {
        let moves = high > 0;
        Self {
            low,
            high,
            first: moves.then_some((lead, index)),
            // The last word is the end of the last step pulse, and that ends the move.
            last: moves.then_some(0),
            silent: (low == 0).then_some(0),
            ..Self::EMPTY
        }
    }

    pub(super) fn level(index: u16, led: u8) -> Self {
        let mut block = Self::EMPTY;
        if let Some(l) = block.leds.get_mut(usize::from(led)) {
            (l.level, l.level_first) = (Some(0), Some(index));
        }
        block
    }

    /// May take no time.
    pub(super) fn is_timeless(&self) -> bool {
        self.low == 0
    }

    /// Lines that are on at the end if all were off at the beginning.
    pub(super) fn left_on(&self) -> u32 {
        self.mask & self.value
    }

    /// This block, then `next`, which ends with instruction `end`.
    pub(super) fn then(&mut self, next: &Self, end: u16, limits: Limits<'_>) -> Result<(), Violation> {
        if let (Some(last), Some((first, index))) = (self.last, next.first) {
            let distance = plus(last, first);
            if distance < u64::from(MIN_STEP_TICKS) {
                return Err(violation(index, Rule::StepTooShort, int(distance), i64::from(MIN_STEP_TICKS)));
            }
        }
        for ((led, then), limit) in self.leds.iter_mut().zip(&next.leds).zip(limits.leds) {
            led.then(then, (self.low, self.high), (next.low, next.high), limit)?;
        }
        let later = next.first.and_then(|(t, index)| self.silent.map(|s| (plus(s, t), index)));
        self.first = match (self.first, later) {
            (Some(a), Some(b)) => Some(if b.0 < a.0 { b } else { a }),
            (a, b) => a.or(b),
        };
        self.last = earlier(next.last, self.last.and_then(|l| next.silent.map(|s| plus(l, s))));
        self.silent = self.silent.and_then(|a| next.silent.map(|b| plus(a, b)));
        self.low = plus(self.low, next.low);
        self.high = bounded(self.high.checked_add(next.high), end)?;
        self.value = (self.value & !next.mask) | (next.value & next.mask);
        self.mask |= next.mask;
        Ok(())
    }

    /// This block `count` times over; it ends with instruction `end`.
    pub(super) fn repeat(mut self, count: u32, end: u16, limits: Limits<'_>) -> Result<Self, Violation> {
        let Some(again) = count.checked_sub(1).filter(|&n| n > 0) else { return Ok(self) };
        // Where one pass meets the next: every seam is like the first.
        self.clone().then(&self, end, limits)?;
        let high = bounded(self.high.checked_mul(u64::from(count)), end)?;
        for led in &mut self.leds {
            if led.off.is_none()
                && let Some(lit) = &mut led.lit
            {
                *lit = plus(*lit, self.high.saturating_mul(u64::from(again)));
            }
        }
        self.high = high;
        self.low = self.low.saturating_mul(u64::from(count));
        self.silent = self.silent.map(|s| s.saturating_mul(u64::from(count)));
        Ok(self)
    }
}

impl Led {
    fn has_edges(&self) -> bool {
        self.off.is_some() || self.lit.is_some()
    }

    /// `here` and `there`: shortest and longest duration of this block and of the next.
    fn then(
        &mut self,
        next: &Self,
        here: (u64, u64),
        there: (u64, u64),
        limits: &LedLimits,
    ) -> Result<(), Violation> {
        let settle = u64::from(limits.settle);
        if let (Some(level), Some((on, index))) = (self.level, next.on) {
            let settled = plus(level, on);
            if settled < settle {
                return Err(violation(index, Rule::LevelNotSettled, int(settled), int(settle)));
            }
        }
        if let (Some(_), Some(index)) = (self.lit, next.level_first) {
            // The light would change while it shines, at a moment nobody knows.
            return Err(violation(index, Rule::LevelNotSettled, 0, int(settle)));
        }
        if let (Some(lit), Some((off, index))) = (self.lit, next.off) {
            let pulse = plus(lit, off);
            if pulse > u64::from(limits.max_pulse) {
                return Err(violation(index, Rule::PulseTooLong, int(pulse), i64::from(limits.max_pulse)));
            }
        }
        let had_edges = self.has_edges();
        if self.on.is_none() && self.level.is_none() {
            self.on = next.on.map(|(t, index)| (plus(here.0, t), index));
        }
        self.level = next.level.or(self.level.map(|l| plus(l, there.0)));
        if !had_edges {
            self.level_first = self.level_first.or(next.level_first);
        }
        self.lit = match (next.off, self.lit) {
            (None, Some(lit)) => Some(plus(lit, there.1)),
            _ => next.lit,
        };
        self.off = self.off.or(next.off.map(|(t, index)| (plus(here.1, t), index)));
        Ok(())
    }
}
