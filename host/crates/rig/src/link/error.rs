//! What can go wrong between host and box.

use daic_protocol::limits::TICK_HZ;
use daic_protocol::message::{Refusal, Rule, SlotError, State};
use std::fmt;
use std::io;
use thiserror::Error;

/// What is known about the effect of a request that did not succeed (a success is `Ok`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The box never received it.
    NotSent,
    /// The box received it, refused it, and changed nothing.
    Refused,
    /// It may or may not have had its effect: ask for the status before going on.
    Unknown,
}

/// Talking to the box failed.
#[derive(Debug, Error)]
pub enum LinkError {
    /// There is no such port.
    #[error("no port {path}; {}", Available(.available))]
    PortAbsent {
        /// The port asked for.
        path: String,
        /// Ports that the system lists.
        available: Vec<String>,
    },
    /// `sim` is not a port.
    #[error(
        "sim is not a port: use `daic simulate` for the simulated rig, or give a serial port or tcp://host:port"
    )]
    SimulatedRig,
    /// Another program has the port.
    #[error("port {path} is in use by another program; close that program, or choose another port")]
    PortBusy {
        /// The port.
        path: String,
    },
    /// A box that says it has more than any box can have.
    #[error(
        "the box says that it has {found} {what}, a box has at most {max}; its firmware is damaged or not ours"
    )]
    BadHello {
        /// Of what.
        what: &'static str,
        /// What it says.
        found: u8,
        /// Most that the protocol knows.
        max: u8,
    },
    /// The system does not open the port.
    #[error("cannot open port {path}: {reason}; check that it is a serial port and that you may use it")]
    PortRefused {
        /// The port.
        path: String,
        /// What the system says.
        reason: String,
    },
    /// Not `tcp://host:port`.
    #[error("{text:?} is not an address; write tcp://host:port, such as tcp://127.0.0.1:7000")]
    BadAddress {
        /// The text given.
        text: String,
    },
    /// Nobody answers at a TCP address.
    #[error("cannot connect to {address}: {source}; check that the box or the simulator is running there")]
    Unreachable {
        /// The address.
        address: String,
        /// Why.
        source: io::Error,
    },
    /// Something answers, but not a daic trigger box.
    #[error(
        "what answers on {port} is not a daic trigger box ({heard} bytes, none of them a valid reply); check the port and its baud rate"
    )]
    NotOurs {
        /// The port.
        port: String,
        /// Bytes heard.
        heard: usize,
    },
    /// A box of another protocol version.
    #[error(
        "the box speaks protocol {theirs}, this program {ours}; install the firmware that came with this program, or the program that fits the firmware ({firmware})"
    )]
    OtherVersion {
        /// Of the box.
        theirs: u16,
        /// Of this program.
        ours: u16,
        /// Firmware version of the box.
        firmware: String,
    },
    /// Same protocol version, other messages.
    #[error(
        "the box's messages ({theirs:#010x}) differ from this program's ({ours:#010x}); install the firmware that came with this program"
    )]
    OtherSchema {
        /// Of the box.
        theirs: u32,
        /// Of this program.
        ours: u32,
    },
    /// No reply, however often asked.
    #[error(
        "the box on {port} does not answer {request} (asked {attempts} times in {after_ms} ms); check its power and cable, then start again"
    )]
    Silent {
        /// The port.
        port: String,
        /// The request.
        request: &'static str,
        /// Time waited in milliseconds.
        after_ms: u64,
        /// Times asked.
        attempts: u32,
    },
    /// The connection broke.
    #[error(
        "the connection to {port} broke during {request}: {source}; check cable and power, then start again"
    )]
    Disconnected {
        /// The port.
        port: String,
        /// The request.
        request: &'static str,
        /// Whether the request was already on its way.
        sent: bool,
        /// Why.
        source: io::Error,
    },
    /// The box has booted anew: program, position and events are gone.
    #[error(
        "the box was reset (boot {before:#010x} became {after:#010x}): its program, position and events are gone; check its power, home the stage, then start again"
    )]
    BoardReset {
        /// Boot id at the beginning.
        before: u32,
        /// Boot id now.
        after: u32,
    },
    /// The box refused a request; nothing changed.
    #[error("the box refused {request}: {}", Refused(.refusal))]
    Refused {
        /// The request.
        request: &'static str,
        /// Why.
        refusal: Refusal,
    },
    /// A reply of the wrong kind.
    #[error("the box answered {request} with {reply}; firmware and program do not fit each other")]
    Unexpected {
        /// The request.
        request: &'static str,
        /// The reply.
        reply: &'static str,
    },
    /// A request does not fit a frame.
    #[error("{request} does not fit a frame of the wire")]
    TooLarge {
        /// The request.
        request: &'static str,
    },
    /// A program that the box cannot hold.
    #[error("the program has {length} bytes, the box holds {max}; shorten the sequence, or use repeat")]
    ProgramTooLong {
        /// Bytes of the program.
        length: usize,
        /// Bytes that fit.
        max: usize,
    },
    /// Events were overwritten before they were read.
    #[error(
        "events {from} to {to} were lost: the box overwrote them before they were read; slow the sequence down"
    )]
    EventsLost {
        /// First event lost.
        from: u32,
        /// Last event lost.
        to: u32,
    },
    /// Events came with a wrong number.
    #[error("event {found} came where {expected} was due; firmware and program do not fit each other")]
    EventsOutOfOrder {
        /// Number due.
        expected: u32,
        /// Number found.
        found: u32,
    },
}

impl LinkError {
    /// What is known about the effect of the request.
    pub fn outcome(&self) -> Outcome {
        match self {
            Self::Refused { .. } => Outcome::Refused,
            Self::Silent { .. }
            | Self::BoardReset { .. }
            | Self::Unexpected { .. }
            | Self::EventsLost { .. }
            | Self::EventsOutOfOrder { .. }
            | Self::Disconnected { sent: true, .. } => Outcome::Unknown,
            Self::Disconnected { sent: false, .. }
            | Self::PortAbsent { .. }
            | Self::SimulatedRig
            | Self::PortBusy { .. }
            | Self::PortRefused { .. }
            | Self::BadAddress { .. }
            | Self::Unreachable { .. }
            | Self::NotOurs { .. }
            | Self::OtherVersion { .. }
            | Self::OtherSchema { .. }
            | Self::BadHello { .. }
            | Self::TooLarge { .. }
            | Self::ProgramTooLong { .. } => Outcome::NotSent,
        }
    }

    /// Whether the input (experiment, address) is to blame rather than the rig.
    pub fn is_input(&self) -> bool {
        matches!(
            self,
            Self::BadAddress { .. }
                | Self::SimulatedRig
                | Self::ProgramTooLong { .. }
                | Self::Refused { refusal: Refusal::Invalid(_) | Refusal::ProgramTooLong { .. }, .. }
        )
    }
}

struct Available<'a>(&'a [String]);

impl fmt::Display for Available<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() {
            f.write_str("the system lists no serial port: plug the box in, give tcp://host:port, or use `daic simulate` for the simulated rig")
        } else {
            write!(
                f,
                "the system lists {}; choose one of them or tcp://host:port, or use `daic simulate` for the simulated rig",
                self.0.join(", ")
            )
        }
    }
}

struct Refused<'a>(&'a Refusal);

impl fmt::Display for Refused<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Refusal::WrongState { state } => {
                write!(f, "not possible while it is {}", state_name(*state))?;
                if *state == State::Faulted {
                    f.write_str("; clear the fault first")?;
                }
                Ok(())
            }
            Refusal::ProgramTooLong { length, max } => {
                write!(f, "the program has {length} bytes, {max} fit; shorten the sequence, or use repeat")
            }
            Refusal::BadChunk { index, length, expected } => {
                write!(f, "chunk {index} has {length} bytes, {expected} were expected")
            }
            Refusal::ChunkChanged { index } => write!(f, "chunk {index} came again with other content"),
            Refusal::ChunkMissing { index } => write!(f, "chunk {index} is missing"),
            Refusal::NotStaging => f.write_str("no program is being loaded"),
            Refusal::LengthDiffers { begun, committed } => {
                write!(f, "{begun} bytes were announced, {committed} committed")
            }
            Refusal::HashDiffers { computed, given } => {
                write!(f, "the program's hash is {computed:#010x}, not {given:#010x}")
            }
            Refusal::Invalid(v) if v.rule == Rule::CannotProve => {
                let rule = u8::try_from(v.value).ok().and_then(|n| postcard::from_bytes::<Rule>(&[n]).ok());
                let rule = rule.map_or_else(|| format!("rule {}", v.value), |rule| format!("{rule:?}"));
                write!(
                    f,
                    "at instruction {} the box cannot prove that the rule {rule} holds: it depends on inputs or on where the stage stands, and the program is too long to be played out ({} instructions); shorten loops, give waits a time-out, or begin with a move",
                    v.instruction, v.limit
                )
            }
            Refusal::Invalid(v) => write!(
                f,
                "instruction {} breaks the rule {:?}: {} where the limit is {}; change the sequence",
                v.instruction, v.rule, v.value, v.limit
            ),
            Refusal::IdReused => f.write_str("the request id was used before for another request"),
            Refusal::NotStreaming => f.write_str("no stream has begun, or the box cannot stream"),
            Refusal::StreamGap { expected, given } => {
                write!(f, "byte {expected} of the stream was expected, byte {given} came")
            }
            Refusal::StreamFull { limit, end } => {
                write!(f, "the stream may go to byte {limit} so far, not to {end}")
            }
            Refusal::StreamEnded { length } => {
                write!(f, "the stream holds {length} bytes of instructions, and is complete or empty")
            }
            Refusal::InterlockOpen => f.write_str("the interlock is open; close it first"),
            Refusal::NotHomed { axis } => {
                write!(f, "axis {axis} does not know where it is; home it first (`daic rig home`)")
            }
            Refusal::Cooling { led, ticks } => {
                let ms = *ticks as f64 * 1e3 / f64::from(TICK_HZ);
                write!(f, "LED {led} must cool for {ms:.1} ms after what it has done; wait and start again")
            }
            Refusal::Slot { slot, error } => write!(f, "slot {slot}: {}", slot_error(*error)),
        }
    }
}

fn slot_error(error: SlotError) -> &'static str {
    match error {
        SlotError::NoMemory => "the box has no permanent memory",
        SlotError::NoSuchSlot => "there is no such slot",
        SlotError::Empty => "nothing is stored there",
        SlotError::Damaged => "what is stored there is damaged; store the program again",
        SlotError::WriteFailed => "it could not be written; try again, then another slot",
    }
}

/// Name of a state in messages.
pub(crate) fn state_name(state: State) -> &'static str {
    match state {
        State::Empty => "empty",
        State::Loaded => "loaded",
        State::Armed => "armed",
        State::Running => "running",
        State::Faulted => "faulted",
    }
}
