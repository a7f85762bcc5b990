//! `cargo xtask bench lightfield`: the light-field reconstruction beside pyolaf from PyPI, in one run, as a
//! section of docs/performance.md.

use super::{lines, outcome, replace_section};
use crate::steps::{Outcome, Report, root};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::Command;

/// Version compared with.
const PYOLAF: &str = "0.2.1";
/// What pyolaf is run with; its own requirements are not pinned.
const WITH: [&str; 3] = ["numpy==2.4.*", "scipy==1.17.*", "setuptools==80.9.0"];

#[derive(Default)]
struct Findings {
    ours: Vec<Value>,
    peer: Vec<Value>,
    remarks: Vec<String>,
}

fn folder() -> PathBuf {
    root().join("target/bench-lightfield")
}

/// Python with pyolaf, made at the first call.
fn environment() -> Result<PathBuf, String> {
    super::environment(&folder(), "pyolaf", PYOLAF, &WITH, "import pyolaf.lf, pyolaf.project")
}

/// The whole benchmark.
pub fn lightfield() -> Report {
    let mut report = Report::default();
    let mut findings = Findings::default();
    let mut program = None;
    report.step("benchmark program", || {
        match super::example("bench", &["--release", "-p", "daic-lightfield"]) {
            Ok(path) => {
                program = Some(path);
                Outcome::Passed
            }
            Err(error) => Outcome::Failed(error),
        }
    });
    let Some(program) = program else { return report };
    let mut peer = None;
    report.step("pyolaf in its own environment", || match environment() {
        Ok(python) => {
            peer = Some(python);
            Outcome::Passed
        }
        Err(why) => {
            findings.remarks.push(format!("pyolaf was not measured: {why}"));
            Outcome::NotRun(why)
        }
    });
    let ours = |what: &str, threads: usize, findings: &mut Findings| {
        let mut command = Command::new(&program);
        command.args([what, &threads.to_string(), "15"]);
        lines(&mut command).map(|l| findings.ours.extend(l))
    };
    // ours before and after the peer: the speed of a virtual machine drifts
    for what in ["psf", "rl", "isra"] {
        report.step(&format!("ours: {what}"), || outcome(ours(what, 1, &mut findings)));
    }
    if let Some(python) = &peer {
        for (name, arguments) in [
            ("the bench problem", ["15", "3", "-20", "20", "2.5", "35", "8"]),
            ("one plane at 75 samples a lenslet", ["75", "3", "20", "20", "2.5", "35", "0"]),
        ] {
            report.step(&format!("pyolaf: {name}"), || {
                let mut command = Command::new(python);
                command.arg(root().join("xtask/lightfield_pyolaf.py")).args(arguments);
                command.env("OMP_NUM_THREADS", "1").env("OPENBLAS_NUM_THREADS", "1");
                let found = lines(&mut command).map(|list| {
                    for mut line in list {
                        line["nnum"] = arguments[0].into();
                        findings.peer.push(line);
                    }
                });
                outcome(found)
            });
        }
    }
    for (what, threads) in
        [("rl", 1), ("isra", 1), ("dlfm", 1), ("psf-plane", 1), ("rl", 2), ("isra", 2), ("size", 1)]
    {
        report.step(&format!("ours: {what}, {threads} threads"), || {
            outcome(ours(what, threads, &mut findings))
        });
    }
    report.step("docs/performance.md", || {
        let page = page(&findings);
        println!("{page}");
        outcome(replace_section(&root().join("docs/performance.md"), "light field", &page))
    });
    report
}

/// All values of a field over the runs of a case, sorted.
fn of(findings: &[Value], name: &str, case: &str, threads: Option<u64>, field: &str) -> Vec<f64> {
    let mut v: Vec<f64> = findings
        .iter()
        .filter(|l| l[name] == case && threads.is_none_or(|t| l["threads"] == t))
        .filter_map(|l| l[field].as_f64())
        .collect();
    v.sort_by(f64::total_cmp);
    v
}

fn middle(v: &[f64]) -> f64 {
    v.get(v.len() / 2).copied().unwrap_or(f64::NAN)
}

fn page(f: &Findings) -> String {
    let mut out = String::new();
    let ms = |v: f64| format!("{:.1}", 1e3 * v);
    let peer = |stage: &str, nnum: &str| {
        let list: Vec<Value> = f.peer.iter().filter(|l| l["nnum"] == nnum).cloned().collect();
        middle(&of(&list, "stage", stage, None, "cpu"))
    };
    writeln!(out, "## Light field\n").ok();
    writeln!(out, "Written by `cargo xtask bench lightfield`; every number is of one run of it. The thesis' simulated microscope, `bench` geometry: Nnum 15, S 3, 17 planes from −20 to 20 µm, 35 × 35 lenslets, 8 iterations after the point spread function. Processor time, median of 15; pyolaf {PYOLAF} from PyPI once, one thread, in the same run.\n").ok();
    writeln!(out, "- Date: {}, load average at the end: {}", super::page::said("date", &["-I"]), load()).ok();
    for remark in &f.remarks {
        writeln!(out, "- {remark}").ok();
    }
    let base = peer("iterations", "15");
    writeln!(
        out,
        "\npyolaf: point spread function {:.1} s, forward {:.2} s, back {:.2} s, 8 iterations {base:.1} s.\n",
        peer("psf", "15"),
        peer("forward", "15"),
        peer("back", "15")
    )
    .ok();
    writeln!(out, "| case | blocks | MiB | CPU, ms | smallest–largest | × less than pyolaf | per iteration, ms | GB/s | GFLOP/s | target | aim |").ok();
    writeln!(out, "|---|---|---|---|---|---|---|---|---|---|---|").ok();
    for (case, target, aim) in [
        ("rl-f32", "300", "600"),
        ("rl-f16", "300", "600"),
        ("rl-complex-f32", "–", "–"),
        ("isra-normal-f32", "700", "1 500"),
        ("isra-normal-f16", "700", "1 500"),
        ("isra-two-passes-f32", "–", "–"),
        ("isra-two-passes-f16", "–", "–"),
        ("dlfm-rl-f32", "60", "–"),
        ("dlfm-rl-f16", "60", "–"),
        ("dlfm-isra-normal-f32", "as ISRA", "–"),
        ("dlfm-isra-two-passes-f32", "–", "–"),
    ] {
        let get = |field: &str| middle(&of(&f.ours, "case", case, Some(1), field));
        let (cpu, bytes, each) = (get("cpu"), get("block_bytes"), get("iteration_cpu"));
        if cpu.is_nan() {
            continue;
        }
        let line = f.ours.iter().find(|l| l["case"] == case);
        let reduction = line.and_then(|l| l["reduction"].as_str()).unwrap_or("–");
        let passes = if case.contains("normal") { 1.0 } else { 2.0 };
        // every stored number is used with as many real vectors as its orbit has
        let real = if case.ends_with("f16") { bytes / 2.0 } else { bytes / 4.0 };
        let vectors =
            match reduction {
                "RealSquare" => 8.0,
                "RealMirrors" | "ComplexMirrorY" => 4.0,
                _ => 2.0,
            } * if case.starts_with("dlfm-rl") || case.starts_with("dlfm-isra-two") { 2.0 } else { 1.0 };
        let bandwidth = passes * bytes / each * 1e-9;
        let flops = 2.0 * passes * real * vectors / each * 1e-9;
        let span = format!("{}–{}", ms(get("cpu_low")), ms(get("cpu_high")));
        writeln!(out, "| {case} | {reduction} | {:.1} | {} | {span} | {:.0} | {} | {bandwidth:.1} | {flops:.0} | {target} | {aim} |", bytes / 1048576.0, ms(cpu), base / cpu, ms(each)).ok();
    }
    writeln!(out, "\nCPU includes packing of images and volumes and, for RL, Hᵀ1. GB/s: stored numbers read per second of an iteration; GFLOP/s: multiplications and additions of the blocks alone, over the whole iteration.\n").ok();
    writeln!(out, "| two threads | wall of one, ms | wall of two, ms | ratio |\n|---|---|---|---|").ok();
    for case in ["rl-f32", "rl-f16", "isra-normal-f32", "isra-normal-f16"] {
        let [one, two] = [1, 2].map(|t| middle(&of(&f.ours, "case", case, Some(t), "wall")));
        writeln!(out, "| {case} | {} | {} | {:.2} |", ms(one), ms(two), one / two).ok();
    }
    let plane = middle(&of(&f.ours, "case", "psf-plane", None, "cpu"));
    let ours = middle(&of(&f.ours, "case", "psf", None, "cpu"));
    let dlfm = middle(&of(&f.ours, "case", "psf-dlfm", None, "cpu"));
    writeln!(out, "\nPoint spread function at 75 field samples a lenslet: {ours:.2} s for 17 planes ({dlfm:.2} s of one order with the grating), one plane {plane:.3} s with its self-test; pyolaf at Nnum 75, one plane: {:.1} s, {:.0} times as much (target 5).\n", peer("psf", "75"), peer("psf", "75") / plane).ok();
    writeln!(
        out,
        "| lenslets × lenslets × planes | MiB | CPU, ms | µs per lenslet and plane |\n|---|---|---|---|"
    )
    .ok();
    for line in f.ours.iter().filter(|l| l["case"].as_str().is_some_and(|c| c.starts_with("rl-f32-"))) {
        let name = line["case"].as_str().unwrap_or_default().trim_start_matches("rl-f32-");
        let count: f64 = name.split('x').filter_map(|v| v.parse::<f64>().ok()).product();
        let cpu = line["cpu"].as_f64().unwrap_or(f64::NAN);
        let bytes = line["block_bytes"].as_f64().unwrap_or(f64::NAN);
        writeln!(out, "| {name} | {:.0} | {} | {:.2} |", bytes / 1048576.0, ms(cpu), 1e6 * cpu / count).ok();
    }
    let peak = middle(&of(&f.ours, "case", "size-memory", None, "peak_mib"));
    writeln!(out, "\nPeak memory of the process over all of these: {peak:.0} MiB (limit for 101² lenslets and 31 planes: 6 GiB).").ok();
    out
}

fn load() -> String {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    text.split_whitespace().next().unwrap_or("unknown").to_owned()
}
