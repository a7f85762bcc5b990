//! Subsets cut by a mask or by the image's edge use what is inside, and nothing else.

#![allow(clippy::needless_range_loop)] // pixel by pixel

mod common;
use common::*;
use daic_correlate::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const N: usize = 160;

fn field(x: f64, y: f64) -> (f64, f64) {
    let (x, y) = (x - 80.0, y - 80.0);
    (0.4 + 0.01 * x - 0.005 * y, -0.7 + 0.008 * x + 0.012 * y)
}

/// The disc of radius 52 px about (80, 80).
fn disc() -> Mask {
    let inside = |k: usize| ((k % N) as f64 - 80.0).hypot((k / N) as f64 - 80.0) <= 52.0;
    Mask::new(N, N, (0..N * N).map(inside).collect()).unwrap()
}

fn run(a: &[f64], b: &[f64], points: &Points, settings: &Settings) -> Correlation {
    let reference = Reference::new(image(N, N, a));
    let target = Target::new(image(N, N, b), settings.interpolation);
    correlate(&reference, &target, points, &Guess::Fft, settings, &()).unwrap()
}

#[test]
fn subsets_cut_by_a_mask_use_what_is_inside() {
    // the disc moves, everything around it is unrelated; a rim of 4 px keeps the spline clear of it
    let (s, other, another) = (Speckles::new(40, N, N), Speckles::new(41, N, N), Speckles::new(42, N, N));
    let moved = s.image(N, N, field);
    let within = |x: f64, y: f64| (x - 80.0).hypot(y - 80.0) <= 57.0;
    let (mut a, mut b) = (Vec::new(), Vec::new());
    for k in 0..N * N {
        let (x, y) = ((k % N) as f64, (k / N) as f64);
        a.push(if within(x, y) { s.at(x, y) } else { other.at(x, y) });
        let d = field(x, y);
        b.push(if within(x - d.0, y - d.1) { moved[k] } else { another.at(x, y) });
    }
    let mask = disc();
    let roi = Roi { rectangle: None, mask: Some(&mask) };
    for (shape, subset) in [(Shape::Affine, 33), (Shape::Affine, 21), (Shape::Quadratic, 27)] {
        // to the fixed point: both runs come to a point from different neighbours
        let solver = SolverChoice::Exact;
        let settings = Settings { subset, shape, solver, tolerance: 1e-6, ..Settings::default() };
        let whole = Points::grid(N, N, subset, 5, &roi).unwrap();
        let cut = Points::grid_cut(N, N, subset, 5, &roi, 0.5).unwrap();
        let c = run(&a, &b, &cut, &settings);
        let e = errors(&c.points, field);
        let worst = e.0.iter().chain(&e.1).fold(0.0f64, |m, v| m.max(v.abs()));
        println!("{shape:?} {subset}: {} whole, {} cut, worst {worst:.2e}", whole.len(), cut.len());
        assert!(cut.len() > whole.len() + whole.len() / 2);
        // half a quadratic subset of 27 px is little
        assert!(c.converged() * 100 >= cut.len() * 98, "{}", c.converged());
        assert!(worst < if shape == Shape::Quadratic { 3e-2 } else { 2.5e-3 }, "{worst}");
        // whole subsets are what they are without cut ones
        let w = run(&a, &b, &whole, &settings);
        for p in &w.points {
            let q = c.points.iter().find(|q| (q.x, q.y) == (p.x, p.y)).unwrap();
            assert!((p.u - q.u).abs() < 2e-5 && (p.v - q.v).abs() < 2e-5, "{p:?} {q:?}");
        }
        // not cut, the same subsets go wrong or fail
        let positions = cut.positions().to_vec();
        let plain = Settings { discontinuities: false, ..settings.clone() };
        let free = run(&a, &b, &Points::scattered(positions).unwrap(), &plain);
        let e = errors(&free.points, field);
        assert!(e.0.iter().chain(&e.1).filter(|v| v.abs() > 0.02).count() > 20);
    }
}

#[test]
fn subsets_reach_the_edge_of_the_image() {
    let s = Speckles::new(43, N, N);
    let (a, b) = (s.image(N, N, |_, _| (0.0, 0.0)), s.image(N, N, field));
    let settings = Settings::default();
    let points = Points::grid_cut(N, N, 33, 5, &Roi::default(), 0.25).unwrap();
    assert_eq!(points.positions()[0], [5.0, 5.0]);
    let c = run(&a, &b, &points, &settings);
    for p in &c.points {
        let t = field(p.x, p.y);
        // the used pixels stay 4 px clear of the edge in the reference, not in the deformed image
        let near = |c: f64| c < 8.0 || c > N as f64 - 9.0;
        if p.status.is_ok() {
            assert!((p.u - t.0).hypot(p.v - t.1) < 0.01, "{p:?}");
        } else {
            assert!(near(p.x) || near(p.y), "{p:?}");
        }
    }
    assert!(c.converged() * 100 >= points.len() * 95, "{} of {}", c.converged(), points.len());
}

#[test]
fn scalar_reference_agrees_and_threads_do_not_matter() {
    let s = Speckles::new(44, N, N);
    let (a, b) = (s.image(N, N, |_, _| (0.0, 0.0)), s.image(N, N, field));
    let (reference, target) =
        (Reference::new(image(N, N, &a)), Target::new(image(N, N, &b), Interpolation::Quintic));
    let settings = Settings { tolerance: 1e-5, ..Settings::default() };
    let points = Points::scattered((0..40).map(|k| [30.0 + 2.5 * f64::from(k), 38.3]).collect())
        .unwrap()
        .within(&disc(), 0.4)
        .unwrap();
    let fast = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
    let slow = correlate_scalar(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
    let mut outside = 0;
    for (p, q) in fast.points.iter().zip(&slow.points) {
        assert_eq!(p.status, q.status);
        outside += usize::from(p.status == Status::OutOfImage);
        if p.status.is_ok() {
            assert!((p.u - q.u).abs() < 2e-5 && (p.v - q.v).abs() < 2e-5);
            assert!((p.sigma_u - q.sigma_u).abs() < 1e-4);
        }
    }
    assert!(outside > 3 && fast.converged() > 20, "{outside} {}", fast.converged());
    let once = |threads| {
        with_threads(threads, || {
            let c = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
            format!("{:?}", c.points)
        })
    };
    assert_eq!(once(1), once(3));
}

#[test]
fn sigma_of_cut_subsets_predicts_their_scatter() {
    const REPEATS: u64 = 120;
    let s = Speckles::new(45, N, N);
    let (a, b) = (s.image(N, N, |_, _| (0.0, 0.0)), s.image(N, N, |_, _| (0.5, 0.27)));
    // points 3 px inside the rim: about half of each subset is left
    let ring = (0..24).map(|k| f64::from(k) * std::f64::consts::TAU / 24.0);
    let xy: Vec<[f64; 2]> = ring.map(|t| [80.0 + 49.0 * t.cos(), 80.0 + 49.0 * t.sin()]).collect();
    let points = Points::scattered(xy).unwrap().within(&disc(), 0.4).unwrap();
    let settings = Settings::default();
    let guess = vec![Some([0.5, 0.27]); points.len()];
    let (mut seen, mut said) = (0.0, 0.0);
    let mut found: Vec<(Vec<f64>, Vec<f64>)> = vec![Default::default(); points.len()];
    println!("noise seeds 0..{REPEATS}");
    for seed in 0..REPEATS {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let reference = Reference::new(image(N, N, &noisy(&a, 2.0, &mut rng)));
        let target = Target::new(image(N, N, &noisy(&b, 2.0, &mut rng)), Interpolation::Quintic);
        let c = correlate(&reference, &target, &points, &Guess::Given(&guess), &settings, &()).unwrap();
        for (p, f) in c.points.iter().zip(&mut found) {
            assert!(p.status.is_ok(), "{p:?}");
            f.0.push(p.u);
            f.1.push(p.v);
            said += f64::from(p.sigma_u).powi(2) + f64::from(p.sigma_v).powi(2);
        }
    }
    for f in &found {
        seen += (mean_std(&f.0).1.powi(2) + mean_std(&f.1).1.powi(2)) * REPEATS as f64;
    }
    let ratio = (said / seen).sqrt();
    println!("said/seen {ratio:.3}");
    // 48 numbers × 120 repeats leave about 2 % of chance
    assert!((ratio - 1.0).abs() < 0.08, "{ratio}");
}

#[test]
fn unusable_shares_and_masks_are_refused() {
    let mask = disc();
    let roi = Roi { rectangle: None, mask: Some(&mask) };
    for share in [0.0, 1.5, -1.0, f64::NAN] {
        assert!(matches!(Points::grid_cut(N, N, 33, 5, &roi, share), Err(PointsError::MinInside { .. })));
    }
    assert!(matches!(Points::grid_cut(100, N, 33, 5, &roi, 0.5), Err(PointsError::MaskSize { .. })));
    assert!(matches!(Points::grid_cut(N, N, 33, 0, &roi, 0.5), Err(PointsError::ZeroStep)));
    let speck = Mask::new(N, N, (0..N * N).map(|k| k == 80 * N + 80).collect()).unwrap();
    let roi = Roi { rectangle: None, mask: Some(&speck) };
    assert!(matches!(Points::grid_cut(N, N, 33, 1, &roi, 0.5), Err(PointsError::Empty { subset: 33 })));
    // a mask of another size than the images
    let blank = Image::from_u8(100, N, &[9; 100 * N]).unwrap();
    let (reference, target) = (Reference::new(blank.clone()), Target::new(blank, Interpolation::Quintic));
    let points = Points::scattered(vec![[50.0, 50.0]]).unwrap().within(&mask, 0.5).unwrap();
    let c = correlate(&reference, &target, &points, &Guess::Fft, &Settings::default(), &());
    assert!(matches!(c, Err(CorrelateError::MaskSize { mask_width: N, width: 100, .. })));
}
