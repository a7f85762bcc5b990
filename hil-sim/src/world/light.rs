//! An LED shines only while its line is up, as bright as its level.

use daic_protocol::channels;

use crate::config::LightConfig;

/// All light sources.
#[derive(Debug, Clone)]
pub struct Lamps {
    full: Vec<f64>,
    level: Vec<u16>,
    ambient: f64,
}

impl Lamps {
    /// Every LED at level 0, as the box leaves them when it boots.
    pub fn new(config: &LightConfig) -> Self {
        Self {
            full: config.led_electrons_per_s.clone(),
            level: vec![0; config.led_electrons_per_s.len()],
            ambient: config.ambient_electrons_per_s,
        }
    }

    /// Sets the level of an LED; one that is not there stays dark.
    pub fn set_level(&mut self, led: u8, level: u16) {
        if let Some(current) = self.level.get_mut(usize::from(led)) {
            *current = level;
        }
    }

    /// Photo-electrons per second at reflectance 1 while the output word is `word`.
    pub fn rate(&self, word: u32) -> f64 {
        let lit = (0u8..).zip(self.full.iter().zip(&self.level)).filter_map(|(led, (full, level))| {
            let up = channels::led(led).is_some_and(|mask| word & mask != 0);
            up.then(|| full * f64::from(*level) / f64::from(u16::MAX))
        });
        self.ambient + lit.sum::<f64>()
    }
}
