//! The end of the flash, which holds program slots.

use crate::reg;
use daic_firmware::pico::SLOTS;
use daic_firmware::slots::{Flash, PAGE, SECTOR, size};
use rp2040_hal::rom_data;

/// Bytes of the flash.
const FLASH: u32 = 2 * 1024 * 1024;
/// Where the slots begin; memory.x keeps the image below.
const BASE: u32 = FLASH - size(SLOTS);
/// Where the flash is read.
const WINDOW: u32 = 0x1000_0000;
/// The watchdog's time, as [`crate::WATCHDOG`]: it counts two a microsecond.
const WATCHDOG_LOAD: u32 = 8_000_000;

const _: () = assert!(size(SLOTS) == 160 * 1024);

/// The flash chip. While it is erased or written nothing else runs; that is only done while no program is played.
pub struct Chip;

fn feed() {
    reg::write(reg::WATCHDOG + 4, WATCHDOG_LOAD);
}

impl Flash for Chip {
    fn read(&self, offset: u32, into: &mut [u8]) {
        for (at, byte) in (WINDOW.wrapping_add(BASE).wrapping_add(offset)..).zip(into) {
            // SAFETY: the flash can be read anywhere; past its end it is mirrored.
            *byte = unsafe { (at as *const u8).read_volatile() };
        }
    }

    fn erase(&mut self, offset: u32) {
        feed();
        change(BASE.wrapping_add(offset), None);
        feed();
    }

    fn program(&mut self, offset: u32, page: &[u8; PAGE]) {
        change(BASE.wrapping_add(offset), Some(page));
        feed();
    }
}

type Call = unsafe extern "C" fn();

/// What the boot ROM has for this.
struct Rom {
    connect: Call,
    exit_xip: Call,
    erase: unsafe extern "C" fn(u32, usize, u32, u8),
    program: unsafe extern "C" fn(u32, *const u8, usize),
    flush: Call,
}

/// The second stage of the boot, which sets up reading again.
#[repr(align(4))]
struct Boot2([u8; 256]);

/// Erases the sector at `offset`, or programs the page there.
fn change(offset: u32, page: Option<&[u8; PAGE]>) {
    let rom = Rom {
        connect: rom_data::connect_internal_flash::ptr(),
        exit_xip: rom_data::flash_exit_xip::ptr(),
        erase: rom_data::flash_range_erase::ptr(),
        program: rom_data::flash_range_program::ptr(),
        flush: rom_data::flash_flush_cache::ptr(),
    };
    let mut boot2 = Boot2([0; 256]);
    for (at, byte) in (WINDOW..).zip(&mut boot2.0) {
        // SAFETY: the flash can be read anywhere.
        *byte = unsafe { (at as *const u8).read_volatile() };
    }
    let data = page.map_or(core::ptr::null(), |page| page.as_ptr());
    // SAFETY: interrupts are off, the other core sleeps, no DMA reads from flash, the range lies beyond the
    // image; `data` is null or a page in RAM.
    critical_section::with(|_| unsafe { carry_out(&rom, &boot2, offset, data) });
}

/// In RAM, and calls nothing that is in flash, which cannot be read meanwhile.
///
/// # Safety
/// Nothing may read from flash until it returns; `page` is null or points to [`PAGE`] bytes of RAM.
#[inline(never)]
#[unsafe(link_section = ".data.flash")]
unsafe fn carry_out(rom: &Rom, boot2: &Boot2, offset: u32, page: *const u8) {
    // SAFETY: pointers of the boot ROM; the copy of the second stage is code for Thumb that returns.
    unsafe {
        (rom.connect)();
        (rom.exit_xip)();
        if page.is_null() {
            // The whole sector with its own command.
            (rom.erase)(offset, SECTOR as usize, SECTOR, 0x20);
        } else {
            (rom.program)(offset, page, PAGE);
        }
        (rom.flush)();
        let start: Call = core::mem::transmute((&raw const *boot2 as usize) | 1);
        start();
    }
}
