//! Strain on surfaces whose truth is known.

mod common;

use common::Normal;
use daic_optics::surface::{NoStrain, Order, Settings, SurfaceError, SurfacePoint, SurfaceStrain, strain};
use nalgebra::{Matrix3, Rotation3, Vector3};

const COLUMNS: usize = 41;
const ROWS: usize = 31;
/// Radius of the cylinder, mm; its axis is parallel to y.
const RADIUS: f64 = 20.0;

type Motion = Box<dyn Fn(Vector3<f64>) -> Vector3<f64>>;

/// Points 0.2 mm apart over ±4 × ±3 mm on the cylinder, apex at h = 0.
fn cylinder(motion: &Motion, position: f64, displacement: f64) -> Vec<Option<SurfacePoint>> {
    (0..COLUMNS * ROWS)
        .map(|k| {
            let x = 0.2 * ((k % COLUMNS) as f64 - 20.0);
            let y = 0.2 * ((k / COLUMNS) as f64 - 15.0);
            let p = Vector3::new(x, y, (RADIUS * RADIUS - x * x).sqrt() - RADIUS);
            Some(SurfacePoint {
                position_mm: p,
                displacement_mm: motion(p) - p,
                position_mm2: Matrix3::identity() * position * position,
                displacement_mm2: Matrix3::identity() * displacement * displacement,
            })
        })
        .collect()
}

/// 6° about a line parallel to y, then 2° about x, and a shift.
fn rigid() -> Motion {
    let q = Rotation3::from_axis_angle(&Vector3::x_axis(), 2.0_f64.to_radians())
        * Rotation3::from_axis_angle(&Vector3::y_axis(), 6.0_f64.to_radians());
    Box::new(move |p| q * (p - Vector3::new(0.5, 0.0, -1.0)) + Vector3::new(0.1, -0.2, 0.3))
}

/// Axial stretch, radial stretch and torsion (rad/mm) of the cylinder, then a rigid motion.
fn stretched(axial: f64, radial: f64, torsion: f64) -> Motion {
    let after = rigid();
    Box::new(move |p| {
        let angle = (p.x / RADIUS).asin() + torsion * p.y;
        let r = RADIUS * radial;
        after(Vector3::new(r * angle.sin(), axial * p.y, r * angle.cos() - RADIUS))
    })
}

fn found(points: &[Option<SurfacePoint>], s: &Settings) -> Vec<SurfaceStrain> {
    strain(COLUMNS, ROWS, points, s).unwrap().into_iter().collect::<Result<_, _>>().unwrap()
}

#[test]
fn rigid_motion_has_no_strain() {
    let points = cylinder(&rigid(), 1e-3, 1e-3);
    for order in [Order::Plane, Order::Quadratic] {
        // cut windows at the rim included
        let s = Settings { order, min_fraction: 0.2, ..Settings::default() };
        for e in found(&points, &s) {
            // rounding of 4 mm over 0.2 mm
            assert!(e.strain.iter().all(|v| v.abs() < 1e-13), "{:?}", e.strain);
        }
    }
}

/// Whole windows: e₁ around, e₂ along the axis. E_θθ = (ρ² − 1)/2 and so on, from the metric of the
/// parametrised surface; what is left is the window's smoothing of the tangent vectors.
#[test]
fn stretched_cylinder() {
    let (axial, radial, torsion) = (1.02, 0.99, 0.004);
    let points = cylinder(&stretched(axial, radial, torsion), 1e-3, 1e-3);
    let r = RADIUS * radial;
    let truth = [
        0.5 * (radial * radial - 1.0),
        0.5 * (axial * axial + (r * torsion).powi(2) - 1.0),
        0.5 * radial * r * torsion,
    ];
    // principal strains by the closed form, angle by its definition
    let (m, d) = (0.5 * (truth[0] + truth[1]), 0.5 * (truth[0] - truth[1]));
    let principal = [m + d.hypot(truth[2]), m - d.hypot(truth[2])];
    for (window, limit) in [(5, 1e-5), (11, 6e-5)] {
        let s = Settings { window, min_fraction: 0.2, ..Settings::default() };
        let all = found(&points, &s);
        let half = window / 2;
        let mut worst: f64 = 0.0;
        for (k, e) in all.iter().enumerate() {
            let (i, j) = (k % COLUMNS, k / COLUMNS);
            if i < half || j < half || i + half >= COLUMNS || j + half >= ROWS {
                continue;
            }
            for (found, truth) in e.strain.iter().zip(truth) {
                worst = worst.max((found - truth).abs());
            }
            for (found, truth) in e.principal.iter().zip(principal) {
                worst = worst.max((found - truth).abs());
            }
            let angle = e.principal_angle_rad;
            let along = e.strain[0] * angle.cos().powi(2)
                + e.strain[1] * angle.sin().powi(2)
                + 2.0 * e.strain[2] * angle.sin() * angle.cos();
            assert!((along - e.principal[0]).abs() < 1e-14);
            // the normal of the cylinder, and axes in its tangent plane
            let x = 0.2 * (i as f64 - 20.0);
            let normal = Vector3::new(x / RADIUS, 0.0, (1.0 - (x / RADIUS).powi(2)).sqrt());
            assert!((e.normal - normal).norm() < 2e-3, "{} {normal}", e.normal);
            assert!(e.axes[0].dot(&e.normal).abs() < 1e-14 && e.axes[1].dot(&e.axes[0]).abs() < 1e-14);
            assert!(e.axes[1].y > 0.999 && e.axes[0].x > 0.9);
        }
        println!("window {window}: worst {worst:.2e}");
        assert!(worst < limit, "{window} {worst:e}");
    }
}

/// A rigid 6° tilt with noise: zero within σ, and σ is the scatter. Independent errors, and errors that
/// neighbours share as overlapping subsets do (3 × 3 mean of white noise).
#[test]
fn sigma_is_the_scatter() {
    let mut random = Normal::new(61);
    let (position, displacement) = (8e-3, 2e-3);
    let clean = cylinder(&rigid(), position, displacement);
    for overlap in [0.0, 3.0] {
        // the middle alone has a whole window
        let s = Settings { window: 9, overlap, min_fraction: 1.0, ..Settings::default() };
        let (mut square, mut inside, mut told) = ([0.0; 3], 0, [0.0; 3]);
        let runs = 3000;
        for _ in 0..runs {
            let mut window: Vec<Option<SurfacePoint>> =
                (0..81).map(|k| clean[(11 + k / 9) * COLUMNS + 23 + k % 9]).collect();
            let mut add = |sigma: f64, pick: &dyn Fn(&mut SurfacePoint) -> &mut Vector3<f64>| {
                let white: Vec<Vector3<f64>> =
                    (0..11 * 11).map(|_| Vector3::from_fn(|_, _| sigma * random.next())).collect();
                for (k, p) in window.iter_mut().flatten().enumerate() {
                    let (i, j) = (k % 9, k / 9);
                    *pick(p) += if overlap == 0.0 {
                        white[j * 11 + i]
                    } else {
                        let near = (0..9).map(|n| white[(j + n / 3) * 11 + i + n % 3]);
                        near.sum::<Vector3<f64>>() / 3.0
                    };
                }
            };
            add(position, &|p| &mut p.position_mm);
            add(displacement, &|p| &mut p.displacement_mm);
            let e = strain(9, 9, &window, &s).unwrap()[40].unwrap();
            for c in 0..3 {
                square[c] += e.strain[c].powi(2) / f64::from(runs);
                told[c] += e.sigma()[c] / f64::from(runs);
                inside += usize::from(e.strain[c].abs() <= e.sigma()[c]);
            }
        }
        let ratio = [0, 1, 2].map(|c| square[c].sqrt() / told[c]);
        let inside = inside as f64 / f64::from(3 * runs);
        println!("overlap {overlap}: σ {told:?}, scatter/σ {ratio:.3?}, inside {:.1} %", 100.0 * inside);
        // 3 000 runs: 1.3 % of a standard deviation, 0.5 % of 68.3 %; three of those
        assert!(ratio.iter().all(|r| (r - 1.0).abs() < 0.04), "{ratio:?}");
        assert!((inside - 0.683).abs() < 0.02, "{inside}");
    }
}

#[test]
fn gaps_and_bad_input() {
    let mut points = cylinder(&rigid(), 1e-3, 1e-3);
    let s = Settings { window: 5, min_fraction: 0.6, ..Settings::default() };
    for i in 0..COLUMNS {
        points[10 * COLUMNS + i] = None;
        if i > 20 {
            points[12 * COLUMNS + i] = None;
            points[13 * COLUMNS + i] = None;
        }
    }
    let found = strain(COLUMNS, ROWS, &points, &s).unwrap();
    assert_eq!(found[10 * COLUMNS + 5], Err(NoStrain::NoPoint));
    assert!(found[11 * COLUMNS + 5].is_ok());
    assert_eq!(found[11 * COLUMNS + 30], Err(NoStrain::TooFew { found: 10, needed: 15 }));
    assert_eq!(found[0], Err(NoStrain::TooFew { found: 9, needed: 15 }));
    // one row of points: no derivative across it
    let line: Vec<_> = points[..COLUMNS].to_vec();
    let few = Settings { min_fraction: 0.1, ..s };
    assert_eq!(strain(COLUMNS, 1, &line, &few).unwrap()[20], Err(NoStrain::Degenerate));

    let size = strain(3, 3, &points, &s);
    assert_eq!(size, Err(SurfaceError::Size { found: COLUMNS * ROWS, columns: 3, rows: 3 }));
    let even = strain(COLUMNS, ROWS, &points, &Settings { window: 4, ..s });
    assert!(matches!(even, Err(SurfaceError::Setting { name: "window", .. })));
    let none = strain(COLUMNS, ROWS, &points, &Settings { min_fraction: f64::NAN, ..s });
    assert!(matches!(none, Err(SurfaceError::Setting { name: "min_fraction", .. })));
    points[7].as_mut().unwrap().displacement_mm.z = f64::NAN;
    assert_eq!(strain(COLUMNS, ROWS, &points, &s), Err(SurfaceError::NotFinite { index: 7 }));
}
