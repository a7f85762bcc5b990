//! Numbers for lining up camera, laser and gratings before a measurement.
//!
//! * [`spots`]: centres of laser spots and of an aperture in an image.
//! * [`axis`]: camera against rail, laser against camera: a mark seen at two distances.
//! * [`orders`]: the spots of orders −1, 0, +1: rotation of the grooves, tilt of the grating.
//! * [`distance`]: pinhole to board from a known length, pinhole to grating.
//!
//! Everything carries its standard deviation. Angles are rotations in the axes of the camera (x right,
//! y down, z away from the camera), positive as in R = Rz·Ry·Rx.

pub mod axis;
pub mod distance;
pub mod orders;
pub mod spots;

use serde::{Deserialize, Serialize};

/// A value and its standard deviation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// The value.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

impl Measured {
    /// A value with its standard deviation.
    pub fn new(value: f64, sigma: f64) -> Self {
        Self { value, sigma }
    }

    /// Whether the value is more than `factor` standard deviations from zero.
    pub fn stands_out(&self, factor: f64) -> bool {
        self.value.abs() > factor * self.sigma
    }
}

/// Why an alignment step has no answer.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// Not as many spots as the step needs.
    #[error(
        "{found} spots were found, {needed} are needed; is the picture overexposed, or does a reflection hide one?"
    )]
    Spots {
        /// Found.
        found: usize,
        /// Needed.
        needed: usize,
    },
    /// No aperture.
    #[error("no bright or dark disc at least 6 pixels wide stands out of the picture")]
    NoDisc,
    /// The model did not fit a spot.
    #[error(
        "the spot near ({x:.0}, {y:.0}) cannot be measured: it is cut off, saturated to its rim or no single spot"
    )]
    Unfit {
        /// Column.
        x: f64,
        /// Row.
        y: f64,
    },
    /// A number out of range.
    #[error("{name} is {value}, it must be {allowed}")]
    Value {
        /// Which one.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// Outer spots that do not belong to orders −1 and +1 of one grating.
    #[error(
        "the outer spots lie {left:.1} and {right:.1} px from the middle one: these are not orders −1, 0 and +1 of one beam"
    )]
    NotOrders {
        /// From the middle to the left.
        left: f64,
        /// From the middle to the right.
        right: f64,
    },
    /// A pixel from which the camera model gives no direction.
    #[error(transparent)]
    Undistort(#[from] crate::camera::UndistortError),
}

pub(crate) fn above_zero(name: &'static str, value: f64) -> Result<f64, AlignError> {
    // Negated so that NaN is refused.
    if !(value > 0.0 && value.is_finite()) {
        return Err(AlignError::Value { name, value, allowed: "above 0" });
    }
    Ok(value)
}
