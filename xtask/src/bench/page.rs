//! docs/performance.md from what was found.

use super::{Findings, pyvale};
use serde_json::Value;
use std::fmt::Write;
use std::process::Command;

/// Median; NaN of nothing.
fn median(values: &[f64]) -> f64 {
    let mut v: Vec<f64> = values.iter().copied().filter(|a| a.is_finite()).collect();
    v.sort_by(f64::total_cmp);
    match v.len() {
        0 => f64::NAN,
        n => 0.5 * (v[(n - 1) / 2] + v[n / 2]),
    }
}

/// Median with smallest and largest, points per second from seconds.
fn rate(points: f64, seconds: &[f64]) -> String {
    let rates: Vec<f64> = seconds.iter().map(|s| points / s).collect();
    let (lo, hi) = rates.iter().fold((f64::INFINITY, 0.0f64), |(a, b), &r| (a.min(r), b.max(r)));
    if rates.is_empty() {
        return "–".into();
    }
    format!("{} ({}–{})", thousands(median(&rates)), thousands(lo), thousands(hi))
}

/// Three significant digits, thousands apart.
fn thousands(value: f64) -> String {
    if !value.is_finite() {
        return "–".into();
    }
    let scale = 10f64.powf((value.abs().max(1.0).log10().floor() - 2.0).max(0.0));
    let digits = format!("{:.0}", (value / scale).round() * scale);
    let mut out = String::new();
    for (k, c) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k) % 3 == 0 {
            out.push('\u{202f}');
        }
        out.push(c);
    }
    out
}

fn numbers(lines: &[Value], pick: impl Fn(&Value) -> Vec<f64>) -> Vec<f64> {
    lines.iter().flat_map(pick).collect()
}

fn warm(line: &Value, what: &str) -> Vec<f64> {
    line["warm"].as_array().into_iter().flatten().filter_map(|r| r[what].as_f64()).collect()
}

fn cold(line: &Value, what: &str) -> Vec<f64> {
    line["cold"][what].as_f64().into_iter().collect()
}

pub fn said(program: &str, arguments: &[&str]) -> String {
    let output = Command::new(program).args(arguments).output();
    let text = output.map(|o| String::from_utf8_lossy(&o.stdout).trim().to_owned()).unwrap_or_default();
    if text.is_empty() { "unknown".into() } else { text }
}

fn field(file: &str, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(file).ok()?;
    let line = text.lines().find(|l| l.starts_with(name))?;
    Some(line.split_once(':')?.1.trim().to_owned())
}

fn machine(simd: &str) -> String {
    let model = field("/proc/cpuinfo", "model name").unwrap_or_else(|| "unknown processor".into());
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    let memory = field("/proc/meminfo", "MemTotal")
        .and_then(|m| m.split(' ').next()?.parse::<f64>().ok())
        .map_or("unknown memory".into(), |k| format!("{:.0} GiB", k / 1024.0 / 1024.0));
    format!(
        "{model}, {cores} cores, {memory}, {} {}; SIMD level of the kernels: {simd}",
        std::env::consts::OS,
        std::env::consts::ARCH
    )
}

/// The whole page.
pub fn write(found: &Findings) -> String {
    let mut p = String::from(
        "# Performance\n\nWritten by `cargo xtask bench correlate`; every number here is of one run of it.\n\n",
    );
    let simd = found.speed.iter().flat_map(|(_, l)| l).find_map(|l| l["simd"].as_str()).unwrap_or("unknown");
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let _ = writeln!(p, "- Machine: {}", machine(simd));
    let _ = writeln!(p, "- Compiler: {}, release profile", said("rustc", &["-V"]));
    let _ = writeln!(p, "- Date: {}", said("date", &["-u", "+%Y-%m-%d"]));
    let _ = writeln!(
        p,
        "- Load average at the end: {}",
        load.split(' ').next().filter(|l| !l.is_empty()).unwrap_or("unknown")
    );
    let _ = writeln!(p, "- Images: {}", found.source);
    p.push_str(
        "- Settings: quintic B-spline, ZNSSD, step 5, centres 40 px inside the image (35 721 points), stop at 10⁻³ px, one thread unless stated\n\
         - Counted: everything from 8-bit pixels in memory to points with σ and status, in seconds of processor time. *Warm*: both images new, memory and the grid of points kept, 7 repeats in each process. *Cold*: the first run of a process, all memory fresh, the grid included\n\
         - Median (smallest–largest) over all processes\n\
         - The speed of a virtual machine may change by half within minutes: compare rows within a section; ratios to pyvale are of runs in turn\n\n",
    );
    if !found.remarks.is_empty() {
        p.push_str("Not measured in this run:\n\n");
        for remark in &found.remarks {
            let _ = writeln!(p, "- **{remark}**");
        }
        p.push('\n');
    }
    speed(&mut p, found);
    peers(&mut p, found);
    threads(&mut p, found);
    live(&mut p, found);
    sizes(&mut p, found);
    memory(&mut p, found);
    accuracy(&mut p, found);
    kernels(&mut p, found);
    let _ = write!(
        p,
        "\n## To reproduce\n\n```text\ncargo xtask bench correlate            {} rounds; brings pyvale {} into target/ with python3 -m venv and pip\n\
         cargo xtask bench correlate --quick    one round, few cases; the page goes to target/bench-correlate/\n\
         cargo xtask bench guard                instruction counts of a small correlation against xtask/callgrind.json\n```\n\n\
         The golden images are looked for in `../shared`, or where `DAIC_SHARED` says; without them a rendered pair is used and errors are not measured.\n",
        super::FULL.rounds,
        pyvale::VERSION
    );
    p
}

fn pyvale_rate(found: &Findings, subset: usize, shape: &str) -> Option<f64> {
    let r = found.pyvale.iter().find(|r| r.subset == subset && r.shape == shape)?;
    Some(r.points as f64 / median(&r.cpu))
}

fn speed(p: &mut String, found: &Findings) {
    p.push_str(
        "## Speed\n\nPoints per second of processor time. *Dense* rows run with `solver = auto`: the dense form where it is valid, the exact one elsewhere; the last columns say how many points each solved.\n\n\
         | work | target | aim | warm | cold | × pyvale | by the dense form | ok |\n|---|---|---|---|---|---|---|---|\n",
    );
    for (row, lines) in &found.speed {
        let Some(first) = lines.first() else { continue };
        let points = first["points"].as_f64().unwrap_or(f64::NAN);
        let seconds = numbers(lines, |l| warm(l, "cpu"));
        let ratio = pyvale_rate(found, row.subset, row.shape)
            .map_or("–".into(), |peer| format!("{:.0}", points / median(&seconds) / peer));
        let target = match row.target_cold {
            Some(c) => format!("{} (cold {})", thousands(row.target), thousands(c)),
            None => thousands(row.target),
        };
        let _ = writeln!(
            p,
            "| {} | {target} | {} | {} | {} | {ratio} | {:.1} % | {} of {} |",
            row.title,
            thousands(row.aim),
            rate(points, &seconds),
            rate(points, &numbers(lines, |l| cold(l, "cpu"))),
            100.0 * first["dense"].as_f64().unwrap_or(0.0) / points,
            first["ok"],
            first["points"],
        );
    }
    p.push('\n');
    let wall: Vec<String> = found
        .speed
        .iter()
        .filter(|(_, lines)| !lines.is_empty())
        .map(|(row, lines)| {
            format!("{} {:.1} ms", row.title, 1e3 * median(&numbers(lines, |l| warm(l, "wall"))))
        })
        .collect();
    let _ = writeln!(p, "Wall time of a warm run: {}.\n", wall.join("; "));
}

fn peers(p: &mut String, found: &Findings) {
    if found.pyvale.is_empty() {
        return;
    }
    let _ = write!(
        p,
        "### pyvale {} from PyPI, between our runs\n\n\
         `pyvale.dic.calculate_2d` alone (import, reading of images not counted; results written in its binary form), `SINGLEWINDOW_RG`, bicubic B-spline, ZNSSD, no prefilter, one thread, same stop and step.\n\n\
         | work | points | points per processor second | wall, s |\n|---|---|---|---|\n",
        pyvale::VERSION
    );
    for r in &found.pyvale {
        let _ = writeln!(
            p,
            "| {0}×{0} {1}, `{2}` | {3} of {4} | {5} | {6:.1} |",
            r.subset,
            r.shape,
            r.field,
            r.ok,
            r.points,
            rate(r.points as f64, &r.cpu),
            median(&r.wall)
        );
    }
    p.push_str(
        "\nOther engines on the same images, measured earlier on another machine (2.9 GHz, AVX-512), 33×33 affine / quadratic / 59×59 affine: OpenCorr 10 900 / 5 300 / 2 820, ncorr_2D_cpp 4 800 / – / 1 980, pyvale 3 600 / 1 800 / 1 325.\n\n",
    );
}

fn threads(p: &mut String, found: &Findings) {
    if found.threads.is_empty() {
        return;
    }
    p.push_str(
        "## Two threads\n\nWall time, the pools in turn within one process; results are identical, bit for bit (checked in the same run). Target: 1.8.\n\n\
         | solver | one thread, ms | two threads, ms | ratio | processor time, two / one |\n|---|---|---|---|---|\n",
    );
    for line in &found.threads {
        let of = |what: &str, k: usize| -> f64 {
            let v: Vec<f64> =
                line[what][k].as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
            median(&v)
        };
        let _ = writeln!(
            p,
            "| {} | {:.1} | {:.1} | {:.2} | {:.2} |",
            line["settings"]["solver"].as_str().unwrap_or("?"),
            1e3 * of("wall", 0),
            1e3 * of("wall", 1),
            of("wall", 0) / of("wall", 1),
            of("cpu", 1) / of("cpu", 0)
        );
    }
    p.push('\n');
}

fn live(p: &mut String, found: &Findings) {
    if found.live.is_empty() {
        return;
    }
    p.push_str(
        "## Live\n\nFrom the 8-bit pixels of a 2592 × 1944 frame in memory to a height map with σ: both views matched, 59 × 59, step 5, \
         every frame starts from the last, two frames in turn (50, −30 and 200 µm apart). Wall time, median of 21. Target: 10 frames/s with two threads.\n\n\
         | subset | threads | frames/s | last frame |\n|---|---|---|---|\n",
    );
    for l in &found.live {
        let frame = l.frame.split_once(": ").map_or("", |f| f.1);
        let _ = writeln!(p, "| {} | {} | {:.1} | {frame} |", l.shape, l.threads, l.frames_per_second);
    }
    p.push('\n');
}

fn sizes(p: &mut String, found: &Findings) {
    if found.sizes.is_empty() {
        return;
    }
    p.push_str(
        "## Size of the image\n\n33×33 affine, warm, one thread, rendered pairs: sums of Gaussian blobs under an affine field, evaluated at every pixel and rounded to 8 bits, the displacement at the edge the same for all sizes. Target: within 25 % of 1024².\n\n\
         | image | points | solver | points per processor second | of 1024² | ok |\n|---|---|---|---|---|---|\n",
    );
    let of = |l: &Value| l["points"].as_f64().unwrap_or(f64::NAN) / median(&warm(l, "cpu"));
    for line in &found.sizes {
        let solver = &line["settings"]["solver"];
        let base = found
            .sizes
            .iter()
            .find(|l| l["width"] == 1024 && &l["settings"]["solver"] == solver)
            .map_or(f64::NAN, of);
        let _ = writeln!(
            p,
            "| {}² | {} | {} | {} | {:.2} | {:.3} % |",
            line["width"],
            line["points"],
            solver.as_str().unwrap_or("?"),
            rate(line["points"].as_f64().unwrap_or(f64::NAN), &warm(line, "cpu")),
            of(line) / base,
            100.0 * line["ok"].as_f64().unwrap_or(f64::NAN) / line["points"].as_f64().unwrap_or(f64::NAN)
        );
    }
    p.push('\n');
}

fn memory(p: &mut String, found: &Findings) {
    let Some(m) = &found.memory else { return };
    let _ = write!(
        p,
        "## Memory\n\nPeak of resident memory above that of a process holding the two 8-bit images, over three frames, {0}² pixels, 33×33 affine, `auto`. \
         Two fresh processes with {1} and {2} points tell pixels and points apart: added = pixels · a + points · b.\n\n\
         | | measured | limit |\n|---|---|---|\n\
         | bytes per pixel of one image (a) | {3:.1} | 64 |\n| bytes per point, results included (b) | {4:.0} | 200 |\n\
         | added in all | {5:.1} and {6:.1} MiB | |\n| growth from the first to the third frame | {7:.1} and {8:.1} MiB | |\n\n",
        m.size,
        m.points[0],
        m.points[1],
        m.pixel,
        m.point,
        m.added[0] / 1048576.0,
        m.added[1] / 1048576.0,
        m.growth[0] / 1048576.0,
        m.growth[1] / 1048576.0
    );
    if !m.reset {
        p.push_str(
            "**The peak could not be reset after decoding the images: some of it may be the decoder's.**\n\n",
        );
    }
}

fn accuracy(p: &mut String, found: &Findings) {
    if found.accuracy.is_empty() {
        return;
    }
    let checked = found.accuracy.iter().filter(|l| l["checked"] == true).count();
    let _ = write!(
        p,
        "## Errors on known fields\n\nGolden images, pixels; points farther off than 0.5 px are counted as outliers and left out of bias and scatter. {checked} of {} rows were scored again by the independent `score.py`, with the same result. Cramér–Rao bounds of the scatter (affine): 33×33 6.5e-4 (n0), 4.55e-3 (n2); 59×59 3.5e-4, 2.46e-3. \
         *From exact*: distance (RMS of u and v) from the exact form iterated to 10⁻⁶ px.\n\n\
         | field | subset | solver | ok, outliers | bias u, v | scatter u, v | mean σ_u | from exact | by the dense form |\n|---|---|---|---|---|---|---|---|---|\n",
        found.accuracy.iter().filter(|l| l["csv"].is_string()).count()
    );
    let e = |v: &Value| v.as_f64().map_or("–".into(), |a| format!("{a:.2e}"));
    for l in found.accuracy.iter().filter(|l| l["field"].is_string()) {
        let text = |k: &str| l[k].as_str().unwrap_or("?").to_owned();
        let _ = writeln!(
            p,
            "| {} {}{} | {} {} | {} | {} of {}, {} | {}, {} | {}, {} | {} | {} | {} |",
            text("field"),
            text("noise"),
            l["period"].as_f64().map_or(String::new(), |w| format!(", 10 % attenuation at {w:.1} px")),
            l["subset"],
            text("shape"),
            text("solver"),
            l["ok"],
            l["points"],
            l["outliers"],
            e(&l["bias"][0]),
            e(&l["bias"][1]),
            e(&l["scatter"][0]),
            e(&l["scatter"][1]),
            e(&l["sigma_u"]),
            e(&l["from_exact"]),
            l["dense"]
        );
    }
    for l in found.accuracy.iter().filter(|l| l["noise_bias"].is_array()) {
        let _ = writeln!(
            p,
            "\nBias from noise, `{}`: mean over {} seeds of the mean error of t02 with fresh noise of {} grey levels in both images {}, {} px (without: {}, {}).",
            l["solver"].as_str().unwrap_or("?"),
            l["seeds"],
            l["grey_levels"],
            e(&l["noise_bias"][0]),
            e(&l["noise_bias"][1]),
            e(&l["without_noise"][0]),
            e(&l["without_noise"][1])
        );
    }
    p.push_str(
        "\nPeers at t02, 33×33 affine, bias / scatter of u: OpenCorr −4.2e-3 / 8.1e-4 (n0), −4.2e-3 / 4.5e-3 (n2); ncorr_2D_cpp 7.6e-5 / 6.5e-4, 9e-5 / 4.5e-3; pyvale 7.1e-4 / 6.7e-4, 4.8e-3 / 4.6e-3. Star, 10 % attenuation: 136 px (affine), 44 px (quadratic) in every engine. Step of 2 px: about 600 points off by more than 0.5 px in every engine.\n",
    );
    if !found.peer_scores.is_empty() {
        let _ = write!(
            p,
            "\npyvale {} in this run, scored by the same program:\n\n| field | points, outliers | bias u | scatter u |\n|---|---|---|---|\n",
            pyvale::VERSION
        );
        for s in &found.peer_scores {
            let _ = writeln!(
                p,
                "| {} | {}, {} | {} | {} |",
                s["case"].as_str().unwrap_or("?"),
                s["ok"],
                s["outliers"],
                e(&s["bias_u"]),
                e(&s["std_u"])
            );
        }
    }
    p.push('\n');
}

fn kernels(p: &mut String, found: &Findings) {
    if found.kernels.is_empty() {
        return;
    }
    p.push_str(
        "## Kernels\n\nMedians of `cargo bench -p daic-correlate --features bench`, one thread; the scalar reference in double precision is what the tests hold the kernels to.\n\n\
         | kernel | vector form, µs | scalar reference, µs | ratio |\n|---|---|---|---|\n",
    );
    let micro = |t: Option<f64>| t.map_or("–".into(), |t| format!("{:.2}", t * 1e-3));
    for k in &found.kernels {
        let ratio = match (k.simd, k.scalar) {
            (Some(a), Some(b)) => format!("{:.0}", b / a),
            _ => "–".into(),
        };
        let _ = writeln!(p, "| {} | {} | {} | {ratio} |", k.name, micro(k.simd), micro(k.scalar));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_and_numbers() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0, f64::NAN, 2.0, 3.0]), 2.5);
        assert!(median(&[]).is_nan());
        assert_eq!(thousands(893_512.0), "894\u{202f}000");
        assert_eq!(thousands(42.4), "42");
        assert_eq!(thousands(999_999.0), "1\u{202f}000\u{202f}000");
    }
}
