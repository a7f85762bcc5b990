//! The dense map, and what it leaves.

use super::carrier::{Fit, Prediction, Sample, rms};
use super::noise::{Measured, Noise};
use super::parts::Grid;
use super::{BrownFit, DistortionError, Left, TargetPhases};
use crate::maps::{DistortionMap, MapSample};

pub(super) struct Dense {
    pub(super) map: DistortionMap,
    pub(super) noise: Vec<[f64; 2]>,
    pub(super) sigma: Vec<[f64; 2]>,
    pub(super) measured: Vec<bool>,
    pub(super) left: Left,
}

pub(super) fn make(
    grid: &Grid,
    phases: &TargetPhases<'_>,
    samples: &[(usize, Sample)],
    prediction: &Prediction,
    only: &Fit,
    brown: &BrownFit,
) -> Result<Dense, DistortionError> {
    let [nx, ny] = grid.map.nodes;
    let base = &brown.e_px;
    let mut at: Vec<Option<Measured>> = (0..nx * ny).map(|_| None).collect();
    for (node, s) in samples {
        let d = only
            .carrier
            .distortion(s, prediction, &only.brown)
            .ok_or(DistortionError::Unpredictable { pixel_px: s.pixel })?;
        let mean: f64 = d.by_noise.iter().flatten().map(|v| 0.5 * v * v).sum();
        at[*node] = Some(Measured {
            sample: MapSample {
                pixel_px: grid.map.node_px(node % nx, node / nx),
                e_px: [0, 1].map(|i| d.e[i] - base[*node][i]),
                // Noise of zero would make the fit an interpolation; the phases are no better than this.
                sigma_px: mean.sqrt().max(1e-5),
            },
            by_noise: d.by_noise,
        });
    }
    let rest: Vec<Option<[f64; 2]>> = at.iter().map(|m| Some(m.as_ref()?.sample.e_px)).collect();
    let scattered: Vec<MapSample> = at.iter().flatten().map(|m| m.sample).collect();
    let bend_px = bend(&rest, nx).max(1e-5);
    let fitted = DistortionMap::fit(grid.map, &scattered, bend_px)?.map;
    let values: Vec<[f64; 2]> = (0..nx * ny)
        .map(|k| {
            let r = fitted.e_px(grid.map.node_px(k % nx, k / nx)).unwrap_or([0.0; 2]);
            [0, 1].map(|i| base[k][i] + r[i])
        })
        .collect();
    let map = DistortionMap::interpolate(grid.map, &values)?;
    let measured: Vec<bool> = at.iter().map(Option::is_some).collect();

    let found = Noise { grid, phases, at: &at, bend_px }.sigmas(samples, prediction, only, brown)?;
    let sigma = found.noise.iter().zip(&found.stray).map(|(n, s)| n.map(|n| n.hypot(*s))).collect();
    let between = rms(&between(grid, phases, samples, prediction, only, &map));
    let noise: Vec<[f64; 2]> = (0..nx * ny).filter(|k| measured[*k]).map(|k| found.noise[k]).collect();
    let left = Left {
        between_nodes_px: [0, 1].map(|i| (between[i].powi(2) - found.between[i].powi(2)).max(0.0).sqrt()),
        noise_px: rms(&noise),
        window_px: rms(&taken_off(grid, phases, &fitted, &measured)),
    };
    Ok(Dense { map, noise: found.noise, sigma, measured, left })
}

/// Measured e less the map half-way between nodes, where the phases have not been used.
fn between(
    grid: &Grid,
    phases: &TargetPhases<'_>,
    samples: &[(usize, Sample)],
    prediction: &Prediction,
    only: &Fit,
    map: &DistortionMap,
) -> Vec<[f64; 2]> {
    let nodes = grid.map.nodes[0] * grid.map.nodes[1];
    let mut by_node = vec![None; nodes];
    for (node, s) in samples {
        by_node[*node] = Some(s);
    }
    let mut pixel = vec![0; nodes];
    for (node, k) in grid.pixels(phases, 0.0) {
        pixel[node] = k;
    }
    let parts = |k: usize| phases.directions.map(|d| d.part[k]);
    let one = |(node, k): (usize, usize)| {
        let at_node = by_node[node]?;
        if parts(k) != parts(pixel[node]) {
            return None;
        }
        // The whole turns that were found for the part.
        let before = grid.sample(phases, pixel[node])?;
        let mut s = grid.sample(phases, k)?;
        s.turns = [0, 1].map(|i| s.turns[i] + (at_node.turns[i] - before.turns[i]).round());
        let e = only.carrier.distortion(&s, prediction, &only.brown)?.e;
        let by_map = map.e_px(s.pixel)?;
        Some([0, 1].map(|i| e[i] - by_map[i]))
    };
    grid.pixels(phases, 0.5 * grid.step as f64).filter_map(one).collect()
}

/// RMS of the second differences between neighbouring nodes: how much the slope changes per cell.
fn bend(rest: &[Option<[f64; 2]>], nx: usize) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0);
    let mut add = |k: usize, step: usize| {
        if let (Some(a), Some(b), Some(c)) = (rest[k], rest[k + step], rest[k + 2 * step]) {
            for i in 0..2 {
                sum += (a[i] - 2.0 * b[i] + c[i]).powi(2);
                n += 1.0;
            }
        }
    };
    for k in 0..rest.len() {
        if k % nx + 2 < nx {
            add(k, 1);
        }
        if k + 2 * nx < rest.len() {
            add(k, nx);
        }
    }
    if n > 0.0 { f64::sqrt(sum / n) } else { 0.0 }
}

/// What the windows take off the map beyond Brown's terms, at the measured nodes. (The analysis follows
/// smooth phases with a polynomial, which the window does not touch.) The map is averaged on a grid
/// of half the step.
fn taken_off(grid: &Grid, p: &TargetPhases<'_>, rest: &DistortionMap, measured: &[bool]) -> Vec<[f64; 2]> {
    let [nx, ny] = grid.map.nodes;
    let (cols, rows) = (2 * nx - 1, 2 * ny - 1);
    let half = 0.5 * grid.step as f64;
    let fine: Vec<[f64; 2]> = (0..cols * rows)
        .map(|k| {
            let [x, y] = grid.map.node_px(0, 0);
            rest.at([x + half * (k % cols) as f64, y + half * (k / cols) as f64]).0
        })
        .collect();
    let mut off = vec![[0.0; 2]; nx * ny];
    let mut whole = vec![true; nx * ny];
    for (d, direction) in p.directions.iter().enumerate() {
        let weights = resampled(direction.window, half);
        let r = weights.len() / 2;
        let mut along = vec![f64::NAN; cols * rows];
        for y in 0..rows {
            for x in r..cols.saturating_sub(r) {
                along[y * cols + x] =
                    weights.iter().enumerate().map(|(k, w)| w * fine[y * cols + x + k - r][d]).sum();
            }
        }
        for node in 0..nx * ny {
            let (x, y) = (2 * (node % nx), 2 * (node / nx));
            let inside = y >= r && y + r < rows;
            let mean: f64 = if inside {
                weights.iter().enumerate().map(|(k, w)| w * along[(y + k - r) * cols + x]).sum()
            } else {
                f64::NAN
            };
            whole[node] &= mean.is_finite() && measured[node];
            off[node][d] = fine[y * cols + x][d] - mean;
        }
    }
    off.into_iter().zip(whole).filter(|(_, w)| *w).map(|(o, _)| o).collect()
}

/// A window's weights `step` pixels apart, of unit sum.
fn resampled(window: &[f32], step: f64) -> Vec<f64> {
    let r = (window.len() / 2) as f64;
    let n = (r / step).floor() as i64;
    let at = |k: i64| {
        let x = r + step * k as f64;
        let (i, t) = (x.floor() as usize, x.fract());
        let (a, b) = (f64::from(window[i]), window.get(i + 1).map_or(0.0, |w| f64::from(*w)));
        a + t * (b - a)
    };
    let weights: Vec<f64> = (-n..=n).map(at).collect();
    let sum: f64 = weights.iter().sum();
    weights.into_iter().map(|w| w / sum).collect()
}
