//! The course of a long run: what it is at, how long that takes, and the numbers it keeps so that an interrupted
//! run goes on.

use crate::reproduce::ReproduceError;
use daic_dataset::atomic::write_bytes;
use daic_lightfield::{Psf, PsfParameters};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// What the numbers kept come from: those of other sources are not used again. Images also come from the operator,
/// which has tests of its own and may change them by its rounding alone.
const SOURCES: [&str; 6] = [
    include_str!("simulate.rs"),
    include_str!("../../../../host/crates/lightfield/src/psf.rs"),
    include_str!("../../../../host/crates/lightfield/src/debye.rs"),
    include_str!("../../../../host/crates/lightfield/src/lenslets.rs"),
    include_str!("../../../../host/crates/lightfield/src/optics.rs"),
    include_str!("../../../../host/crates/lightfield/src/propagate.rs"),
];
/// Time between two lines about the same stage.
const EVERY: Duration = Duration::from_secs(15);

/// A run.
pub struct Course<'a> {
    folder: Option<&'a Path>,
    said: &'a (dyn Fn(&str) + Sync),
    stages: usize,
    begun: AtomicUsize,
}

impl<'a> Course<'a> {
    /// A run of so many stages that keeps its numbers in a folder, if there is one.
    pub fn new(folder: Option<&'a Path>, stages: usize, said: &'a (dyn Fn(&str) + Sync)) -> Self {
        Self { folder, said, stages, begun: AtomicUsize::new(0) }
    }

    /// Says something.
    pub fn say(&self, what: &str) {
        (self.said)(what);
    }

    /// A stage: the numbers that `make` gives, with a line of text, or those kept of the same `key`.
    ///
    /// # Errors
    /// Those of `make`, and a file that cannot be written.
    pub fn stage(
        &self,
        what: &str,
        key: &str,
        make: impl FnOnce() -> Result<(String, Vec<f32>), ReproduceError>,
    ) -> Result<(String, Vec<f32>), ReproduceError> {
        let stage = self.begun.fetch_add(1, Ordering::Relaxed) + 1;
        let of = self.stages;
        let key = key.replace('\n', " ");
        let file = self.folder.map(|folder| {
            let mut hash = DefaultHasher::new();
            (SOURCES, &key).hash(&mut hash);
            folder.join(format!("{:016x}", hash.finish()))
        });
        if let Some(kept) = file.as_ref().and_then(|file| read(file, &key)) {
            self.say(&format!("[{stage} of {of}] {what}: kept from an earlier run"));
            return Ok(kept);
        }
        self.say(&format!("[{stage} of {of}] {what}"));
        let begin = Instant::now();
        let (text, numbers) = make()?;
        self.say(&format!("[{stage} of {of}] done in {:.0} s", begin.elapsed().as_secs_f64()));
        if let Some(file) = file {
            let mut bytes = format!("{key}\n{}\n", text.replace('\n', " ")).into_bytes();
            bytes.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
            write_bytes(&file, &bytes)?;
        }
        Ok((text, numbers))
    }

    /// A point spread function, with lines about its progress.
    ///
    /// # Errors
    /// As [`Psf::compute`].
    pub fn compute(&self, parameters: &PsfParameters) -> Result<Psf, ReproduceError> {
        let begin = Instant::now();
        let spoken = Mutex::new(begin);
        let progress = |done: usize, all: usize| {
            let Ok(mut spoken) = spoken.lock() else { return };
            if spoken.elapsed() >= EVERY {
                *spoken = Instant::now();
                let left = begin.elapsed().as_secs_f64() / done as f64 * (all - done) as f64;
                self.say(&format!("    {done} of {all} fields, {left:.0} s left"));
            }
        };
        Ok(Psf::compute_with(parameters, &progress)?)
    }

    /// A stage that is a point spread function.
    ///
    /// # Errors
    /// As [`Psf::compute`], and a file that cannot be written or is not what it was.
    pub fn psf(&self, what: &str, parameters: &PsfParameters) -> Result<Psf, ReproduceError> {
        let (text, values) = self.stage(what, &json(parameters)?, || {
            let psf = self.compute(parameters)?;
            let text = serde_json::to_string(&(&psf.report, psf.radius)).map_err(garbled)?;
            Ok((text, psf.values))
        })?;
        let (report, radius) = serde_json::from_str(&text).map_err(garbled)?;
        Ok(Psf::from_values(parameters.clone(), report, radius, values)?)
    }
}

/// Parameters as a key.
///
/// # Errors
/// None that numbers could give.
pub fn json(parameters: &PsfParameters) -> Result<String, ReproduceError> {
    serde_json::to_string(parameters).map_err(garbled)
}

/// A text that is not what was kept.
pub fn garbled(error: serde_json::Error) -> ReproduceError {
    ReproduceError::File { path: PathBuf::from("numbers kept"), source: error.into() }
}

/// Text and numbers of a file, if it is there, whole, and of this key.
fn read(file: &Path, key: &str) -> Option<(String, Vec<f32>)> {
    let bytes = std::fs::read(file).ok()?;
    let rest = bytes.strip_prefix(key.as_bytes())?.strip_prefix(b"\n")?;
    let end = rest.iter().position(|b| *b == b'\n')?;
    let text = String::from_utf8(rest.get(..end)?.to_vec()).ok()?;
    let (numbers, left) = rest.get(end + 1..)?.as_chunks::<4>();
    left.is_empty().then(|| (text, numbers.iter().map(|b| f32::from_le_bytes(*b)).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_kept_is_used_again_for_the_same_key_alone() {
        let folder = tempfile::TempDir::new().expect("folder");
        let course = Course::new(Some(folder.path()), 1, &|_| {});
        let ask = |key: &str, value: f32| {
            course.stage("a number", key, || Ok(("text".into(), vec![value, f32::NAN]))).expect("a stage")
        };
        let same = |a: &(String, Vec<f32>), value: f32| a.0 == "text" && a.1[0] == value && a.1[1].is_nan();
        assert!(same(&ask("one", 1.0), 1.0) && same(&ask("one", 2.0), 1.0) && same(&ask("two", 3.0), 3.0));
        // a file that is cut is not used
        for file in std::fs::read_dir(folder.path()).expect("folder") {
            let path = file.expect("file").path();
            let bytes = std::fs::read(&path).expect("bytes");
            std::fs::write(&path, &bytes[..bytes.len() - 3]).expect("written");
        }
        assert!(same(&ask("one", 4.0), 4.0));
    }
}
