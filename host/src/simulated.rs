//! The simulated rig as an experiment describes it, and its camera as the rig crate sees one.

use crate::error::Error;
use crate::optics_section;
use daic_hil_sim::config::{
    AxisConfig, BayerConfig, BayerPattern, GratingConfig, LedConfig, LightConfig, LightFieldConfig,
    MicroscopeConfig, OpticsConfig, SimConfig, SpecimenConfig, SurfaceConfig, TextureConfig,
};
use daic_hil_sim::frame::SimFrame;
use daic_optics::{Grating, Optics};
use daic_rig::camera::{Camera, CameraError, CameraInfo, CameraSettings, CameraStats, Frame, FrameError};
use daic_rig::experiment::{self, Experiment};
use daic_rig::units::Time;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

/// How full the brightest point makes the well with the experiment's own strobe.
const FILL: f64 = 0.85;

/// A rig as the experiment describes it: what its `[optics]` says is true and the specimen the demo's, or the
/// simulated microscope with its specimen.
///
/// # Errors
/// Optics that no set-up can have.
pub fn configuration(experiment: &Experiment) -> Result<SimConfig, Error> {
    if experiment.lightfield.is_some() {
        return Ok(lightfield(experiment));
    }
    match &experiment.microscope {
        Some(_) => Ok(microscope(experiment)),
        None => {
            let optics = optics_section::from_section(optics_section::of(experiment)?)?;
            Ok(macro_scene(experiment, &optics, demo_specimen()))
        }
    }
}

/// A rig as the experiment describes it, in front of `specimen`, with `optics` as its truth.
pub fn macro_scene(experiment: &Experiment, optics: &Optics, specimen: SpecimenConfig) -> SimConfig {
    let mut config = SimConfig::default();
    config.scene.optics = truth(optics);
    config.scene.specimen = specimen;
    with_rig(config, experiment, optics.wavelength_mm)
}

/// Radius and apex of the specimen under the microscope, millimetres.
const CAP_MM: [f64; 2] = [2.0, 0.003];

/// The simulated microscope in front of a spherical cap larger than its field, with a camera of 25 000 electrons
/// and 10 electrons of read noise.
pub fn microscope(experiment: &Experiment) -> SimConfig {
    let mut config = SimConfig::default();
    // four rays per point have the disk's variance, and a frame takes seconds
    let microscope = MicroscopeConfig { pupil_rings: 1, ..MicroscopeConfig::default() };
    let wavelength_mm = microscope.wavelength_mm;
    config.scene.microscope = Some(microscope);
    config.scene.specimen = SpecimenConfig {
        surface: SurfaceConfig::Sphere { radius_mm: CAP_MM[0], apex_mm: CAP_MM[1], floor_mm: None },
        half_width_mm: 0.25,
        half_height_mm: 0.25,
        offset_mm: [0.0; 3],
    };
    config.scene.texture = TextureConfig { speckle_mm: 0.0027, ..TextureConfig::default() };
    config.camera.full_well_electrons = 25_000.0;
    config.camera.read_noise_electrons = 10.0;
    with_rig(config, experiment, wavelength_mm)
}

/// The simulated light-field microscope in front of its beads; LED 3 is not connected.
pub fn lightfield(experiment: &Experiment) -> SimConfig {
    let mut config = SimConfig::default();
    let lightfield = LightFieldConfig::default();
    let wavelength_mm = 1e-3 * lightfield.wavelength_um;
    config.scene.lightfield = Some(lightfield);
    config.camera.full_well_electrons = 25_000.0;
    config.camera.read_noise_electrons = 5.0;
    let mut config = with_rig(config, experiment, wavelength_mm);
    if let Some(rate) = config.light.led_electrons_per_s.last_mut() {
        *rate = 0.0;
    }
    config
}

/// Height of the specimen under the microscope at (x, y), all in millimetres, from the formula of the sphere.
pub fn microscope_height_mm(x: f64, y: f64) -> f64 {
    (CAP_MM[0].powi(2) - x * x - y * y).sqrt() - CAP_MM[0] + CAP_MM[1]
}

/// What a red, green and blue pixel of a common sensor make of light of one wavelength, the best of them being 1:
/// bell curves about 610, 535 and 460 nm over a floor of 2 %.
fn response(wavelength_mm: f64) -> [f64; 3] {
    let nm = wavelength_mm * 1e6;
    let bell = |centre: f64| 0.02 + 0.98 * (-0.5 * ((nm - centre) / 40.0).powi(2)).exp();
    let all = [610.0, 535.0, 460.0].map(bell);
    let best = all.iter().copied().fold(0.0, f64::max);
    all.map(|r| r / best)
}

fn with_rig(mut config: SimConfig, experiment: &Experiment, wavelength_mm: f64) -> SimConfig {
    config.seed = experiment.seed;
    let camera = &experiment.rig.camera;
    config.camera.width = camera.width as usize;
    config.camera.height = camera.height as usize;
    config.camera.line = camera.line;
    config.camera.bits = camera.bits;
    config.camera.trigger_delay_ns = camera.exposure_delay.ns().round() as u64;
    config.camera.exposure_ns = camera.exposure.ns().round() as u64;
    config.camera.readout_ns = camera.readout.ns().round() as u64;
    config.camera.row_ns = camera.row_time.ns().round() as u64;
    config.camera.bayer = camera.bayer.map(|bayer| BayerConfig {
        pattern: match bayer.pattern {
            experiment::BayerPattern::Rggb => BayerPattern::Rggb,
            experiment::BayerPattern::Grbg => BayerPattern::Grbg,
            experiment::BayerPattern::Gbrg => BayerPattern::Gbrg,
            experiment::BayerPattern::Bggr => BayerPattern::Bggr,
        },
        response: response(wavelength_mm),
    });
    // the whole range of grey levels, a twentieth of it for the dark level
    let levels = f64::from((1u32 << camera.bits) - 1);
    config.camera.offset_dn = (0.05 * levels).round();
    config.camera.electrons_per_dn = config.camera.full_well_electrons / (0.95 * levels);

    let strobe = &experiment.rig.strobe;
    let lit_s = strobe.width.ns() * 1e-9 * strobe.level.unwrap_or(1.0);
    config.light = LightConfig {
        led_electrons_per_s: vec![FILL * config.camera.full_well_electrons / lit_s; 4],
        ..LightConfig::default()
    };
    config.board.leds = vec![LedConfig::default(); 4];
    config.board.cameras = 4;
    config.board.axes = Vec::new();
    for (number, (_, axis)) in experiment.rig.axes.named().into_iter().enumerate() {
        let Some(axis) = axis else {
            config.board.axes.push(AxisConfig::default());
            continue;
        };
        let per_mm = axis.steps_per_mm;
        config.stage.steps_per_mm[number] = per_mm;
        config.board.axes.push(AxisConfig {
            min: (axis.min.mm() * per_mm).floor() as i32,
            max: (axis.max.mm() * per_mm).ceil() as i32,
            max_rate: (axis.rate.mm_per_s() * per_mm).ceil() as u32,
            max_acceleration: (axis.acceleration.mm_per_s2() * per_mm).ceil() as u32,
            ..AxisConfig::default()
        });
    }
    config
}

fn truth(optics: &Optics) -> OpticsConfig {
    let grating = |g: &Grating| GratingConfig {
        pitch_mm: g.pitch_mm,
        tilt_rad: g.tilt_rad_xyz,
        substrate_mm: g.substrate.thickness_mm,
        substrate_index: g.substrate.index,
    };
    let brown = optics.camera.brown;
    OpticsConfig {
        wavelength_mm: optics.wavelength_mm,
        focal_px: optics.camera.focal_px,
        principal_point_px: Some(optics.camera.principal_point_px),
        brown_k: [brown.k1, brown.k2, brown.k3],
        brown_p: [brown.p1, brown.p2],
        pinhole_to_grating_mm: optics.pinhole_to_grating_mm,
        grating_to_reference_mm: optics.grating_to_reference_mm,
        grating: grating(&optics.minus),
        grating_plus: (optics.plus != optics.minus).then(|| grating(&optics.plus)),
    }
}

/// The demo's specimen: a spherical cap that both views see whole, with room for the calibration moves.
pub fn demo_specimen() -> SpecimenConfig {
    SpecimenConfig {
        surface: SurfaceConfig::Sphere { radius_mm: 40.0, apex_mm: 1.0, floor_mm: None },
        half_width_mm: 7.5,
        half_height_mm: 7.5,
        offset_mm: [0.0; 3],
    }
}

/// Height of [`demo_specimen`] at (x, y), all in millimetres, from the formula of the sphere.
pub fn demo_height_mm(x: f64, y: f64) -> f64 {
    (40.0f64.powi(2) - x * x - y * y).sqrt() - 40.0 + 1.0
}

/// The camera of a simulated rig.
pub struct SimCamera {
    info: CameraInfo,
    frames: Receiver<SimFrame>,
    settings: CameraSettings,
    stats: CameraStats,
    started: bool,
}

impl SimCamera {
    /// A camera that hands on `frames` of a rig with this configuration.
    pub fn new(config: &SimConfig, frames: Receiver<SimFrame>) -> Self {
        Self {
            info: CameraInfo {
                vendor: "daic".to_owned(),
                model: "simulated".to_owned(),
                serial: format!("seed-{}", config.seed),
                sensor_px: [config.camera.width as u32, config.camera.height as u32],
                pixel_um: None,
                has_clock: true,
            },
            frames,
            settings: CameraSettings {
                exposure: Time::new(config.camera.exposure_ns as f64),
                bits: config.camera.bits,
                hardware_trigger: true,
            },
            stats: CameraStats::default(),
            started: false,
        }
    }
}

impl Camera for SimCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    /// The simulated camera is what the experiment made it: other settings are refused.
    fn configure(&mut self, settings: &CameraSettings) -> Result<CameraSettings, CameraError> {
        let refuse =
            |setting, value: String, allowed: String| Err(CameraError::Setting { setting, value, allowed });
        if !settings.hardware_trigger {
            return refuse("hardware_trigger", "false".to_owned(), "true".to_owned());
        }
        if settings.bits != self.settings.bits {
            return refuse("bits", settings.bits.to_string(), self.settings.bits.to_string());
        }
        if (settings.exposure.ns() - self.settings.exposure.ns()).abs() > 0.5 {
            return refuse("exposure", settings.exposure.to_string(), self.settings.exposure.to_string());
        }
        Ok(self.settings)
    }

    fn start(&mut self) -> Result<(), CameraError> {
        if self.started {
            return Err(CameraError::WrongState { state: "started", wanted: "start" });
        }
        self.started = true;
        self.stats = CameraStats::default();
        Ok(())
    }

    fn next(&mut self, timeout: Duration) -> Result<Frame, FrameError> {
        match self.frames.recv_timeout(timeout) {
            Ok(frame) => {
                self.stats.completed += 1;
                Ok(Frame {
                    id: frame.id,
                    camera_ns: Some(frame.camera_ns),
                    host: Instant::now(),
                    width: frame.width as u32,
                    height: frame.height as u32,
                    bits: frame.bits,
                    data: frame.data,
                })
            }
            Err(RecvTimeoutError::Timeout) => {
                Err(FrameError::Timeout { after_ms: u64::try_from(timeout.as_millis()).unwrap_or(u64::MAX) })
            }
            Err(RecvTimeoutError::Disconnected) => Err(FrameError::Disconnected),
        }
    }

    fn stop(&mut self) -> Result<CameraStats, CameraError> {
        if !self.started {
            return Err(CameraError::WrongState { state: "stopped", wanted: "stop" });
        }
        self.started = false;
        Ok(self.stats)
    }
}

/// Reads a scene file of the simulated rig.
///
/// # Errors
/// The file, or the line and key in it that cannot be used.
pub fn load_scene(path: &std::path::Path) -> Result<SimConfig, Error> {
    let text =
        std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    Ok(SimConfig::from_toml(&text)?)
}
