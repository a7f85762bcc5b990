//! `[optics]`: what the light passes through.

use crate::units::{Angle, Length, PerLength, Pixels};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Camera, grating and the distances between them.
///
/// Lengths along the optical axis from the pinhole; image coordinates in pixels, (0, 0) the centre
/// of the first pixel, x to the right, y down.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Optics {
    /// Mean wavelength λ.
    pub wavelength: Length,
    /// s: pinhole to grating.
    pub pinhole_to_grating: Length,
    /// d: grating to reference plane (h = 0).
    pub grating_to_reference: Length,
    /// F = f/b: pinhole to image plane in pixels.
    pub focal: Pixels,
    /// Where the optical axis meets the sensor (x, y).
    pub principal_point: [Pixels; 2],
    /// Pitch b of the sensor's pixels; only needed to state sizes on the sensor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixel: Option<Length>,
    /// Lens distortion; left out, none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub brown: Option<Brown>,
    /// One grating for both views.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grating: Option<Grating>,
    /// Grating of the −1 view (left on the sensor).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grating_minus: Option<Grating>,
    /// Grating of the +1 view (right on the sensor).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grating_plus: Option<Grating>,
}

impl Optics {
    /// Gratings of the −1 and of the +1 view; `None` only if the optics were not checked.
    pub fn gratings(&self) -> Option<[&Grating; 2]> {
        match (&self.grating, &self.grating_minus, &self.grating_plus) {
            (Some(both), None, None) => Some([both, both]),
            (None, Some(minus), Some(plus)) => Some([minus, plus]),
            _ => None,
        }
    }
}

/// Brown–Conrady distortion, acting on normalised image coordinates (x/F, y/F); dimensionless.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Brown {
    /// Radial, second order.
    pub k1: f64,
    /// Radial, fourth order.
    pub k2: f64,
    /// Radial, sixth order.
    pub k3: f64,
    /// Tangential.
    pub p1: f64,
    /// Tangential.
    pub p2: f64,
}

/// A transmission grating and its pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Grating {
    /// Distance p between grooves; this or `lines`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pitch: Option<Length>,
    /// Grooves per length; this or `pitch`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lines: Option<PerLength>,
    /// Rotations about x, y, z: R = Rz·Ry·Rx about the point where the axis meets the grating.
    #[serde(default = "no_tilt")]
    pub tilt: [Angle; 3],
    /// Glass behind the grating (object side); left out, none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub substrate: Option<Substrate>,
}

impl Grating {
    /// Groove distance in millimetres; `None` only if the grating was not checked.
    pub fn pitch_mm(&self) -> Option<f64> {
        match (self.pitch, self.lines) {
            (Some(pitch), None) => Some(pitch.mm()),
            (None, Some(lines)) => Some(1.0 / lines.per_mm()),
            _ => None,
        }
    }
}

/// The glass plate that carries a grating.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Substrate {
    /// Thickness.
    pub thickness: Length,
    /// Refractive index.
    pub index: f64,
}

/// A file that holds optics alone, such as a calibration writes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "daic optics")]
pub struct OpticsFile {
    /// `daic-optics/1`; left out, the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub format: Option<String>,
    /// Where the values come from, free text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<String>,
    /// The optics.
    pub optics: Optics,
}

impl OpticsFile {
    /// The only format there is.
    pub const FORMAT: &'static str = "daic-optics/1";
}

fn no_tilt() -> [Angle; 3] {
    [Angle::new(0.0); 3]
}
