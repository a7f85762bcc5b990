//! Calibration of the microscope by the moves of a dataset.

use super::{Run, read_json, write_json};
use crate::error::Error;
use crate::microscope::{self, CalibratedModel, KnownMove};
use crate::process::summary::{CalibratedParameter, CalibrationSummary};
use daic_dataset::FrameRecord;
use daic_optics::microscope::Form;
use daic_rig::experiment::MicroscopeForm;
use serde::{Deserialize, Serialize};

/// What `results/calibration.json` holds.
#[derive(Serialize, Deserialize)]
struct Stored {
    key: String,
    summary: CalibrationSummary,
    model: CalibratedModel,
}

impl Run<'_> {
    /// β, the centre and the datum of heights, from the moves between the reference and the calibration frames.
    ///
    /// The fields and the file of moves go to `results/calibration`, where `daic calibrate microscope` takes them
    /// as they are.
    pub(super) fn calibrated_microscope(
        &mut self,
        paired: &[&FrameRecord],
    ) -> Result<(CalibratedModel, CalibrationSummary), Error> {
        let section = self.experiment.microscope.as_ref().ok_or(Error::NoMoves)?;
        let frames = self.calibration_frames(paired);
        if frames.is_empty() || !self.experiment.processing.calibrate {
            return Err(Error::NoMoves);
        }
        let mut inputs = vec![self.reference_record];
        inputs.extend(frames.iter().map(|f| f.0));
        let key = self.key(section, &inputs)?;
        let path = self.dataset.results().join("calibration.json");
        if !self.fresh
            && let Some(stored) = read_json::<Stored>(&path)
            && stored.key == key
        {
            self.resumed += 1;
            return Ok((stored.model, stored.summary));
        }
        let moves: Vec<KnownMove> = self
            .followed(&frames)?
            .into_iter()
            .map(|(record, translation_mm, tracks)| KnownMove {
                name: record.name.clone(),
                translation_mm,
                tracks,
            })
            .collect();
        self.progress.stage("calibrating", 0);
        let settings = microscope::MoveSettings {
            form: match section.form {
                MicroscopeForm::Linear => Form::Linear,
                MicroscopeForm::Perspective => Form::Perspective,
            },
            pixel_mm: section.pixel.mm(),
            subset_px: self.settings.dic.subset as f64,
            step_px: self.settings.step as f64,
            shape: self.experiment.processing.shape,
        };
        let folder = self.dataset.results().join("calibration");
        let matches = &self.reference()?.matches;
        let (model, done) = microscope::from_moves(&folder, matches, &moves, &settings)?;
        let s = &done.summary;
        let summary = CalibrationSummary {
            parameters: s
                .values
                .iter()
                .map(|v| CalibratedParameter {
                    name: format!("{} / {}", v.name, v.unit),
                    start: None,
                    value: v.value,
                    sigma: v.sigma,
                })
                .collect(),
            rms_px: s.rms_px,
            chi_square_reduced: s.chi_square_reduced,
            points: matches.iter().filter(|m| m.status.is_ok()).count(),
            observations: s.motions.iter().map(|m| m.points).sum(),
            rejected: s.rejected,
        };
        write_json(&path, &Stored { key, summary: summary.clone(), model: model.clone() })?;
        Ok((model, summary))
    }
}
