//! NumPy archives: what tables and maps share.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use ndarray::{ArrayBase, Data, Dimension};
use ndarray_npy::{NpzWriter, WritableElement, WriteNpzError};
use thiserror::Error;

use crate::atomic::{self, WriteError};

/// Why a NumPy archive could not be written.
#[derive(Debug, Error)]
pub enum NpzError {
    /// An array could not be encoded.
    #[error("cannot encode array `{array}` of {}: {reason}", path.display())]
    Encode {
        /// The archive.
        path: PathBuf,
        /// The array.
        array: String,
        /// What the encoder said.
        reason: String,
    },
    /// The file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Collects arrays in memory, then writes the archive in one step. Stored, not deflated, as
/// `numpy.savez` does: measured values hardly compress.
pub(crate) struct Archive<'a> {
    path: &'a Path,
    writer: NpzWriter<Cursor<Vec<u8>>>,
}

impl<'a> Archive<'a> {
    pub(crate) fn new(path: &'a Path) -> Self {
        Archive { path, writer: NpzWriter::new(Cursor::new(Vec::new())) }
    }

    fn encode(&self, array: &str, error: WriteNpzError) -> NpzError {
        NpzError::Encode {
            path: self.path.to_path_buf(),
            array: array.to_string(),
            reason: error.to_string(),
        }
    }

    pub(crate) fn add<S, D>(&mut self, name: &str, array: &ArrayBase<S, D>) -> Result<(), NpzError>
    where
        S: Data,
        S::Elem: WritableElement,
        D: Dimension,
    {
        self.writer.add_array(name, array).map_err(|e| self.encode(name, e))
    }

    pub(crate) fn finish(self) -> Result<(), NpzError> {
        let path = self.path;
        let cursor = self.writer.finish().map_err(|e| NpzError::Encode {
            path: path.to_path_buf(),
            array: String::new(),
            reason: e.to_string(),
        })?;
        Ok(atomic::write_bytes(path, cursor.get_ref())?)
    }
}
