//! What can go wrong in a reproduction.

use std::path::PathBuf;

/// Why a reproduction has no result.
#[derive(Debug, thiserror::Error)]
pub enum ReproduceError {
    /// The simulated rig.
    #[error(transparent)]
    Scene(#[from] daic_hil_sim::ConfigError),
    /// A frame.
    #[error(transparent)]
    Image(#[from] daic_correlate::ImageError),
    /// The views of a frame.
    #[error(transparent)]
    Views(#[from] daic_correlate::ViewsError),
    /// Points of interest.
    #[error(transparent)]
    Points(#[from] daic_correlate::PointsError),
    /// A correlation.
    #[error(transparent)]
    Correlate(#[from] daic_correlate::CorrelateError),
    /// A set-up.
    #[error(transparent)]
    Optics(#[from] daic_optics::OpticsError),
    /// A ray.
    #[error(transparent)]
    Trace(#[from] daic_optics::TraceError),
    /// A distortion map.
    #[error(transparent)]
    Map(#[from] daic_optics::MapError),
    /// The calibration of the rig.
    #[error(transparent)]
    Rig(#[from] daic_optics::RigError),
    /// A microscope.
    #[error(transparent)]
    Microscope(#[from] daic_optics::microscope::MicroscopeError),
    /// The calibration of the microscope.
    #[error(transparent)]
    Calibrate(#[from] daic_optics::microscope::calibrate::CalibrateError),
    /// The calibration left parameters of the microscope open.
    #[error("the calibration moves leave parameters of the microscope open")]
    Open,
    /// A point spread function.
    #[error(transparent)]
    Psf(#[from] daic_lightfield::PsfError),
    /// A projection.
    #[error(transparent)]
    Projection(#[from] daic_lightfield::OperatorError),
    /// A volume.
    #[error(transparent)]
    Volume(#[from] daic_lightfield::ReconstructError),
    /// Too little was measured.
    #[error("{what}: {found} points, at least {needed} are needed")]
    Few {
        /// Of what.
        what: String,
        /// Points found.
        found: usize,
        /// Points needed.
        needed: usize,
    },
    /// A figure.
    #[error(transparent)]
    Report(#[from] daic_report::ReportError),
    /// A file could not be written.
    #[error(transparent)]
    Write(#[from] daic_dataset::WriteError),
    /// A file could not be read or made.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A height map could not be written.
    #[error("{}: {source}", path.display())]
    HeightMap {
        /// The file.
        path: PathBuf,
        /// Why.
        source: image::ImageError,
    },
}
