//! Centres of bright spots and of a disc (aperture) in an image.

use serde::{Deserialize, Serialize};

use super::AlignError;
use crate::patch::blob::{Blob, Kind, regions};
use crate::patch::ellipse::{self, Ellipse, quadratic};
use crate::patch::{GreyView, gaussian, smooth::Plane};

/// A spot or disc.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spot {
    /// Its centre, pixels.
    pub at_px: [f64; 2],
    /// Standard deviations of the centre's coordinates.
    pub sigma_px: [f64; 2],
    /// Mean radius: of the disc, or at 1/e² of the spot's peak; pixels.
    pub radius_px: f64,
    /// Height over the ground, grey levels; below 0 for a dark disc.
    pub contrast: f64,
}

/// The `count` strongest bright spots from left to right. Pixels at or above `saturation` are not
/// used for the centres.
///
/// Each spot is fitted as an elliptic Gaussian on a ground that changes linearly.
///
/// # Errors
/// [`AlignError::Spots`] if there are fewer; [`AlignError::Unfit`] if one cannot be measured.
pub fn find_spots(view: &GreyView<'_>, count: usize, saturation: f64) -> Result<Vec<Spot>, AlignError> {
    let none = AlignError::Spots { found: 0, needed: count };
    let plane = Plane::of(view).ok_or(none)?;
    let smoothed = plane.smoothed(1.5);
    let mut sorted = smoothed.data.clone();
    let half = sorted.len() / 2;
    let ground = f64::from(*sorted.select_nth_unstable_by(half, f32::total_cmp).1);
    let peak = smoothed.data.iter().copied().fold(f32::MIN, f32::max);
    let noise = plane.noise();
    // Spots down to a tenth of the strongest, but clear of the noise.
    let over = (0.1 * (f64::from(peak) - ground)).max(6.0 * noise).max(1e-9);
    let mut blobs = foreground(&smoothed, |v| f64::from(v) > ground + over);
    blobs.retain(|b| b.area >= 6);
    let energy = |b: &Blob| {
        let [x, y] = b.centre;
        smoothed.sample(x, y).unwrap_or(0.0) * b.area as f64
    };
    blobs.sort_by(|a, b| energy(b).total_cmp(&energy(a)));
    if blobs.len() < count {
        return Err(AlignError::Spots { found: blobs.len(), needed: count });
    }
    blobs.truncate(count);
    let mut spots = Vec::with_capacity(count);
    for blob in &blobs {
        let [x, y] = blob.centre;
        let unfit = AlignError::Unfit { x, y };
        if blob.cut {
            return Err(unfit);
        }
        let [long, _] = Ellipse::semi_axes(blob.form());
        let mut pixels = view.patch(blob.centre, 1.6 * long + 4.0, 0.3, |_| true).ok_or(unfit)?;
        pixels.retain(|p| p.grey < saturation);
        let top = smoothed.sample(x, y).unwrap_or(f64::from(peak)) - ground;
        // The blob ends where the spot has fallen to `over`: ln(top/over) of its exponent.
        let depth = 2.0 * (top / over).max(1.5).ln();
        let form = blob.form().map(|v| v * depth);
        let fit = gaussian::fit(&pixels, blob.centre, form, top, ground, long).ok_or(unfit)?;
        if !(fit.peak > 3.0 * fit.noise && fit.sigma.iter().all(|s| *s < 0.5)) {
            return Err(unfit);
        }
        let det = fit.form[0] * fit.form[2] - fit.form[1] * fit.form[1];
        spots.push(Spot {
            at_px: fit.centre,
            sigma_px: fit.sigma,
            // exp(−r²/2σ²) = e⁻² at r = 2σ
            radius_px: 2.0 / det.sqrt().sqrt(),
            contrast: fit.peak,
        });
    }
    spots.sort_by(|a, b| a.at_px[0].total_cmp(&b.at_px[0]));
    Ok(spots)
}

/// The most prominent elliptic disc, bright or dark: an aperture that is lit, or seen as a hole.
///
/// # Errors
/// [`AlignError::NoDisc`] if there is none.
pub fn find_disc(view: &GreyView<'_>) -> Result<Spot, AlignError> {
    let plane = Plane::of(view).ok_or(AlignError::NoDisc)?;
    let smoothed = plane.smoothed(1.0);
    let mut sorted = smoothed.data.clone();
    let mut at = |share: f64| {
        let k = (share * (sorted.len() - 1) as f64) as usize;
        f64::from(*sorted.select_nth_unstable_by(k, f32::total_cmp).1)
    };
    let (low, ground, high) = (at(0.0005), at(0.5), at(0.9995));
    let mut best: Option<(f64, Spot)> = None;
    for (level, bright) in [(0.5 * (ground + high), true), (0.5 * (ground + low), false)] {
        let blobs = foreground(&smoothed, |v| (f64::from(v) > level) == bright);
        let discs = blobs.iter().filter(|b| !b.cut && b.area >= 28 && (0.9..1.1).contains(&b.fullness()));
        for blob in discs {
            let Some(spot) = disc(view, blob, ground, if bright { high } else { low }) else { continue };
            let weight = spot.contrast.abs() * spot.radius_px;
            if (spot.contrast > 0.0) == bright && best.is_none_or(|(w, _)| weight > w) {
                best = Some((weight, spot));
            }
        }
    }
    best.map(|(_, spot)| spot).ok_or(AlignError::NoDisc)
}

fn disc(view: &GreyView<'_>, blob: &Blob, ground: f64, inside: f64) -> Option<Spot> {
    let form = blob.form();
    let [long, _] = Ellipse::semi_axes(form);
    // Wide enough for the ground to be seen beside a blurred rim.
    let reach = 1.5 + 3.0 / long;
    let keep = |d: [f64; 2]| quadratic(form, d) < reach * reach;
    let pixels = view.patch(blob.centre, reach * long, 0.2, keep)?;
    let fit = ellipse::fit(&pixels, blob.centre, form, [ground, inside])?;
    let [a, b] = Ellipse::semi_axes(fit.form);
    (fit.contrast.abs() > 5.0 * fit.noise).then_some(Spot {
        at_px: fit.centre,
        sigma_px: fit.sigma,
        radius_px: (a * b).sqrt(),
        contrast: fit.contrast,
    })
}

fn foreground(plane: &Plane, is: impl Fn(f32) -> bool) -> Vec<Blob> {
    let mut kinds: Vec<Kind> = (0..plane.data.len())
        .map(|k| match (plane.is_used(k), is(plane.data[k])) {
            (false, _) => Kind::Unused,
            (true, true) => Kind::Foreground,
            (true, false) => Kind::Background,
        })
        .collect();
    regions(&mut kinds, plane.width, plane.height)
}
