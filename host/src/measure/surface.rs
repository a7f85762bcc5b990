//! Strain on the measured surface: local tangent plane, Green–Lagrange.

use super::{Displacement, spread};
use crate::error::Error;
use daic_optics::surface::{NoStrain, Settings, SurfacePoint, SurfaceStrain, strain};
use nalgebra::Vector3;
use serde::Serialize;

/// Strain at the points of a displacement field.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceField {
    /// How it was computed.
    pub settings: Settings,
    /// One entry per point of the field.
    pub strains: Vec<Result<SurfaceStrain, NoStrain>>,
    /// Side of the window with its subsets, pixels: over so much a strain is an average.
    pub gauge_px: f64,
}

/// A strain field in numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SurfaceSummary {
    /// Points with a strain.
    pub ok: usize,
    /// Mean of E₁₁, E₂₂, E₁₂.
    pub mean: [f64; 3],
    /// Their scatter over the field.
    pub std: [f64; 3],
    /// RMS of their own standard deviations.
    pub sigma: [f64; 3],
    /// Largest first principal strain.
    pub e1_max: f64,
    /// Smallest second principal strain.
    pub e2_min: f64,
    /// Side of the window with its subsets, pixels.
    pub gauge_px: f64,
}

/// Name of a point's status in files.
pub fn strain_status(strain: &Result<SurfaceStrain, NoStrain>) -> &'static str {
    match strain {
        Ok(_) => "ok",
        Err(NoStrain::NoPoint) => "no_point",
        Err(NoStrain::TooFew { .. }) => "too_few",
        Err(NoStrain::Degenerate) => "degenerate",
    }
}

/// Strain of a displacement field; `subset_px` is the side of the subsets it was measured with.
///
/// # Errors
/// [`Error::SurfaceStrain`] for a setting that cannot be.
pub fn surface_strain(
    field: &Displacement,
    settings: &Settings,
    subset_px: usize,
) -> Result<SurfaceField, Error> {
    let grid = &field.grid;
    let at = |k: usize| {
        let p = &field.points[k];
        p.status.is_ok().then(|| SurfacePoint {
            position_mm: Vector3::from(p.reference.point_mm),
            displacement_mm: Vector3::from(p.displacement_mm),
            position_mm2: p.reference.independent_mm2,
            displacement_mm2: p.independent_mm2,
        })
    };
    let points: Vec<Option<SurfacePoint>> = grid.nodes.iter().map(|n| n.and_then(at)).collect();
    let found = strain(grid.columns, grid.rows, &points, settings)?;
    let mut strains = vec![Err(NoStrain::NoPoint); field.points.len()];
    for (node, found) in grid.nodes.iter().zip(found) {
        if let Some(k) = node {
            strains[*k] = found;
        }
    }
    let gauge_px = ((settings.window - 1) * grid.step + subset_px) as f64;
    Ok(SurfaceField { settings: *settings, strains, gauge_px })
}

impl SurfaceField {
    /// What came out.
    pub fn summary(&self) -> SurfaceSummary {
        let ok = || self.strains.iter().flatten();
        let component = |c: usize| spread(ok().map(|s| s.strain[c]));
        SurfaceSummary {
            ok: ok().count(),
            mean: [0, 1, 2].map(|c| component(c).mean),
            std: [0, 1, 2].map(|c| component(c).std),
            sigma: [0, 1, 2].map(|c| spread(ok().map(|s| s.sigma()[c])).rms),
            e1_max: ok().map(|s| s.principal[0]).fold(f64::NAN, f64::max),
            e2_min: ok().map(|s| s.principal[1]).fold(f64::NAN, f64::min),
            gauge_px: self.gauge_px,
        }
    }
}
