//! Strain against analytic fields, transfer functions and Monte-Carlo noise.

#![allow(clippy::needless_range_loop)] // nodes number several arrays at once

mod common;
use common::*;
use daic_correlate::strain::{
    Extensometer, Field, Method, Order, ProbeStatus, Settings, Strain, StrainError, StrainStatus, Tensor,
    gradients, line, point,
};
use daic_correlate::{Guess, Image, Interpolation, Points, Reference, Shape, Target, correlate};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const PLANE: Method = Method::Vsg(Order::Plane);
const QUADRATIC: Method = Method::Vsg(Order::Quadratic);

/// A field of `columns` × `rows` nodes, step 5 from (20, 30), subset 33, σ = 0.01 px.
fn field(columns: usize, rows: usize, u: impl Fn(f64, f64) -> (f64, f64)) -> Field {
    let mut f = Field::empty(columns, rows, [20.0, 30.0], 5.0, 33, Shape::Affine);
    for node in 0..columns * rows {
        let [x, y] = f.position(node);
        (f.u[node], f.v[node]) = u(x, y);
        f.valid[node] = true;
        (f.sigma_u[node], f.sigma_v[node]) = (0.01, 0.01);
    }
    f
}

fn settings(window: usize, method: Method) -> Settings {
    Settings { window, method, ..Settings::default() }
}

/// Displacement of a deformation gradient about (100, 90).
fn affine(f: [[f64; 2]; 2]) -> impl Fn(f64, f64) -> (f64, f64) {
    move |x, y| {
        let (x, y) = (x - 100.0, y - 90.0);
        (f[0][0] * x + f[0][1] * y - x, f[1][0] * x + f[1][1] * y - y)
    }
}

fn strain_of(f: [[f64; 2]; 2], method: Method, tensor: Tensor) -> Vec<Strain> {
    let g = gradients(&field(21, 17, affine(f)), &settings(9, method)).unwrap();
    let strains = g.strains(tensor);
    assert!(strains.iter().filter(|s| s.status.is_ok()).count() > 200);
    strains.into_iter().filter(|s| s.status.is_ok()).collect()
}

const METHODS: [Method; 6] = [
    PLANE,
    QUADRATIC,
    Method::SavitzkyGolay(1),
    Method::SavitzkyGolay(2),
    Method::SavitzkyGolay(3),
    Method::SavitzkyGolay(4),
];

#[track_caller]
fn close(found: f64, truth: f64, tolerance: f64) {
    assert!((found - truth).abs() <= tolerance, "{found} instead of {truth}");
}

// Homogeneous deformations are polynomials of the fit: what is left is rounding (displacements of some
// 10 px over 40 px of window, 1e-13).
const EXACT: f64 = 1e-12;

#[test]
fn a_pure_rotation_strains_nothing() {
    for degrees in [10.0f64, 90.0, -170.0] {
        let a = degrees.to_radians();
        let f = [[a.cos(), -a.sin()], [a.sin(), a.cos()]];
        for method in METHODS {
            for tensor in [Tensor::GreenLagrange, Tensor::Hencky, Tensor::Biot, Tensor::EulerAlmansi] {
                for s in strain_of(f, method, tensor) {
                    s.components.iter().for_each(|&e| close(e, 0.0, EXACT));
                    close(s.rotation, a, EXACT);
                }
            }
        }
    }
    // the small-strain tensor is not free of rotation: cos α − 1
    let a = 10f64.to_radians();
    let f = [[a.cos(), -a.sin()], [a.sin(), a.cos()]];
    for s in strain_of(f, PLANE, Tensor::Engineering) {
        close(s.components[0], a.cos() - 1.0, EXACT);
    }
}

#[test]
fn stretch_shear_and_stretch_with_rotation() {
    let l = 1.3f64;
    let along_x = |tensor| match tensor {
        Tensor::GreenLagrange => (l * l - 1.0) / 2.0,
        Tensor::Hencky => l.ln(),
        Tensor::Engineering | Tensor::Biot => l - 1.0,
        Tensor::EulerAlmansi => (1.0 - 1.0 / (l * l)) / 2.0,
    };
    for tensor in Tensor::ALL {
        for s in strain_of([[l, 0.0], [0.0, 1.0]], PLANE, tensor) {
            let e = along_x(tensor);
            [e, 0.0, 0.0].iter().zip(s.components).for_each(|(t, f)| close(f, *t, EXACT));
            close(s.principal[0], e, EXACT);
            close(s.principal[1], 0.0, EXACT);
            close(s.angle, 0.0, EXACT);
            close(s.von_mises, 2.0 / 3f64.sqrt() * e, EXACT);
        }
        // an isotropic stretch has no direction; its components must not suffer
        for s in strain_of([[l, 0.0], [0.0, l]], PLANE, tensor) {
            let e = along_x(tensor);
            [e, e, 0.0].iter().zip(s.components).for_each(|(t, f)| close(f, *t, EXACT));
        }
    }
    // simple shear x + γ y: E = [[0, γ/2], [γ/2, γ²/2]]; principal stretches λ = √(1 + γ²/4) ± γ/2,
    // so the principal Hencky strains are ± asinh(γ/2) at half the angle of tan 2θ = −2/γ … from C
    let g = 0.4f64;
    for s in strain_of([[1.0, g], [0.0, 1.0]], PLANE, Tensor::GreenLagrange) {
        [0.0, g * g / 2.0, g / 2.0].iter().zip(s.components).for_each(|(t, f)| close(f, *t, EXACT));
        close(s.rotation, -(g / 2.0).atan(), EXACT);
    }
    for s in strain_of([[1.0, g], [0.0, 1.0]], QUADRATIC, Tensor::Hencky) {
        close(s.principal[0], (g / 2.0).asinh(), EXACT);
        close(s.principal[1], -(g / 2.0).asinh(), EXACT);
        // eigenvector of C = [[1, γ], [γ, 1 + γ²]]: tan 2θ = 2γ/(−γ²)
        close(s.angle, 0.5 * (2.0 * g).atan2(-g * g), EXACT);
        let e = (g / 2.0).asinh();
        close(s.von_mises, 2.0 / 3f64.sqrt() * e, EXACT);
    }
    // F = R U with U = diag(1.2, 0.9) turned by 25°: tensors of U whatever R
    let (a, b) = (25f64.to_radians(), -40f64.to_radians());
    let turn = |t: f64| [[t.cos(), -t.sin()], [t.sin(), t.cos()]];
    let product = |p: [[f64; 2]; 2], q: [[f64; 2]; 2]| {
        let e = |i: usize, j: usize| p[i][0] * q[0][j] + p[i][1] * q[1][j];
        [[e(0, 0), e(0, 1)], [e(1, 0), e(1, 1)]]
    };
    let u = product(product(turn(a), [[1.2, 0.0], [0.0, 0.9]]), turn(-a));
    for tensor in [Tensor::Hencky, Tensor::Biot, Tensor::GreenLagrange] {
        for s in strain_of(product(turn(b), u), PLANE, tensor) {
            let value = |l: f64| match tensor {
                Tensor::Hencky => l.ln(),
                Tensor::Biot => l - 1.0,
                _ => (l * l - 1.0) / 2.0,
            };
            close(s.principal[0], value(1.2), EXACT);
            close(s.principal[1], value(0.9), EXACT);
            close(s.angle, a, EXACT);
            close(s.rotation, b, EXACT);
        }
    }
}

#[test]
fn polynomials_come_back_everywhere_even_at_edges_and_holes() {
    // degree n; the slope at every node is exact, one-sided or not
    for (method, degree) in
        [(PLANE, 1), (QUADRATIC, 2), (Method::SavitzkyGolay(3), 3), (Method::SavitzkyGolay(4), 4)]
    {
        let n = f64::from(degree);
        let poly = move |x: f64, y: f64| {
            let (s, t) = (x / 100.0, y / 80.0);
            (s.powi(degree) + 0.3 * s * t.powi(degree - 1), t.powi(degree) - 0.2 * s.powi(degree - 1) * t)
        };
        let mut f = field(25, 19, poly);
        if matches!(method, Method::Vsg(_)) {
            for (i, j) in [(8, 9), (9, 9), (8, 10), (20, 3), (21, 3), (0, 0), (24, 18)] {
                f.valid[j * 25 + i] = false;
            }
            f.u[9 * 25 + 8] = 1e6;
            f.v[3 * 25 + 20] = f64::NAN;
        }
        let s = Settings { min_fraction: 0.2, ..settings(9, method) };
        let found = gradients(&f, &s).unwrap();
        let mut counted = 0;
        for (node, p) in found.points.iter().enumerate() {
            assert_eq!(p.status.is_ok(), f.valid[node], "{method} {node}: {:?}", p.status);
            if !p.status.is_ok() {
                assert!(p.gradient[0][0].is_nan() && p.displacement[0].is_nan());
                continue;
            }
            counted += 1;
            let [x, y] = f.position(node);
            let (s, t) = (x / 100.0, y / 80.0);
            let d = degree - 1;
            let power = |b: f64, e: i32| if e < 0 { 0.0 } else { b.powi(e) };
            let ux = (n * power(s, d) + 0.3 * power(t, d)) / 100.0;
            let uy = 0.3 * s * (n - 1.0) * power(t, d - 1) / 80.0;
            let vx = -0.2 * (n - 1.0) * power(s, d - 1) * t / 100.0;
            let vy = (n * power(t, d) - 0.2 * power(s, d)) / 80.0;
            for (found, truth) in [(p.gradient[0], [ux, uy]), (p.gradient[1], [vx, vy])] {
                close(found[0], truth[0], EXACT);
                close(found[1], truth[1], EXACT);
            }
            close(p.displacement[0], poly(x, y).0, 1e-11);
        }
        assert!(counted >= 468, "{counted}");
    }
}

#[test]
fn a_wave_is_attenuated_as_the_window_says() {
    // least-squares slope of sin(kx) over 2m + 1 points h apart, at the window's middle:
    // cos(kx) Σ j sin(kjh) / (h Σ j²); for many points 3 (sin q − q cos q)/q³ with q = k m h
    let (window, h) = (15usize, 5.0);
    let m = window / 2;
    for period in [400.0, 200.0, 120.0, 90.0] {
        let k = std::f64::consts::TAU / period;
        let f = field(120, 20, |x, _| ((k * x).sin(), 0.0));
        let found = gradients(&f, &settings(window, PLANE)).unwrap();
        let sums =
            (1..=m).map(|j| j as f64).fold((0.0, 0.0), |(a, b), j| (a + j * (k * j * h).sin(), b + j * j));
        let transfer = sums.0 / (k * h * sums.1);
        for node in 0..120 * 20 {
            let i = node % 120;
            if (m..120 - m).contains(&i) && (m..20 - m).contains(&(node / 120)) {
                let x = f.position(node)[0];
                close(found.points[node].gradient[0][0], k * transfer * (k * x).cos(), EXACT);
            }
        }
        let q = k * (m as f64 + 0.5) * h;
        let continuous = 3.0 * (q.sin() - q * q.cos()) / q.powi(3);
        println!("period {period}: transfer {transfer:.4}, continuous {continuous:.4}");
        // (m + ½)h: the points stand for intervals; the rest is of the order of (h/period)²
        close(transfer, continuous, 5e-3);
    }
}

#[test]
fn what_is_missing_has_a_name() {
    let mut f = field(20, 20, |x, y| (0.01 * x, 0.02 * y));
    f.valid[10 * 20 + 10] = false;
    let found = gradients(&f, &settings(5, PLANE)).unwrap();
    assert_eq!(found.points[10 * 20 + 10].status, StrainStatus::NoDisplacement);
    // corners hold 9 of 25 points
    assert_eq!((found.points[0].status, found.points[0].used), (StrainStatus::TooFewPoints, 9));
    assert_eq!((found.points[1].status, found.points[1].used), (StrainStatus::TooFewPoints, 12));
    assert_eq!((found.points[2].status, found.points[2].used), (StrainStatus::Ok, 15));
    assert_eq!((found.points[9 * 20 + 9].status, found.points[9 * 20 + 9].used), (StrainStatus::Ok, 24));
    let found = gradients(&f, &settings(5, Method::SavitzkyGolay(2))).unwrap();
    assert_eq!(found.points[0].status, StrainStatus::Ok);
    assert_eq!(
        (found.points[9 * 20 + 9].status, found.points[9 * 20 + 9].used),
        (StrainStatus::IncompleteWindow, 24)
    );
    // one line of points: a plane is not determined
    for node in 0..400 {
        f.valid[node] = node / 20 == 7;
    }
    let s = Settings { min_fraction: 0.0, ..settings(5, PLANE) };
    assert_eq!(gradients(&f, &s).unwrap().points[7 * 20 + 7].status, StrainStatus::IllConditioned);
    // two lines: a plane is, a quadratic is not
    for node in 0..400 {
        f.valid[node] = node / 20 == 7 || node / 20 == 8;
    }
    assert!(gradients(&f, &s).unwrap().points[7 * 20 + 7].status.is_ok());
    let s = Settings { min_fraction: 0.0, ..settings(5, QUADRATIC) };
    assert_eq!(gradients(&f, &s).unwrap().points[7 * 20 + 7].status, StrainStatus::IllConditioned);
    // inside out
    let f = field(9, 9, |x, _| (-2.0 * x, 0.0));
    let strains = gradients(&f, &settings(5, PLANE)).unwrap().strains(Tensor::Hencky);
    assert_eq!(strains[40].status, StrainStatus::Folded);
    assert!(strains[40].components[0].is_nan());
}

#[test]
fn a_crack_is_not_bridged() {
    // 1 % below, −0.5 % and 2 px apart above; either flagged points between, or only the jump itself
    let two_sides = |_: f64, y: f64| if y < 80.0 { (0.0, 0.01 * y) } else { (2.0, -0.005 * y) };
    let mut flagged = field(30, 24, two_sides);
    for i in 0..30 {
        flagged.valid[9 * 30 + i] = false;
        flagged.valid[10 * 30 + i] = false;
    }
    let jump = Settings { max_jump: Some(1.0), ..settings(9, PLANE) };
    for (f, s) in [(flagged, settings(9, PLANE)), (field(30, 24, two_sides), jump)] {
        let found = gradients(&f, &s).unwrap();
        let mut counted = 0;
        for (node, p) in found.points.iter().enumerate().filter(|(_, p)| p.status.is_ok()) {
            let truth = if f.position(node)[1] < 80.0 { 0.01 } else { -0.005 };
            close(p.gradient[1][1], truth, EXACT);
            close(p.gradient[0][1], 0.0, EXACT);
            counted += 1;
        }
        assert!(counted > 400, "{counted}");
    }
}

#[test]
fn settings_and_fields_are_checked() {
    let f = field(20, 10, |_, _| (0.0, 0.0));
    let error = |s: Settings| gradients(&f, &s).unwrap_err();
    assert!(matches!(error(settings(8, PLANE)), StrainError::EvenWindow { window: 8 }));
    assert!(matches!(error(settings(1, PLANE)), StrainError::WindowRange { min: 3, .. }));
    assert!(matches!(error(settings(3, Method::SavitzkyGolay(4))), StrainError::WindowRange { min: 5, .. }));
    assert!(matches!(error(settings(9, Method::SavitzkyGolay(5))), StrainError::Order { order: 5, max: 4 }));
    assert!(matches!(error(settings(9, Method::SavitzkyGolay(0))), StrainError::Order { order: 0, .. }));
    assert!(matches!(error(settings(11, PLANE)), StrainError::WindowLargerThanField { rows: 10, .. }));
    let s = Settings { min_fraction: f64::NAN, ..Settings::default() };
    assert!(matches!(error(s), StrainError::Range { name: "min_fraction", .. }));
    let mut short = f.clone();
    short.sigma_v.pop();
    assert!(matches!(
        gradients(&short, &settings(9, PLANE)),
        Err(StrainError::Length { name: "sigma_v", found: 199, .. })
    ));
    let mut no_step = f.clone();
    no_step.step = 0.0;
    assert!(matches!(gradients(&no_step, &settings(9, PLANE)), Err(StrainError::Range { name: "step", .. })));
    let nothing = Field::empty(20, 20, [0.0, 0.0], 5.0, 33, Shape::Affine);
    assert_eq!(gradients(&nothing, &settings(9, PLANE)).unwrap().ok(), 0);
    assert_eq!(Settings::default().gauge(5.0, 33), 103.0);
}

#[test]
fn results_do_not_depend_on_threads() {
    let seed = 5;
    println!("seed {seed}");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut f = field(60, 50, |x, y| ((x / 30.0).sin(), (y / 20.0).cos()));
    for node in 0..3000 {
        f.u[node] += rng.random_range(-0.01..0.01);
        f.valid[node] = rng.random_range(0.0..1.0) < 0.98;
    }
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| gradients(&f, &settings(11, QUADRATIC)).unwrap().strains(Tensor::Hencky))
    };
    let bits = |s: &[Strain]| -> Vec<[u64; 6]> {
        s.iter()
            .map(|s| {
                let ([a, b, c], [d, e, f]) = (s.components, s.sigma);
                [a, b, c, d, e, f].map(f64::to_bits)
            })
            .collect()
    };
    assert_eq!(bits(&run(1)), bits(&run(3)));
}

/// Root mean square of the values over that of what was said about them.
struct Ratio {
    seen: f64,
    said: f64,
    count: usize,
}

impl Ratio {
    fn new() -> Self {
        Self { seen: 0.0, said: 0.0, count: 0 }
    }
    fn add(&mut self, error: f64, sigma: f64) {
        self.seen += error * error;
        self.said += sigma * sigma;
        self.count += 1;
    }
    fn said_over_seen(&self) -> f64 {
        (self.said / self.seen).sqrt()
    }
}

#[test]
fn sigma_predicts_correlated_noise() {
    // errors whose correlation is the overlap of 21 px subsets by construction: means of white noise over
    // the subsets. Left over is the chance of the repeats: 40 fields of about 20 independent gauges.
    const SUBSET: usize = 21;
    const STEP: usize = 5;
    let (columns, rows) = (27usize, 25usize);
    let (width, height) = ((columns - 1) * STEP + SUBSET, (rows - 1) * STEP + SUBSET);
    for (window, method) in [
        (7, PLANE),
        (11, PLANE),
        (9, QUADRATIC),
        (9, Method::SavitzkyGolay(1)),
        (11, Method::SavitzkyGolay(3)),
    ] {
        let (mut inner, mut outer, mut holed) = (Ratio::new(), Ratio::new(), Ratio::new());
        for seed in 0..40 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut f = Field::empty(columns, rows, [0.0, 0.0], STEP as f64, SUBSET, Shape::Affine);
            for values in [&mut f.u, &mut f.v] {
                let noise: Vec<f64> = (0..width * height).map(|_| rng.random_range(-1.0..1.0)).collect();
                let mut sums = vec![0.0; (width + 1) * (height + 1)];
                for y in 0..height {
                    for x in 0..width {
                        let at = |a: usize, b: usize| sums[b * (width + 1) + a];
                        let sum = noise[y * width + x] + at(x + 1, y) + at(x, y + 1) - at(x, y);
                        sums[(y + 1) * (width + 1) + x + 1] = sum;
                    }
                }
                let at = |a: usize, b: usize| sums[b * (width + 1) + a];
                for (node, value) in values.iter_mut().enumerate() {
                    let (x, y) = (node % columns * STEP, node / columns * STEP);
                    let sum = at(x + SUBSET, y + SUBSET) - at(x, y + SUBSET) - at(x + SUBSET, y) + at(x, y);
                    *value = sum / (SUBSET * SUBSET) as f64;
                }
            }
            // uniform on −1…1: variance 1/3
            let sigma = (1.0 / 3.0f64).sqrt() / SUBSET as f64;
            f.sigma_u.fill(sigma);
            f.sigma_v.fill(sigma);
            f.valid.fill(true);
            if matches!(method, Method::Vsg(_)) {
                for (i, j) in [(13, 12), (14, 12), (13, 13), (5, 5)] {
                    f.valid[j * columns + i] = false;
                }
            }
            let s = settings(window, method);
            let found = gradients(&f, &s).unwrap();
            for (node, p) in found.points.iter().enumerate().filter(|(_, p)| p.status.is_ok()) {
                let (i, j) = (node % columns, node / columns);
                let m = window / 2;
                let whole = (m..columns - m).contains(&i) && (m..rows - m).contains(&j);
                let full = p.used as usize == window * window;
                let ratio = match (whole, full) {
                    (true, true) => &mut inner,
                    (false, _) => &mut outer,
                    (true, false) => &mut holed,
                };
                for c in 0..2 {
                    for k in 0..2 {
                        ratio.add(p.gradient[c][k], p.covariance[c][k].sqrt());
                    }
                }
            }
        }
        let [a, b] = [&inner, &outer].map(Ratio::said_over_seen);
        println!(
            "{method} {window}: said/seen {a:.3} inside, {b:.3} at the edge, {:.3} with holes",
            holed.said_over_seen()
        );
        // measured within 2.5 % in 60 fields
        assert!((a - 1.0).abs() < 0.04 && (b - 1.0).abs() < 0.04);
        if matches!(method, Method::Vsg(_)) {
            assert!(holed.count > 1000 && (holed.said_over_seen() - 1.0).abs() < 0.04);
        }
    }
    // an unknown uncertainty is not invented
    let mut f = field(15, 15, |x, _| (0.01 * x, 0.0));
    f.sigma_u[7 * 15 + 7] = f64::NAN;
    let strains = gradients(&f, &settings(5, PLANE)).unwrap().strains(Tensor::Engineering);
    assert!(strains[7 * 15 + 8].sigma[0].is_nan() && strains[7 * 15 + 8].sigma[1] > 0.0);
    assert!(strains[7 * 15 + 12].sigma[0] > 0.0);
}

#[test]
fn sigma_predicts_the_scatter_of_noisy_images() {
    // real subsets of noisy images, not the model they are described with
    const N: usize = 150;
    const REPEATS: u64 = 64;
    let s = Speckles::new(31, N, N);
    let (a, b) = (s.image(N, N, |_, _| (0.0, 0.0)), s.image(N, N, |_, _| (0.2, 0.0)));
    for shape in [Shape::Affine, Shape::Quadratic] {
        let dic = daic_correlate::Settings { subset: 25, shape, ..daic_correlate::Settings::default() };
        let points = Points::grid(N, N, dic.subset, 5, &Default::default()).unwrap();
        let guess = vec![Some([0.2, 0.0]); points.len()];
        let mut ratio = Ratio::new();
        let (mut sums, mut squares, mut said) = (Vec::new(), Vec::new(), Vec::new());
        for seed in 0..REPEATS {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (reference, target) = (
                Reference::new(image(N, N, &noisy(&a, 2.0, &mut rng))),
                Target::new(image(N, N, &noisy(&b, 2.0, &mut rng)), Interpolation::Quintic),
            );
            let c = correlate(&reference, &target, &points, &Guess::Given(&guess), &dic, &()).unwrap();
            let f = Field::of(&points, &c, dic.subset, shape).unwrap();
            let strains = gradients(&f, &settings(9, PLANE)).unwrap().strains(Tensor::GreenLagrange);
            sums.resize(strains.len(), [0.0; 3]);
            squares.resize(strains.len(), [0.0; 3]);
            said.resize(strains.len(), [0.0; 3]);
            for (k, s) in strains.iter().enumerate().filter(|(_, s)| s.status.is_ok()) {
                for c in 0..3 {
                    sums[k][c] += s.components[c];
                    squares[k][c] += s.components[c].powi(2);
                    said[k][c] += s.sigma[c].powi(2);
                }
            }
        }
        let n = REPEATS as f64;
        for k in 0..sums.len() {
            for c in 0..3 {
                if squares[k][c] > 0.0 {
                    let variance = (squares[k][c] - sums[k][c] * sums[k][c] / n) / (n - 1.0);
                    ratio.add(variance.max(0.0).sqrt(), (said[k][c] / n).sqrt());
                }
            }
        }
        println!("{shape:?}: said/seen {:.3} over {} points", ratio.said_over_seen(), ratio.count / 3);
        assert!((ratio.said_over_seen() - 1.0).abs() < 0.10);
    }
}

#[test]
fn golden_affine_strain() {
    let Some(dir) = shared("golden_affine_strain", "golden/dic") else {
        return;
    };
    // u = 0.01 x + 0.002 y, v = 0.002 x − 0.003 y about the middle
    let (ux, uy, vx, vy) = (0.01f64, 0.002f64, 0.002f64, -0.003f64);
    let truth =
        [ux + 0.5 * (ux * ux + vx * vx), vy + 0.5 * (uy * uy + vy * vy), 0.5 * (uy + vx + ux * uy + vx * vy)];
    let dic = daic_correlate::Settings::default();
    for (noise, case, truth) in [("n0", "aff1", truth), ("n2", "t02", [0.0; 3])] {
        let read = |name: &str| -> Image { load(&dir.join(format!("s1024_{noise}_{name}.png"))) };
        let roi = daic_correlate::Roi {
            rectangle: Some(daic_correlate::Rectangle { x: 40, y: 40, width: 944, height: 944 }),
            mask: None,
        };
        let points = Points::grid(1024, 1024, dic.subset, 8, &roi).unwrap();
        let (reference, target) = (Reference::new(read("ref")), Target::new(read(case), dic.interpolation));
        let c = correlate(&reference, &target, &points, &Guess::Fft, &dic, &()).unwrap();
        let f = Field::of(&points, &c, dic.subset, dic.shape).unwrap();
        let s = settings(15, PLANE);
        let strains = gradients(&f, &s).unwrap().strains(Tensor::GreenLagrange);
        for c in 0..3 {
            let ok = || strains.iter().filter(|s| s.status.is_ok() && s.used == 225);
            let errors: Vec<f64> = ok().map(|s| s.components[c] - truth[c]).collect();
            let (bias, scatter) = mean_std(&errors);
            let said = (ok().map(|s| s.sigma[c].powi(2)).sum::<f64>() / errors.len() as f64).sqrt();
            let name = ["exx", "eyy", "exy"][c];
            println!(
                "{noise} {case} {name}: bias {bias:.1e}, scatter {scatter:.2e}, said {said:.2e} ({:.3}), gauge {} px, {} points",
                said / scatter,
                s.gauge(8.0, 33),
                errors.len()
            );
            // measured: bias 2e-7 and scatter 5e-6 (n0), 6e-7 and 2.8e-5 (n2)
            let limits = if noise == "n0" { (1e-6, 6e-6) } else { (2e-6, 3.5e-5) };
            assert!(bias.abs() < limits.0 && scatter < limits.1);
            // 944 px hold some 40 independent gauges of 145 px: one image pair leaves 10 % of chance
            assert!((said / scatter - 1.0).abs() < 0.2);
        }
    }
}

#[test]
fn probes_interpolate_and_know_where_they_cannot() {
    let truth = affine([[1.02, 0.004], [-0.003, 0.98]]);
    let mut f = field(25, 21, &truth);
    let g = gradients(&f, &settings(5, PLANE)).unwrap();
    let p = point(&f, Some((&g, Tensor::Engineering)), [73.3, 61.9]).unwrap();
    assert_eq!(p.status, ProbeStatus::Ok);
    close(p.displacement[0], truth(73.3, 61.9).0, EXACT);
    close(p.displacement[1], truth(73.3, 61.9).1, EXACT);
    let s = p.strain.unwrap();
    [0.02, -0.02, 0.0005].iter().zip(s.components).for_each(|(t, f)| close(f, *t, EXACT));
    // at a node the uncertainty is the node's, in between it is hardly less: neighbours share their noise
    close(point(&f, None, [70.0, 60.0]).unwrap().sigma[0], 0.01, 1e-12);
    let between = point(&f, None, [72.5, 60.0]).unwrap().sigma[0];
    // ½ (1 + ρ) σ², ρ = 1 − 5/33
    close(between, 0.01 * (0.5 * (2.0 - 5.0 / 33.0f64)).sqrt(), 1e-12);

    f.valid[6 * 25 + 10] = false; // (70, 60)
    assert_eq!(point(&f, None, [68.0, 60.0]).unwrap().status, ProbeStatus::MissingPoint);
    assert_eq!(point(&f, None, [65.0, 60.0]).unwrap().status, ProbeStatus::Ok);
    assert!(point(&f, None, [68.0, 60.0]).unwrap().displacement[0].is_nan());
    assert_eq!(point(&f, None, [19.9, 60.0]).unwrap().status, ProbeStatus::Outside);
    assert_eq!(point(&f, None, [140.0, 130.0]).unwrap().status, ProbeStatus::Ok);
    assert!(point(&f, None, [f64::NAN, 0.0]).is_err());

    let l = line(&f, None, [20.0, 40.0], [140.0, 130.0], 31).unwrap();
    assert_eq!((l.distance[0], l.distance[30]), (0.0, 150.0));
    for p in l.points.iter().filter(|p| p.status.is_ok()) {
        close(p.displacement[0], truth(p.position[0], p.position[1]).0, EXACT);
    }
    assert!(line(&f, None, [20.0, 40.0], [140.0, 130.0], 0).is_err());
}

#[test]
fn extensometers_measure_lengths() {
    let f = field(25, 21, affine([[1.02, 0.004], [-0.003, 0.98]]));
    for radius in [0.0, 12.0] {
        let e = Extensometer { from: [45.0, 60.0], to: [115.0, 60.0], radius }.measure(&f).unwrap();
        assert_eq!(e.status, ProbeStatus::Ok);
        close(e.length, 70.0, EXACT);
        close(e.deformed_length, 70.0 * 1.02f64.hypot(0.003), 1e-11);
        close(e.strain, 1.02f64.hypot(0.003) - 1.0, EXACT);
        if radius == 0.0 {
            // subsets 70 px apart share nothing: √2 σ / L
            close(e.sigma, 2f64.sqrt() * 0.01 / 70.0, 1e-9);
        } else {
            assert!(
                e.used[0] > 15
                    && e.sigma < 2f64.sqrt() * 0.01 / 70.0
                    && e.sigma > 0.5 * 2f64.sqrt() * 0.01 / 70.0
            );
        }
    }
    // a short one: the ends share noise
    let e = Extensometer { from: [60.0, 60.0], to: [75.0, 60.0], radius: 0.0 }.measure(&f).unwrap();
    close(e.sigma, 0.01 * (2.0 * 15.0 / 33.0f64).sqrt() / 15.0, 1e-6);
    let at = |from, to, radius| Extensometer { from, to, radius }.measure(&f);
    assert_eq!(at([0.0, 60.0], [75.0, 60.0], 0.0).unwrap().status, ProbeStatus::Outside);
    assert!(at([60.0, 60.0], [60.0, 60.0], 0.0).is_err());
    assert!(at([60.0, 60.0], [61.0, 60.0], 0.0).is_ok());
    assert!(at([60.0, 60.0], [60.5, 60.0], 500.0).is_err());
    assert!(at([60.0, 60.0], [80.0, 60.0], -1.0).is_err());
}
