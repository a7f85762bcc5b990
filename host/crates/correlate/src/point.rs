//! What a correlation says about one point.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Which form of the optimisation gave a point's numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SolvedBy {
    /// The point's own Gauss–Newton iteration.
    #[default]
    Exact,
    /// The dense form: all overlapping subsets at once.
    Dense,
    /// Own iteration on the part of the subset on the point's side of a discontinuity.
    Split,
    /// No subset: the phases of a grating.
    Phase,
}

impl SolvedBy {
    /// Stable name.
    pub fn name(self) -> &'static str {
        match self {
            SolvedBy::Exact => "exact",
            SolvedBy::Dense => "dense",
            SolvedBy::Split => "split",
            SolvedBy::Phase => "phase",
        }
    }
}

impl fmt::Display for SolvedBy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Verdict on a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// Converged, significant, plausible and confirmed by its neighbours.
    #[serde(rename = "ok")]
    Converged,
    /// The iteration cap was reached, or the iteration ran away.
    NotConverged,
    /// The subset does not lie inside the reference or the deformed image.
    OutOfImage,
    /// The correlation is too low, or no better than chance.
    LowCorrelation,
    /// The subset has no grey-level variation.
    LowTexture,
    /// The normal equations cannot be solved: the texture does not determine all parameters.
    Singular,
    /// The subset is stretched beyond the limit.
    Distorted,
    /// The neighbours contradict this point.
    Inconsistent,
    /// The subset straddles a step, a crack or the edge of an object, and the point's own side of it
    /// could not be solved.
    Discontinuous,
    /// No initial guess was found.
    NoGuess,
}

impl Status {
    /// Every status.
    pub const ALL: [Status; 10] = [
        Status::Converged,
        Status::NotConverged,
        Status::OutOfImage,
        Status::LowCorrelation,
        Status::LowTexture,
        Status::Singular,
        Status::Distorted,
        Status::Inconsistent,
        Status::Discontinuous,
        Status::NoGuess,
    ];

    /// Stable name: `ok` for a point that can be used, else the reason.
    pub fn name(self) -> &'static str {
        match self {
            Status::Converged => "ok",
            Status::NotConverged => "not_converged",
            Status::OutOfImage => "out_of_image",
            Status::LowCorrelation => "low_correlation",
            Status::LowTexture => "low_texture",
            Status::Singular => "singular",
            Status::Distorted => "distorted",
            Status::Inconsistent => "inconsistent",
            Status::Discontinuous => "discontinuous",
            Status::NoGuess => "no_guess",
        }
    }

    /// Whether the point can be used.
    pub fn is_ok(self) -> bool {
        self == Status::Converged
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Displacement and its derivatives at the centre pixel of the subset; lengths in pixels, index
/// 0…5: value, ∂x, ∂y, ∂²x, ∂x∂y, ∂²y. What the shape function does not have is zero.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ShapeParameters {
    /// u, u_x, u_y, u_xx, u_xy, u_yy.
    pub u: [f32; 6],
    /// v, v_x, v_y, v_xx, v_xy, v_yy.
    pub v: [f32; 6],
}

/// Result at one point. Displacements are Lagrangian: the material at (x, y) in the reference image
/// is at (x + u, y + v) in the deformed one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Position in the reference image, pixels.
    pub x: f64,
    /// Position in the reference image, pixels.
    pub y: f64,
    /// Displacement along x, pixels; NaN where nothing was measured.
    pub u: f64,
    /// Displacement along y, pixels; NaN where nothing was measured.
    pub v: f64,
    /// Standard uncertainty of u from image noise, pixels; NaN where unknown.
    pub sigma_u: f32,
    /// Standard uncertainty of v from image noise, pixels; NaN where unknown.
    pub sigma_v: f32,
    /// Zero-normalised cross-correlation of the subset, −1…1; NaN where unknown. The ZNSSD
    /// criterion is 2 (1 − zncc).
    pub zncc: f32,
    /// Sweeps over the subset of the final attempt, Levenberg–Marquardt included; of a dense point, the
    /// passes over the image (1 or 2).
    pub iterations: u16,
    /// Verdict. Where it is not `Converged`, u, v and the rest are what the last attempt left, for
    /// diagnosis only.
    pub status: Status,
    /// Which form of the optimisation gave the numbers.
    pub solver: SolvedBy,
    /// Parameters of the shape function at the subset's centre pixel (the pixel nearest (x, y)).
    pub shape: ShapeParameters,
}
