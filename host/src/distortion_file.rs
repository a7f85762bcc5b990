//! The file of a distortion map: JSON with version, date, provenance and units in the names of its fields.

use crate::error::Error;
use daic_dataset::atomic;
use daic_optics::{Camera, DistortionMap, View};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What e is counted from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IdealImage {
    /// Straight lines stay straight: for an image without grating, or for a view decoded by `linear` or
    /// `closed`.
    Pinhole,
    /// Exact rays through the grating: for a view decoded by `ray`.
    Ray,
}

/// A distortion map, as a file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DistortionFile {
    /// [`DistortionFile::FORMAT`].
    pub format: String,
    /// Where the values come from, free text.
    pub provenance: String,
    /// When they were found (RFC 3339).
    pub date: String,
    /// Columns and rows of the images.
    pub image_px: [u32; 2],
    /// The view that the map is for; left out, the whole sensor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub view: Option<View>,
    /// What e is counted from.
    pub ideal: IdealImage,
    /// The camera of that image; the map comes on top of its Brown terms.
    pub camera: Camera,
    /// Terms that the images do not determine and that e is therefore free of.
    pub removed: Vec<String>,
    /// e, observed = ideal + e at the observed pixel: a cubic B-spline on a grid of nodes.
    pub e: DistortionMap,
    /// Standard deviations of (e_x, e_y) at the nodes, row by row.
    pub sigma_px: Vec<[f64; 2]>,
    /// Whether phases were measured at a node, row by row; elsewhere the map is extrapolated.
    pub measured: Vec<bool>,
}

impl DistortionFile {
    /// The only format there is.
    pub const FORMAT: &'static str = "daic-distortion-map/1";

    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`Error::Read`], or [`Error::DistortionFile`] with the field that is to blame.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let text =
            std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        let wrong = |reason: String| Error::DistortionFile { path: path.to_owned(), reason };
        let file: Self = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        if file.format != Self::FORMAT {
            return Err(wrong(format!("format is `{}`, `{}` is known here", file.format, Self::FORMAT)));
        }
        let [nx, ny] = file.e.grid().nodes;
        for (field, found) in [("sigma_px", file.sigma_px.len()), ("measured", file.measured.len())] {
            if found != nx * ny {
                return Err(wrong(format!("{field} has {found} entries for {nx} × {ny} nodes")));
            }
        }
        if !file.sigma_px.iter().flatten().all(|s| s.is_finite() && *s >= 0.0) {
            return Err(wrong("sigma_px holds a value that is no standard deviation".to_owned()));
        }
        if file.camera.focal_px.is_nan() || file.camera.focal_px <= 0.0 {
            return Err(wrong(format!("camera.focal_px is {}, it must be above 0", file.camera.focal_px)));
        }
        Ok(file)
    }

    /// Writes the file in one step.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        let text = serde_json::to_string(self)
            .map_err(|e| Error::Unwritable { path: path.to_owned(), reason: e.to_string() })?;
        Ok(atomic::write_bytes(path, text.as_bytes())?)
    }
}
