//! Program slots in flash that survive a power failure at any moment.
//!
//! A slot has two areas. A program is written into the one that does not hold the newest, data
//! first, header last: before the header is whole the area is not valid, and the other still is. A
//! slot is emptied older area first, so that an older program never comes back.
//!
//! When a program starts by itself is kept in the tag of its slot ([`tag`], [`autostart`]).

use daic_protocol::frame::crc32;
use daic_protocol::limits::{MAX_PROGRAM_BYTES, MAX_SLOTS};
use daic_protocol::message::{Autostart, SlotError, SlotInfo};
use daic_protocol::program::{Hasher, ProgramBytes};

/// Bytes that are erased at once.
pub const SECTOR: u32 = 4096;
/// Bytes that are programmed at once.
pub const PAGE: usize = 256;
/// Sectors of one area: a header page and the longest program.
pub const AREA_SECTORS: u32 = (PAGE + MAX_PROGRAM_BYTES).div_ceil(SECTOR as usize) as u32;
const AREA: u32 = AREA_SECTORS * SECTOR;

/// "daic slot", first format.
const MAGIC: u32 = 0xda1c_5101;

/// Flash that holds nothing but slots, from offset 0 on.
pub trait Flash {
    /// Reads bytes from `offset` on.
    fn read(&self, offset: u32, into: &mut [u8]);
    /// Sets the sector that begins at `offset` to ones.
    fn erase(&mut self, offset: u32);
    /// Clears those bits of the page that begins at `offset` that are zero in `page`.
    fn program(&mut self, offset: u32, page: &[u8; PAGE]);
}

/// What a slot holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stored {
    /// Bytes of the program.
    pub length: u32,
    /// Hash of the program.
    pub hash: u32,
    /// Whatever was stored with it.
    pub tag: [u8; 4],
    sequence: u32,
    area: u32,
}

/// Bytes of flash that `slots` slots take.
pub const fn size(slots: u8) -> u32 {
    (slots as u32).saturating_mul(2).saturating_mul(AREA)
}

/// Slots in a flash.
#[derive(Debug)]
pub struct Slots<F> {
    flash: F,
    count: u8,
}

impl<F: Flash> Slots<F> {
    /// `count` slots in `flash`, which has room for [`size`]`(count)` bytes.
    pub const fn new(flash: F, count: u8) -> Self {
        Self { flash, count }
    }

    /// The flash itself.
    pub fn flash(&mut self) -> &mut F {
        &mut self.flash
    }

    /// What the slot holds.
    ///
    /// # Errors
    /// [`SlotError::NoSuchSlot`], [`SlotError::Empty`].
    pub fn stored(&self, slot: u8) -> Result<Stored, SlotError> {
        let [a, b] = self.areas(slot)?;
        match (self.valid(a), self.valid(b)) {
            (Some(a), Some(b)) => Ok(if is_newer(b.sequence, a.sequence) { b } else { a }),
            (Some(one), None) | (None, Some(one)) => Ok(one),
            (None, None) => Err(SlotError::Empty),
        }
    }

    /// Copies the program of a slot into `program`.
    ///
    /// # Errors
    /// [`SlotError::NoSuchSlot`], [`SlotError::Empty`], [`SlotError::Damaged`].
    pub fn load(&self, slot: u8, program: &mut ProgramBytes) -> Result<Stored, SlotError> {
        let stored = self.stored(slot)?;
        let length = usize::try_from(stored.length).map_err(|_| SlotError::Damaged)?;
        program.clear();
        program.resize(length, 0).map_err(|_| SlotError::Damaged)?;
        self.flash.read(stored.area.saturating_add(PAGE as u32), program);
        if crc32(program) == stored.hash { Ok(stored) } else { Err(SlotError::Damaged) }
    }

    /// What the slots hold, empty ones left out.
    pub fn list(&self) -> heapless::Vec<SlotInfo, MAX_SLOTS> {
        let used = (0..self.count).filter_map(|slot| {
            let stored = self.stored(slot).ok()?;
            let (length, hash) = (stored.length, stored.hash);
            Some(SlotInfo { slot, length, hash, autostart: autostart(stored.tag) })
        });
        used.take(MAX_SLOTS).collect()
    }

    /// Replaces the program of a slot; until that is complete the old one stays.
    ///
    /// # Errors
    /// [`SlotError::NoSuchSlot`]; [`SlotError::WriteFailed`], and the old program stays.
    pub fn store(&mut self, slot: u8, program: &[u8], tag: [u8; 4]) -> Result<Stored, SlotError> {
        let [a, b] = self.areas(slot)?;
        let old = self.stored(slot).ok();
        let area = if old.is_some_and(|old| old.area == a) { b } else { a };
        let sequence = old.map_or(0, |old| old.sequence.wrapping_add(1));
        self.erase_area(area);
        let mut at = area.saturating_add(PAGE as u32);
        for chunk in program.chunks(PAGE) {
            let mut page = [0xff; PAGE];
            page.iter_mut().zip(chunk).for_each(|(to, from)| *to = *from);
            self.flash.program(at, &page);
            at = at.saturating_add(PAGE as u32);
        }
        let length = u32::try_from(program.len()).map_err(|_| SlotError::WriteFailed)?;
        let stored = Stored { length, hash: crc32(program), tag, sequence, area };
        if self.sum(&stored) != Some(stored.hash) {
            return Err(SlotError::WriteFailed);
        }
        self.flash.program(area, &header(&stored));
        if self.valid(area) == Some(stored) { Ok(stored) } else { Err(SlotError::WriteFailed) }
    }

    /// Empties a slot.
    ///
    /// # Errors
    /// [`SlotError::NoSuchSlot`], [`SlotError::WriteFailed`].
    pub fn erase(&mut self, slot: u8) -> Result<(), SlotError> {
        let [a, b] = self.areas(slot)?;
        let newest = self.stored(slot).map_or(b, |stored| stored.area);
        for area in [if newest == a { b } else { a }, newest] {
            self.erase_area(area);
        }
        match self.stored(slot) {
            Err(SlotError::Empty) => Ok(()),
            _ => Err(SlotError::WriteFailed),
        }
    }

    fn areas(&self, slot: u8) -> Result<[u32; 2], SlotError> {
        if slot >= self.count {
            return Err(SlotError::NoSuchSlot);
        }
        let first = size(slot);
        Ok([first, first.saturating_add(AREA)])
    }

    /// The header's sector goes first.
    fn erase_area(&mut self, area: u32) {
        for sector in 0..AREA_SECTORS {
            self.flash.erase(area.saturating_add(sector.saturating_mul(SECTOR)));
        }
    }

    /// What the area holds, if header and program are whole.
    fn valid(&self, area: u32) -> Option<Stored> {
        let mut bytes = [0; HEADER];
        self.flash.read(area, &mut bytes);
        let mut words = bytes.chunks_exact(4).map(|w| <[u8; 4]>::try_from(w).unwrap_or_default());
        let mut next = || words.next().map(u32::from_le_bytes);
        let (magic, sequence, length, hash) = (next()?, next()?, next()?, next()?);
        let tag = next()?.to_le_bytes();
        let sum = next()?;
        let stored = Stored { length, hash, tag, sequence, area };
        let whole = magic == MAGIC
            && sum == crc32(bytes.get(..HEADER.saturating_sub(4))?)
            && usize::try_from(length).is_ok_and(|length| length <= MAX_PROGRAM_BYTES)
            && self.sum(&stored)? == hash;
        whole.then_some(stored)
    }

    /// CRC of the program of an area.
    fn sum(&self, stored: &Stored) -> Option<u32> {
        let mut digest = Hasher::new();
        let mut left = usize::try_from(stored.length).ok()?;
        let mut at = stored.area.checked_add(PAGE as u32)?;
        while left > 0 {
            let mut page = [0; PAGE];
            let part = page.get_mut(..left.min(PAGE))?;
            self.flash.read(at, part);
            digest.update(part);
            left = left.saturating_sub(PAGE);
            at = at.checked_add(PAGE as u32)?;
        }
        Some(digest.finish())
    }
}

/// The tag of a program that starts so.
pub const fn tag(autostart: Autostart) -> [u8; 4] {
    match autostart {
        Autostart::Off => [0; 4],
        Autostart::PowerUp => [1, 0, 0, 0],
        Autostart::Input { input } => [2, input, 0, 0],
    }
}

/// How a program with this tag starts.
pub const fn autostart(tag: [u8; 4]) -> Autostart {
    match tag {
        [1, 0, 0, 0] => Autostart::PowerUp,
        [2, input, 0, 0] => Autostart::Input { input },
        _ => Autostart::Off,
    }
}

/// Bytes of a header that count.
const HEADER: usize = 24;

fn header(stored: &Stored) -> [u8; PAGE] {
    let mut page = [0xff; PAGE];
    let words = [MAGIC, stored.sequence, stored.length, stored.hash, u32::from_le_bytes(stored.tag)];
    let bytes = words.iter().flat_map(|word| word.to_le_bytes());
    page.iter_mut().zip(bytes).for_each(|(to, from)| *to = from);
    let sum = crc32(page.get(..HEADER.saturating_sub(4)).unwrap_or(&[]));
    let end = page.iter_mut().skip(HEADER.saturating_sub(4));
    end.zip(sum.to_le_bytes()).for_each(|(to, from)| *to = from);
    page
}

/// `a` comes after `b` on the circle of numbers.
fn is_newer(a: u32, b: u32) -> bool {
    let ahead = a.wrapping_sub(b);
    ahead != 0 && ahead <= i32::MAX as u32
}
