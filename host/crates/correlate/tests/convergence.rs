//! How far from the answer the solver still finds it, and the criterion without gain.

mod common;
use common::*;
use daic_correlate::*;

/// Share of points that end within 0.02 px of the truth when each starts `off` px away.
fn reached(pair: (&Reference, &Target), truth: (f64, f64), off: f64, settings: &Settings) -> f64 {
    let (w, h) = (pair.0.image().width(), pair.0.image().height());
    let (mut found, mut all) = (0, 0);
    for j in 0..6 {
        for i in 0..6 {
            // alone: a point of a set would be reached from its neighbours
            let at = |k: usize, n: usize| 40.0 + ((n - 80) * k) as f64 / 5.0;
            let points = Points::scattered(vec![[at(i, w).round(), at(j, h).round()]]).unwrap();
            let turn = f64::from(7 * i as u32 + 3 * j as u32);
            let guess = [Some([truth.0 + off * turn.cos(), truth.1 + off * turn.sin()])];
            let settings = Settings { significance: 0.0, ..settings.clone() };
            let c = correlate(pair.0, pair.1, &points, &Guess::Given(&guess), &settings, &()).unwrap();
            let p = &c.points[0];
            let error = (p.u - truth.0).hypot(p.v - truth.1);
            all += 1;
            found += usize::from(p.status.is_ok() && error < 0.02);
        }
    }
    found as f64 / all as f64
}

#[test]
fn levenberg_marquardt_widens_the_basin_of_convergence() {
    let Some(dir) = shared("levenberg_marquardt_widens_the_basin_of_convergence", "golden/dic") else {
        return;
    };
    let reference = Reference::new(load(&dir.join("s1024_n2_ref.png")));
    let target = Target::new(load(&dir.join("s1024_n2_t02.png")), Interpolation::Quintic);
    for shape in [Shape::Affine, Shape::Quadratic] {
        let mut sum = [0.0; 2];
        for off in [3.0, 5.0, 7.0, 9.0] {
            let with = |fallback| {
                let settings = Settings { shape, fallback, ..Settings::default() };
                reached((&reference, &target), (0.2, 0.0), off, &settings)
            };
            let (plain, damped) = (with(false), with(true));
            println!("{shape:?}, {off} px off: {plain:.2} without, {damped:.2} with");
            assert!(damped >= plain);
            sum[0] += plain;
            sum[1] += damped;
        }
        assert!(sum[1] > sum[0] + 0.2, "{sum:?}");
    }
}

const N: usize = 120;

#[test]
fn zssd_measures_where_contrast_stays_and_not_where_it_changes() {
    let truth = |_: f64, _: f64| (0.4, 0.3);
    let s = Speckles::new(51, N, N);
    let a = s.image(N, N, |_, _| (0.0, 0.0));
    let moved = s.image(N, N, truth);
    let run = |b: &[f64], criterion, f: fn(&Reference, &Target, &Points, &Settings) -> Correlation| {
        let settings = Settings { criterion, tolerance: 1e-5, ..Settings::default() };
        let points = Points::grid(N, N, 33, 9, &Roi::default()).unwrap();
        let target = Target::new(image(N, N, b), Interpolation::Quintic);
        f(&Reference::new(image(N, N, &a)), &target, &points, &settings)
    };
    let fast = |r: &Reference, t: &Target, p: &Points, s: &Settings| {
        correlate(r, t, p, &Guess::Fft, s, &()).unwrap()
    };
    let slow = |r: &Reference, t: &Target, p: &Points, s: &Settings| {
        correlate_scalar(r, t, p, &Guess::Fft, s, &()).unwrap()
    };
    let worst = |c: &Correlation| {
        let e = errors(&c.points, truth);
        e.0.iter().chain(&e.1).fold(0.0f64, |m, v| m.max(v.abs()))
    };
    // brightness does not matter
    let brighter: Vec<f64> = moved.iter().map(|g| g + 30.0).collect();
    let c = run(&brighter, Criterion::Zssd, fast);
    assert_eq!(c.converged(), c.points.len());
    assert!(worst(&c) < 1e-3, "{}", worst(&c));
    let d = run(&brighter, Criterion::Zssd, slow);
    for (p, q) in c.points.iter().zip(&d.points) {
        assert!((p.u - q.u).abs() < 2e-5 && (p.v - q.v).abs() < 2e-5);
        assert!((p.sigma_u - q.sigma_u).abs() < 1e-4);
    }
    // the minimum over a changed contrast is another one: (1 − gain) Σ f f_x does not vanish
    let fainter: Vec<f64> = moved.iter().map(|g| 0.6 * g).collect();
    let (z, n) = (run(&fainter, Criterion::Zssd, fast), run(&fainter, Criterion::Znssd, fast));
    println!("contrast 0.6: ZSSD {:.2e}, ZNSSD {:.2e}", worst(&z), worst(&n));
    assert!(worst(&n) < 1e-3 && worst(&z) > 10.0 * worst(&n));
}
