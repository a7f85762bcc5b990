//! From a pixel to the straight line behind the grating.
//!
//! Written apart from the decoders on purpose: of `daic-optics` it uses the grating equation and
//! nothing else, so that an error in one of the two is not cancelled by the same error in the other.

use daic_optics::grating::{Grating, GratingFrame};
use nalgebra::Vector3;

use crate::config::{GratingConfig, OpticsConfig};

/// Which of the two first-order views.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum View {
    /// Left half of the sensor; traced from the pinhole its rays take order m = +1.
    Minus,
    /// Right half of the sensor; m = −1.
    Plus,
}

impl View {
    pub(super) const fn order(self) -> f64 {
        match self {
            Self::Minus => 1.0,
            Self::Plus => -1.0,
        }
    }
}

/// A line in object coordinates: x right, y down, h towards the camera, origin where the optical
/// axis meets the reference plane.
#[derive(Debug, Clone, Copy)]
pub struct ObjectLine {
    /// Where the ray leaves grating and substrate.
    pub origin: [f64; 3],
    /// Unit direction towards the object.
    pub direction: [f64; 3],
}

#[derive(Debug)]
struct Plate {
    frame: GratingFrame,
    normal: [f64; 3],
    thickness: f64,
    index: f64,
}

impl Plate {
    fn new(config: &GratingConfig) -> Self {
        let [ax, ay, az] = config.tilt_rad;
        let (sx, cx) = ax.sin_cos();
        // Third column of Rz·Ry·Rx: Rx turns z to (0, −sin, cos), then Ry, then Rz.
        let (sy, cy) = ay.sin_cos();
        let (sz, cz) = az.sin_cos();
        let turned = [sy * cx, -sx, cy * cx];
        let normal = [cz * turned[0] - sz * turned[1], sz * turned[0] + cz * turned[1], turned[2]];
        let grating = Grating { tilt_rad_xyz: config.tilt_rad, ..Grating::square(config.pitch_mm) };
        Self { frame: grating.frame(), normal, thickness: config.substrate_mm, index: config.substrate_index }
    }
}

/// Camera and gratings, ready to trace.
#[derive(Debug)]
pub struct Tracer {
    focal_px: f64,
    principal: [f64; 2],
    k: [f64; 3],
    p: [f64; 2],
    distorted: bool,
    pinhole_to_grating: f64,
    reference: f64,
    plates: [Plate; 2],
}

impl Tracer {
    /// Prepares the geometry for a sensor of `width` × `height` pixels.
    pub fn new(config: &OpticsConfig, width: usize, height: usize) -> Self {
        let centre = [(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0];
        Self {
            focal_px: config.focal_px,
            principal: config.principal_point_px.unwrap_or(centre),
            k: config.brown_k,
            p: config.brown_p,
            distorted: config.brown_k != [0.0; 3] || config.brown_p != [0.0; 2],
            pinhole_to_grating: config.pinhole_to_grating_mm,
            reference: config.pinhole_to_grating_mm + config.grating_to_reference_mm,
            plates: [
                Plate::new(&config.grating),
                Plate::new(config.grating_plus.as_ref().unwrap_or(&config.grating)),
            ],
        }
    }

    /// Size of a pixel on the reference plane without the grating's stretch, (s + d)/F: a lower bound.
    pub fn pixel_mm(&self) -> f64 {
        self.reference / self.focal_px
    }

    /// The line behind the grating that the pixel position (`x_px`, `y_px`) looks along in light of
    /// `wavelength_mm`; `None` if the ray misses the grating's front or the order does not propagate.
    #[inline]
    pub fn line(&self, view: View, x_px: f64, y_px: f64, wavelength_mm: f64) -> Option<ObjectLine> {
        let observed =
            [(x_px - self.principal[0]) / self.focal_px, (y_px - self.principal[1]) / self.focal_px];
        let [x, y] = if self.distorted { self.undistort(observed) } else { observed };
        let plate = &self.plates[view as usize];
        let n = plate.normal;
        let length = (x * x + y * y + 1.0).sqrt();
        let k = [x / length, y / length, 1.0 / length];

        // Pinhole to grating plane n·(P − (0, 0, s)) = 0.
        let towards = n[0] * k[0] + n[1] * k[1] + n[2] * k[2];
        if towards <= 0.0 {
            return None;
        }
        let walk = n[2] * self.pinhole_to_grating / towards;
        let out = plate.frame.diffract(Vector3::from(k), view.order(), wavelength_mm).ok()?;
        let mut at = [walk * k[0], walk * k[1], walk * k[2]];
        if plate.thickness > 0.0 {
            // In the glass the component along the faces is that in air over the index; the faces
            // are parallel, so the direction behind is that of no glass at all.
            let along = n[0] * out.x + n[1] * out.y + n[2] * out.z;
            let side = [out.x - along * n[0], out.y - along * n[1], out.z - along * n[2]];
            let sin2 =
                (side[0] * side[0] + side[1] * side[1] + side[2] * side[2]) / (plate.index * plate.index);
            let per_thickness = 1.0 / (plate.index * (1.0 - sin2).sqrt());
            for i in 0..3 {
                at[i] += plate.thickness * (n[i] + side[i] * per_thickness);
            }
        }
        Some(ObjectLine { origin: [at[0], at[1], self.reference - at[2]], direction: [out.x, out.y, -out.z] })
    }

    /// Inverse of Brown's model by Newton's method, to the last digit within the field of a lens.
    fn undistort(&self, observed: [f64; 2]) -> [f64; 2] {
        let [k1, k2, k3] = self.k;
        let [p1, p2] = self.p;
        let [mut x, mut y] = observed;
        for _ in 0..20 {
            let r2 = x * x + y * y;
            let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
            let slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3));
            let fx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - observed[0];
            let fy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - observed[1];
            let xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x;
            let yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x;
            let xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
            let det = xx * yy - xy * xy;
            let (dx, dy) = ((yy * fx - xy * fy) / det, (xx * fy - xy * fx) / det);
            x -= dx;
            y -= dy;
            if dx.abs() + dy.abs() < 1e-15 {
                break;
            }
        }
        [x, y]
    }
}
