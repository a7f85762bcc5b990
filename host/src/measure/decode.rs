//! Pixel pairs to points and displacements, with uncertainty.

use super::gap::{GapField, GapSummary};
use super::instrument::Instrument;
use super::{Grid, Match, PointStatus, Tracks, status_counts};
use crate::error::Error;
use daic_optics::{PixelPair, TraceError, UncertainPoint, pixel_covariance};
use nalgebra::Matrix3;
use rayon::prelude::*;

/// A gap this many of its own standard deviations away from those around it is no chance: the match is
/// wrong. Generous, so that a small model error marks no point.
const GAP_SIGMAS: f64 = 20.0;
/// No match is taken to be surer than this, pixels: systematic errors of the correlation.
const LEAST_SIGMA_PX: f64 = 0.01;

/// One point of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProfilePoint {
    /// Where the −1 view sees it, pixels.
    pub pixel_px: [f64; 2],
    /// Where the +1 view sees it; NaN without a match.
    pub plus_px: [f64; 2],
    /// (x, y, h) in millimetres; NaN without result.
    pub point_mm: [f64; 3],
    /// Covariance (mm²) from the noise of the match, independent of other points' but for overlapping
    /// subsets.
    pub independent_mm2: Matrix3<f64>,
    /// Covariance (mm²) from the calibration, in common with all points; zero where nothing is stated.
    pub common_mm2: Matrix3<f64>,
    /// Shortest distance of the two rays, millimetres; above 0 where the +1 view's passes at larger y.
    pub gap_mm: f64,
    /// Standard deviation of the gap from the noise of the match, millimetres.
    pub sigma_gap_mm: f64,
    /// Standard deviation of the gap from the calibration, millimetres.
    pub common_gap_mm: f64,
    /// Change of the gap with y of the +1 view, mm/px.
    pub gap_by_v_mm_per_px: f64,
    /// Whether it counts.
    pub status: PointStatus,
}

impl ProfilePoint {
    /// A point without a result.
    pub(crate) fn failed(matched: &Match, status: PointStatus) -> Self {
        let nan = f64::NAN;
        Self {
            pixel_px: matched.pair.minus_px,
            plus_px: matched.pair.plus_px,
            point_mm: [nan; 3],
            independent_mm2: Matrix3::repeat(nan),
            common_mm2: Matrix3::repeat(nan),
            gap_mm: nan,
            sigma_gap_mm: nan,
            common_gap_mm: nan,
            gap_by_v_mm_per_px: nan,
            status,
        }
    }

    /// Standard deviations of (x, y, h) from the noise of the match, millimetres.
    pub fn sigma_mm(&self) -> [f64; 3] {
        sigma_of(&self.independent_mm2)
    }

    /// Standard deviations of (x, y, h) from the calibration, in common with all points, millimetres.
    pub fn common_sigma_mm(&self) -> [f64; 3] {
        sigma_of(&self.common_mm2)
    }
}

fn sigma_of(covariance: &Matrix3<f64>) -> [f64; 3] {
    // rounding may leave a variance of zero just below it; NaN stays
    [0, 1, 2].map(|i| if covariance[(i, i)] < 0.0 { 0.0 } else { covariance[(i, i)].sqrt() })
}

/// A surface on the grid of the −1 view.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Where the points lie.
    pub grid: Grid,
    /// Row by row.
    pub points: Vec<ProfilePoint>,
    /// Whether anything is known of the calibration's uncertainty.
    pub states_common: bool,
    /// The gap as a smooth function of the pixel.
    pub gap: GapField,
}

impl Profile {
    /// Refuses a surface without a single point.
    ///
    /// # Errors
    /// [`Error::NothingMeasured`] says what failed, [`Error::SwappedOrders`] where the views were mistaken for
    /// each other.
    pub fn with_points(self) -> Result<Self, Error> {
        refuse_nothing(self.points.iter().map(|p| p.status))?;
        Ok(self)
    }

    /// What the gap says of the calibration; `shared` points have one independent measurement between them
    /// (see [`super::Settings::points_per_measurement`]).
    pub fn gap_summary(&self, shared: f64) -> GapSummary {
        GapSummary::new(self.points.iter().filter(|p| p.status.is_ok()), &self.gap, shared)
    }
}

fn refuse_nothing(statuses: impl Iterator<Item = PointStatus> + Clone) -> Result<(), Error> {
    let count = |status: PointStatus| statuses.clone().filter(|s| *s == status).count();
    let before = count(PointStatus::BeforeGrating);
    let decoded = statuses.clone().filter(|s| s.is_matched()).count();
    // a few chance pairs may meet in front of the grating even so
    if 2 * before > decoded {
        return Err(Error::SwappedOrders { points: before });
    }
    if count(PointStatus::Ok) > 0 {
        return Ok(());
    }
    Err(Error::NothingMeasured { reasons: status_counts(statuses) })
}

impl Displacement {
    /// Refuses a field without a single point.
    ///
    /// # Errors
    /// As [`Profile::with_points`].
    pub fn with_points(self) -> Result<Self, Error> {
        refuse_nothing(self.points.iter().map(|p| p.status))?;
        Ok(self)
    }

    /// As [`Profile::gap_summary`], of the reference.
    pub fn gap_summary(&self, shared: f64) -> GapSummary {
        let ok = self.points.iter().filter(|p| p.status.is_ok());
        GapSummary::new(ok.map(|p| &p.reference), &self.gap, shared)
    }
}

/// One point and its displacement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisplacementPoint {
    /// The point before, with its own uncertainty.
    pub reference: ProfilePoint,
    /// (u, v, w) along x, y, h in millimetres; NaN where it could not be computed.
    pub displacement_mm: [f64; 3],
    /// Covariance (mm²) of the displacement from the noise of match and tracking.
    pub independent_mm2: Matrix3<f64>,
    /// Covariance (mm²) of the displacement from the calibration, in common with all points.
    pub common_mm2: Matrix3<f64>,
    /// Whether it counts.
    pub status: PointStatus,
}

impl DisplacementPoint {
    /// A point without a result.
    pub(crate) fn failed(reference: ProfilePoint, status: PointStatus) -> Self {
        let nan = Matrix3::repeat(f64::NAN);
        Self { reference, displacement_mm: [f64::NAN; 3], independent_mm2: nan, common_mm2: nan, status }
    }

    /// Standard deviations of the displacement from match and tracking, millimetres.
    pub fn sigma_mm(&self) -> [f64; 3] {
        sigma_of(&self.independent_mm2)
    }

    /// Standard deviations of the displacement from the calibration, millimetres.
    pub fn common_sigma_mm(&self) -> [f64; 3] {
        sigma_of(&self.common_mm2)
    }
}

/// Displacements on the grid of the −1 view of the reference frame (Lagrangian).
#[derive(Debug, Clone, PartialEq)]
pub struct Displacement {
    /// Where the points lie.
    pub grid: Grid,
    /// Row by row.
    pub points: Vec<DisplacementPoint>,
    /// Whether anything is known of the calibration's uncertainty.
    pub states_common: bool,
    /// The reference's gap as a smooth function of the pixel.
    pub gap: GapField,
}

/// Why a pair has no point.
fn reason(error: &TraceError) -> PointStatus {
    match error {
        TraceError::OutsideMap { .. } => PointStatus::Outside,
        TraceError::BeforeGrating { .. } | TraceError::NoIntersection => PointStatus::BeforeGrating,
        _ => PointStatus::Decode,
    }
}

fn point(instrument: &Instrument, matched: &Match) -> ProfilePoint {
    if !matched.status.is_ok() {
        return ProfilePoint::failed(matched, matched.status);
    }
    // the pixel of the −1 view is where the grid put it: all noise is in the match
    let pixels = pixel_covariance([0.0; 2], matched.sigma_px);
    match instrument.decode(matched.pair, &pixels) {
        Err(error) => ProfilePoint::failed(matched, reason(&error)),
        Ok(UncertainPoint { decoded, independent_mm2, common_mm2, gap_independent_mm2, gap_common_mm2 }) => {
            let point_mm = decoded.point_mm.into();
            let inside = instrument.covers(matched.pair, point_mm);
            ProfilePoint {
                pixel_px: matched.pair.minus_px,
                plus_px: matched.pair.plus_px,
                point_mm,
                independent_mm2,
                common_mm2,
                gap_mm: decoded.gap_mm,
                sigma_gap_mm: gap_independent_mm2.sqrt(),
                common_gap_mm: gap_common_mm2.max(0.0).sqrt(),
                gap_by_v_mm_per_px: decoded.gap_jacobian[3],
                status: if inside { PointStatus::Ok } else { PointStatus::Outside },
            }
        }
    }
}

/// Whether a gap is like those around it, within its noise; `by_y` is its derivative by y of the +1 view.
fn fits(gap: &GapField, pixel_px: [f64; 2], gap_mm: f64, sigma_y_px: f64, by_y: f64) -> bool {
    (gap_mm - gap.at(pixel_px)).abs() <= GAP_SIGMAS * by_y.abs() * sigma_y_px.max(LEAST_SIGMA_PX)
}

/// Decodes matched pairs; what does not fit its surroundings is marked.
fn decode(matches: &[Match], instrument: &Instrument) -> (Vec<ProfilePoint>, GapField) {
    let mut points: Vec<ProfilePoint> = matches.par_iter().map(|m| point(instrument, m)).collect();
    let gap = mark_gaps(&mut points, matches);
    (points, gap)
}

/// The gap as a smooth function of the pixel; points that depart from it are marked.
pub(crate) fn mark_gaps(points: &mut [ProfilePoint], matches: &[Match]) -> GapField {
    let gap = GapField::fit(points);
    for (p, m) in points.iter_mut().zip(matches).filter(|(p, _)| p.status.is_ok()) {
        if !fits(&gap, p.pixel_px, p.gap_mm, m.sigma_px[1], p.gap_by_v_mm_per_px) {
            p.status = PointStatus::Gap;
        }
    }
    gap
}

/// Decodes the matched views of one frame.
pub fn profile(grid: &Grid, matches: &[Match], instrument: &Instrument) -> Profile {
    let (points, gap) = decode(matches, instrument);
    Profile { grid: grid.clone(), points, states_common: instrument.states_uncertainty(), gap }
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
    instrument: &Instrument,
    height_mm: [f64; 2],
) -> Displacement {
    let (before, gap) = decode(matches, instrument);
    let points = matches
        .par_iter()
        .zip(before)
        .zip(&tracks.points)
        .map(|((matched, reference), track)| {
            let without = |status| DisplacementPoint::failed(reference, status);
            if !reference.status.is_ok() {
                return without(reference.status);
            }
            if !track.status.is_ok() {
                return without(track.status);
            }
            let deformed = PixelPair { minus_px: track.minus_px, plus_px: track.plus_px };
            let reference_px2 = pixel_covariance([0.0; 2], matched.sigma_px);
            let tracking_px2 = pixel_covariance(track.sigma_minus_px, track.sigma_plus_px);
            let found = instrument.displacement(matched.pair, deformed, &reference_px2, &tracking_px2);
            let (found, common_mm2) = match found {
                Ok(found) => found,
                Err(error) => return without(reason(&error)),
            };
            let after = &found.deformed;
            let by_y = after.gap_jacobian[3];
            let status = if !fits(&gap, track.minus_px, after.gap_mm, track.sigma_plus_px[1], by_y) {
                PointStatus::Gap
            } else if !near(after.point_mm[2], height_mm) {
                PointStatus::Range
            } else if !instrument.covers(deformed, after.point_mm.into()) {
                PointStatus::Outside
            } else {
                PointStatus::Ok
            };
            // the numbers stay, as those of a profile's points do: the status says what is wrong with them
            let displacement_mm = found.displacement_mm.into();
            let independent_mm2 = found.covariance_mm2;
            DisplacementPoint { reference, displacement_mm, independent_mm2, common_mm2, status }
        })
        .collect();
    Displacement { grid: grid.clone(), points, states_common: instrument.states_uncertainty(), gap }
}
