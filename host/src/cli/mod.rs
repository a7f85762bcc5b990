//! Flags, progress and the shape of answers.

mod align;
mod arguments;
mod calibrate;
mod calibrate_distortion;
mod calibrate_rig;
mod camera;
mod commands;
mod lightfield;
mod microscope;
mod output;
mod plan;
mod rig;
mod strain;
mod surface;

use arguments::{Cli, Command};
use clap::Parser as _;
use daic::Error;
use output::Output;
use std::process::ExitCode;

/// Parses the arguments, runs the command, prints its one answer.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            // help and version are answers, everything else an error; with --json also in that form
            if error.use_stderr() && std::env::args().any(|argument| argument == "--json") {
                let text = error.render().to_string();
                output::print_line(&serde_json::json!({ "error": text.trim(), "exit_code": 2 }).to_string());
            }
            error.print().ok();
            return ExitCode::from(if error.use_stderr() { 2 } else { 0 });
        }
    };
    let output = Output::new(cli.json, cli.quiet);
    output.install_error_style();
    match with_threads(cli.threads, || run(&cli.command, &output)) {
        Ok(answer) => {
            let code = answer.exit_code();
            output.answer(&answer);
            ExitCode::from(code)
        }
        Err(error) => {
            output.error(&error);
            ExitCode::from(error.exit_code())
        }
    }
}

fn run(command: &Command, output: &Output) -> Result<output::Answer, Error> {
    match command {
        #[cfg(feature = "sim")]
        Command::Demo(arguments) => commands::demo(arguments, output),
        #[cfg(feature = "sim")]
        Command::Simulate(arguments) => commands::simulate(arguments, output),
        Command::Run(arguments) => commands::run(arguments, output),
        Command::Process(arguments) => commands::process(arguments, output),
        Command::Correlate(arguments) => commands::correlate(arguments, output),
        Command::Strain(arguments) => strain::strain(arguments, output),
        Command::Probe(arguments) => strain::probe(arguments),
        Command::NoiseFloor(arguments) => strain::noise_floor(arguments, output),
        Command::Phase(arguments) => commands::phase(arguments, output),
        Command::Decode(arguments) => surface::decode(arguments),
        Command::Profile(arguments) => surface::profile(arguments, output),
        Command::Displacement(arguments) => surface::displacement(arguments, output),
        Command::Track(arguments) => surface::track(arguments, output),
        Command::Calibrate(arguments) => calibrate::calibrate(arguments, output),
        Command::Lightfield(arguments) => lightfield::lightfield(arguments, output),
        Command::Plan(arguments) => plan::plan(arguments),
        Command::Align(arguments) => align::align(arguments, output),
        Command::Init(arguments) => commands::init(arguments),
        Command::Schema => commands::schema(),
        Command::Doctor(arguments) => commands::doctor(arguments),
        Command::Rig(arguments) => rig::run(arguments, output),
    }
}

/// Runs `work` in a pool of `threads` threads (all cores by default). Results do not depend on it.
fn with_threads<T: Send>(
    threads: Option<u16>,
    work: impl FnOnce() -> Result<T, Error> + Send,
) -> Result<T, Error> {
    let Some(threads) = threads else { return work() };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(usize::from(threads))
        .build()
        .map_err(|error| Error::Threads { threads: usize::from(threads), reason: error.to_string() })?;
    pool.install(work)
}
