//! Image files for correlation: read, checked, compared.

use crate::error::Error;
use daic_dataset::{GreyImage, read_grey};
use std::path::Path;

/// Reads an image that has something on it.
///
/// # Errors
/// The file, and what is wrong with it.
pub fn read(path: &Path) -> Result<GreyImage, Error> {
    let image = read_grey(path)?;
    let level = image.data.first().copied().unwrap_or(0);
    if image.data.iter().all(|&g| g == level) {
        return Err(Error::Blank { path: path.to_owned(), level });
    }
    Ok(image)
}

/// Reads two images of one size.
///
/// # Errors
/// The file, and what is wrong with it.
pub fn read_pair(reference: &Path, deformed: &Path) -> Result<(GreyImage, GreyImage), Error> {
    let (a, b) = (read(reference)?, read(deformed)?);
    if (a.width, a.height) != (b.width, b.height) {
        return Err(Error::SizesDiffer {
            path: deformed.to_owned(),
            other: reference.to_owned(),
            found_width: b.width,
            found_height: b.height,
            width: a.width,
            height: a.height,
        });
    }
    Ok((a, b))
}
