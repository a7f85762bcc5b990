//! Results of `daic correlate`, read back as a field.

use crate::error::Error;
use daic_correlate::strain::Field;
use daic_correlate::{Shape, Status};
use daic_dataset::{Column, Table};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// What is wrong with the content of a file of points.
#[derive(Debug, thiserror::Error)]
pub enum ResultFileError {
    /// A cell that cannot be.
    #[error("{}, line {line}, field `{column}`: found `{found}`, allowed is {allowed}", path.display())]
    Cell {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 with the header.
        line: usize,
        /// Column.
        column: &'static str,
        /// What stands there.
        found: String,
        /// What may stand there.
        allowed: String,
    },
    /// No points.
    #[error("{} holds no points; write it with `daic correlate … --out FILE.csv`", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// No usable points.
    #[error("{}: none of its {points} points is `ok`; there is nothing to compute from", path.display())]
    NoneOk {
        /// The file.
        path: PathBuf,
        /// Points in it.
        points: usize,
    },
    /// Different distances along the axes, or no distance at all.
    #[error(
        "{}: the points are {dx} px apart along x and {dy} px along y; strain needs one distance along both axes", path.display()
    )]
    Steps {
        /// The file.
        path: PathBuf,
        /// Smallest distance of two columns of points; NaN if there is one.
        dx: f64,
        /// Smallest distance of two rows of points; NaN if there is one.
        dy: f64,
    },
    /// A point off the grid.
    #[error(
        "{}, line {line}: the point ({x}, {y}) is not on the grid of {step} px from ({x0}, {y0}) on which the others lie; strain needs points on a regular grid", path.display()
    )]
    OffGrid {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 with the header.
        line: usize,
        /// Column of the point.
        x: f64,
        /// Row of the point.
        y: f64,
        /// Distance of the grid.
        step: f64,
        /// First column of the grid.
        x0: f64,
        /// First row of the grid.
        y0: f64,
    },
    /// A point that is there twice.
    #[error("{}, line {line}: the point ({x}, {y}) stands in line {first} already", path.display())]
    Twice {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 with the header.
        line: usize,
        /// Line of the first one.
        first: usize,
        /// Column of the point.
        x: f64,
        /// Row of the point.
        y: f64,
    },
    /// Points so far apart that the grid around them has no use.
    #[error(
        "{}: {points} points would span a grid of {columns}×{rows} nodes {step} px apart; at most {limit} nodes can be taken", path.display()
    )]
    Sparse {
        /// The file.
        path: PathBuf,
        /// Points in it.
        points: usize,
        /// Columns of the grid.
        columns: f64,
        /// Rows of the grid.
        rows: f64,
        /// Distance of the grid.
        step: f64,
        /// Most nodes.
        limit: f64,
    },
}

/// Nodes per point, at the least a million, that a grid may have.
const NODES_PER_POINT: f64 = 100.0;
const NODES: f64 = 1e6;
/// How far off its node a point may be, in steps.
const OFF_NODE: f64 = 1e-6;
/// First line of data.
const FIRST_LINE: usize = 2;

/// Reads columns `x`, `y`, `u`, `v` and, where they are there, `sigma_u`, `sigma_v` and `status` (pixels;
/// without `status` points with finite u and v count). The subset with which they were measured is not
/// in the file.
///
/// # Errors
/// The file, and the line and field that is to blame.
pub fn read(path: &Path, subset: usize, shape: Shape) -> Result<Field, Error> {
    let table = Table::read_csv(path)?;
    let numbers = |name| column(&table, name, path);
    let (x, y, u, v) = (numbers("x")?, numbers("y")?, numbers("u")?, numbers("v")?);
    let sigma = |name| match table.column(name) {
        Some(_) => column(&table, name, path),
        None => Ok(vec![f64::NAN; table.rows()]),
    };
    let (sigma_u, sigma_v) = (sigma("sigma_u")?, sigma("sigma_v")?);
    let ok = statuses(&table, path, &u, &v)?;
    let path = || path.to_owned();
    if x.is_empty() {
        return Err(ResultFileError::Empty { path: path() }.into());
    }
    let cell = |row: usize, column, found: f64, allowed: &str| ResultFileError::Cell {
        path: path(),
        line: row + FIRST_LINE,
        column,
        found: found.to_string(),
        allowed: allowed.to_owned(),
    };
    const FAR: f64 = 1e6;
    for (name, values) in [("x", &x), ("y", &y)] {
        if let Some(row) = values.iter().position(|c| c.is_nan() || c.abs() > FAR) {
            return Err(cell(row, name, values[row], "a position within ±1000000 px").into());
        }
    }
    for (name, values) in [("u", &u), ("v", &v)] {
        let wrong = |row: usize| ok[row] && (values[row].is_nan() || values[row].abs() > FAR);
        if let Some(row) = (0..values.len()).find(|&row| wrong(row)) {
            return Err(cell(row, name, values[row], "within ±1000000 px where the status is `ok`").into());
        }
    }
    for (name, values) in [("sigma_u", &sigma_u), ("sigma_v", &sigma_v)] {
        if let Some(row) = (0..values.len()).find(|&row| ok[row] && values[row] < 0.0) {
            return Err(cell(row, name, values[row], "0 or more, or nan").into());
        }
    }
    if !ok.contains(&true) {
        return Err(ResultFileError::NoneOk { path: path(), points: x.len() }.into());
    }
    let (x0, dx, far_x) = spacing(&x);
    let (y0, dy, far_y) = spacing(&y);
    let step = if dx.is_nan() { dy } else { dx };
    // in a grid of one row or column the other axis says the distance
    if step.is_nan() || (!dy.is_nan() && (dy - step).abs() > OFF_NODE * step) {
        return Err(ResultFileError::Steps { path: path(), dx, dy }.into());
    }
    let (columns, rows) = (((far_x - x0) / step).round() + 1.0, ((far_y - y0) / step).round() + 1.0);
    let limit = NODES.max(NODES_PER_POINT * x.len() as f64);
    if columns * rows > limit {
        return Err(
            ResultFileError::Sparse { path: path(), points: x.len(), columns, rows, step, limit }.into()
        );
    }
    let mut field = Field::empty(columns as usize, rows as usize, [x0, y0], step, subset, shape);
    let mut lines: HashMap<usize, usize> = HashMap::with_capacity(x.len());
    for row in 0..x.len() {
        let (s, t) = ((x[row] - x0) / step, (y[row] - y0) / step);
        let line = row + FIRST_LINE;
        let [x, y] = [x[row], y[row]];
        if (s - s.round()).abs() > OFF_NODE || (t - t.round()).abs() > OFF_NODE {
            return Err(ResultFileError::OffGrid { path: path(), line, x, y, step, x0, y0 }.into());
        }
        let node = t.round() as usize * field.columns + s.round() as usize;
        if let Some(first) = lines.insert(node, line) {
            return Err(ResultFileError::Twice { path: path(), line, first, x, y }.into());
        }
        (field.u[node], field.v[node]) = (u[row], v[row]);
        (field.sigma_u[node], field.sigma_v[node]) = (sigma_u[row], sigma_v[row]);
        field.valid[node] = ok[row];
    }
    Ok(field)
}

/// Numbers of a column; a cell that is none is reported with its line.
fn column(table: &Table, name: &'static str, path: &Path) -> Result<Vec<f64>, Error> {
    if let Some(Column::Text(cells)) = table.column(name)
        && let Some(row) = cells.iter().position(|c| !c.is_empty() && c.parse::<f64>().is_err())
    {
        return Err(ResultFileError::Cell {
            path: path.to_owned(),
            line: row + FIRST_LINE,
            column: name,
            found: cells[row].clone(),
            allowed: "a number or nan".to_owned(),
        }
        .into());
    }
    Ok(table.numbers(name, path)?)
}

fn statuses(table: &Table, path: &Path, u: &[f64], v: &[f64]) -> Result<Vec<bool>, Error> {
    if table.column("status").is_none() {
        return Ok(u.iter().zip(v).map(|(u, v)| u.is_finite() && v.is_finite()).collect());
    }
    let cells = table.texts("status", path)?;
    if let Some(row) = cells.iter().position(|c| !Status::ALL.iter().any(|s| s.name() == c)) {
        return Err(ResultFileError::Cell {
            path: path.to_owned(),
            line: row + FIRST_LINE,
            column: "status",
            found: cells[row].clone(),
            allowed: Status::ALL.map(Status::name).join(", "),
        }
        .into());
    }
    Ok(cells.iter().map(|c| c == Status::Converged.name()).collect())
}

/// Least value, smallest distance of different values (NaN if all are the same), greatest value.
fn spacing(values: &[f64]) -> (f64, f64, f64) {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let distance = sorted.windows(2).map(|w| w[1] - w[0]).filter(|d| *d > 1e-9).fold(f64::INFINITY, f64::min);
    let (low, high) = (sorted.first().copied().unwrap_or(0.0), sorted.last().copied().unwrap_or(0.0));
    (low, if distance.is_finite() { distance } else { f64::NAN }, high)
}
