//! What can be wrong with a dataset folder.

use std::io;
use std::path::{Path, PathBuf};

use serde::{Serialize, Serializer};
use thiserror::Error;

use crate::atomic::WriteError;
use crate::image_file::ImageFileError;
use crate::table::TableError;

/// Why a dataset could not be created, read or extended.
#[derive(Debug, Error)]
pub enum DatasetError {
    /// The folder holds no manifest of ours.
    #[error("{} is not a dataset: it holds no dataset.json written by daic", root.display())]
    NotADataset {
        /// The folder.
        root: PathBuf,
    },
    /// The folder holds other files, which are not to be touched.
    #[error("folder {} is not empty and is not a dataset; choose an empty or new one", root.display())]
    NotEmpty {
        /// The folder.
        root: PathBuf,
    },
    /// The folder holds a dataset that is not to be replaced.
    #[error("folder {} already holds a dataset; choose another one or ask to replace it", root.display())]
    AlreadyThere {
        /// The folder.
        root: PathBuf,
    },
    /// The folder holds a dataset of another kind than the one that may be replaced.
    #[error(
        "folder {} holds {}, which is not replaced by a {wanted}; choose another folder",
        root.display(),
        kind_of(kind.as_deref())
    )]
    OtherKind {
        /// The folder.
        root: PathBuf,
        /// Kind of the dataset in it; `None` for a plain recording.
        kind: Option<String>,
        /// Kind that may be replaced.
        wanted: &'static str,
    },
    /// The folder has a `dataset.json` that cannot be read, so it may be anybody's.
    #[error(
        "folder {} is not replaced, for it is not sure to be a dataset of daic ({reason}); \
         choose another folder, or remove this one yourself",
        root.display()
    )]
    NotReplaced {
        /// The folder.
        root: PathBuf,
        /// What is wrong with the manifest.
        reason: String,
    },
    /// Written by a newer program.
    #[error(
        "dataset {} has format version {version}, this program reads up to {}; use a newer daic",
        root.display(),
        super::FORMAT_VERSION
    )]
    NewerFormat {
        /// The folder.
        root: PathBuf,
        /// Its version.
        version: u64,
    },
    /// The manifest cannot be read.
    #[error("{}, line {line}, column {column}: {reason}", path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// What is wrong, with the field.
        reason: String,
    },
    /// A line of a journal cannot be read, and it is not the last, torn one.
    #[error("{}, line {line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: u64,
        /// What is wrong, with the field.
        reason: String,
    },
    /// A line of the edges is not `tick,word`.
    #[error("{}, line {line}: an edge is two whole numbers, `tick,word`", path.display())]
    Edge {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: u64,
    },
    /// A frame's file name leads out of the dataset.
    #[error("{}, line {line}, field `file`: `{file}` does not lie inside the dataset", path.display())]
    FrameFile {
        /// The journal.
        path: PathBuf,
        /// Line, from 1; 0 if not known.
        line: u64,
        /// The name.
        file: String,
    },
    /// A frame id that is already recorded.
    #[error("frame {id} is already recorded")]
    DuplicateFrame {
        /// The id.
        id: u64,
    },
    /// A frame id that is not recorded.
    #[error("frame {id} is not recorded")]
    UnknownFrame {
        /// The id.
        id: u64,
    },
    /// A frame that never came has no image.
    #[error("frame {id} has no image: it was expected but never came")]
    NoImage {
        /// The id.
        id: u64,
    },
    /// The file of a recorded frame is missing.
    #[error("frame {id}: its file {} is missing; check that the dataset is complete", file.display())]
    FrameGone {
        /// The id.
        id: u64,
        /// The file.
        file: PathBuf,
    },
    /// The experiment file of the dataset cannot be read.
    #[error("cannot read {}: {source}; check that the dataset is complete", path.display())]
    Experiment {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A value cannot be written as JSON.
    #[error("cannot write {} as JSON: {reason}", path.display())]
    Serialise {
        /// The file.
        path: PathBuf,
        /// What the encoder said.
        reason: String,
    },
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A frame's image failed.
    #[error(transparent)]
    Image(#[from] ImageFileError),
    /// A table failed.
    #[error(transparent)]
    Table(#[from] TableError),
    /// A file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

fn kind_of(kind: Option<&str>) -> String {
    match kind {
        None => "a recorded dataset".into(),
        Some(kind) => format!("a dataset of kind {kind:?}"),
    }
}

impl DatasetError {
    pub(super) fn io(path: &Path, source: io::Error) -> Self {
        DatasetError::Io { path: path.to_path_buf(), source }
    }

    pub(super) fn manifest(path: &Path, error: &serde_json::Error) -> Self {
        DatasetError::Manifest {
            path: path.to_path_buf(),
            line: error.line(),
            column: error.column(),
            reason: error.to_string(),
        }
    }

    pub(super) fn line(path: &Path, line: u64, reason: &dyn std::fmt::Display) -> Self {
        DatasetError::Line { path: path.to_path_buf(), line, reason: reason.to_string() }
    }
}

/// Damage that does not hinder reading the rest; a program using the dataset must say it.
/// Serialised as the sentence that [`std::fmt::Display`] gives.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Damage {
    /// The last line of a journal is incomplete: the recording was interrupted while writing it.
    #[error("{}, line {line}: torn by an interrupted recording, {bytes} bytes dropped", path.display())]
    TornLine {
        /// The journal.
        path: PathBuf,
        /// Line, from 1.
        line: u64,
        /// Its bytes.
        bytes: u64,
    },
    /// A journal is missing.
    #[error("{} is missing; check that the dataset is complete", path.display())]
    JournalGone {
        /// The journal.
        path: PathBuf,
    },
    /// A recorded image is missing.
    #[error(
        "frame {id}: its file {} is missing; the frame is left out; restore the file to measure it",
        file.display()
    )]
    FrameFileGone {
        /// The frame.
        id: u64,
        /// The file.
        file: PathBuf,
    },
    /// Event numbers jump: events were lost, or recorded twice.
    #[error("event {expected} should follow but {found} does")]
    EventGap {
        /// Number that should follow.
        expected: u32,
        /// Number that does.
        found: u32,
    },
}

impl Serialize for Damage {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}
