//! The grid method: phases of line and cross gratings by localised spectrum analysis, and
//! displacements from them.
//!
//! * [`find_carriers`]: pitch, angle and noise from the spectrum.
//! * [`phase_maps`]: unwrapped phase, amplitude, quality and uncertainty at every pixel.
//! * [`PhasePair`]: Lagrangian displacement between two images, at pixels or points.
//! * [`PhaseMaps::grid_coordinates`], [`PhaseMaps::crossings`]: what a distortion calibration takes.

mod carrier;
mod crossings;
mod demodulate;
mod displacement;
mod interpolate;
mod map;
mod polynomial;
mod settings;
mod track;
mod unwrap;
mod window;

pub use carrier::{Carrier, Spectrum, find_carriers};
pub use crossings::{Crossing, GridCoordinates};
pub use displacement::{PhaseField, PhasePair};
pub use map::{PhaseMap, PhaseMaps, phase_maps};
pub use settings::{Gratings, PhaseError, PhaseSettings, WindowKind};
pub use unwrap::{Unwrapped, unwrap};
pub use window::Window;
