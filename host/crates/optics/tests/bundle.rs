//! Calibration of a rig from views of a plate: accuracy, coverage, what data cannot fix, bad input.

mod common;

use common::*;
use daic_optics::bundle::{KnownPose, PlatePose, Pose, RigCalibration, Seen, Sighting};
use daic_optics::{
    Brown, Component, Decoder, DistortionMaps, GratingParameter, Optics, Parameter, PixelPair,
    ReferenceFrame, RigData, RigError, RigSettings, Substrate, SubstrateSide, View, calibrate_rig,
    pixel_covariance,
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

/// The required accuracy: at most 2 µm RMS in the reference plane's absolute frame.
#[test]
fn heights_to_two_micrometres_on_tilted_rigs() {
    let truth = tilted();
    let data = see_plate(&truth, &dots(1.0), &poses());
    for seed in [1, 2, 3, 4] {
        let mut random = Normal::new(seed);
        let (start, settings) = start_for(&truth, &mut random);
        let c = calibrate_rig(
            &start,
            &DistortionMaps::NONE,
            &noisy(&data, &mut random),
            &without_check(settings),
        )
        .unwrap();
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
        for w in &c.weak {
            println!(
                "   {:8.1} {:?}",
                w.data_sigma,
                w.components
                    .iter()
                    .map(|c| (c.parameter.name(), (c.weight * 100.0).round() / 100.0))
                    .collect::<Vec<_>>()
            );
        }
        for e in &c.estimates {
            println!(
                "   {} {:.6} ± {:.6} (start {:.6}, truth {:.6})",
                e.parameter.name(),
                e.value,
                e.sigma,
                e.start,
                e.parameter.get(&truth)
            );
        }
        assert!(of(2) < 2.0, "{}", of(2));
        assert!((c.chi_square_reduced - 1.0).abs() < 0.05);
    }
}
