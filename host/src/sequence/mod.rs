//! 2D-DIC of a series of images: what `daic correlate` does with more than one deformed image.
//!
//! The output folder holds `sequence.json` (settings), `frames/NNNN_NAME.csv` (a table per frame),
//! `summary.json`, and `resume.bin`, from which an interrupted run goes on. Every file is complete
//! or absent.

mod store;

pub use store::{FrameEntry, Resumed};

use crate::error::Error;
use crate::images;
use crate::measure::{Rectangle, image_of, spread};
use crate::pair;
use crate::progress::Progress;
use daic_correlate::{
    CorrelateError, Image, Observer, Points, Roi, Sequence, SequenceError, SequenceFrame, Settings, Stage,
    Update,
};
use daic_dataset::{Column, Table, atomic, result_key};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use store::Store;

/// Where displacements are stated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Description {
    /// At the material's position in the first image.
    #[default]
    Lagrangian,
    /// At the material's position in the deformed image.
    Eulerian,
}

/// What to do with which images.
#[derive(Debug, Clone)]
pub struct Options {
    /// First image.
    pub reference: PathBuf,
    /// All others, in order.
    pub frames: Vec<PathBuf>,
    /// Subset, shape function, interpolation and acceptance.
    pub settings: Settings,
    /// Distance of points, pixels.
    pub step: usize,
    /// Where the centres of subsets may lie.
    pub roi: Option<Rectangle>,
    /// When the reference is replaced.
    pub update: Update,
    /// Where displacements are stated.
    pub description: Description,
    /// Folder for the results.
    pub out: PathBuf,
    /// Replaces the results of another run instead of refusing.
    pub overwrite: bool,
}

/// What `sequence.json` says; results belong together only where all of it agrees.
#[derive(Debug, Clone, Serialize)]
struct Header<'a> {
    format: &'static str,
    format_version: u32,
    daic: &'static str,
    /// File name of the first image, and a key over its content.
    reference: String,
    reference_key: String,
    settings: &'a Settings,
    step: usize,
    roi: Option<[usize; 4]>,
    update: Update,
    description: Description,
}

/// What `summary.json` says.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// Version of the program.
    pub daic: &'static str,
    /// Settings as in `sequence.json`.
    pub sequence: serde_json::Value,
    /// Every frame treated so far.
    pub frames: Vec<FrameEntry>,
    /// Frames given.
    pub total: usize,
    /// Frames that could not be used.
    pub failed: usize,
}

/// What a run of [`correlate`] did.
#[derive(Debug)]
pub struct Done {
    /// As in `summary.json`.
    pub summary: Summary,
    /// Frames whose results were there already.
    pub resumed: usize,
}

/// Hands the correlation's progress on under the frame's name, and Ctrl-C to the correlation.
struct Watch<'a> {
    name: String,
    progress: &'a dyn Progress,
}

impl Observer for Watch<'_> {
    fn stage(&self, stage: Stage) {
        if stage == Stage::Init {
            self.progress.stage(&self.name, 0);
        }
    }
    fn points(&self, done: usize, total: usize) {
        if done == 0 {
            self.progress.stage(&self.name, total as u64);
        }
        self.progress.advance(done as u64);
    }
    fn cancelled(&self) -> bool {
        self.progress.stop_requested().load(Ordering::Relaxed)
    }
}

/// Correlates a series of images; takes up a series that was interrupted.
///
/// A frame that cannot be read, is blank, or has another size is reported in its [`FrameEntry`] and
/// left out; the others are measured.
///
/// # Errors
/// An unusable reference or setting, results of another run in the folder, a file that cannot be
/// written (the frames before it are kept), [`Error::Interrupted`].
pub fn correlate(options: &Options, progress: &dyn Progress) -> Result<Done, Error> {
    let first = image_of(&images::read(&options.reference)?)?;
    options.settings.validate_for(first.width(), first.height())?;
    let roi = Roi { rectangle: options.roi, mask: None };
    let points = Points::grid(first.width(), first.height(), options.settings.subset, options.step, &roi)?;
    let header = Header {
        format: "daic-sequence",
        format_version: 1,
        daic: env!("CARGO_PKG_VERSION"),
        reference: name_of(&options.reference),
        reference_key: key(&options.reference)?,
        settings: &options.settings,
        step: options.step,
        roi: options.roi.map(|r| [r.x, r.y, r.width, r.height]),
        update: options.update,
        description: options.description,
    };
    let header = serde_json::to_value(&header).map_err(|source| Error::Unwritable {
        path: options.out.join("sequence.json"),
        reason: source.to_string(),
    })?;
    let mut store = Store::open(&options.out, header, options.overwrite)?;
    let (mut sequence, resumed) = begin(options, first, points, &mut store)?;
    for path in options.frames.iter().skip(resumed) {
        let number = store.entries().len() + 1;
        let name = format!("frame {number} of {}: {}", options.frames.len(), name_of(path));
        progress.stage(&name, 0);
        let watch = Watch { name, progress };
        let interrupted = Error::Interrupted {
            done: store.entries().len(),
            total: options.frames.len(),
            out: options.out.clone(),
        };
        if watch.cancelled() {
            return Err(interrupted);
        }
        let mut entry = FrameEntry::of(number, name_of(path), key(path).ok());
        match image_at(path) {
            Err(error) => {
                entry.failed = Some(error.to_string());
                sequence.skip();
            }
            Ok(image) => {
                let found = match sequence.next(image, &watch) {
                    Err(SequenceError::Correlate(CorrelateError::Cancelled { .. })) => {
                        return Err(interrupted);
                    }
                    // the one thing that a single frame can do wrong
                    Err(SequenceError::Correlate(error @ CorrelateError::ImageSize { .. })) => {
                        entry.failed = Some(format!("{}: {error}", path.display()));
                        sequence.skip();
                        None
                    }
                    Err(error) => return Err(error.into()),
                    Ok(found) => Some(found),
                };
                if let Some(found) = found {
                    let csv = store.table_name(number, path);
                    table(sequence.points(), &found, options.description)?
                        .write_csv(&options.out.join(&csv))?;
                    entry.fill(&found, csv);
                }
            }
        }
        store.push(entry, sequence.state())?;
        write_summary(&store, options)?;
    }
    if resumed == options.frames.len() {
        write_summary(&store, options)?;
    }
    Ok(Done { summary: summary(&store, options), resumed })
}

/// A sequence where the stored one stopped, or at its first image.
fn begin(
    options: &Options,
    first: Image,
    points: Points,
    store: &mut Store,
) -> Result<(Sequence, usize), Error> {
    let (settings, update) = (options.settings.clone(), options.update);
    let Some(Resumed { state, .. }) = store.resumed(&options.frames, key)? else {
        return Ok((Sequence::new(first, points, settings, update)?, 0));
    };
    let image = |number: u32| match number {
        0 => Ok(first.clone()),
        _ => image_at(&options.frames[number as usize - 1]),
    };
    let reference = image(state.reference())?;
    let candidate =
        if state.candidate() == state.reference() { None } else { Some(image(state.candidate())?) };
    let sequence = Sequence::resume(state, reference, candidate, points, settings, update)?;
    Ok((sequence, store.entries().len()))
}

fn image_at(path: &Path) -> Result<Image, Error> {
    image_of(&images::read(path)?)
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Over the content of a file.
fn key(path: &Path) -> Result<String, Error> {
    Ok(result_key("", &(), &[path.to_owned()])?)
}

/// The table of a pair, then `reference`: the number of the frame with which a point was
/// correlated, or the one in which it was seen last before it was lost.
fn table(points: &Points, found: &SequenceFrame, description: Description) -> Result<Table, Error> {
    let (table, references) = match description {
        Description::Lagrangian => (pair::table(&found.points)?, found.references.clone()),
        Description::Eulerian => {
            let field = daic_correlate::eulerian(points, &found.points, points.positions());
            let nearest = |e: &Option<daic_correlate::EulerianPoint>| {
                e.as_ref().map_or(found.reference, |e| found.references[e.nearest])
            };
            let references = field.iter().map(nearest).collect();
            (pair::eulerian_table(points, &found.points, &field)?, references)
        }
    };
    Ok(table.with("reference", Column::I64(references.into_iter().map(i64::from).collect()))?)
}

impl FrameEntry {
    fn fill(&mut self, found: &SequenceFrame, csv: String) {
        let ok = || found.points.iter().filter(|p| p.status.is_ok());
        let (u, v) = (spread(ok().map(|p| p.u)), spread(ok().map(|p| p.v)));
        self.table = Some(csv);
        self.reference = found.reference;
        self.points = found.points.len();
        self.converged = found.converged();
        // no number where there is no point
        let finite = |v: f64| v.is_finite().then_some(v);
        (self.mean_u_px, self.std_u_px) = (finite(u.mean), finite(u.std));
        (self.mean_v_px, self.std_v_px) = (finite(v.mean), finite(v.std));
    }
}

fn summary(store: &Store, options: &Options) -> Summary {
    let frames = store.entries().to_vec();
    let failed = frames.iter().filter(|f| f.failed.is_some()).count();
    let sequence = store.header().clone();
    Summary { daic: env!("CARGO_PKG_VERSION"), sequence, frames, total: options.frames.len(), failed }
}

fn write_summary(store: &Store, options: &Options) -> Result<(), Error> {
    let path = options.out.join("summary.json");
    let mut text = serde_json::to_string_pretty(&summary(store, options))
        .map_err(|source| Error::Unwritable { path: path.clone(), reason: source.to_string() })?;
    text.push('\n');
    Ok(atomic::write_bytes(&path, text.as_bytes())?)
}
