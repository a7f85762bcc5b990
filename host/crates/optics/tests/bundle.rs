//! Calibration of a rig from views of a plate: accuracy, coverage, what data cannot fix, bad input.

mod common;

use common::*;
use daic_optics::bundle::{KnownPose, PlatePose, Pose, RigCalibration, Seen, Sighting};
use daic_optics::{
    Brown, Component, Decoder, DistortionMaps, GratingParameter, Optics, Parameter, ReferenceFrame, RigData,
    RigError, RigSettings, Substrate, SubstrateSide, View, calibrate_rig, pixel_covariance,
};
use nalgebra::Vector3;

const SIGMA_PX: f64 = 0.01;

/// Two gratings tilted by up to 3°, 1 mrad and 1 mm apart, each behind 3 mm of glass.
fn tilted() -> Optics {
    let mut o = golden();
    o.camera.brown = Brown { k1: -0.15, ..Brown::default() };
    o.minus.tilt_rad_xyz = [0.03, -0.04, 0.012];
    o.minus.substrate = Substrate { thickness_mm: 3.0, index: 1.517, side: SubstrateSide::Object };
    o.plus = o.minus;
    o.plus.tilt_rad_xyz[2] += 1e-3;
    o.plus.offset_mm = 1.0;
    o.reference = ReferenceFrame { tilt_rad_xyz: [0.02, -0.015, 0.01], origin_mm: [0.3, -0.4] };
    o
}

/// A plate tilted and moved along the axis; the first pose is the reference.
fn poses() -> Vec<Pose> {
    let degrees = |v: [f64; 3]| v.map(f64::to_radians);
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.1, 0.0, 3.0]),
        ([0.0, 0.0, 1.0], [0.0, 0.2, -3.0]),
        ([12.0, 0.0, 0.0], [0.0, 0.0, 0.5]),
        ([-12.0, 2.0, 0.0], [0.3, 0.0, 0.0]),
        ([0.0, 12.0, 0.0], [0.0, 0.0, -0.5]),
        ([1.0, -12.0, 0.0], [0.0, -0.4, 0.0]),
        ([8.0, 8.0, 2.0], [0.0, 0.0, 2.0]),
        ([-8.0, 8.0, -3.0], [0.0, 0.1, -2.0]),
        ([-8.0, -8.0, 0.0], [-0.2, 0.0, 1.0]),
    ]
    .map(|(rotation, translation_mm)| Pose { rotation_rad: degrees(rotation), translation_mm })
    .into()
}

/// Dots on a square grid over ±9.5 × ±7.5 mm.
fn dots(pitch: f64) -> Vec<[f64; 2]> {
    let (nx, ny) = ((9.5 / pitch) as i32, (7.5 / pitch) as i32);
    (-nx..=nx).flat_map(|i| (-ny..=ny).map(move |j| [f64::from(i) * pitch, f64::from(j) * pitch])).collect()
}

/// Exact sightings on a sensor of 2592 × 1944 pixels.
fn see_plate(truth: &Optics, plate: &[[f64; 2]], poses: &[Pose]) -> RigData {
    let m = truth.model().unwrap();
    let on = |p: &[f64; 2]| (0.0..2591.0).contains(&p[0]) && (0.0..1943.0).contains(&p[1]);
    let poses = poses.iter().map(|pose| {
        let sightings = plate.iter().enumerate().filter_map(|(point, xy)| {
            let seen = |view| {
                let px = m.project(view, pose.point_mm(*xy)).ok().filter(on)?;
                Some(Seen { px, sigma_px: [SIGMA_PX; 2] })
            };
            let s = Sighting { point, minus: seen(View::Minus), plus: seen(View::Plus) };
            (s.minus.is_some() || s.plus.is_some()).then_some(s)
        });
        PlatePose { sightings: sightings.collect(), known: KnownPose::default() }
    });
    RigData { plate_mm: plate.iter().map(|p| Some(*p)).collect(), poses: poses.collect() }
}

fn noisy(data: &RigData, random: &mut Normal) -> RigData {
    let mut data = data.clone();
    for s in data.poses.iter_mut().flat_map(|p| &mut p.sightings) {
        for seen in s.minus.iter_mut().chain(&mut s.plus) {
            seen.px = seen.px.map(|v| v + SIGMA_PX * random.next());
        }
    }
    data
}

/// A start whose errors are drawn from the priors, square reference plane, d 1 mm off.
fn start_for(truth: &Optics, random: &mut Normal) -> (Optics, RigSettings) {
    let settings = RigSettings::usual(truth);
    let mut start = *truth;
    start.reference = ReferenceFrame::default();
    start.grating_to_reference_mm += 1.0;
    for e in &settings.parameters {
        let off = e.prior_sigma.unwrap() * random.next();
        let mut value = e.parameter.get(&start) + off;
        if let Parameter::Grating(
            _,
            GratingParameter::TiltX | GratingParameter::TiltY | GratingParameter::TiltZ,
        ) = e.parameter
        {
            value = e.parameter.get(truth) + off;
        }
        e.parameter.set(&mut start, value);
    }
    (start, settings)
}

/// Decoded minus true points of fresh, independently traced pairs in the field that both views
/// see, with 0.01 px of noise: (errors, their σ) of x, y, h.
fn decode_fresh(
    truth: &Optics,
    c: &RigCalibration,
    random: &mut Normal,
    step: usize,
) -> Vec<[Vector3<f64>; 2]> {
    let m = c.optics.model().unwrap();
    let pixels = pixel_covariance([SIGMA_PX; 2], [SIGMA_PX; 2]);
    let mut all = Vec::new();
    for surface in [
        |_, _| 0.0,
        |x: f64, _: f64| (36.0_f64.powi(2) - x * x).sqrt() - 35.0,
        |x: f64, y: f64| 0.15 * x - 0.1 * y,
    ] {
        for p in field(surface).into_iter().filter(|p| p.x.abs() <= 9.0).step_by(step) {
            let mut pair = see_both(truth, p);
            for c in 0..2 {
                pair.minus_px[c] += SIGMA_PX * random.next();
                pair.plus_px[c] += SIGMA_PX * random.next();
            }
            let d = m.decode_with_covariance(Decoder::Ray, pair, &pixels, &c.covariance).unwrap();
            all.push([d.decoded.point_mm - p, d.sigma_mm()]);
        }
    }
    all
}

fn without_check(mut s: RigSettings) -> RigSettings {
    s.leave_one_out = false;
    s
}

/// The required accuracy: at most 2 µm RMS in the reference plane's absolute frame, noise of the
/// decoded pixels included.
#[test]
fn heights_to_two_micrometres_on_tilted_rigs() {
    let truth = tilted();
    let data = see_plate(&truth, &dots(1.0), &poses());
    for seed in [1, 2, 3, 4] {
        let mut random = Normal::new(seed);
        let (start, settings) = start_for(&truth, &mut random);
        let data = noisy(&data, &mut random);
        let c = calibrate_rig(&start, &DistortionMaps::NONE, &data, &without_check(settings)).unwrap();
        let errors = decode_fresh(&truth, &c, &mut random, 1);
        let of = |i: usize| 1e3 * rms(errors.iter().map(|e| e[0][i]));
        println!(
            "χ²/dof {:.4}, {} iterations, errors {:.2} {:.2} {:.2} µm RMS, {} weak",
            c.chi_square_reduced,
            c.iterations,
            of(0),
            of(1),
            of(2),
            c.weak.len()
        );
        // Measured 1.16 to 1.17 µm, all but what the noise of the decoded pixels makes.
        assert!(of(2) < 1.25, "{}", of(2));
        assert!(of(0) < 0.2 && of(1) < 0.2);
        // 11 000 residuals: ± 0.014.
        assert!((c.chi_square_reduced - 1.0).abs() < 0.05);
        // Only the glass, which shifts rays as a change of s does, and the pitch are left to priors.
        for w in &c.weak {
            let glass = |p: Parameter| {
                use GratingParameter as G;
                matches!(p, Parameter::Grating(_, G::Index | G::Thickness | G::Pitch))
            };
            assert!(glass(w.components[0].parameter), "{w:?}");
        }
        assert!(!c.weak.is_empty());
        assert!(c.volume.contains(Vector3::new(9.0, -7.0, -2.0), 0.0));
        assert!(!c.volume.contains(Vector3::new(9.0, -7.0, 9.0), 1.0));
    }
}

/// ±1σ covers 68 % of parameters, and of decoded points, over repeated simulations in which the
/// starting values scatter as their priors say.
#[test]
fn one_sigma_covers_two_thirds() {
    let truth = tilted();
    let data = see_plate(&truth, &dots(2.4), &poses());
    let mut random = Normal::new(77);
    let runs = 60;
    let mut of_parameters = vec![0usize; 24];
    let (mut of_points, mut points) = ([0usize; 3], 0usize);
    let mut squares = vec![0.0; 24];
    for _ in 0..runs {
        let (start, settings) = start_for(&truth, &mut random);
        let data = noisy(&data, &mut random);
        let c = calibrate_rig(&start, &DistortionMaps::NONE, &data, &without_check(settings)).unwrap();
        assert_eq!(c.estimates.len(), of_parameters.len());
        for (j, e) in c.estimates.iter().enumerate() {
            let off = (e.value - e.parameter.get(&truth)) / e.sigma;
            of_parameters[j] += usize::from(off.abs() < 1.0);
            squares[j] += off * off / f64::from(runs);
        }
        for [error, sigma] in decode_fresh(&truth, &c, &mut random, 40) {
            points += 1;
            for i in 0..3 {
                of_points[i] += usize::from(error[i].abs() < sigma[i]);
            }
        }
    }
    let share = of_parameters.iter().sum::<usize>() as f64 / (24 * runs) as f64;
    let of_points = of_points.map(|n| n as f64 / points as f64);
    println!(
        "parameters {:.1} %, points {:?} of {points}",
        100.0 * share,
        of_points.map(|p| (1e3 * p).round() / 10.0)
    );
    println!("each: {of_parameters:?} of {runs}, (error/σ)² {squares:.2?}");
    // 24 parameters, about a dozen of them independent, 60 runs: ± 1.7 %. Points of one run share
    // its calibration: ± 2 %. Three times these.
    assert!((share - 0.683).abs() < 0.05, "{share}");
    for p in of_points {
        assert!((p - 0.683).abs() < 0.06, "{p}");
    }
    // Each alone: 60 runs, ± 0.18 for the mean square; 4σ for the largest of 24.
    assert!(squares.iter().all(|s| (0.35..1.85).contains(s)), "{squares:?}");
}

/// Speckle: no coordinates, scale from a stage whose axes are turned against the plate.
#[test]
fn speckle_takes_its_scale_from_known_moves() {
    let mut truth = tilted();
    truth.reference.tilt_rad_xyz[2] = 0.0;
    truth.reference.origin_mm = [0.0; 2];
    let mut random = Normal::new(5);
    let plate: Vec<[f64; 2]> =
        (0..250).map(|_| [19.0 * random.uniform() - 9.5, 15.0 * random.uniform() - 7.5]).collect();
    let stage = Pose { rotation_rad: [0.01, -0.012, 0.02], translation_mm: [0.0; 3] };
    let axes = nalgebra::Rotation3::from_euler_angles(0.01, -0.012, 0.02);
    let mut all = poses();
    let moves = [[0.0; 3], [0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]];
    for (pose, by) in all.iter_mut().zip(moves) {
        *pose = Pose { rotation_rad: [0.0; 3], translation_mm: (axes * Vector3::from(by)).into() };
    }
    let mut data = see_plate(&truth, &plate, &all);
    data.plate_mm.iter_mut().for_each(|p| *p = None);
    let sigma = 2e-4;
    let data = {
        let mut data = noisy(&data, &mut random);
        for (pose, by) in data.poses.iter_mut().zip(moves).skip(1) {
            pose.known = KnownPose::moved(by.map(|v| v + sigma * random.next()), sigma, 1e-5);
        }
        data
    };
    let (start, settings) = start_for(&truth, &mut random);
    let c = calibrate_rig(&start, &DistortionMaps::NONE, &data, &settings).unwrap();
    let found = c.stage_axes_rad.unwrap();
    println!("stage {found:.5?}, χ²/dof {:.3}", c.chi_square_reduced);
    for i in 0..3 {
        // Moves of 2 and 3 mm with 0.2 µm, and the plate's own scatter.
        assert!((found[i] - stage.rotation_rad[i]).abs() < 1e-3, "{found:?}");
    }
    let m = c.optics.model().unwrap();
    let mut errors = Vec::new();
    for h in [-2.0, 0.0, 2.0] {
        for p in field(|_, _| h).into_iter().filter(|p| p.x.abs() <= 9.0) {
            errors.push(1e3 * (m.decode_point(Decoder::Ray, see_both(&truth, p)).unwrap().z - h));
        }
    }
    let rms = rms(errors);
    println!("heights without noise {rms:.2} µm RMS");
    assert!(rms < 0.5, "{rms}");
    for l in &c.left_out {
        println!(
            "without pose {}: {:.2?} µm, noise {:.2?}",
            l.pose,
            l.rms_mm.map(|v| 1e3 * v),
            l.expected_mm.map(|v| 1e3 * v)
        );
        // The plate's points are known to a third of one pose's noise.
        assert!(l.rms_mm[2] < 1.3 * l.expected_mm[2]);
    }
    assert_eq!(c.left_out.len(), 9);
}

/// Each pose predicted by the others to its noise; a plate bent in one pose shows there.
#[test]
fn a_pose_left_out_is_predicted_to_its_noise() {
    let truth = tilted();
    let mut random = Normal::new(8);
    let clean = see_plate(&truth, &dots(1.9), &poses());
    let data = noisy(&clean, &mut random);
    let (start, settings) = start_for(&truth, &mut random);
    let c = calibrate_rig(&start, &DistortionMaps::NONE, &data, &settings).unwrap();
    assert_eq!(c.left_out.len(), 9);
    for l in &c.left_out {
        println!(
            "without pose {}: {:.2?} µm, noise {:.2?}",
            l.pose,
            l.rms_mm.map(|v| 1e3 * v),
            l.expected_mm.map(|v| 1e3 * v)
        );
        for i in 0..3 {
            // 70 points: ± 8 %; three poses of the fit lost at a rim add up to a tenth.
            assert!((l.rms_mm[i] / l.expected_mm[i] - 1.0).abs() < 0.4, "{l:?}");
        }
    }
    for r in &c.residuals {
        assert!(r.points > 40 && r.rms_px.iter().all(|v| (v / SIGMA_PX - 1.0).abs() < 0.3), "{r:?}");
    }
    assert_eq!(c, calibrate_rig(&start, &DistortionMaps::NONE, &data, &settings).unwrap());
}

#[test]
fn outliers_are_found_and_left_out() {
    let truth = tilted();
    let mut random = Normal::new(9);
    let mut data = noisy(&see_plate(&truth, &dots(1.9), &poses()), &mut random);
    let mut wrong = Vec::new();
    for (k, pose) in data.poses.iter_mut().enumerate() {
        for s in pose.sightings.iter_mut().filter(|s| s.point % 23 == k) {
            if let Some(seen) = &mut s.plus {
                seen.px[1] += 0.5 + random.uniform();
                wrong.push((k, s.point, View::Plus));
            }
        }
    }
    assert!(wrong.len() > 20);
    let (start, settings) = start_for(&truth, &mut random);
    let c = calibrate_rig(&start, &DistortionMaps::NONE, &data, &without_check(settings)).unwrap();
    let mut found = c.rejected.clone();
    found.sort_unstable_by_key(|r| (r.0, r.1));
    wrong.sort_unstable_by_key(|r| (r.0, r.1));
    assert!(wrong.iter().all(|w| found.contains(w)));
    // Beyond 5σ of 2600 normal residuals: none expected.
    assert!(found.len() <= wrong.len() + 1, "{found:?}");
}

fn fails(data: &RigData, change: impl Fn(&mut RigSettings)) -> RigError {
    let truth = tilted();
    let mut start = truth;
    start.reference = ReferenceFrame::default();
    start.pinhole_to_grating_mm += 2.0;
    let mut settings = without_check(RigSettings::usual(&start));
    change(&mut settings);
    let e = calibrate_rig(&start, &DistortionMaps::NONE, data, &settings).unwrap_err();
    println!("{e}");
    e
}

#[test]
fn what_cannot_be_calibrated_is_said() {
    let truth = tilted();
    let good = noisy(&see_plate(&truth, &dots(2.4), &poses()), &mut Normal::new(10));
    let same = |_: &mut RigSettings| {};
    let swap = |p: &mut PlatePose| {
        p.sightings.iter_mut().for_each(|s| std::mem::swap(&mut s.minus, &mut s.plus));
    };

    let mut d = good.clone();
    d.poses.iter_mut().for_each(swap);
    assert_eq!(fails(&d, same), RigError::SwappedOrders { poses: (0..10).collect() });
    let mut d = good.clone();
    swap(&mut d.poses[3]);
    assert_eq!(fails(&d, same), RigError::SwappedOrders { poses: vec![3] });

    let mut d = good.clone();
    d.poses.truncate(1);
    assert_eq!(fails(&d, same), RigError::TooFewPoses { found: 1, needed: 2 });
    let mut d = good.clone();
    d.poses[4].sightings.truncate(5);
    assert!(matches!(fails(&d, same), RigError::TooFewPoints { pose: 4, needed: 6, .. }));
    let flat = see_plate(&truth, &dots(2.4), &vec![Pose::default(); 5]);
    assert!(matches!(fails(&flat, same), RigError::NoDepth { .. }));

    let mut d = good.clone();
    d.plate_mm.iter_mut().for_each(|p| *p = None);
    assert_eq!(fails(&d, same), RigError::NoScale);
    let mut d = good.clone();
    d.plate_mm.iter_mut().flatten().for_each(|p| p[1] = -p[1]);
    assert!(matches!(fails(&d, same), RigError::Mirrored { pose: 0 }));

    // Nothing tells s from the offset of both gratings together.
    let e = fails(&good, |s| {
        s.parameters.retain(|e| e.parameter != Parameter::PinholeToGrating);
        s.parameters.retain(|e| !e.parameter.name().ends_with("offset_mm"));
        for parameter in [
            Parameter::PinholeToGrating,
            Parameter::Grating(View::Minus, GratingParameter::Offset),
            Parameter::Grating(View::Plus, GratingParameter::Offset),
        ] {
            s.parameters.push(daic_optics::bundle::Estimated { parameter, prior_sigma: None });
        }
    });
    let RigError::Undetermined { combination } = e else { panic!("{e}") };
    let named = |name: &str| combination.iter().any(|c: &Component| c.parameter.name().contains(name));
    assert!(named("pinhole_to_grating") && named("minus.offset") && named("plus.offset"));

    let mut d = good.clone();
    d.poses[2].sightings[0].point = 1000;
    assert!(matches!(fails(&d, same), RigError::UnknownPoint { pose: 2, point: 1000, .. }));
    let mut d = good.clone();
    d.poses[2].sightings[0].point = d.poses[2].sightings[1].point;
    assert!(matches!(fails(&d, same), RigError::RepeatedPoint { pose: 2, .. }));
    let mut d = good.clone();
    d.poses[1].sightings[7].minus.as_mut().unwrap().px[0] = f64::NAN;
    assert!(matches!(fails(&d, same), RigError::Pixel { pose: 1, .. }));
    let mut d = good.clone();
    d.plate_mm[3] = Some([0.0, f64::INFINITY]);
    assert_eq!(fails(&d, same), RigError::PlateCoordinates { point: 3 });
    let mut d = good.clone();
    d.poses[1].known = KnownPose::moved([0.0; 3], 0.0, 1.0);
    assert_eq!(fails(&d, same), RigError::KnownPose { pose: 1 });
    assert!(matches!(
        fails(&good, |s| s.reference_pose = 10),
        RigError::Setting { name: "reference_pose", .. }
    ));
    assert!(matches!(
        fails(&good, |s| s.outlier_limit = f64::NAN),
        RigError::Setting { name: "outlier_limit", .. }
    ));
    assert!(matches!(fails(&good, |s| s.parameters[1] = s.parameters[0]), RigError::Parameter { .. }));
    // Tracking that belongs to other points.
    let mut d = good.clone();
    let mut random = Normal::new(12);
    for s in d.poses.iter_mut().flat_map(|p| &mut p.sightings) {
        if random.uniform() < 0.46 {
            s.plus.iter_mut().for_each(|s| s.px[1] += 5.0 * random.uniform());
        }
    }
    assert!(matches!(fails(&d, same), RigError::TooManyOutliers { .. }));
}

/// A pitch stated 1 % wrong, noticed by the stage's moves; the right pitch passes.
#[test]
fn a_wrong_pitch_contradicts_known_moves() {
    let truth = tilted();
    let all = poses();
    let mut data = noisy(&see_plate(&truth, &dots(2.4), &all), &mut Normal::new(14));
    for (k, pose) in data.poses.iter_mut().enumerate().take(3).skip(1) {
        pose.known.translation_mm =
            all[k].translation_mm.map(|value| Some(daic_optics::bundle::Known { value, sigma: 2e-3 }));
    }
    let mut wrong = data.clone();
    wrong.plate_mm.iter_mut().flatten().for_each(|p| *p = p.map(|v| 1.01 * v));
    let RigError::PitchConflict { ratio, sigma } = fails(&wrong, |_| {}) else { panic!("no conflict") };
    // 6 mm of travel with 2 µm at either end.
    assert!((ratio - 1.0 / 1.01).abs() < 4.0 * sigma && sigma < 1e-3, "{ratio} ± {sigma}");
    let mut start = truth;
    start.pinhole_to_grating_mm += 2.0;
    let settings = without_check(RigSettings::usual(&start));
    let c = calibrate_rig(&start, &DistortionMaps::NONE, &data, &settings).unwrap();
    let scale = c.plate_scale.unwrap();
    println!("{scale:?}");
    assert!((scale.value - 1.0).abs() < 4.0 * scale.sigma);
}
