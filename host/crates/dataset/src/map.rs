//! Maps of a measured quantity on a regular grid: exact as NPZ, viewable as 16-bit TIFF.
//!
//! TIFF: `value = offset + scale * code`; code 0 is no data, codes 1..=65535 span the smallest to
//! the largest finite value. `offset`, `scale`, `unit`, the quantity's name and the grid's axes are
//! JSON in the ImageDescription tag; the rounding error is at most `scale / 2`.
//!
//! NPZ: one 2-D array (height, width) of `f8` per map, named as the map, NaN where there is no
//! data, and `<name>_meta`, the UTF-8 bytes of JSON with unit and axes.

use std::path::Path;

use ndarray::{Array1, ArrayView2};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::image_file::{self, ImageFileError};
use crate::npz::{Archive, NpzError};

/// Where the nodes of a map lie: node (i, j) — column i, row j — is at
/// (`x0 + i * dx`, `y0 + j * dy`) in `unit`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapAxes {
    /// x of column 0.
    pub x0: f64,
    /// Distance between columns.
    pub dx: f64,
    /// y of row 0.
    pub y0: f64,
    /// Distance between rows.
    pub dy: f64,
    /// Unit of the axes, "px" or "mm".
    pub unit: String,
}

/// A scalar on a regular grid, row-major, `data[j * width + i]`; NaN means no value.
#[derive(Debug, Clone, PartialEq)]
pub struct FloatMap {
    /// What it is, as an identifier: "h_mm".
    pub name: String,
    /// Unit of the values.
    pub unit: String,
    /// Number of columns.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
    /// The values.
    pub data: Vec<f64>,
    /// Where the nodes lie.
    pub axes: MapAxes,
}

/// Why a map could not be written or read.
#[derive(Debug, Error)]
pub enum MapError {
    /// Number of values and size differ, or there is no node.
    #[error("map `{name}` has {values} values for {width} x {height} nodes")]
    Shape {
        /// The map.
        name: String,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Number of values.
        values: usize,
    },
    /// A TIFF without our scale in its description.
    #[error("{} holds no map: its description states no scale", path.display())]
    NoScale {
        /// The file.
        path: std::path::PathBuf,
    },
    /// The image file failed.
    #[error(transparent)]
    Image(#[from] ImageFileError),
    /// The NumPy archive failed.
    #[error(transparent)]
    Npz(#[from] NpzError),
}

/// What the TIFF description states.
#[derive(Debug, Serialize, Deserialize)]
struct Scale {
    quantity: String,
    unit: String,
    offset: f64,
    scale: f64,
    no_data: u16,
    axes: MapAxes,
}

impl FloatMap {
    fn check(&self) -> Result<(), MapError> {
        let nodes = u64::from(self.width) * u64::from(self.height);
        if nodes == 0 || nodes != self.data.len() as u64 {
            return Err(MapError::Shape {
                name: self.name.clone(),
                width: self.width,
                height: self.height,
                values: self.data.len(),
            });
        }
        Ok(())
    }

    /// Smallest and largest finite value, if there is one.
    #[must_use]
    pub fn range(&self) -> Option<(f64, f64)> {
        let finite = || self.data.iter().copied().filter(|v| v.is_finite());
        let low = finite().fold(f64::INFINITY, f64::min);
        (low.is_finite()).then(|| (low, finite().fold(f64::NEG_INFINITY, f64::max)))
    }

    /// Writes the map as 16-bit TIFF with the scale stated inside; see the module.
    ///
    /// # Errors
    /// [`MapError`]; nothing is left half-written.
    pub fn write_tiff(&self, path: &Path) -> Result<(), MapError> {
        self.check()?;
        let (low, high) = self.range().unwrap_or((0.0, 0.0));
        // Halves, so that the span of extreme values does not overflow.
        let scale = (high / 2.0 - low / 2.0) / 32767.0;
        let code = |v: f64| {
            if !v.is_finite() {
                0
            } else if scale > 0.0 {
                let steps = (v / 2.0 - low / 2.0) / scale * 2.0;
                1 + steps.round().clamp(0.0, 65534.0) as u16
            } else {
                1
            }
        };
        let codes: Vec<u16> = self.data.iter().map(|&v| code(v)).collect();
        let description = Scale {
            quantity: self.name.clone(),
            unit: self.unit.clone(),
            offset: low - scale,
            scale,
            no_data: 0,
            axes: self.axes.clone(),
        };
        let json = serde_json::to_value(&description).unwrap_or_default();
        let text = image_file::ascii_json(&json);
        Ok(image_file::write_tiff16(path, self.width, self.height, &codes, Some(&text))?)
    }

    /// Reads a map written by [`FloatMap::write_tiff`]; values are exact to half a code.
    ///
    /// # Errors
    /// [`MapError::Image`] for an unreadable file, [`MapError::NoScale`] for another TIFF.
    pub fn read_tiff(path: &Path) -> Result<Self, MapError> {
        let image = image_file::read_grey(path)?;
        let no_scale = || MapError::NoScale { path: path.to_path_buf() };
        let text = image_file::read_description(path).ok_or_else(no_scale)?;
        let scale: Scale = serde_json::from_str(&text).map_err(|_| no_scale())?;
        let value = |&code: &u16| {
            if code == scale.no_data { f64::NAN } else { scale.offset + scale.scale * f64::from(code) }
        };
        Ok(FloatMap {
            name: scale.quantity,
            unit: scale.unit,
            width: image.width,
            height: image.height,
            data: image.data.iter().map(value).collect(),
            axes: scale.axes,
        })
    }
}

/// Writes maps, exactly, into one NumPy archive; see the module.
///
/// # Errors
/// [`MapError`]; nothing is left half-written.
pub fn write_maps_npz(path: &Path, maps: &[FloatMap]) -> Result<(), MapError> {
    let mut archive = Archive::new(path);
    for map in maps {
        map.check()?;
        let shape = (map.height as usize, map.width as usize);
        let view = ArrayView2::from_shape(shape, &map.data).map_err(|_| MapError::Shape {
            name: map.name.clone(),
            width: map.width,
            height: map.height,
            values: map.data.len(),
        })?;
        archive.add(&map.name, &view)?;
        let meta = serde_json::json!({ "unit": map.unit, "axes": map.axes });
        archive.add(&format!("{}_meta", map.name), &Array1::from(meta.to_string().into_bytes()))?;
    }
    Ok(archive.finish()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) fn map(data: Vec<f64>, width: u32) -> FloatMap {
        FloatMap {
            name: "h_mm".into(),
            unit: "µm".into(),
            width,
            height: data.len() as u32 / width,
            data,
            axes: MapAxes { x0: -1.5, dx: 0.25, y0: 2.0, dy: 0.5, unit: "mm".into() },
        }
    }

    #[test]
    fn tiff_is_exact_to_half_a_code() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("h.tif");
        let mut data: Vec<f64> = (0..300).map(|i| (f64::from(i) * 0.37).sin() * 5.0).collect();
        data[7] = f64::NAN;
        data[8] = f64::INFINITY;
        let original = map(data, 20);
        original.write_tiff(&path).unwrap();
        let back = FloatMap::read_tiff(&path).unwrap();
        let (low, high) = original.range().unwrap();
        // Half a code, and the rounding of offset + scale * code.
        let limit = (high - low) / 65534.0 * 0.5 + 4.0 * f64::EPSILON * high.abs();
        for (i, (a, b)) in original.data.iter().zip(&back.data).enumerate() {
            assert!(if a.is_finite() { (a - b).abs() <= limit } else { b.is_nan() }, "{i} {a} {b}");
        }
        assert_eq!((back.axes, back.unit), (original.axes, original.unit));
    }

    #[test]
    fn constant_and_empty_maps() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("h.tif");
        map(vec![3.25; 6], 2).write_tiff(&path).unwrap();
        assert_eq!(FloatMap::read_tiff(&path).unwrap().data, vec![3.25; 6]);
        map(vec![f64::NAN; 6], 2).write_tiff(&path).unwrap();
        assert!(FloatMap::read_tiff(&path).unwrap().data.iter().all(|v| v.is_nan()));
        map(vec![f64::MAX, -f64::MAX], 2).write_tiff(&path).unwrap();
        let mut wrong = map(vec![1.0; 6], 2);
        wrong.width = 4;
        assert!(matches!(wrong.write_tiff(&path), Err(MapError::Shape { .. })));
    }
}
