//! Measures the correlation; `cargo xtask bench correlate` runs it and writes docs/performance.md.
//!
//! ```text
//! bench render   --size N --out DIR       writes ref.png and def.png, an analytic speckle pair
//! bench speed    REF DEF [settings]       a cold run, then warm ones with everything kept
//! bench threads  REF DEF [settings]       wall time of one thread beside that of two
//! bench memory   REF DEF [settings]       peak of resident memory over three frames
//! bench accuracy DIR [settings]           errors on a folder of images with known fields
//!
//! settings: --subset 33 --step 5 --shape translation|affine|quadratic --solver auto|dense|exact
//!           --margin 40 --threads 1 --repeats 5 --cases all|few --csv DIR
//! ```
//! One JSON object per line on the standard output.

mod accuracy;
mod clock;
mod pictures;
#[path = "../../tests/common/score.rs"]
mod score;
mod speed;

use daic_correlate::*;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The command line: positions and `--name value` pairs.
struct Arguments {
    positions: Vec<String>,
    options: Vec<(String, String)>,
}

impl Arguments {
    fn read() -> Result<Self, String> {
        let mut all = std::env::args().skip(1);
        let (mut positions, mut options) = (Vec::new(), Vec::new());
        while let Some(a) = all.next() {
            match a.strip_prefix("--") {
                Some(name) => {
                    let value = all.next().ok_or_else(|| format!("--{name} needs a value"))?;
                    options.push((name.to_owned(), value));
                }
                None => positions.push(a),
            }
        }
        Ok(Self { positions, options })
    }

    fn text<'a>(&'a self, name: &str, default: &'a str) -> &'a str {
        self.options.iter().rev().find(|(n, _)| n == name).map_or(default, |(_, v)| v)
    }

    fn number(&self, name: &str, default: usize) -> Result<usize, String> {
        let text = self.text(name, "");
        if text.is_empty() {
            return Ok(default);
        }
        text.parse().map_err(|_| format!("--{name} {text}: not a whole number"))
    }

    fn path(&self, k: usize) -> Result<&Path, String> {
        self.positions.get(k).map(Path::new).ok_or_else(|| "a path is missing".into())
    }

    fn work(&self) -> Result<Work, String> {
        let choice = |name: &str, default: &str| Value::String(self.text(name, default).to_owned());
        let settings = Settings {
            subset: self.number("subset", 33)?,
            shape: serde_json::from_value(choice("shape", "affine")).map_err(|e| format!("--shape: {e}"))?,
            solver: serde_json::from_value(choice("solver", "auto")).map_err(|e| format!("--solver: {e}"))?,
            ..Settings::default()
        };
        settings.validate().map_err(|e| e.to_string())?;
        Ok(Work {
            settings,
            step: self.number("step", 5)?,
            margin: self.number("margin", 40)?,
            threads: self.number("threads", 1)?,
            repeats: self.number("repeats", 5)?,
        })
    }
}

/// What is correlated, and how often.
#[derive(Clone)]
struct Work {
    settings: Settings,
    step: usize,
    margin: usize,
    threads: usize,
    repeats: usize,
}

impl Work {
    /// Subset centres `margin` pixels clear of the image's edge.
    fn grid(&self, width: usize, height: usize) -> Result<Points, String> {
        let inner = |n: usize| n.saturating_sub(2 * self.margin);
        let rectangle =
            Rectangle { x: self.margin, y: self.margin, width: inner(width), height: inner(height) };
        let roi = Roi { rectangle: Some(rectangle), mask: None };
        Points::grid(width, height, self.settings.subset, self.step, &roi).map_err(|e| e.to_string())
    }

    fn pool(&self, threads: usize) -> Result<rayon::ThreadPool, String> {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(|e| e.to_string())
    }
}

fn run() -> Result<(), String> {
    let arguments = Arguments::read()?;
    let pair = || Ok::<_, String>((pictures::read(arguments.path(1)?)?, pictures::read(arguments.path(2)?)?));
    match arguments.positions.first().map_or("", String::as_str) {
        "render" => {
            let out = PathBuf::from(arguments.text("out", "."));
            pictures::write_pair(arguments.number("size", 1024)?, &out)
        }
        "speed" => {
            let (a, b) = pair()?;
            println!("{}", speed::speed(&arguments.work()?, &a, &b)?);
            Ok(())
        }
        "threads" => {
            let (a, b) = pair()?;
            println!("{}", speed::threads(&arguments.work()?, &a, &b)?);
            Ok(())
        }
        "memory" => {
            let (a, b) = pair()?;
            println!("{}", speed::memory(&arguments.work()?, &a, &b)?);
            Ok(())
        }
        "accuracy" => {
            let csv = arguments.text("csv", "");
            let csv = (!csv.is_empty()).then(|| PathBuf::from(csv));
            let few = arguments.text("cases", "all") == "few";
            accuracy::all(&arguments.work()?, arguments.path(1)?, few, csv.as_deref())
        }
        other => Err(format!("no measurement `{other}`: render, speed, threads, memory or accuracy")),
    }
}

fn main() -> std::process::ExitCode {
    match run() {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("bench: {error}");
            std::process::ExitCode::FAILURE
        }
    }
}
