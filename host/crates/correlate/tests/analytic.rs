//! Against analytic speckle images, which are evaluated and never interpolated.

mod common;
use common::*;
use daic_correlate::*;

const N: usize = 160;

fn run(
    reference: Image,
    target: Image,
    points: &Points,
    guess: &Guess<'_>,
    settings: &Settings,
) -> Correlation {
    let reference = Reference::new(reference);
    let target = Target::new(target, settings.interpolation);
    correlate(&reference, &target, points, guess, settings, &()).unwrap()
}

fn grid(settings: &Settings, step: usize, margin: usize) -> Points {
    let rectangle = Some(Rectangle { x: margin, y: margin, width: N - 2 * margin, height: N - 2 * margin });
    let roi = Roi { rectangle, mask: None };
    Points::grid(N, N, settings.subset, step, &roi).unwrap()
}

fn worst(e: &(Vec<f64>, Vec<f64>)) -> f64 {
    e.0.iter().chain(&e.1).fold(0.0, |m, v| m.max(v.abs()))
}

fn pair(seed: u64, u: impl Fn(f64, f64) -> (f64, f64) + Copy) -> (Image, Image) {
    let s = Speckles::new(seed, N, N);
    (image(N, N, &s.image(N, N, |_, _| (0.0, 0.0))), image(N, N, &s.image(N, N, u)))
}

#[test]
fn translation_is_found_by_every_interpolation_and_shape() {
    let truth = |_: f64, _: f64| (2.3, -1.4);
    let (a, b) = pair(1, truth);
    // largest error seen: the interpolation error of the spline on blobs of σ ≥ 1.6 px
    for (interpolation, tolerance) in [(Interpolation::Quintic, 1.0e-3), (Interpolation::Cubic, 6e-3)] {
        for shape in [Shape::Translation, Shape::Affine, Shape::Quadratic] {
            let settings = Settings { subset: 25, shape, interpolation, ..Settings::default() };
            let points = grid(&settings, 7, 20);
            let c = run(a.clone(), b.clone(), &points, &Guess::Fft, &settings);
            assert_eq!(c.converged(), points.len());
            let e = worst(&errors(&c.points, truth));
            println!("{interpolation:?} {shape:?}: {e:.2e} px");
            assert!(e < tolerance, "{interpolation:?} {shape:?}: {e}");
        }
    }
}

#[test]
fn affine_field_and_its_gradients() {
    let field = |x: f64, y: f64| {
        let (x, y) = (x - 80.0, y - 80.0);
        (0.4 + 0.02 * x - 0.01 * y, -0.7 + 0.015 * x + 0.03 * y)
    };
    let (a, b) = pair(2, field);
    let settings = Settings::default();
    let points = grid(&settings, 8, 24);
    let c = run(a, b, &points, &Guess::Fft, &settings);
    assert_eq!(c.converged(), points.len());
    let e = worst(&errors(&c.points, field));
    println!("{e:.2e} px");
    assert!(e < 5e-4, "{e}");
    for p in &c.points {
        for (found, expected) in
            [(p.shape.u[1], 0.02), (p.shape.u[2], -0.01), (p.shape.v[1], 0.015), (p.shape.v[2], 0.03)]
        {
            assert!((f64::from(found) - expected).abs() < 1e-4);
        }
        assert_eq!(p.shape.u[3..], [0.0; 3]);
    }
}

#[test]
fn quadratic_field_needs_the_quadratic_shape() {
    let field = |x: f64, y: f64| {
        let (x, y) = (x - 80.0, y - 80.0);
        (0.3 + 4e-4 * x * x - 2e-4 * x * y, -0.2 + 1e-4 * x * x + 3e-4 * y * y)
    };
    let (a, b) = pair(3, field);
    let mut settings = Settings { shape: Shape::Quadratic, ..Settings::default() };
    let points = grid(&settings, 8, 24);
    let c = run(a.clone(), b.clone(), &points, &Guess::Fft, &settings);
    assert_eq!(c.converged(), points.len());
    let e = worst(&errors(&c.points, field));
    println!("{e:.2e} px");
    assert!(e < 1.5e-3, "{e}");
    for p in &c.points {
        assert!((p.shape.u[3] - 8e-4).abs() < 1e-4, "{}", p.shape.u[3]);
        assert!((p.shape.u[4] + 2e-4).abs() < 1e-4, "{}", p.shape.u[4]);
        assert!((p.shape.v[5] - 6e-4).abs() < 1e-4, "{}", p.shape.v[5]);
    }
    // the affine subset is off by about w²/24 ∇²u = 33²/24 · 8e-4 = 0.036 px
    settings.shape = Shape::Affine;
    let c = run(a, b, &points, &Guess::Fft, &settings);
    let (eu, _) = errors(&c.points, field);
    let (bias, _) = mean_std(&eu);
    assert!((bias - 0.036).abs() < 0.008, "{bias}");
}

#[test]
fn scattered_points_are_answered_at_their_own_position() {
    let field = |x: f64, y: f64| (1.0 + 0.04 * (x - 80.0), 0.5 - 0.03 * (x - 80.0) + 0.02 * (y - 80.0));
    let (a, b) = pair(4, field);
    let xy: Vec<[f64; 2]> = (0..200)
        .map(|k| {
            let k = f64::from(k);
            [30.0 + (k * 7.37) % 100.0, 30.0 + (k * 3.91) % 100.0]
        })
        .collect();
    let points = Points::scattered(xy.clone()).unwrap();
    let settings = Settings::default();
    let c = run(a, b, &points, &Guess::Fft, &settings);
    assert_eq!(c.converged(), points.len());
    for (p, q) in c.points.iter().zip(&xy) {
        assert_eq!([p.x, p.y], *q);
    }
    // evaluated at the centre pixel instead, the error would reach 0.5 · 0.04 = 0.02 px
    let e = worst(&errors(&c.points, field));
    println!("{e:.2e} px");
    assert!(e < 1e-3, "{e}");
}

#[test]
fn brightness_and_contrast_do_not_matter() {
    let truth = |_: f64, _: f64| (0.4, 0.3);
    let s = Speckles::new(5, N, N);
    let a = s.image(N, N, |_, _| (0.0, 0.0));
    let b: Vec<f64> = s.image(N, N, truth).iter().map(|g| 0.4 * g + 55.0).collect();
    let settings = Settings::default();
    let points = grid(&settings, 9, 20);
    let c = run(image(N, N, &a), image(N, N, &b), &points, &Guess::Fft, &settings);
    assert_eq!(c.converged(), points.len());
    let e = worst(&errors(&c.points, truth));
    assert!(e < 1e-3, "{e}");
}

#[test]
fn rotation_beyond_the_fast_sampler() {
    // 12°: gradients of 0.21, every pixel is interpolated by itself
    let (s, c) = 12f64.to_radians().sin_cos();
    let field = move |x: f64, y: f64| {
        let (x, y) = (x - 80.0, y - 80.0);
        (c * x - s * y - x, s * x + c * y - y)
    };
    let (a, b) = pair(6, field);
    let settings = Settings::default();
    let points = grid(&settings, 8, 40);
    let guess: Vec<Option<[f64; 2]>> = points
        .positions()
        .iter()
        .enumerate()
        .map(|(k, p)| {
            // only the middle is given, the rest must be reached from there
            let (u, v) = field(p[0], p[1]);
            (k == points.len() / 2).then_some([u + 0.4, v - 0.3])
        })
        .collect();
    let r = run(a, b, &points, &Guess::Given(&guess), &settings);
    assert_eq!(r.converged(), points.len());
    let e = worst(&errors(&r.points, field));
    println!("{e:.2e} px");
    assert!(e < 1e-3, "{e}");
}

#[test]
fn shift_of_nearly_half_the_image_and_search_along_a_range() {
    let truth = |_: f64, _: f64| (-61.7, 3.3);
    let (a, b) = pair(7, truth);
    let settings = Settings { subset: 21, ..Settings::default() };
    let rectangle = Some(Rectangle { x: 80, y: 12, width: 68, height: 130 });
    let roi = Roi { rectangle, mask: None };
    let points = Points::grid(N, N, 21, 6, &roi).unwrap();
    for guess in [Guess::Fft, Guess::Search { u: (-90.0, -40.0), v: (-5.0, 5.0) }] {
        let c = run(a.clone(), b.clone(), &points, &guess, &settings);
        assert_eq!(c.converged(), points.len(), "{guess:?}");
        let e = worst(&errors(&c.points, truth));
        assert!(e < 1.5e-3, "{e}");
    }
}

#[test]
fn a_jump_is_crossed_and_a_failed_region_does_not_spoil_the_rest() {
    // the right third is painted over in the deformed image
    let truth = |_: f64, y: f64| (if y > 80.0 { 1.0 } else { -1.0 }, 0.0);
    let s = Speckles::new(8, N, N);
    let a = s.image(N, N, |_, _| (0.0, 0.0));
    let mut b = Vec::new();
    for y in 0..N {
        for x in 0..N {
            let shift = if y > 80 { 1.0 } else { -1.0 };
            b.push(if x > 110 { 90.0 } else { s.at(x as f64 - shift, y as f64) });
        }
    }
    let settings = Settings { subset: 21, ..Settings::default() };
    let points = grid(&settings, 4, 12);
    let c = run(image(N, N, &a), image(N, N, &b), &points, &Guess::Fft, &settings);
    for p in &c.points {
        let clear = (p.y - 80.5).abs() > 11.0;
        if p.x < 97.0 && clear {
            assert!(p.status.is_ok(), "{p:?}");
            assert!((p.u - truth(p.x, p.y).0).abs() < 3e-3, "{p:?}");
        }
        if p.x > 122.0 {
            assert!(!p.status.is_ok(), "{p:?}");
        }
    }
}

#[test]
fn same_bits_for_any_number_of_threads() {
    let field = |x: f64, y: f64| (0.3 + 0.01 * (x - 80.0), 0.02 * (y - 80.0));
    let (a, b) = pair(9, field);
    let settings = Settings { subset: 21, ..Settings::default() };
    let points = grid(&settings, 3, 12);
    let once = |threads| {
        with_threads(threads, || {
            let c = run(a.clone(), b.clone(), &points, &Guess::Fft, &settings);
            format!("{:?}", c.points)
        })
    };
    let one = once(1);
    assert_eq!(one, once(2));
    assert_eq!(one, once(5));
}

#[test]
fn vector_kernels_agree_with_the_scalar_reference() {
    let field = |x: f64, y: f64| {
        let (x, y) = (x - 80.0, y - 80.0);
        (0.3 + 0.01 * x - 0.004 * y + 1e-4 * x * x, -0.45 + 0.02 * y)
    };
    let (a, b) = pair(10, field);
    let reference = Reference::new(a);
    for (interpolation, shape, subset) in [
        (Interpolation::Quintic, Shape::Affine, 33),
        (Interpolation::Quintic, Shape::Quadratic, 33),
        (Interpolation::Quintic, Shape::Quadratic, 21),
        (Interpolation::Quintic, Shape::Translation, 25),
        (Interpolation::Cubic, Shape::Affine, 19),
        (Interpolation::Cubic, Shape::Quadratic, 41),
    ] {
        // the scalar form solves every point by itself
        let solver = SolverChoice::Exact;
        let settings =
            Settings { subset, shape, interpolation, solver, tolerance: 1e-5, ..Settings::default() };
        let target = Target::new(b.clone(), interpolation);
        let points = grid(&settings, 20, 30);
        let fast = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
        let slow = correlate_scalar(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
        for (p, q) in fast.points.iter().zip(&slow.points) {
            assert_eq!(p.status, q.status);
            // single precision over the subset: a few 1e-6 px, more where twelve parameters share
            assert!((p.u - q.u).abs() < 2e-5, "{shape:?} {subset}: {} {}", p.u, q.u);
            assert!((p.v - q.v).abs() < 2e-5);
            assert!((p.zncc - q.zncc).abs() < 1e-5);
            // both are about zero: there is no noise in these images
            assert!((p.sigma_u - q.sigma_u).abs() < 1e-4);
        }
    }
}
