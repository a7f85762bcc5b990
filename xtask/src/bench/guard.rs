//! Instruction counts of a small fixed correlation under callgrind, against a committed baseline.
//!
//! Counts do not depend on how busy the machine is. Valgrind shows programs an AVX2 machine whatever
//! the real one is, so that every x86-64 runs the same kernels; the compiler must be the same one.

use super::{example, replace};
use crate::steps::{Outcome, Report, root};
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Growth of a count beyond which the guard fails.
const TOLERANCE: f64 = 0.03;

/// What is counted; `nothing` (start of the process, making the images) is taken off the others.
const WORKS: [&str; 5] = ["prepare", "exact-affine", "exact-quadratic", "dense-affine", "search"];

fn baseline_path() -> PathBuf {
    root().join("xtask/callgrind.json")
}

fn rustc() -> String {
    let output = Command::new("rustc").arg("-V").output();
    output.map(|o| String::from_utf8_lossy(&o.stdout).trim().to_owned()).unwrap_or_default()
}

/// Instructions of one run, and the SIMD level it used.
fn count(program: &Path, work: &str) -> Result<(f64, String), String> {
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(program)
        .arg(work)
        .output()
        .map_err(|e| format!("valgrind did not start: {e}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        return Err(format!("`{work}` under valgrind: {}\n{said}", output.status));
    }
    let collected = said
        .lines()
        .find_map(|l| l.split("Collected :").nth(1)?.trim().parse().ok())
        .ok_or_else(|| format!("callgrind told no count:\n{said}"))?;
    Ok((collected, String::from_utf8_lossy(&output.stdout).trim().to_owned()))
}

fn counts(program: &Path) -> Result<Value, String> {
    let (nothing, simd) = count(program, "nothing")?;
    let mut counts = Map::new();
    for work in WORKS {
        let (n, _) = count(program, work)?;
        counts.insert(work.to_owned(), json!(n - nothing));
    }
    Ok(json!({ "rustc": rustc(), "simd": simd, "profile": "dev", "instructions": counts }))
}

/// The guard as a report of its own.
pub fn step(update: bool) -> Report {
    let mut report = Report::default();
    report.step("instruction counts of the correlation (callgrind)", || guard(update));
    report
}

/// Counts and compares; writes the baseline anew where asked.
pub fn guard(update: bool) -> Outcome {
    if !Command::new("valgrind").arg("--version").output().is_ok_and(|o| o.status.success()) {
        return Outcome::NotRun("valgrind is not installed: instruction counts were not compared".into());
    }
    // as the tests of the workspace build it, so that nothing is built twice
    let now = match example("guard", &["--workspace"]).and_then(|program| counts(&program)) {
        Ok(now) => now,
        Err(error) => return Outcome::Failed(error),
    };
    let text = format!("{now:#}\n");
    print!("{text}");
    let path = baseline_path();
    if update {
        return match replace(&path, &text) {
            Ok(()) => Outcome::Passed,
            Err(error) => Outcome::Failed(format!("{}: {error}", path.display())),
        };
    }
    let Ok(text) = std::fs::read_to_string(&path) else {
        return Outcome::NotRun(format!(
            "instruction counts were NOT COMPARED: there is no baseline {}; `cargo xtask bench guard --update` makes one",
            path.display()
        ));
    };
    let baseline: Value = match serde_json::from_str(&text) {
        Ok(baseline) => baseline,
        Err(error) => return Outcome::Failed(format!("{}: {error}", path.display())),
    };
    for what in ["rustc", "simd"] {
        if baseline[what] != now[what] {
            return Outcome::NotRun(format!(
                "instruction counts were NOT COMPARED: the baseline is of {what} {}, this is {}; `cargo xtask bench guard --update` makes a new one",
                baseline[what], now[what]
            ));
        }
    }
    compare(&baseline, &now)
}

fn compare(baseline: &Value, now: &Value) -> Outcome {
    let mut grown = Vec::new();
    for work in WORKS {
        let (Some(old), Some(new)) =
            (baseline["instructions"][work].as_f64(), now["instructions"][work].as_f64())
        else {
            return Outcome::Failed(format!("the baseline has no count for `{work}`"));
        };
        let change = new / old - 1.0;
        println!("  {work}: {old:.0} -> {new:.0} ({:+.1} %)", 100.0 * change);
        if change > TOLERANCE {
            grown.push(format!("{work} takes {:+.1} % instructions", 100.0 * change));
        } else if change < -TOLERANCE {
            println!("  {work} has become cheaper: `cargo xtask bench guard --update` keeps it so");
        }
    }
    if grown.is_empty() { Outcome::Passed } else { Outcome::Failed(grown.join("; ")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(scale: f64) -> Value {
        let counts: Map<String, Value> =
            WORKS.iter().map(|w| ((*w).to_owned(), json!(1e6 * scale))).collect();
        json!({ "instructions": counts })
    }

    #[test]
    fn growth_fails_and_savings_pass() {
        assert!(matches!(compare(&of(1.0), &of(1.04)), Outcome::Failed(_)));
        assert!(matches!(compare(&of(1.0), &of(1.02)), Outcome::Passed));
        assert!(matches!(compare(&of(1.0), &of(0.5)), Outcome::Passed));
        assert!(matches!(compare(&json!({}), &of(1.0)), Outcome::Failed(_)));
    }
}
