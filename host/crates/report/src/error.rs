//! Why a figure or a page could not be made.

use thiserror::Error;

/// Why a figure or a page could not be made.
#[derive(Debug, Error)]
pub enum ReportError {
    /// Number of values and size differ, or there is no value.
    #[error("figure `{figure}` has {values} values for {width} x {height} points")]
    Shape {
        /// Title of the figure.
        figure: String,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Number of values.
        values: usize,
    },
    /// A figure without anything to draw.
    #[error("figure `{figure}` has no finite value to draw")]
    Empty {
        /// Title of the figure.
        figure: String,
    },
    /// Grid axes that do not advance, or are not finite.
    #[error("figure `{figure}`: axes need finite origins and steps other than zero")]
    Axes {
        /// Title of the figure.
        figure: String,
    },
    /// A picture could not be encoded.
    #[error("cannot encode the picture of figure `{figure}`: {reason}")]
    Picture {
        /// Title of the figure.
        figure: String,
        /// What the encoder said.
        reason: String,
    },
    /// The page could not be put together.
    #[error("cannot fill the page: {source}")]
    Page {
        /// What the template engine said.
        #[from]
        source: askama::Error,
    },
}
