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
            Lines::Square(_) => {
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
    fn grey(&self, n: usize, u: &(dyn Fn(f64, f64) -> [f64; 2] + Sync)) -> Vec<f64> {
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

/// 8-bit image with noise of `sigma` grey levels.
fn recorded(n: usize, grey: &[f64], sigma: f64, rng: &mut ChaCha8Rng) -> Image {
    let grey = if sigma > 0.0 { noisy(grey, sigma, rng) } else { grey.to_vec() };
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
    truth: &(dyn Fn(f64, f64) -> [f64; 2] + Sync),
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
    let n = 320;
    let m = 0.5 * (n as f64 - 1.0);
    let translation = |_: f64, _: f64| [0.37, -0.21];
    let strain = move |x: f64, y: f64| [0.005 * (x - m), -0.0015 * (y - m)];
    let wave = |x: f64, y: f64| [0.3 * (TAU * x / 400.0).sin(), 0.2 * (TAU * y / 500.0).cos()];
    let turn = rotation(2.0, n);
    let cases: [(&str, &(dyn Fn(f64, f64) -> [f64; 2] + Sync)); 4] = [
        ("translation", &translation),
        ("strain 0.5 %", &strain),
        ("rotation 2°", &turn),
        ("wave of 400 px", &wave),
    ];
    let mut seed = 1;
    for lines in [Lines::Sine, Lines::Square(0.5)] {
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
                assert!(e.rms <= 1e-3, "{name} {pitch} {lines:?}");
            }
        }
    }
    for lines in [Lines::Sine, Lines::Square(0.5)] {
        for pitch in [6.3, 8.37] {
            let grating = Grating::cross(pitch, lines);
            let settings = PhaseSettings { width: 3.5, ..PhaseSettings::default() };
            for (name, truth) in &cases {
                seed += 1;
                let e = measured(n, &grating, NOISE, seed, &settings, truth);
                println!(
                    "{lines:?} cross pitch {pitch} {name}: bias {:.1e} rms {:.2e} max {:.2e} px, σ {:.2e}, {} pixels",
                    e.bias, e.rms, e.max, e.sigma, e.valid
                );
                assert!(e.rms <= 1e-3, "{name} {pitch} {lines:?}");
            }
        }
    }
}
