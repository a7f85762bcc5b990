//! Colour filters of a sensor.

use serde::{Deserialize, Serialize};

/// A Bayer mosaic and what it lets through.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BayerConfig {
    /// Colours of the pixels (0, 0), (1, 0), (0, 1), (1, 1).
    pub pattern: BayerPattern,
    /// Share of the light that a red, green and blue pixel turns into electrons, of what a bare pixel would.
    pub response: [f64; 3],
}

/// Colours of a Bayer cell, row by row from the top left.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BayerPattern {
    /// Red, green / green, blue.
    Rggb,
    /// Green, red / blue, green.
    Grbg,
    /// Green, blue / red, green.
    Gbrg,
    /// Blue, green / green, red.
    Bggr,
}

impl BayerConfig {
    /// Share of the light that the pixel (`x`, `y`) turns into electrons.
    pub fn response_at(&self, x: usize, y: usize) -> f64 {
        // 0 red, 1 green, 2 blue
        let cell = match self.pattern {
            BayerPattern::Rggb => [0, 1, 1, 2],
            BayerPattern::Grbg => [1, 0, 2, 1],
            BayerPattern::Gbrg => [1, 2, 0, 1],
            BayerPattern::Bggr => [2, 1, 1, 0],
        };
        self.response[cell[2 * (y % 2) + x % 2]]
    }
}
