//! The file of a calibrated microscope.

use super::{Calibration, Instrument, MicroscopeFileError, Moves};
use crate::error::Error;
use daic_dataset::atomic;
use daic_optics::microscope::calibrate::{Motion, MotionResult};
use daic_optics::microscope::{Form, Microscope, Parameters};
use nalgebra::SMatrix;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A calibrated microscope. Lengths in micrometres, as the keys say.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MicroscopeFile {
    /// `daic-microscope/1`.
    pub format: String,
    /// Program and version that wrote it.
    pub program: String,
    /// Date of the measurement or of the calibration.
    pub date: String,
    /// Where the values come from.
    pub provenance: String,
    /// The parameters.
    pub microscope: MicroscopeSection,
    /// What the calibration's points filled; left out, not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reach: Option<Reach>,
    /// How well they fit.
    pub fit: Fit,
}

/// The part of field and depth that the points of a calibration filled: beyond it points are extrapolated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reach {
    /// Lowest and highest x of midpoint pixels.
    pub x_px: [f64; 2],
    /// Lowest and highest y.
    pub y_px: [f64; 2],
    /// Lowest and highest height, µm.
    pub height_um: [f64; 2],
}

impl Reach {
    /// Part of a side by which a point may lie outside.
    const MARGIN: f64 = 0.1;

    fn of(motions: &[Motion], results: &[MotionResult]) -> Option<Self> {
        let mut sides = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
        for (motion, result) in motions.iter().zip(results).filter(|(m, _)| m.fit) {
            // a rotation's own heights are left out: its pivot may lie anywhere
            let w_um =
                if result.translation_mm[2].is_finite() { 1e3 * result.translation_mm[2] } else { 0.0 };
            for p in &motion.points {
                let h_um = 1e3 * p.height_mm;
                let [x, y] = p.middle_px;
                let values = [[x, x], [y, y], [h_um.min(h_um + w_um), h_um.max(h_um + w_um)]];
                for (side, value) in sides.iter_mut().zip(values) {
                    *side = [side[0].min(value[0]), side[1].max(value[1])];
                }
            }
        }
        let [x_px, y_px, height_um] = sides;
        (x_px[0] <= x_px[1]).then_some(Self { x_px, y_px, height_um })
    }

    /// Whether a point lies inside or hardly outside.
    pub fn covers(&self, middle_px: [f64; 2], height_mm: f64) -> bool {
        let inside = |value: f64, [low, high]: [f64; 2]| {
            let margin = Self::MARGIN * (high - low);
            (low - margin..=high + margin).contains(&value)
        };
        inside(middle_px[0], self.x_px)
            && inside(middle_px[1], self.y_px)
            && inside(1e3 * height_mm, self.height_um)
    }
}

/// The parameters and their covariance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MicroscopeSection {
    /// Form of the model.
    pub form: Form,
    /// β₁, µm/px.
    pub beta1_um_per_px: f64,
    /// β₂, µm/px.
    pub beta2_um_per_px: f64,
    /// β₃, 1/px.
    pub beta3_per_px: f64,
    /// β₄, 1/px.
    pub beta4_per_px: f64,
    /// Centre of perspective, midpoint pixels.
    pub centre_px: [f64; 2],
    /// Covariance of (β₁, β₂, β₃, β₄, x_c, y_c) in the units above.
    pub covariance: [[f64; 6]; 6],
}

/// How well a calibration fits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fit {
    /// RMS of the residuals, px.
    pub rms_px: f64,
    /// χ² over degrees of freedom.
    pub chi_square_reduced: f64,
    /// Residuals minus unknowns.
    pub degrees_of_freedom: usize,
    /// Points left out as outliers.
    pub rejected: usize,
    /// The motions.
    pub motion: Vec<FittedMotion>,
}

/// A motion of the calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FittedMotion {
    /// Its name.
    pub name: String,
    /// Whether it took part.
    pub fitted: bool,
    /// Its points.
    pub points: usize,
    /// RMS of decoded minus imposed displacement (u, v, w), µm.
    pub rms_um: [f64; 3],
}

/// What a TOML file says wrongly, with its line.
pub(super) fn toml_error(path: &Path, text: &str, e: &toml::de::Error) -> MicroscopeFileError {
    let line = e.span().map(|s| text.get(..s.start).unwrap_or("").matches('\n').count() + 1);
    let reason = e.message().trim().replace('\n', ", ");
    MicroscopeFileError { path: path.to_owned(), line, reason }
}

impl MicroscopeFile {
    /// The only format there is.
    pub const FORMAT: &'static str = "daic-microscope/1";

    pub(super) fn of(c: &Calibration, moves: &Moves, motions: &[Motion], path: &Path) -> Option<Self> {
        let (p, covariance) = (c.parameters?, c.covariance?);
        // millimetres to micrometres in β₁ and β₂
        let factor = [1e3, 1e3, 1.0, 1.0, 1.0, 1.0];
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
        let told = moves.provenance.as_ref().map(|p| format!("{p}; ")).unwrap_or_default();
        Some(Self {
            format: Self::FORMAT.to_owned(),
            program: format!("daic {}", env!("CARGO_PKG_VERSION")),
            date: moves.date.clone().unwrap_or_else(crate::camera_file::today),
            provenance: format!("{told}calibrated from {name}"),
            microscope: MicroscopeSection {
                form: c.form,
                beta1_um_per_px: p.beta1_mm_per_px * 1e3,
                beta2_um_per_px: p.beta2_mm_per_px * 1e3,
                beta3_per_px: p.beta3_per_px,
                beta4_per_px: p.beta4_per_px,
                centre_px: p.centre_px,
                covariance: std::array::from_fn(|i| {
                    std::array::from_fn(|j| covariance[(i, j)] * factor[i] * factor[j])
                }),
            },
            reach: Reach::of(motions, &c.motions),
            fit: Fit {
                rms_px: c.rms_px,
                chi_square_reduced: c.chi_square_reduced,
                degrees_of_freedom: c.degrees_of_freedom,
                rejected: c.rejected.len(),
                motion: c
                    .motions
                    .iter()
                    .map(|m| FittedMotion {
                        name: m.name.clone(),
                        fitted: m.fitted,
                        points: m.points,
                        rms_um: m.rms_mm.map(|v| v * 1e3),
                    })
                    .collect(),
            },
        })
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// The file, and the field that is wrong.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let text =
            std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        let file: Self = toml::from_str(&text).map_err(|e| toml_error(path, &text, &e))?;
        let wrong = |reason: String| MicroscopeFileError { path: path.to_owned(), line: None, reason };
        if file.format != Self::FORMAT {
            return Err(
                wrong(format!("format is \"{}\", allowed is \"{}\"", file.format, Self::FORMAT)).into()
            );
        }
        file.model([0.0; 2]).map_err(|e| wrong(format!("microscope: {e}")))?;
        let c = &file.microscope.covariance;
        for (i, row) in c.iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                let size = (c[i][i] * c[j][j]).sqrt();
                // negated: a NaN is refused too
                let fits = value.is_finite()
                    && c[i][i] >= 0.0
                    && (value - c[j][i]).abs() <= 1e-9 * size
                    && value.abs() <= size * (1.0 + 1e-9);
                if !fits {
                    return Err(wrong(format!(
                        "microscope.covariance[{i}][{j}] is {value}, no covariance: symmetric, not below 0 on the diagonal, correlations within ±1"
                    ))
                    .into());
                }
            }
        }
        let matrix = nalgebra::DMatrix::from_fn(6, 6, |i, j| c[i][j]);
        let eigenvalue = daic_optics::least_correlation_eigenvalue(&matrix);
        if eigenvalue < daic_optics::LEAST_EIGENVALUE {
            return Err(wrong(format!(
                "microscope.covariance is of no possible errors: the smallest eigenvalue of its correlations is {eigenvalue}, it must not be below 0"
            ))
            .into());
        }
        Ok(file)
    }

    /// The model, with the disparity of the plane h = 0.
    ///
    /// # Errors
    /// The first parameter that is not allowed.
    pub fn model(
        &self,
        reference_disparity_px: [f64; 2],
    ) -> Result<Microscope, daic_optics::microscope::MicroscopeError> {
        let m = &self.microscope;
        let parameters = Parameters {
            beta1_mm_per_px: m.beta1_um_per_px * 1e-3,
            beta2_mm_per_px: m.beta2_um_per_px * 1e-3,
            beta3_per_px: m.beta3_per_px,
            beta4_per_px: m.beta4_per_px,
            centre_px: m.centre_px,
        };
        Microscope::new(parameters, m.form, reference_disparity_px)
    }

    /// Whether a file says that it is a microscope's, of whatever version.
    pub fn is_one(path: &Path) -> bool {
        #[derive(Deserialize)]
        struct Head {
            format: String,
        }
        let text = std::fs::read_to_string(path).unwrap_or_default();
        // whatever else is wrong with the file, reading it whole says so
        toml::from_str::<Head>(&text).is_ok_and(|head| head.format.starts_with("daic-microscope"))
    }

    /// Ready to decode, with the disparity of the plane h = 0.
    ///
    /// # Errors
    /// The first parameter that is not allowed.
    pub fn instrument(
        &self,
        reference_disparity_px: [f64; 2],
    ) -> Result<Instrument, daic_optics::microscope::MicroscopeError> {
        // of the file's micrometres, millimetres
        let factor = [1e-3, 1e-3, 1.0, 1.0, 1.0, 1.0];
        let covariance = SMatrix::from_fn(|i, j| self.microscope.covariance[i][j] * factor[i] * factor[j]);
        Ok(Instrument { model: self.model(reference_disparity_px)?, covariance, reach: self.reach })
    }

    /// Writes the file.
    ///
    /// # Errors
    /// The file that could not be written.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        let text = toml::to_string(self)
            .map_err(|e| Error::Unwritable { path: path.to_owned(), reason: e.to_string() })?;
        Ok(atomic::write_bytes(path, text.as_bytes())?)
    }
}
