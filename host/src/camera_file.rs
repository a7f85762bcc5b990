//! The file of a calibrated camera: `daic-camera/1`, TOML.

use crate::error::Error;
use daic_dataset::atomic;
use daic_optics::Camera;
use daic_optics::align::Measured;
use daic_optics::intrinsics::{CameraCalibration, CameraEstimate, CameraParameter};
use daic_optics::target::Pattern;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A calibrated camera with everything needed to judge it. Lengths in millimetres, image coordinates
/// and F in pixels, coefficients of distortion act on x/F and have no unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraFile {
    /// `daic-camera/1`.
    pub format: String,
    /// Program that wrote it.
    pub program: String,
    /// When, UTC, as 2025-01-31T12:00:00Z.
    pub date: String,
    /// Columns and rows of the images.
    pub image_px: [usize; 2],
    /// RMS of the residuals (coordinates), pixels.
    pub rms_px: f64,
    /// χ² divided by the degrees of freedom.
    pub chi_square_reduced: f64,
    /// Largest angle between two boards, degrees.
    pub normals_spread_deg: f64,
    /// Covariance of the estimates, in their order, in the product of their units.
    pub covariance: Vec<Vec<f64>>,
    /// Units of the numbers.
    pub units: Units,
    /// F, principal point, distortion.
    pub camera: Camera,
    /// What was on the boards.
    pub board: Board,
    /// What was estimated; other parameters were held.
    pub estimates: Vec<CameraEstimate>,
    /// The images.
    pub views: Vec<View>,
}

/// Units of the numbers in the file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Units {
    /// Of lengths on the board and of distances.
    pub length: String,
    /// Of F, principal point and residuals.
    pub image: String,
    /// Of tilts.
    pub angle: String,
    /// Of coefficients of distortion.
    pub distortion: String,
}

impl Default for Units {
    fn default() -> Self {
        let own = str::to_owned;
        Self { length: own("mm"), image: own("px"), angle: own("deg"), distortion: own("1, on x/F") }
    }
}

/// The board.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// Dots or corners.
    pub pattern: Pattern,
    /// Their distance.
    pub pitch_mm: f64,
}

/// One image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct View {
    /// The file.
    pub image: String,
    /// Points used.
    pub points: usize,
    /// Points left out.
    pub rejected: usize,
    /// RMS of the residuals (coordinates) of the points used, pixels.
    pub rms_px: f64,
    /// Angle between board and sensor.
    pub tilt_deg: f64,
    /// From the pinhole to the board along the optical axis.
    pub distance_mm: f64,
}

impl CameraFile {
    /// The only format there is.
    pub const FORMAT: &'static str = "daic-camera/1";

    /// The file of a calibration; `images` names the views.
    pub fn new(
        calibration: &CameraCalibration,
        images: &[String],
        image_px: [usize; 2],
        board: Board,
    ) -> Self {
        let n = calibration.estimates.len();
        let covariance = (0..n).map(|i| (0..n).map(|j| calibration.covariance[(i, j)]).collect()).collect();
        let views = calibration
            .views
            .iter()
            .zip(images)
            .map(|(v, image)| View {
                image: image.clone(),
                points: v.residuals_px.len() - v.rejected.len(),
                rejected: v.rejected.len(),
                rms_px: v.rms_px,
                tilt_deg: v.pose.tilt_rad().to_degrees(),
                distance_mm: v.pose.axial_distance_mm(),
            })
            .collect();
        Self {
            format: Self::FORMAT.to_owned(),
            program: format!("daic {}", env!("CARGO_PKG_VERSION")),
            date: now(),
            image_px,
            rms_px: calibration.rms_px,
            chi_square_reduced: calibration.chi_square_reduced,
            normals_spread_deg: calibration.normals_spread_rad.to_degrees(),
            covariance,
            units: Units::default(),
            camera: calibration.camera,
            board,
            estimates: calibration.estimates.clone(),
            views,
        }
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`Error::CameraFile`] names the line or the field.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let text =
            std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        let bad = |reason: String| Error::CameraFile { path: path.to_owned(), reason };
        let file: Self = toml::from_str(&text).map_err(|e| bad(e.to_string()))?;
        if file.format != Self::FORMAT {
            return Err(bad(format!("field format is {:?}, known is {:?}", file.format, Self::FORMAT)));
        }
        for p in CameraParameter::ALL {
            if !p.get(&file.camera).is_finite() {
                return Err(bad(format!("field camera: {} is not finite", p.name())));
            }
        }
        if file.camera.focal_px <= 0.0 {
            return Err(bad("field camera.focal_px must be above 0".to_owned()));
        }
        let n = file.estimates.len();
        if file.covariance.len() != n || file.covariance.iter().any(|row| row.len() != n) {
            return Err(bad(format!(
                "field covariance must have {n} rows of {n} numbers, as there are estimates"
            )));
        }
        let matrix = nalgebra::DMatrix::from_fn(n, n, |i, j| file.covariance[i][j]);
        let symmetric = (0..n).all(|i| {
            (0..i).all(|j| {
                let unit = (matrix[(i, i)] * matrix[(j, j)]).sqrt();
                (matrix[(i, j)] - matrix[(j, i)]).abs() <= 1e-9 * unit
            })
        });
        let variances = matrix.iter().all(|v| v.is_finite()) && matrix.diagonal().iter().all(|v| *v >= 0.0);
        if !(symmetric
            && variances
            && daic_optics::least_correlation_eigenvalue(&matrix) >= daic_optics::LEAST_EIGENVALUE)
        {
            return Err(bad(
                "field covariance is no covariance: it must be finite, symmetric, without a negative eigenvalue"
                    .to_owned(),
            ));
        }
        if let Some(e) = file.estimates.iter().find(|e| !(e.sigma >= 0.0 && e.value.is_finite())) {
            return Err(bad(format!("field estimates: {} has no valid value and sigma", e.parameter.name())));
        }
        Ok(file)
    }

    /// Writes the file.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        let text = toml::to_string(self)
            .map_err(|e| Error::Unwritable { path: path.to_owned(), reason: e.to_string() })?;
        Ok(atomic::write_bytes(path, text.as_bytes())?)
    }

    /// A parameter with its standard deviation, 0 if it was held.
    pub fn measured(&self, parameter: CameraParameter) -> Measured {
        let sigma = self.estimates.iter().find(|e| e.parameter == parameter).map_or(0.0, |e| e.sigma);
        Measured::new(parameter.get(&self.camera), sigma)
    }
}

/// The date, UTC.
pub fn today() -> String {
    now().chars().take(10).collect()
}

/// The time, UTC, to the second, as 2025-01-31T12:00:00Z.
pub fn now() -> String {
    humantime::format_rfc3339_seconds(std::time::SystemTime::now()).to_string()
}
