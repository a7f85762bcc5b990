//! Tables, maps and pictures of results.

use super::surface::strain_status;
use super::{Displacement, DisplacementPoint, Grid, ObjectGrid, Profile, ProfilePoint, SurfaceField};
use crate::error::Error;
use daic_dataset::{Column, FloatMap, MapAxes, Table, map};
use daic_optics::surface::SurfaceStrain;
use std::path::Path;

const AXES: [&str; 3] = ["x", "y", "h"];
const MOVES: [&str; 3] = ["u", "v", "w"];

/// How results are resampled to object coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ObjectOptions {
    /// Distance of nodes, mm; none: as far as the points are.
    pub step_mm: Option<f64>,
    /// See [`super::Settings::overlap`].
    pub overlap: f64,
}

/// `x_px,y_px,x_mm,y_mm,h_mm,sigma_h_mm,gap_mm,status,sigma_x_mm,sigma_y_mm`, then the calibration's part of the
/// uncertainty `sigma_x_cal_mm,sigma_y_cal_mm,sigma_h_cal_mm` (NaN where nothing is known of it),
/// `sigma_gap_mm` and the match `plus_x_px,plus_y_px`; a row per grid point.
///
/// # Errors
/// Only if two columns had one name.
pub fn profile_table(profile: &Profile) -> Result<Table, Error> {
    let points: Vec<&ProfilePoint> = profile.points.iter().collect();
    let status = points.iter().map(|p| p.status.to_string()).collect();
    surface_columns(&points, status, profile.states_common)
}

fn stated(stated: bool, sigma: f64) -> f64 {
    if stated { sigma } else { f64::NAN }
}

fn surface_columns(points: &[&ProfilePoint], status: Vec<String>, common: bool) -> Result<Table, Error> {
    let column = |f: &dyn Fn(&ProfilePoint) -> f64| Column::F64(points.iter().map(|p| f(p)).collect());
    let mut table = Table::new()
        .with("x_px", column(&|p| p.pixel_px[0]))?
        .with("y_px", column(&|p| p.pixel_px[1]))?
        .with("x_mm", column(&|p| p.point_mm[0]))?
        .with("y_mm", column(&|p| p.point_mm[1]))?
        .with("h_mm", column(&|p| p.point_mm[2]))?
        .with("sigma_h_mm", column(&|p| p.sigma_mm()[2]))?
        .with("gap_mm", column(&|p| p.gap_mm))?
        .with("status", Column::Text(status))?
        .with("sigma_x_mm", column(&|p| p.sigma_mm()[0]))?
        .with("sigma_y_mm", column(&|p| p.sigma_mm()[1]))?;
    for (i, axis) in AXES.into_iter().enumerate() {
        let sigma = column(&|p| stated(common, p.common_sigma_mm()[i]));
        table.push(&format!("sigma_{axis}_cal_mm"), sigma)?;
    }
    Ok(table
        .with("sigma_gap_mm", column(&|p| p.sigma_gap_mm))?
        .with("plus_x_px", column(&|p| p.plus_px[0]))?
        .with("plus_y_px", column(&|p| p.plus_px[1]))?)
}

/// The columns of [`profile_table`] for the reference, then
/// `u_mm,v_mm,w_mm,sigma_u_mm,sigma_v_mm,sigma_w_mm,sigma_u_cal_mm,sigma_v_cal_mm,sigma_w_cal_mm`; with `strain`
/// also `e11,e22,e12,sigma_e11,sigma_e22,sigma_e12,e1,e2,sigma_e1,sigma_e2,angle_deg,normal_x,normal_y,normal_h,strain_status`.
///
/// # Errors
/// Only if two columns had one name.
pub fn displacement_table(
    displacement: &Displacement,
    strain: Option<&SurfaceField>,
) -> Result<Table, Error> {
    let common = displacement.states_common;
    let points: Vec<&ProfilePoint> = displacement.points.iter().map(|p| &p.reference).collect();
    let status = displacement.points.iter().map(|p| p.status.to_string()).collect();
    let mut table = surface_columns(&points, status, common)?;
    let column =
        |f: &dyn Fn(&DisplacementPoint) -> f64| Column::F64(displacement.points.iter().map(f).collect());
    for (i, name) in MOVES.into_iter().enumerate() {
        table.push(&format!("{name}_mm"), column(&|p| p.displacement_mm[i]))?;
    }
    for (i, name) in MOVES.into_iter().enumerate() {
        table.push(&format!("sigma_{name}_mm"), column(&|p| p.sigma_mm()[i]))?;
    }
    for (i, name) in MOVES.into_iter().enumerate() {
        table.push(&format!("sigma_{name}_cal_mm"), column(&|p| stated(common, p.common_sigma_mm()[i])))?;
    }
    let Some(strain) = strain else { return Ok(table) };
    for (name, of) in strain_columns() {
        let value = |s: &Result<SurfaceStrain, _>| s.as_ref().map_or(f64::NAN, &of);
        table.push(name, Column::F64(strain.strains.iter().map(value).collect()))?;
    }
    let status = strain.strains.iter().map(|s| strain_status(s).to_owned()).collect();
    table.push("strain_status", Column::Text(status))?;
    Ok(table)
}

type OfStrain = Box<dyn Fn(&SurfaceStrain) -> f64>;

fn strain_columns() -> Vec<(&'static str, OfStrain)> {
    fn of(f: impl Fn(&SurfaceStrain) -> f64 + 'static) -> OfStrain {
        Box::new(f)
    }
    vec![
        ("e11", of(|s| s.strain[0])),
        ("e22", of(|s| s.strain[1])),
        ("e12", of(|s| s.strain[2])),
        ("sigma_e11", of(|s| s.sigma()[0])),
        ("sigma_e22", of(|s| s.sigma()[1])),
        ("sigma_e12", of(|s| s.sigma()[2])),
        ("e1", of(|s| s.principal[0])),
        ("e2", of(|s| s.principal[1])),
        ("sigma_e1", of(|s| s.principal_sigma[0])),
        ("sigma_e2", of(|s| s.principal_sigma[1])),
        ("angle_deg", of(|s| s.principal_angle_rad.to_degrees())),
        ("normal_x", of(|s| s.normal.x)),
        ("normal_y", of(|s| s.normal.y)),
        ("normal_h", of(|s| s.normal.z)),
    ]
}

/// How many of [`strain_columns`] are components, their σ and principal strains.
const STRAIN_MAPS: usize = 10;

fn float_map(grid: &Grid, name: &str, unit: &str, values: Vec<f64>) -> FloatMap {
    FloatMap {
        name: name.to_owned(),
        unit: unit.to_owned(),
        width: grid.columns as u32,
        height: grid.rows as u32,
        data: values,
        axes: MapAxes {
            x0: grid.x0 as f64,
            dx: grid.step as f64,
            y0: grid.y0 as f64,
            dy: grid.step as f64,
            unit: "px".to_owned(),
        },
    }
}

/// Name, value of a point, and whether it is a standard deviation: a map to be.
type Quantity<'a> = (String, Box<dyn Fn(usize) -> f64 + 'a>, bool);

fn profile_quantities(profile: &Profile) -> Vec<Quantity<'_>> {
    let p = |k: usize| &profile.points[k];
    let mut all: Vec<Quantity<'_>> = vec![
        ("h_mm".to_owned(), Box::new(move |k| p(k).point_mm[2]), false),
        ("gap_mm".to_owned(), Box::new(move |k| p(k).gap_mm), false),
    ];
    for (i, axis) in AXES.into_iter().enumerate() {
        all.push((format!("sigma_{axis}_mm"), Box::new(move |k| p(k).sigma_mm()[i]), true));
    }
    for (i, axis) in AXES.into_iter().enumerate().filter(|_| profile.states_common) {
        // in common for all points: interpolated as it is
        all.push((format!("sigma_{axis}_cal_mm"), Box::new(move |k| p(k).common_sigma_mm()[i]), false));
    }
    all
}

fn displacement_quantities(field: &Displacement) -> Vec<Quantity<'_>> {
    let p = |k: usize| &field.points[k];
    let mut all: Vec<Quantity<'_>> = vec![
        ("h_mm".to_owned(), Box::new(move |k| p(k).reference.point_mm[2]), false),
        ("gap_mm".to_owned(), Box::new(move |k| p(k).reference.gap_mm), false),
    ];
    for (i, name) in MOVES.into_iter().enumerate() {
        all.push((format!("{name}_mm"), Box::new(move |k| p(k).displacement_mm[i]), false));
    }
    for (i, name) in MOVES.into_iter().enumerate() {
        all.push((format!("sigma_{name}_mm"), Box::new(move |k| p(k).sigma_mm()[i]), true));
    }
    for (i, name) in MOVES.into_iter().enumerate().filter(|_| field.states_common) {
        all.push((format!("sigma_{name}_cal_mm"), Box::new(move |k| p(k).common_sigma_mm()[i]), false));
    }
    all
}

fn strain_quantities(strain: &SurfaceField) -> Vec<Quantity<'_>> {
    strain_columns()
        .into_iter()
        .take(STRAIN_MAPS)
        .map(|(name, of)| -> Quantity<'_> {
            let value = move |k: usize| strain.strains[k].as_ref().map_or(f64::NAN, &of);
            (name.to_owned(), Box::new(value), name.starts_with("sigma"))
        })
        .collect()
}

/// The unit in a quantity's name; strain has none.
fn unit_of(name: &str) -> &'static str {
    if name.ends_with("_mm") { "mm" } else { "1" }
}

fn node_maps(grid: &Grid, ok: impl Fn(usize) -> bool, quantities: &[Quantity<'_>]) -> Vec<FloatMap> {
    let value = |of: &dyn Fn(usize) -> f64, k: usize| if ok(k) { of(k) } else { f64::NAN };
    let map = |(name, of, _): &Quantity<'_>| {
        float_map(grid, name, unit_of(name), grid.spread_over_nodes(|k| value(of, k)))
    };
    quantities.iter().map(map).collect()
}

/// Maps of uncertainty are in the archive alone.
fn pictured(map: &FloatMap) -> bool {
    !map.name.starts_with("sigma_")
}

fn write(directory: &Path, table: &Table, maps: &[FloatMap]) -> Result<(), Error> {
    table.write_csv(&directory.join("points.csv"))?;
    table.write_npz(&directory.join("points.npz"))?;
    map::write_maps_npz(&directory.join("maps.npz"), maps)?;
    for one in maps.iter().filter(|m| pictured(m)) {
        one.write_tiff(&directory.join(format!("{}.tif", one.name)))?;
        crate::figures::write_map_png(&directory.join(format!("{}.png", one.name)), one)?;
    }
    Ok(())
}

/// Resamples and writes `object.csv`, `object.npz` and `object_NAME.tif`.
fn write_object(
    directory: &Path,
    grid: &Grid,
    at: impl Fn(usize) -> Option<[f64; 2]>,
    quantities: &[Quantity<'_>],
    options: &ObjectOptions,
) -> Result<(), Error> {
    let object = match ObjectGrid::new(grid, at, options.step_mm, options.overlap) {
        Ok(object) => object,
        // a few points, or points on a line, have no surface between them; a step that was asked for is an error
        Err(Error::ObjectGrid { .. }) if options.step_mm.is_none() => return Ok(()),
        Err(error) => return Err(error),
    };
    let maps: Vec<FloatMap> = quantities
        .iter()
        .map(|(name, of, sigma)| {
            let data = if *sigma { object.sigmas(of) } else { object.values(of) };
            object.map(name, unit_of(name), data)
        })
        .collect();
    let on: Vec<usize> = (0..object.columns * object.rows).filter(|n| object.is_on_surface(*n)).collect();
    let mut table = Table::new();
    for (i, name) in ["x_mm", "y_mm"].into_iter().enumerate() {
        table.push(name, Column::F64(on.iter().map(|n| object.position_mm(*n)[i]).collect()))?;
    }
    for map in &maps {
        table.push(&map.name, Column::F64(on.iter().map(|n| map.data[*n]).collect()))?;
    }
    table.write_csv(&directory.join("object.csv"))?;
    map::write_maps_npz(&directory.join("object.npz"), &maps)?;
    for one in maps.iter().filter(|m| pictured(m)) {
        one.write_tiff(&directory.join(format!("object_{}.tif", one.name)))?;
    }
    Ok(())
}

/// Height, gap, σ and the calibration's σ at the nodes of the grid, in this order; NaN where they do not count.
pub fn profile_maps(profile: &Profile) -> Vec<FloatMap> {
    let ok = |k: usize| profile.points[k].status.is_ok();
    node_maps(&profile.grid, ok, &profile_quantities(profile))
}

/// Height and gap of the reference, u, v, w and their σ at the nodes of the grid, then the strain's maps; NaN
/// where they do not count.
pub fn displacement_maps(displacement: &Displacement, strain: Option<&SurfaceField>) -> Vec<FloatMap> {
    let ok = |k: usize| displacement.points[k].status.is_ok();
    let mut quantities = displacement_quantities(displacement);
    quantities.extend(strain.into_iter().flat_map(strain_quantities));
    node_maps(&displacement.grid, ok, &quantities)
}

/// The map of that name.
pub fn map_named<'a>(maps: &'a [FloatMap], name: &str) -> Option<&'a FloatMap> {
    maps.iter().find(|m| m.name == name)
}

/// Writes `points.csv`, `points.npz`, `maps.npz`, a TIFF and a PNG for h and the gap, and, resampled to object
/// coordinates, `object.csv`, `object.npz` and a TIFF each.
///
/// # Errors
/// The file that could not be written; [`Error::ObjectGrid`] for a step that cannot be.
pub fn write_profile(directory: &Path, profile: &Profile, options: &ObjectOptions) -> Result<(), Error> {
    let at = |k: usize| {
        let p = &profile.points[k];
        p.status.is_ok().then_some([p.point_mm[0], p.point_mm[1]])
    };
    write_object(directory, &profile.grid, at, &profile_quantities(profile), options)?;
    write(directory, &profile_table(profile)?, &profile_maps(profile))
}

/// As [`write_profile`], with u, v, w and perhaps the strain.
///
/// # Errors
/// As [`write_profile`].
pub fn write_displacement(
    directory: &Path,
    displacement: &Displacement,
    strain: Option<&SurfaceField>,
    options: &ObjectOptions,
) -> Result<(), Error> {
    let at = |k: usize| {
        let p = &displacement.points[k];
        p.status.is_ok().then_some([p.reference.point_mm[0], p.reference.point_mm[1]])
    };
    let mut quantities = displacement_quantities(displacement);
    quantities.extend(strain.into_iter().flat_map(strain_quantities));
    write_object(directory, &displacement.grid, at, &quantities, options)?;
    let table = displacement_table(displacement, strain)?;
    write(directory, &table, &displacement_maps(displacement, strain))
}
