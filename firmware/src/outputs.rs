//! What stands on the outputs and in the event log: everything a player changes.

use crate::Sink;
use crate::events::EventLog;
use daic_protocol::channels::{AXIS_MASK, SAFE_WORD};
use daic_protocol::limits::MIN_STEP_TICKS;
use daic_protocol::message::EventKind;

/// Axes a status tells the position of.
pub(crate) const AXES: usize = daic_protocol::channels::AXES as usize;
/// LEDs that have a level.
pub(crate) const LEDS: usize = daic_protocol::channels::LEDS as usize;

/// Outputs, positions and events.
#[derive(Debug, Clone)]
pub(crate) struct Outputs {
    pub(crate) word: u32,
    /// Tick of the last word, if there was one.
    last_word: Option<u64>,
    /// Tick of the last word or event: nothing may come before it.
    last: u64,
    levels: [u16; LEDS],
    position: [i32; AXES],
    pub(crate) log: EventLog,
    /// Words and events of this run; both count modulo 2³².
    pub(crate) words: u32,
    pub(crate) events: u32,
}

impl Outputs {
    pub(crate) const fn new() -> Self {
        Self {
            word: SAFE_WORD,
            last_word: None,
            last: 0,
            levels: [0; LEDS],
            position: [0; AXES],
            log: EventLog::new(),
            words: 0,
            events: 0,
        }
    }

    pub(crate) fn position(&self) -> [i32; AXES] {
        self.position
    }

    pub(crate) fn levels(&self) -> [u16; LEDS] {
        self.levels
    }

    pub(crate) fn axis(&self, axis: u8) -> i32 {
        self.position.get(usize::from(axis)).copied().unwrap_or(0)
    }

    /// Counts a step made.
    pub(crate) fn step(&mut self, axis: u8, by: i32) {
        if let Some(p) = self.position.get_mut(usize::from(axis)) {
            *p = p.saturating_add(by);
        }
    }

    /// Tick of the last word or event.
    pub(crate) fn last(&self) -> u64 {
        self.last
    }

    /// When a word wanted at `tick` can be put out.
    pub(crate) fn earliest(&self, tick: u64) -> u64 {
        let free = self.last_word.map_or(0, |last| last.saturating_add(u64::from(MIN_STEP_TICKS)));
        tick.max(free)
    }

    /// When the safe word can stand if it is wanted at `tick`.
    pub(crate) fn earliest_safe(&self, tick: u64) -> u64 {
        if self.word == SAFE_WORD { tick } else { self.earliest(tick) }
    }

    pub(crate) fn put(&mut self, tick: u64, word: u32, sink: &mut dyn Sink) {
        let changed = (self.word ^ word) & !AXIS_MASK;
        self.word = word;
        self.last_word = Some(tick);
        self.last = self.last.max(tick);
        self.words = self.words.wrapping_add(1);
        sink.word(tick, word);
        if changed != 0 {
            self.note(tick, EventKind::Edge { changed, word });
        }
    }

    pub(crate) fn set_level(&mut self, tick: u64, led: u8, level: u16, sink: &mut dyn Sink) {
        if let Some(l) = self.levels.get_mut(usize::from(led)) {
            *l = level;
        }
        sink.level(tick, led, level);
        self.note(tick, EventKind::Level { led, level });
    }

    pub(crate) fn note(&mut self, tick: u64, kind: EventKind) {
        self.last = self.last.max(tick);
        self.events = self.events.wrapping_add(1);
        self.log.push(tick, kind);
    }

    /// Every line low, then every level 0. What is already so is not put out again.
    pub(crate) fn make_safe(&mut self, tick: u64, sink: &mut dyn Sink) {
        if self.word != SAFE_WORD {
            self.put(tick, SAFE_WORD, sink);
        }
        for (led, level) in (0u8..).zip(self.levels) {
            if level != 0 {
                self.set_level(tick, led, 0, sink);
            }
        }
    }
}
