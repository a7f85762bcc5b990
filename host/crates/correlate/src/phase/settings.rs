//! Settings of a phase analysis, and what can be wrong with it.

use crate::image::ImageError;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Form of the analysis window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WindowKind {
    /// Gaussian (Sur & Grédiac 2014): the best joint localisation in space and frequency.
    #[default]
    Gaussian,
    /// Gaussian times the polynomial that makes its second moment vanish: quadratic phase passes
    /// unattenuated, at 1.7 times the noise of the plain Gaussian of the same width.
    GaussianFlat,
    /// Product of two triangles (Surrel; Badulescu et al. 2009): zeros at the grating's harmonics
    /// where the width is a whole number of pitches.
    BiTriangular,
}

impl WindowKind {
    /// Stable name.
    pub fn name(self) -> &'static str {
        match self {
            WindowKind::Gaussian => "gaussian",
            WindowKind::GaussianFlat => "gaussian_flat",
            WindowKind::BiTriangular => "bi_triangular",
        }
    }
}

/// Which gratings an image shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Gratings {
    /// What the spectrum shows.
    #[default]
    Auto,
    /// Parallel lines.
    Line,
    /// Two directions.
    Cross,
}

/// Settings of a phase analysis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PhaseSettings {
    /// Form of the analysis window.
    pub window: WindowKind,
    /// Width of the window in pitches: standard deviation of the Gaussians, half the base of the
    /// triangle.
    pub width: f64,
    /// Directions to look for.
    pub gratings: Gratings,
    /// Pitch in pixels to look for, to within ±25 %; `None`: the strongest pattern.
    pub pitch: Option<f64>,
    /// Standard deviation of the image noise in grey levels; `None`: estimated from the floor of the
    /// image's spectrum.
    pub noise: Option<f64>,
    /// Modulation, relative to that of the best tenth of the pattern, below which a pixel has no phase.
    pub min_modulation: f64,
    /// Degree of the polynomial in x and y that follows the local carrier.
    pub tracking: usize,
}

impl Default for PhaseSettings {
    fn default() -> Self {
        Self {
            window: WindowKind::Gaussian,
            width: 2.5,
            gratings: Gratings::Auto,
            pitch: None,
            noise: None,
            min_modulation: 0.3,
            tracking: 5,
        }
    }
}

/// Why an image gave no phase.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PhaseError {
    /// A number outside its range.
    #[error("{name} = {value} is outside {min}..={max}")]
    Range {
        /// Name of the setting.
        name: &'static str,
        /// Value given.
        value: f64,
        /// Smallest accepted.
        min: f64,
        /// Largest accepted.
        max: f64,
    },
    /// The mask does not fit the image.
    #[error("the mask has {mask_width}×{mask_height} pixels, the image {width}×{height}")]
    MaskSize {
        /// Columns of the mask.
        mask_width: usize,
        /// Rows of the mask.
        mask_height: usize,
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
    },
    /// Too few pixels to see a period in.
    #[error("an image of {width}×{height} pixels is too small for a grating: at least {min}×{min}")]
    TooSmall {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Smallest side.
        min: usize,
    },
    /// Every pixel that may be used has the same grey level.
    #[error("every pixel has grey level {level}: there is no pattern")]
    Constant {
        /// The level.
        level: f32,
    },
    /// Nothing periodic stands out of the spectrum.
    #[error(
        "no periodic pattern: the strongest line of the spectrum stands {found:.1} times above its surroundings, {required} are required"
    )]
    NoPattern {
        /// Power of the strongest line over the power beside it.
        found: f64,
        /// Least accepted.
        required: f64,
    },
    /// Two directions were asked for and one was found.
    #[error("only one grating direction was found (pitch {pitch:.2} px at {angle_deg:.1}°), two are needed")]
    OneDirection {
        /// Pitch of the one that was found, pixels.
        pitch: f64,
        /// Angle of its normal against the x axis, degrees.
        angle_deg: f64,
    },
    /// The pitch is too small to be sampled.
    #[error("the pitch of {pitch:.2} px is below {min} px: the grating is aliased by the pixels")]
    Aliased {
        /// Pitch, pixels.
        pitch: f64,
        /// Smallest accepted.
        min: f64,
    },
    /// The window does not fit into the image, or the image and its mask leave no pixel with a
    /// whole window.
    #[error(
        "no window of {side}×{side} pixels (width {width_in_pitches} pitches of {pitch:.2} px) fits into the pattern: use a narrower window"
    )]
    WindowTooLarge {
        /// Side of the window, pixels.
        side: usize,
        /// Its width in pitches.
        width_in_pitches: f64,
        /// Pitch, pixels.
        pitch: f64,
    },
    /// Two analyses that do not belong together.
    #[error(
        "reference and deformed image do not show the same grating: pitch {reference:.2} px at {reference_deg:.1}° against {deformed:.2} px at {deformed_deg:.1}°"
    )]
    DifferentGratings {
        /// Pitch in the reference, pixels.
        reference: f64,
        /// Angle of its normal, degrees.
        reference_deg: f64,
        /// Pitch in the deformed image, pixels.
        deformed: f64,
        /// Angle of its normal, degrees.
        deformed_deg: f64,
    },
    /// Two images of different size, or not finite.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// Two images of different size.
    #[error("the deformed image has {found_width}×{found_height} pixels, the reference {width}×{height}")]
    SizesDiffer {
        /// Columns of the deformed image.
        found_width: usize,
        /// Rows of the deformed image.
        found_height: usize,
        /// Columns of the reference.
        width: usize,
        /// Rows of the reference.
        height: usize,
    },
}

impl PhaseSettings {
    /// Smallest pitch accepted, pixels: the fundamental of a finer grating is close to the aliases
    /// of its own harmonics.
    pub const MIN_PITCH: f64 = 3.0;

    /// Checks every value.
    ///
    /// # Errors
    /// [`PhaseError::Range`] with the setting's name and limits.
    pub fn validate(&self) -> Result<(), PhaseError> {
        let range = |name, value: f64, min, max| {
            // not-a-number is refused too
            if value >= min && value <= max {
                Ok(())
            } else {
                Err(PhaseError::Range { name, value, min, max })
            }
        };
        // a Gaussian below 0.75 pitches lets the background through; a triangle reaches less far
        let least = if self.window == WindowKind::BiTriangular { 1.0 } else { 0.75 };
        range("width", self.width, least, 20.0)?;
        if let Some(pitch) = self.pitch {
            range("pitch", pitch, Self::MIN_PITCH, 1000.0)?;
        }
        if let Some(noise) = self.noise {
            range("noise", noise, 0.0, 1e9)?;
        }
        range("min_modulation", self.min_modulation, 0.0, 1.0)?;
        range("tracking", self.tracking as f64, 1.0, 8.0)
    }
}
