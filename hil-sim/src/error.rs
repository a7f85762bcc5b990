//! What can go wrong in the simulated rig.

use std::path::PathBuf;

/// A configuration that cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// Not TOML, an unknown key or a value of the wrong type; the message shows line and key.
    #[error("the scene file cannot be used: {0}")]
    Syntax(Box<toml::de::Error>),
    /// The configuration cannot be written as TOML.
    #[error("the configuration cannot be written as TOML: {0}")]
    Unwritable(Box<toml::ser::Error>),
    /// A value outside its range.
    #[error("{key} = {value} is outside {min} … {max}")]
    OutOfRange {
        /// Which value.
        key: &'static str,
        /// What it was.
        value: f64,
        /// Smallest allowed.
        min: f64,
        /// Largest allowed.
        max: f64,
    },
    /// First order would not leave the grating.
    #[error(
        "the grating pitch of {pitch_mm} mm is not above the wavelength of {wavelength_mm} mm: there is no first order"
    )]
    PitchBelowWavelength {
        /// Pitch.
        pitch_mm: f64,
        /// Wavelength.
        wavelength_mm: f64,
    },
    /// A number of the microscope is not allowed.
    #[error("scene.microscope: {0}")]
    Microscope(#[from] daic_optics::microscope::MicroscopeError),
    /// The light-field microscope cannot be.
    #[error("scene.lightfield: {0}")]
    LightField(#[from] daic_lightfield::PsfError),
    /// The light-field microscope's sensor cannot be.
    #[error("scene.lightfield: {0}")]
    LightFieldSensor(#[from] daic_lightfield::OperatorError),
    /// The height map cannot be read.
    #[error("the height map {} cannot be read: {cause}", path.display())]
    HeightMap {
        /// Which file.
        path: PathBuf,
        /// Why.
        cause: image::ImageError,
    },
    /// The height map has fewer than 4 × 4 pixels.
    #[error("the height map {} has {width} × {height} pixels; it needs at least 4 × 4", path.display())]
    HeightMapTooSmall {
        /// Which file.
        path: PathBuf,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
}

/// The simulated rig cannot start.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The configuration is refused.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The box cannot be offered on a PTY.
    #[error("no pseudo-terminal: {cause}")]
    Pty {
        /// Why.
        cause: std::io::Error,
    },
    /// The link to the PTY cannot be made.
    #[error("the link {} to the pseudo-terminal cannot be made: {cause}", path.display())]
    PtyLink {
        /// Where it should be.
        path: PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// The TCP address cannot be listened on.
    #[error("cannot listen on {address}: {cause}")]
    Tcp {
        /// The address.
        address: String,
        /// Why.
        cause: std::io::Error,
    },
    /// A thread cannot be started.
    #[error("a thread of the simulated rig cannot be started: {cause}")]
    Thread {
        /// Why.
        cause: std::io::Error,
    },
}
