//! Calibration from moves whose frames have just been tracked.

use super::{Calibrated, Instrument, MicroscopeFile, Reach, field, page, run};
use crate::error::Error;
use crate::measure::{Match, Tracks};
use daic_dataset::atomic;
use daic_optics::microscope::calibrate::{FieldPoint, Motion, Settings, calibrate};
use daic_optics::microscope::{Form, Microscope, MicroscopeError, Parameters};
use daic_rig::experiment::Shape;
use nalgebra::SMatrix;
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::Path;

/// Passes in which heights and β₁ follow each other: each takes the rest down by the height over the working distance.
const PASSES: usize = 3;

/// A known translation of the specimen and where it took the points of the reference.
#[derive(Debug, Clone)]
pub struct KnownMove {
    /// Its name.
    pub name: String,
    /// Displacement (x, y, h) from the reference frame, millimetres.
    pub translation_mm: [f64; 3],
    /// The reference's points in this frame.
    pub tracks: Tracks,
}

/// How to calibrate from moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MoveSettings {
    /// Form of the model.
    pub form: Form,
    /// Size of a pixel on the specimen to start from, millimetres.
    pub pixel_mm: f64,
    /// Side of a subset, pixels.
    pub subset_px: f64,
    /// Distance of points, pixels.
    pub step_px: f64,
    /// Shape function of the subsets.
    pub shape: Shape,
}

/// A calibrated microscope as plain numbers, with the datum of heights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibratedModel {
    /// Form.
    pub form: Form,
    /// The six parameters.
    pub parameters: Parameters,
    /// Disparity (x₊ − x₋, y₊ − y₋) where the height is 0, pixels.
    pub reference_disparity_px: [f64; 2],
    /// Covariance of the parameters in the order of [`Parameters::to_array`]; lengths in millimetres.
    pub covariance: [[f64; 6]; 6],
    /// What the calibration's points filled.
    pub reach: Option<Reach>,
}

impl CalibratedModel {
    /// Ready to decode.
    ///
    /// # Errors
    /// The first parameter that no microscope has.
    pub fn instrument(&self) -> Result<Instrument, MicroscopeError> {
        let covariance = SMatrix::from_fn(|i, j| self.covariance[i][j]);
        Ok(Instrument { model: self.model()?, covariance, reach: self.reach })
    }

    /// The model.
    ///
    /// # Errors
    /// The first parameter that no microscope has.
    pub fn model(&self) -> Result<Microscope, MicroscopeError> {
        Microscope::new(self.parameters, self.form, self.reference_disparity_px)
    }
}

/// Mean disparity (x₊ − x₋, y₊ − y₋) of the matched points, pixels: where heights count from.
pub fn mean_disparity(matches: &[Match]) -> [f64; 2] {
    let ok = || matches.iter().filter(|m| m.status.is_ok());
    let count = ok().count() as f64;
    [0, 1].map(|i| ok().map(|m| m.pair.plus_px[i] - m.pair.minus_px[i]).sum::<f64>() / count)
}

/// Half of how far a pair lies apart in x less than the datum: δ − δ₀.
fn half_approach(matched: &Match, disparity_px: [f64; 2]) -> f64 {
    -0.5 * (matched.pair.plus_px[0] - matched.pair.minus_px[0] - disparity_px[0])
}

/// Writes `moves.toml`, a CSV file per move, `microscope.toml` and `report.html` into `folder` and calibrates from
/// them, with the heights of the reference surface from the matches themselves.
///
/// # Errors
/// If a file cannot be written, the calibration fails, or the moves leave something open.
pub fn from_moves(
    folder: &Path,
    matches: &[Match],
    moves: &[KnownMove],
    settings: &MoveSettings,
) -> Result<(CalibratedModel, Calibrated), Error> {
    std::fs::create_dir_all(folder).map_err(|source| Error::Folder { path: folder.to_owned(), source })?;
    let disparity_px = mean_disparity(matches);
    let fit = Settings { form: settings.form, start_pixel_mm: settings.pixel_mm, ..Settings::default() };
    let mut beta1 = 0.0;
    for _ in 0..PASSES {
        let motions: Vec<Motion> = moves
            .iter()
            .map(|m| {
                let points = matches.iter().zip(&m.tracks.points).filter(|(_, t)| t.status.is_ok());
                let points = points
                    .map(|(p, t)| FieldPoint {
                        middle_px: [0, 1].map(|i| 0.5 * (p.pair.minus_px[i] + p.pair.plus_px[i])),
                        height_mm: beta1 * half_approach(p, disparity_px),
                        moved_px: field::moved(p, t),
                        sigma_px: field::sigmas(t),
                    })
                    .collect();
                Motion::translation(&m.name, m.translation_mm, points)
            })
            .collect();
        let found = calibrate(&motions, &fit)?;
        let Some(parameters) = found.parameters else {
            return Err(Error::MovesOpen {
                open: found.undetermined.iter().map(|q| q.name()).collect(),
                add: found.add.iter().map(|c| c.advice()).collect(),
            });
        };
        beta1 = parameters.beta1_mm_per_px;
    }

    let mut text = format!(
        "format = \"daic-moves/1\"\nprovenance = \"the rig's own moves\"\nform = \"{}\"\ncorrelation = {{ subset = \"{} px\", step = \"{} px\", shape = \"{}\" }}\n",
        settings.form.name(),
        settings.subset_px,
        settings.step_px,
        match settings.shape {
            Shape::Translation => "translation",
            Shape::Affine => "affine",
            Shape::Quadratic => "quadratic",
        }
    );
    for m in moves {
        let file = format!("{}.csv", m.name);
        let height_um = |p: &Match| 1e3 * beta1 * half_approach(p, disparity_px);
        field::table(matches, &m.tracks, Some(&height_um))?.write_csv(&folder.join(&file))?;
        let [x, y, h] = m.translation_mm.map(|mm| mm * 1e3);
        let name = &m.name;
        write!(
            text,
            "\n[[motion]]\nname = \"{name}\"\nfield = \"{file}\"\ntranslation = [\"{x} um\", \"{y} um\", \"{h} um\"]\n"
        )
        .ok();
    }
    let path = folder.join("moves.toml");
    atomic::write_bytes(&path, text.as_bytes())?;
    let done = run(&path)?;
    atomic::write_bytes(&folder.join("report.html"), page(&done, "moves.toml")?.as_bytes())?;
    let Some(file) = &done.file else {
        let s = &done.summary;
        return Err(Error::MovesOpen { open: s.undetermined.clone(), add: s.add.clone() });
    };
    file.write(&folder.join("microscope.toml"))?;
    Ok((calibrated_model(file, disparity_px)?, done))
}

fn calibrated_model(
    file: &MicroscopeFile,
    reference_disparity_px: [f64; 2],
) -> Result<CalibratedModel, MicroscopeError> {
    let model = file.model(reference_disparity_px)?;
    let covariance = file.instrument(reference_disparity_px)?.covariance;
    Ok(CalibratedModel {
        form: model.form(),
        parameters: *model.parameters(),
        reference_disparity_px,
        covariance: std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i, j)])),
        reach: file.reach,
    })
}
