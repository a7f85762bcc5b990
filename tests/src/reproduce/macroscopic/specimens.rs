//! The specimens of chapter 2.

use super::super::ReproduceError;
use super::rig::PIXEL_MM;
use daic_hil_sim::config::SurfaceConfig;
use daic_optics::{OpticalModel, View};
use image::{ImageBuffer, Luma};
use nalgebra::Vector3;
use std::f64::consts::FRAC_PI_2;
use std::path::Path;

/// Height of the step, mm.
pub const STEP_MM: f64 = 1.46;
/// Points closer to the cone's tip than this have a subset that holds it, px: half a subset.
pub const TIP_PX: f64 = 30.0;
/// What the error of a step may reach, px.
pub const CONFINED_PX: f64 = 8.0;

/// Where a specimen is not smooth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Edge {
    /// Nowhere.
    None,
    /// At the cone's tip.
    Tip,
    /// On a line: coordinate 0 (x) or 1 (y) of the object is 0 there.
    Wall(usize),
}

/// A specimen.
#[derive(Clone, Debug)]
pub struct Specimen {
    /// Its name in tables.
    pub name: &'static str,
    /// Its name in files.
    pub file: &'static str,
    /// Its surface.
    pub surface: SurfaceConfig,
    /// Where it is not smooth.
    pub edge: Edge,
}

/// Cylinder of 36.00 mm.
pub fn cylinder() -> Specimen {
    let surface = SurfaceConfig::Cylinder { radius_mm: 36.0, apex_mm: 0.7, floor_mm: None };
    Specimen { name: "cylinder, R = 36.00 mm", file: "cylinder", surface, edge: Edge::None }
}

/// Cone with a half-apex angle of 76.16°.
pub fn cone() -> Specimen {
    let slope = 1.0 / 76.16f64.to_radians().tan();
    let surface = SurfaceConfig::Cone { apex_mm: 1.6, slope, floor_mm: None };
    Specimen { name: "cone, 76.16°", file: "cone", surface, edge: Edge::Tip }
}

/// Step of 1.46 mm whose edge runs along x, or along y: there each view sees something that is hidden
/// from the other.
pub fn step(edge_along_x: bool) -> Specimen {
    let surface = |direction_rad| SurfaceConfig::Step {
        x_mm: 0.0,
        low_mm: -0.5 * STEP_MM,
        high_mm: 0.5 * STEP_MM,
        direction_rad,
    };
    if edge_along_x {
        let name = "step, 1.46 mm, edge along x";
        Specimen { name, file: "step", surface: surface(FRAC_PI_2), edge: Edge::Wall(1) }
    } else {
        let name = "step, 1.46 mm, edge along y";
        Specimen { name, file: "step-y", surface: surface(0.0), edge: Edge::Wall(0) }
    }
}

/// Height of the face-like form, mm: forehead and cheeks, eye sockets, nose, lips, chin.
pub fn face_mm(x: f64, y: f64) -> f64 {
    let bump = |height: f64, cx: f64, cy: f64, sx: f64, sy: f64| {
        height * (-0.5 * (((x - cx) / sx).powi(2) + ((y - cy) / sy).powi(2))).exp()
    };
    -1.3 + bump(2.0, 0.0, 0.0, 7.5, 9.0) + bump(0.9, 0.0, 0.4, 1.3, 2.2) + bump(0.5, 0.0, 1.9, 1.5, 1.1)
        - bump(0.55, -3.4, -2.2, 1.7, 1.2)
        - bump(0.55, 3.4, -2.2, 1.7, 1.2)
        + bump(0.35, 0.0, 4.6, 2.0, 0.9)
        + bump(0.4, 0.0, 7.6, 2.2, 1.5)
        + bump(0.25, -4.6, 2.2, 2.2, 2.2)
        + bump(0.25, 4.6, 2.2, 2.2, 2.2)
}

/// The face-like form as a height map of 16 bits in `folder`: 0.07 µm per grey value.
///
/// # Errors
/// If the file cannot be written.
pub fn face(folder: &Path) -> Result<Specimen, ReproduceError> {
    const N: u32 = 241;
    const PITCH_MM: f64 = 0.1;
    let (low, high) = (-2.0, 2.5);
    let path = folder.join("face.png");
    let map = ImageBuffer::<Luma<u16>, _>::from_fn(N, N, |i, j| {
        let at = |k: u32| (f64::from(k) - 0.5 * f64::from(N - 1)) * PITCH_MM;
        Luma([((face_mm(at(i), at(j)) - low) / (high - low) * 65_535.0).round() as u16])
    });
    map.save(&path).map_err(|source| ReproduceError::HeightMap { path: path.clone(), source })?;
    let surface = SurfaceConfig::HeightMap { file: path, pixel_mm: PITCH_MM, black_mm: low, white_mm: high };
    Ok(Specimen { name: "face-like form", file: "face", surface, edge: Edge::None })
}

impl Specimen {
    /// Distance (px of the −1 view) of a pixel that sees about `point_mm` from the specimen's discontinuity;
    /// for a wall from its image and from what beside it one view alone sees. Infinite without any.
    ///
    /// # Errors
    /// A ray.
    pub fn edge_distance_px(
        &self,
        truth: &OpticalModel,
        minus_px: [f64; 2],
        point_mm: [f64; 3],
    ) -> Result<f64, ReproduceError> {
        let across = match self.edge {
            Edge::None => return Ok(f64::INFINITY),
            Edge::Tip => return Ok(point_mm[0].hypot(point_mm[1]) / PIXEL_MM),
            Edge::Wall(across) => across,
        };
        let at = |h: f64| {
            let mut p = Vector3::new(point_mm[0], point_mm[1], h);
            p[across] = 0.0;
            p
        };
        let (foot, top) = (at(-0.5 * STEP_MM), at(0.5 * STEP_MM));
        let mut zone = vec![truth.project(View::Minus, foot)?, truth.project(View::Minus, top)?];
        // where the line of sight of the +1 view over the upper edge meets the lower level
        let over = truth.project(View::Plus, top)?;
        let shadow = truth.point_at_height(View::Plus, over, foot[2])?;
        if shadow[across] < 0.0 {
            zone.push(truth.project(View::Minus, shadow)?);
        }
        let places = || zone.iter().map(|q| q[across]);
        let (from, to) = (places().fold(f64::INFINITY, f64::min), places().fold(f64::NEG_INFINITY, f64::max));
        let here = minus_px[across];
        Ok((from - here).max(here - to).max(0.0))
    }

    /// Whether a point is away from discontinuities.
    ///
    /// # Errors
    /// A ray.
    pub fn is_smooth(
        &self,
        truth: &OpticalModel,
        minus_px: [f64; 2],
        point_mm: [f64; 3],
    ) -> Result<bool, ReproduceError> {
        let least = match self.edge {
            Edge::None => return Ok(true),
            Edge::Tip => TIP_PX,
            Edge::Wall(_) => CONFINED_PX,
        };
        Ok(self.edge_distance_px(truth, minus_px, point_mm)? > least)
    }
}
