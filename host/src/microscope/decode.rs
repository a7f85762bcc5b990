//! Pixel pairs to points and displacements under the microscope.

use super::Reach;
use crate::measure::{
    Displacement, DisplacementPoint, Grid, Match, PointStatus, Profile, ProfilePoint, Tracks, mark_gaps,
};
use daic_optics::microscope::Microscope;
use daic_optics::{Decoded, PairModel as _, PixelPair, TraceError, pixel_covariance};
use nalgebra::{Matrix3, SMatrix};

/// A microscope and the covariance of its six parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Instrument {
    /// The model.
    pub model: Microscope,
    /// Covariance of [`daic_optics::microscope::Parameters::to_array`].
    pub covariance: SMatrix<f64, 6, 6>,
    /// What the calibration's points filled; everything if none.
    pub reach: Option<Reach>,
}

impl Instrument {
    /// `ok`, or `outside` where the calibration was not made.
    fn status(&self, pair: PixelPair, height_mm: f64) -> PointStatus {
        let middle = [0, 1].map(|i| 0.5 * (pair.minus_px[i] + pair.plus_px[i]));
        let covered = self.reach.is_none_or(|reach| reach.covers(middle, height_mm));
        if covered { PointStatus::Ok } else { PointStatus::Outside }
    }

    fn common(&self, by: &SMatrix<f64, 3, 6>) -> Matrix3<f64> {
        by * self.covariance * by.transpose()
    }

    fn decoded(&self, matched: &Match) -> Result<ProfilePoint, TraceError> {
        let decoded: Decoded = self.model.decode_pair(matched.pair)?;
        let pixels = pixel_covariance([0.0; 2], matched.sigma_px);
        Ok(ProfilePoint {
            pixel_px: matched.pair.minus_px,
            plus_px: matched.pair.plus_px,
            point_mm: decoded.point_mm.into(),
            independent_mm2: decoded.covariance_mm2(&pixels),
            common_mm2: self.common(&self.model.parameter_jacobian(matched.pair)?),
            gap_mm: decoded.gap_mm,
            sigma_gap_mm: decoded.gap_variance_mm2(&pixels).sqrt(),
            // the gap is the departure of y₊ − y₋ from that of the datum: no parameter enters to first order
            common_gap_mm: 0.0,
            gap_by_v_mm_per_px: decoded.gap_jacobian[3],
            status: self.status(matched.pair, decoded.point_mm.z),
        })
    }

    fn point(&self, matched: &Match) -> ProfilePoint {
        if !matched.status.is_ok() {
            return ProfilePoint::failed(matched, matched.status);
        }
        self.decoded(matched).unwrap_or_else(|_| ProfilePoint::failed(matched, PointStatus::Decode))
    }

    fn moved(
        &self,
        reference: ProfilePoint,
        matched: &Match,
        deformed: PixelPair,
        tracking: [[f64; 2]; 2],
    ) -> Result<DisplacementPoint, TraceError> {
        let pixels = pixel_covariance([0.0; 2], matched.sigma_px);
        let tracking = pixel_covariance(tracking[0], tracking[1]);
        let found = self.model.track(matched.pair, deformed, &pixels, &tracking)?;
        let by = self.model.displacement_parameter_jacobian(matched.pair, deformed)?;
        Ok(DisplacementPoint {
            reference,
            displacement_mm: found.displacement_mm.into(),
            independent_mm2: found.covariance_mm2,
            common_mm2: self.common(&by),
            status: self.status(deformed, self.model.decode_pair(deformed)?.point_mm.z),
        })
    }
}

/// Decodes the matched views of one frame, (3.4)–(3.5).
pub fn profile(grid: &Grid, matches: &[Match], instrument: &Instrument) -> Profile {
    let mut points: Vec<ProfilePoint> = matches.iter().map(|m| instrument.point(m)).collect();
    let gap = mark_gaps(&mut points, matches);
    Profile { grid: grid.clone(), points, states_common: true, gap }
}

/// Decodes matched points before and after, the +1 pixel being followed from the match of the −1 pixel (3.3).
pub fn displacement(
    grid: &Grid,
    matches: &[Match],
    tracks: &Tracks,
    instrument: &Instrument,
) -> Displacement {
    let Profile { points: before, gap, .. } = profile(grid, matches, instrument);
    let points = matches
        .iter()
        .zip(before)
        .zip(&tracks.points)
        .map(|((matched, reference), track)| {
            if !reference.status.is_ok() {
                return DisplacementPoint::failed(reference, reference.status);
            }
            if !track.status.is_ok() {
                return DisplacementPoint::failed(reference, track.status);
            }
            let deformed = PixelPair { minus_px: track.minus_px, plus_px: track.plus_px };
            let tracking = [track.sigma_minus_px, track.sigma_plus_px];
            instrument
                .moved(reference, matched, deformed, tracking)
                .unwrap_or_else(|_| DisplacementPoint::failed(reference, PointStatus::Decode))
        })
        .collect();
    Displacement { grid: grid.clone(), points, states_common: true, gap }
}
