//! CSV files of image displacements in both views.
//!
//! Columns: `x_px,y_px` (midpoint of the pair) or `x_minus_px,y_minus_px,x_plus_px,y_plus_px`;
//! `u_minus_px,v_minus_px,u_plus_px,v_plus_px`, the +1 pair at the +1 match of the −1 point; σ as
//! `sigma_u_minus_px,sigma_v_minus_px,sigma_u_plus_px,sigma_v_plus_px` or `sigma_px` for all four, or from
//! the file of moves; `h_um`, the height before the motion, 0 if left out; `status`, of which only `ok`
//! counts. Other columns are not read.

use super::MicroscopeFileError;
use crate::error::Error;
use crate::measure::{Match, Track, Tracks};
use daic_dataset::{Column, Table};
use daic_optics::microscope::calibrate::FieldPoint;
use std::path::Path;

const MOVED: [&str; 4] = ["u_minus_px", "v_minus_px", "u_plus_px", "v_plus_px"];
const SIGMA: [&str; 4] = ["sigma_u_minus_px", "sigma_v_minus_px", "sigma_u_plus_px", "sigma_v_plus_px"];
const PAIR: [&str; 4] = ["x_minus_px", "y_minus_px", "x_plus_px", "y_plus_px"];

/// Points of a field that are `ok`.
pub(super) fn read(path: &Path, sigma_px: Option<f64>) -> Result<Vec<FieldPoint>, Error> {
    let table = Table::read_csv(path)?;
    let column = |name: &str| table.numbers(name, path);
    let four = |names: [&str; 4]| -> Result<[Vec<f64>; 4], Error> {
        let [a, b, c, d] = names;
        Ok([column(a)?, column(b)?, column(c)?, column(d)?])
    };
    let middle = if table.column(PAIR[0]).is_some() {
        let [x0, y0, x1, y1] = four(PAIR)?;
        let mean =
            |a: Vec<f64>, b: Vec<f64>| -> Vec<f64> { a.iter().zip(b).map(|(a, b)| 0.5 * (a + b)).collect() };
        [mean(x0, x1), mean(y0, y1)]
    } else {
        [column("x_px")?, column("y_px")?]
    };
    let moved = four(MOVED)?;
    let sigma = if table.column(SIGMA[0]).is_some() {
        four(SIGMA)?
    } else if table.column("sigma_px").is_some() {
        let one = column("sigma_px")?;
        [one.clone(), one.clone(), one.clone(), one]
    } else if let Some(sigma) = sigma_px {
        std::array::from_fn(|_| vec![sigma; table.rows()])
    } else {
        return Err(MicroscopeFileError {
            path: path.to_owned(),
            line: None,
            reason: format!(
                "no σ: give the columns {}, or sigma_px, or sigma = \"0.02 px\" in the file of moves",
                SIGMA.join(", ")
            ),
        }
        .into());
    };
    let height = if table.column("h_um").is_some() { column("h_um")? } else { vec![0.0; table.rows()] };
    let status = if table.column("status").is_some() { Some(table.texts("status", path)?) } else { None };
    let mut points = Vec::with_capacity(table.rows());
    for row in 0..table.rows() {
        if status.as_ref().is_some_and(|s| s[row] != "ok") {
            continue;
        }
        let at = |columns: &[Vec<f64>; 4]| std::array::from_fn(|c| columns[c][row]);
        let point = FieldPoint {
            middle_px: [middle[0][row], middle[1][row]],
            height_mm: height[row] * 1e-3,
            moved_px: at(&moved),
            sigma_px: at(&sigma),
        };
        let bad = point.middle_px.iter().chain(&point.moved_px).chain([&point.height_mm]);
        let finite = bad.copied().all(f64::is_finite);
        if !finite || !point.sigma_px.iter().all(|s| s.is_finite() && *s > 0.0) {
            return Err(MicroscopeFileError {
                path: path.to_owned(),
                line: Some(row + 2),
                reason: "a number is missing or not finite, or a σ is not above 0; points that failed are to be left out or to have a status other than ok".to_owned(),
            }
            .into());
        }
        points.push(point);
    }
    Ok(points)
}

/// (u₋, v₋, u₊, v₊) of a matched point that was tracked.
pub(super) fn moved(matched: &Match, track: &Track) -> [f64; 4] {
    let (from, to) = (matched.pair, track);
    let [a, b] = [0, 1].map(|i| to.minus_px[i] - from.minus_px[i]);
    let [c, d] = [0, 1].map(|i| to.plus_px[i] - from.plus_px[i]);
    [a, b, c, d]
}

/// Standard deviations of the same.
pub(super) fn sigmas(track: &Track) -> [f64; 4] {
    let ([a, b], [c, d]) = (track.sigma_minus_px, track.sigma_plus_px);
    [a, b, c, d]
}

/// The field of a frame as [`read`] takes it: matched points of the reference, a row each; `height_um` gives the
/// height before the motion.
///
/// # Errors
/// Only if two columns had one name.
pub(super) fn table(
    matches: &[Match],
    tracks: &Tracks,
    height_um: Option<&dyn Fn(&Match) -> f64>,
) -> Result<Table, Error> {
    let both = || matches.iter().zip(&tracks.points);
    let mut table = Table::new();
    let mut push = |name: &str, f: &dyn Fn(&Match, &Track) -> f64| {
        table.push(name, Column::F64(both().map(|(m, t)| f(m, t)).collect()))
    };
    let pair: [fn(&Match) -> f64; 4] =
        [|m| m.pair.minus_px[0], |m| m.pair.minus_px[1], |m| m.pair.plus_px[0], |m| m.pair.plus_px[1]];
    for (name, value) in PAIR.into_iter().zip(pair) {
        push(name, &|m, _| value(m))?;
    }
    for (i, name) in MOVED.into_iter().enumerate() {
        push(name, &|m, t| moved(m, t)[i])?;
    }
    for (i, name) in SIGMA.into_iter().enumerate() {
        push(name, &|_, t| sigmas(t)[i])?;
    }
    if let Some(height_um) = height_um {
        push("h_um", &|m, _| height_um(m))?;
    }
    table.push("status", Column::Text(tracks.points.iter().map(|t| t.status.to_string()).collect()))?;
    Ok(table)
}
