//! COBS( header ‖ body ‖ CRC-32 ) 0x00.
//!
//! Header, little-endian, 8 bytes: `version: u8`, `kind: u8` ([`Kind`]), `length: u16` (of the body), `id: u32`.
//! CRC-32/ISO-HDLC over header and body. Receiving order: COBS → length → CRC over the raw bytes →
//! decode → nothing may be left over.

use crate::limits::MAX_BODY;
use crate::message::{Rejected, Reply, Request};

/// Bytes of header and CRC.
pub const OVERHEAD: usize = 12;
/// Largest payload before COBS.
pub const MAX_PAYLOAD: usize = MAX_BODY + OVERHEAD;
/// Largest frame on the wire, delimiter included.
pub const MAX_FRAME: usize = MAX_PAYLOAD + MAX_PAYLOAD / 254 + 2;

/// What a frame holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// A [`Request`].
    Request = 1,
    /// A [`Reply`].
    Reply = 2,
}

/// An encoded frame, delimiter included.
pub type FrameBytes = heapless::Vec<u8, MAX_FRAME>;

/// The message does not fit a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TooLarge;

/// Encodes a request with the id chosen by the host.
pub fn encode_request(id: u32, request: &Request) -> Result<FrameBytes, TooLarge> {
    let _ = (id, request);
    Err(TooLarge)
}

/// Encodes the reply to request `id`.
pub fn encode_reply(id: u32, reply: &Reply) -> Result<FrameBytes, TooLarge> {
    let _ = (id, reply);
    Err(TooLarge)
}

/// One step of an incremental decoder: nothing yet, a message, or a rejection (already counted).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fed<M> {
    /// No complete frame yet (or an empty one).
    Pending,
    /// A valid message.
    Message {
        /// Id from the header.
        id: u32,
        /// CRC of the frame: tells a repeat from another message under the same id.
        crc: u32,
        /// The message.
        message: M,
    },
    /// A frame was rejected; the counter of its cause went up.
    Rejected,
}

/// Incremental decoder; feed it byte by byte, cut the stream anywhere.
#[derive(Debug, Clone)]
pub struct Decoder {
    /// Frames rejected, by cause.
    pub rejected: Rejected,
}

impl Decoder {
    /// A decoder that has seen nothing.
    pub const fn new() -> Self {
        Self { rejected: Rejected { oversized: 0, cobs: 0, length: 0, crc: 0, header: 0, body: 0 } }
    }
    /// Feeds one byte and expects requests (the box's side).
    pub fn feed_request(&mut self, byte: u8) -> Fed<Request> {
        let _ = byte;
        Fed::Pending
    }
    /// Feeds one byte and expects replies (the host's side).
    pub fn feed_reply(&mut self, byte: u8) -> Fed<Reply> {
        let _ = byte;
        Fed::Pending
    }
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}
