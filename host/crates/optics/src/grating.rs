//! The grating equation, and nothing else of the set-up.
//!
//! A transmission grating changes the component of the direction across its grooves,
//! α' = α + mλ/p, keeps the one along them, β' = β, and γ' = √(1 − α'² − β'²)
//! follows. This holds in air whatever plane-parallel substrate carries the grooves; a substrate
//! only shifts the ray sideways.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use crate::real::{Real, along, dot};

/// On which side of the grooves the substrate lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SubstrateSide {
    /// Between the pinhole and the grooves.
    Camera,
    /// Between the grooves and the object.
    Object,
}

/// Plane-parallel plate that carries the grooves. Thickness 0 means none.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Substrate {
    /// Thickness in millimetres, ≥ 0.
    pub thickness_mm: f64,
    /// Refractive index at the wavelength in use, ≥ 1.
    pub index: f64,
    /// Where the plate lies.
    pub side: SubstrateSide,
}

impl Substrate {
    /// No substrate.
    pub const NONE: Self = Self { thickness_mm: 0.0, index: 1.5, side: SubstrateSide::Object };
}

impl Default for Substrate {
    fn default() -> Self {
        Self::NONE
    }
}

/// A transmission grating: pitch, pose and substrate.
///
/// Its frame is the world's turned by R = Rz·Ry·Rx about its pivot (0, 0, s + offset): across the grooves
/// t̂ = R·x̂, along them ĝ = R·ŷ, normal n̂ = R·ẑ (towards the object). The plane of the grooves
/// contains the pivot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grating {
    /// Groove pitch in millimetres.
    pub pitch_mm: f64,
    /// Rotation about x, y and z in radians, applied in this order.
    #[serde(default)]
    pub tilt_rad_xyz: [f64; 3],
    /// How far its pivot lies behind the common one at s, in millimetres: two separate gratings may
    /// stand at different distances.
    #[serde(default)]
    pub offset_mm: f64,
    /// Plate that carries the grooves.
    #[serde(default)]
    pub substrate: Substrate,
}

/// Why a direction has no diffracted order.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum DiffractError {
    /// The order is evanescent: the direction cosines it would need exceed one.
    #[error(
        "order {order} does not propagate: its direction cosines across and along the grooves would be {across:.4} and {along:.4}, whose squares must sum to less than 1"
    )]
    Evanescent {
        /// Diffraction order m.
        order: f64,
        /// α' = α + mλ/p.
        across: f64,
        /// β' = β.
        along: f64,
    },
    /// The direction does not point through the grating towards the object.
    #[error(
        "the ray does not pass through the grating: its direction cosine along the grating's normal is {normal:.4}, it must be positive"
    )]
    NotThrough {
        /// γ, direction cosine along the normal.
        normal: f64,
    },
}

impl Grating {
    /// A grating square to the optical axis, without substrate.
    pub fn square(pitch_mm: f64) -> Self {
        Self { pitch_mm, tilt_rad_xyz: [0.0; 3], offset_mm: 0.0, substrate: Substrate::NONE }
    }

    /// The grating's frame, computed once for many rays.
    pub fn frame(&self) -> GratingFrame {
        GratingFrame { axes: Axes::new(self.tilt_rad_xyz), pitch_mm: self.pitch_mm }
    }

    /// See [`GratingFrame::diffract`]; for more than a few rays prepare [`Grating::frame`] once.
    pub fn diffract(
        &self,
        direction: Vector3<f64>,
        order: f64,
        wavelength_mm: f64,
    ) -> Result<Vector3<f64>, DiffractError> {
        self.frame().diffract(direction, order, wavelength_mm)
    }

    /// Angle θ = asin(λ/p) of the first order for a ray that arrives along the normal, in radians;
    /// NaN if the first order does not propagate.
    pub fn angle_rad(&self, wavelength_mm: f64) -> f64 {
        (wavelength_mm / self.pitch_mm).asin()
    }
}

/// A grating's axes and pitch, ready to diffract rays.
#[derive(Clone, Copy, Debug)]
pub struct GratingFrame {
    axes: Axes<f64>,
    pitch_mm: f64,
}

impl GratingFrame {
    /// Direction (unit, world axes) behind the grating of a ray that arrives with `direction`
    /// (unit, world axes).
    ///
    /// # Errors
    /// If the ray does not come from the camera's side or the order does not propagate.
    #[inline]
    pub fn diffract(
        &self,
        direction: Vector3<f64>,
        order: f64,
        wavelength_mm: f64,
    ) -> Result<Vector3<f64>, DiffractError> {
        let k = [direction.x, direction.y, direction.z];
        let shift = order * (wavelength_mm / self.pitch_mm);
        let cosines = self.axes.diffract(k, shift).map_err(|e| e.of_order(order))?;
        let [x, y, z] = self.axes.to_world(cosines.after);
        Ok(Vector3::new(x, y, z))
    }

    /// The rotation R = Rz·Ry·Rx; its columns are t̂, ĝ and n̂.
    pub fn rotation(&self) -> Matrix3<f64> {
        let a = &self.axes;
        Matrix3::from_columns(&[a.across.into(), a.along.into(), a.normal.into()])
    }

    /// Unit normal n̂ of the grating, towards the object.
    #[inline]
    pub fn normal(&self) -> Vector3<f64> {
        self.axes.normal.into()
    }
}

/// The axes t̂, ĝ, n̂ for any scalar.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axes<T> {
    pub(crate) across: [T; 3],
    pub(crate) along: [T; 3],
    pub(crate) normal: [T; 3],
}

/// Direction cosines (across, along, normal) before and after the grating.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cosines<T> {
    pub(crate) before: [T; 3],
    pub(crate) after: [T; 3],
}

/// [`DiffractError`] before the order is known.
#[derive(Clone, Copy, Debug)]
pub(crate) enum NoOrder {
    Evanescent { across: f64, along: f64 },
    NotThrough { normal: f64 },
}

impl NoOrder {
    pub(crate) fn of_order(self, order: f64) -> DiffractError {
        match self {
            Self::Evanescent { across, along } => DiffractError::Evanescent { order, across, along },
            Self::NotThrough { normal } => DiffractError::NotThrough { normal },
        }
    }
}

impl<T: Real> Axes<T> {
    pub(crate) fn new(tilt: [T; 3]) -> Self {
        let [(sx, cx), (sy, cy), (sz, cz)] = tilt.map(T::sin_cos);
        Self {
            across: [cz * cy, sz * cy, -sy],
            along: [cz * sy * sx - sz * cx, sz * sy * sx + cz * cx, cy * sx],
            normal: [cz * sy * cx + sz * sx, sz * sy * cx - cz * sx, cy * cx],
        }
    }

    /// The grating equation with shift mλ/p.
    #[inline]
    pub(crate) fn diffract(&self, k: [T; 3], shift: T) -> Result<Cosines<T>, NoOrder> {
        let before = [dot(k, self.across), dot(k, self.along), dot(k, self.normal)];
        // Negated comparisons so that NaN is refused too.
        if !(before[2].value() > 0.0) {
            return Err(NoOrder::NotThrough { normal: before[2].value() });
        }
        let a = before[0] + shift;
        let b = before[1];
        let c2 = T::constant(1.0) - a * a - b * b;
        if !(c2.value() > 0.0) {
            return Err(NoOrder::Evanescent { across: a.value(), along: b.value() });
        }
        Ok(Cosines { before, after: [a, b, c2.sqrt()] })
    }

    /// Where a ray that crosses the plane of the grooves at `origin` seems to cross it because of the plate
    /// that carries them.
    ///
    /// Snell's law keeps the tangential cosines; the plate is passed at a steeper angle and shifts the ray
    /// along the grating. One shift serves both sides: before the grooves it moves where they are hit, behind
    /// them where the ray seems to come from.
    #[inline]
    pub(crate) fn past_plate(
        &self,
        origin: [T; 3],
        cosines: &Cosines<T>,
        side: SubstrateSide,
        thickness: T,
        index: T,
    ) -> [T; 3] {
        let c = match side {
            SubstrateSide::Camera => cosines.before,
            SubstrateSide::Object => cosines.after,
        };
        let one = T::constant(1.0);
        let inside = (index * index - c[0] * c[0] - c[1] * c[1]).sqrt();
        let t = thickness * (one / inside - one / c[2]);
        along(along(origin, self.across, c[0] * t), self.along, c[1] * t)
    }

    #[inline]
    pub(crate) fn to_world(self, v: [T; 3]) -> [T; 3] {
        let mut w = [T::constant(0.0); 3];
        for (i, w) in w.iter_mut().enumerate() {
            *w = self.across[i] * v[0] + self.along[i] * v[1] + self.normal[i] * v[2];
        }
        w
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    const LAMBDA: f64 = 633e-6;

    #[test]
    fn frame_is_rz_ry_rx() {
        let [a, b, c] = [0.31, -0.22, 0.57];
        let r = Rotation3::from_axis_angle(&Vector3::z_axis(), c)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), b)
            * Rotation3::from_axis_angle(&Vector3::x_axis(), a);
        let mut g = Grating::square(1.0 / 300.0);
        g.tilt_rad_xyz = [a, b, c];
        assert!((g.frame().rotation() - r.matrix()).norm() < 1e-15);
    }

    #[test]
    fn normal_incidence_leaves_at_theta() {
        let g = Grating::square(1.0 / 300.0);
        let out = g.diffract(Vector3::z(), 1.0, LAMBDA).unwrap();
        // θ = 10.95° of the thesis.
        assert!((g.angle_rad(LAMBDA).to_degrees() - 10.95).abs() < 0.005);
        assert!((out.x - (LAMBDA * 300.0)).abs() < 1e-16);
        assert!((out.x.atan2(out.z) - g.angle_rad(LAMBDA)).abs() < 1e-15);
        assert!((out.norm() - 1.0).abs() < 1e-15);
    }

    /// In any pose: the change of direction has no component along the grooves, mλ/p across them,
    /// and the zeroth order goes straight on.
    #[test]
    fn tilted_grating_obeys_the_equation() {
        let mut g = Grating::square(1.0 / 300.0);
        g.tilt_rad_xyz = [0.05, -0.04, 0.03];
        let r = g.frame().rotation();
        let k = Vector3::new(0.1, -0.2, 0.9).normalize();
        for order in [-1.0, 0.0, 1.0, 2.0] {
            let out = g.diffract(k, order, LAMBDA).unwrap();
            let change = r.transpose() * (out - k);
            assert!((change.x - order * LAMBDA * 300.0).abs() < 1e-15);
            assert!(change.y.abs() < 1e-15);
            assert!((out.norm() - 1.0).abs() < 1e-15);
            if order == 0.0 {
                assert!((out - k).norm() < 1e-15);
            }
        }
    }

    #[test]
    fn impossible_orders_are_errors() {
        let g = Grating::square(1.0 / 300.0);
        assert!(matches!(
            g.diffract(Vector3::z(), 6.0, LAMBDA),
            Err(DiffractError::Evanescent { order: 6.0, .. })
        ));
        assert!(matches!(g.diffract(-Vector3::z(), 1.0, LAMBDA), Err(DiffractError::NotThrough { .. })));
        assert!(g.diffract(Vector3::zeros(), 1.0, LAMBDA).is_err());
        assert!(g.diffract(Vector3::repeat(f64::NAN), 1.0, LAMBDA).is_err());
    }
}
