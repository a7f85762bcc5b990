//! The part of the flash that holds program slots.

use core::sync::atomic::{Ordering, compiler_fence};
use daic_firmware::slots::{Flash, PAGE, SECTOR, size};
use rp2040_hal::rom_data;

/// Slots on the board.
pub const SLOTS: u8 = 4;
const CHIP: u32 = 2 * 1024 * 1024;
/// Where the slots begin, from the beginning of the chip: its end. The linker keeps the image below.
const BASE: u32 = CHIP - size(SLOTS);
/// Where the chip can be read.
const WINDOW: u32 = 0x1000_0000;

/// The slots' part of the chip.
pub struct Chip;

impl Flash for Chip {
    fn read(&self, offset: u32, into: &mut [u8]) {
        for (at, byte) in (WINDOW + BASE + offset..).zip(into) {
            // SAFETY: the chip may be read anywhere at any time; while it is written nothing else
            // runs.
            *byte = unsafe { (at as *const u8).read_volatile() };
        }
    }

    fn erase(&mut self, offset: u32) {
        if offset < size(SLOTS) {
            change(BASE + offset, None);
        }
    }

    fn program(&mut self, offset: u32, page: &[u8; PAGE]) {
        if offset < size(SLOTS) {
            change(BASE + offset, Some(page));
        }
    }
}

/// Routines of the boot ROM, looked up while the ROM's table may be read through code in flash.
#[repr(C)]
struct Routines {
    connect: unsafe extern "C" fn(),
    exit: unsafe extern "C" fn(),
    erase: unsafe extern "C" fn(u32, usize, u32, u8),
    program: unsafe extern "C" fn(u32, *const u8, usize),
    flush: unsafe extern "C" fn(),
    enter: unsafe extern "C" fn(),
}

/// Erases the sector at `offset`, or programs the page there. Nothing else runs meanwhile.
fn change(offset: u32, page: Option<&[u8; PAGE]>) {
    // The second stage of the boot, which makes reading fast again, must run from RAM too.
    let mut second = [0u32; 64];
    for (at, word) in (WINDOW..).step_by(4).zip(&mut second) {
        // SAFETY: the first 256 bytes of the chip.
        *word = unsafe { (at as *const u32).read_volatile() };
    }
    let routines = Routines {
        connect: rom_data::connect_internal_flash::ptr(),
        exit: rom_data::flash_exit_xip::ptr(),
        erase: rom_data::flash_range_erase::ptr(),
        program: rom_data::flash_range_program::ptr(),
        flush: rom_data::flash_flush_cache::ptr(),
        enter: rom_data::flash_enter_cmd_xip::ptr(),
    };
    let page = page.map_or(core::ptr::null(), |page| page.as_ptr());
    critical_section::with(|_| {
        compiler_fence(Ordering::SeqCst);
        // SAFETY: the offset is within the slots and aligned; no interrupt and no other core reads
        // the flash, and the DMA reads RAM only.
        unsafe { in_ram(&routines, offset, page, second.as_ptr()) };
        compiler_fence(Ordering::SeqCst);
    });
}

/// # Safety
/// `offset` must be that of a sector or page which nothing uses, `page` null or a page in RAM,
/// `second` the second stage of the boot in RAM; nothing else may touch the flash.
#[inline(never)]
#[unsafe(link_section = ".data.flash")]
unsafe fn in_ram(routines: &Routines, offset: u32, page: *const u8, second: *const u32) {
    // SAFETY: as the caller says; the order is that of the ROM's documentation.
    unsafe {
        (routines.connect)();
        (routines.exit)();
        if page.is_null() {
            // Sectors of 4 KiB only: no block command fits so little.
            (routines.erase)(offset, SECTOR as usize, 1 << 16, 0xd8);
        } else {
            (routines.program)(offset, page, PAGE);
        }
        (routines.flush)();
        (routines.enter)();
        let run: extern "C" fn() = core::mem::transmute((second as usize + 1) as *const ());
        run();
    }
}
