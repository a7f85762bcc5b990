//! Words on a timeline, packed into blocks of fixed size for a player that is fed by DMA.
//!
//! A record is a word and how long it stands. The player takes records back to back, so a block
//! holds an unbroken stretch of time. A long time is cut into several records of the same word:
//! blocks must fill while nothing happens.

use daic_protocol::channels::SAFE_WORD;
use daic_protocol::limits::MIN_STEP_TICKS;

/// Records of a block.
pub const BLOCK: usize = 16;
/// Longest record in ticks (0.25 ms): how far a block reaches when nothing happens is 16 of them.
pub const MAX_HOLD: u32 = 31_250;

const MIN: u64 = MIN_STEP_TICKS as u64;

/// One word and the ticks that it stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Record {
    /// The word.
    pub word: u32,
    /// Ticks that it stands, at least [`MIN_STEP_TICKS`], at most [`MAX_HOLD`] and three.
    pub ticks: u32,
}

/// A block and where it lies on the timeline.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Block {
    /// Records in order.
    pub records: [Record; BLOCK],
    /// Tick at which the last record begins.
    pub last: u64,
    /// Tick at which it ends.
    pub end: u64,
}

/// A word comes before time, or closer to the last one than the player can do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TooClose;

/// Packs words into blocks.
#[derive(Debug)]
pub struct Packer {
    word: u32,
    /// Up to here there are records.
    upto: u64,
    records: heapless::Vec<Record, BLOCK>,
    last: u64,
}

impl Packer {
    /// The safe word stands from `start` on.
    pub const fn new(start: u64) -> Self {
        Self { word: SAFE_WORD, upto: start, records: heapless::Vec::new(), last: start }
    }

    /// Tick up to which there are records, whole blocks or not.
    pub fn upto(&self) -> u64 {
        self.upto
    }

    /// At `tick` the word becomes `word`; full blocks go to `out`.
    ///
    /// # Errors
    /// [`TooClose`] to the word before.
    pub fn word(&mut self, tick: u64, word: u32, out: &mut dyn FnMut(&Block)) -> Result<(), TooClose> {
        let ticks = tick.checked_sub(self.upto).ok_or(TooClose)?;
        if ticks > 0 && ticks < MIN {
            return Err(TooClose);
        }
        self.hold(tick, out);
        self.word = word;
        Ok(())
    }

    /// Nothing happens before `until`: records up to there or a little less.
    pub fn quiet(&mut self, until: u64, out: &mut dyn FnMut(&Block)) {
        // What is left to the next word must be long enough for a record.
        self.hold(until.saturating_sub(MIN), out);
    }

    /// Nothing happens before `until`, and what comes then is not known yet: what there is goes out now, as a
    /// full block that reaches there. False: there is no time for as many records.
    pub fn flush(&mut self, until: u64, out: &mut dyn FnMut(&Block)) -> bool {
        let until = until.saturating_sub(MIN);
        let time = until.saturating_sub(self.upto);
        let left = (BLOCK as u64).saturating_sub(self.records.len() as u64).max(1);
        let most = u64::from(MAX_HOLD);
        let each = time.checked_div(left).unwrap_or(0).min(most);
        if each < MIN {
            return false;
        }
        for _ in 0..left {
            self.push(u32::try_from(each).unwrap_or(MAX_HOLD), out);
        }
        true
    }

    /// The run is over at `tick` and the safe word stands: fills the block, and one more, so that
    /// whatever looks ahead in the player finds the safe word.
    pub fn finish(&mut self, tick: u64, out: &mut dyn FnMut(&Block)) {
        // What is left to the end may be too short for a record; the safe word stands either way.
        self.hold(tick, out);
        self.word = SAFE_WORD;
        let left = BLOCK.saturating_sub(self.records.len());
        for _ in 0..left.saturating_add(BLOCK) {
            self.push(MIN_STEP_TICKS, out);
        }
    }

    /// Records of the word that stands, up to `until`.
    fn hold(&mut self, until: u64, out: &mut dyn FnMut(&Block)) {
        while let Some(left) = until.checked_sub(self.upto).filter(|&left| left >= MIN) {
            let most = u64::from(MAX_HOLD);
            // No remainder that is too short.
            let ticks = if left >= most.saturating_add(MIN) { most } else { left };
            self.push(u32::try_from(ticks).unwrap_or(MAX_HOLD), out);
        }
    }

    fn push(&mut self, ticks: u32, out: &mut dyn FnMut(&Block)) {
        self.last = self.upto;
        self.upto = self.upto.saturating_add(u64::from(ticks));
        // There is room: a full block is handed out below.
        let _ = self.records.push(Record { word: self.word, ticks });
        if let Ok(records) = <[Record; BLOCK]>::try_from(self.records.as_slice()) {
            out(&Block { records, last: self.last, end: self.upto });
            self.records.clear();
        }
    }
}
