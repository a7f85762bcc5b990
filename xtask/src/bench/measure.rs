//! The measurements, each by a fresh process of the benchmark program.

use super::{Extent, Findings, folder, lines, pyvale};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A row of the table of speeds.
#[derive(Clone, Copy)]
pub struct Row {
    pub title: &'static str,
    pub solver: &'static str,
    pub subset: usize,
    pub shape: &'static str,
    /// Points per processor second that must be reached, warm.
    pub target: f64,
    /// The same for the first run of a process.
    pub target_cold: Option<f64>,
    /// What is aimed at.
    pub aim: f64,
}

const fn row(
    title: &'static str,
    solver: &'static str,
    (subset, shape): (usize, &'static str),
    (target, aim): (f64, f64),
) -> Row {
    Row { title, solver, subset, shape, target, target_cold: None, aim }
}

pub const ROWS: [Row; 5] = [
    row("exact, 33×33 affine", "exact", (33, "affine"), (80e3, 150e3)),
    row("exact, 33×33 quadratic", "exact", (33, "quadratic"), (25e3, 60e3)),
    Row { target_cold: Some(400e3), ..row("dense, 33×33 affine", "auto", (33, "affine"), (600e3, 1200e3)) },
    row("dense, 59×59 affine", "auto", (59, "affine"), (350e3, 800e3)),
    row("dense, 33×33 quadratic", "auto", (33, "quadratic"), (150e3, 400e3)),
];

/// Bytes that a run adds: `pixel` for each pixel of one image, `point` for each point.
pub struct Memory {
    pub pixel: f64,
    pub point: f64,
    pub size: u64,
    pub points: [u64; 2],
    /// Added bytes of the two runs.
    pub added: [f64; 2],
    /// Growth from the first to the third frame, bytes.
    pub growth: [f64; 2],
    /// The peak could be reset after decoding.
    pub reset: bool,
}

pub struct Measurement<'a> {
    pub program: &'a Path,
    pub extent: Extent,
    pub golden: Option<PathBuf>,
}

impl Measurement<'_> {
    fn run(&self, what: &str, paths: &[PathBuf], options: &[(&str, &str)]) -> Result<Vec<Value>, String> {
        let mut command = Command::new(self.program);
        command.arg(what).args(paths);
        for (name, value) in options {
            command.arg(format!("--{name}")).arg(value);
        }
        let lines = lines(&mut command)?;
        lines.iter().for_each(|l| println!("{l}"));
        Ok(lines)
    }

    fn one(&self, what: &str, paths: &[PathBuf], options: &[(&str, &str)]) -> Result<Value, String> {
        self.run(what, paths, options)?.pop().ok_or_else(|| format!("`{what}` printed nothing"))
    }

    /// A rendered pair, made where it is not there yet.
    fn rendered(&self, size: usize) -> Result<[PathBuf; 2], String> {
        let dir = folder().join(format!("images-{size}"));
        let pair = [dir.join("ref.png"), dir.join("def.png")];
        if !pair.iter().all(|p| p.is_file()) {
            self.run("render", &[], &[("size", &size.to_string()), ("out", &dir.to_string_lossy())])?;
        }
        Ok(pair)
    }

    /// The pair of the speed rows for a shape function, and the name of its field.
    fn pair(&self, shape: &str) -> Result<([PathBuf; 2], &'static str), String> {
        let Some(dir) = &self.golden else {
            return Ok((self.rendered(1024)?, "rendered"));
        };
        let field = if shape == "quadratic" { "quad" } else { "aff1" };
        let file = |name: &str| dir.join(format!("s1024_n0_{name}.png"));
        Ok(([file("ref"), file(field)], field))
    }

    pub fn speed(&self, python: Option<&Path>, findings: &mut Findings) -> Result<(), String> {
        findings.source = match self.golden {
            Some(_) => "golden pairs of 1024² pixels, quantised only: `aff1` for affine subsets, `quad` for quadratic ones".into(),
            None => "a rendered pair of 1024² pixels under an affine field (the golden images are not on this machine)".into(),
        };
        findings.speed = ROWS.map(|r| (r, Vec::new())).into();
        for round in 0..self.extent.rounds {
            for (row, found) in &mut findings.speed {
                let (pair, _) = self.pair(row.shape)?;
                let subset = row.subset.to_string();
                let options =
                    [("solver", row.solver), ("subset", &subset), ("shape", row.shape), ("repeats", "7")];
                found.push(self.one("speed", &pair, &options)?);
            }
            let Some(python) = python else { continue };
            // the first row every time, between our own; the slow ones once
            let peers: &[(usize, &'static str)] = match (self.extent.quick, round) {
                (false, 0) => &[(33, "affine"), (33, "quadratic"), (59, "affine")],
                _ => &[(33, "affine")],
            };
            for &(subset, shape) in peers {
                let (pair, field) = self.pair(shape)?;
                let new = pyvale::run(python, &pair, (field, subset, shape), 1)?;
                println!("pyvale {subset} {shape}: {} points in {:?} s", new.points, new.cpu);
                match findings.pyvale.iter_mut().find(|p| (p.subset, p.shape) == (subset, shape)) {
                    Some(old) => {
                        old.cpu.extend(new.cpu);
                        old.wall.extend(new.wall);
                    }
                    None => findings.pyvale.push(new),
                }
            }
        }
        Ok(())
    }

    pub fn threads(&self, findings: &mut Findings) -> Result<(), String> {
        let (pair, _) = self.pair("affine")?;
        for solver in ["exact", "auto"] {
            let line = self.one("threads", &pair, &[("solver", solver), ("repeats", "9")])?;
            if line["identical"] != true {
                return Err(format!("{solver}: one and two threads gave different results"));
            }
            findings.threads.push(line);
        }
        Ok(())
    }

    pub fn sizes(&self, findings: &mut Findings) -> Result<(), String> {
        for &size in self.extent.sizes {
            let pair = self.rendered(size)?;
            for solver in ["exact", "auto"] {
                // millions of points by the exact form would take a minute a run
                let repeats = match (solver, size) {
                    ("exact", 4096..) => "1",
                    ("auto", 4096..) => "3",
                    _ => "5",
                };
                findings.sizes.push(self.one("speed", &pair, &[("solver", solver), ("repeats", repeats)])?);
            }
        }
        Ok(())
    }

    /// Two runs on images of one size with different steps tell apart what belongs to the pixels
    /// and what to the points.
    pub fn memory(&self, findings: &mut Findings) -> Result<(), String> {
        let size = 2048;
        let pair = self.rendered(size)?;
        let mut runs = Vec::new();
        for step in ["3", "12"] {
            runs.push(self.one("memory", &pair, &[("step", step), ("margin", "24")])?);
        }
        let number = |v: &Value| v.as_f64().ok_or("a number is missing");
        let mut added = [0.0; 2];
        let mut growth = [0.0; 2];
        let mut points = [0; 2];
        for (k, run) in runs.iter().enumerate() {
            let peaks = run["peaks"].as_array().cloned().unwrap_or_default();
            let peak = |i: usize| peaks.get(i).and_then(Value::as_f64).ok_or("no peak was told");
            added[k] = peak(2)? - number(&run["before"])?;
            growth[k] = peak(2)? - peak(0)?;
            points[k] = run["points"].as_u64().ok_or("no points")?;
        }
        let point = (added[0] - added[1]) / (points[0] - points[1]) as f64;
        let pixel = (added[1] - point * points[1] as f64) / (size * size) as f64;
        let reset = runs.iter().all(|r| r["reset"] == true);
        println!("{}", json!({ "bytes_per_pixel": pixel, "bytes_per_point": point }));
        findings.memory = Some(Memory { pixel, point, size: size as u64, points, added, growth, reset });
        Ok(())
    }

    /// Errors of both solvers, checked with the independent scoring program; and pyvale's.
    pub fn accuracy(&self, dir: &Path, python: Option<&Path>, findings: &mut Findings) -> Result<(), String> {
        let out = folder().join("points");
        std::fs::create_dir_all(&out).map_err(|e| format!("{}: {e}", out.display()))?;
        let cases = if self.extent.quick { "few" } else { "all" };
        for solver in ["exact", "auto"] {
            let options = [("solver", solver), ("cases", cases), ("csv", &out.to_string_lossy())];
            findings.accuracy.extend(self.run("accuracy", &[dir.to_owned()], &options)?);
        }
        let program = dir.join("score.py");
        let mut unchecked = None;
        for line in findings.accuracy.iter_mut().filter(|l| l["csv"].is_string()) {
            match scored(python, &program, line) {
                Ok(true) => line["checked"] = json!(true),
                Ok(false) => return Err(format!("score.py disagrees with {line}")),
                Err(why) => unchecked = Some(why),
            }
        }
        if let Some(why) = unchecked {
            println!("NOT CHECKED by score.py: {why}");
            findings.remarks.push(format!("the scores were not checked by score.py: {why}"));
        }
        let Some(python) = python.filter(|_| !self.extent.quick) else {
            return Ok(());
        };
        for noise in ["n0", "n2"] {
            let pair = ["ref", "t02"].map(|f| dir.join(format!("s1024_{noise}_{f}.png")));
            let field = format!("{noise}_t02");
            let run = pyvale::run(python, &pair, (&field, 33, "affine"), 1)?;
            let answer = score(Some(python), &program, &format!("s1024_{field}"), &run.csv)?;
            println!("pyvale: {answer}");
            findings.peer_scores.push(answer);
        }
        Ok(())
    }
}

/// What score.py says of a file of points.
fn score(python: Option<&Path>, program: &Path, case: &str, csv: &Path) -> Result<Value, String> {
    // pyvale's environment has NumPy
    let mut command = Command::new(python.unwrap_or(Path::new("python3")));
    command.arg(program).arg(case).arg(csv);
    lines(&mut command)?.pop().ok_or_else(|| "score.py printed nothing".into())
}

/// Whether score.py finds the same numbers in the same points.
fn scored(python: Option<&Path>, program: &Path, line: &Value) -> Result<bool, String> {
    let text = |k: &str| line[k].as_str().unwrap_or_default();
    let case = format!("s1024_{}_{}", text("noise"), text("field"));
    let answer = score(python, program, &case, Path::new(text("csv")))?;
    // it rounds to six decimals
    let near = |a: &Value, b: &Value| match (a.as_f64(), b.as_f64()) {
        (Some(a), Some(b)) => (a - b).abs() <= 1.1e-6,
        _ => false,
    };
    Ok(line["ok"] == answer["ok"]
        && line["outliers"] == answer["outliers"]
        && near(&line["bias"][0], &answer["bias_u"])
        && near(&line["bias"][1], &answer["bias_v"])
        && near(&line["scatter"][0], &answer["std_u"])
        && near(&line["scatter"][1], &answer["std_v"])
        && (line["period"].is_null() || near(&line["period"], &answer["period_at_10pct_bias"])))
}
