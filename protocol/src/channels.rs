//! Which bit of the 32-bit output word drives what.
//!
//! All outputs are one word on one timeline, so that their order is exact.
//!
//! | bits    | what |
//! |---------|------|
//! | 0…7     | LED 0…7, high = lit |
//! | 8…11    | camera trigger 0…3, rising edge triggers |
//! | 12…15   | free auxiliary lines 0…3 |
//! | 16…27   | axis 0…5: step (even bit, rising edge steps) and direction (odd bit, high = positive) |
//! | 28…31   | reserved, always low |
//!
//! The inputs are one word too:
//!
//! | bits    | what |
//! |---------|------|
//! | 0…7     | trigger input 0…7 |
//! | 8…11    | exposure-active line of camera 0…3, high while it is exposed |
//! | 12…23   | limit switches of axis 0…5: at the low end (even bit) and at the high end (odd bit), high = pressed |
//! | 24      | interlock, high = closed |

/// Number of LED lines.
pub const LEDS: u8 = 8;
/// Number of camera trigger lines.
pub const CAMERAS: u8 = 4;
/// Number of stage axes (x, y, z by convention on axes 0, 1, 2).
pub const AXES: u8 = 6;
/// Bits that an [`Edge`](crate::program::Instruction::Edge) may drive: LEDs, cameras, auxiliary lines.
pub const EDGE_MASK: u32 = 0x0000_ffff;
/// Bits that only the move planner drives.
pub const AXIS_MASK: u32 = 0x0fff_0000;
/// All LED bits.
pub const LED_MASK: u32 = 0x0000_00ff;
/// All camera trigger bits.
pub const CAMERA_MASK: u32 = 0x0000_0f00;

/// Trigger inputs that a box can have.
pub const INPUTS: u8 = 8;
/// All trigger bits of the input word.
pub const TRIGGER_INPUT_MASK: u32 = 0x0000_00ff;
/// All exposure-active bits of the input word.
pub const EXPOSURE_MASK: u32 = 0x0000_0f00;
/// All limit switch bits of the input word.
pub const LIMIT_MASK: u32 = 0x00ff_f000;
/// The interlock's bit of the input word: high = closed, light and motion allowed.
pub const INTERLOCK: u32 = 0x0100_0000;

/// The word with every output off.
pub const SAFE_WORD: u32 = 0;

const fn bit(first: u8, index: u8, count: u8) -> Option<u32> {
    if index < count { 1u32.checked_shl(first.wrapping_add(index) as u32) } else { None }
}

/// Mask of LED `index`, or `None` beyond the last.
pub const fn led(index: u8) -> Option<u32> {
    bit(0, index, LEDS)
}
/// Mask of camera trigger `index`, or `None` beyond the last.
pub const fn camera(index: u8) -> Option<u32> {
    bit(8, index, CAMERAS)
}
/// Mask of the step line of axis `index`, or `None` beyond the last.
pub const fn step(index: u8) -> Option<u32> {
    if index < AXES { bit(16, index.wrapping_mul(2), AXES * 2) } else { None }
}
/// Mask of the direction line of axis `index`, or `None` beyond the last.
pub const fn direction(index: u8) -> Option<u32> {
    if index < AXES { bit(17, index.wrapping_mul(2), AXES * 2) } else { None }
}
/// Bit of trigger input `index` in the input word, or `None` beyond the last.
pub const fn trigger_input(index: u8) -> Option<u32> {
    bit(0, index, INPUTS)
}
/// Bit of the exposure-active line of camera `index` in the input word, or `None` beyond the last.
pub const fn exposure_active(index: u8) -> Option<u32> {
    bit(8, index, CAMERAS)
}
/// Bit of the limit switch of axis `index` in the input word, or `None` beyond the last.
pub const fn limit_switch(index: u8, high_end: bool) -> Option<u32> {
    if index < AXES { bit(12, index.wrapping_mul(2).wrapping_add(high_end as u8), AXES * 2) } else { None }
}
