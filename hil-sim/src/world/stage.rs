//! The stage stands where the step pulses put it, behind the play of its drives.

use daic_protocol::channels::{self, AXES};

use crate::config::StageConfig;

/// Positions counted from the pulses.
#[derive(Debug, Clone)]
pub struct Stage {
    steps: [i64; AXES as usize],
    steps_per_mm: [f64; 3],
    /// Half of the play of each drive, in millimetres.
    play_mm: [f64; 3],
    /// Where the carriages stand, in millimetres.
    carriage_mm: [f64; 3],
}

impl Stage {
    /// All axes at step 0, in the middle of their play.
    pub fn new(config: &StageConfig) -> Self {
        Self {
            steps: [0; AXES as usize],
            steps_per_mm: config.steps_per_mm,
            play_mm: config.backlash_mm.map(|play| 0.5 * play),
            carriage_mm: [0.0; 3],
        }
    }

    /// The word changes: each rising step line moves its axis by one step, in the direction that
    /// the direction line has from this word on.
    pub fn edge(&mut self, before: u32, after: u32) {
        let risen = after & !before;
        if risen & channels::AXIS_MASK == 0 {
            return;
        }
        for (axis, steps) in (0u8..).zip(&mut self.steps) {
            let (Some(step), Some(direction)) = (channels::step(axis), channels::direction(axis)) else {
                continue;
            };
            if risen & step != 0 {
                *steps += if after & direction != 0 { 1 } else { -1 };
            }
        }
        // A drive pulls its carriage along once it has turned through its play.
        for (k, carriage) in self.carriage_mm.iter_mut().enumerate() {
            let drive = self.steps[k] as f64 / self.steps_per_mm[k];
            *carriage = carriage.clamp(drive - self.play_mm[k], drive + self.play_mm[k]);
        }
    }

    /// Steps made from the start, signed, per axis.
    pub fn steps(&self) -> [i64; AXES as usize] {
        self.steps
    }

    /// Position of the specimen: x right, y down, h towards the camera, in millimetres.
    pub fn position_mm(&self) -> [f64; 3] {
        self.carriage_mm
    }
}
