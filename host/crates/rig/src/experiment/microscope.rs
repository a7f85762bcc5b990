//! `[microscope]`: a microscope with a grating, in place of `[optics]`.

use crate::units::{Length, Pixels};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What has to be known of a microscope before it is calibrated. All else follows from the calibration frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Microscope {
    /// Form of the model.
    #[serde(default)]
    pub form: MicroscopeForm,
    /// Nominal size of a pixel on the specimen; the calibration starts from it.
    pub pixel: Length,
    /// How far the matches between the views may lie from where the two views' outlines lie upon each other.
    #[serde(default = "search")]
    pub search: Pixels,
}

/// Form of the microscope's model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MicroscopeForm {
    /// The linear formulas of the literature.
    Linear,
    /// With the denominator of a perspective image.
    #[default]
    Perspective,
}

fn search() -> Pixels {
    Pixels::new(40.0)
}
