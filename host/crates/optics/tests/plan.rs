//! The planning tool against the numbers of the thesis' set-up, closed forms, and the tracer that
//! shares no code with the crate.

mod common;

use common::{golden, see, see_both, trace};
use daic_optics::plan::{PlanError, Request, Suggestion, Warning, plan};
use daic_optics::{Decoder, Optics, View};
use nalgebra::Vector3;

/// The thesis' set-up focused on the reference plane.
fn thesis() -> Optics {
    let mut o = golden();
    o.camera.focal_px = 17_347.0;
    o
}

fn cos3() -> f64 {
    let sin: f64 = 633e-6 * 300.0;
    (1.0 - sin * sin).powf(1.5)
}

#[test]
fn numbers_of_the_thesis() {
    let p = plan(&thesis(), &Request::default()).unwrap();
    let near = |a: f64, b: f64, digits: f64| assert!((a - b).abs() <= 0.5 * digits, "{a} {b}");
    near(p.angle_deg[0], 10.95, 0.01);
    near(p.angle_deg[1], 10.95, 0.01);
    near(p.paraxial.angle_deg, 10.95, 0.01);
    near(p.paraxial.pixel_mm * 1e3, 24.3, 0.1);
    near(p.paraxial.sigma_h_mm * 1e3, 7.8, 0.1);
    // 25 µm per 0.1 nm
    near(p.light.drift_h_paraxial_mm * 1e3, 25.0, 1.0);
    // footprints −23…−8 and +8…+23 mm
    let [minus, plus] = p.footprints_mm;
    let full = plan(
        &thesis(),
        &Request {
            specimen_mm: Some([p.field_mm.x.length(), p.field_mm.y.length()]),
            heights_mm: [0.0, 0.0],
            ..Request::default()
        },
    )
    .unwrap();
    near(full.footprints_mm[0].x.low, -23.0, 1.0);
    near(full.footprints_mm[0].x.high, -8.0, 1.0);
    near(full.footprints_mm[1].x.low, 8.0, 1.0);
    near(full.footprints_mm[1].x.high, 23.0, 1.0);
    assert!(minus.x.high < 0.0 && plus.x.low > 0.0);
    // 0.1 mm of d is 0.1 mm, 0.1 mm of s is −35 µm
    near(p.light.offset_d_mm * 1e3, 100.0, 0.01);
    // −35.4 in the paraxial model, −35.5 by rays
    near(p.light.offset_s_mm * 1e3, -35.0, 2.0);
    // 2.84 px of smear for 2 nm at this F; the 2.9 px of the literature are at F = 17 956 (b' = 23.5 µm)
    near(p.light.smear_paraxial_px, 2.84, 0.01);
    let golden = plan(&golden(), &Request::default()).unwrap();
    near(golden.light.smear_paraxial_px, 2.9, 0.1);
    near(golden.paraxial.pixel_mm * 1e3, 23.5, 0.1);
    // exact rays agree with the formula to the 1.5 % by which the virtual object is off
    for p in [&p, &golden] {
        assert!((p.light.smear_px / p.light.smear_paraxial_px - 1.0).abs() < 0.02, "{:?}", p.light);
        // the formula holds b' fixed, which shrinks by 3 % of the drift
        let drift = p.light.drift_h_mm / p.light.drift_h_paraxial_mm;
        assert!((0.96..0.98).contains(&drift), "{drift}");
        assert!((p.sigma.centre_mm[2] / p.paraxial.sigma_h_mm - 1.0).abs() < 0.02, "{:?}", p.sigma);
        assert!((p.pixel_mm[0] / p.paraxial.pixel_mm - 1.0).abs() < 0.02, "{:?}", p.pixel_mm);
    }
}

/// σ, smear, drift, field, footprints and columns by the independent tracer.
#[test]
fn exact_rays() {
    let o = thesis();
    let r = Request { specimen_mm: Some([18.0, 14.0]), heights_mm: [-1.0, 1.5], ..Request::default() };
    let p = plan(&o, &r).unwrap();
    let model = o.model().unwrap();

    // σ of the centre: 0.09 px in u and v of the +1 pixel, by differences of decoded points
    let pair = see_both(&o, Vector3::zeros());
    let mut variance = Vector3::zeros();
    for i in 0..2 {
        let at = |s: f64| {
            let mut pair = pair;
            pair.plus_px[i] += s;
            model.decode_point(Decoder::Ray, pair).unwrap()
        };
        let by = (at(0.01) - at(-0.01)) / 0.02 * 0.09;
        variance += by.component_mul(&by);
    }
    for i in 0..3 {
        assert!((p.sigma.centre_mm[i] / variance[i].sqrt() - 1.0).abs() < 1e-5, "{i}");
    }

    // light: what the tracer sees of other wavelengths
    let coloured = |by: f64| Optics { wavelength_mm: o.wavelength_mm + by, ..o };
    let seen = |by: f64| see_both(&coloured(by), Vector3::zeros());
    let smear = seen(-1e-6).minus_px[0] - seen(1e-6).minus_px[0];
    assert!((p.light.smear_px / smear.abs() - 1.0).abs() < 1e-4, "{} {smear}", p.light.smear_px);
    let drift = model.decode_point(Decoder::Ray, seen(1e-7)).unwrap().z;
    assert!((p.light.drift_h_mm / drift.abs() - 1.0).abs() < 1e-3, "{} {drift}", p.light.drift_h_mm);

    // the field: its border is on the sensor, 1 % more is not
    let on_sensor = |x: f64, y: f64| {
        let [a, b] = View::BOTH.map(|v| see(&o, v, Vector3::new(x, y, 0.0)));
        let rows = |row: f64| (-0.5..=1943.5).contains(&row);
        (-0.5..=1295.5).contains(&a[0]) && (1295.5..=2591.5).contains(&b[0]) && rows(a[1]) && rows(b[1])
    };
    let f = p.field_mm;
    let border = |scale: f64| {
        (0..=20).all(|i| {
            let t = f64::from(i) / 20.0;
            let x = scale * (f.x.low + t * f.x.length());
            let y = scale * (f.y.low + t * f.y.length());
            on_sensor(x, scale * f.y.low)
                && on_sensor(x, scale * f.y.high)
                && on_sensor(scale * f.x.low, y)
                && on_sensor(scale * f.x.high, y)
        })
    };
    println!("field {f:?}");
    assert!(border(1.0 - 1e-9) && !border(1.01));

    // columns and footprints of the specimen
    let (mut columns, mut prints) = ([f64::INFINITY, f64::NEG_INFINITY], [f64::INFINITY, f64::NEG_INFINITY]);
    for h in r.heights_mm {
        for i in 0..=40 {
            for y in [-7.0, 0.0, 7.0] {
                let at = Vector3::new(-9.0 + 0.45 * f64::from(i), y, h);
                let [x, row] = see(&o, View::Minus, at);
                columns = [columns[0].min(x), columns[1].max(x)];
                let q = [(x - 1295.5) / 17_347.0, (row - 971.5) / 17_347.0];
                let hit = trace(&o, View::Minus, q).0.x;
                prints = [prints[0].min(hit), prints[1].max(hit)];
            }
        }
    }
    let minus = p.columns_px[0];
    assert!((minus.low - columns[0]).abs() < 1e-6 && (minus.high - columns[1]).abs() < 1e-6, "{minus:?}");
    let x = p.footprints_mm[0].x;
    assert!((x.low - prints[0]).abs() < 1e-9 && (x.high - prints[1]).abs() < 1e-9, "{x:?} {prints:?}");

    // the disparity of the centre lies in the range, and the range is little more than the heights give
    let [low, high] = p.disparity_px.u_px;
    let u = |h: f64| {
        let pair = see_both(&o, Vector3::new(0.0, 0.0, h));
        pair.plus_px[0] - pair.minus_px[0]
    };
    assert!(low <= u(1.5) && u(-1.0) <= high && (high - low) < 1.3 * (u(-1.0) - u(1.5)));
}

/// (2.9), corrected, against the linear decoder (2.5) with wrong d and s, written out.
#[test]
fn budget_is_the_linear_decoder() {
    let o = thesis();
    let r = Request { distance_errors_mm: [0.2, 0.3], ..Request::default() };
    let p = plan(&o, &r).unwrap();
    let t = (633e-6 * 300.0_f64).asin().tan();
    let height = |u: f64, s: f64, d: f64| {
        let b = (s + d / cos3()) / 17_347.0;
        (d - b * u / (2.0 * t)) * (1.0 + d / (s * cos3()))
    };
    let u0 = 2.0 * t * 109.0 / ((307.0 + 109.0 / cos3()) / 17_347.0);
    for row in &p.budget {
        // the disparity that the right values decode as this height
        let per_px = p.paraxial.height_per_px;
        let u = u0 - row.height_mm / per_px;
        assert!((height(u, 307.0, 109.0) - row.height_mm).abs() < 1e-12);
        let e = 1e-4;
        let slope = |s: f64, d: f64| {
            let change = |u: f64| height(u, 307.0 + s, 109.0 + d) - height(u, 307.0 - s, 109.0 - d);
            // apart from the constant offset
            (change(u) - change(u0)) / (2.0 * e)
        };
        let (by_d, by_s) = (0.2 * slope(0.0, e), 0.3 * slope(e, 0.0));
        println!(
            "h {} mm: from d {:.3e} {by_d:.3e}, from s {:.3e} {by_s:.3e}",
            row.height_mm, row.from_d_mm, row.from_s_mm
        );
        assert!((row.from_d_mm / by_d.abs() - 1.0).abs() < 1e-5);
        assert!((row.from_s_mm / by_s.abs() - 1.0).abs() < 1e-5);
        let sum = row.from_disparity_mm.powi(2) + row.from_d_mm.powi(2) + row.from_s_mm.powi(2);
        assert!((row.total_mm.powi(2) / sum - 1.0).abs() < 1e-12);
        assert!((row.from_disparity_mm - p.paraxial.sigma_h_mm).abs() < 1e-15);
    }
}

/// How wide a specimen may be before a view touches the zeroth order, in the paraxial model:
/// W = d t/(1 + (s + d/c³)/(s + d)); what is said about one that is wider, and whether the advice helps.
#[test]
fn overlaps_and_advice() {
    let o = thesis();
    let flat = Request { heights_mm: [0.0, 0.0], ..Request::default() };
    let t = (633e-6 * 300.0_f64).asin().tan();
    let half = 109.0 * t / (1.0 + (307.0 + 109.0 / cos3()) / (307.0 + 109.0));
    let p = plan(&o, &Request { specimen_mm: Some([10.0, 2.0]), ..flat.clone() }).unwrap();
    // 1.5 % for the virtual object
    assert!((p.widest_specimen_mm / (2.0 * half) - 1.0).abs() < 0.015, "{} {half}", p.widest_specimen_mm);
    assert!(!p.warnings.iter().any(|w| matches!(w, Warning::ZerothOverlaps { .. })), "{:?}", p.warnings);

    let wide = Request { specimen_mm: Some([26.0, 2.0]), ..flat };
    let p = plan(&o, &wide).unwrap();
    let zeroth: Vec<_> = p.warnings.iter().filter(|w| matches!(w, Warning::ZerothOverlaps { .. })).collect();
    assert_eq!(zeroth.len(), 2, "{:?}", p.warnings);
    assert!(p.free_px[0] < 0.0 && (p.free_px[0] - p.free_px[1]).abs() < 1e-6);
    let found = |p: &daic_optics::plan::Plan, request: &Request| {
        let mut fixed = (0, 0);
        for s in &p.suggestions {
            match *s {
                Suggestion::NarrowerSpecimen { width_mm } => {
                    let narrow = Request { specimen_mm: Some([width_mm - 1e-6, 2.0]), ..request.clone() };
                    assert!(plan(&o, &narrow).unwrap().free_px[0] >= 0.0);
                    fixed.0 += 1;
                }
                Suggestion::LongerD { d_mm } => {
                    let longer = Optics { grating_to_reference_mm: d_mm, ..o };
                    let free = plan(&longer, request).unwrap().free_px[0];
                    // to first order: within 3 % of the columns of the specimen
                    assert!(free > -0.03 * p.columns_px[0].length(), "{free}");
                    fixed.1 += 1;
                }
                _ => {}
            }
        }
        fixed
    };
    assert_eq!(found(&p, &wide), (1, 1), "{:?}", p.suggestions);
    // a grating that suppresses the zeroth order
    let dark = Request { zeroth_order: false, ..wide };
    let p = plan(&o, &dark).unwrap();
    assert!(!p.warnings.iter().any(|w| matches!(w, Warning::ZerothOverlaps { .. })));
    assert!(p.widest_specimen_mm > 40.0, "{}", p.widest_specimen_mm);
}

#[test]
fn light_advice_does_what_it_says() {
    let p = plan(&thesis(), &Request::default()).unwrap();
    assert!(p.warnings.iter().any(|w| matches!(w, Warning::Smear { smear_px } if *smear_px > 2.5)));
    let mut seen = 0;
    for s in &p.suggestions {
        match *s {
            Suggestion::Bandwidth { bandwidth_mm } => {
                let q = plan(&thesis(), &Request { bandwidth_mm, ..Request::default() }).unwrap();
                assert!((q.light.smear_px - 1.0).abs() < 1e-9);
                seen += 1;
            }
            Suggestion::Wavelength { drift_mm, sigma_h_mm } => {
                let q = plan(&thesis(), &Request { drift_mm, ..Request::default() }).unwrap();
                assert!((q.light.drift_h_mm / sigma_h_mm - 1.0).abs() < 1e-9);
                seen += 1;
            }
            Suggestion::Calibrate { distances_um, noise_um, .. } => {
                assert!(distances_um > noise_um);
                seen += 1;
            }
            _ => {}
        }
    }
    assert_eq!(seen, 3, "{:?}", p.suggestions);
    // what a finer grating would bring is what a plan of it says
    let finer = p.variants.iter().find(|v| v.change.starts_with("400 lines")).unwrap();
    assert!(p.variants[0].change == "as planned" && finer.sigma_h_mm < 0.8 * p.sigma.centre_mm[2]);
    assert_eq!(p.variants[0].sigma_h_mm, p.sigma.centre_mm[2]);
    let mut o = thesis();
    o.minus.pitch_mm = 1.0 / 400.0;
    o.plus.pitch_mm = 1.0 / 400.0;
    let q = plan(&o, &Request::default()).unwrap();
    assert!((finer.sigma_h_mm / q.sigma.centre_mm[2] - 1.0).abs() < 1e-12);
    assert!((finer.field_mm[0] / q.field_mm.x.length() - 1.0).abs() < 1e-12);
}

#[test]
fn depth_and_blur() {
    let r = Request {
        specimen_mm: Some([14.0, 10.0]),
        pupil_mm: Some(10.0),
        heights_mm: [-8.0, 8.0],
        ..Request::default()
    };
    let o = thesis();
    let p = plan(&o, &r).unwrap();
    let [low, high] = p.depth.sharp_mm.unwrap();
    // blur circle by similar triangles: pupil · |v − v₀|/v of the image distances, f from 1/f = 1/Z + 1/v
    let z = |h: f64| 307.0 + (109.0 - h) / cos3();
    let v0 = 17_347.0 * 2.2e-3;
    let f = 1.0 / (1.0 / z(0.0) + 1.0 / v0);
    for h in [low, high] {
        let v = 1.0 / (1.0 / f - 1.0 / z(h));
        let blur = 10.0 * ((v0 - v) / v).abs() / 2.2e-3;
        assert!((blur - 2.0).abs() < 1e-9, "{h} {blur}");
    }
    assert!(p.warnings.iter().any(|w| matches!(w, Warning::Blurred { .. })));
    let pupil = p.suggestions.iter().find_map(|s| match s {
        Suggestion::SmallerPupil { pupil_mm } => Some(*pupil_mm),
        _ => None,
    });
    let q = plan(&o, &Request { pupil_mm: Some((1.0 - 1e-9) * pupil.unwrap()), ..r.clone() }).unwrap();
    assert!(!q.warnings.iter().any(|w| matches!(w, Warning::Blurred { .. })), "{:?}", q.depth);
    // the ends of the depth range are where a corner leaves the sensor or the orders meet
    let [low, high] = p.depth.seen_mm;
    println!("seen {low} to {high}");
    let at = |h: f64| {
        let q = plan(&o, &Request { heights_mm: [h, h], ..r.clone() }).unwrap();
        q.warnings.iter().all(|w| {
            !matches!(
                w,
                Warning::OffSensor { .. } | Warning::ZerothOverlaps { .. } | Warning::ViewsOverlap { .. }
            )
        }) && q.columns_px[0].low >= -0.5
    };
    assert!(at(high - 0.01) && at(low + 0.01), "{low} {high}");
    assert!(!at(high + 0.1) || !at(low - 0.1), "{low} {high}");
}

#[test]
fn impossible_set_ups_are_refused() {
    let mut o = thesis();
    o.minus.pitch_mm = 600e-6;
    assert!(
        matches!(plan(&o, &Request::default()), Err(PlanError::Optics(e)) if e.field == "minus.pitch_mm")
    );
    let mut o = thesis();
    o.camera.principal_point_px[0] = 400.0;
    let e = plan(&o, &Request::default()).unwrap_err();
    assert!(matches!(e, PlanError::OffSensor { view: View::Minus, .. }), "{e}");
    let bad = Request { sigma_px: [0.0, 0.1], ..Request::default() };
    assert!(matches!(plan(&thesis(), &bad), Err(PlanError::Request { field: "sigma of u", .. })));
    let bad = Request { heights_mm: [1.0, f64::NAN], ..Request::default() };
    assert!(matches!(plan(&thesis(), &bad), Err(PlanError::Request { .. })));
    // a grating so fine that the order is lost beyond 0.0165 rad on one side
    let mut o = thesis();
    for g in [&mut o.minus, &mut o.plus] {
        g.pitch_mm = 633e-6 / 0.99;
    }
    o.grating_to_reference_mm = 2.0;
    o.camera.principal_point_px[0] = 950.0;
    let p = plan(&o, &Request { heights_mm: [0.0, 0.0], ..Request::default() }).unwrap();
    let lost = p.warnings.iter().any(|w| matches!(w, Warning::NoOrder { view: View::Minus, .. }));
    assert!(lost, "{:?}", p.warnings);
}
