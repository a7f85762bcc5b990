//! The experiment file: rig, optics, processing and sequence in one TOML file.
//!
//! Reading is in two steps, each with file, line and column in its errors: TOML and its types
//! (unknown keys, wrong units), then the rules between values ([`Problem`] names field, value and
//! allowed range). `docs/experiment.md` is the reference for people, [`experiment_schema`] the one
//! for editors.

mod check;
mod lightfield;
mod microscope;
mod optics;
mod problem;
mod processing;
mod rig;
mod sequence;

pub use lightfield::LightField;
pub use microscope::{Microscope, MicroscopeForm};
pub use optics::{
    Brown, Covariance, Grating, MapFile, Maps, Optics, OpticsFile, Reference, Side, Substrate, Volume,
};
pub use problem::{ConfigError, Problem, ProblemKind};
pub use processing::{Criterion, Decoder, Interpolation, Processing, Shape, Solver};
pub use rig::{
    Approach, Axes, Axis, Bayer, BayerChannel, BayerPattern, CameraSection, CameraSource, Rig, Strobe,
};
pub use sequence::{FrameStep, LevelStep, MoveStep, RepeatStep, Role, Step};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A whole experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "daic experiment")]
pub struct Experiment {
    /// Seed of everything random (simulated noise and speckles).
    #[serde(default)]
    pub seed: u64,
    /// Trigger box, stage, camera, LEDs.
    pub rig: Rig,
    /// What the light passes through; this, `microscope` or `lightfield`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub optics: Option<Optics>,
    /// The microscope that the light passes through.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub microscope: Option<Microscope>,
    /// The light-field microscope that the light passes through.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lightfield: Option<LightField>,
    /// How frames become results.
    #[serde(default)]
    pub processing: Processing,
    /// What is played, in order.
    pub sequence: Vec<Step>,
}

/// The commented template that `daic init` writes; it is a valid experiment.
pub fn template() -> &'static str {
    include_str!("template.toml")
}

/// A commented experiment under the microscope, valid as it stands.
pub fn microscope_template() -> &'static str {
    include_str!("microscope.toml")
}

/// A commented experiment under the light-field microscope, valid as it stands.
pub fn lightfield_template() -> &'static str {
    include_str!("lightfield.toml")
}

impl Experiment {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`ConfigError`] with every problem found, each with its place in the text.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::parse(&problem::read(path)?, path)
    }

    /// Reads and checks `text`; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`Experiment::load`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let experiment: Self = problem::from_toml(text, path)?;
        problem::report(text, path, check::experiment(&experiment))?;
        Ok(experiment)
    }
}

impl OpticsFile {
    /// Reads and checks an optics file; a whole experiment file will do too.
    ///
    /// # Errors
    /// [`ConfigError`] with every problem found, each with its place in the text.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::parse(&problem::read(path)?, path)
    }

    /// Reads and checks `text`; `path` is only named in errors.
    ///
    /// # Errors
    /// As [`OpticsFile::load`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        if problem::has_key(text, "rig") {
            let experiment = Experiment::parse(text, path)?;
            let Some(optics) = experiment.optics else {
                return Err(ConfigError::NoOptics { path: path.to_owned() });
            };
            return Ok(Self {
                format: None,
                provenance: None,
                date: None,
                optics,
                covariance: None,
                maps: None,
                volume: None,
            });
        }
        let file: Self = problem::from_toml(text, path)?;
        problem::report(text, path, check::optics_file(&file))?;
        Ok(file)
    }

    /// The file as text; reads back to the same values, bit for bit.
    ///
    /// # Errors
    /// Only if a value cannot be written in TOML, which no value of these types does.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self)
    }
}

/// JSON schema (draft 2020-12) of the experiment file, indented.
pub fn experiment_schema() -> String {
    pretty(&schemars::schema_for!(Experiment))
}

/// JSON schema (draft 2020-12) of the optics file, indented.
pub fn optics_schema() -> String {
    pretty(&schemars::schema_for!(OpticsFile))
}

fn pretty(schema: &schemars::Schema) -> String {
    format!("{:#}\n", schema.as_value())
}
