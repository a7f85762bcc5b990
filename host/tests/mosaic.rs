//! One channel of a colour sensor, from simulated frames to points, against the simulated geometry.
#![cfg(feature = "sim")]

use daic::Silent;
use daic::measure::{self, Instrument, Reference, Settings, status_counts};
use daic_dataset::{GreyImage, Lattice};
use daic_hil_sim::SimConfig;
use daic_hil_sim::config::{BayerConfig, BayerPattern, SurfaceConfig};
use daic_hil_sim::scene::Scene;
use daic_hil_sim::scene::trace::View;
use daic_hil_sim::sensor::Sensor;
use daic_optics::{Brown, Camera, Decoder, Grating, OpticalModel, Optics, ReferenceFrame};

const SIZE: [usize; 2] = [1296, 972];

/// The macro set-up at half the pixels, a slanted plane, speckles of five pixels of a channel.
fn config() -> SimConfig {
    let mut config = SimConfig { seed: 8, ..SimConfig::default() };
    (config.camera.width, config.camera.height) = (SIZE[0], SIZE[1]);
    config.scene.optics.focal_px /= 2.0;
    config.scene.texture.speckle_mm = 0.45;
    config.scene.specimen.surface = SurfaceConfig::Plane { height_mm: 0.2, slope_x: 0.15, slope_y: -0.1 };
    config.scene.specimen.half_width_mm = 7.5;
    config.scene.specimen.half_height_mm = 7.5;
    config.camera.bayer = Some(BayerConfig { pattern: BayerPattern::Grbg, response: [1.0, 0.3, 0.05] });
    config
}

fn frame(config: &SimConfig, scene: &Scene, stage_mm: [f64; 3], id: u64) -> GreyImage {
    let bayer = config.camera.bayer.as_ref().expect("a mosaic");
    let mut expected = scene.render(stage_mm);
    for (k, e) in expected.iter_mut().enumerate() {
        *e *= (9000.0 * bayer.response_at(k % SIZE[0], k / SIZE[0])) as f32;
    }
    GreyImage {
        width: SIZE[0] as u32,
        height: SIZE[1] as u32,
        container_bits: 16,
        significant_bits: config.camera.bits,
        data: Sensor::new(&config.camera, config.seed).read(id, &expected),
    }
}

fn model(config: &SimConfig) -> OpticalModel {
    let o = &config.scene.optics;
    let grating = Grating::square(o.grating.pitch_mm);
    let optics = Optics {
        camera: Camera {
            focal_px: o.focal_px,
            principal_point_px: [0.5 * (SIZE[0] as f64 - 1.0), 0.5 * (SIZE[1] as f64 - 1.0)],
            brown: Brown::default(),
        },
        wavelength_mm: o.wavelength_mm,
        pinhole_to_grating_mm: o.pinhole_to_grating_mm,
        grating_to_reference_mm: o.grating_to_reference_mm,
        minus: grating,
        plus: grating,
        reference: ReferenceFrame::default(),
    };
    OpticalModel::new(&optics).expect("valid")
}

/// Points of the red and of the green channel lie on the simulated plane, at the pixels of the sensor that they say,
/// and follow a move. An offset forgotten (one pixel, 47 µm, on these slopes) would show as 5 to 7 µm of height.
#[test]
fn a_channel_measures_where_its_pixels_are() {
    let config = config();
    let scene = Scene::new(&config).expect("valid");
    let model = model(&config);
    let instrument = Instrument::new(model.clone(), Decoder::Ray);
    let moved_mm = [0.08, -0.05, 0.3];
    let (before, after) = (frame(&config, &scene, [0.0; 3], 0), frame(&config, &scene, moved_mm, 1));
    // Pattern GRBG: red at (1, 0), green of the red rows at (0, 0).
    for (name, origin) in [("red", [1, 0]), ("green", [0, 0])] {
        let mut settings = Settings { lattice: Lattice::bayer(origin), step: 8, ..Settings::default() };
        (settings.dic.subset, settings.dic.shape) = (41, daic_correlate::Shape::Quadratic);
        let reference = Reference::new(&before, &model, &settings, &Silent).expect("two views");
        assert_eq!(
            (reference.grid.step, reference.grid.x0 % 2, reference.grid.y0 % 2),
            (16, origin[0] as usize, 0)
        );
        let tracks = reference.track(&after, &Silent).expect("tracked");
        let field = measure::displacement(
            &reference.grid,
            &reference.matches,
            &tracks,
            &instrument,
            settings.height_mm,
        );
        eprintln!("{name}: {}", status_counts(field.points.iter().map(|p| p.status)));
        let ok: Vec<_> = field.points.iter().filter(|p| p.status.is_ok()).collect();
        // 15 mm are 320 px; subsets of 82 px, 16 px apart, fit in 13 times along both
        assert_eq!((ok.len(), field.points.len()), (169, 169), "{name}");
        let mut squares = [[0.0; 3]; 2];
        for p in &ok {
            let [x, y] = p.reference.pixel_px;
            let truth = scene.object_point(View::Minus, x, y, [0.0; 3]).expect("on the specimen");
            for i in 0..3 {
                squares[0][i] += (p.reference.point_mm[i] - truth[i]).powi(2);
                squares[1][i] += (p.displacement_mm[i] - moved_mm[i]).powi(2);
            }
        }
        let rms = squares.map(|s| s.map(|s| 1e3 * (s / ok.len() as f64).sqrt()));
        eprintln!("{name}: points {:.3?} µm, displacement {:.3?} µm RMS over {}", rms[0], rms[1], ok.len());
        let mut sigma = [[0.0; 3]; 2];
        for p in &ok {
            for (sum, stated) in sigma.iter_mut().zip([p.reference.sigma_mm(), p.sigma_mm()]) {
                *sum = [0, 1, 2].map(|i| sum[i] + stated[i].powi(2));
            }
        }
        let sigma = sigma.map(|s| s.map(|s| 1e3 * (s / ok.len() as f64).sqrt()));
        eprintln!("{name}: stated {:.3?} µm, displacement {:.3?} µm", sigma[0], sigma[1]);
        for (found, stated) in rms.iter().flatten().zip(sigma.iter().flatten()) {
            // subsets overlap: 169 points are worth about 7, whose RMS scatters by 27 %; two of that
            assert!((0.45..1.55).contains(&(found / stated)), "{name}: {found} µm, stated {stated}");
        }
    }
}
