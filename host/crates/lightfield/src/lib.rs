//! Light-field microscopy by wave optics.
//!
//! From objective, lenslets and grating to the light of every voxel in every pixel ([`Psf`]); projections
//! with it and their exact adjoint ([`Operator`]); volumes from frames ([`reconstruct`]); and the lenslet
//! lattice of a real camera from a white image ([`lattice`]). Plain arrays in, results out: this crate
//! knows nothing of files or rigs.
#![forbid(unsafe_code)]
#![allow(clippy::needless_range_loop)] // index loops are what the vector kernels are made of

pub mod debye;
mod error;
pub mod lattice;
mod lenslets;
mod operator;
mod optics;
mod propagate;
mod psf;
mod reconstruct;
mod simd;

pub use error::{LatticeError, OperatorError, PsfError, ReconstructError};
pub use operator::{
    Direct, MemoryEstimate, Normal, Operator, OperatorSettings, Reduction, Storage, Symmetries,
};
pub use optics::{
    Aperture, DepthSign, DiffractionModel, Grating, Lenslets, Objective, Order, Oversampling, Packing,
    Propagation, PsfParameters, Radius, VoxelKernel,
};
pub use psf::{Psf, PsfReport, PsfShape};
pub use reconstruct::{
    Frame, Method, Model, Path, Reconstruction, Settings, State, Step, native_widths, reconstruct,
};
