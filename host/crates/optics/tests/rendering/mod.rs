//! Images of boards and spots, rendered here from their definitions.
#![allow(dead_code, reason = "each test program uses its part")]

use daic_optics::Camera;
use nalgebra::{Rotation3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A grey image, row-major.
#[derive(Clone)]
pub struct Image {
    pub width: usize,
    pub height: usize,
    pub data: Vec<f32>,
}

/// Where a board is: board coordinates (mm, z = 0) to the camera's.
#[derive(Clone, Copy)]
pub struct Pose {
    pub rotation: Rotation3<f64>,
    pub translation: Vector3<f64>,
}

impl Pose {
    /// Turned by angles in degrees (x, then y, then z), its origin at `translation`.
    pub fn new(degrees: [f64; 3], translation: [f64; 3]) -> Self {
        let [a, b, c] = degrees.map(f64::to_radians);
        let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), c)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), b)
            * Rotation3::from_axis_angle(&Vector3::x_axis(), a);
        Self { rotation, translation: Vector3::from(translation) }
    }

    /// Pixel of the board point (x, y).
    pub fn pixel(&self, camera: &Camera, board: [f64; 2]) -> [f64; 2] {
        let p = self.rotation * Vector3::new(board[0], board[1], 0.0) + self.translation;
        camera.pixel([p.x / p.z, p.y / p.z])
    }

    /// Board point that a pixel sees.
    pub fn board(&self, camera: &Camera, pixel: [f64; 2]) -> [f64; 2] {
        let q = camera.direction(pixel).expect("pixels of the tests can be undistorted");
        let ray = self.rotation.inverse() * Vector3::new(q[0], q[1], 1.0);
        let from = self.rotation.inverse() * self.translation;
        let t = from.z / ray.z;
        [ray.x * t - from.x, ray.y * t - from.y]
    }
}

/// Grey values integrated over each pixel: `pattern` takes board coordinates.
pub fn render(
    camera: &Camera,
    pose: &Pose,
    width: usize,
    height: usize,
    pattern: impl Fn([f64; 2]) -> f64,
) -> Image {
    // Board coordinates at the corners of the pixels; inside a pixel they are bilinear to 1e-6.
    let corners: Vec<[f64; 2]> = (0..(width + 1) * (height + 1))
        .map(|k| {
            let (x, y) = (k % (width + 1), k / (width + 1));
            pose.board(camera, [x as f64 - 0.5, y as f64 - 0.5])
        })
        .collect();
    const N: usize = 8;
    let data = (0..width * height)
        .map(|k| {
            let c = k / width * (width + 1) + k % width;
            let [a, b, d, e] = [c, c + 1, c + width + 1, c + width + 2].map(|i| corners[i]);
            // Where the corners and the middle agree the pixel is of one paint.
            let middle = [0, 1].map(|l| 0.25 * (a[l] + b[l] + d[l] + e[l]));
            let first = pattern(middle);
            if [a, b, d, e].into_iter().all(|c| pattern(c) == first) {
                return first as f32;
            }
            let mut sum = 0.0;
            for j in 0..N {
                let v = (j as f64 + 0.5) / N as f64;
                for i in 0..N {
                    let u = (i as f64 + 0.5) / N as f64;
                    let at = [0, 1].map(|l| {
                        (a[l] * (1.0 - u) + b[l] * u) * (1.0 - v) + (d[l] * (1.0 - u) + e[l] * u) * v
                    });
                    sum += pattern(at);
                }
            }
            (sum / (N * N) as f64) as f32
        })
        .collect();
    Image { width, height, data }
}

/// Share of dots' paint: `columns × rows` dots of the given radius and pitch, the first at (0, 0).
pub fn dots(columns: i32, rows: i32, pitch: f64, radius: f64) -> impl Fn([f64; 2]) -> f64 {
    move |[x, y]| {
        let (i, j) = ((x / pitch).round(), (y / pitch).round());
        let inside = i >= 0.0 && j >= 0.0 && i < f64::from(columns) && j < f64::from(rows);
        let r2 = (x - i * pitch).powi(2) + (y - j * pitch).powi(2);
        f64::from(u8::from(inside && r2 < radius * radius))
    }
}

/// Share of a checkerboard's paint: its `columns × rows` inner corners from (0, 0).
pub fn checker(columns: i32, rows: i32, pitch: f64) -> impl Fn([f64; 2]) -> f64 {
    move |[x, y]| {
        let (i, j) = ((x / pitch).floor() as i32, (y / pitch).floor() as i32);
        let inside = i >= -1 && j >= -1 && i < columns && j < rows;
        f64::from(u8::from(inside && (i + j).rem_euclid(2) == 0))
    }
}

impl Image {
    /// Blurred with a Gaussian.
    pub fn blurred(&self, sigma: f64) -> Self {
        let r = (4.0 * sigma).ceil() as i64;
        let raw: Vec<f64> = (-r..=r).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
        let sum: f64 = raw.iter().sum();
        let (w, h) = (self.width as i64, self.height as i64);
        let pass = |from: &[f32], dx: i64, dy: i64| -> Vec<f32> {
            (0..w * h)
                .map(|k| {
                    let (x, y) = (k % w, k / w);
                    let at = |n: i64| {
                        let (x, y) = ((x + n * dx).clamp(0, w - 1), (y + n * dy).clamp(0, h - 1));
                        f64::from(from[(y * w + x) as usize])
                    };
                    ((-r..=r).map(|n| raw[(n + r) as usize] * at(n)).sum::<f64>() / sum) as f32
                })
                .collect()
        };
        let data = pass(&pass(&self.data, 1, 0), 0, 1);
        Self { data, ..*self }
    }

    /// Paint under light: grey = light(x, y) · (ground + (paint − ground) · share), pixels as x, y.
    pub fn lit(&self, ground: f64, paint: f64, light: impl Fn(f64, f64) -> f64) -> Self {
        let data = self
            .data
            .iter()
            .enumerate()
            .map(|(k, s)| {
                let l = light((k % self.width) as f64, (k / self.width) as f64);
                (l * (ground + (paint - ground) * f64::from(*s))) as f32
            })
            .collect();
        Self { data, ..*self }
    }

    /// With Gaussian noise, in whole grey levels of a camera that saturates at `full`.
    pub fn recorded(&self, noise: f64, full: f64, seed: u64) -> Self {
        println!("seed {seed}");
        let mut random = Noise::new(seed);
        let data = self
            .data
            .iter()
            .map(|v| (f64::from(*v) + noise * random.normal()).round().clamp(0.0, full) as f32)
            .collect();
        Self { data, ..*self }
    }
}

/// Normal random numbers, reproducible.
pub struct Noise(ChaCha8Rng);

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    pub fn uniform(&mut self) -> f64 {
        self.0.random::<f64>()
    }

    pub fn normal(&mut self) -> f64 {
        let (a, b) = (self.uniform(), self.uniform());
        (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    }
}
