//! Consistent overhead byte stuffing, one byte at a time.
//!
//! A block is a code byte `c` followed by `c - 1` bytes that are not zero; it stands for those
//! bytes and one zero, except that a block with `c = 255` and the last block stand for no zero.
//! Written here rather than taken from a crate because a byte-wise decoder that can be cloned,
//! never indexes and reports the early end of a block is thirty lines.

/// What one byte (never 0x00) of an encoded stream stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Step {
    /// Nothing: a code byte that follows no zero.
    Nothing,
    /// A byte of the payload.
    Byte(u8),
}

/// State of the decoder inside a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Decoder {
    /// Bytes still to come in this block.
    remaining: u8,
    /// Whether a zero stands between this block and the next.
    zero: bool,
    /// Whether any byte of the frame has been seen.
    started: bool,
}

impl Decoder {
    pub(crate) const fn new() -> Self {
        Self { remaining: 0, zero: false, started: false }
    }

    /// No byte since the delimiter.
    pub(crate) const fn is_empty(&self) -> bool {
        !self.started
    }

    /// A frame may end here: no block is incomplete.
    pub(crate) const fn is_complete(&self) -> bool {
        self.remaining == 0
    }

    /// Takes one byte of the frame, not its delimiter.
    pub(crate) fn feed(&mut self, byte: u8) -> Step {
        if let Some(left) = self.remaining.checked_sub(1) {
            self.remaining = left;
            return Step::Byte(byte);
        }
        let zero = self.zero;
        self.remaining = byte.saturating_sub(1);
        self.zero = byte != u8::MAX;
        self.started = true;
        if zero { Step::Byte(0) } else { Step::Nothing }
    }
}

/// Appends the encoding of `payload`, without delimiter; `Err` if `out` is full.
pub(crate) fn encode<const N: usize>(payload: &[u8], out: &mut heapless::Vec<u8, N>) -> Result<(), u8> {
    let mut rest = payload;
    loop {
        let run = rest.iter().take(254).take_while(|&&b| b != 0).count();
        let (block, tail) = rest.split_at_checked(run).unwrap_or((rest, &[]));
        // `run` is at most 254, so the code fits a byte.
        out.push(u8::try_from(run.saturating_add(1)).unwrap_or(u8::MAX))?;
        out.extend_from_slice(block).map_err(|_| 0u8)?;
        if tail.is_empty() {
            return Ok(());
        }
        rest = if run == 254 { tail } else { tail.get(1..).unwrap_or(&[]) };
    }
}
