//! Chapter 3: the microscope. Rigid motions and a steel ball, simulated and measured.

mod field;
mod focus;
mod page;
mod profile;
mod rigid;
mod scene;

pub use page::{RIGID, THESIS, part};
pub use profile::{Ball, Ring};
pub use rigid::{MotionErrors, Way};

use super::{Extent, ReproduceError};
use daic_correlate::Shape;
use daic_optics::microscope::{Form, Parameters};

/// Seed of particles and noise.
pub const SEED: u64 = 3;
/// Shape functions side by side.
pub const SHAPES: [Shape; 2] = [Shape::Affine, Shape::Quadratic];

/// Everything that chapter 3 gives.
#[derive(Debug)]
pub struct Results {
    /// Distance of points, px.
    pub step: usize,
    /// Half of the field, mm.
    pub half_mm: [f64; 2],
    /// Errors of the rigid motions of Table 1.
    pub motions: Vec<MotionErrors>,
    /// The ball, with affine and with quadratic shape functions.
    pub balls: Vec<Ball>,
    /// What the calibration found, and what the geometry has.
    pub parameters: [Parameters; 2],
    /// Size of a pixel along y in that along x, as found and as the geometry has it.
    pub aspect: [f64; 2],
    /// Its σ.
    pub sigma: [f64; 6],
    /// Its RMS residual, px.
    pub residual_px: f64,
    /// Points of the calibration left out as outliers.
    pub rejected: usize,
    /// Its χ² over degrees of freedom.
    pub chi_square: f64,
    /// The moves that the calibration saw.
    pub moves: Vec<&'static str>,
    /// Data of the figures.
    figures: page::Drawn,
}

/// Runs chapter 3.
///
/// # Errors
/// What the correlation, the calibration or a ray refuses.
pub fn run(extent: Extent) -> Result<Results, ReproduceError> {
    let half_mm = match extent {
        Extent::Full => scene::FIELD_MM.map(|f| 0.5 * f),
        Extent::Quick => [0.07; 2],
    };
    let plate = rigid::Plate::new(half_mm, extent.step())?;
    let mut motions = Vec::new();
    let mut balls = Vec::new();
    let mut found = None;
    let mut drawn = page::Drawn::default();
    let ball = profile::Specimen::new(half_mm, extent.step())?;
    for shape in SHAPES {
        let measured = plate.measure(shape)?;
        let calibrated = [Form::Linear, Form::Perspective].map(|form| measured.calibrate(form));
        let [linear, perspective] = calibrated;
        let (linear, perspective) = (linear?, perspective?);
        motions.extend(measured.errors(&linear, &perspective)?);
        balls.push(ball.measure(shape, &measured, &linear, &perspective)?);
        if shape == Shape::Quadratic {
            drawn = measured.drawn(&perspective)?;
            found = Some((perspective, measured.moves(), measured.aspect));
        }
    }
    let (calibration, moves, aspect) = found.ok_or(ReproduceError::Open)?;
    drawn.views = vec![plate.picture(), ball.picture()];
    let mut parameters = calibration.parameters.ok_or(ReproduceError::Open)?;
    parameters.centre_px[1] /= aspect;
    let covariance = calibration.covariance.ok_or(ReproduceError::Open)?;
    let mut sigma = std::array::from_fn(|i| covariance[(i, i)].sqrt());
    sigma[5] /= aspect;
    Ok(Results {
        step: extent.step(),
        half_mm,
        motions,
        balls,
        parameters: [parameters, plate.truth()?],
        aspect: [aspect, plate.true_aspect()?],
        sigma,
        rejected: calibration.rejected.len(),
        chi_square: calibration.chi_square_reduced,
        residual_px: calibration.rms_px,
        moves,
        figures: drawn,
    })
}
