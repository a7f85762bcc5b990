//! Figures and self-contained HTML reports.
//!
//! Figures are plain numbers in and [`Markup`] out: SVG (maps and photographs as PNG inside it) or,
//! for the surface that can be turned, HTML with a small script. A [`Report`] puts them on one page
//! that needs no other file and makes no request. Lines and text take the colour of the page, so
//! that a figure is readable on light and on dark ground and in print.
//!
//! Every text from outside is escaped here; [`Markup`] can only be made by this crate.

pub mod axis;
pub mod colour;
mod error;
pub mod heatmap;
pub mod html;
pub mod line;
pub mod number;
pub mod overlay;
pub mod scene3d;
pub mod stack;
mod svg;
pub mod timeline;

pub use colour::{ColourMap, ColourScale, Limits};
pub use error::ReportError;
pub use heatmap::{GridAxes, Heatmap};
pub use html::{Cell, Figure, Report, Section, TableBlock, Verdict};
pub use line::{Chart, Series, SeriesStyle};
pub use number::{plain, with_uncertainty};
pub use overlay::{Mark, Overlay};
pub use scene3d::HeightSurface;
pub use stack::ImageStack;
pub use svg::{Markup, escape};
pub use timeline::{AnalogTrace, DigitalLine, Timeline};
