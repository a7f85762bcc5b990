//! Two-dimensional digital image correlation.
//!
//! Plain arrays in, results out: subset correlation by inverse-compositional Gauss–Newton with the
//! zero-normalised sum of squared differences, B-spline interpolation, initial guesses that reach
//! across half the image, a status and an uncertainty for every point.
//!
//! Conventions: pixel (0, 0) has its centre at (0, 0), x to the right, y down; displacements are
//! Lagrangian, in pixels.
#![forbid(unsafe_code)]
#![allow(clippy::needless_range_loop)] // index loops are what the vector kernels are made of

#[cfg(feature = "bench")]
#[doc(hidden)]
pub mod bench_support;
mod consistency;
mod correlate;
mod dense;
mod fft;
mod icgn;
mod image;
mod kernel;
mod noise;
mod normal;
mod plane;
mod point;
mod points;
mod prepared;
mod propagate;
mod sampler;
mod scalar;
mod settings;
mod shape;
mod simd;
mod subset;
mod views;

pub use correlate::{
    CorrelateError, Correlation, Guess, Observer, Stage, Timing, Workspace, correlate, correlate_scalar,
    simd_level,
};
pub use image::{Image, ImageError, Mask};
pub use point::{Point, ShapeParameters, SolvedBy, Status};
pub use points::{Grid, Points, PointsError, Rectangle, Roi};
pub use prepared::{Reference, Target};
pub use settings::{Criterion, Interpolation, Settings, SettingsError, SolverChoice};
pub use shape::Shape;
pub use views::{View, Views, ViewsError, find_views};
