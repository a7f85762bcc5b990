//! Points of a reference frame followed in both views: what `daic track` does.

use super::field;
use crate::error::Error;
use crate::images;
use crate::measure::{self, Reference};
use crate::progress::Progress;
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
    let image = images::read(&options.reference)?;
    let reference = Reference::by_outlines(&image, options.search_px, &options.settings, progress)?;
    std::fs::create_dir_all(&options.out)
        .map_err(|source| Error::Folder { path: options.out.clone(), source })?;
    options
        .frames
        .iter()
        .map(|path| {
            let frame = images::read_like(path, &image, &options.reference)?;
            let tracks = reference.track(&frame, progress)?;
            let file = field_path(&options.out, path);
            field::table(&reference.matches, &tracks, None)?.write_csv(&file)?;
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
        .collect()
}

fn field_path(out: &Path, frame: &Path) -> PathBuf {
    let stem = frame.file_stem().unwrap_or(frame.as_os_str());
    let mut name = stem.to_owned();
    name.push(".csv");
    out.join(name)
}
