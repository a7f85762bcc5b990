//! A mark on a carrier seen at two distances: where the carrier's rail points.
//!
//! A mark at (X₀ + a z, Y₀ + b z) at distance z from the pinhole is seen F (X₀/z + a) beside the
//! principal point. Two distances give the direction (a, b) of the rail against the optical axis and
//! the offset (X₀, Y₀) of the mark at the pinhole.

use serde::{Deserialize, Serialize};

use super::spots::Spot;
use super::{AlignError, Measured, above_zero};
use crate::camera::Camera;

/// How a mark stands against the principal point in one image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Offset {
    /// Mark minus principal point, without distortion, pixels.
    pub offset_px: [Measured; 2],
    /// The same as an angle, radians.
    pub angle_rad: [Measured; 2],
}

/// Mark against the principal point, whose standard deviations are `principal_sigma_px`.
///
/// # Errors
/// A pixel that the distortion model cannot invert.
pub fn offset(camera: &Camera, principal_sigma_px: [f64; 2], mark: &Spot) -> Result<Offset, AlignError> {
    let q = camera.direction(mark.at_px)?;
    let offset_px =
        [0, 1].map(|l| Measured::new(q[l] * camera.focal_px, mark.sigma_px[l].hypot(principal_sigma_px[l])));
    let angle_rad = offset_px.map(|o| Measured::new(o.value / camera.focal_px, o.sigma / camera.focal_px));
    Ok(Offset { offset_px, angle_rad })
}

/// Direction and offset of a rail or beam.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Axis {
    /// Slope against the optical axis along x and y (radians for small angles).
    pub slope_rad: [Measured; 2],
    /// Where it passes the plane of the pinhole, millimetres.
    pub offset_mm: [Measured; 2],
}

/// The axis through a mark seen at the distances `near_mm` and `far_mm` from the pinhole.
///
/// The error of the principal point is common to both images: it goes into the slope only, and with
/// its full weight.
///
/// # Errors
/// Distances that are not 0 < near < far; a pixel that the distortion model cannot invert.
pub fn axis(
    camera: &Camera,
    principal_sigma_px: [f64; 2],
    marks: [&Spot; 2],
    near_mm: f64,
    far_mm: f64,
) -> Result<Axis, AlignError> {
    above_zero("the distance of the near mark", near_mm)?;
    if !(far_mm > near_mm && far_mm.is_finite()) {
        let name = "the distance of the far mark";
        return Err(AlignError::Value { name, value: far_mm, allowed: "above that of the near one" });
    }
    let f = camera.focal_px;
    let near = offset(camera, [0.0; 2], marks[0])?;
    let far = offset(camera, [0.0; 2], marks[1])?;
    let between = far_mm - near_mm;
    let pick = |l: usize| (near.angle_rad[l], far.angle_rad[l]);
    let slope_rad = [0, 1].map(|l| {
        let (n, r) = pick(l);
        let value = (far_mm * r.value - near_mm * n.value) / between;
        let marks = (far_mm * r.sigma).hypot(near_mm * n.sigma) / between;
        Measured::new(value, marks.hypot(principal_sigma_px[l] / f))
    });
    let offset_mm = [0, 1].map(|l| {
        let (n, r) = pick(l);
        let k = near_mm * far_mm / between;
        Measured::new((n.value - r.value) * k, n.sigma.hypot(r.sigma) * k)
    });
    Ok(Axis { slope_rad, offset_mm })
}

/// Tilt of a grating about x and y (as in R = Rz·Ry·Rx) from a beam that comes along the axis through
/// the middle of an aperture and is reflected back beside it: half the angle of the reflection.
///
/// The rotation about z must be small; to second order in the tilts. `pinhole_to_aperture_mm` turns pixels into millimetres in the plane of the aperture,
/// `grating_to_aperture_mm` is the way of the reflected beam.
///
/// # Errors
/// Distances that are not above 0; a pixel that the distortion model cannot invert.
pub fn grating_tilt(
    camera: &Camera,
    aperture: &Spot,
    reflection: &Spot,
    pinhole_to_aperture_mm: f64,
    grating_to_aperture_mm: f64,
) -> Result<[Measured; 2], AlignError> {
    let far = above_zero("the distance from pinhole to aperture", pinhole_to_aperture_mm)?;
    let way = above_zero("the distance from grating to aperture", grating_to_aperture_mm)?;
    let (a, r) = (offset(camera, [0.0; 2], aperture)?, offset(camera, [0.0; 2], reflection)?);
    // The beam comes along −z; with the normal (n_x, n_y, 1) it leaves along (2 n_x, 2 n_y, 1).
    let normal = [0, 1].map(|l| {
        let value = (r.angle_rad[l].value - a.angle_rad[l].value) * far / (2.0 * way);
        Measured::new(value, r.angle_rad[l].sigma.hypot(a.angle_rad[l].sigma) * far / (2.0 * way))
    });
    // n = R ẑ = (θ_y, −θ_x, 1) for small angles.
    Ok([Measured::new(-normal[1].value, normal[1].sigma), normal[0]])
}
