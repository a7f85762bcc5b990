//! `daic calibrate camera` and `daic align` from image files to result files.

#[path = "../crates/optics/tests/rendering/mod.rs"]
mod rendering;

use daic::camera_file::CameraFile;
use daic_optics::{Brown, Camera};
use rendering::{Image, Pose, checker, dots, render};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const W: usize = 480;
const H: usize = 360;

fn camera() -> Camera {
    Camera {
        focal_px: 600.0,
        principal_point_px: [243.0, 176.0],
        brown: Brown { k1: -0.1, ..Brown::default() },
    }
}

fn daic(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_daic")).args(arguments).output().expect("daic starts")
}

fn json(arguments: &[&str]) -> Value {
    let output = daic(arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one JSON object")
}

fn save(folder: &Path, name: &str, image: &Image) -> PathBuf {
    let path = folder.join(name);
    let grey = image.data.iter().map(|v| *v as u8).collect();
    image::GrayImage::from_raw(image.width as u32, image.height as u32, grey)
        .expect("size")
        .save(&path)
        .expect("written");
    path
}

/// A board of 13 × 9 points, 6 mm apart, its middle on the axis.
fn tilted(degrees: [f64; 3], distance: f64) -> Pose {
    let mut pose = Pose::new(degrees, [0.0; 3]);
    let middle = pose.rotation * nalgebra::Vector3::new(36.0, 24.0, 0.0);
    pose.translation = nalgebra::Vector3::new(0.0, 0.0, distance) - middle;
    pose
}

fn board(pose: &Pose, checkers: bool, seed: u64) -> Image {
    let clean = if checkers {
        render(&camera(), pose, W, H, checker(13, 9, 6.0))
    } else {
        render(&camera(), pose, W, H, dots(13, 9, 6.0, 1.8))
    };
    clean.blurred(0.8).lit(200.0, 40.0, |x, _| 1.0 - 0.0005 * x).recorded(2.0, 255.0, seed)
}

fn spots(at: &[[f64; 2]]) -> Image {
    let data = (0..W * H)
        .map(|k| {
            let (x, y) = ((k % W) as f64, (k / W) as f64);
            let sum: f64 =
                at.iter().map(|p| (-0.5 * ((x - p[0]).powi(2) + (y - p[1]).powi(2)) / 9.0).exp()).sum();
            (20.0 + 180.0 * sum) as f32
        })
        .collect();
    Image { width: W, height: H, data }.recorded(2.0, 255.0, 7)
}

const TILTS: [[f64; 3]; 5] =
    [[28.0, 0.0, 4.0], [-28.0, 4.0, -8.0], [0.0, 30.0, 0.0], [4.0, -30.0, 12.0], [20.0, 20.0, 0.0]];

fn path(p: &Path) -> &str {
    p.to_str().expect("UTF-8")
}

#[test]
fn camera_from_images_and_the_distance_of_a_board() {
    let folder = tempfile::TempDir::new().expect("folder");
    let at = |name: &str| folder.path().join(name);
    for (checkers, name) in [(false, "dots"), (true, "checker")] {
        let mut images: Vec<PathBuf> = TILTS
            .iter()
            .enumerate()
            .map(|(k, t)| {
                save(
                    folder.path(),
                    &format!("{name}-{k}.png"),
                    &board(&tilted(*t, 110.0), checkers, k as u64),
                )
            })
            .collect();
        // One that shows no board is skipped and named.
        images.push(save(folder.path(), &format!("{name}-none.png"), &spots(&[[100.0, 100.0]])));
        let out = at(&format!("camera-{name}"));
        let mut arguments = vec!["calibrate", "camera", "--board", name, "--pitch", "6", "--json", "--quiet"];
        arguments.extend(["--columns", "13", "--rows", "9", "--fix", "k2,k3,p1,p2", "--out", path(&out)]);
        arguments.extend(images.iter().map(|p| path(p)));
        let answer = json(&arguments);
        assert_eq!(answer["skipped"].as_array().expect("list").len(), 1);
        let file = CameraFile::load(&out.join("camera.toml")).expect("the file is valid");
        assert_eq!(file.views.len(), 5);
        for e in &file.estimates {
            let truth = e.parameter.get(&camera());
            println!("{name} {:?} {} ± {}, true {truth}", e.parameter, e.value, e.sigma);
            assert!((e.value - truth).abs() < 4.0 * e.sigma, "{e:?}, true {truth}");
        }
        assert!(file.rms_px < 0.02, "{}", file.rms_px);
        let page = std::fs::read_to_string(out.join("report.html")).expect("report");
        assert!(page.contains("focal") && page.contains("<svg"));
    }
    // Distance, record and optics file.
    let image = save(folder.path(), "square.png", &board(&tilted([0.4, -0.2, 1.0], 130.0), false, 20));
    let (camera_file, record, optics) = (at("camera-dots/camera.toml"), at("align.toml"), at("optics.toml"));
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml");
    let mut arguments =
        vec!["align", "distance", path(&image), "--camera", path(&camera_file), "--board", "dots"];
    arguments.extend(["--pitch", "6,0.001", "--grating-to-board", "40,0.05", "--json"]);
    arguments.extend(["--record", path(&record), "--optics", path(&example), "--out", path(&optics)]);
    let answer = json(&arguments);
    let s = &answer["found"]["pinhole_to_grating_mm"];
    let (value, sigma) = (s["value"].as_f64().expect("number"), s["sigma"].as_f64().expect("number"));
    println!("s {value} ± {sigma}");
    assert!((value - 90.0).abs() < 4.0 * sigma && sigma < 0.1, "{value} ± {sigma}");
    let written = daic_rig::experiment::OpticsFile::load(&optics).expect("valid");
    assert_eq!(written.optics.pinhole_to_grating.mm(), value);
    assert!((written.optics.focal.px() - 600.0).abs() < 1.0);
    // A second step joins the first in the record: orders on a line turned by 5 mrad.
    let line: Vec<[f64; 2]> =
        [-120.0, 0.0, 120.0].map(|x| camera().pixel([x / 600.0, x * 5e-3 / 600.0])).into();
    let image = save(folder.path(), "orders.png", &spots(&line));
    let answer = json(&[
        "align",
        "orders",
        path(&image),
        "--camera",
        path(&camera_file),
        "--record",
        path(&record),
        "--json",
    ]);
    let angle = answer["found"]["first"]["angle_rad"]["value"].as_f64().expect("number");
    assert!((angle - 5e-3).abs() < 5e-4, "{angle}");
    assert_eq!(answer["aligned"], false);
    assert!(answer["advice"][0].as_str().expect("text").contains("about z by −"), "{answer}");
    let table: toml::Table = std::fs::read_to_string(&record).expect("record").parse().expect("TOML");
    assert!(table.contains_key("distance") && table.contains_key("orders"));
    the_rest_of_the_alignment(folder.path(), &camera_file, &record, &line);
}

/// Guide, gratings back on the rail, tilts into the optics file, images as they arrive.
fn the_rest_of_the_alignment(folder: &Path, camera_file: &Path, record: &Path, line: &[[f64; 2]]) {
    let on = |words: &[&str]| {
        let mut arguments = vec!["align"];
        arguments.extend(words);
        arguments.extend(["--camera", path(camera_file), "--record", path(record), "--json"]);
        json(&arguments)
    };
    let guide = on(&["guide"]);
    let states: Vec<&str> = guide["steps"]
        .as_array()
        .expect("steps")
        .iter()
        .map(|s| s["state"].as_str().expect("state"))
        .collect();
    let expected =
        ["done", "to_do", "to_do", "to_do", "correct", "to_do", "by_hand", "done", "to_do", "done", "to_do"];
    assert_eq!(states, expected);
    assert_eq!(guide["next"], 5);

    // the aperture 400 mm from the pinhole, the reflected spot beside it: 2 mrad about y over a way of 300 mm
    let lit = |x: f64, y: f64| {
        let data = (0..W * H).map(|k| {
            let r = ((k % W) as f64 - x).hypot((k / W) as f64 - y);
            (20.0 + 180.0 / (1.0 + ((r - 12.0) / 0.6).exp())) as f32
        });
        Image { width: W, height: H, data: data.collect() }.recorded(2.0, 255.0, 8)
    };
    let aperture = save(folder, "aperture.png", &lit(250.0, 180.0));
    let shift = 600.0 * (2.0 * 2e-3 * 300.0) / 400.0;
    let reflected = save(folder, "reflected.png", &spots(&[[250.0 + shift, 180.0]]));
    let way = ["--pinhole-to-aperture", "400", "--grating-to-aperture", "300"];
    let found = on(&[&["reflection", path(&aperture), path(&reflected)][..], &way[..]].concat());
    let about_y = found["found"]["tilt_rad"][1]["value"].as_f64().expect("number");
    assert!((about_y.abs() - 2e-3).abs() < 5e-5, "{about_y}");

    // back on the rail, turned by another 3 mrad, which is told
    let turned: Vec<[f64; 2]> = line.iter().map(|[x, y]| [*x, y + 3e-3 * (x - 243.0)]).collect();
    let again = save(folder, "again.png", &spots(&turned));
    let found = on(&["orders", path(&again), "--again"]);
    assert_eq!(found["step"], "orders_again");
    let advice = found["advice"].to_string();
    assert!(advice.contains("since step orders the gratings have turned about z by +"), "{advice}");

    let image = folder.join("square.png");
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml");
    let optics = folder.join("aligned.toml");
    let board = ["--board", "dots", "--pitch", "6,0.001", "--grating-to-board", "40,0.05"];
    let files = ["--optics", path(&example), "--out", path(&optics), "--first-grating", "plus"];
    on(&[&["distance", path(&image)][..], &board[..], &files[..]].concat());
    let written = daic_rig::experiment::OpticsFile::load(&optics).expect("valid");
    let covariance = daic::optics_section::covariance(&written, &optics).expect("valid").expect("stated");
    let sigma = |name: &str| {
        let k = covariance.parameters().iter().position(|p| p.name() == name).expect(name);
        covariance.matrix()[(k, k)].sqrt()
    };
    assert!((sigma("grating_to_reference_mm") - 0.05).abs() < 1e-9);
    // d of the caliper, 0.05 mm, and D by F, pose and pitch
    assert!(sigma("pinhole_to_grating_mm") > 0.05 && sigma("pinhole_to_grating_mm") < 0.07);
    assert!(sigma("plus.tilt_rad_xyz[1]") > 0.0 && written.date.is_some());
    let provenance = written.provenance.as_ref().expect("stated");
    assert!(provenance.contains("orders_again (2") && provenance.contains("reflection (2"), "{provenance}");
    for grating in written.optics.gratings().expect("both") {
        assert_eq!(grating.tilt[1].rad(), about_y);
        assert!((grating.tilt[2].rad() - 8e-3).abs() < 5e-4, "{:?}", grating.tilt);
    }

    // images as they arrive: off, without a spot, at the principal point
    let live = folder.join("live");
    std::fs::create_dir(&live).expect("folder");
    let watch =
        ["align", "watch", "laser", path(&live), "--camera", path(camera_file), "--idle", "20", "--json"];
    let program = Command::new(env!("CARGO_BIN_EXE_daic"))
        .args(watch)
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("daic starts");
    let centre = CameraFile::load(camera_file).expect("valid").camera.principal_point_px;
    let pictures = [spots(&[[300.0, 120.0]]), spots(&[]), spots(&[centre])];
    for (k, picture) in pictures.iter().enumerate() {
        // complete under its name, as a camera's program does it
        let made = save(folder, "made.png", picture);
        std::fs::rename(made, live.join(format!("{k}.png"))).expect("renamed");
        std::thread::sleep(std::time::Duration::from_millis(400));
    }
    let output = program.wait_with_output().expect("ended");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let answer: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!(answer["aligned"], true);
    let seen = answer["images"].as_array().expect("images");
    // on a busy machine older ones are passed over
    assert!((1..=3).contains(&seen.len()) && seen[seen.len() - 1]["found"] == true, "{seen:?}");
    let empty = folder.join("empty");
    std::fs::create_dir(&empty).expect("folder");
    let none =
        daic(&["align", "watch", "orders", path(&empty), "--camera", path(camera_file), "--idle", "0.2"]);
    assert_eq!(none.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&none.stderr).contains("no new image came"));
}

#[test]
fn bad_input_is_named() {
    let folder = tempfile::TempDir::new().expect("folder");
    let at = |name: &str| folder.path().join(name);
    let fails = |arguments: &[&str], words: &[&str]| {
        let output = daic(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        // without the frame that the message is wrapped in
        let said = String::from_utf8_lossy(&output.stderr).replace(['│', '├', '╰', '─', '▶'], " ");
        let said: String = said.split_whitespace().collect::<Vec<_>>().join(" ");
        for word in words {
            assert!(said.contains(word), "{word} is not in {said}");
        }
    };
    let none = save(folder.path(), "none.png", &spots(&[[100.0, 100.0]]));
    let one = save(folder.path(), "one.png", &board(&tilted(TILTS[0], 110.0), false, 1));
    let base = ["calibrate", "camera", "--pitch", "6", "--board", "dots"];
    fails(&[&base[..], &[path(&none)]].concat(), &["none.png", "no board"]);
    fails(&[&base[..], &[path(&one)]].concat(), &["1 views", "at least 2"]);
    fails(&[&base[..], &[path(&one), "--columns", "5", "--rows", "5"]].concat(), &["13 × 9", "5 × 5"]);
    fails(&["calibrate", "camera", "--pitch", "-6", "--board", "dots", path(&one)], &["above 0"]);
    let parallel: Vec<PathBuf> = [100.0, 112.0, 125.0]
        .iter()
        .map(|z| save(folder.path(), &format!("flat-{z}.png"), &board(&tilted([0.0; 3], *z), false, 2)))
        .collect();
    let names: Vec<&str> = parallel.iter().map(|p| path(p)).collect();
    fails(&[&base[..], &names[..]].concat(), &["parallel"]);
    let damaged = at("camera.toml");
    std::fs::write(&damaged, "format = \"daic-camera/1\"\nrms_px = \"much\"\n").expect("written");
    fails(&["align", "orders", path(&none), "--camera", path(&damaged)], &["camera.toml", "rms_px"]);
    fails(&["align", "orders", path(&none), "--camera", path(&at("missing.toml"))], &["missing.toml"]);
}
