//! `daic calibrate`.

use super::calibrate_distortion::{self, DistortionArgs};
use super::calibrate_rig::{self, RigArgs};
use super::camera::{self, CameraArgs};
use super::microscope::{self, MicroscopeArgs};
use super::output::{Answer, Output};
use clap::{Args, Subcommand};
use daic::Error;

#[derive(Debug, Args)]
pub struct CalibrateArgs {
    #[command(subcommand)]
    what: Calibrate,
}

#[derive(Debug, Subcommand)]
enum Calibrate {
    /// F, principal point and distortion of a camera from images of a dot grid or checkerboard
    Camera(CameraArgs),
    /// Image distortion as a dense map, from images of a line target: one cross grating, or lines along x and
    /// lines along y
    Distortion(DistortionArgs),
    /// Camera, gratings and distances, from points of a flat plate tracked through several poses in both
    /// first-order views
    Rig(RigArgs),
    /// β and the centre of the microscope from fields of known motions
    Microscope(MicroscopeArgs),
}

pub fn calibrate(arguments: &CalibrateArgs, output: &Output) -> Result<Answer, Error> {
    match &arguments.what {
        Calibrate::Camera(arguments) => camera::calibrate(arguments, output),
        Calibrate::Distortion(arguments) => calibrate_distortion::calibrate(arguments, output),
        Calibrate::Rig(arguments) => calibrate_rig::calibrate(arguments),
        Calibrate::Microscope(arguments) => microscope::calibrate(arguments, output),
    }
}
