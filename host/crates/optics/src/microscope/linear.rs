//! The model of chapter 3: β₁…β₄ and the centre of perspective.
//!
//! With m = ((x₋, y₋) + (x₊, y₊))/2 the midpoint and δ = (x₋ − x₊)/2 half the approach of the views,
//! a displacement (u, v, w) of a material point changes them by (3.1)–(3.2)
//!
//! ```text
//! Δδ   = w/β₁
//! Δm_x = u/β₂ + (β₃/β₂)(m_x − x_c) w
//! Δm_y = v/β₂ + (β₄/β₂)(m_y − y_c) w
//! ```
//!
//! whose inverse is (3.3); (3.4)–(3.5) give height and object coordinates of a pair,
//!
//! ```text
//! h = β₁ (δ − δ₀)    x = (β₂ − β₃ h)(m_x − x_c)    y = (β₂ − β₄ h)(m_y − y_c)
//! ```
//!
//! with δ₀ half the approach on the plane h = 0 and the origin of x, y at the centre of perspective
//! (the literature's β₂ m_x has it at pixel 0: a constant).
//!
//! [`Form::Linear`] takes these formulas as they stand. They are the first order of a perspective
//! image, in which the magnification changes as 1/(1 − (β₃/β₂) h), in x and in the approach of the
//! views alike: [`Form::Perspective`] keeps that denominator. Both share the six parameters, which
//! are the derivatives on the plane h = 0, and differ by about (β₃/β₂) h of what non-telecentricity
//! does: second order, but more than the noise of good images at ±15 µm.

use nalgebra::{Matrix2x3, Matrix3, Matrix3x4, Matrix4, SMatrix, Vector3};
use serde::{Deserialize, Serialize};

use crate::decode::{Decoded, Displacement, PixelPair};
use crate::model::TraceError;
use crate::pair_model::PairModel;
use crate::real::{Dual, Real};
use crate::setup::View;

/// Which terms of the perspective are kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// (3.1)–(3.5) as they stand.
    #[default]
    Linear,
    /// With the denominator 1 − (β₃/β₂) h of a perspective image.
    Perspective,
}

impl Form {
    /// Name as in files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Perspective => "perspective",
        }
    }
}

/// The six parameters.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameters {
    /// β₁ = 1/(N M_z tan θ), mm/px: height per half approach of the views. Above 0.
    pub beta1_mm_per_px: f64,
    /// β₂ = 1/(N M_xy), mm/px: size of a pixel on the specimen. Below 0 for an image turned by 180°.
    pub beta2_mm_per_px: f64,
    /// β₃ = α_x/M_xy, 1/px: sideways shift along x per height and distance from the centre.
    pub beta3_per_px: f64,
    /// β₄ = α_y/M_xy, 1/px.
    pub beta4_per_px: f64,
    /// Centre of perspective (x_c, y_c), in pixels of the midpoint.
    pub centre_px: [f64; 2],
}

impl Parameters {
    /// As a vector: β₁, β₂, β₃, β₄, x_c, y_c.
    pub fn to_array(&self) -> [f64; 6] {
        let [x, y] = self.centre_px;
        [self.beta1_mm_per_px, self.beta2_mm_per_px, self.beta3_per_px, self.beta4_per_px, x, y]
    }

    /// From β₁, β₂, β₃, β₄, x_c, y_c.
    pub fn from_array([b1, b2, b3, b4, x, y]: [f64; 6]) -> Self {
        Self {
            beta1_mm_per_px: b1,
            beta2_mm_per_px: b2,
            beta3_per_px: b3,
            beta4_per_px: b4,
            centre_px: [x, y],
        }
    }
}

/// A parameter of the microscope outside its limits.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{field} is {value}, it must be {allowed}")]
pub struct MicroscopeError {
    /// Name of the field.
    pub field: &'static str,
    /// The value found.
    pub value: f64,
    /// What is allowed.
    pub allowed: &'static str,
}

/// Checks a value against what is allowed; NaN and infinity never are.
pub(super) fn check(
    field: &'static str,
    value: f64,
    fits: bool,
    allowed: &'static str,
) -> Result<(), MicroscopeError> {
    if value.is_finite() && fits { Ok(()) } else { Err(MicroscopeError { field, value, allowed }) }
}

/// The linear model, validated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Microscope {
    parameters: Parameters,
    form: Form,
    reference_disparity_px: [f64; 2],
}

impl Microscope {
    /// The model with the disparity (x₊ − x₋, y₊ − y₋) of the plane h = 0. Without it, (0, 0), heights
    /// count from where the views would coincide: an unknown constant is added to all of them.
    ///
    /// # Errors
    /// The first parameter that is not finite or not allowed.
    pub fn new(
        parameters: Parameters,
        form: Form,
        reference_disparity_px: [f64; 2],
    ) -> Result<Self, MicroscopeError> {
        let p = &parameters;
        check(
            "beta1",
            p.beta1_mm_per_px,
            p.beta1_mm_per_px > 0.0,
            "a finite number above 0; below 0 the −1 and +1 views are swapped",
        )?;
        check("beta2", p.beta2_mm_per_px, p.beta2_mm_per_px != 0.0, "a finite number other than 0")?;
        for (field, value) in [
            ("beta3", p.beta3_per_px),
            ("beta4", p.beta4_per_px),
            ("centre[0]", p.centre_px[0]),
            ("centre[1]", p.centre_px[1]),
            ("reference_disparity[0]", reference_disparity_px[0]),
            ("reference_disparity[1]", reference_disparity_px[1]),
        ] {
            check(field, value, true, "a finite number")?;
        }
        Ok(Self { parameters, form, reference_disparity_px })
    }

    /// The parameters.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// The form.
    pub fn form(&self) -> Form {
        self.form
    }

    /// Disparity of the plane h = 0, pixels.
    pub fn reference_disparity_px(&self) -> [f64; 2] {
        self.reference_disparity_px
    }

    fn beta<T: Real>(&self) -> Beta<T> {
        let k = T::constant;
        let [b1, b2, b3, b4, x, y] = self.parameters.to_array().map(k);
        Beta {
            b1,
            b2,
            b3,
            b4,
            centre: [x, y],
            form: self.form,
            disparity: self.reference_disparity_px.map(k),
        }
    }

    fn by_parameters(&self) -> Beta<Dual<6>> {
        let p = self.parameters.to_array();
        let v = |i: usize| Dual::<6>::variable(p[i], i);
        Beta {
            b1: v(0),
            b2: v(1),
            b3: v(2),
            b4: v(3),
            centre: [v(4), v(5)],
            form: self.form,
            disparity: self.reference_disparity_px.map(Dual::constant),
        }
    }

    /// Derivatives (3×6) of the decoded point with respect to [`Parameters::to_array`]: what the
    /// covariance of the calibration does to a point, in common for all points.
    ///
    /// # Errors
    /// As [`PairModel::decode_pair`].
    pub fn parameter_jacobian(&self, pair: PixelPair) -> Result<SMatrix<f64, 3, 6>, TraceError> {
        let (p, _) = self.by_parameters().decode(pair.coordinates().map(Dual::constant))?;
        Ok(SMatrix::from_fn(|i, j| p[i].gradient[j]))
    }

    /// As [`Microscope::parameter_jacobian`], of the displacement from one pair to another.
    ///
    /// # Errors
    /// As [`PairModel::decode_pair`].
    pub fn displacement_parameter_jacobian(
        &self,
        reference: PixelPair,
        deformed: PixelPair,
    ) -> Result<SMatrix<f64, 3, 6>, TraceError> {
        if self.form == Form::Perspective {
            return Ok(self.parameter_jacobian(deformed)? - self.parameter_jacobian(reference)?);
        }
        let [a, b] = [reference, deformed].map(|p| p.coordinates());
        let moved = std::array::from_fn(|i| Dual::constant(b[i] - a[i]));
        let u = self.by_parameters().displacement(a.map(Dual::constant), moved)?;
        Ok(SMatrix::from_fn(|i, j| u[i].gradient[j]))
    }

    /// Image displacements (u₋, v₋, u₊, v₊) in pixels by the forward model (3.1)–(3.2) of a material
    /// point seen at `pair` that moves by `displacement_mm`.
    ///
    /// # Errors
    /// As [`PairModel::decode_pair`]; also if the point leaves the model's half space.
    pub fn forward(&self, pair: PixelPair, displacement_mm: Vector3<f64>) -> Result<[f64; 4], TraceError> {
        let c = pair.coordinates();
        let [u, v, w]: [f64; 3] = displacement_mm.into();
        if self.form == Form::Linear {
            let p = &self.parameters;
            let middle = [0.5 * (c[0] + c[2]), 0.5 * (c[1] + c[3])];
            let (b2, [xc, yc]) = (p.beta2_mm_per_px, p.centre_px);
            let common = u / b2 + p.beta3_per_px / b2 * (middle[0] - xc) * w;
            let across = v / b2 + p.beta4_per_px / b2 * (middle[1] - yc) * w;
            let apart = w / p.beta1_mm_per_px;
            let moved = [common + apart, across, common - apart, across];
            return if moved.iter().all(|m| m.is_finite()) { Ok(moved) } else { Err(TraceError::NotFinite) };
        }
        let beta = self.beta::<f64>();
        let (p, _) = beta.decode(c)?;
        let q = beta.project([p[0] + u, p[1] + v, p[2] + w])?;
        let p = beta.project(p)?;
        Ok(std::array::from_fn(|i| q[i] - p[i]))
    }
}

/// The model for any scalar.
struct Beta<T> {
    b1: T,
    b2: T,
    b3: T,
    b4: T,
    centre: [T; 2],
    form: Form,
    disparity: [T; 2],
}

fn finite<T: Real>(values: &[T]) -> Result<(), TraceError> {
    if values.iter().all(|v| v.value().is_finite()) { Ok(()) } else { Err(TraceError::NotFinite) }
}

/// The scale at a height: positive in units of β₂, else the point lies behind the centre of projection.
fn in_front<T: Real>(ratio: T) -> Result<T, TraceError> {
    if ratio.value() > 0.0 { Ok(ratio) } else { Err(TraceError::NoIntersection) }
}

impl<T: Real> Beta<T> {
    /// x and y of the midpoint relative to the centre, and δ − δ₀.
    fn measured(&self, c: [T; 4]) -> [T; 3] {
        let half = T::constant(0.5);
        [
            (c[0] + c[2]) * half - self.centre[0],
            (c[1] + c[3]) * half - self.centre[1],
            (c[0] - c[2] + self.disparity[0]) * half,
        ]
    }

    /// (x, y, h) and the gap y₊ − y₋ − v₀ on the specimen.
    fn decode(&self, c: [T; 4]) -> Result<([T; 3], T), TraceError> {
        finite(&c)?;
        let one = T::constant(1.0);
        let [x, y, delta] = self.measured(c);
        let mut h = self.b1 * delta;
        if self.form == Form::Perspective {
            h = h / in_front(one + self.b3 / self.b2 * h)?;
        }
        let scale = [self.b3, self.b4].map(|b| self.b2 - b * h);
        for s in scale {
            in_front(s / self.b2)?;
        }
        let gap = (c[3] - c[1] - self.disparity[1]) * scale[1];
        Ok(([scale[0] * x, scale[1] * y, h], gap))
    }

    /// (x₋, y₋, x₊, y₊).
    fn project(&self, p: [T; 3]) -> Result<[T; 4], TraceError> {
        finite(&p)?;
        let half = T::constant(0.5);
        let one = T::constant(1.0);
        let scale = [self.b3, self.b4].map(|b| self.b2 - b * p[2]);
        for s in scale {
            in_front(s / self.b2)?;
        }
        let mut delta = p[2] / self.b1;
        if self.form == Form::Perspective {
            delta = delta / (one - self.b3 / self.b2 * p[2]);
        }
        let x = self.centre[0] + p[0] / scale[0];
        let y = self.centre[1] + p[1] / scale[1];
        let [dx, dy] = self.disparity.map(|d| d * half);
        Ok([x - dx + delta, y - dy, x + dx - delta, y + dy])
    }

    /// (3.3) for a pair and the four increments.
    fn displacement(&self, at: [T; 4], moved: [T; 4]) -> Result<[T; 3], TraceError> {
        finite(&at)?;
        finite(&moved)?;
        let half = T::constant(0.5);
        let [x, y, _] = self.measured(at);
        let w = self.b1 * (moved[0] - moved[2]) * half;
        let u = self.b2 * (moved[0] + moved[2]) * half - self.b3 * x * w;
        let v = self.b2 * (moved[1] + moved[3]) * half - self.b4 * y * w;
        Ok([u, v, w])
    }
}

impl PairModel for Microscope {
    fn decode_pair(&self, pair: PixelPair) -> Result<Decoded, TraceError> {
        let c = pair.coordinates();
        let (p, gap) = self.beta::<Dual<4>>().decode(std::array::from_fn(|i| Dual::variable(c[i], i)))?;
        Ok(Decoded {
            point_mm: p.map(|p| p.value).into(),
            gap_mm: gap.value,
            gap_jacobian: gap.gradient.into(),
            jacobian: Matrix3x4::from_fn(|i, j| p[i].gradient[j]),
        })
    }

    fn project_point(
        &self,
        view: View,
        point_mm: Vector3<f64>,
    ) -> Result<([f64; 2], Matrix2x3<f64>), TraceError> {
        let p: [f64; 3] = point_mm.into();
        let c = self.beta::<Dual<3>>().project(std::array::from_fn(|i| Dual::variable(p[i], i)))?;
        let [x, y] = match view {
            View::Minus => [c[0], c[1]],
            View::Plus => [c[2], c[3]],
        };
        let (gx, gy) = (x.gradient, y.gradient);
        Ok(([x.value, y.value], Matrix2x3::new(gx[0], gx[1], gx[2], gy[0], gy[1], gy[2])))
    }

    /// [`Form::Linear`]: (3.3) at the reference midpoint, which is not exactly the difference of the
    /// two points of (3.5). [`Form::Perspective`]: that difference.
    fn track(
        &self,
        reference: PixelPair,
        deformed: PixelPair,
        reference_px2: &Matrix4<f64>,
        tracking_px2: &Matrix4<f64>,
    ) -> Result<Displacement, TraceError> {
        let (a, b) = (self.decode_pair(reference)?, self.decode_pair(deformed)?);
        if self.form == Form::Perspective {
            return Ok(Displacement::between(a, b, reference_px2, tracking_px2));
        }
        let (from, to) = (reference.coordinates(), deformed.coordinates());
        let at = |i: usize| Dual::<8>::variable(from[i], i);
        let by = |i: usize| Dual::<8>::variable(to[i] - from[i], 4 + i);
        let u = self.beta::<Dual<8>>().displacement(std::array::from_fn(at), std::array::from_fn(by))?;
        let place = Matrix3x4::from_fn(|i, j| u[i].gradient[j]);
        let increments = Matrix3x4::from_fn(|i, j| u[i].gradient[4 + j]);
        let covariance_mm2: Matrix3<f64> =
            place * reference_px2 * place.transpose() + increments * tracking_px2 * increments.transpose();
        Ok(Displacement {
            reference: a,
            deformed: b,
            displacement_mm: u.map(|u| u.value).into(),
            covariance_mm2,
        })
    }
}
