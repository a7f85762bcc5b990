//! What the manifest and the journals hold.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// `dataset.json`: where the dataset comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Always "daic-dataset"; set when the dataset is created.
    #[serde(default)]
    pub format: String,
    /// Version of the folder layout; set when the dataset is created.
    #[serde(default)]
    pub format_version: u32,
    /// Name of the program that recorded.
    pub program: String,
    /// Its version.
    pub program_version: String,
    /// What made the dataset, where that is more than a recording ("demo"); decides whether it may
    /// be replaced, see [`super::Existing::ReplaceKind`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<String>,
    /// Seed of everything random, for a simulated rig.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// Ticks per second of the trigger box.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tick_hz: Option<f64>,
    /// When the recording began, RFC 3339 in UTC; left out where runs must be byte-identical.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub started_utc: Option<String>,
    /// What was planned: steps, frames, commanded positions, as the recorder sees fit.
    #[serde(default)]
    pub plan: Value,
    /// Anything else worth keeping: identity of box and camera.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub extra: BTreeMap<String, Value>,
}

impl Manifest {
    /// A manifest with the mandatory fields; the others are empty and may be set.
    #[must_use]
    pub fn new(program: &str, program_version: &str) -> Self {
        Manifest {
            format: String::new(),
            format_version: 0,
            program: program.into(),
            program_version: program_version.into(),
            kind: None,
            seed: None,
            tick_hz: None,
            started_utc: None,
            plan: Value::Null,
            extra: BTreeMap::new(),
        }
    }
}

/// What a frame is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameRole {
    /// Taken to calibrate the optics.
    Calibration,
    /// The state from which displacement is counted.
    Reference,
    /// A state to be measured.
    Measurement,
    /// Without light, or otherwise for checks only.
    Check,
    /// Not in the plan.
    Unplanned,
}

/// Whether it is known which trigger and strobes belong to a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Exactly one trigger fits the frame, within the error bound.
    Paired,
    /// A trigger without a frame.
    Missing,
    /// A frame without a trigger.
    Extra,
    /// More than one assignment fits within the error bound.
    Ambiguous,
    /// Recorded, but not judged yet.
    Pending,
}

/// One light pulse.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StrobeRecord {
    /// Number of the LED channel.
    pub led: u8,
    /// Tick at which its line went up.
    pub on_tick: u64,
    /// Tick at which its line went down.
    pub off_tick: u64,
    /// Level as a fraction of full scale, 0..=1.
    pub level: f64,
}

/// One line of `frames.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Number of the frame in the dataset, unique.
    pub id: u64,
    /// Image file, relative to the dataset with `/`; `None` for a frame that never came. Set by
    /// the recording.
    pub file: Option<String>,
    /// Name for people: "reference", "z +0.200".
    pub name: String,
    /// What the frame is for.
    pub role: FrameRole,
    /// Which trigger it belongs to.
    pub verdict: Verdict,
    /// Number the camera gave it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_frame: Option<u64>,
    /// Time the camera gave it, in nanoseconds of the camera's clock.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_ns: Option<i64>,
    /// Bound on the error of that time after conversion to the box's clock, in nanoseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_error_ns: Option<f64>,
    /// Position of the stage as commanded, (x, y, z) in micrometres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub commanded_um: Option<[f64; 3]>,
    /// Tick of the camera trigger.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trigger_tick: Option<u64>,
    /// Tick at which the exposure began: as the box saw it, or else the trigger's and the experiment's delay.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_tick: Option<u64>,
    /// Exposure in nanoseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_ns: Option<u64>,
    /// The pulses that lit it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub strobes: Vec<StrobeRecord>,
    /// Why the verdict is what it is, for people.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub note: String,
    /// Anything else worth keeping.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub extra: BTreeMap<String, Value>,
}

impl FrameRecord {
    /// A record with the mandatory fields, verdict pending; the others are empty and may be set.
    #[must_use]
    pub fn new(id: u64, name: &str, role: FrameRole) -> Self {
        FrameRecord {
            id,
            file: None,
            name: name.into(),
            role,
            verdict: Verdict::Pending,
            camera_frame: None,
            camera_ns: None,
            time_error_ns: None,
            commanded_um: None,
            trigger_tick: None,
            exposure_tick: None,
            exposure_ns: None,
            strobes: Vec::new(),
            note: String::new(),
            extra: BTreeMap::new(),
        }
    }
}

/// One line of `events.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EventRecord {
    /// Sequence number given by the box; consecutive, wrapping.
    pub seq: u32,
    /// Tick of the event.
    pub tick: u64,
    /// Kind of event, as the protocol names it.
    pub kind: String,
    /// What the kind carries.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub data: Value,
}
