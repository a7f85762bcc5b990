//! Pixel pairs to points and displacements, with uncertainty.

use super::{Grid, Match, PointStatus, Tracks, status_counts};
use crate::error::Error;
use daic_optics::{Decoded, Decoder, OpticalModel, PixelPair, pixel_covariance};
use rayon::prelude::*;

/// A gap beyond this many of its own standard deviations is no chance: the match is wrong or the
/// optics are. Generous, so that a small model error marks no point.
const GAP_SIGMAS: f64 = 20.0;

/// One point of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProfilePoint {
    /// Where the −1 view sees it, pixels.
    pub pixel_px: [f64; 2],
    /// (x, y, h) in millimetres; NaN without result.
    pub point_mm: [f64; 3],
    /// Standard deviations of (x, y, h) from the noise of the match, millimetres.
    pub sigma_mm: [f64; 3],
    /// Shortest distance of the two rays, millimetres.
    pub gap_mm: f64,
    /// Whether it counts.
    pub status: PointStatus,
}

/// A surface on the grid of the −1 view.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Where the points lie.
    pub grid: Grid,
    /// Row by row.
    pub points: Vec<ProfilePoint>,
    /// Mean gap of the rays in millimetres: a consistency check that needs no truth.
    pub mean_gap_mm: f64,
}

impl Profile {
    /// Refuses a surface without a single point.
    ///
    /// # Errors
    /// [`Error::NothingMeasured`] says what failed.
    pub fn with_points(self) -> Result<Self, Error> {
        if self.points.iter().any(|p| p.status.is_ok()) {
            return Ok(self);
        }
        Err(Error::NothingMeasured { reasons: status_counts(self.points.iter().map(|p| p.status)) })
    }
}

impl Displacement {
    /// Refuses a field without a single point.
    ///
    /// # Errors
    /// [`Error::NothingMeasured`] says what failed.
    pub fn with_points(self) -> Result<Self, Error> {
        if self.points.iter().any(|p| p.status.is_ok()) {
            return Ok(self);
        }
        Err(Error::NothingMeasured { reasons: status_counts(self.points.iter().map(|p| p.status)) })
    }
}

/// One point and its displacement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisplacementPoint {
    /// The point before, with its own uncertainty.
    pub reference: ProfilePoint,
    /// (u, v, w) along x, y, h in millimetres; NaN without result.
    pub displacement_mm: [f64; 3],
    /// Standard deviations of the displacement, millimetres.
    pub sigma_mm: [f64; 3],
    /// Whether it counts.
    pub status: PointStatus,
}

/// Displacements on the grid of the −1 view of the reference frame (Lagrangian).
#[derive(Debug, Clone, PartialEq)]
pub struct Displacement {
    /// Where the points lie.
    pub grid: Grid,
    /// Row by row.
    pub points: Vec<DisplacementPoint>,
}

fn failed(pixel_px: [f64; 2], status: PointStatus) -> ProfilePoint {
    let nan = f64::NAN;
    ProfilePoint { pixel_px, point_mm: [nan; 3], sigma_mm: [nan; 3], gap_mm: nan, status }
}

fn point(model: &OpticalModel, decoder: Decoder, matched: &Match) -> ProfilePoint {
    let pixel_px = matched.pair.minus_px;
    if !matched.status.is_ok() {
        return failed(pixel_px, matched.status);
    }
    let Ok(decoded) = model.decode(decoder, matched.pair) else {
        return failed(pixel_px, PointStatus::Decode);
    };
    // the pixel of the −1 view is where the grid put it: all noise is in the match
    let covariance = decoded.covariance_mm2(&pixel_covariance([0.0; 2], matched.sigma_px));
    let sigma = [0, 1, 2].map(|i| covariance[(i, i)].sqrt());
    let p = decoded.point_mm;
    let consistent = meets(&decoded, decoder, matched.sigma_px[1]);
    ProfilePoint {
        pixel_px,
        point_mm: [p.x, p.y, p.z],
        sigma_mm: sigma,
        gap_mm: decoded.gap_mm,
        status: if consistent { PointStatus::Ok } else { PointStatus::Gap },
    }
}

/// Whether the two rays meet as well as the noise lets them.
fn meets(decoded: &Decoded, decoder: Decoder, sigma_y_px: f64) -> bool {
    // across the grooves the gap answers to v alone, on the scale that y has
    let scale = decoded.jacobian[(1, 1)].hypot(decoded.jacobian[(1, 3)]);
    decoder != Decoder::Ray || decoded.gap_mm <= GAP_SIGMAS * scale * sigma_y_px.max(0.01)
}

/// Decodes the matched views of one frame.
pub fn profile(grid: &Grid, matches: &[Match], model: &OpticalModel, decoder: Decoder) -> Profile {
    let points: Vec<ProfilePoint> = matches.par_iter().map(|m| point(model, decoder, m)).collect();
    let gaps = || points.iter().filter(|p| p.status.is_ok()).map(|p| p.gap_mm);
    let mean_gap_mm = gaps().sum::<f64>() / gaps().count() as f64;
    Profile { grid: grid.clone(), points, mean_gap_mm }
}

/// Whether a height lies within the range or less than its span outside.
fn near(h: f64, [low, high]: [f64; 2]) -> bool {
    let span = high - low;
    (low - span..=high + span).contains(&h)
}

/// Decodes matched points before and after; both points belong to the same material (1e).
///
/// `height_mm` are the heights between which surfaces are searched; a point that ends up further outside
/// than their span was followed to the wrong place.
pub fn displacement(
    grid: &Grid,
    matches: &[Match],
    tracks: &Tracks,
    model: &OpticalModel,
    decoder: Decoder,
    height_mm: [f64; 2],
) -> Displacement {
    let points = matches
        .par_iter()
        .zip(&tracks.points)
        .map(|(matched, track)| {
            let reference = point(model, decoder, matched);
            let nan = [f64::NAN; 3];
            let without =
                |status| DisplacementPoint { reference, displacement_mm: nan, sigma_mm: nan, status };
            if !reference.status.is_ok() {
                return without(reference.status);
            }
            if !track.status.is_ok() {
                return without(track.status);
            }
            let deformed = PixelPair { minus_px: track.minus_px, plus_px: track.plus_px };
            let reference_px2 = pixel_covariance([0.0; 2], matched.sigma_px);
            let tracking_px2 = pixel_covariance(track.sigma_minus_px, track.sigma_plus_px);
            match model.displacement(decoder, matched.pair, deformed, &reference_px2, &tracking_px2) {
                Ok(found) if !meets(&found.deformed, decoder, track.sigma_plus_px[1]) => {
                    without(PointStatus::Gap)
                }
                Ok(found) if !near(found.deformed.point_mm[2], height_mm) => without(PointStatus::Range),
                Ok(found) => {
                    let [u, v, w] = [0, 1, 2].map(|i| found.displacement_mm[i]);
                    DisplacementPoint {
                        reference,
                        displacement_mm: [u, v, w],
                        sigma_mm: [0, 1, 2].map(|i| found.covariance_mm2[(i, i)].sqrt()),
                        status: PointStatus::Ok,
                    }
                }
                Err(_) => without(PointStatus::Decode),
            }
        })
        .collect();
    Displacement { grid: grid.clone(), points }
}
