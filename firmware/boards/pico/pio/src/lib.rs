//! The types of the crate `pio` without its macros.
#![no_std]

pub use pio_core::*;
