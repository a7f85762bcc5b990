//! Phases of gratings and displacements from them: what `daic phase` does.

use crate::error::Error;
use crate::figures;
use crate::measure::{Spread, image_of, spread};
use crate::pair::table;
use daic_correlate::phase::{PhaseField, PhaseMaps, PhasePair, PhaseSettings, phase_maps};
use daic_correlate::{Point, Points, Roi};
use daic_dataset::{Column, FloatMap, GreyImage, MapAxes, Table, map};
use serde::Serialize;
use std::f64::consts::TAU;
use std::path::Path;

/// One grating direction of an image, in numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DirectionSummary {
    /// Mean pitch, pixels.
    pub pitch_px: f64,
    /// Angle of the lines' normal against the x axis, degrees, positive from x to y.
    pub angle_deg: f64,
    /// Pixels with a phase.
    pub valid: usize,
    /// Connected parts.
    pub components: usize,
    /// Places around which the phase does not close.
    pub residues: usize,
    /// Mean uncertainty of the phase, radians.
    pub sigma_rad: f64,
    /// The same as a position across the lines, pixels.
    pub sigma_px: f64,
    /// Mean amplitude, grey levels.
    pub amplitude: f64,
    /// Side of the analysis window, pixels.
    pub window_px: usize,
}

/// An image's phases, in numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhaseSummary {
    /// Noise of the image, grey levels.
    pub noise: f64,
    /// Pixels of the image.
    pub pixels: usize,
    /// One or two directions.
    pub directions: Vec<DirectionSummary>,
    /// Crossings of the lines of a cross grating.
    pub crossings: usize,
}

/// Phases of one image.
///
/// # Errors
/// A setting that cannot be used, or an image without a grating.
pub fn analyse(image: &GreyImage, settings: &PhaseSettings) -> Result<PhaseMaps, Error> {
    Ok(phase_maps(&image_of(image)?, None, settings)?)
}

/// Mean of the finite values.
fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.filter(|v| v.is_finite()).fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
    sum / n
}

/// The numbers of a phase analysis.
pub fn summary(maps: &PhaseMaps) -> PhaseSummary {
    let directions = maps
        .directions
        .iter()
        .zip(&maps.windows)
        .map(|(map, window)| {
            let sigma_rad = mean(map.sigma.iter().map(|v| f64::from(*v)));
            let inside = map.amplitude.iter().zip(&map.label).filter(|(_, l)| **l != 0);
            DirectionSummary {
                pitch_px: map.carrier.pitch(),
                angle_deg: map.carrier.angle().to_degrees(),
                valid: map.valid(),
                components: map.components,
                residues: map.residues,
                sigma_rad,
                sigma_px: sigma_rad * map.carrier.pitch() / TAU,
                amplitude: mean(inside.map(|(a, _)| f64::from(*a))),
                window_px: 2 * window.radius() + 1,
            }
        })
        .collect();
    let crossings = maps.crossings().len();
    PhaseSummary { noise: maps.noise, pixels: maps.width * maps.height, directions, crossings }
}

fn float_map(maps: (usize, usize), name: &str, unit: &str, data: Vec<f64>) -> FloatMap {
    FloatMap {
        name: name.to_owned(),
        unit: unit.to_owned(),
        width: maps.0 as u32,
        height: maps.1 as u32,
        data,
        axes: MapAxes { x0: 0.0, dx: 1.0, y0: 0.0, dy: 1.0, unit: "px".to_owned() },
    }
}

/// `m,n,x,y,sigma_x,sigma_y,part_1,part_2`, a row per crossing; pixels.
fn crossing_table(maps: &PhaseMaps) -> Result<Table, Error> {
    let crossings = maps.crossings();
    let real =
        |f: &dyn Fn(&daic_correlate::phase::Crossing) -> f64| Column::F64(crossings.iter().map(f).collect());
    let whole =
        |f: &dyn Fn(&daic_correlate::phase::Crossing) -> i64| Column::I64(crossings.iter().map(f).collect());
    Ok(Table::new()
        .with("m", whole(&|c| c.m))?
        .with("n", whole(&|c| c.n))?
        .with("x", real(&|c| c.x))?
        .with("y", real(&|c| c.y))?
        .with("sigma_x", real(&|c| c.sigma_x))?
        .with("sigma_y", real(&|c| c.sigma_y))?
        .with("part_1", whole(&|c| i64::from(c.parts[0])))?
        .with("part_2", whole(&|c| i64::from(c.parts[1])))?)
}

/// Writes `phase.npz` (per direction d: `phase_d`, `sigma_d` in radians, `amplitude_d`, `quality_d`,
/// `part_d`), `crossings.csv` for a cross grating, and per direction the figures `distortion_d.svg`
/// (phase less its carrier, as a position in pixels) and `amplitude_d.svg`.
///
/// # Errors
/// The file that could not be written.
pub fn write_maps(folder: &Path, maps: &PhaseMaps) -> Result<(), Error> {
    let size = (maps.width, maps.height);
    let mut all = Vec::new();
    for (d, one) in maps.directions.iter().enumerate() {
        let wide = |v: &[f32]| -> Vec<f64> { v.iter().map(|v| f64::from(*v)).collect() };
        let name = |what: &str| format!("{what}_{}", d + 1);
        let c = one.carrier;
        let rest: Vec<f64> = one
            .phase
            .iter()
            .enumerate()
            .map(|(k, p)| {
                let (x, y) = ((k % maps.width) as f64, (k / maps.width) as f64);
                -(p - TAU * (c.fx * x + c.fy * y)) * c.pitch() / TAU
            })
            .collect();
        let level = mean(rest.iter().copied());
        let rest = rest.iter().map(|v| v - level).collect();
        let distortion = float_map(size, &name("distortion"), "px", rest);
        let amplitude = float_map(size, &name("amplitude"), "grey levels", wide(&one.amplitude));
        for (map, title, symbol) in [
            (&distortion, "Position across the lines less the mean grating", "e"),
            (&amplitude, "Amplitude of the grating", "a"),
        ] {
            figures::write_map_svg(&folder.join(format!("{}.svg", map.name)), map, title, symbol)?;
        }
        all.push(float_map(size, &name("phase"), "rad", one.phase.clone()));
        all.push(float_map(size, &name("sigma"), "rad", wide(&one.sigma)));
        all.push(amplitude);
        all.push(float_map(size, &name("quality"), "1", wide(&one.quality)));
        all.push(float_map(size, &name("part"), "1", one.label.iter().map(|l| f64::from(*l)).collect()));
    }
    map::write_maps_npz(&folder.join("phase.npz"), &all)?;
    if maps.directions.len() == 2 {
        crossing_table(maps)?.write_csv(&folder.join("crossings.csv"))?;
    }
    Ok(())
}

/// Displacement between two images of a grating.
#[derive(Debug)]
pub struct PhaseDisplacement {
    /// At every pixel of the reference image.
    pub field: PhaseField,
    /// At the points of a regular grid.
    pub points: Vec<Point>,
    /// Unit normal of the lines where the grating has one direction: only the displacement along it
    /// is known.
    pub line_normal: Option<[f64; 2]>,
}

/// A displacement, in numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DisplacementSummary {
    /// Points of the grid.
    pub points: usize,
    /// Points with a displacement.
    pub converged: usize,
    /// Means of u and v over those points, pixels.
    pub mean_px: [f64; 2],
    /// Their scatter, pixels.
    pub std_px: [f64; 2],
    /// Mean uncertainties from image noise, pixels.
    pub sigma_px: [f64; 2],
    /// Unit normal of a line grating.
    pub line_normal: Option<[f64; 2]>,
}

/// Displacement from `reference` to `deformed`, of the possible ones that nearest to `shift`, with
/// points every `step` pixels.
///
/// # Errors
/// Images that do not show the same grating; a step of zero.
pub fn displacement(
    reference: &PhaseMaps,
    deformed: &PhaseMaps,
    shift: [f64; 2],
    step: usize,
) -> Result<PhaseDisplacement, Error> {
    let pair = PhasePair::new(reference, deformed, shift)?;
    let side = reference.windows.iter().map(|w| 2 * w.radius() + 1).max().unwrap_or(1);
    let points = Points::grid(reference.width, reference.height, side, step, &Roi::default())?;
    Ok(PhaseDisplacement {
        field: pair.field(),
        points: pair.points(&points),
        line_normal: pair.line_normal(),
    })
}

/// The numbers of a displacement.
///
/// # Errors
/// [`Error::NothingMeasured`] where no point has one.
pub fn displacement_summary(found: &PhaseDisplacement) -> Result<DisplacementSummary, Error> {
    let ok = || found.points.iter().filter(|p| p.status.is_ok());
    if ok().next().is_none() {
        let reason = found.points.first().map_or("no point", |p| p.status.name());
        return Err(Error::NothingMeasured { reasons: format!("{} {reason}", found.points.len()) });
    }
    let (u, v): (Spread, Spread) = (spread(ok().map(|p| p.u)), spread(ok().map(|p| p.v)));
    Ok(DisplacementSummary {
        points: found.points.len(),
        converged: ok().count(),
        mean_px: [u.mean, v.mean],
        std_px: [u.std, v.std],
        sigma_px: [mean(ok().map(|p| f64::from(p.sigma_u))), mean(ok().map(|p| f64::from(p.sigma_v)))],
        line_normal: found.line_normal,
    })
}

/// Writes `displacement.npz` (`u`, `v`, `sigma_u`, `sigma_v` at every pixel), `points.csv` (as
/// `daic correlate`) and the figures `u.svg` and `v.svg`.
///
/// # Errors
/// The file that could not be written.
pub fn write_displacement(folder: &Path, found: &PhaseDisplacement) -> Result<(), Error> {
    let f = &found.field;
    let size = (f.width, f.height);
    let wide = |v: &[f32]| -> Vec<f64> { v.iter().map(|v| f64::from(*v)).collect() };
    let maps = [
        float_map(size, "u", "px", f.u.clone()),
        float_map(size, "v", "px", f.v.clone()),
        float_map(size, "sigma_u", "px", wide(&f.sigma_u)),
        float_map(size, "sigma_v", "px", wide(&f.sigma_v)),
    ];
    for (map, title) in maps.iter().zip(["Displacement along x", "Displacement along y"]) {
        figures::write_map_svg(&folder.join(format!("{}.svg", map.name)), map, title, &map.name)?;
    }
    map::write_maps_npz(&folder.join("displacement.npz"), &maps)?;
    Ok(table(&found.points)?.write_csv(&folder.join("points.csv"))?)
}
