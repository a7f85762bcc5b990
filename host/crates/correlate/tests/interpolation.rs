//! Systematic errors of the interpolating splines at sub-pixel displacements.

mod common;
use common::*;
use daic_correlate::*;

/// Bias of u and v of every interpolation and solver over the image less `margin` pixels, 33×33
/// affine, printed with the scatter.
fn biases(what: &str, (a, b): (&Image, &Image), step: usize, truth: f64) -> Vec<(Interpolation, f64)> {
    const MARGIN: usize = 40;
    let (width, height) = (a.width(), a.height());
    let rectangle =
        Rectangle { x: MARGIN, y: MARGIN, width: width - 2 * MARGIN, height: height - 2 * MARGIN };
    let roi = Roi { rectangle: Some(rectangle), mask: None };
    let reference = Reference::new(a.clone());
    let mut out = Vec::new();
    for interpolation in [Interpolation::Quintic, Interpolation::Septic] {
        let target = Target::new(b.clone(), interpolation);
        for solver in [SolverChoice::Exact, SolverChoice::Auto] {
            let settings = Settings { interpolation, solver, ..Settings::default() };
            let points = Points::grid(width, height, settings.subset, step, &roi).unwrap();
            let c = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
            assert_eq!(c.converged(), points.len(), "{what} {interpolation:?} {solver:?}");
            let (u, v) = errors(&c.points, |_, _| (truth, 0.0));
            let ((bu, su), (bv, sv)) = (mean_std(&u), mean_std(&v));
            println!("{what} {interpolation:?} {solver:?}: u {bu:.2e} ± {su:.1e}, v {bv:.2e} ± {sv:.1e}");
            out.push((interpolation, bu.abs().max(bv.abs())));
        }
    }
    out
}

#[test]
fn bias_at_every_tenth_of_a_pixel() {
    const N: usize = 200;
    let s = Speckles::new(5, N, N);
    let a = image(N, N, &s.image(N, N, |_, _| (0.0, 0.0)));
    for k in 1..10 {
        let u = f64::from(k) / 10.0;
        let b = image(N, N, &s.image(N, N, |_, _| (u, 0.0)));
        for (interpolation, bias) in biases(&format!("{u} px"), (&a, &b), 6, u) {
            let limit = if interpolation == Interpolation::Septic { 5e-5 } else { 1.5e-4 };
            assert!(bias <= limit, "{interpolation:?} at {u} px: {bias}");
        }
    }
}

#[test]
fn bias_of_quantised_images() {
    let Some(dir) = shared("bias_of_quantised_images", "golden/dic") else {
        return;
    };
    let a = load(&dir.join("s1024_n0_ref.png"));
    for (case, u) in [("t02", 0.2), ("t05", 0.5)] {
        let b = load(&dir.join(format!("s1024_n0_{case}.png")));
        for (interpolation, bias) in biases(case, (&a, &b), 8, u) {
            let limit = if interpolation == Interpolation::Septic { 5e-5 } else { 1.5e-4 };
            assert!(bias <= limit, "{interpolation:?} {case}: {bias}");
        }
    }
}
