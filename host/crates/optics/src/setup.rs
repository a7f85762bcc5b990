//! The parameters of a set-up and their limits.

use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::grating::{Grating, SubstrateSide};
use crate::model::OpticalModel;

/// One of the two first-order views on the sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum View {
    /// The −1 view, on the left of the sensor; its virtual object lies at −x.
    Minus,
    /// The +1 view, on the right of the sensor; its virtual object lies at +x.
    Plus,
}

impl View {
    /// Both views, −1 first.
    pub const BOTH: [Self; 2] = [Self::Minus, Self::Plus];

    /// Order m in α' = α + mλ/p of a ray traced from the pinhole: +1 in the −1 view, −1 in the
    /// +1 view.
    #[inline]
    pub const fn traced_order(self) -> f64 {
        match self {
            Self::Minus => 1.0,
            Self::Plus => -1.0,
        }
    }

    /// The other view.
    pub const fn other(self) -> Self {
        match self {
            Self::Minus => Self::Plus,
            Self::Plus => Self::Minus,
        }
    }

    #[inline]
    pub(crate) const fn index(self) -> usize {
        match self {
            Self::Minus => 0,
            Self::Plus => 1,
        }
    }
}

/// Where the object coordinates lie, other than square to the optical axis.
///
/// The world point of the object point (x, y, h) is (o_x, o_y, s + d) + R·(x, y, −h) with
/// R = Rz·Ry·Rx in world axes: the reference plane h = 0 passes through (o_x, o_y, s + d) and is
/// turned by R. All zero is the plane square to the axis with its origin on it. A calibration that
/// sees a flat plate fixes the plate far better than the optical axis, so its heights count from
/// the plate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReferenceFrame {
    /// Rotation about x, y and z in radians, applied in this order.
    pub tilt_rad_xyz: [f64; 3],
    /// World x and y (mm) of the origin.
    pub origin_mm: [f64; 2],
}

/// A set-up: camera, light, distances and the grating in each view's path.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Optics {
    /// The camera.
    pub camera: Camera,
    /// Wavelength λ in millimetres.
    pub wavelength_mm: f64,
    /// Distance s from the pinhole to the gratings' pivot in millimetres.
    pub pinhole_to_grating_mm: f64,
    /// Distance d from the gratings' pivot to the reference plane h = 0 in millimetres.
    pub grating_to_reference_mm: f64,
    /// Grating in the path of the −1 view.
    pub minus: Grating,
    /// Grating in the path of the +1 view; the same as `minus` where one serves both.
    pub plus: Grating,
    /// Where the object coordinates lie.
    #[serde(default)]
    pub reference: ReferenceFrame,
}

/// A parameter outside its limits.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{field} is {value}, it must be {allowed}")]
pub struct OpticsError {
    /// Name of the field, with its parent: `minus.pitch_mm`.
    pub field: &'static str,
    /// The value found.
    pub value: f64,
    /// What is allowed.
    pub allowed: &'static str,
}

fn check(field: &'static str, value: f64, fits: bool, allowed: &'static str) -> Result<(), OpticsError> {
    if value.is_finite() && fits {
        return Ok(());
    }
    Err(OpticsError { field, value, allowed })
}

impl Optics {
    /// The grating in the path of `view`.
    pub fn grating(&self, view: View) -> &Grating {
        match view {
            View::Minus => &self.minus,
            View::Plus => &self.plus,
        }
    }

    /// Checks every parameter against its limits.
    ///
    /// # Errors
    /// The first parameter that is not finite or not allowed.
    pub fn validate(&self) -> Result<(), OpticsError> {
        const POSITIVE: &str = "a finite number above 0";
        const FINITE: &str = "a finite number";
        let c = &self.camera;
        check("camera.focal_px", c.focal_px, c.focal_px > 0.0, POSITIVE)?;
        for (field, value) in [
            ("camera.principal_point_px[0]", c.principal_point_px[0]),
            ("camera.principal_point_px[1]", c.principal_point_px[1]),
            ("camera.brown.k1", c.brown.k1),
            ("camera.brown.k2", c.brown.k2),
            ("camera.brown.k3", c.brown.k3),
            ("camera.brown.p1", c.brown.p1),
            ("camera.brown.p2", c.brown.p2),
        ] {
            check(field, value, true, FINITE)?;
        }
        for (field, value) in [
            ("wavelength_mm", self.wavelength_mm),
            ("pinhole_to_grating_mm", self.pinhole_to_grating_mm),
            ("grating_to_reference_mm", self.grating_to_reference_mm),
        ] {
            check(field, value, value > 0.0, POSITIVE)?;
        }
        let r = &self.reference;
        for (field, value) in [
            ("reference.tilt_rad_xyz[0]", r.tilt_rad_xyz[0]),
            ("reference.tilt_rad_xyz[1]", r.tilt_rad_xyz[1]),
            ("reference.tilt_rad_xyz[2]", r.tilt_rad_xyz[2]),
        ] {
            // About z a plate may lie in any direction.
            check(field, value, value.abs() <= std::f64::consts::PI, "between −π and π (radians)")?;
        }
        check("reference.origin_mm[0]", r.origin_mm[0], true, FINITE)?;
        check("reference.origin_mm[1]", r.origin_mm[1], true, FINITE)?;
        const MINUS: [&str; 7] = [
            "minus.pitch_mm",
            "minus.tilt_rad_xyz[0]",
            "minus.tilt_rad_xyz[1]",
            "minus.tilt_rad_xyz[2]",
            "minus.substrate.thickness_mm",
            "minus.substrate.index",
            "minus.offset_mm",
        ];
        const PLUS: [&str; 7] = [
            "plus.pitch_mm",
            "plus.tilt_rad_xyz[0]",
            "plus.tilt_rad_xyz[1]",
            "plus.tilt_rad_xyz[2]",
            "plus.substrate.thickness_mm",
            "plus.substrate.index",
            "plus.offset_mm",
        ];
        self.check_grating(&self.minus, MINUS)?;
        self.check_grating(&self.plus, PLUS)
    }

    fn check_grating(&self, g: &Grating, names: [&'static str; 7]) -> Result<(), OpticsError> {
        check(
            names[0],
            g.pitch_mm,
            g.pitch_mm > self.wavelength_mm,
            "a finite number above wavelength_mm, else the first order does not exist",
        )?;
        for (tilt, name) in g.tilt_rad_xyz.into_iter().zip(&names[1..4]) {
            check(name, tilt, tilt.abs() < std::f64::consts::FRAC_PI_2, "between −π/2 and π/2 (radians)")?;
        }
        // Room in front of the grooves and behind them.
        let (front, back) =
            (self.pinhole_to_grating_mm + g.offset_mm, self.grating_to_reference_mm - g.offset_mm);
        check(
            names[6],
            g.offset_mm,
            front > 0.0 && back > 0.0,
            "above −pinhole_to_grating_mm and below grating_to_reference_mm",
        )?;
        let s = &g.substrate;
        let (room, allowed) = match s.side {
            SubstrateSide::Camera => (front, "at least 0 and below pinhole_to_grating_mm"),
            SubstrateSide::Object => (back, "at least 0 and below grating_to_reference_mm"),
        };
        let fits = s.thickness_mm >= 0.0 && s.thickness_mm < room;
        check(names[4], s.thickness_mm, fits, allowed)?;
        check(names[5], s.index, s.index >= 1.0, "a finite number, at least 1")
    }

    /// The set-up, validated and prepared for decoding and projecting.
    ///
    /// # Errors
    /// As [`Optics::validate`].
    pub fn model(&self) -> Result<OpticalModel, OpticsError> {
        OpticalModel::new(self)
    }
}

#[cfg(test)]
pub(crate) mod tests_support {
    use super::*;

    /// Some set-up.
    pub(crate) fn any() -> Optics {
        Optics {
            camera: Camera {
                focal_px: 17956.2,
                principal_point_px: [1295.5, 971.5],
                brown: Default::default(),
            },
            wavelength_mm: 633e-6,
            pinhole_to_grating_mm: 307.0,
            grating_to_reference_mm: 109.0,
            minus: Grating::square(1.0 / 300.0),
            plus: Grating::square(1.0 / 300.0),
            reference: ReferenceFrame::default(),
        }
    }
}
