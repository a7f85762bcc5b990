//! Runs the hardware-in-the-loop cases: `hil --target inprocess|pty|pico [--port PORT] [--long] [--filter TEXT]`.
//!
//! `pico` needs `DAIC_PICO_ELF` (the image) and `DAIC_EMULATOR_MODULES` (rp2040js); `cargo xtask hil`
//! provides both.

use daic_tests::hil::emulator::Emulator;
use daic_tests::hil::inprocess::InProcess;
use daic_tests::hil::serial::Serial;
use daic_tests::hil::{Outcome, Target, run};
use daic_tests::shared::root;
use std::path::PathBuf;
use std::process::ExitCode;

fn pico() -> Result<Box<dyn Target>, String> {
    let path = |name: &str| std::env::var_os(name).map(PathBuf::from).ok_or(format!("{name} is not set"));
    let (elf, modules) = (path("DAIC_PICO_ELF")?, path("DAIC_EMULATOR_MODULES")?);
    Ok(Box::new(Emulator::start(&root().join("hil-sim/emulator"), &modules, &elf)?))
}

fn targets(names: &[String], port: Option<&str>) -> Result<Vec<Box<dyn Target>>, String> {
    let mut targets: Vec<Box<dyn Target>> = Vec::new();
    for name in names {
        targets.push(match name.as_str() {
            "inprocess" => Box::new(InProcess::default()),
            "pty" => Box::new(Serial::simulated()?),
            "pico" => pico()?,
            other => return Err(format!("no target `{other}`: inprocess, pty, pico")),
        });
    }
    if let Some(port) = port {
        targets.push(Box::new(Serial::real(port)?));
    }
    Ok(targets)
}

/// What the cases measured, as [case, what, value, unit].
fn write_numbers(file: &str, outcomes: &[(&str, Outcome)]) -> std::io::Result<()> {
    let mut rows = Vec::new();
    for (case, outcome) in outcomes {
        if let Outcome::Passed(numbers) = outcome {
            rows.extend(numbers.iter().map(|(what, value, unit)| (case, what, value, unit)));
        }
    }
    let beside = format!("{file}.new");
    std::fs::write(&beside, serde_json::to_string(&rows)?)?;
    std::fs::rename(&beside, file)
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let values = |name: &str| -> Vec<String> {
        let pairs = arguments.windows(2).filter(|pair| pair[0] == name);
        pairs.map(|pair| pair[1].clone()).collect()
    };
    let port = values("--port").pop();
    let mut names = values("--target");
    if names.is_empty() && port.is_none() {
        names = ["inprocess", "pty", "pico"].map(str::to_owned).to_vec();
    }
    let long = arguments.iter().any(|argument| argument == "--long");
    let filter = values("--filter").pop().unwrap_or_default();
    let targets = match targets(&names, port.as_deref()) {
        Ok(targets) => targets,
        Err(error) => {
            eprintln!("hil: {error}");
            return ExitCode::from(2);
        }
    };
    let mut failed = 0;
    for target in targets {
        let outcomes = run(target, long, &filter);
        if let Some(file) = values("--numbers").pop()
            && let Err(error) = write_numbers(&file, &outcomes)
        {
            eprintln!("hil: {file}: {error}");
            return ExitCode::from(2);
        }
        failed += outcomes.iter().filter(|(_, outcome)| matches!(outcome, Outcome::Failed(_))).count();
    }
    if failed > 0 {
        eprintln!("hil: {failed} cases failed");
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}
