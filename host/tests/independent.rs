//! `daic decode` against a Python script that shares no code with it (`tests/independent/decode.py`).

#[path = "../crates/optics/tests/common/mod.rs"]
mod common;

use common::*;
use daic::optics_section;
use daic_optics::Optics;
use daic_rig::experiment::OpticsFile;
use nalgebra::Vector3;
use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

fn run(program: &str, arguments: &[&str], folder: &Path) -> Result<String, String> {
    let out = Command::new(program)
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap_or_else(|e| panic!("{program}: {e}"));
    let text = format!("{}{}", String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
    if out.status.success() { Ok(text) } else { Err(text) }
}

fn write_optics(folder: &Path, optics: &Optics) {
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml");
    let mut file = OpticsFile::load(&example).unwrap();
    file.optics = optics_section::to_section(&file.optics, optics);
    std::fs::write(folder.join("optics.toml"), file.to_toml().unwrap()).unwrap();
    std::fs::write(folder.join("optics.json"), serde_json::to_string(optics).unwrap()).unwrap();
}

/// Pixel pairs of points in a box of ±9 × ±7 × ±4 mm, each coordinate up to 2 px off, so that rays pass each other.
fn pairs(optics: &Optics, random: &mut Normal, count: usize) -> String {
    let mut text = String::from("minus_x,minus_y,plus_x,plus_y\n");
    for _ in 0..count {
        let mut within = |reach: f64| reach * (2.0 * random.uniform() - 1.0);
        let pair = see_both(optics, Vector3::new(within(9.0), within(7.0), within(4.0)));
        let [[a, b], [c, d]] = [pair.minus_px, pair.plus_px].map(|p| p.map(|v| v + within(2.0)));
        writeln!(text, "{a},{b},{c},{d}").unwrap();
    }
    text
}

#[test]
fn an_independent_script_finds_the_same_points() {
    if Command::new("python3").arg("--version").output().is_err() {
        eprintln!("SKIPPED an_independent_script_finds_the_same_points: there is no python3");
        return;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/independent/decode.py");
    let script = script.to_str().unwrap();
    let mut random = Normal::new(20);
    for (name, optics) in [("square", golden()), ("everything tilted, glass, distortion", awkward())] {
        let folder = tempfile::TempDir::new().unwrap();
        write_optics(folder.path(), &optics);
        std::fs::write(folder.path().join("pairs.csv"), pairs(&optics, &mut random, 300)).unwrap();
        for decoder in ["ray", "closed", "linear"] {
            let decode = [
                "decode",
                "--quiet",
                "--optics",
                "optics.toml",
                "pairs.csv",
                "--decoder",
                decoder,
                // the noise that `pairs` adds
                "--sigma",
                "1.2",
                "--out",
                "points.csv",
            ];
            run(env!("CARGO_BIN_EXE_daic"), &decode, folder.path()).unwrap_or_else(|e| panic!("{e}"));
            let check = [script, "optics.json", "pairs.csv", "points.csv", decoder];
            let found = run("python3", &check, folder.path()).unwrap_or_else(|e| panic!("{name}: {e}"));
            print!("{name}, {found}");
            assert!(found.contains("300 points"), "{found}");
        }
        // the check can fail: a pitch 1e-6 wrong is seen
        let mut other = optics;
        other.plus.pitch_mm *= 1.0 + 1e-6;
        std::fs::write(folder.path().join("optics.json"), serde_json::to_string(&other).unwrap()).unwrap();
        assert!(
            run("python3", &[script, "optics.json", "pairs.csv", "points.csv", "linear"], folder.path())
                .is_err()
        );
    }
}

#[test]
fn swapped_and_bad_pairs_are_refused_or_flagged() {
    let folder = tempfile::TempDir::new().unwrap();
    let optics = golden();
    write_optics(folder.path(), &optics);
    let text = pairs(&optics, &mut Normal::new(21), 20);
    let decode = |text: &str| {
        std::fs::write(folder.path().join("pairs.csv"), text).unwrap();
        let arguments = [
            "decode",
            "--quiet",
            "--optics",
            "optics.toml",
            "pairs.csv",
            "--sigma",
            "1.2",
            "--out",
            "points.csv",
        ];
        run(env!("CARGO_BIN_EXE_daic"), &arguments, folder.path())
    };
    let swapped = text.replacen("minus_x,minus_y,plus_x,plus_y", "plus_x,plus_y,minus_x,minus_y", 1);
    let message = decode(&swapped).unwrap_err();
    assert!(message.contains("mistaken for each other") && message.contains("20 pairs"), "{message}");
    // one pair that happens to be right does not hide the rest
    let good = text.lines().nth(1).expect("a pair").split(',').collect::<Vec<_>>();
    let message = decode(&format!("{swapped}{},{},{},{}\n", good[2], good[3], good[0], good[1])).unwrap_err();
    assert!(message.contains("mistaken for each other") && message.contains("20 pairs"), "{message}");
    // a gap and a pair that cannot be are rows with a status
    let found = decode(&format!("{text}1000,800,,\n2400,800,300,800\n")).unwrap();
    assert!(found.contains("20 of 22 pairs"), "{found}");
    let points = std::fs::read_to_string(folder.path().join("points.csv")).unwrap();
    let last: Vec<&str> = points.lines().rev().take(2).collect();
    assert!(last[1].contains("match:no_match") && last[0].contains("before_grating"), "{last:?}");
    for (bad, named) in [
        (text.replacen("minus_x", "minus", 1), "minus_x"),
        (format!("{text}inf,800,2300,800\n"), "row 21"),
        (text.replace('\n', ",-0.1\n").replacen("-0.1", "sigma_px", 1), "sigma_px"),
    ] {
        let message = decode(&bad).unwrap_err();
        assert!(message.contains(named), "{named}: {message}");
    }
}
