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
    let a = read(reference)?;
    let b = read_like(deformed, &a, reference)?;
    Ok((a, b))
}

/// Reads an image that has the size of `other`, which was read from `other_path`.
///
/// # Errors
/// The file, and what is wrong with it.
pub fn read_like(path: &Path, other: &GreyImage, other_path: &Path) -> Result<GreyImage, Error> {
    let image = read(path)?;
    if (image.width, image.height) != (other.width, other.height) {
        return Err(Error::SizesDiffer {
            path: path.to_owned(),
            other: other_path.to_owned(),
            found_width: image.width,
            found_height: image.height,
            width: other.width,
            height: other.height,
        });
    }
    Ok(image)
}
