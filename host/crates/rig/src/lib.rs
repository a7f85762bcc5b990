//! Everything between the program and a rig: link, clock, experiment file, cameras, acquisition.
//!
//! * [`units`]: quantities as they are written in files ("633 nm", "20 ms").
//! * [`experiment`]: the experiment file, its checks, its JSON schema, its template.
//! * [`compile`]: a sequence becomes a program for the box and a plan of the frames to expect.
//! * [`link`]: requests and replies over a serial port, TCP or an in-process stream.
//! * [`clock`]: device ticks as host times, each with an error bound.
//! * [`camera`]: what a camera must do; a replay camera.
//! * [`pairing`]: which trigger and which strobe belong to which frame.
//! * [`acquire`]: one run, from loading to paired frames.
//!
//! Nothing here knows of files of frames, of optics or of the program's flags.

pub mod acquire;
pub mod camera;
pub mod clock;
pub mod compile;
pub mod experiment;
pub mod link;
pub mod pairing;
pub mod units;

mod error;
pub use error::RigError;
