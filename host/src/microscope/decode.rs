//! Pixel pairs to points and displacements under the microscope.

use crate::measure::{
    Displacement, DisplacementPoint, Grid, Match, PointStatus, Profile, ProfilePoint, Tracks,
};
use daic_optics::microscope::Microscope;
use daic_optics::{Decoded, PairModel as _, PixelPair, pixel_covariance};

fn surface_point(decoded: Option<&Decoded>, matched: &Match, status: PointStatus) -> ProfilePoint {
    let pixel_px = matched.pair.minus_px;
    match decoded {
        Some(decoded) => {
            let covariance = decoded.covariance_mm2(&pixel_covariance([0.0; 2], matched.sigma_px));
            ProfilePoint {
                pixel_px,
                point_mm: decoded.point_mm.into(),
                sigma_mm: [0, 1, 2].map(|i| covariance[(i, i)].sqrt()),
                gap_mm: decoded.gap_mm,
                status,
            }
        }
        None => ProfilePoint {
            pixel_px,
            point_mm: [f64::NAN; 3],
            sigma_mm: [f64::NAN; 3],
            gap_mm: f64::NAN,
            status,
        },
    }
}

fn point(model: &Microscope, matched: &Match) -> ProfilePoint {
    if !matched.status.is_ok() {
        return surface_point(None, matched, matched.status);
    }
    match model.decode_pair(matched.pair) {
        Ok(decoded) => surface_point(Some(&decoded), matched, PointStatus::Ok),
        Err(_) => surface_point(None, matched, PointStatus::Decode),
    }
}

/// Decodes the matched views of one frame, (3.4)–(3.5); σ from the noise of the match.
pub fn profile(grid: &Grid, matches: &[Match], model: &Microscope) -> Profile {
    let points: Vec<ProfilePoint> = matches.iter().map(|m| point(model, m)).collect();
    let gaps = || points.iter().filter(|p| p.status.is_ok()).map(|p| p.gap_mm);
    let mean_gap_mm = gaps().sum::<f64>() / gaps().count() as f64;
    Profile { grid: grid.clone(), points, mean_gap_mm }
}

/// Decodes matched points before and after, the +1 pixel being followed from the match of the −1 pixel (3.3); σ from
/// the noise of match and tracking.
pub fn displacement(grid: &Grid, matches: &[Match], tracks: &Tracks, model: &Microscope) -> Displacement {
    let points = matches
        .iter()
        .zip(&tracks.points)
        .map(|(matched, track)| {
            let reference = point(model, matched);
            let without = |status| DisplacementPoint {
                reference,
                displacement_mm: [f64::NAN; 3],
                sigma_mm: [f64::NAN; 3],
                status,
            };
            if !reference.status.is_ok() {
                return without(reference.status);
            }
            if !track.status.is_ok() {
                return without(track.status);
            }
            let deformed = PixelPair { minus_px: track.minus_px, plus_px: track.plus_px };
            let reference_px2 = pixel_covariance([0.0; 2], matched.sigma_px);
            let tracking_px2 = pixel_covariance(track.sigma_minus_px, track.sigma_plus_px);
            match model.track(matched.pair, deformed, &reference_px2, &tracking_px2) {
                Ok(found) => DisplacementPoint {
                    reference,
                    displacement_mm: found.displacement_mm.into(),
                    sigma_mm: [0, 1, 2].map(|i| found.covariance_mm2[(i, i)].sqrt()),
                    status: PointStatus::Ok,
                },
                Err(_) => without(PointStatus::Decode),
            }
        })
        .collect();
    Displacement { grid: grid.clone(), points }
}
