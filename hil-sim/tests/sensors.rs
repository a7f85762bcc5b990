//! Width of the spectrum, colour filters and rolling shutter against formulas.

mod support;

use daic_hil_sim::SimConfig;
use daic_hil_sim::config::{BayerConfig, BayerPattern, SpectrumShape};
use daic_hil_sim::frame::Imager;
use daic_hil_sim::scene::Scene;
use daic_hil_sim::scene::trace::View;
use daic_hil_sim::world::World;
use daic_protocol::channels;
use support::{noiseless, small};

/// Pinhole to grating, grating to plane, pitch, mm; F in pixels; left edge of the specimen, mm.
const RIG: (f64, f64, f64, f64, f64) = (307.0, 109.0, 1.0 / 300.0, 17_347.0, -4.0);
/// Column of the optical axis.
const AXIS: f64 = 1295.5;

/// The macro set-up with F of a lens focused on the reference plane, an even plane that ends at ±4 mm; one row, one ray
/// per pixel.
fn edge(change: impl FnOnce(&mut SimConfig)) -> Scene {
    let mut config = SimConfig::default();
    config.scene.optics.focal_px = RIG.3;
    config.scene.specimen.half_width_mm = -RIG.4;
    config.scene.texture.contrast = 0.0;
    config.scene.samples = 1;
    config.camera.height = 1;
    config.scene.optics.principal_point_px = Some([AXIS, 0.0]);
    change(&mut config);
    Scene::new(&config).expect("valid")
}

/// The column that sees the edge, and the specimen's millimetres per pixel there, from the grating equation alone:
/// X = s tan a + d tan a', sin a' = sin a ± λ/p, solved by bisection.
fn column(view: View, wavelength_mm: f64) -> (f64, f64) {
    let (s, d, pitch, focal, edge_mm) = RIG;
    let order = if view == View::Minus { 1.0 } else { -1.0 };
    let behind = |a: f64| (a.sin() + order * wavelength_mm / pitch).asin();
    let (mut low, mut high) = (-0.2_f64, 0.2_f64);
    for _ in 0..60 {
        let a = 0.5 * (low + high);
        if s * a.tan() + d * behind(a).tan() < edge_mm { low = a } else { high = a }
    }
    let stretch = (low.cos() / behind(low).cos()).powi(3);
    (AXIS + focal * low.tan(), (s + d * stretch) / focal)
}

/// Positions of the stage, a `STEPS`th of a pixel apart.
const STEPS: usize = 64;

/// Mean and variance, px, of the slope of the image at the left edge of a view.
///
/// The slopes of an edge that the pixels see at one place only depend on where in a pixel it lies: of a sharp one the
/// variance is 0, whatever is taken off for the pixels. So the specimen is moved through one pixel and the slopes are
/// taken together, each at its place less the motion. A sharp edge then has the mean of its place within
/// 1/(2·`STEPS`), and the variance (1 − 1/`STEPS`²)/12 of `STEPS` places a `STEPS`th apart, wherever it lies.
fn left_edge(scene: &Scene, view: View) -> [f64; 2] {
    let step_mm = column(view, 633e-6).1 / STEPS as f64;
    let (width, _) = scene.size();
    let half = width / 2;
    let from = if view == View::Minus { 0 } else { half };
    let mut slopes = Vec::new();
    for k in 0..STEPS {
        let image = scene.render([k as f64 * step_mm, 0.0, 0.0]);
        let row = &image[from..from + half];
        let lit = row.iter().position(|v| *v > 0.25).expect("lit");
        // Wide enough for 20 px of smear to either side, and far from the right edge.
        slopes.extend((lit - 40..lit + 40).map(|i| {
            let place = (from + i) as f64 - 0.5 - k as f64 / STEPS as f64;
            (place, f64::from(row[i]) - f64::from(row[i - 1]))
        }));
    }
    let total: f64 = slopes.iter().map(|s| s.1).sum();
    assert!((total / STEPS as f64 - 0.5).abs() < 1e-5, "a part of the edge is outside: {total}");
    let mean = slopes.iter().map(|s| s.0 * s.1).sum::<f64>() / total;
    [mean, slopes.iter().map(|s| (s.0 - mean).powi(2) * s.1).sum::<f64>() / total]
}

/// A source of width Δλ smears each view. For rays that leave the grating along its normal that is z Δλ/(p c³)
/// (2.84 px for 2 nm); the specimen below the axis is seen at 8° instead of 10.95°, and 2.79 px wide.
/// Expected is therefore the variance of the places where the grating equation puts the edge, over the spectrum.
#[test]
fn the_spectrum_smears_the_views() {
    for view in [View::Minus, View::Plus] {
        let [_, mono] = left_edge(&edge(|_| {}), view);
        let of_steps = (1.0 - (STEPS as f64).powi(-2)) / 12.0;
        assert!((mono - of_steps).abs() < 1e-9, "{mono} {of_steps}");
        for (nm, shape) in
            [(2.0, SpectrumShape::Box), (10.0, SpectrumShape::Box), (2.0, SpectrumShape::Gaussian)]
        {
            let scene = edge(|c| {
                c.scene.spectrum.width_mm = nm * 1e-6;
                c.scene.spectrum.shape = shape;
                c.scene.spectrum.samples = 64;
            });
            let [_, variance] = left_edge(&scene, view);
            let found = (variance - mono).sqrt();
            // Full widths to either side, and the density there.
            let reach = if shape == SpectrumShape::Box { 0.5 } else { 1.5 };
            let places: Vec<(f64, f64)> = (0..2000)
                .map(|i| {
                    let offset = reach * ((f64::from(i) + 0.5) / 1000.0 - 1.0);
                    let density = match shape {
                        SpectrumShape::Box => 1.0,
                        SpectrumShape::Gaussian => 0.5_f64.powf(4.0 * offset * offset),
                    };
                    (column(view, (633.0 + offset * nm) * 1e-6).0, density)
                })
                .collect();
            let total: f64 = places.iter().map(|p| p.1).sum();
            let mean = places.iter().map(|p| p.0 * p.1).sum::<f64>() / total;
            let expected = (places.iter().map(|p| (p.0 - mean).powi(2) * p.1).sum::<f64>() / total).sqrt();
            eprintln!("{view:?} {nm} nm {shape:?}: σ {found:.4} px, expected {expected:.4}");
            // Each of the 64 wavelengths' edges is rounded to 1/64 px. Rounding such edges from 1000 random places
            // changes σ by at most 1.7e-3 of it.
            assert!((found / expected - 1.0).abs() < 2e-3, "{view:?} {nm} {shape:?}: {found} {expected}");
        }
    }
}

/// A longer wavelength moves the views apart, each by half of what the disparity takes: opposite senses. The left
/// edge is seen at 7.5° in one and 8.6° in the other view, hence not by the same.
#[test]
fn a_longer_wavelength_moves_the_views_apart() {
    for (view, sense) in [(View::Minus, -1.0), (View::Plus, 1.0)] {
        let [before, after] = [632e-6, 634e-6].map(|wavelength| {
            let found = left_edge(&edge(|c| c.scene.optics.wavelength_mm = wavelength), view)[0];
            let expected = column(view, wavelength).0;
            // Half a step of the stage; the specimen's scale changes by 3e-5 within a pixel and 1 nm.
            assert!((found - expected).abs() < 0.5 / STEPS as f64 + 1e-4, "{view:?}: {found} {expected}");
            found
        });
        eprintln!("{view:?}: {:.4} px for 2 nm", after - before);
        // 2.783 px and 2.798 px, the difference of two places rounded to half a step.
        assert!((sense * (after - before) - 2.79).abs() < 0.01 + 1.0 / STEPS as f64, "{before} {after}");
    }
}

/// As few wavelengths as are taken by themselves give the picture that many give.
#[test]
fn few_wavelengths_are_enough() {
    let render = |samples| {
        let mut config = SimConfig::default();
        config.scene.spectrum.width_mm = 2e-6;
        config.scene.spectrum.samples = samples;
        config.camera.height = 60;
        config.scene.optics.principal_point_px = Some([1295.5, 29.5]);
        Scene::new(&config).expect("valid").render([0.0; 3])
    };
    let (few, many) = (render(0), render(24));
    // Away from the specimen's edges, which few wavelengths make into steps.
    let worst = (0..60)
        .flat_map(|y| (250..650).map(move |x| y * 2592 + x))
        .map(|k| f64::from((few[k] - many[k]).abs()))
        .fold(0.0, f64::max);
    eprintln!("largest difference {worst:.1e} of full reflectance");
    // A twelfth of a grey level of 8 bits.
    assert!(worst < 3e-4, "{worst}");
}

fn bare(change: impl FnOnce(&mut SimConfig)) -> SimConfig {
    let mut config = noiseless(small());
    config.scene.texture.contrast = 0.0;
    config.camera.exposure_ns = 1_000_000;
    config.camera.trigger_delay_ns = 0;
    config.light.led_electrons_per_s = vec![1e7];
    change(&mut config);
    config
}

/// Plays a trigger at tick 0 and a strobe between two ticks; the counts without offset, in electrons.
fn frame(config: &SimConfig, on: u64, off: u64) -> (Vec<f64>, f64) {
    let mut world = World::new(config);
    let (camera, led) = (channels::camera(0).expect("there"), channels::led(0).expect("there"));
    world.level(0, 0, u16::MAX);
    world.word(1_000, camera);
    world.word(1_000 + on, led);
    world.word(1_000 + off, 0);
    world.advance(100_000_000);
    let exposures = world.take_exposures();
    let [exposure] = &exposures[..] else { panic!("{} exposures", exposures.len()) };
    let mut imager = Imager::new(config).expect("valid");
    let frame = imager.frame(exposure);
    let counts = frame.data.iter();
    let electrons =
        counts.map(|&c| (f64::from(c) - config.camera.offset_dn) * config.camera.electrons_per_dn).collect();
    (electrons, frame.truth.electrons)
}

/// Of a strobe that begins before the last rows are exposed and ends after the first, each row has what overlaps
/// with its own exposure; a strobe while all rows are exposed is as with a global shutter.
#[test]
fn rows_of_a_rolling_shutter_see_their_own_part_of_a_strobe() {
    // 243 rows, 2 µs each: the last is 484 µs late. Exposure 1 ms. The rows see 45 mm, all of it specimen.
    let tall = |row_ns| {
        bare(|c| {
            c.camera.row_ns = row_ns;
            c.scene.specimen.half_height_mm = 30.0;
        })
    };
    let (rolling, global) = (tall(2_000), tall(0));
    let us = 125;
    let (inside, _) = frame(&rolling, 500 * us, 900 * us);
    assert!(inside == frame(&global, 500 * us, 900 * us).0);

    let (cut, mean) = frame(&rolling, 200 * us, 1_200 * us);
    let mut sum = 0.0;
    for y in 0..243 {
        // Row y is exposed from 2y to 1000 + 2y µs.
        let start = 2.0 * y as f64;
        let lit = (1_200.0_f64.min(1_000.0 + start) - 200.0_f64.max(start)) * 1e-6;
        let expected = 1e7 * lit;
        sum += expected;
        // The specimen's reflectance is 0.5; in the middle of the −1 view it fills the pixel.
        let found = cut[y * 324 + 60];
        // Counts are rounded to 2.5 electrons.
        assert!((found - 0.5 * expected).abs() <= 1.3, "row {y}: {found} {}", 0.5 * expected);
    }
    assert!((mean - sum / 243.0).abs() < 1e-6 * mean, "{mean} {}", sum / 243.0);
}

/// The camera is busy until its last row has been read.
#[test]
fn a_rolling_shutter_keeps_the_camera_busy_for_longer() {
    for (row_ns, busy_us) in [(0, 11_000), (2_000, 11_484)] {
        let mut world = World::new(&bare(|c| c.camera.row_ns = row_ns));
        let camera = channels::camera(0).expect("there");
        world.word(0, camera);
        assert_eq!(world.camera_free_at(), Some(busy_us * 125));
    }
}

/// A mosaic takes from each pixel what its filter does, and nothing else.
#[test]
fn colour_filters_take_their_part() {
    let us = 125;
    let (plain, _) = frame(&bare(|_| {}), 0, 100 * us);
    let cells = [
        (BayerPattern::Rggb, [0, 1, 1, 2]),
        (BayerPattern::Grbg, [1, 0, 2, 1]),
        (BayerPattern::Gbrg, [1, 2, 0, 1]),
        (BayerPattern::Bggr, [2, 1, 1, 0]),
    ];
    let response = [1.0, 0.25, 0.05];
    for (pattern, cell) in cells {
        let (filtered, _) =
            frame(&bare(|c| c.camera.bayer = Some(BayerConfig { pattern, response })), 0, 100 * us);
        let mut lit = 0;
        for (k, (&found, &bare)) in filtered.iter().zip(&plain).enumerate() {
            let (x, y) = (k % 324, k / 324);
            let expected = bare * response[cell[2 * (y % 2) + x % 2]];
            // Both are rounded to 2.5 electrons.
            assert!((found - expected).abs() <= 2.6, "{pattern:?} {x} {y}: {found} {expected}");
            lit += usize::from(bare > 0.0);
        }
        assert!(lit > 10_000, "{lit}");
    }
}
