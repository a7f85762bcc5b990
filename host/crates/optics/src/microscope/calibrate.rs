//! β and the centre from known motions, by weighted least squares in image space.
//!
//! The residuals are the four image displacements (u₋, v₋, u₊, v₊) of every point of every motion
//! against the forward model (3.1)–(3.2), divided by their standard deviations. Fitting decoded to
//! imposed displacements instead, as the literature does, is degenerate: a pure z move is fitted
//! perfectly by β₂ = β₃ = β₄ = 0.
//!
//! # What motions determine
//!
//! * A z move fixes β₁, the centre, and of the others the ratios β₃/β₂ and β₄/β₂ alone.
//! * An in-plane move fixes β₂.
//! * A tilt by a known angle fixes β₁/β₂ by the change of w across the field, and how the spread
//!   changes with it; where its axis lies may be left open ([`Motion::translation_mm`]).
//!
//! What a set of motions leaves open is found from the information matrix itself, and named with the
//! motions that would close it ([`Calibration::undetermined`], [`Calibration::add`]).
//!
//! # Outliers
//!
//! As in [`calibrate`](mod@crate::calibrate): a first fit uses Huber's loss; then points beyond
//! [`Settings::outlier_limit`] are left out until the selection stays the same.

mod fit;

use nalgebra::{Matrix3, SMatrix, Vector3};
use serde::{Deserialize, Serialize};

use super::determined::{Candidate, Quantity};
use super::linear::{Form, Microscope, MicroscopeError, Parameters};
use crate::decode::PixelPair;
use crate::model::TraceError;
use crate::pair_model::PairModel;

/// Image displacements of one material point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldPoint {
    /// Midpoint of its −1 and +1 pixels before the motion.
    pub middle_px: [f64; 2],
    /// Its height (mm) before the motion over the plane that the parameters are meant for.
    pub height_mm: f64,
    /// (u₋, v₋, u₊, v₊), the +1 pair taken at the +1 match of the −1 point.
    pub moved_px: [f64; 4],
    /// Their standard deviations, taken as independent.
    pub sigma_px: [f64; 4],
}

/// A known rigid motion and what the images show of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    /// Its name in messages.
    pub name: String,
    /// Displacement (x, y, h) of the pivot in mm; a component that is not known is estimated.
    pub translation_mm: [Option<f64>; 3],
    /// Rotation by these angles about x, y and h, applied in this order, R = Rh·Ry·Rx, exact. With
    /// (x, y, h) right, down and towards the camera: about y, h' = −x sin + h cos (the right side
    /// falls); about x, h' = y sin + h cos (the lower side rises); about h, x turns towards y.
    pub rotation_rad: [f64; 3],
    /// Point about which it turns: midpoint pixels. Of no consequence without a rotation; with one
    /// and an unknown translation, where that translation is stated.
    pub pivot_px: [f64; 2],
    /// Height of that point, mm.
    pub pivot_height_mm: f64,
    /// The field.
    pub points: Vec<FieldPoint>,
    /// Whether it takes part in the fit; if not, it is predicted.
    pub fit: bool,
}

impl Motion {
    /// A known translation (x, y, h) mm that takes part in the fit.
    pub fn translation(name: &str, by_mm: [f64; 3], points: Vec<FieldPoint>) -> Self {
        Self {
            name: name.to_owned(),
            translation_mm: by_mm.map(Some),
            rotation_rad: [0.0; 3],
            pivot_px: [0.0; 2],
            pivot_height_mm: 0.0,
            points,
            fit: true,
        }
    }

    /// A known rotation about a point that is not known, which takes part in the fit.
    pub fn tilt(name: &str, rotation_rad: [f64; 3], points: Vec<FieldPoint>) -> Self {
        Self { translation_mm: [None; 3], rotation_rad, ..Self::translation(name, [0.0; 3], points) }
    }

    /// R = Rh·Ry·Rx.
    pub fn rotation(&self) -> Matrix3<f64> {
        rotation(self.rotation_rad)
    }
}

fn rotation([x, y, z]: [f64; 3]) -> Matrix3<f64> {
    let a = crate::grating::Axes::<f64>::new([x, y, z]);
    Matrix3::from_columns(&[a.across.into(), a.along.into(), a.normal.into()])
}

/// What to fit and when to be content.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Settings {
    /// Form of the model.
    pub form: Form,
    /// Size of a pixel on the specimen (mm) to start from; only matters where no translation is known.
    pub start_pixel_mm: f64,
    /// Largest residual in (robust) standard deviations before a point is left out.
    pub outlier_limit: f64,
    /// Largest fraction of points that may be left out.
    pub max_outlier_fraction: f64,
    /// Largest σ of β₁ and β₂ relative to the value before they count as undetermined.
    pub max_relative_sigma: f64,
    /// How many neighbouring points share one independent measurement (overlapping subsets), ≥ 1: the
    /// covariance is so many times larger.
    pub shared: f64,
    /// Most linearisations in one fit.
    pub max_iterations: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            form: Form::Linear,
            start_pixel_mm: 1e-3,
            outlier_limit: 5.0,
            max_outlier_fraction: 0.2,
            max_relative_sigma: 0.05,
            shared: 1.0,
            max_iterations: 100,
        }
    }
}

/// A quantity that the motions determine.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Which one.
    pub quantity: Quantity,
    /// Its value, in [`Quantity::unit`].
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// How one motion comes out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MotionResult {
    /// Its name.
    pub name: String,
    /// Whether it took part in the fit.
    pub fitted: bool,
    /// Points that count.
    pub points: usize,
    /// RMS of the image residuals (u₋, v₋, u₊, v₊), px.
    pub rms_px: [f64; 4],
    /// RMS of decoded minus imposed displacement (u, v, w), mm; NaN while β are undetermined.
    pub rms_mm: [f64; 3],
    /// Mean of the same, mm; 0 in the components whose translation is not known.
    pub mean_mm: [f64; 3],
    /// Translation of the pivot: as given, or as found.
    pub translation_mm: [f64; 3],
}

/// Result of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Form that was fitted.
    pub form: Form,
    /// The six parameters, if the motions determine all of them.
    pub parameters: Option<Parameters>,
    /// Their covariance, in the order of [`Parameters::to_array`]: from the σ of the points, times the
    /// reduced χ² where that exceeds 1, times [`Settings::shared`].
    pub covariance: Option<SMatrix<f64, 6, 6>>,
    /// What is determined: parameters, and ratios of those that are not.
    pub estimates: Vec<Estimate>,
    /// Parameters that the motions leave open.
    pub undetermined: Vec<Quantity>,
    /// Motions that would determine them.
    pub add: Vec<Candidate>,
    /// Along x, y: the spread of the image with height is within three σ of none (telecentric), so
    /// that the centre has no effect and its σ no meaning.
    pub telecentric: [bool; 2],
    /// RMS of all fitted residuals, px.
    pub rms_px: f64,
    /// χ² over degrees of freedom.
    pub chi_square_reduced: f64,
    /// Residuals minus unknowns.
    pub degrees_of_freedom: usize,
    /// Points left out as outliers: (motion, point).
    pub rejected: Vec<(usize, usize)>,
    /// Linearisations of all fits together.
    pub iterations: usize,
    /// Every motion, fitted or predicted, in the order given.
    pub motions: Vec<MotionResult>,
}

impl Calibration {
    /// The estimate of a quantity, if it is determined.
    pub fn estimate(&self, quantity: Quantity) -> Option<&Estimate> {
        self.estimates.iter().find(|e| e.quantity == quantity)
    }
}

/// Why no calibration came out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// No motion takes part in the fit.
    #[error("no motion takes part in the fit: give at least a z move and an in-plane move")]
    NoMotion,
    /// A setting is out of its limits.
    #[error("setting {name} is {value}, it must be {allowed}")]
    Setting {
        /// Which one.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A number of a motion is not finite, or σ is not above 0.
    #[error("motion {motion}: {what} is {value}, it must be {allowed}")]
    Value {
        /// Name of the motion.
        motion: String,
        /// What.
        what: String,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A motion with too few points.
    #[error("motion {motion} has {found} points, at least {needed} are needed")]
    Points {
        /// Name of the motion.
        motion: String,
        /// Points found.
        found: usize,
        /// Points needed.
        needed: usize,
    },
    /// β₁ came out negative.
    #[error(
        "beta1 would be {beta1_mm_per_px:.3e} mm/px, below 0: the −1 and +1 views are swapped, or the sign of a z move or tilt is wrong"
    )]
    Swapped {
        /// The value found.
        beta1_mm_per_px: f64,
    },
    /// Too many points disagree.
    #[error(
        "{rejected} of {points} points disagree with the model, at most {limit} may: wrong motions, swapped views or bad correlation"
    )]
    TooManyOutliers {
        /// Left out.
        rejected: usize,
        /// All.
        points: usize,
        /// Largest number allowed.
        limit: usize,
    },
    /// The iteration did not come to rest.
    #[error(
        "no convergence in {iterations} iterations: the motions do not belong to these fields, or the start is too far off"
    )]
    NotConverged {
        /// Iterations made.
        iterations: usize,
    },
    /// The result is no possible microscope.
    #[error("the fitted values: {0}")]
    Parameters(#[from] MicroscopeError),
    /// A point that the fitted model cannot decode.
    #[error("motion {motion}: {source}")]
    Decode {
        /// Name of the motion.
        motion: String,
        /// Why.
        source: TraceError,
    },
}

/// Fewest points of a motion.
const LEAST_POINTS: usize = 3;

fn check(motions: &[Motion], s: &Settings) -> Result<(), CalibrateError> {
    let positive = [
        ("start_pixel_mm", s.start_pixel_mm),
        ("outlier_limit", s.outlier_limit),
        ("max_relative_sigma", s.max_relative_sigma),
    ];
    for (name, value) in positive {
        if !(value > 0.0 && value.is_finite()) {
            return Err(CalibrateError::Setting { name, value, allowed: "a finite number above 0" });
        }
    }
    if !(0.0..1.0).contains(&s.max_outlier_fraction) {
        let value = s.max_outlier_fraction;
        return Err(CalibrateError::Setting {
            name: "max_outlier_fraction",
            value,
            allowed: "at least 0 and below 1",
        });
    }
    if !(s.shared >= 1.0 && s.shared.is_finite()) {
        let (name, value) = ("shared", s.shared);
        return Err(CalibrateError::Setting { name, value, allowed: "a finite number, at least 1" });
    }
    if !motions.iter().any(|m| m.fit) {
        return Err(CalibrateError::NoMotion);
    }
    for m in motions {
        let value = |what: String, value: f64, allowed| CalibrateError::Value {
            motion: m.name.clone(),
            what,
            value,
            allowed,
        };
        let numbers = m
            .translation_mm
            .iter()
            .flatten()
            .chain(&m.rotation_rad)
            .chain(&m.pivot_px)
            .chain([&m.pivot_height_mm]);
        if let Some(bad) = numbers.copied().find(|v| !v.is_finite()) {
            return Err(value("the motion".to_owned(), bad, "finite"));
        }
        if m.points.len() < LEAST_POINTS {
            let (motion, found) = (m.name.clone(), m.points.len());
            return Err(CalibrateError::Points { motion, found, needed: LEAST_POINTS });
        }
        for (i, p) in m.points.iter().enumerate() {
            let mut numbers = p.middle_px.iter().chain(&p.moved_px).chain([&p.height_mm]);
            if let Some(bad) = numbers.find(|v| !v.is_finite()) {
                return Err(value(format!("a number of point {i}"), *bad, "finite"));
            }
            if let Some(bad) = p.sigma_px.iter().find(|s| !(s.is_finite() && **s > 0.0)) {
                return Err(value(format!("σ of point {i}"), *bad, "a finite number above 0"));
            }
        }
    }
    Ok(())
}

/// Estimates the six parameters from known motions. The result depends on nothing but the input.
///
/// # Errors
/// See [`CalibrateError`]. That the motions leave parameters open is no error: it is in the result.
pub fn calibrate(motions: &[Motion], settings: &Settings) -> Result<Calibration, CalibrateError> {
    check(motions, settings)?;
    fit::Problem::new(motions, settings).solve()
}

/// Every fitted motion predicted from the others: each calibration leaves one out. An entry per
/// motion, none for those that take no part or without which parameters stay open or nothing converges.
pub fn leave_one_out(motions: &[Motion], settings: &Settings) -> Vec<Option<MotionResult>> {
    let mut left = motions.to_vec();
    let mut results = Vec::with_capacity(motions.len());
    for k in 0..motions.len() {
        let others = motions.iter().enumerate().any(|(i, m)| m.fit && i != k);
        if !motions[k].fit || !others {
            results.push(None);
            continue;
        }
        left[k].fit = false;
        // the others may not do by themselves: that is no fault of the calibration
        let found = calibrate(&left, settings).ok();
        left[k].fit = true;
        results.push(found.and_then(|f| f.parameters.and(f.motions.into_iter().nth(k))));
    }
    results
}

/// Image residuals (u₋, v₋, u₊, v₊), observed minus model, in pixels, of every point of a motion with
/// the fitted `parameters`; `translation_mm` as in [`MotionResult::translation_mm`]. NaN for a point
/// that the model cannot follow.
///
/// # Errors
/// If the parameters are impossible.
pub fn residuals_px(
    motion: &Motion,
    parameters: &Parameters,
    form: Form,
    translation_mm: [f64; 3],
) -> Result<Vec<[f64; 4]>, CalibrateError> {
    Microscope::new(*parameters, form, [0.0; 2])?;
    let residual = |p: &FieldPoint| {
        let at = PixelPair { minus_px: p.middle_px, plus_px: p.middle_px };
        let by = turned(motion, parameters, p.middle_px, p.height_mm) + Vector3::from(translation_mm);
        let told = model_at(parameters, form, p.height_mm)?.forward(at, by).ok()?;
        Some(std::array::from_fn(|c| p.moved_px[c] - told[c]))
    };
    Ok(motion.points.iter().map(|p| residual(p).unwrap_or([f64::NAN; 4])).collect())
}

/// The model in which a pair without disparity has this height.
fn model_at(parameters: &Parameters, form: Form, height_mm: f64) -> Option<Microscope> {
    let free = Microscope::new(*parameters, form, [0.0; 2]).ok()?;
    let high = free.see(Vector3::new(0.0, 0.0, height_mm)).ok()?;
    let disparity = [high.minus_px[0] - high.plus_px[0], 0.0];
    Microscope::new(*parameters, form, disparity).ok()
}

/// Imposed displacement (mm) of a point without the motion's translation: (R − 1)(P − pivot).
fn turned(motion: &Motion, parameters: &Parameters, middle_px: [f64; 2], height_mm: f64) -> Vector3<f64> {
    let p = parameters;
    let place = |m: [f64; 2], h: f64| {
        let [xc, yc] = p.centre_px;
        Vector3::new(
            (p.beta2_mm_per_px - p.beta3_per_px * h) * (m[0] - xc),
            (p.beta2_mm_per_px - p.beta4_per_px * h) * (m[1] - yc),
            h,
        )
    };
    let arm = place(middle_px, height_mm) - place(motion.pivot_px, motion.pivot_height_mm);
    (motion.rotation() - Matrix3::identity()) * arm
}

/// Decoded minus imposed displacement (mm) of the points of a motion that `counts` names, with the
/// translation as stated; where it is not known, the mean is taken off and is that translation.
fn decoded_errors(
    motion: &Motion,
    parameters: &Parameters,
    form: Form,
    counts: impl Fn(usize) -> bool,
) -> Result<(Vec<Vector3<f64>>, [f64; 3]), CalibrateError> {
    Microscope::new(*parameters, form, [0.0; 2])?;
    let mut errors = Vec::new();
    for (_, p) in motion.points.iter().enumerate().filter(|(i, _)| counts(*i)) {
        let decode = |source| CalibrateError::Decode { motion: motion.name.clone(), source };
        let at = PixelPair { minus_px: p.middle_px, plus_px: p.middle_px };
        let model = model_at(parameters, form, p.height_mm).ok_or(decode(TraceError::NoIntersection))?;
        let [u0, v0, u1, v1] = p.moved_px;
        let moved = PixelPair {
            minus_px: [p.middle_px[0] + u0, p.middle_px[1] + v0],
            plus_px: [p.middle_px[0] + u1, p.middle_px[1] + v1],
        };
        let none = nalgebra::Matrix4::zeros();
        let found = model.track(at, moved, &none, &none).map_err(decode)?;
        errors.push(found.displacement_mm - turned(motion, parameters, p.middle_px, p.height_mm));
    }
    let n = errors.len().max(1) as f64;
    let mean = errors.iter().sum::<Vector3<f64>>() / n;
    let translation = std::array::from_fn(|c| motion.translation_mm[c].unwrap_or(mean[c]));
    for e in &mut errors {
        *e -= Vector3::from(translation);
    }
    Ok((errors, translation))
}
