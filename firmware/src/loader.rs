//! Staged loading: a program is complete and valid before it replaces the old one.

use crate::board::Board;
use crate::stream::{Source, Stream};
use crate::verifier::{self, Checker};
use daic_protocol::limits::{CHUNK_LEN, MAX_PROGRAM_BYTES, STREAM_BYTES};
use daic_protocol::message::Refusal;
use daic_protocol::program::{self, ProgramBytes};

/// One bit per chunk received.
type ChunkSet = u128;
const _: () = assert!(MAX_PROGRAM_BYTES.div_ceil(CHUNK_LEN) <= ChunkSet::BITS as usize);

/// The committed program and the one being received: staged whole, or streamed.
#[derive(Debug)]
pub(crate) struct Loader {
    live: ProgramBytes,
    hash: Option<u32>,
    staged: ProgramBytes,
    staging: Option<ChunkSet>,
    /// The stream whose ring is `staged`.
    stream: Option<Stream>,
}

impl Loader {
    pub(crate) const fn new() -> Self {
        Self {
            live: ProgramBytes::new(),
            hash: None,
            staged: ProgramBytes::new(),
            staging: None,
            stream: None,
        }
    }

    /// Hash of the committed program.
    pub(crate) fn hash(&self) -> Option<u32> {
        self.hash
    }

    /// The committed program.
    pub(crate) fn program(&self) -> &[u8] {
        &self.live
    }

    /// What is played: the stream if there is one, else the committed program.
    pub(crate) fn source(&mut self) -> Source<'_> {
        match &mut self.stream {
            Some(stream) => Source::Stream(stream, &self.staged),
            None => Source::Stored(&self.live),
        }
    }

    /// What is played, for one who reads ahead.
    pub(crate) fn source_ahead(&self) -> Source<'_> {
        match &self.stream {
            Some(stream) => Source::Ahead(stream, &self.staged),
            None => Source::Stored(&self.live),
        }
    }

    /// The stream takes nothing any more.
    pub(crate) fn seal_stream(&mut self) {
        if let Some(stream) = &mut self.stream {
            stream.seal();
        }
    }

    /// The stream, if there is one.
    pub(crate) fn stream(&self) -> Option<&Stream> {
        self.stream.as_ref()
    }

    /// Begins a stream; drops what was staged.
    pub(crate) fn begin_stream(&mut self, checker: Checker, homed: u8) {
        self.staging = None;
        self.staged.clear();
        // It is as long as its capacity.
        let _ = self.staged.resize(STREAM_BYTES, 0);
        self.stream = Some(Stream::new(checker, homed));
    }

    /// Forgets the stream.
    pub(crate) fn end_stream(&mut self) {
        if self.stream.take().is_some() {
            self.staged.clear();
        }
    }

    pub(crate) fn write_stream(
        &mut self,
        offset: u32,
        data: &[u8],
        board: &Board,
        played: Option<u64>,
    ) -> Result<(), Refusal> {
        let stream = self.stream.as_mut().ok_or(Refusal::NotStreaming)?;
        stream.write(offset, data, &mut self.staged, board, played)
    }

    pub(crate) fn close_stream(&mut self, length: u32, hash: u32) -> Result<(), Refusal> {
        self.stream.as_mut().ok_or(Refusal::NotStreaming)?.end(length, hash)
    }

    /// Takes a program from elsewhere, verified as at commit; what was staged is dropped.
    pub(crate) fn take(
        &mut self,
        board: &Board,
        fetch: impl FnOnce(&mut ProgramBytes) -> Result<(), Refusal>,
    ) -> Result<(), Refusal> {
        (self.staging, self.stream) = (None, None);
        self.staged.clear();
        fetch(&mut self.staged)?;
        verifier::verify(&self.staged, board).map_err(Refusal::Invalid)?;
        self.replace();
        self.hash = Some(program::hash(&self.live));
        self.staged.clear();
        Ok(())
    }

    /// A program is being loaded.
    pub(crate) fn is_staging(&self) -> bool {
        self.staging.is_some()
    }

    pub(crate) fn begin(&mut self, length: u32) -> Result<(), Refusal> {
        let too_long = Refusal::ProgramTooLong { length, max: MAX_PROGRAM_BYTES as u32 };
        let bytes = usize::try_from(length).map_err(|_| too_long)?;
        if bytes > MAX_PROGRAM_BYTES {
            return Err(too_long);
        }
        self.stream = None;
        self.staged.clear();
        self.staged.resize(bytes, 0).map_err(|_| too_long)?;
        self.staging = Some(0);
        Ok(())
    }

    pub(crate) fn chunk(&mut self, index: u16, data: &[u8]) -> Result<(), Refusal> {
        let received = self.staging.as_mut().ok_or(Refusal::NotStaging)?;
        let length = u16::try_from(data.len()).unwrap_or(u16::MAX);
        let place = self.staged.chunks_mut(CHUNK_LEN).nth(usize::from(index));
        let expected = place.as_ref().map_or(0, |p| p.len());
        let place = place.filter(|p| p.len() == data.len()).ok_or(Refusal::BadChunk {
            index,
            length,
            expected: u16::try_from(expected).unwrap_or(u16::MAX),
        })?;
        // A chunk that exists has an index below the number of bits.
        let bit: ChunkSet = 1u128.checked_shl(u32::from(index)).unwrap_or(0);
        if *received & bit != 0 {
            return if place == data { Ok(()) } else { Err(Refusal::ChunkChanged { index }) };
        }
        place.copy_from_slice(data);
        *received |= bit;
        Ok(())
    }

    pub(crate) fn commit(&mut self, length: u32, hash: u32, board: &Board) -> Result<(), Refusal> {
        let received = self.staging.ok_or(Refusal::NotStaging)?;
        let begun = u32::try_from(self.staged.len()).unwrap_or(u32::MAX);
        if begun != length {
            return Err(Refusal::LengthDiffers { begun, committed: length });
        }
        let missing = u16::try_from(received.trailing_ones()).unwrap_or(u16::MAX);
        if usize::from(missing) < self.staged.len().div_ceil(CHUNK_LEN) {
            return Err(Refusal::ChunkMissing { index: missing });
        }
        let computed = program::hash(&self.staged);
        if computed != hash {
            return Err(Refusal::HashDiffers { computed, given: hash });
        }
        verifier::verify(&self.staged, board).map_err(Refusal::Invalid)?;
        self.replace();
        self.hash = Some(hash);
        self.abort();
        Ok(())
    }

    /// What is staged becomes the program. Copied in place: swapped they would need room for both on the stack.
    fn replace(&mut self) {
        self.live.clear();
        // Both have the same capacity.
        let _ = self.live.extend_from_slice(&self.staged);
    }

    pub(crate) fn abort(&mut self) {
        if self.staging.take().is_some() {
            self.staged.clear();
        }
    }
}
