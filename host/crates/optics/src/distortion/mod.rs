//! Image distortion from the phases of a flat line target.
//!
//! Two phase maps (lines crossed by x, lines crossed by y) give both coordinates on the target at
//! every pixel. The ideal target's image is a *homography* (a pinhole sees a tilted plane so), and what
//! is left is the distortion, observed = ideal + e:
//!
//! ```text
//! e = (φ_carrier − φ_measured) p₀/2π
//! ```
//!
//! for lines along an image axis, and in general the pixel less the place where the carrier has the
//! measured phases. The carrier is the homography with the smallest e (least squares over the
//! target). So e has no part that another scale, place or tilt of the target could have made:
//! [`TargetPose`] says which terms these are.
//!
//! The dense map passes the phases on at nodes about as far apart as the phases' window resolves; beside
//! it Brown's terms are fitted, each with its own carrier.

mod brown;
mod carrier;
mod dense;
mod noise;
mod parts;

use crate::camera::{Brown, Camera};
use crate::maps::{DistortionMap, MapError};
use crate::setup::{Optics, OpticsError, View};

pub use brown::BrownFit;
use carrier::{Carrier, Prediction, Sample, fit, rms};
use parts::Grid;

/// Fewest pixels with both phases, one per node of the map.
pub const LEAST_SAMPLES: usize = 40;

/// The phase of one direction of lines, as an analysis with a local window gives it.
#[derive(Clone, Copy, Debug)]
pub struct TargetPhase<'a> {
    /// Unwrapped phase, radians, row by row, 2π per line, rising with x (lines crossed by x) or y; NaN
    /// where there is none.
    pub phase_rad: &'a [f64],
    /// Its standard deviation.
    pub sigma_rad: &'a [f32],
    /// Connected part of the target; 0 for none, 1 for the largest. Parts differ by whole turns.
    pub part: &'a [u32],
    /// The analysis window along either axis, an odd number of weights.
    pub window: &'a [f32],
}

/// Both phases of a target.
#[derive(Clone, Copy, Debug)]
pub struct TargetPhases<'a> {
    /// Columns of the arrays.
    pub width: usize,
    /// Rows of the arrays.
    pub height: usize,
    /// Pixel of the sensor that the arrays begin with.
    pub origin_px: [usize; 2],
    /// Lines whose normal is nearer to x, then nearer to y.
    pub directions: [TargetPhase<'a>; 2],
    /// Whether both directions are known to lie in one plane.
    pub pose: TargetPose,
}

/// What the two directions of lines have in common, and hence which parts of e a tilt of the target
/// could have made. In the target's axes:
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TargetPose {
    /// One pose: a cross grating, or two exposures on a holder that keeps the plane. Not determined:
    /// 1, x, y of e_x and of e_y; (x², xy) and (xy, y²) of e_x and e_y in common.
    Common,
    /// The target is known to lie square to the camera, or in the reference plane of a set-up: nothing of a tilt is
    /// removed. Not determined: 1, x, y of e_x and of e_y. Through a grating and counted from straight lines this keeps
    /// what the paraxial models take the grating's own perspective for.
    Square,
    /// Each direction has a pose of its own. Not determined: 1, x, y, x², xy of e_x;
    /// 1, x, y, xy, y² of e_y.
    Separate,
}

impl TargetPose {
    /// The terms that are removed with the carrier: of e_x alone, of e_y alone, and of both in common.
    pub fn removed(self) -> [&'static [&'static str]; 3] {
        match self {
            Self::Square => [&["1", "x", "y"], &["1", "x", "y"], &[]],
            Self::Common => [&["1", "x", "y"], &["1", "x", "y"], &["(x², xy)", "(xy, y²)"]],
            Self::Separate => [&["1", "x", "y", "x²", "xy"], &["1", "x", "y", "xy", "y²"], &[]],
        }
    }

    /// The terms among them that a tilt makes: of e_x, of e_y, and of both in common.
    pub fn shared_with_tilt(self) -> [&'static [&'static str]; 3] {
        match self {
            Self::Square => [&[], &[], &[]],
            Self::Common => [&[], &[], &["(x², xy)", "(xy, y²)"]],
            Self::Separate => [&["x², xy"], &["xy, y²"], &[]],
        }
    }
}

/// What e is counted from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ideal {
    /// The image by this camera, Brown's terms included: with none of them, a pinhole's; with some, the
    /// map holds what they leave.
    Camera(Camera),
    /// The image by this set-up through the grating of a view, along exact rays from the reference
    /// plane; Brown's terms as above.
    Grating {
        /// The set-up.
        optics: Optics,
        /// The view.
        view: View,
    },
}

impl Ideal {
    fn brown(&self) -> Brown {
        match self {
            Self::Camera(c) => c.brown,
            Self::Grating { optics, .. } => optics.camera.brown,
        }
    }
}

/// Something that does not prevent a calibration but should be looked at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DistortionWarning {
    /// The target covers only part of the image; there is no map elsewhere.
    PartlyCovered {
        /// Part of the image within reach of the map.
        share: f64,
    },
    /// Line distances along x and y differ: another target, another distance, or pixels that are not square.
    PitchesDiffer {
        /// Line distance of the second direction over that of the first.
        ratio: f64,
    },
    /// Connected parts of the target whose whole turns could not be told were left out.
    PartsLeftOut {
        /// Number of pixels, of those looked at.
        pixels: usize,
    },
}

/// Largest ratio of line distances that passes without a warning, less 1: twice what a tilt by 3° makes.
const PITCH_TOLERANCE: f64 = 0.003;
/// Share of the image that the map must cover to pass without a warning.
const COVERED: f64 = 0.85;

/// Why there is no calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DistortionError {
    /// An array has another size than the image.
    #[error("{array} of direction {direction} has {found} values, {expected} are needed")]
    Size {
        /// Which one.
        array: &'static str,
        /// 1 or 2.
        direction: usize,
        /// Values given.
        found: usize,
        /// Values needed.
        expected: usize,
    },
    /// The window is no window.
    #[error("the analysis window has {found} weights: an odd number from 3 on, of positive sum, is needed")]
    Window {
        /// Weights given.
        found: usize,
    },
    /// The camera has no focal length.
    #[error("the camera's focal length is {focal_px} px, it must be above 0, and its principal point finite")]
    Camera {
        /// Its value.
        focal_px: f64,
    },
    /// The set-up.
    #[error(transparent)]
    Optics(#[from] OpticsError),
    /// Hardly anything to calibrate from.
    #[error(
        "only {found} places show both directions of lines, at least {needed} are needed: does the target reach well beyond the analysis window (ten line distances by default), and are both images of it sharp?"
    )]
    TooFew {
        /// Places found.
        found: usize,
        /// Places needed.
        needed: usize,
    },
    /// Both directions are one.
    #[error(
        "the lines of both directions are {angle_deg:.1}° from each other, at least 45° are needed: give one image of lines along x and one of lines along y"
    )]
    SameDirection {
        /// Angle between the two normals.
        angle_deg: f64,
    },
    /// The model does not reach a pixel.
    #[error(
        "the ideal image cannot be predicted at pixel ({:.0}, {:.0}): do the optics fit the image, and is it the view it is said to be?",
        pixel_px[0], pixel_px[1]
    )]
    Unpredictable {
        /// The pixel.
        pixel_px: [f64; 2],
    },
    /// Carrier or Brown's terms are left open.
    #[error("the phases do not determine the target's pose: does the target fill enough of the image?")]
    Undetermined,
    /// The fit went astray.
    #[error("the fit of the target's pose does not converge: are the phases those of one flat target?")]
    NotConverged,
    /// The map.
    #[error("no map could be made: {0}")]
    Map(#[from] MapError),
}

/// A calibrated distortion.
#[derive(Clone, Debug)]
pub struct DistortionCalibration {
    /// e over the target.
    pub map: DistortionMap,
    /// Standard deviation of (e_x, e_y) at the map's nodes, row by row, pixels: from image noise, and how far the
    /// true distortion may stray from a smooth map between and beyond the nodes that were
    /// [`measured`](Self::measured).
    pub sigma_px: Vec<[f64; 2]>,
    /// The part from image noise: the scatter of the map over repeated exposures.
    pub noise_px: Vec<[f64; 2]>,
    /// Nodes at which phases were measured; elsewhere (the border that the window leaves, gaps) the map
    /// goes on smoothly from Brown's terms.
    pub measured: Vec<bool>,
    /// Brown's terms fitted to the same phases.
    pub brown: BrownFit,
    /// Which terms are removed.
    pub pose: TargetPose,
    /// Line distances at the middle of the target: pixels of the ideal camera, or millimetres on the
    /// reference plane ([`Ideal::Grating`]).
    pub pitch: [f64; 2],
    /// Angle of both normals of the lines against x in the same frame, radians.
    pub angle_rad: [f64; 2],
    /// Relative change of the target's inverse distance along x and y per unit of that frame, for both
    /// directions: the tangent of the tilt divided by the distance (by F for pixels). Lens decentring
    /// looks the same.
    pub tilt: [[f64; 2]; 2],
    /// RMS and largest magnitude of (e_x, e_y) over the measured nodes, pixels.
    pub rms_px: [f64; 2],
    /// Largest magnitude of (e_x, e_y).
    pub largest_px: [f64; 2],
    /// What is left once the map is taken off.
    pub left: Left,
    /// To be looked at.
    pub warnings: Vec<DistortionWarning>,
}

/// The error of a map, in parts; RMS over the measured nodes, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Left {
    /// Measured less map at places half-way between the nodes, which the map was not made from, beyond what
    /// noise makes of that difference.
    pub between_nodes_px: [f64; 2],
    /// Standard deviation of the map from image noise.
    pub noise_px: [f64; 2],
    /// Detail that the analysis window takes off, from what it takes off the map itself.
    pub window_px: [f64; 2],
}

impl Left {
    /// All together.
    pub fn total_px(&self) -> [f64; 2] {
        [0, 1].map(|i| self.between_nodes_px[i].hypot(self.noise_px[i]).hypot(self.window_px[i]))
    }
}

/// Calibrates the distortion, see the [module](self).
///
/// # Errors
/// See [`DistortionError`].
pub fn calibrate_distortion(
    phases: &TargetPhases<'_>,
    ideal: &Ideal,
) -> Result<DistortionCalibration, DistortionError> {
    let prediction = Prediction::new(ideal)?;
    let grid = Grid::new(phases)?;
    let base = ideal.brown();
    let (samples, left_out) = parts::joined(&grid, phases, &prediction, &base)?;
    let nodes: Vec<Sample> = samples.iter().map(|(_, s)| *s).collect();
    let start = Carrier::start(&nodes, &prediction, &base, phases.pose)?;
    let apart = {
        let [a, b] = start.angle();
        (a - b).sin().abs().asin().to_degrees()
    };
    if apart < 45.0 {
        return Err(DistortionError::SameDirection { angle_deg: apart });
    }
    let only = fit(&nodes, &prediction, start, base, [false; 5])?;
    let brown = brown::fit_beside(&grid, &samples, &prediction, &only)?;
    let made = dense::make(&grid, phases, &samples, &prediction, &only, &brown)?;
    let pitch = only.carrier.pitch();
    let mut warnings = Vec::new();
    if grid.share < COVERED {
        warnings.push(DistortionWarning::PartlyCovered { share: grid.share });
    }
    let ratio = pitch[1] / pitch[0];
    if (ratio - 1.0).abs() > PITCH_TOLERANCE {
        warnings.push(DistortionWarning::PitchesDiffer { ratio });
    }
    if left_out > 0 {
        warnings.push(DistortionWarning::PartsLeftOut { pixels: left_out });
    }
    let largest = |i: usize| only.left.iter().fold(0.0_f64, |m, e| m.max(e[i].abs()));
    Ok(DistortionCalibration {
        map: made.map,
        sigma_px: made.sigma,
        noise_px: made.noise,
        measured: made.measured,
        brown,
        pose: phases.pose,
        pitch,
        angle_rad: only.carrier.angle(),
        tilt: only.carrier.tilt(),
        rms_px: rms(&only.left),
        largest_px: [largest(0), largest(1)],
        left: made.left,
        warnings,
    })
}
