//! The dense form: where it answers, that its memory may be used for anything, that threads do not matter.

mod common;

use common::{Speckles, image, noisy, with_threads};
use daic_correlate::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const WIDTH: usize = 420;
const HEIGHT: usize = 320;

/// A pair displaced by `u`, with noise of one grey level.
fn pair(width: usize, height: usize, u: impl Fn(f64, f64) -> (f64, f64)) -> (Image, Image) {
    pair_with(1.0, width, height, u)
}

fn pair_with(noise: f64, width: usize, height: usize, u: impl Fn(f64, f64) -> (f64, f64)) -> (Image, Image) {
    let s = Speckles::new(41, width, height);
    let mut rng = ChaCha8Rng::seed_from_u64(41);
    let mut seen = |u: &dyn Fn(f64, f64) -> (f64, f64)| {
        image(width, height, &noisy(&s.image(width, height, u), noise, &mut rng))
    };
    let reference = seen(&|_, _| (0.0, 0.0));
    (reference, seen(&u))
}

fn smooth(x: f64, y: f64) -> (f64, f64) {
    (0.4 + 0.004 * x - 0.002 * y, -0.3 + 0.003 * y)
}

fn bits(c: &Correlation) -> String {
    format!("{:?}", c.points)
}

#[test]
fn smooth_fields_are_solved_by_it() {
    let (a, b) = pair(WIDTH, HEIGHT, smooth);
    let (reference, target) = (Reference::new(a), Target::new(b, Interpolation::Quintic));
    for (shape, subset) in [(Shape::Affine, 33), (Shape::Affine, 55), (Shape::Quadratic, 41)] {
        // remainders of a subset by the step: some, none
        for step in [5, 11, subset] {
            let settings = Settings { shape, subset, ..Settings::default() };
            let points = Points::grid(WIDTH, HEIGHT, subset, step, &Roi::default()).unwrap();
            let auto = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
            let exact = Settings { solver: SolverChoice::Exact, ..settings.clone() };
            let exact = correlate(&reference, &target, &points, &Guess::Fft, &exact, &()).unwrap();
            let dense = auto.points.iter().filter(|p| p.solver == SolvedBy::Dense).count();
            println!("{shape:?} {subset}/{step}: {dense} of {} dense", points.len());
            // a subset must hold two steps
            let expected = 2 * step <= subset;
            assert_eq!(dense * 10 >= 9 * points.len(), expected, "{dense} of {}", points.len());
            assert!(expected || dense == 0);
            for (p, q) in auto.points.iter().zip(&exact.points) {
                assert!(p.status.is_ok() && q.status.is_ok());
                // what is neglected is bounded by a fifth of σ
                assert!((p.u - q.u).abs() < 0.2 * f64::from(q.sigma_u), "{p:?} {q:?}");
                assert!((p.v - q.v).abs() < 0.2 * f64::from(q.sigma_v), "{p:?} {q:?}");
                // the dense form's σ comes from single precision and a linearised residual
                assert!((p.sigma_u / q.sigma_u - 1.0).abs() < 0.02, "{} {}", p.sigma_u, q.sigma_u);
                assert!((p.sigma_v / q.sigma_v - 1.0).abs() < 0.02, "{} {}", p.sigma_v, q.sigma_v);
            }
        }
    }
}

#[test]
fn a_workspace_may_be_used_for_anything() {
    let (a, b) = pair(204, 204, smooth);
    let (c, d) = pair(260, 190, |x, y| (1.5 - 0.002 * y, 0.003 * x));
    let first = (Reference::new(a), Target::new(b, Interpolation::Quintic));
    let second = (Reference::new(c), Target::new(d, Interpolation::Quintic));
    let rectangle = Some(Rectangle { x: 30, y: 41, width: 130, height: 120 });
    let part = Roi { rectangle, mask: None };
    let whole = Roi::default();
    let grid = |n: (usize, usize), step, roi| Points::grid(n.0, n.1, 33, step, roi).unwrap();
    let cut = |n: (usize, usize), step| Points::grid_cut(n.0, n.1, 33, step, &whole, 0.4).unwrap();
    let (small, wide) = ((204, 204), (260, 190));
    let runs = [
        // the same tiles of whole subsets, at another place of the grid
        (&first, grid(small, 10, &whole), Shape::Affine),
        (&first, cut(small, 10), Shape::Affine),
        (&first, grid(small, 10, &whole), Shape::Affine),
        (&first, grid(small, 5, &part), Shape::Quadratic),
        (&second, grid(wide, 5, &whole), Shape::Affine),
        (&second, cut(wide, 5), Shape::Translation),
        (&first, grid(small, 10, &whole), Shape::Quadratic),
        (&second, grid(wide, 5, &whole), Shape::Affine),
    ];
    let mut workspace = Workspace::new();
    for (k, ((reference, target), points, shape)) in runs.iter().enumerate() {
        let settings = Settings { shape: *shape, ..Settings::default() };
        let fresh = correlate(reference, target, points, &Guess::Fft, &settings, &()).unwrap();
        let used = workspace.correlate(reference, target, points, &Guess::Fft, &settings, &()).unwrap();
        assert!(fresh.converged() * 10 >= 9 * points.len(), "run {k}: {}", fresh.converged());
        assert_eq!(bits(&fresh), bits(&used), "run {k}");
    }
}

#[test]
fn threads_do_not_matter_where_some_tiles_need_a_second_pass() {
    // bent on the right alone: its tiles get a second pass, those on the left do not
    let bent = |x: f64, y: f64| {
        let (u, v) = smooth(x, y);
        (u + if x > 260.0 { 4e-4 * (x - 260.0).powi(2) } else { 0.0 }, v)
    };
    // (noise alone would ask for a second pass)
    let (a, b) = pair_with(0.0, WIDTH, HEIGHT, bent);
    let settings = Settings { subset: 21, ..Settings::default() };
    let points = Points::grid(WIDTH, HEIGHT, 21, 2, &Roi::default()).unwrap();
    let once = |threads| {
        with_threads(threads, || {
            let (reference, target) =
                (Reference::new(a.clone()), Target::new(b.clone(), Interpolation::Quintic));
            correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap()
        })
    };
    let one = once(1);
    let passes =
        |n: u16| one.points.iter().filter(|p| p.solver == SolvedBy::Dense && p.iterations == n).count();
    println!("{} and {} of {} points after one and two passes", passes(1), passes(2), points.len());
    assert!(passes(1) > 1000 && passes(2) > 1000);
    assert_eq!(bits(&one), bits(&once(2)));
    assert_eq!(bits(&one), bits(&once(3)));
}

#[test]
fn the_dense_form_alone_is_refused_where_there_is_none() {
    let (a, b) = pair(120, 120, smooth);
    let (reference, target) = (Reference::new(a), Target::new(b, Interpolation::Quintic));
    let settings = Settings { solver: SolverChoice::Dense, ..Settings::default() };
    let run = |points: &Points, settings: &Settings| {
        correlate(&reference, &target, points, &Guess::Fft, settings, &()).map(|c| c.converged())
    };
    let grid = |step| Points::grid(120, 120, 33, step, &Roi::default()).unwrap();
    assert!(run(&grid(8), &settings).unwrap() > 0);
    let refused = |result| matches!(result, Err(CorrelateError::NoDenseForm { .. }));
    assert!(refused(run(&grid(20), &settings)));
    assert!(refused(run(&Points::scattered(vec![[50.0, 50.0]]).unwrap(), &settings)));
    assert!(refused(run(&grid(8), &Settings { criterion: Criterion::Zssd, ..settings.clone() })));
}
