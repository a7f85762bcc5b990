//! Replies kept, so that a repeated request is answered and not carried out again.

use daic_protocol::frame::MAX_FRAME;
use daic_protocol::limits::REPLY_CACHE;
use daic_protocol::message::Request;
use heapless::{Deque, Vec};

/// Longest reply frame to a request that has an effect: the refusal of an invalid program takes 42.
const EFFECT_FRAME: usize = 64;
/// Replies kept to requests that only read. They are long, and repeating one does no harm.
pub const READ_CACHE: usize = 4;

/// How a request relates to those answered before.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Seen<'a> {
    /// New.
    No,
    /// The same again: this was the reply.
    Repeat(&'a [u8]),
    /// Another request under an id that is still kept.
    IdReused,
}

#[derive(Debug)]
struct Kept<const LEN: usize, const N: usize>(Deque<(u32, u32, Vec<u8, LEN>), N>);

impl<const LEN: usize, const N: usize> Kept<LEN, N> {
    fn find(&self, id: u32) -> Option<(u32, &[u8])> {
        self.0.iter().find(|(i, ..)| *i == id).map(|(_, crc, frame)| (*crc, frame.as_slice()))
    }

    fn keep(&mut self, id: u32, crc: u32, frame: &[u8]) {
        if self.0.is_full() {
            self.0.pop_front();
        }
        if let Ok(frame) = Vec::from_slice(frame) {
            // There is room: one was taken out above.
            let _ = self.0.push_back((id, crc, frame));
        }
    }
}

/// The last [`REPLY_CACHE`] replies to requests that have an effect and the last [`READ_CACHE`] to
/// those that only read, apart, so that polling never pushes an effect out.
#[derive(Debug)]
pub(crate) struct Replies {
    effects: Kept<EFFECT_FRAME, REPLY_CACHE>,
    reads: Kept<MAX_FRAME, READ_CACHE>,
}

impl Replies {
    pub(crate) const fn new() -> Self {
        Self { effects: Kept(Deque::new()), reads: Kept(Deque::new()) }
    }

    pub(crate) fn seen(&self, id: u32, crc: u32) -> Seen<'_> {
        match self.effects.find(id).or_else(|| self.reads.find(id)) {
            None => Seen::No,
            Some((kept, frame)) if kept == crc => Seen::Repeat(frame),
            Some(_) => Seen::IdReused,
        }
    }

    pub(crate) fn keep(&mut self, id: u32, crc: u32, request: &Request, frame: &[u8]) {
        match request {
            Request::Hello => {}
            Request::Status
            | Request::ReadEvents { .. }
            | Request::Clock
            | Request::StreamStatus
            | Request::Inputs
            | Request::Slots
            | Request::SelfTest
            | Request::Health => self.reads.keep(id, crc, frame),
            _ => self.effects.keep(id, crc, frame),
        }
    }
}
