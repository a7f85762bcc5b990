//! Places of a cross grating's lines.

use super::interpolate::inverse;
use super::map::PhaseMaps;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Where both phases of a cross grating are whole turns: the middle of a bright spot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// Turns of the first direction.
    pub m: i64,
    /// Turns of the second direction.
    pub n: i64,
    /// Position, pixels.
    pub x: f64,
    /// Position, pixels.
    pub y: f64,
    /// Standard uncertainty of x from image noise, pixels.
    pub sigma_x: f64,
    /// Standard uncertainty of y from image noise, pixels.
    pub sigma_y: f64,
    /// Connected parts of the two maps that it lies in. Crossings count together only within a part.
    pub parts: [u32; 2],
}

/// A cross grating's own coordinates at every pixel: what a distortion calibration compares with
/// the ideal grating.
#[derive(Debug, Clone, PartialEq)]
pub struct GridCoordinates {
    /// Columns of the image.
    pub width: usize,
    /// Rows of the image.
    pub height: usize,
    /// Pitches along the first direction, Φ/2π; NaN where there is no phase.
    pub first: Vec<f64>,
    /// Pitches along the second direction.
    pub second: Vec<f64>,
    /// Standard uncertainty of `first`, pitches.
    pub sigma_first: Vec<f32>,
    /// Standard uncertainty of `second`, pitches.
    pub sigma_second: Vec<f32>,
    /// Pixels of the largest connected part that both directions share: their coordinates count
    /// from one origin.
    pub valid: Vec<bool>,
}

impl PhaseMaps {
    /// Coordinates in the grating's own frame at every pixel, in pitches; `None` for a line
    /// grating.
    ///
    /// This is what the calibration of image distortion takes: with the pitch of the target the
    /// coordinates are lengths on it, apart from an unknown whole number of pitches.
    pub fn grid_coordinates(&self) -> Option<GridCoordinates> {
        let [a, b] = &self.directions[..] else { return None };
        let pitches = |p: &[f64]| p.iter().map(|v| v / TAU).collect();
        let sigma = |s: &[f32]| s.iter().map(|v| v / TAU as f32).collect();
        Some(GridCoordinates {
            width: self.width,
            height: self.height,
            first: pitches(&a.phase),
            second: pitches(&b.phase),
            sigma_first: sigma(&a.sigma),
            sigma_second: sigma(&b.sigma),
            valid: a.label.iter().zip(&b.label).map(|(a, b)| *a == 1 && *b == 1).collect(),
        })
    }

    /// All crossings of a cross grating, ordered by parts, then n, then m; empty for a line grating.
    pub fn crossings(&self) -> Vec<Crossing> {
        let mut found: Vec<Crossing> = (0..self.height)
            .into_par_iter()
            .flat_map_iter(|y| (0..self.width).filter_map(move |x| self.crossing(x, y)))
            .collect();
        found.sort_by_key(|c| (c.parts, c.n, c.m));
        // one on the border of two pixels is found from both
        found.dedup_by_key(|c| (c.parts, c.n, c.m));
        found
    }

    /// The crossing within pixel (x, y), by Newton's method.
    fn crossing(&self, x: usize, y: usize) -> Option<Crossing> {
        let [a, b] = &self.directions[..] else { return None };
        let k = y * self.width + x;
        let parts = [a.label[k], b.label[k]];
        if parts.contains(&0) {
            return None;
        }
        let turns = [a.phase[k], b.phase[k]].map(|p| (p / TAU).round());
        // a pixel is at most this part of a turn away from its own corners
        let near = |p: f64, t: f64, f: f64| (p / TAU - t).abs() <= f;
        if !near(a.phase[k], turns[0], a.carrier.frequency())
            || !near(b.phase[k], turns[1], b.carrier.frequency())
        {
            return None;
        }
        let (mut px, mut py) = (x as f64, y as f64);
        for _ in 0..10 {
            let (sa, sb) = (a.sample(self.width, px, py, parts[0])?, b.sample(self.width, px, py, parts[1])?);
            let g = inverse([sa.gradient, sb.gradient])?;
            let e = [sa.phase - TAU * turns[0], sb.phase - TAU * turns[1]];
            let d = [0, 1].map(|i| -(g[i][0] * e[0] + g[i][1] * e[1]));
            (px, py) = (px + d[0], py + d[1]);
            if (px - x as f64).abs() > 1.0 || (py - y as f64).abs() > 1.0 {
                return None;
            }
            if d[0].abs().max(d[1].abs()) < 1e-9 {
                let inside = (px - x as f64).abs() <= 0.5 + 1e-6 && (py - y as f64).abs() <= 0.5 + 1e-6;
                let (sa, sb) = (f64::from(a.sigma[k]), f64::from(b.sigma[k]));
                let sigma = [0, 1].map(|i| (g[i][0] * sa).hypot(g[i][1] * sb));
                return inside.then_some(Crossing {
                    m: turns[0] as i64,
                    n: turns[1] as i64,
                    x: px,
                    y: py,
                    sigma_x: sigma[0],
                    sigma_y: sigma[1],
                    parts,
                });
            }
        }
        None
    }
}
