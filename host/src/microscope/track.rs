//! Points of a reference frame followed in both views: what `daic track` does.

use super::field;
use crate::error::Error;
use crate::images;
use crate::measure::{self, Match, Reference, Track};
use crate::progress::Progress;
use daic_dataset::{Column, Table};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What `daic track` is asked for.
#[derive(Debug, Clone)]
pub struct TrackOptions {
    /// Reference frame with both first-order views.
    pub reference: PathBuf,
    /// Frames with the specimen elsewhere.
    pub frames: Vec<PathBuf>,
    /// How far the matches may lie from where the outlines of the views lie upon each other, pixels.
    pub search_px: f64,
    /// Subsets, region and pixels used.
    pub settings: measure::Settings,
    /// Folder of the fields.
    pub out: PathBuf,
    /// Also a table for `daic calibrate rig`: the frames are poses of a flat plate.
    pub plate: Option<PathBuf>,
}

/// A frame that was tracked.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Tracked {
    /// The frame.
    pub frame: String,
    /// Its field.
    pub field: String,
    /// Points followed in both views.
    pub ok: usize,
    /// All points.
    pub points: usize,
    /// Points by status.
    pub status: String,
    /// Mean image displacement (u₋, v₋, u₊, v₊), pixels.
    pub mean_px: [f64; 4],
}

/// Matches the two views of the reference, follows both into every frame and writes for each a CSV file that
/// `daic calibrate microscope` takes: `<out>/<name of the frame>.csv`.
///
/// # Errors
/// An image that cannot be used, frames of different sizes, or a reference without two views.
pub fn track(options: &TrackOptions, progress: &dyn Progress) -> Result<Vec<Tracked>, Error> {
    let mut names = std::collections::BTreeMap::new();
    for frame in &options.frames {
        if let Some(first) = names.insert(field_path(&options.out, frame), frame) {
            let (first, second) = (first.clone(), frame.clone());
            return Err(Error::SameName { first, second, file: field_path(&options.out, frame) });
        }
    }
    let image = images::read(&options.reference)?;
    let reference = Reference::by_outlines(&image, options.search_px, &options.settings, progress)?;
    std::fs::create_dir_all(&options.out)
        .map_err(|source| Error::Folder { path: options.out.clone(), source })?;
    let mut plate = PlateTable::default();
    plate.add(0, reference.matches.iter().enumerate().map(|(k, m)| (k, home(m))));
    let tracked: Result<Vec<Tracked>, Error> = options
        .frames
        .iter()
        .zip(1..)
        .map(|(path, pose)| {
            let frame = images::read_like(path, &image, &options.reference)?;
            let tracks = reference.track(&frame, progress)?;
            let file = field_path(&options.out, path);
            field::table(&reference.matches, &tracks, None)?.write_csv(&file)?;
            let both = reference.matches.iter().zip(&tracks.points);
            plate.add(pose, both.enumerate().map(|(k, (m, t))| (k, moved(m, t))));
            let ok: Vec<[f64; 4]> = reference
                .matches
                .iter()
                .zip(&tracks.points)
                .filter(|(_, t)| t.status.is_ok())
                .map(|(m, t)| field::moved(m, t))
                .collect();
            let mean = |i: usize| ok.iter().map(|d| d[i]).sum::<f64>() / ok.len() as f64;
            Ok(Tracked {
                frame: path.display().to_string(),
                field: file.display().to_string(),
                ok: ok.len(),
                points: tracks.points.len(),
                status: measure::status_counts(tracks.points.iter().map(|t| t.status)),
                mean_px: [0, 1, 2, 3].map(mean),
            })
        })
        .collect();
    let tracked = tracked?;
    if let Some(path) = &options.plate {
        plate.table()?.write_csv(path)?;
    }
    Ok(tracked)
}

/// Pixels (x₋, y₋, x₊, y₊) of a point of a plate and their standard deviation.
type Seen = Option<([f64; 4], f64)>;

/// A point where the reference shows it: all noise is in the match.
fn home(m: &Match) -> Seen {
    let ([a, b], [c, d]) = (m.pair.minus_px, m.pair.plus_px);
    m.status.is_ok().then(|| ([a, b, c, d], rms(&m.sigma_px)))
}

/// A point in another frame; what was matched wrongly goes along with it.
fn moved(m: &Match, t: &Track) -> Seen {
    let ([a, b], [c, d]) = (t.minus_px, t.plus_px);
    let all = [t.sigma_minus_px, t.sigma_plus_px, m.sigma_px].concat();
    (m.status.is_ok() && t.status.is_ok()).then(|| ([a, b, c, d], rms(&all)))
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

/// Columns of the table for `daic calibrate rig`; where on the plate the points lie is not known.
#[derive(Default)]
struct PlateTable {
    pose: Vec<i64>,
    point: Vec<i64>,
    pixels: [Vec<f64>; 4],
    sigma: Vec<f64>,
}

impl PlateTable {
    fn add(&mut self, pose: i64, points: impl Iterator<Item = (usize, Seen)>) {
        for (point, seen) in points {
            let Some((pixels, sigma)) = seen else { continue };
            self.pose.push(pose);
            self.point.push(point as i64);
            for (column, value) in self.pixels.iter_mut().zip(pixels) {
                column.push(value);
            }
            self.sigma.push(sigma);
        }
    }

    fn table(self) -> Result<Table, Error> {
        let unknown = Column::F64(vec![f64::NAN; self.pose.len()]);
        let mut table = Table::new()
            .with("pose", Column::I64(self.pose))?
            .with("point", Column::I64(self.point))?
            .with("plate_x_mm", unknown.clone())?
            .with("plate_y_mm", unknown)?;
        for (name, column) in ["minus_x", "minus_y", "plus_x", "plus_y"].into_iter().zip(self.pixels) {
            table.push(name, Column::F64(column))?;
        }
        Ok(table.with("sigma_px", Column::F64(self.sigma))?)
    }
}

fn field_path(out: &Path, frame: &Path) -> PathBuf {
    let stem = frame.file_stem().unwrap_or(frame.as_os_str());
    let mut name = stem.to_owned();
    name.push(".csv");
    out.join(name)
}
