//! Calibration of the microscope from files: what `daic calibrate microscope` does.
//!
//! A file of moves ([`Moves`]) names for each known motion a CSV file with the image displacements of
//! its points; the result is a [`MicroscopeFile`].

mod decode;
mod field;
mod file;
mod known;
mod moves;
mod report;
mod track;

use crate::error::Error;
use daic_optics::microscope::calibrate::{
    Calibration, Motion, MotionResult, Settings, calibrate, leave_one_out,
};
use daic_optics::microscope::{Candidate, Form, Quantity};
use serde::Serialize;
use std::path::Path;

pub use decode::{Instrument, displacement, profile};
pub use file::{Fit, FittedMotion, MicroscopeFile, MicroscopeSection, Reach};
pub use known::{CalibratedModel, KnownMove, MoveSettings, from_moves, mean_disparity};
pub use moves::{Component, Correlation, MotionEntry, Moves};
pub use report::page;
pub use track::{TrackOptions, Tracked, track};

/// What is wrong with a file of moves, of fields or of a microscope.
#[derive(Debug, thiserror::Error)]
#[error("{}{}: {reason}", path.display(), line.map(|l| format!(", line {l}")).unwrap_or_default())]
pub struct MicroscopeFileError {
    /// The file.
    pub path: std::path::PathBuf,
    /// Line from 1, if one is to blame.
    pub line: Option<usize>,
    /// What is wrong, and what is allowed.
    pub reason: String,
}

/// A determined quantity in the units of files.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Value {
    /// Its name.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// µm/px, 1/px, px, 1/mm or 1.
    pub unit: &'static str,
}

/// How a motion came out, in micrometres and pixels.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MotionSummary {
    /// Its name.
    pub name: String,
    /// Whether it took part in the fit.
    pub fitted: bool,
    /// Points used.
    pub points: usize,
    /// RMS of the residuals of (u₋, v₋, u₊, v₊), px.
    pub rms_px: [f64; 4],
    /// RMS of decoded minus imposed displacement (u, v, w), µm; `null` while it is undetermined.
    pub rms_um: [Option<f64>; 3],
    /// The same with this motion left out of the fit: a prediction.
    pub predicted_rms_um: Option<[Option<f64>; 3]>,
    /// Translation of the pivot, µm, as told or found.
    pub translation_um: [Option<f64>; 3],
}

/// What came out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Form of the model.
    pub form: &'static str,
    /// Whether all parameters are determined.
    pub complete: bool,
    /// What is determined.
    pub values: Vec<Value>,
    /// What is not.
    pub undetermined: Vec<&'static str>,
    /// Motions that would determine it.
    pub add: Vec<&'static str>,
    /// Along x and y, whether the image does not spread with height within its noise.
    pub telecentric: [bool; 2],
    /// RMS of all residuals, px.
    pub rms_px: f64,
    /// χ² over degrees of freedom.
    pub chi_square_reduced: f64,
    /// The same of the other form.
    pub other_form_chi_square_reduced: Option<f64>,
    /// Points left out as outliers.
    pub rejected: usize,
    /// Motions.
    pub motions: Vec<MotionSummary>,
    /// What to look at.
    pub notes: Vec<String>,
}

/// A calibration with everything that is written.
#[derive(Debug, Clone)]
pub struct Calibrated {
    /// For people and programs.
    pub summary: Summary,
    /// The file, if all parameters are determined.
    pub file: Option<MicroscopeFile>,
    motions: Vec<Motion>,
    calibration: Calibration,
}

fn number(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

fn value(e: &daic_optics::microscope::calibrate::Estimate) -> Value {
    let (factor, unit) = match e.quantity {
        Quantity::Beta1 | Quantity::Beta2 => (1e3, "µm/px"),
        other => (1.0, other.unit()),
    };
    Value { name: e.quantity.name(), value: e.value * factor, sigma: e.sigma * factor, unit }
}

fn motion(m: &MotionResult, predicted: Option<&MotionResult>) -> MotionSummary {
    let um = |v: [f64; 3]| v.map(|v| number(v * 1e3));
    MotionSummary {
        name: m.name.clone(),
        fitted: m.fitted,
        points: m.points,
        rms_px: m.rms_px,
        rms_um: um(m.rms_mm),
        predicted_rms_um: predicted.map(|p| um(p.rms_mm)),
        translation_um: um(m.translation_mm),
    }
}

/// Adds what the uncertainty of the moves themselves does to the estimates: each known component of each fitted motion is
/// changed by its σ in turn, and the calibration repeated.
fn add_stage(
    calibration: &mut Calibration,
    motions: &[Motion],
    settings: &Settings,
    moves: &Moves,
) -> Result<(), Error> {
    let [translation, rotation] = [
        moves.translation_sigma.map_or(0.0, daic_rig::units::Length::mm),
        moves.rotation_sigma.map_or(0.0, daic_rig::units::Angle::rad),
    ];
    let turned = |m: &Motion| m.rotation_rad.iter().any(|r| *r != 0.0);
    let mut changed = motions.to_vec();
    let mut changes = Vec::new();
    for (k, motion) in motions.iter().enumerate().filter(|(_, m)| m.fit) {
        for axis in 0..3 {
            if let (Some(at), true) = (motion.translation_mm[axis], translation > 0.0) {
                changed[k].translation_mm[axis] = Some(at + translation);
                changes.push(calibrate(&changed, settings)?);
                changed[k].translation_mm[axis] = Some(at);
            }
            if rotation > 0.0 && turned(motion) {
                changed[k].rotation_rad[axis] += rotation;
                changes.push(calibrate(&changed, settings)?);
                changed[k].rotation_rad[axis] = motion.rotation_rad[axis];
            }
        }
    }
    let before = calibration.clone();
    for other in &changes {
        for e in &mut calibration.estimates {
            let by =
                other.estimate(e.quantity).zip(before.estimate(e.quantity)).map(|(o, b)| o.value - b.value);
            e.sigma = e.sigma.hypot(by.unwrap_or(0.0));
        }
        if let (Some(covariance), Some(p), Some(q)) =
            (&mut calibration.covariance, before.parameters, other.parameters)
        {
            let by = nalgebra::SVector::from(q.to_array()) - nalgebra::SVector::from(p.to_array());
            *covariance += by * by.transpose();
        }
    }
    Ok(())
}

/// Calibrates from a file of moves and the fields it names.
///
/// # Errors
/// What is wrong with a file, or the calibration. That parameters stay open is no error.
pub fn run(path: &Path) -> Result<Calibrated, Error> {
    let moves = Moves::load(path)?;
    let motions = moves.motions(path)?;
    let settings = moves.settings();
    let mut calibration = calibrate(&motions, &settings)?;
    add_stage(&mut calibration, &motions, &settings, &moves)?;
    let predicted = leave_one_out(&motions, &settings);
    let form = match settings.form {
        Form::Linear => Form::Perspective,
        Form::Perspective => Form::Linear,
    };
    // a form that does not converge on these data is no better one
    let other = calibrate(&motions, &Settings { form, ..settings.clone() }).ok();
    let other_chi = other.map(|c| c.chi_square_reduced);
    let mut notes = Vec::new();
    if let Some(chi) = other_chi.filter(|chi| *chi < 0.9 * calibration.chi_square_reduced) {
        notes.push(format!(
            "the form \"{}\" fits better (reduced χ² {chi:.3} against {:.3}): set form = \"{}\"",
            form.name(),
            calibration.chi_square_reduced,
            form.name()
        ));
    }
    for (telecentric, axis) in calibration.telecentric.into_iter().zip(["x", "y"]) {
        if telecentric && calibration.undetermined.is_empty() {
            notes.push(format!(
                "along {axis} the image does not spread with height within three σ: the centre has no effect there"
            ));
        }
    }
    let summary = Summary {
        form: calibration.form.name(),
        complete: calibration.undetermined.is_empty(),
        values: calibration.estimates.iter().map(value).collect(),
        undetermined: calibration.undetermined.iter().map(|q| q.name()).collect(),
        add: calibration.add.iter().map(|c: &Candidate| c.advice()).collect(),
        telecentric: calibration.telecentric,
        rms_px: calibration.rms_px,
        chi_square_reduced: calibration.chi_square_reduced,
        other_form_chi_square_reduced: other_chi,
        rejected: calibration.rejected.len(),
        motions: calibration.motions.iter().zip(&predicted).map(|(m, p)| motion(m, p.as_ref())).collect(),
        notes,
    };
    let file = MicroscopeFile::of(&calibration, &moves, &motions, path);
    Ok(Calibrated { summary, file, motions, calibration })
}
