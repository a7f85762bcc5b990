//! The one entry for people and CI: `cargo xtask test | lint | firmware | hil | figures | reproduce | bench`.
//!
//! Every step runs even when an earlier one failed, and the end names what passed, what failed
//! and what could not be run on this machine, with the reason.

mod bench;
mod campaign;
mod datasheet;
mod firmware;
mod hil;
mod steps;

use std::process::ExitCode;

const USAGE: &str = "\
cargo xtask COMMAND

  test       everything that proves the project: unit, property and whole-chain tests,
             the Pico's image (brings its toolchain into target/) and the cases on it in an emulator
  firmware   the Pico's image as ELF and UF2, in target/firmware/
  hil        [--target inprocess|pty|pico] [--port PORT] [--long] [--filter TEXT]: the same cases on the
             controller, on the simulated board, on the emulated Pico, on the board at PORT
             --serve: the emulated Pico on TCP, for `daic rig` and the like
             --faults N: N more runs of the fault campaign; totals in docs/campaigns/faults.json
             --verifier [--long]: 10 000 (1 000 000 more) random programs through the verifier
  lint       formatting, clippy, documentation without warnings, cargo-deny where installed
  ci         test, then lint
  datasheet  measures on the emulated Pico and writes the numbers into docs/datasheet.md
  figures    draws the pictures of README and docs anew with the program itself
  coverage   2 000 simulated calibrations: what the stated uncertainties cover (minutes)
  reproduce  macro: chapter 2 of the thesis, micro: chapter 3, lightfield: chapter 4 (a quarter of an
             hour; an interrupted run goes on), simulated and measured, into docs/reproduction.md
  fuzz       [--long]: each fuzz target for a minute (an hour); needs a nightly compiler and cargo-fuzz
  bench      correlate [--quick]: speed, memory and errors beside pyvale, into docs/performance.md
             optics: speed of the decoders
             lightfield: speed and memory beside pyolaf, into docs/performance.md
             guard [--update]: instruction counts against the baseline (or: makes a new one)
";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let report = match words[..] {
        ["test"] => steps::test(),
        ["lint"] => steps::lint(),
        ["ci"] => {
            let mut report = steps::test();
            report.append(steps::lint());
            report
        }
        ["firmware"] => {
            let mut report = steps::Report::default();
            report.step("firmware for the Pico", firmware::build);
            report
        }
        ["datasheet"] => hil::datasheet(),
        ["figures"] => steps::figures(),
        ["coverage"] => steps::coverage(),
        ["reproduce", chapter @ ("macro" | "micro" | "lightfield")] => steps::reproduce(chapter),
        ["hil", "--faults", count] if count.parse::<u64>().is_ok() => {
            campaign::faults(count.parse().unwrap_or(0))
        }
        ["hil", "--verifier"] => campaign::verifier(),
        ["hil", "--verifier", "--long"] => campaign::verifier_long(100),
        ["hil", "--serve"] => hil::serve(),
        ["hil", ..] => hil::hil(&words[1..]),
        ["fuzz"] => campaign::fuzz(60),
        ["fuzz", "--long"] => campaign::fuzz(3600),
        ["bench", "correlate"] => bench::correlate(false),
        ["bench", "correlate", "--quick"] => bench::correlate(true),
        ["bench", "lightfield"] => bench::lightfield::lightfield(),
        ["bench", "optics"] => steps::bench_optics(),
        ["bench", "guard"] => bench::guard::step(false),
        ["bench", "guard", "--update"] => bench::guard::step(true),
        [] | ["help" | "--help" | "-h"] => {
            print!("{USAGE}");
            return ExitCode::SUCCESS;
        }
        _ => {
            eprintln!("xtask: no command `{}`\n\n{USAGE}", words.join(" "));
            return ExitCode::from(2);
        }
    };
    report.print();
    if report.failed() { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}
