//! The kernels by themselves: criterion's results, the vector form beside the scalar reference.

use super::{Findings, folder};
use crate::steps::cargo;
use serde_json::Value;
use std::path::Path;

/// Medians in nanoseconds.
pub struct Kernel {
    pub name: String,
    pub simd: Option<f64>,
    pub scalar: Option<f64>,
}

pub fn measure(findings: &mut Findings) -> Result<(), String> {
    let home = folder().join("criterion");
    // results of kernels that no longer exist must not come back
    let _ = std::fs::remove_dir_all(&home);
    let mut command =
        cargo(&["bench", "--locked", "-p", "daic-correlate", "--features", "bench", "--bench", "kernels"]);
    command.env("CRITERION_HOME", &home);
    match command.status() {
        Ok(status) if status.success() => {}
        Ok(status) => return Err(status.to_string()),
        Err(error) => return Err(format!("{command:?} did not start: {error}")),
    }
    let mut names: Vec<String> = std::fs::read_dir(&home)
        .map_err(|e| format!("{}: {e}", home.display()))?
        .flatten()
        .filter(|d| d.path().is_dir())
        .map(|d| d.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    for name in names {
        let median = |form: &str| median(&home.join(&name).join(form).join("new/estimates.json"));
        let (simd, scalar) = (median("simd"), median("scalar"));
        if simd.is_some() || scalar.is_some() {
            findings.kernels.push(Kernel { name, simd, scalar });
        }
    }
    if findings.kernels.is_empty() { Err("criterion left no results".into()) } else { Ok(()) }
}

fn median(path: &Path) -> Option<f64> {
    let text = std::fs::read_to_string(path).ok()?;
    let value: Value = serde_json::from_str(&text).ok()?;
    value["median"]["point_estimate"].as_f64()
}
