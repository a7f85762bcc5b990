//! `daic calibrate`.

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
    /// β and the centre of the microscope from fields of known motions
    Microscope(MicroscopeArgs),
}

pub fn calibrate(arguments: &CalibrateArgs, output: &Output) -> Result<Answer, Error> {
    match &arguments.what {
        Calibrate::Microscope(arguments) => microscope::calibrate(arguments, output),
    }
}
