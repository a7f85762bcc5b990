//! Every kind of specimen against its analytic height.

mod support;

use daic_hil_sim::config::{SpecimenConfig, SurfaceConfig};
use daic_hil_sim::scene::surface::{Line, Surface};
use daic_hil_sim::{ConfigError, SimConfig};

/// Lines like those behind the grating: both orders, leaning a little along y too.
fn lines() -> Vec<Line> {
    let mut list = Vec::new();
    for i in 0..41 {
        for j in 0..17 {
            for lean in [-0.22, -0.19, 0.16, 0.24] {
                let direction = [lean, -0.02 + 0.0025 * f64::from(j), -0.97];
                let aim = [-10.2 + 0.51 * f64::from(i), -9.7 + 1.21 * f64::from(j)];
                // 100 mm in front of the reference plane.
                let t = 100.0 / direction[2];
                list.push(Line {
                    origin: [aim[0] + t * direction[0], aim[1] + t * direction[1], 100.0],
                    direction,
                });
            }
        }
    }
    list
}

/// The hit lies on the line and on h(X, Y), and no point of the line before it is at or below h.
fn check(name: &str, surface: SurfaceConfig, tolerance: f64, height: impl Fn(f64, f64) -> Option<f64>) {
    let specimen = SpecimenConfig { surface, ..SpecimenConfig::default() };
    let prepared = Surface::new(&specimen).expect("valid");
    let (mut hits, mut worst) = (0, 0.0f64);
    for line in lines() {
        let at = |h: f64| {
            let t = (h - line.origin[2]) / line.direction[2];
            [line.origin[0] + t * line.direction[0], line.origin[1] + t * line.direction[1]]
        };
        let inside = |[x, y]: [f64; 2]| x.abs() <= 10.0 && y.abs() <= 10.0;
        // Brute force: from above in steps of 1 µm, the first point at or below the surface.
        let mut walked = None;
        let mut h = 3.0;
        while h > -4.0 {
            let p = at(h);
            if height(p[0], p[1]).is_some_and(|s| h <= s) {
                walked = inside(p).then_some((h, p));
                break;
            }
            h -= 1e-3;
        }
        let hit = prepared.first_hit(&line);
        match (hit, walked) {
            (Some(hit), Some((h, _))) => {
                hits += 1;
                assert!((hit[2] - h).abs() < 2e-3, "{name}: {hit:?}, walked to {h}");
                let p = at(hit[2]);
                assert!(
                    (p[0] - hit[0]).abs() < 1e-10 && (p[1] - hit[1]).abs() < 1e-10,
                    "{name}: off the line"
                );
                let on = height(hit[0], hit[1]).map_or(f64::INFINITY, |s| (s - hit[2]).abs());
                worst = worst.max(on);
                assert!(prepared.may_hit(&line, 0.0), "{name}: the box must hold every hit");
            }
            (None, None) => {}
            // Rim of specimen or shape: the two may differ by the step of the walk.
            (Some(hit), None) => {
                let rim = (hit[0].abs() - 10.0).abs() < 2e-3 || (hit[1].abs() - 10.0).abs() < 2e-3;
                assert!(rim, "{name}: {hit:?} but walked past");
            }
            (None, Some((_, p))) => {
                let rim = (p[0].abs() - 10.0).abs() < 2e-3 || (p[1].abs() - 10.0).abs() < 2e-3;
                assert!(rim, "{name}: missed, walked to {p:?}");
            }
        }
    }
    println!("{name}: {hits} hits, farthest from the surface {worst:.1e} mm");
    assert!(hits > 2000, "{name}: {hits}");
    assert!(worst < tolerance, "{name}: {worst}");
}

#[test]
fn plane() {
    let config = SurfaceConfig::Plane { height_mm: 0.3, slope_x: 0.12, slope_y: -0.07 };
    check("plane", config, 1e-12, |x, y| Some(0.3 + 0.12 * x - 0.07 * y));
}

#[test]
fn cylinder() {
    let config = SurfaceConfig::Cylinder { radius_mm: 36.0, apex_mm: 1.0, floor_mm: None };
    check("cylinder", config, 1e-12, |x, _| Some((36.0_f64.powi(2) - x * x).sqrt() - 35.0));
}

#[test]
fn sphere_on_a_floor() {
    let config = SurfaceConfig::Sphere { radius_mm: 30.0, apex_mm: 1.5, floor_mm: Some(0.2) };
    check("sphere", config, 1e-12, |x, y| {
        let root2 = 900.0 - x * x - y * y;
        Some(if root2 > 0.0 { (root2.sqrt() - 28.5).max(0.2) } else { 0.2 })
    });
}

#[test]
fn small_ball_hides_what_lies_behind_it() {
    // Steeper than the light at its rim: part of the floor is in its shadow.
    let config = SurfaceConfig::Sphere { radius_mm: 2.0, apex_mm: 2.0, floor_mm: Some(0.0) };
    check("ball", config, 1e-12, |x, y| {
        let root2 = 4.0 - x * x - y * y;
        Some(if root2 > 0.0 { root2.sqrt() } else { 0.0 })
    });
}

#[test]
fn cone_on_a_floor() {
    let config = SurfaceConfig::Cone { apex_mm: 1.0, slope: 0.25, floor_mm: Some(-0.5) };
    check("cone", config, 1e-12, |x, y| Some((1.0 - 0.25 * (x * x + y * y).sqrt()).max(-0.5)));
}

#[test]
fn steep_cone() {
    let config = SurfaceConfig::Cone { apex_mm: 2.0, slope: 6.0, floor_mm: Some(-1.0) };
    check("steep cone", config, 1e-11, |x, y| Some((2.0 - 6.0 * (x * x + y * y).sqrt()).max(-1.0)));
}

#[test]
fn step_up_and_down() {
    const WALL: f64 = 0.45;
    for (low, high, direction) in [(0.0, 0.8, 0.0), (0.6, -0.4, 0.0), (0.0, 0.8, 1.9)] {
        let config = SurfaceConfig::Step { x_mm: WALL, low_mm: low, high_mm: high, direction_rad: direction };
        let specimen = SpecimenConfig { surface: config, ..SpecimenConfig::default() };
        let surface = Surface::new(&specimen).expect("valid");
        let (mut levels, mut walls) = (0, 0);
        for line in lines() {
            let [o, d] = [line.origin, line.direction];
            // Distance along the direction in which the wall is crossed.
            let across = |p: [f64; 3]| p[0] * direction.cos() + p[1] * direction.sin();
            let at = |h: f64| {
                let t = (h - o[2]) / d[2];
                [o[0] + t * d[0], o[1] + t * d[1], h]
            };
            let Some(hit) = surface.first_hit(&line) else { continue };
            let (upper, lower) = (low.max(high), low.min(high));
            let upper_here = |p: [f64; 3]| (across(p) >= WALL) == (high > low);
            let near = |p: [f64; 3]| (0..2).all(|k| (hit[k] - p[k]).abs() < 1e-12);
            // Expected from where the line passes the two levels.
            if upper_here(at(upper)) {
                assert!(hit[2] == upper && near(at(upper)));
                levels += 1;
            } else if !upper_here(at(lower)) {
                assert!(hit[2] == lower && near(at(lower)));
                levels += 1;
            } else {
                assert!((across(hit) - WALL).abs() < 1e-12 && hit[2] < upper && hit[2] > lower);
                assert!(near(at(hit[2])));
                walls += 1;
            }
        }
        assert!(levels > 2000 && walls >= 5, "{levels} {walls}");
    }
}

/// A 16-bit image of a paraboloid: heights quantised to 2 mm / 65 535 = 31 nm, cubic in between.
#[test]
fn height_map_from_an_image() {
    let (n, pixel) = (221u32, 0.1);
    let bowl = |x: f64, y: f64| 1.2 - 0.008 * (x * x + 0.6 * y * y + 0.3 * x * y);
    let directory = tempfile::tempdir().expect("directory");
    let file = directory.path().join("bowl.png");
    let image = image::ImageBuffer::<image::Luma<u16>, _>::from_fn(n, n, |i, j| {
        let (x, y) = ((f64::from(i) - 110.0) * pixel, (f64::from(j) - 110.0) * pixel);
        image::Luma([((bowl(x, y) + 0.8) / 2.0 * 65_535.0).round() as u16])
    });
    image.save(&file).expect("saved");
    let config =
        SurfaceConfig::HeightMap { file: file.clone(), pixel_mm: pixel, black_mm: -0.8, white_mm: 1.2 };
    // Half a grey value is 15 nm; the spline's overshoot makes that at most 3 times as much.
    check("height map", config, 4.6e-5, |x, y| Some(bowl(x, y)));

    let open = |file: &std::path::Path| {
        let surface =
            SurfaceConfig::HeightMap { file: file.to_owned(), pixel_mm: pixel, black_mm: 0.0, white_mm: 1.0 };
        Surface::new(&SpecimenConfig { surface, ..SpecimenConfig::default() })
    };
    let empty = directory.path().join("empty.png");
    std::fs::write(&empty, b"").expect("written");
    assert!(matches!(open(&empty), Err(ConfigError::HeightMap { .. })));
    assert!(matches!(open(&directory.path().join("absent.png")), Err(ConfigError::HeightMap { .. })));
    let tiny = directory.path().join("tiny.png");
    image::GrayImage::new(3, 9).save(&tiny).expect("saved");
    assert!(matches!(open(&tiny), Err(ConfigError::HeightMapTooSmall { width: 3, height: 9, .. })));
}

/// A relief so steep that lines meet it several times: the first meeting counts.
#[test]
fn rough_height_map_is_met_from_the_front() {
    let (n, pixel) = (401usize, 0.05);
    let wave = |x: f64, y: f64| 0.6 * (x * 4.0).sin() * (y * 3.0).cos();
    let heights = (0..n * n)
        .map(|k| wave(((k % n) as f64 - 200.0) * pixel, ((k / n) as f64 - 200.0) * pixel) * 4.0)
        .collect();
    let map = daic_hil_sim::scene::height_map::HeightMap::from_heights(n, n, heights, pixel);
    let (mut several, mut worst) = (0, 0.0f64);
    for line in lines() {
        let Some(hit) = map.first_hit(&line) else { panic!("a map has no holes") };
        let above = |h: f64| {
            let [x, y] = line.at_height(h);
            h - map.height(x, y)
        };
        worst = worst.max(above(hit[2]).abs());
        let mut h = 2.5;
        while h > hit[2] + 1e-3 {
            assert!(above(h) > 0.0, "met at {h} already, not at {}", hit[2]);
            h -= 1e-3;
        }
        while h > -2.5 {
            if above(h) > 1e-3 && h < hit[2] - 1e-2 {
                several += 1;
                break;
            }
            h -= 1e-3;
        }
    }
    assert!(several > 20, "only {several} lines meet it more than once");
    assert!(worst < 1e-9, "{worst}");
}

#[test]
fn configurations_are_written_read_and_refused() {
    let config = SimConfig::default();
    let text = config.to_toml().expect("written");
    assert_eq!(SimConfig::from_toml(&text).expect("read"), config);
    let mut full = config.clone();
    full.scene.specimen.surface = SurfaceConfig::Cone { apex_mm: 1.0, slope: 0.2, floor_mm: Some(0.0) };
    full.scene.optics.grating_plus = Some(Default::default());
    full.clock = daic_hil_sim::config::ClockMode::Wall { rate: 2.0 };
    full.faults.drop_frames = vec![3];
    full.faults.reset_after_requests = Some(4);
    assert_eq!(SimConfig::from_toml(&full.to_toml().expect("written")).expect("read"), full);

    let refused = |text: &str| SimConfig::from_toml(text).expect_err(text).to_string();
    assert!(refused("[camera]\nexposure_us = 3\n").contains("exposure_us"));
    assert!(refused("[camera]\nexposure_us = 3\n").contains("line 2"));
    assert!(refused("[scene.specimen.surface]\nkind = \"plane\"\nradius_mm = 3.0\n").contains("radius_mm"));
    assert!(refused("[scene.optics]\npinhole_to_grating_mm = -307.0\n").contains("pinhole_to_grating_mm"));
    assert!(refused("[scene.optics]\nfocal_px = nan\n").contains("focal_px"));
    assert!(refused("[scene.optics.grating]\npitch_mm = 0.0005\n").contains("no first order"));
    assert!(refused("[camera]\nbits = 17\n").contains("8 … 16"));
}
