//! Affine maps: their fit to matches, robustly.

use super::FeatureMatch;

/// Affine map from the reference to the deformed image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Affine {
    /// `x′ = m[0][0] x + m[0][1] y + m[0][2]`, y′ likewise from `m[1]`; pixels.
    pub target_from_reference: [[f64; 3]; 2],
}

/// Attempts to find a group of matches.
const TRIES: u64 = 4000;
/// Agreement, in pixels of the features' scale, while three matches are tried.
const LOOSE: f64 = 3.0;
/// Departure of a smoothly deforming specimen from one affine map, as a part of its extent.
const BENT: f64 = 0.02;
/// Fewest matches that make a group.
pub(super) const FEWEST: usize = 8;
/// Rotation between a match's own frame and the affine map beyond which they disagree, radians.
const TURN: f64 = 0.5;
/// Largest |ln λ| of a plausible map.
const STRETCH: f64 = 0.7;

impl Affine {
    /// Position in the deformed image of what is at (x, y) in the reference.
    pub fn at(&self, x: f64, y: f64) -> [f64; 2] {
        self.target_from_reference.map(|m| m[0] * x + m[1] * y + m[2])
    }

    /// Displacement of (x, y), pixels.
    pub fn displacement(&self, x: f64, y: f64) -> [f64; 2] {
        let [a, b] = self.at(x, y);
        [a - x, b - y]
    }

    /// Displacement gradient u_x, u_y, v_x, v_y.
    pub fn gradient(&self) -> [f64; 4] {
        let [a, b] = &self.target_from_reference;
        [a[0] - 1.0, a[1], b[0], b[1] - 1.0]
    }

    /// Angle of the rotation in the polar decomposition, degrees; positive from x towards y, which
    /// is clockwise as seen on the screen.
    pub fn rotation_deg(&self) -> f64 {
        self.rotation().to_degrees()
    }

    fn rotation(&self) -> f64 {
        let [a, b] = &self.target_from_reference;
        (b[0] - a[1]).atan2(a[0] + b[1])
    }

    /// Principal stretches, the larger first; 0 for both where the map turns the image inside out.
    pub fn stretches(&self) -> [f64; 2] {
        let [a, b] = &self.target_from_reference;
        let det = a[0] * b[1] - a[1] * b[0];
        if !(det > 0.0 && det.is_finite()) {
            return [0.0; 2];
        }
        let half = 0.5 * (a[0] * a[0] + a[1] * a[1] + b[0] * b[0] + b[1] * b[1]);
        let large = (half + (half * half - det * det).max(0.0).sqrt()).sqrt();
        [large, det / large]
    }

    fn plausible(&self) -> bool {
        let [large, small] = self.stretches();
        small > 0.0 && large.ln().abs().max(small.ln().abs()) <= STRETCH
    }

    fn error(&self, m: &FeatureMatch) -> f64 {
        let [x, y] = self.at(m.reference[0], m.reference[1]);
        (x - m.target[0]).hypot(y - m.target[1])
    }

    fn explains(&self, m: &FeatureMatch, tolerance: f64) -> bool {
        let turn = (self.rotation() - m.rotation).rem_euclid(std::f64::consts::TAU);
        turn.min(std::f64::consts::TAU - turn) < TURN && self.error(m) <= tolerance
    }

    /// Least-squares map; `None` where the matches lie on one line.
    pub(super) fn fit<'a>(matches: impl Iterator<Item = &'a FeatureMatch> + Clone) -> Option<Affine> {
        let mut n = 0.0;
        let (mut c, mut d) = ([0.0; 2], [0.0; 2]);
        for m in matches.clone() {
            n += 1.0;
            for k in 0..2 {
                c[k] += m.reference[k];
                d[k] += m.target[k];
            }
        }
        if n < 3.0 {
            return None;
        }
        for k in 0..2 {
            c[k] /= n;
            d[k] /= n;
        }
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        let mut cross = [[0.0; 2]; 2];
        for m in matches {
            let (x, y) = (m.reference[0] - c[0], m.reference[1] - c[1]);
            xx += x * x;
            xy += x * y;
            yy += y * y;
            for k in 0..2 {
                cross[k][0] += (m.target[k] - d[k]) * x;
                cross[k][1] += (m.target[k] - d[k]) * y;
            }
        }
        let det = xx * yy - xy * xy;
        // at least a pixel or so of extent across
        if !(det > 1e-4 * (xx + yy).powi(2) && xx + yy > n) {
            return None;
        }
        let row = |k: usize| {
            let a = (cross[k][0] * yy - cross[k][1] * xy) / det;
            let b = (cross[k][1] * xx - cross[k][0] * xy) / det;
            [a, b, d[k] - a * c[0] - b * c[1]]
        };
        Some(Affine { target_from_reference: [row(0), row(1)] })
    }

    /// Fit that leaves out what does not agree with the rest.
    pub(super) fn trimmed(mut near: Vec<&FeatureMatch>) -> Option<Affine> {
        for _ in 0..3 {
            let affine = Self::fit(near.iter().copied())?;
            let mut errors: Vec<f64> = near.iter().map(|m| affine.error(m)).collect();
            errors.sort_by(f64::total_cmp);
            let limit = (2.5 * errors[errors.len() / 2]).max(1.0);
            if errors.last().is_none_or(|&e| e <= limit) {
                return affine.plausible().then_some(affine);
            }
            near.retain(|m| affine.error(m) <= limit);
        }
        Self::fit(near.into_iter()).filter(Affine::plausible)
    }
}

/// SplitMix64 (Steele, Lea & Flood 2014): the draws are the same in every run.
struct Draws(u64);

impl Draws {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((u128::from(z ^ (z >> 31)) * n as u128) >> 64) as usize
    }
}

/// The affine map that explains most of the matches in `open`, and those it explains (RANSAC,
/// Fischler & Bolles 1981, with refinement of every new best); `None` if there are too few.
pub(super) fn consensus(matches: &[FeatureMatch], open: &[usize]) -> Option<(Affine, Vec<usize>)> {
    if open.len() < FEWEST {
        return None;
    }
    let (mut lo, mut hi) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for &k in open {
        for c in 0..2 {
            lo[c] = lo[c].min(matches[k].reference[c]);
            hi[c] = hi[c].max(matches[k].reference[c]);
        }
    }
    let extent = (hi[0] - lo[0]).hypot(hi[1] - lo[1]);
    let typical = {
        let mut scales: Vec<f64> = open.iter().map(|&k| matches[k].scale).collect();
        scales.sort_by(f64::total_cmp);
        scales[scales.len() / 2]
    };
    let tolerance = (LOOSE * typical).max(BENT * extent);
    let explained = |a: &Affine| -> Vec<usize> {
        open.iter().copied().filter(|&k| a.explains(&matches[k], tolerance)).collect()
    };
    let mut draws = Draws(open.len() as u64);
    let mut best: Option<(Affine, Vec<usize>)> = None;
    let mut tries = TRIES;
    let mut done = 0;
    while done < tries {
        done += 1;
        let three = [0; 3].map(|_| &matches[open[draws.below(open.len())]]);
        let Some(affine) = Affine::fit(three.iter().copied()) else {
            continue;
        };
        if !affine.plausible() || !three.iter().all(|m| affine.explains(m, 1.0)) {
            continue;
        }
        let mut found = explained(&affine);
        if found.len() < 4 || best.as_ref().is_some_and(|b| found.len() <= b.1.len()) {
            continue;
        }
        let mut map = affine;
        for _ in 0..4 {
            let Some(refined) = Affine::fit(found.iter().map(|&k| &matches[k])) else {
                break;
            };
            let next = explained(&refined);
            if !refined.plausible() || next.len() < found.len() {
                break;
            }
            (map, found) = (refined, next);
        }
        // enough draws that three of the explained were met with a probability of 0.999
        let part = found.len() as f64 / open.len() as f64;
        let enough = 1e-3f64.ln() / (1.0 - part.powi(3)).min(1.0 - 1e-9).ln();
        tries = tries.min(done + enough.ceil().max(1.0) as u64 * 2);
        best = Some((map, found));
    }
    best.filter(|b| b.1.len() >= FEWEST)
}
