//! Which pixels are used, and what whole turns belong to them.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use super::carrier::{Carrier, Prediction, Sample, fit};
use super::{DistortionError, LEAST_SAMPLES, TargetPhases};
use crate::camera::Brown;
use crate::maps::MapGrid;

/// Nodes of the map over the target.
pub(super) struct Grid {
    pub(super) map: MapGrid,
    /// Distance between nodes, pixels.
    pub(super) step: usize,
    /// Pixels of the arrays that are used.
    usable: Vec<bool>,
    /// Part of the image within the windows of these pixels.
    pub(super) share: f64,
}

/// Nodes are this many widths of the window apart. Two noise averages over Gaussian windows are
/// correlated by 0.37 then, and of a wave as short as the nodes can carry e⁻⁵ passes the window.
const STEP_IN_WIDTHS: f64 = 2.0;
/// Nearest nodes, pixels.
const LEAST_STEP: f64 = 4.0;

fn check(p: &TargetPhases<'_>) -> Result<(), DistortionError> {
    let expected = p.width * p.height;
    for (k, d) in p.directions.iter().enumerate() {
        for (array, found) in
            [("the phase", d.phase_rad.len()), ("σ", d.sigma_rad.len()), ("the parts", d.part.len())]
        {
            if found != expected {
                return Err(DistortionError::Size { array, direction: k + 1, found, expected });
            }
        }
        let found = d.window.len();
        let sum: f32 = d.window.iter().sum();
        if found < 3 || found % 2 == 0 || !(sum > 0.0) {
            return Err(DistortionError::Window { found });
        }
    }
    Ok(())
}

/// Standard deviation of the Gaussian that averages noise as the window does.
fn width(window: &[f32]) -> f64 {
    let sum: f64 = window.iter().map(|w| f64::from(*w)).sum();
    let energy: f64 = window.iter().map(|w| f64::from(*w).powi(2)).sum::<f64>() / (sum * sum);
    0.5 / (std::f64::consts::PI.sqrt() * energy)
}

impl Grid {
    pub(super) fn new(p: &TargetPhases<'_>) -> Result<Self, DistortionError> {
        check(p)?;
        let narrow = p.directions.iter().map(|d| width(d.window)).fold(f64::INFINITY, f64::min);
        let step = (STEP_IN_WIDTHS * narrow).max(LEAST_STEP).round() as usize;
        let reach = p.directions.iter().map(|d| d.window.len() / 2).max().unwrap_or(0);
        let usable = usable(p, reach);
        let mut from = [usize::MAX; 2];
        let mut to = [0; 2];
        let mut found = 0;
        for k in (0..usable.len()).filter(|k| usable[*k]) {
            found += 1;
            for (i, v) in [k % p.width, k / p.width].into_iter().enumerate() {
                from[i] = from[i].min(v);
                to[i] = to[i].max(v);
            }
        }
        if found == 0 {
            return Err(DistortionError::TooFew { found, needed: LEAST_SAMPLES });
        }
        let seen = near(&usable, p.width, reach);
        let share = seen.iter().filter(|s| **s).count() as f64 / seen.len() as f64;
        // As far as the windows saw the target.
        let size = [p.width, p.height];
        let mut origin_px = [0.0; 2];
        let mut nodes = [0; 2];
        for i in 0..2 {
            let (first, last) = (from[i].saturating_sub(reach), (to[i] + reach).min(size[i] - 1));
            nodes[i] = ((last - first).div_ceil(step) + 1).max(4);
            let beyond = (nodes[i] - 1) * step - (last - first).min((nodes[i] - 1) * step);
            origin_px[i] = (p.origin_px[i] + first) as f64 - (beyond / 2) as f64;
        }
        Ok(Self { map: MapGrid { origin_px, step_px: [step as f64; 2], nodes }, step, usable, share })
    }

    /// Pixels of the arrays at the nodes moved by `offset`, with the node's number.
    pub(super) fn pixels<'a>(
        &'a self,
        p: &'a TargetPhases<'_>,
        offset: f64,
    ) -> impl Iterator<Item = (usize, usize)> + 'a {
        let [nx, ny] = self.map.nodes;
        (0..nx * ny).filter_map(move |node| {
            let at = self.map.node_px(node % nx, node / nx);
            let place = |i: usize, size: usize| {
                let v = at[i] + offset - p.origin_px[i] as f64;
                (v >= 0.0 && v < size as f64).then_some(v as usize)
            };
            Some((node, place(1, p.height)? * p.width + place(0, p.width)?))
        })
    }
}

/// Pixels with both phases whose windows lie on the target: where they reach over its edge the step of
/// brightness there is taken for lines. (Over the edge of the image no phase reaches.)
fn usable(p: &TargetPhases<'_>, reach: usize) -> Vec<bool> {
    let both = |k: usize| {
        p.directions
            .iter()
            .all(|d| d.part[k] != 0 && d.phase_rad[k].is_finite() && d.sigma_rad[k].is_finite())
    };
    let valid: Vec<bool> = (0..p.width * p.height).map(both).collect();
    let inner = |at: usize, size: usize| at >= reach && at + reach < size;
    let beside: Vec<bool> = (0..valid.len())
        .map(|k| !valid[k] && inner(k % p.width, p.width) && inner(k / p.width, p.height))
        .collect();
    let over = near(&beside, p.width, reach);
    valid.into_iter().zip(over).map(|(v, o)| v && !o).collect()
}

/// Pixels with one of `these` within `reach` along both axes.
fn near(these: &[bool], width: usize, reach: usize) -> Vec<bool> {
    let height = these.len() / width;
    let grown = |from: &[bool], out: &mut [bool], length: usize, step: usize, start: usize| {
        let mut done = 0;
        for i in (0..length).filter(|i| from[start + i * step]) {
            for n in done.max(i.saturating_sub(reach))..(i + reach + 1).min(length) {
                out[start + n * step] = true;
            }
            done = (i + reach + 1).min(length);
        }
    };
    let mut along = vec![false; these.len()];
    for y in 0..height {
        grown(these, &mut along, width, 1, y * width);
    }
    let mut out = vec![false; these.len()];
    for x in 0..width {
        grown(&along, &mut out, height, width, x);
    }
    out
}

impl Grid {
    /// Both phases at pixel k of the arrays, as they are.
    pub(super) fn sample(&self, p: &TargetPhases<'_>, k: usize) -> Option<Sample> {
        self.usable[k].then(|| Sample {
            pixel: [(p.origin_px[0] + k % p.width) as f64, (p.origin_px[1] + k / p.width) as f64],
            turns: p.directions.map(|d| d.phase_rad[k] / TAU),
            sigma: p.directions.map(|d| f64::from(d.sigma_rad[k]) / TAU),
        })
    }
}

/// Samples at the nodes, all counted from the largest part; how many were left out.
///
/// A carrier through the largest part says how many whole turns lie between it and another part,
/// unless the distortion between them is half a line or more.
pub(super) fn joined(
    grid: &Grid,
    p: &TargetPhases<'_>,
    prediction: &Prediction,
    base: &Brown,
) -> Result<(Vec<(usize, Sample)>, usize), DistortionError> {
    let mut by_part: BTreeMap<[u32; 2], Vec<(usize, Sample)>> = BTreeMap::new();
    for (node, k) in grid.pixels(p, 0.0) {
        if let Some(s) = grid.sample(p, k) {
            by_part.entry(p.directions.map(|d| d.part[k])).or_default().push((node, s));
        }
    }
    let largest = by_part.values().map(Vec::len).max().unwrap_or(0);
    let found = by_part.values().map(Vec::len).sum();
    let first = by_part.iter().find(|(_, s)| s.len() == largest).map(|(k, _)| *k);
    let Some(mut all) = first.and_then(|f| by_part.remove(&f)) else {
        return Err(DistortionError::TooFew { found, needed: LEAST_SAMPLES });
    };
    if all.len() < LEAST_SAMPLES {
        return Err(DistortionError::TooFew { found: all.len(), needed: LEAST_SAMPLES });
    }
    let mut left_out = 0;
    if !by_part.is_empty() {
        let nodes: Vec<Sample> = all.iter().map(|(_, s)| *s).collect();
        let start = Carrier::start(&nodes, prediction, base, p.pose)?;
        let carrier = fit(&nodes, prediction, start, *base, [false; 5])?.carrier;
        for mut samples in by_part.into_values() {
            let expected: Option<Vec<[f64; 2]>> = samples
                .iter()
                .map(|(_, s)| prediction.plane(s.pixel, base).map(|q| carrier.turns(q)))
                .collect();
            let Some(turns) = expected.and_then(|e| whole_turns(&samples, &e)) else {
                left_out += samples.len();
                continue;
            };
            for (_, s) in &mut samples {
                s.turns = [0, 1].map(|i| s.turns[i] + turns[i]);
            }
            all.append(&mut samples);
        }
        all.sort_by_key(|(node, _)| *node);
    }
    Ok((all, left_out))
}

/// The whole turns that bring a part nearest to what is expected, if they are beyond doubt.
fn whole_turns(samples: &[(usize, Sample)], expected: &[[f64; 2]]) -> Option<[f64; 2]> {
    let mut turns = [0.0; 2];
    for (i, turn) in turns.iter_mut().enumerate() {
        let mut off: Vec<f64> = samples.iter().zip(expected).map(|((_, s), e)| e[i] - s.turns[i]).collect();
        off.sort_by(f64::total_cmp);
        let middle = off[off.len() / 2];
        *turn = middle.round();
        if (middle - *turn).abs() > 0.25 {
            return None;
        }
    }
    Some(turns)
}
