//! The instruction set of a stored program.
//!
//! A program is a header-less sequence of postcard-encoded [`Instruction`]s. It is loaded with
//! begin → chunk → commit, validated as a whole, and played on one timeline: `Edge`, `Delay`,
//! `Settle` and `Move` take time, everything else takes none.

use serde::{Deserialize, Serialize};

/// One instruction. Append-only: the encoding of every variant is pinned by golden tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Instruction {
    /// After `after` ticks (counted from the end of the previous instruction) set the bits of
    /// `mask` to those of `value`; the instruction ends at that tick.
    Edge {
        /// Bits to change; a subset of [`EDGE_MASK`](crate::channels::EDGE_MASK).
        mask: u32,
        /// New levels; a subset of `mask`.
        value: u32,
        /// Ticks from the end of the previous instruction.
        after: u32,
    },
    /// Let `ticks` pass with the outputs unchanged.
    Delay {
        /// How long.
        ticks: u32,
    },
    /// Begin a loop that runs `count` times (≥ 1).
    LoopBegin {
        /// Number of passes.
        count: u32,
    },
    /// End of the innermost loop.
    LoopEnd,
    /// Wait for an edge on a trigger input. Encoded now, played by a later firmware.
    WaitTrigger {
        /// Input index.
        input: u8,
        /// Which edge.
        edge: TriggerEdge,
        /// Edges to let pass before the one that counts.
        skip: u32,
        /// Give up after this many ticks; 0 waits for ever.
        timeout: u32,
    },
    /// Move an axis to an absolute target and end when the last step has been made.
    Move {
        /// Axis index.
        axis: u8,
        /// Absolute target in steps from home.
        target: i32,
        /// Highest rate in steps per second.
        max_rate: u32,
        /// Acceleration in steps per second squared.
        acceleration: u32,
        /// Jerk limit in steps per second cubed; 0 plans a trapezoid.
        jerk: u32,
    },
    /// Wait for mechanics or a driver to settle: like [`Instruction::Delay`], but named in events and diagrams.
    Settle {
        /// How long.
        ticks: u32,
    },
    /// Set the current level of an LED driver (full scale 65 535). Not tick-exact.
    Level {
        /// LED index.
        led: u8,
        /// Level, 0…65 535.
        level: u16,
    },
    /// Put a mark into the event stream.
    Mark {
        /// Free for the host; repeated marks are told apart by their tick.
        id: u16,
    },
    /// End the program: outputs go to the safe word. Also implied after the last instruction.
    Stop,
}

/// Edge of a trigger input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum TriggerEdge {
    /// Low to high.
    Rising,
    /// High to low.
    Falling,
}
