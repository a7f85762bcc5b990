//! Phase maps of an image.

use super::carrier::{Carrier, find_carriers};
use super::demodulate::{Pair, convolve};
use super::settings::{PhaseError, PhaseSettings};
use super::track::{Track, best_tenth, track};
use super::unwrap::unwrap;
use super::window::Window;
use crate::image::{Image, Mask, MaskSums};
use crate::point::Status;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Phase of one grating direction at every pixel, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct PhaseMap {
    /// Mean wave vector over the largest connected part.
    pub carrier: Carrier,
    /// Unwrapped phase in radians, carrier included: 2π per pitch, a whole number of turns where
    /// the pattern is brightest. NaN where there is none. In each connected part the phase of the pixel
    /// nearest to the image's centre lies in (−π, π]; the parts' true offsets are unknown whole turns.
    pub phase: Vec<f64>,
    /// Standard uncertainty of the phase from image noise, radians; NaN where there is no phase.
    pub sigma: Vec<f32>,
    /// Amplitude of the pattern's fundamental, grey levels: half its peak-to-peak.
    pub amplitude: Vec<f32>,
    /// Part of the grey levels' variance within the window that the fundamental explains, 0…1: 1
    /// for a lone sinusoid, 0.81 for square lines, at most 0.5 for each direction of a cross grating.
    pub quality: Vec<f32>,
    /// [`Status::OutOfImage`] where the window leaves the image or the mask,
    /// [`Status::LowTexture`] where there is too little modulation.
    pub status: Vec<Status>,
    /// Connected part of each pixel: 0 for none, 1 for the largest.
    pub label: Vec<u32>,
    /// Number of connected parts.
    pub components: usize,
    /// Places around which the phase does not close; see [`Unwrapped`](super::Unwrapped).
    pub residues: usize,
}

impl PhaseMap {
    /// Pixels with a phase.
    pub fn valid(&self) -> usize {
        self.label.iter().filter(|&&l| l != 0).count()
    }

    /// Phase at pixel k wrapped to −π…π; NaN where there is none.
    pub fn wrapped(&self, k: usize) -> f64 {
        self.phase.get(k).map_or(f64::NAN, |p| super::unwrap::wrap(*p))
    }
}

/// Phase maps of one image.
#[derive(Debug, Clone, PartialEq)]
pub struct PhaseMaps {
    /// Columns of the image.
    pub width: usize,
    /// Rows of the image.
    pub height: usize,
    /// One map per grating direction, in the order of [`Spectrum`](super::Spectrum).
    pub directions: Vec<PhaseMap>,
    /// Noise of the image that the uncertainties rest on, grey levels.
    pub noise: f64,
    /// The analysis windows, one per direction.
    pub windows: Vec<Window>,
}

/// Phase above which noise makes a pixel's turn uncertain, radians.
const MOST_SIGMA: f64 = 0.5;

/// Localised spectrum analysis: the phase of every grating direction at every pixel, with its
/// uncertainty.
///
/// The image times the conjugate local carrier is averaged with the analysis window (Surrel 1994;
/// Sur & Grédiac, Inverse Problems and Imaging 8 (2014) 259): Ψ(x) = Σ w(y − x) s(y) e^(−iφ̂(y)). φ̂ is a
/// polynomial through phases found with a narrow window, so that the analysis works at the local
/// frequency and only what the polynomial misses is subject to the window's attenuation. The phase is
/// φ̂ + arg Ψ, the amplitude 2|Ψ|. White noise of deviation σ gives
/// σ_φ = σ √(Σ w²/2) / |Ψ| (for a Gaussian σ/(√(8π) · deviation · |Ψ|)).
///
/// Phases of a pixel rest on all pixels within the window's radius; where that leaves the image or
/// the mask there is no phase.
///
/// # Errors
/// Those of [`find_carriers`], and [`PhaseError::WindowTooLarge`].
pub fn phase_maps(
    image: &Image,
    mask: Option<&Mask>,
    settings: &PhaseSettings,
) -> Result<PhaseMaps, PhaseError> {
    let spectrum = find_carriers(image, mask, settings)?;
    let noise = settings.noise.unwrap_or(spectrum.noise);
    let sums = mask.map(MaskSums::new);
    let mean = mean(image, mask);
    let (width, height) = (image.width(), image.height());
    let mut maps = PhaseMaps { width, height, directions: Vec::new(), noise, windows: Vec::new() };
    let mut variance: Option<(Window, Pair)> = None;
    for carrier in &spectrum.carriers {
        let window = Window::new(settings.window, settings.width * carrier.pitch());
        let side = 2 * window.radius() + 1;
        let too_large =
            || PhaseError::WindowTooLarge { side, width_in_pitches: settings.width, pitch: carrier.pitch() };
        if side > width || side > height {
            return Err(too_large());
        }
        let model = track(image, mean, sums.as_ref(), *carrier, settings.tracking, settings.min_modulation)
            .ok_or_else(too_large)?;
        // grey levels and their squares do not depend on the direction if the window does not
        if variance.as_ref().is_none_or(|v| v.0 != window) {
            variance = Some((window.clone(), moments(image, &window, mean)));
        }
        let Some((_, moments)) = &variance else { continue };
        let psi = demodulate(image, mask, &window, &model, mean);
        let analysis = Analysis { image, sums: sums.as_ref(), window: &window, noise, settings };
        let map = analysis.map(&psi, moments, &model).ok_or_else(too_large)?;
        maps.directions.push(map);
        maps.windows.push(window);
    }
    Ok(maps)
}

fn mean(image: &Image, mask: Option<&Mask>) -> f64 {
    let Some(mask) = mask else { return f64::from(image.mean()) };
    let inside = || image.grey().iter().zip(mask.pixels()).filter(|(_, m)| **m).map(|(g, _)| f64::from(*g));
    inside().sum::<f64>() / inside().count().max(1) as f64
}

/// Windowed means of the grey levels (less their mean) and of their squares.
fn moments(image: &Image, window: &Window, mean: f64) -> Pair {
    convolve(image, window, |y, re, im| {
        for ((g, a), b) in image.row(y).iter().zip(re).zip(im) {
            *a = (f64::from(*g) - mean) as f32;
            *b = *a * *a;
        }
    })
}

fn demodulate(image: &Image, mask: Option<&Mask>, window: &Window, model: &Track, mean: f64) -> Pair {
    convolve(image, window, |y, re, im| {
        let track = model.row(y as f64);
        for (x, g) in image.row(y).iter().enumerate() {
            let g = if mask.is_none_or(|m| m.contains(x, y)) { f64::from(*g) - mean } else { 0.0 };
            let (sin, cos) = track.at(x as f64).sin_cos();
            re[x] = (g * cos) as f32;
            im[x] = (-g * sin) as f32;
        }
    })
}

/// What the maps of one direction are made with.
struct Analysis<'a> {
    image: &'a Image,
    sums: Option<&'a MaskSums>,
    window: &'a Window,
    noise: f64,
    settings: &'a PhaseSettings,
}

impl Analysis<'_> {
    fn covered(&self, x: usize, y: usize) -> bool {
        let r = self.window.radius();
        let inside = x >= r && y >= r && x + r < self.image.width() && y + r < self.image.height();
        let side = 2 * r + 1;
        inside
            && self.sums.is_none_or(|s| s.count(x - r, y - r, x + r + 1, y + r + 1) as usize == side * side)
    }

    fn map(&self, psi: &Pair, moments: &Pair, model: &Track) -> Option<PhaseMap> {
        let (width, height) = (self.image.width(), self.image.height());
        let n = width * height;
        let mut amplitude = vec![0.0f32; n];
        let mut quality = vec![0.0f32; n];
        let mut wrapped = vec![0.0f32; n];
        let mut status = vec![Status::OutOfImage; n];
        amplitude
            .par_chunks_mut(width)
            .zip(quality.par_chunks_mut(width))
            .zip(wrapped.par_chunks_mut(width))
            .zip(status.par_chunks_mut(width))
            .enumerate()
            .for_each(|(y, (((amplitude, quality), wrapped), status))| {
                let ((re, im), (m1, m2)) = (psi.row(y), moments.row(y));
                for x in 0..width {
                    let magnitude = re[x].hypot(im[x]);
                    amplitude[x] = 2.0 * magnitude;
                    let variance = m2[x] - m1[x] * m1[x];
                    let explained = 2.0 * magnitude * magnitude / variance;
                    quality[x] = if variance > 0.0 { explained.clamp(0.0, 1.0) } else { 0.0 };
                    wrapped[x] = im[x].atan2(re[x]);
                    if self.covered(x, y) {
                        status[x] = Status::Converged;
                    }
                }
            });
        let strong = best_tenth(amplitude.iter().zip(&status).filter(|(_, s)| s.is_ok()).map(|(a, _)| *a))?;
        let least = f64::from(strong) * self.settings.min_modulation;
        let gain = self.noise * self.window.energy() * std::f64::consts::SQRT_2;
        for (s, &a) in status.iter_mut().zip(&amplitude) {
            let a = f64::from(a);
            if s.is_ok() && (a < least || a <= 0.0 || gain / a > MOST_SIGMA) {
                *s = Status::LowTexture;
            }
        }
        let valid: Vec<bool> = status.iter().map(|s| s.is_ok()).collect();
        let unwrapped = unwrap(width, &wrapped, &valid);
        let mut phase = unwrapped.phase;
        phase.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            let track = model.row(y as f64);
            row.iter_mut().enumerate().for_each(|(x, p)| *p += track.at(x as f64));
        });
        let offsets = offsets(&phase, &unwrapped.label, unwrapped.components, width);
        phase.iter_mut().zip(&unwrapped.label).for_each(|(p, l)| *p -= offsets[*l as usize]);
        let sigma = amplitude
            .iter()
            .zip(&valid)
            .map(|(&a, &v)| if v { (gain / f64::from(a)) as f32 } else { f32::NAN })
            .collect();
        let carrier = mean_carrier(&phase, &unwrapped.label, width)?;
        Some(PhaseMap {
            carrier,
            phase,
            sigma,
            amplitude,
            quality,
            status,
            label: unwrapped.label,
            components: unwrapped.components,
            residues: unwrapped.residues,
        })
    }
}

/// Whole turns to take off each component: its pixel nearest to the centre gets a phase in −π…π.
fn offsets(phase: &[f64], label: &[u32], components: usize, width: usize) -> Vec<f64> {
    let height = phase.len() / width;
    let centre = [0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0)];
    let mut nearest = vec![(f64::INFINITY, 0.0); components + 1];
    for (k, (&p, &l)) in phase.iter().zip(label).enumerate() {
        if l == 0 {
            continue;
        }
        let d = ((k % width) as f64 - centre[0]).powi(2) + ((k / width) as f64 - centre[1]).powi(2);
        let best = &mut nearest[l as usize];
        if d < best.0 {
            *best = (d, p);
        }
    }
    nearest.iter().map(|(_, p)| TAU * (p / TAU).round()).collect()
}

/// Gradient of the plane through the phases of the largest component.
fn mean_carrier(phase: &[f64], label: &[u32], width: usize) -> Option<Carrier> {
    let inside = || {
        phase
            .iter()
            .zip(label)
            .enumerate()
            .filter(|(_, (_, l))| **l == 1)
            .map(move |(k, (p, _))| ((k % width) as f64, (k / width) as f64, *p))
    };
    let n = inside().count() as f64;
    let (sx, sy, sp) = inside().fold((0.0, 0.0, 0.0), |s, (x, y, p)| (s.0 + x, s.1 + y, s.2 + p));
    let (mx, my, mp) = (sx / n, sy / n, sp / n);
    let (mut xx, mut xy, mut yy, mut xp, mut yp) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (x, y, p) in inside() {
        let (x, y, p) = (x - mx, y - my, p - mp);
        xx += x * x;
        xy += x * y;
        yy += y * y;
        xp += x * p;
        yp += y * p;
    }
    let d = xx * yy - xy * xy;
    (d > 0.0).then(|| Carrier { fx: (xp * yy - yp * xy) / (TAU * d), fy: (yp * xx - xp * xy) / (TAU * d) })
}
