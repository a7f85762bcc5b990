//! Frames per second from pixels in memory to height maps.

use super::{Findings, example};
use crate::steps::root;
use std::path::Path;
use std::process::Command;

/// One run: subset shape, threads, frames per second.
pub struct Live {
    pub shape: &'static str,
    pub threads: usize,
    pub frames_per_second: f64,
    /// The last frame's line.
    pub frame: String,
}

/// Matches both views of two golden frames in turn; 59 × 59, step 5.
pub fn measure(golden: &Path, findings: &mut Findings) -> Result<(), String> {
    let program = example("live", &["--release", "-p", "daic"])?;
    let frames = ["flat.png", "flat_up.png"].map(|f| golden.join("../daic").join(f));
    for shape in ["affine", "quadratic"] {
        for threads in [1, 2] {
            let output = Command::new(&program)
                .arg(root().join("examples/golden-macro.toml"))
                .args([shape, &threads.to_string(), "21"])
                .args(&frames)
                .output()
                .map_err(|e| format!("{}: {e}", program.display()))?;
            let text = String::from_utf8_lossy(&output.stdout);
            let last = text.lines().rfind(|l| l.starts_with("frame")).unwrap_or_default().to_owned();
            let rate = text
                .lines()
                .find_map(|l| l.strip_prefix("median ")?.split(' ').next()?.parse().ok())
                .ok_or_else(|| {
                    format!("{}: {}", program.display(), String::from_utf8_lossy(&output.stderr))
                })?;
            findings.live.push(Live { shape, threads, frames_per_second: rate, frame: last });
        }
    }
    Ok(())
}
