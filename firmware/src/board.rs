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
    /// Highest jerk in steps per second cubed.
    pub max_jerk: u32,
    /// The home switch, if there is one. Then the axis moves only once it has been homed.
    pub home: Option<Homing>,
}

/// How an axis finds its home switch: towards it at `rate` until it is pressed, then back at an eighth of the
/// rate until it lets go; there the count is `position`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Homing {
    /// Whether the switch at the high end is used.
    pub high_end: bool,
    /// Steps per second, at which the axis starts and stops at once.
    pub rate: u32,
    /// Most steps towards the switch, and most steps back.
    pub travel: u32,
    /// The count where the switch lets go.
    pub position: i32,
}

impl Homing {
    /// Step rate on the way back.
    pub fn rate_back(&self) -> u32 {
        (self.rate / 8).max(1)
    }
}

/// What an LED stands above a level. Of all rows whose level is exceeded the strictest counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Overdrive {
    /// The row holds for levels above this one.
    pub above: u16,
    /// Longest time on, in ticks.
    pub max_pulse: u32,
    /// Ticks of cycle that one tick of light costs: the reciprocal of the duty, at least 1.
    pub cycle: u32,
}

/// Limits of one LED.
///
/// A tick of light at a level that costs c ticks of cycle adds c − 1 ticks of *rest owed*, a tick of
/// darkness pays one back. What is owed may never exceed `window`: bursts are limited by the
/// window, the mean by the duty 1/c.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LedLimits {
    /// Longest time on at any level, in ticks.
    pub max_pulse: u32,
    /// Time a new level needs to settle, in ticks.
    pub settle: u32,
    /// Most rest that may be owed, in ticks.
    pub window: u32,
    /// Stricter limits above some levels.
    pub overdrive: heapless::Vec<Overdrive, 4>,
}

impl LedLimits {
    /// An LED that stands any duty.
    pub const fn new(max_pulse: u32, settle: u32) -> Self {
        Self { max_pulse, settle, window: u32::MAX, overdrive: heapless::Vec::new() }
    }

    /// Longest pulse and cost of a tick of light at `level`.
    pub fn at(&self, level: u16) -> (u32, u32) {
        let rows = self.overdrive.iter().filter(|row| level > row.above);
        rows.fold((self.max_pulse, 1), |(pulse, cycle), row| (pulse.min(row.max_pulse), cycle.max(row.cycle)))
    }
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
    /// Trigger inputs present.
    pub inputs: u8,
    /// Ticks that the board needs to act on an input: no wait ends sooner after its trigger.
    pub input_latency: u32,
    /// Ticks from the reception of `Start` to the first tick of the program: time for a player in
    /// hardware to be filled.
    pub start_lead: u64,
}

/// [`Board::start_lead`] of a board that needs no more (1 ms).
pub const START_LEAD: u64 = 125_000;

/// Capabilities that this firmware plays; a board may claim no other.
pub const PLAYED: u32 = Capabilities::SIMULATED
    | Capabilities::TRIGGER_INPUTS
    | Capabilities::JERK
    | Capabilities::STREAMING
    | Capabilities::FLASH
    | Capabilities::INTERLOCK
    | Capabilities::EXPOSURE_ACTIVE;

/// Ticks per microsecond.
const TICKS_PER_MICROSECOND: u32 = TICK_HZ / 1_000_000;

impl Board {
    /// The rig of the documentation: 4 LEDs (10 ms at most, level settled after 100 µs), 2 cameras,
    /// 3 axes of ±50 mm at 6400 steps per millimetre, 10 mm/s, 312.5 mm/s², 2 trigger inputs answered
    /// after 50 µs.
    pub fn reference() -> Self {
        let axis = AxisLimits {
            min: -320_000,
            max: 320_000,
            max_rate: 64_000,
            max_acceleration: 2_000_000,
            max_jerk: 1_000_000_000,
            home: None,
        };
        let led = LedLimits::new(10_000 * TICKS_PER_MICROSECOND, 100 * TICKS_PER_MICROSECOND);
        Self {
            name: "reference",
            capabilities: Capabilities::TRIGGER_INPUTS
                | Capabilities::JERK
                | Capabilities::STREAMING
                | Capabilities::EXPOSURE_ACTIVE,
            axes: heapless::Vec::from_array([axis; 3]),
            leds: heapless::Vec::from_array([led.clone(), led.clone(), led.clone(), led]),
            cameras: 2,
            inputs: 2,
            input_latency: 50 * TICKS_PER_MICROSECOND,
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
