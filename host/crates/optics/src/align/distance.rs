//! Distances from a length of known size.

use super::{AlignError, Measured, above_zero};

/// D = L F / L′: distance along the optical axis from the pinhole to a line of length L (mm) square
/// to the axis that is L′ pixels long in the image; the standard deviations are independent.
///
/// # Errors
/// [`AlignError::Value`] if one of them is not above 0.
pub fn pinhole_to_line(
    focal_px: Measured,
    length_mm: Measured,
    image_px: Measured,
) -> Result<Measured, AlignError> {
    let f = above_zero("F", focal_px.value)?;
    let l = above_zero("the length of the line", length_mm.value)?;
    let i = above_zero("the length in the image", image_px.value)?;
    let value = l * f / i;
    let relative = (focal_px.sigma / f).hypot(length_mm.sigma / l).hypot(image_px.sigma / i);
    Ok(Measured::new(value, value * relative))
}

/// s = D − d: pinhole to grating.
///
/// # Errors
/// [`AlignError::Value`] if d is not between 0 and D.
pub fn pinhole_to_grating(board_mm: Measured, grating_to_board_mm: Measured) -> Result<Measured, AlignError> {
    let d = above_zero("the distance from grating to board", grating_to_board_mm.value)?;
    if !(d < board_mm.value) {
        let name = "the distance from grating to board";
        return Err(AlignError::Value { name, value: d, allowed: "less than that from pinhole to board" });
    }
    Ok(Measured::new(board_mm.value - d, board_mm.sigma.hypot(grating_to_board_mm.sigma)))
}
