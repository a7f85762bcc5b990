//! From an exposure to a frame.

use std::collections::VecDeque;
use std::sync::Arc;

use rayon::prelude::*;

use crate::config::SimConfig;
use crate::error::ConfigError;
use crate::scene::Scene;
use crate::scene::lightfield::LightFieldScene;
use crate::sensor::Sensor;
use crate::world::{ExposureRecord, ns_from_ticks};

/// A frame as the camera delivers it, and apart from that the truth about it.
#[derive(Debug, Clone, PartialEq)]
pub struct SimFrame {
    /// The camera's frame number; counts lost frames too.
    pub id: u64,
    /// Start of the exposure by the camera's own clock, which has its own offset and rate.
    pub camera_ns: u64,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Significant bits of a pixel value.
    pub bits: u8,
    /// Pixel values row by row.
    pub data: Vec<u16>,
    /// What no camera knows.
    pub truth: FrameTruth,
}

/// What really happened during an exposure.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct FrameTruth {
    /// Tick of the trigger edge.
    pub trigger_tick: u64,
    /// First tick of the exposure of row 0.
    pub exposure_start_tick: u64,
    /// Tick at which that exposure ended.
    pub exposure_end_tick: u64,
    /// Photo-electrons that a bare pixel of reflectance 1 expects, the mean over the rows; 0 for a dark frame.
    pub electrons: f64,
    /// Mean position of the stage, weighted by the light; `None` for a dark frame.
    pub stage_mm: Option<[f64; 3]>,
    /// Number of positions averaged; more than 1 if the specimen moved while lit.
    pub positions: usize,
    /// Distance in millimetres within which positions were taken as one.
    pub blur_step_mm: f64,
}

/// Rendered positions kept: series often come back to the same place.
const KEPT: usize = 3;

/// What is in front of the sensor.
#[derive(Debug)]
enum View {
    Rays(Box<Scene>),
    LightField(Box<LightFieldScene>),
}

impl View {
    fn size(&self) -> (usize, usize) {
        match self {
            Self::Rays(scene) => scene.size(),
            Self::LightField(scene) => scene.size(),
        }
    }

    fn render(&self, stage_mm: [f64; 3]) -> Vec<f32> {
        match self {
            Self::Rays(scene) => scene.render(stage_mm),
            Self::LightField(scene) => scene.render(stage_mm),
        }
    }
}

/// Makes frames from exposures.
#[derive(Debug)]
pub struct Imager {
    scene: View,
    sensor: Sensor,
    config: SimConfig,
    rendered: VecDeque<([f64; 3], Arc<Vec<f32>>)>,
}

impl Imager {
    /// Prepares scene and sensor of a configuration.
    pub fn new(config: &SimConfig) -> Result<Self, ConfigError> {
        let scene = match &config.scene.lightfield {
            Some(lightfield) => {
                config.validate()?;
                View::LightField(Box::new(LightFieldScene::new(config, lightfield)?))
            }
            None => View::Rays(Box::new(Scene::new(config)?)),
        };
        Ok(Self {
            scene,
            sensor: Sensor::new(&config.camera, config.seed),
            config: config.clone(),
            rendered: VecDeque::new(),
        })
    }

    /// Expected photo-electrons per pixel, row by row.
    pub fn expose(&mut self, exposure: &ExposureRecord) -> Vec<f32> {
        let (width, height) = self.scene.size();
        let mut expected = vec![0.0f32; width * height];
        for position in exposure.light.positions() {
            let image = self.render(position.stage_mm);
            expected.par_chunks_mut(width).zip(image.par_chunks(width)).enumerate().for_each(
                |(y, (sum, row))| {
                    let electrons = exposure.electrons_of_row(&position, y) as f32;
                    for (sum, reflectance) in sum.iter_mut().zip(row) {
                        *sum += electrons * reflectance;
                    }
                },
            );
        }
        if let Some(bayer) = &self.config.camera.bayer {
            expected.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
                for (x, electrons) in row.iter_mut().enumerate() {
                    *electrons *= bayer.response_at(x, y) as f32;
                }
            });
        }
        expected
    }

    /// The frame of an exposure, noise included.
    pub fn frame(&mut self, exposure: &ExposureRecord) -> SimFrame {
        let expected = self.expose(exposure);
        let (width, height) = self.scene.size();
        let positions = exposure.light.positions();
        let light: f64 = positions.iter().map(|p| p.electrons).sum();
        let mean =
            [0, 1, 2].map(|k| positions.iter().map(|p| p.stage_mm[k] * p.electrons).sum::<f64>() / light);
        let rows = if exposure.row_ticks == 0 { 1 } else { height };
        let of_row = |row| positions.iter().map(|p| exposure.electrons_of_row(p, row)).sum::<f64>();
        let electrons = (0..rows).map(of_row).sum::<f64>() / rows as f64;
        let stage_mm = match &positions[..] {
            [] => None,
            [one] => Some(one.stage_mm),
            _ => Some(mean),
        };
        SimFrame {
            id: exposure.id,
            camera_ns: self.camera_ns(exposure.start_tick),
            width,
            height,
            bits: self.config.camera.bits,
            data: self.sensor.read(exposure.id, &expected),
            truth: FrameTruth {
                trigger_tick: exposure.trigger_tick,
                exposure_start_tick: exposure.start_tick,
                exposure_end_tick: exposure.end_tick,
                electrons,
                stage_mm,
                positions: positions.len(),
                blur_step_mm: exposure.light.step_mm(),
            },
        }
    }

    /// Time of a tick by the camera's clock.
    fn camera_ns(&self, tick: u64) -> u64 {
        let ns = ns_from_ticks(tick);
        let gained = (ns as f64 * self.config.camera.clock_drift_ppm * 1e-6).round() as i64;
        self.config.camera.clock_offset_ns.saturating_add(ns).saturating_add_signed(gained)
    }

    fn render(&mut self, stage_mm: [f64; 3]) -> Arc<Vec<f32>> {
        if let Some((_, image)) = self.rendered.iter().find(|(at, _)| *at == stage_mm) {
            return Arc::clone(image);
        }
        let image = Arc::new(self.scene.render(stage_mm));
        if self.rendered.len() == KEPT {
            self.rendered.pop_front();
        }
        self.rendered.push_back((stage_mm, Arc::clone(&image)));
        image
    }
}
