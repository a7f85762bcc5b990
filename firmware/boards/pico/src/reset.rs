//! Why the board started, and how it ends when something impossible has happened.

use crate::{player, reg};
use core::panic::PanicInfo;
use daic_protocol::message::ResetCause;

const PANIC: u32 = 0xda1c_0001;
const HARD_FAULT: u32 = 0xda1c_0002;
const RUNNING: u32 = 0xda1c_0000;
/// First two scratch registers: they survive every reset but that of the power.
const STATE: u32 = reg::WATCHDOG + 0x0c;
const BOOTS: u32 = reg::WATCHDOG + 0x10;

/// Why the board started, and how often since power came.
pub fn cause() -> (ResetCause, u32) {
    let boots = reg::read(BOOTS).wrapping_add(1);
    let cause = match (reg::read(STATE), reg::read(reg::WATCHDOG + 0x08)) {
        (PANIC, _) => ResetCause::Panic,
        (HARD_FAULT, _) => ResetCause::HardFault,
        (_, 0) => ResetCause::Power,
        _ => ResetCause::Watchdog,
    };
    reg::write(STATE, RUNNING);
    reg::write(BOOTS, boots);
    (cause, boots)
}

/// Outputs off, then a new start.
fn end(state: u32) -> ! {
    player::kill();
    reg::write(STATE, state);
    // The watchdog's trigger resets everything that `Watchdog::start` has chosen.
    reg::write(reg::WATCHDOG + reg::SET, 1 << 31);
    loop {
        cortex_m::asm::nop();
    }
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    cortex_m::interrupt::disable();
    end(PANIC)
}

// SAFETY: the handler touches nothing that the interrupted program could have left half done.
#[cortex_m_rt::exception]
unsafe fn HardFault(_: &cortex_m_rt::ExceptionFrame) -> ! {
    end(HARD_FAULT)
}
