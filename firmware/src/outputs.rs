//! What stands on the outputs and in the event log: everything a player changes.

use crate::Sink;
use crate::board::Board;
use crate::events::EventLog;
use crate::guard::{Lamp, first_deadline};
use crate::inputs::InputLog;
use daic_protocol::channels::{self, AXIS_MASK, CAMERA_MASK, LED_MASK, SAFE_WORD};
use daic_protocol::limits::MIN_STEP_TICKS;
use daic_protocol::message::{Capabilities, EventKind};

/// Axes a status tells the position of.
pub(crate) const AXES: usize = daic_protocol::channels::AXES as usize;
/// LEDs that have a level.
pub(crate) const LEDS: usize = daic_protocol::channels::LEDS as usize;

/// Outputs, positions, inputs and events.
#[derive(Debug, Clone)]
pub(crate) struct Outputs {
    pub(crate) word: u32,
    /// Tick of the last word, if there was one.
    last_word: Option<u64>,
    /// Tick of the last word or event: nothing may come before it.
    last: u64,
    levels: [u16; LEDS],
    lamps: [Lamp; LEDS],
    position: [i32; AXES],
    /// Axes that know where they are, one bit each.
    homed: u8,
    /// The box has exposure-active inputs.
    exposure_active: bool,
    pub(crate) inputs: InputLog,
    pub(crate) log: EventLog,
    /// Words and events of this run; both count modulo 2³².
    pub(crate) words: u32,
    pub(crate) events: u32,
}

impl Outputs {
    pub(crate) fn new(board: &Board) -> Self {
        let mut lamps = [Lamp::new(); LEDS];
        for (lamp, limits) in lamps.iter_mut().zip(&board.leds) {
            lamp.set_level(limits, 0);
        }
        // An axis without a switch is taken to stand at 0 at boot.
        let homed = (0u8..).zip(&board.axes).filter(|(_, axis)| axis.home.is_none());
        Self {
            word: SAFE_WORD,
            last_word: None,
            last: 0,
            levels: [0; LEDS],
            lamps,
            position: [0; AXES],
            homed: homed.fold(0, |bits, (axis, _)| bits | axis_bit(axis)),
            exposure_active: board.capabilities & Capabilities::EXPOSURE_ACTIVE != 0,
            inputs: InputLog::new(),
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

    pub(crate) fn homed(&self) -> u8 {
        self.homed
    }

    pub(crate) fn is_homed(&self, axis: u8) -> bool {
        self.homed & axis_bit(axis) != 0
    }

    pub(crate) fn set_homed(&mut self, axis: u8, homed: bool) {
        if homed {
            self.homed |= axis_bit(axis);
        } else {
            self.homed &= !axis_bit(axis);
        }
    }

    pub(crate) fn axis(&self, axis: u8) -> i32 {
        self.position.get(usize::from(axis)).copied().unwrap_or(0)
    }

    pub(crate) fn set_axis(&mut self, axis: u8, position: i32) {
        if let Some(p) = self.position.get_mut(usize::from(axis)) {
            *p = position;
        }
    }

    /// Counts a step made.
    pub(crate) fn step(&mut self, axis: u8, positive: bool) {
        let by = if positive { 1 } else { -1 };
        self.set_axis(axis, self.axis(axis).saturating_add(by));
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
        let risen = word & !self.word;
        self.word = word;
        self.last_word = Some(tick);
        self.last = self.last.max(tick);
        self.words = self.words.wrapping_add(1);
        sink.word(tick, word);
        if changed & LED_MASK != 0 {
            for (led, lamp) in (0u8..).zip(&mut self.lamps) {
                lamp.switch(tick, channels::led(led).is_some_and(|bit| word & bit != 0));
            }
        }
        if changed != 0 {
            self.note(tick, EventKind::Edge { changed, word });
        }
        if risen & CAMERA_MASK != 0 && self.exposure_active {
            let (inputs, log, events) = (&mut self.inputs, &mut self.log, &mut self.events);
            inputs.triggered(tick, risen, &mut |kind| {
                *events = events.wrapping_add(1);
                log.push(tick, kind);
            });
        }
    }

    /// The exposure-active lines have changed.
    pub(crate) fn exposures(&mut self, tick: u64, changed: u32) {
        let (inputs, log, events) = (&mut self.inputs, &mut self.log, &mut self.events);
        inputs.exposures(tick, changed, &mut |kind| {
            *events = events.wrapping_add(1);
            log.push(tick, kind);
        });
    }

    /// A run ends: camera triggers older than `grace` that had no exposure are told.
    pub(crate) fn end_exposures(&mut self, tick: u64, grace: u64) {
        let (inputs, log, events) = (&mut self.inputs, &mut self.log, &mut self.events);
        inputs.end_of_run(tick, grace, &mut |kind| {
            *events = events.wrapping_add(1);
            log.push(tick, kind);
        });
    }

    pub(crate) fn set_level(&mut self, tick: u64, led: u8, level: u16, board: &Board, sink: &mut dyn Sink) {
        let index = usize::from(led);
        if let Some(l) = self.levels.get_mut(index) {
            *l = level;
        }
        if let (Some(lamp), Some(limits)) = (self.lamps.get_mut(index), board.leds.get(index)) {
            lamp.set_level(limits, level);
        }
        sink.level(tick, led, level);
        self.note(tick, EventKind::Level { led, level });
    }

    pub(crate) fn note(&mut self, tick: u64, kind: EventKind) {
        self.last = self.last.max(tick);
        self.events = self.events.wrapping_add(1);
        self.log.push(tick, kind);
    }

    /// Last tick at which all LEDs may stay as they are, and the LED that must go off then.
    pub(crate) fn light_deadline(&self) -> Option<(u64, u8)> {
        if self.word & LED_MASK == 0 { None } else { first_deadline(&self.lamps) }
    }

    /// The LED that owes most rest at `tick`, and how much.
    pub(crate) fn owed(&self, tick: u64) -> Option<(u64, u8)> {
        (0u8..).zip(&self.lamps).map(|(led, lamp)| (lamp.owed(tick), led)).max().filter(|(owed, _)| *owed > 0)
    }

    /// Every line low, then every level 0. What is already so is not put out again.
    pub(crate) fn make_safe(&mut self, tick: u64, board: &Board, sink: &mut dyn Sink) {
        if self.word != SAFE_WORD {
            self.put(tick, SAFE_WORD, sink);
        }
        for (led, level) in (0u8..).zip(self.levels) {
            if level != 0 {
                self.set_level(tick, led, 0, board, sink);
            }
        }
    }
}

pub(crate) fn axis_bit(axis: u8) -> u8 {
    1u8.checked_shl(u32::from(axis)).unwrap_or(0)
}
