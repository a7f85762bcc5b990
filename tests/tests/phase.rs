//! `daic phase` as a user runs it.

use daic_dataset::Table;
use daic_tests::program::daic;
use std::path::Path;
use tempfile::TempDir;

const SIDE: u32 = 320;
const PITCH: f64 = 8.37;

/// Vertical and horizontal sinusoidal lines (a cross grating), moved by (u, v).
fn cross(path: &Path, u: f64, v: f64) {
    let wave = |x: f64| (std::f64::consts::TAU * x / PITCH).cos();
    let image = image::GrayImage::from_fn(SIDE, SIDE, |x, y| {
        let g = 128.0 + 45.0 * (wave(f64::from(x) - u) + wave(f64::from(y) - v));
        image::Luma([g.round() as u8])
    });
    image.save(path).expect("written");
}

#[test]
fn a_moved_cross_grating() {
    let place = TempDir::new().expect("folder");
    cross(&place.path().join("a.png"), 0.0, 0.0);
    cross(&place.path().join("b.png"), 1.25, -0.6);
    let run = daic(place.path(), ["phase", "a.png", "b.png", "--json", "--out", "out"]).expect_code(0);
    let json = run.json();
    let text = json.to_string();
    assert!(text.contains("pitch_px"), "{text}");
    let out = place.path().join("out");
    for file in ["phase.npz", "crossings.csv", "displacement.npz", "points.csv", "u.svg", "v.svg"] {
        assert!(out.join(file).is_file(), "{file} is missing");
    }
    let path = out.join("points.csv");
    let table = Table::read_csv(&path).expect("a table");
    let column = |name: &str| table.numbers(name, &path).expect("a column");
    let (u, v) = (column("u"), column("v"));
    let valid: Vec<_> = u.iter().zip(&v).filter(|(u, _)| u.is_finite()).collect();
    assert!(valid.len() > 1000, "{}", valid.len());
    // rounding to 8 bits leaves 4e-4 px
    for (u, v) in valid {
        assert!((u - 1.25).abs() < 2e-3 && (v + 0.6).abs() < 2e-3, "({u}, {v})");
    }
}

#[test]
fn an_image_without_a_grating_is_refused() {
    let place = TempDir::new().expect("folder");
    image::GrayImage::from_pixel(200, 200, image::Luma([90]))
        .save(place.path().join("flat.png"))
        .expect("written");
    let run = daic(place.path(), ["phase", "flat.png", "--out", "out"]).expect_code(2);
    assert!(run.stderr.contains("blank"), "{}", run.stderr);
    assert!(!place.path().join("out").exists());
}
