//! The file of a calibrated microscope.

use super::{Calibration, MicroscopeFileError, Moves};
use crate::error::Error;
use daic_dataset::atomic;
use daic_optics::microscope::{Form, Microscope, Parameters};
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
    /// How well they fit.
    pub fit: Fit,
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

    pub(super) fn of(c: &Calibration, moves: &Moves, path: &Path) -> Option<Self> {
        let (p, covariance) = (c.parameters?, c.covariance?);
        // millimetres to micrometres in β₁ and β₂
        let factor = [1e3, 1e3, 1.0, 1.0, 1.0, 1.0];
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
        let told = moves.provenance.as_ref().map(|p| format!("{p}; ")).unwrap_or_default();
        Some(Self {
            format: Self::FORMAT.to_owned(),
            program: format!("daic {}", env!("CARGO_PKG_VERSION")),
            date: moves.date.clone().unwrap_or_else(today),
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

/// Today's date, UTC, as 2026-01-31.
fn today() -> String {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    date(since.map_or(0, |s| s.as_secs() / 86_400))
}

/// Date of a number of days after 1970-01-01.
fn date(days: u64) -> String {
    // Counted from 1 March of year 0, so that the leap day is the last of a year: 146 097 days in
    // every 400 years.
    let z = days + 719_468;
    let (era, day) = (z / 146_097, z % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let of_year = day - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let of_month = of_year - (153 * month + 2) / 5 + 1;
    let (month, carry) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    format!("{:04}-{month:02}-{of_month:02}", era * 400 + year + carry)
}

#[cfg(test)]
mod tests {
    #[test]
    fn dates() {
        // from `date -u -d @…`
        for (days, text) in [
            (0, "1970-01-01"),
            (59, "1970-03-01"),
            (789, "1972-02-29"),
            (11_016, "2000-02-29"),
            (20_454, "2026-01-01"),
            (47_540, "2100-02-28"),
            (47_541, "2100-03-01"),
        ] {
            assert_eq!(super::date(days), text);
        }
    }
}
