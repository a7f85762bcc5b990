//! Hardware in the loop: the emulated Pico, and a board at a port.

use crate::steps::{Outcome, Report, cargo, root};
use crate::{datasheet, firmware};
use std::path::PathBuf;
use std::process::Command;

/// As pip takes it.
const PIO_EMULATOR: &str = "rp2040-pio-emulator==0.88.0";

/// Directory of the emulator's sources.
fn sources() -> PathBuf {
    root().join("hil-sim/emulator")
}

/// Where its packages are installed.
fn modules() -> PathBuf {
    root().join("target/emulator/node_modules")
}

/// Installs exactly what the lock file names into `target/emulator`.
fn install() -> Outcome {
    if Command::new("node").arg("--version").output().is_err() {
        return Outcome::NotRun("node is not installed (Node.js 20 or newer)".into());
    }
    let to = root().join("target/emulator");
    let lock = std::fs::read(sources().join("package-lock.json"));
    let same = |name: &str| std::fs::read(to.join(name)).ok() == std::fs::read(sources().join(name)).ok();
    if lock.is_ok() && same("package-lock.json") && modules().join("rp2040js/package.json").exists() {
        return Outcome::Passed;
    }
    if let Err(error) = std::fs::create_dir_all(&to) {
        return Outcome::Failed(error.to_string());
    }
    for name in ["package.json", "package-lock.json"] {
        if let Err(error) = std::fs::copy(sources().join(name), to.join(name)) {
            return Outcome::Failed(format!("{name}: {error}"));
        }
    }
    let mut npm = Command::new("npm");
    npm.args(["ci", "--no-audit", "--no-fund", "--ignore-scripts"]).current_dir(&to);
    match npm.status() {
        Ok(status) if status.success() => Outcome::Passed,
        Ok(status) => Outcome::NotRun(format!("npm could not bring rp2040js: {status}")),
        Err(error) => Outcome::NotRun(format!("npm did not start: {error}")),
    }
}

fn emulator_tests() -> Outcome {
    let mut node = Command::new("node");
    node.arg("--test").arg(sources().join("test.mjs")).env("DAIC_EMULATOR_MODULES", modules());
    match node.status() {
        Ok(status) if status.success() => Outcome::Passed,
        Ok(status) => Outcome::Failed(status.to_string()),
        Err(error) => Outcome::NotRun(format!("node did not start: {error}")),
    }
}

/// The PIO programs in an emulator that shares no code with the other, from PyPI, in `target/pio-check`.
fn pio_check() -> Outcome {
    let place = root().join("target/pio-check");
    let python = place.join("bin/python");
    let run = |mut command: Command, what: &str| match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{what}: {status}")),
        Err(error) => Err(format!("{what} did not start: {error}")),
    };
    let prepare = || {
        if place.join(PIO_EMULATOR).exists() {
            return Ok(());
        }
        let mut venv = Command::new("python3");
        venv.args(["-m", "venv"]).arg(&place);
        run(venv, "python3 -m venv")?;
        let mut pip = Command::new(&python);
        pip.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", PIO_EMULATOR]);
        run(pip, "pip")?;
        std::fs::write(place.join(PIO_EMULATOR), "").map_err(|error| error.to_string())
    };
    if let Err(why) = prepare() {
        return Outcome::NotRun(format!("the second PIO emulator could not be had: {why}"));
    }
    let mut check = Command::new(&python);
    check.arg(sources().join("pio_check.py"));
    for program in ["player.rs", "inputs.rs"] {
        check.arg(root().join("firmware/boards/pico/src").join(program));
    }
    run(check, "pio_check.py").map_or_else(Outcome::Failed, |()| Outcome::Passed)
}

/// The image in the emulator with both links on TCP, until it is interrupted.
pub fn serve() -> Report {
    let mut report = Report::default();
    report.step("firmware for the Pico", firmware::build);
    report.step("emulator of the Pico: packages", install);
    if report.last_two_passed() {
        report.step("emulated Pico: `daic rig --port tcp://127.0.0.1:PORT info`, end with Ctrl-C", || {
            let mut node = Command::new("node");
            node.arg(sources().join("main.mjs")).arg(firmware::elf());
            node.args(["--uart", "0", "--usb", "0"]).env("DAIC_EMULATOR_MODULES", modules());
            match node.status() {
                Ok(status) if status.success() => Outcome::Passed,
                Ok(status) => Outcome::Failed(status.to_string()),
                Err(error) => Outcome::NotRun(format!("node did not start: {error}")),
            }
        });
    }
    report
}

fn cases(arguments: &[&str]) -> Outcome {
    let mut command = cargo(&["run", "--quiet", "--locked", "--package", "daic-tests", "--bin", "hil", "--"]);
    command.args(arguments).arg("--numbers").arg(datasheet::numbers());
    command.env("DAIC_PICO_ELF", firmware::elf()).env("DAIC_EMULATOR_MODULES", modules());
    match command.status() {
        Ok(status) if status.success() => Outcome::Passed,
        Ok(status) => Outcome::Failed(status.to_string()),
        Err(error) => Outcome::Failed(format!("cargo did not start: {error}")),
    }
}

/// The image, the emulator with its own tests, and the cases on the emulated Pico.
pub fn pico(report: &mut Report, arguments: &[&str]) {
    report.step("firmware for the Pico", firmware::build);
    report.step("emulator of the Pico: packages", install);
    if report.last_two_passed() {
        report.step("emulator of the Pico: its own tests", emulator_tests);
        if arguments.contains(&"--long") {
            report.step("PIO programs in a second emulator", pio_check);
        }
        report.step("hardware in the loop: emulated Pico", || cases(arguments));
        if arguments == ["--target", "pico"] {
            report.step("numbers of docs/datasheet.md", datasheet::check);
        }
    } else {
        let why = "needs the image and the emulator above";
        report.step("hardware in the loop: emulated Pico", || Outcome::NotRun(why.into()));
    }
}

/// `cargo xtask hil`.
pub fn hil(arguments: &[&str]) -> Report {
    let mut report = Report::default();
    let value = |name: &str| arguments.iter().position(|a| *a == name).and_then(|i| arguments.get(i + 1));
    let target = value("--target").copied();
    if target == Some("pico") {
        pico(&mut report, arguments);
    } else if target.is_some() || value("--port").is_some() {
        report.step("hardware in the loop", || cases(arguments));
    } else {
        for target in ["inprocess", "pty"] {
            let with: Vec<&str> = arguments.iter().copied().chain(["--target", target]).collect();
            report.step(&format!("hardware in the loop: {target}"), || cases(&with));
        }
        let with: Vec<&str> = arguments.iter().copied().chain(["--target", "pico"]).collect();
        pico(&mut report, &with);
    }
    report
}

/// `cargo xtask datasheet`.
pub fn datasheet() -> Report {
    let mut report = Report::default();
    // Another argument than in a test: what is written is not compared.
    pico(&mut report, &["--target", "pico", "--filter", ""]);
    report.step("numbers into docs/datasheet.md", datasheet::write);
    report
}
