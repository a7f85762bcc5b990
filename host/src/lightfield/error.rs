//! Why a light field could not be processed.

use daic_lightfield::{LatticeError, OperatorError, PsfError, ReconstructError};
use std::path::PathBuf;

/// Why a light field could not be processed.
#[derive(Debug, thiserror::Error)]
pub enum LightFieldError {
    /// A setup file that cannot be understood.
    #[error("{}: {reason}", path.display())]
    Setup {
        /// The file.
        path: PathBuf,
        /// What is wrong, with line and column.
        reason: String,
    },
    /// A lattice file that cannot be understood.
    #[error("{} is no lattice of `daic lightfield calibrate`: {reason}", path.display())]
    LatticeFile {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A stored point spread function that is not whole.
    #[error("{} is damaged: {reason}; delete it, it will be computed again", path.display())]
    PsfFile {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A stored point spread function of another setup.
    #[error("{} belongs to another setup ({what} differs); give another file, or compute it anew with --force", path.display())]
    PsfDiffers {
        /// The file.
        path: PathBuf,
        /// First part that differs.
        what: &'static str,
    },
    /// Nothing is left of the volume.
    #[error("an inset of {inset} lenslets on each side leaves nothing of {} × {}", cells[1], cells[0])]
    Inset {
        /// Lenslets on each side.
        inset: usize,
        /// Lenslets (y, x) of the frames.
        cells: [usize; 2],
    },
    /// A state that cannot be gone on from.
    #[error("{} cannot be continued: {reason}; begin anew with --overwrite", path.display())]
    State {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Images of one order and not of the other.
    #[error(
        "a grating in the setup needs the images of both orders: {plus} of the first and {minus} of the second were given (--minus)"
    )]
    Orders {
        /// Images of the plus order.
        plus: usize,
        /// Images of the minus order.
        minus: usize,
    },
    /// An image whose size is no whole number of cells.
    #[error("{}: {width} × {height} pixels are no whole number of lenslets of {pixels} pixels; give the lattice of the camera with --lattice, or rectified images", path.display())]
    Cells {
        /// The image.
        path: PathBuf,
        /// Width.
        width: usize,
        /// Height.
        height: usize,
        /// Pixels of a lenslet.
        pixels: usize,
    },
    /// An image of another size than the calibration's.
    #[error("{} has {found_width} × {found_height} pixels, the lattice was found in images of {width} × {height}", path.display())]
    Size {
        /// The image.
        path: PathBuf,
        /// Its width.
        found_width: usize,
        /// Its height.
        found_height: usize,
        /// Of the calibration.
        width: usize,
        /// Of the calibration.
        height: usize,
    },
    /// Planes that the point spread function does not have.
    #[error("the volume from {first} to {last} µm in steps of {step} µm has no planes")]
    Planes {
        /// First.
        first: f64,
        /// Last.
        last: f64,
        /// Step.
        step: f64,
    },
    /// A volume that no file of the kind can hold.
    #[error("{}: {reason}", path.display())]
    Stack {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// No point spread function.
    #[error("no point spread function: {0}")]
    Psf(#[from] PsfError),
    /// No operator.
    #[error("no projection: {0}")]
    Operator(#[from] OperatorError),
    /// No lattice.
    #[error("{}: {source}", path.display())]
    Lattice {
        /// The image.
        path: PathBuf,
        /// Why.
        source: LatticeError,
    },
    /// No reconstruction.
    #[error("{name} cannot be reconstructed: {source}")]
    Reconstruct {
        /// The frame.
        name: String,
        /// Why.
        source: ReconstructError,
    },
}
