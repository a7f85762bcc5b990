//! Against the golden images: analytic deformed speckles and ray-traced frames made elsewhere.

mod common;
use common::*;
use daic_correlate::*;
use std::path::Path;

/// 33×33, affine, quintic, margin 40, as the published figures.
fn correlate_case(dir: &Path, noise: &str, case: &str, step: usize, shape: Shape) -> Correlation {
    let settings = Settings { shape, ..Settings::default() };
    let read = |name: &str| load(&dir.join(format!("s1024_{noise}_{name}.png")));
    let reference = Reference::new(read("ref"));
    let target = Target::new(read(case), settings.interpolation);
    let roi = Roi { rectangle: Some(Rectangle { x: 40, y: 40, width: 944, height: 944 }), mask: None };
    let points = Points::grid(1024, 1024, settings.subset, step, &roi).unwrap();
    correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap()
}

#[test]
fn translation_at_the_noise_limit() {
    let Some(dir) = shared("translation_at_the_noise_limit", "golden/dic") else {
        return;
    };
    // Cramér–Rao bounds: 6.5e-4 (quantisation) and 4.55e-3 px (noise of 2 grey levels)
    // the mean over some 800 independent subsets is itself known to 4.5e-3 / √800 = 1.6e-4 at n2
    for (noise, bias, scatter) in [("n0", 1.5e-4, 6.9e-4), ("n2", 4e-4, 4.8e-3)] {
        let c = correlate_case(&dir, noise, "t02", 5, Shape::Affine);
        assert_eq!(c.points.len(), 35721);
        assert_eq!(c.converged(), 35721);
        let (u, v) = errors(&c.points, |_, _| (0.2, 0.0));
        let said: f64 =
            c.points.iter().map(|p| f64::from(p.sigma_u).powi(2)).sum::<f64>() / c.points.len() as f64;
        let (mean_u, std_u) = mean_std(&u);
        let (mean_v, std_v) = mean_std(&v);
        println!(
            "{noise}: u {mean_u:.2e} ± {std_u:.2e}, v {mean_v:.2e} ± {std_v:.2e}, sigma_u {:.2e}",
            said.sqrt()
        );
        assert!(mean_u.abs() <= bias && mean_v.abs() <= bias);
        assert!(std_u <= scatter && std_v <= scatter);
        // sigma predicts the scatter
        assert!((said.sqrt() / std_u - 1.0).abs() < 0.10);
    }
}

#[test]
fn deformed_fields() {
    let Some(dir) = shared("deformed_fields", "golden/dic") else {
        return;
    };
    let centre = 511.5;
    let affine = move |x: f64, y: f64| {
        let (x, y) = (x - centre, y - centre);
        (0.01 * x + 0.002 * y, 0.002 * x - 0.003 * y)
    };
    let c = correlate_case(&dir, "n0", "aff1", 10, Shape::Affine);
    assert_eq!(c.converged(), c.points.len());
    let (u, v) = errors(&c.points, affine);
    let ((bu, su), (bv, sv)) = (mean_std(&u), mean_std(&v));
    println!("aff1: {bu:.2e} ± {su:.2e}, {bv:.2e} ± {sv:.2e}");
    assert!(bu.abs() < 1e-4 && bv.abs() < 1e-4 && su < 6.9e-4 && sv < 6.9e-4);

    let quad = move |x: f64, y: f64| {
        let (x, y) = (x - centre, y - centre);
        let (a, b, c) = (4e-5, 1e-5, -2e-5);
        (a * x * x + b * x * y + c * y * y, 0.5 * (a * y * y + b * x * y + c * x * x))
    };
    let c = correlate_case(&dir, "n0", "quad", 10, Shape::Quadratic);
    assert!(c.converged() >= c.points.len() * 999 / 1000);
    let (u, v) = errors(&c.points, quad);
    let ((bu, su), (bv, sv)) = (mean_std(&u), mean_std(&v));
    println!("quad: {bu:.2e} ± {su:.2e}, {bv:.2e} ± {sv:.2e}");
    // a quadratic subset scatters about twice as much as an affine one
    assert!(bu.abs() < 1.5e-4 && bv.abs() < 1.5e-4 && su < 1.5e-3 && sv < 1.5e-3);
}

#[test]
fn steps_waves_and_the_star_are_followed() {
    let Some(dir) = shared("steps_waves_and_the_star_are_followed", "golden/dic") else {
        return;
    };
    let tau = std::f64::consts::TAU;
    let c = correlate_case(&dir, "n0", "sin60", 10, Shape::Affine);
    // period 1.8 subsets: attenuated, but every point follows the wave
    let (u, _) = errors(&c.points, |x, y| (0.5 * (tau * x / 60.0).sin(), 0.5 * (tau * y / 60.0).sin()));
    let (bias, scatter) = mean_std(&u);
    println!("sin60: {} of {} ok, {bias:.2e} ± {scatter:.3}", c.converged(), c.points.len());
    assert!(c.converged() >= c.points.len() * 99 / 100);
    assert!(bias.abs() < 5e-3 && scatter < 0.17);

    let c = correlate_case(&dir, "n0", "step", 10, Shape::Affine);
    for p in &c.points {
        // subsets clear of the jump
        if (p.y - 511.5).abs() > 17.0 {
            let truth = if p.y > 511.5 { 1.0 } else { -1.0 };
            assert!(p.status.is_ok(), "{p:?}");
            assert!((p.u - truth).abs() < 6e-3, "{p:?}");
        }
    }

    let c = correlate_case(&dir, "n0", "star", 10, Shape::Affine);
    let slow: Vec<f64> = c
        .points
        .iter()
        .filter(|p| p.x > 900.0)
        .map(|p| {
            assert!(p.status.is_ok());
            let period = 10.0 + 140.0 * p.x / 1023.0;
            p.v - 0.5 * (tau * (p.y - 511.5) / period).cos()
        })
        .collect();
    let (bias, scatter) = mean_std(&slow);
    println!("star, x > 900: {bias:.2e} ± {scatter:.2e}");
    assert!(scatter < 0.05);
}

#[test]
fn the_other_view_is_found_in_the_same_frame() {
    let name = "the_other_view_is_found_in_the_same_frame";
    let Some(dir) = shared(name, "golden/daic") else {
        return;
    };
    let frame = load(&dir.join("cylinder.png"));
    let views = find_views(&frame).unwrap();
    let reference = Reference::new(frame.clone());
    let target = Target::new(frame.clone(), Interpolation::Quintic);
    for (subset, shape) in
        [(33, Shape::Affine), (59, Shape::Affine), (33, Shape::Quadratic), (59, Shape::Quadratic)]
    {
        let settings = Settings { subset, shape, ..Settings::default() };
        let roi = Roi { rectangle: Some(views.minus.bounds), mask: Some(&views.minus.mask) };
        let points = Points::grid(2592, 1944, subset, 10, &roi).unwrap();
        let guess = Guess::Search { u: (1500.0, 2100.0), v: (-4.0, 4.0) };
        let c = correlate(&reference, &target, &points, &guess, &settings, &()).unwrap();
        // the disparity of this frame is at most 1804 px: further right the +1 view is cut off
        let limit = 2591.0 - 1804.0 - settings.radius() as f64;
        let both: Vec<&Point> = c.points.iter().filter(|p| p.x <= limit).collect();
        let ok = both.iter().filter(|p| p.status.is_ok()).count();
        println!("{subset} {shape:?}: {ok} of {}", both.len());
        assert!(ok * 100 >= both.len() * 99);
        for p in both.iter().filter(|p| p.status.is_ok()) {
            assert!((1735.0..1810.0).contains(&p.u) && p.v.abs() < 4.0, "{p:?}");
        }
    }
}

#[test]
fn views_of_all_frames() {
    let Some(dir) = shared("views_of_all_frames", "golden/daic") else {
        return;
    };
    for name in ["cylinder", "flat", "flat_up"] {
        let views = find_views(&load(&dir.join(format!("{name}.png")))).unwrap();
        for (view, x) in [(&views.minus, 0), (&views.plus, 1768)] {
            let b = view.bounds;
            println!("{name}: {b:?}");
            // looked up in the pictures, to two blocks
            assert!(b.x.abs_diff(x) <= 8 && b.width.abs_diff(824) <= 8, "{b:?}");
            assert!(b.y.abs_diff(540) <= 8 && b.height.abs_diff(864) <= 8, "{b:?}");
            // solid: the specimens are squares
            assert!(view.mask.count() as f64 > 0.99 * (b.width * b.height) as f64);
        }
    }
}
