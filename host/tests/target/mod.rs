//! Images of a flat line target by a distorting camera, with exact answers.
//!
//! Lines are square waves, blurred by a diffraction-limited lens and integrated over the pixels. The
//! lens passes nothing beyond its cut-off, so each pixel is a finite Fourier sum; the phase is taken
//! as linear within the few pixels that the lens spreads.

use rayon::prelude::*;
use std::f64::consts::{PI, TAU};
use std::path::Path;

/// Cut-off of an f/8 lens at 633 nm on pixels of 2.2 µm, cycles per pixel.
const CUT_OFF: f64 = 2.2 / (0.633 * 8.0);

/// Where a target lies.
#[derive(Clone, Copy, Debug)]
pub struct Pose {
    /// Turn in its plane and out of it about x and about y, degrees.
    pub turn_deg: f64,
    pub tilt_deg: [f64; 2],
}

/// One degree in the plane and one out of it.
pub const POSE: Pose = Pose { turn_deg: 1.0, tilt_deg: [0.6, -0.8] };
/// Another of the same size, for the other exposure.
pub const OTHER: Pose = Pose { turn_deg: -1.0, tilt_deg: [-1.0, 0.0] };

/// A camera with its distortions, in front of a target.
#[derive(Clone, Debug)]
pub struct Scene {
    pub size: [usize; 2],
    pub focal: f64,
    pub centre: [f64; 2],
    /// k1, k2, k3, p1, p2.
    pub brown: [f64; 5],
    /// Sensor defects: centre, standard deviation, (e_x, e_y) at the centre.
    pub defects: Vec<([f64; 2], f64, [f64; 2])>,
    /// e_x more: amplitude and period along x.
    pub wave: Option<(f64, f64)>,
    /// Line distance at the middle, pixels.
    pub pitch: f64,
}

/// What an image shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lines {
    CrossedByX,
    CrossedByY,
    Both,
}

impl Scene {
    /// Brown's distortion of 0.3 % in the corner, defects of 0.05 px with a standard deviation of `width` px.
    pub fn usual(size: [usize; 2], width: f64) -> Self {
        let [w, h] = size.map(|s| s as f64);
        let focal = 6.7 * w;
        let corner = 0.5 * w.hypot(h) / focal;
        let spread =
            [(0.17, 0.23), (0.5, 0.3), (0.8, 0.2), (0.3, 0.7), (0.62, 0.62), (0.85, 0.8), (0.12, 0.85)];
        let defects = spread
            .into_iter()
            .enumerate()
            .map(|(k, (x, y))| {
                let angle = 1.3 * k as f64;
                ([x * w, y * h], width * (1.0 + 0.1 * k as f64), [0.05 * angle.cos(), 0.05 * angle.sin()])
            })
            .collect();
        Self {
            size,
            focal,
            centre: [0.5 * (w - 1.0) + 9.0, 0.5 * (h - 1.0) - 6.0],
            brown: [-0.0027 / corner.powi(2), -0.0003 / corner.powi(4), 0.0, 1.2e-4, -0.8e-4],
            defects,
            wave: None,
            pitch: 10.3,
        }
    }

    /// Distortion of the sensor (defects and wave) at an observed pixel.
    fn sensor(&self, o: [f64; 2]) -> [f64; 2] {
        let mut e = [0.0; 2];
        for (c, s, a) in &self.defects {
            let g = (-0.5 * ((o[0] - c[0]).powi(2) + (o[1] - c[1]).powi(2)) / (s * s)).exp();
            e = [e[0] + a[0] * g, e[1] + a[1] * g];
        }
        if let Some((a, period)) = self.wave {
            e[0] += a * (TAU * o[0] / period).cos();
        }
        e
    }

    /// Direction that an observed pixel sees.
    pub fn direction(&self, o: [f64; 2]) -> [f64; 2] {
        let e = self.sensor(o);
        let seen = [0, 1].map(|i| (o[i] - e[i] - self.centre[i]) / self.focal);
        let [k1, k2, k3, p1, p2] = self.brown;
        let mut q = seen;
        // The distortion is small and smooth: each round gains two digits.
        for _ in 0..12 {
            let [x, y] = q;
            let r2 = x * x + y * y;
            let radial = r2 * (k1 + r2 * (k2 + r2 * k3));
            let d = [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ];
            q = [seen[0] - d[0], seen[1] - d[1]];
        }
        q
    }

    /// Both phases of the target at an observed pixel, turns.
    pub fn turns(&self, pose: &Pose, o: [f64; 2]) -> [f64; 2] {
        let [qx, qy] = self.direction(o);
        let [ax, ay] = pose.tilt_deg.map(|a| a.to_radians().sin_cos());
        let (sz, cz) = pose.turn_deg.to_radians().sin_cos();
        // Columns of Rx·Ry after a turn in the plane: the target's axes in the camera's frame.
        let tilted = |x: f64, y: f64| {
            let (x, z) = (ay.1 * x, -ay.0 * x);
            [x, ax.1 * y - ax.0 * z, ax.0 * y + ax.1 * z]
        };
        let (a, b) = (tilted(cz, sz), tilted(-sz, cz));
        let n = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        // The plane holds (0, 0, 1), at the distance that makes a line distance `pitch` pixels.
        let t = n[2] / (n[0] * qx + n[1] * qy + n[2]);
        let p = [t * qx, t * qy, t - 1.0];
        let dot = |v: [f64; 3]| v[0] * p[0] + v[1] * p[1] + v[2] * p[2];
        [dot(a), dot(b)].map(|v| v * self.focal / self.pitch)
    }

    /// Brightness 0…1 of every pixel, row by row.
    pub fn brightness(&self, pose: &Pose, lines: Lines) -> Vec<f64> {
        brightness(self.size, lines, &|o| self.turns(pose, o))
    }
}

/// Brightness of a target whose phases (turns) at a pixel are known.
pub fn brightness(
    [w, h]: [usize; 2],
    lines: Lines,
    turns: &(dyn Fn([f64; 2]) -> [f64; 2] + Sync),
) -> Vec<f64> {
    let stride = w + 2;
    let all: Vec<[f64; 2]> = (0..stride * (h + 2))
        .into_par_iter()
        .map(|k| turns([(k % stride) as f64 - 1.0, (k / stride) as f64 - 1.0]))
        .collect();
    (0..w * h)
        .into_par_iter()
        .map(|k| {
            let at = (k / w + 1) * stride + k % w + 1;
            let t = all[at];
            let slope = |d: usize| {
                [0.5 * (all[at + 1][d] - all[at - 1][d]), 0.5 * (all[at + stride][d] - all[at - stride][d])]
            };
            match lines {
                Lines::CrossedByX => line(t[0], slope(0)),
                Lines::CrossedByY => line(t[1], slope(1)),
                Lines::Both => cross(t, [slope(0), slope(1)]),
            }
        })
        .collect()
}

/// What is left of a wave of `f` cycles per pixel after lens and pixel.
fn passed(f: [f64; 2]) -> f64 {
    let nu = f[0].hypot(f[1]) / CUT_OFF;
    if nu >= 1.0 {
        return 0.0;
    }
    let sinc = |v: f64| if v.abs() < 1e-9 { 1.0 } else { (PI * v).sin() / (PI * v) };
    2.0 / PI * (nu.acos() - nu * (1.0 - nu * nu).sqrt()) * sinc(f[0]) * sinc(f[1])
}

/// Fourier coefficient of a square wave between 0 and 1, bright at whole turns.
fn harmonic(m: i32) -> f64 {
    if m == 0 { 0.5 } else { (0.5 * PI * f64::from(m)).sin() / (PI * f64::from(m)) }
}

/// Lines of pitch 6 px and more have nothing beyond the third harmonic within the cut-off; 9 is ample.
const MOST: i32 = 9;

fn line(t: f64, slope: [f64; 2]) -> f64 {
    let wave =
        |m: i32| 2.0 * harmonic(m) * passed(slope.map(|s| s * f64::from(m))) * (TAU * f64::from(m) * t).cos();
    0.5 + (1..=MOST).step_by(2).map(wave).sum::<f64>()
}

fn cross(t: [f64; 2], slope: [[f64; 2]; 2]) -> f64 {
    let mut sum = 0.0;
    for m in -MOST..=MOST {
        for n in -MOST..=MOST {
            let c = harmonic(m) * harmonic(n);
            if c.abs() < 1e-12 {
                continue;
            }
            let (m, n) = (f64::from(m), f64::from(n));
            let f = [0, 1].map(|i| m * slope[0][i] + n * slope[1][i]);
            sum += c * passed(f) * (TAU * (m * t[0] + n * t[1])).cos();
        }
    }
    sum
}

/// Normal noise, always the same for a seed.
pub struct Noise(u64);

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Evenly between 0 and 1.
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (TAU * self.uniform()).cos()
    }
}

/// Grey levels of 8 bits, 20 to 220, with noise of 1 % of full scale.
pub fn grey(brightness: &[f64], noise: &mut Noise) -> Vec<u8> {
    brightness
        .iter()
        .map(|b| (20.0 + 200.0 * b + 2.55 * noise.normal()).round().clamp(0.0, 255.0) as u8)
        .collect()
}

pub fn save(path: &Path, [w, h]: [usize; 2], grey: Vec<u8>) {
    image::GrayImage::from_raw(w as u32, h as u32, grey).unwrap().save(path).unwrap();
}
