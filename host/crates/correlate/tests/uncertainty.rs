//! The stated uncertainties against the scatter of noisy repeats.

mod common;
use common::*;
use daic_correlate::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const N: usize = 160;
const REPEATS: u64 = 200;
const TRUTH: [f64; 2] = [0.5, 0.27];

/// Sums over points and repeats, for u and v.
#[derive(Default, Clone, Copy)]
struct Tally {
    dense: usize,
    squares: [f64; 2],
    stated: [f64; 2],
    covered: [f64; 2],
}

/// Errors and stated variances of all points over all repeats, for both solvers with the noise
/// estimated and given.
fn check(shape: Shape, contrasts: [f64; 2], noise: f64) {
    let s = Speckles::new(20, N, N);
    let scaled = |c: f64, g: Vec<f64>| g.iter().map(|v| c * v).collect::<Vec<_>>();
    let a = scaled(contrasts[0], s.image(N, N, |_, _| (0.0, 0.0)));
    let b = scaled(contrasts[1], s.image(N, N, |_, _| (TRUTH[0], TRUTH[1])));
    let rectangle = Some(Rectangle { x: 20, y: 20, width: 120, height: 120 });
    let points = Points::grid(N, N, 33, 8, &Roi { rectangle, mask: None }).unwrap();
    let guess = vec![Some(TRUTH); points.len()];
    let ways = [SolverChoice::Exact, SolverChoice::Auto].map(|solver| {
        [None, Some(noise)].map(|noise| Settings { shape, solver, noise, ..Settings::default() })
    });
    let ways = ways.as_flattened();
    let mut tallies = vec![Tally::default(); ways.len()];
    for seed in 0..REPEATS {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let reference = Reference::new(image(N, N, &noisy(&a, noise, &mut rng)));
        let target = Target::new(image(N, N, &noisy(&b, noise, &mut rng)), Interpolation::Quintic);
        for (settings, tally) in ways.iter().zip(&mut tallies) {
            let c = correlate(&reference, &target, &points, &Guess::Given(&guess), settings, &()).unwrap();
            assert_eq!(c.converged(), points.len(), "{settings:?}");
            tally.dense += c.points.iter().filter(|p| p.solver == SolvedBy::Dense).count();
            for p in &c.points {
                let errors = [p.u - TRUTH[0], p.v - TRUTH[1]];
                for (k, sigma) in [p.sigma_u, p.sigma_v].into_iter().map(f64::from).enumerate() {
                    tally.squares[k] += errors[k] * errors[k];
                    tally.stated[k] += sigma * sigma;
                    tally.covered[k] += f64::from(u8::from(errors[k].abs() < sigma));
                }
            }
        }
    }
    let all = points.len() as f64 * REPEATS as f64;
    for (settings, t) in ways.iter().zip(&tallies) {
        // beyond a tenth of the gradients' energy the exact form takes over
        let dense = settings.solver == SolverChoice::Auto && noise / contrasts[0] < 1.5;
        assert_eq!(t.dense as f64 > 0.9 * all, dense, "{}", t.dense);
        for k in 0..2 {
            let ratio = (t.stated[k] / t.squares[k]).sqrt();
            let covered = t.covered[k] / all;
            let given = if settings.noise.is_some() { "given" } else { "estimated" };
            println!(
                "{shape:?} contrast {contrasts:?} noise {noise} {given}, {:?}: stated/seen {ratio:.3}, covered {covered:.3}",
                settings.solver
            );
            // some twenty subsets beside one another × 200 repeats leave 1.1 % of chance
            assert!((ratio - 1.0).abs() < 0.05, "{ratio}");
            assert!((covered - 0.68).abs() < 0.02, "{covered}");
        }
    }
}

#[test]
fn sigma_predicts_the_scatter() {
    // the last: gradients nearly half of whose energy is noise
    for (contrast, noise) in [(2.0, 2.0), (2.0, 5.0), (1.0, 2.0), (1.0, 5.0)] {
        check(Shape::Affine, [contrast; 2], noise);
    }
}

#[test]
fn sigma_of_other_shapes_and_of_images_of_different_contrast() {
    check(Shape::Quadratic, [2.0, 2.0], 2.0);
    check(Shape::Affine, [2.0, 1.2], 2.0);
}
