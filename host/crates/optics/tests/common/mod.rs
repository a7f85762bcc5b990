//! The golden macro set-up and a ray tracer that shares no code with the crate.
#![allow(dead_code, reason = "each test program uses its part")]

use daic_optics::{
    Brown, Camera, Grating, Optics, PixelPair, ReferenceFrame, Substrate, SubstrateSide, View,
};
use nalgebra::{DMatrix, DVector, Rotation3, Vector2, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The set-up of the golden frames.
pub fn golden() -> Optics {
    Optics {
        camera: Camera {
            focal_px: 17956.216577540104,
            principal_point_px: [1295.5, 971.5],
            brown: Brown::default(),
        },
        wavelength_mm: 633e-6,
        pinhole_to_grating_mm: 307.0,
        grating_to_reference_mm: 109.0,
        minus: Grating::square(1.0 / 300.0),
        plus: Grating::square(1.0 / 300.0),
        reference: Default::default(),
    }
}

/// Everything at once: two gratings tilted differently, glass on either side, a distorting lens.
pub fn awkward() -> Optics {
    let mut o = golden();
    o.camera.brown = Brown { k1: -0.35, k2: 1.2, k3: -2.0, p1: 6e-4, p2: -9e-4 };
    o.minus.tilt_rad_xyz = [0.03, -0.045, 0.012];
    o.minus.substrate = Substrate { thickness_mm: 3.0, index: 1.517, side: SubstrateSide::Object };
    o.plus.tilt_rad_xyz = [-0.02, 0.05, 0.011];
    o.plus.pitch_mm *= 1.001;
    o.plus.offset_mm = 1.7;
    o.plus.substrate = Substrate { thickness_mm: 2.0, index: 1.46, side: SubstrateSide::Camera };
    o.reference = ReferenceFrame { tilt_rad_xyz: [0.02, -0.03, 0.15], origin_mm: [0.4, -0.7] };
    o
}

/// Snell's law in vector form at a surface of unit normal `n` (along the light).
fn refract(d: Vector3<f64>, n: Vector3<f64>, ratio: f64) -> Vector3<f64> {
    let c = d.dot(&n);
    let c2 = (1.0 - ratio * ratio * (1.0 - c * c)).sqrt();
    d * ratio + n * (c2 - ratio * c)
}

/// Follows the ray of ideal direction (q, 1) surface by surface. Returns a point in the air behind
/// the grating and the unit direction there; world coordinates.
pub fn trace(o: &Optics, view: View, q: [f64; 2]) -> (Vector3<f64>, Vector3<f64>) {
    let g = match view {
        View::Minus => &o.minus,
        View::Plus => &o.plus,
    };
    let [a, b, c] = g.tilt_rad_xyz;
    let r = Rotation3::from_axis_angle(&Vector3::z_axis(), c)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), b)
        * Rotation3::from_axis_angle(&Vector3::x_axis(), a);
    let n = r * Vector3::z();
    let pivot = Vector3::new(0.0, 0.0, o.pinhole_to_grating_mm + g.offset_mm);
    let t = g.substrate.thickness_mm;
    let index = g.substrate.index;
    // The left view bends towards +x, the right one towards −x.
    let sign = match view {
        View::Minus => 1.0,
        View::Plus => -1.0,
    };
    let kick = r * Vector3::x() * (sign * o.wavelength_mm / g.pitch_mm);
    let to_plane =
        |p: Vector3<f64>, d: Vector3<f64>, at: Vector3<f64>| p + d * ((at - p).dot(&n) / d.dot(&n));
    // Wave vector behind the grooves in a medium of the given index, from the tangential part.
    let leave = |tangential: Vector3<f64>, medium: f64| {
        (tangential + n * (medium * medium - tangential.norm_squared()).sqrt()) / medium
    };
    let d = Vector3::new(q[0], q[1], 1.0).normalize();
    match g.substrate.side {
        SubstrateSide::Camera => {
            let front = to_plane(Vector3::zeros(), d, pivot - n * t);
            let inside = refract(d, n, 1.0 / index);
            let grooves = to_plane(front, inside, pivot);
            let wave = inside * index;
            let tangential = wave - n * wave.dot(&n) + kick;
            (grooves, leave(tangential, 1.0))
        }
        SubstrateSide::Object => {
            let grooves = to_plane(Vector3::zeros(), d, pivot);
            let tangential = d - n * d.dot(&n) + kick;
            let inside = leave(tangential, index);
            let back = to_plane(grooves, inside, pivot + n * t);
            (back, refract(inside, n, index))
        }
    }
}

/// Pixel of an ideal direction, Brown's terms written out once more.
pub fn pixel(o: &Optics, [x, y]: [f64; 2]) -> [f64; 2] {
    let b = &o.camera.brown;
    let r2 = x * x + y * y;
    let m = 1.0 + b.k1 * r2 + b.k2 * r2.powi(2) + b.k3 * r2.powi(3);
    let dx = x * m + 2.0 * b.p1 * x * y + b.p2 * (r2 + 2.0 * x * x);
    let dy = y * m + b.p1 * (r2 + 2.0 * y * y) + 2.0 * b.p2 * x * y;
    [
        dx * o.camera.focal_px + o.camera.principal_point_px[0],
        dy * o.camera.focal_px + o.camera.principal_point_px[1],
    ]
}

/// Pixel that sees the object point (x, y, h): secant Newton on [`trace`].
pub fn see(o: &Optics, view: View, p: Vector3<f64>) -> [f64; 2] {
    let [a, b, c] = o.reference.tilt_rad_xyz;
    let r = Rotation3::from_axis_angle(&Vector3::z_axis(), c)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), b)
        * Rotation3::from_axis_angle(&Vector3::x_axis(), a);
    let [ox, oy] = o.reference.origin_mm;
    let p = Vector3::new(ox, oy, o.pinhole_to_grating_mm + o.grating_to_reference_mm)
        + r * Vector3::new(p.x, p.y, -p.z);
    let z = p.z;
    let miss = |q: [f64; 2]| {
        let (at, d) = trace(o, view, q);
        let hit = at + d * ((z - at.z) / d.z);
        Vector2::new(hit.x - p.x, hit.y - p.y)
    };
    let side = match view {
        View::Minus => -1.0,
        View::Plus => 1.0,
    };
    let mut q = [(p.x + side * 21.0) / 420.0, p.y / 420.0];
    let e = 1e-6;
    for _ in 0..12 {
        let m = miss(q);
        let dx = (miss([q[0] + e, q[1]]) - m) / e;
        let dy = (miss([q[0], q[1] + e]) - m) / e;
        let det = dx.x * dy.y - dy.x * dx.y;
        q[0] -= (m.x * dy.y - m.y * dy.x) / det;
        q[1] -= (dx.x * m.y - dx.y * m.x) / det;
    }
    pixel(o, q)
}

/// Both pixels of an object point, by [`see`].
pub fn see_both(o: &Optics, p: Vector3<f64>) -> PixelPair {
    PixelPair { minus_px: see(o, View::Minus, p), plus_px: see(o, View::Plus, p) }
}

/// Points 1 mm apart over ±10 × ±8 mm on the surface `h`.
pub fn field(h: impl Fn(f64, f64) -> f64) -> Vec<Vector3<f64>> {
    let mut points = Vec::new();
    for i in -10..=10 {
        for j in -8..=8 {
            let (x, y) = (f64::from(i), f64::from(j));
            points.push(Vector3::new(x, y, h(x, y)));
        }
    }
    points
}

pub fn rms(values: impl IntoIterator<Item = f64>) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0_f64);
    for v in values {
        sum += v * v;
        n += 1.0;
    }
    (sum / n).sqrt()
}

/// Least-squares coefficients of `rows · c = values` and the residuals.
pub fn least_squares(rows: &[Vec<f64>], values: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let a = DMatrix::from_fn(rows.len(), rows[0].len(), |i, j| rows[i][j]);
    let b = DVector::from_column_slice(values);
    let c = (a.transpose() * &a).try_inverse().expect("independent columns") * a.transpose() * &b;
    let r = &b - a * &c;
    (c.iter().copied().collect(), r.iter().copied().collect())
}

/// Normal random numbers, reproducible; prints its seed.
pub struct Normal(ChaCha8Rng);

impl Normal {
    pub fn new(seed: u64) -> Self {
        println!("seed {seed}");
        Self::quiet(seed)
    }

    /// The same where seeds are counted through.
    pub fn quiet(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    pub fn next(&mut self) -> f64 {
        let (a, b) = (self.uniform(), self.uniform());
        (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    }

    /// In [0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.0.random::<f64>()
    }

    pub fn index(&mut self, n: usize) -> usize {
        (self.0.next_u64() % n as u64) as usize
    }
}
