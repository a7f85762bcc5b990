//! `summary.json`: what a dataset says, in numbers.

use crate::exposure::ExposureSummary;
use crate::measure::GapSummary;
use serde::{Deserialize, Serialize};

/// Everything measured in a dataset. Lengths in micrometres unless the name says otherwise; axes x
/// right, y down, h towards the camera, in this order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Version of the program that measured.
    pub daic: String,
    /// Seed of the dataset, if it was simulated.
    pub seed: Option<u64>,
    /// Frames by verdict.
    pub frames: FrameCounts,
    /// Commanded move of the last measured frame from the reference.
    pub commanded_um: Option<[f64; 3]>,
    /// Mean displacement of the last measured frame.
    pub measured_um: Option<[f64; 3]>,
    /// Measured minus commanded, RMS over the field.
    pub rms_um: Option<[f64; 3]>,
    /// Standard deviation of a single point of the last measured frame, from its own uncertainty (RMS
    /// over the field).
    pub sigma_um: Option<[f64; 3]>,
    /// Largest difference in ticks between played and expected edges, where the edges were recorded and
    /// their words agree; none otherwise.
    pub edge_error_ticks_max: Option<u64>,
    /// Word changes that were compared.
    pub edges_compared: usize,
    /// Exposures as the box saw them; none where no exposure-active line is wired.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure: Option<ExposureSummary>,
    /// What the calibration found, if there was one.
    pub calibration: Option<CalibrationSummary>,
    /// Shape of the reference.
    pub profile: ProfileSummary,
    /// Every measured frame, in the order of the dataset.
    pub measured: Vec<FrameSummary>,
    /// Paired frames that could not be measured.
    pub failed: Vec<FailedFrame>,
    /// What could not be read of the dataset.
    pub damage: Vec<String>,
}

/// Frames by verdict.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameCounts {
    /// With exactly one trigger.
    pub paired: usize,
    /// Triggers without a frame.
    pub missing: usize,
    /// Frames without a trigger.
    pub extra: usize,
    /// Frames that fit more than one trigger.
    pub ambiguous: usize,
}

/// A frame that could not be measured.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailedFrame {
    /// Number of the frame in the dataset.
    pub id: u64,
    /// Name in the experiment.
    pub name: String,
    /// Why.
    pub reason: String,
}

/// A calibration in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibrationSummary {
    /// Each parameter.
    pub parameters: Vec<CalibratedParameter>,
    /// RMS of the residuals in pixels.
    pub rms_px: f64,
    /// χ² per degree of freedom.
    pub chi_square_reduced: f64,
    /// Points used.
    pub points: usize,
    /// Observations (point in a frame) used.
    pub observations: usize,
    /// Observations left out as outliers.
    pub rejected: usize,
}

/// One calibrated parameter, in the unit of its name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibratedParameter {
    /// Name with unit.
    pub name: String,
    /// What the experiment file said, if it did.
    pub start: Option<f64>,
    /// Estimate.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// A profile in numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ProfileSummary {
    /// Points of the grid.
    pub points: usize,
    /// Points with a result.
    pub ok: usize,
    /// Mean height in millimetres.
    pub mean_h_mm: f64,
    /// RMS of the points' own σ_h in micrometres.
    pub sigma_h_um: f64,
    /// RMS of the points' σ_h from the calibration in micrometres; none where nothing is known of it.
    pub sigma_h_cal_um: Option<f64>,
    /// Gap of the two rays: whether the calibration fits the frame.
    pub gap: GapSummary,
}

/// A measured frame in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameSummary {
    /// Number of the frame in the dataset; its results are in `results/<id>`.
    pub id: u64,
    /// Name in the experiment.
    pub name: String,
    /// Commanded move from the reference, if known.
    pub commanded_um: Option<[f64; 3]>,
    /// Measured minus commanded, RMS over the field.
    pub rms_um: Option<[f64; 3]>,
    /// The field in numbers.
    #[serde(flatten)]
    pub field: FieldSummary,
}

/// A displacement field in numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FieldSummary {
    /// Mean displacement.
    pub measured_um: [f64; 3],
    /// Scatter about the mean.
    pub std_um: [f64; 3],
    /// RMS of the points' own standard deviations.
    pub sigma_um: [f64; 3],
    /// RMS of the points' standard deviations from the calibration; none where nothing is known of it.
    pub sigma_cal_um: Option<[f64; 3]>,
    /// Gap of the two rays of the reference: whether the calibration fits the frame.
    pub gap: GapSummary,
    /// Points of the grid.
    pub points: usize,
    /// Points with a result.
    pub ok: usize,
}

/// A check against what is known otherwise.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Check {
    /// What.
    pub name: String,
    /// What was found.
    pub found: String,
    /// What it must not exceed, or must be.
    pub limit: String,
    /// Whether it held.
    pub passed: bool,
}
