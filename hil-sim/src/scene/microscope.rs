//! From a pixel to the chief ray at the specimen, through the microscope with a grating.
//!
//! The geometry and its conventions are those of `daic_optics::microscope`; the tracing is written apart from it
//! on purpose (see [`super::trace`]) and uses of it the numbers and the grating equation.

use daic_optics::grating::GratingFrame;
use daic_optics::microscope::Geometry;
use daic_optics::{Grating, SubstrateSide};
use nalgebra::Vector3;

use super::trace::{ObjectLine, View};
use crate::config::MicroscopeConfig;

/// A second height through which the straight line of a ray at the specimen is laid, millimetres.
const UPPER_MM: f64 = 0.05;
/// Far in front of any specimen: where lines begin, millimetres.
const IN_FRONT_MM: f64 = 10.0;

#[derive(Debug)]
struct Plate {
    frame: GratingFrame,
    normal: [f64; 3],
    grating: Grating,
}

/// The microscope, ready to trace.
#[derive(Debug)]
pub struct MicroscopeTracer {
    geometry: Geometry,
    plates: [Plate; 2],
    stop: [f64; 2],
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

impl MicroscopeTracer {
    /// Prepares the geometry for a sensor of `width` × `height` pixels.
    pub fn new(config: &MicroscopeConfig, width: usize, height: usize) -> Self {
        let geometry = config.geometry(width, height);
        let plate = |grating: Grating| {
            let [ax, ay, az] = grating.tilt_rad_xyz;
            // Third column of Rz·Ry·Rx.
            let (sz, cz) = az.sin_cos();
            let turned = [ay.sin() * ax.cos(), -ax.sin(), ay.cos() * ax.cos()];
            let normal = [cz * turned[0] - sz * turned[1], sz * turned[0] + cz * turned[1], turned[2]];
            Plate { frame: grating.frame(), normal, grating }
        };
        Self {
            plates: [plate(geometry.minus), plate(geometry.plus)],
            stop: config.field_mm.map(|side| 0.5 * side),
            geometry,
        }
    }

    /// Size of a pixel on the reference plane.
    pub fn pixel_mm(&self) -> f64 {
        let g = &self.geometry;
        (g.objective.pixel_mm / (g.objective.magnification * g.relay.magnification)).abs()
    }

    /// The chief ray at the specimen of the pixel position (`x_px`, `y_px`); `None` beyond the field stop or where
    /// the order does not propagate.
    #[inline]
    pub fn line(&self, view: View, x_px: f64, y_px: f64, wavelength_mm: f64) -> Option<ObjectLine> {
        let Geometry { relay, grating_to_image_mm, objective, .. } = &self.geometry;
        let scale = objective.pixel_mm / objective.magnification;
        let [x, y] = [(x_px - objective.axis_px[0]) * scale, (y_px - objective.axis_px[1]) * scale];
        // The chief ray x(z) = x (1 + κ₃ (z − z_f)), y(z) alike.
        let spread = objective.perspective_per_mm;
        let lean = [x * spread, y * spread];
        let length = (lean[0] * lean[0] + lean[1] * lean[1] + 1.0).sqrt();
        let k = [lean[0] / length, lean[1] / length, 1.0 / length];
        let at = [x - lean[0] * objective.focus_mm, y - lean[1] * objective.focus_mm, 0.0];

        let plate = &self.plates[view as usize];
        let n = plate.normal;
        let walk = -dot(at, n) / dot(k, n);
        let mut hit = [0, 1, 2].map(|i| at[i] + walk * k[i]);
        let out = plate.frame.diffract(Vector3::from(k), view.order(), wavelength_mm).ok()?;
        let out = [out.x, out.y, out.z];
        let glass = plate.grating.substrate;
        if glass.thickness_mm > 0.0 {
            // A plane plate moves a ray sideways by t (tan of the angle inside − tan of the angle outside).
            let d = match glass.side {
                SubstrateSide::Camera => k,
                SubstrateSide::Object => out,
            };
            let along = dot(d, n);
            let sin2 = 1.0 - along * along;
            let by = glass.thickness_mm * (1.0 / (glass.index * glass.index - sin2).sqrt() - 1.0 / along);
            for i in 0..3 {
                hit[i] += by * (d[i] - along * n[i]);
            }
        }

        // At the intermediate image of the reference plane stands the field stop.
        let axial = relay.magnification * relay.magnification / relay.index;
        let specimen = |h: f64| {
            let image_height = axial * h / (1.0 + relay.perspective_per_mm * h);
            let walk = (grating_to_image_mm - image_height - hit[2]) / out[2];
            let scale = (1.0 + relay.perspective_per_mm * h) / relay.magnification;
            [(hit[0] + walk * out[0]) * scale, (hit[1] + walk * out[1]) * scale, h]
        };
        let (upper, lower) = (specimen(UPPER_MM), specimen(0.0));
        if lower[0].abs() > self.stop[0] || lower[1].abs() > self.stop[1] {
            return None;
        }
        let towards = [0, 1, 2].map(|i| lower[i] - upper[i]);
        let length = dot(towards, towards).sqrt();
        let direction = towards.map(|c| c / length);
        Some(ObjectLine { origin: [0, 1, 2].map(|i| lower[i] - IN_FRONT_MM * direction[i]), direction })
    }
}
