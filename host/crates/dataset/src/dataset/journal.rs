//! Files of one JSON object per line that grow while a recording runs.

use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::error::{Damage, DatasetError};

/// A journal open for appending.
#[derive(Debug)]
pub(super) struct Journal {
    path: PathBuf,
    file: File,
}

impl Journal {
    /// Opens or makes the journal. What a crash left after the last line feed is removed if it is
    /// no complete record, completed by a line feed if it is one.
    pub(super) fn append_to(path: &Path) -> Result<Self, DatasetError> {
        let io = |source| DatasetError::io(path, source);
        let old = match fs::read(path) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == ErrorKind::NotFound => Vec::new(),
            Err(source) => return Err(io(source)),
        };
        let whole = old.iter().rposition(|&b| b == b'\n').map_or(0, |at| at + 1);
        let mut file = OpenOptions::new().create(true).append(true).open(path).map_err(io)?;
        if whole < old.len() {
            if serde_json::from_slice::<serde_json::Value>(&old[whole..]).is_ok_and(|v| v.is_object()) {
                file.write_all(b"\n").map_err(io)?;
            } else {
                file.set_len(whole as u64).map_err(io)?;
            }
        }
        Ok(Journal { path: path.to_path_buf(), file })
    }

    /// Appends records with a single write, so that a crash tears at most the tail.
    pub(super) fn append<T: Serialize>(&mut self, records: &[T]) -> Result<(), DatasetError> {
        let mut lines = Vec::new();
        for record in records {
            serde_json::to_writer(&mut lines, record)
                .map_err(|e| DatasetError::Serialise { path: self.path.clone(), reason: e.to_string() })?;
            lines.push(b'\n');
        }
        self.file.write_all(&lines).map_err(|source| DatasetError::io(&self.path, source))
    }

    pub(super) fn sync(&self) -> Result<(), DatasetError> {
        self.file.sync_all().map_err(|source| DatasetError::io(&self.path, source))
    }
}

/// Reads a journal as (line from 1, record). Only the last line may be unreadable, and only if it
/// lacks its line feed or is followed by nothing: that is what a crash leaves.
#[allow(clippy::type_complexity)]
pub(super) fn read<T: DeserializeOwned>(path: &Path) -> Result<(Vec<(u64, T)>, Vec<Damage>), DatasetError> {
    let bytes = match fs::read(path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == ErrorKind::NotFound => {
            return Ok((Vec::new(), vec![Damage::JournalGone { path: path.to_path_buf() }]));
        }
        Err(source) => return Err(DatasetError::io(path, source)),
    };
    let mut records = Vec::new();
    let mut damage = Vec::new();
    let mut lines = bytes.split_inclusive(|&b| b == b'\n').zip(1u64..).peekable();
    while let Some((line, number)) = lines.next() {
        if line.trim_ascii().is_empty() {
            continue;
        }
        match serde_json::from_slice(line) {
            Ok(record) => records.push((number, record)),
            Err(_) if lines.peek().is_none() && !line.ends_with(b"\n") => {
                damage.push(Damage::TornLine {
                    path: path.to_path_buf(),
                    line: number,
                    bytes: line.len() as u64,
                });
            }
            Err(e) => return Err(DatasetError::line(path, number, &e)),
        }
    }
    Ok((records, damage))
}
