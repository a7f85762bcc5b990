//! Where 2D-DIC looks: a rectangle of centres, drawn regions, a mask image.

use crate::error::Error;
use crate::measure::Rectangle;
use daic_correlate::{Mask, Points, Regions, Roi};
use daic_dataset::read_grey;
use std::path::Path;

/// Share of a cut subset that must be inside unless something else is asked for.
pub const MIN_INSIDE: f64 = 0.5;

/// Where points lie and which pixels their subsets use.
#[derive(Debug, Clone, Default)]
pub struct Area {
    /// Where centres lie; everywhere if left out.
    pub roi: Option<Rectangle>,
    /// Which pixels are used; all if left out.
    pub mask: Option<Mask>,
    /// Share of a subset that must be inside, 0.1 to 1. Left out: [`MIN_INSIDE`] with a mask, and 1,
    /// whole subsets only, without.
    pub min_inside: Option<f64>,
}

impl Area {
    /// Points every `step` pixels of an image of `width` × `height`.
    ///
    /// # Errors
    /// If no subset fits, or the mask has another size.
    pub fn grid(&self, width: usize, height: usize, subset: usize, step: usize) -> Result<Points, Error> {
        let roi = Roi { rectangle: self.roi, mask: self.mask.as_ref() };
        let share = self.min_inside.or(self.mask.is_some().then_some(MIN_INSIDE));
        Ok(match share {
            Some(share) => Points::grid_cut(width, height, subset, step, &roi, share)?,
            None => Points::grid(width, height, subset, step, &roi)?,
        })
    }
}

/// Reads regions (`[[region]]` tables) and draws them.
///
/// # Errors
/// The file, and which field of which region is wrong.
pub fn regions(path: &Path, width: usize, height: usize) -> Result<Mask, Error> {
    let text =
        std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    let regions: Regions = toml::from_str(&text).map_err(|e| {
        let line = e.span().map_or(1, |s| text.get(..s.start).unwrap_or("").matches('\n').count() + 1);
        let reason = e.message().trim().replace('\n', ", ");
        Error::RegionsFile { path: path.to_owned(), line, reason }
    })?;
    regions.mask(width, height).map_err(|source| Error::Regions { path: path.to_owned(), source })
}

/// Reads a mask image: pixels that are not black are inside.
///
/// # Errors
/// The file, and what is wrong with it: unreadable, of another size than the images.
pub fn mask(path: &Path, width: usize, height: usize) -> Result<Mask, Error> {
    let image = read_grey(path)?;
    let (found_width, found_height) = (image.width as usize, image.height as usize);
    if (found_width, found_height) != (width, height) {
        return Err(Error::MaskSize { path: path.to_owned(), found_width, found_height, width, height });
    }
    Ok(Mask::new(width, height, image.data.iter().map(|&g| g > 0).collect())?)
}

/// Pixels inside both.
///
/// # Errors
/// Only if the two differ in size.
pub fn both(a: &Mask, b: &Mask) -> Result<Mask, Error> {
    let inside = a.pixels().iter().zip(b.pixels()).map(|(a, b)| *a && *b).collect();
    Ok(Mask::new(a.width(), a.height(), inside)?)
}
