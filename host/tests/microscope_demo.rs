//! `daic demo --scene microscope`, `daic track` and what they leave, as a user runs them.
#![cfg(feature = "sim")]

use daic::microscope::MicroscopeFile;
use daic_dataset::{Dataset, FrameRole, Table};
use daic_hil_sim::config::MicroscopeConfig;
use daic_optics::microscope::RayMicroscope;
use serde_json::Value;
use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

struct Run {
    code: Option<i32>,
    out: String,
    err: String,
}

impl Run {
    fn json(&self) -> Value {
        serde_json::from_str(&self.out).unwrap_or_else(|e| panic!("{e}:\n{}\n{}", self.out, self.err))
    }
}

fn daic(folder: &Path, arguments: &[&str]) -> Run {
    let output = Command::new(env!("CARGO_BIN_EXE_daic"))
        .args(arguments)
        .current_dir(folder)
        .output()
        .expect("daic starts");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    Run { code: output.status.code(), out: text(output.stdout), err: text(output.stderr) }
}

/// The calibration moves and the measured one, from the built-in template: micrometres.
const MOVES_UM: [(&str, [f64; 3]); 5] = [
    ("cal_z_plus", [0.0, 0.0, 10.0]),
    ("cal_z_minus", [0.0, 0.0, -10.0]),
    ("cal_x", [10.0, 0.0, 0.0]),
    ("cal_y", [0.0, 10.0, 0.0]),
    ("moved", [4.0, -3.0, 6.0]),
];

/// One run serves all: rendering takes seconds.
#[test]
fn a_move_under_the_microscope_comes_back() {
    let place = TempDir::new().expect("folder");
    let folder = place.path();
    let run = daic(folder, &["demo", "--scene", "microscope", "--json", "--quiet", "--out", "demo"]);
    assert_eq!(run.code, Some(0), "{}\n{}", run.out, run.err);
    let summary = run.json();
    eprintln!("{summary:#}");
    assert_eq!(summary["passed"], true);
    assert_eq!(summary["frames"]["paired"], 6);
    assert_eq!(summary["edge_error_ticks_max"], 0);

    // what the summary says follows from the table alone
    let dataset = Dataset::open(&folder.join("demo")).expect("a dataset");
    let frames = dataset.frames().expect("frames").records;
    let of = |name: &str| frames.iter().find(|f| f.name == name).expect(name);
    assert_eq!(of("moved").role, FrameRole::Measurement);
    let path = dataset.frame_results(of("moved").id).join("points.csv");
    let table = Table::read_csv(&path).expect("points");
    let status = table.texts("status", &path).expect("status");
    let ok = status.iter().filter(|s| *s == "ok").count();
    assert!(ok as f64 > 0.99 * status.len() as f64, "{ok} of {}", status.len());
    let (_, moved_um) = MOVES_UM[4];
    for (i, name) in ["u_mm", "v_mm", "w_mm"].into_iter().enumerate() {
        let values = table.numbers(name, &path).expect("numbers");
        let squares: f64 = values
            .iter()
            .zip(&status)
            .filter(|(_, s)| *s == "ok")
            .map(|(v, _)| (1e3 * v - moved_um[i]).powi(2))
            .sum();
        let rms = (squares / ok as f64).sqrt();
        assert!((rms - summary["rms_um"][i].as_f64().expect("a number")).abs() < 1e-9, "{name}");
        // The literature's set-up: 0.038, 0.022 and 0.232 µm for a translation of 10 µm.
        // Measured: 0.0020, 0.0020, 0.0043.
        assert!(rms < [0.003, 0.003, 0.006][i], "{name}: {rms} µm");
    }

    // the calibration is that of the simulated geometry
    let calibration = folder.join("demo/results/calibration");
    let file = MicroscopeFile::load(&calibration.join("microscope.toml")).expect("reads back");
    let geometry = MicroscopeConfig::default().geometry(1440, 720);
    let (truth, _) = RayMicroscope::new(&geometry).expect("valid").parameters().expect("seen");
    let m = &file.microscope;
    for (name, found, truth, sigma) in [
        ("beta1", m.beta1_um_per_px, 1e3 * truth.beta1_mm_per_px, m.covariance[0][0].sqrt()),
        ("beta2", m.beta2_um_per_px, 1e3 * truth.beta2_mm_per_px, m.covariance[1][1].sqrt()),
        ("beta3", m.beta3_per_px, truth.beta3_per_px, m.covariance[2][2].sqrt()),
        ("beta4", m.beta4_per_px, truth.beta4_per_px, m.covariance[3][3].sqrt()),
        ("x_c", m.centre_px[0], truth.centre_px[0], m.covariance[4][4].sqrt()),
        ("y_c", m.centre_px[1], truth.centre_px[1], m.covariance[5][5].sqrt()),
    ] {
        eprintln!("{name}: {found:.6e} ± {sigma:.1e}, geometry {truth:.6e}");
        // five standard deviations, and a thousandth for what interpolation does to each of them
        assert!(
            (found - truth).abs() < 5.0 * sigma + 1e-3 * truth.abs(),
            "{name}: {found} ± {sigma}, not {truth}"
        );
    }

    // `daic calibrate microscope` takes what is left as it is
    let again =
        daic(&calibration, &["calibrate", "microscope", "moves.toml", "--out", "again.toml", "--json"]);
    assert_eq!(again.code, Some(0), "{}", again.err);
    let again = MicroscopeFile::load(&calibration.join("again.toml")).expect("reads back");
    assert_eq!(again.microscope, file.microscope);

    // processing again finds everything done, also with one thread
    let processed = daic(folder, &["process", "demo", "--json", "--quiet", "--threads", "1"]);
    assert_eq!(processed.code, Some(0), "{}", processed.err);
    assert_eq!(processed.json(), summary);

    // `daic track` on the recorded frames makes the same displacements
    let file_of = |name: &str| {
        let path = folder.join("demo").join(of(name).file.as_ref().expect("a file"));
        path.to_str().expect("UTF-8").to_owned()
    };
    let (reference, z) = (file_of("reference"), file_of("cal_z_plus"));
    let arguments = [
        "track",
        &reference,
        &z,
        "--roi",
        "114,97,485,526",
        "--subset",
        "41",
        "--step",
        "8",
        "--shape",
        "affine",
        "--out",
        "fields",
        "--json",
        "--quiet",
    ];
    let tracked = daic(folder, &arguments);
    assert_eq!(tracked.code, Some(0), "{}\n{}", tracked.out, tracked.err);
    let field = tracked.json()["frames"][0]["field"].as_str().expect("a path").to_owned();
    let path = folder.join(&field);
    let (alone, stored) = (
        Table::read_csv(&path).expect("field"),
        Table::read_csv(&calibration.join("cal_z_plus.csv")).expect("field"),
    );
    for name in ["x_minus_px", "x_plus_px", "u_minus_px", "v_plus_px", "sigma_u_plus_px"] {
        let both = [&alone, &stored].map(|t| t.numbers(name, &path).expect("numbers"));
        assert!(both[0].iter().zip(&both[1]).all(|(a, b)| a.to_bits() == b.to_bits()), "{name}");
    }
    assert!(alone.column("h_um").is_none());
}

/// Options that the microscope does not have, and moves that leave its scale open, are refused by name.
#[test]
fn what_cannot_be_is_refused() {
    let place = TempDir::new().expect("folder");
    let folder = place.path();
    for (arguments, words) in [
        (&["--no-calibration"][..], "--scene macro"),
        (&["--pitch-factor", "1.01"], "--scene macro"),
        (&["--move", "0.05,0,0"], "0.012"),
    ] {
        let all = [&["demo", "--scene", "microscope", "--out", "demo"][..], arguments].concat();
        let run = daic(folder, &all);
        assert_eq!(run.code, Some(2), "{}", run.out);
        assert!(run.err.contains(words), "{}", run.err);
        assert!(!folder.join("demo").exists());
    }
    let run = daic(folder, &["init", "--microscope", "scope.toml"]);
    assert_eq!(run.code, Some(0), "{}", run.err);
    let text = std::fs::read_to_string(folder.join("scope.toml")).expect("written");
    assert!(text.contains("[microscope]") && text.contains("cal_z_plus"));
}
