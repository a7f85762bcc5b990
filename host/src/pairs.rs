//! Pixel pairs that were matched elsewhere: what `daic decode` does.

use crate::error::Error;
use crate::measure::{self, Grid, Instrument, Match, PointStatus, Profile};
use daic_dataset::Table;
use daic_optics::PixelPair;
use std::path::Path;

/// Reads columns `minus_x`, `minus_y`, `plus_x`, `plus_y` and perhaps `sigma_px` (of each of the four pixel coordinates;
/// `sigma_px` serves where the column is not there). Empty cells are no match.
///
/// # Errors
/// The file, or the row and column that cannot be used.
pub fn read(path: &Path, sigma_px: f64) -> Result<Vec<Match>, Error> {
    let table = Table::read_csv(path)?;
    let column = |name: &str| table.numbers(name, path);
    let [minus_x, minus_y] = [column("minus_x")?, column("minus_y")?];
    let [plus_x, plus_y] = [column("plus_x")?, column("plus_y")?];
    let sigma = match table.column("sigma_px") {
        Some(_) => column("sigma_px")?,
        None => vec![sigma_px; table.rows()],
    };
    let bad = |row: usize, column, value: f64, allowed| {
        Err(Error::TrackedPoint { path: path.to_owned(), row: row + 1, column, value, allowed })
    };
    let mut all = Vec::with_capacity(table.rows());
    for row in 0..table.rows() {
        let pair = PixelPair { minus_px: [minus_x[row], minus_y[row]], plus_px: [plus_x[row], plus_y[row]] };
        let numbers = [
            ("minus_x", pair.minus_px[0]),
            ("minus_y", pair.minus_px[1]),
            ("plus_x", pair.plus_px[0]),
            ("plus_y", pair.plus_px[1]),
        ];
        if let Some((name, value)) = numbers.into_iter().find(|(_, v)| v.is_infinite()) {
            return bad(row, name, value, "a finite number, or empty");
        }
        let missing = numbers.iter().any(|(_, v)| v.is_nan());
        let s = sigma[row];
        let usable = s.is_finite() && s >= 0.0;
        if !(missing || usable) {
            return bad(row, "sigma_px", s, "a finite number, at least 0");
        }
        // what both pixels contribute, as the noise of their difference
        let both = std::f64::consts::SQRT_2 * s;
        let status = if missing { PointStatus::Match("no_match") } else { PointStatus::Ok };
        all.push(Match { pair, sigma_px: [both; 2], status });
    }
    Ok(all)
}

/// Points of the pairs, in their order; the grid is empty.
///
/// # Errors
/// [`Error::SwappedOrders`] where the views are mistaken for each other, [`Error::NothingMeasured`] where no pair has
/// a point.
pub fn decode(matches: &[Match], instrument: &Instrument) -> Result<Profile, Error> {
    measure::profile(&Grid::none(), matches, instrument).with_points()
}
