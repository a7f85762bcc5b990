//! Diffraction-assisted image correlation: 3D shape and displacement with one camera behind a
//! transmission grating.
//!
//! This crate puts the parts together; each of them is useful on its own:
//! [`daic_correlate`] (2D-DIC), [`daic_optics`] (grating, decoders, calibration), [`daic_rig`] (link,
//! experiment, acquisition), [`daic_dataset`] (files), [`daic_report`] (figures, HTML).
//!
//! * [`measure`]: frames with two views become points and displacements.
//! * [`box_program`], [`timeline`]: programs of the trigger box, and pictures of them.
//! * [`recording`]: a run of the rig becomes a dataset.
//! * [`process`]: a dataset becomes results, summary and report.
//! * [`pair`]: plain 2D-DIC of two images; [`strain`] and [`probe`] work on its results, [`noise_floor`]
//!   says what such a measurement can resolve.
//! * [`phase`]: phases of gratings and displacements from them.
//! * [`calibrate_distortion`]: images of a line target become a distortion map.
//! * [`calibrate_rig`]: points tracked on a plate become an optics file.
//! * [`calibrate_camera`]: a camera from images of a board; [`align`]: lining up a rig.
//! * [`optics_file`]: an optics file with covariance, distortion maps ([`distortion_file`]) and volume, ready to
//!   decode; [`pairs`] decodes pixel pairs from elsewhere.
//! * [`sequence`]: the same of a series of images.
//! * [`lightfield`]: light fields become volumes.
//! * [`microscope`]: calibration of the microscope from known motions.

pub mod align;
pub mod area;
pub mod box_program;
pub mod calibrate_camera;
pub mod calibrate_distortion;
pub mod calibrate_rig;
pub mod camera_file;
#[cfg(feature = "sim")]
pub mod demo;
pub mod distortion_file;
pub mod doctor;
pub mod error;
pub mod expand;
pub mod exposure;
mod figures;
pub mod folder_camera;
pub mod frames;
pub mod images;
pub mod lightfield;
#[cfg(feature = "sim")]
pub mod lightfield_demo;
pub mod measure;
pub mod microscope;
pub mod noise_floor;
pub mod optics_file;
pub mod optics_section;
pub mod pair;
pub mod pairs;
pub mod phase;
pub mod probe;
pub mod process;
pub mod progress;
pub mod recording;
pub mod reports;
pub mod result_file;
pub mod sequence;
pub mod settings;
#[cfg(feature = "sim")]
pub mod simulated;
pub mod stage;
pub mod strain;
pub mod timeline;
pub mod usage;
mod verdicts;

pub use error::Error;
pub use progress::{Progress, Silent};
