//! The stated uncertainties against the scatter of noisy repeats.

mod common;
use common::*;
use daic_correlate::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

#[test]
fn sigma_predicts_the_scatter() {
    const N: usize = 136;
    const REPEATS: u64 = 200;
    let s = Speckles::new(20, N, N);
    let (a, b) = (s.image(N, N, |_, _| (0.0, 0.0)), s.image(N, N, |_, _| (0.5, 0.27)));
    let xy: Vec<[f64; 2]> = (0..36)
        .map(|k| [28.0 + 16.0 * f64::from(k % 6) + 0.3, 28.0 + 16.0 * f64::from(k / 6) - 0.4])
        .collect();
    let points = Points::scattered(xy).unwrap();
    let guess = vec![Some([0.5, 0.27]); points.len()];
    for (shape, contrast, noise, given) in [
        (Shape::Affine, 1.0, 2.0, None),
        (Shape::Affine, 1.0, 5.0, None),
        (Shape::Affine, 0.4, 2.0, Some(2.0)),
        (Shape::Quadratic, 1.0, 2.0, None),
    ] {
        let settings = Settings { shape, noise: given, ..Settings::default() };
        let mut found = vec![(Vec::new(), Vec::new(), 0.0, 0.0); points.len()];
        for seed in 0..REPEATS {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let scaled = |g: &[f64]| g.iter().map(|v| contrast * v).collect::<Vec<_>>();
            let ia = image(N, N, &noisy(&scaled(&a), noise, &mut rng));
            let ib = image(N, N, &noisy(&scaled(&b), noise, &mut rng));
            let (reference, target) = (Reference::new(ia), Target::new(ib, Interpolation::Quintic));
            let given = Guess::Given(&guess);
            let c = correlate(&reference, &target, &points, &given, &settings, &()).unwrap();
            for (p, f) in c.points.iter().zip(&mut found) {
                assert!(p.status.is_ok());
                f.0.push(p.u);
                f.1.push(p.v);
                f.2 += f64::from(p.sigma_u).powi(2) / REPEATS as f64;
                f.3 += f64::from(p.sigma_v).powi(2) / REPEATS as f64;
            }
        }
        let (mut seen, mut said) = ([0.0; 2], [0.0; 2]);
        for f in &found {
            let unbiased = REPEATS as f64 / (REPEATS - 1) as f64;
            seen[0] += mean_std(&f.0).1.powi(2) * unbiased;
            seen[1] += mean_std(&f.1).1.powi(2) * unbiased;
            said[0] += f.2;
            said[1] += f.3;
        }
        for c in 0..2 {
            let ratio = (said[c] / seen[c]).sqrt();
            println!("{shape:?} contrast {contrast} noise {noise} {given:?}: said/seen {ratio:.3}");
            // 36 overlapping points × 200 repeats leave about 2 % of chance
            assert!((ratio - 1.0).abs() < 0.10, "{ratio}");
        }
    }
}
