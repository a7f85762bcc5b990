//! Calibration of distances and F from the calibration frames of a dataset.

use super::summary::{CalibratedParameter, CalibrationSummary};
use crate::error::Error;
use crate::measure::{self, Match, Tracks};
use daic_optics::calibrate::{Observation, Settings, TrackedPoint, calibrate};
use daic_optics::{Decoder, OpticalModel, Optics, Parameter, PixelPair};
use daic_rig::experiment::Covariance;
use nalgebra::{Matrix3x2, Vector3};

/// Points within this radius of the optical axis make the surface whose height there is known.
const AXIS_RADIUS_MM: f64 = 1.5;
/// Fewest points for that.
const AXIS_POINTS: usize = 30;
/// What a sub-pixel σ of zero would claim no camera can; keeps the weights finite.
const LEAST_SIGMA_PX: f64 = 1e-4;

/// Optics, and how sure they are.
pub struct Calibrated {
    /// The set-up.
    pub optics: Optics,
    /// Covariance of what was calibrated.
    pub covariance: Option<Covariance>,
    /// What was found; none without a calibration.
    pub summary: Option<CalibrationSummary>,
}

/// One calibration frame: where the stage stood relative to the reference, and the tracked points.
pub struct Moved {
    /// Displacement of the specimen from the reference frame (x, y, h), millimetres.
    pub displacement_mm: [f64; 3],
    /// The reference's points in this frame.
    pub tracks: Tracks,
}

/// Estimates F and s from the moves, then d from the known height of the specimen on the optical axis.
///
/// Moves alone say nothing about d: it only says from where heights are counted. So the height of the
/// specimen where the optical axis meets it, at the reference position, is the datum.
///
/// `shared` (see [`measure::Settings::points_per_measurement`]) is how many points have one independent measurement between them.
///
/// # Errors
/// If the moves do not determine a parameter, or there is no surface near the axis.
pub fn run(
    start: &Optics,
    matches: &[Match],
    moved: &[Moved],
    axis_height_mm: f64,
    shared: f64,
) -> Result<Calibrated, Error> {
    let mut displacements = vec![Vector3::zeros()];
    displacements.extend(moved.iter().map(|m| Vector3::from(m.displacement_mm)));
    let points: Vec<TrackedPoint> = (0..matches.len())
        .filter(|&k| matches[k].status.is_ok())
        .map(|k| {
            let home = observation(matches[k].pair, [0.0; 2], matches[k].sigma_px);
            let mut frames = vec![Some(home)];
            frames.extend(moved.iter().map(|m| {
                let track = &m.tracks.points[k];
                let pair = PixelPair { minus_px: track.minus_px, plus_px: track.plus_px };
                // the match between the views enters the +1 pixel of every frame
                let match_and_track = [0, 1].map(|i| matches[k].sigma_px[i].hypot(track.sigma_plus_px[i]));
                track.status.is_ok().then(|| observation(pair, track.sigma_minus_px, match_and_track))
            }));
            TrackedPoint { frames }
        })
        .collect();
    let settings = Settings {
        parameters: vec![Parameter::FocalPx, Parameter::PinholeToGrating],
        reference_height_mm: None,
        ..Settings::default()
    };
    let found = calibrate(start, &displacements, &points, &settings)?;
    let mut optics = found.optics;

    let model = OpticalModel::new(&optics)?;
    let instrument = measure::Instrument::new(model.clone(), Decoder::Ray);
    let surface = measure::profile(&measure::Grid::none(), matches, &instrument);
    let near: Vec<[f64; 3]> = surface
        .points
        .iter()
        .filter(|p| p.status.is_ok() && p.point_mm[0].hypot(p.point_mm[1]) <= AXIS_RADIUS_MM)
        .map(|p| p.point_mm)
        .collect();
    let (height, height_sigma) = height_on_axis(&near).ok_or(Error::NoAxisPoints {
        found: near.len(),
        needed: AXIS_POINTS,
        radius_mm: AXIS_RADIUS_MM,
    })?;
    optics.grating_to_reference_mm += axis_height_mm - height;

    let covariance = covariance(&found, &model, height_sigma, shared);
    let mut parameters: Vec<CalibratedParameter> = found
        .estimates
        .iter()
        .map(|e| CalibratedParameter {
            name: unit_name(e.parameter).to_owned(),
            start: Some(e.start),
            value: e.value,
            sigma: e.sigma * shared.sqrt(),
        })
        .collect();
    parameters.push(CalibratedParameter {
        name: unit_name(Parameter::GratingToReference).to_owned(),
        start: Some(start.grating_to_reference_mm),
        value: optics.grating_to_reference_mm,
        sigma: covariance.as_ref().map_or(f64::NAN, |c| c.matrix[2][2].sqrt()),
    });
    let summary = CalibrationSummary {
        parameters,
        rms_px: found.rms_px,
        chi_square_reduced: found.chi_square_reduced,
        points: found.points,
        observations: found.observations,
        rejected: found.rejected.len(),
    };
    Ok(Calibrated { optics, covariance, summary: Some(summary) })
}

/// Covariance of F, s and d. F and s are those of the moves; an error of theirs moves the height on the axis, and d,
/// which puts that height right, the other way.
fn covariance(
    found: &daic_optics::calibrate::Calibration,
    model: &OpticalModel,
    height_sigma: f64,
    shared: f64,
) -> Option<Covariance> {
    let [by_f, by_s] = height_by(model)?;
    let carry = Matrix3x2::new(1.0, 0.0, 0.0, 1.0, -by_f, -by_s);
    let mut all = carry * found.covariance.fixed_view::<2, 2>(0, 0) * carry.transpose();
    all[(2, 2)] += height_sigma * height_sigma;
    // symmetric to the last bit
    let all = (all + all.transpose()) * (0.5 * shared);
    let parameters = [Parameter::FocalPx, Parameter::PinholeToGrating, Parameter::GratingToReference];
    Some(Covariance {
        parameters: parameters.map(|p| p.name().to_owned()).into(),
        matrix: all.row_iter().map(|row| row.iter().copied().collect()).collect(),
    })
}

fn observation(pair: PixelPair, minus: [f64; 2], plus: [f64; 2]) -> Observation {
    let sigma_px = [minus[0], minus[1], plus[0], plus[1]].map(|s| s.max(LEAST_SIGMA_PX));
    Observation { pair, sigma_px }
}

/// The parameter's field with its unit.
fn unit_name(parameter: Parameter) -> &'static str {
    parameter.name().trim_start_matches("camera.")
}

/// Height at x = y = 0 of the second-order surface through the points, and its standard deviation from
/// their scatter.
fn height_on_axis(points: &[[f64; 3]]) -> Option<(f64, f64)> {
    use nalgebra::{SMatrix, SVector};
    if points.len() < AXIS_POINTS {
        return None;
    }
    let row = |p: &[f64; 3]| {
        let [x, y, _] = *p;
        SVector::<f64, 6>::from([1.0, x, y, x * x, x * y, y * y])
    };
    let mut normal = SMatrix::<f64, 6, 6>::zeros();
    let mut right = SVector::<f64, 6>::zeros();
    for p in points {
        let r = row(p);
        normal += r * r.transpose();
        right += r * p[2];
    }
    let inverse = normal.cholesky()?.inverse();
    let coefficients = inverse * right;
    let squares: f64 = points.iter().map(|p| (p[2] - row(p).dot(&coefficients)).powi(2)).sum();
    let variance = squares / (points.len() - 6) as f64;
    Some((coefficients[0], (variance * inverse[(0, 0)]).sqrt()))
}

/// Derivatives of the height on the axis by F and by s, at the pixels where it is seen.
fn height_by(model: &OpticalModel) -> Option<[f64; 2]> {
    let axis = Vector3::zeros();
    let minus_px = model.project(daic_optics::View::Minus, axis).ok()?;
    let plus_px = model.project(daic_optics::View::Plus, axis).ok()?;
    let jacobian = model.parameter_jacobian(Decoder::Ray, PixelPair { minus_px, plus_px }).ok()?;
    Some([Parameter::FocalPx, Parameter::PinholeToGrating].map(|p| jacobian.by(p)[2]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_height_on_the_axis_of_a_second_order_surface_is_exact() {
        let points: Vec<[f64; 3]> = (0..10)
            .flat_map(|i| (0..10).map(move |j| (f64::from(i) * 0.2 - 0.7, f64::from(j) * 0.2 - 1.1)))
            .map(|(x, y)| [x, y, 0.4 + 0.1 * x - 0.2 * y - 0.01 * x * x + 0.03 * x * y - 0.02 * y * y])
            .collect();
        let (height, sigma) = height_on_axis(&points).expect("enough points");
        assert!((height - 0.4).abs() < 1e-12, "{height}");
        assert!(sigma < 1e-12);
        assert!(height_on_axis(&points[..10]).is_none());
    }
}
