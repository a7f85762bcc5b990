//! Calibration of the microscope from known motions.

mod common;

use common::{Normal, least_squares, rms};
use daic_optics::microscope::calibrate::{
    CalibrateError, Calibration, FieldPoint, Motion, Settings, calibrate, leave_one_out,
};
use daic_optics::microscope::{
    Candidate, Form, Geometry, Microscope, Objective, Parameters, Quantity, RayMicroscope, Relay,
};
use daic_optics::{Grating, PairModel, PixelPair};
use nalgebra::{Matrix4, SMatrix, Vector3};

fn truth() -> Parameters {
    Parameters {
        beta1_mm_per_px: 2.295e-3,
        beta2_mm_per_px: 0.53e-3,
        beta3_per_px: 2.12e-4,
        beta4_per_px: 2.0e-4,
        centre_px: [322.0, 287.5],
    }
}

/// A rigid motion of the specimen as a function of the point (mm), coordinates relative to the centre.
type Move = Box<dyn Fn(Vector3<f64>) -> Vector3<f64>>;

fn shift(by: [f64; 3]) -> Move {
    Box::new(move |_| Vector3::from(by))
}

/// Exact rotation by `angle` about the line x = `x`, h = `h` parallel to y; written out.
fn turn_y(angle: f64, x: f64, h: f64) -> Move {
    Box::new(move |p| {
        let (dx, dh) = (p.x - x, p.z - h);
        Vector3::new(dx * angle.cos() + dh * angle.sin() - dx, 0.0, -dx * angle.sin() + dh * angle.cos() - dh)
    })
}

fn turn_x(angle: f64, y: f64) -> Move {
    Box::new(move |p| {
        let dy = p.y - y;
        Vector3::new(
            0.0,
            dy * angle.cos() - p.z * angle.sin() - dy,
            dy * angle.sin() + p.z * angle.cos() - p.z,
        )
    })
}

/// Field of a motion on an n × n grid over 600 × 640 px, height 0, by the formulas (3.1)–(3.2) or by
/// any instrument.
fn field(n: usize, sigma: f64, by: &Move, form: Form) -> Vec<FieldPoint> {
    let p = truth();
    grid(n)
        .map(|middle_px| {
            let [dx, dy] = [middle_px[0] - p.centre_px[0], middle_px[1] - p.centre_px[1]];
            let d = by(Vector3::new(p.beta2_mm_per_px * dx, p.beta2_mm_per_px * dy, 0.0));
            let (a3, a4) = (p.beta3_per_px / p.beta2_mm_per_px, p.beta4_per_px / p.beta2_mm_per_px);
            let mut u = d.x / p.beta2_mm_per_px + a3 * dx * d.z;
            let mut v = d.y / p.beta2_mm_per_px + a4 * dy * d.z;
            let mut w = d.z / p.beta1_mm_per_px;
            if form == Form::Perspective {
                u /= 1.0 - a3 * d.z;
                v /= 1.0 - a4 * d.z;
                w /= 1.0 - a3 * d.z;
            }
            FieldPoint { middle_px, height_mm: 0.0, moved_px: [u + w, v, u - w, v], sigma_px: [sigma; 4] }
        })
        .collect()
}

fn grid(n: usize) -> impl Iterator<Item = [f64; 2]> {
    let at = move |i: usize| i as f64 / (n - 1) as f64;
    (0..n).flat_map(move |i| (0..n).map(move |j| [20.0 + 600.0 * at(i), 10.0 + 640.0 * at(j)]))
}

fn noisy(mut motions: Vec<Motion>, random: &mut Normal) -> Vec<Motion> {
    for p in motions.iter_mut().flat_map(|m| &mut m.points) {
        for (moved, sigma) in p.moved_px.iter_mut().zip(p.sigma_px) {
            *moved += sigma * random.next();
        }
    }
    motions
}

fn z_move(n: usize, sigma: f64, form: Form) -> Motion {
    let by = [0.0, 0.0, 0.010];
    Motion::translation("z", by, field(n, sigma, &shift(by), form))
}

fn x_move(n: usize, sigma: f64, form: Form) -> Motion {
    let by = [0.010, 0.0, 0.0];
    Motion::translation("x", by, field(n, sigma, &shift(by), form))
}

fn y_move(n: usize, sigma: f64, form: Form) -> Motion {
    let by = [0.0, 0.010, 0.0];
    Motion::translation("y", by, field(n, sigma, &shift(by), form))
}

/// 6° about a line parallel to y, 0.03 mm right of the centre and 0.02 mm up, not told.
fn tilt_y(n: usize, sigma: f64, form: Form) -> Motion {
    let angle = 6.0_f64.to_radians();
    Motion::tilt("tilt y", [0.0, angle, 0.0], field(n, sigma, &turn_y(angle, 0.03, 0.02), form))
}

fn tilt_x(n: usize, sigma: f64, form: Form) -> Motion {
    let angle = -4.0_f64.to_radians();
    Motion::tilt("tilt x", [angle, 0.0, 0.0], field(n, sigma, &turn_x(angle, -0.02), form))
}

fn relative_error(c: &Calibration) -> f64 {
    let found = c.parameters.expect("all determined").to_array();
    let pairs = found.iter().zip(truth().to_array());
    pairs.map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max)
}

#[test]
fn exact_fields_give_exact_parameters() {
    for form in [Form::Linear, Form::Perspective] {
        let settings = Settings { form, ..Settings::default() };
        let (z, x, y) = (z_move(7, 0.02, form), x_move(7, 0.02, form), y_move(7, 0.02, form));
        let (ty, tx) = (tilt_y(7, 0.02, form), tilt_x(7, 0.02, form));
        let sets = [
            ("z x", vec![z.clone(), x.clone()]),
            ("z y", vec![z.clone(), y.clone()]),
            ("z tilt", vec![z.clone(), ty.clone()]),
            ("tilts x", vec![ty.clone(), tx.clone(), x.clone()]),
            ("all", vec![z, x, y, ty, tx]),
        ];
        for (name, motions) in sets {
            let c = calibrate(&motions, &settings).unwrap();
            let error = relative_error(&c);
            println!("{form:?} {name}: error {error:.1e}, {} iterations", c.iterations);
            assert!(c.undetermined.is_empty() && c.add.is_empty());
            // rounding: measured 5e-15
            assert!(error < 1e-13, "{form:?} {name} {error:e}");
            assert!(c.rms_px < 1e-9 && c.rejected.is_empty(), "{name} {:e}", c.rms_px);
            for m in &c.motions {
                assert!(m.rms_mm.iter().all(|e| *e < 1e-9), "{name} {m:?}");
            }
        }
    }
}

/// A rotation about a point that is told, instead of an unknown one, and a specimen that is not flat.
#[test]
fn pivots_and_heights() {
    let p = truth();
    let angle = 6.0_f64.to_radians();
    let model = Microscope::new(p, Form::Perspective, [0.0; 2]).unwrap();
    let height = |x: f64, y: f64| 0.01 * (20.0 * x).sin() + 0.05 * y;
    let by = turn_y(angle, 0.03, 0.02);
    let see = |by: &Move| -> Vec<FieldPoint> {
        grid(9)
            .map(|[x, y]| {
                let (x, y) = ((x - 320.0) * 5e-4, (y - 290.0) * 5e-4);
                let at = Vector3::new(x, y, height(x, y));
                let (a, b) = (model.see(at).unwrap(), model.see(at + by(at)).unwrap());
                FieldPoint {
                    middle_px: [0, 1].map(|i| 0.5 * (a.minus_px[i] + a.plus_px[i])),
                    height_mm: at.z,
                    moved_px: [
                        b.minus_px[0] - a.minus_px[0],
                        b.minus_px[1] - a.minus_px[1],
                        b.plus_px[0] - a.plus_px[0],
                        b.plus_px[1] - a.plus_px[1],
                    ],
                    sigma_px: [0.01; 4],
                }
            })
            .collect()
    };
    // pivot at x = 0.03 mm, h = 0.02 mm: its midpoint pixel by the model's own formula
    let pivot_x = p.centre_px[0] + 0.03 / (p.beta2_mm_per_px - p.beta3_per_px * 0.02);
    let mut tilt = Motion::translation("tilt", [0.0; 3], see(&by));
    tilt.rotation_rad = [0.0, angle, 0.0];
    tilt.pivot_px = [pivot_x, 0.0];
    tilt.pivot_height_mm = 0.02;
    let z = Motion::translation("z", [0.0, 0.0, 0.01], see(&shift([0.0, 0.0, 0.01])));
    let settings = Settings { form: Form::Perspective, ..Settings::default() };
    let c = calibrate(&[z.clone(), tilt.clone()], &settings).unwrap();
    let error = relative_error(&c);
    println!("pivot told: error {error:.1e}");
    assert!(error < 1e-13, "{error:e}");
    // a tilt with its pivot not told: found where it is, 0.02 mm of h turned by 6° and so on
    tilt.translation_mm = [None; 3];
    tilt.pivot_px = p.centre_px;
    tilt.pivot_height_mm = 0.0;
    let c = calibrate(&[z, tilt], &settings).unwrap();
    assert!(relative_error(&c) < 1e-13);
    let expected = by(Vector3::zeros());
    let found = Vector3::from(c.motions[1].translation_mm);
    assert!((found - expected).norm() < 1e-10, "{found} {expected}");
}

/// What each set of motions leaves open, as derived by hand (documentation of the module).
#[test]
fn undetermined_parameters_are_named() {
    use Quantity::*;
    let f = Form::Linear;
    let mut random = Normal::new(51);
    let mut check = |motions: Vec<Motion>, open: &[Quantity], add: &[Candidate], ratios: &[Quantity]| {
        let names: Vec<_> = motions.iter().map(|m| m.name.clone()).collect();
        for motions in [motions.clone(), noisy(motions, &mut random)] {
            let c = calibrate(&motions, &Settings::default()).unwrap();
            assert_eq!(c.undetermined, open, "{names:?}");
            assert_eq!(c.add, add, "{names:?}");
            assert!(c.parameters.is_none() && c.covariance.is_none());
            for q in ratios {
                assert!(c.estimate(*q).is_some(), "{names:?}: {q:?} is determined");
            }
            for q in open {
                assert!(c.estimate(*q).is_none(), "{names:?}: {q:?} is open");
            }
        }
    };
    // the pure z move of the thesis
    check(
        vec![z_move(7, 0.01, f)],
        &[Beta2, Beta3, Beta4],
        &[Candidate::MoveX],
        &[Beta1, CentreX, CentreY, Beta3OverBeta2, Beta4OverBeta2],
    );
    check(vec![x_move(7, 0.01, f)], &[Beta1, Beta3, Beta4, CentreX, CentreY], &[Candidate::MoveZ], &[Beta2]);
    check(
        vec![x_move(7, 0.01, f), y_move(7, 0.01, f)],
        &[Beta1, Beta3, Beta4, CentreX, CentreY],
        &[Candidate::MoveZ],
        &[Beta2],
    );
    // one tilt about a line that is not known: everything but the scale
    check(
        vec![tilt_y(7, 0.001, f)],
        &[Beta1, Beta2],
        &[Candidate::MoveX],
        &[Beta3, Beta4, CentreX, CentreY, Beta1OverBeta2],
    );
    // a z move on one line of points: nothing on y
    let mut line = z_move(7, 0.01, f);
    line.points.retain(|p| (p.middle_px[1] - 330.0).abs() < 1.0);
    assert_eq!(line.points.len(), 7);
    check(vec![line, x_move(7, 0.01, f)], &[Beta4, CentreY], &[Candidate::MoveZ], &[Beta1, Beta2, Beta3]);
}

/// Values of the ratios that a pure z move does determine.
#[test]
fn a_pure_z_move_gives_its_ratios() {
    let c = calibrate(&[z_move(7, 0.01, Form::Linear)], &Settings::default()).unwrap();
    let t = truth();
    for (q, value) in [
        (Quantity::Beta1, t.beta1_mm_per_px),
        (Quantity::CentreX, 322.0),
        (Quantity::CentreY, 287.5),
        (Quantity::Beta3OverBeta2, t.beta3_per_px / t.beta2_mm_per_px),
        (Quantity::Beta4OverBeta2, t.beta4_per_px / t.beta2_mm_per_px),
    ] {
        let e = c.estimate(q).unwrap();
        assert!((e.value / value - 1.0).abs() < 1e-9, "{e:?} {value}");
    }
    assert!(c.motions[0].rms_mm[0].is_nan());
}

/// The thesis' way: least squares between decoded and imposed displacement. For a pure z move the
/// imposed in-plane displacement is zero and decoded u = β₂ m − β₃ x w + (β₃ x_c) w is linear and
/// homogeneous in the unknowns: they come out as zero, and fit perfectly.
#[test]
fn fitting_decoded_to_imposed_is_degenerate() {
    let mut random = Normal::new(52);
    let z = noisy(vec![z_move(9, 0.02, Form::Linear)], &mut random).remove(0);
    let w = 0.010;
    let rows: Vec<Vec<f64>> = z
        .points
        .iter()
        .map(|p| vec![0.5 * (p.moved_px[0] + p.moved_px[2]), -p.middle_px[0] * w, w])
        .collect();
    let zeros = vec![0.0; rows.len()];
    let (c, r) = least_squares(&rows, &zeros);
    println!("thesis' way: beta2, beta3, beta3 x_c = {c:?}, rms {:e}", rms(r.iter().copied()));
    assert!(c.iter().all(|c| *c == 0.0) && r.iter().all(|r| *r == 0.0));
    // the truth fits worse than that
    let t = truth();
    let at_truth = rms(rows
        .iter()
        .map(|r| t.beta2_mm_per_px * r[0] + t.beta3_per_px * r[1] + t.beta3_per_px * t.centre_px[0] * r[2]));
    assert!(at_truth > 5e-6, "{at_truth:e}");
    // in image space the same data give the ratio to its σ, and say that β₂ is open
    let c = calibrate(&[z], &Settings::default()).unwrap();
    let ratio = c.estimate(Quantity::Beta3OverBeta2).unwrap();
    assert!((ratio.value - t.beta3_per_px / t.beta2_mm_per_px).abs() < 4.0 * ratio.sigma);
    assert!(c.undetermined.contains(&Quantity::Beta2));
}

/// 2 000 calibrations with fresh noise: every parameter, and every component of a displacement decoded
/// with them, lies within ±1σ in 68.3 % of the cases; 2 000 runs give that to 1.0 %, the limit is
/// three of those.
#[test]
fn sigmas_cover() {
    for form in [Form::Linear, Form::Perspective] {
        let clean = vec![z_move(4, 0.03, form), x_move(4, 0.03, form), tilt_y(4, 0.03, form)];
        let settings = Settings { form, ..Settings::default() };
        let exact = Microscope::new(truth(), form, [0.0; 2]).unwrap();
        let at = exact.see(Vector3::new(0.1, -0.12, 0.0)).unwrap();
        let by = Vector3::new(2e-3, 1e-3, 9e-3);
        let moved = exact.forward(at, by).unwrap();
        let (runs, mut within, mut chi2) = (2000, [0; 9], 0.0);
        let mut random = Normal::new(53);
        for _ in 0..runs {
            let c = calibrate(&noisy(clean.clone(), &mut random), &settings).unwrap();
            chi2 += c.chi_square_reduced / f64::from(runs);
            let (p, covariance) = (c.parameters.unwrap(), c.covariance.unwrap());
            for (i, (a, b)) in p.to_array().iter().zip(truth().to_array()).enumerate() {
                within[i] += usize::from((a - b).abs() <= covariance[(i, i)].sqrt());
            }
            let model = Microscope::new(p, form, [0.0; 2]).unwrap();
            let add = |p: [f64; 2], u: f64, v: f64| [p[0] + u, p[1] + v];
            let deformed = PixelPair {
                minus_px: add(at.minus_px, moved[0], moved[1]),
                plus_px: add(at.plus_px, moved[2], moved[3]),
            };
            let none = Matrix4::zeros();
            let found = model.track(at, deformed, &none, &none).unwrap().displacement_mm;
            let j: SMatrix<f64, 3, 6> = model.displacement_parameter_jacobian(at, deformed).unwrap();
            let spread = j * covariance * j.transpose();
            for i in 0..3 {
                within[6 + i] += usize::from((found[i] - by[i]).abs() <= spread[(i, i)].sqrt());
            }
        }
        println!("{form:?}: within ±1σ {:.1?} %, χ² {chi2:.4}", within.map(|n| n as f64 / 20.0));
        for n in within {
            assert!((n as f64 / f64::from(runs) - 0.683).abs() < 0.031, "{within:?}");
        }
        // inflated where it exceeds 1, so the mean is of no use beyond this
        assert!((chi2 - 1.0).abs() < 0.01, "{chi2}");
    }
}

#[test]
fn motions_not_fitted_are_predicted() {
    let f = Form::Linear;
    let mut random = Normal::new(54);
    let mut tilt = tilt_y(9, 0.02, f);
    tilt.fit = false;
    let mut motions = vec![z_move(9, 0.02, f), x_move(9, 0.02, f), tilt, y_move(9, 0.02, f)];
    motions = noisy(motions, &mut random);
    let c = calibrate(&motions, &Settings::default()).unwrap();
    for m in &c.motions {
        println!("{} fitted {}: px {:.4?}, µm {:.4?}", m.name, m.fitted, m.rms_px, m.rms_mm.map(|v| v * 1e3));
        assert_eq!(m.points, 81);
        // noise of 0.02 px: β₁ σ/√2 and β₂ σ/√2, with the spread's part of w; 81 points give the RMS to 8 %
        assert!((m.rms_mm[2] / (2.295e-3 * 0.02 / 2.0_f64.sqrt()) - 1.0).abs() < 0.25, "{m:?}");
        assert!((m.rms_mm[1] / (0.53e-3 * 0.02 / 2.0_f64.sqrt()) - 1.0).abs() < 0.25, "{m:?}");
        assert!(m.rms_px.iter().all(|r| (r / 0.02 - 1.0).abs() < 0.25), "{m:?}");
    }
    assert!(!c.motions[2].fitted);
    // a wrong prediction is seen: the tilt was 6.3°, not 6°
    motions[2].rotation_rad[1] *= 1.05;
    let wrong = calibrate(&motions, &Settings::default()).unwrap();
    assert_eq!(wrong.parameters, c.parameters);
    assert!(wrong.motions[2].rms_mm[2] > 3.0 * c.motions[2].rms_mm[2]);
    // one left out at a time: without z nothing predicts
    let out = leave_one_out(&motions, &Settings::default());
    assert!(out[0].is_none() && out[2].is_none());
    for k in [1, 3] {
        let m = out[k].as_ref().unwrap();
        assert!(!m.fitted && m.rms_mm[1] < 1.3 * 0.53e-3 * 0.02, "{m:?}");
    }
}

#[test]
fn outliers_are_left_out() {
    let f = Form::Linear;
    let mut random = Normal::new(55);
    let clean = vec![z_move(9, 0.02, f), x_move(9, 0.02, f)];
    let mut motions = noisy(clean, &mut random);
    for i in 0..8 {
        motions[i % 2].points[7 * i].moved_px[i % 4] += 3.0 + i as f64;
    }
    let c = calibrate(&motions, &Settings::default()).unwrap();
    assert_eq!(c.rejected.len(), 8, "{:?}", c.rejected);
    for (a, (b, s)) in c
        .parameters
        .unwrap()
        .to_array()
        .iter()
        .zip(truth().to_array().iter().zip(c.covariance.unwrap().diagonal().iter()))
    {
        assert!((a - b).abs() < 4.0 * s.sqrt(), "{a} {b}");
    }
    for (i, p) in motions[1].points.iter_mut().enumerate().filter(|(i, _)| i % 2 == 0) {
        p.moved_px[0] += 3.0 + (i * i % 17) as f64;
    }
    let many = calibrate(&motions, &Settings::default());
    assert!(matches!(many, Err(CalibrateError::TooManyOutliers { .. })), "{many:?}");
}

#[test]
fn bad_input_is_refused() {
    let f = Form::Linear;
    let s = Settings::default();
    let good = vec![z_move(5, 0.02, f), x_move(5, 0.02, f)];
    // −1 and +1 mistaken
    let mut swapped = good.clone();
    for p in swapped.iter_mut().flat_map(|m| &mut m.points) {
        p.moved_px.rotate_left(2);
    }
    let e = calibrate(&swapped, &s).unwrap_err();
    assert!(matches!(e, CalibrateError::Swapped { .. }) && e.to_string().contains("swapped"), "{e}");
    assert_eq!(calibrate(&[], &s), Err(CalibrateError::NoMotion));
    let mut one = good.clone();
    one[1].points.truncate(2);
    assert!(matches!(calibrate(&one, &s), Err(CalibrateError::Points { found: 2, .. })));
    let mut one = good.clone();
    one[1].points[3].sigma_px[2] = 0.0;
    let e = calibrate(&one, &s).unwrap_err();
    assert!(matches!(&e, CalibrateError::Value { motion, .. } if motion == "x"), "{e}");
    let mut one = good.clone();
    one[0].points[3].moved_px[2] = f64::NAN;
    assert!(matches!(calibrate(&one, &s), Err(CalibrateError::Value { .. })));
    let mut one = good.clone();
    one[0].translation_mm[1] = Some(f64::INFINITY);
    assert!(matches!(calibrate(&one, &s), Err(CalibrateError::Value { .. })));
    let bad = Settings { shared: 0.5, ..s.clone() };
    assert!(matches!(calibrate(&good, &bad), Err(CalibrateError::Setting { name: "shared", .. })));
    // 0.3 px of noise on 4 px of z move, few points: β₁ and β₂ are too weak and that is said
    let weak = Settings { max_relative_sigma: 1e-4, ..s };
    let c = calibrate(&good, &weak).unwrap();
    assert_eq!(c.undetermined, [Quantity::Beta1, Quantity::Beta2]);
    assert_eq!(c.add, [Candidate::MoveZ, Candidate::MoveX]);
}

/// A telecentric microscope: the centre has no meaning, which is said; decoding is as good.
#[test]
fn telecentric() {
    let mut motions = vec![z_move(9, 0.02, Form::Linear), x_move(9, 0.02, Form::Linear)];
    for p in &mut motions[0].points {
        let w = 0.010 / truth().beta1_mm_per_px;
        p.moved_px = [w, 0.0, -w, 0.0];
    }
    let exact = calibrate(&motions, &Settings::default()).unwrap();
    assert!(exact.parameters.unwrap().to_array().iter().all(|v| v.is_finite()));
    let c = calibrate(&noisy(motions, &mut Normal::new(56)), &Settings::default()).unwrap();
    assert_eq!(c.telecentric, [true, true]);
    for m in &c.motions {
        assert!(m.rms_mm[0] < 1.5e-5 && m.rms_mm[1] < 1.5e-5, "{m:?}");
    }
}

/// The thesis' experiment by exact rays (relay perspective of 0.3/mm), 0.01 px of noise per view:
/// z move of 10 µm and an in-plane move calibrate, the 6° tilt is predicted. Table 1 of the thesis:
/// u 0.084, v 0.031, w 0.296 µm.
#[test]
fn table_1_from_exact_rays() {
    let grating = Grating::square(2e-3);
    let rays = RayMicroscope::new(&Geometry {
        relay: Relay { magnification: 0.9, index: 1.0, perspective_per_mm: -0.3 },
        grating_to_image_mm: 1.0,
        wavelength_mm: 450e-6,
        minus: grating,
        plus: grating,
        objective: Objective {
            magnification: 11.32,
            focus_mm: 1.08,
            perspective_per_mm: 0.0,
            pixel_mm: 5.4e-3,
            axis_px: [320.0, 330.0],
        },
    })
    .unwrap();
    let see = |by: &Move| -> Vec<FieldPoint> {
        grid(21)
            .map(|m| {
                let at = Vector3::new((m[0] - 320.0) * 0.53e-3, (m[1] - 330.0) * 0.53e-3, 0.0);
                let (a, b) = (rays.see(at).unwrap(), rays.see(at + by(at)).unwrap());
                FieldPoint {
                    middle_px: [0, 1].map(|i| 0.5 * (a.minus_px[i] + a.plus_px[i])),
                    height_mm: 0.0,
                    moved_px: [
                        b.minus_px[0] - a.minus_px[0],
                        b.minus_px[1] - a.minus_px[1],
                        b.plus_px[0] - a.plus_px[0],
                        b.plus_px[1] - a.plus_px[1],
                    ],
                    sigma_px: [0.01; 4],
                }
            })
            .collect()
    };
    let angle = 6.0_f64.to_radians();
    let mut tilt = Motion::tilt("tilt", [0.0, angle, 0.0], see(&turn_y(angle, 0.0, 0.0)));
    tilt.fit = false;
    let z = Motion::translation("z", [0.0, 0.0, 0.01], see(&shift([0.0, 0.0, 0.01])));
    let x = Motion::translation("x", [0.01, 0.0, 0.0], see(&shift([0.01, 0.0, 0.0])));
    let motions = noisy(vec![z, x, tilt], &mut Normal::new(57));
    let run = |form| {
        let c = calibrate(&motions, &Settings { form, ..Settings::default() }).unwrap();
        let um = |k: usize| c.motions[k].rms_mm.map(|v| v * 1e3);
        println!(
            "{form:?}: z move {:.4?} µm, tilt predicted {:.4?} µm, χ² {:.3}",
            um(0),
            um(2),
            c.chi_square_reduced
        );
        um(2)
    };
    let (linear, perspective) = (run(Form::Linear), run(Form::Perspective));
    // 0.01 px: 0.0037 µm in-plane, 0.016 µm in w; measured 0.0038, 0.0038, 0.0165
    assert!(perspective[0] < 0.005 && perspective[1] < 0.005 && perspective[2] < 0.02, "{perspective:?}");
    assert!(linear[2] > 1.5 * perspective[2], "{linear:?} {perspective:?}");
}
