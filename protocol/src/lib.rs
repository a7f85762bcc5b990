//! Messages, framing and limits shared by the daic trigger box and its host.
//!
//! This crate is the only thing the two sides share. It is `no_std`, allocates nothing, and holds
//! no behaviour beyond encoding: the controller lives in `daic-firmware`, the link in `daic-rig`.
//!
//! * [`frame`]: COBS( header ‖ body ‖ CRC-32 ) 0x00 and its incremental decoder.
//! * [`message`]: requests, replies, events, the frozen [`message::Hello`].
//! * [`program`]: the instruction set of a stored program.
//! * [`channels`]: which bit of the output word drives what.
//! * [`limits`]: sizes both sides agree on.
//!
//! The wire is specified byte by byte in `docs/protocol.md`.
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

pub mod channels;
mod cobs;
pub mod frame;
pub mod limits;
pub mod message;
pub mod program;
