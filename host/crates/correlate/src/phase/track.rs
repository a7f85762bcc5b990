//! The local carrier: phase of the grating, roughly, as a polynomial over the image.

use super::carrier::Carrier;
use super::polynomial::{Node, Polynomial, Row};
use super::settings::WindowKind;
use super::unwrap::unwrap;
use super::window::Window;
use crate::image::{Image, MaskSums};
use rayon::prelude::*;
use rustfft::num_complex::Complex64;
use std::f64::consts::TAU;

/// Model of a grating's phase: the carrier and a polynomial of what distortion, perspective and
/// strain add to it.
#[derive(Debug, Clone)]
pub(super) struct Track {
    carrier: Carrier,
    rest: Polynomial,
}

/// The model along one row.
pub(super) struct TrackRow {
    start: f64,
    slope: f64,
    rest: Row,
}

impl TrackRow {
    /// Phase at column x, radians.
    pub(super) fn at(&self, x: f64) -> f64 {
        self.start + self.slope * x + self.rest.at(x)
    }
}

impl Track {
    /// The model along row y.
    pub(super) fn row(&self, y: f64) -> TrackRow {
        let rest = self.rest.row(y);
        TrackRow { start: TAU * self.carrier.fy * y, slope: TAU * self.carrier.fx, rest }
    }
}

/// Width of the narrow window in pitches: it bears local pitches that differ from the carrier's by
/// a third.
const NARROW: f64 = 1.0;
/// Phase that the polynomial may miss a node by to count in the second fit, radians.
const OUTLIER: f64 = 1.5;

/// Connected parts that the polynomial is fitted to, each up to a constant of its own.
const MOST_PARTS: usize = 16;

/// Follows the carrier over the image: phases at nodes half a pitch apart by a narrow window, unwrapped, and a
/// polynomial of up to `degree` through their connected parts.
///
/// `None` where no node has a whole window inside image and mask.
pub(super) fn track(
    image: &Image,
    mean: f64,
    mask: Option<&MaskSums>,
    carrier: Carrier,
    degree: usize,
    min_modulation: f64,
) -> Option<Track> {
    let (width, height) = (image.width(), image.height());
    let window = Window::new(WindowKind::Gaussian, NARROW * carrier.pitch());
    let r = window.radius();
    let step = ((0.5 * carrier.pitch()).round() as usize).max(1);
    let nodes = |n: usize| if n > 2 * r { (n - 2 * r).div_ceil(step) } else { 0 };
    let (columns, rows) = (nodes(width), nodes(height));
    if columns == 0 || rows == 0 {
        return None;
    }
    let turned = |f: f64| -> Vec<Complex64> {
        let at =
            |(k, w): (usize, &f32)| Complex64::from_polar(f64::from(*w), -TAU * f * (k as f64 - r as f64));
        window.weights().iter().enumerate().map(at).collect()
    };
    let (wx, wy) = (turned(carrier.fx), turned(carrier.fy));
    let mut along = vec![Complex64::default(); columns * height];
    along.par_chunks_mut(columns).enumerate().for_each(|(y, out)| {
        let row = image.row(y);
        for (i, o) in out.iter_mut().enumerate() {
            let part = &row[i * step..i * step + wx.len()];
            *o = part.iter().zip(&wx).map(|(g, w)| w * (f64::from(*g) - mean)).sum();
        }
    });
    let mut psi = vec![Complex64::default(); columns * rows];
    psi.par_chunks_mut(columns).enumerate().for_each(|(j, out)| {
        for (line, w) in along[j * step * columns..].chunks_exact(columns).zip(&wy) {
            out.iter_mut().zip(line).for_each(|(o, l)| *o += w * l);
        }
    });
    let inside = |i: usize, j: usize| {
        let (x, y, side) = (i * step, j * step, 2 * r + 1);
        mask.is_none_or(|m| m.count(x, y, x + side, y + side) as usize == side * side)
    };
    let covered: Vec<bool> = (0..columns * rows).map(|k| inside(k % columns, k / columns)).collect();
    let strong = best_tenth(psi.iter().zip(&covered).filter(|(_, c)| **c).map(|(p, _)| p.norm() as f32))?;
    let least = f64::from(strong) * min_modulation;
    let valid: Vec<bool> =
        psi.iter().zip(&covered).map(|(p, c)| *c && p.norm() >= least && p.norm() > 0.0).collect();
    let position = |k: usize| ((k % columns * step + r) as f64, (k / columns * step + r) as f64);
    let wrapped: Vec<f32> = psi
        .iter()
        .enumerate()
        .map(|(k, p)| {
            let (x, y) = position(k);
            (p * Complex64::from_polar(1.0, -TAU * (carrier.fx * x + carrier.fy * y))).arg() as f32
        })
        .collect();
    let unwrapped = unwrap(columns, &wrapped, &valid);
    let groups = unwrapped.components.min(MOST_PARTS);
    let mut points: Vec<Node> = (0..columns * rows)
        .filter(|&k| (1..=groups).contains(&(unwrapped.label[k] as usize)))
        .map(|k| {
            let (x, y) = position(k);
            let weight = psi[k].norm_sqr() / f64::from(strong).powi(2);
            Node { x, y, value: unwrapped.phase[k], weight, group: unwrapped.label[k] as usize - 1 }
        })
        .collect();
    let mut rest = None;
    for round in 0..2 {
        let (fit, constants) = (0..=degree)
            .rev()
            // enough nodes for every term
            .filter(|d| 4 * ((d + 1) * (d + 2) / 2 + groups) <= points.len() || *d == 0)
            .find_map(|d| Polynomial::zero(width, height, d).fit(&points, groups))?;
        if round == 0 {
            points.retain(|p| (p.value - constants[p.group] - fit.at(p.x, p.y)).abs() < OUTLIER);
        }
        rest = Some(fit);
        if points.is_empty() {
            break;
        }
    }
    rest.map(|rest| Track { carrier, rest })
}

/// The value that a tenth of the others exceed.
pub(super) fn best_tenth(values: impl Iterator<Item = f32>) -> Option<f32> {
    let mut values: Vec<f32> = values.collect();
    if values.is_empty() {
        return None;
    }
    let k = values.len() * 9 / 10;
    let at = *values.select_nth_unstable_by(k, f32::total_cmp).1;
    (at > 0.0).then_some(at)
}
