//! Phases and displacements of analytic gratings.

mod common;
use common::{mean_std, noisy, with_threads};
use daic_correlate::phase::*;
use daic_correlate::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

/// Full scale of the noise stated as "1 %".
const NOISE: f64 = 2.55;

/// A displacement field.
type Field<'a> = dyn Fn(f64, f64) -> [f64; 2] + Sync + 'a;

/// Profile of the lines.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Lines {
    Sine,
    /// Bright and dark with edges, the bright part of a pitch.
    Square(f64),
}

/// A grating fixed to the material; two directions unless `line`.
#[derive(Debug, Clone, Copy)]
struct Grating {
    pitch: f64,
    angle: f64,
    lines: Lines,
    line: bool,
}

impl Grating {
    fn cross(pitch: f64, lines: Lines) -> Self {
        Self { pitch, angle: 0.0, lines, line: false }
    }

    /// Brightness 0…1 along one direction at phase `turns`.
    fn profile(&self, turns: f64) -> f64 {
        match self.lines {
            Lines::Sine => 0.5 + 0.5 * (TAU * turns).cos(),
            Lines::Square(duty) => f64::from((turns - turns.round()).abs() < 0.5 * duty),
        }
    }

    /// Turns of both directions at a material point.
    fn turns(&self, x: f64, y: f64) -> [f64; 2] {
        let (s, c) = self.angle.sin_cos();
        [(c * x + s * y) / self.pitch + 0.13, (c * y - s * x) / self.pitch - 0.27]
    }

    /// Integral over the pixel at (x, y), of the material displaced by `u` (Lagrangian).
    /// Within a pixel the material's position is linear.
    fn pixel(&self, x: f64, y: f64, u: &dyn Fn(f64, f64) -> [f64; 2]) -> f64 {
        let material = |x: f64, y: f64| {
            let (mut a, mut b) = (x, y);
            for _ in 0..60 {
                let d = u(a, b);
                let (na, nb) = (x - d[0], y - d[1]);
                let moved = (na - a).abs() + (nb - b).abs();
                (a, b) = (na, nb);
                if moved < 1e-12 {
                    break;
                }
            }
            (a, b)
        };
        let (x0, y0) = material(x, y);
        let ((x1, y1), (x2, y2)) = (material(x + 0.5, y), material(x, y + 0.5));
        let t = self.turns(x0, y0);
        let (tx, ty) = (self.turns(x1, y1), self.turns(x2, y2));
        // turns across the pixel along x and y, for both directions
        let steps = [0, 1].map(|k| (2.0 * (tx[k] - t[k]), 2.0 * (ty[k] - t[k])));
        match self.lines {
            Lines::Sine => {
                let sinc = |v: f64| if v.abs() < 1e-12 { 1.0 } else { (PI * v).sin() / (PI * v) };
                let wave = |t: f64, s: (f64, f64)| sinc(s.0) * sinc(s.1) * (TAU * t).cos();
                let (a, b) = (wave(t[0], steps[0]), wave(t[1], steps[1]));
                if self.line {
                    return 0.5 + 0.5 * a;
                }
                // cos a cos b has its own averages
                let sum = wave(t[0] + t[1], (steps[0].0 + steps[1].0, steps[0].1 + steps[1].1));
                let difference = wave(t[0] - t[1], (steps[0].0 - steps[1].0, steps[0].1 - steps[1].1));
                0.25 * (1.0 + a + b + 0.5 * (sum + difference))
            }
            Lines::Square(duty) => {
                // each direction changes along one axis only: exact
                if steps[0].1.abs() < 1e-9 && steps[1].0.abs() < 1e-9 {
                    let bright = |t: f64| t.round() * duty + (t - t.round()).clamp(-0.5 * duty, 0.5 * duty);
                    let mean = |t: f64, s: f64| (bright(t + 0.5 * s) - bright(t - 0.5 * s)) / s;
                    let a = mean(t[0], steps[0].0);
                    return if self.line { a } else { a * mean(t[1], steps[1].1) };
                }
                const N: usize = 16;
                let mut sum = 0.0;
                for j in 0..N {
                    for i in 0..N {
                        let at = |k: usize| (k as f64 + 0.5) / N as f64 - 0.5;
                        let p = |k: usize| self.profile(t[k] + at(i) * steps[k].0 + at(j) * steps[k].1);
                        sum += if self.line { p(0) } else { p(0) * p(1) };
                    }
                }
                sum / (N * N) as f64
            }
        }
    }

    /// Grey levels 8…247 of `n` × `n` pixels, without noise.
    fn grey(&self, n: usize, u: &Field<'_>) -> Vec<f64> {
        let row = |y: usize| -> Vec<f64> {
            (0..n).map(|x| 8.0 + 239.0 * self.pixel(x as f64, y as f64, u)).collect()
        };
        use rayon::prelude::*;
        (0..n).into_par_iter().map(row).collect::<Vec<_>>().concat()
    }
}

fn still(_: f64, _: f64) -> [f64; 2] {
    [0.0, 0.0]
}

/// Instead of a noise: grey levels as they are.
const NOT_ROUNDED: f64 = -1.0;

/// 8-bit image with noise of `sigma` grey levels.
fn recorded(n: usize, grey: &[f64], sigma: f64, rng: &mut ChaCha8Rng) -> Image {
    let grey = if sigma > 0.0 { noisy(grey, sigma, rng) } else { grey.to_vec() };
    if sigma == NOT_ROUNDED {
        return common::image(n, n, &grey);
    }
    let bytes: Vec<u8> = grey.iter().map(|g| g.round().clamp(0.0, 255.0) as u8).collect();
    Image::from_u8(n, n, &bytes).unwrap()
}

fn seeded(seed: u64) -> ChaCha8Rng {
    println!("noise seed {seed}");
    ChaCha8Rng::seed_from_u64(seed)
}

/// Bias, RMS and largest error of the valid pixels, u and v together, and how many are valid.
struct Errors {
    bias: f64,
    rms: f64,
    max: f64,
    valid: usize,
    sigma: f64,
}

fn compare(field: &PhaseField, truth: &dyn Fn(f64, f64) -> [f64; 2], line: bool) -> Errors {
    let mut e = [Vec::new(), Vec::new()];
    let mut sigma = 0.0;
    for (k, s) in field.status.iter().enumerate() {
        if !s.is_ok() {
            assert!(field.u[k].is_nan() && field.sigma_u[k].is_nan());
            continue;
        }
        let t = truth((k % field.width) as f64, (k / field.width) as f64);
        e[0].push(field.u[k] - t[0]);
        if !line {
            e[1].push(field.v[k] - t[1]);
        }
        sigma += f64::from(field.sigma_u[k]);
    }
    let valid = e[0].len();
    let bias = e.iter().filter(|v| !v.is_empty()).map(|v| mean_std(v).0.abs()).fold(0.0, f64::max);
    let all = e.concat();
    let rms = (all.iter().map(|v| v * v).sum::<f64>() / all.len() as f64).sqrt();
    let max = all.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    Errors { bias, rms, max, valid, sigma: sigma / valid as f64 }
}

fn measured(
    n: usize,
    grating: &Grating,
    sigma: f64,
    seed: u64,
    settings: &PhaseSettings,
    truth: &Field<'_>,
) -> Errors {
    let mut rng = seeded(seed);
    let a = recorded(n, &grating.grey(n, &still), sigma, &mut rng);
    let b = recorded(n, &grating.grey(n, truth), sigma, &mut rng);
    let (a, b) = (phase_maps(&a, None, settings).unwrap(), phase_maps(&b, None, settings).unwrap());
    let pair = PhasePair::new(&a, &b, [0.0, 0.0]).unwrap();
    compare(&pair.field(), truth, grating.line)
}

fn rotation(degrees: f64, n: usize) -> impl Fn(f64, f64) -> [f64; 2] + Sync {
    let (s, c) = degrees.to_radians().sin_cos();
    let m = 0.5 * (n as f64 - 1.0);
    move |x, y| {
        let (x, y) = (x - m, y - m);
        [c * x - s * y - x, s * x + c * y - y]
    }
}

#[test]
fn displacement_of_noisy_gratings_is_within_a_thousandth_of_a_pixel() {
    let n = 480;
    let m = 200.0;
    let translation = |_: f64, _: f64| [0.37, -0.21];
    let strain = move |x: f64, y: f64| [0.005 * (x - m), -0.0015 * (y - m)];
    let wave = |x: f64, y: f64| [0.3 * (TAU * x / 800.0).sin(), 0.2 * (TAU * y / 1000.0).cos()];
    let turn = rotation(2.0, n);
    let cases: [(&str, &Field<'_>); 4] = [
        ("translation", &translation),
        ("strain 0.5 %", &strain),
        ("rotation 2°", &turn),
        ("wave of 800 px", &wave),
    ];
    let mut seed = 1;
    for lines in [Lines::Sine, Lines::Square(0.5)] {
        let mut pooled = Vec::new();
        for pitch in [6.3, 8.37, 11.6] {
            let grating = Grating { line: true, ..Grating::cross(pitch, lines) };
            let settings = PhaseSettings::default();
            for (name, truth) in &cases {
                seed += 1;
                // lines along y see u alone: the truth along x
                if *name == "rotation 2°" {
                    continue;
                }
                let along = |x: f64, y: f64| [truth(x, y)[0], 0.0];
                let e = measured(n, &grating, NOISE, seed, &settings, &along);
                println!(
                    "{lines:?} line pitch {pitch} {name}: bias {:.1e} rms {:.2e} max {:.2e} px, σ {:.2e}, {} pixels",
                    e.bias, e.rms, e.max, e.sigma, e.valid
                );
                pooled.push(e.rms * e.rms);
                // largest seen 1.15e-3: a field holds few windows, its RMS scatters by a third
                assert!(e.rms <= 1.5e-3 && e.max < 6e-3, "{name} {pitch} {lines:?}");
            }
        }
        let rms = mean_std(&pooled).0.sqrt();
        println!("{lines:?}: {rms:.2e} px over all");
        assert!(rms <= 1e-3, "{lines:?}");
    }
    for lines in [Lines::Sine, Lines::Square(0.5)] {
        let mut pooled = Vec::new();
        let n = 400;
        for pitch in [6.3] {
            let grating = Grating::cross(pitch, lines);
            let settings = PhaseSettings { width: 5.0, ..PhaseSettings::default() };
            for (name, truth) in &cases {
                seed += 1;
                let e = measured(n, &grating, NOISE, seed, &settings, truth);
                println!(
                    "{lines:?} cross pitch {pitch} {name}: bias {:.1e} rms {:.2e} max {:.2e} px, σ {:.2e}, {} pixels",
                    e.bias, e.rms, e.max, e.sigma, e.valid
                );
                pooled.push(e.rms * e.rms);
                // largest seen 1.15e-3: a field holds few windows, its RMS scatters by a third
                assert!(e.rms <= 1.5e-3 && e.max < 6e-3, "{name} {pitch} {lines:?}");
            }
        }
        let rms = mean_std(&pooled).0.sqrt();
        println!("{lines:?}: {rms:.2e} px over all");
        assert!(rms <= 1e-3, "{lines:?}");
    }
}

/// Integer pitches make the harmonics of sharp lines coincide, after sampling, with the fundamental:
/// no window removes that, only lens blur or another pitch does.
#[test]
fn aliased_harmonics_of_sharp_lines_are_as_large_as_stated() {
    let n = 200;
    let worst = |pitch: f64, lines: Lines| {
        let grating = Grating { line: true, ..Grating::cross(pitch, lines) };
        let settings = PhaseSettings { noise: Some(0.1), ..PhaseSettings::default() };
        let error = |k: usize| {
            let u = k as f64 * 0.1;
            measured(n, &grating, NOT_ROUNDED, 1, &settings, &move |_: f64, _: f64| [u, 0.0]).max
        };
        (1..=5).map(error).fold(0.0, f64::max)
    };
    for pitch in [6.0, 8.0, 10.0, 7.3, 8.37, 9.7] {
        let (square, sine) = (worst(pitch, Lines::Square(0.5)), worst(pitch, Lines::Sine));
        println!("pitch {pitch}: square {square:.2e} px, sine {sine:.2e} px");
        if pitch.fract() == 0.0 {
            // 5th and 7th harmonic of a pitch of 6, 7th and 9th of 8, 9th and 11th of 10
            assert!((5e-3..4e-2).contains(&square), "{pitch}: {square}");
        } else {
            assert!(square < 1e-3, "{pitch}: {square}");
        }
        assert!(sine < 1e-4, "{pitch}: {sine}");
    }
}

#[test]
fn stated_uncertainty_is_the_scatter_of_noisy_repeats() {
    let (n, repeats) = (220, 40);
    for (window, width, pitch) in [
        (WindowKind::Gaussian, 1.0, 7.4),
        (WindowKind::GaussianFlat, 1.0, 7.4),
        (WindowKind::BiTriangular, 2.0, 8.0),
    ] {
        let grating = Grating { angle: 0.3, ..Grating::cross(pitch, Lines::Sine) };
        let grey = grating.grey(n, &still);
        let mut rng = seeded(7);
        let settings = PhaseSettings { window, width, ..PhaseSettings::default() };
        let at: Vec<usize> = (2..7).flat_map(|j| (2..7).map(move |i| j * 25 * n + i * 25)).collect();
        let mut phases = vec![Vec::new(); 2 * at.len()];
        let (mut stated, mut noise) = (0.0, 0.0);
        for _ in 0..repeats {
            // not rounded: the noise is exactly what is stated
            let image = common::image(n, n, &noisy(&grey, NOISE, &mut rng));
            let maps = phase_maps(&image, None, &settings).unwrap();
            noise += maps.noise / f64::from(repeats);
            for (d, map) in maps.directions.iter().enumerate() {
                for (i, &k) in at.iter().enumerate() {
                    phases[d * at.len() + i].push(map.wrapped(k));
                    stated += f64::from(map.sigma[k]) / f64::from(repeats) / phases_len(&at);
                }
            }
        }
        let scatter = (phases
            .iter()
            .map(|p| {
                // phases near ±π: about the first one
                let d: Vec<f64> = p.iter().map(|v| (v - p[0] + PI).rem_euclid(TAU) - PI).collect();
                let s = mean_std(&d).1;
                s * s * f64::from(repeats) / f64::from(repeats - 1)
            })
            .sum::<f64>()
            / phases.len() as f64)
            .sqrt();
        println!(
            "{window:?}: scatter {scatter:.3e} rad, stated {stated:.3e} rad, ratio {:.3}; noise {noise:.3} of {NOISE}",
            scatter / stated
        );
        // 50 phases of 40 repeats: the ratio itself scatters by 1.6 %, the noise is found 1 % too large
        assert!((scatter / stated - 1.0).abs() < 0.06);
        // the median of the spectrum counts the grating's own lines as noise
        assert!((noise / NOISE - 1.0).abs() < 0.05, "{noise}");
    }
}

fn phases_len(at: &[usize]) -> f64 {
    2.0 * at.len() as f64
}

#[test]
fn pitch_and_angle_of_every_kind_of_grating() {
    let n = 200;
    let mut rng = seeded(3);
    for (pitch, angle, lines, line) in [
        (8.37, 0.0, Lines::Sine, false),
        (8.0, 0.0, Lines::Square(0.5), false),
        (9.3, 0.1, Lines::Square(0.2), false),
        (9.3, 0.0, Lines::Square(0.8), true),
        (6.4, -0.6, Lines::Square(0.35), true),
        (5.2, 0.7, Lines::Sine, true),
        (12.0, 0.4, Lines::Square(0.5), false),
        (3.6, 0.2, Lines::Sine, false),
    ] {
        let grating = Grating { pitch, angle, lines, line };
        let image = recorded(n, &grating.grey(n, &still), NOISE, &mut rng);
        let found = find_carriers(&image, None, &PhaseSettings::default()).unwrap();
        println!("{grating:?}: {:?}", found.carriers);
        assert_eq!(found.carriers.len(), if line { 1 } else { 2 }, "{grating:?}");
        for (k, c) in found.carriers.iter().enumerate() {
            // a tenth of a bin of the 200 px transform
            let expected = (angle + 0.5 * PI * k as f64).sin_cos();
            let error = (c.fx - expected.1 / pitch).hypot(c.fy - expected.0 / pitch) * n as f64;
            assert!(error < 0.1, "{grating:?}: {error} bins");
        }
        let map =
            phase_maps(&image, None, &PhaseSettings { width: 1.5, ..PhaseSettings::default() }).unwrap();
        let c = map.directions[0].carrier;
        assert!((c.pitch() / pitch - 1.0).abs() < 1e-4 && (c.angle() - angle).abs() < 1e-3, "{c:?}");
        assert_eq!((map.directions[0].components, map.directions[0].residues), (1, 0));
    }
}

#[test]
fn strong_distortion_and_perspective_do_not_bias() {
    let n = 320;
    let m = 0.5 * (n as f64 - 1.0);
    // ±8 % of local pitch across the image by perspective, and 2 % barrel, which is 6 % of local pitch
    // at the middle of the edges
    let field = move |x: f64, y: f64| {
        let (a, b) = (x - m, y - m);
        let w = 1.0 / (1.0 + 0.04 * a / m);
        let r = 0.02 * (a * a + b * b) / (m * m);
        [a * w * (1.0 - r) - a, b * w * (1.0 - r) - b]
    };
    let grating = Grating::cross(8.37, Lines::Sine);
    let mut rng = seeded(5);
    let image = recorded(n, &grating.grey(n, &field), 0.0, &mut rng);
    let coordinates =
        phase_maps(&image, None, &PhaseSettings::default()).unwrap().grid_coordinates().unwrap();
    let mut errors = [Vec::new(), Vec::new()];
    for (k, valid) in coordinates.valid.iter().enumerate() {
        if !valid {
            continue;
        }
        let (x, y) = ((k % n) as f64, (k / n) as f64);
        let (mut a, mut b) = (x, y);
        for _ in 0..100 {
            let d = field(a, b);
            (a, b) = (x - d[0], y - d[1]);
        }
        let t = grating.turns(a, b);
        for (e, d) in errors.iter_mut().zip([coordinates.first[k] - t[0], coordinates.second[k] - t[1]]) {
            e.push(d);
        }
    }
    for e in &mut errors {
        let turns = e[0].round();
        e.iter_mut().for_each(|v| *v -= turns);
        let max = e.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        println!("{} pixels, largest error {:.2e} pitches = {:.2e} px", e.len(), max, max * grating.pitch);
        // largest seen 2.3e-3: what the polynomial of degree 5 misses, after the window
        assert!(e.len() > 25_000 && max * grating.pitch < 3e-3, "{max}");
    }
}

#[test]
fn crossings_lie_where_the_lines_cross() {
    let n = 200;
    let grating = Grating { angle: 0.05, ..Grating::cross(9.37, Lines::Sine) };
    let mut rng = seeded(9);
    let image = recorded(n, &grating.grey(n, &still), NOISE, &mut rng);
    let maps = phase_maps(&image, None, &PhaseSettings::default()).unwrap();
    let crossings = maps.crossings();
    let (mut pulls, mut origin) = (Vec::new(), None);
    for c in &crossings {
        let t = grating.turns(c.x, c.y);
        let [m, n] = t.map(f64::round);
        // indices count from another origin, the same for all
        let offset = (m as i64 - c.m, n as i64 - c.n);
        assert_eq!(*origin.get_or_insert(offset), offset);
        // turns to pixels: the grating is nearly along the axes
        pulls.push((t[0] - m) * grating.pitch / c.sigma_x);
        pulls.push((t[1] - n) * grating.pitch / c.sigma_y);
    }
    let (mean, std) = mean_std(&pulls);
    println!("{} crossings, pulls {mean:.2} ± {std:.2}", crossings.len());
    // the image less 3.5 · 2.5 pitches at each edge is nearly 4 pitches wide
    assert!((6..=16).contains(&crossings.len()));
    assert!(std < 2.0 && mean.abs() < 1.5);
}

#[test]
fn parts_of_a_mask_have_their_own_labels_and_whole_pitches() {
    let (n, pitch) = (240, 6.4);
    let grating = Grating::cross(pitch, Lines::Sine);
    let mut rng = seeded(4);
    let settings = PhaseSettings { width: 1.0, ..PhaseSettings::default() };
    let truth = |_: f64, _: f64| [13.0, -9.3];
    let (a, b) = (grating.grey(n, &still), grating.grey(n, &truth));
    let (a, b) = (recorded(n, &a, NOISE, &mut rng), recorded(n, &b, NOISE, &mut rng));
    let inside = (0..n * n).map(|k| !(100..105).contains(&(k % n))).collect();
    let mask = Mask::new(n, n, inside).unwrap();
    let a = phase_maps(&a, Some(&mask), &settings).unwrap();
    assert_eq!(a.directions[0].components, 2);
    assert_eq!(a.directions[0].status[120 * n + 95], Status::OutOfImage);
    let b = phase_maps(&b, None, &settings).unwrap();
    // more than a pitch: known only to whole pitches, found with a shift
    let pair = PhasePair::new(&a, &b, [12.0, -10.0]).unwrap();
    let e = compare(&pair.field(), &truth, false);
    println!("rms {:.2e} max {:.2e} px over {}", e.rms, e.max, e.valid);
    assert!(e.valid > 20_000 && e.max < 0.02);
    let near = compare(
        &PhasePair::new(&a, &b, [0.0, 0.0]).unwrap().field(),
        &|_, _| [13.0 - 2.0 * pitch, -9.3 + pitch],
        false,
    );
    assert!(near.max < 0.02, "{}", near.max);
    // at points, with derivatives
    let points = Points::scattered(vec![[60.25, 120.5], [102.0, 100.0], [500.0, 3.0]]).unwrap();
    let found = pair.points(&points);
    assert!((found[0].u - 13.0).abs() < 0.01 && (found[0].v + 9.3).abs() < 0.01);
    assert_eq!(found[0].solver, SolvedBy::Phase);
    assert!(found[0].shape.u[1].abs() < 1e-3 && found[0].shape.v[2].abs() < 1e-3);
    assert!(found[1].status == Status::OutOfImage && found[2].status == Status::OutOfImage);
    assert!(found[1].u.is_nan());
}

#[test]
fn same_bits_for_any_number_of_threads() {
    let n = 200;
    let grating = Grating::cross(7.7, Lines::Sine);
    let mut rng = seeded(11);
    let image = recorded(n, &grating.grey(n, &still), NOISE, &mut rng);
    let run = || {
        let maps = phase_maps(&image, None, &PhaseSettings::default()).unwrap();
        let field = PhasePair::new(&maps, &maps, [0.0, 0.0]).unwrap().field();
        let bits = |v: &[f64]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        let all: Vec<_> = maps.directions.iter().map(|d| bits(&d.phase)).chain([bits(&field.u)]).collect();
        (all, maps.crossings())
    };
    let one = with_threads(1, run);
    for threads in [2, 3] {
        assert!(one == with_threads(threads, run));
    }
}

#[test]
fn what_is_no_grating_is_refused() {
    let settings = PhaseSettings::default();
    let refused = |image: &Image, settings: &PhaseSettings| phase_maps(image, None, settings).unwrap_err();
    let constant = common::image(64, 64, &[12.0; 64 * 64]);
    assert!(matches!(refused(&constant, &settings), PhaseError::Constant { level: 12.0 }));
    let tiny = common::image(1, 1, &[12.0]);
    assert!(matches!(refused(&tiny, &settings), PhaseError::TooSmall { .. }));
    for seed in 1..5 {
        for n in [96, 200, 300] {
            let speckle = common::Speckles::new(seed, n, n);
            let image = common::image(n, n, &speckle.image(n, n, |_, _| (0.0, 0.0)));
            let e = refused(&image, &settings);
            assert!(matches!(e, PhaseError::NoPattern { .. }), "{e}");
        }
        let noise = common::image(200, 200, &noisy(&[100.0; 40_000], 5.0, &mut seeded(seed)));
        assert!(matches!(refused(&noise, &settings), PhaseError::NoPattern { .. }));
    }
    let ramp: Vec<f64> = (0..40_000).map(|k| f64::from(k % 200)).collect();
    assert!(matches!(refused(&common::image(200, 200, &ramp), &settings), PhaseError::NoPattern { .. }));
    let edge: Vec<f64> = (0..40_000).map(|k| if k % 200 < 90 { 20.0 } else { 200.0 }).collect();
    assert!(matches!(refused(&common::image(200, 200, &edge), &settings), PhaseError::NoPattern { .. }));
    let fine = Grating { line: true, ..Grating::cross(2.4, Lines::Sine) };
    let fine = recorded(128, &fine.grey(128, &still), 0.0, &mut seeded(1));
    assert!(matches!(refused(&fine, &settings), PhaseError::Aliased { .. }));
    let lines = Grating { line: true, ..Grating::cross(8.4, Lines::Sine) };
    let lines = recorded(128, &lines.grey(128, &still), NOISE, &mut seeded(1));
    let cross = PhaseSettings { gratings: Gratings::Cross, ..settings.clone() };
    assert!(matches!(refused(&lines, &cross), PhaseError::OneDirection { .. }));
    let wide = PhaseSettings { width: 5.0, ..settings.clone() };
    assert!(matches!(refused(&lines, &wide), PhaseError::WindowTooLarge { .. }));
    for bad in [f64::NAN, 0.1, f64::INFINITY] {
        let s = PhaseSettings { width: bad, ..settings.clone() };
        assert!(matches!(refused(&lines, &s), PhaseError::Range { name: "width", .. }));
    }
    let mask = Mask::new(64, 128, vec![true; 64 * 128]).unwrap();
    assert!(matches!(phase_maps(&lines, Some(&mask), &settings), Err(PhaseError::MaskSize { .. })));
    let other = Grating { line: true, angle: 1.2, ..Grating::cross(8.4, Lines::Sine) };
    let other = recorded(128, &other.grey(128, &still), NOISE, &mut seeded(2));
    let narrow = PhaseSettings { width: 1.0, ..settings };
    let (a, b) = (phase_maps(&lines, None, &narrow).unwrap(), phase_maps(&other, None, &narrow).unwrap());
    assert!(matches!(PhasePair::new(&a, &b, [0.0; 2]).err(), Some(PhaseError::DifferentGratings { .. })));
}
