//! Frames of a light-field camera, brought onto whole cells.

use super::calibration::{grey, saturation};
use super::error::LightFieldError;
use crate::error::Error;
use daic_dataset::read_grey;
use daic_lightfield::lattice::{Lattice, Rectifier};
use std::path::{Path, PathBuf};

/// What frames are corrected with.
#[derive(Debug, Clone, Default)]
pub struct Corrections {
    /// The lattice; without it frames must consist of whole cells already.
    pub lattice: Option<Lattice>,
    /// White image, whose cells give the gain.
    pub white: Option<PathBuf>,
    /// Dark image, taken off.
    pub dark: Option<PathBuf>,
    /// Image that is not zero at bad pixels.
    pub bad: Option<PathBuf>,
    /// First cell and number of cells (y, x), of the whole cells in the image.
    pub crop: Option<[[usize; 2]; 2]>,
    /// Leave saturated pixels out instead of refusing the frame.
    pub mask_saturated: bool,
}

/// A frame of whole cells.
#[derive(Debug, Clone)]
pub struct CellFrame {
    /// Cells (y, x).
    pub cells: [usize; 2],
    /// Light, `[y][x]`.
    pub values: Vec<f32>,
    /// Weights, where some pixel is bad.
    pub weights: Option<Vec<f32>>,
}

/// Corrects frames.
pub struct FrameReader {
    pixels: [usize; 2],
    corrections: Corrections,
    rectifier: Option<Rectifier>,
    dark: Option<Vec<f32>>,
    bad: Option<Vec<bool>>,
}

impl FrameReader {
    /// For `pixels` (y, x) a cell.
    ///
    /// # Errors
    /// Images that cannot be read or do not fit the lattice.
    pub fn new(pixels: [usize; 2], corrections: Corrections) -> Result<Self, Error> {
        let size = corrections.lattice.as_ref().map(|l| l.size_px);
        let read = |path: &Option<PathBuf>| -> Result<Option<Vec<f32>>, Error> {
            let Some(path) = path else { return Ok(None) };
            let image = read_grey(path)?;
            check_size(path, [image.width as usize, image.height as usize], size)?;
            Ok(Some(grey(&image)))
        };
        let (white, dark) = (read(&corrections.white)?, read(&corrections.dark)?);
        let bad = read(&corrections.bad)?.map(|v| v.iter().map(|v| *v != 0.0).collect());
        let mut rectifier = None;
        if let Some(lattice) = &corrections.lattice {
            let mut r =
                Rectifier::new(lattice, pixels, white.as_deref(), dark.as_deref()).map_err(|source| {
                    let path = corrections.white.clone().unwrap_or_default();
                    LightFieldError::Lattice { path, source }
                })?;
            if let Some([first, cells]) = corrections.crop {
                r.crop(first, cells);
            }
            rectifier = Some(r);
        }
        Ok(Self { pixels, corrections, rectifier, dark, bad })
    }

    /// Area of a pixel of a corrected frame, in pixels of the camera.
    pub fn area(&self) -> f32 {
        let [ny, nx] = self.pixels;
        self.corrections.lattice.as_ref().map_or(1.0, |l| (l.cell_area() / (ny * nx) as f64) as f32)
    }

    /// Reads and corrects a frame.
    ///
    /// # Errors
    /// A file that cannot be read, a size that does not fit, saturated pixels.
    pub fn read(&self, path: &Path) -> Result<CellFrame, Error> {
        let image = read_grey(path)?;
        let (width, height) = (image.width as usize, image.height as usize);
        check_size(path, [width, height], self.corrections.lattice.as_ref().map(|l| l.size_px))?;
        let values = grey(&image);
        let level = saturation(&image);
        let mut bad = self.bad.clone();
        let saturated = |i: usize| values[i] >= level && !bad.as_ref().is_some_and(|b| b[i]);
        if let Some(first) = (0..values.len()).find(|&i| saturated(i)) {
            let count = (0..values.len()).filter(|&i| saturated(i)).count();
            if !self.corrections.mask_saturated {
                let source = daic_lightfield::ReconstructError::Saturated {
                    image: 0,
                    count,
                    level,
                    x: first % width,
                    y: first / width,
                };
                return Err(LightFieldError::Reconstruct { name: path.display().to_string(), source }.into());
            }
            let bad = bad.get_or_insert_with(|| vec![false; values.len()]);
            bad.iter_mut().zip(&values).filter(|(_, v)| **v >= level).for_each(|(b, _)| *b = true);
        }
        let weigh = |b: &Vec<bool>| b.iter().map(|b| f32::from(u8::from(!b))).collect();
        if let Some(rectifier) = &self.rectifier {
            let done = rectifier
                .apply(&values, bad.as_deref())
                .map_err(|source| LightFieldError::Lattice { path: path.to_owned(), source })?;
            let weights = bad.is_some().then_some(done.weights);
            return Ok(CellFrame { cells: done.cells, values: done.values, weights });
        }
        let [ny, nx] = self.pixels;
        if width % nx != 0 || height % ny != 0 || width == 0 {
            let error = LightFieldError::Cells { path: path.to_owned(), width, height, pixels: nx };
            return Err(error.into());
        }
        let values = match &self.dark {
            Some(dark) if dark.len() == values.len() => values.iter().zip(dark).map(|(v, d)| v - d).collect(),
            Some(_) => {
                let path = self.corrections.dark.clone().unwrap_or_default();
                return Err(LightFieldError::Cells { path, width, height, pixels: nx }.into());
            }
            None => values,
        };
        Ok(CellFrame { cells: [height / ny, width / nx], values, weights: bad.as_ref().map(weigh) })
    }
}

fn check_size(path: &Path, found: [usize; 2], size: Option<[usize; 2]>) -> Result<(), Error> {
    match size {
        Some([width, height]) if found != [width, height] => Err(LightFieldError::Size {
            path: path.to_owned(),
            found_width: found[0],
            found_height: found[1],
            width,
            height,
        }
        .into()),
        _ => Ok(()),
    }
}
