//! Chapters 2, 3 and 4 of the thesis, simulated with exact physics and measured with the project's own
//! correlation, calibration, decoding and reconstruction: what `cargo xtask reproduce` runs.
//!
//! [`macroscopic`] is chapter 2, [`microscopic`] chapter 3, [`lightfield`] chapter 4. Each gives numbers (for the tests) and a
//! [`document::Part`] of `docs/reproduction.md` with its figures. Nothing depends on the machine, the
//! number of threads or the time.

pub mod document;
mod error;
pub mod lightfield;
pub mod macroscopic;
pub mod microscopic;
mod pictures;
pub mod statistics;

pub use error::ReproduceError;

/// How much is simulated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extent {
    /// The thesis' fields.
    Full,
    /// Small fields and few cases, for the test-suite.
    Quick,
}

impl Extent {
    /// Distance of points in pixels: the thesis' 5, fewer in a quick run.
    pub const fn step(self) -> usize {
        match self {
            Self::Full => 5,
            Self::Quick => 11,
        }
    }
}

/// Subset of the correlation in pixels, as in the thesis.
pub const SUBSET: usize = 59;
