//! Calibration against simulated observations of the independent tracer.

mod common;

use common::*;
use daic_optics::{
    CalibrateError, Calibration, Decoder, Observation, Optics, Parameter, ParameterCovariance, Settings,
    TrackedPoint, calibrate,
};
use nalgebra::{Matrix3, Vector3};

/// Reference, two in-plane moves, two along z, one of everything.
fn moves() -> Vec<Vector3<f64>> {
    vec![
        Vector3::new(0.0, 0.0, 0.0),
        Vector3::new(0.5, 0.0, 0.0),
        Vector3::new(0.0, 0.5, 0.0),
        Vector3::new(0.0, 0.0, 0.8),
        Vector3::new(0.0, 0.0, -0.8),
        Vector3::new(0.3, -0.3, 0.4),
    ]
}

/// Points of a wavy specimen of mean height zero, seen without noise.
fn track(o: &Optics, moves: &[Vector3<f64>], n: usize, sigma: f64, seed: u64) -> Vec<TrackedPoint> {
    let mut random = Normal::new(seed);
    let mut points: Vec<_> = (0..n)
        .map(|_| {
            let (x, y) = (18.0 * random.uniform() - 9.0, 16.0 * random.uniform() - 8.0);
            Vector3::new(x, y, 0.3 * (0.5 * x).sin() + 0.02 * y)
        })
        .collect();
    let mean = points.iter().map(|p| p.z).sum::<f64>() / n as f64;
    points.iter_mut().for_each(|p| p.z -= mean);
    points
        .iter()
        .map(|p| TrackedPoint {
            frames: moves
                .iter()
                .map(|m| Some(Observation { pair: see_both(o, p + m), sigma_px: [sigma; 4] }))
                .collect(),
        })
        .collect()
}

fn add_noise(points: &mut [TrackedPoint], random: &mut Normal) {
    for o in points.iter_mut().flat_map(|p| p.frames.iter_mut().flatten()) {
        for c in 0..2 {
            o.pair.minus_px[c] += o.sigma_px[c] * random.next();
            o.pair.plus_px[c] += o.sigma_px[2 + c] * random.next();
        }
    }
}

/// The truth with the three parameters wrong by `by`, alternately up and down.
fn wrong(o: &Optics, by: f64) -> Optics {
    let mut w = *o;
    for (i, p) in daic_optics::calibrate::SUPPORTED.into_iter().enumerate() {
        let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
        p.set(&mut w, p.get(o) * (1.0 + sign * by));
    }
    w
}

fn relative_error(c: &Calibration, truth: &Optics) -> f64 {
    daic_optics::calibrate::SUPPORTED
        .into_iter()
        .map(|p| (p.get(&c.optics) / p.get(truth) - 1.0).abs())
        .fold(0.0, f64::max)
}

#[test]
fn exact_data_give_exact_parameters() {
    for (name, truth) in [("square", golden()), ("awkward", awkward())] {
        let points = track(&truth, &moves(), 150, 0.01, 30);
        for by in [0.01, -0.01, 0.05] {
            let start = wrong(&truth, by);
            let c = calibrate(&start, &moves(), &points, &Settings::default()).unwrap();
            let error = relative_error(&c, &truth);
            println!(
                "{name}, start {by}: error {error:.1e}, rms {:.1e} px, {} iterations",
                c.rms_px, c.iterations
            );
            assert!(error < 1e-9, "{error:e}");
            assert!(c.rms_px < 1e-9 && c.rejected.is_empty());
            assert_eq!((c.points, c.observations), (150, 900));
            assert_eq!(c.degrees_of_freedom, 4 * 900 - 3 * 150 - 3);
        }
    }
}

/// Any subset of the parameters, with the others at the truth, and frames missing here and there.
#[test]
fn subsets_and_gaps() {
    let truth = golden();
    let mut points = track(&truth, &moves(), 120, 0.01, 31);
    for (i, p) in points.iter_mut().enumerate() {
        // Never the same frames; every tenth point is seen once only.
        p.frames[i % 6] = None;
        if i % 10 == 0 {
            p.frames.iter_mut().skip(2).for_each(|f| *f = None);
        }
    }
    let [f, s, d] = daic_optics::calibrate::SUPPORTED;
    for parameters in [vec![f], vec![s], vec![d], vec![d, f], vec![s, f], vec![d, s, f]] {
        let mut start = truth;
        for p in &parameters {
            p.set(&mut start, 1.01 * p.get(&truth));
        }
        let settings = Settings { parameters: parameters.clone(), ..Settings::default() };
        let c = calibrate(&start, &moves(), &points, &settings).unwrap();
        let error = relative_error(&c, &truth);
        assert!(error < 1e-9, "{parameters:?} {error:e}");
        assert_eq!(c.estimates.len(), parameters.len());
        for (e, p) in c.estimates.iter().zip(&parameters) {
            assert_eq!(e.parameter, *p);
            assert_eq!(e.start, 1.01 * p.get(&truth));
            assert!(e.sigma > 0.0);
        }
    }
}

/// The stated covariance is that of many calibrations with fresh noise, started 1 % wrong.
#[test]
fn sigmas_predict_the_scatter() {
    let truth = golden();
    let clean = track(&truth, &moves(), 100, 0.02, 32);
    let mut random = Normal::new(33);
    let runs = 400;
    let mut found = Matrix3::zeros();
    let mut expected = Matrix3::zeros();
    let mut mean = Vector3::zeros();
    let (mut chi2, mut within) = (0.0, [0; 3]);
    // What it means for a displacement measured near the rim: spread found and predicted.
    let (at, by) = (Vector3::new(8.0, 6.0, 0.0), Vector3::new(0.05, -0.03, 0.2));
    let (before, after) = (see_both(&truth, at), see_both(&truth, at + by));
    let mut spread = [Vector3::zeros(); 2];
    for _ in 0..runs {
        let mut points = clean.clone();
        add_noise(&mut points, &mut random);
        let c = calibrate(&wrong(&truth, 0.01), &moves(), &points, &Settings::default()).unwrap();
        let e = Vector3::from(daic_optics::calibrate::SUPPORTED.map(|p| p.get(&c.optics) - p.get(&truth)));
        mean += e / f64::from(runs);
        found += e * e.transpose() / f64::from(runs);
        expected += Matrix3::from_fn(|i, j| c.covariance[(i, j)]) / f64::from(runs);
        chi2 += c.chi_square_reduced / f64::from(runs);
        let m = c.optics.model().unwrap();
        let (p, q) =
            (m.decode_point(Decoder::Ray, before).unwrap(), m.decode_point(Decoder::Ray, after).unwrap());
        let off: Vector3<f64> = q - p - by;
        let jacobian = m.parameter_jacobian(Decoder::Ray, after).unwrap()
            - m.parameter_jacobian(Decoder::Ray, before).unwrap();
        let supported = daic_optics::calibrate::SUPPORTED.to_vec();
        let covariance = ParameterCovariance::new(supported, c.covariance.clone()).unwrap();
        let covariance = covariance.between(&jacobian, &jacobian);
        spread[0] += off.component_mul(&off) / f64::from(runs);
        spread[1] += covariance.diagonal() / f64::from(runs);
        for i in 0..3 {
            within[i] += usize::from(e[i].abs() <= c.estimates[i].sigma);
        }
    }
    let sigma = Vector3::from_fn(|i, _| expected[(i, i)].sqrt());
    println!("sigma F {:.3} px, s {:.4} mm, d {:.4} mm", sigma.x, sigma.y, sigma.z);
    println!("scatter/sigma {:?}", Vector3::from_fn(|i, _| found[(i, i)].sqrt() / sigma[i]));
    println!("mean/sigma {:?}, chi² {chi2:.4}, within 1σ {within:?} of {runs}", mean.component_div(&sigma));
    let spread = spread.map(|v| v.map(f64::sqrt));
    println!("displacement off by {:?} µm RMS, predicted {:?}", 1e3 * spread[0], 1e3 * spread[1]);
    for i in 0..3 {
        assert!((spread[0][i] / spread[1][i] - 1.0).abs() < 0.11);
        // Of 400 runs: variance ± 7 %, mean ± 0.05 σ, coverage 68.3 ± 2.3 %; three times that.
        assert!((found[(i, i)] / expected[(i, i)] - 1.0).abs() < 0.21);
        assert!(mean[i].abs() < 0.15 * sigma[i]);
        let covered = within[i] as f64 / f64::from(runs);
        assert!((covered - 0.683).abs() < 0.07, "{covered}");
        for j in 0..i {
            let unit = sigma[i] * sigma[j];
            assert!((found[(i, j)] - expected[(i, j)]).abs() < 0.21 * unit);
        }
    }
    // Mean of 400 values, each ± √(2/2097).
    assert!((chi2 - 1.0).abs() < 0.01);
}

/// 1 % of the observations grossly wrong: found, left out, and the result is as good as without.
#[test]
fn outliers_are_left_out() {
    let truth = golden();
    let mut points = track(&truth, &moves(), 400, 0.01, 34);
    let mut random = Normal::new(35);
    add_noise(&mut points, &mut random);
    let mut bad = std::collections::BTreeSet::new();
    while bad.len() < 24 {
        bad.insert((random.index(400), random.index(6)));
    }
    for (n, (i, k)) in bad.iter().enumerate() {
        let pair = &mut points[*i].frames[*k].as_mut().unwrap().pair;
        // From a slip of 0.3 px to a false match 40 px away.
        let by = [0.3, 2.0, 40.0][n % 3];
        if n % 2 == 0 {
            pair.minus_px[n % 4 / 2] += by;
        } else {
            pair.plus_px[n % 4 / 2] -= by;
        }
    }
    let c = calibrate(&wrong(&truth, 0.01), &moves(), &points, &Settings::default()).unwrap();
    let kept: Vec<_> = bad.iter().filter(|b| !c.rejected.contains(b)).collect();
    println!("rejected {}, bad ones kept {kept:?}, rms {:.5}", c.rejected.len(), c.rms_px);
    assert!(kept.is_empty());
    // A few neighbours of a 40 px outlier may go in the first round, none for good.
    assert!(c.rejected.len() <= 26);
    for e in &c.estimates {
        assert!((e.value - e.parameter.get(&truth)).abs() < 4.0 * e.sigma, "{e:?}");
    }
    assert!((c.chi_square_reduced - 1.0).abs() < 0.06);
}

/// Sigmas stated ten times too small: χ² says so and the covariance is widened.
#[test]
fn too_small_sigmas_widen_the_covariance() {
    let truth = golden();
    let mut points = track(&truth, &moves(), 200, 0.02, 36);
    add_noise(&mut points, &mut Normal::new(37));
    let honest = calibrate(&truth, &moves(), &points, &Settings::default()).unwrap();
    for o in points.iter_mut().flat_map(|p| p.frames.iter_mut().flatten()) {
        o.sigma_px = [0.002; 4];
    }
    let c = calibrate(&truth, &moves(), &points, &Settings::default()).unwrap();
    assert!((c.chi_square_reduced / honest.chi_square_reduced / 100.0 - 1.0).abs() < 0.01);
    for (a, b) in c.estimates.iter().zip(&honest.estimates) {
        assert!((a.sigma / b.sigma - 1.0).abs() < 0.05, "{a:?} {b:?}");
    }
}

#[test]
fn what_the_data_do_not_fix_is_an_error() {
    let truth = golden();
    let run = |moves: &[Vector3<f64>], settings: &Settings| {
        let points = track(&truth, moves, 60, 0.05, 38);
        calibrate(&truth, moves, &points, settings)
    };
    run(&moves(), &Settings::default()).unwrap();
    // Without a move along z only the field's perspective tells F from s, six times worse.
    let in_plane = &moves()[..3];
    let e = run(in_plane, &Settings::default()).unwrap_err();
    println!("{e}");
    let CalibrateError::Undetermined { sigma, limit, .. } = e else {
        panic!("{e:?}");
    };
    assert!(sigma > limit && sigma.is_finite());
    assert!(e.to_string().contains("along z"));
    // One parameter of the two can be had from the same moves.
    let focal = Settings { parameters: vec![Parameter::FocalPx], ..Settings::default() };
    run(in_plane, &focal).unwrap();
    // No move at all: the scale of the whole is free.
    let e = run(&[Vector3::zeros(); 3], &Settings::default()).unwrap_err();
    println!("{e}");
    assert!(matches!(e, CalibrateError::Undetermined { .. }), "{e:?}");
    let no_datum = Settings { reference_height_mm: None, ..Settings::default() };
    assert_eq!(run(&moves(), &no_datum), Err(CalibrateError::NoReferenceHeight));
}

#[test]
fn bad_input_is_named() {
    let truth = golden();
    let shifts = moves();
    let good = track(&truth, &shifts, 40, 0.01, 39);
    let default = Settings::default();
    let few = calibrate(&truth, &shifts, &[], &default);
    assert!(matches!(few, Err(CalibrateError::TooFewData { points: 0, .. })));
    let none = calibrate(&truth, &[], &[], &default);
    assert!(matches!(none, Err(CalibrateError::TooFewData { .. })));
    let mut short = good.clone();
    short[3].frames.pop();
    let e = CalibrateError::FrameCount { point: 3, found: 5, expected: 6 };
    assert_eq!(calibrate(&truth, &shifts, &short, &default), Err(e));
    for value in [0.0, -1.0, f64::INFINITY] {
        let mut sigma = good.clone();
        sigma[2].frames[1].as_mut().unwrap().sigma_px[3] = value;
        let e = CalibrateError::Sigma { point: 2, frame: 1, value };
        assert_eq!(calibrate(&truth, &shifts, &sigma, &default), Err(e));
    }
    let mut nan = shifts.clone();
    nan[4].y = f64::NAN;
    let e = CalibrateError::Displacement { frame: 4 };
    assert_eq!(calibrate(&truth, &nan, &good, &default), Err(e));
    for parameters in [vec![], vec![Parameter::FocalPx; 2]] {
        let settings = Settings { parameters, ..default.clone() };
        let e = Err(CalibrateError::Parameters);
        assert_eq!(calibrate(&truth, &shifts, &good, &settings), e);
    }
    let settings = Settings { outlier_limit: f64::NAN, ..default.clone() };
    let e = calibrate(&truth, &shifts, &good, &settings);
    assert!(matches!(e, Err(CalibrateError::Setting { name: "outlier_limit", .. })));
    // A pixel that is not a number cannot be decoded: left out, and said.
    let mut hole = good.clone();
    hole[5].frames[2].as_mut().unwrap().pair.minus_px[0] = f64::NAN;
    let c = calibrate(&truth, &shifts, &hole, &default).unwrap();
    assert_eq!(c.rejected, [(5, 2)]);
    // Displacements of another experiment: nothing fits.
    let other: Vec<_> = shifts.iter().map(|m| Vector3::new(m.y, m.z, -m.x)).collect();
    let e = calibrate(&truth, &other, &good, &default);
    assert!(matches!(e, Err(CalibrateError::NotConverged { .. })), "{e:?}");
}

/// The same bits every time.
#[test]
fn reproducible() {
    let truth = awkward();
    let mut points = track(&truth, &moves(), 50, 0.02, 40);
    add_noise(&mut points, &mut Normal::new(41));
    let run = || calibrate(&wrong(&truth, 0.01), &moves(), &points, &Settings::default()).unwrap();
    assert_eq!(run(), run());
}
