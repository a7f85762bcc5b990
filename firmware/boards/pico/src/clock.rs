//! Ticks since boot.
//!
//! The core's 24-bit timer counts the system clock; the microsecond timer, which runs from the same
//! crystal, tells how often it has wrapped. No state, no interrupt: exact at any time, anywhere.

use crate::reg;
use core::sync::atomic::{AtomicU32, Ordering};
use rp2040_hal::pac;

const MASK: u32 = 0x00ff_ffff;
/// Ticks of a microsecond.
const US: u64 = 125;

/// What to add to the count of the core's timer, modulo 2²⁴.
static OFFSET: AtomicU32 = AtomicU32::new(0);

/// Starts the core's timer.
pub fn start(syst: &mut pac::SYST) {
    syst.set_clock_source(cortex_m::peripheral::syst::SystClkSource::Core);
    syst.set_reload(MASK);
    syst.clear_current();
    syst.enable_counter();
    // At the turn of a microsecond both agree to a few ticks.
    let before = micros();
    let mut after = before;
    while after == before {
        after = micros();
    }
    let ticks = after.wrapping_mul(US) as u32;
    OFFSET.store(ticks.wrapping_sub(count()) & MASK, Ordering::Relaxed);
}

/// Microseconds since boot.
fn micros() -> u64 {
    loop {
        let high = reg::read(reg::TIMER + 0x24);
        let low = reg::read(reg::TIMER + 0x28);
        if reg::read(reg::TIMER + 0x24) == high {
            return (u64::from(high) << 32) | u64::from(low);
        }
    }
}

/// Ticks by the core's timer, modulo 2²⁴.
#[inline(always)]
fn count() -> u32 {
    !reg::read(reg::SYST_CVR) & MASK
}

/// Ticks since boot.
pub fn now() -> u64 {
    let coarse = micros().wrapping_mul(US);
    let fine = count().wrapping_add(OFFSET.load(Ordering::Relaxed));
    // The nearest tick to `coarse` whose low 24 bits are those of `fine`.
    let apart = (fine.wrapping_sub(coarse as u32) << 8) as i32 >> 8;
    coarse.wrapping_add_signed(i64::from(apart))
}

/// Value of the core's timer at `tick`.
pub fn reading_at(tick: u64) -> u32 {
    !(tick as u32).wrapping_sub(OFFSET.load(Ordering::Relaxed)) & MASK
}
