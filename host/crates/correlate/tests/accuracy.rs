//! Bias, scatter and resolution of both solvers.

#![allow(clippy::needless_range_loop)] // arrays of two components

mod common;
#[path = "common/score.rs"]
mod score;
use common::*;
use daic_correlate::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::Path;

/// Scatter allowed beyond the Cramér–Rao bound.
const EXCESS: f64 = 1.05;
/// Cramér–Rao bound of the golden images, 33 × 33, affine, gain and offset free: quantised only,
/// and with noise of 2 grey levels.
const BOUND: [(&str, f64); 2] = [("n0", 6.5e-4), ("n2", 4.55e-3)];
const BOTH: [SolverChoice; 2] = [SolverChoice::Exact, SolverChoice::Auto];

struct Pair {
    reference: Reference,
    target: Target,
}

impl Pair {
    fn golden(dir: &Path, noise: &str, case: &str) -> Self {
        let read = |name: &str| load(&dir.join(format!("s1024_{noise}_{name}.png")));
        Self {
            reference: Reference::new(read("ref")),
            target: Target::new(read(case), Interpolation::Quintic),
        }
    }

    fn of(a: &[f64], b: &[f64], size: usize) -> Self {
        Self {
            reference: Reference::new(image(size, size, a)),
            target: Target::new(image(size, size, b), Interpolation::Quintic),
        }
    }

    /// Every 5 px, 40 px from the edges, as the published figures.
    fn correlate(&self, settings: &Settings) -> Correlation {
        let size = self.reference.image().width();
        let roi = Roi {
            rectangle: Some(Rectangle { x: 40, y: 40, width: size - 80, height: size - 80 }),
            mask: None,
        };
        let points = Points::grid(size, size, settings.subset, 5, &roi).unwrap();
        let c = correlate(&self.reference, &self.target, &points, &Guess::Fft, settings, &()).unwrap();
        assert!(c.converged() * 1000 >= points.len() * 999, "{} of {}", c.converged(), points.len());
        c
    }
}

fn scored(field: &str, size: usize, c: &Correlation) -> Vec<([f64; 4], bool)> {
    assert!(score::truth(field, size, 0.0, 0.0).is_some());
    c.points.iter().map(|p| ([p.x, p.y, p.u, p.v], p.status.is_ok())).collect()
}

fn measure(field: &str, size: usize, c: &Correlation) -> score::Score {
    score::score(field, size, &scored(field, size, c)).unwrap()
}

#[test]
fn translations_and_stretches_are_unbiased_and_at_the_bound() {
    let Some(dir) = shared("translations_and_stretches_are_unbiased_and_at_the_bound", "golden/dic") else {
        return;
    };
    for (noise, bound) in BOUND {
        for case in ["t02", "t05", "aff1"] {
            let pair = Pair::golden(&dir, noise, case);
            for solver in BOTH {
                let c = pair.correlate(&Settings { solver, ..Settings::default() });
                let s = measure(case, 1024, &c);
                println!("{noise} {case} {solver:?}: {}", s.line());
                for k in 0..2 {
                    assert!(s.scatter[k] <= EXCESS * bound, "{:?}", s.scatter);
                    // some 800 subsets beside one another leave the mean at n2 uncertain by
                    // 4.5e-3 / √800 = 1.6e-4: twice that here, and the real test below
                    let limit = if noise == "n0" { 1.5e-4 } else { 3.2e-4 };
                    assert!(s.bias[k].abs() <= limit, "{:?}", s.bias);
                }
            }
        }
    }
}

#[test]
fn quadratic_field_at_the_bound_of_the_quadratic_shape() {
    let Some(dir) = shared("quadratic_field_at_the_bound_of_the_quadratic_shape", "golden/dic") else {
        return;
    };
    for (noise, grey) in [("n0", (1.0f64 / 12.0).sqrt()), ("n2", (4.0f64 + 1.0 / 12.0).sqrt())] {
        let pair = Pair::golden(&dir, noise, "quad");
        for solver in BOTH {
            let settings =
                Settings { shape: Shape::Quadratic, solver, noise: Some(grey), ..Settings::default() };
            let c = pair.correlate(&settings);
            let s = measure("quad", 1024, &c);
            // with the noise given, σ is the bound of each subset
            let bound = [0, 1].map(|k| {
                let squares = |p: &Point| f64::from(if k == 0 { p.sigma_u } else { p.sigma_v }).powi(2);
                let ok: Vec<f64> = c.points.iter().filter(|p| p.status.is_ok()).map(squares).collect();
                (ok.iter().sum::<f64>() / ok.len() as f64).sqrt()
            });
            println!("{noise} quad {solver:?}: {}, bound {:.3e} {:.3e}", s.line(), bound[0], bound[1]);
            for k in 0..2 {
                assert!(s.scatter[k] <= EXCESS * bound[k]);
                // twice the uncertainty of the mean over some 800 subsets, and what n0 may be off
                assert!(s.bias[k].abs() <= 1.5e-4 + 2.0 * s.scatter[k] / 800f64.sqrt(), "{:?}", s.bias);
            }
        }
    }
}

#[test]
fn dense_agrees_with_the_exact_form_iterated_to_the_end() {
    let Some(dir) = shared("dense_agrees_with_the_exact_form_iterated_to_the_end", "golden/dic") else {
        return;
    };
    // what is neglected is the square of the distance between neighbouring subsets: 2.1e-6 and
    // 2.2e-6 px without noise, 7.7e-5 px with it
    for (noise, case, limit) in
        [("n0", "t02", 5e-6), ("n0", "aff1", 5e-6), ("n2", "t02", 1e-4), ("n2", "aff1", 1e-4)]
    {
        let pair = Pair::golden(&dir, noise, case);
        let [exact, dense] = BOTH.map(|solver| {
            pair.correlate(&Settings { solver, tolerance: 1e-6, ..Settings::default() }).points
        });
        let by_dense = dense.iter().filter(|p| p.solver == SolvedBy::Dense).count();
        assert!(by_dense * 1000 >= 999 * dense.len(), "{by_dense}");
        let mut squares = Vec::new();
        for (p, q) in exact.iter().zip(&dense).filter(|(p, q)| p.status.is_ok() && q.status.is_ok()) {
            squares.extend([(p.u - q.u).powi(2), (p.v - q.v).powi(2)]);
        }
        let rms = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        println!("{noise} {case}: dense − exact {rms:.2e} px RMS");
        assert!(rms <= limit, "{rms}");
    }
}

const SIZE: usize = 256;

fn shifted(speckles: &Speckles, u: f64, v: f64) -> Vec<f64> {
    speckles.image(SIZE, SIZE, |_, _| (u, v))
}

#[test]
fn no_shift_is_biased() {
    let s = Speckles::new(30, SIZE, SIZE);
    let a = shifted(&s, 0.0, 0.0);
    for tenth in 1..=9 {
        let u = f64::from(tenth) / 10.0;
        let pair = Pair::of(&a, &shifted(&s, u, 0.0), SIZE);
        for solver in BOTH {
            let c = pair.correlate(&Settings { solver, ..Settings::default() });
            let (eu, ev) = errors(&c.points, |_, _| (u, 0.0));
            let (bias, scatter) = mean_std(&eu);
            let across = mean_std(&ev).0;
            println!("{u} {solver:?}: {bias:.2e} ± {scatter:.1e}, across {across:.1e}");
            // measured: 1.2e-5 along and 1.4e-7 across
            assert!(bias.abs() <= 1.5e-5 && across.abs() <= 1e-6);
        }
    }
}

#[test]
fn noise_makes_no_bias() {
    const U: f64 = 0.2;
    let s = Speckles::new(31, SIZE, SIZE);
    // twice the contrast of the blobs: grey levels as those of the golden images
    let [a, b] = [0.0, U].map(|u| shifted(&s, u, 0.0).iter().map(|g| 2.0 * g).collect::<Vec<_>>());
    for solver in BOTH {
        let settings = Settings { solver, ..Settings::default() };
        let mean = |a: &[f64], b: &[f64]| {
            let c = Pair::of(a, b, SIZE).correlate(&settings);
            mean_std(&errors(&c.points, |_, _| (U, 0.0)).0).0
        };
        let without = mean(&a, &b);
        let zero = vec![0.0; a.len()];
        let mut sum = 0.0;
        for seed in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let [m, n] = [0, 1].map(|_| noisy(&zero, 2.0, &mut rng));
            // noise and its negative: what is linear in it cancels, a bias stays
            for sign in [1.0, -1.0] {
                let add =
                    |g: &[f64], n: &[f64]| g.iter().zip(n).map(|(g, n)| g + sign * n).collect::<Vec<_>>();
                sum += mean(&add(&a, &m), &add(&b, &n)) / 40.0;
            }
        }
        println!("{solver:?}: {sum:.2e} px with noise, {without:.2e} without");
        assert!((sum - without).abs() <= 1e-4 && sum.abs() <= 2.5e-4);
    }
}

#[test]
fn the_star_is_resolved() {
    let Some(dir) = shared("the_star_is_resolved", "golden/dic") else {
        return;
    };
    let pair = Pair::golden(&dir, "n0", "star");
    for (shape, limit) in [(Shape::Affine, 137.0), (Shape::Quadratic, 44.5)] {
        for solver in [SolverChoice::Exact, SolverChoice::Auto] {
            let roi =
                Roi { rectangle: Some(Rectangle { x: 40, y: 40, width: 944, height: 944 }), mask: None };
            let settings = Settings { shape, solver, ..Settings::default() };
            let points = Points::grid(1024, 1024, settings.subset, 5, &roi).unwrap();
            let c = correlate(&pair.reference, &pair.target, &points, &Guess::Fft, &settings, &()).unwrap();
            let period = score::star_period_at_tenth(1024, &scored("star", 1024, &c));
            println!("{shape:?} {solver:?}: a tenth is lost at {period:.1} px");
            assert!(period <= limit, "{period}");
        }
    }
}
