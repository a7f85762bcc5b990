//! Strain from a displacement field on a regular grid.
//!
//! Around every point a polynomial is fitted to the displacements by least squares; its slope at the
//! point is the displacement gradient, from which the strain tensors follow.
//!
//! * [`Method::Vsg`]: a plane or a quadratic over a square window, cut at the edge of the field and
//!   around points without a result (the *virtual strain gauge*).
//! * [`Method::SavitzkyGolay`]: a polynomial of order 1 to 4 over whole windows only; at the edge of the
//!   field the window is moved inwards and the slope taken off its middle.
//!
//! The length over which a value is an average is the side of the virtual strain gauge,
//! L = (window − 1) · step + subset, in pixels ([`Settings::gauge`]; iDICs, *A Good Practices Guide for
//! Digital Image Correlation*, 2018, § 5.4.2).
//!
//! Conventions: x to the right, y down; gradients of the Lagrangian displacement, F = I + ∂u/∂X;
//! e_xy is the component of the tensor, half of the engineering shear angle γ; angles are counted from
//! x towards y, on the screen clockwise.

mod error_correlation;
mod field;
mod fit;
mod gram;
mod probe;
mod scattered;
mod tensor;

pub use field::Field;
pub use fit::{Gradient, Gradients, gradients};
pub use probe::{Elongation, Extensometer, Probe, ProbeStatus, Profile, line, point};
pub use tensor::{Strain, Tensor};

use serde::{Deserialize, Serialize};
use std::fmt;
use thiserror::Error;

/// Polynomial of the virtual strain gauge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Order {
    /// 1, x, y.
    #[default]
    Plane,
    /// 1, x, y, x², xy, y².
    Quadratic,
}

/// How displacements become gradients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Local fit to the points that are there.
    Vsg(Order),
    /// Local fit of total degree 1 to 4 to whole windows.
    SavitzkyGolay(u8),
}

impl Method {
    /// Total degree of the polynomial.
    pub fn degree(self) -> usize {
        match self {
            Method::Vsg(Order::Plane) => 1,
            Method::Vsg(Order::Quadratic) => 2,
            Method::SavitzkyGolay(order) => usize::from(order),
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Method::Vsg(Order::Plane) => f.write_str("VSG, plane"),
            Method::Vsg(Order::Quadratic) => f.write_str("VSG, quadratic"),
            Method::SavitzkyGolay(order) => write!(f, "Savitzky–Golay, order {order}"),
        }
    }
}

/// Settings of a strain computation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Side of the window in points of the grid, odd.
    pub window: usize,
    /// Kind of fit.
    pub method: Method,
    /// Part of a whole window's points, 0…1, that a [`Method::Vsg`] fit must find.
    pub min_fraction: f64,
    /// Difference of displacement between adjacent grid points, pixels, from which on the material
    /// between them counts as parted: the fit at a point uses only points that are linked to it
    /// within the window. `None`: only points without a result part the material.
    pub max_jump: Option<f64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self { window: 15, method: Method::Vsg(Order::Plane), min_fraction: 0.5, max_jump: None }
    }
}

impl Settings {
    /// Largest window accepted, points.
    pub const MAX_WINDOW: usize = 1001;
    /// Highest order of a Savitzky–Golay filter.
    pub const MAX_ORDER: u8 = 4;

    /// Checks every value.
    ///
    /// # Errors
    /// The first [`StrainError`] found.
    pub fn validate(&self) -> Result<(), StrainError> {
        let degree = self.method.degree();
        if degree == 0 || degree > usize::from(Self::MAX_ORDER) {
            return Err(StrainError::Order { order: degree, max: usize::from(Self::MAX_ORDER) });
        }
        let min = (degree + 1).max(3) | 1;
        if !(min..=Self::MAX_WINDOW).contains(&self.window) {
            return Err(StrainError::WindowRange { window: self.window, min, max: Self::MAX_WINDOW });
        }
        if self.window.is_multiple_of(2) {
            return Err(StrainError::EvenWindow { window: self.window });
        }
        let jump = self.max_jump.unwrap_or(1.0);
        for (name, value, min, max) in
            [("min_fraction", self.min_fraction, 0.0, 1.0), ("max_jump", jump, 1e-6, 65536.0)]
        {
            if !(min..=max).contains(&value) {
                return Err(StrainError::Range { name, value, min, max });
            }
        }
        Ok(())
    }

    /// Side of the virtual strain gauge in pixels: (window − 1) · `step` + `subset`.
    pub fn gauge(&self, step: f64, subset: usize) -> f64 {
        (self.window as f64 - 1.0) * step + subset as f64
    }
}

/// Verdict on the strain at a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StrainStatus {
    /// Fitted.
    Ok,
    /// The point itself has no displacement.
    NoDisplacement,
    /// Fewer linked points in the window than the minimum fraction.
    TooFewPoints,
    /// A whole window is needed and points are missing in it, or the material is parted in it.
    IncompleteWindow,
    /// The points in the window do not determine the polynomial (they lie on too few lines).
    IllConditioned,
    /// The gradient turns the material inside out (det F ≤ 0): no strain exists.
    Folded,
}

impl StrainStatus {
    /// Every status.
    pub const ALL: [StrainStatus; 6] = [
        StrainStatus::Ok,
        StrainStatus::NoDisplacement,
        StrainStatus::TooFewPoints,
        StrainStatus::IncompleteWindow,
        StrainStatus::IllConditioned,
        StrainStatus::Folded,
    ];

    /// Stable name: `ok`, else the reason.
    pub fn name(self) -> &'static str {
        match self {
            StrainStatus::Ok => "ok",
            StrainStatus::NoDisplacement => "no_displacement",
            StrainStatus::TooFewPoints => "too_few_points",
            StrainStatus::IncompleteWindow => "incomplete_window",
            StrainStatus::IllConditioned => "ill_conditioned",
            StrainStatus::Folded => "folded",
        }
    }

    /// Whether there is a strain.
    pub fn is_ok(self) -> bool {
        self == StrainStatus::Ok
    }
}

impl fmt::Display for StrainStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Why strain could not be computed at all.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum StrainError {
    /// The window has no middle point.
    #[error("the strain window must be an odd number of points, {window} is even: use {} or {}", window.saturating_sub(1), window + 1)]
    EvenWindow {
        /// Value given.
        window: usize,
    },
    /// The window is too small for its polynomial, or too large to be meant.
    #[error("a strain window of {window} points is outside {min}..={max}")]
    WindowRange {
        /// Value given.
        window: usize,
        /// Smallest for the polynomial.
        min: usize,
        /// Largest.
        max: usize,
    },
    /// The window does not fit into the field.
    #[error(
        "a strain window of {window} points is larger than the field of {columns}×{rows} points: use at most {}",
        largest_odd(*columns.min(rows))
    )]
    WindowLargerThanField {
        /// Value given.
        window: usize,
        /// Columns of the field.
        columns: usize,
        /// Rows of the field.
        rows: usize,
    },
    /// No such polynomial.
    #[error("a polynomial of order {order} is outside 1..={max}")]
    Order {
        /// Value given.
        order: usize,
        /// Highest.
        max: usize,
    },
    /// A number outside its range.
    #[error("{name} = {value} is outside {min}..={max}")]
    Range {
        /// Name of the setting.
        name: &'static str,
        /// Value given.
        value: f64,
        /// Smallest accepted.
        min: f64,
        /// Largest accepted.
        max: f64,
    },
    /// An array of another length than the grid.
    #[error("`{name}` has {found} values, the field of {columns}×{rows} points needs {}", columns * rows)]
    Length {
        /// Name of the array.
        name: &'static str,
        /// Its length.
        found: usize,
        /// Columns of the field.
        columns: usize,
        /// Rows of the field.
        rows: usize,
    },
    /// The points do not form a grid.
    #[error("strain needs points on a regular grid, these are scattered")]
    Scattered,
    /// Points and results do not belong together.
    #[error("{results} results were given for {points} points")]
    Count {
        /// Results given.
        results: usize,
        /// Points.
        points: usize,
    },
    /// A probe is not at finite coordinates, or has no length.
    #[error("the probe at ({x}, {y}) cannot be used: {reason}")]
    Probe {
        /// Column.
        x: f64,
        /// Row.
        y: f64,
        /// What is wrong.
        reason: &'static str,
    },
}

fn largest_odd(n: usize) -> usize {
    if n.is_multiple_of(2) { n.saturating_sub(1) } else { n }
}
