//! The formulas of the literature, and what the light does.

use nalgebra::Vector3;
use serde::Serialize;

use super::{Depth, PlanError, Request};
use crate::decode::{Decoder, PixelPair};
use crate::model::{OpticalModel, TraceError};
use crate::setup::{Optics, View};

/// The virtual-object model on the axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Paraxial {
    /// b' = (s + d/cos³θ)/F, mm/px.
    pub pixel_mm: f64,
    /// θ of the mean λ/p, degrees.
    pub angle_deg: f64,
    /// σ_h by (2.10), mm: σ_u b'/(2 tan θ) (1 + d/(s cos³θ)).
    pub sigma_h_mm: f64,
    /// −∂h/∂u at the reference plane, mm/px.
    pub height_per_px: f64,
    #[serde(skip)]
    cos3: f64,
    #[serde(skip)]
    sin: f64,
}

impl Paraxial {
    pub(super) fn new(o: &Optics, sigma_px: f64) -> Self {
        let sin = 0.5 * o.wavelength_mm * (1.0 / o.minus.pitch_mm + 1.0 / o.plus.pitch_mm);
        let cos = (1.0 - sin * sin).sqrt();
        let (s, d, cos3) = (o.pinhole_to_grating_mm, o.grating_to_reference_mm, cos * cos * cos);
        let pixel_mm = (s + d / cos3) / o.camera.focal_px;
        let height_per_px = pixel_mm * cos / (2.0 * sin) * (1.0 + d / (s * cos3));
        Self {
            pixel_mm,
            angle_deg: sin.asin().to_degrees(),
            sigma_h_mm: sigma_px * height_per_px,
            height_per_px,
            cos3,
            sin,
        }
    }

    /// Diameter of the blur circle of a point at height `h`, px: F A |1/Z − 1/Z₀|.
    pub(super) fn blur_px(&self, o: &Optics, pupil_mm: f64, h: f64) -> f64 {
        let (s, d) = (o.pinhole_to_grating_mm, o.grating_to_reference_mm);
        let z = |h: f64| s + (d - h) / self.cos3;
        o.camera.focal_px * pupil_mm * (1.0 / z(h) - 1.0 / z(0.0)).abs()
    }

    /// Heights whose blur circle is at most [`Depth::BLUR_PX`] wide: F A |1/Z − 1/Z₀| with
    /// Z = s + (d − h)/cos³θ.
    pub(super) fn sharp(&self, o: &Optics, pupil_mm: f64) -> [f64; 2] {
        let (s, d) = (o.pinhole_to_grating_mm, o.grating_to_reference_mm);
        let z0 = s + d / self.cos3;
        let change = Depth::BLUR_PX / (o.camera.focal_px * pupil_mm);
        let height = |reciprocal: f64| {
            if reciprocal > 0.0 { self.cos3 * (z0 - 1.0 / reciprocal) } else { f64::NEG_INFINITY }
        };
        [height(1.0 / z0 - change), height(1.0 / z0 + change).min(d)]
    }
}

/// (2.9), corrected, at one height. With b' = (s + d/c³)/F and u_rel = u − u(h = 0):
/// (ε_h/h)² = (ε_u/u_rel)² + [4 (ε_d/d)² + (s c³/d − 1)² (ε_s/s)²]/(1 + s c³/d)², apart from a constant
/// offset of all heights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BudgetRow {
    /// h.
    pub height_mm: f64,
    /// Error of h from the disparity.
    pub from_disparity_mm: f64,
    /// From the error of d.
    pub from_d_mm: f64,
    /// From the error of s.
    pub from_s_mm: f64,
    /// Root of the sum of squares.
    pub total_mm: f64,
}

pub(super) fn rows(o: &Optics, r: &Request, p: &Paraxial) -> Vec<BudgetRow> {
    let (s, d) = (o.pinhole_to_grating_mm, o.grating_to_reference_mm);
    let ratio = s * p.cos3 / d;
    let [error_d, error_s] = r.distance_errors_mm;
    let largest = r.heights_mm[0].abs().max(r.heights_mm[1].abs());
    [0.25, 0.5, 1.0]
        .map(|part| {
            let height_mm = largest * part;
            let from_disparity_mm = p.sigma_h_mm;
            let from_d_mm = height_mm * 2.0 * error_d / d / (1.0 + ratio);
            let from_s_mm = height_mm * (ratio - 1.0).abs() * error_s / s / (1.0 + ratio);
            BudgetRow {
                height_mm,
                from_disparity_mm,
                from_d_mm,
                from_s_mm,
                total_mm: from_disparity_mm.hypot(from_d_mm).hypot(from_s_mm),
            }
        })
        .to_vec()
}

/// What bandwidth and drift of the light do on the axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Light {
    /// Smear of each view by the bandwidth, in opposite senses, px; exact rays.
    pub smear_px: f64,
    /// The same by d Δλ/(p cos³θ)/b'.
    pub smear_paraxial_px: f64,
    /// Change of all heights if the wavelength drifts as asked and the decoder does not know, mm;
    /// exact rays.
    pub drift_h_mm: f64,
    /// The same by d δλ/(λ cos²θ) (1 + d/(s cos³θ)).
    pub drift_h_paraxial_mm: f64,
    /// The drift that this is for, mm.
    pub drift_mm: f64,
    /// Constant offset of the heights from the error of d, mm.
    pub offset_d_mm: f64,
    /// Constant offset of the heights from the error of s, mm.
    pub offset_s_mm: f64,
}

impl Light {
    pub(super) fn new(o: &Optics, r: &Request, p: &Paraxial) -> Result<Self, PlanError> {
        let model = OpticalModel::new(o)?;
        let changed = |change: &dyn Fn(&mut Optics)| -> Result<OpticalModel, PlanError> {
            let mut o = *o;
            change(&mut o);
            Ok(OpticalModel::new(&o)?)
        };
        let see = |m: &OpticalModel| -> Result<PixelPair, TraceError> {
            let at = |v| m.project(v, Vector3::zeros());
            Ok(PixelPair { minus_px: at(View::Minus)?, plus_px: at(View::Plus)? })
        };
        // the derivative over a tenth of a nanometre, so that any bandwidth can be asked for
        const STEP_MM: f64 = 1e-7;
        let redder = changed(&|o| o.wavelength_mm += 0.5 * STEP_MM)?;
        let bluer = changed(&|o| o.wavelength_mm -= 0.5 * STEP_MM)?;
        let (a, b) = (see(&redder)?.minus_px, see(&bluer)?.minus_px);
        let per_mm = (a[0] - b[0]).hypot(a[1] - b[1]) / STEP_MM;
        let height = |true_model: &OpticalModel| -> Result<f64, PlanError> {
            Ok(model.decode_point(Decoder::Ray, see(true_model)?)?.z)
        };
        let drift = (height(&redder)? - height(&bluer)?) / STEP_MM * r.drift_mm;
        let d = o.grating_to_reference_mm;
        let [error_d, error_s] = r.distance_errors_mm;
        // what a set-up that is longer by a tenth of the error shows, decoded with the values believed
        let offset = |error: f64, change: &dyn Fn(&mut Optics, f64)| -> Result<f64, PlanError> {
            Ok(-10.0 * height(&changed(&|o| change(o, 0.1 * error))?)?)
        };
        Ok(Self {
            smear_px: per_mm * r.bandwidth_mm,
            smear_paraxial_px: o.grating_to_reference_mm * r.bandwidth_mm * p.sin
                / o.wavelength_mm
                / (p.cos3 * p.pixel_mm),
            drift_h_mm: drift.abs(),
            drift_h_paraxial_mm: d * r.drift_mm / (o.wavelength_mm * (1.0 - p.sin * p.sin))
                * (1.0 + d / (o.pinhole_to_grating_mm * p.cos3)),
            drift_mm: r.drift_mm,
            offset_d_mm: offset(error_d, &|o, e| o.grating_to_reference_mm += e)?,
            offset_s_mm: offset(error_s, &|o, e| o.pinhole_to_grating_mm += e)?,
        })
    }
}
