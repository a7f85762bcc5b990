//! The one entry for people and CI: `cargo xtask test | lint | figures | bench`.
//!
//! Every step runs even when an earlier one failed, and the end names what passed, what failed
//! and what could not be run on this machine, with the reason.

mod steps;

use std::process::ExitCode;

const USAGE: &str = "\
cargo xtask COMMAND

  test       everything that proves the project: unit, property and whole-chain tests, the
             firmware for thumbv6m-none-eabi (brings its toolchain into target/), the examples
  lint       formatting, clippy, documentation without warnings, cargo-deny where installed
  ci         test, then lint
  figures    draws the pictures of README and docs anew with the program itself
  bench      prints the speed of correlation and rendering on this machine
";

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let command = arguments.next().unwrap_or_default();
    if let Some(extra) = arguments.next() {
        eprintln!("xtask: `{extra}` was not expected\n\n{USAGE}");
        return ExitCode::from(2);
    }
    let report = match command.as_str() {
        "test" => steps::test(),
        "lint" => steps::lint(),
        "ci" => {
            let mut report = steps::test();
            report.append(steps::lint());
            report
        }
        "figures" => steps::figures(),
        "bench" => steps::bench(),
        "" | "help" | "--help" | "-h" => {
            print!("{USAGE}");
            return ExitCode::SUCCESS;
        }
        other => {
            eprintln!("xtask: no command `{other}`\n\n{USAGE}");
            return ExitCode::from(2);
        }
    };
    report.print();
    if report.failed() { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}
