//! Light fields: files in, volumes out. What `daic lightfield` does.

pub mod calibration;
pub mod error;
pub mod frames;
pub mod numbers_file;
pub mod output;
pub mod psf_file;
pub mod series;
pub mod setup;
pub mod spots;

pub use error::LightFieldError;
