//! The pure controller of the daic trigger box: no pins, no clock, no allocation.
//!
//! Time comes in as an argument, edges go out through a [`Sink`]. The same code runs on the Pico
//! and in the simulated rig.
#![no_std]

use daic_protocol::message::State;

/// Where the controller puts what it plays, in order of ticks.
pub trait Sink {
    /// At `tick` the output word becomes `word` (all lines at once).
    fn word(&mut self, tick: u64, word: u32);
    /// At about `tick` LED `led` gets `level` (PWM or DAC, not tick-exact).
    fn level(&mut self, tick: u64, led: u8, level: u16);
}

/// Limits of one axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AxisLimits {
    /// Lowest allowed target in steps.
    pub min: i32,
    /// Highest allowed target in steps.
    pub max: i32,
    /// Highest step rate in steps per second.
    pub max_rate: u32,
    /// Highest acceleration in steps per second squared.
    pub max_acceleration: u32,
}

/// Limits of one LED.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LedLimits {
    /// Longest time on, in ticks.
    pub max_pulse: u32,
    /// Time a new level needs to settle, in ticks.
    pub settle: u32,
}

/// What a board has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Board {
    /// Name, reported in `Hello`.
    pub name: &'static str,
    /// Bits of `Capabilities`.
    pub capabilities: u32,
    /// One entry per axis present (x, y, z, …).
    pub axes: heapless::Vec<AxisLimits, 6>,
    /// One entry per LED present.
    pub leds: heapless::Vec<LedLimits, 8>,
    /// Camera trigger lines present.
    pub cameras: u8,
}

/// The controller.
#[derive(Debug)]
pub struct Controller {
    state: State,
}

impl Controller {
    /// A controller just booted: outputs safe, no program, all axes at step 0.
    pub fn new(board: Board, boot_id: u32) -> Self {
        let _ = (board, boot_id);
        Self { state: State::Empty }
    }
    /// State now.
    pub fn state(&self) -> State {
        self.state
    }
    /// Takes bytes received by tick `now`; every reply frame goes to `reply`.
    ///
    /// Before it acts on `Stop` or `Abort` the caller must have called [`Controller::play`] up to `now`.
    pub fn receive(&mut self, now: u64, bytes: &[u8], sink: &mut dyn Sink, reply: &mut dyn FnMut(&[u8])) {
        let _ = (now, bytes, sink, reply);
    }
    /// Plays everything due up to and including tick `until`.
    pub fn play(&mut self, until: u64, sink: &mut dyn Sink) {
        let _ = (until, sink);
    }
    /// Tick of the next output or event, if a program is running.
    pub fn next_due(&self) -> Option<u64> {
        None
    }
}
