//! Programs that are longer than the memory of the box.

use super::{Link, LinkError};
use daic_protocol::limits::CHUNK_LEN;
use daic_protocol::message::{Request, StreamState};
use daic_protocol::program::{Hasher, Instruction, encode_instruction};

/// Sends a program while it is played, never more than the box has room for.
#[derive(Debug)]
pub struct StreamSender<I> {
    instructions: I,
    /// Encoded and not yet acknowledged.
    waiting: Vec<u8>,
    /// Offset of the first of them.
    offset: u32,
    hasher: Hasher,
    /// The instructions are all encoded.
    exhausted: bool,
    state: StreamState,
}

impl<I: Iterator<Item = Instruction>> StreamSender<I> {
    /// Begins a stream of `instructions` and fills the box; it can be started then.
    ///
    /// # Errors
    /// As [`Link::request`]; [`LinkError::Refused`] names an instruction that breaks a rule.
    pub fn begin(link: &mut Link, instructions: I) -> Result<Self, LinkError> {
        let state = link.stream(&Request::StreamBegin)?;
        let mut sender = Self {
            instructions,
            waiting: Vec::new(),
            offset: 0,
            hasher: Hasher::new(),
            exhausted: false,
            state,
        };
        sender.fill(link)?;
        Ok(sender)
    }

    /// Sends what the box has room for; true when all of it is there.
    ///
    /// # Errors
    /// As [`StreamSender::begin`].
    pub fn fill(&mut self, link: &mut Link) -> Result<bool, LinkError> {
        if self.state.ended {
            return Ok(true);
        }
        self.state = link.stream(&Request::StreamStatus)?;
        loop {
            self.encode();
            let room = usize::try_from(self.state.limit.saturating_sub(self.offset)).unwrap_or(0);
            let length = self.waiting.len().min(room).min(CHUNK_LEN);
            if length == 0 {
                break;
            }
            let data = self.waiting.iter().take(length).copied().collect();
            self.state = link.stream(&Request::StreamWrite { offset: self.offset, data })?;
            self.waiting.drain(..length);
            // At most CHUNK_LEN.
            self.offset = self.offset.saturating_add(length as u32);
        }
        if self.exhausted && self.waiting.is_empty() {
            let request = Request::StreamEnd { length: self.offset, hash: self.hasher.finish() };
            self.state = link.stream(&request)?;
        }
        Ok(self.state.ended)
    }

    fn encode(&mut self) {
        while self.waiting.len() < CHUNK_LEN && !self.exhausted {
            match self.instructions.next() {
                Some(instruction) => {
                    let bytes = encode_instruction(&instruction);
                    self.hasher.update(&bytes);
                    self.waiting.extend_from_slice(&bytes);
                }
                None => self.exhausted = true,
            }
        }
    }

    /// How far the stream was when the box last answered.
    pub fn state(&self) -> StreamState {
        self.state
    }
}
