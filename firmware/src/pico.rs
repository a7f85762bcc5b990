//! The Pico as a board: what it has, and which line is which pin.

use crate::board::{AxisLimits, Board, LedLimits};
use daic_protocol::channels;
use daic_protocol::limits::TICK_HZ;
use daic_protocol::message::Capabilities;

/// LEDs of the board.
pub const LEDS: u8 = 4;
/// Camera trigger lines of the board.
pub const CAMERAS: u8 = 2;
/// Auxiliary lines of the board.
pub const AUXILIARY: u8 = 4;
/// Axes of the board.
pub const AXES: u8 = 2;

/// GPIO of the UART that is served beside USB: transmit, receive.
pub const UART: [u8; 2] = [0, 1];
/// First GPIO of the output word; the lines follow in order.
pub const OUT_BASE: u8 = 2;
/// GPIO of the on-board LED, which shows LED 0.
pub const ONBOARD: u8 = 25;
/// GPIOs with the level of each LED as PWM.
pub const LEVEL: [u8; 4] = [16, 17, 18, 19];
/// GPIO of the interlock: high permits, low (or an open wire) makes every output safe.
pub const INTERLOCK: u8 = 20;

/// GPIO of each input, as (bit of the input word, GPIO): trigger inputs 0 and 1, exposure-active line of
/// camera 0, limit switches at the low end of axes 0 and 1, interlock.
pub const INPUTS: [(u8, u8); 6] = [(0, 21), (1, 22), (8, 26), (12, 27), (14, 28), (24, INTERLOCK)];
/// Slots for programs.
pub const SLOTS: u8 = 4;
/// [`Board::input_latency`] of the board: 1 ms, in which the player is fed a few times.
pub const INPUT_LATENCY: u32 = TICK_HZ / 1000;

/// Pins that the player drives, [`OUT_BASE`] first: the lines, nothing, the on-board LED.
pub const OUT_PINS: u8 = ONBOARD - OUT_BASE + 1;

/// GPIO of each line of the board, as (bit of the output word, GPIO).
///
/// LEDs on GPIO 2…5, camera triggers on 6 and 7, auxiliary lines on 8…11, step and direction of axis
/// 0 on 12 and 13, of axis 1 on 14 and 15.
pub const LINES: [(u8, u8); 14] = [
    (0, 2),
    (1, 3),
    (2, 4),
    (3, 5),
    (8, 6),
    (9, 7),
    (12, 8),
    (13, 9),
    (14, 10),
    (15, 11),
    (16, 12),
    (17, 13),
    (18, 14),
    (19, 15),
];

/// The word of the player, whose bit 0 is GPIO [`OUT_BASE`], for an output word.
pub const fn pin_word(word: u32) -> u32 {
    let leds = word & 0xf;
    let cameras = (word >> 8) & 0x3;
    let auxiliary = (word >> 12) & 0xf;
    let axes = (word >> 16) & 0xf;
    let onboard = leds & 1;
    leds | (cameras << 4) | (auxiliary << 6) | (axes << 10) | (onboard << (ONBOARD - OUT_BASE))
}

impl Board {
    /// A Raspberry Pi Pico: 4 LEDs (10 ms at most, level settled after 2 ms), 2 cameras, 2 axes of
    /// ±50 mm at 6400 steps per millimetre, 2.5 mm/s, 312.5 mm/s², 2 trigger inputs answered after 1 ms.
    pub fn pico() -> Self {
        let axis = AxisLimits {
            min: -320_000,
            max: 320_000,
            max_rate: 16_000,
            max_acceleration: 2_000_000,
            max_jerk: 1_000_000_000,
            home: None,
        };
        let led = LedLimits::new(TICK_HZ / 100, TICK_HZ / 500);
        Self {
            name: "pico",
            capabilities: Capabilities::TRIGGER_INPUTS
                | Capabilities::JERK
                | Capabilities::STREAMING
                | Capabilities::FLASH
                | Capabilities::INTERLOCK
                | Capabilities::EXPOSURE_ACTIVE,
            axes: heapless::Vec::from_array([axis; AXES as usize]),
            leds: heapless::Vec::from_array([led.clone(), led.clone(), led.clone(), led]),
            cameras: CAMERAS,
            inputs: 2,
            // Three blocks of a wait.
            input_latency: INPUT_LATENCY,
            // 10 ms: some 450 words, so that a burst at the beginning does not outrun the processor.
            start_lead: TICK_HZ as u64 / 100,
        }
    }
}

/// The input word for the levels of all GPIOs.
pub fn input_word(levels: u32) -> u32 {
    let high = |gpio: u8| levels.checked_shr(u32::from(gpio)).unwrap_or(0) & 1;
    INPUTS.iter().fold(0, |word, &(bit, gpio)| word | high(gpio).checked_shl(u32::from(bit)).unwrap_or(0))
}

const _: () = assert!(AUXILIARY == (channels::EDGE_MASK >> 12).count_ones() as u8);
