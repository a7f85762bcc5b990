//! Marks in the images of a camera as they arrive: what `daic align watch` does.

use super::{Mark, Step, orders, rail};
use crate::camera_file::CameraFile;
use crate::error::Error;
use crate::progress::Progress;
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

/// How often the folder is looked at.
const POLL: Duration = Duration::from_millis(50);

/// What is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Watched {
    /// An aperture or a laser spot against the principal point.
    Mark(Mark),
    /// The spots of orders −1, 0, +1.
    Orders,
}

/// When to stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Until {
    /// After so many images, aligned or not.
    pub images: Option<usize>,
    /// When no image has come for so long.
    pub idle: Duration,
}

/// One image.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sight {
    /// The file.
    pub image: String,
    /// What to do; why there is nothing to say, if the mark was not found.
    pub advice: Vec<String>,
    /// Whether it is aligned.
    pub aligned: bool,
    /// Whether the mark was found.
    pub found: bool,
}

/// The newest image that has not been looked at; with it all older ones are passed over.
fn newest(folder: &Path, seen: &mut BTreeSet<PathBuf>) -> Result<Option<PathBuf>, Error> {
    let mut found: Option<(SystemTime, PathBuf)> = None;
    for path in crate::frames::listed(folder)? {
        if seen.contains(&path) {
            continue;
        }
        // a file that is gone again was a temporary one
        let Ok(changed) = std::fs::metadata(&path).and_then(|m| m.modified()) else { continue };
        if found.as_ref().is_none_or(|(time, name)| (*time, name) < (changed, &path)) {
            found = Some((changed, path.clone()));
        }
        seen.insert(path);
    }
    Ok(found.map(|(_, path)| path))
}

fn step_of<T>(step: Step<T>) -> (Vec<String>, bool) {
    (step.advice, step.aligned)
}

fn look(camera: &CameraFile, what: Watched, image: &Path) -> Result<(Vec<String>, bool), Error> {
    match what {
        Watched::Mark(mark) => rail(camera, mark, image, None, None).map(step_of),
        Watched::Orders => orders(camera, image, None, None).map(step_of),
    }
}

/// Looks at every new image of `folder`, the newest first, and tells `say` what it shows; ends when the mark is where it
/// should be, or with [`Until`], or when a stop is requested.
///
/// An image that cannot be read yet is looked at again; one without the mark is a [`Sight`] that says so.
///
/// # Errors
/// A folder that cannot be read, or into which no image came ([`Error::NoImageCame`]).
pub fn watch(
    camera: &CameraFile,
    what: Watched,
    folder: &Path,
    until: Until,
    progress: &dyn Progress,
    say: &mut dyn FnMut(&Sight),
) -> Result<Vec<Sight>, Error> {
    let mut seen = BTreeSet::new();
    let mut sights = Vec::new();
    let mut last = Instant::now();
    while !progress.stop_requested().load(Ordering::Relaxed) {
        let Some(image) = newest(folder, &mut seen)? else {
            if last.elapsed() < until.idle {
                std::thread::sleep(POLL);
                continue;
            }
            if sights.is_empty() {
                return Err(Error::NoImageCame {
                    folder: folder.to_owned(),
                    seconds: until.idle.as_secs_f64(),
                });
            }
            break;
        };
        let sight = match look(camera, what, &image) {
            Ok((advice, aligned)) => {
                Sight { image: image.display().to_string(), advice, aligned, found: true }
            }
            Err(Error::Align { source, .. }) => Sight {
                image: image.display().to_string(),
                advice: vec![source.to_string()],
                aligned: false,
                found: false,
            },
            // still being written: again, until it is old
            Err(_) if last.elapsed() < until.idle => {
                seen.remove(&image);
                std::thread::sleep(POLL);
                continue;
            }
            Err(error) => return Err(error),
        };
        last = Instant::now();
        say(&sight);
        let done = sight.aligned || until.images.is_some_and(|n| sights.len() + 1 >= n);
        sights.push(sight);
        if done {
            break;
        }
    }
    Ok(sights)
}
