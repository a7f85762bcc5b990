//! From frames of a speckled plate on a stage to a calibrated rig: `daic track --plate`, `daic calibrate rig --moves`.
#![cfg(feature = "sim")]

use daic::measure::{self, Settings};
use daic::microscope::{TrackOptions, track};
use daic::{Silent, calibrate_rig, optics_section};
use daic_dataset::GreyImage;
use daic_hil_sim::SimConfig;
use daic_hil_sim::config::SurfaceConfig;
use daic_hil_sim::scene::Scene;
use daic_hil_sim::sensor::Sensor;
use daic_optics::{Brown, Camera, Decoder, Grating, OpticalModel, Optics, PixelPair, ReferenceFrame, View};
use daic_rig::experiment::OpticsFile;
use daic_rig::units::{Length, Pixels};
use nalgebra::Vector3;
use std::path::{Path, PathBuf};

const SIZE: [usize; 2] = [1296, 972];
const SLOPES: [f64; 2] = [0.06, -0.05];
const MOVES_MM: [[f64; 3]; 5] =
    [[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [0.8, 0.0, 0.0], [0.0, 0.8, 1.0], [-0.5, 0.4, -1.0]];

/// The macro set-up at half the pixels, a plate that is not square to the axis.
fn config() -> SimConfig {
    let mut config = SimConfig { seed: 5, ..SimConfig::default() };
    (config.camera.width, config.camera.height) = (SIZE[0], SIZE[1]);
    config.scene.optics.focal_px /= 2.0;
    config.scene.texture.speckle_mm = 0.25;
    config.scene.specimen.surface =
        SurfaceConfig::Plane { height_mm: 0.0, slope_x: SLOPES[0], slope_y: SLOPES[1] };
    config.scene.specimen.half_width_mm = 7.0;
    config.scene.specimen.half_height_mm = 7.0;
    config
}

fn truth(config: &SimConfig) -> OpticalModel {
    let o = &config.scene.optics;
    let grating = Grating::square(o.grating.pitch_mm);
    OpticalModel::new(&Optics {
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
    })
    .expect("valid")
}

fn frame(
    folder: &Path,
    name: &str,
    config: &SimConfig,
    scene: &Scene,
    stage_mm: [f64; 3],
    id: u64,
) -> PathBuf {
    let expected: Vec<f32> = scene.render(stage_mm).into_iter().map(|e| 9000.0 * e).collect();
    let image = GreyImage {
        width: SIZE[0] as u32,
        height: SIZE[1] as u32,
        container_bits: 16,
        significant_bits: 16,
        data: Sensor::new(&config.camera, config.seed).read(id, &expected),
    };
    let path = folder.join(name);
    image::ImageBuffer::<image::Luma<u16>, _>::from_raw(image.width, image.height, image.data)
        .expect("size")
        .save(&path)
        .expect("written");
    path
}

#[test]
fn a_speckled_plate_on_a_stage_calibrates_the_rig() {
    let folder = tempfile::TempDir::new().expect("folder");
    let at = |name: &str| folder.path().join(name);
    let config = config();
    let scene = Scene::new(&config).expect("valid");
    let reference = frame(folder.path(), "home.png", &config, &scene, [0.0; 3], 0);
    let mut moves = String::from("pose,x_mm,y_mm,h_mm\n0,0,0,0\n");
    let mut frames = Vec::new();
    for (k, stage) in MOVES_MM.into_iter().enumerate() {
        frames.push(frame(folder.path(), &format!("pose-{k}.png"), &config, &scene, stage, 1 + k as u64));
        moves += &format!("{},{},{},{}\n", k + 1, stage[0], stage[1], stage[2]);
    }
    std::fs::write(at("moves.csv"), moves).expect("written");
    let mut settings = Settings { step: 24, ..Settings::default() };
    (settings.dic.subset, settings.dic.shape) = (41, daic_correlate::Shape::Quadratic);
    // the sides of the field stop do not move with the plate
    settings.roi = Some(measure::Rectangle { x: 100, y: 370, width: 230, height: 230 });
    let options = TrackOptions {
        reference,
        frames,
        search_px: 40.0,
        settings,
        out: at("fields"),
        plate: Some(at("plate.csv")),
    };
    let tracked = track(&options, &Silent).expect("tracked");
    assert_eq!(tracked.len(), MOVES_MM.len());

    // the optics to start from: F and distances 1 % off
    let o = &config.scene.optics;
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml");
    let mut start = OpticsFile::load(&example).expect("valid");
    start.optics.wavelength = Length::new(o.wavelength_mm);
    start.optics.focal = Pixels::new(o.focal_px * 1.005);
    start.optics.principal_point =
        [0.5 * (SIZE[0] as f64 - 1.0), 0.5 * (SIZE[1] as f64 - 1.0)].map(Pixels::new);
    start.optics.pinhole_to_grating = Length::new(o.pinhole_to_grating_mm + 2.0);
    start.optics.grating_to_reference = Length::new(o.grating_to_reference_mm - 1.0);
    std::fs::write(at("start.toml"), start.to_toml().expect("TOML")).expect("written");
    let found = calibrate_rig::run(&calibrate_rig::Options {
        optics: at("start.toml"),
        points: at("plate.csv"),
        moves: Some(at("moves.csv")),
        move_sigma_mm: 1e-4,
        sigma_px: 0.01,
        reference: None,
        out: at("out"),
    })
    .expect("calibrated");
    println!("{} px RMS, χ² {}", found.rms_px, found.chi_square_reduced);

    // the plate is the reference plane: it is flat and at 0, and 1.5 mm along the axis are 1.5 mm times the cosine
    let file = OpticsFile::load(&found.optics).expect("valid");
    let model = optics_section::from_section(&file.optics).expect("optics").model().expect("valid");
    let truth = truth(&config);
    let cosine = 1.0 / (1.0 + SLOPES[0] * SLOPES[0] + SLOPES[1] * SLOPES[1]).sqrt();
    for (h, limit_um) in [(0.0, [0.5, 0.5]), (1.5, [0.5, 0.5])] {
        let heights: Vec<f64> = (0..64)
            .map(|k| {
                let (x, y) = (1.5 * f64::from(k % 8) - 5.25, 1.5 * f64::from(k / 8) - 5.25);
                let p = Vector3::new(x, y, SLOPES[0] * x + SLOPES[1] * y + h);
                let [minus_px, plus_px] =
                    [View::Minus, View::Plus].map(|view| truth.project(view, p).expect("seen"));
                1e3 * model.decode_point(Decoder::Ray, PixelPair { minus_px, plus_px }).expect("decodes").z
            })
            .collect();
        let mean = heights.iter().sum::<f64>() / 64.0;
        let spread = (heights.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / 64.0).sqrt();
        let off = mean - 1e3 * h * cosine;
        println!("{h} mm: {off:.3} µm off, spread {spread:.3} µm");
        assert!(off.abs() < limit_um[0] && spread < limit_um[1], "{h}: {off}, {spread}");
    }
}
