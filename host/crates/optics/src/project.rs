//! Forward model: the pixel whose line of sight passes through a given point.
//!
//! The grating leaves no closed form, so Newton's iteration runs on the ideal direction of the
//! line of sight; lens distortion is applied afterwards and costs no iteration.

use nalgebra::{Matrix2x3, SMatrix, Vector3};
use serde::{Deserialize, Serialize};

use crate::model::{OpticalModel, Setup, TraceError};
use crate::parameter::ParameterJacobian;
use crate::real::{Dual, Real, solve2};
use crate::setup::{Optics, View};

/// Range of the displacement from the −1 to the +1 view over a range of heights, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DisparityRange {
    /// Smallest and largest u = x₊ − x₋.
    pub u_px: [f64; 2],
    /// Smallest and largest v = y₊ − y₋.
    pub v_px: [f64; 2],
}

/// Where the line of sight of `q` misses the world point, in the point's z plane.
#[inline]
fn miss<T: Real>(setup: &Setup<T>, view: View, q: [T; 2], p: [T; 3]) -> Result<[T; 2], TraceError> {
    let r = setup.trace(view, q)?;
    let t = (p[2] - r.origin[2]) / r.direction[2];
    Ok([r.origin[0] + r.direction[0] * t - p[0], r.origin[1] + r.direction[1] * t - p[1]])
}

/// Direction (normalised ideal coordinates) that sees the world point `p`, and the Jacobian of the
/// miss there.
fn aim(
    setup: &Setup<Dual<2>>,
    view: View,
    p: [f64; 3],
    start: Option<[f64; 2]>,
) -> Result<([f64; 2], [[f64; 2]; 2]), TraceError> {
    let not_seen =
        || TraceError::NotSeen { view, point_mm: setup.object(p.map(Dual::constant)).map(Dual::value) };
    if !p.iter().all(|c| c.is_finite()) {
        return Err(TraceError::NotFinite);
    }
    let distance_mm = setup.behind(view, p.map(Dual::constant));
    if !(distance_mm > 0.0) {
        return Err(TraceError::BeforeGrating { distance_mm });
    }
    let mut q = start.unwrap_or_else(|| {
        // Virtual object of the paraxial model: at ∓z·tan θ, z/cos³θ behind the grating.
        let (sin, s) = (setup.paraxial.sin_theta.value, setup.paraxial.s.value);
        let cos = (1.0 - sin * sin).sqrt();
        let z = p[2] - s;
        let depth = s + z / (cos * cos * cos);
        let x = p[0] - view.traced_order() * z * sin / cos;
        [x / depth, p[1] / depth]
    });
    let at = p.map(Dual::constant);
    for _ in 0..30 {
        let m = miss(setup, view, [Dual::variable(q[0], 0), Dual::variable(q[1], 1)], at)?;
        let jacobian = m.map(|m| m.gradient);
        let step = solve2(jacobian, m.map(|m| m.value)).ok_or_else(not_seen)?;
        q = [q[0] - step[0], q[1] - step[1]];
        // Quadratic convergence: the error after a step of 1e-9 is below rounding.
        if step[0].abs() + step[1].abs() < 1e-9 {
            return Ok((q, jacobian));
        }
    }
    Err(not_seen())
}

/// Pixel of the object point `p` (x, y, h), with all derivatives the scalar of `setup` carries.
///
/// `newton` is the same set-up for the iteration; `start` an ideal direction to begin from.
pub(crate) fn project<T: Real>(
    setup: &Setup<T>,
    newton: &Setup<Dual<2>>,
    view: View,
    p: [T; 3],
    start: Option<[f64; 2]>,
) -> Result<[T; 2], TraceError> {
    let world = setup.world(p);
    let (q, jacobian) = aim(newton, view, world.map(T::value), start)?;
    let not_seen = TraceError::NotSeen { view, point_mm: p.map(T::value) };
    // One more Newton step in T: by the implicit function theorem it carries exact derivatives.
    let q = q.map(T::constant);
    let m = miss(setup, view, q, world)?;
    let step = solve2(jacobian, m).ok_or(not_seen)?;
    setup.pixel(view, [q[0] - step[0], q[1] - step[1]]).ok_or(not_seen)?
}

/// Direction of an observed pixel but for the distortion: a start for the forward model.
pub(crate) fn near(optics: &Optics, pixel: [f64; 2]) -> Option<[f64; 2]> {
    let c = &optics.camera;
    Some([0, 1].map(|i| (pixel[i] - c.principal_point_px[i]) / c.focal_px))
}

impl OpticalModel {
    /// Pixel at which `view` sees the point (x, y, h) mm.
    ///
    /// # Errors
    /// If the point is not behind the grating or no ray of the order reaches it.
    pub fn project(&self, view: View, point_mm: Vector3<f64>) -> Result<[f64; 2], TraceError> {
        project(&self.plain, &self.by_direction, view, point_mm.into(), None)
    }

    /// Pixel at which `view` sees the point (x, y, h) mm, and its derivatives (2×3, px/mm) with
    /// respect to the point.
    ///
    /// # Errors
    /// As [`OpticalModel::project`].
    pub fn project_with_jacobian(
        &self,
        view: View,
        point_mm: Vector3<f64>,
    ) -> Result<([f64; 2], Matrix2x3<f64>), TraceError> {
        let p: [f64; 3] = point_mm.into();
        let p = [0, 1, 2].map(|i| Dual::<3>::variable(p[i], i));
        let pixel = project(&self.by_point, &self.by_direction, view, p, None)?;
        let [x, y] = pixel.map(|c| c.gradient);
        Ok((pixel.map(|c| c.value), Matrix2x3::new(x[0], x[1], x[2], y[0], y[1], y[2])))
    }

    /// Derivatives (px per unit of each field) of the pixel at which `view` sees the point with
    /// respect to every parameter.
    ///
    /// # Errors
    /// As [`OpticalModel::project`].
    pub fn project_parameter_jacobian(
        &self,
        view: View,
        point_mm: Vector3<f64>,
    ) -> Result<ParameterJacobian<2>, TraceError> {
        let p: [f64; 3] = point_mm.into();
        let pixel = project(&self.by_parameters, &self.by_direction, view, p.map(Dual::constant), None)?;
        Ok(ParameterJacobian(SMatrix::from_fn(|i, j| pixel[i].gradient[j])))
    }

    /// Pixel in the other view of what pixel `pixel_px` of view `from` sees at height `height_mm`.
    ///
    /// # Errors
    /// If either view does not see that point.
    pub fn transfer(&self, from: View, pixel_px: [f64; 2], height_mm: f64) -> Result<[f64; 2], TraceError> {
        let p = self.point_at_height(from, pixel_px, height_mm)?;
        self.project(from.other(), p)
    }

    /// Displacements (u, v) from the −1 to the +1 view to expect at a pixel of the −1 view while
    /// the surface lies between two heights (in either order): where to search for the match.
    ///
    /// u falls steadily with the height; v is all but constant (zero for a square, common grating
    /// and no distortion) and is taken over both ends and the middle.
    ///
    /// # Errors
    /// If a view does not see one of the points.
    pub fn disparity_range(
        &self,
        pixel_minus_px: [f64; 2],
        heights_mm: [f64; 2],
    ) -> Result<DisparityRange, TraceError> {
        let mut range = DisparityRange {
            u_px: [f64::INFINITY, f64::NEG_INFINITY],
            v_px: [f64::INFINITY, f64::NEG_INFINITY],
        };
        let middle = 0.5 * (heights_mm[0] + heights_mm[1]);
        for h in [heights_mm[0], middle, heights_mm[1]] {
            let plus = self.transfer(View::Minus, pixel_minus_px, h)?;
            let grow = |r: &mut [f64; 2], v: f64| *r = [r[0].min(v), r[1].max(v)];
            grow(&mut range.u_px, plus[0] - pixel_minus_px[0]);
            grow(&mut range.v_px, plus[1] - pixel_minus_px[1]);
        }
        Ok(range)
    }
}
