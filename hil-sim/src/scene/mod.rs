//! What the camera sees: from pixel to surface, ray by ray.

pub mod height_map;
pub mod lightfield;
pub mod microscope;
pub mod quadrature;
pub mod render;
pub mod surface;
pub mod texture;
pub mod trace;

use crate::config::{SceneConfig, SimConfig, SpectrumConfig, SpectrumShape};
use crate::error::ConfigError;
use microscope::MicroscopeTracer;
use surface::{Line, Surface};
use texture::Texture;
use trace::{ObjectLine, Tracer, View};

/// Camera and gratings of either set-up.
#[derive(Debug)]
enum Instrument {
    Macro(Box<Tracer>),
    Microscope(Box<MicroscopeTracer>),
}

impl Instrument {
    #[inline]
    fn line(&self, view: View, x_px: f64, y_px: f64, wavelength_mm: f64) -> Option<ObjectLine> {
        match self {
            Self::Macro(tracer) => tracer.line(view, x_px, y_px, wavelength_mm),
            Self::Microscope(tracer) => tracer.line(view, x_px, y_px, wavelength_mm),
        }
    }

    /// Whether a pixel may see nothing because of what stands in the way.
    fn has_stop(&self) -> bool {
        matches!(self, Self::Microscope(_))
    }

    fn pixel_mm(&self) -> f64 {
        match self {
            Self::Macro(tracer) => tracer.pixel_mm(),
            Self::Microscope(tracer) => tracer.pixel_mm(),
        }
    }
}

/// The cone of light that the objective takes in from a point.
#[derive(Debug)]
struct Cone {
    /// Height of the plane that is sharp on the sensor.
    focus_mm: f64,
    /// Largest of the tangents.
    widest: f64,
    /// Tangents of the rays against the chief ray, and weights.
    rays: Vec<([f64; 2], f64)>,
}

/// A scene ready to render.
#[derive(Debug)]
pub struct Scene {
    width: usize,
    height: usize,
    instrument: Instrument,
    surface: Surface,
    texture: Texture,
    offset_mm: [f64; 3],
    /// Nodes and weights over one pixel.
    nodes: Vec<(f64, f64)>,
    mean_wavelength_mm: f64,
    /// Wavelengths and weights.
    spectrum: Vec<(f64, f64)>,
    cone: Option<Cone>,
    /// How far from its middle a pixel may take in light, on the specimen.
    reach_mm: f64,
}

impl Scene {
    /// Prepares the scene of a configuration; reads the height map if there is one.
    pub fn new(config: &SimConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let (width, height) = (config.camera.width, config.camera.height);
        let SceneConfig { optics, microscope, spectrum, specimen, texture, samples, .. } = &config.scene;
        let (instrument, wavelength) = match microscope {
            None => (Instrument::Macro(Box::new(Tracer::new(optics, width, height))), optics.wavelength_mm),
            Some(m) => {
                (Instrument::Microscope(Box::new(MicroscopeTracer::new(m, width, height))), m.wavelength_mm)
            }
        };
        let surface = Surface::new(specimen)?;
        let cone = microscope.as_ref().filter(|m| m.numerical_aperture > 0.0).map(|m| {
            let tangent = m.numerical_aperture.asin().tan();
            let rays = quadrature::disk(m.pupil_rings);
            Cone {
                focus_mm: m.focus_height_mm,
                widest: tangent,
                rays: rays.into_iter().map(|(at, weight)| (at.map(|c| c * tangent), weight)).collect(),
            }
        });
        let pixel_mm = instrument.pixel_mm();
        let centre = [(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0];
        let smear_mm = smear_mm(&instrument, centre, wavelength, spectrum.width_mm);
        let spectrum = wavelengths(spectrum, wavelength, smear_mm / pixel_mm);
        // A pixel whose centre passes the specimen's box by this much has no part inside; the −1 and +1
        // stretch of a pixel stays below 2 within any usable order. Under a microscope nothing is seen any
        // more 1 mm from the sharp plane.
        let defocus_mm = cone.as_ref().map_or(0.0, |c| c.widest * 1.0);
        let reach_mm = 4.0 * pixel_mm + 4.0 * smear_mm + defocus_mm;
        Ok(Self {
            width,
            height,
            instrument,
            surface,
            texture: Texture::new(texture, config.seed, specimen.half_width_mm, specimen.half_height_mm),
            offset_mm: specimen.offset_mm,
            nodes: quadrature::legendre(*samples),
            mean_wavelength_mm: wavelength,
            spectrum,
            cone,
            reach_mm,
        })
    }

    /// Columns and rows of the sensor.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
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
    /// stage at `stage_mm`, in light of the mean wavelength (chief ray); `None` where it looks past the specimen.
    pub fn object_point(&self, view: View, x_px: f64, y_px: f64, stage_mm: [f64; 3]) -> Option<[f64; 3]> {
        let shift = self.shift(stage_mm);
        let hit = self.surface.first_hit(&self.line(view, x_px, y_px, self.mean_wavelength_mm, shift)?)?;
        Some([0, 1, 2].map(|k| hit[k] + shift[k]))
    }

    fn shift(&self, stage_mm: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|k| self.offset_mm[k] + stage_mm[k])
    }

    /// The line of a pixel in the coordinates of a specimen shifted by `shift`.
    #[inline]
    fn line(&self, view: View, x_px: f64, y_px: f64, wavelength_mm: f64, shift: [f64; 3]) -> Option<Line> {
        let line = self.instrument.line(view, x_px, y_px, wavelength_mm)?;
        Some(Line {
            origin: [line.origin[0] - shift[0], line.origin[1] - shift[1], line.origin[2] - shift[2]],
            direction: line.direction,
        })
    }
}

/// How far the views move on the specimen between the ends of a spectrum of this width, on the axis.
fn smear_mm(instrument: &Instrument, [x, y]: [f64; 2], wavelength_mm: f64, width_mm: f64) -> f64 {
    let at = |view, wavelength| {
        let line = instrument.line(view, x, y, wavelength)?;
        Some((-line.origin[2] / line.direction[2]).mul_add(line.direction[0], line.origin[0]))
    };
    let smear =
        |view| Some(at(view, wavelength_mm + 0.5 * width_mm)? - at(view, wavelength_mm - 0.5 * width_mm)?);
    [View::Minus, View::Plus].into_iter().filter_map(smear).fold(0.0, |most: f64, s| most.max(s.abs()))
}

/// Wavelengths that stand for a spectrum, with weights that sum to 1.
fn wavelengths(config: &SpectrumConfig, mean_mm: f64, smear_px: f64) -> Vec<(f64, f64)> {
    if config.width_mm == 0.0 {
        return vec![(mean_mm, 1.0)];
    }
    // Beyond ±1.5 full widths a Gaussian has 4e-4 of its light.
    let span = match config.shape {
        SpectrumShape::Box => 1.0,
        SpectrumShape::Gaussian => 3.0,
    };
    let count = match config.samples {
        // Two pixels between nodes: speckles are several pixels wide.
        0 => (0.5 * span * smear_px).ceil() as usize + 3,
        n => n,
    };
    let mut nodes: Vec<(f64, f64)> = quadrature::legendre(count.min(256))
        .into_iter()
        .map(|(x, weight)| {
            let offset = span * x;
            let density = match config.shape {
                SpectrumShape::Box => 1.0,
                SpectrumShape::Gaussian => (-4.0 * std::f64::consts::LN_2 * offset * offset).exp(),
            };
            (mean_mm + offset * config.width_mm, weight * density)
        })
        .collect();
    let total: f64 = nodes.iter().map(|n| n.1).sum();
    for node in &mut nodes {
        node.1 /= total;
    }
    nodes
}
