//! The physics around the box, driven by its edges alone.
//!
//! The world is fed the output words in the order of their ticks. Between two words nothing on the
//! lines changes, so light and positions are exact sums over the intervals between them.

mod camera;
mod light;
mod stage;
mod wiring;

pub use camera::{Camera, ExposureRecord, Light, SubPosition};
pub use light::Lamps;
pub use stage::Stage;
pub use wiring::Wiring;

use daic_protocol::limits::TICK_HZ;

use crate::config::SimConfig;

/// Nanoseconds to ticks, rounded up so that nothing gets shorter than asked.
pub fn ticks_from_ns(ns: u64) -> u64 {
    (u128::from(ns) * u128::from(TICK_HZ)).div_ceil(1_000_000_000).min(u128::from(u64::MAX)) as u64
}

/// Ticks to nanoseconds, rounded down.
pub fn ns_from_ticks(ticks: u64) -> u64 {
    (u128::from(ticks) * 1_000_000_000 / u128::from(TICK_HZ)).min(u128::from(u64::MAX)) as u64
}

/// Stage, lamps and camera, at one instant.
#[derive(Debug)]
pub struct World {
    tick: u64,
    word: u32,
    stage: Stage,
    lamps: Lamps,
    camera: Camera,
}

impl World {
    /// Everything at rest at tick 0, all lines low.
    pub fn new(config: &SimConfig) -> Self {
        Self {
            tick: 0,
            word: daic_protocol::channels::SAFE_WORD,
            stage: Stage::new(&config.stage),
            lamps: Lamps::new(&config.light),
            camera: Camera::new(
                &config.camera,
                config.scene.blur_step_px * config.pixel_mm(),
                config.scene.blur_positions_max,
            ),
        }
    }

    /// Instant reached.
    pub fn tick(&self) -> u64 {
        self.tick
    }

    /// The stage.
    pub fn stage(&self) -> &Stage {
        &self.stage
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The camera, to set its exposure.
    pub fn camera_mut(&mut self) -> &mut Camera {
        &mut self.camera
    }

    /// Lets time pass up to `tick` with the lines as they are. Ticks of the past change nothing.
    pub fn advance(&mut self, tick: u64) {
        if tick <= self.tick {
            return;
        }
        self.camera.collect(self.tick, tick, self.lamps.rate(self.word), self.stage.position_mm());
        self.tick = tick;
    }

    /// From `tick` on the output word is `word`.
    pub fn word(&mut self, tick: u64, word: u32) {
        self.advance(tick);
        self.stage.edge(self.word, word);
        self.camera.edge(self.tick, self.word, word);
        self.word = word;
    }

    /// From `tick` on LED `led` has level `level`.
    pub fn level(&mut self, tick: u64, led: u8, level: u16) {
        self.advance(tick);
        self.lamps.set_level(led, level);
    }

    /// Tick at which the camera has ended its exposure and readout, if it is busy.
    pub fn camera_free_at(&self) -> Option<u64> {
        self.camera.free_at(self.tick)
    }

    /// Exposures that have ended since the last call.
    pub fn take_exposures(&mut self) -> Vec<ExposureRecord> {
        self.camera.take_finished()
    }
}
