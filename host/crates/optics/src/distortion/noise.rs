//! What image noise makes of a map: exact propagation through everything that the map is made with.
//!
//! The noise n of a direction's phases has the correlation ρ(Δx) ρ(Δy) of the overlap of its analysis windows.
//! It moves e by y = M n, M being the derivative of e by the phases. Let X₁ be the derivatives of e by the
//! carrier at the nodes, X₂ by the carrier and Brown's terms, G = (XᵀX)⁻¹, and S_k the weights that the
//! smoothing spline gives the samples at node k. What Brown's terms leave is y − X₂G₂X₂ᵀ y; the spline goes
//! through that, and Brown's terms counted from the map's carrier are added again:
//!
//! ```text
//! map_k = S_k y + (X₂ₖ − S_k X₂) G₂ X₂ᵀ y − X₁ₖ G₁ X₁ᵀ y
//! ```
//!
//! S_k reaches a few nodes, the rest is of the rank of the carrier: the variance is a local sum with the
//! overlap of the windows, a product of 15 terms and their mixture.
//!
//! Beside noise there is what the samples do not say: the spline's own variance with uncorrelated noise is
//! A⁻¹, of which S's share of that noise is Σ S²σ²; the rest is how far the true distortion, bent as its
//! prior allows, may stray from the map.

use super::carrier::{Fit, Prediction, Sample};
use super::parts::Grid;
use super::{BrownFit, DistortionError, TargetPhases};
use crate::maps::{DistortionMap, MapError, MapFit, MapGrid, MapSample};
use nalgebra::{DMatrix, DVector};

/// Nodes of a tile along either axis; the spline is followed tile by tile.
const TILE: usize = 16;
/// Nodes around a tile that its spline is followed over: the weights have fallen to 1e-4 there (test).
const MARGIN: usize = 8;

/// σ of a map at its nodes, row by row, pixels.
pub(super) struct Sigmas {
    /// From image noise alone.
    pub(super) noise: Vec<[f64; 2]>,
    /// How far the distortion may stray from the map between and beyond the samples.
    pub(super) stray: Vec<f64>,
    /// From image noise alone: a measured value half-way between the nodes less the map there.
    pub(super) between: [f64; 2],
}

/// A node where phases were measured.
pub(super) struct Measured {
    /// As the spline takes it.
    pub(super) sample: MapSample,
    /// e per standard deviation of either phase.
    pub(super) by_noise: [[f64; 2]; 2],
}

/// Derivatives of (e_x, e_y) by carrier and free Brown terms.
type Row = [DVector<f64>; 2];

/// The carrier's and Brown's part of the propagation.
struct Common {
    rows: Vec<Row>,
    /// Inverse normal matrix of all terms, and of the carrier's filled up with zeros.
    all: DMatrix<f64>,
    carrier: DMatrix<f64>,
    /// Per direction, term by term over the nodes: the noise of the terms' right-hand sides, correlated.
    correlated: [Vec<Vec<f64>>; 2],
    /// Covariance of the right-hand sides.
    covariance: DMatrix<f64>,
}

pub(super) struct Noise<'a> {
    pub(super) grid: &'a Grid,
    pub(super) phases: &'a TargetPhases<'a>,
    /// Node by node.
    pub(super) at: &'a [Option<Measured>],
    pub(super) bend_px: f64,
}

impl Noise<'_> {
    pub(super) fn sigmas(
        &self,
        samples: &[(usize, Sample)],
        prediction: &Prediction,
        only: &Fit,
        brown: &BrownFit,
    ) -> Result<Sigmas, DistortionError> {
        let lags = self.lags();
        let common = self.common(&lags, samples, prediction, only, brown)?;
        let [nx, ny] = self.grid.map.nodes;
        let far = self.distances(|k| self.at[k].is_some(), false);
        let mut noise = vec![[0.0; 2]; nx * ny];
        let mut stray = vec![0.0; nx * ny];
        for j in (0..ny).step_by(TILE) {
            for i in (0..nx).step_by(TILE) {
                let to = [(i + TILE).min(nx), (j + TILE).min(ny)];
                let nodes = (j..to[1]).flat_map(|b| (i..to[0]).map(move |a| b * nx + a));
                let gap = nodes.clone().map(|k| usize::from(far[k])).max().unwrap_or(0);
                let tile = self.tile([i, j], to, MARGIN + 2 * gap)?;
                for k in nodes {
                    let local = self.local(&tile, self.grid.map.node_px(k % nx, k / nx));
                    noise[k] = self.variance(&local, &lags, &common, k).map(|v| v.max(0.0).sqrt());
                    stray[k] = local.stray;
                }
            }
        }
        let between = self.between(&lags)?;
        Ok(Sigmas { noise, stray, between })
    }

    /// Correlation of the noise of either direction's phases at nodes 0, 1, 2… apart along an axis.
    fn lags(&self) -> [Vec<f64>; 2] {
        self.phases.directions.map(|d| {
            let most = d.window.len().div_ceil(self.grid.step);
            (0..most).map(|n| correlation(d.window, n * self.grid.step)).collect()
        })
    }

    fn common(
        &self,
        lags: &[Vec<f64>; 2],
        samples: &[(usize, Sample)],
        prediction: &Prediction,
        only: &Fit,
        brown: &BrownFit,
    ) -> Result<Common, DistortionError> {
        let [nx, ny] = self.grid.map.nodes;
        let mut seen = vec![None; nx * ny];
        for (node, s) in samples {
            seen[*node] = Some(*s);
        }
        let free: Vec<usize> = (0..5).filter(|k| brown.sigma[*k].is_some()).collect();
        let row = |k: usize| -> Option<Row> {
            let pixel = self.grid.map.node_px(k % nx, k / nx);
            let s = match seen[k] {
                Some(s) => s,
                None => {
                    let turns = only.carrier.turns(prediction.plane(pixel, &only.brown)?);
                    Sample { pixel, turns, sigma: [0.0; 2] }
                }
            };
            Some(only.carrier.distortion(&s, prediction, &only.brown)?.terms(only.carrier.terms(), &free))
        };
        let mut rows = Vec::with_capacity(nx * ny);
        for k in 0..nx * ny {
            let pixel_px = self.grid.map.node_px(k % nx, k / nx);
            rows.push(row(k).ok_or(DistortionError::Unpredictable { pixel_px })?);
        }
        let measured = || (0..nx * ny).filter_map(|k| Some((k, self.at[k].as_ref()?)));
        // Columns of unit length: k1, k2 and k3 differ by many powers of ten.
        let terms = only.carrier.terms() + free.len();
        let length: Vec<f64> = (0..terms)
            .map(|a| {
                measured().map(|(k, _)| rows[k][0][a].powi(2) + rows[k][1][a].powi(2)).sum::<f64>().sqrt()
            })
            .collect();
        for v in rows.iter_mut().flatten() {
            v.iter_mut().zip(&length).for_each(|(v, l)| *v /= l);
        }
        let mut normal = DMatrix::<f64>::zeros(terms, terms);
        for (k, _) in measured() {
            for v in &rows[k] {
                normal.ger(1.0, v, v, 1.0);
            }
        }
        let inverse = |n: usize| {
            let part = normal.view((0, 0), (n, n)).clone_owned();
            let inverse = part.cholesky().ok_or(DistortionError::Undetermined)?.inverse();
            Ok::<_, DistortionError>(inverse.resize(terms, terms, 0.0))
        };
        let (all, carrier) = (inverse(terms)?, inverse(only.carrier.terms())?);
        let mut covariance = DMatrix::zeros(terms, terms);
        let correlated = [0, 1].map(|d| {
            let mut own = vec![vec![0.0; nx * ny]; terms];
            for (k, m) in measured() {
                for (a, own) in own.iter_mut().enumerate() {
                    own[k] = rows[k][0][a] * m.by_noise[0][d] + rows[k][1][a] * m.by_noise[1][d];
                }
            }
            let spread: Vec<Vec<f64>> = own.iter().map(|v| correlate(v, nx, &lags[d])).collect();
            for a in 0..terms {
                for b in 0..terms {
                    covariance[(a, b)] += dot(&own[a], &spread[b]);
                }
            }
            spread
        });
        Ok(Common { rows, all, carrier, correlated, covariance })
    }

    /// The spline over the nodes `from`…`to` and `margin` nodes around them, as it is there in the whole map.
    fn tile(&self, from: [usize; 2], to: [usize; 2], margin: usize) -> Result<Tile, DistortionError> {
        let map = &self.grid.map;
        let first = from.map(|v| v.saturating_sub(margin));
        let last = [0, 1].map(|i| (to[i] + margin).min(map.nodes[i]));
        let first = [0, 1].map(|i| first[i].min(last[i].saturating_sub(4)));
        let grid = MapGrid {
            origin_px: map.node_px(first[0], first[1]),
            nodes: [last[0] - first[0], last[1] - first[1]],
            ..*map
        };
        let nodes: Vec<usize> = (first[1]..last[1])
            .flat_map(|j| (first[0]..last[0]).map(move |i| j * map.nodes[0] + i))
            .collect();
        let samples: Vec<MapSample> =
            nodes.iter().filter_map(|k| Some(self.at[*k].as_ref()?.sample)).collect();
        match DistortionMap::fit(grid, &samples, self.bend_px) {
            Ok(fit) => Ok(Tile { fit, first, last, margin }),
            Err(MapError::Undetermined { .. }) if grid.nodes != map.nodes => self.tile(from, to, 2 * margin),
            Err(e) => Err(e.into()),
        }
    }

    /// What the spline at a pixel is made of.
    fn local(&self, tile: &Tile, pixel: [f64; 2]) -> Local {
        let map = &self.grid.map;
        let at = [0, 1].map(|i| ((pixel[i] - map.origin_px[i]) / map.step_px[i]).floor() as usize);
        let first = [0, 1].map(|i| at[i].saturating_sub(tile.margin).max(tile.first[i]));
        let last = [0, 1].map(|i| (at[i] + tile.margin + 1).min(tile.last[i]));
        let influence = tile.fit.influence(pixel);
        let mut left = influence.variance();
        let mut nodes = Vec::new();
        let mut weights = Vec::new();
        for j in first[1]..last[1] {
            for i in first[0]..last[0] {
                let k = j * map.nodes[0] + i;
                let weight = self.at[k].as_ref().map_or(0.0, |m| {
                    let weight = influence.weight(&m.sample);
                    left -= (weight * m.sample.sigma_px).powi(2);
                    weight
                });
                nodes.push(k);
                weights.push(weight);
            }
        }
        Local { nodes, weights, width: last[0] - first[0], stray: left.max(0.0).sqrt() }
    }

    /// Weights of the noise of direction d in component i.
    fn of_noise(&self, local: &Local, i: usize, d: usize) -> Vec<f64> {
        let one = |(k, w): (&usize, &f64)| self.at[*k].as_ref().map_or(0.0, |m| w * m.by_noise[i][d]);
        local.nodes.iter().zip(&local.weights).map(one).collect()
    }

    fn variance(&self, local: &Local, lags: &[Vec<f64>; 2], common: &Common, node: usize) -> [f64; 2] {
        [0, 1].map(|i| {
            let mut rest = common.rows[node][i].clone();
            for (k, w) in local.nodes.iter().zip(&local.weights).filter(|(_, w)| **w != 0.0) {
                rest.axpy(-w, &common.rows[*k][i], 1.0);
            }
            let terms = &common.all * rest - &common.carrier * &common.rows[node][i];
            let mut variance = terms.dot(&(&common.covariance * &terms));
            for (d, lag) in lags.iter().enumerate() {
                let u = self.of_noise(local, i, d);
                variance += dot(&u, &correlate(&u, local.width, lag));
                for (a, t) in terms.iter().enumerate() {
                    let with: f64 =
                        local.nodes.iter().zip(&u).map(|(k, u)| u * common.correlated[d][a][*k]).sum();
                    variance += 2.0 * t * with;
                }
            }
            variance
        })
    }

    /// Of a measured value half-way between the nodes less the map there, amid the target. The carrier moves
    /// both alike.
    fn between(&self, lags: &[Vec<f64>; 2]) -> Result<[f64; 2], DistortionError> {
        let map = &self.grid.map;
        let nx = map.nodes[0];
        let depth = self.distances(|k| self.at[k].is_none(), true);
        let deepest = (0..depth.len()).rev().max_by_key(|k| depth[*k]).unwrap_or(0);
        let (i, j) = (deepest % nx, deepest / nx);
        let tile = self.tile([i, j], [i + 1, j + 1], MARGIN)?;
        let half = (0.5 * self.grid.step as f64).floor();
        let place = map.node_px(i, j).map(|v| v + half);
        let local = self.local(&tile, place);
        let Some(here) = &self.at[deepest] else { return Ok([0.0; 2]) };
        Ok([0, 1].map(|c| {
            let mut variance = 0.0;
            for (d, lags) in lags.iter().enumerate() {
                let own = here.by_noise[c][d];
                let u = self.of_noise(&local, c, d);
                let window = self.phases.directions[d].window;
                let with: f64 = local
                    .nodes
                    .iter()
                    .zip(&u)
                    .map(|(k, u)| {
                        let at = map.node_px(k % nx, k / nx);
                        let lag = |i: usize| correlation(window, (at[i] - place[i]).abs().round() as usize);
                        u * lag(0) * lag(1)
                    })
                    .sum();
                variance += own * own - 2.0 * own * with + dot(&u, &correlate(&u, local.width, lags));
            }
            variance.max(0.0).sqrt()
        }))
    }

    /// How many nodes away (steps along the axes, up to 255) the nearest of `these` lies, or the rim.
    fn distances(&self, these: impl Fn(usize) -> bool, rim: bool) -> Vec<u8> {
        let [nx, ny] = self.grid.map.nodes;
        let mut out: Vec<u8> = (0..nx * ny).map(|k| if these(k) { 0 } else { 255 }).collect();
        let beyond = if rim { 0 } else { 255 };
        let mut nearer = |k: usize, beside: [Option<usize>; 2]| {
            for d in beside.map(|b| b.map_or(beyond, |b| out[b])) {
                out[k] = out[k].min(d.saturating_add(1));
            }
        };
        for k in 0..nx * ny {
            nearer(k, [(k % nx > 0).then(|| k - 1), (k >= nx).then(|| k - nx)]);
        }
        for k in (0..nx * ny).rev() {
            nearer(k, [(k % nx + 1 < nx).then(|| k + 1), (k + nx < nx * ny).then(|| k + nx)]);
        }
        out
    }
}

struct Tile {
    fit: MapFit,
    /// Its nodes.
    first: [usize; 2],
    last: [usize; 2],
    margin: usize,
}

/// A rectangle of nodes with the weights of their samples, zero where there is none.
struct Local {
    nodes: Vec<usize>,
    weights: Vec<f64>,
    width: usize,
    stray: f64,
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Values on a rectangle of nodes times the correlation of the noise between them.
fn correlate(values: &[f64], width: usize, lags: &[f64]) -> Vec<f64> {
    let along = |values: &[f64], length: usize, stride: usize, lines: &mut dyn Iterator<Item = usize>| {
        let mut out = vec![0.0; values.len()];
        for start in lines {
            for i in 0..length {
                let v = values[start + i * stride];
                if v == 0.0 {
                    continue;
                }
                for (lag, r) in lags.iter().enumerate() {
                    if lag > 0 && i >= lag {
                        out[start + (i - lag) * stride] += r * v;
                    }
                    if i + lag < length {
                        out[start + (i + lag) * stride] += r * v;
                    }
                }
            }
        }
        out
    };
    let height = values.len() / width;
    let rows = along(values, width, 1, &mut (0..height).map(|j| j * width));
    along(&rows, height, width, &mut (0..width))
}

/// Correlation of noise averaged with `window` at two places `lag` pixels apart.
fn correlation(window: &[f32], lag: usize) -> f64 {
    let product = |lag: usize| -> f64 {
        window.iter().zip(window.get(lag..).unwrap_or(&[])).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
    };
    product(lag) / product(0)
}
