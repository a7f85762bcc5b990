//! The pure controller of the daic trigger box: no pins, no clock, no allocation.
//!
//! Time comes in as an argument, edges go out through a [`Sink`]. The same code runs on the Pico
//! and in the simulated rig. `docs/controller.md` defines what is played, to the tick.
//!
//! * [`Controller`]: requests in, replies out; the state machine.
//! * [`verifier`]: proves a program sound before it replaces the old one.
//! * [`motion`]: when each step of a move is made.
//! * [`board`]: what a board has and what may be done with it.
#![no_std]
#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    deny(
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::indexing_slicing,
        clippy::arithmetic_side_effects,
        clippy::panic
    )
)]

mod ahead;
pub mod blocks;
pub mod board;
mod controller;
mod events;
pub mod links;
mod loader;
pub mod motion;
mod outputs;
pub mod pico;
mod replies;
pub mod slots;
mod timeline;
pub mod verifier;

pub use ahead::{Ahead, Reached};
pub use board::{AxisLimits, Board, LedLimits, START_LEAD};
pub use controller::Controller;
pub use replies::READ_CACHE;

/// Where the controller puts what it plays, in order of ticks.
pub trait Sink {
    /// At `tick` the output word becomes `word` (all lines at once).
    fn word(&mut self, tick: u64, word: u32);
    /// At about `tick` LED `led` gets `level` (PWM or DAC, not tick-exact).
    fn level(&mut self, tick: u64, led: u8, level: u16);
    /// All outputs must go safe at once, without waiting for `tick`; returns the tick at which they
    /// did. What plays on time by itself goes safe at `tick`.
    fn halt(&mut self, tick: u64) -> u64 {
        tick
    }
}
