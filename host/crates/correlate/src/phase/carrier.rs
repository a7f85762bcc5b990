//! Grating directions from the spectrum.

use super::settings::{Gratings, PhaseError, PhaseSettings};
use crate::image::{Image, Mask};
use rayon::prelude::*;
use rustfft::{FftPlanner, num_complex::Complex64};
use serde::Serialize;

/// One grating direction: the wave vector of its fundamental.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Carrier {
    /// Wave vector along x, cycles per pixel.
    pub fx: f64,
    /// Wave vector along y, cycles per pixel.
    pub fy: f64,
}

impl Carrier {
    /// Distance between lines, pixels.
    pub fn pitch(&self) -> f64 {
        1.0 / self.frequency()
    }

    /// Length of the wave vector, cycles per pixel.
    pub fn frequency(&self) -> f64 {
        self.fx.hypot(self.fy)
    }

    /// Direction of the normal of the lines against the x axis, radians, positive from x to y.
    pub fn angle(&self) -> f64 {
        self.fy.atan2(self.fx)
    }

    pub(super) fn scaled(&self, by: f64) -> Self {
        Self { fx: by * self.fx, fy: by * self.fy }
    }

    fn plus(&self, other: &Self, sign: f64) -> Self {
        Self { fx: self.fx + sign * other.fx, fy: self.fy + sign * other.fy }
    }
}

/// What the spectrum says about an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectrum {
    /// One or two directions; the first is the one whose normal is nearer to the x axis, and has
    /// fx > 0; the second has fy > 0.
    pub carriers: Vec<Carrier>,
    /// Standard deviation of white noise in the image, grey levels, from the median of the spectrum.
    pub noise: f64,
}

/// Sides of the parts of the image whose spectra are taken, in this order until one shows a line.
/// Strong distortion smears the line of a large part.
const TILES: [usize; 3] = [512, 256, 128];
/// Smallest image side.
pub(super) const MIN_SIDE: usize = 32;
/// Periods that the smaller side of a part must hold.
const PERIODS: f64 = 6.0;
/// Power of a line over the largest power beside it; among the bins of a random pattern 2 is
/// usual and 4 rare.
const CONTRAST: f64 = 8.0;
/// Power of a line over the median at its distance from the origin.
const PROMINENCE: f64 = 100.0;
/// Half width in bins of a line, which the data window spreads.
const LOBE: f64 = 4.0;
/// Least power of the second direction relative to the first.
const SECOND: f64 = 0.05;

/// Finds the gratings' pitch and angle, and the noise.
///
/// The power spectrum of up to nine parts of the image (Hann window) is searched for lines that
/// stand out of their neighbourhood; the part with the clearest line is used. Multiples of a line,
/// their aliases, and sums and differences of two lines are not mistaken for fundamentals.
///
/// # Errors
/// [`PhaseError::TooSmall`], [`PhaseError::Constant`], [`PhaseError::NoPattern`],
/// [`PhaseError::OneDirection`], [`PhaseError::Aliased`], [`PhaseError::MaskSize`], and
/// [`PhaseError::Range`] for settings.
pub fn find_carriers(
    image: &Image,
    mask: Option<&Mask>,
    settings: &PhaseSettings,
) -> Result<Spectrum, PhaseError> {
    settings.validate()?;
    let (width, height) = (image.width(), image.height());
    if width < MIN_SIDE || height < MIN_SIDE {
        return Err(PhaseError::TooSmall { width, height, min: MIN_SIDE });
    }
    if let Some(m) = mask
        && (m.width(), m.height()) != (width, height)
    {
        return Err(PhaseError::MaskSize { mask_width: m.width(), mask_height: m.height(), width, height });
    }
    let level = image.grey()[0];
    if image.grey().iter().all(|&g| g == level) {
        return Err(PhaseError::Constant { level });
    }
    let mut found = 0.0f64;
    for (k, side) in TILES.iter().enumerate() {
        if k > 0 && *side >= width.max(height) {
            continue;
        }
        let best = tiles(width, height, *side)
            .into_par_iter()
            .map(|at| Tile::new(image, mask, at))
            .collect::<Vec<_>>()
            .into_iter()
            .flatten()
            .map(|tile| (tile.strongest(settings.pitch), tile))
            .reduce(|a, b| if b.0.1 > a.0.1 { b } else { a });
        let Some(((line, contrast), tile)) = best else { continue };
        found = found.max(contrast);
        if let Some(first) = line
            && contrast >= CONTRAST
        {
            return tile.directions(first, settings);
        }
    }
    Err(PhaseError::NoPattern { found, required: CONTRAST })
}

/// Left, top, columns, rows of the parts; the central one first.
fn tiles(width: usize, height: usize, side: usize) -> Vec<[usize; 4]> {
    let axis = |n: usize| {
        let len = n.min(side);
        let rest = n - len;
        let starts = if rest < side / 4 { vec![rest / 2] } else { vec![rest / 2, 0, rest] };
        (starts, len)
    };
    let ((xs, w), (ys, h)) = (axis(width), axis(height));
    ys.iter().flat_map(|&y| xs.iter().map(move |&x| [x, y, w, h])).collect()
}

/// Power spectrum of a part of the image.
struct Tile {
    nx: usize,
    ny: usize,
    power: Vec<f64>,
    noise: f64,
}

/// A local maximum of the spectrum.
#[derive(Debug, Clone, Copy)]
struct Line {
    carrier: Carrier,
    power: f64,
}

impl Tile {
    fn new(image: &Image, mask: Option<&Mask>, [left, top, nx, ny]: [usize; 4]) -> Option<Self> {
        let hann = |n: usize| -> Vec<f64> {
            (0..n).map(|k| (std::f64::consts::PI * (k as f64 + 0.5) / n as f64).sin().powi(2)).collect()
        };
        let (wx, wy) = (hann(nx), hann(ny));
        let weight = |i: usize, j: usize| {
            let inside = mask.is_none_or(|m| m.contains(left + i, top + j));
            if inside { wx[i] * wy[j] } else { 0.0 }
        };
        let (mut sum, mut total, mut energy) = (0.0, 0.0, 0.0);
        for j in 0..ny {
            let row = &image.row(top + j)[left..left + nx];
            for i in 0..nx {
                let w = weight(i, j);
                sum += w * f64::from(row[i]);
                total += w;
                energy += w * w;
            }
        }
        // a part that the mask leaves next to nothing of
        if total < 0.1 * (nx * ny) as f64 * 0.25 {
            return None;
        }
        let mean = sum / total;
        let mut data = vec![Complex64::default(); nx * ny];
        for j in 0..ny {
            let row = &image.row(top + j)[left..left + nx];
            for i in 0..nx {
                data[i * ny + j].re = weight(i, j) * (f64::from(row[i]) - mean);
            }
        }
        let mut planner = FftPlanner::new();
        planner.plan_fft_forward(ny).process(&mut data);
        let mut turned = vec![Complex64::default(); nx * ny];
        for i in 0..nx {
            for j in 0..ny {
                turned[j * nx + i] = data[i * ny + j];
            }
        }
        planner.plan_fft_forward(nx).process(&mut turned);
        let power: Vec<f64> = turned.iter().map(Complex64::norm_sqr).collect();
        let mut sorted = power.clone();
        let middle = sorted.len() / 2;
        let median = *sorted.select_nth_unstable_by(middle, f64::total_cmp).1;
        // the median of an exponential distribution is ln 2 of its mean
        let noise = (median / (std::f64::consts::LN_2 * energy)).sqrt();
        Some(Self { nx, ny, power, noise })
    }

    fn at(&self, kx: i64, ky: i64) -> f64 {
        let (x, y) = (kx.rem_euclid(self.nx as i64) as usize, ky.rem_euclid(self.ny as i64) as usize);
        self.power[y * self.nx + x]
    }

    fn bins(&self, c: &Carrier) -> (f64, f64) {
        (c.fx * self.nx as f64, c.fy * self.ny as f64)
    }

    /// Distance in bins between two wave vectors, whole sampling frequencies apart counted as none.
    fn apart(&self, a: &Carrier, b: &Carrier) -> f64 {
        let wrap = |f: f64| f - f.round();
        let (kx, ky) = self.bins(&Carrier { fx: wrap(a.fx - b.fx), fy: wrap(a.fy - b.fy) });
        kx.hypot(ky)
    }

    /// Local maxima in the half plane of positive frequencies, strongest first.
    fn lines(&self, pitch: Option<f64>) -> Vec<Line> {
        let (hx, hy) = (self.nx as i64 / 2, self.ny as i64 / 2);
        let lowest = PERIODS / self.nx.min(self.ny) as f64;
        let mut lines = Vec::new();
        for ky in -hy + 1..hy {
            for kx in 0..hx {
                if kx == 0 && ky <= 0 {
                    continue;
                }
                let f = Carrier { fx: kx as f64 / self.nx as f64, fy: ky as f64 / self.ny as f64 };
                let wanted = pitch.is_none_or(|p| (f.frequency() * p).ln().abs() < 1.25f64.ln());
                if f.frequency() < lowest || !wanted {
                    continue;
                }
                let p = self.at(kx, ky);
                let largest = (-1..=1)
                    .flat_map(|b| (-1..=1).map(move |a| (a, b)))
                    .all(|(a, b)| (a, b) == (0, 0) || p >= self.at(kx + a, ky + b));
                if largest && p > 0.0 {
                    lines.push(Line { carrier: self.refined(kx, ky), power: p });
                }
            }
        }
        lines.sort_by(|a, b| b.power.total_cmp(&a.power));
        lines.truncate(400);
        lines
    }

    /// Parabola through the logarithm of the power, to about 0.05 bins.
    fn refined(&self, kx: i64, ky: i64) -> Carrier {
        let vertex = |a: f64, b: f64, c: f64| {
            let (a, b, c) = (a.max(1e-300).ln(), b.max(1e-300).ln(), c.max(1e-300).ln());
            let curvature = a - 2.0 * b + c;
            if curvature < 0.0 { (0.5 * (a - c) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
        };
        let p = self.at(kx, ky);
        let dx = vertex(self.at(kx - 1, ky), p, self.at(kx + 1, ky));
        let dy = vertex(self.at(kx, ky - 1), p, self.at(kx, ky + 1));
        Carrier { fx: (kx as f64 + dx) / self.nx as f64, fy: (ky as f64 + dy) / self.ny as f64 }
    }

    /// How far a line stands above its surroundings; [`CONTRAST`] is the least accepted.
    fn contrast(&self, line: &Line) -> f64 {
        let (kx, ky) = self.bins(&line.carrier);
        let distance = kx.hypot(ky);
        let (cx, cy) = (kx.round() as i64, ky.round() as i64);
        let reach = (0.6 * distance).clamp(LOBE + 1.0, 12.0);
        let r = reach as i64;
        let mut beside = 0.0f64;
        for b in -r..=r {
            for a in -r..=r {
                let d = (a as f64).hypot(b as f64);
                // neither the line itself nor the background
                let origin = ((cx + a) as f64).hypot((cy + b) as f64);
                if d > LOBE && d <= reach && origin > LOBE {
                    beside = beside.max(self.at(cx + a, cy + b));
                }
            }
        }
        let mut ring = Vec::new();
        let f = line.carrier.frequency();
        for y in 0..self.ny {
            let fy = y.min(self.ny - y) as f64 / self.ny as f64;
            for x in 0..self.nx {
                let fx = x.min(self.nx - x) as f64 / self.nx as f64;
                if (fx.hypot(fy) / f - 1.0).abs() < 0.25 {
                    ring.push(self.power[y * self.nx + x]);
                }
            }
        }
        let middle = ring.len() / 2;
        let median =
            if ring.is_empty() { 0.0 } else { *ring.select_nth_unstable_by(middle, f64::total_cmp).1 };
        // what is left of rounding counts as something
        let floor = 1e-24 * line.power;
        (line.power / beside.max(floor)).min(line.power / median.max(floor) * CONTRAST / PROMINENCE)
    }

    /// The strongest line that stands out, with its contrast; else the best contrast there is.
    fn strongest(&self, pitch: Option<f64>) -> (Option<Line>, f64) {
        let mut best = (None, 0.0);
        for line in self.lines(pitch).iter().take(3) {
            let contrast = self.contrast(line);
            if contrast >= CONTRAST {
                return (Some(*line), contrast);
            }
            if contrast > best.1 {
                best = (None, contrast);
            }
        }
        best
    }

    /// Completes and orders the directions.
    fn directions(&self, first: Line, settings: &PhaseSettings) -> Result<Spectrum, PhaseError> {
        let lines = self.lines(settings.pitch);
        let near = |c: &Carrier, least: f64| {
            lines
                .iter()
                .filter(|l| l.power >= least)
                .find(|l| self.apart(&l.carrier, c) < 1.5 || self.apart(&l.carrier, &c.scaled(-1.0)) < 1.5)
                .copied()
        };
        // the line may be a multiple of the fundamental
        let mut first = first;
        for n in [3.0, 2.0] {
            if let Some(lower) = near(&first.carrier.scaled(1.0 / n), 0.25 * first.power)
                && self.contrast(&lower) >= CONTRAST
            {
                first = lower;
            }
        }
        let mut second = None;
        if settings.gratings != Gratings::Line {
            second = lines
                .iter()
                .filter(|l| {
                    let c = &l.carrier;
                    let cross = first.carrier.fx * c.fy - first.carrier.fy * c.fx;
                    let sine = cross.abs() / (first.carrier.frequency() * c.frequency());
                    let harmonic = (2..=15).any(|n| {
                        [-1.0, 1.0]
                            .iter()
                            .any(|s| self.apart(&first.carrier.scaled(s * f64::from(n)), c) < 2.5)
                    });
                    sine > 0.34 && !harmonic && l.power >= SECOND * first.power
                })
                .find(|l| self.contrast(l) >= CONTRAST)
                .copied();
            // sums and differences of two fundamentals are no fundamentals
            while let Some(other) = second {
                let (long, short) = if first.carrier.frequency() > other.carrier.frequency() {
                    (first, other)
                } else {
                    (other, first)
                };
                let shorter = [-1.0, 1.0].iter().find_map(|&sign| {
                    let c = long.carrier.plus(&short.carrier, sign);
                    let shorter = c.frequency() < 0.95 * long.carrier.frequency();
                    if shorter { near(&c, 0.1 * long.power) } else { None }
                });
                first = short;
                second = Some(shorter.unwrap_or(long));
                if shorter.is_none() {
                    break;
                }
            }
        }
        let mut carriers: Vec<Carrier> =
            [Some(first), second].into_iter().flatten().map(|l| l.carrier).collect();
        for c in &carriers {
            if c.pitch() < PhaseSettings::MIN_PITCH {
                return Err(PhaseError::Aliased { pitch: c.pitch(), min: PhaseSettings::MIN_PITCH });
            }
        }
        if carriers.len() < 2 && settings.gratings == Gratings::Cross {
            let angle_deg = first.carrier.angle().to_degrees();
            return Err(PhaseError::OneDirection { pitch: first.carrier.pitch(), angle_deg });
        }
        let steep = |c: &Carrier| c.fy.abs() / c.frequency();
        carriers.sort_by(|a, b| steep(a).total_cmp(&steep(b)));
        if carriers.len() == 1 {
            let c = &mut carriers[0];
            let lead = if c.fx.abs() >= c.fy.abs() { c.fx } else { c.fy };
            *c = c.scaled(lead.signum());
        } else {
            carriers[0] = carriers[0].scaled(carriers[0].fx.signum());
            carriers[1] = carriers[1].scaled(carriers[1].fy.signum());
        }
        Ok(Spectrum { carriers, noise: self.noise })
    }
}
