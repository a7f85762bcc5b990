//! Why a rig could not be calibrated.

use crate::bundle::Component;
use crate::setup::OpticsError;

/// Why no calibration of the rig came out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RigError {
    /// The starting values, or the estimates, are not a possible set-up.
    #[error("{0}")]
    Optics(#[from] OpticsError),
    /// A parameter is named twice, or is one of the reference frame, which is always estimated.
    #[error(
        "{name} is listed twice, or belongs to the reference plane, which the poses determine by themselves"
    )]
    Parameter {
        /// Its name.
        name: &'static str,
    },
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
    /// A pose names a point that the plate has not.
    #[error("pose {pose} names point {point}, the plate has {points}")]
    UnknownPoint {
        /// The pose.
        pose: usize,
        /// The point.
        point: usize,
        /// Points of the plate.
        points: usize,
    },
    /// A pose names a point twice.
    #[error("pose {pose} has point {point} twice")]
    RepeatedPoint {
        /// The pose.
        pose: usize,
        /// The point.
        point: usize,
    },
    /// A pixel is not finite or its standard deviation not above 0.
    #[error("pose {pose}, point {point}: pixel and standard deviation must be finite, the latter above 0")]
    Pixel {
        /// The pose.
        pose: usize,
        /// The point.
        point: usize,
    },
    /// A coordinate of the plate is not finite.
    #[error("plate coordinates of point {point} are not finite")]
    PlateCoordinates {
        /// The point.
        point: usize,
    },
    /// What is known of a pose is not finite or its standard deviation not above 0.
    #[error("what is known of pose {pose} must be finite, with a standard deviation above 0")]
    KnownPose {
        /// The pose.
        pose: usize,
    },
    /// Not enough poses.
    #[error("{found} poses of the plate, at least {needed} are needed: move it along the axis and tilt it")]
    TooFewPoses {
        /// Poses given.
        found: usize,
        /// Poses needed.
        needed: usize,
    },
    /// Too few points of a pose are seen in both views.
    #[error(
        "pose {pose}: {found} points are found in both views and fit the starting values, at least {needed} are needed"
    )]
    TooFewPoints {
        /// The pose.
        pose: usize,
        /// Points found.
        found: usize,
        /// Points needed.
        needed: usize,
    },
    /// A pose shares too few points with the others for its place on the plate to be known.
    #[error("pose {pose} shares {found} points with the other poses, at least {needed} are needed")]
    NotLinked {
        /// The pose.
        pose: usize,
        /// Points shared.
        found: usize,
        /// Points needed.
        needed: usize,
    },
    /// All poses lie in one plane.
    #[error(
        "all poses lie within {span_mm:.3} mm of height, at least {needed_mm:.3} mm are needed: the height scale would be a guess"
    )]
    NoDepth {
        /// Largest difference of height.
        span_mm: f64,
        /// What is needed.
        needed_mm: f64,
    },
    /// Neither plate coordinates nor moves are known.
    #[error("nothing gives the scale: state the plate's pitch, or moves of the stage")]
    NoScale,
    /// The two views are exchanged.
    #[error(
        "the -1 and +1 views are swapped in pose(s) {poses:?}: their lines of sight meet behind the grating only when exchanged"
    )]
    SwappedOrders {
        /// The poses.
        poses: Vec<usize>,
    },
    /// The plate would be seen from behind.
    #[error(
        "pose {pose} shows the plate mirrored: its coordinates must run as x to the right and y down on the sensor"
    )]
    Mirrored {
        /// The pose.
        pose: usize,
    },
    /// The plate's pitch and the stage's moves contradict each other.
    #[error(
        "the plate is {ratio:.5} ± {sigma:.5} times as large as stated if the moves are right: pitch of the target or scale of the stage is wrong"
    )]
    PitchConflict {
        /// Size found divided by size stated.
        ratio: f64,
        /// Its standard deviation.
        sigma: f64,
    },
    /// Parameters that neither the data nor a prior fix.
    #[error(
        "neither the data nor a prior determine the combination {}: fix one of them or give it a prior",
        list(combination)
    )]
    Undetermined {
        /// What may change together without any effect on the images.
        combination: Vec<Component>,
    },
    /// Too many observations disagree with the model.
    #[error(
        "{rejected} of {observations} pixels disagree with the model; at most {limit} may: wrong tracking, or a plate that is not flat"
    )]
    TooManyOutliers {
        /// Left out.
        rejected: usize,
        /// All.
        observations: usize,
        /// Largest number allowed.
        limit: usize,
    },
    /// The iteration did not come to rest.
    #[error(
        "no convergence in {iterations} iterations: starting values too far off, or poses that do not belong to these points"
    )]
    NotConverged {
        /// Iterations made.
        iterations: usize,
    },
}

fn list(combination: &[Component]) -> String {
    let terms: Vec<String> =
        combination.iter().map(|c| format!("{:+.2}·{}", c.weight, c.parameter.name())).collect();
    terms.join(" ")
}

impl RigError {
    /// The pose and the point that are to blame, counted from 0, where there are such.
    pub fn place(&self) -> (Option<usize>, Option<usize>) {
        match *self {
            Self::UnknownPoint { pose, point, .. }
            | Self::RepeatedPoint { pose, point }
            | Self::Pixel { pose, point } => (Some(pose), Some(point)),
            Self::PlateCoordinates { point } => (None, Some(point)),
            Self::KnownPose { pose }
            | Self::Mirrored { pose }
            | Self::TooFewPoints { pose, .. }
            | Self::NotLinked { pose, .. } => (Some(pose), None),
            _ => (None, None),
        }
    }
}
