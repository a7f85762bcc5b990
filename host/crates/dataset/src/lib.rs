//! Files in and out: images, tables, maps and dataset folders.
//!
//! This crate knows plain numbers and arrays only; it knows nothing of optics, correlation or
//! rigs. Every file is written under a temporary name in its own folder and then renamed
//! ([`atomic`]), except the journals of a dataset, which grow line by line while a recording runs
//! ([`dataset`]).
//!
//! Image convention: row-major, `data[y * width + x]`, pixel (0, 0) at the top left, x to the
//! right, y down.

pub mod atomic;
pub mod dataset;
pub mod image_file;
mod lattice;
pub mod map;
mod npz;
pub mod table;
pub mod volume;

pub use atomic::WriteError;
pub use dataset::{
    Contents, Damage, Dataset, DatasetError, EventRecord, Existing, FrameRecord, FrameRole, Manifest,
    Recording, StrobeRecord, Verdict, result_key,
};
pub use image_file::{GreyImage, ImageFileError, ReadNote, read_grey};
pub use lattice::Lattice;
pub use map::{FloatMap, MapAxes, MapError};
pub use npz::NpzError;
pub use table::{Column, Table, TableError};
pub use volume::{Volume, VolumeError, read_stack};
