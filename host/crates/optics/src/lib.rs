//! Optics of diffraction-assisted image correlation with one camera behind a transmission grating.
//!
//! Plain numbers in, plain numbers out: this crate knows no files, images or rigs.
//!
//! # Conventions
//!
//! * World: origin in the pinhole, x right, y down, z along the optical axis towards the object.
//!   The grating's pivot is at (0, 0, s), the reference plane at z = s + d.
//! * Object coordinates (x, y, h), millimetres: origin where the optical axis meets the reference
//!   plane, x right, y down, h towards the camera, so z = s + d − h; [`ReferenceFrame`] turns and
//!   shifts them with a reference plane that is not square to the axis.
//! * Pixels: (0, 0) is the centre of the first pixel, x right, y down.
//! * The view on the left half of the sensor is [`View::Minus`]. Traced from the pinhole its rays
//!   take order m = +1 in α' = α + mλ/p, those of [`View::Plus`] m = −1.
//!
//! # Parts
//!
//! [`grating`] holds the grating equation alone, [`camera`] the pinhole with Brown–Conrady
//! distortion, [`Optics`] the parameters of a set-up, and [`OpticalModel`] the set-up prepared for
//! work: decoding a pixel pair ([`OpticalModel::decode`]), projecting a point
//! ([`OpticalModel::project`]), displacement of a material point
//! ([`OpticalModel::displacement`]), the expected disparity ([`OpticalModel::disparity_range`]).
//! Dense distortion maps ([`maps`]) may stand in for the camera's Brown terms or on top of them.
//! [`calibrate`](calibrate::calibrate) estimates F and the distances from points tracked through
//! known moves, [`bundle`] everything from views of a plate in several poses, [`distortion`] maps of the image
//! distortion from phases of a line target.
//! [`microscope`] holds the same for the microscope. What both are is [`PairModel`]. [`plan`](mod@plan) says what a
//! set-up will be able to measure; [`surface`] is the strain on a measured surface.
//! [`target`] finds calibration boards in images, [`intrinsics`] calibrates a camera from them,
//! [`align`] helps to line up a rig.

#![allow(
    clippy::neg_cmp_op_on_partial_ord,
    reason = "!(a > b) is written where a NaN must be refused as well"
)]

pub mod align;
mod banded;
pub mod bundle;
pub mod calibrate;
pub mod camera;
pub mod decode;
pub mod distortion;
pub mod grating;
pub mod intrinsics;
pub mod maps;
pub mod microscope;
mod model;
mod pair_model;
pub mod parameter;
pub mod patch;
pub mod plan;
mod project;
mod real;
mod robust;
mod setup;
pub mod surface;
pub mod target;

pub use bundle::{Component, RigCalibration, RigData, RigError, RigSettings, calibrate_rig};
pub use calibrate::{CalibrateError, Calibration, Estimate, Observation, Settings, TrackedPoint, calibrate};
pub use camera::{Brown, Camera, UndistortError};
pub use decode::{Decoded, Decoder, Displacement, PixelPair, UncertainPoint, pixel_covariance};
pub use distortion::{
    DistortionCalibration, DistortionError, DistortionWarning, TargetPhase, TargetPhases, TargetPose,
    calibrate_distortion,
};
pub use grating::{DiffractError, Grating, GratingFrame, Substrate, SubstrateSide};
pub use maps::{DistortionMap, DistortionMaps, MapError, MapFit, MapGrid, MapSample};
pub use model::{OpticalModel, Ray, TraceError};
pub use pair_model::PairModel;
pub use parameter::{
    CovarianceError, GratingParameter, LEAST_EIGENVALUE, Parameter, ParameterCovariance, ParameterJacobian,
    UnknownParameter, least_correlation_eigenvalue,
};
pub use patch::{GreyError, GreyView};
pub use project::DisparityRange;
pub use setup::{Optics, OpticsError, ReferenceFrame, View};
