//! Calibration from material points tracked through known moves of a stage.
//!
//! Each point is seen in both views in some of K frames; between frames the specimen is moved by
//! known displacements along the object axes. Where the points are is not known: three unknowns
//! per point are estimated with the parameters and eliminated from the normal equations (Schur
//! complement). The residuals are the four pixel coordinates of every observation against the
//! forward model, each divided by its standard deviation.
//!
//! # What moves determine
//!
//! * An in-plane move gives the lateral scale, a z move the change of disparity with height.
//!   With the grating's λ/p known, F and s follow from both; without a z move they all but
//!   trade against each other and the calibration refuses ([`CalibrateError::Undetermined`]).
//! * d is where the heights are counted from. Moves say nothing about it; it follows from
//!   [`Settings::reference_height_mm`], the mean height given to the points at displacement zero.
//!
//! # Outliers
//!
//! A first fit uses Huber's loss, scaled by the median absolute residual. Observations beyond
//! [`Settings::outlier_limit`] are then left out and the rest is fitted by least squares, until
//! the selection stays the same.

mod normal;
mod solve;

use nalgebra::{DMatrix, Vector3};
use serde::{Deserialize, Serialize};

use crate::decode::PixelPair;
use crate::parameter::Parameter;
use crate::setup::{Optics, OpticsError};

/// A point seen in both views of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Its pixels.
    pub pair: PixelPair,
    /// Standard deviations of (x₋, y₋, x₊, y₊) in pixels, taken as independent.
    pub sigma_px: [f64; 4],
}

/// One material point: an entry for each frame, none where it was not found.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackedPoint {
    /// As many entries as there are frames.
    pub frames: Vec<Option<Observation>>,
}

/// What moves can determine without knowing the specimen. Everything else needs a plate seen in
/// several poses: [`bundle`](crate::bundle).
pub const SUPPORTED: [Parameter; 3] =
    [Parameter::FocalPx, Parameter::PinholeToGrating, Parameter::GratingToReference];

/// What to estimate and when to be content.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Settings {
    /// Parameters to estimate, of [`SUPPORTED`]; the others keep their starting values.
    pub parameters: Vec<Parameter>,
    /// Mean height (mm) of the points used at displacement zero: the datum that fixes
    /// [`Parameter::GratingToReference`]. Not needed for the others.
    pub reference_height_mm: Option<f64>,
    /// Largest residual in standard deviations (or in robust standard deviations of the
    /// residuals, if those are larger) before an observation is left out.
    pub outlier_limit: f64,
    /// Largest fraction of observations that may be left out.
    pub max_outlier_fraction: f64,
    /// Largest standard deviation of a parameter relative to its value before it counts as
    /// undetermined.
    pub max_relative_sigma: f64,
    /// Most linearisations in one fit.
    pub max_iterations: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            parameters: SUPPORTED.to_vec(),
            reference_height_mm: Some(0.0),
            outlier_limit: 5.0,
            max_outlier_fraction: 0.2,
            max_relative_sigma: 0.01,
            max_iterations: 60,
        }
    }
}

/// An estimated parameter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Which one.
    pub parameter: Parameter,
    /// Value it started from.
    pub start: f64,
    /// Estimate, in the unit of its field.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// Result of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// The set-up with the estimates put in.
    pub optics: Optics,
    /// The estimates, in the order of [`Settings::parameters`].
    pub estimates: Vec<Estimate>,
    /// Their covariance. Follows from the standard deviations of the observations; multiplied by
    /// the reduced χ² where that exceeds 1, because those were then too small.
    pub covariance: DMatrix<f64>,
    /// RMS of the residuals used, in pixels.
    pub rms_px: f64,
    /// χ² divided by the degrees of freedom; about 1 if the model and the standard deviations
    /// describe the data.
    pub chi_square_reduced: f64,
    /// Residuals (pixel coordinates) used minus parameters and point coordinates.
    pub degrees_of_freedom: usize,
    /// Points used.
    pub points: usize,
    /// Observations used.
    pub observations: usize,
    /// Observations left out as outliers or because the start could not decode or project them,
    /// as (point, frame).
    pub rejected: Vec<(usize, usize)>,
    /// Linearisations used by all fits together.
    pub iterations: usize,
}

impl Calibration {
    /// The estimate of a parameter, if it was estimated.
    pub fn estimate(&self, parameter: Parameter) -> Option<&Estimate> {
        self.estimates.iter().find(|e| e.parameter == parameter)
    }
}

/// Why no calibration came out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// The starting values are not a possible set-up.
    #[error("starting values: {0}")]
    Optics(#[from] OpticsError),
    /// No parameter to estimate was named, or one twice.
    #[error("the list of parameters to estimate is empty or names one twice")]
    Parameters,
    /// A parameter that tracked points of unknown shape are not asked to determine.
    #[error("{} cannot be estimated from moves of a specimen of unknown shape", .0.name())]
    Unsupported(Parameter),
    /// A setting is out of its limits.
    #[error("setting {name} is {value}, it must be {allowed}")]
    Setting {
        /// Which one.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A displacement is not finite.
    #[error("the displacement of frame {frame} is not finite")]
    Displacement {
        /// The frame.
        frame: usize,
    },
    /// A point has not as many entries as there are frames.
    #[error("point {point} has {found} entries for {expected} frames")]
    FrameCount {
        /// The point.
        point: usize,
        /// Entries found.
        found: usize,
        /// Frames, one for each displacement.
        expected: usize,
    },
    /// A standard deviation is not a finite number above zero.
    #[error("point {point}, frame {frame}: standard deviation {value} px, it must be above 0")]
    Sigma {
        /// The point.
        point: usize,
        /// The frame.
        frame: usize,
        /// Its value.
        value: f64,
    },
    /// Not enough data for the unknowns.
    #[error(
        "{residuals} pixel coordinates of {points} usable points cannot determine {unknowns} unknowns: track more points through more frames"
    )]
    TooFewData {
        /// Usable points.
        points: usize,
        /// Usable pixel coordinates.
        residuals: usize,
        /// Parameters and point coordinates.
        unknowns: usize,
    },
    /// The data do not fix a parameter.
    #[error(
        "the data do not determine {}: its standard deviation would be {sigma:.3e}, allowed is {limit:.3e}; {}",
        parameter.name(), remedy(*parameter)
    )]
    Undetermined {
        /// The parameter.
        parameter: Parameter,
        /// Its standard deviation (infinite if the normal equations are singular).
        sigma: f64,
        /// The largest allowed.
        limit: f64,
    },
    /// grating_to_reference_mm is to be estimated without a datum for the heights.
    #[error(
        "grating_to_reference_mm cannot be estimated from moves alone: give the mean height of the points in the reference position"
    )]
    NoReferenceHeight,
    /// Too many observations disagree with the model.
    #[error(
        "{rejected} of {observations} observations disagree with the model; at most {limit} may: wrong displacements, swapped views or bad tracking"
    )]
    TooManyOutliers {
        /// Left out.
        rejected: usize,
        /// All.
        observations: usize,
        /// Largest number allowed.
        limit: usize,
    },
    /// The iteration did not come to rest.
    #[error(
        "no convergence in {iterations} iterations: the displacements do not belong to these frames, or the starting values are too far off"
    )]
    NotConverged {
        /// Iterations made.
        iterations: usize,
    },
}

fn remedy(parameter: Parameter) -> &'static str {
    match parameter {
        Parameter::FocalPx | Parameter::PinholeToGrating => {
            "add frames moved along z (and in-plane) by known amounts, larger moves or more points"
        }
        _ => "add larger moves along z or more points",
    }
}

/// Estimates parameters of the set-up from tracked points.
///
/// `displacements_mm[k]` is the displacement (x, y, h; mm, object axes) of the specimen in frame k
/// relative to one position common to all frames, usually that of the first frame. The result does
/// not depend on the number of threads or the machine's load.
///
/// # Errors
/// See [`CalibrateError`].
pub fn calibrate(
    start: &Optics,
    displacements_mm: &[Vector3<f64>],
    points: &[TrackedPoint],
    settings: &Settings,
) -> Result<Calibration, CalibrateError> {
    start.validate()?;
    check_settings(settings)?;
    check_data(displacements_mm, points)?;
    solve::Problem::new(displacements_mm, points, settings).solve(start)
}

fn check_settings(s: &Settings) -> Result<(), CalibrateError> {
    let repeated = (1..s.parameters.len()).any(|i| s.parameters[..i].contains(&s.parameters[i]));
    if s.parameters.is_empty() || repeated {
        return Err(CalibrateError::Parameters);
    }
    if let Some(p) = s.parameters.iter().find(|p| !SUPPORTED.contains(p)) {
        return Err(CalibrateError::Unsupported(*p));
    }
    for (name, value) in [("outlier_limit", s.outlier_limit), ("max_relative_sigma", s.max_relative_sigma)] {
        // Negated so that NaN is refused.
        if !(value > 0.0) {
            return Err(CalibrateError::Setting { name, value, allowed: "above 0" });
        }
    }
    if !(0.0..1.0).contains(&s.max_outlier_fraction) {
        return Err(CalibrateError::Setting {
            name: "max_outlier_fraction",
            value: s.max_outlier_fraction,
            allowed: "at least 0 and below 1",
        });
    }
    if let Some(value) = s.reference_height_mm.filter(|h| !h.is_finite()) {
        return Err(CalibrateError::Setting { name: "reference_height_mm", value, allowed: "finite" });
    }
    if s.parameters.contains(&Parameter::GratingToReference) && s.reference_height_mm.is_none() {
        return Err(CalibrateError::NoReferenceHeight);
    }
    Ok(())
}

fn check_data(displacements: &[Vector3<f64>], points: &[TrackedPoint]) -> Result<(), CalibrateError> {
    if let Some(frame) = displacements.iter().position(|d| !d.iter().all(|c| c.is_finite())) {
        return Err(CalibrateError::Displacement { frame });
    }
    for (point, p) in points.iter().enumerate() {
        if p.frames.len() != displacements.len() {
            return Err(CalibrateError::FrameCount {
                point,
                found: p.frames.len(),
                expected: displacements.len(),
            });
        }
        for (frame, o) in p.frames.iter().enumerate() {
            let bad = |v: &f64| !(v.is_finite() && *v > 0.0);
            if let Some(value) = o.iter().flat_map(|o| o.sigma_px).find(bad) {
                return Err(CalibrateError::Sigma { point, frame, value });
            }
        }
    }
    Ok(())
}
