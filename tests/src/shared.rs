//! Golden answers and real images that are not part of the project.

use std::path::{Path, PathBuf};

/// The workspace.
pub fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// `relative` among the data of others (`DAIC_SHARED`, else `../shared` beside the project).
///
/// `None`, said aloud with the name of the test, where it is not there.
pub fn shared(test: &str, relative: &str) -> Option<PathBuf> {
    let base = std::env::var_os("DAIC_SHARED").map_or_else(|| root().join("../shared"), PathBuf::from);
    let path = base.join(relative);
    if path.exists() {
        return Some(path);
    }
    eprintln!("SKIPPED {test}: no {relative} in {} (set DAIC_SHARED)", base.display());
    None
}
