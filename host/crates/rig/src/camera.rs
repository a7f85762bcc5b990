//! What a camera must do, and a camera that replays frames from memory.

use crate::units::Time;
use std::collections::VecDeque;
use std::time::{Duration, Instant};
use thiserror::Error;

/// What a camera is.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraInfo {
    /// Who made it.
    pub vendor: String,
    /// Which model.
    pub model: String,
    /// Serial number.
    pub serial: String,
    /// Sensor columns and rows.
    pub sensor_px: [u32; 2],
    /// Pitch of the pixels in micrometres, if known.
    pub pixel_um: Option<f64>,
    /// Whether frames carry a time of the camera's own clock.
    pub has_clock: bool,
}

/// What a camera is asked for, and what it has really set.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraSettings {
    /// How long the sensor integrates.
    pub exposure: Time,
    /// Significant bits of a grey level, 8…16.
    pub bits: u8,
    /// Frames begin with an edge of the trigger line rather than by themselves.
    pub hardware_trigger: bool,
}

/// One image and when it was taken.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The camera's frame counter, unwrapped to 64 bits.
    pub id: u64,
    /// Begin of the exposure by the camera's own clock, in nanoseconds.
    pub camera_ns: Option<u64>,
    /// When the host had it.
    pub host: Instant,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Significant bits of a grey level.
    pub bits: u8,
    /// Grey levels, row by row, `width · height` of them.
    pub data: Vec<u16>,
}

/// A frame did not come.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum FrameError {
    /// No frame within the time given. Not an error of the camera.
    #[error("no frame within {after_ms} ms")]
    Timeout {
        /// Time waited.
        after_ms: u64,
    },
    /// A frame came with holes and was thrown away.
    #[error(
        "frame {id} came incomplete ({missing_bytes} bytes missing); use a faster cable or a lower frame rate"
    )]
    Incomplete {
        /// Its number.
        id: u64,
        /// Bytes that did not come.
        missing_bytes: u64,
    },
    /// The camera has no more frames to give, ever.
    #[error("the camera has no more frames")]
    Exhausted,
    /// The camera is gone.
    #[error("the camera was disconnected; check its cable and power")]
    Disconnected,
}

/// A camera refuses or fails.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum CameraError {
    /// No such camera.
    #[error("no camera {name}; connect it, or choose another source")]
    Absent {
        /// The camera asked for.
        name: String,
    },
    /// A setting that the camera does not have.
    #[error("the camera does not do {setting} = {value}; allowed: {allowed}")]
    Setting {
        /// Which.
        setting: &'static str,
        /// Asked for.
        value: String,
        /// What it does.
        allowed: String,
    },
    /// Not possible now, such as stopping a camera that is not started.
    #[error("the camera is {state}; {wanted} is not possible now")]
    WrongState {
        /// What it is doing.
        state: &'static str,
        /// What was asked.
        wanted: &'static str,
    },
    /// The camera is gone.
    #[error("the camera was disconnected; check its cable and power")]
    Disconnected,
}

/// Counters of one recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CameraStats {
    /// Frames given.
    pub completed: u64,
    /// Frames that came incomplete.
    pub failed: u64,
    /// Frames lost because nobody fetched them in time.
    pub overrun: u64,
}

/// A camera: object safe, blocking, owned by one thread.
pub trait Camera: Send {
    /// What it is.
    fn info(&self) -> &CameraInfo;

    /// Sets it up; returns what was really set.
    ///
    /// # Errors
    /// [`CameraError`]; the old settings stay.
    fn configure(&mut self, settings: &CameraSettings) -> Result<CameraSettings, CameraError>;

    /// Frames may come from now on.
    ///
    /// # Errors
    /// [`CameraError`].
    fn start(&mut self) -> Result<(), CameraError>;

    /// The next frame, waiting at most `timeout`.
    ///
    /// # Errors
    /// [`FrameError`]; after [`FrameError::Timeout`] and [`FrameError::Incomplete`] more may come.
    fn next(&mut self, timeout: Duration) -> Result<Frame, FrameError>;

    /// No more frames.
    ///
    /// # Errors
    /// [`CameraError`].
    fn stop(&mut self) -> Result<CameraStats, CameraError>;
}

/// Gives frames from memory, in the order given, as fast as they are fetched.
#[derive(Debug, Clone)]
pub struct ReplayCamera {
    info: CameraInfo,
    frames: VecDeque<Result<Frame, FrameError>>,
    running: bool,
    stats: CameraStats,
}

impl ReplayCamera {
    /// A camera that gives `frames`.
    pub fn new(frames: Vec<Frame>) -> Self {
        Self::with_faults(frames.into_iter().map(Ok).collect())
    }

    /// A camera that gives frames and failures.
    pub fn with_faults(frames: Vec<Result<Frame, FrameError>>) -> Self {
        let first = frames.iter().find_map(|f| f.as_ref().ok());
        let info = CameraInfo {
            vendor: "daic".to_owned(),
            model: "replay".to_owned(),
            serial: "0".to_owned(),
            sensor_px: first.map_or([0, 0], |f| [f.width, f.height]),
            pixel_um: None,
            has_clock: first.is_some_and(|f| f.camera_ns.is_some()),
        };
        Self { info, frames: frames.into(), running: false, stats: CameraStats::default() }
    }
}

impl Camera for ReplayCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }
    fn configure(&mut self, settings: &CameraSettings) -> Result<CameraSettings, CameraError> {
        Ok(*settings)
    }
    fn start(&mut self) -> Result<(), CameraError> {
        if self.running {
            return Err(CameraError::WrongState { state: "running", wanted: "start" });
        }
        self.running = true;
        Ok(())
    }
    fn next(&mut self, _: Duration) -> Result<Frame, FrameError> {
        if !self.running {
            return Err(FrameError::Disconnected);
        }
        let next = self.frames.pop_front().unwrap_or(Err(FrameError::Exhausted));
        match &next {
            Ok(_) => self.stats.completed += 1,
            Err(FrameError::Incomplete { .. }) => self.stats.failed += 1,
            Err(_) => {}
        }
        next.map(|frame| Frame { host: Instant::now(), ..frame })
    }
    fn stop(&mut self) -> Result<CameraStats, CameraError> {
        if !self.running {
            return Err(CameraError::WrongState { state: "stopped", wanted: "stop" });
        }
        self.running = false;
        Ok(self.stats)
    }
}
