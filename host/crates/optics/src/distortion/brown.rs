//! Brown's terms fitted beside the dense map.

use super::DistortionError;
use super::carrier::{Fit, Prediction, Sample, fit, rms};
use super::parts::Grid;
use crate::camera::Brown;

/// Brown's terms fitted to the phases, with a carrier of their own.
#[derive(Clone, Debug, PartialEq)]
pub struct BrownFit {
    /// The terms; those that are not fitted are what the camera has.
    pub brown: Brown,
    /// Standard deviations of k1, k2, k3, p1, p2 from what is left and how far it is alike; nothing for
    /// terms that are not fitted.
    pub sigma: [Option<f64>; 5],
    /// RMS of (e_x, e_y) that they leave, pixels.
    pub left_px: [f64; 2],
    /// (e_x, e_y) by these terms at the nodes of the map, row by row, counted from the map's carrier.
    pub e_px: Vec<[f64; 2]>,
}

/// Terms tried, each more after the one before: k2 and k3 only if they come out as significant.
const LADDER: [[bool; 5]; 3] =
    [[true, false, false, true, true], [true, true, false, true, true], [true, true, true, true, true]];
/// Significant: this many standard deviations.
const SIGNIFICANT: f64 = 3.0;

/// The fit. Where the phases determine not even k1, p1 and p2, the
/// terms that are there already stand.
pub(super) fn fit_beside(
    grid: &Grid,
    samples: &[(usize, Sample)],
    prediction: &Prediction,
    only: &Fit,
) -> Result<BrownFit, DistortionError> {
    let nodes: Vec<Sample> = samples.iter().map(|(_, s)| *s).collect();
    let mut best: Option<(BrownFit, Fit)> = None;
    for (round, free) in LADDER.into_iter().enumerate() {
        let from = best.as_ref().map_or(only, |(_, f)| f);
        let found = match fit(&nodes, prediction, from.carrier.clone(), from.brown, free) {
            Ok(found) => found,
            Err(
                DistortionError::Undetermined
                | DistortionError::NotConverged
                | DistortionError::Unpredictable { .. },
            ) => break,
            Err(e) => return Err(e),
        };
        let sigma = sigmas(grid, samples, &found, free);
        let top = [(found.brown.k1, sigma[0]), (found.brown.k2, sigma[1]), (found.brown.k3, sigma[2])][round];
        if round > 0 && !top.1.is_some_and(|s| top.0.abs() > SIGNIFICANT * s) {
            break;
        }
        let fit = BrownFit { brown: found.brown, sigma, left_px: rms(&found.left), e_px: Vec::new() };
        best = Some((fit, found));
    }
    let (mut fit, beside) = best.unwrap_or_else(|| {
        let left_px = rms(&only.left);
        (BrownFit { brown: only.brown, sigma: [None; 5], left_px, e_px: Vec::new() }, only.clone())
    });
    fit.e_px = at_nodes(grid, prediction, only, &beside)?;
    Ok(fit)
}

/// e by the fit at every node, counted from the carrier of the map.
fn at_nodes(
    grid: &Grid,
    prediction: &Prediction,
    only: &Fit,
    beside: &Fit,
) -> Result<Vec<[f64; 2]>, DistortionError> {
    let [nx, ny] = grid.map.nodes;
    let at = |pixel: [f64; 2]| {
        let turns = beside.carrier.turns(prediction.plane(pixel, &beside.brown)?);
        let s = Sample { pixel, turns, sigma: [0.0; 2] };
        Some(only.carrier.distortion(&s, prediction, &only.brown)?.e)
    };
    (0..nx * ny)
        .map(|k| {
            let pixel_px = grid.map.node_px(k % nx, k / nx);
            at(pixel_px).ok_or(DistortionError::Unpredictable { pixel_px })
        })
        .collect()
}

/// σ of the free terms: what is left is alike at neighbouring nodes, so there are fewer independent values
/// than nodes, by (1 + ρ)/(1 − ρ) along each axis for a correlation ρ of neighbours.
fn sigmas(grid: &Grid, samples: &[(usize, Sample)], found: &Fit, free: [bool; 5]) -> [Option<f64>; 5] {
    let [nx, ny] = grid.map.nodes;
    let mut at = vec![None; nx * ny];
    for ((node, _), e) in samples.iter().zip(&found.left) {
        at[*node] = Some(*e);
    }
    let alike = |step: usize, whole: &dyn Fn(usize) -> bool| {
        let (mut product, mut square) = (0.0, 0.0);
        for k in (0..nx * ny - step).filter(|k| whole(*k)) {
            if let (Some(a), Some(b)) = (at[k], at[k + step]) {
                product += a[0] * b[0] + a[1] * b[1];
                square += 0.5 * (a[0] * a[0] + a[1] * a[1] + b[0] * b[0] + b[1] * b[1]);
            }
        }
        let r = if square > 0.0 { (product / square).clamp(0.0, 0.99) } else { 0.0 };
        (1.0 + r) / (1.0 - r)
    };
    let fewer = alike(1, &|k| k % nx + 1 < nx) * alike(nx, &|_| true);
    let square: f64 = found.left.iter().map(|e| e[0] * e[0] + e[1] * e[1]).sum();
    let freedom = (2 * found.left.len()).saturating_sub(found.covariance.nrows() + 10).max(1);
    let variance = fewer * square / freedom as f64;
    let mut sigma = [None; 5];
    for (row, k) in (0..5).filter(|k| free[*k]).enumerate() {
        sigma[k] = Some((variance * found.covariance[(row, row)]).sqrt());
    }
    sigma
}
