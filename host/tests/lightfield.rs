//! `daic lightfield` from image files to volumes.

use daic::lightfield::psf_file;
use daic_dataset::read_stack;
use daic_lightfield::{Operator, OperatorSettings, Psf};
use image::{ImageBuffer, Luma};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Pixels and voxels of a lenslet, planes.
const N: usize = 9;
const S: usize = 3;
const PLANES: usize = 5;

fn daic(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_daic")).args(arguments).output().expect("daic starts")
}

fn json(arguments: &[&str]) -> Value {
    let output = daic(&[arguments, &["--json"]].concat());
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one JSON object")
}

/// What a failing command says, on one line.
fn refused(arguments: &[&str]) -> String {
    let output = daic(arguments);
    assert!(!output.status.success(), "{arguments:?} was not refused");
    let said = String::from_utf8_lossy(&output.stderr).replace(['\n', '│', '×'], " ");
    said.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// The template made small.
fn setup(folder: &Path, name: &str, changes: &[(&str, &str)]) -> PathBuf {
    let path = folder.join(name);
    let init = daic(&["lightfield", "init", text(&path)]);
    assert!(init.status.success(), "{}", String::from_utf8_lossy(&init.stderr));
    let mut toml = fs::read_to_string(&path).expect("template");
    let small = [
        ("pixels = 15", "pixels = 9"),
        ("first_um = -20.0", "first_um = -10.0"),
        ("last_um = 20.0", "last_um = 10.0"),
        ("step_um = 2.5", "step_um = 5.0"),
        ("# [psf]", "[psf]\nradius = 2\nsamples = 8\ntolerance = 0.1"),
    ];
    for (from, to) in small.iter().chain(changes) {
        assert!(toml.contains(from), "{from}");
        toml = toml.replacen(from, to, 1);
    }
    fs::write(&path, toml).expect("written");
    path
}

fn save(path: &Path, width: usize, values: &[f32], scale: f32) {
    let data: Vec<u16> = values.iter().map(|v| (v * scale).round().clamp(0.0, 65_534.0) as u16).collect();
    let height = values.len() / width;
    ImageBuffer::<Luma<u16>, _>::from_raw(width as u32, height as u32, data)
        .expect("size")
        .save(path)
        .expect("written");
}

/// Where lenslets are on the camera, from (cell coordinates).
const ORIGIN: [f64; 2] = [92.3, 81.6];
const ALONG_X: [f64; 2] = [13.37, 0.05];
const ALONG_Y: [f64; 2] = [-0.05, 13.37];
const SIZE: [usize; 2] = [190, 170];

fn cell_of(x: f64, y: f64) -> [f64; 2] {
    let det = ALONG_X[0] * ALONG_Y[1] - ALONG_X[1] * ALONG_Y[0];
    let d = [x - ORIGIN[0], y - ORIGIN[1]];
    [(d[0] * ALONG_Y[1] - d[1] * ALONG_Y[0]) / det, (ALONG_X[0] * d[1] - ALONG_X[1] * d[0]) / det]
}

/// An image of the camera from light per cell coordinate.
fn camera(light: impl Fn(f64, f64) -> f64) -> Vec<f32> {
    let part = |i: usize| (i as f64 + 0.5) / 3.0 - 0.5;
    (0..SIZE[0] * SIZE[1])
        .map(|i| {
            let (x, y) = ((i % SIZE[0]) as f64, (i / SIZE[0]) as f64);
            let sum: f64 = (0..9)
                .map(|s| {
                    let [u, v] = cell_of(x + part(s % 3), y + part(s / 3));
                    light(u, v)
                })
                .sum();
            (sum / 9.0) as f32
        })
        .collect()
}

fn white() -> Vec<f32> {
    camera(|u, v| {
        let r = (u - u.round()).hypot(v - v.round());
        50.0 + 2000.0 / (1.0 + ((r - 0.42) / 0.04).exp()) * (1.0 - 0.003 * (u * u + v * v))
    })
}

/// Image of a bead at voxel (z, y, x) of a volume of 11 × 11 cells.
fn bead(psf: &Psf, at: [usize; 3]) -> Vec<f32> {
    let operator = Operator::new(psf, &OperatorSettings::new([11; 2])).expect("operator");
    let side = 11 * S;
    let mut volume = vec![0f32; PLANES * side * side];
    volume[(at[0] * side + at[1]) * side + at[2]] = 1.0;
    operator.project(&[&volume]).expect("projection").remove(0)
}

/// Sums over everything but one axis.
fn highest(volume: &[f32], shape: [usize; 3]) -> [usize; 3] {
    let top = (0..volume.len()).max_by(|&a, &b| volume[a].total_cmp(&volume[b])).expect("voxels");
    [top / (shape[1] * shape[2]), top / shape[2] % shape[1], top % shape[2]]
}

#[test]
fn from_white_image_to_volume() {
    let dir = tempfile::tempdir().expect("folder");
    let path = |name: &str| dir.path().join(name);
    let setup = setup(dir.path(), "microscope.toml", &[]);
    let stored = path("stored.psf");

    let first = json(&["lightfield", "psf", text(&setup), "--out", text(&stored)]);
    assert_eq!(first["reused"], false);
    let again = json(&["lightfield", "psf", text(&setup), "--out", text(&stored)]);
    assert_eq!((&again["reused"], &again["hash"]), (&Value::Bool(true), &first["hash"]));

    save(&path("white.png"), SIZE[0], &white(), 20.0);
    let lattice = json(&[
        "lightfield",
        "calibrate",
        text(&path("white.png")),
        "--out",
        text(&path("lattice.toml")),
        "--overlay",
        text(&path("overlay.svg")),
    ]);
    let pitch = ALONG_X[0].hypot(ALONG_X[1]);
    for axis in 0..2 {
        let found = lattice["pitch_px"][axis]["value"].as_f64().expect("a number");
        assert!((found / pitch - 1.0).abs() < 1e-3, "{found} {pitch}");
    }
    assert!(fs::read_to_string(path("overlay.svg")).expect("overlay").contains("<svg"));

    // a bead, once on an ideal sensor and once on the camera
    let psf = psf_file::read(&stored).expect("stored");
    let at = [3, 17, 13];
    let image = bead(&psf, at);
    let largest = image.iter().copied().fold(0.0, f32::max);
    save(&path("ideal.png"), 11 * N, &image, 30_000.0 / largest);
    let seen = camera(|u, v| {
        // cell (0, 0) of the lattice is the middle of the ideal sensor
        let [x, y] = [u, v].map(|c| (c + 5.5) * N as f64 - 0.5);
        let (fx, fy) = (x.floor(), y.floor());
        let value = |x: f64, y: f64| {
            let inside = x >= 0.0 && y >= 0.0 && x < (11 * N) as f64 && y < (11 * N) as f64;
            if inside { f64::from(image[y as usize * 11 * N + x as usize]) } else { 0.0 }
        };
        let (s, t) = (x - fx, y - fy);
        (1.0 - t) * ((1.0 - s) * value(fx, fy) + s * value(fx + 1.0, fy))
            + t * ((1.0 - s) * value(fx, fy + 1.0) + s * value(fx + 1.0, fy + 1.0))
    });
    save(&path("seen.png"), SIZE[0], &seen, 30_000.0 / largest);

    let command = |frame: &str, out: &str, more: &[&str]| -> Vec<String> {
        let (frame, out) = (path(frame), path(out));
        let basic = ["lightfield", "reconstruct", text(&setup), text(&frame), "--out", text(&out)];
        let all = [&basic[..], &["--psf", text(&stored)], more].concat();
        all.into_iter().map(str::to_owned).collect()
    };
    let run = |c: &[String]| json(&c.iter().map(String::as_str).collect::<Vec<_>>());
    let whole = command("ideal.png", "a", &["--format", "tiff,ome-tiff,ome-zarr", "--background", "0"]);
    let tiff = command("ideal.png", "a", &["--background", "0"]);
    let summary = run(&tiff);
    assert!(!path("a/ideal.ome.tif").exists());
    // what is asked for later is made then
    assert_eq!(run(&whole)["resumed"], 0);
    assert_eq!(summary["psf_reused"], true);
    let shape = [PLANES, 11 * S, 11 * S];
    let (values, found) = read_stack(&path("a/ideal.tif")).expect("stack");
    assert_eq!((found, highest(&values, shape)), (shape, at));
    assert!(path("a/ideal.ome.tif").is_file() && path("a/ideal.ome.zarr/zarr.json").is_file());
    assert!(path("a/ideal-xz.png").is_file());
    assert!(fs::read_to_string(path("a/ideal.html")).expect("page").contains("z = 5.00 µm"));
    let residuals = summary["frames"][0]["residuals"].as_array().expect("residuals");
    assert!(residuals.last().and_then(Value::as_f64) < residuals[1].as_f64(), "{residuals:?}");
    // what is there is not computed again
    for same in [&whole, &tiff] {
        assert_eq!(run(same)["resumed"], 1);
    }
    // nor mistaken for another frame of that name
    let other: Vec<f32> = image.iter().rev().copied().collect();
    save(&path("ideal.png"), 11 * N, &other, 30_000.0 / largest);
    let said = refused(&whole.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(
        said.contains("ideal.json") && said.contains("changed") && said.contains("--overwrite"),
        "{said}"
    );
    let anew: Vec<String> = whole.iter().cloned().chain(["--overwrite".to_owned()]).collect();
    assert_eq!(run(&anew)["resumed"], 0);
    let (values, _) = read_stack(&path("a/ideal.tif")).expect("stack");
    let [_, y, x] = highest(&values, shape);
    assert_eq!([y, x], [11 * S - 1 - at[1], 11 * S - 1 - at[2]]);

    // ISRA says which way it went; by the stored normal matrix, where the sensor catches all light
    save(&path("ideal.png"), 11 * N, &image, 30_000.0 / largest);
    let isra = |out: &str, more: &[&str]| {
        run(&command("ideal.png", out, &[&["--method", "isra", "--background", "0"], more].concat()))
    };
    let said = isra("c", &[])["path"].clone();
    assert!(said.as_str().expect("words").contains("does not catch all light"), "{said}");
    let said = isra("d", &["--inset", "2"])["path"].clone();
    assert!(said.as_str().expect("words").contains("normal matrix"), "{said}");
    let (values, inner) = read_stack(&path("d/ideal.tif")).expect("stack");
    assert_eq!(inner, [PLANES, 7 * S, 7 * S]);
    assert_eq!(highest(&values, inner), [at[0], at[1] - 2 * S, at[2] - 2 * S]);

    let (lattice, white) = (path("lattice.toml"), path("white.png"));
    let corrected = ["--lattice", text(&lattice), "--white", text(&white)];
    run(&command("seen.png", "b", &[&corrected[..], &["--storage", "f16", "--momentum"]].concat()));
    let (values, shape) = read_stack(&path("b/seen.tif")).expect("stack");
    let [_, height, width] = shape;
    let found = highest(&values, shape);
    // the same bead among the whole cells of the camera, which are counted from another corner
    let from_middle = |v: usize, cells: usize| v as f64 - 0.5 * (cells * S) as f64;
    let corner = [SIZE[1], SIZE[0]].map(|n| (n as f64 / pitch).floor());
    assert!(height / S <= corner[0] as usize && width / S <= corner[1] as usize);
    assert_eq!(found[0], at[0], "{found:?}");
    for axis in 0..2 {
        let cells = [height, width][axis] / S;
        let shift = from_middle(found[1 + axis], cells) - from_middle(at[1 + axis], 11);
        // whole cells, up to half a one where their number is even
        let off = (shift / S as f64 * 2.0).round() * 0.5 * S as f64 - shift;
        assert!(off.abs() <= 1.0, "{found:?} {shift}");
    }
}

#[test]
fn bad_input_is_named_and_leaves_nothing() {
    let dir = tempfile::tempdir().expect("folder");
    let path = |name: &str| dir.path().join(name);
    let good = setup(dir.path(), "good.toml", &[]);
    let stored = path("stored.psf");
    json(&["lightfield", "psf", text(&good), "--out", text(&stored)]);
    save(&path("white.png"), SIZE[0], &white(), 20.0);
    let lattice = path("lattice.toml");
    json(&["lightfield", "calibrate", text(&path("white.png")), "--out", text(&lattice)]);
    let frame = path("frame.png");
    let even: Vec<f32> = (0..121 * N * N).map(|i| 100.0 + (i % 7) as f32).collect();
    save(&frame, 11 * N, &even, 1.0);
    let out = path("out");
    let reconstruct = |setup: &Path, frame: &Path, more: &[&str]| {
        let basic = ["lightfield", "reconstruct", text(setup), text(frame), "--out", text(&out)];
        let said = refused(&[&basic, more].concat());
        let left: Vec<_> = fs::read_dir(&out).map_or_else(|_| Vec::new(), |d| d.flatten().collect());
        assert!(left.is_empty(), "{said}: left {left:?}");
        said
    };
    let psf = ["--psf", text(&stored)];

    // sizes
    let said = reconstruct(&good, &frame, &["--lattice", text(&lattice), psf[0], psf[1]]);
    assert!(said.contains("99 99 pixels") && said.contains("190 170"), "{said}");
    save(&path("odd.png"), 100, &vec![100.0; 9900], 1.0);
    let said = reconstruct(&good, &path("odd.png"), &psf);
    assert!(said.contains("no whole number of lenslets of 9 pixels"), "{said}");
    // saturated
    ImageBuffer::<Luma<u16>, _>::from_fn(99, 99, |x, y| Luma([if (x, y) == (7, 5) { 65_535 } else { 300 }]))
        .save(path("bright.png"))
        .expect("written");
    let said = reconstruct(&good, &path("bright.png"), &psf);
    assert!(said.contains("saturated") && said.contains("(7, 5)"), "{said}");
    // no light, or a dark image that is brighter everywhere
    save(&path("black.png"), 99, &vec![0.0; 9801], 1.0);
    let said = reconstruct(&good, &path("black.png"), &psf);
    assert!(said.contains("no light"), "{said}");
    let said = reconstruct(&good, &path("black.png"), &[psf[0], psf[1], "--dark", text(&frame)]);
    assert!(said.contains("no light"), "{said}");
    // memory
    let said = reconstruct(&good, &frame, &[psf[0], psf[1], "--memory", "0"]);
    assert!(said.contains("MiB"), "{said}");
    // nothing left
    let said = reconstruct(&good, &frame, &[psf[0], psf[1], "--inset", "6"]);
    assert!(said.contains("inset of 6") && said.contains("nothing of 11 11"), "{said}");
    // planes that the stored point spread function does not have
    let deeper = setup(dir.path(), "deeper.toml", &[("last_um = 10.0", "last_um = 15.0")]);
    let said = reconstruct(&deeper, &frame, &psf);
    assert!(said.contains("another setup") && said.contains("volume"), "{said}");
    // setups that cannot be
    let grating = ("# [grating]", "[grating]\npitch_um = 0.4\nmodel = \"virtual\"\n#");
    let evanescent = setup(dir.path(), "evanescent.toml", &[grating]);
    let said = reconstruct(&evanescent, &frame, &["--minus", text(&frame)]);
    assert!(said.contains("evanescent"), "{said}");
    let wide = setup(dir.path(), "wide.toml", &[("na = 0.5", "na = 1.0")]);
    let said = reconstruct(&wide, &frame, &[]);
    assert!(said.contains("aperture"), "{said}");
    let coarse = setup(dir.path(), "coarse.toml", &[("samples = 8", "samples = 2")]);
    let said = reconstruct(&coarse, &frame, &[]);
    assert!(said.contains("sampl"), "{said}");
    // an interrupted file
    let bytes = fs::read(&stored).expect("stored");
    fs::write(path("cut.psf"), &bytes[..bytes.len() / 2]).expect("written");
    let said = reconstruct(&good, &frame, &["--psf", text(&path("cut.psf"))]);
    assert!(said.contains("damaged"), "{said}");
    // no lattice
    let mut state = 1u32;
    let noise: Vec<f32> = (0..200 * 200)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            1000.0 + (state >> 24) as f32
        })
        .collect();
    save(&path("noise.png"), 200, &noise, 1.0);
    let nowhere = path("nowhere.toml");
    let said = refused(&["lightfield", "calibrate", text(&path("noise.png")), "--out", text(&nowhere)]);
    assert!(said.contains("noise.png") && !nowhere.exists(), "{said}");
    let said = refused(&["lightfield", "calibrate", text(&path("white.png")), "--dark", text(&frame)]);
    assert!(said.contains("99") && said.contains("190"), "{said}");
}
