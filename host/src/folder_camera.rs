//! A camera whose own program writes its frames into a folder.
//!
//! The folder holds `frames.jsonl`, a line per frame as it is written — `file`, `id`, `camera_ns`,
//! `bits` — after the image file itself is complete. `hil-sim --frames` writes this form; a few lines of
//! script do for any camera.

use daic_dataset::read_grey;
use daic_rig::camera::{Camera, CameraError, CameraInfo, CameraSettings, CameraStats, Frame, FrameError};
use serde::Deserialize;
use std::io::{BufRead as _, BufReader, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How often the list is looked at.
const POLL: Duration = Duration::from_millis(5);

#[derive(Deserialize)]
struct Line {
    file: String,
    id: u64,
    #[serde(default)]
    camera_ns: Option<u64>,
    #[serde(default)]
    bits: Option<u8>,
}

/// Watches a folder.
pub struct FolderCamera {
    info: CameraInfo,
    directory: PathBuf,
    /// Bytes of the list that are done with.
    position: u64,
    started: bool,
    stats: CameraStats,
}

impl FolderCamera {
    /// A camera that writes into `directory`; frames that are there already do not count.
    pub fn new(directory: &Path, sensor_px: [u32; 2]) -> Self {
        let name = directory.display().to_string();
        Self {
            info: CameraInfo {
                vendor: "folder".to_owned(),
                model: name,
                serial: String::new(),
                sensor_px,
                pixel_um: None,
                has_clock: true,
            },
            directory: directory.to_owned(),
            position: 0,
            started: false,
            stats: CameraStats::default(),
        }
    }

    fn list(&self) -> PathBuf {
        self.directory.join("frames.jsonl")
    }

    /// The next whole line, if there is one.
    fn line(&mut self) -> Option<String> {
        let mut file = std::fs::File::open(self.list()).ok()?;
        file.seek(SeekFrom::Start(self.position)).ok()?;
        let mut text = String::new();
        let length = BufReader::new(file).read_line(&mut text).ok()?;
        // a line without its end is still being written
        text.ends_with('\n').then(|| {
            self.position += length as u64;
            text
        })
    }

    fn frame(&self, text: &str) -> Option<Frame> {
        let line: Line = serde_json::from_str(text).ok()?;
        let image = read_grey(&self.directory.join(&line.file)).ok()?;
        Some(Frame {
            id: line.id,
            camera_ns: line.camera_ns,
            host: Instant::now(),
            width: image.width,
            height: image.height,
            bits: line.bits.unwrap_or(image.significant_bits),
            data: image.data,
        })
    }
}

impl Camera for FolderCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    /// The camera's own program sets it up: nothing can be asked of it here.
    fn configure(&mut self, settings: &CameraSettings) -> Result<CameraSettings, CameraError> {
        if !self.directory.is_dir() {
            return Err(CameraError::Absent { name: self.directory.display().to_string() });
        }
        Ok(*settings)
    }

    fn start(&mut self) -> Result<(), CameraError> {
        self.started = true;
        self.stats = CameraStats::default();
        self.position = std::fs::metadata(self.list()).map_or(0, |m| m.len());
        Ok(())
    }

    fn next(&mut self, timeout: Duration) -> Result<Frame, FrameError> {
        let until = Instant::now() + timeout;
        loop {
            if let Some(text) = self.line() {
                if let Some(frame) = self.frame(&text) {
                    self.stats.completed += 1;
                    return Ok(frame);
                }
                // a line that names no readable image is a frame that came with holes
                self.stats.failed += 1;
                return Err(FrameError::Incomplete {
                    id: self.stats.completed + self.stats.failed,
                    missing_bytes: 0,
                });
            }
            if Instant::now() >= until {
                return Err(FrameError::Timeout {
                    after_ms: u64::try_from(timeout.as_millis()).unwrap_or(u64::MAX),
                });
            }
            std::thread::sleep(POLL);
        }
    }

    fn stop(&mut self) -> Result<CameraStats, CameraError> {
        if !self.started {
            return Err(CameraError::WrongState { state: "stopped", wanted: "stop" });
        }
        self.started = false;
        Ok(self.stats)
    }
}
