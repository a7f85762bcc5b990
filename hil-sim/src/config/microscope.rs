//! The microscope with a grating.

use daic_optics::microscope::{Geometry, Objective, Relay};
use daic_optics::{Grating, Substrate, SubstrateSide};
use serde::{Deserialize, Serialize};

use super::GratingConfig;

/// The true geometry of a microscope: two objectives relay the specimen to an intermediate image with the field stop,
/// a grating in front of it, a third objective, the sensor. Formulas and conventions as in `daic_optics::microscope`.
///
/// The defaults show 320 × 340 µm at 0.53 µm per pixel twice on 1440 × 720 pixels, in light of 450 nm through a
/// grating of 2 µm (13.0°).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MicroscopeConfig {
    /// Wavelength.
    pub wavelength_mm: f64,
    /// Lateral magnification of the relay; below 0 if its image is turned.
    pub relay_magnification: f64,
    /// Index of refraction around the specimen.
    pub relay_index: f64,
    /// κ: relative fall of the relay's magnification with the height; 0 if telecentric.
    pub relay_perspective_per_mm: f64,
    /// Grating to intermediate image.
    pub grating_to_image_mm: f64,
    /// The grating in the path of the −1 view, and of the +1 view unless that has its own.
    pub grating: GratingConfig,
    /// The grating in the path of the +1 view, if it is another one.
    pub grating_plus: Option<GratingConfig>,
    /// Magnification of objective 3.
    pub objective_magnification: f64,
    /// Distance from the grating to the plane to which κ₃ belongs.
    pub objective_focus_mm: f64,
    /// κ₃: reciprocal distance from objective 3's entrance pupil to that plane; 0 if telecentric.
    pub objective_perspective_per_mm: f64,
    /// Pitch of the sensor's pixels.
    pub pixel_mm: f64,
    /// Where the optical axis meets the sensor; `None` takes its centre.
    pub axis_px: Option<[f64; 2]>,
    /// Sides of the field stop, on the specimen.
    pub field_mm: [f64; 2],
    /// Numerical aperture on the specimen's side: a point `w` off the sharp plane is a disk of diameter
    /// 2 w tan(asin(NA)). 0 is sharp everywhere.
    pub numerical_aperture: f64,
    /// Height of the plane that is sharp.
    pub focus_height_mm: f64,
    /// Rings of rays in the cone (1 to 8), 4 · rings rays on each.
    pub pupil_rings: usize,
}

impl Default for MicroscopeConfig {
    fn default() -> Self {
        Self {
            wavelength_mm: 450e-6,
            relay_magnification: 0.9,
            relay_index: 1.0,
            relay_perspective_per_mm: -0.3,
            grating_to_image_mm: 0.75,
            grating: GratingConfig { pitch_mm: 2e-3, ..GratingConfig::default() },
            grating_plus: None,
            objective_magnification: 11.32,
            objective_focus_mm: 0.79,
            objective_perspective_per_mm: 0.0,
            pixel_mm: 5.4e-3,
            axis_px: None,
            field_mm: [0.32, 0.34],
            numerical_aperture: 0.1,
            focus_height_mm: 0.0,
            pupil_rings: 2,
        }
    }
}

impl MicroscopeConfig {
    /// The same as exact rays take it, for a sensor of `width` × `height` pixels.
    pub fn geometry(&self, width: usize, height: usize) -> Geometry {
        let grating = |g: &GratingConfig| Grating {
            tilt_rad_xyz: g.tilt_rad,
            substrate: Substrate {
                thickness_mm: g.substrate_mm,
                index: g.substrate_index,
                side: SubstrateSide::Object,
            },
            ..Grating::square(g.pitch_mm)
        };
        let centre = [(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0];
        Geometry {
            relay: Relay {
                magnification: self.relay_magnification,
                index: self.relay_index,
                perspective_per_mm: self.relay_perspective_per_mm,
            },
            grating_to_image_mm: self.grating_to_image_mm,
            wavelength_mm: self.wavelength_mm,
            minus: grating(&self.grating),
            plus: grating(self.grating_plus.as_ref().unwrap_or(&self.grating)),
            objective: Objective {
                magnification: self.objective_magnification,
                focus_mm: self.objective_focus_mm,
                perspective_per_mm: self.objective_perspective_per_mm,
                pixel_mm: self.pixel_mm,
                axis_px: self.axis_px.unwrap_or(centre),
            },
        }
    }
}
