//! Registers by address: those that the HAL does not offer.

/// Levels of all GPIOs.
pub const GPIO_IN: u32 = 0xd000_0004;
/// PIO block 0, whose machines drive and guard the outputs.
pub const PIO0: u32 = 0x5020_0000;
/// PIO block 1, whose machines stamp inputs.
pub const PIO1: u32 = 0x5030_0000;
/// DMA controller.
pub const DMA: u32 = 0x5000_0000;
/// Functions of the pins.
pub const IO_BANK0: u32 = 0x4001_4000;
/// Electrical properties of the pins.
pub const PADS_BANK0: u32 = 0x4001_c000;
/// UART 0.
pub const UART0: u32 = 0x4003_4000;
/// Watchdog and its scratch registers.
pub const WATCHDOG: u32 = 0x4005_8000;
/// The microsecond timer.
pub const TIMER: u32 = 0x4005_4000;
/// Current value of the system timer of the core.
pub const SYST_CVR: u32 = 0xe000_e018;

/// Alias of a register that sets bits.
pub const SET: u32 = 0x2000;

/// Reads a register.
#[inline(always)]
pub fn read(address: u32) -> u32 {
    // SAFETY: only called with the addresses of registers above, all of which may be read at any
    // time; a read does not touch memory that Rust knows of.
    unsafe { (address as *const u32).read_volatile() }
}

/// Writes a register.
#[inline(always)]
pub fn write(address: u32, value: u32) {
    // SAFETY: only called with the addresses of registers above. The DMA is the one of them that
    // reaches memory; `player` gives it nothing but its own static buffers.
    unsafe { (address as *mut u32).write_volatile(value) }
}

/// Register `offset` of machine `machine` of a PIO block.
pub const fn machine(block: u32, machine: u32, offset: u32) -> u32 {
    block.wrapping_add(machine.wrapping_mul(0x18)).wrapping_add(offset)
}
/// Clock divider.
pub const CLKDIV: u32 = 0xc8;
/// Wrap, status source.
pub const EXECCTRL: u32 = 0xcc;
/// Shifting and FIFO joining.
pub const SHIFTCTRL: u32 = 0xd0;
/// Program counter.
pub const ADDR: u32 = 0xd4;
/// Executes what is written.
pub const INSTR: u32 = 0xd8;
/// Pins of a machine.
pub const PINCTRL: u32 = 0xdc;
