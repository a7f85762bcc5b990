//! The set-up of chapter 2 and the frames it takes.

use super::super::{Extent, ReproduceError};
use daic_correlate::Image;
use daic_hil_sim::SimConfig;
use daic_hil_sim::config::{SpecimenConfig, TextureConfig};
use daic_hil_sim::scene::Scene;
use daic_hil_sim::sensor::Sensor;
use daic_optics::{Brown, Camera, Grating, Optics, ReferenceFrame};

/// Seed of speckle and noise.
pub const SEED: u64 = 2;
/// F in pixels: nominal 35 mm focused on the reference plane, f = 38.16 mm with pixels of 2.2 µm.
pub const FOCAL_PX: f64 = 17_347.0;
/// Columns of the sensor.
pub const WIDTH: usize = 2592;
const WAVELENGTH_MM: f64 = 633e-6;
/// The filter passes 632–634 nm.
const BAND_MM: f64 = 2e-6;
/// Gauss–Legendre nodes over the band and their weights: three, 1.1 px apart, for speckles of 5 px.
const BAND: [(f64, f64); 3] =
    [(-0.387_298_334_620_741_7, 5.0 / 18.0), (0.0, 8.0 / 18.0), (0.387_298_334_620_741_7, 5.0 / 18.0)];
/// Electrons of a full well; the brightest paint fills 85 % of it.
const FULL_WELL: f64 = 6000.0;
/// Object pixel at the reference plane along x, mm: (s + d/cos³θ)/F.
pub const PIXEL_MM: f64 = 0.0243;

/// A simulated rig.
pub struct Rig {
    /// What it really is.
    pub truth: Optics,
    /// Half the width and height of the specimens, mm.
    pub half_mm: f64,
    /// Rows of the sensor.
    pub rows: usize,
    /// Distance of points, px.
    pub step: usize,
    config: SimConfig,
}

/// A frame and the scene that it shows.
pub struct Shot {
    /// The frame, 8 bit.
    pub image: Image,
    /// Grey values.
    pub grey: Vec<u16>,
    /// What is there, at 633 nm.
    pub scene: Scene,
}

impl Rig {
    /// The set-up with radial lens distortion `k1`.
    pub fn new(extent: Extent, k1: f64) -> Self {
        let (half_mm, rows) = match extent {
            Extent::Full => (10.0, 1944),
            Extent::Quick => (4.0, 420),
        };
        let principal = [(WIDTH as f64 - 1.0) / 2.0, (rows as f64 - 1.0) / 2.0];
        let grating = Grating::square(1.0 / 300.0);
        let truth = Optics {
            camera: Camera {
                focal_px: FOCAL_PX,
                principal_point_px: principal,
                brown: Brown { k1, ..Brown::default() },
            },
            wavelength_mm: WAVELENGTH_MM,
            pinhole_to_grating_mm: 307.0,
            grating_to_reference_mm: 109.0,
            minus: grating,
            plus: grating,
            reference: ReferenceFrame::default(),
        };
        let mut config = SimConfig { seed: SEED, ..SimConfig::default() };
        let o = &mut config.scene.optics;
        (o.focal_px, o.principal_point_px, o.brown_k) = (FOCAL_PX, Some(principal), [k1, 0.0, 0.0]);
        let c = &mut config.camera;
        (c.width, c.height, c.bits) = (WIDTH, rows, 8);
        (c.full_well_electrons, c.read_noise_electrons) = (FULL_WELL, 5.0);
        (c.electrons_per_dn, c.offset_dn) = (FULL_WELL / 240.0, 12.0);
        Self { truth, half_mm, rows, step: extent.step(), config }
    }

    /// The set-up as the nominal values have it: no lens distortion.
    pub fn nominal(&self) -> Optics {
        let mut optics = self.truth;
        optics.camera.brown = Brown::default();
        optics
    }

    /// The speckle.
    pub fn texture(&self) -> &TextureConfig {
        &self.config.scene.texture
    }

    /// A specimen of this rig's size.
    pub fn specimen(&self, surface: daic_hil_sim::config::SurfaceConfig) -> SpecimenConfig {
        let half = self.half_mm;
        SpecimenConfig { surface, half_width_mm: half, half_height_mm: half, offset_mm: [0.0; 3] }
    }

    /// Takes frame number `frame` of a specimen: the mean over the filter's band, each wavelength traced
    /// by itself, then photon noise, read noise and 8 bits.
    ///
    /// # Errors
    /// A height map that cannot be read.
    pub fn shoot(&self, frame: u64, specimen: SpecimenConfig) -> Result<Shot, ReproduceError> {
        let mut config = self.config.clone();
        config.scene.specimen = specimen;
        let mut light = vec![0f32; WIDTH * self.rows];
        let electrons = 0.85 * FULL_WELL;
        for (node, weight) in BAND {
            config.scene.optics.wavelength_mm = WAVELENGTH_MM + BAND_MM * node;
            for (sum, part) in light.iter_mut().zip(Scene::new(&config)?.render([0.0; 3])) {
                *sum += (electrons * weight) as f32 * part;
            }
        }
        config.scene.optics.wavelength_mm = WAVELENGTH_MM;
        let grey = Sensor::new(&config.camera, SEED).read(frame, &light);
        let image = Image::from_u16(WIDTH, self.rows, &grey)?;
        Ok(Shot { image, grey, scene: Scene::new(&config)? })
    }
}
