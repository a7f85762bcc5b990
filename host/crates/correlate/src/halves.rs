//! Straight lines that part a subset in two.

use std::f64::consts::TAU;

/// Directions tried first, and the refinements after them.
const DIRECTIONS: usize = 24;
const REFINEMENTS: usize = 3;
/// Squared residuals count up to this many variances: beyond, a pixel is simply not explained.
const CAP: f32 = 50.0;
/// What a pixel that nothing explains costs, in variances.
const UNKNOWN: f32 = 6.0;
/// Pixels that must speak for a line, each with the full cap.
const PIXELS: f32 = 3.0;
/// Pixels that must speak for the side on which the centre lies.
const SURE: f32 = 4.0;

/// A line n · (ξ, η) = offset; the near side is where n · (ξ, η) is smaller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Line {
    /// Unit normal n, from the near to the far side.
    pub(crate) normal: [f64; 2],
    /// Distance from the subset's centre, pixels.
    pub(crate) offset: f64,
    /// What both sides leave, capped, in variances.
    pub(crate) energy: f32,
    /// How much less that is than with the best line of the same direction that has the centre on
    /// its other side.
    margin: f32,
}

impl Line {
    /// Near and far side exchanged.
    pub(crate) fn turned(&self) -> Self {
        Self { normal: [-self.normal[0], -self.normal[1]], offset: -self.offset, ..*self }
    }

    /// Whether it is certain on which side the centre lies.
    pub(crate) fn sure(&self) -> bool {
        self.margin >= SURE * CAP
    }

    fn distance(&self, xi: f64, eta: f64) -> f64 {
        self.normal[0] * xi + self.normal[1] * eta - self.offset
    }
}

/// Best far side along one direction.
#[derive(Debug, Clone, Copy)]
struct Gain {
    gain: f32,
    /// Where it begins.
    offset: f64,
    margin: f32,
}

/// Memory of the search.
#[derive(Debug, Default)]
pub(crate) struct Halves {
    radius: usize,
    gain: Vec<f32>,
    bins: Vec<f32>,
}

impl Halves {
    pub(crate) fn prepare(&mut self, radius: usize) {
        self.radius = radius;
    }

    fn width(&self) -> usize {
        2 * self.radius + 1
    }

    /// Position of pixel k from the centre.
    fn at(&self, k: usize) -> (f64, f64) {
        let r = self.radius as f64;
        ((k % self.width()) as f64 - r, (k / self.width()) as f64 - r)
    }

    /// The line that best parts the subset between two models, the first on the near side.
    pub(crate) fn between(&mut self, near: &[f32], far: &[f32], variance: f64) -> Option<Line> {
        let inverse = (1.0 / variance) as f32;
        let capped = |e: f32| (e * e * inverse).min(CAP);
        self.gain.clear();
        let mut base = 0.0;
        for (&a, &b) in near.iter().zip(far) {
            let (a, b) = if a.is_nan() || b.is_nan() { (0.0, 0.0) } else { (capped(a), capped(b)) };
            base += a;
            self.gain.push(a - b);
        }
        let all: f32 = self.gain.iter().sum();
        // neither model alone may do nearly as well
        let line = self.search(base)?;
        let alone = base.min(base - all);
        (line.energy + PIXELS * CAP < alone).then_some(line)
    }

    /// The line beyond which a model explains nothing, with the centre on the near side.
    pub(crate) fn beyond(&mut self, near: &[f32], variance: f64) -> Option<Line> {
        let inverse = (1.0 / variance) as f32;
        self.gain.clear();
        let mut base = 0.0;
        for &e in near {
            let a = if e.is_nan() { UNKNOWN } else { (e * e * inverse).min(CAP) };
            base += a;
            self.gain.push(a - UNKNOWN);
        }
        let line = self.search(base)?;
        (line.energy + PIXELS * CAP < base && line.offset > 0.0).then_some(line)
    }

    /// The line whose far side has the largest sum of gains.
    fn search(&mut self, base: f32) -> Option<Line> {
        let mut best: Option<(Gain, f64)> = None;
        let mut consider = |halves: &mut Self, angle: f64| {
            let g = halves.along(angle);
            if g.gain > 0.0 && best.is_none_or(|b| g.gain > b.0.gain) {
                best = Some((g, angle));
            }
            best
        };
        let step = TAU / DIRECTIONS as f64;
        let mut found = None;
        for k in 0..DIRECTIONS {
            found = consider(self, k as f64 * step);
        }
        for n in 1..=REFINEMENTS {
            let middle = found?.1;
            let half = step / f64::from(1u32 << n);
            consider(self, middle - half);
            found = consider(self, middle + half);
        }
        let (Gain { gain, offset, margin }, angle) = found?;
        Some(Line { normal: [angle.cos(), angle.sin()], offset, energy: base - gain, margin })
    }

    /// Best far side along one direction.
    fn along(&mut self, angle: f64) -> Gain {
        let (w, r) = (self.width(), self.radius as f32);
        let (c, s) = (angle.cos() as f32, angle.sin() as f32);
        let half = (1.5 * r) as usize + 1;
        self.bins.clear();
        self.bins.resize(2 * half + 2, 0.0);
        let shift = half as f32 + 0.5;
        for (d, row) in self.gain.chunks_exact(w).enumerate() {
            let mut p = (d as f32 - r) * s - r * c + shift;
            for g in row {
                // pixel distances to the nearest whole one
                self.bins[p as usize] += g;
                p += c;
            }
        }
        // with the centre on the near side, and on the far one
        let mut sum = 0.0;
        let mut best = [(0.0, f64::INFINITY), (f32::NEG_INFINITY, f64::NEG_INFINITY)];
        for (b, g) in self.bins.iter().enumerate().rev() {
            sum += g;
            let side = &mut best[usize::from(b <= half)];
            if sum > side.0 {
                *side = (sum, b as f64 - half as f64 - 0.5);
            }
        }
        let [near, far] = best;
        let (gain, offset) = if far.0 > near.0 { far } else { near };
        Gain { gain, offset, margin: (near.0 - far.0).abs() }
    }

    /// Pixels on the near side, `guard` or more from the line.
    pub(crate) fn part(&self, line: &Line, guard: f64) -> Vec<bool> {
        (0..self.width() * self.width())
            .map(|k| {
                let (xi, eta) = self.at(k);
                line.distance(xi, eta) <= -guard
            })
            .collect()
    }

    /// Mean square of the residuals where `select` says so of the distance from the line.
    fn mean_square(&self, map: &[f32], line: &Line, select: impl Fn(f64) -> bool) -> Option<f64> {
        let (mut sum, mut n) = (0.0, 0);
        for (k, &e) in map.iter().enumerate() {
            let (xi, eta) = self.at(k);
            if !e.is_nan() && select(line.distance(xi, eta)) {
                sum += f64::from(e) * f64::from(e);
                n += 1;
            }
        }
        (n > 0).then(|| sum / f64::from(n))
    }

    /// Takes from a part the pixels around which, over 5 × 5, a model leaves more than it may.
    pub(crate) fn keep_quiet(&self, part: &mut [bool], map: &[f32], variance: f64) {
        let w = self.width();
        let limit = UNKNOWN * variance as f32;
        for k in (0..part.len()).filter(|&k| map[k].abs() > limit.sqrt()) {
            // only places with at least one large residual need the mean
            let (x, y) = (k % w, k / w);
            for b in y.saturating_sub(2)..(y + 3).min(w) {
                for a in x.saturating_sub(2)..(x + 3).min(w) {
                    if part[b * w + a] && self.mean_around(map, a, b) > limit {
                        part[b * w + a] = false;
                    }
                }
            }
        }
    }

    /// Mean square over 5 × 5 pixels.
    fn mean_around(&self, map: &[f32], x: usize, y: usize) -> f32 {
        let w = self.width();
        let (mut sum, mut n) = (0.0, 0.0);
        for b in y.saturating_sub(2)..(y + 3).min(w) {
            for e in &map[b * w + x.saturating_sub(2)..b * w + (x + 3).min(w)] {
                if !e.is_nan() {
                    sum += e * e;
                    n += 1.0;
                }
            }
        }
        if n > 0.0 { sum / n } else { 0.0 }
    }

    /// Whether a model explains the near side.
    pub(crate) fn explained(&self, map: &[f32], line: &Line, guard: f64, variance: f64) -> bool {
        self.mean_square(map, line, |d| d <= -guard).is_some_and(|m| m <= f64::from(UNKNOWN) * variance)
    }

    /// Whether it fails on the far side at once, not by and by as that of a curved field does.
    pub(crate) fn unexplained(&self, map: &[f32], line: &Line, variance: f64) -> bool {
        self.mean_square(map, line, |d| d > 0.0 && d <= 4.0)
            .is_some_and(|m| m >= 0.5 * f64::from(CAP) * variance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_between_two_models_is_found() {
        let radius = 16;
        let w = 2 * radius + 1;
        for (angle, offset) in
            [(0.3f64, 4.2), (2.0, -6.7), (4.1, 0.8), (5.5, 11.0), (std::f64::consts::FRAC_PI_2, 0.5)]
        {
            let mut halves = Halves::default();
            halves.prepare(radius);
            let beyond = |k: usize| {
                let (xi, eta) = ((k % w) as f64 - 16.0, (k / w) as f64 - 16.0);
                xi * angle.cos() + eta * angle.sin() > offset
            };
            // noise of ±1 where a model holds, up to ±20 where it does not
            let noise = |k: usize| ((k * 7919 + 13) % 41) as f32 / 20.0 - 1.0;
            let near: Vec<f32> = (0..w * w).map(|k| noise(k) * if beyond(k) { 20.0 } else { 1.0 }).collect();
            let far: Vec<f32> =
                (0..w * w).map(|k| noise(k + 5) * if beyond(k) { 1.0 } else { 20.0 }).collect();
            let line = halves.between(&near, &far, 0.35).unwrap();
            let turn = (line.normal[1].atan2(line.normal[0]) - angle).rem_euclid(TAU);
            assert!(turn.min(TAU - turn) < 0.1, "{line:?} {angle}");
            assert!((line.offset - offset).abs() < 1.2, "{line:?} {offset}");
            let wrong =
                halves.part(&line, 0.0).iter().enumerate().filter(|&(k, &near)| near == beyond(k)).count();
            assert!(wrong < w * w / 40, "{wrong}");
            // one model that explains everything leaves no line
            let flat: Vec<f32> = (0..w * w).map(noise).collect();
            assert_eq!(halves.between(&flat, &near, 0.35), None);
            assert_eq!(halves.beyond(&flat, 0.35), None);
        }
    }
}
