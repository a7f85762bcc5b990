//! The lattice of a camera, from white images: what `daic lightfield calibrate` does.

use super::error::LightFieldError;
use crate::error::Error;
use crate::images;
use daic_dataset::{GreyImage, atomic};
use daic_lightfield::lattice::{Lattice, find};
use daic_report::{Mark, Overlay};
use std::path::Path;

/// Grey values as numbers.
pub fn grey(image: &GreyImage) -> Vec<f32> {
    image.data.iter().map(|v| f32::from(*v)).collect()
}

/// Level at which a camera of this image saturates; of a 16-bit container that does not say how many bits
/// it holds, the container's.
pub fn saturation(image: &GreyImage) -> f32 {
    (2f32.powi(i32::from(image.significant_bits)) - 1.0).max(1.0)
}

/// Finds the lattice in a white image.
///
/// # Errors
/// Images that cannot be read or differ in size, or without a lattice.
pub fn calibrate(white: &Path, dark: Option<&Path>) -> Result<(Lattice, GreyImage), Error> {
    let image = images::read(white)?;
    let dark = dark.map(|d| images::read_like(d, &image, white)).transpose()?;
    let size = [image.width as usize, image.height as usize];
    let dark = dark.as_ref().map(grey);
    let lattice = find(&grey(&image), dark.as_deref(), size, Some(saturation(&image)))
        .map_err(|source| LightFieldError::Lattice { path: white.to_owned(), source })?;
    Ok((lattice, image))
}

/// Writes the lattice.
///
/// # Errors
/// A file that cannot be written.
pub fn write(path: &Path, lattice: &Lattice) -> Result<(), Error> {
    let text = toml::to_string(lattice)
        .map_err(|e| Error::Unwritable { path: path.to_owned(), reason: e.to_string() })?;
    Ok(atomic::write_bytes(path, text.as_bytes())?)
}

/// Reads a lattice.
///
/// # Errors
/// [`LightFieldError::LatticeFile`].
pub fn read(path: &Path) -> Result<Lattice, Error> {
    let text =
        std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    let bad = |reason: String| LightFieldError::LatticeFile { path: path.to_owned(), reason };
    let lattice: Lattice = toml::from_str(&text).map_err(|e| bad(e.to_string().trim_end().to_owned()))?;
    let mut numbers = lattice.origin_px.iter().chain(&lattice.along_x_px).chain(&lattice.along_y_px);
    // not comparable is not enough either
    if numbers.any(|v| !v.is_finite()) || lattice.cell_area().total_cmp(&4.0).is_lt() {
        return Err(bad("its cell has less than 4 pixels".to_owned()).into());
    }
    Ok(lattice)
}

/// Most centres drawn on the overlay's crop.
const CROP: usize = 400;

/// A picture of the white image's middle and corners with the lattice on it, to look at.
///
/// # Errors
/// A picture that cannot be drawn or written.
pub fn write_overlay(path: &Path, lattice: &Lattice, white: &GreyImage) -> Result<(), Error> {
    let [width, height] = lattice.size_px;
    let side = CROP.min(width).min(height) / 2;
    // five pieces side by side: an error of pitch or angle shows at the corners
    let places = [
        [0, 0],
        [width - side, 0],
        [(width - side) / 2, (height - side) / 2],
        [0, height - side],
        [width - side, height - side],
    ];
    let gap = 6;
    let total = places.len() * (side + gap) - gap;
    let mut data = vec![0u16; total * side];
    let mut centres = Vec::new();
    for (k, [x0, y0]) in places.into_iter().enumerate() {
        let left = k * (side + gap);
        for y in 0..side {
            let from = (y0 + y) * width + x0;
            data[y * total + left..][..side].copy_from_slice(&white.data[from..from + side]);
        }
        let corners = [[x0, y0], [x0 + side, y0], [x0, y0 + side], [x0 + side, y0 + side]]
            .map(|p| lattice.cell_of(p.map(|v| v as f64)));
        let range = |a: usize| {
            let low = corners.iter().map(|c| c[a]).fold(f64::INFINITY, f64::min).floor() as i64 - 1;
            let high = corners.iter().map(|c| c[a]).fold(f64::NEG_INFINITY, f64::max).ceil() as i64 + 1;
            low..=high
        };
        let shifts: &[f64] =
            if lattice.packing == daic_lightfield::Packing::Hexagonal { &[0.0, 0.5] } else { &[0.0] };
        for v in range(1) {
            for u in range(0) {
                for s in shifts {
                    let [x, y] = lattice.at(u as f64 + s, v as f64 + s);
                    let (x, y) = (x - x0 as f64, y - y0 as f64);
                    let edge = side as f64 - 1.0;
                    if x >= 0.0 && y >= 0.0 && x <= edge && y <= edge {
                        centres.push((left as f64 + x, y));
                    }
                }
            }
        }
    }
    let overlay = Overlay {
        title: "Lattice on the white image: corners and middle".to_owned(),
        width: total,
        height: side,
        grey: data,
        display: None,
        most_pixels: 1100,
        marks: vec![Mark::Dots { points: centres, colour: 1 }],
    };
    Ok(atomic::write_bytes(path, overlay.render_svg()?.as_str().as_bytes())?)
}
