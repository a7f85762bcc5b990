//! The microscope as exact rays through a stated geometry.
//!
//! Axes: origin where the optical axis meets the grating (its pivot), x right, y down, z towards the
//! specimen. The light goes the other way; rays are traced from the sensor.
//!
//! **Relay** (objectives 1 and 2). An ideal imaging system maps straight lines to straight lines, so
//! with the height h of a specimen point over the reference plane
//!
//! ```text
//! (x', y') = M (x, y)/(1 + κ h)    h' = M_z h/(1 + κ h)    M_z = M²/n
//! ```
//!
//! (Newton's equation ξ ξ' = −f f' about the conjugate planes; n the index of refraction around the
//! specimen, −1/κ the height of the focal point). κ = 0 is an afocal, telecentric relay. The
//! intermediate image of the reference plane lies at z = D.
//!
//! **Objective 3.** A pixel p is conjugate to r = (p − axis) b/N in the plane z = z_f, and its chief ray
//! passes through the middle of the entrance pupil at z = z_f − 1/κ₃:
//! (x, y) = r (1 + κ₃ (z − z_f)). κ₃ = 0 is object-side telecentric.
//!
//! **Grating.** The chief ray meets the grating's plane, its direction cosines become
//! α' = α + mλ/p, β' = β (exactly, in any pose; see [`crate::grating`]), and it goes on straight to
//! the intermediate image. The −1 and +1 pixels of a point give two rays; their meeting point,
//! taken back through the relay, is the specimen's.
//!
//! Only the chief ray is traced: that a wide cone through the grating is not stigmatic moves the
//! centroid of a defocused image and is not part of this model.
//!
//! About the axis, with t = tan θ, a square grating and everything telecentric this is (3.1)–(3.2)
//! exactly, with β₁ = b/(N M_z t), β₂ = b/(N M), β₃ = β₄ = 0. To first order κ adds −κ β₂ to both
//! β₃ and β₄; κ₃ adds M_z β₂ κ₃/cos³θ to β₃ along x and M_z β₂ κ₃/cos θ to β₄: the grating makes
//! α_x and α_y differ. [`RayMicroscope::parameters`] gives them with every order in κ₃.

use nalgebra::{Matrix2x3, Matrix3x4, Vector3};
use serde::{Deserialize, Serialize};

use super::linear::{MicroscopeError, Parameters, check};
use crate::decode::{Decoded, PixelPair};
use crate::grating::{Axes, Grating, SubstrateSide};
use crate::model::TraceError;
use crate::pair_model::PairModel;
use crate::real::{Dual, Real, along, cross, dot, solve2, sub};
use crate::setup::View;

/// Objectives 1 and 2: from the specimen to the intermediate image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Relay {
    /// Lateral magnification M on the reference plane; below 0 if the image is turned.
    pub magnification: f64,
    /// Index of refraction n around the specimen.
    pub index: f64,
    /// κ in 1/mm: relative fall of the magnification with the height. 0 if telecentric.
    pub perspective_per_mm: f64,
}

/// Objective 3 with the camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Objective {
    /// Magnification N > 0 onto the sensor.
    pub magnification: f64,
    /// z_f in millimetres: distance from the grating to the plane that is sharp on the sensor.
    pub focus_mm: f64,
    /// κ₃ in 1/mm: reciprocal distance from the entrance pupil to that plane. 0 if telecentric.
    pub perspective_per_mm: f64,
    /// Pitch b of the sensor's pixels in millimetres.
    pub pixel_mm: f64,
    /// Where the optical axis meets the sensor, in pixels.
    pub axis_px: [f64; 2],
}

/// A microscope whose geometry is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Geometry {
    /// Objectives 1 and 2.
    pub relay: Relay,
    /// D in millimetres: distance from the grating to the intermediate image of the plane h = 0.
    pub grating_to_image_mm: f64,
    /// Wavelength λ in millimetres.
    pub wavelength_mm: f64,
    /// Grating in the path of the −1 view.
    pub minus: Grating,
    /// Grating in the path of the +1 view; the same as `minus` where one serves both.
    pub plus: Grating,
    /// Objective 3 and the camera.
    pub objective: Objective,
}

impl Geometry {
    /// Checks every number against its limits.
    ///
    /// # Errors
    /// The first that is not finite or not allowed.
    pub fn validate(&self) -> Result<(), MicroscopeError> {
        const ABOVE: &str = "a finite number above 0";
        let (r, o) = (&self.relay, &self.objective);
        check(
            "relay.magnification",
            r.magnification,
            r.magnification != 0.0,
            "a finite number other than 0",
        )?;
        check("relay.index", r.index, r.index >= 1.0, "a finite number, at least 1")?;
        check("relay.perspective_per_mm", r.perspective_per_mm, true, "a finite number")?;
        for (field, value) in [
            ("grating_to_image_mm", self.grating_to_image_mm),
            ("wavelength_mm", self.wavelength_mm),
            ("objective.magnification", o.magnification),
            ("objective.pixel_mm", o.pixel_mm),
        ] {
            check(field, value, value > 0.0, ABOVE)?;
        }
        check("objective.focus_mm", o.focus_mm, true, "a finite number")?;
        check(
            "objective.perspective_per_mm",
            o.perspective_per_mm,
            o.perspective_per_mm * o.focus_mm < 1.0,
            "such that the entrance pupil lies on the camera's side of the grating",
        )?;
        check("objective.axis_px[0]", o.axis_px[0], true, "a finite number")?;
        check("objective.axis_px[1]", o.axis_px[1], true, "a finite number")?;
        for g in [&self.minus, &self.plus] {
            check(
                "grating.pitch_mm",
                g.pitch_mm,
                g.pitch_mm > self.wavelength_mm,
                "a finite number above wavelength_mm, else the first order does not exist",
            )?;
            for tilt in g.tilt_rad_xyz {
                let fits = tilt.abs() < std::f64::consts::FRAC_PI_2;
                check("grating.tilt_rad_xyz", tilt, fits, "between −π/2 and π/2 (radians)")?;
            }
            let s = &g.substrate;
            let fits = s.thickness_mm >= 0.0
                && (s.side == SubstrateSide::Camera || s.thickness_mm < self.grating_to_image_mm);
            check(
                "grating.substrate.thickness_mm",
                s.thickness_mm,
                fits,
                "at least 0 and, on the object's side, below grating_to_image_mm",
            )?;
            check("grating.substrate.index", s.index, s.index >= 1.0, "a finite number, at least 1")?;
        }
        Ok(())
    }
}

/// [`Geometry`], validated and prepared.
#[derive(Clone, Debug)]
pub struct RayMicroscope {
    geometry: Geometry,
    axes: [Axes<f64>; 2],
}

/// A ray in the image space of the relay.
struct Line<T> {
    origin: [T; 3],
    direction: [T; 3],
}

impl RayMicroscope {
    /// Validates and prepares `geometry`.
    ///
    /// # Errors
    /// As [`Geometry::validate`].
    pub fn new(geometry: &Geometry) -> Result<Self, MicroscopeError> {
        geometry.validate()?;
        let axes = [&geometry.minus, &geometry.plus].map(|g| Axes::new(g.tilt_rad_xyz));
        Ok(Self { geometry: *geometry, axes })
    }

    /// The geometry it was made from.
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    fn grating(&self, view: View) -> &Grating {
        match view {
            View::Minus => &self.geometry.minus,
            View::Plus => &self.geometry.plus,
        }
    }

    /// Chief ray of the point `r` of the sharp plane, behind the grating.
    fn trace<T: Real>(&self, view: View, r: [T; 2]) -> Result<Line<T>, TraceError> {
        let k = T::constant;
        let o = &self.geometry.objective;
        let g = self.grating(view);
        let axes = self.axes[view.index()];
        let axes = Axes { across: axes.across.map(k), along: axes.along.map(k), normal: axes.normal.map(k) };
        let tilt = k(o.perspective_per_mm);
        let (a, b) = (r[0] * tilt, r[1] * tilt);
        let norm = (a * a + b * b + k(1.0)).sqrt();
        let direction = [a / norm, b / norm, k(1.0) / norm];
        let shrink = k(1.0 - o.perspective_per_mm * o.focus_mm);
        let at = [r[0] * shrink, r[1] * shrink, k(0.0)];
        let order = view.traced_order();
        let shift = k(order * self.geometry.wavelength_mm / g.pitch_mm);
        let cosines = axes
            .diffract(direction, shift)
            .map_err(|e| TraceError::Diffract { view, source: e.of_order(order) })?;
        let to_plane = -dot(at, axes.normal) / cosines.before[2];
        let mut origin = along(at, direction, to_plane);
        if g.substrate.thickness_mm > 0.0 {
            let glass = &g.substrate;
            origin = axes.past_plate(origin, &cosines, glass.side, k(glass.thickness_mm), k(glass.index));
        }
        Ok(Line { origin, direction: axes.to_world(cosines.after) })
    }

    /// Distance of a point of the image space behind the last surface of the view's grating.
    fn behind(&self, view: View, p: [f64; 3]) -> f64 {
        let g = self.grating(view);
        let distance = dot(p, self.axes[view.index()].normal);
        match g.substrate.side {
            SubstrateSide::Camera => distance,
            SubstrateSide::Object => distance - g.substrate.thickness_mm,
        }
    }

    /// Conjugate point of the sharp plane, mm.
    fn conjugate<T: Real>(&self, pixel: [T; 2]) -> [T; 2] {
        let o = &self.geometry.objective;
        let scale = T::constant(o.pixel_mm / o.magnification);
        [0, 1].map(|i| (pixel[i] - T::constant(o.axis_px[i])) * scale)
    }

    /// Specimen point (x, y, h) of a point of the image space.
    fn to_specimen<T: Real>(&self, p: [T; 3]) -> Result<[T; 3], TraceError> {
        let k = T::constant;
        let r = &self.geometry.relay;
        let image_height = k(self.geometry.grating_to_image_mm) - p[2];
        // h' = M_z h/(1 + κ h), solved for h; then 1 + κ h = M_z/(M_z − κ h').
        let axial = k(r.magnification * r.magnification / r.index);
        let rest = axial - k(r.perspective_per_mm) * image_height;
        if !(rest.value() > 0.0) {
            return Err(TraceError::NoIntersection);
        }
        let scale = axial / (rest * k(r.magnification));
        Ok([p[0] * scale, p[1] * scale, image_height / rest])
    }

    /// Point of the image space of a specimen point.
    fn to_image<T: Real>(&self, view: View, p: [T; 3]) -> Result<[T; 3], TraceError> {
        let k = T::constant;
        if !p.iter().all(|c| c.value().is_finite()) {
            return Err(TraceError::NotFinite);
        }
        let r = &self.geometry.relay;
        let shrink = k(1.0) + k(r.perspective_per_mm) * p[2];
        if !(shrink.value() > 0.0) {
            return Err(TraceError::NotSeen { view, point_mm: p.map(T::value) });
        }
        let lateral = k(r.magnification) / shrink;
        let axial = k(r.magnification * r.magnification / r.index) * p[2] / shrink;
        Ok([p[0] * lateral, p[1] * lateral, k(self.geometry.grating_to_image_mm) - axial])
    }

    /// Where the ray of `r` misses an image point, in the point's z plane.
    fn miss<T: Real>(&self, view: View, r: [T; 2], p: [T; 3]) -> Result<[T; 2], TraceError> {
        let line = self.trace(view, r)?;
        let t = (p[2] - line.origin[2]) / line.direction[2];
        let hit = along(line.origin, line.direction, t);
        Ok([hit[0] - p[0], hit[1] - p[1]])
    }

    fn project<T: Real>(&self, view: View, p: [T; 3]) -> Result<[T; 2], TraceError> {
        let not_seen = TraceError::NotSeen { view, point_mm: p.map(T::value) };
        let image = self.to_image(view, p)?;
        let at = image.map(T::value);
        let distance_mm = self.behind(view, at);
        if !(distance_mm > 0.0) {
            return Err(TraceError::BeforeGrating { distance_mm });
        }
        let o = &self.geometry.objective;
        let sin = self.geometry.wavelength_mm / self.grating(view).pitch_mm;
        let virtual_x = at[0] - view.traced_order() * at[2] * sin / (1.0 - sin * sin).sqrt();
        let mut r = [virtual_x, at[1]];
        let target = at.map(Dual::constant);
        for _ in 0..30 {
            let m = self.miss(view, [Dual::<2>::variable(r[0], 0), Dual::<2>::variable(r[1], 1)], target)?;
            let jacobian = m.map(|m| m.gradient);
            let step = solve2(jacobian, m.map(|m| m.value)).ok_or(not_seen)?;
            r = [r[0] - step[0], r[1] - step[1]];
            // quadratic convergence: after a step this small (mm) the error is below rounding
            if step[0].abs() + step[1].abs() < 1e-9 {
                // one more step in the caller's scalar carries its derivatives exactly
                let m = self.miss(view, r.map(T::constant), image)?;
                let step = solve2(jacobian, m).ok_or(not_seen)?;
                let scale = T::constant(o.magnification / o.pixel_mm);
                return Ok([0, 1].map(|i| (T::constant(r[i]) - step[i]) * scale + T::constant(o.axis_px[i])));
            }
        }
        Err(not_seen)
    }

    /// The six parameters of the linear model that this geometry has on the plane h = 0 near the axis,
    /// and the disparity there: derivatives of the exact projection, the mixed ones by central
    /// differences over ±1 µm (relative error about 1e-6).
    ///
    /// The centre is the axis where the image does not spread with height (β₃ = 0 or β₄ = 0).
    ///
    /// # Errors
    /// If the axis is not seen in both views.
    pub fn parameters(&self) -> Result<(Parameters, [f64; 2]), TraceError> {
        const STEP_MM: f64 = 1e-3;
        let seen = |x: f64, y: f64, h: f64| -> Result<_, TraceError> {
            let p = Vector3::new(x, y, h);
            let (a, ja) = self.project_point(View::Minus, p)?;
            let (b, jb) = self.project_point(View::Plus, p)?;
            Ok((a, b, (ja + jb) * 0.5, (ja - jb) * 0.5))
        };
        let (a, b, middle, half) = seen(0.0, 0.0, 0.0)?;
        let beta1 = 1.0 / half[(0, 2)];
        let beta2 = 1.0 / middle[(0, 0)];
        let spread = |axis: usize| -> Result<f64, TraceError> {
            let at = |s: f64| {
                let by = |i: usize| if i == axis { s } else { 0.0 };
                seen(by(0), by(1), 0.0)
            };
            let (_, _, before, _) = at(-STEP_MM)?;
            let (_, _, after, _) = at(STEP_MM)?;
            // ∂²m/∂X∂h · β₂ = β₃/β₂
            Ok((after[(axis, 2)] - before[(axis, 2)]) / (2.0 * STEP_MM) / middle[(axis, axis)])
        };
        let axis_px = [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])];
        let ratio = [spread(0)?, spread(1)?];
        // 1e-9/mm: what rounding leaves of a telecentric system
        let centre_px = [0, 1]
            .map(|i| if ratio[i].abs() > 1e-9 { axis_px[i] - middle[(i, 2)] / ratio[i] } else { axis_px[i] });
        let parameters = Parameters {
            beta1_mm_per_px: beta1,
            beta2_mm_per_px: beta2,
            beta3_per_px: ratio[0] * beta2,
            beta4_per_px: ratio[1] * beta2,
            centre_px,
        };
        Ok((parameters, [b[0] - a[0], b[1] - a[1]]))
    }
}

impl PairModel for RayMicroscope {
    fn decode_pair(&self, pair: PixelPair) -> Result<Decoded, TraceError> {
        let c = pair.coordinates();
        if !c.iter().all(|c| c.is_finite()) {
            return Err(TraceError::NotFinite);
        }
        let v = |i: usize| Dual::<4>::variable(c[i], i);
        let a = self.trace(View::Minus, self.conjugate([v(0), v(1)]))?;
        let b = self.trace(View::Plus, self.conjugate([v(2), v(3)]))?;
        let w = sub(a.origin, b.origin);
        let cos = dot(a.direction, b.direction);
        let (wa, wb) = (dot(w, a.direction), dot(w, b.direction));
        let sin2 = Dual::constant(1.0) - cos * cos;
        if sin2.value() < 1e-12 {
            return Err(TraceError::NoIntersection);
        }
        let on_a = along(a.origin, a.direction, (cos * wb - wa) / sin2);
        let on_b = along(b.origin, b.direction, (wb - cos * wa) / sin2);
        let half = Dual::constant(0.5);
        let middle = [0, 1, 2].map(|i| (on_a[i] + on_b[i]) * half);
        for view in View::BOTH {
            let distance_mm = self.behind(view, middle.map(Dual::value));
            if !(distance_mm > 0.0) {
                return Err(TraceError::BeforeGrating { distance_mm });
            }
        }
        let p = self.to_specimen(middle)?;
        // on the scale of the specimen, along its y
        let normal = cross(a.direction, b.direction);
        let magnification = Dual::constant(self.geometry.relay.magnification);
        let gap = dot(w, normal) / (dot(normal, normal).sqrt() * magnification);
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
        let [x, y] = self.project(view, std::array::from_fn(|i| Dual::<3>::variable(p[i], i)))?;
        let (gx, gy) = (x.gradient, y.gradient);
        Ok(([x.value, y.value], Matrix2x3::new(gx[0], gx[1], gx[2], gy[0], gy[1], gy[2])))
    }
}
