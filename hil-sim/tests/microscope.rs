//! The microscope's scene against the exact rays of the decoders' crate and against formulas.

use daic_hil_sim::SimConfig;
use daic_hil_sim::config::{GratingConfig, MicroscopeConfig, SpecimenConfig, SurfaceConfig, TextureConfig};
use daic_hil_sim::scene::Scene;
use daic_hil_sim::scene::trace::View;
use daic_optics::PairModel as _;
use daic_optics::microscope::RayMicroscope;
use nalgebra::Vector3;

fn config(change: impl FnOnce(&mut SimConfig)) -> SimConfig {
    let mut config = SimConfig { seed: 5, ..SimConfig::default() };
    config.camera.width = 1440;
    config.camera.height = 720;
    config.scene.microscope = Some(MicroscopeConfig::default());
    config.scene.specimen = SpecimenConfig {
        surface: SurfaceConfig::Sphere { radius_mm: 0.68, apex_mm: 0.01, floor_mm: None },
        half_width_mm: 0.25,
        half_height_mm: 0.25,
        offset_mm: [0.0; 3],
    };
    config.scene.texture = TextureConfig { speckle_mm: 0.0027, ..TextureConfig::default() };
    change(&mut config);
    config
}

fn microscope(config: &mut SimConfig) -> &mut MicroscopeConfig {
    config.scene.microscope.as_mut().expect("set")
}

/// What a pixel sees is projected back onto it by the rays of `daic_optics`, which are traced apart: square and
/// telecentric, and with everything tilted, on glass, in water and with perspective on both sides.
#[test]
fn pixels_and_points_belong_together() {
    let odd = |c: &mut SimConfig| {
        let m = microscope(c);
        m.relay_magnification = -0.9;
        m.relay_index = 1.33;
        m.objective_perspective_per_mm = 0.08;
        m.axis_px = Some([700.0, 371.5]);
        m.grating.tilt_rad = [0.02, -0.03, 0.01];
        m.grating.substrate_mm = 0.3;
        m.grating_plus = Some(GratingConfig {
            pitch_mm: 2.004e-3,
            tilt_rad: [-0.015, 0.02, 0.011],
            substrate_mm: 0.2,
            substrate_index: 1.46,
        });
    };
    for config in [config(|_| {}), config(odd)] {
        let scene = Scene::new(&config).expect("valid");
        let m = config.scene.microscope.as_ref().expect("set");
        let rays = RayMicroscope::new(&m.geometry(1440, 720)).expect("valid");
        let mut seen = 0;
        for (view, other) in [(View::Minus, daic_optics::View::Minus), (View::Plus, daic_optics::View::Plus)]
        {
            for k in 0..400 {
                let x = f64::from(k % 20) * 35.0 + if view == View::Plus { 720.0 } else { 0.0 };
                let y = f64::from(k / 20) * 36.0;
                let stage = [0.003, -0.002, 0.007];
                let Some(p) = scene.object_point(view, x, y, stage) else { continue };
                seen += 1;
                let (pixel, _) = rays.project_point(other, Vector3::from(p)).expect("seen");
                let off = (pixel[0] - x).hypot(pixel[1] - y);
                // Rounding of numbers of 10 mm, magnified to pixels of 0.5 µm.
                assert!(off < 1e-8, "{view:?} {x} {y}: {p:?} {pixel:?}");
                let sphere =
                    (0.68_f64.powi(2) - (p[0] - stage[0]).powi(2) - (p[1] - stage[1]).powi(2)).sqrt();
                assert!((p[2] - stage[2] - (sphere - 0.68 + 0.01)).abs() < 1e-12, "{p:?}");
            }
        }
        assert!(seen > 300, "{seen}");
    }
}

/// The field stop shows as two rectangles of its size, apart by the disparity of the plane it lies on.
#[test]
fn the_field_stop_bounds_both_views() {
    let config = config(|c| {
        c.scene.specimen.surface = SurfaceConfig::Plane { height_mm: 0.0, slope_x: 0.0, slope_y: 0.0 };
        c.scene.texture.contrast = 0.0;
    });
    let image = Scene::new(&config).expect("valid").render([0.0; 3]);
    let m = config.scene.microscope.as_ref().expect("set");
    let rays = RayMicroscope::new(&m.geometry(1440, 720)).expect("valid");
    let pair = rays.see(Vector3::zeros()).expect("seen");
    for (view, at) in [(0, pair.minus_px), (1, pair.plus_px)] {
        let row = &image[360 * 1440 + 720 * view..][..720];
        let column: Vec<f32> = (0..720).map(|y| image[y * 1440 + at[0].round() as usize]).collect();
        let lit = |line: &[f32]| {
            let sum: f64 = line.iter().map(|&v| f64::from(v)).sum();
            let first: f64 = line.iter().enumerate().map(|(i, &v)| i as f64 * f64::from(v)).sum();
            (sum / 0.5, first / sum)
        };
        let (width, middle) = lit(row);
        let (height, level) = lit(&column);
        let pixel = config.pixel_mm();
        // 2 × 2 samples resolve an edge to a quarter of a pixel or so.
        assert!((width - 0.32 / pixel).abs() < 1.0, "{width}");
        assert!((height - 0.34 / pixel).abs() < 1.0, "{height}");
        assert!((middle + 720.0 * view as f64 - at[0]).abs() < 0.5, "{middle} {at:?}");
        assert!((level - at[1]).abs() < 0.5, "{level} {at:?}");
    }
}

/// Positions of the stage, a `STEPS`th of a pixel apart.
const STEPS: usize = 128;

/// Out of focus a point is a disk: the line spread function of a uniform disk of radius r has the variance r²/4, and
/// r = w tan(asin NA). From the edge of the specimen, whose derivative is that function.
///
/// What the pixels add to the variance of a single edge depends on where in a pixel it lies: nothing if sharp. So the
/// specimen is moved through one pixel and the slopes are taken together, each at its place less the motion; they then
/// sample the edge `STEPS` times per pixel and the pixel's share is that of the sharp edge, wherever it lies.
#[test]
fn defocus_grows_with_the_distance_from_the_sharp_plane() {
    let config = config(|c| {
        c.camera.height = 1;
        c.scene.specimen.surface = SurfaceConfig::Plane { height_mm: 0.0, slope_x: 0.0, slope_y: 0.0 };
        c.scene.specimen.half_width_mm = 0.02;
        c.scene.specimen.half_height_mm = 0.1;
        c.scene.texture.contrast = 0.0;
        // The middle of each pixel alone, so that nothing but the cone widens the edge.
        c.scene.samples = 1;
        let m = microscope(c);
        m.relay_perspective_per_mm = 0.0;
        // 38 px of it lie dark on either side of the specimen.
        m.field_mm[0] = 0.08;
        m.pupil_rings = 6;
    });
    let scene = Scene::new(&config).expect("valid");
    let pixel = config.pixel_mm();
    let variance = |w: f64| {
        let mut slopes = Vec::new();
        for k in 0..STEPS {
            let part = k as f64 / STEPS as f64;
            let image = scene.render([part * pixel, 0.0, w]);
            // The left edge of the −1 view, 10 px of it to either side; the disk has at most 4.
            let lit = image.iter().position(|v| *v > 0.25).expect("lit");
            slopes.extend(
                (lit - 10..lit + 10)
                    .map(|i| (i as f64 - 0.5 - part, f64::from(image[i]) - f64::from(image[i - 1]))),
            );
        }
        let total: f64 = slopes.iter().map(|s| s.1).sum();
        assert!((total / STEPS as f64 - 0.5).abs() < 1e-5, "a part of the edge is outside: {total}");
        let mean = slopes.iter().map(|s| s.0 * s.1).sum::<f64>() / total;
        slopes.iter().map(|s| (s.0 - mean).powi(2) * s.1).sum::<f64>() / total
    };
    let sharp = variance(0.0);
    let of_steps = (1.0 - (STEPS as f64).powi(-2)) / 12.0;
    assert!((sharp - of_steps).abs() < 1e-9, "{sharp} {of_steps}");
    for w in [0.005, -0.005, 0.01, 0.02] {
        let radius = w * 0.1_f64.asin().tan() / pixel;
        let found = variance(w) - sharp;
        let expected = radius * radius / 4.0;
        eprintln!("w {w} mm: variance {found:.4} px², of the disk {expected:.4}");
        // The cone's 144 rays have a disk's variance exactly, but each one's edge is rounded to 1/128 px. Rounding such
        // rays from 2000 random places changes the variance by at most 1.4e-3 of it at 5 µm, less beyond.
        assert!((found / expected - 1.0).abs() < 2e-3, "{w}: {found} {expected}");
    }
}

/// What no microscope has is refused with the name of the number.
#[test]
fn impossible_microscopes_are_refused() {
    type Change = fn(&mut MicroscopeConfig);
    let cases: [(&str, Change); 5] = [
        ("pitch_mm", |m| m.grating.pitch_mm = 4e-4),
        ("relay.magnification", |m| m.relay_magnification = 0.0),
        ("numerical_aperture", |m| m.numerical_aperture = 1.0),
        ("field_mm", |m| m.field_mm[1] = f64::NAN),
        ("pupil_rings", |m| m.pupil_rings = 0),
    ];
    for (name, change) in cases {
        let config = config(|c| change(microscope(c)));
        let error = Scene::new(&config).expect_err(name).to_string();
        assert!(error.contains(name), "{name}: {error}");
    }
    let text = config(|_| {}).to_toml().expect("writable");
    assert_eq!(SimConfig::from_toml(&text).expect("reads back"), config(|_| {}));
}
