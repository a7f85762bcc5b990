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
    /// Where the object coordinates lie; left out, square to the optical axis with the origin on it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference: Option<Reference>,
}

/// A reference plane that is not square to the optical axis, such as a calibration plate gives it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Reference {
    /// Rotations about x, y, z: R = Rz·Ry·Rx about the point on the axis at h = 0.
    #[serde(default = "no_tilt")]
    pub tilt: [Angle; 3],
    /// Where the origin lies beside the optical axis (x, y).
    pub origin: [Length; 2],
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
    /// How far it lies behind `pinhole_to_grating`; left out, not at all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset: Option<Length>,
    /// Glass that carries the grooves; left out, none.
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
    /// Side of the grooves on which the glass lies; left out, `object`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub side: Option<Side>,
}

/// Side of a grating.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// Towards the camera.
    Camera,
    /// Towards the object.
    Object,
}

/// Covariance of calibrated values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Covariance {
    /// What the rows and columns are, such as `camera.focal_px` or `minus.pitch_mm`; the name ends
    /// in the unit, angles (`tilt_rad_xyz`) are in radians.
    pub parameters: Vec<String>,
    /// The symmetric matrix, row by row, in these units.
    pub matrix: Vec<Vec<f64>>,
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
    /// When they were found: date, or date and time (RFC 3339).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub date: Option<String>,
    /// The optics.
    pub optics: Optics,
    /// How sure its values are, in common for all points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance: Option<Covariance>,
    /// Dense distortion maps on top of `optics.brown`; left out, none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub maps: Option<Maps>,
    /// Where it was calibrated; left out, points are taken wherever they lie.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub volume: Option<Volume>,
}

/// Files of distortion maps. What is given adds up.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Maps {
    /// For every pixel, whichever view it belongs to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<MapFile>,
    /// For pixels of the −1 view, taken through the grating.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub minus: Option<MapFile>,
    /// For pixels of the +1 view, taken through the grating.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plus: Option<MapFile>,
}

/// A file beside this one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MapFile {
    /// Its path, from the folder of this file on.
    pub file: String,
    /// CRC-64/XZ of its bytes, 16 hexadecimal digits: another map than the one meant is refused.
    pub crc64: String,
}

/// A box of object coordinates, each from the smallest to the largest.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// To the right.
    pub x: [Length; 2],
    /// Down.
    pub y: [Length; 2],
    /// Towards the camera.
    pub h: [Length; 2],
}

impl OpticsFile {
    /// The only format there is.
    pub const FORMAT: &'static str = "daic-optics/1";
}

fn no_tilt() -> [Angle; 3] {
    [Angle::new(0.0); 3]
}
