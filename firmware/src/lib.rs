//! The pure controller of the daic trigger box: no pins, no clock, no allocation.
//!
//! Time comes in as an argument, edges go out through a [`Sink`]. The same code runs on the Pico
//! and in the simulated rig. `docs/controller.md` defines what is played, to the tick.
//!
//! * [`Controller`]: requests in, replies out; the state machine.
//! * [`verifier`]: proves a program sound before it replaces the old one.
//! * [`motion`]: when each step of a move is made.
//! * [`board`]: what a board has and what may be done with it.
//! * [`levels`]: LED levels by PWM and by external converters.
//! * [`Ahead`], [`blocks`], [`slots`], [`links`]: what a board with a player in hardware needs beside it.
//! * [`pico`]: the Raspberry Pi Pico as a board.
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
mod guard;
mod inputs;
pub mod levels;
pub mod links;
mod loader;
pub mod motion;
mod outputs;
pub mod pico;
mod player;
mod replies;
mod self_test;
pub mod slots;
mod stream;
pub mod verifier;

pub use ahead::{Ahead, Reached};
pub use board::{AxisLimits, Board, Homing, LedLimits, Overdrive, PLAYED, START_LEAD};
pub use controller::Controller;
pub use replies::READ_CACHE;

use daic_protocol::limits::MAX_SLOTS;
use daic_protocol::message::{Autostart, SelfTest, SlotError, SlotInfo};
use daic_protocol::program::ProgramBytes;

/// The board: where the controller puts what it plays, in order of ticks, and where it keeps programs.
pub trait Sink {
    /// At `tick` the output word becomes `word` (all lines at once).
    fn word(&mut self, tick: u64, word: u32);
    /// At about `tick` LED `led` gets `level` (PWM or DAC, not tick-exact).
    fn level(&mut self, tick: u64, led: u8, level: u16);

    /// No word can be taken now: playing pauses, and goes on when it is asked to play again.
    fn is_full(&self) -> bool {
        false
    }

    /// All outputs must be safe from `tick` on; returns the tick from which they are. What plays on time by
    /// itself goes safe at `tick`; what has been given words beyond it goes safe at once.
    fn halt(&mut self, tick: u64) -> u64 {
        tick
    }

    /// Keeps a program in a slot. Whatever happens meanwhile, the slot holds the old program or the new
    /// one, never a part of either.
    ///
    /// # Errors
    /// Why it is not kept.
    fn store(&mut self, slot: u8, program: &[u8], autostart: Autostart) -> Result<(), SlotError> {
        let _ = (slot, program, autostart);
        Err(SlotError::NoMemory)
    }

    /// Copies the program of a slot into `program`.
    ///
    /// # Errors
    /// Why there is none.
    fn fetch(&mut self, slot: u8, program: &mut ProgramBytes) -> Result<(), SlotError> {
        let _ = (slot, program);
        Err(SlotError::NoMemory)
    }

    /// Forgets the program of a slot.
    ///
    /// # Errors
    /// Why it is still there.
    fn erase(&mut self, slot: u8) -> Result<(), SlotError> {
        let _ = slot;
        Err(SlotError::NoMemory)
    }

    /// What the slots hold, empty ones left out.
    fn slots(&mut self) -> heapless::Vec<SlotInfo, MAX_SLOTS> {
        heapless::Vec::new()
    }

    /// Tests of the board itself, bits from [`SelfTests::BOARD`](daic_protocol::message::SelfTests::BOARD) on.
    fn self_test(&mut self) -> SelfTest {
        SelfTest::default()
    }
}
