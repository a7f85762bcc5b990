//! The file of moves.

use super::{MicroscopeFileError, field};
use crate::error::Error;
use crate::measure::points_per_measurement;
use daic_optics::microscope::Form;
use daic_optics::microscope::calibrate::{Motion, Settings};
use daic_rig::experiment::Shape;
use daic_rig::units::{Angle, Length, Pixels};
use serde::{Deserialize, Deserializer};
use std::path::{Path, PathBuf};

/// Known motions of a specimen under the microscope.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Moves {
    /// `daic-moves/1`; left out, the same.
    #[serde(default)]
    pub format: Option<String>,
    /// Where the fields come from, free text; goes into the result.
    #[serde(default)]
    pub provenance: Option<String>,
    /// Date of the measurement, free text; left out, today's.
    #[serde(default)]
    pub date: Option<String>,
    /// Form of the model.
    #[serde(default)]
    pub form: Form,
    /// Standard deviation of an image displacement, for fields that do not state it.
    #[serde(default)]
    pub sigma: Option<Pixels>,
    /// Subsets of the correlation: where they overlap, neighbours share their noise.
    #[serde(default)]
    pub correlation: Option<Correlation>,
    /// Standard deviation of every known component of a translation; left out, they are taken as exact.
    #[serde(default)]
    pub translation_sigma: Option<Length>,
    /// Standard deviation of every component of a rotation; left out, they are taken as exact.
    #[serde(default)]
    pub rotation_sigma: Option<Angle>,
    /// The motions.
    pub motion: Vec<MotionEntry>,
}

/// How the fields were correlated.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Correlation {
    /// Side of a subset.
    pub subset: Pixels,
    /// Distance of points.
    pub step: Pixels,
    /// Shape function; left out, affine.
    #[serde(default = "affine")]
    pub shape: Shape,
}

fn affine() -> Shape {
    Shape::Affine
}

/// One motion.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionEntry {
    /// Its name in messages and reports.
    pub name: String,
    /// CSV file of the field, relative to this file.
    pub field: PathBuf,
    /// Displacement along x, y and towards the camera; `"unknown"` where it is not known. Left out:
    /// unknown if there is a rotation.
    #[serde(default)]
    pub translation: Option<[Component; 3]>,
    /// Rotation about x, y and h, applied in this order.
    #[serde(default)]
    pub rotation: Option<[Angle; 3]>,
    /// Midpoint pixel of the point about which it turns.
    #[serde(default)]
    pub pivot: Option<[Pixels; 2]>,
    /// Height of that point.
    #[serde(default)]
    pub pivot_height: Option<Length>,
    /// Whether it takes part in the fit; if not, it is predicted.
    #[serde(default = "yes")]
    pub fit: bool,
}

fn yes() -> bool {
    true
}

/// A component of a translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Component {
    /// Told.
    Known(Length),
    /// `"unknown"`.
    Unknown,
}

impl<'de> Deserialize<'de> for Component {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        if text.trim() == "unknown" {
            return Ok(Self::Unknown);
        }
        text.parse()
            .map(Self::Known)
            .map_err(|e: daic_rig::units::UnitError| serde::de::Error::custom(format!("{e}, or \"unknown\"")))
    }
}

impl Moves {
    /// The only format there is.
    pub const FORMAT: &'static str = "daic-moves/1";

    /// Reads and checks a file.
    ///
    /// # Errors
    /// The file, the line and what is wrong.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let text =
            std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        let moves: Self = toml::from_str(&text).map_err(|e| super::file::toml_error(path, &text, &e))?;
        let wrong = |reason: String| MicroscopeFileError { path: path.to_owned(), line: None, reason };
        if let Some(format) = moves.format.as_ref().filter(|f| *f != Self::FORMAT) {
            return Err(wrong(format!("format is \"{format}\", allowed is \"{}\"", Self::FORMAT)).into());
        }
        if let Some(sigma) = moves.sigma.filter(|s| s.px().is_nan() || s.px() <= 0.0) {
            return Err(wrong(format!("sigma is {sigma}, it must be above 0 px")).into());
        }
        if let Some(c) = moves.correlation.filter(|c| !(c.subset.px() > 0.0 && c.step.px() > 0.0)) {
            let (subset, step) = (c.subset, c.step);
            return Err(wrong(format!(
                "correlation.subset is {subset} and step {step}, both must be above 0 px"
            ))
            .into());
        }
        let sigmas = [
            ("translation_sigma", moves.translation_sigma.map(Length::mm)),
            ("rotation_sigma", moves.rotation_sigma.map(Angle::rad)),
        ];
        for (name, sigma) in sigmas {
            if let Some(sigma) = sigma.filter(|s| !(s.is_finite() && *s >= 0.0)) {
                return Err(wrong(format!("{name} is {sigma}, it must not be below 0")).into());
            }
        }
        for (i, m) in moves.motion.iter().enumerate() {
            if m.translation.is_none() && m.rotation.is_none() {
                return Err(wrong(format!(
                    "motion[{i}] ({}) has neither translation nor rotation; give translation = [\"0 um\", \"0 um\", \"10 um\"]",
                    m.name
                ))
                .into());
            }
        }
        Ok(moves)
    }

    pub(super) fn settings(&self) -> Settings {
        let shared = self.correlation.map_or(1.0, |c| {
            let shape = match c.shape {
                Shape::Translation => daic_correlate::Shape::Translation,
                Shape::Affine => daic_correlate::Shape::Affine,
                Shape::Quadratic => daic_correlate::Shape::Quadratic,
            };
            points_per_measurement(c.subset.px() / c.step.px(), shape)
        });
        Settings { form: self.form, shared, ..Settings::default() }
    }

    pub(super) fn motions(&self, path: &Path) -> Result<Vec<Motion>, Error> {
        let folder = path.parent().unwrap_or(Path::new(""));
        self.motion
            .iter()
            .map(|m| {
                let points = field::read(&folder.join(&m.field), self.sigma.map(Pixels::px))?;
                let translation_mm = match m.translation {
                    None => [None; 3],
                    Some(t) => t.map(|c| match c {
                        Component::Known(length) => Some(length.mm()),
                        Component::Unknown => None,
                    }),
                };
                Ok(Motion {
                    name: m.name.clone(),
                    translation_mm,
                    rotation_rad: m.rotation.map_or([0.0; 3], |r| r.map(Angle::rad)),
                    pivot_px: m.pivot.map_or([0.0; 2], |p| p.map(Pixels::px)),
                    pivot_height_mm: m.pivot_height.map_or(0.0, Length::mm),
                    points,
                    fit: m.fit,
                })
            })
            .collect()
    }
}
