//! Calibration of a camera from several views of a plane board.
//!
//! The start follows Zhang (IEEE Trans. PAMI 22, 2000, 1330): a homography for each view, F from
//! the conditions that the board's axes are perpendicular and of equal scale, the principal point
//! at the centre of the image. Then all poses and the free parameters of the camera are adjusted
//! together (Levenberg–Marquardt with analytic derivatives; the poses are eliminated from the normal
//! equations). Residuals are pixel coordinates divided by their standard deviations; points far
//! from the model are left out and listed.
//!
//! F and principal point come from boards *tilted* in different directions: views in parallel
//! planes do not fix them ([`CameraError::ParallelViews`]). The board's pitch scales the poses alone:
//! a wrong pitch does not show in the residuals and does no harm to the camera's parameters.

mod solve;
mod start;

use nalgebra::{DMatrix, Matrix6, Rotation3, Vector3};
use serde::{Deserialize, Serialize};

use crate::camera::Camera;

/// A point of the board seen in a view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoardPoint {
    /// Where it is on the board, millimetres.
    pub board_mm: [f64; 2],
    /// Where it is in the image, pixels.
    pub pixel_px: [f64; 2],
    /// Standard deviations of the pixel coordinates, taken as independent.
    pub sigma_px: [f64; 2],
}

/// A parameter of the camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CameraParameter {
    /// F, pixels.
    Focal,
    /// Principal point, x, pixels.
    PrincipalX,
    /// Principal point, y, pixels.
    PrincipalY,
    /// Brown's k1.
    K1,
    /// Brown's k2.
    K2,
    /// Brown's k3.
    K3,
    /// Brown's p1.
    P1,
    /// Brown's p2.
    P2,
}

impl CameraParameter {
    /// All of them.
    pub const ALL: [Self; 8] =
        [Self::Focal, Self::PrincipalX, Self::PrincipalY, Self::K1, Self::K2, Self::K3, Self::P1, Self::P2];

    /// As in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Focal => "focal",
            Self::PrincipalX => "principal_x",
            Self::PrincipalY => "principal_y",
            Self::K1 => "k1",
            Self::K2 => "k2",
            Self::K3 => "k3",
            Self::P1 => "p1",
            Self::P2 => "p2",
        }
    }

    /// Unit of the value.
    pub fn unit(self) -> &'static str {
        match self {
            Self::Focal | Self::PrincipalX | Self::PrincipalY => "px",
            _ => "1",
        }
    }

    /// Its value.
    pub fn get(self, camera: &Camera) -> f64 {
        match self {
            Self::Focal => camera.focal_px,
            Self::PrincipalX => camera.principal_point_px[0],
            Self::PrincipalY => camera.principal_point_px[1],
            Self::K1 => camera.brown.k1,
            Self::K2 => camera.brown.k2,
            Self::K3 => camera.brown.k3,
            Self::P1 => camera.brown.p1,
            Self::P2 => camera.brown.p2,
        }
    }

    fn add(self, camera: &mut Camera, by: f64) {
        *match self {
            Self::Focal => &mut camera.focal_px,
            Self::PrincipalX => &mut camera.principal_point_px[0],
            Self::PrincipalY => &mut camera.principal_point_px[1],
            Self::K1 => &mut camera.brown.k1,
            Self::K2 => &mut camera.brown.k2,
            Self::K3 => &mut camera.brown.k3,
            Self::P1 => &mut camera.brown.p1,
            Self::P2 => &mut camera.brown.p2,
        } += by;
    }

    fn is_distortion(self) -> bool {
        self >= Self::K1
    }
}

/// What to estimate and when to be content.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraSettings {
    /// Columns and rows of the images.
    pub image_px: [usize; 2],
    /// Parameters to estimate; the others keep their values of `start`.
    pub free: Vec<CameraParameter>,
    /// Starting values; none: F from the views, principal point in the middle, no distortion.
    pub start: Option<Camera>,
    /// Largest residual in standard deviations (or robust standard deviations of the residuals, if
    /// those are larger) before a point is left out.
    pub outlier_limit: f64,
    /// Largest fraction of points that may be left out.
    pub max_outlier_fraction: f64,
    /// Largest standard deviation of F, and of the principal point, relative to F, before they count
    /// as undetermined.
    pub max_relative_sigma: f64,
    /// Most linearisations in one fit.
    pub max_iterations: usize,
}

impl CameraSettings {
    /// All eight parameters from images of this size.
    pub fn new(image_px: [usize; 2]) -> Self {
        Self {
            image_px,
            free: CameraParameter::ALL.to_vec(),
            start: None,
            outlier_limit: 5.0,
            max_outlier_fraction: 0.1,
            max_relative_sigma: 0.05,
            max_iterations: 100,
        }
    }
}

/// Where a board is: camera coordinates = rotation · (x, y, 0) + translation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// From board to camera.
    pub rotation: Rotation3<f64>,
    /// Of the board's origin, millimetres.
    pub translation: Vector3<f64>,
}

impl Pose {
    /// Angle between the board's normal and the optical axis, radians.
    pub fn tilt_rad(&self) -> f64 {
        let n = self.normal();
        n.x.hypot(n.y).atan2(n.z)
    }

    /// Unit normal of the board, away from the camera.
    pub fn normal(&self) -> Vector3<f64> {
        let n = self.rotation * Vector3::z();
        if n.z < 0.0 { -n } else { n }
    }

    /// Distance from the pinhole to the board along the optical axis, millimetres.
    pub fn axial_distance_mm(&self) -> f64 {
        let n = self.normal();
        n.dot(&self.translation) / n.z
    }
}

/// An estimated parameter of the camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraEstimate {
    /// Which one.
    pub parameter: CameraParameter,
    /// Its value.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// Whether the views fix it. A coefficient of distortion is fixed if its standard deviation is
    /// worth less than a pixel where the outermost points were seen, and its value more than twice
    /// its standard deviation; others might as well be held at zero.
    pub determined: bool,
}

/// What the calibration says of one view.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewFit {
    /// Where the board was.
    pub pose: Pose,
    /// RMS of the residuals (coordinates) of the points used, pixels.
    pub rms_px: f64,
    /// Residuals observed − model of all points, pixels.
    pub residuals_px: Vec<[f64; 2]>,
    /// Points left out.
    pub rejected: Vec<usize>,
}

/// Result of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraCalibration {
    /// The camera.
    pub camera: Camera,
    /// The estimates, in the order of [`CameraSettings::free`].
    pub estimates: Vec<CameraEstimate>,
    /// Their covariance: follows from the standard deviations of the points, multiplied by the
    /// reduced χ² where that exceeds 1.
    pub covariance: DMatrix<f64>,
    /// The views.
    pub views: Vec<ViewFit>,
    /// RMS of the residuals (coordinates) used, pixels.
    pub rms_px: f64,
    /// χ² divided by the degrees of freedom.
    pub chi_square_reduced: f64,
    /// Coordinates used minus unknowns.
    pub degrees_of_freedom: usize,
    /// Largest angle between the normals of two boards, radians.
    pub normals_spread_rad: f64,
    /// Linearisations used.
    pub iterations: usize,
}

impl CameraCalibration {
    /// The estimate of a parameter, if it was estimated.
    pub fn estimate(&self, parameter: CameraParameter) -> Option<&CameraEstimate> {
        self.estimates.iter().find(|e| e.parameter == parameter)
    }
}

/// Pose of a board seen by a known camera.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseFit {
    /// The pose.
    pub pose: Pose,
    /// Covariance of (rotation vector in camera axes applied from the left, radians; translation,
    /// mm), scaled as that of [`CameraCalibration`].
    pub covariance: Matrix6<f64>,
    /// RMS of the residuals (coordinates), pixels.
    pub rms_px: f64,
}

impl PoseFit {
    /// Distance along the optical axis and its standard deviation, millimetres.
    pub fn axial_distance_mm(&self) -> [f64; 2] {
        let base = self.pose.axial_distance_mm();
        // Of a smooth function by differences: the result is rounded to less than its σ anyway.
        let gradient = nalgebra::Vector6::from_fn(|k, _| {
            let mut by = [0.0; 6];
            by[k] = if k < 3 { 1e-6 } else { 1e-5 };
            (solve::moved(&self.pose, &by).axial_distance_mm() - base) / by[k]
        });
        [base, gradient.dot(&(self.covariance * gradient)).sqrt()]
    }
}

/// Why no camera came out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// Not enough views for the free parameters.
    #[error(
        "{found} views of the board cannot determine {parameters} parameters of the camera: at least {needed} are needed, tilted in different directions"
    )]
    TooFewViews {
        /// Views given.
        found: usize,
        /// Fewest.
        needed: usize,
        /// Free parameters.
        parameters: usize,
    },
    /// The points of a view lie on a line, or are less than four.
    #[error(
        "view {view}: its {points} points do not fix the position of a board (fewer than 4, or on a line)"
    )]
    DegenerateView {
        /// The view, from 0.
        view: usize,
        /// Its points.
        points: usize,
    },
    /// A number that is not finite, or a standard deviation that is not above zero.
    #[error(
        "view {view}, point {point}: coordinates and standard deviations must be finite, the latter above 0"
    )]
    Value {
        /// The view, from 0.
        view: usize,
        /// The point, from 0.
        point: usize,
    },
    /// All boards lie in parallel planes.
    #[error(
        "the boards of all views are parallel to within {spread_deg:.2}°: F and the principal point cannot be told from the distance; tilt the board by 20° and more, in different directions"
    )]
    ParallelViews {
        /// Largest angle between two normals.
        spread_deg: f64,
    },
    /// The views do not fix a parameter.
    #[error(
        "the views do not determine {}: its standard deviation would be {sigma:.3e} px, allowed is {limit:.3e}; add views tilted in other directions, that fill the image, or fix parameters",
        parameter.name()
    )]
    Undetermined {
        /// The parameter.
        parameter: CameraParameter,
        /// Its standard deviation (infinite where the normal equations are singular).
        sigma: f64,
        /// The largest allowed.
        limit: f64,
    },
    /// A setting that cannot be used.
    #[error("setting {name}: {allowed}")]
    Setting {
        /// Which one.
        name: &'static str,
        /// What is allowed.
        allowed: &'static str,
    },
    /// Too many points disagree with the model.
    #[error(
        "{rejected} of {points} points disagree with the model, at most {limit} may: wrong indices, another board, or a lens that Brown's model does not describe"
    )]
    TooManyOutliers {
        /// Left out.
        rejected: usize,
        /// All.
        points: usize,
        /// Largest number allowed.
        limit: usize,
    },
    /// The adjustment did not come to rest.
    #[error(
        "no convergence in {iterations} iterations: the views do not show one plane board with a fixed camera"
    )]
    NotConverged {
        /// Iterations made.
        iterations: usize,
    },
}

/// Calibrates a camera from views of one board.
///
/// # Errors
/// See [`CameraError`].
pub fn calibrate_camera(
    views: &[Vec<BoardPoint>],
    settings: &CameraSettings,
) -> Result<CameraCalibration, CameraError> {
    check(views, settings)?;
    solve::calibrate(views, settings)
}

/// Finds where a board is, for a known camera.
///
/// # Errors
/// [`CameraError::DegenerateView`], [`CameraError::Value`], [`CameraError::NotConverged`]; the view is 0.
pub fn pose_of_board(camera: &Camera, points: &[BoardPoint]) -> Result<PoseFit, CameraError> {
    let views = [points.to_vec()];
    let settings = CameraSettings { free: Vec::new(), start: Some(*camera), ..CameraSettings::new([1, 1]) };
    check(&views, &settings)?;
    solve::pose(camera, &views, &settings)
}

fn check(views: &[Vec<BoardPoint>], s: &CameraSettings) -> Result<(), CameraError> {
    let setting = |name, allowed| Err(CameraError::Setting { name, allowed });
    if (1..s.free.len()).any(|i| s.free[..i].contains(&s.free[i])) {
        return setting("free", "no parameter may be named twice");
    }
    if s.start.is_none() && !s.free.contains(&CameraParameter::Focal) {
        return setting("start", "F can only be held fixed at a value: give one to start from");
    }
    if let Some(c) = &s.start
        && !(c.focal_px > 0.0 && CameraParameter::ALL.iter().all(|p| p.get(c).is_finite()))
    {
        return setting("start", "F must be above 0, all values finite");
    }
    if !(s.outlier_limit > 0.0 && s.max_relative_sigma > 0.0 && (0.0..1.0).contains(&s.max_outlier_fraction))
    {
        return setting("limits", "limits must be above 0, the fraction of outliers in 0 to 1");
    }
    // Each view has two conditions for F and the principal point.
    let pinhole = s.free.iter().filter(|p| !p.is_distortion()).count();
    let needed = pinhole.div_ceil(2).max(1);
    if views.len() < needed {
        return Err(CameraError::TooFewViews { found: views.len(), needed, parameters: s.free.len() });
    }
    for (view, points) in views.iter().enumerate() {
        for (point, p) in points.iter().enumerate() {
            let finite = p.board_mm.iter().chain(&p.pixel_px).all(|v| v.is_finite());
            if !finite || !p.sigma_px.iter().all(|s| s.is_finite() && *s > 0.0) {
                return Err(CameraError::Value { view, point });
            }
        }
    }
    Ok(())
}
