//! Optics of diffraction-assisted image correlation with one camera behind a transmission grating.
//!
//! Plain numbers in, plain numbers out: this crate knows no files, images or rigs.
//!
//! # Conventions
//!
//! * World: origin in the pinhole, x right, y down, z along the optical axis towards the object.
//!   The grating's pivot is at (0, 0, s), the reference plane at z = s + d.
//! * Object coordinates (x, y, h), millimetres: origin where the optical axis meets the reference
//!   plane, x right, y down, h towards the camera, so z = s + d − h.
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
//! [`target`] finds calibration boards in images, [`intrinsics`] calibrates a camera from them,
//! [`align`] helps to line up a rig. [`calibrate`](calibrate::calibrate) estimates parameters from points tracked through known moves.

#![allow(
    clippy::neg_cmp_op_on_partial_ord,
    reason = "!(a > b) is written where a NaN must be refused as well"
)]

pub mod align;
pub mod calibrate;
pub mod camera;
pub mod decode;
pub mod grating;
pub mod intrinsics;
mod model;
pub mod patch;
mod project;
mod real;
mod setup;
pub mod target;

pub use calibrate::{CalibrateError, Calibration, Estimate, Observation, Settings, TrackedPoint, calibrate};
pub use camera::{Brown, Camera, UndistortError};
pub use decode::{Decoded, Decoder, Displacement, PixelPair, pixel_covariance};
pub use grating::{DiffractError, Grating, GratingFrame, Substrate, SubstrateSide};
pub use model::{OpticalModel, Ray, TraceError};
pub use patch::{GreyError, GreyView};
pub use project::DisparityRange;
pub use setup::{Optics, OpticsError, Parameter, View};
