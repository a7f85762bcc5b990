//! Everything that describes a simulated rig, as TOML and in memory.
//!
//! Unknown keys are refused. The defaults are the macro set-up of the published method: 633 nm,
//! 300 lines/mm, a camera of 2592 × 1944 pixels 307 mm in front of the grating.

mod lightfield;
mod microscope;
mod sensor;
mod validate;

pub(crate) use lightfield::PLANE_UM;
pub use lightfield::{BeadConfig, LightFieldConfig};
pub use microscope::MicroscopeConfig;
pub use sensor::{BayerConfig, BayerPattern};

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::error::ConfigError;

/// A simulated rig.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimConfig {
    /// Seed of texture, noise and boot ids.
    pub seed: u64,
    /// Threads that render; 0 takes all cores. The frames do not depend on it.
    pub threads: usize,
    /// What the camera looks at, and through what.
    pub scene: SceneConfig,
    /// The camera.
    pub camera: CameraConfig,
    /// The light sources.
    pub light: LightConfig,
    /// The stage under the specimen.
    pub stage: StageConfig,
    /// The trigger box.
    pub board: BoardConfig,
    /// How the box's clock advances.
    pub clock: ClockMode,
    /// Faults on demand.
    pub faults: FaultsConfig,
}

/// What the camera looks at, and through what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneConfig {
    /// Camera geometry and grating.
    pub optics: OpticsConfig,
    /// A microscope in place of `optics`.
    pub microscope: Option<MicroscopeConfig>,
    /// A light-field microscope in place of all other things of the scene.
    pub lightfield: Option<LightFieldConfig>,
    /// Width of the light's spectrum.
    pub spectrum: SpectrumConfig,
    /// Shape and extent of the specimen.
    pub specimen: SpecimenConfig,
    /// Speckle on the specimen.
    pub texture: TextureConfig,
    /// Gauss–Legendre points per pixel side (1 to 4).
    pub samples: usize,
    /// Largest distance between the positions averaged for a moving specimen, in pixels.
    pub blur_step_px: f64,
    /// Most positions averaged for one frame; a longer smear gets larger steps.
    pub blur_positions_max: usize,
}

impl Default for SceneConfig {
    fn default() -> Self {
        Self {
            optics: OpticsConfig::default(),
            microscope: None,
            lightfield: None,
            spectrum: SpectrumConfig::default(),
            specimen: SpecimenConfig::default(),
            texture: TextureConfig::default(),
            samples: 2,
            blur_step_px: 0.1,
            blur_positions_max: 256,
        }
    }
}

/// The spectrum of the light about the mean wavelength of the optics.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SpectrumConfig {
    /// Its shape.
    pub shape: SpectrumShape,
    /// Full width of the box, full width of the Gaussian at half its height; 0 is one wavelength.
    pub width_mm: f64,
    /// Wavelengths that are rendered (1 to 256); 0 takes as many as the smear in pixels asks for.
    pub samples: usize,
}

/// Shape of a spectrum.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpectrumShape {
    /// Even between two ends: an interference filter.
    #[default]
    Box,
    /// An LED.
    Gaussian,
}

/// The true geometry: pinhole camera in front of a transmission grating.
///
/// Origin in the pinhole, x right and y down as on the sensor, z along the optical axis. The grating
/// plane cuts the axis at `pinhole_to_grating_mm`, the reference plane (height 0) lies
/// `grating_to_reference_mm` behind it. Heights grow towards the camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OpticsConfig {
    /// Wavelength.
    pub wavelength_mm: f64,
    /// Pinhole to image plane, in pixels.
    pub focal_px: f64,
    /// Where the optical axis meets the sensor; `None` takes the centre of the sensor.
    pub principal_point_px: Option<[f64; 2]>,
    /// Radial terms of Brown's model, acting on x/F: observed = ideal · (1 + k1 r² + k2 r⁴ + k3 r⁶) + tangential.
    pub brown_k: [f64; 3],
    /// Tangential terms p1, p2 of Brown's model.
    pub brown_p: [f64; 2],
    /// Pinhole to grating plane along the axis.
    pub pinhole_to_grating_mm: f64,
    /// Grating plane to reference plane along the axis.
    pub grating_to_reference_mm: f64,
    /// The grating in front of the −1 view, and of the +1 view unless that has its own.
    pub grating: GratingConfig,
    /// The grating in front of the +1 view, if it is another one.
    pub grating_plus: Option<GratingConfig>,
}

impl Default for OpticsConfig {
    fn default() -> Self {
        Self {
            wavelength_mm: 0.000_633,
            focal_px: 17_956.216_577_540_104,
            principal_point_px: None,
            brown_k: [0.0; 3],
            brown_p: [0.0; 2],
            pinhole_to_grating_mm: 307.0,
            grating_to_reference_mm: 109.0,
            grating: GratingConfig::default(),
            grating_plus: None,
        }
    }
}

/// One transmission grating on a plane substrate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GratingConfig {
    /// Distance between grooves.
    pub pitch_mm: f64,
    /// Angles about x, y, z: R = Rz·Ry·Rx about the point where the axis meets the grating plane.
    pub tilt_rad: [f64; 3],
    /// Thickness of the glass behind the grooves (object side).
    pub substrate_mm: f64,
    /// Refractive index of that glass.
    pub substrate_index: f64,
}

impl Default for GratingConfig {
    fn default() -> Self {
        Self { pitch_mm: 1.0 / 300.0, tilt_rad: [0.0; 3], substrate_mm: 0.0, substrate_index: 1.5 }
    }
}

/// Shape and extent of the specimen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SpecimenConfig {
    /// Height over material coordinates.
    pub surface: SurfaceConfig,
    /// The specimen ends at |X| = this.
    pub half_width_mm: f64,
    /// The specimen ends at |Y| = this.
    pub half_height_mm: f64,
    /// Where the specimen sits when all axes stand at step 0: x, y, h.
    pub offset_mm: [f64; 3],
}

impl Default for SpecimenConfig {
    fn default() -> Self {
        Self {
            surface: SurfaceConfig::default(),
            half_width_mm: 10.0,
            half_height_mm: 10.0,
            offset_mm: [0.0; 3],
        }
    }
}

/// Height h(X, Y) of the specimen in millimetres, growing towards the camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum SurfaceConfig {
    /// h = height + slope_x·X + slope_y·Y.
    Plane {
        /// Height at the origin.
        #[serde(default)]
        height_mm: f64,
        /// Slope along X.
        #[serde(default)]
        slope_x: f64,
        /// Slope along Y.
        #[serde(default)]
        slope_y: f64,
    },
    /// Axis along Y: h = √(R² − X²) − R + apex.
    Cylinder {
        /// R.
        radius_mm: f64,
        /// Height of the apex.
        apex_mm: f64,
        /// Height of a plane that the cylinder rises from.
        floor_mm: Option<f64>,
    },
    /// h = apex − slope·√(X² + Y²).
    Cone {
        /// Height of the tip.
        apex_mm: f64,
        /// Tangent of the angle between flank and base.
        slope: f64,
        /// Height of a plane that the cone rises from.
        floor_mm: Option<f64>,
    },
    /// Two levels with a vertical wall: h = low where X cos a + Y sin a < x, high beyond.
    Step {
        /// Where the wall stands.
        x_mm: f64,
        /// Height left of it.
        low_mm: f64,
        /// Height right of it; may be the lower one.
        high_mm: f64,
        /// Direction a from X towards Y in which the wall is crossed.
        #[serde(default)]
        direction_rad: f64,
    },
    /// h = √(R² − X² − Y²) − R + apex.
    Sphere {
        /// R.
        radius_mm: f64,
        /// Height of the apex.
        apex_mm: f64,
        /// Height of a plane that the sphere rises from.
        floor_mm: Option<f64>,
    },
    /// Heights from a grey image (cubic B-spline between its pixels), centred on the origin.
    HeightMap {
        /// PNG, BMP or TIFF of 8 or 16 bits; relative paths start at the working directory.
        file: PathBuf,
        /// Distance between the image's pixels on the specimen.
        pixel_mm: f64,
        /// Height of grey value 0.
        black_mm: f64,
        /// Height of full scale (255 or 65 535).
        white_mm: f64,
    },
}

impl Default for SurfaceConfig {
    fn default() -> Self {
        Self::Plane { height_mm: 0.0, slope_x: 0.0, slope_y: 0.0 }
    }
}

/// Speckle on the specimen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TextureConfig {
    /// Full width of a blob at half its height.
    pub speckle_mm: f64,
    /// Mean number of blobs per cell of (1.254 · speckle)².
    pub density: f64,
    /// Mean strength of a blob before saturation.
    pub strength: f64,
    /// Reflectance of bare paint.
    pub mean_reflectance: f64,
    /// Largest departure from it; together at most 1.
    pub contrast: f64,
}

impl Default for TextureConfig {
    fn default() -> Self {
        Self { speckle_mm: 0.125, density: 1.5, strength: 0.9, mean_reflectance: 0.5, contrast: 0.47 }
    }
}

/// The camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraConfig {
    /// Columns; the left half holds the −1 view, the right half the +1 view.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Which camera trigger line it listens to.
    pub line: u8,
    /// From the rising edge to the start of the exposure.
    pub trigger_delay_ns: u64,
    /// Length of the exposure.
    pub exposure_ns: u64,
    /// From the end of the exposure until the next trigger is taken.
    pub readout_ns: u64,
    /// How much later than the row above it a row is exposed; 0 is a global shutter.
    pub row_ns: u64,
    /// Colour filters before the pixels; without, all pixels are alike.
    pub bayer: Option<BayerConfig>,
    /// Bits of a pixel value, 8 to 16.
    pub bits: u8,
    /// Electrons per count.
    pub electrons_per_dn: f64,
    /// Electrons a pixel can hold.
    pub full_well_electrons: f64,
    /// Counts of a dark pixel.
    pub offset_dn: f64,
    /// Standard deviation of the read noise.
    pub read_noise_electrons: f64,
    /// Photon (shot) noise on or off.
    pub photon_noise: bool,
    /// The camera's clock when the box's is 0.
    pub clock_offset_ns: u64,
    /// How much faster than true time the camera's clock runs.
    pub clock_drift_ppm: f64,
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            width: 2592,
            height: 1944,
            line: 0,
            trigger_delay_ns: 5_000,
            exposure_ns: 1_000_000,
            readout_ns: 10_000_000,
            row_ns: 0,
            bayer: None,
            bits: 12,
            electrons_per_dn: 2.5,
            full_well_electrons: 10_000.0,
            offset_dn: 192.0,
            read_noise_electrons: 4.0,
            photon_noise: true,
            clock_offset_ns: 1_234_567_890_123,
            clock_drift_ppm: 12.5,
        }
    }
}

/// The light sources.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LightConfig {
    /// Photo-electrons per second and pixel that LED i at full level brings from a point of
    /// reflectance 1. Levels are 0 until the box sets them.
    pub led_electrons_per_s: Vec<f64>,
    /// The same for light that is always there.
    pub ambient_electrons_per_s: f64,
}

impl Default for LightConfig {
    fn default() -> Self {
        // 100 µs at full level fill 90 % of the well at reflectance 1.
        Self { led_electrons_per_s: vec![9.0e7; 2], ambient_electrons_per_s: 0.0 }
    }
}

/// The stage: axis 0 moves the specimen right, axis 1 down, axis 2 towards the camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StageConfig {
    /// Steps per millimetre of axes 0, 1, 2.
    pub steps_per_mm: [f64; 3],
    /// Play of the drives of axes 0, 1, 2: after a reversal a drive turns so far before the stage follows.
    pub backlash_mm: [f64; 3],
}

impl Default for StageConfig {
    fn default() -> Self {
        Self { steps_per_mm: [6400.0; 3], backlash_mm: [0.0; 3] }
    }
}

/// The trigger box.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BoardConfig {
    /// One entry per axis.
    pub axes: Vec<AxisConfig>,
    /// One entry per LED.
    pub leds: Vec<LedConfig>,
    /// Camera trigger lines.
    pub cameras: u8,
    /// Trigger inputs.
    pub inputs: u8,
    /// Ticks of 8 ns that the board needs to act on an input.
    pub input_latency: u32,
    /// There is an interlock; it is closed while bit 24 of the input word is high.
    pub interlock: bool,
    /// The exposure-active line of the camera is wired to the box.
    pub exposure_active: bool,
    /// What happens on trigger inputs and interlock, in order of ticks.
    pub stimulus: Vec<Stimulus>,
    /// Slots of permanent memory.
    pub slots: u8,
}

impl Default for BoardConfig {
    fn default() -> Self {
        Self {
            axes: vec![AxisConfig::default(); 3],
            leds: vec![LedConfig::default(); 2],
            cameras: 1,
            inputs: 2,
            input_latency: 6_250,
            interlock: false,
            exposure_active: false,
            stimulus: Vec::new(),
            slots: 4,
        }
    }
}

/// From a tick on the trigger inputs and the interlock have these levels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stimulus {
    /// Ticks of 8 ns since the rig started.
    pub tick: u64,
    /// Bits 0 to 7: trigger inputs, bit 24: interlock closed.
    pub word: u32,
}

/// Limits of one axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AxisConfig {
    /// Lowest target in steps.
    pub min: i32,
    /// Highest target in steps.
    pub max: i32,
    /// Highest rate in steps per second.
    pub max_rate: u32,
    /// Highest acceleration in steps per second squared.
    pub max_acceleration: u32,
    /// Highest jerk in steps per second cubed.
    pub max_jerk: u32,
    /// The home switch, if there is one.
    pub home: Option<HomeConfig>,
}

impl Default for AxisConfig {
    fn default() -> Self {
        Self {
            min: -64_000,
            max: 64_000,
            max_rate: 128_000,
            max_acceleration: 1_280_000,
            max_jerk: 1_000_000_000,
            home: None,
        }
    }
}

/// A home switch and how it is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HomeConfig {
    /// At the high end of the axis.
    pub high_end: bool,
    /// Steps per second.
    pub rate: u32,
    /// Most steps each way.
    pub travel: u32,
    /// The count where the switch lets go.
    pub position: i32,
    /// Where the switch really is, in steps from where the stage stands at the start.
    pub switch_at: i64,
}

/// Limits of one LED.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LedConfig {
    /// Longest time on, in ticks of 8 ns.
    pub max_pulse: u32,
    /// Time a new level needs to settle, in ticks of 8 ns.
    pub settle: u32,
    /// Most rest that may be owed, in ticks of 8 ns.
    pub window: u32,
    /// Stricter limits above some levels, at most 4.
    pub overdrive: Vec<OverdriveConfig>,
}

impl Default for LedConfig {
    fn default() -> Self {
        Self { max_pulse: 1_250_000, settle: 12_500, window: u32::MAX, overdrive: Vec::new() }
    }
}

/// What an LED stands above a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OverdriveConfig {
    /// For levels above this one.
    pub above: u16,
    /// Longest time on, in ticks of 8 ns.
    pub max_pulse: u32,
    /// Ticks of cycle that a tick of light costs.
    pub cycle: u32,
}

/// How the box's clock advances.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "mode", rename_all = "snake_case", deny_unknown_fields)]
pub enum ClockMode {
    /// By the bytes on the link and by playing, nothing else: the same bytes give the same ticks.
    ///
    /// A program is played to its end, and the camera reads out, before the next byte is looked at.
    /// Only after [`STEPPED_PATIENCE_S`](crate::board::STEPPED_PATIENCE_S) virtual seconds of one program is the link polled in between, so
    /// that an endless one can be aborted.
    Stepped {
        /// Bits per second of the link; a byte takes ten.
        #[serde(default = "default_baud")]
        baud: u32,
    },
    /// With the wall clock.
    Wall {
        /// Virtual seconds per second.
        rate: f64,
    },
}

const fn default_baud() -> u32 {
    1_000_000
}

impl Default for ClockMode {
    fn default() -> Self {
        Self::Stepped { baud: default_baud() }
    }
}

/// Faults on demand.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FaultsConfig {
    /// Ids of frames that the camera takes and loses.
    pub drop_frames: Vec<u64>,
    /// Ids of frames that are delivered twice.
    pub duplicate_frames: Vec<u64>,
    /// The box resets itself instead of answering once it has answered this many requests.
    pub reset_after_requests: Option<u32>,
    /// The box says nothing more once it has answered this many requests.
    pub silent_after_requests: Option<u32>,
}

impl SimConfig {
    /// Size of a pixel on the reference plane; in the macro set-up without the grating's stretch, (s + d)/F: a
    /// lower bound.
    pub fn pixel_mm(&self) -> f64 {
        let optics = &self.scene.optics;
        if let Some(l) = &self.scene.lightfield {
            return 1e-3 * l.lenslet_pitch_um / (l.magnification * l.pitch_px);
        }
        match &self.scene.microscope {
            None => (optics.pinhole_to_grating_mm + optics.grating_to_reference_mm) / optics.focal_px,
            Some(m) => (m.pixel_mm / (m.objective_magnification * m.relay_magnification)).abs(),
        }
    }

    /// Reads a configuration; the error names line and key.
    pub fn from_toml(text: &str) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|e| ConfigError::Syntax(Box::new(e)))?;
        config.validate()?;
        Ok(config)
    }

    /// The configuration as TOML.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        toml::to_string_pretty(self).map_err(|e| ConfigError::Unwritable(Box::new(e)))
    }
}
