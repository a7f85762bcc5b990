//! Results of one frame, and whether they still belong to the present settings and inputs.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crc::{CRC_64_XZ, Crc};
use serde::{Deserialize, Serialize};

use super::{Dataset, DatasetError, RESULTS, to_json};
use crate::atomic;

const CRC: Crc<u64> = Crc::<u64>::new(&CRC_64_XZ);
const DONE: &str = "done.json";

#[derive(Serialize, Deserialize)]
struct Done {
    key: String,
    /// Length in bytes of every result file, by name.
    files: BTreeMap<String, u64>,
}

/// A key over everything a result depends on: program version, settings (as JSON) and the content
/// of the input files, each with its length, by CRC-64/XZ. It guards against stale results, not
/// against forgery.
///
/// # Errors
/// [`DatasetError::Io`] for an unreadable input, [`DatasetError::Serialise`] for settings that
/// have no JSON form.
pub fn result_key(
    program_version: &str,
    settings: &impl Serialize,
    inputs: &[PathBuf],
) -> Result<String, DatasetError> {
    let mut digest = CRC.digest();
    let mut part = |bytes: &[u8]| {
        digest.update(&(bytes.len() as u64).to_le_bytes());
        digest.update(bytes);
    };
    part(program_version.as_bytes());
    part(&to_json(settings, Path::new("settings"))?);
    for path in inputs {
        part(&fs::read(path).map_err(|source| DatasetError::io(path, source))?);
    }
    Ok(format!("{:016x}", digest.finalize()))
}

impl Dataset {
    /// Folder for the results of a frame.
    #[must_use]
    pub fn frame_results(&self, id: u64) -> PathBuf {
        self.root.join(RESULTS).join(format!("{id:06}"))
    }

    /// Whether the results of a frame belong to this key and are complete: every file that was
    /// there when they were marked done is there, with its length. Anything unreadable counts as
    /// not done.
    #[must_use]
    pub fn is_done(&self, id: u64, key: &str) -> bool {
        let dir = self.frame_results(id);
        let done = fs::read(dir.join(DONE)).ok().and_then(|b| serde_json::from_slice::<Done>(&b).ok());
        let (Some(done), Ok(present)) = (done, file_lengths(&dir)) else { return false };
        done.key == key && done.files.iter().all(|(name, length)| present.get(name) == Some(length))
    }

    /// Empties the folder of a frame's results and makes it anew; call before computing.
    ///
    /// # Errors
    /// [`DatasetError::Io`], naming the folder.
    pub fn begin_results(&self, id: u64) -> Result<PathBuf, DatasetError> {
        let dir = self.frame_results(id);
        super::remove(fs::remove_file(dir.join(DONE)), &dir.join(DONE))?;
        super::remove(fs::remove_dir_all(&dir), &dir)?;
        fs::create_dir_all(&dir).map_err(|source| DatasetError::io(&dir, source))?;
        Ok(dir)
    }

    /// States that the results of a frame are complete, the files as they now are in its folder;
    /// call last.
    ///
    /// # Errors
    /// [`DatasetError::Io`] or [`DatasetError::Write`], naming folder or file.
    pub fn mark_done(&self, id: u64, key: &str) -> Result<(), DatasetError> {
        let dir = self.frame_results(id);
        let files = file_lengths(&dir).map_err(|source| DatasetError::io(&dir, source))?;
        let path = dir.join(DONE);
        Ok(atomic::write_bytes_synced(&path, &to_json(&Done { key: key.into(), files }, &path)?)?)
    }
}

/// Length of every file of a folder of results, by name, but for the mark itself. Folders in it
/// are not looked into: results are flat.
fn file_lengths(dir: &Path) -> io::Result<BTreeMap<String, u64>> {
    let mut lengths = BTreeMap::new();
    for entry in fs::read_dir(dir)? {
        let entry = entry?;
        let data = fs::metadata(entry.path())?;
        let name = entry.file_name();
        if data.is_file() && name != DONE {
            lengths.insert(name.to_string_lossy().into_owned(), data.len());
        }
    }
    Ok(lengths)
}
