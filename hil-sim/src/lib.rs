//! A simulated rig: the daic firmware on virtual pins and a virtual clock, in front of a simulated
//! stage, LEDs, grating, specimen and camera.
//!
//! Everything follows from the edges that the real controller puts out. The stage stands where the
//! step pulses put it, an LED shines only while its line is up, the camera integrates what light
//! there is between its trigger and the end of its exposure. Frames are traced ray by ray through
//! the grating equation onto an analytic specimen.
//!
//! * [`config`]: everything that can be set, as TOML.
//! * [`scene`]: texture, surface, tracing, rendering.
//! * [`world`]: stage, lamps and camera, driven by edges.
//! * [`sensor`], [`frame`]: from light to counts.
//! * [`board`]: the controller on a virtual clock; [`record`]: what it put out.
//! * [`transport`], [`rig`]: how a host reaches it, and the whole in one.
#![cfg_attr(not(test), warn(clippy::unwrap_used))]

pub mod board;
pub mod config;
pub mod error;
pub mod frame;
pub mod hash;
pub mod record;
pub mod rig;
pub mod scene;
pub mod sensor;
mod slots;
pub mod transport;
pub mod world;

pub use config::SimConfig;
pub use error::{ConfigError, SimError};
pub use frame::{FrameTruth, SimFrame};
pub use rig::SimRig;
pub use transport::{DuplexEnd, Transport};
