//! `daic calibrate microscope` and `daic plan` as a user runs them.

use daic::microscope::MicroscopeFile;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

struct Run {
    code: Option<i32>,
    out: String,
    err: String,
}

impl Run {
    fn json(&self) -> serde_json::Value {
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

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples").join(name)
}

/// β₁, β₂ in µm/px, β₃, β₄, centre: what the fields are made with.
const TRUTH: [f64; 6] = [2.295, 0.53, 2.12e-4, 2.0e-4, 322.0, 287.5];

/// A field by (3.1)–(3.2) on 9 × 9 points of the displacement (u, v, w) in µm as a function of (x, y) in
/// µm from the centre.
fn field(folder: &Path, name: &str, by: impl Fn(f64, f64) -> [f64; 3]) {
    let [b1, b2, b3, b4, xc, yc] = TRUTH;
    let mut text = String::from("x_px,y_px,u_minus_px,v_minus_px,u_plus_px,v_plus_px,status\n");
    for k in 0..81 {
        let (x, y) = (20.0 + 75.0 * f64::from(k % 9), 10.0 + 80.0 * f64::from(k / 9));
        let [u, v, w] = by(b2 * (x - xc), b2 * (y - yc));
        let common = u / b2 + b3 / b2 * (x - xc) * w;
        let across = v / b2 + b4 / b2 * (y - yc) * w;
        writeln!(text, "{x},{y},{},{across},{},{across},ok", common + w / b1, common - w / b1).expect("text");
    }
    // a point that failed
    text.push_str("1,1,nan,nan,nan,nan,not_converged\n");
    std::fs::write(folder.join(name), text).expect("written");
}

fn fields(folder: &Path) {
    field(folder, "z.csv", |_, _| [0.0, 0.0, 10.0]);
    field(folder, "x.csv", |_, _| [10.0, 0.0, 0.0]);
    let (sin, cos) = 6.0_f64.to_radians().sin_cos();
    field(folder, "tilt.csv", |x, _| [x * (cos - 1.0), 0.0, -x * sin]);
}

const Z: &str =
    "[[motion]]\nname = \"z\"\nfield = \"z.csv\"\ntranslation = [\"0 um\", \"0 um\", \"10 um\"]\n";
const X: &str =
    "[[motion]]\nname = \"x\"\nfield = \"x.csv\"\ntranslation = [\"10 um\", \"0 um\", \"0 um\"]\n";
const TILT: &str = "[[motion]]\nname = \"tilt\"\nfield = \"tilt.csv\"\nrotation = [\"0 deg\", \"6 deg\", \"0 deg\"]\nfit = false\n";

fn moves(folder: &Path, head: &str, motions: &[&str]) {
    std::fs::write(folder.join("moves.toml"), format!("{head}\n{}", motions.concat())).expect("written");
}

#[test]
fn calibrates_from_files() {
    let place = TempDir::new().expect("folder");
    let folder = place.path();
    fields(folder);
    moves(folder, "sigma = \"0.01 px\"\ndate = \"2026-01-31\"\nprovenance = \"made up\"\n", &[Z, X, TILT]);
    let arguments =
        ["calibrate", "microscope", "moves.toml", "--out", "scope.toml", "--report", "scope.html"];
    let run = daic(folder, &arguments);
    assert_eq!(run.code, Some(0), "{}\n{}", run.out, run.err);
    for words in ["beta1", "µm/px", "predicted, not in the fit", "wrote scope.toml"] {
        assert!(run.out.contains(words), "`{words}` is not in\n{}", run.out);
    }
    let file = MicroscopeFile::load(&folder.join("scope.toml")).expect("reads back");
    let m = &file.microscope;
    let found = [
        m.beta1_um_per_px,
        m.beta2_um_per_px,
        m.beta3_per_px,
        m.beta4_per_px,
        m.centre_px[0],
        m.centre_px[1],
    ];
    for (i, (found, truth)) in found.iter().zip(TRUTH).enumerate() {
        // the CSV holds every digit; rounding of the fit
        assert!((found / truth - 1.0).abs() < 1e-12, "{i}: {found} {truth}");
        // 162 points at 0.01 px: σ is there, and small
        let sigma = m.covariance[i][i].sqrt();
        assert!(sigma > 0.0 && sigma < 2e-3 * truth, "{i}: {sigma}");
    }
    assert_eq!((file.format.as_str(), file.date.as_str()), ("daic-microscope/1", "2026-01-31"));
    assert!(file.provenance.contains("made up") && file.provenance.contains("moves.toml"));
    assert_eq!(file.fit.motion.len(), 3);
    assert!(!file.fit.motion[2].fitted && file.fit.motion[2].rms_um[2] < 1e-9);
    let page = std::fs::read_to_string(folder.join("scope.html")).expect("report");
    assert!(page.contains("Residuals of tilt") && page.contains("<svg"));

    // the same input gives the same file, whatever the number of threads
    let before = std::fs::read(folder.join("scope.toml")).expect("file");
    let run =
        daic(folder, &["calibrate", "microscope", "moves.toml", "--out", "scope.toml", "--threads", "1"]);
    assert_eq!(run.code, Some(0));
    assert_eq!(std::fs::read(folder.join("scope.toml")).expect("file"), before);

    // σ of overlapping subsets: (33/5)² points share their noise
    moves(folder, "sigma = \"0.01 px\"\ncorrelation = { subset = \"33 px\", step = \"5 px\" }\n", &[Z, X]);
    let shared = daic(folder, &["calibrate", "microscope", "moves.toml", "--json"]).json();
    let sigma = shared["values"][0]["sigma"].as_f64().expect("σ");
    let alone = m.covariance[0][0].sqrt();
    assert!((sigma / alone / 6.6 - 1.0).abs() < 1e-6, "{sigma} {alone}");
}

#[test]
fn says_what_is_open() {
    let place = TempDir::new().expect("folder");
    let folder = place.path();
    fields(folder);
    moves(folder, "sigma = \"0.01 px\"", &[Z]);
    let run = daic(folder, &["calibrate", "microscope", "moves.toml", "--out", "scope.toml", "--json"]);
    // a check that did not hold
    assert_eq!(run.code, Some(1), "{}", run.err);
    let json = run.json();
    assert_eq!(json["undetermined"], serde_json::json!(["beta2", "beta3", "beta4"]));
    assert_eq!(json["add"], serde_json::json!(["a known in-plane move along x"]));
    let names: Vec<_> = json["values"].as_array().expect("values").iter().map(|v| &v["name"]).collect();
    assert_eq!(names, ["beta1", "centre_x", "centre_y", "beta3/beta2", "beta4/beta2"]);
    assert!(!folder.join("scope.toml").exists());
}

#[test]
fn bad_files_are_refused_by_name() {
    let place = TempDir::new().expect("folder");
    let folder = place.path();
    fields(folder);
    let refused = |words: &[&str]| {
        let run = daic(folder, &["calibrate", "microscope", "moves.toml", "--out", "scope.toml", "--json"]);
        assert_eq!(run.code, Some(2), "{}\n{}", run.out, run.err);
        let error = run.json()["error"].as_str().expect("text").to_owned();
        for word in words {
            assert!(error.contains(word), "`{word}` is not in: {error}");
        }
        assert!(!folder.join("scope.toml").exists());
    };
    let sigma = "sigma = \"0.01 px\"";
    moves(folder, "sigmas = \"0.01 px\"", &[Z, X]);
    refused(&["moves.toml", "line 1", "sigmas"]);
    moves(folder, "sigma = \"0 px\"", &[Z, X]);
    refused(&["sigma", "above 0"]);
    moves(folder, "format = \"daic-moves/2\"", &[Z, X]);
    refused(&["daic-moves/2", "daic-moves/1"]);
    moves(folder, "", &[Z, X]);
    refused(&["z.csv", "sigma_px", "sigma ="]);
    moves(folder, sigma, &["[[motion]]\nname = \"z\"\nfield = \"z.csv\"\n"]);
    refused(&["motion[0]", "neither translation nor rotation"]);
    moves(folder, sigma, &[&Z.replace("10 um", "10")]);
    refused(&["moves.toml", "line 5", "unit", "unknown"]);
    moves(folder, sigma, &[&Z.replace("z.csv", "none.csv")]);
    refused(&["none.csv"]);
    std::fs::write(folder.join("bare.csv"), "x_px,y_px,u_minus_px\n1,2,3\n").expect("written");
    moves(folder, sigma, &[&Z.replace("z.csv", "bare.csv")]);
    refused(&["bare.csv", "v_minus_px"]);
    std::fs::write(
        folder.join("bare.csv"),
        "x_px,y_px,u_minus_px,v_minus_px,u_plus_px,v_plus_px\n1,2,3,4,5,6\n1,2,nan,4,5,6\n",
    )
    .expect("written");
    refused(&["bare.csv", "line 3", "not finite"]);
    // −1 and +1 mistaken
    field(folder, "z.csv", |_, _| [0.0, 0.0, -10.0]);
    moves(folder, sigma, &[Z, X]);
    refused(&["swapped"]);

    // a damaged calibration names the field
    fields(folder);
    moves(folder, sigma, &[Z, X]);
    assert_eq!(daic(folder, &["calibrate", "microscope", "moves.toml", "--out", "good.toml"]).code, Some(0));
    let good = std::fs::read_to_string(folder.join("good.toml")).expect("file");
    let load = |text: &str| {
        std::fs::write(folder.join("bad.toml"), text).expect("written");
        MicroscopeFile::load(&folder.join("bad.toml")).expect_err("refused").to_string()
    };
    let line = |key: &str| good.lines().find(|l| l.starts_with(key)).expect("key").to_owned();
    let error = load(&good.replace(&line("beta1_um_per_px"), "beta1_um_per_px = -1.0"));
    assert!(error.contains("beta1"), "{error}");
    let error = load(&good.replace(&line("covariance"), "covariance = 1"));
    assert!(error.contains("line") && error.contains("bad.toml"), "{error}");
    let error = load(&good.replace(&line("beta2_um_per_px"), ""));
    assert!(error.contains("beta2_um_per_px"), "{error}");
    let error = load(&good.replace("daic-microscope/1", "daic-microscope/9"));
    assert!(error.contains("daic-microscope/9"), "{error}");
}

#[test]
fn plans_a_set_up() {
    let place = TempDir::new().expect("folder");
    let optics = example("golden-macro.toml");
    let optics = optics.to_str().expect("path");
    let run = daic(place.path(), &["plan", optics]);
    assert_eq!(run.code, Some(0), "{}", run.err);
    for words in [
        "10.95°",
        "b' = 23.5",
        "2592 × 1944",
        "warning: the bandwidth",
        "suggestion: light of at most",
        "400 lines/mm",
    ] {
        assert!(run.out.contains(words), "`{words}` is not in\n{}", run.out);
    }
    let json = daic(place.path(), &["plan", optics, "--sigma", "0.09", "--json"]).json();
    let near = |value: &serde_json::Value, expected: f64, by: f64| {
        let value = value.as_f64().expect("number");
        assert!((value - expected).abs() < by, "{value} {expected}");
    };
    near(&json["paraxial"]["angle_deg"], 10.95, 0.005);
    near(&json["paraxial"]["pixel_mm"], 0.0235, 5e-5);
    near(&json["light"]["smear_paraxial_px"], 2.9, 0.05);
    near(&json["light"]["drift_h_paraxial_mm"], 0.025, 0.0005);
    assert!(json["warning_texts"].as_array().is_some_and(|w| !w.is_empty()));

    let wide =
        daic(place.path(), &["plan", optics, "--specimen", "26 mm,4 mm", "--heights", "0 mm,0 mm", "--json"]);
    let texts = wide.json()["warning_texts"].to_string();
    assert!(texts.contains("zeroth order overlap"), "{texts}");

    let fine = std::fs::read_to_string(example("golden-macro.toml"))
        .expect("example")
        .replace("300 /mm", "1600 /mm");
    std::fs::write(place.path().join("fine.toml"), fine).expect("written");
    let run = daic(place.path(), &["plan", "fine.toml"]);
    assert_eq!(run.code, Some(2));
    assert!(run.err.contains("no first order"), "{}", run.err);
    let run = daic(place.path(), &["plan", optics, "--heights", "2,3"]);
    assert_eq!(run.code, Some(2));
    assert!(run.err.contains("unit"), "{}", run.err);

    // an experiment file brings its camera
    assert_eq!(daic(place.path(), &["init", "e.toml"]).code, Some(0));
    let run = daic(place.path(), &["plan", "e.toml"]);
    assert_eq!(run.code, Some(0), "{}", run.err);
    assert!(run.out.contains("of the experiment's camera"), "{}", run.out);
}
