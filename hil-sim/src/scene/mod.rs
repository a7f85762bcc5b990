//! What the camera sees: from pixel to surface, ray by ray.

pub mod height_map;
pub mod render;
pub mod surface;
pub mod texture;
pub mod trace;

use crate::config::{SceneConfig, SimConfig};
use crate::error::ConfigError;
use surface::{Line, Surface};
use texture::Texture;
use trace::{Tracer, View};

/// A scene ready to render.
#[derive(Debug)]
pub struct Scene {
    width: usize,
    height: usize,
    tracer: Tracer,
    surface: Surface,
    texture: Texture,
    offset_mm: [f64; 3],
    samples: usize,
}

impl Scene {
    /// Prepares the scene of a configuration; reads the height map if there is one.
    pub fn new(config: &SimConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let (width, height) = (config.camera.width, config.camera.height);
        let SceneConfig { optics, specimen, texture, samples, .. } = &config.scene;
        Ok(Self {
            width,
            height,
            tracer: Tracer::new(optics, width, height),
            surface: Surface::new(specimen)?,
            texture: Texture::new(texture, config.seed, specimen.half_width_mm, specimen.half_height_mm),
            offset_mm: specimen.offset_mm,
            samples: *samples,
        })
    }

    /// Columns and rows of the sensor.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// The geometry of camera and grating.
    pub fn tracer(&self) -> &Tracer {
        &self.tracer
    }

    /// The specimen's surface.
    pub fn surface(&self) -> &Surface {
        &self.surface
    }

    /// The specimen's texture.
    pub fn texture(&self) -> &Texture {
        &self.texture
    }

    /// The view that column `column` belongs to.
    pub fn view_of_column(&self, column: usize) -> View {
        if column < self.width / 2 { View::Minus } else { View::Plus }
    }

    /// The object point (x, y, h) in millimetres that a pixel position of `view` looks at, with the
    /// stage at `stage_mm`; `None` where it looks past the specimen.
    pub fn object_point(&self, view: View, x_px: f64, y_px: f64, stage_mm: [f64; 3]) -> Option<[f64; 3]> {
        let shift = self.shift(stage_mm);
        let hit = self.surface.first_hit(&self.line(view, x_px, y_px, shift)?)?;
        Some([0, 1, 2].map(|k| hit[k] + shift[k]))
    }

    fn shift(&self, stage_mm: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|k| self.offset_mm[k] + stage_mm[k])
    }

    /// The line of a pixel in the coordinates of a specimen shifted by `shift`.
    #[inline]
    fn line(&self, view: View, x_px: f64, y_px: f64, shift: [f64; 3]) -> Option<Line> {
        let line = self.tracer.line(view, x_px, y_px)?;
        Some(Line {
            origin: [line.origin[0] - shift[0], line.origin[1] - shift[1], line.origin[2] - shift[2]],
            direction: line.direction,
        })
    }
}
