//! Pinhole camera with Brown–Conrady distortion.
//!
//! A direction is given by its normalised coordinates q = (X/Z, Y/Z). The distortion turns the
//! ideal q into the observed one, and the pixel is F·q_observed + principal point; so the
//! image distortion of the literature, observed = ideal + e, is e = F·(q_observed − q).

use serde::{Deserialize, Serialize};

use crate::real::{Dual, Real, solve2};

/// Coefficients of Brown–Conrady distortion, acting on normalised coordinates (x/F):
///
/// ```text
/// x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)
/// y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Brown {
    /// Radial, r².
    pub k1: f64,
    /// Radial, r⁴.
    pub k2: f64,
    /// Radial, r⁶.
    pub k3: f64,
    /// Tangential.
    pub p1: f64,
    /// Tangential.
    pub p2: f64,
}

/// A pinhole camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// F = f/b: distance from pinhole to image plane in pixels.
    pub focal_px: f64,
    /// Where the optical axis meets the sensor, in pixels.
    pub principal_point_px: [f64; 2],
    /// Lens distortion.
    #[serde(default)]
    pub brown: Brown,
}

/// A pixel from which no ideal direction could be computed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "the distortion model cannot be inverted at pixel ({:.2}, {:.2}): it folds over or is too strong there",
    pixel_px[0], pixel_px[1]
)]
pub struct UndistortError {
    /// The pixel.
    pub pixel_px: [f64; 2],
}

impl Camera {
    /// Pixel of the direction with normalised coordinates `q` (explicit, never fails).
    pub fn pixel(&self, q: [f64; 2]) -> [f64; 2] {
        CameraModel::<f64>::new(self).pixel(q)
    }

    /// Normalised coordinates of the direction that `pixel_px` sees, to about 1e-14.
    ///
    /// # Errors
    /// If Newton's iteration does not converge or ends where the model folds over.
    pub fn direction(&self, pixel_px: [f64; 2]) -> Result<[f64; 2], UndistortError> {
        CameraModel::<f64>::new(self).direction(pixel_px)
    }

    /// Observed pixel of an ideal one (pixel of a distortion-free camera): adds e.
    pub fn distort_px(&self, ideal_px: [f64; 2]) -> [f64; 2] {
        let [cx, cy] = self.principal_point_px;
        self.pixel([(ideal_px[0] - cx) / self.focal_px, (ideal_px[1] - cy) / self.focal_px])
    }

    /// Ideal pixel (x*, y*) of an observed one: takes e away.
    ///
    /// # Errors
    /// As [`Camera::direction`].
    pub fn undistort_px(&self, observed_px: [f64; 2]) -> Result<[f64; 2], UndistortError> {
        let [x, y] = self.direction(observed_px)?;
        let [cx, cy] = self.principal_point_px;
        Ok([self.focal_px * x + cx, self.focal_px * y + cy])
    }
}

/// The camera for any scalar.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CameraModel<T> {
    focal: T,
    principal_point: [T; 2],
    brown: Coefficients<T>,
    /// Whether the distortion or a derivative by it is anything but zero.
    distorting: bool,
}

/// k1, k2, k3, p1, p2.
pub(crate) type Coefficients<T> = [T; 5];

impl Brown {
    /// In their order.
    pub(crate) fn coefficients(&self) -> Coefficients<f64> {
        [self.k1, self.k2, self.k3, self.p1, self.p2]
    }
}

impl<T: Real> CameraModel<T> {
    pub(crate) fn new(camera: &Camera) -> Self {
        Self::of(
            T::constant(camera.focal_px),
            camera.principal_point_px.map(T::constant),
            camera.brown.coefficients().map(T::constant),
        )
    }

    pub(crate) fn of(focal: T, principal_point: [T; 2], brown: Coefficients<T>) -> Self {
        let distorting = brown.iter().any(|c| c.value() != 0.0 || !c.is_constant());
        Self { focal, principal_point, brown, distorting }
    }

    #[inline]
    pub(crate) fn pixel(&self, q: [T; 2]) -> [T; 2] {
        let [x, y] = if self.distorting { distort(&self.brown, q) } else { q };
        [self.focal * x + self.principal_point[0], self.focal * y + self.principal_point[1]]
    }

    #[inline]
    pub(crate) fn direction(&self, pixel: [T; 2]) -> Result<[T; 2], UndistortError> {
        let observed = [
            (pixel[0] - self.principal_point[0]) / self.focal,
            (pixel[1] - self.principal_point[1]) / self.focal,
        ];
        if !self.distorting {
            return Ok(observed);
        }
        undistort(&self.brown, observed).ok_or(UndistortError { pixel_px: pixel.map(T::value) })
    }

    /// Whether the distortion is one to one at the ideal coordinates `q` (it folds over where not).
    pub(crate) fn is_invertible(&self, q: [f64; 2]) -> bool {
        !self.distorting || is_invertible(&self.brown.map(T::value), q)
    }
}

#[inline]
fn distort<T: Real>(b: &Coefficients<T>, [x, y]: [T; 2]) -> [T; 2] {
    let k = T::constant;
    let [k1, k2, k3, p1, p2] = *b;
    let (xx, yy, xy) = (x * x, y * y, x * y);
    let r2 = xx + yy;
    let radial = k(1.0) + r2 * (k1 + r2 * (k2 + r2 * k3));
    let two = k(2.0);
    [x * radial + two * p1 * xy + p2 * (r2 + two * xx), y * radial + p1 * (r2 + two * yy) + two * p2 * xy]
}

/// ∂(observed)/∂(ideal) at the ideal coordinates `q`, and the observed coordinates.
pub(crate) fn distort_jacobian(b: &Coefficients<f64>, q: [f64; 2]) -> ([f64; 2], [[f64; 2]; 2]) {
    let b = b.map(Dual::constant);
    let d = distort(&b, [Dual::<2>::variable(q[0], 0), Dual::<2>::variable(q[1], 1)]);
    (d.map(|d| d.value), d.map(|d| d.gradient))
}

fn is_invertible(b: &Coefficients<f64>, q: [f64; 2]) -> bool {
    let (_, m) = distort_jacobian(b, q);
    m[0][0] > 0.0 && m[0][0] * m[1][1] - m[0][1] * m[1][0] > 0.0
}

fn undistort<T: Real>(brown: &Coefficients<T>, observed: [T; 2]) -> Option<[T; 2]> {
    let b = brown.map(T::value);
    let target = observed.map(T::value);
    let mut q = target;
    for _ in 0..30 {
        let (at, m) = distort_jacobian(&b, q);
        let step = solve2(m, [at[0] - target[0], at[1] - target[1]])?;
        q = [q[0] - step[0], q[1] - step[1]];
        // Convergence is quadratic: after a step this small the error is below rounding.
        if step[0].abs() + step[1].abs() < 1e-9 {
            if !is_invertible(&b, q) {
                return None;
            }
            // One more step in the caller's scalar brings in its derivatives exactly.
            let (_, m) = distort_jacobian(&b, q);
            let q = q.map(T::constant);
            let at = distort(brown, q);
            let step = solve2(m, [at[0] - observed[0], at[1] - observed[1]])?;
            return Some([q[0] - step[0], q[1] - step[1]]);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(brown: Brown) -> Camera {
        Camera { focal_px: 17956.2, principal_point_px: [1295.5, 971.5], brown }
    }

    const STRONG: Brown = Brown { k1: -0.8, k2: 4.0, k3: 10.0, p1: 0.004, p2: -0.003 };

    #[test]
    fn undistort_inverts_distort() {
        let c = camera(STRONG);
        for x in [0.0, 500.0, 1295.5, 2591.0, 4000.0] {
            for y in [-700.0, 0.0, 971.5, 1943.0] {
                let back = c.undistort_px(c.distort_px([x, y])).unwrap();
                // 1e-11 px: rounding of coordinates of a few thousand pixels, times ten.
                assert!((back[0] - x).abs() < 1e-11 && (back[1] - y).abs() < 1e-11);
            }
        }
    }

    /// Signs and sizes against the terms worked out by hand for single coefficients.
    #[test]
    fn distortion_signs() {
        let x = 1295.5 + 1795.62; // q = (0.1, 0)
        let y = 971.5 + 3591.24; // q = (·, 0.2)
        let one = |brown: Brown, p: [f64; 2]| {
            let o = camera(brown).distort_px(p);
            [(o[0] - p[0]) / 17956.2, (o[1] - p[1]) / 17956.2]
        };
        let near = |a: [f64; 2], b: [f64; 2]| {
            assert!((a[0] - b[0]).abs() < 1e-14 && (a[1] - b[1]).abs() < 1e-14, "{a:?} {b:?}");
        };
        let zero = Brown::default();
        // k1 > 0 pushes outwards: e = +k1 r² x.
        near(one(Brown { k1: 0.3, ..zero }, [x, 971.5]), [0.3e-3, 0.0]);
        near(one(Brown { k1: 0.3, ..zero }, [x, y]), [0.3 * 0.05 * 0.1, 0.3 * 0.05 * 0.2]);
        near(one(Brown { k2: 0.3, ..zero }, [x, y]), [0.3 * 0.0025 * 0.1, 0.3 * 0.0025 * 0.2]);
        near(one(Brown { k3: 2.0, ..zero }, [x, y]), [2.0 * 1.25e-4 * 0.1, 2.0 * 1.25e-4 * 0.2]);
        near(one(Brown { p1: 0.1, ..zero }, [x, y]), [0.2 * 0.02, 0.1 * (0.05 + 0.08)]);
        near(one(Brown { p2: 0.1, ..zero }, [x, y]), [0.1 * (0.05 + 0.02), 0.2 * 0.02]);
    }

    #[test]
    fn fold_and_nan_are_errors() {
        // x' = x − 30 x³ has its maximum 0.0703 at x = 0.105.
        let c = camera(Brown { k1: -30.0, ..Brown::default() });
        assert!(c.undistort_px([1295.5 + 0.06 * 17956.2, 971.5]).is_ok());
        let p = [1295.5 + 0.08 * 17956.2, 971.5];
        assert_eq!(c.undistort_px(p), Err(UndistortError { pixel_px: p }));
        assert!(c.undistort_px([f64::NAN, 0.0]).is_err());
        assert!(c.undistort_px([f64::INFINITY, 0.0]).is_err());
    }
}
