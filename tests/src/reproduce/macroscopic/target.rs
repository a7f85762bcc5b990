//! A flat plate with a printed, known speckle pattern: found in both views by correlating the frame
//! with the pattern itself. Calibrates the rig and gives maps through the grating.

use super::super::{Extent, ReproduceError};
use super::rig::{PIXEL_MM, Rig, SEED, Shot, WIDTH};
use daic_correlate::{Guess, Image, Points, Rectangle, Reference, Roi, Settings, Target, correlate};
use daic_hil_sim::config::SurfaceConfig;
use daic_hil_sim::scene::texture::Texture;
use daic_optics::bundle::{KnownPose, PlatePose, Seen, Sighting};
use daic_optics::{
    DistortionMap, DistortionMaps, MapGrid, MapSample, OpticalModel, Optics, RigCalibration, RigData,
    RigSettings, View, calibrate_rig,
};
use nalgebra::{DMatrix, DVector, Vector3};
use std::sync::Arc;

/// Heights of the plate for the calibration, mm; the first is the reference plane.
const HEIGHTS_MM: [f64; 5] = [0.0, -2.0, -1.0, 1.0, 2.0];
/// What the stage is believed to do, mm and rad.
const STAGE_SIGMA: (f64, f64) = (1e-3, 2e-4);
/// Distance of the maps' nodes and margin around what was measured, px.
const MAP_STEP_PX: f64 = 100.0;
const MAP_MARGIN_PX: f64 = 60.0;
/// How much a map's slope may change from node to node, px.
const MAP_BEND_PX: f64 = 0.1;

/// A point of the pattern in one view.
#[derive(Clone, Copy, Debug)]
pub struct Found {
    /// Its number in the pattern's grid.
    pub number: usize,
    /// On the plate, mm.
    pub plate_mm: [f64; 2],
    /// On the sensor, px.
    pub px: [f64; 2],
    /// σ, px.
    pub sigma_px: [f64; 2],
}

/// The plate seen once.
pub struct Sheet {
    /// By view, −1 first.
    pub views: [Vec<Found>; 2],
    /// The pattern's grid on the plate, mm.
    pub plate_mm: Vec<[f64; 2]>,
}

/// The printed pattern as an image of square pixels of [`PIXEL_MM`], and its points.
struct Pattern {
    size: [usize; 2],
    reference: Reference,
    points: Points,
    settings: Settings,
}

impl Pattern {
    fn new(rig: &Rig, step: usize) -> Result<Self, ReproduceError> {
        let settings = Settings::default();
        let side = (2.0 * rig.half_mm / PIXEL_MM) as usize + 80;
        let size = [side, side.min(rig.rows)];
        let texture = Texture::new(rig.texture(), SEED, rig.half_mm, rig.half_mm);
        let grey = |k: usize| {
            let [x, y] = plate(size, (k % size[0]) as f64, (k / size[0]) as f64);
            let inside = x.abs().max(y.abs()) <= rig.half_mm;
            if inside { 240.0 * texture.reflectance(x, y) as f32 } else { 0.0 }
        };
        let image = Image::from_f32(size[0], size[1], (0..size[0] * size[1]).map(grey).collect())?;
        let reach = rig.half_mm / PIXEL_MM - settings.radius() as f64 - 12.0;
        let from = size.map(|n| (0.5 * (n as f64 - 1.0) - reach).ceil().max(0.0) as usize);
        let rectangle =
            Rectangle { x: from[0], y: from[1], width: size[0] - 2 * from[0], height: size[1] - 2 * from[1] };
        let roi = Roi { rectangle: Some(rectangle), mask: None };
        let points = Points::grid(size[0], size[1], settings.subset, step, &roi)?;
        Ok(Self { size, reference: Reference::new(image), points, settings })
    }

    fn find(&self, rig: &Rig, shot: &Shot, view: View) -> Result<Vec<Found>, ReproduceError> {
        let middle = OpticalModel::new(&rig.nominal())?.project(view, Vector3::zeros())?;
        let corner = [0, 1].map(|k| {
            let most = [WIDTH, rig.rows][k] - self.size[k];
            let at = (middle[k] - 0.5 * (self.size[k] as f64 - 1.0)).round();
            at.clamp(0.0, most as f64) as usize
        });
        let part = (0..self.size[1])
            .flat_map(|j| &shot.image.row(j + corner[1])[corner[0]..corner[0] + self.size[0]])
            .copied()
            .collect();
        let image = Image::from_f32(self.size[0], self.size[1], part)?;
        let target = Target::new(image, self.settings.interpolation);
        let found = correlate(&self.reference, &target, &self.points, &Guess::Fft, &self.settings, &())?;
        let ok = found.points.iter().enumerate().filter(|(_, p)| p.status.is_ok());
        Ok(ok
            .map(|(number, p)| Found {
                number,
                plate_mm: plate(self.size, p.x, p.y),
                px: [p.x + p.u + corner[0] as f64, p.y + p.v + corner[1] as f64],
                sigma_px: [f64::from(p.sigma_u), f64::from(p.sigma_v)],
            })
            .collect())
    }

    /// Takes a frame of the plate at a height and finds the pattern in both views.
    fn sheet(&self, rig: &Rig, frame: u64, height_mm: f64) -> Result<Sheet, ReproduceError> {
        let plane = SurfaceConfig::Plane { height_mm, slope_x: 0.0, slope_y: 0.0 };
        let shot = rig.shoot(frame, rig.specimen(plane))?;
        let views = [self.find(rig, &shot, View::Minus)?, self.find(rig, &shot, View::Plus)?];
        let plate_mm = self.points.positions().iter().map(|p| plate(self.size, p[0], p[1])).collect();
        Ok(Sheet { views, plate_mm })
    }
}

/// Point of the plate at a pixel of the pattern's image, mm.
fn plate(size: [usize; 2], x: f64, y: f64) -> [f64; 2] {
    [(x - 0.5 * (size[0] as f64 - 1.0)) * PIXEL_MM, (y - 0.5 * (size[1] as f64 - 1.0)) * PIXEL_MM]
}

/// Calibrates the rig from the plate at five heights, starting 1 % off in F and s and 1 mm off in d.
///
/// # Errors
/// What the calibration refuses.
pub fn calibrate(rig: &Rig, extent: Extent) -> Result<RigCalibration, ReproduceError> {
    let step = match extent {
        Extent::Full => 32,
        Extent::Quick => 20,
    };
    let pattern = Pattern::new(rig, step)?;
    let mut data = RigData::default();
    for (k, h) in HEIGHTS_MM.into_iter().enumerate() {
        let seen = pattern.sheet(rig, 100 + k as u64, h)?;
        data.plate_mm = seen.plate_mm.iter().map(|p| Some(*p)).collect();
        let mut sightings: Vec<Sighting> =
            (0..data.plate_mm.len()).map(|point| Sighting { point, minus: None, plus: None }).collect();
        for (view, found) in View::BOTH.into_iter().zip(&seen.views) {
            for f in found {
                let seen = Some(Seen { px: f.px, sigma_px: f.sigma_px });
                match view {
                    View::Minus => sightings[f.number].minus = seen,
                    View::Plus => sightings[f.number].plus = seen,
                }
            }
        }
        sightings.retain(|s| s.minus.is_some() || s.plus.is_some());
        let known = if k == 0 {
            KnownPose::default()
        } else {
            KnownPose::moved([0.0, 0.0, h], STAGE_SIGMA.0, STAGE_SIGMA.1)
        };
        data.poses.push(PlatePose { sightings, known });
    }
    let mut start = rig.nominal();
    start.camera.focal_px *= 1.01;
    start.pinhole_to_grating_mm *= 0.99;
    start.grating_to_reference_mm += 1.0;
    let settings = RigSettings { leave_one_out: false, ..RigSettings::usual(&start) };
    Ok(calibrate_rig(&start, &DistortionMaps::NONE, &data, &settings)?)
}

/// Maps of both views through the grating from the plate in the reference plane.
pub struct Maps {
    /// For the virtual-object models: the straight carrier of each view is taken off, as the thesis does.
    pub carrier: DistortionMaps,
    /// For the exact rays: what they leave once the plate's pose is fitted.
    pub ray: DistortionMaps,
    /// RMS and largest value of the former, px.
    pub size_px: (f64, f64),
    /// RMS and largest value of the latter, px.
    pub ray_size_px: (f64, f64),
    /// (x₋, y₋, e_x, e_y), px, of the −1 view's points for the former.
    pub minus: Vec<[f64; 4]>,
}

/// Measures the maps.
///
/// # Errors
/// What the correlation, a ray or the fit refuses.
pub fn maps(rig: &Rig, nominal: &Optics) -> Result<Maps, ReproduceError> {
    let flat = Pattern::new(rig, 12)?.sheet(rig, 200, 0.0)?;
    let carrier: [Vec<[f64; 2]>; 2] = [straight(&flat.views[0]), straight(&flat.views[1])];
    let ray = posed(&OpticalModel::new(nominal)?, &flat)?;
    let (c, r) = (fit(&flat, &carrier)?, fit(&flat, &ray)?);
    let minus = flat.views[0].iter().zip(&carrier[0]).map(|(f, e)| [f.px[0], f.px[1], e[0], e[1]]).collect();
    Ok(Maps { carrier: c, ray: r, size_px: size(&carrier), ray_size_px: size(&ray), minus })
}

fn size(e: &[Vec<[f64; 2]>; 2]) -> (f64, f64) {
    let all = || e.iter().flatten().map(|e| e[0].hypot(e[1]));
    (super::super::statistics::rms(all()), super::super::statistics::largest(all()))
}

/// Observed pixels minus the straight carrier that fits them best.
fn straight(found: &[Found]) -> Vec<[f64; 2]> {
    let rows = DMatrix::from_fn(found.len(), 3, |k, i| [1.0, found[k].plate_mm[0], found[k].plate_mm[1]][i]);
    let normal = rows.transpose() * &rows;
    let mut out = vec![[0.0; 2]; found.len()];
    for c in 0..2 {
        let seen = DVector::from_fn(found.len(), |k, _| found[k].px[c]);
        let Some(solved) = normal.clone().cholesky().map(|n| n.solve(&(rows.transpose() * &seen))) else {
            continue;
        };
        let left = seen - &rows * solved;
        for (out, left) in out.iter_mut().zip(left.iter()) {
            out[c] = *left;
        }
    }
    out
}

/// Observed pixels minus those that the exact rays give for the plate in its best pose.
fn posed(model: &OpticalModel, flat: &Sheet) -> Result<[Vec<[f64; 2]>; 2], ReproduceError> {
    let mut pose = [0.0; 6];
    let residuals = |pose: &[f64; 6]| -> Result<Vec<f64>, ReproduceError> {
        let turn = nalgebra::Rotation3::from_euler_angles(pose[0], pose[1], pose[2]);
        let mut out = Vec::new();
        for (view, found) in View::BOTH.into_iter().zip(&flat.views) {
            for f in found {
                let p = turn * Vector3::new(f.plate_mm[0], f.plate_mm[1], 0.0)
                    + Vector3::new(pose[3], pose[4], pose[5]);
                let q = model.project(view, p)?;
                out.extend([f.px[0] - q[0], f.px[1] - q[1]]);
            }
        }
        Ok(out)
    };
    let mut left = residuals(&pose)?;
    for _ in 0..3 {
        let n = left.len();
        let mut by = DMatrix::zeros(n, 6);
        for i in 0..6 {
            const STEP: f64 = 1e-4;
            let mut moved = pose;
            moved[i] += STEP;
            for (k, r) in residuals(&moved)?.into_iter().enumerate() {
                by[(k, i)] = (r - left[k]) / STEP;
            }
        }
        let right = by.transpose() * DVector::from_column_slice(&left);
        let Some(factor) = (by.transpose() * &by).cholesky() else { break };
        let step = factor.solve(&right);
        for i in 0..6 {
            pose[i] -= step[i];
        }
        left = residuals(&pose)?;
    }
    let pairs: Vec<[f64; 2]> = left.chunks_exact(2).map(|c| [c[0], c[1]]).collect();
    let (a, b) = pairs.split_at(flat.views[0].len());
    Ok([a.to_vec(), b.to_vec()])
}

fn fit(flat: &Sheet, e: &[Vec<[f64; 2]>; 2]) -> Result<DistortionMaps, ReproduceError> {
    let one = |found: &[Found], e: &[[f64; 2]]| -> Result<_, ReproduceError> {
        let mut from = [f64::INFINITY; 2];
        let mut to = [f64::NEG_INFINITY; 2];
        for f in found {
            for i in 0..2 {
                (from[i], to[i]) = (from[i].min(f.px[i]), to[i].max(f.px[i]));
            }
        }
        let grid =
            MapGrid::covering(from.map(|v| v - MAP_MARGIN_PX), to.map(|v| v + MAP_MARGIN_PX), MAP_STEP_PX);
        let samples: Vec<MapSample> = found
            .iter()
            .zip(e)
            .map(|(f, e)| MapSample { pixel_px: f.px, e_px: *e, sigma_px: f.sigma_px[0].max(1e-4) })
            .collect();
        Ok(Some(Arc::new(DistortionMap::fit(grid, &samples, MAP_BEND_PX)?.map)))
    };
    Ok(DistortionMaps { sensor: None, minus: one(&flat.views[0], &e[0])?, plus: one(&flat.views[1], &e[1])? })
}
