//! From a pixel pair to a point, by three models behind one interface.

use nalgebra::{Matrix3, Matrix3x4, Matrix4, RowVector4, SMatrix, Vector3};
use serde::{Deserialize, Serialize};

use crate::model::{OpticalModel, Paraxial, Setup, TraceError};
use crate::parameter::{ParameterCovariance, ParameterJacobian};
use crate::real::{Dual, Real, along, cross, dot, sub};
use crate::setup::View;

/// How a pixel pair becomes a point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decoder {
    /// The grating equation itself: both lines of sight are traced and the point is the middle of
    /// the shortest segment between them. Exact for any pose and substrate.
    #[default]
    Ray,
    /// Virtual object at z/cos³θ, solved exactly: z = u s / (2 F t − u/c³).
    Closed,
    /// The same, linearised in the height about the reference plane, as in the literature.
    Linear,
}

/// Pixels of one material point in the two views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PixelPair {
    /// (x₋, y₋) in the −1 view.
    pub minus_px: [f64; 2],
    /// (x₊, y₊) in the +1 view.
    pub plus_px: [f64; 2],
}

impl PixelPair {
    /// From the pixel in the −1 view and the displacement (u, v) to the +1 view.
    pub fn from_disparity(minus_px: [f64; 2], u: f64, v: f64) -> Self {
        Self { minus_px, plus_px: [minus_px[0] + u, minus_px[1] + v] }
    }

    /// The pixel in `view`.
    pub fn pixel(&self, view: View) -> [f64; 2] {
        match view {
            View::Minus => self.minus_px,
            View::Plus => self.plus_px,
        }
    }

    pub(crate) fn coordinates(&self) -> [f64; 4] {
        let ([a, b], [c, d]) = (self.minus_px, self.plus_px);
        [a, b, c, d]
    }
}

/// Covariance (px²) of (x₋, y₋, x₊, y₊) from independent standard deviations.
pub fn pixel_covariance(sigma_minus_px: [f64; 2], sigma_plus_px: [f64; 2]) -> Matrix4<f64> {
    let ([a, b], [c, d]) = (sigma_minus_px, sigma_plus_px);
    Matrix4::from_diagonal(&nalgebra::Vector4::new(a * a, b * b, c * c, d * d))
}

/// A decoded point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decoded {
    /// (x, y, h) in millimetres.
    pub point_mm: Vector3<f64>,
    /// How far the pair is from meeting: for [`Decoder::Ray`] the shortest distance of the two lines of
    /// sight; for the virtual-object models v on the scale of the object. Above 0 where the +1 view's
    /// passes at larger y.
    pub gap_mm: f64,
    /// ∂gap/∂(x₋, y₋, x₊, y₊), mm/px.
    pub gap_jacobian: RowVector4<f64>,
    /// ∂(x, y, h)/∂(x₋, y₋, x₊, y₊), mm/px.
    pub jacobian: Matrix3x4<f64>,
}

impl Decoded {
    /// Covariance (mm²) of the point from that of the four pixel coordinates (px²).
    pub fn covariance_mm2(&self, pixels: &Matrix4<f64>) -> Matrix3<f64> {
        self.jacobian * pixels * self.jacobian.transpose()
    }

    /// Variance (mm²) of the gap from the covariance of the four pixel coordinates (px²).
    pub fn gap_variance_mm2(&self, pixels: &Matrix4<f64>) -> f64 {
        (self.gap_jacobian * pixels * self.gap_jacobian.transpose())[0]
    }
}

/// A decoded point and its covariance in two parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UncertainPoint {
    /// The point.
    pub decoded: Decoded,
    /// Covariance (mm²) from the pixels, independent from point to point.
    pub independent_mm2: Matrix3<f64>,
    /// Covariance (mm²) from the calibration, shared with all other points:
    /// [`ParameterCovariance::between`] gives it between two.
    pub common_mm2: Matrix3<f64>,
    /// Variance (mm²) of the gap from the pixels.
    pub gap_independent_mm2: f64,
    /// Variance (mm²) of the gap from the calibration.
    pub gap_common_mm2: f64,
}

impl UncertainPoint {
    /// Standard deviations of (x, y, h) from both parts together, mm.
    pub fn sigma_mm(&self) -> Vector3<f64> {
        (self.independent_mm2 + self.common_mm2).diagonal().map(f64::sqrt)
    }
}

/// Displacement of a material point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Displacement {
    /// The point before.
    pub reference: Decoded,
    /// The point after.
    pub deformed: Decoded,
    /// Displacement (x, y, h) in millimetres.
    pub displacement_mm: Vector3<f64>,
    /// Its covariance in mm², from the pixels alone.
    pub covariance_mm2: Matrix3<f64>,
}

impl Displacement {
    /// Difference of two decoded points, and its covariance: an error of the reference pair moves
    /// both points and all but cancels, those of the increments (`tracking_px2`) do not.
    pub(crate) fn between(
        reference: Decoded,
        deformed: Decoded,
        reference_px2: &Matrix4<f64>,
        tracking_px2: &Matrix4<f64>,
    ) -> Self {
        let common = deformed.jacobian - reference.jacobian;
        Self {
            reference,
            deformed,
            displacement_mm: deformed.point_mm - reference.point_mm,
            covariance_mm2: common * reference_px2 * common.transpose()
                + deformed.covariance_mm2(tracking_px2),
        }
    }
}

impl OpticalModel {
    /// Point seen by a pixel pair.
    ///
    /// # Errors
    /// If an input is not finite, the distortion cannot be undone, an order does not propagate,
    /// or the lines of sight do not meet behind the grating.
    pub fn decode(&self, decoder: Decoder, pair: PixelPair) -> Result<Decoded, TraceError> {
        let c = pair.coordinates();
        let v = |i: usize| Dual::<4>::variable(c[i], i);
        let (p, gap) = decode(&self.by_pair, decoder, [v(0), v(1)], [v(2), v(3)])?;
        Ok(Decoded {
            point_mm: p.map(|p| p.value).into(),
            gap_mm: gap.value,
            gap_jacobian: gap.gradient.into(),
            jacobian: Matrix3x4::from_fn(|i, j| p[i].gradient[j]),
        })
    }

    /// As [`OpticalModel::decode`], the point alone: cheaper where no Jacobian is needed.
    ///
    /// # Errors
    /// As [`OpticalModel::decode`].
    pub fn decode_point(&self, decoder: Decoder, pair: PixelPair) -> Result<Vector3<f64>, TraceError> {
        let (p, _) = decode(&self.plain, decoder, pair.minus_px, pair.plus_px)?;
        Ok(p.into())
    }

    /// Derivatives (mm per unit of each field) of the decoded point with respect to every
    /// parameter: what the covariance of a calibration does to a point, in common for all points.
    ///
    /// # Errors
    /// As [`OpticalModel::decode`].
    pub fn parameter_jacobian(
        &self,
        decoder: Decoder,
        pair: PixelPair,
    ) -> Result<ParameterJacobian<3>, TraceError> {
        let all = self.point_and_gap_by_parameters(decoder, pair)?;
        Ok(ParameterJacobian(all.0.fixed_rows::<3>(0).into_owned()))
    }

    /// Derivatives of (x, y, h, gap) with respect to every parameter.
    fn point_and_gap_by_parameters(
        &self,
        decoder: Decoder,
        pair: PixelPair,
    ) -> Result<ParameterJacobian<4>, TraceError> {
        let constant = |p: [f64; 2]| p.map(Dual::constant);
        let (p, gap) = decode(&self.by_parameters, decoder, constant(pair.minus_px), constant(pair.plus_px))?;
        let rows = [p[0], p[1], p[2], gap];
        Ok(ParameterJacobian(SMatrix::from_fn(|i, j| rows[i].gradient[j])))
    }

    /// The point with its covariance in two parts: what the pixels' noise does to this point
    /// alone, and what the calibration's does to it in common with all others.
    ///
    /// # Errors
    /// As [`OpticalModel::decode`].
    pub fn decode_with_covariance(
        &self,
        decoder: Decoder,
        pair: PixelPair,
        pixels_px2: &Matrix4<f64>,
        calibration: &ParameterCovariance,
    ) -> Result<UncertainPoint, TraceError> {
        let decoded = self.decode(decoder, pair)?;
        let common = if calibration.parameters().is_empty() {
            Matrix4::zeros()
        } else {
            let by = self.point_and_gap_by_parameters(decoder, pair)?;
            calibration.between(&by, &by)
        };
        Ok(UncertainPoint {
            independent_mm2: decoded.covariance_mm2(pixels_px2),
            common_mm2: common.fixed_view::<3, 3>(0, 0).into_owned(),
            gap_independent_mm2: decoded.gap_variance_mm2(pixels_px2),
            gap_common_mm2: common[(3, 3)],
            decoded,
        })
    }

    /// Displacement of a material point tracked in both views.
    ///
    /// `reference_px2` is the covariance (px²) of the pair in the reference frame (the match
    /// between the views), `tracking_px2` that of the four increments from it to the deformed
    /// frame. An error of the reference pair moves both points and all but cancels in the
    /// difference; the increments do not.
    ///
    /// # Errors
    /// As [`OpticalModel::decode`].
    pub fn displacement(
        &self,
        decoder: Decoder,
        reference: PixelPair,
        deformed: PixelPair,
        reference_px2: &Matrix4<f64>,
        tracking_px2: &Matrix4<f64>,
    ) -> Result<Displacement, TraceError> {
        let reference = self.decode(decoder, reference)?;
        let deformed = self.decode(decoder, deformed)?;
        Ok(Displacement::between(reference, deformed, reference_px2, tracking_px2))
    }
}

fn decode<T: Real>(
    setup: &Setup<T>,
    decoder: Decoder,
    minus: [T; 2],
    plus: [T; 2],
) -> Result<([T; 3], T), TraceError> {
    let finite = |p: [T; 2]| p.iter().all(|c| c.value().is_finite());
    if !(finite(minus) && finite(plus)) {
        return Err(TraceError::NotFinite);
    }
    let minus = setup.direction(View::Minus, minus)?;
    let plus = setup.direction(View::Plus, plus)?;
    let (point, gap) = match decoder {
        Decoder::Ray => by_rays(setup, minus, plus)?,
        Decoder::Closed | Decoder::Linear => {
            by_virtual_object(setup, decoder == Decoder::Linear, minus, plus)?
        }
    };
    // distances near the largest number have squares beyond it
    let finite = point.iter().all(|c| c.value().is_finite()) && gap.value().is_finite();
    if finite { Ok((point, gap)) } else { Err(TraceError::NotFinite) }
}

fn by_rays<T: Real>(setup: &Setup<T>, minus: [T; 2], plus: [T; 2]) -> Result<([T; 3], T), TraceError> {
    let a = setup.trace(View::Minus, minus)?;
    let b = setup.trace(View::Plus, plus)?;
    // Lines a + s·da and b + t·db with unit directions; the shortest segment is normal to both.
    let w = sub(a.origin, b.origin);
    let cos = dot(a.direction, b.direction);
    let (wa, wb) = (dot(w, a.direction), dot(w, b.direction));
    let sin2 = T::constant(1.0) - cos * cos;
    if sin2.value() < 1e-12 {
        return Err(TraceError::NoIntersection);
    }
    let on_a = along(a.origin, a.direction, (cos * wb - wa) / sin2);
    let on_b = along(b.origin, b.direction, (wb - cos * wa) / sin2);
    let half = T::constant(0.5);
    let middle = [0, 1, 2].map(|i| (on_a[i] + on_b[i]) * half);
    for view in View::BOTH {
        let distance_mm = setup.behind(view, middle);
        if !(distance_mm > 0.0) {
            return Err(TraceError::BeforeGrating { distance_mm });
        }
    }
    // Both lines lean towards each other along x, so the normal of both points along −y.
    let normal = cross(a.direction, b.direction);
    Ok((setup.object(middle), dot(w, normal) / dot(normal, normal).sqrt()))
}

/// The paraxial models, with pixels already free of distortion and divided by F.
fn by_virtual_object<T: Real>(
    setup: &Setup<T>,
    linear: bool,
    minus: [T; 2],
    plus: [T; 2],
) -> Result<([T; 3], T), TraceError> {
    let one = T::constant(1.0);
    let half = T::constant(0.5);
    let Paraxial { s, d, sin_theta: sin } = setup.paraxial;
    let cos = (one - sin * sin).sqrt();
    let (tan, c3) = (sin / cos, cos * cos * cos);
    // u*/F, v*/F and the middle of the two views.
    let (u, v) = (plus[0] - minus[0], plus[1] - minus[1]);
    let middle = [minus[0] + u * half, minus[1] + v * half];
    let (h, scale) = if linear {
        let scale = s + d / c3;
        let h = (d - scale * u / (tan + tan)) * (one + d / (s * c3));
        (h, scale / (one + h / (s * c3 + d)))
    } else {
        let below = tan + tan - u / c3;
        if !(below.value() > 0.0) {
            return Err(TraceError::NoIntersection);
        }
        let z = u * s / below;
        (d - z, s + z / c3)
    };
    let distance_mm = (d - h).value();
    if !(distance_mm > 0.0) {
        return Err(TraceError::BeforeGrating { distance_mm });
    }
    let world = [middle[0] * scale, middle[1] * scale, s + d - h];
    Ok((setup.object(world), v * scale))
}
