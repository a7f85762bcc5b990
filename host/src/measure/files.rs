//! Tables, maps and pictures of results.

use super::{Displacement, DisplacementPoint, Grid, Profile, ProfilePoint};
use crate::error::Error;
use daic_dataset::{Column, FloatMap, MapAxes, Table, map};
use std::path::Path;

/// `x_px,y_px,x_mm,y_mm,h_mm,sigma_h_mm,gap_mm,status,sigma_x_mm,sigma_y_mm`, a row per grid point.
///
/// # Errors
/// Only if two columns had one name.
pub fn profile_table(profile: &Profile) -> Result<Table, Error> {
    let points: Vec<&ProfilePoint> = profile.points.iter().collect();
    let status = points.iter().map(|p| p.status.to_string()).collect();
    surface_columns(&points, status)
}

fn surface_columns(points: &[&ProfilePoint], status: Vec<String>) -> Result<Table, Error> {
    let column = |f: &dyn Fn(&ProfilePoint) -> f64| Column::F64(points.iter().map(|p| f(p)).collect());
    Ok(Table::new()
        .with("x_px", column(&|p| p.pixel_px[0]))?
        .with("y_px", column(&|p| p.pixel_px[1]))?
        .with("x_mm", column(&|p| p.point_mm[0]))?
        .with("y_mm", column(&|p| p.point_mm[1]))?
        .with("h_mm", column(&|p| p.point_mm[2]))?
        .with("sigma_h_mm", column(&|p| p.sigma_mm[2]))?
        .with("gap_mm", column(&|p| p.gap_mm))?
        .with("status", Column::Text(status))?
        .with("sigma_x_mm", column(&|p| p.sigma_mm[0]))?
        .with("sigma_y_mm", column(&|p| p.sigma_mm[1]))?)
}

/// The columns of [`profile_table`] for the reference, then
/// `u_mm,v_mm,w_mm,sigma_u_mm,sigma_v_mm,sigma_w_mm`.
///
/// # Errors
/// Only if two columns had one name.
pub fn displacement_table(displacement: &Displacement) -> Result<Table, Error> {
    let points: Vec<&ProfilePoint> = displacement.points.iter().map(|p| &p.reference).collect();
    let status = displacement.points.iter().map(|p| p.status.to_string()).collect();
    let mut table = surface_columns(&points, status)?;
    for (i, name) in ["u_mm", "v_mm", "w_mm"].into_iter().enumerate() {
        table.push(name, Column::F64(displacement.points.iter().map(|p| p.displacement_mm[i]).collect()))?;
    }
    for (i, name) in ["sigma_u_mm", "sigma_v_mm", "sigma_w_mm"].into_iter().enumerate() {
        table.push(name, Column::F64(displacement.points.iter().map(|p| p.sigma_mm[i]).collect()))?;
    }
    Ok(table)
}

fn float_map(grid: &Grid, name: &str, values: Vec<f64>) -> FloatMap {
    FloatMap {
        name: name.to_owned(),
        unit: "mm".to_owned(),
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

fn write(directory: &Path, table: &Table, maps: &[FloatMap]) -> Result<(), Error> {
    table.write_csv(&directory.join("points.csv"))?;
    table.write_npz(&directory.join("points.npz"))?;
    map::write_maps_npz(&directory.join("maps.npz"), maps)?;
    for one in maps {
        one.write_tiff(&directory.join(format!("{}.tif", one.name)))?;
        crate::figures::write_map_png(&directory.join(format!("{}.png", one.name)), one)?;
    }
    Ok(())
}

/// The height at the nodes of the grid; NaN where it does not count.
pub fn height_map(profile: &Profile) -> FloatMap {
    let height =
        |k: usize| if profile.points[k].status.is_ok() { profile.points[k].point_mm[2] } else { f64::NAN };
    float_map(&profile.grid, "h_mm", profile.grid.spread_over_nodes(height))
}

/// Height (of the reference), u, v and w at the nodes of the grid; NaN where they do not count.
pub fn displacement_maps(displacement: &Displacement) -> [FloatMap; 4] {
    let grid = &displacement.grid;
    let values = |f: &dyn Fn(&DisplacementPoint) -> f64| {
        grid.spread_over_nodes(|k| {
            let point = &displacement.points[k];
            if point.status.is_ok() { f(point) } else { f64::NAN }
        })
    };
    [
        float_map(grid, "h_mm", values(&|p| p.reference.point_mm[2])),
        float_map(grid, "u_mm", values(&|p| p.displacement_mm[0])),
        float_map(grid, "v_mm", values(&|p| p.displacement_mm[1])),
        float_map(grid, "w_mm", values(&|p| p.displacement_mm[2])),
    ]
}

/// Writes `points.csv`, `points.npz`, `maps.npz`, `h_mm.tif`, `h_mm.png`.
///
/// # Errors
/// The file that could not be written.
pub fn write_profile(directory: &Path, profile: &Profile) -> Result<(), Error> {
    write(directory, &profile_table(profile)?, &[height_map(profile)])
}

/// Writes `points.csv`, `points.npz`, `maps.npz` and a TIFF and a PNG for h, u, v and w.
///
/// # Errors
/// The file that could not be written.
pub fn write_displacement(directory: &Path, displacement: &Displacement) -> Result<(), Error> {
    write(directory, &displacement_table(displacement)?, &displacement_maps(displacement))
}
