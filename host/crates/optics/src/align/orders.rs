//! Spots of the orders −1, 0 and +1 of one beam: how the grooves stand.
//!
//! The directions of the three orders differ by ±λ/p along t̂, across the grooves: with the grating
//! square to the beam the spots lie on a line along t̂. Tilted about x by θ_x, both outer ones leave
//! that line to the same side, by F θ_x (1/cos θ − 1); tilted about y by θ_y, one moves outwards and
//! one inwards.

use serde::{Deserialize, Serialize};

use super::spots::Spot;
use super::{AlignError, Measured};
use crate::camera::Camera;

/// The line through three spots.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct OrderLine {
    /// Angle of the line through the outer spots to the x axis, radians, from x towards y. It is the
    /// rotation θ_z of the grating.
    pub angle_rad: Measured,
    /// How far the middle spot lies from that line, pixels, towards larger y. Nothing but noise if
    /// the grating is square to the beam.
    pub bow_px: Measured,
    /// Distances of the outer spots from the middle one, pixels: left, right.
    pub reach_px: [f64; 2],
}

/// Angle and bow of the spots of orders −1, 0, +1, given from left to right; the camera takes away
/// its distortion.
///
/// # Errors
/// [`AlignError::Spots`] if there are not three, [`AlignError::NotOrders`] if the outer ones are not
/// about equally far from the middle one.
pub fn order_line(camera: &Camera, spots: &[Spot]) -> Result<OrderLine, AlignError> {
    let [left, middle, right] = spots else {
        return Err(AlignError::Spots { found: spots.len(), needed: 3 });
    };
    let [l, m, r] = [left, middle, right].map(|s| camera.undistort_px(s.at_px));
    let (l, m, r) = (l?, m?, r?);
    let reach_px = [(m[0] - l[0]).hypot(m[1] - l[1]), (r[0] - m[0]).hypot(r[1] - m[1])];
    let ratio = reach_px[0] / reach_px[1];
    if !(0.8..1.25).contains(&ratio) {
        return Err(AlignError::NotOrders { left: reach_px[0], right: reach_px[1] });
    }
    let d = [r[0] - l[0], r[1] - l[1]];
    let length = d[0].hypot(d[1]);
    // Unit normal of the line, towards larger y.
    let n = [-d[1] / length, d[0] / length];
    let across = |s: &Spot| (n[0] * s.sigma_px[0]).hypot(n[1] * s.sigma_px[1]);
    let (sl, sm, sr) = (across(left), across(middle), across(right));
    let t = ((m[0] - l[0]) * d[0] + (m[1] - l[1]) * d[1]) / (length * length);
    Ok(OrderLine {
        angle_rad: Measured::new(d[1].atan2(d[0]), sl.hypot(sr) / length),
        bow_px: Measured::new(
            n[0] * (m[0] - l[0]) + n[1] * (m[1] - l[1]),
            sm.hypot((1.0 - t) * sl).hypot(t * sr),
        ),
        reach_px,
    })
}

impl OrderLine {
    /// Tilt θ_x of the grating that makes the bow, for a parallel beam along the optical axis;
    /// `shift` is λ/p.
    ///
    /// # Errors
    /// [`AlignError::Value`] unless 0 < λ/p < 1.
    pub fn tilt_x_rad(&self, camera: &Camera, shift: f64) -> Result<Measured, AlignError> {
        if !(shift > 0.0 && shift < 1.0) {
            return Err(AlignError::Value { name: "λ/p", value: shift, allowed: "between 0 and 1" });
        }
        let cos = (1.0 - shift * shift).sqrt();
        let per = camera.focal_px * (1.0 / cos - 1.0);
        // The outer spots leave towards +y for a positive tilt, the middle one stays.
        Ok(Measured::new(-self.bow_px.value / per, self.bow_px.sigma / per))
    }

    /// Rotation of the grooves of another grating against these.
    pub fn relative_rad(&self, other: &Self) -> Measured {
        Measured::new(
            other.angle_rad.value - self.angle_rad.value,
            self.angle_rad.sigma.hypot(other.angle_rad.sigma),
        )
    }
}
