//! Writing a file so that a reader sees the old content or the new one, never half of it.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;
use thiserror::Error;

/// Why a file could not be written.
#[derive(Debug, Error)]
pub enum WriteError {
    /// The path names a folder; nothing was written.
    #[error("{} is a folder; give a file name", path.display())]
    IsFolder {
        /// The path.
        path: PathBuf,
    },
    /// The folder that should hold the file could not be made or written into.
    #[error("cannot create a temporary file in folder {}: {source}", dir.display())]
    Folder {
        /// The folder.
        dir: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Writing the content failed (disk full, quota, device gone); the old file is untouched.
    #[error("cannot write {}: {source}", path.display())]
    Content {
        /// The file that was to be written.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The finished temporary file could not be given its name; the old file is untouched.
    #[error("cannot rename the finished file to {}: {source}", path.display())]
    Rename {
        /// The file that was to be written.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// Replaces `path` by `bytes` in one step, creating the folders above it.
///
/// A crash of the program leaves the old file or the new one. The content is not forced to the
/// disk; use [`write_bytes_synced`] for files that must survive a power failure as well.
///
/// # Errors
/// [`WriteError`], naming the file; the old file is then untouched.
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    replace(path, bytes, false)
}

/// As [`write_bytes`], and waits until the content is on the disk before renaming.
///
/// # Errors
/// [`WriteError`], naming the file; the old file is then untouched.
pub fn write_bytes_synced(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    replace(path, bytes, true)
}

fn replace(path: &Path, bytes: &[u8], sync: bool) -> Result<(), WriteError> {
    if path.is_dir() {
        return Err(WriteError::IsFolder { path: path.to_path_buf() });
    }
    let dir = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let folder = |source| WriteError::Folder { dir: dir.to_path_buf(), source };
    fs::create_dir_all(dir).map_err(folder)?;
    let mut file = temporary_in(dir).map_err(folder)?;
    let content = |source| WriteError::Content { path: path.to_path_buf(), source };
    file.write_all(bytes).map_err(content)?;
    if sync {
        file.as_file().sync_all().map_err(content)?;
    }
    file.persist(path).map_err(|e| WriteError::Rename { path: path.to_path_buf(), source: e.error })?;
    Ok(())
}

/// Temporary files are private (0600) by default; results are to have the permissions that any
/// other file of the user would have.
fn temporary_in(dir: &Path) -> io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".daic-").suffix(".tmp");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(dir)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaces_the_whole_file_and_leaves_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("deep/er/a.bin");
        write_bytes(&path, b"a long first content").unwrap();
        write_bytes_synced(&path, b"short").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"short");
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn a_failed_write_leaves_no_temporary_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("taken");
        fs::create_dir(&path).unwrap();
        fs::write(path.join("x"), b"x").unwrap();
        let error = write_bytes(&path, b"y").unwrap_err();
        assert!(matches!(error, WriteError::IsFolder { .. }), "{error}");
        assert!(error.to_string().ends_with("taken is a folder; give a file name"), "{error}");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        let error = write_bytes(&path.join("x").join("z"), b"y").unwrap_err();
        assert!(matches!(error, WriteError::Folder { .. }), "{error}");
    }

    #[cfg(unix)]
    #[test]
    fn permissions_follow_the_umask() {
        use std::os::unix::fs::PermissionsExt as _;
        let dir = tempfile::tempdir().unwrap();
        let ours = dir.path().join("ours");
        let plain = dir.path().join("plain");
        write_bytes(&ours, b"1").unwrap();
        fs::write(&plain, b"1").unwrap();
        let mode = |p: &Path| fs::metadata(p).unwrap().permissions().mode();
        assert_eq!(mode(&ours), mode(&plain));
    }
}
