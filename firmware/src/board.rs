//! What a board has and what may be done with it.

use daic_protocol::channels;
use daic_protocol::limits::TICK_HZ;
use daic_protocol::message::Capabilities;

/// Limits of one axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AxisLimits {
    /// Lowest allowed target in steps.
    pub min: i32,
    /// Highest allowed target in steps.
    pub max: i32,
    /// Highest step rate in steps per second.
    pub max_rate: u32,
    /// Highest acceleration in steps per second squared.
    pub max_acceleration: u32,
}

/// Limits of one LED.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LedLimits {
    /// Longest time on, in ticks.
    pub max_pulse: u32,
    /// Time a new level needs to settle, in ticks.
    pub settle: u32,
}

/// What a board has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Board {
    /// Name, reported in `Hello` (its first 16 bytes).
    pub name: &'static str,
    /// Bits of `Capabilities`.
    pub capabilities: u32,
    /// One entry per axis present (x, y, z, …).
    pub axes: heapless::Vec<AxisLimits, 6>,
    /// One entry per LED present.
    pub leds: heapless::Vec<LedLimits, 8>,
    /// Camera trigger lines present.
    pub cameras: u8,
    /// Ticks from the reception of `Start` to the first tick of the program: time for a player in
    /// hardware to be filled.
    pub start_lead: u64,
}

/// [`Board::start_lead`] of a board that needs no more (1 ms).
pub const START_LEAD: u64 = 125_000;

/// Ticks per microsecond.
const TICKS_PER_MICROSECOND: u32 = TICK_HZ / 1_000_000;

impl Board {
    /// The rig of the documentation: 4 LEDs (10 ms at most, level settled after 100 µs), 2 cameras,
    /// 3 axes of ±50 mm at 6400 steps per millimetre, 10 mm/s, 312.5 mm/s².
    pub fn reference() -> Self {
        let axis = AxisLimits { min: -320_000, max: 320_000, max_rate: 64_000, max_acceleration: 2_000_000 };
        let led =
            LedLimits { max_pulse: 10_000 * TICKS_PER_MICROSECOND, settle: 100 * TICKS_PER_MICROSECOND };
        Self {
            name: "reference",
            capabilities: 0,
            axes: heapless::Vec::from_array([axis; 3]),
            leds: heapless::Vec::from_array([led; 4]),
            cameras: 2,
            start_lead: START_LEAD,
        }
    }

    /// The same board, saying that it is a simulation.
    pub fn simulated(mut self) -> Self {
        self.capabilities |= Capabilities::SIMULATED;
        self
    }

    /// Bits that an `Edge` may drive on this board: its LEDs, its cameras, all auxiliary lines.
    pub fn edge_mask(&self) -> u32 {
        let leds = (0u8..).zip(self.leds.iter()).filter_map(|(i, _)| channels::led(i));
        let cameras = (0..self.cameras).filter_map(channels::camera);
        let auxiliary = channels::EDGE_MASK & !channels::LED_MASK & !channels::CAMERA_MASK;
        leds.chain(cameras).fold(auxiliary, |mask, bit| mask | bit)
    }
}
