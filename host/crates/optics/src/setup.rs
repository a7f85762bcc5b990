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

/// A quantity of the set-up that can be estimated or carry an uncertainty.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Parameter {
    /// [`Camera::focal_px`].
    FocalPx,
    /// [`Optics::pinhole_to_grating_mm`].
    PinholeToGrating,
    /// [`Optics::grating_to_reference_mm`].
    GratingToReference,
}

impl Parameter {
    /// Every parameter, in the order used for vectors and matrices over all of them.
    pub const ALL: [Self; 3] = [Self::FocalPx, Self::PinholeToGrating, Self::GratingToReference];

    /// Name of the field it stands for.
    pub const fn name(self) -> &'static str {
        match self {
            Self::FocalPx => "camera.focal_px",
            Self::PinholeToGrating => "pinhole_to_grating_mm",
            Self::GratingToReference => "grating_to_reference_mm",
        }
    }

    /// Its value in `optics`.
    pub fn get(self, optics: &Optics) -> f64 {
        match self {
            Self::FocalPx => optics.camera.focal_px,
            Self::PinholeToGrating => optics.pinhole_to_grating_mm,
            Self::GratingToReference => optics.grating_to_reference_mm,
        }
    }

    /// Sets it in `optics`, unchecked.
    pub fn set(self, optics: &mut Optics, value: f64) {
        match self {
            Self::FocalPx => optics.camera.focal_px = value,
            Self::PinholeToGrating => optics.pinhole_to_grating_mm = value,
            Self::GratingToReference => optics.grating_to_reference_mm = value,
        }
    }
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
        const MINUS: [&str; 6] = [
            "minus.pitch_mm",
            "minus.tilt_rad_xyz[0]",
            "minus.tilt_rad_xyz[1]",
            "minus.tilt_rad_xyz[2]",
            "minus.substrate.thickness_mm",
            "minus.substrate.index",
        ];
        const PLUS: [&str; 6] = [
            "plus.pitch_mm",
            "plus.tilt_rad_xyz[0]",
            "plus.tilt_rad_xyz[1]",
            "plus.tilt_rad_xyz[2]",
            "plus.substrate.thickness_mm",
            "plus.substrate.index",
        ];
        self.check_grating(&self.minus, MINUS)?;
        self.check_grating(&self.plus, PLUS)
    }

    fn check_grating(&self, g: &Grating, names: [&'static str; 6]) -> Result<(), OpticsError> {
        check(
            names[0],
            g.pitch_mm,
            g.pitch_mm > self.wavelength_mm,
            "a finite number above wavelength_mm, else the first order does not exist",
        )?;
        for (tilt, name) in g.tilt_rad_xyz.into_iter().zip(&names[1..4]) {
            check(name, tilt, tilt.abs() < std::f64::consts::FRAC_PI_2, "between −π/2 and π/2 (radians)")?;
        }
        let s = &g.substrate;
        let (room, allowed) = match s.side {
            SubstrateSide::Camera => {
                (self.pinhole_to_grating_mm, "at least 0 and below pinhole_to_grating_mm")
            }
            SubstrateSide::Object => {
                (self.grating_to_reference_mm, "at least 0 and below grating_to_reference_mm")
            }
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
