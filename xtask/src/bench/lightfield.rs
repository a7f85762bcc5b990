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

/// How often ours is measured, with the peer in between.
const SLOTS: usize = 4;

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
    let theirs = |arguments: [&str; 7], findings: &mut Findings| {
        let Some(python) = &peer else { return Outcome::NotRun("there is no pyolaf".into()) };
        let mut command = Command::new(python);
        command.arg(root().join("xtask/lightfield_pyolaf.py")).args(arguments);
        command.env("OMP_NUM_THREADS", "1").env("OPENBLAS_NUM_THREADS", "1");
        outcome(lines(&mut command).map(|list| {
            for mut line in list {
                line["nnum"] = arguments[0].into();
                findings.peer.push(line);
            }
        }))
    };
    // in alternation, ours first and last: the speed of a virtual machine drifts over seconds to minutes
    for slot in 1..=SLOTS {
        for (what, threads) in [("rl", 1), ("rl", 2), ("isra", 1), ("isra", 2)] {
            report.step(&format!("ours: {what}, {threads} threads, {slot} of {SLOTS}"), || {
                outcome(ours(what, threads, &mut findings))
            });
        }
        if slot < SLOTS {
            report.step(&format!("pyolaf: the bench problem, {slot} of {}", SLOTS - 1), || {
                theirs(["15", "3", "-20", "20", "2.5", "35", "8"], &mut findings)
            });
        }
    }
    report.step("pyolaf: one plane at 75 samples a lenslet", || {
        theirs(["75", "3", "20", "20", "2.5", "35", "0"], &mut findings)
    });
    for what in ["psf", "psf-plane", "stream", "dlfm", "size"] {
        report.step(&format!("ours: {what}"), || outcome(ours(what, 1, &mut findings)));
    }
    report.step("docs/performance.md", || {
        let page = page(&findings);
        println!("{page}");
        outcome(replace_section(&root().join("docs/performance.md"), "light field", &page))
    });
    report
}

/// All values of a field over the runs of a case, sorted; a run has one value or a list.
fn of(findings: &[Value], name: &str, case: &str, threads: Option<u64>, field: &str) -> Vec<f64> {
    let mut v: Vec<f64> = findings
        .iter()
        .filter(|l| l[name] == case && threads.is_none_or(|t| l["threads"] == t))
        .flat_map(|l| l[field].as_array().cloned().unwrap_or_else(|| vec![l[field].clone()]))
        .filter_map(|v| v.as_f64())
        .collect();
    v.sort_by(f64::total_cmp);
    v
}

fn middle(v: &[f64]) -> f64 {
    v.get(v.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Real vectors with which one stored number is multiplied in a pass: those of all frequencies of the half plane,
/// over the blocks that are stored for them.
fn vectors(reduction: &str, grid: [u64; 2], orders: f64) -> f64 {
    let (half, quarter) = (grid[1] / 2 + 1, grid[0] / 2 + 1);
    let frequencies = grid[0] * half;
    let blocks = match reduction {
        "RealSquare" => half * (half + 1) / 2,
        "RealMirrors" | "ComplexMirrorX" | "ComplexMirrorY" => quarter * half,
        _ => frequencies,
    };
    2.0 * orders * frequencies as f64 / blocks as f64
}

fn page(f: &Findings) -> String {
    let mut out = String::new();
    let ms = |v: f64| format!("{:.1}", 1e3 * v);
    let peer = |stage: &str, nnum: &str| {
        let list: Vec<Value> = f.peer.iter().filter(|l| l["nnum"] == nnum).cloned().collect();
        of(&list, "stage", stage, None, "cpu")
    };
    let span = |v: &[f64], digits: usize| {
        let at = |v: Option<&f64>| v.copied().unwrap_or(f64::NAN);
        format!("{:.digits$} s ({:.digits$}–{:.digits$})", middle(v), at(v.first()), at(v.last()))
    };
    writeln!(out, "## Light field\n").ok();
    writeln!(out, "Written by `cargo xtask bench lightfield`; every number is of one run of it. The thesis' simulated microscope, `bench` geometry: Nnum 15, S 3, 17 planes from −20 to 20 µm, 35 × 35 lenslets, 8 iterations after the point spread function. Processor time on one thread if nothing else is said. The machine's speed drifts over seconds to minutes, so RL and ISRA on one and two threads and pyolaf {PYOLAF} from PyPI take turns: {SLOTS} times ours, 15 repeats each, with pyolaf in between, {} times. Printed are medians over all repeats, with the smallest and the largest. After that, once each: point spread functions, pyolaf's plane at Nnum 75; `dlfm` 15 repeats, the table of sizes 3.\n", SLOTS - 1).ok();
    writeln!(out, "- Date: {}, load average at the end: {}", super::page::said("date", &["-I"]), load()).ok();
    for remark in &f.remarks {
        writeln!(out, "- {remark}").ok();
    }
    let iterations = peer("iterations", "15");
    let base = middle(&iterations);
    writeln!(
        out,
        "\npyolaf, {} times: point spread function {}, forward {}, back {}, 8 iterations {}.\n",
        iterations.len(),
        span(&peer("psf", "15"), 1),
        span(&peer("forward", "15"), 2),
        span(&peer("back", "15"), 2),
        span(&iterations, 1)
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
        let real = if case.ends_with("f16") { bytes / 2.0 } else { bytes / 4.0 };
        let grid = [0, 1].map(|k| line.and_then(|l| l["grid"][k].as_u64()).unwrap_or(0));
        // the product that replaces both passes is of both orders together
        let orders = if case.starts_with("dlfm") && !case.contains("normal") { 2.0 } else { 1.0 };
        let vectors = vectors(reduction, grid, orders);
        let bandwidth = passes * bytes / each * 1e-9;
        let flops = 2.0 * passes * real * vectors / each * 1e-9;
        let all = of(&f.ours, "case", case, Some(1), "cpu");
        let [low, high] = [all.first(), all.last()].map(|v| ms(v.copied().unwrap_or(f64::NAN)));
        writeln!(out, "| {case} | {reduction} | {:.1} | {} | {low}–{high} | {:.0} | {} | {bandwidth:.1} | {flops:.0} | {target} | {aim} |", bytes / 1048576.0, ms(cpu), base / cpu, ms(each)).ok();
    }
    let [stream, best] =
        ["gb_s", "gb_s_best"].map(|field| middle(&of(&f.ours, "case", "stream", None, field)));
    writeln!(out, "\nCPU includes packing of images and volumes and, for RL, Hᵀ1. GB/s: stored numbers read per second of an iteration; summing 64 MiB from memory, one thread reads {stream:.1} GB/s here (median of 15, best {best:.1}). GFLOP/s: multiplications and additions of the stored blocks with all frequencies of the half plane, over the whole iteration.\n").ok();
    writeln!(out, "| two threads | wall of one, ms | wall of two, ms | ratio |\n|---|---|---|---|").ok();
    for case in ["rl-f32", "rl-f16", "isra-normal-f32", "isra-normal-f16"] {
        let [one, two] = [1, 2].map(|t| middle(&of(&f.ours, "case", case, Some(t), "wall")));
        writeln!(out, "| {case} | {} | {} | {:.2} |", ms(one), ms(two), one / two).ok();
    }
    let plane = middle(&of(&f.ours, "case", "psf-plane", None, "cpu"));
    let ours = middle(&of(&f.ours, "case", "psf", None, "cpu"));
    let dlfm = middle(&of(&f.ours, "case", "psf-dlfm", None, "cpu"));
    let theirs = middle(&peer("psf", "75"));
    writeln!(out, "\nPoint spread function at 75 field samples a lenslet: {ours:.2} s for 17 planes ({dlfm:.2} s of one order with the grating), one plane {plane:.3} s with its self-test; pyolaf at Nnum 75, one plane: {theirs:.1} s, {:.0} times as much (target 5). Each of these once.\n", theirs / plane).ok();
    writeln!(
        out,
        "| lenslets × lenslets × planes | MiB | CPU, ms, median of 3 | µs per lenslet and plane |\n|---|---|---|---|"
    )
    .ok();
    for line in f.ours.iter().filter(|l| l["case"].as_str().is_some_and(|c| c.starts_with("rl-f32-"))) {
        let name = line["case"].as_str().unwrap_or_default().trim_start_matches("rl-f32-");
        let count: f64 = name.split('x').filter_map(|v| v.parse::<f64>().ok()).product();
        let cpu = middle(&of(
            std::slice::from_ref(line),
            "case",
            line["case"].as_str().unwrap_or_default(),
            None,
            "cpu",
        ));
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

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn vectors_are_those_of_the_half_plane() {
        // 40 × 21 frequencies, real and imaginary part of each: 231 blocks (k_y ≤ k_x), 441, or all
        for (reduction, blocks) in [("RealSquare", 231.0), ("RealMirrors", 441.0), ("Complex", 840.0)] {
            assert!((vectors(reduction, [40, 40], 1.0) * blocks - 1680.0).abs() < 1e-9, "{reduction}");
        }
        assert_eq!(vectors("Complex", [40, 40], 2.0), 4.0);
    }

    #[test]
    fn repeats_are_pooled_over_the_slots() {
        let ours = |threads: u64, cpu: [f64; 3]| {
            json!({"case": "rl-f32", "threads": threads, "cpu": cpu, "wall": cpu, "iteration_cpu": [0.01],
                "block_bytes": 32 << 20, "reduction": "RealSquare", "grid": [40, 40]})
        };
        let size = json!({"case": "rl-f32-35x35x17", "threads": 1, "cpu": [0.07, 0.08, null], "block_bytes": 1 << 20});
        let stream = json!({"case": "stream", "gb_s": 11.5, "gb_s_best": 12.25});
        let peer = |seconds: f64| json!({"stage": "iterations", "cpu": seconds, "nnum": "15"});
        let findings = Findings {
            ours: vec![ours(1, [0.1, 0.3, 0.2]), ours(1, [0.5, 0.4, 0.6]), ours(2, [0.05; 3]), size, stream],
            peer: vec![peer(30.0), peer(20.0), peer(24.0)],
            remarks: Vec::new(),
        };
        let page = page(&findings);
        println!("{page}");
        // 2 · 2 passes · 8 Mi numbers · 1680/231 vectors in 10 ms
        let row = "| rl-f32 | RealSquare | 32.0 | 400.0 | 100.0–600.0 | 60 | 10.0 | 6.7 | 24 | 300 | 600 |";
        for text in [
            row,
            "8 iterations 24.0 s (20.0–30.0)",
            "reads 11.5 GB/s here (median of 15, best 12.2)",
            "| rl-f32 | 400.0 | 50.0 | 8.00 |",
            "| 35x35x17 | 1 | 80.0 | 3.84 |",
        ] {
            assert!(page.contains(text), "{text}");
        }
    }
}
