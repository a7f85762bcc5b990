//! The microscope: two objectives relay the specimen to a real image, a grating behind it splits it
//! into two first-order virtual images, a third objective puts both on the sensor.
//!
//! * [`Microscope`]: the linear model with β₁…β₄ and the centre of perspective, as calibrated from
//!   known motions ([`calibrate`](calibrate::calibrate)).
//! * [`RayMicroscope`]: exact rays through a stated geometry.
//!
//! Both implement [`PairModel`](crate::PairModel). Lengths are millimetres, as everywhere in this
//! crate; x and y in the model's formulas are the midpoint of the two pixels of one material point.

pub mod calibrate;
mod determined;
mod linear;
mod rays;

pub use determined::{Candidate, Quantity};
pub use linear::{Form, Microscope, MicroscopeError, Parameters};
pub use rays::{Geometry, Objective, RayMicroscope, Relay};
