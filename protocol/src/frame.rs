//! COBS( header ‖ body ‖ CRC-32 ) 0x00.
//!
//! Header, little-endian, 8 bytes: `version: u8`, `kind: u8` ([`Kind`]), `length: u16` (of the body), `id: u32`.
//! CRC-32/ISO-HDLC over header and body. Receiving order: COBS → length → CRC over the raw bytes →
//! header → decode → nothing may be left over.
//!
//! `version` is [`PROTOCOL_VERSION`]. Frames of another version are refused, with one exception:
//! [`Request::Hello`] and its reply are frozen, so that sides of different versions can tell each
//! other who they are.

use crate::cobs::{self, Step};
use crate::limits::{MAX_BODY, PROTOCOL_VERSION};
use crate::message::{Rejected, Reply, Request};
use serde::{Serialize, de::DeserializeOwned};

/// Bytes of the header.
pub const HEADER_LEN: usize = 8;
/// Bytes of the CRC.
pub const CRC_LEN: usize = 4;
/// Bytes of header and CRC.
pub const OVERHEAD: usize = HEADER_LEN + CRC_LEN;
/// Largest payload before COBS.
pub const MAX_PAYLOAD: usize = MAX_BODY + OVERHEAD;
/// Largest frame on the wire, delimiter included.
pub const MAX_FRAME: usize = MAX_PAYLOAD + MAX_PAYLOAD / 254 + 2;
/// Version byte of the header.
pub const VERSION: u8 = PROTOCOL_VERSION as u8;
const _: () = assert!(PROTOCOL_VERSION < 256, "the header has one byte for the version");

pub(crate) static CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);

/// CRC-32/ISO-HDLC (polynomial 0x04c11db7 reflected, initial value and final xor 0xffffffff).
///
/// The check value, that of the nine ASCII bytes `123456789`, is 0xcbf43926.
pub fn crc32(bytes: &[u8]) -> u32 {
    CRC.checksum(bytes)
}

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

impl core::fmt::Display for TooLarge {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "the message is longer than {MAX_BODY} bytes")
    }
}

impl core::error::Error for TooLarge {}

/// Encodes a request with the id chosen by the host.
///
/// # Errors
/// [`TooLarge`] if the body exceeds [`MAX_BODY`]; no value of [`Request`] does.
pub fn encode_request(id: u32, request: &Request) -> Result<FrameBytes, TooLarge> {
    encode(VERSION, Kind::Request, id, request)
}

/// Encodes the reply to request `id`.
///
/// # Errors
/// [`TooLarge`] if the body exceeds [`MAX_BODY`]: only [`Reply::Events`] can, when it is full of
/// the longest events with the largest numbers.
pub fn encode_reply(id: u32, reply: &Reply) -> Result<FrameBytes, TooLarge> {
    encode(VERSION, Kind::Reply, id, reply)
}

fn encode<T: Serialize>(version: u8, kind: Kind, id: u32, message: &T) -> Result<FrameBytes, TooLarge> {
    let mut body = [0u8; MAX_BODY];
    let body = postcard::to_slice(message, &mut body).map_err(|_| TooLarge)?;
    let length = u16::try_from(body.len()).map_err(|_| TooLarge)?;

    let mut payload = heapless::Vec::<u8, MAX_PAYLOAD>::new();
    let mut put = |bytes: &[u8]| payload.extend_from_slice(bytes).map_err(|_| TooLarge);
    put(&[version, kind as u8])?;
    put(&length.to_le_bytes())?;
    put(&id.to_le_bytes())?;
    put(body)?;
    let crc = crc32(&payload);
    payload.extend_from_slice(&crc.to_le_bytes()).map_err(|_| TooLarge)?;

    let mut frame = FrameBytes::new();
    cobs::encode(&payload, &mut frame).map_err(|_| TooLarge)?;
    frame.push(0).map_err(|_| TooLarge)?;
    Ok(frame)
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
    /// Frames rejected, by cause. They count up and stop at `u32::MAX`.
    pub rejected: Rejected,
    cobs: cobs::Decoder,
    payload: heapless::Vec<u8, MAX_PAYLOAD>,
    /// The frame was too long: everything up to the next delimiter belongs to it.
    discarding: bool,
}

/// Why a frame was rejected; names the fields of [`Rejected`].
#[derive(Debug, Clone, Copy)]
enum Cause {
    Oversized,
    Cobs,
    Length,
    Crc,
    Header,
    Body,
}

/// A message that only differs in version from ours may still be understood.
trait Frozen {
    /// True for what every version, past or future, understands.
    fn is_frozen(&self) -> bool;
}
impl Frozen for Request {
    fn is_frozen(&self) -> bool {
        matches!(self, Request::Hello)
    }
}
impl Frozen for Reply {
    fn is_frozen(&self) -> bool {
        matches!(self, Reply::Hello(_))
    }
}

impl Decoder {
    /// A decoder that has seen nothing.
    pub const fn new() -> Self {
        Self {
            rejected: Rejected { oversized: 0, cobs: 0, length: 0, crc: 0, header: 0, body: 0 },
            cobs: cobs::Decoder::new(),
            payload: heapless::Vec::new(),
            discarding: false,
        }
    }

    /// Feeds one byte and expects requests (the box's side).
    pub fn feed_request(&mut self, byte: u8) -> Fed<Request> {
        self.feed(byte, Kind::Request)
    }

    /// Feeds one byte and expects replies (the host's side).
    pub fn feed_reply(&mut self, byte: u8) -> Fed<Reply> {
        self.feed(byte, Kind::Reply)
    }

    /// Forgets a frame that has begun (for a link that was opened anew); the counters stay.
    pub fn restart(&mut self) {
        self.cobs = cobs::Decoder::new();
        self.payload.clear();
        self.discarding = false;
    }

    fn feed<M: DeserializeOwned + Frozen>(&mut self, byte: u8, kind: Kind) -> Fed<M> {
        if byte != 0 {
            if self.discarding {
                return Fed::Pending;
            }
            if let Step::Byte(b) = self.cobs.feed(byte)
                && self.payload.push(b).is_err()
            {
                self.discarding = true;
                return self.reject(Cause::Oversized);
            }
            return Fed::Pending;
        }
        if self.discarding || self.cobs.is_empty() {
            self.restart();
            return Fed::Pending;
        }
        let result = if self.cobs.is_complete() { open(&self.payload, kind) } else { Err(Cause::Cobs) };
        self.restart();
        match result {
            Ok((id, crc, message)) => Fed::Message { id, crc, message },
            Err(cause) => self.reject(cause),
        }
    }

    fn reject<M>(&mut self, cause: Cause) -> Fed<M> {
        let counter = match cause {
            Cause::Oversized => &mut self.rejected.oversized,
            Cause::Cobs => &mut self.rejected.cobs,
            Cause::Length => &mut self.rejected.length,
            Cause::Crc => &mut self.rejected.crc,
            Cause::Header => &mut self.rejected.header,
            Cause::Body => &mut self.rejected.body,
        };
        *counter = counter.saturating_add(1);
        Fed::Rejected
    }
}

/// Checks a payload from the outside in; nothing is decoded before the CRC is right.
fn open<M: DeserializeOwned + Frozen>(payload: &[u8], kind: Kind) -> Result<(u32, u32, M), Cause> {
    let (&[version, kind_found, l0, l1, i0, i1, i2, i3], rest) =
        payload.split_first_chunk().ok_or(Cause::Length)?;
    let (body, &crc) = rest.split_last_chunk::<CRC_LEN>().ok_or(Cause::Length)?;
    if body.len() != usize::from(u16::from_le_bytes([l0, l1])) {
        return Err(Cause::Length);
    }
    let checked = payload.split_last_chunk::<CRC_LEN>().map_or(payload, |(head, _)| head);
    let crc = u32::from_le_bytes(crc);
    if crc32(checked) != crc {
        return Err(Cause::Crc);
    }
    if kind_found != kind as u8 {
        return Err(Cause::Header);
    }
    let decoded = postcard::take_from_bytes::<M>(body);
    if version != VERSION && !matches!(&decoded, Ok((m, [])) if m.is_frozen()) {
        return Err(Cause::Header);
    }
    match decoded {
        Ok((message, [])) => Ok((u32::from_le_bytes([i0, i1, i2, i3]), crc, message)),
        _ => Err(Cause::Body),
    }
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crc_has_the_published_check_value() {
        assert_eq!(crc32(b"123456789"), 0xcbf4_3926);
    }

    /// A frame of a version this crate does not speak.
    fn foreign<T: Serialize>(kind: Kind, message: &T) -> FrameBytes {
        encode(VERSION + 1, kind, 9, message).unwrap()
    }

    #[test]
    fn another_version_is_refused_but_for_hello() {
        let feed = |frame: &FrameBytes| {
            let mut d = Decoder::new();
            let last = frame.iter().map(|&b| d.feed_request(b)).last().unwrap();
            (last, d.rejected)
        };
        let (fed, rejected) = feed(&foreign(Kind::Request, &Request::Status));
        assert_eq!((fed, rejected.header), (Fed::Rejected, 1));
        let (fed, rejected) = feed(&foreign(Kind::Request, &Request::Hello));
        assert!(matches!(fed, Fed::Message { id: 9, message: Request::Hello, .. }));
        assert_eq!(rejected, Rejected::default());
    }

    #[test]
    fn a_reply_is_no_request() {
        let mut d = Decoder::new();
        let frame = encode_reply(1, &Reply::Clock { tick: 5 }).unwrap();
        assert_eq!(frame.iter().map(|&b| d.feed_request(b)).last(), Some(Fed::Rejected));
        assert_eq!(d.rejected.header, 1);
    }
}
