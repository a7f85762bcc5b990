//! Long campaigns, in blocks of seeds; each block's numbers are added to a file in `docs/`, from which the next
//! call goes on.

use crate::steps::{Outcome, Report, cargo, root};
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;

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

/// A campaign: what a block of it is, and where its totals are kept.
struct Campaign {
    /// Name of the file in `docs/campaigns`, without its ending.
    name: &'static str,
    /// Most units of one block.
    block: u64,
    /// The first seed of all; 0 where units are no seeds.
    first: u64,
}

impl Campaign {
    fn file(&self) -> PathBuf {
        root().join("docs/campaigns").join(self.name).with_extension("json")
    }

    /// Runs `count` more units from where the last call ended; `run` does units `first .. first + n` and writes
    /// their numbers as a JSON object into the file given.
    fn go_on(&self, count: u64, run: impl Fn(u64, u64, &Path) -> Result<(), String>) -> Outcome {
        match self.blocks(count, run) {
            Ok(()) => Outcome::Passed,
            Err(why) => Outcome::Failed(why),
        }
    }

    fn blocks(&self, count: u64, run: impl Fn(u64, u64, &Path) -> Result<(), String>) -> Result<(), String> {
        let file = self.file();
        let named = |error: &dyn std::fmt::Display| format!("{}: {error}", file.display());
        let block_file = root().join("target").join(format!("{}-block.json", self.name));
        let mut state: Value = match std::fs::read_to_string(&file) {
            Ok(text) => serde_json::from_str(&text).map_err(|e| named(&e))?,
            Err(_) => json!({ "totals": {}, "commits": [] }),
        };
        let mut left = count;
        while left > 0 {
            let first = state["next_seed"].as_u64().unwrap_or(self.first);
            let units = left.min(self.block);
            std::fs::remove_file(&block_file).ok();
            run(first, units, &block_file)?;
            let text = std::fs::read_to_string(&block_file).map_err(|e| format!("no totals: {e}"))?;
            let block: Value = serde_json::from_str(&text).map_err(|e| format!("totals: {e}"))?;
            if let (Some(totals), Some(block)) = (state["totals"].as_object_mut(), block.as_object()) {
                add(totals, block);
            }
            if self.first > 0 {
                state["next_seed"] = json!(first + units);
            }
            let commit = commit();
            if let Some(commits) = state["commits"].as_array_mut()
                && !commits.iter().any(|c| c == commit.as_str())
            {
                commits.push(json!(commit));
            }
            // Written after each block: an interrupted campaign goes on from here.
            if let Some(folder) = file.parent() {
                std::fs::create_dir_all(folder).map_err(|e| named(&e))?;
            }
            let part = file.with_extension("part");
            std::fs::write(&part, format!("{state:#}\n"))
                .and_then(|()| std::fs::rename(&part, &file))
                .map_err(|e| named(&e))?;
            left -= units;
        }
        Ok(())
    }
}

fn run(mut command: Command, what: &str) -> Result<(), String> {
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{what}: {status}")),
        Err(error) => Err(format!("{what} did not start: {error}")),
    }
}

fn test_of(package: &str, test: &str, filter: &[&str]) -> Command {
    let mut command = cargo(&["test", "--release", "--locked", "-p", package, "--test", test, "--"]);
    command.args(filter).arg("--nocapture");
    command
}

/// `count` runs of the fault campaign, from where the last call ended.
pub fn faults(count: u64) -> Report {
    let mut report = Report::default();
    let campaign = Campaign { name: "faults", block: 1000, first: 1 };
    report.step(&format!("fault campaign, {count} runs"), || {
        campaign.go_on(count, |first, runs, totals| {
            let mut command = test_of("daic-rig", "faults", &["whatever"]);
            command.env("DAIC_FAULTS", runs.to_string()).env("DAIC_FAULTS_FIRST", first.to_string());
            command.env("DAIC_FAULTS_TOTALS", totals);
            run(command, &format!("seeds {first} … {}", first + runs - 1))
        })
    });
    report
}

/// 10 000 random programs through the verifier and the second player, always the same.
pub fn verifier() -> Report {
    let mut report = Report::default();
    report.step("verifier against a player that unrolls everything, 10 000 programs", || {
        match run(test_of("daic-firmware", "verifier", &[]), "the programs") {
            Ok(()) => Outcome::Passed,
            Err(why) => Outcome::Failed(why),
        }
    });
    report
}

/// `blocks` times 10 000 random programs, from where the last call ended.
pub fn verifier_long(blocks: u64) -> Report {
    let mut report = Report::default();
    let campaign = Campaign { name: "verifier", block: 1, first: 2 };
    report.step(
        &format!("verifier against a player that unrolls everything, {blocks} × 10 000 programs"),
        || {
            campaign.go_on(blocks, |seed, _, totals| {
                let mut command = test_of("daic-firmware", "verifier", &["with_moves_from_any_position"]);
                command.env("DAIC_SEED", seed.to_string()).env("DAIC_TOTALS", totals);
                run(command, &format!("seed {seed}"))
            })
        },
    );
    report
}

/// Fuzz targets of `fuzz/`.
const TARGETS: [&str; 5] = ["framing", "requests", "program", "stream", "flash"];

/// Each fuzz target for so many seconds; the corpora grow, the totals are kept.
pub fn fuzz(seconds: u64) -> Report {
    let mut report = Report::default();
    let there = Command::new("cargo").args(["+nightly", "fuzz", "--version"]).output();
    let there = there.is_ok_and(|output| output.status.success());
    for target in TARGETS {
        report.step(&format!("fuzzing {target} for {seconds} s"), || {
            if !there {
                let way_out = "needs a nightly compiler and `cargo install cargo-fuzz`";
                return Outcome::NotRun(way_out.into());
            }
            let campaign = Campaign { name: "fuzz", block: u64::MAX, first: 0 };
            campaign.go_on(seconds, |_, seconds, totals| fuzz_target(target, seconds, totals))
        });
    }
    report
}

fn fuzz_target(target: &str, seconds: u64, totals: &Path) -> Result<(), String> {
    // What is found goes beside the seeds, which the tests go through one by one, and is kept for the next call.
    let (grown, seeds) = (format!("grown/{target}"), format!("corpus/{target}"));
    std::fs::create_dir_all(root().join("fuzz").join(&grown)).map_err(|e| format!("{grown}: {e}"))?;
    let mut command = Command::new("cargo");
    command.args(["+nightly", "fuzz", "run", "--fuzz-dir", ".", target, &grown, &seeds, "--"]);
    command.current_dir(root().join("fuzz"));
    command.arg(format!("-max_total_time={seconds}")).arg("-print_final_stats=1").arg("-timeout=20");
    let output = command.output().map_err(|e| format!("cargo did not start: {e}"))?;
    let text = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        let end: Vec<&str> = text.lines().rev().take(30).collect();
        return Err(end.into_iter().rev().collect::<Vec<_>>().join("\n"));
    }
    let inputs = text.lines().find_map(|l| l.strip_prefix("stat::number_of_executed_units:"));
    let inputs: u64 = inputs.and_then(|n| n.trim().parse().ok()).ok_or("no number of inputs")?;
    let block = json!({ target: { "inputs": inputs, "seconds": seconds } });
    std::fs::write(totals, format!("{block:#}\n")).map_err(|e| format!("{}: {e}", totals.display()))
}
