//! Calibration of a rig by bundle adjustment: camera, gratings and distances from views of a flat
//! plate in several poses.
//!
//! The plate carries dots of known coordinates, or speckle whose points are tracked from pose to
//! pose, or both. It is seen through the gratings in both first orders, at several heights or
//! tilts, known or not. Unknowns are the parameters asked for, the plate's pose in each view
//! but the reference, and the plate coordinates of points where they are not known; the latter are
//! eliminated from the normal equations point by point (Schur complement), the rest is solved by
//! Levenberg and Marquardt's method. Residuals are pixel coordinates against the exact forward
//! model divided by their standard deviations; priors are further residuals.
//!
//! # Frame and scale
//!
//! The plate in the reference pose *is* the object frame of the result: its plane is h = 0, and
//! where plate coordinates are known they are x and y ([`crate::ReferenceFrame`]). Heights
//! therefore do not depend on the optical axis, which a long lens leaves uncertain. With speckle
//! alone the origin is where the axis meets the plate.
//!
//! Lengths come from the plate's coordinates, or from known moves. Where both are given they are
//! compared ([`RigError::PitchConflict`]).
//!
//! # What data cannot fix
//!
//! A narrow field hardly separates F from s, the principal point from tilts of the gratings, or
//! the substrate's thickness from s. Such combinations change points little; priors hold them.
//! [`RigCalibration::weak`] names them: eigenvectors of the data's normal matrix in units of
//! the priors' standard deviations, of which the data know less than the priors do.

mod check;
mod error;
mod finish;
mod geometry;
mod normal;
mod problem;
mod solve;
mod start;

use nalgebra::{Rotation3, Vector3};
use serde::{Deserialize, Serialize};

pub use error::RigError;

use crate::maps::DistortionMaps;
use crate::parameter::{GratingParameter, Parameter, ParameterCovariance};
use crate::setup::{Optics, View};

/// A pixel at which a point is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// The pixel.
    pub px: [f64; 2],
    /// Standard deviations of x and y in pixels, taken as independent.
    pub sigma_px: [f64; 2],
}

/// One point of the plate in one pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Its number in [`RigData::plate_mm`].
    pub point: usize,
    /// Where the −1 view sees it, if it does.
    pub minus: Option<Seen>,
    /// Where the +1 view sees it, if it does.
    pub plus: Option<Seen>,
}

impl Sighting {
    /// Where `view` sees it.
    pub fn view(&self, view: View) -> Option<&Seen> {
        match view {
            View::Minus => self.minus.as_ref(),
            View::Plus => self.plus.as_ref(),
        }
    }
}

/// A known value and its standard deviation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Known {
    /// The value.
    pub value: f64,
    /// Standard deviation, above 0.
    pub sigma: f64,
}

/// What is known of a pose against the reference pose; nothing by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct KnownPose {
    /// Displacement of the plate's origin along the stage's axes (x, y, h), mm.
    pub translation_mm: [Option<Known>; 3],
    /// Rotation about x, y and h as in [`Pose`], radians.
    pub rotation_rad: [Option<Known>; 3],
}

impl KnownPose {
    /// A stage that moved without turning.
    pub fn moved(translation_mm: [f64; 3], sigma_mm: f64, sigma_rad: f64) -> Self {
        Self {
            translation_mm: translation_mm.map(|value| Some(Known { value, sigma: sigma_mm })),
            rotation_rad: [Some(Known { value: 0.0, sigma: sigma_rad }); 3],
        }
    }
}

/// The plate in one pose.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlatePose {
    /// Points found.
    pub sightings: Vec<Sighting>,
    /// What is known of the pose.
    pub known: KnownPose,
}

/// All that was measured.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RigData {
    /// Coordinates (x, y) on the plate in mm of every point, where known: x to the right and y
    /// down on the sensor.
    pub plate_mm: Vec<Option<[f64; 2]>>,
    /// The poses.
    pub poses: Vec<PlatePose>,
}

/// A parameter to estimate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimated {
    /// Which one.
    pub parameter: Parameter,
    /// Standard deviation of its starting value, if that is to count as a measurement.
    pub prior_sigma: Option<f64>,
}

/// What to estimate and when to be content.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RigSettings {
    /// Parameters to estimate, beside those of the reference plane, which always are; all others
    /// keep their starting values.
    pub parameters: Vec<Estimated>,
    /// The pose that becomes the reference plane.
    pub reference_pose: usize,
    /// Standard deviation (rad) of the directions of the stage's axes about each axis of the
    /// object frame; used where translations are known.
    pub stage_axes_sigma_rad: f64,
    /// Largest residual in (robust) standard deviations before a pixel is left out.
    pub outlier_limit: f64,
    /// Largest fraction of pixels that may be left out.
    pub max_outlier_fraction: f64,
    /// Most linearisations in one fit.
    pub max_iterations: usize,
    /// Whether to leave out one pose after the other and predict it.
    pub leave_one_out: bool,
}

impl RigSettings {
    /// The usual set for `start`, with priors that a ruler and the makers' data give: F and s to
    /// 2 %, the principal point to 50 px, groove pitches to 0.1 %, tilts to 0.1 rad, the relative
    /// distance of the gratings to 5 mm, substrates to 0.1 mm and 0.005 of index, k1 to 1.
    pub fn usual(start: &Optics) -> Self {
        use GratingParameter as G;
        let with = |parameter, sigma: f64| Estimated { parameter, prior_sigma: Some(sigma) };
        let mut parameters = vec![
            with(Parameter::FocalPx, 0.02 * start.camera.focal_px),
            with(Parameter::PrincipalPointX, 50.0),
            with(Parameter::PrincipalPointY, 50.0),
            with(Parameter::BrownK1, 1.0),
            with(Parameter::PinholeToGrating, 0.02 * start.pinhole_to_grating_mm),
        ];
        for view in View::BOTH {
            let g = start.grating(view);
            let own = |p| Parameter::Grating(view, p);
            parameters.push(with(own(G::Pitch), 1e-3 * g.pitch_mm));
            parameters.extend([G::TiltX, G::TiltY, G::TiltZ].map(|p| with(own(p), 0.1)));
            if g.substrate.thickness_mm > 0.0 {
                parameters.push(with(own(G::Thickness), 0.1));
                parameters.push(with(own(G::Index), 0.005));
            }
        }
        parameters.push(with(Parameter::Grating(View::Plus, G::Offset), 5.0));
        Self {
            parameters,
            reference_pose: 0,
            stage_axes_sigma_rad: 0.02,
            outlier_limit: 5.0,
            max_outlier_fraction: 0.2,
            max_iterations: 60,
            leave_one_out: true,
        }
    }
}

/// Pose of the plate in object coordinates: the point (x, y) of the plate is at
/// R·(x, y, 0) + t in (x, y, h) with R = Rz·Ry·Rx acting on these three numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// Angles about x, y and h, radians.
    pub rotation_rad: [f64; 3],
    /// t in mm.
    pub translation_mm: [f64; 3],
}

impl Pose {
    /// Object coordinates (x, y, h) of a point of the plate.
    pub fn point_mm(&self, plate_mm: [f64; 2]) -> Vector3<f64> {
        self.rotation() * Vector3::new(plate_mm[0], plate_mm[1], 0.0) + Vector3::from(self.translation_mm)
    }

    pub(crate) fn rotation(&self) -> Rotation3<f64> {
        let [a, b, c] = self.rotation_rad;
        Rotation3::from_euler_angles(a, b, c)
    }
}

/// An estimated parameter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RigEstimate {
    /// Which one.
    pub parameter: Parameter,
    /// Value it started from.
    pub start: f64,
    /// Standard deviation of the starting value, where it counted as a measurement.
    pub prior_sigma: Option<f64>,
    /// Estimate, in the unit of its field.
    pub value: f64,
    /// Its standard deviation, from data and prior.
    pub sigma: f64,
}

impl RigEstimate {
    /// How many of the prior's standard deviations the estimate lies from the start.
    pub fn pull(&self) -> Option<f64> {
        self.prior_sigma.map(|s| (self.value - self.start) / s)
    }
}

/// Share of a parameter in a combination.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Component {
    /// Which one.
    pub parameter: Parameter,
    /// Its share in units of the prior's (or a usual) standard deviation; squares sum to 1.
    pub weight: f64,
}

/// A combination of parameters of which the data know less than the priors.
#[derive(Clone, Debug, PartialEq)]
pub struct WeakCombination {
    /// Shares above 0.1, largest first.
    pub components: Vec<Component>,
    /// Standard deviation that the data alone would leave, in units of the prior's; above 1.
    pub data_sigma: f64,
}

/// Residuals of one pose in one view, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewResiduals {
    /// The pose.
    pub pose: usize,
    /// The view.
    pub view: View,
    /// Points used.
    pub points: usize,
    /// RMS of x and y.
    pub rms_px: [f64; 2],
    /// Mean of x and y.
    pub mean_px: [f64; 2],
}

/// A pose predicted by the calibration made without it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LeftOut {
    /// The pose.
    pub pose: usize,
    /// Points decoded.
    pub points: usize,
    /// RMS of (x, y, h) of its decoded points against the plate laid upon them as best possible
    /// without change of scale, mm.
    pub rms_mm: [f64; 3],
    /// What the pixels' noise alone makes of it, mm.
    pub expected_mm: [f64; 3],
}

/// Part of the object space that the plates filled.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Volume {
    /// Least x, y and h, mm.
    pub from_mm: [f64; 3],
    /// Largest x, y and h, mm.
    pub to_mm: [f64; 3],
}

impl Volume {
    /// Whether a point lies inside, or not more than `margin_mm` outside.
    pub fn contains(&self, point_mm: Vector3<f64>, margin_mm: f64) -> bool {
        (0..3).all(|i| point_mm[i] >= self.from_mm[i] - margin_mm && point_mm[i] <= self.to_mm[i] + margin_mm)
    }
}

/// Result of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct RigCalibration {
    /// The set-up with the estimates and the reference plane put in.
    pub optics: Optics,
    /// The estimates: those asked for, then the reference plane's.
    pub estimates: Vec<RigEstimate>,
    /// Their covariance, in the same order. Follows from the standard deviations given; multiplied
    /// by the reduced χ² where that exceeds 1, because those were then too small.
    pub covariance: ParameterCovariance,
    /// What the data cannot fix, weakest first.
    pub weak: Vec<WeakCombination>,
    /// The plate's pose in each view; the reference is all zero.
    pub poses: Vec<Pose>,
    /// Plate coordinates, given or found; none for points never used.
    pub plate_mm: Vec<Option<[f64; 2]>>,
    /// Angles of the stage's axes against the object frame, where moves were known.
    pub stage_axes_rad: Option<[f64; 3]>,
    /// Size of the plate found from the moves against the size stated, and its standard
    /// deviation, where both were known.
    pub plate_scale: Option<Known>,
    /// Residuals for each pose and view.
    pub residuals: Vec<ViewResiduals>,
    /// RMS of all residuals used, pixels.
    pub rms_px: f64,
    /// χ² divided by the degrees of freedom; about 1 if the model and the standard deviations
    /// describe the data.
    pub chi_square_reduced: f64,
    /// Residuals and priors used minus unknowns.
    pub degrees_of_freedom: usize,
    /// Pixels left out, as (pose, point, view).
    pub rejected: Vec<(usize, usize, View)>,
    /// Poses predicted without themselves; empty where not asked for or fewer than four.
    pub left_out: Vec<LeftOut>,
    /// Where the plates were.
    pub volume: Volume,
    /// Linearisations used by the fit (without those of the leave-one-out check).
    pub iterations: usize,
}

impl RigCalibration {
    /// The estimate of a parameter, if it was estimated.
    pub fn estimate(&self, parameter: Parameter) -> Option<&RigEstimate> {
        self.estimates.iter().find(|e| e.parameter == parameter)
    }

    /// Correlation of two estimated parameters.
    pub fn correlation(&self, a: Parameter, b: Parameter) -> Option<f64> {
        let place = |p| self.covariance.parameters().iter().position(|q| *q == p);
        let (i, j) = (place(a)?, place(b)?);
        let m = self.covariance.matrix();
        Some(m[(i, j)] / (m[(i, i)] * m[(j, j)]).sqrt())
    }
}

/// Calibrates a rig.
///
/// `start` needs to be right to a few percent and degrees; `maps` are distortion maps measured
/// before, which are kept. The result does not depend on the machine.
///
/// # Errors
/// See [`RigError`].
pub fn calibrate_rig(
    start: &Optics,
    maps: &DistortionMaps,
    data: &RigData,
    settings: &RigSettings,
) -> Result<RigCalibration, RigError> {
    start.validate()?;
    check::settings(settings)?;
    check::data(data, settings)?;
    let (state, optics) = start::find(start, maps, data, settings)?;
    solve::calibrate(&optics, state, maps, data, settings)
}
