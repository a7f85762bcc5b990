//! Surfaces from simulated pixel pairs: what the gap reveals, strain on the surface, object coordinates, reach of a
//! calibration, maps of an optics file.

#[path = "../crates/optics/tests/common/mod.rs"]
mod common;

use common::*;
use daic::distortion_file::{DistortionFile, IdealImage};
use daic::measure::{
    Displacement, GapSummary, Grid, Instrument, Match, ObjectGrid, PointStatus, Profile, Track, Tracks,
    displacement, profile, surface_strain,
};
use daic::optics_file::{CalibratedOptics, map_entry};
use daic::{Error, optics_section};
use daic_optics::bundle::Volume;
use daic_optics::surface::Settings;
use daic_optics::{Decoder, DistortionMap, MapGrid, Optics, PixelPair, View};
use daic_rig::experiment::{Maps, OpticsFile};
use nalgebra::{Rotation3, Vector3};
use std::path::Path;

/// Noise of a match: what 59 × 59 second-order subsets reach on good frames.
const SIGMA_PX: f64 = 0.005;
/// Pixels between points.
const STEP: usize = 20;

fn cylinder(x: f64) -> f64 {
    (36.0_f64.powi(2) - x * x).sqrt() - 35.0
}

/// A grid of the −1 view of `truth` over about ±8 × ±7 mm and the points of the surface that it sees.
fn seen(truth: &Optics, h: &dyn Fn(f64, f64) -> f64) -> (Grid, Vec<Vector3<f64>>) {
    let model = truth.model().unwrap();
    let (columns, rows) = (35, 30);
    let (x0, y0) = (60, 680);
    let points = (0..columns * rows).map(|k| {
        let pixel = [(x0 + k % columns * STEP) as f64, (y0 + k / columns * STEP) as f64];
        let mut height = 0.0;
        let mut p = Vector3::zeros();
        // the line of sight leans by 11°: each step leaves a tenth of the error
        for _ in 0..40 {
            p = model.point_at_height(View::Minus, pixel, height).unwrap();
            height = h(p.x, p.y);
        }
        p
    });
    let nodes = (0..columns * rows).map(Some).collect();
    (Grid { x0, y0, step: STEP, columns, rows, nodes }, points.collect())
}

/// Matches of these points, with noise where the correlation has it.
fn matches(truth: &Optics, points: &[Vector3<f64>], sigma: f64, random: &mut Normal) -> Vec<Match> {
    let one = |p: &Vector3<f64>| {
        let mut pair = see_both(truth, *p);
        pair.plus_px = pair.plus_px.map(|v| v + sigma * random.next());
        Match { pair, sigma_px: [sigma; 2], status: PointStatus::Ok }
    };
    points.iter().map(one).collect()
}

fn instrument(o: &Optics, decoder: Decoder) -> Instrument {
    Instrument::new(o.model().unwrap(), decoder)
}

fn gap(of: &Optics, grid: &Grid, matches: &[Match]) -> (GapSummary, Profile) {
    let found = profile(grid, matches, &instrument(of, Decoder::Ray));
    (found.gap_summary(1.0), found)
}

/// A wrong groove angle, a wrong pitch or a tilt shows in the gap, without any truth; right optics show noise alone.
#[test]
fn the_gap_reveals_a_wrong_calibration() {
    let mut truth = golden();
    truth.minus.tilt_rad_xyz = [0.01, -0.02, 0.003];
    truth.plus.tilt_rad_xyz = [-0.01, 0.01, 0.004];
    let (grid, points) = seen(&truth, &|x, _| cylinder(x));
    let mut random = Normal::new(41);
    let found = matches(&truth, &points, SIGMA_PX, &mut random);
    let (right, surface) = gap(&truth, &grid, &found);
    println!("right: {right:?}");
    assert!(right.consistent);
    // 1 050 points: 2.2 % of an RMS; 3σ
    assert!((right.rms_um / right.expected_um - 1.0).abs() < 0.07, "{right:?}");
    let signed: Vec<f64> = surface.points.iter().map(|p| p.gap_mm / p.sigma_gap_mm).collect();
    let within = signed.iter().filter(|g| g.abs() < 1.0).count() as f64 / signed.len() as f64;
    assert!((within - 0.683).abs() < 0.045, "{within}");

    type Change = Box<dyn Fn(&mut Optics)>;
    let wrong: [(&str, Change); 6] = [
        ("grooves of one grating 0.05 mrad off", Box::new(|o| o.plus.tilt_rad_xyz[2] += 5e-5)),
        ("pitch of one grating 0.1 % off", Box::new(|o| o.plus.pitch_mm *= 1.001)),
        ("pitch of one grating 1 % off", Box::new(|o| o.plus.pitch_mm *= 1.01)),
        (
            "pitch of both 1 % off",
            Box::new(|o| {
                o.plus.pitch_mm *= 1.01;
                o.minus.pitch_mm *= 1.01;
            }),
        ),
        ("tilt of one grating about y 5 mrad off", Box::new(|o| o.minus.tilt_rad_xyz[1] += 5e-3)),
        ("gratings exchanged", Box::new(|o| std::mem::swap(&mut o.minus, &mut o.plus))),
    ];
    for (name, change) in wrong {
        let mut o = truth;
        change(&mut o);
        let (found, surface) = gap(&o, &grid, &found);
        println!("{name}: {found:?}");
        // a pitch moves the rays along x, the gap lies along y: 0.1 % does not show
        let shows = !name.contains("0.1 %");
        assert_eq!(found.consistent, !shows, "{name}: {found:?}");
        assert_eq!(found.verdict().contains("do not meet"), shows);
        // the points remain: it is for the user to judge
        assert!(surface.points.iter().all(|p| p.status.is_ok()));
    }
    // one false match among good ones is marked, whatever the calibration
    let mut one = found.clone();
    one[333].pair.plus_px[1] += 0.5;
    for o in [truth, {
        let mut o = truth;
        o.plus.tilt_rad_xyz[2] += 1e-3;
        o
    }] {
        let (_, surface) = gap(&o, &grid, &one);
        let flagged: Vec<usize> = (0..one.len()).filter(|k| !surface.points[*k].status.is_ok()).collect();
        assert_eq!(flagged, [333]);
        assert_eq!(surface.points[333].status, PointStatus::Gap);
    }
}

/// Both views of the points before and after a motion.
fn moved(
    truth: &Optics,
    h: &dyn Fn(f64, f64) -> f64,
    motion: &dyn Fn(Vector3<f64>) -> Vector3<f64>,
    sigma: f64,
    seed: u64,
) -> Displacement {
    let (grid, points) = seen(truth, h);
    let mut random = Normal::new(seed);
    let home = matches(truth, &points, sigma, &mut random);
    let track = |(p, m): (&Vector3<f64>, &Match)| {
        let (before, after) = (see_both(truth, *p), see_both(truth, motion(*p)));
        let mut noise = || sigma * random.next();
        // the +1 point is where the match put it: its error goes along
        let slip = [0, 1].map(|c| m.pair.plus_px[c] - before.plus_px[c]);
        let minus_px = after.minus_px.map(|v| v + noise());
        let plus_px = [0, 1].map(|c| after.plus_px[c] + slip[c] + noise());
        let (sigma_minus_px, sigma_plus_px) = ([sigma; 2], [sigma; 2]);
        Track { minus_px, plus_px, sigma_minus_px, sigma_plus_px, status: PointStatus::Ok }
    };
    let tracks = Tracks { points: points.iter().zip(&home).map(track).collect() };
    let range = [-12.0, 12.0];
    displacement(&grid, &home, &tracks, &instrument(truth, Decoder::Ray), range).with_points().unwrap()
}

/// A rigid tilt by 6° has no strain, within noise that σ states.
#[test]
fn a_rigid_tilt_has_no_strain() {
    let truth = awkward();
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), 6f64.to_radians());
    let motion = |p: Vector3<f64>| turn * p + Vector3::new(0.1, 0.05, 0.2);
    let settings = Settings { window: 9, overlap: 0.0, ..Settings::default() };
    type Height = fn(f64, f64) -> f64;
    let surfaces: [(&str, Height); 2] = [("plane", |_, _| 0.0), ("cylinder", |x, _| cylinder(x))];
    for (name, h) in surfaces {
        let exact = surface_strain(&moved(&truth, &h, &motion, 0.0, 7), &settings, 59).unwrap();
        let worst =
            exact.strains.iter().flatten().flat_map(|s| s.strain).fold(0.0, |a: f64, b| a.max(b.abs()));
        // 1e-12 mm of decoding over a window of 2 mm
        assert!(worst < 1e-11, "{name} {worst:e}");
        let (mut within, mut of, mut square) = (0.0, 0.0, 0.0);
        let mut means = [0.0; 3];
        let mut sigma = [0.0; 3];
        let runs = 10;
        for seed in 0..runs {
            let field = moved(&truth, &h, &motion, SIGMA_PX, 80 + seed);
            let found = surface_strain(&field, &settings, 59).unwrap();
            let summary = found.summary();
            // nodes with at least 0.6 of a window of 9 × 9 among 35 × 30
            assert_eq!(summary.ok, 904, "{summary:?}");
            for s in found.strains.iter().flatten() {
                for (e, sigma) in s.strain.iter().zip(s.sigma()) {
                    within += f64::from(u8::from(e.abs() <= sigma));
                    square += (e / sigma).powi(2);
                    of += 1.0;
                }
            }
            for (mean, of_run) in means.iter_mut().zip(summary.mean) {
                *mean += of_run / runs as f64;
            }
            sigma = summary.sigma;
        }
        let (within, ratio) = (within / of, f64::sqrt(square / of));
        println!("{name}: {:.1} % within σ, scatter/σ {ratio:.3}; means {means:?}", 100.0 * within);
        // 35 × 30 points hold 13 windows of 9 × 9: ten runs have 390 independent strains, an RMS of them scatters by
        // 3.6 %, a share by 2.4 %; two of that
        assert!((within - 0.683).abs() < 0.048 && (ratio - 1.0).abs() < 0.072, "{within} {ratio}");
        for c in 0..3 {
            assert!(means[c].abs() < 3.0 * sigma[c] / 130f64.sqrt(), "{means:?}");
        }
    }
}

/// A cylinder stretched along and around its axis and turned rigidly, through both views.
#[test]
fn a_stretched_cylinder_has_the_true_strain() {
    let truth = awkward();
    let (axial, around) = (1.004, 0.998);
    let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), 2f64.to_radians());
    // on the circle of radius 36 mm about (x, h) = (0, −35)
    let motion = |p: Vector3<f64>| {
        let angle = (p.x / 36.0).asin() * around;
        turn * Vector3::new(36.0 * angle.sin(), axial * p.y, 36.0 * angle.cos() - 35.0)
    };
    let settings = Settings { window: 5, overlap: 0.0, min_fraction: 1.0, ..Settings::default() };
    let field = moved(&truth, &|x, _| cylinder(x), &motion, 0.0, 9);
    let found = surface_strain(&field, &settings, 59).unwrap();
    // axes: x lies around the cylinder where y does not turn it; the grid is turned against the cylinder by
    // nothing, so E11 is around, E22 along
    let e = [0.5 * (around * around - 1.0), 0.5 * (axial * axial - 1.0), 0.0];
    let mut worst = 0.0_f64;
    for s in found.strains.iter().flatten() {
        for (found, truth) in s.strain.iter().zip(e) {
            worst = worst.max((found - truth).abs());
        }
        worst = worst.max((s.principal[0] - e[1]).abs()).max((s.principal[1] - e[0]).abs());
    }
    println!("worst {worst:.2e}, {:?}", found.summary());
    // 4.5e-7: smoothing of the tangents over a window of 5 points 0.5 mm apart, below (1 mm/36 mm)² of a strain of 4e-3
    assert!(worst < 6e-7, "{worst:e}");
}

/// Resampled heights are those of the surface to the sag of its chords; σ is carried, nothing lies outside.
#[test]
fn object_coordinates() {
    let truth = golden();
    let (grid, points) = seen(&truth, &|x, _| cylinder(x));
    let found = matches(&truth, &points, 0.0, &mut Normal::new(11));
    let exact = profile(&grid, &found, &instrument(&truth, Decoder::Ray));
    let at = |k: usize| Some([exact.points[k].point_mm[0], exact.points[k].point_mm[1]]);
    let object = ObjectGrid::new(&grid, at, None, 1.0).unwrap();
    // 20 px of 0.0235 mm
    assert!((object.step_mm - 0.47).abs() < 0.021, "{}", object.step_mm);
    let heights = object.values(|k| exact.points[k].point_mm[2]);
    let reach = |i: usize| points.iter().fold([f64::MAX, f64::MIN], |[a, b], p| [a.min(p[i]), b.max(p[i])]);
    let (mut n, mut worst) = (0, 0.0_f64);
    for (node, h) in heights.iter().enumerate().filter(|(_, h)| h.is_finite()) {
        let [x, y] = object.position_mm(node);
        assert!((reach(0)[0]..=reach(0)[1]).contains(&x) && (reach(1)[0]..=reach(1)[1]).contains(&y));
        assert!((x / object.step_mm - (x / object.step_mm).round()).abs() < 1e-9);
        worst = worst.max((h - cylinder(x)).abs());
        n += 1;
    }
    // a chord of 0.48 mm under R = 36 mm sags by 0.48²/(8·36) mm, 8 mm from the apex by 8 % more, and there the
    // oblique view sees points 4 % farther apart
    println!("{n} nodes, worst {:.3} µm", 1e3 * worst);
    assert!(n > 900 && worst < 1.2 * 0.48 * 0.48 / (8.0 * 36.0), "{worst:e}");
}

/// Points outside the volume, and pixels off the map or where it was not measured, are flagged.
#[test]
fn what_lies_outside_the_calibration_is_flagged() {
    let truth = golden();
    let (grid, points) = seen(&truth, &|x, _| 0.1 * x);
    let found = matches(&truth, &points, SIGMA_PX, &mut Normal::new(12));
    let mut inside = instrument(&truth, Decoder::Ray);
    inside.volume = Some(Volume { from_mm: [-5.0, -9.0, -1.0], to_mm: [5.0, 9.0, 1.0] });
    let surface = profile(&grid, &found, &inside);
    for (p, truth) in surface.points.iter().zip(&points) {
        // a tenth of the shortest side, 2 mm, is granted
        let out = truth.x.abs() > 5.2;
        let near = (truth.x.abs() - 5.2).abs() < 1e-3;
        assert!(near || (p.status == PointStatus::Outside) == out, "{truth} {:?}", p.status);
        assert!(p.point_mm[2].is_finite());
    }
    assert!(surface.points.iter().any(|p| p.status.is_ok()));
}

struct Files(tempfile::TempDir);

impl Files {
    fn map(&self, name: &str, view: Option<View>, ideal: IdealImage, sigma: f64) {
        let grid = MapGrid::covering([-200.0, -200.0], [2800.0, 2200.0], 150.0);
        let [nx, ny] = grid.nodes;
        let nodes: Vec<[f64; 2]> = (0..nx * ny)
            .map(|k| grid.node_px(k % nx, k / nx))
            .map(|[x, y]| [0.4 * (x / 500.0).sin(), 0.3 * ((x + y) / 600.0).cos()])
            .collect();
        let measured = (0..nx * ny).map(|k| grid.node_px(k % nx, k / nx)[1] < 1150.0).collect();
        let file = DistortionFile {
            format: DistortionFile::FORMAT.to_owned(),
            provenance: "simulated".to_owned(),
            date: "2026-01-02T03:04:05Z".to_owned(),
            image_px: [2592, 1944],
            view,
            ideal,
            camera: golden().camera,
            removed: Vec::new(),
            e: DistortionMap::interpolate(grid, &nodes).unwrap(),
            sigma_px: vec![[sigma; 2]; nx * ny],
            measured,
        };
        file.save(&self.0.path().join(name)).unwrap();
    }

    fn optics(&self, maps: Maps) -> std::path::PathBuf {
        let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml");
        let mut file = OpticsFile::load(&example).unwrap();
        file.optics = optics_section::to_section(&file.optics, &golden());
        file.maps = Some(maps);
        std::fs::create_dir_all(self.0.path().join("optics")).unwrap();
        let path = self.0.path().join("optics/optics.toml");
        std::fs::write(&path, file.to_toml().unwrap()).unwrap();
        path
    }

    fn entry(&self, name: &str) -> Option<daic_rig::experiment::MapFile> {
        std::fs::create_dir_all(self.0.path().join("optics")).unwrap();
        Some(map_entry(&self.0.path().join("optics"), &self.0.path().join(name)).unwrap())
    }
}

#[test]
fn maps_of_an_optics_file() {
    let files = Files(tempfile::TempDir::new().unwrap());
    files.map("sensor.json", None, IdealImage::Pinhole, 0.02);
    files.map("minus.json", Some(View::Minus), IdealImage::Ray, 0.02);
    let maps = Maps { sensor: files.entry("sensor.json"), ..Maps::default() };
    assert_eq!(maps.sensor.as_ref().unwrap().file, "../sensor.json");
    let optics = CalibratedOptics::load(&files.optics(maps.clone())).unwrap();
    let with = optics.instrument(Decoder::Ray).unwrap();
    // what the map adds to a pixel is taken off again; half of the field was not measured
    let truth = golden();
    let (grid, points) = seen(&truth, &|_, _| 0.0);
    let project = |view, p: &Vector3<f64>| with.model.project(view, *p).unwrap();
    let found: Vec<Match> = points
        .iter()
        .map(|p| PixelPair { minus_px: project(View::Minus, p), plus_px: project(View::Plus, p) })
        .map(|pair| Match { pair, sigma_px: [SIGMA_PX; 2], status: PointStatus::Ok })
        .collect();
    let surface = profile(&grid, &found, &with);
    assert!(surface.states_common);
    for ((p, truth), m) in surface.points.iter().zip(&points).zip(&found) {
        assert!((Vector3::from(p.point_mm) - truth).amax() < 1e-10, "{:?} {truth}", p.point_mm);
        let row = m.pair.minus_px[1];
        if !(1000.0..1200.0).contains(&row) {
            assert_eq!(p.status.is_ok(), row < 1000.0, "{row} {:?}", p.status);
        }
        // 0.02 px of map on either pixel against 0.005 px of match on one
        let ratio = p.common_sigma_mm()[2] / p.sigma_mm()[2];
        assert!((ratio - 0.02 * 2f64.sqrt() / SIGMA_PX).abs() < 0.2, "{ratio}");
    }
    // without the map the gap tells
    let without = profile(&grid, &found, &instrument(&truth, Decoder::Ray));
    assert!(!without.gap_summary(1.0).consistent);
    // a pixel off the map
    let far = PixelPair { minus_px: [-300.0, 900.0], plus_px: [2000.0, 900.0] };
    let far = [Match { pair: far, sigma_px: [0.01; 2], status: PointStatus::Ok }];
    assert_eq!(profile(&Grid::none(), &far, &with).points[0].status, PointStatus::Outside);

    // a map for another view, for another decoder, a changed one, a missing one
    let refused = |maps: Maps, decoder: Decoder| {
        CalibratedOptics::load(&files.optics(maps)).and_then(|o| o.instrument(decoder)).unwrap_err()
    };
    let wrong_view = refused(Maps { plus: files.entry("minus.json"), ..Maps::default() }, Decoder::Ray);
    assert!(
        wrong_view.to_string().contains("maps.plus") && wrong_view.to_string().contains("−1 view"),
        "{wrong_view}"
    );
    let minus = Maps { minus: files.entry("minus.json"), ..Maps::default() };
    let decoder = refused(minus.clone(), Decoder::Linear);
    assert!(decoder.to_string().contains("pinhole"), "{decoder}");
    let comparison = CalibratedOptics::load(&files.optics(minus)).unwrap();
    assert!(comparison.instrument_for_comparison(Decoder::Linear).unwrap().maps.is_empty());
    files.map("sensor.json", None, IdealImage::Pinhole, 0.03);
    let changed = refused(maps.clone(), Decoder::Ray);
    assert!(
        changed.to_string().contains("checksum") && matches!(changed, Error::OpticsMap { .. }),
        "{changed}"
    );
    std::fs::remove_file(files.0.path().join("sensor.json")).unwrap();
    assert!(refused(maps, Decoder::Ray).to_string().contains("sensor.json"));
}
