//! pyvale from PyPI, pinned, in an environment of its own under target/.

use super::{folder, lines};
use crate::steps::root;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Version compared with.
pub const VERSION: &str = "2026.10.2";

/// What it did on one pair.
pub struct Result {
    pub subset: usize,
    pub shape: &'static str,
    /// Field of the golden pair, or `rendered`.
    pub field: String,
    pub points: u64,
    pub ok: u64,
    pub cpu: Vec<f64>,
    pub wall: Vec<f64>,
    pub csv: PathBuf,
}

/// Python with pyvale; made at the first call. The error says what was missing.
pub fn environment() -> std::result::Result<PathBuf, String> {
    let import = format!("import pyvale; assert pyvale.__version__ == '{VERSION}'");
    super::environment(&folder(), "pyvale", VERSION, &[], &import)
}

/// One process, `repeats` runs in it.
pub fn run(
    python: &Path,
    pair: &[PathBuf; 2],
    (field, subset, shape): (&str, usize, &'static str),
    repeats: usize,
) -> std::result::Result<Result, String> {
    let out = folder().join(format!("pyvale-{field}-{subset}-{shape}"));
    let mut command = Command::new(python);
    command.arg(root().join("xtask/pyvale_dic.py")).args(pair);
    command.args([&subset.to_string(), pyvale_name(shape), &repeats.to_string()]).arg(&out);
    let lines = lines(&mut command)?;
    let last = lines.last().ok_or("pyvale printed nothing")?;
    let all = |name: &str| lines.iter().filter_map(|l| l[name].as_f64()).collect();
    Ok(Result {
        subset,
        shape,
        field: field.to_owned(),
        points: last["points"].as_u64().unwrap_or(0),
        ok: last["ok"].as_u64().unwrap_or(0),
        cpu: all("cpu"),
        wall: all("wall"),
        csv: last["csv"].as_str().map(PathBuf::from).unwrap_or_default(),
    })
}

fn pyvale_name(shape: &str) -> &'static str {
    if shape == "quadratic" { "QUAD" } else { "AFFINE" }
}
