//! `cargo xtask bench correlate`: speed, memory and errors of the correlation beside those of pyvale,
//! in one run, written to docs/performance.md.

pub mod guard;
mod kernels;
pub mod lightfield;
mod live;
mod measure;
mod page;
mod pyvale;

use crate::steps::{Outcome, Report, cargo, root};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// How much is measured.
#[derive(Clone, Copy)]
pub struct Extent {
    /// Rounds of all speed measurements, ours and pyvale's in turn.
    rounds: usize,
    /// Sizes of the rendered images.
    sizes: &'static [usize],
    /// Few cases of accuracy, no kernels, pyvale's first row alone.
    quick: bool,
}

const FULL: Extent = Extent { rounds: 3, sizes: &[1024, 2048, 4096, 8192], quick: false };
const QUICK: Extent = Extent { rounds: 1, sizes: &[1024, 2048], quick: true };

/// Everything that one run of the benchmark found; what could not be measured is empty, with a
/// remark.
#[derive(Default)]
pub struct Findings {
    /// Images of the speed rows: golden or rendered.
    source: String,
    /// Row → lines of the speed program, one per round.
    speed: Vec<(measure::Row, Vec<Value>)>,
    pyvale: Vec<pyvale::Result>,
    threads: Vec<Value>,
    sizes: Vec<Value>,
    memory: Option<measure::Memory>,
    accuracy: Vec<Value>,
    /// pyvale's points, as score.py sees them.
    peer_scores: Vec<Value>,
    kernels: Vec<kernels::Kernel>,
    live: Vec<live::Live>,
    /// What was not measured, and why.
    remarks: Vec<String>,
}

/// Where measured things are kept: rendered images, results, the environment of pyvale.
fn folder() -> PathBuf {
    root().join("target/bench-correlate")
}

/// Runs a program and reads the JSON objects of its standard output.
fn lines(command: &mut Command) -> Result<Vec<Value>, String> {
    let output = command
        .stderr(std::process::Stdio::inherit())
        .output()
        .map_err(|e| format!("{command:?} did not start: {e}"))?;
    if !output.status.success() {
        return Err(format!("{command:?}: {}", output.status));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    text.lines()
        .filter(|l| l.starts_with('{'))
        .map(|l| serde_json::from_str(l).map_err(|e| format!("{command:?} printed `{l}`: {e}")))
        .collect()
}

/// Python of an environment in `folder` that holds one version of a package and what it needs `with`; made where
/// `import` does not work there.
fn environment(
    folder: &Path,
    package: &str,
    version: &str,
    with: &[&str],
    import: &str,
) -> Result<PathBuf, String> {
    let dir = folder.join(format!("{package}-{version}"));
    let python = dir.join(if cfg!(windows) { "Scripts/python.exe" } else { "bin/python" });
    let works = || Command::new(&python).args(["-c", import]).output().is_ok_and(|o| o.status.success());
    if works() {
        return Ok(python);
    }
    println!("making {}", dir.display());
    let run = |command: &mut Command| match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{command:?}: {status}")),
        Err(error) => Err(format!("{command:?} did not start: {error}")),
    };
    run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&dir))?;
    let wanted = format!("{package}=={version}");
    run(Command::new(&python).args(["-m", "pip", "install", "--quiet"]).args(with).arg(&wanted))?;
    if works() {
        Ok(python)
    } else {
        Err(format!("{package} {version} was installed but cannot be imported"))
    }
}

/// Folder with the golden images, where it is there.
fn golden() -> Option<PathBuf> {
    let shared = std::env::var_os("DAIC_SHARED").map_or_else(|| root().join("../shared"), PathBuf::from);
    let dir = shared.join("golden/dic");
    dir.is_dir().then_some(dir)
}

/// Path of an example of daic-correlate built in the given profile; the build prints its progress.
fn example(name: &str, arguments: &[&str]) -> Result<PathBuf, String> {
    let mut build = cargo(&["build", "--locked", "--message-format", "json-render-diagnostics"]);
    build.args(arguments).args(["--example", name]);
    let built = lines(&mut build)?;
    built
        .iter()
        .filter(|m| m["target"]["name"] == name)
        .find_map(|m| m["executable"].as_str().map(PathBuf::from))
        .ok_or_else(|| format!("cargo named no program for the example `{name}`"))
}

/// Writes a file whole or not at all.
fn replace(path: &Path, text: &str) -> std::io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    std::fs::write(&part, text)?;
    std::fs::rename(&part, path)
}

/// Sections of a page that other commands write, from the first marker on.
fn sections(path: &Path) -> String {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    text.find("<!-- section ").map_or(String::new(), |at| format!("\n{}", &text[at..]))
}

/// Replaces the section of a page between its markers, or adds it at the end.
fn replace_section(path: &Path, name: &str, text: &str) -> Result<(), String> {
    let (begin, end) = (format!("<!-- section {name} -->"), format!("<!-- end {name} -->"));
    let mut page = std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let section = format!("{begin}\n\n{}\n\n{end}\n", text.trim());
    match (page.find(&begin), page.find(&end)) {
        (Some(from), Some(to)) if from < to => page.replace_range(from..to + end.len() + 1, &section),
        _ => page = format!("{}\n\n{section}", page.trim_end()),
    }
    replace(path, &page).map_err(|e| format!("{}: {e}", path.display()))
}

/// The whole benchmark.
pub fn correlate(quick: bool) -> Report {
    let extent = if quick { QUICK } else { FULL };
    let mut report = Report::default();
    let mut findings = Findings::default();
    let mut program = None;
    report.step("benchmark program", || match example("bench", &["--release", "-p", "daic-correlate"]) {
        Ok(path) => {
            program = Some(path);
            Outcome::Passed
        }
        Err(error) => Outcome::Failed(error),
    });
    let Some(program) = program else {
        return report;
    };
    let mut peer = None;
    report.step("pyvale in its own environment", || match pyvale::environment() {
        Ok(python) => {
            peer = Some(python);
            Outcome::Passed
        }
        Err(why) => {
            findings.remarks.push(format!("pyvale was not measured: {why}"));
            Outcome::NotRun(why)
        }
    });
    let measurement = measure::Measurement { program: &program, extent, golden: golden() };
    report.step("speed, ours and pyvale's in turn", || {
        outcome(measurement.speed(peer.as_deref(), &mut findings))
    });
    report.step("two threads beside one", || outcome(measurement.threads(&mut findings)));
    report.step("sizes of the image", || outcome(measurement.sizes(&mut findings)));
    report.step("memory", || outcome(measurement.memory(&mut findings)));
    report.step("live: two views to height maps", || match &measurement.golden {
        Some(dir) => outcome(live::measure(dir, &mut findings)),
        None => {
            let why = "no golden frames (set DAIC_SHARED to where golden/ is)".to_owned();
            findings.remarks.push(format!("live was not measured: {why}"));
            Outcome::NotRun(why)
        }
    });
    report.step("errors on known fields", || match &measurement.golden {
        Some(dir) => outcome(measurement.accuracy(dir, peer.as_deref(), &mut findings)),
        None => {
            let why = "no golden images (set DAIC_SHARED to where golden/ is)".to_owned();
            findings.remarks.push(format!("errors were not measured: {why}"));
            Outcome::NotRun(why)
        }
    });
    if extent.quick {
        findings.remarks.push("a quick run: one round, few cases, no kernels".into());
    } else {
        report.step("kernels", || outcome(kernels::measure(&mut findings)));
    }
    report.step("docs/performance.md", || {
        let page = page::write(&findings);
        let path = if quick { folder().join("performance.md") } else { root().join("docs/performance.md") };
        println!("{page}");
        let kept = sections(&path);
        outcome(replace(&path, &(page + &kept)).map_err(|e| format!("{}: {e}", path.display())))
    });
    report
}

fn outcome(result: Result<(), String>) -> Outcome {
    match result {
        Ok(()) => Outcome::Passed,
        Err(why) => Outcome::Failed(why),
    }
}
