//! The dense map, its uncertainty, and what it leaves.

use super::carrier::{Fit, Prediction, Sample, rms};
use super::parts::Grid;
use super::{DistortionError, Left, TargetPhases};
use crate::maps::{DistortionMap, MapFit, MapSample};

pub(super) struct Dense {
    pub(super) map: DistortionMap,
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
    base: &[[f64; 2]],
) -> Result<Dense, DistortionError> {
    let [nx, ny] = grid.map.nodes;
    let mut rest = vec![None; nx * ny];
    let mut own = vec![None; nx * ny];
    for (node, s) in samples {
        let d = only
            .carrier
            .distortion(s, prediction, &only.brown)
            .ok_or(DistortionError::Unpredictable { pixel_px: s.pixel })?;
        rest[*node] = Some([0, 1].map(|i| d.e[i] - base[*node][i]));
        own[*node] = Some(d.sigma);
    }
    let scattered: Vec<MapSample> = (0..nx * ny)
        .filter_map(|k| {
            let (e_px, sigma) = (rest[k]?, own[k]?);
            // Noise of zero would make the fit an interpolation; the phases are no better than this.
            let sigma_px = (0.5 * (sigma[0].powi(2) + sigma[1].powi(2))).sqrt().max(1e-5);
            Some(MapSample { pixel_px: grid.map.node_px(k % nx, k / nx), e_px, sigma_px })
        })
        .collect();
    let bend = bend(&rest, nx).max(1e-5);
    let fitted = DistortionMap::fit(grid.map, &scattered, bend)?;
    let at = |k: usize| grid.map.node_px(k % nx, k / nx);
    let values: Vec<[f64; 2]> = (0..nx * ny)
        .map(|k| {
            let r = fitted.map.e_px(at(k)).unwrap_or([0.0; 2]);
            [0, 1].map(|i| base[k][i] + r[i])
        })
        .collect();
    let map = DistortionMap::interpolate(grid.map, &values)?;
    let sigma = sigmas(grid, phases, &fitted, &scattered, &own);
    let measured: Vec<bool> = rest.iter().map(Option::is_some).collect();

    let between = between(grid, phases, samples, prediction, only, &map);
    let noise: Vec<[f64; 2]> = (0..nx * ny).filter(|k| measured[*k]).map(|k| sigma[k]).collect();
    let left = Left {
        between_nodes_px: rms(&between),
        noise_px: rms(&noise),
        window_px: rms(&taken_off(grid, phases, &fitted.map, &measured)),
    };
    Ok(Dense { map, sigma, measured, left })
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

/// Correlation of noise averaged with `window` at two places `lag` pixels apart.
fn correlation(window: &[f32], lag: usize) -> f64 {
    let product = |lag: usize| -> f64 {
        window.iter().zip(window.get(lag..).unwrap_or(&[])).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
    };
    product(lag) / product(0)
}

/// Nodes around one that its noise is followed over.
const FOLLOWED: usize = 8;

/// σ at the nodes. The fit takes the samples' noise as independent, but windows overlap: at the node
/// that is farthest from any gap the noise is followed exactly, through the fit's weights and the
/// overlap of the windows. Nodes amid others are smoothed alike; the rest has what the fit says,
/// widened by the same ratio.
fn sigmas(
    grid: &Grid,
    p: &TargetPhases<'_>,
    fitted: &MapFit,
    scattered: &[MapSample],
    own: &[Option<[f64; 2]>],
) -> Vec<[f64; 2]> {
    let [nx, ny] = grid.map.nodes;
    let pixel = |k: usize| grid.map.node_px(k % nx, k / nx);
    let depth = depths(own, nx);
    let deepest = (0..nx * ny).rev().max_by_key(|k| depth[*k]).unwrap_or(0);
    let lags: Vec<[f64; 2]> = (0..=2 * FOLLOWED)
        .map(|n| [0, 1].map(|i| correlation(p.directions[i].window, n * grid.step)))
        .collect();
    let influence = fitted.influence(pixel(deepest));
    let near: Vec<(usize, usize, f64)> = scattered
        .iter()
        .filter_map(|s| {
            let at = grid.map.nearest(s.pixel_px)?;
            let (i, j) = (at % nx, at / nx);
            let close = i.abs_diff(deepest % nx) <= FOLLOWED && j.abs_diff(deepest / nx) <= FOLLOWED;
            close.then(|| (i, j, influence.weight(s) * s.sigma_px))
        })
        .collect();
    let mut exact = [0.0; 2];
    for (i, j, w) in &near {
        for (k, l, v) in &near {
            let (a, b) = (lags[i.abs_diff(*k)], lags[j.abs_diff(*l)]);
            for d in 0..2 {
                exact[d] += w * v * a[d] * b[d];
            }
        }
    }
    let typical = own[deepest].map_or(1.0, |s| (0.5 * (s[0] * s[0] + s[1] * s[1])).sqrt().max(1e-5));
    let white = fitted.sigma_px(pixel(deepest)).unwrap_or(typical);
    let shrunk = exact.map(|v| v.max(0.0).sqrt() / typical);
    let widened = exact.map(|v| (v.max(0.0).sqrt() / white).max(1.0));
    (0..nx * ny)
        .map(|k| match own[k] {
            Some(s) if depth[k] > 2 => [0, 1].map(|i| s[i] * shrunk[i]),
            _ => {
                let white = fitted.sigma_px(pixel(k)).unwrap_or(f64::NAN);
                widened.map(|w| white * w)
            }
        })
        .collect()
}

/// How many nodes away the nearest node without a phase or the border lies, up to 255.
fn depths(own: &[Option<[f64; 2]>], nx: usize) -> Vec<u8> {
    let ny = own.len() / nx;
    let mut depth: Vec<u8> = own.iter().map(|o| if o.is_some() { 255 } else { 0 }).collect();
    let step = |depth: &mut Vec<u8>, i: usize, j: usize, back: bool| {
        let k = j * nx + i;
        let beside = |inside: bool, k: usize, depth: &[u8]| if inside { depth[k] } else { 0 };
        let (a, b) = if back {
            (beside(i + 1 < nx, k + 1, depth), beside(j + 1 < ny, k + nx, depth))
        } else {
            (beside(i > 0, k.wrapping_sub(1), depth), beside(j > 0, k.wrapping_sub(nx), depth))
        };
        depth[k] = depth[k].min(a.min(b).saturating_add(1));
    };
    for j in 0..ny {
        for i in 0..nx {
            step(&mut depth, i, j, false);
        }
    }
    for j in (0..ny).rev() {
        for i in (0..nx).rev() {
            step(&mut depth, i, j, true);
        }
    }
    depth
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
