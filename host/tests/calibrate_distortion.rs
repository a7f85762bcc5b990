//! Images of line targets become distortion maps that straighten them.

mod target;

use daic::Error;
use daic::calibrate_distortion::{
    DistortionFile, IdealImage, Options, Outcome, Warning, calibrate, phase_settings, run,
};
use daic_optics::distortion::{DistortionCalibration, TargetPose};
use daic_optics::{DistortionError, DistortionMaps, OpticalModel, Optics, View};
use nalgebra::{DMatrix, DVector};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use target::{Lines, Noise, OTHER, POSE, Pose, Scene, brightness, grey, save};

const SIZE: [usize; 2] = [700, 520];
fn options(images: Vec<PathBuf>, out: &Path) -> Options {
    Options {
        images,
        optics: None,
        into: false,
        view: None,
        region: None,
        ideal: None,
        one_pose: false,
        square: false,
        target_pitch_mm: None,
        phase: phase_settings(),
        out: out.join("out"),
    }
}

/// Brightness of the two exposures or of the cross, with the names of their files.
fn exposures(scene: &Scene, poses: [Pose; 2], cross: bool) -> Vec<(&'static str, Vec<f64>)> {
    let one = |name, pose: usize, lines| (name, scene.brightness(&poses[pose], lines));
    if cross {
        return vec![one("cross.png", 0, Lines::Both)];
    }
    vec![one("along_x.png", 1, Lines::CrossedByY), one("along_y.png", 0, Lines::CrossedByX)]
}

/// Writes them with noise, and says where they are.
fn record(folder: &Path, size: [usize; 2], all: &[(&'static str, Vec<f64>)], seed: u64) -> Vec<PathBuf> {
    println!("noise seed {seed}");
    let mut noise = Noise::new(seed);
    let one = |(name, brightness): &(&'static str, Vec<f64>)| {
        let path = folder.join(name);
        save(&path, size, grey(brightness, &mut noise));
        path
    };
    all.iter().map(one).collect()
}

fn images(folder: &Path, scene: &Scene, poses: [Pose; 2], cross: bool, seed: u64) -> Vec<PathBuf> {
    record(folder, scene.size, &exposures(scene, poses, cross), seed)
}

/// A pixel's ideal position by the map, and the target's true phases there.
struct Straightened {
    ideal: [f64; 2],
    /// Stated there.
    sigma: [f64; 2],
    turns: [f64; 2],
}

/// What the map leaves, in pixels along the target's axes, apart from what the pose of the target takes
/// up: the phases less the best homography of the straightened positions.
fn left(points: &[Straightened], pose: TargetPose, pitch: f64) -> [Vec<f64>; 2] {
    let n = points.len() as f64;
    let mean = |f: &dyn Fn(&Straightened) -> f64| points.iter().map(f).sum::<f64>() / n;
    let centre = [0, 1].map(|i| mean(&|p| p.ideal[i]));
    let middle = [0, 1].map(|i| mean(&|p| p.turns[i]));
    let scale = mean(&|p| (p.ideal[0] - centre[0]).hypot(p.ideal[1] - centre[1]));
    let tied = pose == TargetPose::Common;
    // n·(x, y, 1) − φ d·(x, y) = φ, with φ in units of the scale
    let row = |p: &Straightened, k: usize| {
        let [x, y] = [0, 1].map(|i| (p.ideal[i] - centre[i]) / scale);
        let t = (p.turns[k] - middle[k]) * pitch / scale;
        let mut row = [0.0; 10];
        row[3 * k..3 * k + 3].copy_from_slice(&[x, y, 1.0]);
        let d = if tied { 6 } else { 6 + 2 * k };
        (row[d], row[d + 1]) = (-t * x, -t * y);
        (row, t)
    };
    let columns = if tied { 8 } else { 10 };
    let mut normal = DMatrix::<f64>::zeros(columns, columns);
    let mut rhs = DVector::<f64>::zeros(columns);
    for p in points {
        for k in 0..2 {
            let (row, t) = row(p, k);
            for a in 0..columns {
                rhs[a] += row[a] * t;
                for b in 0..columns {
                    normal[(a, b)] += row[a] * row[b];
                }
            }
        }
    }
    let h = normal.lu().solve(&rhs).unwrap();
    [0, 1].map(|k| {
        let one = |p: &Straightened| {
            let (row, t) = row(p, k);
            scale * (t - (0..columns).map(|a| row[a] * h[a]).sum::<f64>())
        };
        points.iter().map(one).collect()
    })
}

fn rms(v: &[f64]) -> f64 {
    (v.iter().map(|v| v * v).sum::<f64>() / v.len() as f64).sqrt()
}

/// Every few pixels of the map, measured ones or those of the border; nothing but places the image has.
fn straightened(
    found: &DistortionCalibration,
    size: [usize; 2],
    measured: bool,
    turns: &dyn Fn([f64; 2]) -> [f64; 2],
) -> Vec<Straightened> {
    let grid = found.map.grid();
    let mut points = Vec::new();
    for y in (0..size[1]).step_by(7) {
        for x in (0..size[0]).step_by(7) {
            let o = [x as f64, y as f64];
            let Some(k) = grid.nearest(o) else { continue };
            let around = [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)].map(|(a, b)| {
                grid.nearest([o[0] + a * grid.step_px[0], o[1] + b * grid.step_px[1]])
                    .is_some_and(|k| found.measured[k])
            });
            let inside = found.measured[k] && around.iter().all(|m| *m);
            if inside == measured {
                let e = found.map.e_px(o).unwrap();
                let ideal = [o[0] - e[0], o[1] - e[1]];
                points.push(Straightened { ideal, sigma: found.sigma_px[k], turns: turns(o) });
            }
        }
    }
    points
}

/// Calibrates from simulated exposures and checks what is left.
fn check(scene: &Scene, cross: bool, one_pose: bool, limit: f64) -> Outcome {
    let folder = tempfile::tempdir().unwrap();
    let poses = if one_pose || cross { [POSE; 2] } else { [POSE, OTHER] };
    let images = images(folder.path(), scene, poses, cross, 7);
    let outcome = calibrate(&Options { one_pose, ..options(images, folder.path()) }).unwrap();
    let found = &outcome.found;
    let turns = |o: [f64; 2]| [scene.turns(&poses[0], o)[0], scene.turns(&poses[1], o)[1]];
    let inside = straightened(found, scene.size, true, &turns);
    let [x, y] = left(&inside, found.pose, scene.pitch);
    let border = straightened(found, scene.size, false, &turns);
    let [bx, by] = left(&border, found.pose, scene.pitch);
    let [tx, ty] = found.left.total_px();
    println!(
        "{:?}: e {:.3?} px RMS, left by Brown {:.4?}, by the map {:.4} and {:.4} px (stated {tx:.4}, {ty:.4}: {:?}), in the border {:.4} and {:.4}",
        found.pose,
        found.rms_px,
        found.brown.left_px,
        rms(&x),
        rms(&y),
        found.left,
        rms(&bx),
        rms(&by)
    );
    let in_sigma = |points: &[Straightened], left: [&Vec<f64>; 2]| {
        [0, 1].map(|i| rms(&points.iter().zip(left[i]).map(|(p, v)| v / p.sigma[i]).collect::<Vec<f64>>()))
    };
    println!(
        "  error over σ: {:.3?} at measured nodes, {:.3?} in the border",
        in_sigma(&inside, [&x, &y]),
        in_sigma(&border, [&bx, &by])
    );
    println!("  brown {:?} ± {:?}", found.brown.brown, found.brown.sigma);
    assert!(inside.len() > scene.size[0] * scene.size[1] / 49 / 2, "{}", inside.len());
    assert!(rms(&x) < limit && rms(&y) < limit, "{} {}", rms(&x), rms(&y));
    // What is left is stated, neither too small nor too large: to a tenth below, to a fifth above.
    for (stated, is) in [(tx, rms(&x)), (ty, rms(&y))] {
        assert!(stated > 0.9 * is && stated < 1.2 * is, "stated {stated}, is {is}");
    }
    // Where the window leaves the image Brown's terms and smoothness carry the map on.
    assert!(rms(&bx) < 0.02 && rms(&by) < 0.02);
    outcome
}

#[test]
fn two_exposures_with_poses_of_their_own() {
    let scene = Scene::usual(SIZE, 60.0);
    let outcome = check(&scene, false, false, 0.005);
    assert!(outcome.warnings.is_empty(), "{:?}", outcome.warnings);
    assert_eq!(outcome.found.pose, TargetPose::Separate);
}

#[test]
fn two_exposures_tied_to_one_pose() {
    let outcome = check(&Scene::usual(SIZE, 60.0), false, true, 0.005);
    assert_eq!(outcome.found.pose, TargetPose::Common);
}

#[test]
fn a_cross_grating() {
    let outcome = check(&Scene::usual(SIZE, 60.0), true, false, 0.005);
    assert_eq!(outcome.found.pose, TargetPose::Common);
}

/// By hand: the thesis' sensor. `DAIC_FIGURES` names a folder for report and figures.
#[test]
#[ignore = "full size, a minute"]
fn full_size() {
    let scene = Scene::usual([2592, 1944], 60.0);
    check(&scene, false, false, 0.005);
    if let Some(folder) = std::env::var_os("DAIC_FIGURES") {
        let folder = PathBuf::from(folder);
        let images = images(&folder, &scene, [POSE, OTHER], false, 7);
        println!("{:#?}", run(&options(images, &folder)).unwrap());
    }
}

/// The sign of the literature's formula: an image moved by +0.3 px comes back as +0.3.
#[test]
fn a_distortion_of_plus_0_3_px_comes_back_as_plus_0_3() {
    let folder = tempfile::tempdir().unwrap();
    let flat = Scene { brown: [0.0; 5], defects: Vec::new(), ..Scene::usual([480, 360], 60.0) };
    let scene = Scene { wave: Some((0.3, 120.0)), ..flat };
    let images = images(folder.path(), &scene, [POSE, OTHER], false, 3);
    let found = calibrate(&options(images, folder.path())).unwrap().found;
    // Along a row: the terms of e_x that the carrier takes up, and the wave.
    let places: Vec<f64> = (60..=420).step_by(5).map(f64::from).collect();
    let turn = |x: f64| std::f64::consts::TAU * x / 120.0;
    let basis = DMatrix::from_fn(places.len(), 5, |row, k| {
        let x = places[row];
        [1.0, x / 240.0, (x / 240.0).powi(2), turn(x).cos(), turn(x).sin()][k]
    });
    for y in [100.0, 180.0, 260.0] {
        let e: Vec<[f64; 2]> = places.iter().map(|x| found.map.e_px([*x, y]).unwrap()).collect();
        let fit = |i: usize| {
            let values = DVector::from_iterator(e.len(), e.iter().map(|e| e[i]));
            basis.clone().svd(true, true).solve(&values, 1e-12).unwrap()
        };
        let (along_x, along_y) = (fit(0), fit(1));
        println!("e_x: {:.4} cos {:+.4} sin; e_y: {:.4} cos", along_x[3], along_x[4], along_y[3]);
        // The window of 13 px takes 2.2 % off a wave of 120 px.
        assert!((along_x[3] - 0.3 * 0.978).abs() < 0.004 && along_x[4].abs() < 0.004);
        assert!(along_y[3].abs() < 0.004);
    }
}

/// σ against the scatter over repeats: the noise alone differs.
#[test]
fn stated_uncertainty_is_the_scatter_of_repeats() {
    const REPEATS: usize = 16;
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::usual([360, 280], 60.0);
    for (cross, pose) in [(false, [POSE, OTHER]), (true, [POSE, POSE])] {
        let mut all = Vec::new();
        let clean = exposures(&scene, pose, cross);
        for seed in 0..REPEATS as u64 {
            let images = record(folder.path(), scene.size, &clean, 100 + seed);
            all.push(calibrate(&options(images, folder.path())).unwrap().found);
        }
        let grid = *all[0].map.grid();
        let (mut ratio, mut border) = ([0.0_f64; 2], [0.0_f64; 2]);
        let mut count = [0.0_f64; 2];
        for k in 0..grid.nodes[0] * grid.nodes[1] {
            let at = grid.node_px(k % grid.nodes[0], k / grid.nodes[0]);
            let e: Vec<[f64; 2]> = all.iter().map(|f| f.map.e_px(at).unwrap()).collect();
            for i in 0..2 {
                let mean = e.iter().map(|e| e[i]).sum::<f64>() / REPEATS as f64;
                let scatter = e.iter().map(|e| (e[i] - mean).powi(2)).sum::<f64>() / (REPEATS - 1) as f64;
                let stated = all.iter().map(|f| f.noise_px[k][i].powi(2)).sum::<f64>() / REPEATS as f64;
                if all.iter().all(|f| f.measured[k]) {
                    ratio[i] += scatter / stated;
                    count[0] += 0.5;
                } else {
                    border[i] += scatter / stated;
                    count[1] += 0.5;
                }
            }
        }
        let ratio = ratio.map(|r| (r / count[0]).sqrt());
        let border = border.map(|r| (r / count[1]).sqrt());
        println!("cross {cross}: scatter over σ {ratio:.3?} at measured nodes, {border:.3?} in the border");
        // A node's variance from 16 repeats is known to √(2/15) = 37 %; windows overlap and the carrier is common, so
        // some 30 measured nodes and 15 of the border count as independent: 3.3 % and 4.7 % of the root. Three
        // of these. (With 100 repeats of simulated phases it is 0.97 to 1.01: the optics crate's distortion_noise.)
        assert!(ratio.iter().all(|r| (r - 1.0).abs() < 0.10), "{ratio:?}");
        assert!(border.iter().all(|r| (r - 1.0).abs() < 0.14), "{border:?}");
    }
}

/// Optics of the golden set-up on a sensor a quarter as wide.
fn small_optics(folder: &Path, brown: bool) -> (PathBuf, Optics) {
    let text =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml"))
            .unwrap();
    let mut text = text
        .replace("17956.216577540104 px", "4434 px")
        .replace("\"1295.5 px\", \"971.5 px\"", "\"319.5 px\", \"239.5 px\"");
    if brown {
        text = text.replace("[optics.grating]", "[optics.brown]\nk1 = -0.5\np1 = 1e-3\n\n[optics.grating]");
    }
    let path = folder.join(if brown { "true.toml" } else { "optics.toml" });
    std::fs::write(&path, text).unwrap();
    let file = daic_rig::experiment::OpticsFile::load(&path).unwrap();
    (path, daic::optics_section::from_section(&file.optics).unwrap())
}

#[test]
fn maps_through_the_grating_serve_either_decoder() {
    const SIZE: [usize; 2] = [640, 480];
    const PITCH_MM: f64 = 0.9;
    let folder = tempfile::tempdir().unwrap();
    let (plain_path, plain) = small_optics(folder.path(), false);
    let (_, truth) = small_optics(folder.path(), true);
    let seen = truth.model().unwrap();
    let turn = 1.0_f64.to_radians();
    let turns = |view: View, o: [f64; 2]| {
        let p = seen.point_at_height(view, o, 0.0).unwrap();
        [(turn.cos() * p.x + turn.sin() * p.y) / PITCH_MM, (turn.cos() * p.y - turn.sin() * p.x) / PITCH_MM]
    };
    // One frame with both views, of the target turned by 1°.
    let mut frames = Vec::new();
    for (name, lines) in [("x.png", Lines::CrossedByX), ("y.png", Lines::CrossedByY)] {
        let half = |view, from: usize| {
            brightness([SIZE[0] / 2, SIZE[1]], lines, &move |o: [f64; 2]| {
                turns(view, [o[0] + from as f64, o[1]])
            })
        };
        let (minus, plus) = (half(View::Minus, 0), half(View::Plus, SIZE[0] / 2));
        let rows = minus.chunks(SIZE[0] / 2).zip(plus.chunks(SIZE[0] / 2));
        let whole: Vec<f64> = rows.flat_map(|(a, b)| a.iter().chain(b).copied()).collect();
        let path = folder.path().join(name);
        save(&path, SIZE, grey(&whole, &mut Noise::new(11)));
        frames.push(path);
    }
    let given = |view, ideal, optics: bool| Options {
        view: Some(view),
        ideal,
        optics: optics.then(|| plain_path.clone()),
        one_pose: true,
        square: false,
        target_pitch_mm: optics.then_some(PITCH_MM),
        ..options(frames.clone(), folder.path())
    };
    let mut maps = DistortionMaps::NONE;
    for view in View::BOTH {
        // Counted from rays the lens alone is left, and the map straightens the view.
        let outcome = calibrate(&given(view, None, true)).unwrap();
        assert!(outcome.warnings.is_empty(), "{:?}", outcome.warnings);
        let found = outcome.found;
        assert!((found.pitch[0] / PITCH_MM - 1.0).abs() < 0.004, "{:?}", found.pitch);
        let mut points = straightened(&found, SIZE, true, &|o| turns(view, o));
        let ideal = plain.model().unwrap();
        for p in &mut points {
            let at = ideal.point_at_height(view, p.ideal, 0.0).unwrap();
            p.ideal = [at.x, at.y];
        }
        let px = |mm: f64| mm * 4434.0 / 416.0;
        let [x, y] = left(&points, found.pose, PITCH_MM).map(|v| px(rms(&v)));
        println!("{view:?}, rays: e {:.3?}, left {x:.4} and {y:.4} px", found.rms_px);
        assert!(x < 0.005 && y < 0.005, "{x} {y}");
        // Counted from a pinhole the map holds the bowl of the virtual object, too.
        let pinhole = calibrate(&given(view, Some(IdealImage::Pinhole), true)).unwrap().found;
        let points = straightened(&pinhole, SIZE, true, &|o| turns(view, o));
        let [x, y] = left(&points, pinhole.pose, px(PITCH_MM)).map(|v| rms(&v));
        println!("{view:?}, pinhole: e {:.3?}, left {x:.4} and {y:.4} px", pinhole.rms_px);
        assert!(x < 0.005 && y < 0.005, "{x} {y}");
        let without = calibrate(&given(view, None, false)).unwrap();
        assert!(without.warnings.contains(&Warning::NotForRays));
        let map = Some(Arc::new(found.map));
        match view {
            View::Minus => maps.minus = map,
            View::Plus => maps.plus = map,
        }
    }
    // In the model the maps do what was tested above: away with e, then the rays.
    let model = OpticalModel::with_maps(&plain, maps.clone()).unwrap();
    for (view, o) in [(View::Minus, [160.0, 200.0]), (View::Plus, [480.0, 300.0])] {
        let map = if view == View::Minus { &maps.minus } else { &maps.plus };
        let e = map.as_ref().unwrap().e_px(o).unwrap();
        let expected = plain.model().unwrap().point_at_height(view, [o[0] - e[0], o[1] - e[1]], 0.0).unwrap();
        assert!((model.point_at_height(view, o, 0.0).unwrap() - expected).norm() < 1e-9);
    }
}

#[test]
fn bad_input_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let size = [360, 280];
    let scene = Scene::usual(size, 60.0);
    let good = images(folder.path(), &scene, [POSE, OTHER], false, 1);
    let with = |images: &[PathBuf]| calibrate(&options(images.to_vec(), folder.path()));

    save(&path("blank.png"), size, vec![128; size[0] * size[1]]);
    assert!(matches!(with(&[path("blank.png"), good[0].clone()]), Err(Error::Blank { .. })));
    save(&path("noise.png"), size, grey(&vec![0.5; size[0] * size[1]], &mut Noise::new(5)));
    let e = with(&[path("noise.png"), good[0].clone()]).unwrap_err();
    assert!(matches!(&e, Error::TargetPhase { path, .. } if path.ends_with("noise.png")), "{e}");
    let e = with(&[good[0].clone(), good[0].clone()]).unwrap_err();
    let same = matches!(&e, Error::CalibrateDistortion(DistortionError::SameDirection { .. }));
    assert!(same && e.to_string().contains("lines along y"), "{e}");
    let e = with(&good[..1]).unwrap_err();
    assert!(matches!(e, Error::OneImageOfLines { .. }), "{e}");
    // A strip narrower than the window of ten lines.
    let strip = |name: &str, lines, pose: &Pose| {
        let all = scene.brightness(pose, lines);
        let part = all.iter().enumerate().map(|(k, b)| if k % size[0] < 90 { *b } else { 0.1 });
        save(&path(name), size, grey(&part.collect::<Vec<f64>>(), &mut Noise::new(6)));
        path(name)
    };
    let strips = [strip("sx.png", Lines::CrossedByX, &POSE), strip("sy.png", Lines::CrossedByY, &OTHER)];
    let e = with(&strips).unwrap_err();
    let few = matches!(&e, Error::CalibrateDistortion(DistortionError::TooFew { .. }));
    assert!(few && e.to_string().contains("analysis window"), "{e}");
    assert!(matches!(with(&[]), Err(Error::TargetImages { found: 0 })));
    let rays = Options { ideal: Some(IdealImage::Ray), ..options(good.clone(), folder.path()) };
    assert!(matches!(calibrate(&rays), Err(Error::IdealRay)));
    let beyond = Options { region: Some([0, 0, 361, 100]), ..options(good.clone(), folder.path()) };
    assert!(matches!(calibrate(&beyond), Err(Error::RoiOutside { .. })));

    // One image of a target 1 % coarser.
    let coarse = Scene { pitch: 1.01 * scene.pitch, ..scene.clone() };
    save(&path("coarse.png"), size, grey(&coarse.brightness(&POSE, Lines::CrossedByX), &mut Noise::new(2)));
    let outcome = with(&[path("coarse.png"), good[0].clone()]).unwrap();
    let ratio = outcome.warnings.iter().find_map(|w| match w {
        Warning::PitchesDiffer { ratio } => Some(*ratio),
        _ => None,
    });
    assert!((ratio.unwrap() * 1.01 - 1.0).abs() < 1e-3, "{:?}", outcome.warnings);

    // The optics and the target's pitch disagree by 1 %.
    let (optics, parameters) = small_optics(folder.path(), false);
    let mm = scene.pitch * 416.0 / parameters.camera.focal_px;
    for (factor, warned) in [(1.0, 0), (1.01, 2)] {
        let target_pitch_mm = Some(factor * mm);
        let o =
            Options { optics: Some(optics.clone()), target_pitch_mm, ..options(good.clone(), folder.path()) };
        let warnings = calibrate(&o).unwrap().warnings;
        assert_eq!(warnings.len(), warned, "{warnings:?}");
        assert!(warnings.iter().all(|w| matches!(w, Warning::Scale { .. })));
    }

    // A target that fills half of the image, and a lamp too bright.
    let half = |pose: &Pose, lines| -> Vec<f64> {
        let all = scene.brightness(pose, lines);
        all.iter().enumerate().map(|(k, b)| if k % size[0] < 200 { *b } else { 0.1 }).collect()
    };
    save(&path("hx.png"), size, grey(&half(&POSE, Lines::CrossedByX), &mut Noise::new(3)));
    save(&path("hy.png"), size, grey(&half(&OTHER, Lines::CrossedByY), &mut Noise::new(4)));
    let outcome = with(&[path("hx.png"), path("hy.png")]).unwrap();
    let share = outcome.warnings.iter().find_map(|w| match w {
        Warning::PartlyCovered { share } => Some(*share),
        _ => None,
    });
    assert!((0.4..0.75).contains(&share.unwrap()), "{:?}", outcome.warnings);
    assert!(outcome.found.map.e_px([300.0, 140.0]).is_none());
    let bright: Vec<u8> = grey(&scene.brightness(&POSE, Lines::CrossedByX), &mut Noise::new(3))
        .into_iter()
        .map(|g| g.saturating_mul(2))
        .collect();
    save(&path("bright.png"), size, bright);
    let outcome = with(&[path("bright.png"), good[0].clone()]).unwrap();
    assert!(
        matches!(&outcome.warnings[..], [Warning::Saturated { share, .. }] if *share > 0.2),
        "{:?}",
        outcome.warnings
    );
}

#[test]
fn the_program_writes_a_map_that_reads_back() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::usual([360, 280], 60.0);
    let images = images(folder.path(), &scene, [POSE; 2], true, 1);
    let out = folder.path().join("map");
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_daic"))
        .args(["calibrate", "distortion", "--json", "--out"])
        .args([&out, &images[0]])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let said: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(said["shared_with_tilt"][0], "(e_x, e_y): (x², xy), (xy, y²)");
    let path = out.join("distortion.json");
    let file = DistortionFile::load(&path).unwrap();
    assert_eq!((file.image_px, file.view, file.ideal), ([360, 280], None, IdealImage::Pinhole));
    assert!(file.provenance.contains("cross.png") && file.date.len() == 20);
    let found = calibrate(&options(images, folder.path())).unwrap().found;
    assert_eq!((file.e, file.sigma_px, file.measured), (found.map, found.sigma_px, found.measured));
    for name in ["distortion.npz", "report.html", "e_x.svg", "e_y.svg", "e_magnitude.svg", "section_x.svg"] {
        assert!(out.join(name).metadata().unwrap().len() > 1000, "{name}");
    }
    // A damaged file is refused by the name of the field.
    let text = std::fs::read_to_string(&path).unwrap();
    for (from, to, field) in [
        ("daic-distortion-map/1", "daic-distortion-map/9", "format"),
        ("\"sigma_px\":[[", "\"sigma_px\":[[0.1,0.1],[", "sigma_px"),
        ("\"focal_px\":", "\"focal_px\":-", "focal_px"),
        ("\"ideal\"", "\"idle\"", "idle"),
        ("\"nodes\":[", "\"nodes\":[1", "values"),
    ] {
        assert!(text.contains(from), "{from}");
        std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
        let e = DistortionFile::load(&path).unwrap_err().to_string();
        assert!(e.contains(field), "{e}");
    }
}
