//! What the box's inputs are wired to: trigger sources, interlock, limit switches, the camera.

use daic_protocol::channels;

use crate::config::{BoardConfig, Stimulus};
use crate::world::World;

/// The input word as the world makes it.
#[derive(Debug, Clone)]
pub struct Wiring {
    stimulus: Vec<Stimulus>,
    /// Stimuli that have happened.
    next: usize,
    /// Levels of trigger inputs and interlock.
    levels: u32,
    /// Axis, high end, steps at which the switch is pressed.
    switches: Vec<(u8, bool, i64)>,
    exposure_active: bool,
    interlock: bool,
}

impl Wiring {
    /// As configured; the interlock is closed at first.
    pub fn new(config: &BoardConfig) -> Self {
        let home = |(axis, a): (u8, &crate::config::AxisConfig)| {
            a.home.map(|home| (axis, home.high_end, home.switch_at))
        };
        Self {
            stimulus: config.stimulus.clone(),
            next: 0,
            levels: channels::INTERLOCK,
            switches: (0u8..).zip(&config.axes).filter_map(home).collect(),
            exposure_active: config.exposure_active,
            interlock: config.interlock,
        }
    }

    /// Sets trigger inputs and interlock from outside, over what the stimulus says.
    pub fn set_levels(&mut self, word: u32) {
        self.levels = word;
    }

    /// Whether any input can change, or the box must be told that its interlock is closed.
    pub fn is_wired(&self) -> bool {
        !self.stimulus.is_empty()
            || !self.switches.is_empty()
            || self.exposure_active
            || self.levels != channels::INTERLOCK
            || self.interlock
    }

    /// Next tick after which something may have changed by itself.
    pub fn due(&self, world: &World) -> Option<u64> {
        let stimulus = self.stimulus.get(self.next).map(|s| s.tick);
        let camera = self.exposure_active.then(|| world.camera().next_change(world.tick())).flatten();
        stimulus.into_iter().chain(camera).min()
    }

    /// The input word at `tick`, up to which the world has been advanced.
    pub fn word(&mut self, tick: u64, world: &World) -> u32 {
        while let Some(stimulus) = self.stimulus.get(self.next).filter(|s| s.tick <= tick) {
            self.levels = stimulus.word;
            self.next += 1;
        }
        let mut word = self.levels & (channels::TRIGGER_INPUT_MASK | channels::INTERLOCK);
        let steps = world.stage().steps();
        for &(axis, high_end, at) in &self.switches {
            let here = steps.get(usize::from(axis)).copied().unwrap_or(0);
            if (high_end && here >= at) || (!high_end && here <= at) {
                word |= channels::limit_switch(axis, high_end).unwrap_or(0);
            }
        }
        if self.exposure_active && world.camera().is_exposing(tick) {
            word |= channels::exposure_active(world.camera().line()).unwrap_or(0);
        }
        word
    }
}
