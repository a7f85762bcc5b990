//! `[rig]`: trigger box, stage, camera, LEDs.

use crate::units::{Acceleration, Jerk, Length, Speed, Time};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Trigger box, stage, camera and strobe.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// Where the box is: a serial port, `tcp://host:port`, or `sim` for the simulated rig.
    #[serde(default = "sim")]
    pub port: String,
    /// Bits per second of a serial port (USB ignores it).
    #[serde(default = "baud")]
    pub baud: u32,
    /// How long to wait for one reply before asking again.
    #[serde(default = "reply_timeout")]
    pub reply_timeout: Time,
    /// How long to wait for frames after the last trigger.
    #[serde(default = "frame_timeout")]
    pub frame_timeout: Time,
    /// The camera and its trigger line.
    pub camera: CameraSection,
    /// The strobe that lights a frame unless the frame has its own.
    pub strobe: Strobe,
    /// Stage axes.
    #[serde(default)]
    pub axes: Axes,
}

/// The camera and its trigger line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraSection {
    /// Where `daic run` takes frames from when `--frames` is not given.
    #[serde(default)]
    pub source: CameraSource,
    /// Trigger line of the box, 0…3.
    #[serde(default)]
    pub line: u8,
    /// Sensor columns.
    pub width: u32,
    /// Sensor rows.
    pub height: u32,
    /// Significant bits of a grey level, 8…16.
    #[serde(default = "bits")]
    pub bits: u8,
    /// How long the trigger line stays high.
    #[serde(default = "trigger_width")]
    pub trigger_width: Time,
    /// From the rising trigger edge to the begin of the exposure.
    #[serde(default = "zero")]
    pub exposure_delay: Time,
    /// How long the sensor integrates.
    pub exposure: Time,
    /// From the end of the exposure until the camera takes the next trigger.
    #[serde(default = "readout")]
    pub readout: Time,
    /// How much later than the row above it a row is exposed (rolling shutter); left out, all rows at once.
    #[serde(default = "zero", skip_serializing_if = "is_zero")]
    pub row_time: Time,
    /// Colour mosaic of the sensor, of which one channel is used; left out, none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bayer: Option<Bayer>,
}

impl CameraSection {
    /// How much later the last row is exposed than the first.
    pub fn rolling(&self) -> Time {
        Time::new(self.row_time.ns() * f64::from(self.height.saturating_sub(1)))
    }
}

/// A Bayer mosaic and the channel that is used. Nothing is interpolated: the pixels of the channel are an image of
/// half the columns and rows, whose positions are known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Bayer {
    /// Colours of the pixels (0, 0), (1, 0), (0, 1), (1, 1).
    pub pattern: BayerPattern,
    /// Channel that is used.
    pub channel: BayerChannel,
}

/// Colours of a Bayer cell, row by row from the top left.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum BayerPattern {
    /// Red, green / green, blue.
    Rggb,
    /// Green, red / blue, green.
    Grbg,
    /// Green, blue / red, green.
    Gbrg,
    /// Blue, green / green, red.
    Bggr,
}

/// A square lattice of pixels of one colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum BayerChannel {
    /// Red.
    R,
    /// Green in the rows with red.
    Gr,
    /// Green in the rows with blue.
    Gb,
    /// Blue.
    B,
}

impl Bayer {
    /// Column and row, 0 or 1, of the channel's first pixel.
    pub fn origin(self) -> [u32; 2] {
        let red = match self.pattern {
            BayerPattern::Rggb => [0, 0],
            BayerPattern::Grbg => [1, 0],
            BayerPattern::Gbrg => [0, 1],
            BayerPattern::Bggr => [1, 1],
        };
        let [x, y] = red;
        match self.channel {
            BayerChannel::R => [x, y],
            BayerChannel::Gr => [1 - x, y],
            BayerChannel::Gb => [x, 1 - y],
            BayerChannel::B => [1 - x, 1 - y],
        }
    }
}

/// `rggb:r`: pattern and channel.
impl std::str::FromStr for Bayer {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!(
                "found `{text}`, wanted a pattern (rggb, grbg, gbrg, bggr) and a channel (r, gr, gb, b): rggb:r"
            )
        };
        let (pattern, channel) = text.split_once(':').ok_or_else(wrong)?;
        let pattern = match pattern {
            "rggb" => BayerPattern::Rggb,
            "grbg" => BayerPattern::Grbg,
            "gbrg" => BayerPattern::Gbrg,
            "bggr" => BayerPattern::Bggr,
            _ => return Err(wrong()),
        };
        let channel = match channel {
            "r" => BayerChannel::R,
            "gr" => BayerChannel::Gr,
            "gb" => BayerChannel::Gb,
            "b" => BayerChannel::B,
            _ => return Err(wrong()),
        };
        Ok(Self { pattern, channel })
    }
}

/// Where frames come from.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CameraSource {
    /// The simulated camera.
    #[default]
    Sim,
    /// Image files of a folder, in natural order of their names.
    Folder(PathBuf),
}

/// A strobe: one LED pulse inside the exposure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Strobe {
    /// LED line, 0…7.
    #[serde(default)]
    pub led: u8,
    /// From the rising trigger edge to LED on.
    pub delay: Time,
    /// How long the LED is on.
    pub width: Time,
    /// Current level, 0…1 of full scale; left out, the level last set (1 before any).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub level: Option<f64>,
    /// Time the driver needs after a new level.
    #[serde(default = "level_settle")]
    pub level_settle: Time,
}

/// Stage axes that are there.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Axes {
    /// x, axis 0 of the box: to the right on the sensor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub x: Option<Axis>,
    /// y, axis 1 of the box: down on the sensor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub y: Option<Axis>,
    /// z, axis 2 of the box: towards the camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub z: Option<Axis>,
}

impl Axes {
    /// Name and axis in the order of the box (x, y, z).
    pub fn named(&self) -> [(&'static str, Option<&Axis>); 3] {
        [("x", self.x.as_ref()), ("y", self.y.as_ref()), ("z", self.z.as_ref())]
    }
}

/// One stage axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Axis {
    /// Step pulses per millimetre.
    pub steps_per_mm: f64,
    /// Lowest position a move may ask for.
    pub min: Length,
    /// Highest position a move may ask for.
    pub max: Length,
    /// Highest speed.
    pub rate: Speed,
    /// Acceleration.
    pub acceleration: Acceleration,
    /// Change of the acceleration per time; left out, it may jump (trapezoid).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub jerk: Option<Jerk>,
    /// Play of the drive: so far it turns after a reversal before the stage follows.
    #[serde(default = "no_length", skip_serializing_if = "is_no_length")]
    pub backlash: Length,
    /// With a backlash every move ends in this direction: one that would not goes past its target by twice the
    /// backlash first.
    #[serde(default, skip_serializing_if = "Approach::is_default")]
    pub approach: Approach,
}

/// Direction in which an axis arrives.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Approach {
    /// Counting up.
    #[default]
    Positive,
    /// Counting down.
    Negative,
}

impl Approach {
    /// +1 or −1.
    pub fn sign(self) -> i32 {
        match self {
            Self::Positive => 1,
            Self::Negative => -1,
        }
    }

    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

fn sim() -> String {
    "sim".to_owned()
}
fn baud() -> u32 {
    115_200
}
fn reply_timeout() -> Time {
    Time::new(200e6)
}
fn frame_timeout() -> Time {
    Time::new(5e9)
}
fn no_length() -> Length {
    Length::new(0.0)
}
fn is_no_length(length: &Length) -> bool {
    length.mm() == 0.0
}
fn bits() -> u8 {
    8
}
fn trigger_width() -> Time {
    Time::new(10e3)
}
fn zero() -> Time {
    Time::new(0.0)
}
fn is_zero(time: &Time) -> bool {
    time.ns() == 0.0
}
fn readout() -> Time {
    Time::new(20e6)
}
fn level_settle() -> Time {
    Time::new(2e6)
}
