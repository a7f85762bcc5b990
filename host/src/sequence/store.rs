//! The folder of a sequence: whose results are in it, and how far they go.

use crate::error::Error;
use daic_correlate::SequenceState;
use daic_dataset::atomic;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

const CRC: crc::Crc<u64> = crc::Crc::<u64>::new(&crc::CRC_64_XZ);
/// In front of the stored state.
const MAGIC: &[u8; 8] = b"daicseq1";
const HEADER: &str = "sequence.json";
const SUMMARY: &str = "summary.json";
const STATE: &str = "resume.bin";
const FRAMES: &str = "frames";

/// What is known of one frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameEntry {
    /// Number; the first image is 0.
    pub frame: usize,
    /// File name of the image.
    pub file: String,
    /// Over the content of the image file; none if it could not be read.
    pub key: Option<String>,
    /// Table of its points, relative to the output folder.
    pub table: Option<String>,
    /// Number of the frame with which it was correlated.
    pub reference: u32,
    /// Points.
    pub points: usize,
    /// Points that are `ok`.
    pub converged: usize,
    /// Mean displacement along x over the points that are `ok`, pixels.
    pub mean_u_px: Option<f64>,
    /// Scatter of the same over the points.
    pub std_u_px: Option<f64>,
    /// Mean displacement along y, pixels.
    pub mean_v_px: Option<f64>,
    /// Scatter of the same over the points.
    pub std_v_px: Option<f64>,
    /// Why the frame could not be used.
    pub failed: Option<String>,
}

impl FrameEntry {
    pub(super) fn of(frame: usize, file: String, key: Option<String>) -> Self {
        Self {
            frame,
            file,
            key,
            table: None,
            reference: 0,
            points: 0,
            converged: 0,
            mean_u_px: None,
            std_u_px: None,
            mean_v_px: None,
            std_v_px: None,
            failed: None,
        }
    }
}

/// A stored run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Resumed {
    /// Frames treated.
    pub entries: Vec<FrameEntry>,
    /// What the sequence hands to the next frame.
    pub state: SequenceState,
}

/// The same, to be written.
#[derive(Serialize)]
struct Stored<'a> {
    entries: &'a [FrameEntry],
    state: &'a SequenceState,
}

/// An output folder that belongs to this run.
pub(super) struct Store {
    out: PathBuf,
    header: serde_json::Value,
    entries: Vec<FrameEntry>,
}

impl Store {
    /// Takes the folder, or finds why it cannot be taken.
    pub(super) fn open(out: &Path, header: serde_json::Value, overwrite: bool) -> Result<Self, Error> {
        let path = out.join(HEADER);
        let store = Self { out: out.to_owned(), header, entries: Vec::new() };
        let mut text = serde_json::to_vec_pretty(&store.header)
            .map_err(|source| Error::Unwritable { path: path.clone(), reason: source.to_string() })?;
        text.push(b'\n');
        match std::fs::read(&path) {
            Ok(old) if overwrite && is_sequence(&old) => {
                // in this order an interruption leaves nothing that looks whole
                for file in [STATE, SUMMARY, HEADER] {
                    remove(std::fs::remove_file(out.join(file)), &out.join(file))?;
                }
                remove(std::fs::remove_dir_all(out.join(FRAMES)), &out.join(FRAMES))?;
            }
            Ok(old) if old == text => return Ok(store),
            Ok(old) if is_sequence(&old) => {
                return Err(Error::SequenceDiffers { path, what: differing(&old, &store.header) });
            }
            Ok(_) => return Err(Error::FolderTaken { path: out.to_owned() }),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                let mut content = std::fs::read_dir(out).into_iter().flatten();
                if content.next().is_some() {
                    return Err(Error::FolderTaken { path: out.to_owned() });
                }
            }
            Err(source) => return Err(Error::Read { path, source }),
        }
        std::fs::create_dir_all(out).map_err(|source| Error::Folder { path: out.to_owned(), source })?;
        atomic::write_bytes(&path, &text)?;
        Ok(store)
    }

    pub(super) fn header(&self) -> &serde_json::Value {
        &self.header
    }

    pub(super) fn entries(&self) -> &[FrameEntry] {
        &self.entries
    }

    /// Name of a frame's table, relative to the folder.
    pub(super) fn table_name(&self, number: usize, image: &Path) -> String {
        let stem = image.file_stem().unwrap_or_default().to_string_lossy();
        format!("{FRAMES}/{number:04}_{stem}.csv")
    }

    /// The stored run, if there is one; its frames must be the first ones of `frames`, unchanged.
    pub(super) fn resumed(
        &mut self,
        frames: &[PathBuf],
        key: impl Fn(&Path) -> Result<String, Error>,
    ) -> Result<Option<Resumed>, Error> {
        let path = self.out.join(STATE);
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(Error::Read { path, source }),
        };
        let stored = decode(&bytes).ok_or_else(|| Error::ResumeDamaged { path: path.clone() })?;
        let state = &stored.state;
        if stored.entries.len() != state.frame() as usize
            || state.reference() > state.frame()
            || state.candidate() > state.frame()
        {
            return Err(Error::ResumeDamaged { path });
        }
        for entry in &stored.entries {
            let changed = |reason: &'static str| Error::ResumeFrame {
                frame: entry.frame,
                file: entry.file.clone(),
                out: self.out.clone(),
                reason,
            };
            let file = frames.get(entry.frame - 1).ok_or_else(|| changed("is not given any more"))?;
            if file.file_name().is_none_or(|name| name.to_string_lossy() != entry.file) {
                return Err(changed("is now another file"));
            }
            if key(file).ok() != entry.key {
                return Err(changed("has changed since"));
            }
            if entry.table.as_ref().is_some_and(|t| !self.out.join(t).is_file()) {
                return Err(changed("has lost its table"));
            }
        }
        self.entries.clone_from(&stored.entries);
        Ok(Some(stored))
    }

    /// States that a frame is done; its table must be written before.
    pub(super) fn push(&mut self, entry: FrameEntry, state: &SequenceState) -> Result<(), Error> {
        self.entries.push(entry);
        let path = self.out.join(STATE);
        let stored = Stored { entries: &self.entries, state };
        let mut bytes = postcard::to_extend(&stored, MAGIC.to_vec())
            .map_err(|error| Error::Unwritable { path: path.clone(), reason: error.to_string() })?;
        let sum = CRC.checksum(&bytes);
        bytes.extend_from_slice(&sum.to_le_bytes());
        Ok(atomic::write_bytes(&path, &bytes)?)
    }
}

fn decode(bytes: &[u8]) -> Option<Resumed> {
    let (content, sum) = bytes.split_last_chunk::<8>()?;
    if CRC.checksum(content) != u64::from_le_bytes(*sum) {
        return None;
    }
    let (stored, rest) = postcard::take_from_bytes::<Resumed>(content.strip_prefix(MAGIC)?).ok()?;
    // frames count from 1, in order
    let ordered = stored.entries.iter().zip(1..).all(|(e, n)| e.frame == n);
    (rest.is_empty() && ordered).then_some(stored)
}

fn is_sequence(header: &[u8]) -> bool {
    serde_json::from_slice::<serde_json::Value>(header)
        .is_ok_and(|v| v.get("format").is_some_and(|f| f == "daic-sequence"))
}

/// Names of what two headers say differently, with both values.
fn differing(old: &[u8], new: &serde_json::Value) -> String {
    let old: serde_json::Value = serde_json::from_slice(old).unwrap_or_default();
    let mut found = Vec::new();
    compare("", &old, new, &mut found);
    if found.is_empty() { "the form of the file".to_owned() } else { found.join(", ") }
}

fn compare(name: &str, old: &serde_json::Value, new: &serde_json::Value, found: &mut Vec<String>) {
    match (old.as_object(), new.as_object()) {
        (Some(a), Some(b)) => {
            let null = serde_json::Value::Null;
            let names: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            for key in names {
                let full = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
                compare(&full, a.get(key).unwrap_or(&null), b.get(key).unwrap_or(&null), found);
            }
        }
        _ if old != new => found.push(format!("{name} was {old}, is {new}")),
        _ => {}
    }
}

fn remove(result: std::io::Result<()>, path: &Path) -> Result<(), Error> {
    match result {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            Err(Error::Folder { path: path.to_owned(), source })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damaged_states_are_no_states() {
        for bytes in [&b""[..], b"daicseq1", b"daicseq1\0\0\0\0\0\0\0\0", &[0xff; 64]] {
            assert!(decode(bytes).is_none());
        }
        // an empty list and a state cut short, with a right sum
        let mut bytes = MAGIC.to_vec();
        bytes.extend([0, 1]);
        let sum = CRC.checksum(&bytes);
        bytes.extend(sum.to_le_bytes());
        assert!(decode(&bytes).is_none());
    }

    #[test]
    fn differences_are_named() {
        let old = br#"{"format":"daic-sequence","settings":{"subset":33},"step":5}"#;
        let new = serde_json::json!({"format":"daic-sequence","settings":{"subset":21},"step":5});
        assert_eq!(differing(old, &new), "settings.subset was 33, is 21");
    }
}
