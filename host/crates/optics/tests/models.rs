//! Every parameter's derivatives, separate gratings, and dense distortion maps.

mod common;

use std::sync::Arc;

use common::*;
use daic_optics::{
    Brown, Decoder, DistortionMap, DistortionMaps, GratingParameter, MapError, MapGrid, MapSample,
    OpticalModel, Optics, Parameter, PixelPair, TraceError, View,
};
use nalgebra::Vector3;

const DECODERS: [Decoder; 3] = [Decoder::Ray, Decoder::Closed, Decoder::Linear];

/// A smooth map of up to 0.7 px over the sensor and some margin, different for each `phase`.
fn wave(phase: f64) -> Arc<DistortionMap> {
    let grid = MapGrid::covering([-400.0, -400.0], [3000.0, 2400.0], 100.0);
    let mut e = Vec::new();
    for j in 0..grid.nodes[1] {
        for i in 0..grid.nodes[0] {
            let [x, y] = grid.node_px(i, j);
            e.push([
                0.5 * (x / 300.0 + phase).sin() + 0.2 * (y / 400.0).cos(),
                0.4 * ((x - y) / 350.0 + phase).cos(),
            ]);
        }
    }
    Arc::new(DistortionMap::interpolate(grid, &e).unwrap())
}

fn all_maps() -> DistortionMaps {
    DistortionMaps { sensor: Some(wave(0.3)), minus: Some(wave(1.1)), plus: Some(wave(2.5)) }
}

/// Step for central differences: about 1e-5 of what the parameter may reasonably be.
fn step(p: Parameter) -> f64 {
    use GratingParameter as G;
    match p {
        Parameter::FocalPx => 1e-1,
        Parameter::PrincipalPointX | Parameter::PrincipalPointY => 1e-2,
        Parameter::BrownK1 => 1e-4,
        Parameter::BrownK2 => 1e-2,
        Parameter::BrownK3 => 1.0,
        Parameter::BrownP1 | Parameter::BrownP2 => 1e-5,
        Parameter::Wavelength => 1e-9,
        Parameter::Grating(_, G::Pitch) => 1e-8,
        Parameter::Grating(_, G::Index) => 1e-4,
        _ => match p.unit() {
            "rad" => 1e-5,
            _ => 1e-3,
        },
    }
}

/// Derivatives of points and of pixels with respect to all parameters, with and without maps.
#[test]
fn parameter_jacobians_match_central_differences() {
    let mut worst = [0.0_f64; 2];
    for (o, maps) in
        [(golden(), DistortionMaps::NONE), (awkward(), DistortionMaps::NONE), (awkward(), all_maps())]
    {
        let m = OpticalModel::with_maps(&o, maps.clone()).unwrap();
        for p in [Vector3::new(7.0, -5.0, 1.2), Vector3::new(-3.0, 6.0, -2.0)] {
            let pixel = |m: &OpticalModel, view| m.project(view, p).unwrap();
            let pair = PixelPair { minus_px: pixel(&m, View::Minus), plus_px: pixel(&m, View::Plus) };
            for parameter in Parameter::ALL {
                let e = step(parameter);
                let moved = |by: f64| {
                    let mut o = o;
                    let value = parameter.get(&o) + by;
                    parameter.set(&mut o, value);
                    OpticalModel::with_maps(&o, maps.clone()).unwrap()
                };
                // A substrate cannot be thinner than nothing: one-sided there.
                let zero = parameter.get(&o) == 0.0 && parameter.name().ends_with("thickness_mm");
                let (up, down, span) =
                    if zero { (moved(e), moved(0.0), e) } else { (moved(e), moved(-e), 2.0 * e) };
                // In what one step changes; 1e-5 of a mm or px is what such a step typically does.
                for decoder in DECODERS {
                    let by = m.parameter_jacobian(decoder, pair).unwrap().by(parameter);
                    let fd = (up.decode_point(decoder, pair).unwrap()
                        - down.decode_point(decoder, pair).unwrap())
                        / span;
                    let off = (by - fd).amax() * e;
                    assert!(off < 2e-11, "{decoder:?} {}: {by} {fd} {off:e}", parameter.name());
                    worst[0] = worst[0].max(off);
                }
                for view in View::BOTH {
                    let by = m.project_parameter_jacobian(view, p).unwrap().by(parameter);
                    let (a, b) = (pixel(&up, view), pixel(&down, view));
                    for i in 0..2 {
                        let off = (by[i] - (a[i] - b[i]) / span).abs() * e;
                        assert!(off < 2e-9, "{view:?} {}: {off:e}", parameter.name());
                        worst[1] = worst[1].max(off);
                    }
                }
            }
        }
    }
    println!("worst: {:.1e} mm, {:.1e} px", worst[0], worst[1]);
}

/// Two gratings 4 mm apart that differ by 1 mrad, in a turned frame, against the tracer.
#[test]
fn separate_gratings_and_a_turned_frame_are_exact() {
    let mut o = awkward();
    o.minus.offset_mm = -2.3;
    o.plus.tilt_rad_xyz = o.minus.tilt_rad_xyz;
    o.plus.tilt_rad_xyz[2] += 1e-3;
    let m = o.model().unwrap();
    let mut worst = 0.0_f64;
    for p in field(|x, y| 0.1 * x - 0.05 * y) {
        let d = m.decode(Decoder::Ray, see_both(&o, p)).unwrap();
        worst = worst.max((d.point_mm - p).amax()).max(d.gap_mm.abs());
    }
    println!("worst {worst:.1e} mm");
    assert!(worst < 2e-12, "{worst:e}");
}

/// The spline has the error of its order: 1/16 for half the step, and no error for a cubic.
#[test]
fn interpolation_is_of_fourth_order() {
    let f = |x: f64, y: f64| [0.3 * (x / 120.0).sin() * (y / 150.0).cos(), 0.2 * (y / 100.0).sin()];
    let cubic = |x: f64, y: f64| [1e-9 * x * x * x - 2e-7 * x * y, 3e-10 * x * x * y + 1e-9 * y * y * y];
    let worst = |f: &dyn Fn(f64, f64) -> [f64; 2], step: f64| {
        let grid = MapGrid::covering([0.0, 10.0], [640.0, 490.0], step);
        let nodes: Vec<_> = (0..grid.nodes[1])
            .flat_map(|j| (0..grid.nodes[0]).map(move |i| grid.node_px(i, j)))
            .map(|[x, y]| f(x, y))
            .collect();
        let map = DistortionMap::interpolate(grid, &nodes).unwrap();
        let mut worst = 0.0_f64;
        for i in 0..=200 {
            for j in 0..=200 {
                let [x, y] = [3.2 * f64::from(i), 10.0 + 2.4 * f64::from(j)];
                let (e, t) = (map.e_px([x, y]).unwrap(), f(x, y));
                worst = worst.max((e[0] - t[0]).abs()).max((e[1] - t[1]).abs());
            }
        }
        worst
    };
    let (coarse, fine) = (worst(&f, 40.0), worst(&f, 20.0));
    println!("{coarse:.2e} px at 40 px, {fine:.2e} px at 20 px, cubic {:.1e}", worst(&cubic, 40.0));
    assert!((12.0..24.0).contains(&(coarse / fine)));
    assert!(worst(&cubic, 40.0) < 1e-13);
}

/// observed = ideal + e(observed): alone and on top of Brown, for the sensor and for a view.
#[test]
fn the_map_is_observed_minus_ideal() {
    for brown in [Brown::default(), awkward().camera.brown] {
        let mut o = golden();
        o.camera.brown = brown;
        let plain = o.model().unwrap();
        for (maps, view) in [
            (DistortionMaps { sensor: Some(wave(0.2)), ..DistortionMaps::NONE }, View::Plus),
            (DistortionMaps { minus: Some(wave(0.7)), ..DistortionMaps::NONE }, View::Minus),
        ] {
            let map = maps.sensor.clone().or_else(|| maps.minus.clone()).unwrap();
            let m = OpticalModel::with_maps(&o, maps.clone()).unwrap();
            for p in [Vector3::new(4.0, 6.0, 0.5), Vector3::new(-7.0, 1.0, -1.0)] {
                let (ideal, observed) = (plain.project(view, p).unwrap(), m.project(view, p).unwrap());
                let e = map.e_px(observed).unwrap();
                for i in 0..2 {
                    assert!((observed[i] - ideal[i] - e[i]).abs() < 1e-11);
                }
                // A view's own map leaves the other alone.
                if maps.sensor.is_none() {
                    assert_eq!(m.project(View::Plus, p), plain.project(View::Plus, p));
                }
            }
        }
    }
}

#[test]
fn decoding_and_projecting_with_maps_are_inverse_with_exact_jacobians() {
    let o = awkward();
    let m = OpticalModel::with_maps(&o, all_maps()).unwrap();
    let mut worst = 0.0_f64;
    for p in field(|x, y| 0.1 * x - 0.05 * y) {
        let (minus, jm) = m.project_with_jacobian(View::Minus, p).unwrap();
        let (plus, jp) = m.project_with_jacobian(View::Plus, p).unwrap();
        let d = m.decode(Decoder::Ray, PixelPair { minus_px: minus, plus_px: plus }).unwrap();
        worst = worst.max((d.point_mm - p).amax());
        // d(decode)·d(project) = 1.
        let mut both = nalgebra::Matrix4x3::zeros();
        both.fixed_rows_mut::<2>(0).copy_from(&jm);
        both.fixed_rows_mut::<2>(2).copy_from(&jp);
        assert!((d.jacobian * both - nalgebra::Matrix3::identity()).amax() < 1e-10);
    }
    assert!(worst < 1e-11, "{worst:e}");
    let p = Vector3::new(3.0, -2.0, 0.7);
    let pair = PixelPair {
        minus_px: m.project(View::Minus, p).unwrap(),
        plus_px: m.project(View::Plus, p).unwrap(),
    };
    for decoder in DECODERS {
        let d = m.decode(decoder, pair).unwrap();
        for j in 0..4 {
            let moved = |by: f64| {
                let mut q = pair;
                if j < 2 {
                    q.minus_px[j] += by
                } else {
                    q.plus_px[j - 2] += by
                }
                let d = m.decode(decoder, q).unwrap();
                assert!((d.point_mm - m.decode_point(decoder, q).unwrap()).amax() < 1e-12);
                nalgebra::Vector4::new(d.point_mm.x, d.point_mm.y, d.point_mm.z, d.gap_mm)
            };
            let fd = (moved(1e-3) - moved(-1e-3)) / 2e-3;
            assert!((d.jacobian.column(j) - fd.xyz()).amax() < 2e-9, "{decoder:?} {j}");
            assert!((d.gap_jacobian[j] - fd.w).abs() < 2e-9, "{decoder:?} {j}");
        }
    }
}

/// A map of the sensor's defects fitted to noisy samples, and its own statement of uncertainty.
#[test]
fn a_fitted_map_finds_the_truth_within_its_sigma() {
    // Defects of 0.05 px with a Gaussian width of 60 px.
    let truth = |[x, y]: [f64; 2]| {
        let bump =
            |cx: f64, cy: f64| (-((x - cx).powi(2) + (y - cy).powi(2)) / (2.0 * 60.0_f64.powi(2))).exp();
        [0.05 * bump(200.0, 150.0) + 2e-4 * x, -0.05 * bump(420.0, 300.0) + 1e-6 * x * y]
    };
    let grid = MapGrid::covering([0.0, 0.0], [600.0, 450.0], 25.0);
    let mut noise = Normal::new(31);
    let sigma = 0.01;
    let samples: Vec<_> = (0..6000)
        .map(|_| {
            let pixel_px = [600.0 * noise.uniform(), 450.0 * noise.uniform()];
            let e = truth(pixel_px);
            MapSample { pixel_px, e_px: e.map(|e| e + sigma * noise.next()), sigma_px: sigma }
        })
        .collect();
    let fit = DistortionMap::fit(grid, &samples, 0.01).unwrap();
    let (mut inside, mut n, mut square) = (0.0, 0.0, 0.0);
    for i in 0..60 {
        for j in 0..45 {
            let at = [5.0 + 10.0 * f64::from(i), 5.0 + 10.0 * f64::from(j)];
            let (e, t, s) = (fit.map.e_px(at).unwrap(), truth(at), fit.sigma_px(at).unwrap());
            for c in 0..2 {
                inside += f64::from(u8::from((e[c] - t[c]).abs() < s));
                square += (e[c] - t[c]).powi(2);
                n += 1.0;
            }
        }
    }
    let rms = (square / n).sqrt();
    println!("{rms:.4} px RMS, {:.1} % within σ, residual {:?}", 100.0 * inside / n, fit.rms_px);
    // 16 samples a cell of 0.01 px each; about 150 independent values scatter the share by 4 %.
    assert!(rms < 0.004 && (inside / n - 0.683).abs() < 0.12);
    assert!(fit.rms_px.iter().all(|r| (r / sigma - 1.0).abs() < 0.05));
}

/// A flat target seen through the grating, mapped against what `linear` expects, as arrays of
/// samples: the same models then decode the cylinder to the few µm that remain.
#[test]
fn through_grating_maps_serve_the_virtual_object_models() {
    let o = golden();
    let m = o.model().unwrap();
    let theta = (o.wavelength_mm * 300.0).asin();
    let (t, c3) = (theta.tan(), theta.cos().powi(3));
    let expected = |view: View, p: Vector3<f64>| {
        let scale = o.camera.focal_px / (307.0 + 109.0 / c3);
        [1295.5 + (p.x - view.traced_order() * 109.0 * t) * scale, 971.5 + p.y * scale]
    };
    let map = |view: View| {
        let mut samples = Vec::new();
        for i in -50..=50 {
            for j in -36..=36 {
                let p = Vector3::new(0.25 * f64::from(i), 0.25 * f64::from(j), 0.0);
                let (seen, ideal) = (m.project(view, p).unwrap(), expected(view, p));
                samples.push(MapSample {
                    pixel_px: seen,
                    e_px: [seen[0] - ideal[0], seen[1] - ideal[1]],
                    sigma_px: 1e-3,
                });
            }
        }
        let reach = |c: usize, least: bool| {
            let v = samples.iter().map(|s| s.pixel_px[c]);
            if least { v.fold(f64::MAX, f64::min) } else { v.fold(f64::MIN, f64::max) }
        };
        let grid =
            MapGrid::covering([reach(0, true), reach(1, true)], [reach(0, false), reach(1, false)], 60.0);
        Arc::new(DistortionMap::fit(grid, &samples, 0.1).unwrap().map)
    };
    let maps = DistortionMaps { sensor: None, minus: Some(map(View::Minus)), plus: Some(map(View::Plus)) };
    let with = OpticalModel::with_maps(&o, maps).unwrap();
    let cylinder = |x: f64| (36.0_f64.powi(2) - x * x).sqrt() - 35.0;
    for decoder in [Decoder::Linear, Decoder::Closed] {
        let rms_of = |m: &OpticalModel| {
            let (mut rows, mut errors) = (Vec::new(), Vec::new());
            for p in field(|x, _| cylinder(x)) {
                let q = m.decode_point(decoder, see_both(&o, p)).unwrap();
                rows.push(vec![1.0, q.x, q.y]);
                errors.push(q.z - cylinder(q.x));
            }
            1e3 * rms(least_squares(&rows, &errors).1)
        };
        let (without, with) = (rms_of(&m), rms_of(&with));
        println!("{decoder:?}: {without:.2} µm without maps, {with:.2} µm with");
        assert!(without > 40.0 && with < 15.0, "{without} {with}");
    }
}

#[test]
fn bad_maps_and_pixels_off_the_map_are_refused() {
    let grid = MapGrid { origin_px: [0.0, 0.0], step_px: [10.0, 10.0], nodes: [5, 4] };
    let zero = vec![[0.0; 2]; 20];
    let of = |g: MapGrid, e: &[[f64; 2]]| DistortionMap::interpolate(g, e).unwrap_err();
    assert!(matches!(of(MapGrid { nodes: [3, 4], ..grid }, &zero), MapError::Nodes { found: 3 }));
    assert!(matches!(of(MapGrid { nodes: [5, usize::MAX], ..grid }, &zero), MapError::Nodes { .. }));
    assert!(matches!(
        of(MapGrid { step_px: [0.0, 1.0], ..grid }, &zero),
        MapError::Field { field: "step_px", .. }
    ));
    assert!(matches!(of(grid, &zero[1..]), MapError::Count { expected: 20, found: 19 }));
    assert!(matches!(of(grid, &[[f64::NAN; 2]; 20]), MapError::Value { index: 0 }));
    let sample = MapSample { pixel_px: [5.0, 5.0], e_px: [0.0; 2], sigma_px: 0.1 };
    let fit = |s: &[MapSample]| DistortionMap::fit(grid, s, 0.1).unwrap_err();
    assert!(matches!(fit(&[]), MapError::Undetermined { samples: 0 }));
    assert!(matches!(fit(&[sample; 50]), MapError::Undetermined { samples: 50 }));
    assert!(matches!(
        fit(&[MapSample { pixel_px: [50.0, 5.0], ..sample }]),
        MapError::Outside { index: 0, .. }
    ));
    assert!(matches!(fit(&[MapSample { sigma_px: 0.0, ..sample }]), MapError::Value { index: 0 }));
    let json = serde_json::to_string(&*wave(0.0)).unwrap();
    let back: DistortionMap = serde_json::from_str(&json).unwrap();
    let at = [700.0, 300.0];
    let (a, b) = (back.e_px(at).unwrap(), wave(0.0).e_px(at).unwrap());
    assert!((a[0] - b[0]).abs() < 1e-14 && (a[1] - b[1]).abs() < 1e-14);
    assert!(
        serde_json::from_str::<DistortionMap>(&json.replace("\"nodes\":[35,", "\"nodes\":[34,")).is_err()
    );

    let small = Arc::new(DistortionMap::interpolate(grid, &zero).unwrap());
    let maps = DistortionMaps { plus: Some(small), ..DistortionMaps::NONE };
    let o: Optics = golden();
    let m = OpticalModel::with_maps(&o, maps).unwrap();
    let p = Vector3::new(1.0, 2.0, 0.0);
    let pair = see_both(&o, p);
    let outside = |e| matches!(e, TraceError::OutsideMap { view: View::Plus, .. });
    assert!(outside(m.decode(Decoder::Ray, pair).unwrap_err()));
    assert!(outside(m.project(View::Plus, p).unwrap_err()));
    assert!(m.project(View::Minus, p).is_ok());
}
