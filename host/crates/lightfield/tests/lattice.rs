//! The lattice of rendered white images.

use daic_lightfield::LatticeError;
use daic_lightfield::Packing;
use daic_lightfield::lattice::{Rectifier, find};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A white image: soft discs on a lattice, vignetting, noise.
fn white(
    size: [usize; 2],
    origin: [f64; 2],
    a: [f64; 2],
    b: [f64; 2],
    hexagonal: bool,
    seed: u64,
) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let det = a[0] * b[1] - a[1] * b[0];
    let pitch = a[0].hypot(a[1]);
    (0..size[0] * size[1])
        .map(|i| {
            let p = [(i % size[0]) as f64, (i / size[0]) as f64];
            let d = [p[0] - origin[0], p[1] - origin[1]];
            let (u, v) = ((d[0] * b[1] - d[1] * b[0]) / det, (a[0] * d[1] - a[1] * d[0]) / det);
            let shifts: &[f64] = if hexagonal { &[0.0, 0.5] } else { &[0.0] };
            let r = shifts
                .iter()
                .map(|s| {
                    let (fu, fv) = (u - s - (u - s).round(), v - s - (v - s).round());
                    (fu * a[0] + fv * b[0]).hypot(fu * a[1] + fv * b[1])
                })
                .fold(f64::INFINITY, f64::min);
            let disc = 1.0 / (1.0 + ((r - 0.42 * pitch) / (0.05 * pitch)).exp());
            let far = d[0].hypot(d[1]) / size[0] as f64;
            let light = 100.0 + 2000.0 * disc * (1.0 - 0.8 * far * far);
            (light + light.sqrt() * rng.random_range(-1.7..1.7)) as f32
        })
        .collect()
}

#[test]
fn a_square_lattice_is_found() {
    let seed = 5;
    println!("seed {seed}");
    let (size, origin) = ([620, 500], [301.37, 254.81]);
    let (a, b) = ([15.41, 0.031], [-0.029, 15.39]);
    let image = white(size, origin, a, b, false, seed);
    let lattice = find(&image, None, size, None).unwrap();
    println!("{lattice:?}");
    assert_eq!(lattice.packing, Packing::Square);
    // ten times the stated uncertainty would be a lie, one thousandth of a pixel is what the noise allows
    for (found, sigma, truth) in [
        (lattice.along_x_px[0], lattice.sides_sigma_px[0][0], a[0]),
        (lattice.along_x_px[1], lattice.sides_sigma_px[0][1], a[1]),
        (lattice.along_y_px[0], lattice.sides_sigma_px[1][0], b[0]),
        (lattice.along_y_px[1], lattice.sides_sigma_px[1][1], b[1]),
    ] {
        assert!(
            (found - truth).abs() < 1e-3 && (found - truth).abs() < 5.0 * sigma + 1e-5,
            "{found} {truth} {sigma}"
        );
    }
    let [u, v] = lattice.cell_of(origin);
    assert!((u - u.round()).abs() < 1e-3 && (v - v.round()).abs() < 1e-3, "{u} {v}");
}

#[test]
fn a_hexagonal_lattice_is_found() {
    let seed = 6;
    println!("seed {seed}");
    let (size, origin) = ([600, 600], [305.2, 290.6]);
    let (sin, cos) = 0.02f64.sin_cos();
    let p = 18.3;
    let (a, b) = ([p * cos, p * sin], [-3f64.sqrt() * p * sin, 3f64.sqrt() * p * cos]);
    let image = white(size, origin, a, b, true, seed);
    let lattice = find(&image, None, size, None).unwrap();
    println!("{lattice:?}");
    assert_eq!(lattice.packing, Packing::Hexagonal);
    assert!((lattice.pitch_px[0].value - p).abs() < 2e-3, "{:?}", lattice.pitch_px);
    assert!((lattice.pitch_px[1].value - 3f64.sqrt() * p).abs() < 4e-3, "{:?}", lattice.pitch_px);
    assert!((lattice.rotation_rad.value - 0.02).abs() < 2e-4, "{:?}", lattice.rotation_rad);
}

/// A rectified frame has its lenslets where they belong and as much light as before.
#[test]
fn frames_are_rectified() {
    let (size, origin) = ([400, 300], [198.3, 151.9]);
    let (a, b) = ([17.27, 0.08], [-0.08, 17.27]);
    let image = white(size, origin, a, b, false, 7);
    let lattice = find(&image, None, size, None).unwrap();
    let mut rectifier = Rectifier::new(&lattice, [15, 15], Some(&image), None).unwrap();
    rectifier.crop([1, 2], [11, 12]);
    assert_eq!(rectifier.cells(), [11, 12]);
    let out = rectifier.apply(&image, None).unwrap();
    assert_eq!(out.values.len(), 11 * 12 * 225);
    // the vignetting is gone: all cells have the same light
    let light = |cy: usize, cx: usize| -> f64 {
        (0..225).map(|n| f64::from(out.values[(cy * 15 + n / 15) * 180 + cx * 15 + n % 15])).sum()
    };
    let lights: Vec<f64> = (0..132).map(|i| light(i / 12, i % 12)).collect();
    let mean = lights.iter().sum::<f64>() / 132.0;
    let worst = lights.iter().map(|l| (l / mean - 1.0).abs()).fold(0.0, f64::max);
    let total: f64 = image.iter().map(|v| f64::from(*v)).sum::<f64>() / image.len() as f64;
    println!(
        "worst cell {worst:.4}, light per cell {mean:.0}, mean of the image times area {:.0}",
        total * lattice.cell_area()
    );
    assert!(worst < 0.01, "{worst}");
    // every cell looks the same on both sides of its centre
    let mut odd = 0.0;
    let mut all = 0.0;
    for y in 0..165 {
        for cx in 0..12 {
            for n in 0..7 {
                let row = &out.values[y * 180 + cx * 15..][..15];
                odd += f64::from(row[n] - row[14 - n]);
                all += f64::from(row[n] + row[14 - n]);
            }
        }
    }
    assert!((odd / all).abs() < 1e-3, "{}", odd / all);
    assert!(matches!(rectifier.apply(&image[1..], None), Err(LatticeError::Size { .. })));
}

#[test]
fn what_is_no_lattice_is_refused() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let noise: Vec<f32> = (0..300 * 300).map(|_| rng.random_range(900.0..1100.0)).collect();
    assert!(matches!(find(&noise, None, [300, 300], None), Err(LatticeError::NoPattern { .. })));
    assert!(matches!(find(&noise, Some(&noise), [300, 300], None), Err(LatticeError::Dark)));
    assert!(matches!(find(&noise, Some(&noise[1..]), [300, 300], None), Err(LatticeError::Size { .. })));
    assert!(matches!(find(&noise, None, [300, 300], Some(1000.0)), Err(LatticeError::Saturated { .. })));
    assert!(matches!(find(&noise[..900], None, [30, 30], None), Err(LatticeError::Small { .. })));
}
