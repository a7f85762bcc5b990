//! Long campaigns, in blocks of seeds; each block's numbers are added to a file in `docs/`, from which the next
//! call goes on.

use crate::steps::{Outcome, Report, cargo, root};
use serde_json::{Map, Value, json};
use std::process::Command;

/// Seeds per block.
const BLOCK: u64 = 1000;

fn commit() -> String {
    let output = Command::new("git").args(["rev-parse", "--short=12", "HEAD"]).current_dir(root()).output();
    output.map_or_else(|_| "unknown".to_owned(), |o| String::from_utf8_lossy(&o.stdout).trim().to_owned())
}

/// Adds every number of `block` to that of `totals`, below the same names.
fn add(totals: &mut Map<String, Value>, block: &Map<String, Value>) {
    for (name, value) in block {
        match value {
            Value::Object(inner) => {
                let entry = totals.entry(name.clone()).or_insert_with(|| json!({}));
                if let Value::Object(sum) = entry {
                    add(sum, inner);
                }
            }
            Value::Number(number) => {
                let before = totals.get(name).and_then(Value::as_u64).unwrap_or(0);
                totals.insert(name.clone(), json!(before + number.as_u64().unwrap_or(0)));
            }
            _ => {}
        }
    }
}

/// `count` runs of the fault campaign, from where the last call ended.
pub fn faults(count: u64) -> Report {
    let mut report = Report::default();
    report.step(&format!("fault campaign, {count} runs"), || match run_faults(count) {
        Ok(()) => Outcome::Passed,
        Err(why) => Outcome::Failed(why),
    });
    report
}

fn run_faults(count: u64) -> Result<(), String> {
    let file = root().join("docs/campaigns/faults.json");
    let block_file = root().join("target/faults-block.json");
    let fail = |what: &str, error: &dyn std::fmt::Display| format!("{what}: {error}");
    let mut state: Value = match std::fs::read_to_string(&file) {
        Ok(text) => serde_json::from_str(&text).map_err(|e| fail("docs/campaigns/faults.json", &e))?,
        Err(_) => json!({ "next_seed": 1, "totals": {}, "commits": [] }),
    };
    let mut left = count;
    while left > 0 {
        let first = state["next_seed"].as_u64().ok_or("docs/campaigns/faults.json: no next_seed")?;
        let runs = left.min(BLOCK);
        let status = cargo(&[
            "test",
            "--release",
            "--locked",
            "-p",
            "daic-rig",
            "--test",
            "faults",
            "--",
            "whatever",
            "--nocapture",
        ])
        .env("DAIC_FAULTS", runs.to_string())
        .env("DAIC_FAULTS_FIRST", first.to_string())
        .env("DAIC_FAULTS_TOTALS", &block_file)
        .status()
        .map_err(|e| fail("cargo did not start", &e))?;
        if !status.success() {
            return Err(format!("seeds {first} … {}: {status}", first + runs - 1));
        }
        let text = std::fs::read_to_string(&block_file).map_err(|e| fail("no totals", &e))?;
        let block: Value = serde_json::from_str(&text).map_err(|e| fail("totals", &e))?;
        if let (Some(totals), Some(block)) = (state["totals"].as_object_mut(), block.as_object()) {
            add(totals, block);
        }
        state["next_seed"] = json!(first + runs);
        let commit = commit();
        if let Some(commits) = state["commits"].as_array_mut()
            && !commits.iter().any(|c| c == commit.as_str())
        {
            commits.push(json!(commit));
        }
        // Written after each block: an interrupted campaign goes on from here.
        let folder = file.parent().ok_or("no folder")?;
        std::fs::create_dir_all(folder).map_err(|e| fail("docs/campaigns", &e))?;
        let whole = format!("{state:#}\n");
        let part = file.with_extension("part");
        std::fs::write(&part, whole)
            .and_then(|()| std::fs::rename(&part, &file))
            .map_err(|e| fail("docs/campaigns", &e))?;
        left -= runs;
    }
    Ok(())
}

/// `cases` random programs through the verifier and the second player.
pub fn verifier(cases: u64) -> Report {
    let mut report = Report::default();
    report.step(&format!("verifier against a player that unrolls everything, {cases} programs"), || {
        let status = cargo(&[
            "test",
            "--release",
            "--locked",
            "-p",
            "daic-firmware",
            "--test",
            "verifier",
            "--",
            "--nocapture",
        ])
        .env("DAIC_CASES", cases.to_string())
        .status();
        match status {
            Ok(status) if status.success() => Outcome::Passed,
            Ok(status) => Outcome::Failed(status.to_string()),
            Err(error) => Outcome::Failed(error.to_string()),
        }
    });
    report
}
