//! Strain on a measured surface.
//!
//! Points on the grid of the −1 view have places r and displacements u. Around each, r and R = r + u are
//! fitted as polynomials of the grid's indices (a, b); their derivatives g_α = ∂r/∂α and G_α = ∂R/∂α are
//! tangent vectors before and after, and
//!
//! ```text
//! E_αβ = (G_α·G_β − g_α·g_β)/2
//! ```
//!
//! is the Green–Lagrange strain of the surface, whatever its curvature: a rigid motion gives G = Q g and
//! zero to rounding. It is stated on orthonormal axes in the tangent plane: e₁ as near to x as the plane
//! allows, e₂ square to it towards y, the normal towards the camera.
//!
//! The covariance follows from those of r and u through the same derivatives. Errors of neighbours whose
//! subsets overlap are taken as correlated, in proportion to the overlap along either axis.

mod window;

use nalgebra::{Matrix2, Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use window::{Derivative, Window};

/// A measured point that moved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Its place (x, y, h) before, mm.
    pub position_mm: Vector3<f64>,
    /// Its displacement, mm.
    pub displacement_mm: Vector3<f64>,
    /// Covariance of the place, mm².
    pub position_mm2: Matrix3<f64>,
    /// Covariance of the displacement, mm².
    pub displacement_mm2: Matrix3<f64>,
}

/// Polynomial of the fits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Order {
    /// a + b x + c y.
    #[default]
    Plane,
    /// With x², xy, y²: at the rim of a surface, where windows are cut, without the bias of its curvature.
    Quadratic,
}

/// How strain is computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Settings {
    /// Side of the window in points, odd, at least 3.
    pub window: usize,
    /// Polynomial.
    pub order: Order,
    /// Share of the window that must have a point, above 0 to 1.
    pub min_fraction: f64,
    /// Side of a subset in steps of the grid; errors farther apart are independent. 0: all are.
    pub overlap: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { window: 11, order: Order::Plane, min_fraction: 0.6, overlap: 33.0 / 5.0 }
    }
}

/// Strain at a point of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceStrain {
    /// Unit normal before the motion, towards the camera (h).
    pub normal: Vector3<f64>,
    /// Unit axes e₁ and e₂ in the tangent plane.
    pub axes: [Vector3<f64>; 2],
    /// E₁₁, E₂₂, E₁₂ (half the engineering shear).
    pub strain: [f64; 3],
    /// Their covariance.
    pub covariance: Matrix3<f64>,
    /// Principal strains, the larger first.
    pub principal: [f64; 2],
    /// Their standard deviations; where both are equal, an upper bound.
    pub principal_sigma: [f64; 2],
    /// Angle from e₁ towards e₂ of the larger, radians, above −π/2 to π/2.
    pub principal_angle_rad: f64,
    /// Points of the window.
    pub points: usize,
}

impl SurfaceStrain {
    /// Standard deviations of E₁₁, E₂₂, E₁₂.
    pub fn sigma(&self) -> [f64; 3] {
        [0, 1, 2].map(|i| self.covariance[(i, i)].max(0.0).sqrt())
    }
}

/// Why a point has no strain.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoStrain {
    /// The point itself has no displacement.
    #[error("no displacement here")]
    NoPoint,
    /// Too few neighbours.
    #[error("{found} of the window's points have a displacement, {needed} are needed")]
    TooFew {
        /// Points there.
        found: usize,
        /// Points needed.
        needed: usize,
    },
    /// The neighbours lie so that no derivative follows.
    #[error("the window's points leave the derivatives open")]
    Degenerate,
}

/// Input that cannot be.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SurfaceError {
    /// Another number of points than the grid has.
    #[error("{found} points for a grid of {columns} × {rows}")]
    Size {
        /// Points given.
        found: usize,
        /// Columns.
        columns: usize,
        /// Rows.
        rows: usize,
    },
    /// A setting out of its limits.
    #[error("{name} is {value}, it must be {allowed}")]
    Setting {
        /// Which one.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A number that is not finite.
    #[error("point {index}: a number is not finite")]
    NotFinite {
        /// The point, row by row.
        index: usize,
    },
}

fn check(
    columns: usize,
    rows: usize,
    points: &[Option<SurfacePoint>],
    s: &Settings,
) -> Result<(), SurfaceError> {
    if columns.checked_mul(rows) != Some(points.len()) {
        return Err(SurfaceError::Size { found: points.len(), columns, rows });
    }
    let setting = |name, value, allowed| Err(SurfaceError::Setting { name, value, allowed });
    if s.window < 3 || s.window.is_multiple_of(2) || s.window > 999 {
        return setting("window", s.window as f64, "odd, 3 to 999");
    }
    if !(s.min_fraction > 0.0 && s.min_fraction <= 1.0) {
        return setting("min_fraction", s.min_fraction, "above 0 and at most 1");
    }
    if !(s.overlap >= 0.0 && s.overlap.is_finite()) {
        return setting("overlap", s.overlap, "a finite number, at least 0");
    }
    for (index, p) in points.iter().enumerate() {
        let Some(p) = p else { continue };
        let numbers = p.position_mm.iter().chain(&p.displacement_mm);
        let mut all = numbers.chain(&p.position_mm2).chain(&p.displacement_mm2);
        if !all.all(|v| v.is_finite()) {
            return Err(SurfaceError::NotFinite { index });
        }
    }
    Ok(())
}

/// Strain at every point of a grid of `columns` × `rows`, `points` row by row.
///
/// # Errors
/// If the input or a setting is impossible. That a point has no strain is in its own entry.
pub fn strain(
    columns: usize,
    rows: usize,
    points: &[Option<SurfacePoint>],
    settings: &Settings,
) -> Result<Vec<Result<SurfaceStrain, NoStrain>>, SurfaceError> {
    check(columns, rows, points, settings)?;
    let window = Window::new(settings);
    let at = |k: usize| {
        if points[k].is_none() {
            return Err(NoStrain::NoPoint);
        }
        let near = window.around(columns, rows, k % columns, k / columns, |k| points[k].is_some());
        let d = near?;
        one(&d, points, k)
    };
    Ok((0..points.len()).map(at).collect())
}

/// E₁₁, E₂₂, E₁₂ of a symmetric matrix.
fn components(m: &Matrix2<f64>) -> Vector3<f64> {
    Vector3::new(m[(0, 0)], m[(1, 1)], 0.5 * (m[(0, 1)] + m[(1, 0)]))
}

fn one(d: &Derivative, points: &[Option<SurfacePoint>], centre: usize) -> Result<SurfaceStrain, NoStrain> {
    let home = points[centre].ok_or(NoStrain::NoPoint)?;
    let mut g = [Vector3::zeros(); 2];
    let mut h = [Vector3::zeros(); 2];
    let (mut place_mm2, mut moved_mm2) = (Matrix3::zeros(), Matrix3::zeros());
    for (index, w) in &d.weights {
        let Some(p) = &points[*index] else { continue };
        for a in 0..2 {
            g[a] += (p.position_mm - home.position_mm) * w[a];
            h[a] += (p.displacement_mm - home.displacement_mm) * w[a];
        }
        place_mm2 += p.position_mm2 / d.weights.len() as f64;
        moved_mm2 += p.displacement_mm2 / d.weights.len() as f64;
    }
    let normal = g[0].cross(&g[1]);
    // also refuses tangents that are parallel
    if !(normal.norm() > 1e-9 * g[0].norm() * g[1].norm()) {
        return Err(NoStrain::Degenerate);
    }
    let normal = normal.normalize() * if normal.z < 0.0 { -1.0 } else { 1.0 };
    let along_x = Vector3::x() - normal * normal.x;
    if !(along_x.norm() > 1e-6) {
        return Err(NoStrain::Degenerate);
    }
    let e1 = along_x.normalize();
    let e2 = normal.cross(&e1);
    let e2 = if e2.y < 0.0 { -e2 } else { e2 };
    // g_α = Σ J_iα e_i
    let j = Matrix2::new(e1.dot(&g[0]), e1.dot(&g[1]), e2.dot(&g[0]), e2.dot(&g[1]));
    let inverse = j.try_inverse().ok_or(NoStrain::Degenerate)?;
    let to_axes = |m: Matrix2<f64>| inverse.transpose() * m * inverse;
    let after = [g[0] + h[0], g[1] + h[1]];
    // G·G − g·g as g·H + H·g + H·H: no difference of nearly equal numbers
    let strain = components(&to_axes(Matrix2::from_fn(|a, b| {
        0.5 * (g[a].dot(&h[b]) + h[a].dot(&g[b]) + h[a].dot(&h[b]))
    })));
    // δE = sym(G_α·δH_β) from the displacements, sym(H_α·δg_β) from the places: an error of a place moves
    // the point before and after alike
    let slope = |by: &[Vector3<f64>; 2], a: usize| -> Matrix3<f64> {
        Matrix3::from_columns(&[0, 1, 2].map(|c| {
            let m = Matrix2::from_fn(|i, k| {
                let one = if k == a { by[i][c] } else { 0.0 };
                let two = if i == a { by[k][c] } else { 0.0 };
                0.5 * (one + two)
            });
            components(&to_axes(m))
        }))
    };
    let mut covariance = Matrix3::zeros();
    for (by, variance) in [(&after, &moved_mm2), (&h, &place_mm2)] {
        let m = [slope(by, 0), slope(by, 1)];
        for a in 0..2 {
            for b in 0..2 {
                covariance += m[a] * variance * m[b].transpose() * d.noise[(a, b)];
            }
        }
    }
    let [exx, eyy, exy]: [f64; 3] = strain.into();
    let (middle, half) = (0.5 * (exx + eyy), 0.5 * (exx - eyy));
    let radius = half.hypot(exy);
    let principal_angle_rad = if radius > 0.0 { 0.5 * exy.atan2(half) } else { 0.0 };
    let (sin, cos) = principal_angle_rad.sin_cos();
    // to first order a principal strain is the normal strain along its own direction
    let sigma = |c: f64, s: f64| {
        let v = Vector3::new(c * c, s * s, 2.0 * c * s);
        (covariance * v).dot(&v).max(0.0).sqrt()
    };
    Ok(SurfaceStrain {
        normal,
        axes: [e1, e2],
        strain: [exx, eyy, exy],
        covariance,
        principal: [middle + radius, middle - radius],
        principal_sigma: [sigma(cos, sin), sigma(-sin, cos)],
        principal_angle_rad,
        points: d.weights.len(),
    })
}
