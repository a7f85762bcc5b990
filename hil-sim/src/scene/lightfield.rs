//! Beads under a light-field microscope, by wave optics and finer than reconstructions sample.

use crate::config::{LightFieldConfig, SimConfig};
use crate::error::ConfigError;
use crate::scene::quadrature;
use daic_lightfield::{Operator, OperatorSettings, Psf};
use rayon::prelude::*;

/// Points of a voxel and side at which a bead is looked for.
const POINTS: usize = 4;

/// A light-field scene ready to render.
pub struct LightFieldScene {
    config: LightFieldConfig,
    size: [usize; 2],
    operator: Operator,
    /// Lenslets of the ideal sensor along a side; the middle one is on the axis.
    cells: usize,
    /// Pixels of a lenslet on the ideal sensor.
    fine: usize,
    voxel_um: f64,
    planes_um: Vec<f64>,
    /// What the camera sees of the slide.
    white: Vec<f32>,
    /// From projected light to brightness.
    scale: f32,
    nodes: Vec<(f64, f64)>,
}

impl std::fmt::Debug for LightFieldScene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LightFieldScene").field("config", &self.config).finish_non_exhaustive()
    }
}

impl LightFieldScene {
    /// Computes the point spread function and the operator.
    ///
    /// # Errors
    /// Optics or sizes that cannot be.
    pub fn new(config: &SimConfig, lightfield: &LightFieldConfig) -> Result<Self, ConfigError> {
        let size = [config.camera.width, config.camera.height];
        let parameters = lightfield.psf();
        let psf = Psf::compute(&parameters)?;
        // the farthest corner of the sensor, in lenslets; an odd number, so that the middle one is on the axis
        let far = [0, size[0] - 1]
            .into_iter()
            .flat_map(|x| [0, size[1] - 1].map(|y| [x as f64, y as f64]))
            .flat_map(|p| cell_of(lightfield, p))
            .fold(0.0, |a: f64, v| a.max(v.abs()));
        let cells = 2 * far.ceil() as usize + 1;
        // light from outside reaches the rim
        let margin = lightfield.radius as isize;
        let settings =
            OperatorSettings { margin: -margin, ..OperatorSettings::new([cells + 2 * lightfield.radius; 2]) };
        let operator = Operator::new(&psf, &settings)?;
        let mut scene = Self {
            config: lightfield.clone(),
            size,
            operator,
            cells,
            fine: parameters.pixels[0],
            voxel_um: parameters.voxel_um()[0],
            planes_um: parameters.planes_um,
            white: Vec::new(),
            scale: 1.0,
            nodes: quadrature::legendre(2),
        };
        let [_, ny, nx] = scene.operator.volume_shape();
        let mut slide = vec![0f32; scene.planes_um.len() * ny * nx];
        // rays of any even plane fill all lenslets alike: the nearest to the focus will do
        let depth = |z: &usize| scene.planes_um[*z].abs();
        let sharp = (0..scene.planes_um.len()).min_by(|a, b| depth(a).total_cmp(&depth(b))).unwrap_or(0);
        slide[sharp * ny * nx..(sharp + 1) * ny * nx].fill(1.0);
        let white = scene.seen(&slide)?;
        let largest = |image: &[f32]| image.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
        let top = largest(&white);
        scene.white = white.iter().map(|v| v / top).collect();
        let beads = scene.seen(&scene.volume([0.0; 3]))?;
        scene.scale = lightfield.peak as f32 / largest(&beads);
        Ok(scene)
    }

    /// Columns and rows of the sensor.
    pub fn size(&self) -> (usize, usize) {
        (self.size[0], self.size[1])
    }

    /// Brightness of every pixel with the stage at `stage_mm`.
    pub fn render(&self, stage_mm: [f64; 3]) -> Vec<f32> {
        if stage_mm[0] >= self.config.slide_mm {
            return self.white.clone();
        }
        // sizes were checked when the scene was made
        let mut image = self.seen(&self.volume(stage_mm)).unwrap_or_default();
        image.resize(self.size[0] * self.size[1], 0.0);
        image.iter_mut().for_each(|v| *v = (*v * self.scale).max(0.0));
        image
    }

    /// Shares of the voxels that beads fill.
    fn volume(&self, stage_mm: [f64; 3]) -> Vec<f32> {
        let [_, ny, nx] = self.operator.volume_shape();
        let part = |i: usize| (i as f64 + 0.5) / POINTS as f64 - 0.5;
        let plane_um = crate::config::PLANE_UM;
        let centres: Vec<([f64; 3], f64)> = self
            .config
            .beads
            .iter()
            .map(|b| {
                let [x, y, z] = b.centre_um;
                // the stage's z points towards the objective
                let [x, y, z] = [x + 1e3 * stage_mm[0], y + 1e3 * stage_mm[1], z - 1e3 * stage_mm[2]];
                // voxels lie along the lenslets, beads and stage along the sensor
                let (sin, cos) = self.config.rotation_rad.sin_cos();
                ([x * cos + y * sin, y * cos - x * sin, z], 0.5 * b.diameter_um)
            })
            .collect();
        let mut out = vec![0f32; self.planes_um.len() * ny * nx];
        out.par_iter_mut().enumerate().for_each(|(i, out)| {
            let (x, y, z) = (i % nx, i / nx % ny, i / (nx * ny));
            let at = [(x, nx), (y, ny)].map(|(i, n)| (i as f64 + 0.5 - 0.5 * n as f64) * self.voxel_um);
            let p = [at[0], at[1], self.planes_um[z]];
            let mut inside = 0u32;
            for (c, radius) in &centres {
                let reach = radius + self.voxel_um + plane_um;
                if (0..3).any(|k| (c[k] - p[k]).abs() > reach) {
                    continue;
                }
                for s in 0..POINTS.pow(3) {
                    let d = [
                        p[0] + part(s % POINTS) * self.voxel_um - c[0],
                        p[1] + part(s / POINTS % POINTS) * self.voxel_um - c[1],
                        p[2] + part(s / POINTS / POINTS) * plane_um - c[2],
                    ];
                    inside += u32::from(d.iter().map(|d| d * d).sum::<f64>() <= radius * radius);
                }
            }
            *out = inside as f32 / POINTS.pow(3) as f32;
        });
        out
    }

    /// What the camera's pixels see of a volume: the ideal sensor, turned and integrated over each pixel.
    fn seen(&self, volume: &[f32]) -> Result<Vec<f32>, ConfigError> {
        let ideal = self.operator.project(&[volume])?.remove(0);
        let side = self.cells * self.fine;
        let value = |x: f64, y: f64| {
            let inside = x >= 0.0 && y >= 0.0 && x < side as f64 && y < side as f64;
            if inside { f64::from(ideal[y as usize * side + x as usize]) } else { 0.0 }
        };
        let [width, height] = self.size;
        let mut out = vec![0f32; width * height];
        out.par_chunks_mut(width).enumerate().for_each(|(row, out)| {
            for (column, out) in out.iter_mut().enumerate() {
                let mut sum = 0.0;
                for &(dy, wy) in &self.nodes {
                    for &(dx, wx) in &self.nodes {
                        let cell = cell_of(&self.config, [column as f64 + dx, row as f64 + dy]);
                        let [x, y] = cell.map(|c| (c + 0.5 * self.cells as f64) * self.fine as f64 - 0.5);
                        let (fx, fy) = (x.floor(), y.floor());
                        let (s, t) = (x - fx, y - fy);
                        let upper = (1.0 - s) * value(fx, fy) + s * value(fx + 1.0, fy);
                        let lower = (1.0 - s) * value(fx, fy + 1.0) + s * value(fx + 1.0, fy + 1.0);
                        sum += wx * wy * ((1.0 - t) * upper + t * lower);
                    }
                }
                *out = sum as f32;
            }
        });
        Ok(out)
    }
}

/// Lenslets from the axis of a place on the sensor.
fn cell_of(config: &LightFieldConfig, at: [f64; 2]) -> [f64; 2] {
    let (sin, cos) = config.rotation_rad.sin_cos();
    let d = [at[0] - config.centre_px[0], at[1] - config.centre_px[1]];
    [(d[0] * cos + d[1] * sin) / config.pitch_px, (d[1] * cos - d[0] * sin) / config.pitch_px]
}
