//! The steps behind the commands.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// What became of one step.
pub enum Outcome {
    /// It did what it should.
    Passed,
    /// It did not, and why.
    Failed(String),
    /// It could not be run here, and why.
    NotRun(String),
}

/// Steps in the order they ran.
#[derive(Default)]
pub struct Report(Vec<(String, Outcome, Duration)>);

impl Report {
    pub fn append(&mut self, mut other: Report) {
        self.0.append(&mut other.0);
    }

    pub fn failed(&self) -> bool {
        self.0.iter().any(|(_, outcome, _)| matches!(outcome, Outcome::Failed(_)))
    }

    /// Whether the last two steps did what they should.
    pub fn last_two_passed(&self) -> bool {
        self.0.iter().rev().take(2).all(|(_, outcome, _)| matches!(outcome, Outcome::Passed))
    }

    pub fn print(&self) {
        println!("\nsummary");
        for (name, outcome, took) in &self.0 {
            let seconds = took.as_secs_f64();
            match outcome {
                Outcome::Passed => println!("  passed   {name} ({seconds:.0} s)"),
                Outcome::Failed(why) => println!("  FAILED   {name} ({seconds:.0} s): {why}"),
                Outcome::NotRun(why) => println!("  NOT RUN  {name}: {why}"),
            }
        }
    }

    pub fn step(&mut self, name: &str, run: impl FnOnce() -> Outcome) {
        println!("\n=== {name}");
        let start = Instant::now();
        let outcome = run();
        self.0.push((name.to_owned(), outcome, start.elapsed()));
    }
}

pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new(".")).to_owned()
}

pub fn cargo(arguments: &[&str]) -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.args(arguments).current_dir(root());
    command
}

fn outcome_of(mut command: Command) -> Outcome {
    match command.status() {
        Ok(status) if status.success() => Outcome::Passed,
        Ok(status) => Outcome::Failed(status.to_string()),
        Err(error) => Outcome::Failed(format!("{command:?} did not start: {error}")),
    }
}

pub fn test() -> Report {
    let mut report = Report::default();
    report.step("tests of the workspace", || outcome_of(cargo(&["test", "--workspace", "--locked"])));
    report.step("the tour of the examples", tour);
    report.step("distortion map of a simulated target", || {
        distortion_map(&root().join("target/line-target"), "480x360", Profile::Debug)
    });
    crate::hil::pico(&mut report, &["--target", "pico"]);
    report.step("instruction counts of the correlation (callgrind)", || crate::bench::guard::guard(false));
    report.step("data of others", || {
        let shared = std::env::var_os("DAIC_SHARED").map_or_else(|| root().join("../shared"), PathBuf::from);
        if shared.join("golden").is_dir() && shared.join("data").is_dir() {
            Outcome::Passed
        } else {
            Outcome::NotRun(format!(
                "no golden/ and data/ in {}: the tests against golden answers and real images printed SKIPPED; set DAIC_SHARED to where they are",
                shared.display()
            ))
        }
    });
    report
}

/// Where programs are built.
#[derive(Clone, Copy)]
enum Profile {
    Debug,
    Release,
}

/// Builds programs of `daic`, with the features of the whole workspace, so that nothing is built twice; gives their folder.
fn programs(profile: Profile, names: &[&str]) -> Result<PathBuf, Outcome> {
    let mut build = cargo(&["build", "--locked", "--workspace"]);
    let folder = match profile {
        Profile::Debug => "debug",
        Profile::Release => {
            build.arg("--release");
            "release"
        }
    };
    match outcome_of({
        build.args(names);
        build
    }) {
        Outcome::Passed => {
            let target =
                std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from);
            Ok(target.join(folder))
        }
        failed => Err(failed),
    }
}

/// Commands that plan, calibrate, align and decode, on simulated inputs, and their answers against the truth.
fn tour() -> Outcome {
    let built = match programs(Profile::Debug, &["--bin", "daic", "--example", "rehearsal"]) {
        Ok(built) => built,
        Err(failed) => return failed,
    };
    let mut command = Command::new("bash");
    command.arg(root().join("examples/tour.sh")).arg(built.join("../tour"));
    command.env("DAIC", built.join("daic")).env("REHEARSAL", built.join("examples/rehearsal"));
    outcome_of(command)
}

/// `daic calibrate distortion` on the images that the example writes; the results are in `folder`/map.
fn distortion_map(folder: &Path, size: &str, profile: Profile) -> Outcome {
    let built = match programs(profile, &["--bin", "daic", "--example", "line_target"]) {
        Ok(built) => built,
        Err(failed) => return failed,
    };
    let mut images = Command::new(built.join("examples/line_target"));
    images.arg(folder).arg(size);
    match outcome_of(images) {
        Outcome::Passed => {}
        failed => return failed,
    }
    let mut calibrate = Command::new(built.join("daic"));
    calibrate.args(["calibrate", "distortion"]);
    calibrate.args(["along_x.png", "along_y.png"].map(|name| folder.join(name)));
    calibrate.arg("--out").arg(folder.join("map"));
    outcome_of(calibrate)
}

pub fn lint() -> Report {
    let mut report = Report::default();
    report.step("formatting", || outcome_of(cargo(&["fmt", "--all", "--check"])));
    report.step("formatting of the Pico's program", || {
        let mut command = cargo(&["fmt", "--check", "--manifest-path"]);
        command.arg(root().join("firmware/boards/pico/Cargo.toml"));
        outcome_of(command)
    });
    report.step("clippy", || {
        outcome_of(cargo(&["clippy", "--workspace", "--all-targets", "--locked", "--", "-D", "warnings"]))
    });
    report.step("clippy of the kernel benchmarks", || {
        let arguments = ["clippy", "-p", "daic-correlate", "--features", "bench", "--benches", "--locked"];
        let mut command = cargo(&arguments);
        command.args(["--", "-D", "warnings"]);
        outcome_of(command)
    });
    report.step("documentation", || {
        let mut command = cargo(&["doc", "--workspace", "--no-deps", "--locked"]);
        command.env("RUSTDOCFLAGS", "-D warnings");
        outcome_of(command)
    });
    report.step("licences, sources and bans (cargo-deny)", || match cargo(&["deny", "--version"]).output() {
        Ok(output) if output.status.success() => {
            outcome_of(cargo(&["deny", "--offline", "check", "licenses", "bans", "sources"]))
        }
        _ => Outcome::NotRun("cargo-deny is not installed (`cargo install cargo-deny`)".into()),
    });
    report
}

/// Figures of README and docs, each from the demo's own results.
const FIGURES: [&str; 6] = ["views", "surface", "h_mm", "u_mm", "w_mm", "timing"];

pub fn figures() -> Report {
    let mut report = Report::default();
    let out = root().join("target/figures-demo");
    report.step("the demo", || {
        let mut command =
            cargo(&["run", "--release", "--locked", "--package", "daic", "--", "demo", "--out"]);
        command.arg(&out);
        outcome_of(command)
    });
    report.step("figures into docs/figures", || {
        let to = root().join("docs/figures");
        let copy = |name: &str| {
            let file = format!("{name}.svg");
            std::fs::copy(out.join("results/figures").join(&file), to.join(&file)).map(|_| ())
        };
        match std::fs::create_dir_all(&to).and_then(|()| FIGURES.iter().try_for_each(|name| copy(name))) {
            Ok(()) => Outcome::Passed,
            Err(error) => Outcome::Failed(error.to_string()),
        }
    });
    report.step("a program of the trigger box into docs/figures", || {
        let mut command =
            cargo(&["run", "--release", "--locked", "--package", "daic", "--", "rig", "timeline"]);
        command.arg(root().join("examples/strobe.json")).arg("--out");
        command.arg(root().join("docs/figures/strobe.svg"));
        outcome_of(command)
    });
    report.step("a distortion map into docs/figures", || {
        let folder = root().join("target/figures-target");
        match distortion_map(&folder, "2592x1944", Profile::Release) {
            Outcome::Passed => {}
            failed => return failed,
        }
        let copy = |name: &str| {
            let to = root().join(format!("docs/figures/distortion-{name}.svg"));
            std::fs::copy(folder.join(format!("map/{name}.svg")), to).map(|_| ())
        };
        match ["e_x", "e_y", "left_x"].into_iter().try_for_each(copy) {
            Ok(()) => Outcome::Passed,
            Err(error) => Outcome::Failed(error.to_string()),
        }
    });
    report.step("accuracy of the correlation into docs/figures", || {
        let mut command = cargo(&[
            "run",
            "--release",
            "--locked",
            "--package",
            "daic-correlate",
            "--example",
            "figures",
            "--",
        ]);
        command.arg(root().join("docs/figures"));
        outcome_of(command)
    });
    report
}

/// The Monte-Carlo of the uncertainties that is too long for every day.
pub fn coverage() -> Report {
    let mut report = Report::default();
    report.step("coverage of the stated uncertainties, 2 000 calibrations", || {
        let arguments = ["test", "--release", "--locked", "--package", "daic", "--test", "coverage", "--"];
        let mut command = cargo(&arguments);
        command.args(["--ignored", "--nocapture"]);
        outcome_of(command)
    });
    report
}

/// A chapter of the thesis into docs/reproduction.md.
pub fn reproduce(chapter: &str) -> Report {
    let mut report = Report::default();
    report.step(&format!("reproduction of the thesis: {chapter}"), || {
        let program =
            ["run", "--release", "--locked", "--package", "daic-tests", "--example", "reproduce", "--"];
        let mut command = cargo(&program);
        command.arg(chapter).arg(root().join("docs"));
        outcome_of(command)
    });
    report
}

/// Speed of the optics.
pub fn bench_optics() -> Report {
    let mut report = Report::default();
    report.step("speed of the optics", || {
        outcome_of(cargo(&[
            "run",
            "--release",
            "--locked",
            "--package",
            "daic-optics",
            "--example",
            "decode_speed",
        ]))
    });
    report
}
