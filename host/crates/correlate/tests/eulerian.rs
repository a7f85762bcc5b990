//! The Eulerian field against fields that are known in both descriptions.

mod common;
use common::*;
use daic_correlate::*;

/// Points as a perfect correlation of a field would return them.
fn exact(points: &Points, u: impl Fn(f64, f64) -> [f64; 2]) -> Vec<Point> {
    let d = 1e-4;
    points
        .positions()
        .iter()
        .map(|&[x, y]| {
            let at = u(x, y);
            let (cx, cy) = (x.round(), y.round());
            let (e, w) = (u(cx + d, cy), u(cx - d, cy));
            let (s, n) = (u(cx, cy + d), u(cx, cy - d));
            let here = u(cx, cy);
            let shape = |c: usize| {
                [here[c], (e[c] - w[c]) / (2.0 * d), (s[c] - n[c]) / (2.0 * d), 0.0, 0.0, 0.0]
                    .map(|v| v as f32)
            };
            Point {
                x,
                y,
                u: at[0],
                v: at[1],
                sigma_u: 0.01,
                sigma_v: 0.02,
                zncc: 1.0,
                iterations: 1,
                status: Status::Converged,
                solver: SolvedBy::Exact,
                shape: ShapeParameters { u: shape(0), v: shape(1) },
            }
        })
        .collect()
}

fn grid(n: usize) -> Points {
    Points::grid(n, n, 21, 5, &Roi::default()).unwrap()
}

#[test]
fn affine_fields_are_inverted_exactly() {
    // x = A X + t, so that u_E(x) = x − A⁻¹ (x − t)
    let (s, c) = 0.3f64.sin_cos();
    for a in [[[1.1, 0.05], [-0.03, 0.95]], [[c, -s], [s, c]]] {
        let t = [7.3, -4.1];
        let u = |x: f64, y: f64| [a[0][0] * x + a[0][1] * y + t[0] - x, a[1][0] * x + a[1][1] * y + t[1] - y];
        let det = a[0][0] * a[1][1] - a[0][1] * a[1][0];
        let back = |x: f64, y: f64| {
            let (p, q) = (x - t[0], y - t[1]);
            [(a[1][1] * p - a[0][1] * q) / det, (a[0][0] * q - a[1][0] * p) / det]
        };
        let points = grid(160);
        let scattered: Vec<[f64; 2]> = points
            .positions()
            .iter()
            .enumerate()
            .map(|(k, p)| [p[0] + 0.3 * (k % 3) as f64, p[1] - 0.4])
            .collect();
        for points in [points, Points::scattered(scattered).unwrap()] {
            let found = exact(&points, u);
            let at = grid(160).positions().to_vec();
            let field = eulerian(&points, &found, &at);
            let mut covered = 0;
            for (&[x, y], e) in at.iter().zip(&field) {
                let [bx, by] = back(x, y);
                let inside = |m: f64| [bx, by].iter().all(|&b| b > 14.0 + m && b < 144.0 - m);
                match e {
                    Some(e) => {
                        covered += 1;
                        assert!(inside(-6.5), "material from outside at {x}, {y}");
                        // single precision of the slopes over half a cell: 1e-7 · 0.3 · 5
                        let worst = (e.u - (x - bx)).abs().max((e.v - (y - by)).abs());
                        assert!(worst < 1e-6, "{x} {y}: {worst}");
                        let expected = (a[1][1] * 0.01 / det).hypot(a[0][1] * 0.02 / det);
                        assert!((f64::from(e.sigma_u) - expected).abs() < 1e-6);
                    }
                    None => assert!(!inside(1.0), "nothing at {x}, {y} from {bx}, {by}"),
                }
            }
            assert!(covered > at.len() / 2);
        }
    }
}

#[test]
fn a_wave_is_inverted() {
    // Cells of 5 px in a wave of 60 px: Σ wᵢ [uᵢ + ½ ∇uᵢ·δ] leaves third derivatives,
    // u''' h³ t (t − ½)(t − 1)/6, at most 0.008 u''' h³ = 2.3e-3 px along x and again along y;
    // found 3.8e-3
    let u = |x: f64, y: f64| {
        let k = std::f64::consts::TAU / 60.0;
        [2.0 * (k * x).sin() * (k * y).cos(), 1.5 * (k * (x + y)).cos()]
    };
    let points = grid(200);
    let mut found = exact(&points, u);
    let lost = points.len() / 2 + 7;
    found[lost].status = Status::LowCorrelation;
    let at: Vec<[f64; 2]> =
        (0..4000).map(|k| [25.0 + f64::from(k % 64) * 2.31, 25.0 + f64::from(k / 64) * 2.37]).collect();
    let mut worst = [0.0f64; 2];
    for (&[x, y], e) in at.iter().zip(eulerian(&points, &found, &at)) {
        let e = e.expect("covered");
        let (mut a, mut b) = (x, y);
        for _ in 0..200 {
            let d = u(a, b);
            (a, b) = (x - d[0], y - d[1]);
        }
        let error = (e.u - (x - a)).abs().max((e.v - (y - b)).abs());
        let near = (a - found[lost].x).abs().max((b - found[lost].y).abs()) < 5.0;
        worst[usize::from(near)] = worst[usize::from(near)].max(error);
        assert!(e.nearest != lost);
    }
    println!("wave of 60 px: largest error {:.2e} px, beside a lost point {:.2e} px", worst[0], worst[1]);
    assert!(worst[0] < 4.2e-3);
    // the shape function of a neighbour over a diagonal of 7 px: |u''| 7²/2 with u'' up to
    // 2·2 (2π/60)² is 0.5 px at worst; found 0.19
    assert!(worst[1] > 0.0 && worst[1] < 0.25);
}

#[test]
fn measured_rotation_is_inverted() {
    const N: usize = 120;
    let (s, c) = 5f64.to_radians().sin_cos();
    let turn = |x: f64, y: f64| {
        let (p, q) = (x - 60.0, y - 60.0);
        (c * p - s * q - p, s * p + c * q - q)
    };
    let speckles = Speckles::new(31, N, N);
    let reference = Reference::new(image(N, N, &speckles.image(N, N, |_, _| (0.0, 0.0))));
    let target = Target::new(image(N, N, &speckles.image(N, N, turn)), Interpolation::Quintic);
    let settings = Settings { subset: 21, ..Settings::default() };
    let points = Points::grid(N, N, 21, 5, &Roi::default()).unwrap();
    let found = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
    let field = eulerian(&points, &found.points, points.positions());
    let mut errors = Vec::new();
    for e in field.iter().flatten() {
        let (p, q) = (e.x - 60.0, e.y - 60.0);
        errors.push(e.u - (p - (c * p + s * q)));
        errors.push(e.v - (q - (c * q - s * p)));
    }
    let (mean, std) = mean_std(&errors);
    println!(
        "rotation by 5°: {} of {}, mean {mean:.1e}, scatter {std:.1e} px",
        errors.len() / 2,
        field.len()
    );
    assert!(errors.len() > field.len() && mean.abs() < 5e-4 && std < 2e-3);
}

#[test]
fn no_field_no_material() {
    let points = grid(60);
    let found = exact(&points, |_, _| [0.0, 0.0]);
    let odd = [[f64::NAN, 1.0], [f64::INFINITY, 0.0], [1e300, -1e300], [30.0, 30.0]];
    let field = eulerian(&points, &found, &odd);
    assert!(field[..3].iter().all(Option::is_none) && field[3].is_some());
    assert!(eulerian(&points, &[], &odd).iter().all(Option::is_none));
    let folded = exact(&points, |x, _| [-2.0 * x, 0.0]);
    assert!(eulerian(&points, &folded, &[[-30.0, 30.0]])[0].is_none());
    let one = Points::scattered(vec![[20.0, 20.0]]).unwrap();
    let found = exact(&one, |_, _| [1.0, 0.0]);
    assert!(eulerian(&one, &found, &[[21.2, 20.1]])[0].is_some_and(|e| (e.u - 1.0).abs() < 1e-9));
}
