//! The stage stands where the step pulses put it.

use daic_protocol::channels::{self, AXES};

use crate::config::StageConfig;

/// Positions counted from the pulses.
#[derive(Debug, Clone)]
pub struct Stage {
    steps: [i64; AXES as usize],
    steps_per_mm: [f64; 3],
}

impl Stage {
    /// All axes at step 0.
    pub fn new(config: &StageConfig) -> Self {
        Self { steps: [0; AXES as usize], steps_per_mm: config.steps_per_mm }
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
    }

    /// Steps made from the start, signed, per axis.
    pub fn steps(&self) -> [i64; AXES as usize] {
        self.steps
    }

    /// Position of the specimen: x right, y down, h towards the camera, in millimetres.
    pub fn position_mm(&self) -> [f64; 3] {
        [0, 1, 2].map(|k| self.steps[k] as f64 / self.steps_per_mm[k])
    }
}
