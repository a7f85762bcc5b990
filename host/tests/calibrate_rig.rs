//! Tables of tracked points become an optics file that decodes to micrometres.

use daic::{Error, calibrate_rig, optics_section};
use daic_optics::bundle::Pose;
use daic_optics::{Decoder, Optics, Parameter, PixelPair, RigError, View};
use daic_rig::experiment::OpticsFile;
use nalgebra::Vector3;
use std::fmt::Write as _;
use std::path::Path;

fn start() -> OpticsFile {
    OpticsFile::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml")).unwrap()
}

/// The rig as it is: every distance and angle somewhat off, a reference plane not square.
fn truth(start: &Optics) -> Optics {
    let mut o = *start;
    o.camera.focal_px *= 1.006;
    o.pinhole_to_grating_mm += 1.5;
    o.grating_to_reference_mm -= 1.0;
    o.minus.tilt_rad_xyz = [0.02, -0.03, 0.01];
    o.plus.tilt_rad_xyz = [0.015, -0.03, 0.011];
    o.reference.tilt_rad_xyz = [0.01, -0.02, 0.005];
    o.reference.origin_mm = [0.2, -0.3];
    o
}

/// A table of dots 2 mm apart in seven poses. Noise of a fixed pattern stands for tracking's.
fn table(o: &Optics, swapped: bool) -> String {
    let m = o.model().unwrap();
    let mut text = String::from("pose,point,plate_x_mm,plate_y_mm,minus_x,minus_y,plus_x,plus_y\n");
    let poses = [
        ([0.0; 3], [0.0; 3]),
        ([0.0; 3], [0.0, 0.0, 2.5]),
        ([0.0; 3], [0.1, 0.0, -2.5]),
        ([0.2, 0.0, 0.0], [0.0; 3]),
        ([-0.2, 0.0, 0.0], [0.0, 0.2, 0.0]),
        ([0.0, 0.2, 0.0], [0.0; 3]),
        ([0.0, -0.2, 0.05], [0.0; 3]),
    ];
    let mut k = 0_u32;
    for (pose, (rotation_rad, translation_mm)) in poses.into_iter().enumerate() {
        let plate = Pose { rotation_rad, translation_mm };
        for point in 0..63 {
            let [x, y] = [f64::from(point % 9) * 2.0 - 8.0, f64::from(point / 9) * 2.0 - 6.0];
            let mut px = [View::Minus, View::Plus].map(|view| {
                let p = m.project(view, plate.point_mm([x, y])).unwrap();
                p.map(|v| {
                    k = k.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    // Uniform, σ = 0.01 px.
                    v + 0.01 * 12_f64.sqrt() * (f64::from(k >> 8) / f64::from(1 << 24) - 0.5)
                })
            });
            if swapped {
                px.swap(0, 1);
            }
            let [[a, b], [c, d]] = px;
            // Numbers of poses and points are one's own choice.
            writeln!(text, "{},{},{x},{y},{a},{b},{c},{d}", pose + 10, 100 - point).unwrap();
        }
    }
    text
}

fn options(folder: &Path, points: &str) -> calibrate_rig::Options {
    let path = folder.join("points.csv");
    std::fs::write(&path, points).unwrap();
    calibrate_rig::Options {
        optics: Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml"),
        points: path,
        moves: None,
        move_sigma_mm: 0.001,
        sigma_px: 0.01,
        reference: Some(10),
        out: folder.join("out"),
    }
}

#[test]
fn a_table_of_points_becomes_an_optics_file() {
    let folder = tempfile::tempdir().unwrap();
    let start = optics_section::from_section(&start().optics).unwrap();
    let truth = truth(&start);
    let summary = calibrate_rig::run(&options(folder.path(), &table(&truth, false))).unwrap();
    assert!((summary.chi_square_reduced - 1.0).abs() < 0.2);
    assert_eq!(summary.left_out.len(), 6);
    let file = OpticsFile::load(&summary.optics).unwrap();
    assert!(file.provenance.as_ref().unwrap().contains("7 poses"));
    assert_eq!(file.date.as_ref().unwrap().len(), 20);
    let optics = optics_section::from_section(&file.optics).unwrap();
    for p in &summary.parameters {
        let parameter = Parameter::from_name(p.name).unwrap();
        // 5σ, and the file holds what was found to the last digit but of unit conversion.
        let off = (p.value - parameter.get(&truth)).abs();
        assert!(off < 5.0 * p.sigma, "{}: {} ± {}", p.name, p.value, p.sigma);
        assert!((parameter.get(&optics) - p.value).abs() <= 1e-12 * p.value.abs());
    }
    let covariance = optics_section::covariance(&file, &summary.optics).unwrap().unwrap();
    assert_eq!(covariance.parameters().len(), summary.parameters.len());
    let model = optics.model().unwrap();
    let seen = truth.model().unwrap();
    let mut worst = 0.0_f64;
    for (x, y, h) in
        [(0.0, 0.0, 0.0), (7.0, 5.0, 1.0), (-7.0, 5.0, -1.0), (6.0, -6.0, 2.0), (-8.0, -6.0, 0.0)]
    {
        let p = Vector3::new(x, y, h);
        let pair = PixelPair {
            minus_px: seen.project(View::Minus, p).unwrap(),
            plus_px: seen.project(View::Plus, p).unwrap(),
        };
        worst = worst.max((model.decode_point(Decoder::Ray, pair).unwrap() - p).amax());
    }
    println!("worst {:.2} µm", 1e3 * worst);
    assert!(worst < 1e-3, "{worst}");
    assert!(std::fs::read_to_string(folder.path().join("out/report.html")).unwrap().contains("Residuals"));

    // A damaged file is refused by the name of the field.
    let text = std::fs::read_to_string(&summary.optics).unwrap();
    let refused = |from: &str, to: &str, named: &str| {
        assert!(text.contains(from), "{from}");
        let e = OpticsFile::parse(&text.replacen(from, to, 1), &summary.optics).unwrap_err();
        assert!(e.to_string().contains(named) || format!("{e:?}").contains(named), "{named}: {e:?}");
    };
    refused("date = \"2", "date = \"x", "date");
    refused("parameters = [", "parameters = [\"more\", ", "covariance.matrix");
    refused("focal = \"", "focal = \"-", "optics.focal");
    let unknown = text.replacen("\"camera.focal_px\"", "\"camera.focus\"", 1);
    let unknown = OpticsFile::parse(&unknown, &summary.optics).unwrap();
    let e = optics_section::covariance(&unknown, &summary.optics).unwrap_err();
    assert!(e.to_string().contains("camera.focus"), "{e}");
}

#[test]
fn tables_that_cannot_be_used_are_refused_by_row_and_column() {
    let folder = tempfile::tempdir().unwrap();
    let start = optics_section::from_section(&start().optics).unwrap();
    let truth = truth(&start);
    let swapped = calibrate_rig::run(&options(folder.path(), &table(&truth, true))).unwrap_err();
    assert!(matches!(swapped, Error::CalibrateRig { source: RigError::SwappedOrders { .. }, .. }));
    let good = table(&truth, false);
    let fails = |text: &str| calibrate_rig::run(&options(folder.path(), text)).unwrap_err().to_string();
    assert!(fails(&good.replacen("10,100,", "10.5,100,", 1)).contains("row 1: pose is 10.5"));
    assert!(fails(&good.replacen("11,100,-8", "11,100,-7", 1)).contains("plate_x_mm"));
    assert!(fails(&good.replacen("plus_y", "plus_z", 1)).contains("plus_y"));
}
