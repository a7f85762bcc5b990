//! Where a program comes from: memory, or the host while it is played.

use crate::board::Board;
use crate::player::unhomed;
use crate::verifier::{Checker, violation};
use daic_protocol::limits::STREAM_BYTES;
use daic_protocol::message::{Refusal, Rule, StreamState, Violation};
use daic_protocol::program::{Hasher, Instruction, MAX_INSTRUCTION_BYTES, ProgramBytes, decode_instruction};

/// What is found at an offset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fetched {
    /// An instruction and its length.
    Instruction(Instruction, usize),
    /// The end of the program.
    End,
    /// Nothing, and nothing will come in time.
    Dry,
    /// Nothing yet.
    Later,
    /// No instruction.
    Broken,
}

/// The program that is played.
#[derive(Debug)]
pub(crate) enum Source<'a> {
    /// All of it.
    Stored(&'a [u8]),
    /// What has come so far, and the ring it is in.
    Stream(&'a mut Stream, &'a ProgramBytes),
    /// The same for one who reads ahead of the player.
    Ahead(&'a Stream, &'a ProgramBytes),
}

impl Source<'_> {
    pub(crate) fn fetch(&self, offset: usize) -> Fetched {
        match self {
            Self::Stored(program) => match program.get(offset..) {
                Some([]) => Fetched::End,
                Some(rest) => decoded(rest),
                None => Fetched::Broken,
            },
            Self::Stream(stream, ring) => stream.fetch(offset, ring),
            Self::Ahead(stream, ring) => match stream.fetch(offset, ring) {
                Fetched::Dry if !stream.sealed => Fetched::Later,
                fetched => fetched,
            },
        }
    }

    /// Everything before `end` has been taken; `begun` instructions have begun.
    pub(crate) fn consume(&mut self, end: usize, begun: u32) {
        if let Self::Stream(stream, _) = self {
            stream.consumed = u32::try_from(end).unwrap_or(u32::MAX);
            stream.begun = begun;
        }
    }
}

fn decoded(bytes: &[u8]) -> Fetched {
    decode_instruction(bytes).map_or(Fetched::Broken, |(i, length)| Fetched::Instruction(i, length))
}

/// A program that comes while it is played. Every instruction is checked before it is taken in.
#[derive(Debug, Clone)]
pub(crate) struct Stream {
    /// Bytes received, of them in whole instructions that were checked, of them begun.
    received: u32,
    checked: u32,
    consumed: u32,
    instructions: u32,
    begun: u32,
    ended: bool,
    /// What comes now comes too late.
    sealed: bool,
    hasher: Hasher,
    checker: Checker,
    /// Axes that know where they are once what was checked has been played.
    homed: u8,
    min_lead: u64,
}

/// Copies what stands in the ring at an absolute offset, up to `end`.
fn gather(ring: &ProgramBytes, offset: u32, end: u32) -> heapless::Vec<u8, MAX_INSTRUCTION_BYTES> {
    let bytes = (offset..end).take(MAX_INSTRUCTION_BYTES);
    bytes.filter_map(|at| ring.get(place(at))).copied().collect()
}

fn place(offset: u32) -> usize {
    usize::try_from(offset).unwrap_or(0).checked_rem(STREAM_BYTES).unwrap_or(0)
}

impl Stream {
    pub(crate) fn new(checker: Checker, homed: u8) -> Self {
        Self {
            received: 0,
            checked: 0,
            consumed: 0,
            instructions: 0,
            begun: 0,
            ended: false,
            sealed: false,
            hasher: Hasher::new(),
            checker,
            homed,
            min_lead: u64::MAX,
        }
    }

    fn fetch(&self, offset: usize, ring: &ProgramBytes) -> Fetched {
        let Ok(offset) = u32::try_from(offset) else { return Fetched::Broken };
        if offset < self.checked {
            decoded(&gather(ring, offset, self.checked))
        } else if self.ended {
            Fetched::End
        } else {
            Fetched::Dry
        }
    }

    fn limit(&self) -> u32 {
        self.consumed.saturating_add(STREAM_BYTES as u32)
    }

    pub(crate) fn hash(&self) -> u32 {
        self.hasher.finish()
    }

    /// Takes nothing any more: the run ends with what there is.
    pub(crate) fn seal(&mut self) {
        self.sealed = true;
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.checked == 0
    }

    pub(crate) fn min_lead(&self) -> u64 {
        self.min_lead
    }

    /// Ticks of program received that lie after `played` ticks of playing.
    fn lead(&self, played: u64) -> u64 {
        self.checker.shortest().saturating_sub(played)
    }

    /// How far it is, `played` ticks after its begin (0 before).
    pub(crate) fn state(&self, played: u64) -> StreamState {
        StreamState {
            received: self.received,
            consumed: self.consumed,
            limit: self.limit(),
            lead: self.lead(played),
            min_lead: self.min_lead,
            instruction: self.begun,
            ended: self.ended,
        }
    }

    pub(crate) fn write(
        &mut self,
        offset: u32,
        data: &[u8],
        ring: &mut ProgramBytes,
        board: &Board,
        played: Option<u64>,
    ) -> Result<(), Refusal> {
        let Some(known) = self.received.checked_sub(offset) else {
            return Err(Refusal::StreamGap { expected: self.received, given: offset });
        };
        let limit = self.limit();
        let length = u32::try_from(data.len()).unwrap_or(u32::MAX);
        let end = offset.checked_add(length).ok_or(Refusal::StreamFull { limit, end: u32::MAX })?;
        let fresh = usize::try_from(known).ok().and_then(|known| data.get(known..)).unwrap_or(&[]);
        if fresh.is_empty() {
            return Ok(());
        }
        if self.ended || self.sealed {
            return Err(Refusal::StreamEnded { length: self.checked });
        }
        if end > limit {
            return Err(Refusal::StreamFull { limit, end });
        }
        // Beyond what counts as received nobody looks.
        for (at, byte) in (self.received..end).zip(fresh) {
            if let Some(b) = ring.get_mut(place(at)) {
                *b = *byte;
            }
        }
        let (mut checker, mut checked, mut instructions) =
            (self.checker.clone(), self.checked, self.instructions);
        let mut homed = self.homed;
        while checked < end {
            let bytes = gather(ring, checked, end);
            let index = u16::try_from(instructions).unwrap_or(u16::MAX);
            let Ok((instruction, length)) = decode_instruction(&bytes) else {
                if bytes.len() >= MAX_INSTRUCTION_BYTES {
                    return Err(Refusal::Invalid(self.undecodable()));
                }
                break;
            };
            checker.take(index, &instruction, board).map_err(Refusal::Invalid)?;
            if let Some(axis) = unhomed(&mut homed, &instruction) {
                return Err(Refusal::NotHomed { axis });
            }
            checked = checked.saturating_add(u32::try_from(length).unwrap_or(0));
            instructions = instructions.saturating_add(1);
        }
        // What there was when these bytes came.
        if let Some(played) = played {
            self.min_lead = self.min_lead.min(self.lead(played));
        }
        (self.checker, self.checked, self.instructions) = (checker, checked, instructions);
        self.homed = homed;
        self.received = end;
        self.hasher.update(fresh);
        Ok(())
    }

    fn undecodable(&self) -> Violation {
        let index = u16::try_from(self.instructions).unwrap_or(u16::MAX);
        violation(index, Rule::Undecodable, i64::from(self.checked), i64::from(self.received))
    }

    pub(crate) fn end(&mut self, length: u32, hash: u32) -> Result<(), Refusal> {
        if length != self.received {
            return Err(Refusal::LengthDiffers { begun: self.received, committed: length });
        }
        let computed = self.hash();
        if hash != computed {
            return Err(Refusal::HashDiffers { computed, given: hash });
        }
        if self.checked != self.received {
            return Err(Refusal::Invalid(self.undecodable()));
        }
        let last = u16::try_from(self.instructions.saturating_sub(1)).unwrap_or(u16::MAX);
        if self.instructions == 0 {
            return Err(Refusal::Invalid(violation(0, Rule::EmptyProgram, 0, 1)));
        }
        self.checker.end(last).map_err(Refusal::Invalid)?;
        self.ended = true;
        Ok(())
    }
}
