//! Slots in flash: power fails at every operation, before, within and after it.

use daic_firmware::slots::{AREA_SECTORS, Flash, PAGE, SECTOR, Slots, Stored, autostart, size, tag};
use daic_protocol::message::{Autostart, SlotError};
use daic_protocol::program::ProgramBytes;

const COUNT: u8 = 3;

/// Flash whose power fails at an operation.
#[derive(Clone)]
struct Fragile {
    bytes: Vec<u8>,
    operations: usize,
    /// Operation that is done to this part only, and nothing after it.
    cut: Option<(usize, f64)>,
    /// Bits that cannot be cleared.
    stuck: Option<usize>,
}

impl Fragile {
    fn new() -> Self {
        // Whatever was there before.
        let bytes = (0..size(COUNT)).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
        Self { bytes, operations: 0, cut: None, stuck: None }
    }

    /// How many of `count` bytes are done.
    fn part(&mut self, count: usize) -> usize {
        let n = self.operations;
        self.operations += 1;
        match self.cut {
            Some((at, part)) if n == at => (count as f64 * part) as usize,
            Some((at, _)) if n > at => 0,
            _ => count,
        }
    }
}

impl Flash for Fragile {
    fn read(&self, offset: u32, into: &mut [u8]) {
        into.copy_from_slice(&self.bytes[offset as usize..][..into.len()]);
    }
    fn erase(&mut self, offset: u32) {
        assert_eq!(offset % SECTOR, 0);
        let part = self.part(SECTOR as usize);
        self.bytes[offset as usize..][..part].fill(0xff);
    }
    fn program(&mut self, offset: u32, page: &[u8; PAGE]) {
        assert_eq!(offset as usize % PAGE, 0);
        let part = self.part(PAGE);
        for (to, from) in self.bytes[offset as usize..].iter_mut().zip(&page[..part]) {
            *to &= from;
        }
        if let Some(stuck) = self.stuck {
            self.bytes[stuck] = 0xff;
        }
    }
}

fn program(seed: u8, length: usize) -> Vec<u8> {
    (0..length).map(|i| (i as u8).wrapping_mul(31).wrapping_add(seed)).collect()
}

fn load(slots: &Slots<Fragile>, slot: u8) -> Result<(Stored, ProgramBytes), SlotError> {
    let mut program = ProgramBytes::new();
    let stored = slots.load(slot, &mut program)?;
    Ok((stored, program))
}

#[test]
fn what_is_stored_is_loaded() {
    let mut slots = Slots::new(Fragile::new(), COUNT);
    for slot in 0..COUNT {
        assert_eq!(load(&slots, slot), Err(SlotError::Empty));
    }
    for (slot, length) in [(0, 1), (1, 16 * 1024), (2, 0), (1, 256), (1, 257)] {
        let bytes = program(slot, length);
        slots.store(slot, &bytes, [slot, 1, 2, 3]).unwrap();
        let (stored, loaded) = load(&slots, slot).unwrap();
        assert_eq!((&loaded[..], stored.tag, stored.length), (&bytes[..], [slot, 1, 2, 3], length as u32));
    }
    assert_eq!(load(&slots, 0).unwrap().1[..], program(0, 1), "slots do not touch one another");
    slots.erase(1).unwrap();
    assert_eq!(load(&slots, 1), Err(SlotError::Empty));
    assert_eq!(load(&slots, COUNT), Err(SlotError::NoSuchSlot));
    assert_eq!(slots.store(COUNT, &[], [0; 4]), Err(SlotError::NoSuchSlot));
    assert_eq!(slots.erase(COUNT), Err(SlotError::NoSuchSlot));
}

/// Every place where power can go while a slot is written, and how far the operation got.
fn cuts(operations: usize) -> impl Iterator<Item = (usize, f64)> {
    (0..operations).flat_map(|operation| [0.0, 0.02, 0.5, 0.99, 1.0].map(|part| (operation, part)))
}

#[test]
fn a_power_failure_leaves_the_old_program_or_the_new() {
    let (old, new) = (program(7, 3000), program(9, 2500));
    let mut prepared = Slots::new(Fragile::new(), COUNT);
    // Both areas are in use, and the one before must never come back.
    prepared.store(1, &program(1, 999), [0; 4]).unwrap();
    prepared.store(1, &old, [1; 4]).unwrap();
    let flash = prepared.flash().clone();

    let mut whole = Slots::new(Fragile { operations: 0, ..flash.clone() }, COUNT);
    whole.store(1, &new, [2; 4]).unwrap();
    let operations = whole.flash().operations;
    assert_eq!(operations, AREA_SECTORS as usize + 2500usize.div_ceil(PAGE) + 1);

    let (mut kept, mut replaced) = (0, 0);
    for (operation, part) in cuts(operations) {
        let cut = Some((operation, part));
        let mut slots = Slots::new(Fragile { operations: 0, cut, ..flash.clone() }, COUNT);
        let said = slots.store(1, &new, [2; 4]);
        // Power is back.
        let bytes = slots.flash().bytes.clone();
        let mut slots = Slots::new(Fragile { bytes, operations: 0, cut: None, stuck: None }, COUNT);
        let (stored, loaded) = load(&slots, 1).unwrap_or_else(|e| panic!("cut {operation} {part}: {e:?}"));
        if loaded[..] == new {
            assert_eq!(stored.tag, [2; 4]);
            replaced += 1;
        } else {
            assert_eq!((&loaded[..], stored.tag), (&old[..], [1; 4]), "cut {operation} {part}");
            assert!(said.is_err(), "cut {operation} {part}: said to be stored");
            kept += 1;
        }
        // And the slot can be written as ever.
        slots.store(1, &new, [3; 4]).unwrap();
        assert_eq!(load(&slots, 1).unwrap().1[..], new);
    }
    // New only if all of the header that counts is written: from half of the last operation on.
    assert_eq!((kept, replaced), (5 * operations - 3, 3));
}

#[test]
fn a_power_failure_while_emptying_never_brings_back_the_program_before() {
    let (old, new) = (program(7, 3000), program(9, 2500));
    let mut prepared = Slots::new(Fragile::new(), COUNT);
    prepared.store(0, &old, [1; 4]).unwrap();
    prepared.store(0, &new, [2; 4]).unwrap();
    let flash = prepared.flash().clone();
    for (operation, part) in cuts(2 * AREA_SECTORS as usize) {
        let cut = Some((operation, part));
        let mut slots = Slots::new(Fragile { operations: 0, cut, ..flash.clone() }, COUNT);
        let _ = slots.erase(0);
        match load(&slots, 0) {
            Ok((_, loaded)) => assert_eq!(loaded[..], new, "cut {operation} {part}"),
            Err(error) => assert_eq!(error, SlotError::Empty),
        }
    }
}

#[test]
fn worn_out_flash_is_noticed_and_the_old_program_stays() {
    let old = program(7, 600);
    let mut slots = Slots::new(Fragile::new(), COUNT);
    slots.store(0, &old, [1; 4]).unwrap();
    // In the data, then in the header of the other area.
    let area = (AREA_SECTORS * SECTOR) as usize;
    for stuck in [area + PAGE + 300, area + 9] {
        slots.flash().stuck = Some(stuck);
        assert_eq!(slots.store(0, &[0; 600], [2; 4]), Err(SlotError::WriteFailed));
        assert_eq!(load(&slots, 0).unwrap().1[..], old);
    }
}

/// The number of the newest wraps.
#[test]
fn many_times() {
    let mut slots = Slots::new(Fragile::new(), 1);
    for n in 0..100u8 {
        slots.store(0, &[n], [n; 4]).unwrap();
        assert_eq!(load(&slots, 0).unwrap().1[..], [n]);
    }
}

#[test]
fn the_list_tells_when_a_program_starts() {
    let mut slots = Slots::new(Fragile::new(), COUNT);
    let kinds = [Autostart::Off, Autostart::PowerUp, Autostart::Input { input: 3 }];
    assert!(slots.list().is_empty());
    for (slot, kind) in (0u8..).zip(kinds) {
        assert_eq!(autostart(tag(kind)), kind);
        slots.store(slot, &program(slot, 100), tag(kind)).unwrap();
    }
    slots.erase(1).unwrap();
    let list: Vec<_> = slots.list().iter().map(|s| (s.slot, s.length, s.autostart)).collect();
    assert_eq!(list, [(0, 100, kinds[0]), (2, 100, kinds[2])]);
}
