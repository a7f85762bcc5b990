//! What a stretch of instructions asks of its neighbours.

use super::checker::Span;
use super::{FOREVER, MAX_RUN_TICKS, int, violation};
use crate::outputs::LEDS;
use daic_protocol::channels;
use daic_protocol::limits::MIN_STEP_TICKS;
use daic_protocol::message::{Rule, Violation};

/// Limits of an LED that show only between instructions, at the highest level the program uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Limit {
    pub(super) max_pulse: u32,
    /// Ticks of cycle that a tick of light costs.
    pub(super) cycle: u32,
    pub(super) settle: u32,
    pub(super) window: u32,
}

/// One per LED; LEDs that are not there have limits that nothing meets.
pub(super) type Limits = [Limit; LEDS];

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
    /// Rest owed, if the LED was off at the beginning, and if it was on.
    debt: [Debt; 2],
}

/// What a stretch makes of the rest owed at its beginning: b becomes max(b + gain, floor), and on the way it is
/// at most max(b + peak_gain, peak_floor).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Debt {
    gain: i64,
    floor: i64,
    peak_gain: i64,
    peak_floor: i64,
}

/// Beyond every sum that is told apart.
const HUGE: i64 = 1 << 62;

fn clamp(value: i64) -> i64 {
    value.clamp(-HUGE, HUGE)
}

fn add(a: i64, b: i64) -> i64 {
    clamp(a.saturating_add(b))
}

impl Debt {
    const NONE: Self = Self { gain: 0, floor: 0, peak_gain: -HUGE, peak_floor: -HUGE };

    /// Darkness of at least `ticks` pays back.
    fn dark(ticks: u64) -> Self {
        Self { gain: clamp(int(ticks).saturating_neg()), ..Self::NONE }
    }

    /// Light of at most `ticks` costs.
    fn light(ticks: u64, cycle: u32) -> Self {
        let gain = clamp(int(ticks).saturating_mul(i64::from(cycle.saturating_sub(1))));
        Self { gain, peak_gain: gain, ..Self::NONE }
    }

    fn then(self, next: Self) -> Self {
        Self {
            gain: add(self.gain, next.gain),
            floor: add(self.floor, next.gain).max(next.floor),
            peak_gain: self.peak_gain.max(add(self.gain, next.peak_gain)),
            peak_floor: self.peak_floor.max(add(self.floor, next.peak_gain)).max(next.peak_floor),
        }
    }

    /// `again` + 1 times over.
    fn repeat(self, again: u32) -> Self {
        let times = |n: u32| clamp(self.gain.saturating_mul(i64::from(n))).max(0);
        let last = self.floor.saturating_add(times(again.saturating_sub(1)));
        Self {
            gain: clamp(self.gain.saturating_mul(i64::from(again).saturating_add(1))),
            floor: add(self.floor, times(again)),
            peak_gain: add(self.peak_gain, times(again)),
            peak_floor: if again == 0 {
                self.peak_floor
            } else {
                self.peak_floor.max(add(last, self.peak_gain))
            },
        }
    }
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

const UNTOUCHED: Led =
    Led { on: None, level: None, level_first: None, off: None, lit: None, debt: [Debt::NONE; 2] };

/// Shortest times are never above longest ones, and those are checked against [`MAX_RUN_TICKS`] or
/// [`FOREVER`].
fn plus(a: u64, b: u64) -> u64 {
    a.saturating_add(b)
}

fn earlier(a: Option<u64>, b: Option<u64>) -> Option<u64> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a.min(b)),
        (a, b) => a.or(b),
    }
}

/// A sum of longest times.
fn longest(a: u64, b: u64, index: u16) -> Result<u64, Violation> {
    if a == FOREVER || b == FOREVER {
        return Ok(FOREVER);
    }
    bounded(a.checked_add(b), index)
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

    pub(super) fn edge(index: u16, mask: u32, value: u32, after: u32, limits: &Limits) -> Self {
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
        block.spend((ticks, ticks), limits);
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

    /// Nothing for `low` … `high` ticks.
    pub(super) fn pause((low, high): Span, limits: &Limits) -> Self {
        let mut block = Self { low, high, silent: Some(low), ..Self::EMPTY };
        block.spend((low, high), limits);
        block
    }

    /// A move that takes `low` … `high` ticks, 0 only without steps; its first word comes after `lead`, its
    /// last `tail` before the end.
    pub(super) fn motion(index: u16, (low, high): Span, lead: u64, tail: u64, limits: &Limits) -> Self {
        let moves = high > 0;
        let mut block = Self {
            low,
            high,
            first: moves.then_some((lead, index)),
            last: moves.then_some(tail),
            silent: (low == 0).then_some(0),
            ..Self::EMPTY
        };
        block.spend((low, high), limits);
        block
    }

    /// Rest owed over a time in which no LED changes.
    fn spend(&mut self, (low, high): Span, limits: &Limits) {
        for (led, limit) in self.leds.iter_mut().zip(limits) {
            led.debt = [Debt::dark(low), Debt::light(high, limit.cycle)];
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

    /// Shortest and longest duration.
    pub(super) fn span(&self) -> Span {
        (self.low, self.high)
    }

    /// The LED that owes too much rest if nothing was owed at the beginning and all were off: what it
    /// owes, and its window.
    pub(super) fn overdrawn(&self, limits: &Limits) -> Option<(i64, i64)> {
        let owed = self.leds.iter().zip(limits).map(|(led, limit)| {
            let [dark, _] = led.debt;
            (dark.peak_gain.max(dark.peak_floor), i64::from(limit.window))
        });
        owed.filter(|(owed, window)| owed > window).max()
    }

    /// Lines that are on at the end if all were off at the beginning.
    pub(super) fn left_on(&self) -> u32 {
        self.mask & self.value
    }

    /// This block, then `next`, which ends with instruction `end`.
    pub(super) fn then(&mut self, next: &Self, end: u16, limits: &Limits) -> Result<(), Violation> {
        if let (Some(last), Some((first, index))) = (self.last, next.first) {
            let distance = plus(last, first);
            if distance < u64::from(MIN_STEP_TICKS) {
                return Err(violation(index, Rule::StepTooShort, int(distance), i64::from(MIN_STEP_TICKS)));
            }
        }
        let (mask, value) = (self.mask, self.value);
        for (((bit, led), then), limit) in (0u8..).zip(&mut self.leds).zip(&next.leds).zip(limits) {
            led.then(then, (self.low, self.high), (next.low, next.high), limit)?;
            let bit = channels::led(bit).unwrap_or(0);
            let [dark, light] = then.debt;
            let [after_dark, after_light] = match (mask & bit != 0, value & bit != 0) {
                (true, true) => [light, light],
                (true, false) => [dark, dark],
                _ => [dark, light],
            };
            let [was_dark, was_light] = led.debt;
            led.debt = [was_dark.then(after_dark), was_light.then(after_light)];
        }
        let later = next.first.and_then(|(t, index)| self.silent.map(|s| (plus(s, t), index)));
        self.first = match (self.first, later) {
            (Some(a), Some(b)) => Some(if b.0 < a.0 { b } else { a }),
            (a, b) => a.or(b),
        };
        self.last = earlier(next.last, self.last.and_then(|l| next.silent.map(|s| plus(l, s))));
        self.silent = self.silent.and_then(|a| next.silent.map(|b| plus(a, b)));
        self.low = plus(self.low, next.low);
        self.high = longest(self.high, next.high, end)?;
        self.value = (self.value & !next.mask) | (next.value & next.mask);
        self.mask |= next.mask;
        Ok(())
    }

    /// This block `count` times over; it ends with instruction `end`.
    pub(super) fn repeat(mut self, count: u32, end: u16, limits: &Limits) -> Result<Self, Violation> {
        let Some(again) = count.checked_sub(1).filter(|&n| n > 0) else { return Ok(self) };
        // Where one pass meets the next: every seam is like the first.
        self.clone().then(&self, end, limits)?;
        let high = match self.high {
            FOREVER => FOREVER,
            high => bounded(high.checked_mul(u64::from(count)), end)?,
        };
        for (bit, led) in (0u8..).zip(&mut self.leds) {
            let bit = channels::led(bit).unwrap_or(0);
            let [dark, light] = led.debt;
            let more = again.saturating_sub(1);
            led.debt = match (self.mask & bit != 0, self.value & bit != 0) {
                (true, true) => [dark.then(light.repeat(more)), light.repeat(again)],
                (true, false) => [dark.repeat(again), light.then(dark.repeat(more))],
                _ => [dark.repeat(again), light.repeat(again)],
            };
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
        limits: &Limit,
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
