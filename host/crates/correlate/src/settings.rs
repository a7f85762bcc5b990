//! Settings of a correlation and their validation.

use crate::shape::Shape;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Interpolation of the deformed image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// Cubic B-spline: faster, with a systematic error of a few thousandths of a pixel for fine
    /// speckles.
    Cubic,
    /// Quintic B-spline.
    #[default]
    Quintic,
    /// Septic B-spline: slower, with the smallest systematic error at sub-pixel displacements.
    Septic,
}

/// Which form of the optimisation solves the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SolverChoice {
    /// The dense form where it is valid, the exact form everywhere else.
    #[default]
    Auto,
    /// The dense form alone: points where it is not valid are reported as such.
    Dense,
    /// Every point by its own Gauss–Newton iteration; on a grid the dense form gives the start.
    Exact,
}

/// What is minimised over a subset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Criterion {
    /// Zero-normalised sum of squared differences: blind to brightness and contrast.
    #[default]
    Znssd,
    /// Zero-mean sum of squared differences: blind to brightness alone.
    Zssd,
}

/// Settings of a subset correlation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Width and height of the subset, an odd number of pixels.
    pub subset: usize,
    /// Order of the shape function.
    pub shape: Shape,
    /// Interpolation of the deformed image.
    pub interpolation: Interpolation,
    /// What is minimised.
    pub criterion: Criterion,
    /// Which form of the optimisation is used.
    pub solver: SolverChoice,
    /// The iteration stops when the increment moves no pixel on the subset's edge by more than
    /// about this many pixels.
    pub tolerance: f64,
    /// Iterations after which an attempt counts as not converged.
    pub max_iterations: u32,
    /// Whether points where Gauss–Newton diverges or reaches the cap are tried again by
    /// Levenberg–Marquardt.
    pub fallback: bool,
    /// Whether points whose subset straddles a step, a crack or the edge of an object are looked for
    /// and solved again with their own side of it.
    pub discontinuities: bool,
    /// Zero-normalised cross-correlation below which a point is not accepted, whatever its
    /// statistical significance.
    pub min_zncc: f64,
    /// How far above chance the ZNCC of a point must lie, in standard deviations of Fisher's
    /// z for unrelated speckles of the same size; 0 turns the test off.
    pub significance: f64,
    /// Largest |ln λ| of a principal stretch λ of the subset.
    pub max_log_stretch: f64,
    /// Disagreement, in pixels, between neighbouring points (each extrapolated to the middle
    /// between them) above which they do not confirm each other.
    pub consistency: f64,
    /// Standard deviation of the noise of one image in grey levels. `None`: estimated at every
    /// point from the residuals.
    pub noise: Option<f64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            subset: 33,
            shape: Shape::Affine,
            interpolation: Interpolation::Quintic,
            criterion: Criterion::Znssd,
            solver: SolverChoice::Auto,
            tolerance: 1e-3,
            max_iterations: 30,
            fallback: true,
            discontinuities: true,
            min_zncc: 0.5,
            significance: 5.0,
            max_log_stretch: 0.4,
            consistency: 0.5,
            noise: None,
        }
    }
}

/// A setting that cannot be used, with its limit.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SettingsError {
    /// The subset has no centre pixel.
    #[error("the subset must be an odd number of pixels, {subset} is even: use {} or {}", subset.saturating_sub(1), subset + 1)]
    EvenSubset {
        /// Value given.
        subset: usize,
    },
    /// The subset is too small for its shape function, or too large to be meant.
    #[error("a subset of {subset} pixels is outside {min}..={max}")]
    SubsetRange {
        /// Value given.
        subset: usize,
        /// Smallest for the shape function.
        min: usize,
        /// Largest.
        max: usize,
    },
    /// The subset does not fit into the image.
    #[error("a subset of {subset} pixels does not fit into an image of {width}×{height} pixels")]
    SubsetLargerThanImage {
        /// Value given.
        subset: usize,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
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
}

impl Settings {
    /// Largest subset accepted.
    pub const MAX_SUBSET: usize = 1001;

    /// Half width of the subset in pixels, its centre not counted.
    pub fn radius(&self) -> usize {
        self.subset / 2
    }

    /// Checks every value.
    ///
    /// # Errors
    /// The first [`SettingsError`] found.
    pub fn validate(&self) -> Result<(), SettingsError> {
        let min = match self.shape {
            Shape::Translation => 5,
            Shape::Affine => 7,
            Shape::Quadratic => 11,
        };
        let max = Self::MAX_SUBSET;
        if !(min..=max).contains(&self.subset) {
            return Err(SettingsError::SubsetRange { subset: self.subset, min, max });
        }
        if self.subset.is_multiple_of(2) {
            return Err(SettingsError::EvenSubset { subset: self.subset });
        }
        let ranges = [
            ("tolerance", self.tolerance, 1e-6, 1.0),
            ("max_iterations", f64::from(self.max_iterations), 1.0, 1000.0),
            ("min_zncc", self.min_zncc, 0.0, 1.0),
            ("significance", self.significance, 0.0, 100.0),
            ("max_log_stretch", self.max_log_stretch, 1e-3, 2.0),
            ("consistency", self.consistency, 1e-3, 100.0),
            ("noise", self.noise.unwrap_or(1.0), 1e-6, 65535.0),
        ];
        for (name, value, min, max) in ranges {
            if !(min..=max).contains(&value) {
                return Err(SettingsError::Range { name, value, min, max });
            }
        }
        Ok(())
    }

    /// Checks every value against the size of the images.
    ///
    /// # Errors
    /// As [`Settings::validate`], and [`SettingsError::SubsetLargerThanImage`].
    pub fn validate_for(&self, width: usize, height: usize) -> Result<(), SettingsError> {
        self.validate()?;
        if self.subset > width || self.subset > height {
            return Err(SettingsError::SubsetLargerThanImage { subset: self.subset, width, height });
        }
        Ok(())
    }
}
