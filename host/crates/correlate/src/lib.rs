#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]
#![allow(clippy::needless_range_loop)] // index loops are what the vector kernels are made of

mod begin;
#[cfg(feature = "bench")]
#[doc(hidden)]
pub mod bench_support;
mod consistency;
mod correlate;
mod damped;
mod dense;
mod discontinuity;
mod domain;
mod eulerian;
mod features;
mod fft;
mod halves;
mod icgn;
mod image;
mod kernel;
mod noise;
mod normal;
mod per_thread;
pub mod phase;
mod plane;
mod point;
mod points;
mod prepared;
mod propagate;
mod regions;
mod sampler;
mod scalar;
mod sequence;
mod settings;
mod shape;
mod simd;
mod start;
pub mod strain;
mod subset;
mod uncertainty;
mod verdict;
mod views;

pub use correlate::{
    CorrelateError, Correlation, Guess, Observer, Stage, Timing, Workspace, correlate, correlate_scalar,
    simd_level,
};
pub use eulerian::{EulerianPoint, eulerian};
pub use features::{Affine, AffineGroup, FeatureMatch, FeatureMatches, match_features};
pub use image::{Image, ImageError, Mask};
pub use point::{Point, ShapeParameters, SolvedBy, Status};
pub use points::{Grid, Points, PointsError, Rectangle, Roi};
pub use prepared::{Reference, Target};
pub use regions::{Effect, Region, RegionError, Regions};
pub use sequence::{Sequence, SequenceError, SequenceFrame, SequenceState, Update};
pub use settings::{Criterion, Interpolation, Settings, SettingsError, SolverChoice};
pub use shape::Shape;
pub use start::{FeatureStart, RejectedSeed, Seed, StartAttempt, StartMethod, StartReport, StartWarning};
pub use views::{View, Views, ViewsError, find_views};
