//! The instruction set of a stored program.
//!
//! A program is a header-less sequence of postcard-encoded [`Instruction`]s. It is loaded with
//! begin → chunk → commit, validated as a whole, and played on one timeline: `Edge`, `Delay`,
//! `Settle`, `Move`, `Wait`, `WaitTrigger`, `Reach`, `Home` and `Capture` take time, everything else
//! takes none.

use crate::frame::{CRC, TooLarge, crc32};
use crate::limits::MAX_PROGRAM_BYTES;
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
    /// Wait for an edge on a trigger input: [`Instruction::Wait`] with the smallest delay that the
    /// box allows, and a fault when time runs out.
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
    /// Wait for a trigger; ends exactly `delay` ticks after it.
    Wait {
        /// Trigger input.
        input: u8,
        /// What counts as a trigger.
        condition: Condition,
        /// Edges to let pass before the one that counts; 0 for levels.
        skip: u32,
        /// From the trigger to the end of the instruction; at least the latency of the box.
        delay: u32,
        /// Give up after this many ticks; 0 waits for ever.
        timeout: u32,
        /// What then.
        on_timeout: Timeout,
    },
    /// From here on triggers count only while a gate input has the level given.
    Gate {
        /// Trigger input used as a gate.
        input: u8,
        /// Level that lets triggers through.
        open_high: bool,
    },
    /// From here on every trigger counts.
    NoGate,
    /// Another axis for the move that follows: all axes of a move start and end together, and the
    /// steps of those that have fewer fall on steps of the one that has most.
    Join {
        /// Axis index.
        axis: u8,
        /// Absolute target in steps from home.
        target: i32,
    },
    /// Like [`Instruction::Move`], but the program goes on at once; [`Instruction::Reach`] waits for
    /// the end. Edges in between keep their ticks, steps make way by a few ticks.
    Go {
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
    /// Wait until the move begun by [`Instruction::Go`] has ended.
    Reach,
    /// Find the limit switch of an axis and count from there.
    Home {
        /// Axis index.
        axis: u8,
    },
    /// Move, settle, trigger the camera, strobe: one thing that is done whole or not at all.
    Capture {
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
        /// From the end of the move to the camera's trigger.
        settle: u32,
        /// Camera trigger lines, a subset of [`CAMERA_MASK`](crate::channels::CAMERA_MASK).
        cameras: u32,
        /// LED lines, a subset of [`LED_MASK`](crate::channels::LED_MASK).
        leds: u32,
        /// From the camera's trigger to light on.
        lead: u32,
        /// How long the light is on.
        pulse: u32,
        /// From light off to the end of the camera's trigger, which ends the instruction.
        hold: u32,
    },
    /// What to do when something goes wrong, from here on. Without it: [`Policy::DEFAULT`].
    Policy(Policy),
}

/// What to do when something goes wrong. Every way but [`Reaction::Continue`] ends in the safe state,
/// faulted, with tick, instruction and cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Policy {
    /// The host is lost when it has said nothing for so many milliseconds; 0: never.
    pub host_timeout_ms: u32,
    /// The host is lost.
    pub host_loss: Reaction,
    /// The interlock opens; [`Reaction::Continue`] is not allowed.
    pub interlock: Reaction,
    /// A stream runs dry; [`Reaction::Continue`] is not allowed.
    pub underrun: Reaction,
}

impl Policy {
    /// No host is needed; everything else goes safe at once.
    pub const DEFAULT: Self = Self {
        host_timeout_ms: 0,
        host_loss: Reaction::Continue,
        interlock: Reaction::Safe,
        underrun: Reaction::Safe,
    };
}

/// A way to react. Append-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reaction {
    /// Outputs safe at once.
    Safe,
    /// Lights and camera triggers off at once, a move under way is finished, then outputs safe.
    FinishMove,
    /// Go on as if nothing had happened.
    Continue,
}

/// What counts as a trigger. Append-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Condition {
    /// Low to high.
    Rising,
    /// High to low.
    Falling,
    /// High, also if it is so already.
    High,
    /// Low, also if it is so already.
    Low,
}

/// What to do when no trigger came in time. Append-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Timeout {
    /// Outputs safe, faulted.
    Fault,
    /// Go on with the next instruction, at the tick at which time ran out.
    Continue,
    /// End the program as [`Instruction::Stop`] does.
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

/// Longest encoding of one instruction in bytes (`Capture`: 2 + 10 · 5).
pub const MAX_INSTRUCTION_BYTES: usize = 52;

/// An encoded program.
pub type ProgramBytes = heapless::Vec<u8, MAX_PROGRAM_BYTES>;

/// The bytes do not hold an instruction (or only its beginning).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Undecodable;

impl core::fmt::Display for Undecodable {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the bytes do not hold an instruction")
    }
}

impl core::error::Error for Undecodable {}

/// Encodes one instruction.
pub fn encode_instruction(instruction: &Instruction) -> heapless::Vec<u8, MAX_INSTRUCTION_BYTES> {
    // The buffer holds the longest instruction; `tests/golden.rs` checks that constant.
    let mut buffer = [0; MAX_INSTRUCTION_BYTES];
    let used: &[u8] = postcard::to_slice(instruction, &mut buffer).map_or(&[], |used| used);
    heapless::Vec::from_slice(used).unwrap_or_default()
}

/// Encodes a program.
///
/// # Errors
/// [`TooLarge`] if it exceeds [`MAX_PROGRAM_BYTES`].
pub fn encode<'a>(instructions: impl IntoIterator<Item = &'a Instruction>) -> Result<ProgramBytes, TooLarge> {
    let mut bytes = ProgramBytes::new();
    for instruction in instructions {
        bytes.extend_from_slice(&encode_instruction(instruction)).map_err(|_| TooLarge)?;
    }
    Ok(bytes)
}

/// Decodes the instruction at the start of `bytes`; returns it and its length.
///
/// # Errors
/// [`Undecodable`] if there is none.
pub fn decode_instruction(bytes: &[u8]) -> Result<(Instruction, usize), Undecodable> {
    let (instruction, rest) = postcard::take_from_bytes(bytes).map_err(|_| Undecodable)?;
    Ok((instruction, bytes.len().saturating_sub(rest.len())))
}

/// Decodes a program; ends after the last byte or after the first error.
pub fn decode(bytes: &[u8]) -> Decode<'_> {
    Decode { rest: bytes, offset: 0 }
}

/// Iterator over the instructions of an encoded program with their byte offsets.
#[derive(Debug, Clone)]
pub struct Decode<'a> {
    rest: &'a [u8],
    offset: usize,
}

impl Iterator for Decode<'_> {
    type Item = (usize, Result<Instruction, Undecodable>);

    fn next(&mut self) -> Option<Self::Item> {
        if self.rest.is_empty() {
            return None;
        }
        let offset = self.offset;
        match decode_instruction(self.rest) {
            Ok((instruction, length)) => {
                self.rest = self.rest.get(length..).unwrap_or(&[]);
                self.offset = offset.saturating_add(length);
                Some((offset, Ok(instruction)))
            }
            Err(error) => {
                self.rest = &[];
                Some((offset, Err(error)))
            }
        }
    }
}

/// Hash of an encoded program: its CRC-32/ISO-HDLC.
pub fn hash(bytes: &[u8]) -> u32 {
    crc32(bytes)
}

/// The same hash of a program that comes in pieces.
#[derive(Clone)]
pub struct Hasher(crc::Digest<'static, u32>);

impl Hasher {
    /// Of nothing yet.
    pub fn new() -> Self {
        Self(CRC.digest())
    }

    /// Adds the next piece.
    pub fn update(&mut self, bytes: &[u8]) {
        self.0.update(bytes);
    }

    /// The hash of all pieces so far.
    pub fn finish(&self) -> u32 {
        self.0.clone().finalize()
    }
}

impl Default for Hasher {
    fn default() -> Self {
        Self::new()
    }
}

impl core::fmt::Debug for Hasher {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "Hasher({:#010x})", self.finish())
    }
}
