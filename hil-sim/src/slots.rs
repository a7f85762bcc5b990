//! Program slots of a simulated box: they outlast its resets, not the process.

use daic_protocol::frame::crc32;
use daic_protocol::limits::MAX_SLOTS;
use daic_protocol::message::{Autostart, SlotError, SlotInfo};
use daic_protocol::program::ProgramBytes;

/// The slots.
#[derive(Debug, Clone)]
pub(crate) struct Slots(Vec<Option<(Vec<u8>, Autostart)>>);

impl Slots {
    pub(crate) fn new(count: u8) -> Self {
        Self(vec![None; usize::from(count).min(MAX_SLOTS)])
    }

    /// Whether one of them starts by a trigger input.
    pub(crate) fn await_input(&self) -> bool {
        self.0.iter().flatten().any(|(_, autostart)| matches!(autostart, Autostart::Input { .. }))
    }

    fn place(&mut self, slot: u8) -> Result<&mut Option<(Vec<u8>, Autostart)>, SlotError> {
        let none = if self.0.is_empty() { SlotError::NoMemory } else { SlotError::NoSuchSlot };
        self.0.get_mut(usize::from(slot)).ok_or(none)
    }

    pub(crate) fn store(&mut self, slot: u8, program: &[u8], autostart: Autostart) -> Result<(), SlotError> {
        *self.place(slot)? = Some((program.to_vec(), autostart));
        Ok(())
    }

    pub(crate) fn fetch(&mut self, slot: u8, program: &mut ProgramBytes) -> Result<(), SlotError> {
        let (bytes, _) = self.place(slot)?.as_ref().ok_or(SlotError::Empty)?;
        program.clear();
        program.extend_from_slice(bytes).map_err(|_| SlotError::Damaged)
    }

    pub(crate) fn erase(&mut self, slot: u8) -> Result<(), SlotError> {
        self.place(slot)?.take().map(drop).ok_or(SlotError::Empty)
    }

    pub(crate) fn list(&self) -> heapless::Vec<SlotInfo, MAX_SLOTS> {
        let used = (0u8..).zip(&self.0).filter_map(|(slot, held)| {
            let (program, autostart) = held.as_ref()?;
            let length = u32::try_from(program.len()).unwrap_or(u32::MAX);
            Some(SlotInfo { slot, length, hash: crc32(program), autostart: *autostart })
        });
        used.collect()
    }
}
