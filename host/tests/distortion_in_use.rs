//! Maps from `daic calibrate distortion` in an optics file, down to the heights of `daic profile`.

// The other test uses more of it.
#[allow(dead_code)]
mod target;

use daic_dataset::Table;
use daic_optics::{OpticalModel, View};
use nalgebra::{DMatrix, DVector};
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use target::{Lines, Noise, brightness, grey, save};

const SIZE: [usize; 2] = [640, 480];
const PITCH_MM: f64 = 0.9;
/// Half of the speckled plate.
const HALF_MM: [f64; 2] = [8.5, 9.0];

fn daic(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_daic")).args(arguments).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The golden set-up on a sensor a quarter as wide.
fn optics(folder: &Path) -> (PathBuf, OpticalModel) {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml");
    let toml = std::fs::read_to_string(golden)
        .unwrap()
        .replace("17956.216577540104 px", "4434 px")
        .replace("\"1295.5 px\", \"971.5 px\"", "\"319.5 px\", \"239.5 px\"");
    let path = folder.join("optics.toml");
    std::fs::write(&path, toml).unwrap();
    let file = daic_rig::experiment::OpticsFile::load(&path).unwrap();
    (path, daic::optics_section::from_section(&file.optics).unwrap().model().unwrap())
}

/// Both views of what lies in the plane at height h, each by `half`, as one frame.
fn frame(half: &dyn Fn(View, usize) -> Vec<f64>) -> Vec<f64> {
    let width = SIZE[0] / 2;
    let (minus, plus) = (half(View::Minus, 0), half(View::Plus, width));
    minus.chunks(width).zip(plus.chunks(width)).flat_map(|(a, b)| a.iter().chain(b).copied()).collect()
}

/// A flat speckled plate in the reference plane.
fn speckle(model: &OpticalModel) -> Vec<f64> {
    let mut random = Noise::new(21);
    // Waves of 4 to 12 px in all directions.
    let waves: Vec<[f64; 3]> = (0..80)
        .map(|_| {
            let (f, a) = (10.7 / (4.0 + 8.0 * random.uniform()), TAU * random.uniform());
            [f * a.cos(), f * a.sin(), random.uniform()]
        })
        .collect();
    frame(&|view, from| {
        (0..SIZE[0] / 2 * SIZE[1])
            .map(|k| {
                let o = [(from + k % (SIZE[0] / 2)) as f64, (k / (SIZE[0] / 2)) as f64];
                let p = model.point_at_height(view, o, 0.0).unwrap();
                // the plate stands before a dark background
                if p.x.abs() > HALF_MM[0] || p.y.abs() > HALF_MM[1] {
                    return 0.02;
                }
                let sum: f64 = waves.iter().map(|[a, b, c]| (TAU * (a * p.x + b * p.y + c)).cos()).sum();
                0.5 + 0.06 * sum
            })
            .collect()
    })
}

/// RMS of the heights less their best plane, µm.
fn unevenness(folder: &Path) -> f64 {
    let path = folder.join("points.csv");
    let table = Table::read_csv(&path).unwrap();
    let column = |name: &str| table.numbers(name, &path).unwrap();
    let (x, y, h) = (column("x_mm"), column("y_mm"), column("h_mm"));
    let good: Vec<usize> = (0..h.len()).filter(|k| h[*k].is_finite() && y[*k].abs() < 7.0).collect();
    assert!(good.len() > 200, "{}", good.len());
    let basis = DMatrix::from_fn(good.len(), 3, |r, c| [1.0, x[good[r]], y[good[r]]][c]);
    let h = DVector::from_iterator(good.len(), good.iter().map(|k| h[*k]));
    let plane = basis.clone().svd(true, true).solve(&h, 1e-12).unwrap();
    1e3 * (h - basis * plane).norm() / (good.len() as f64).sqrt()
}

#[test]
fn maps_through_the_grating_flatten_a_plate() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let (file, model) = optics(folder.path());
    for (name, lines) in [("x.png", Lines::CrossedByX), ("y.png", Lines::CrossedByY)] {
        let all = frame(&|view, from| {
            brightness([SIZE[0] / 2, SIZE[1]], lines, &|o: [f64; 2]| {
                let p = model.point_at_height(view, [o[0] + from as f64, o[1]], 0.0).unwrap();
                [p.x / PITCH_MM, p.y / PITCH_MM]
            })
        });
        save(&path(name), SIZE, grey(&all, &mut Noise::new(11)));
    }
    save(&path("plate.png"), SIZE, grey(&speckle(&model), &mut Noise::new(12)));
    let profile = |out: &str| {
        let (file, plate, out) = (file.clone(), path("plate.png"), path(out));
        let done = daic(&[
            "profile",
            "--decoder",
            "linear",
            "--optics",
            text(&file),
            text(&plate),
            "--out",
            text(&out),
        ]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        unevenness(&out)
    };
    let before = profile("without");
    let comment = "# measured by hand\n";
    std::fs::write(&file, comment.to_owned() + &std::fs::read_to_string(&file).unwrap()).unwrap();
    for view in ["minus", "plus"] {
        let out = path(view);
        let done = daic(&[
            "calibrate",
            "distortion",
            text(&path("x.png")),
            text(&path("y.png")),
            // in the reference plane: what looks like its tilt is the grating's perspective
            "--square",
            "--ideal",
            "pinhole",
            "--view",
            view,
            "--into",
            text(&file),
            "--out",
            text(&out),
        ]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        let said = String::from_utf8_lossy(&done.stdout).into_owned();
        assert!(said.contains(&format!("named as maps.{view} in")), "{said}");
    }
    let named = std::fs::read_to_string(&file).unwrap();
    assert!(named.starts_with(comment) && named.contains("file = \"minus/distortion.json\""), "{named}");
    let after = profile("with");
    println!("flat plate by `linear`: {before:.1} µm RMS without maps, {after:.1} µm with");
    // Without maps the bowl of the virtual object, 12.6; with them 2.3, of which 0.96 are the match's noise and 0.69 the
    // maps'.
    assert!(before > 12.0 && after < 2.5, "{before} {after}");

    // A map of the whole sensor would count twice what the views' maps hold, and the other way round.
    let out = path("sensor");
    let images = [path("x.png"), path("y.png")];
    let region = ["--region", "0,0,320,480"];
    let sensor = |into: &Path| {
        let mut all =
            vec!["calibrate", "distortion", text(&images[0]), text(&images[1]), "--out", text(&out)];
        all.extend(region);
        all.extend(["--into", text(into)]);
        daic(&all)
    };
    let refused = sensor(&file);
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && said.contains("maps.minus"), "{said}");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), named);
    // A damaged map is found out by its checksum.
    let map = path("minus").join("distortion.json");
    let bytes = std::fs::read_to_string(&map).unwrap().replacen("0.0", "0.1", 1);
    std::fs::write(&map, bytes).unwrap();
    let done = daic(&[
        "profile",
        "--decoder",
        "linear",
        "--optics",
        text(&file),
        text(&path("plate.png")),
        "--out",
        text(&out),
    ]);
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(!done.status.success() && said.contains("maps.minus") && said.contains("checksum"), "{said}");
}
