//! The dataset folder: everything one recording is, and what was computed from it.
//!
//! ```text
//! dataset.json      manifest: format version, program and version, seed, tick rate, plan
//! experiment.toml   the experiment file, as it was given
//! frames/NNNNNN.tif frames as the camera gave them
//! frames.jsonl      one line per frame, as it came in; a later line of the same id replaces it
//! events.jsonl      one line per event of the trigger box
//! edges.csv         tick,word of every edge played, where that is known (simulated rig, logic analyser)
//! results/NNNNNN/   what was computed from a frame; done.json last
//! summary.json      written at the end
//! ```
//! The journals (`*.jsonl`) grow while the recording runs. After a crash the last line may be
//! torn: readers report it ([`Damage`]) and go on; [`Dataset::resume`] removes it before appending.

mod error;
mod journal;
mod records;
mod results;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Component, Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

pub use error::{Damage, DatasetError};
pub use records::{EventRecord, FrameRecord, FrameRole, Manifest, StrobeRecord, Verdict};
pub use results::result_key;

use crate::atomic;
use crate::image_file::{self, GreyImage, ImageFileError};
use crate::table::{Column, Table};
use journal::Journal;

/// Version of the folder layout written by this program; newer ones are refused.
pub const FORMAT_VERSION: u32 = 1;

const FORMAT: &str = "daic-dataset";
const MANIFEST: &str = "dataset.json";
const EXPERIMENT: &str = "experiment.toml";
const FRAMES: &str = "frames.jsonl";
const FRAMES_DIR: &str = "frames";
const EVENTS: &str = "events.jsonl";
const EDGES: &str = "edges.csv";
const RESULTS: &str = "results";
const SUMMARY: &str = "summary.json";
const REPORT: &str = "report.html";

/// What to do with a folder that already holds a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Existing {
    /// Refuse.
    Refuse,
    /// Remove the parts of the old dataset; other files in the folder stay.
    Replace,
    /// As `Replace`, but only a dataset of this [`Manifest::kind`]; any other is refused. The new
    /// dataset is of this kind, too.
    ReplaceKind(&'static str),
}

/// A dataset folder, open for reading results into it; for recording see [`Recording`].
#[derive(Debug, Clone)]
pub struct Dataset {
    root: PathBuf,
    manifest: Manifest,
}

/// A dataset that is being recorded: frames and events are appended as they come in.
#[derive(Debug)]
pub struct Recording {
    dataset: Dataset,
    frames: Journal,
    events: Journal,
    ids: BTreeSet<u64>,
}

/// The records of a dataset, and what was found damaged while reading them.
#[derive(Debug, Clone, PartialEq)]
pub struct Contents<T> {
    /// The records, in the order they were first written.
    pub records: Vec<T>,
    /// What could not be read.
    pub damage: Vec<Damage>,
}

impl Dataset {
    /// Makes the folder and writes manifest and experiment file; the recording can begin.
    ///
    /// `manifest.format` and `manifest.format_version` are set here, and `manifest.kind` for
    /// [`Existing::ReplaceKind`].
    ///
    /// # Errors
    /// [`DatasetError::NotEmpty`] for a folder with other files in it,
    /// [`DatasetError::AlreadyThere`] for a dataset unless it is to be replaced,
    /// [`DatasetError::OtherKind`] for one that is not of the kind to be replaced,
    /// [`DatasetError::NotReplaced`] and [`DatasetError::NewerFormat`] for one whose manifest
    /// cannot be read, write errors. What was in the folder is then untouched, but for write errors.
    pub fn create(
        root: &Path,
        mut manifest: Manifest,
        experiment_toml: &str,
        existing: Existing,
    ) -> Result<Recording, DatasetError> {
        clear_for_new(root, existing)?;
        manifest.format = FORMAT.into();
        manifest.format_version = FORMAT_VERSION;
        if let Existing::ReplaceKind(kind) = existing {
            manifest.kind = Some(kind.into());
        }
        let dataset = Dataset { root: root.to_path_buf(), manifest };
        atomic::write_bytes_synced(&root.join(MANIFEST), &to_json(&dataset.manifest, &root.join(MANIFEST))?)?;
        atomic::write_bytes_synced(&root.join(EXPERIMENT), experiment_toml.as_bytes())?;
        fs::create_dir_all(root.join(FRAMES_DIR))
            .map_err(|source| DatasetError::io(&root.join(FRAMES_DIR), source))?;
        Recording::start(dataset, BTreeSet::new())
    }

    /// Opens a dataset for processing.
    ///
    /// # Errors
    /// [`DatasetError::NotADataset`], [`DatasetError::NewerFormat`], [`DatasetError::Manifest`].
    pub fn open(root: &Path) -> Result<Self, DatasetError> {
        let path = root.join(MANIFEST);
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(e)
                if matches!(e.kind(), std::io::ErrorKind::NotFound | std::io::ErrorKind::NotADirectory) =>
            {
                return Err(DatasetError::NotADataset { root: root.to_path_buf() });
            }
            Err(source) => return Err(DatasetError::io(&path, source)),
        };
        // The version is looked at first: the rest of a newer manifest may be anything.
        let value: Value = serde_json::from_slice(&bytes).map_err(|e| DatasetError::manifest(&path, &e))?;
        if value.get("format").and_then(Value::as_str) != Some(FORMAT) {
            return Err(DatasetError::NotADataset { root: root.to_path_buf() });
        }
        if let Some(version) = value.get("format_version").and_then(Value::as_u64)
            && version > u64::from(FORMAT_VERSION)
        {
            return Err(DatasetError::NewerFormat { root: root.to_path_buf(), version });
        }
        let manifest: Manifest =
            serde_json::from_slice(&bytes).map_err(|e| DatasetError::manifest(&path, &e))?;
        Ok(Dataset { root: root.to_path_buf(), manifest })
    }

    /// Opens a dataset whose recording was interrupted, to append to it; torn lines at the end of
    /// the journals are removed.
    ///
    /// # Errors
    /// As [`Dataset::open`] and [`Dataset::frames`].
    pub fn resume(root: &Path) -> Result<Recording, DatasetError> {
        let dataset = Self::open(root)?;
        let ids = dataset.frames()?.records.iter().map(|f| f.id).collect();
        Recording::start(dataset, ids)
    }

    /// The folder.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The manifest.
    #[must_use]
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The experiment file, as it was given.
    ///
    /// # Errors
    /// [`DatasetError::Experiment`] if it is missing or not text.
    pub fn experiment_toml(&self) -> Result<String, DatasetError> {
        let path = self.root.join(EXPERIMENT);
        fs::read_to_string(&path).map_err(|source| DatasetError::Experiment { path, source })
    }

    /// The frames, in the order they came in. Of several lines of one id the last is taken.
    /// A recorded file that is gone is reported as [`Damage::FrameFileGone`].
    ///
    /// # Errors
    /// [`DatasetError::Line`] for an unreadable line that is not the last,
    /// [`DatasetError::FrameFile`] for a file name that leads out of the dataset.
    pub fn frames(&self) -> Result<Contents<FrameRecord>, DatasetError> {
        let path = self.root.join(FRAMES);
        let (lines, mut damage) = journal::read::<FrameRecord>(&path)?;
        let mut place: BTreeMap<u64, usize> = BTreeMap::new();
        let mut records: Vec<FrameRecord> = Vec::new();
        for (line, record) in lines {
            if let Some(file) = &record.file {
                check_inside(&path, line, file)?;
            }
            match place.get(&record.id) {
                Some(&at) => records[at] = record,
                None => {
                    place.insert(record.id, records.len());
                    records.push(record);
                }
            }
        }
        for record in &records {
            if let Some(file) = &record.file
                && !self.root.join(file).is_file()
            {
                damage.push(Damage::FrameFileGone { id: record.id, file: self.root.join(file) });
            }
        }
        Ok(Contents { records, damage })
    }

    /// The image of a frame.
    ///
    /// # Errors
    /// [`DatasetError::NoImage`] for a frame that never came, [`DatasetError::FrameGone`] for one
    /// whose file is missing, else [`DatasetError::Image`].
    pub fn read_frame(&self, record: &FrameRecord) -> Result<GreyImage, DatasetError> {
        let file = record.file.as_ref().ok_or(DatasetError::NoImage { id: record.id })?;
        check_inside(&self.root.join(FRAMES), 0, file)?;
        image_file::read_grey(&self.root.join(file)).map_err(|error| match error {
            ImageFileError::Missing { path } => DatasetError::FrameGone { id: record.id, file: path },
            other => DatasetError::Image(other),
        })
    }

    /// The events, in the order they were written. A jump of the sequence number is reported as
    /// [`Damage::EventGap`].
    ///
    /// # Errors
    /// [`DatasetError::Line`] for an unreadable line that is not the last.
    pub fn events(&self) -> Result<Contents<EventRecord>, DatasetError> {
        let (lines, mut damage) = journal::read::<EventRecord>(&self.root.join(EVENTS))?;
        let records: Vec<EventRecord> = lines.into_iter().map(|(_, r)| r).collect();
        for pair in records.windows(2) {
            let expected = pair[0].seq.wrapping_add(1);
            if pair[1].seq != expected {
                damage.push(Damage::EventGap { expected, found: pair[1].seq });
            }
        }
        Ok(Contents { records, damage })
    }

    /// Writes the edges played, (tick, word) in time order.
    ///
    /// # Errors
    /// [`DatasetError::Table`], naming the file.
    pub fn write_edges(&self, edges: &[(u64, u32)]) -> Result<(), DatasetError> {
        // Ticks of 8 ns reach the end of i64 after 2000 years.
        let ticks = edges.iter().map(|&(t, _)| i64::try_from(t).unwrap_or(i64::MAX)).collect();
        let words = edges.iter().map(|&(_, w)| i64::from(w)).collect();
        let table = Table::new().with("tick", Column::I64(ticks))?.with("word", Column::I64(words))?;
        Ok(table.write_csv(&self.root.join(EDGES))?)
    }

    /// The edges played, or `None` where they were not recorded.
    ///
    /// # Errors
    /// [`DatasetError::Table`] or [`DatasetError::Edge`], naming file and line.
    pub fn edges(&self) -> Result<Option<Vec<(u64, u32)>>, DatasetError> {
        let path = self.root.join(EDGES);
        if !path.exists() {
            return Ok(None);
        }
        let table = Table::read_csv(&path)?;
        let ticks = table.texts("tick", &path)?;
        let words = table.texts("word", &path)?;
        let edge = |(row, (tick, word)): (usize, (&String, &String))| match (tick.parse(), word.parse()) {
            (Ok(tick), Ok(word)) => Ok((tick, word)),
            _ => Err(DatasetError::Edge { path: path.clone(), line: row as u64 + 2 }),
        };
        ticks.iter().zip(&words).enumerate().map(edge).collect::<Result<_, _>>().map(Some)
    }

    /// Writes `summary.json`, the last file of a run.
    ///
    /// # Errors
    /// [`DatasetError::Write`] or [`DatasetError::Serialise`].
    pub fn write_summary(&self, summary: &impl Serialize) -> Result<(), DatasetError> {
        let path = self.root.join(SUMMARY);
        Ok(atomic::write_bytes_synced(&path, &to_json(summary, &path)?)?)
    }

    /// Reads `summary.json`, `None` if the run has not ended.
    ///
    /// # Errors
    /// [`DatasetError::Io`] or [`DatasetError::Line`], naming the file.
    pub fn summary<T: DeserializeOwned>(&self) -> Result<Option<T>, DatasetError> {
        let path = self.root.join(SUMMARY);
        match fs::read(&path) {
            Ok(bytes) => serde_json::from_slice(&bytes)
                .map(Some)
                .map_err(|e| DatasetError::line(&path, e.line() as u64, &e)),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(source) => Err(DatasetError::io(&path, source)),
        }
    }

    /// Where the report of this dataset belongs.
    #[must_use]
    pub fn report_path(&self) -> PathBuf {
        self.root.join(REPORT)
    }

    /// Folder for results of the whole dataset; those of one frame are in
    /// [`Dataset::frame_results`].
    #[must_use]
    pub fn results(&self) -> PathBuf {
        self.root.join(RESULTS)
    }
}

impl Recording {
    fn start(dataset: Dataset, ids: BTreeSet<u64>) -> Result<Self, DatasetError> {
        let frames = Journal::append_to(&dataset.root.join(FRAMES))?;
        let events = Journal::append_to(&dataset.root.join(EVENTS))?;
        Ok(Recording { dataset, frames, events, ids })
    }

    /// The folder, for reading and for results.
    #[must_use]
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Records a frame: the image first, then its line. `record.file` is set here, from the id;
    /// without an image (a frame that never came) it is `None`. Returns the record as written.
    ///
    /// # Errors
    /// [`DatasetError::DuplicateFrame`] for an id already there, write errors.
    pub fn append_frame(
        &mut self,
        mut record: FrameRecord,
        image: Option<&GreyImage>,
    ) -> Result<FrameRecord, DatasetError> {
        if self.ids.contains(&record.id) {
            return Err(DatasetError::DuplicateFrame { id: record.id });
        }
        record.file = image.map(|_| format!("{FRAMES_DIR}/{:06}.tif", record.id));
        if let (Some(image), Some(file)) = (image, &record.file) {
            image_file::write_frame(&self.dataset.root.join(file), image)?;
        }
        self.frames.append(std::slice::from_ref(&record))?;
        self.ids.insert(record.id);
        Ok(record)
    }

    /// Replaces what is recorded of a frame, such as its verdict once it is known. The image and
    /// the old line stay; `record.file` must be the one returned by [`Recording::append_frame`].
    ///
    /// # Errors
    /// [`DatasetError::UnknownFrame`] for an id not recorded, write errors.
    pub fn revise_frame(&mut self, record: &FrameRecord) -> Result<(), DatasetError> {
        if !self.ids.contains(&record.id) {
            return Err(DatasetError::UnknownFrame { id: record.id });
        }
        self.frames.append(std::slice::from_ref(record))
    }

    /// Records events, in one write.
    ///
    /// # Errors
    /// Write errors, naming the file.
    pub fn append_events(&mut self, events: &[EventRecord]) -> Result<(), DatasetError> {
        self.events.append(events)
    }

    /// Ends the recording: forces the journals to the disk.
    ///
    /// # Errors
    /// [`DatasetError::Io`], naming the file.
    pub fn finish(self) -> Result<Dataset, DatasetError> {
        self.frames.sync()?;
        self.events.sync()?;
        Ok(self.dataset)
    }
}

fn to_json(value: &impl Serialize, path: &Path) -> Result<Vec<u8>, DatasetError> {
    let mut bytes = serde_json::to_vec_pretty(value)
        .map_err(|e| DatasetError::Serialise { path: path.to_path_buf(), reason: e.to_string() })?;
    bytes.push(b'\n');
    Ok(bytes)
}

/// A dataset may come from anybody: its records must not make us read elsewhere.
fn check_inside(journal: &Path, line: u64, file: &str) -> Result<(), DatasetError> {
    let plain = Path::new(file).components().all(|c| matches!(c, Component::Normal(_)));
    if plain && !file.is_empty() {
        return Ok(());
    }
    Err(DatasetError::FrameFile { path: journal.to_path_buf(), line, file: file.to_string() })
}

fn clear_for_new(root: &Path, existing: Existing) -> Result<(), DatasetError> {
    let mut entries = match fs::read_dir(root) {
        Ok(entries) => entries,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(source) => return Err(DatasetError::io(root, source)),
    };
    if entries.next().is_none() {
        return Ok(());
    }
    if !root.join(MANIFEST).is_file() {
        return Err(DatasetError::NotEmpty { root: root.to_path_buf() });
    }
    if existing == Existing::Refuse {
        return Err(DatasetError::AlreadyThere { root: root.to_path_buf() });
    }
    // Only a folder that is surely one of ours is cleared; a file called dataset.json is not enough.
    let old = Dataset::open(root).map_err(|error| match error {
        DatasetError::NotADataset { root } => DatasetError::NotEmpty { root },
        newer @ DatasetError::NewerFormat { .. } => newer,
        other => DatasetError::NotReplaced { root: root.to_path_buf(), reason: other.to_string() },
    })?;
    if let Existing::ReplaceKind(wanted) = existing
        && old.manifest.kind.as_deref() != Some(wanted)
    {
        return Err(DatasetError::OtherKind { root: root.to_path_buf(), kind: old.manifest.kind, wanted });
    }
    for dir in [RESULTS, FRAMES_DIR] {
        remove(fs::remove_dir_all(root.join(dir)), &root.join(dir))?;
    }
    // The manifest goes last, so that an interrupted removal can be repeated.
    for file in [SUMMARY, REPORT, EDGES, EVENTS, FRAMES, EXPERIMENT, MANIFEST] {
        remove(fs::remove_file(root.join(file)), &root.join(file))?;
    }
    Ok(())
}

fn remove(outcome: std::io::Result<()>, path: &Path) -> Result<(), DatasetError> {
    match outcome {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => Err(DatasetError::io(path, source)),
        _ => Ok(()),
    }
}
