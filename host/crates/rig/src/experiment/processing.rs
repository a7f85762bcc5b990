//! `[processing]`: how frames become results.

use crate::units::Length;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Correlation and decoding. Sizes are whole numbers of pixels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Processing {
    /// Side of the square subset; odd, 5…255.
    pub subset: u32,
    /// Distance between points, 1…1000.
    pub step: u32,
    /// Shape function of a subset.
    pub shape: Shape,
    /// B-spline that interpolates grey levels.
    pub interpolation: Interpolation,
    /// What is minimised.
    pub criterion: Criterion,
    /// Which form of the correlation solves the points.
    pub solver: Solver,
    /// How a pair of views becomes a point in space.
    pub decoder: Decoder,
    /// Whether the calibration frames, where there are any, set F and the distances; without, the
    /// values of `[optics]` stand.
    pub calibrate: bool,
    /// Height of the specimen where the optical axis meets it, stage at the reference frame: the datum
    /// from which a calibration counts heights (moves alone do not say where h = 0 is).
    pub axis_height: Length,
    /// Standard deviation of the camera noise in grey levels; left out, estimated from the frames.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise: Option<f64>,
    /// Most iterations of one point, 1…1000.
    pub max_iterations: u32,
    /// Largest norm of the last update, in pixels, for a point to count as converged.
    pub convergence: f64,
    /// Smallest zero-mean normalised cross-correlation of a good point, 0…1.
    pub min_zncc: f64,
    /// Rectangle of points in the −1 view: first and last column, first and last row; left out,
    /// the view found in the frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub roi: Option<[u32; 4]>,
}

impl Default for Processing {
    fn default() -> Self {
        Self {
            subset: 59,
            step: 10,
            shape: Shape::Quadratic,
            interpolation: Interpolation::Quintic,
            criterion: Criterion::Znssd,
            solver: Solver::Auto,
            decoder: Decoder::Ray,
            calibrate: true,
            axis_height: Length::new(0.0),
            noise: None,
            max_iterations: 30,
            convergence: 1e-3,
            min_zncc: 0.8,
            roi: None,
        }
    }
}

/// Shape function of a subset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Shape {
    /// Order 0: 2 parameters.
    Translation,
    /// First order: 6 parameters.
    Affine,
    /// Second order: 12 parameters.
    Quadratic,
}

/// B-spline that interpolates grey levels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// Degree 3.
    Cubic,
    /// Degree 5.
    Quintic,
    /// Degree 7.
    Septic,
}

/// What is minimised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Criterion {
    /// Zero-mean normalised sum of squared differences: blind to brightness and contrast.
    Znssd,
    /// Zero-mean sum of squared differences: blind to brightness.
    Zssd,
}

/// Which form of the correlation solves the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Solver {
    /// The dense form where it is valid, the exact one elsewhere.
    Auto,
    /// Every point by its own iteration.
    Exact,
    /// The dense form alone; points it does not answer for are left out.
    Dense,
}

/// How a pair of views becomes a point in space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Decoder {
    /// The grating equation, ray by ray.
    Ray,
    /// The virtual-object model without linearisation.
    Closed,
    /// The linearised virtual-object model of the literature.
    Linear,
}
