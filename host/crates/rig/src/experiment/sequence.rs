//! `[[sequence]]`: what is played, in order. Each entry is a table with one key.

use super::rig::Strobe;
use crate::units::{Length, Time};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// One entry of the sequence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Step {
    /// Move axes, one after the other, to absolute positions.
    Move(MoveStep),
    /// Wait with the outputs unchanged.
    Settle(Time),
    /// Set the current level of an LED.
    Level(LevelStep),
    /// Trigger the camera and strobe.
    Frame(FrameStep),
    /// Play steps several times.
    Repeat(RepeatStep),
}

/// Absolute positions from home; an axis left out stays where it is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MoveStep {
    /// Target of x.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub x: Option<Length>,
    /// Target of y.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub y: Option<Length>,
    /// Target of z.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub z: Option<Length>,
}

impl MoveStep {
    /// Targets in the order of the box (x, y, z).
    pub fn targets(&self) -> [Option<Length>; 3] {
        [self.x, self.y, self.z]
    }
}

/// A new level of an LED, and the time its driver needs to follow.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LevelStep {
    /// LED line, 0…7.
    pub led: u8,
    /// 0…1 of full scale.
    pub level: f64,
    /// Waited after setting it.
    #[serde(default = "level_settle")]
    pub settle: Time,
}

/// One frame: camera trigger, then the strobe inside the exposure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FrameStep {
    /// Letters, digits, `-` and `_`; inside a `repeat` a running number is appended.
    pub name: String,
    /// What the frame is for.
    pub role: Role,
    /// Strobe of this frame; left out, that of the rig.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub strobe: Option<Strobe>,
}

/// What a frame is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Known stage position, for calibration.
    Calibration,
    /// The state displacements count from.
    Reference,
    /// A state to be compared with the reference.
    Deformed,
    /// One of many states to be compared with the reference.
    Series,
}

/// Steps played several times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RepeatStep {
    /// How often, at least once.
    pub times: u32,
    /// What.
    pub steps: Vec<Step>,
}

fn level_settle() -> Time {
    Time::new(2e6)
}
