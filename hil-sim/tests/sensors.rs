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

/// The macro set-up with F of a lens focused on the reference plane, an even plane that ends at ±4 mm.
fn edge(change: impl FnOnce(&mut SimConfig)) -> Scene {
    let mut config = SimConfig::default();
    config.scene.optics.focal_px = 17_347.0;
    config.scene.specimen.half_width_mm = 4.0;
    config.scene.texture.contrast = 0.0;
    config.scene.samples = 4;
    config.camera.height = 3;
    config.scene.optics.principal_point_px = Some([1295.5, 1.0]);
    change(&mut config);
    Scene::new(&config).expect("valid")
}

/// Mean and variance, px, of the image's slope at the left edge of a view.
fn left_edge(scene: &Scene, view: View) -> [f64; 2] {
    let image = scene.render([0.0; 3]);
    let (width, _) = scene.size();
    let half = width / 2;
    let row = &image[width + if view == View::Minus { 0 } else { half }..][..half];
    let brightest = row.iter().position(|v| *v > 0.49).expect("lit");
    let slopes = (1..brightest + 40).map(|i| (i as f64 - 0.5, f64::from(row[i] - row[i - 1])));
    let total: f64 = slopes.clone().map(|s| s.1).sum();
    let mean = slopes.clone().map(|s| s.0 * s.1).sum::<f64>() / total;
    [mean, slopes.map(|s| (s.0 - mean).powi(2) * s.1).sum::<f64>() / total]
}

/// A source of width Δλ smears each view by z Δλ/(p c³) (EQUATIONS 1d). For 2 nm at 109 mm and 300 lines/mm that is
/// 69.1 µm, 2.84 px of 24.3 µm. An even spectrum has the variance of a box of that width, a Gaussian its own.
#[test]
fn the_spectrum_smears_the_views() {
    let theta = (633e-6_f64 * 300.0).asin();
    let c3 = theta.cos().powi(3);
    let pixel = (307.0 + 109.0 / c3) / 17_347.0;
    let width = |nm: f64| 109.0 * nm * 1e-6 * 300.0 / c3 / pixel;
    assert!((width(2.0) - 2.84).abs() < 0.005, "{}", width(2.0));
    for view in [View::Minus, View::Plus] {
        let [_, mono] = left_edge(&edge(|_| {}), view);
        for (nm, shape) in
            [(2.0, SpectrumShape::Box), (10.0, SpectrumShape::Box), (2.0, SpectrumShape::Gaussian)]
        {
            let scene = edge(|c| {
                c.scene.spectrum.width_mm = nm * 1e-6;
                c.scene.spectrum.shape = shape;
                c.scene.spectrum.samples = 64;
            });
            let [_, variance] = left_edge(&scene, view);
            let found = variance - mono;
            let expected = match shape {
                SpectrumShape::Box => width(nm).powi(2) / 12.0,
                // Full width at half maximum to σ; cut at ±1.5 full widths, which takes 0.6 % off.
                SpectrumShape::Gaussian => width(nm).powi(2) / (8.0 * std::f64::consts::LN_2) * 0.994,
            };
            let (found, expected) = (found.sqrt(), expected.sqrt());
            eprintln!("{view:?} {nm} nm {shape:?}: σ {found:.4} px, formula {expected:.4}");
            // The edge at X = −4 mm is seen 0.8° off the axis, where z Δλ/(p c³) is 2 % larger or smaller.
            assert!((found / expected - 1.0).abs() < 0.03, "{view:?} {nm} {shape:?}: {found} {expected}");
        }
    }
}

/// A longer wavelength moves the views apart, each by half of what the disparity takes: opposite senses.
#[test]
fn a_longer_wavelength_moves_the_views_apart() {
    let at = |nm: f64, view| left_edge(&edge(|c| c.scene.optics.wavelength_mm = nm * 1e-6), view)[0];
    let moved = |view| at(634.0, view) - at(632.0, view);
    let (minus, plus) = (moved(View::Minus), moved(View::Plus));
    assert!((minus + 2.84).abs() < 0.1 && (plus - 2.84).abs() < 0.1, "{minus} {plus}");
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
    // 243 rows, 2 µs each: the last is 484 µs late. Exposure 1 ms.
    let rolling = bare(|c| c.camera.row_ns = 2_000);
    let global = bare(|_| {});
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
        let found = cut[y * 324 + 90];
        if found > 0.0 {
            // Counts are rounded to 2.5 electrons.
            assert!((found - 0.5 * expected).abs() <= 1.3, "row {y}: {found} {}", 0.5 * expected);
        } else {
            assert!(!(40..200).contains(&y), "row {y} is dark");
        }
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
