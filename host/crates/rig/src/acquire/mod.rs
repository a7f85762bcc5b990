//! One run: load, arm, play, collect events and frames, pair them.

mod record;

pub use record::{FrameRecord, Run, TriggerRecord, triggers_of};

use crate::camera::{Camera, CameraSettings, CameraStats, Frame, FrameError};
use crate::clock::{ClockModel, ClockOptions, sample_period_ms};
use crate::compile::Compiled;
use crate::error::RigError;
use crate::link::{EventReader, Link, LinkError};
use crate::pairing::{PairingOptions, Stamp};
use daic_protocol::message::{Event, EventKind, Fault, State, Status};
use std::collections::HashSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

/// Why something recorded could not be kept.
pub type SinkError = Box<dyn std::error::Error + Send + Sync>;

/// Takes what is recorded, as it comes in.
pub trait FrameSink {
    /// A frame, in order of arrival.
    ///
    /// # Errors
    /// It cannot be kept; the run is stopped.
    fn frame(&mut self, frame: &Frame) -> Result<(), SinkError>;

    /// Events, in order.
    ///
    /// # Errors
    /// They cannot be kept; the run is stopped.
    fn events(&mut self, events: &[Event]) -> Result<(), SinkError>;
}

/// Throws everything away.
#[derive(Debug, Clone, Copy, Default)]
pub struct NullSink;

impl FrameSink for NullSink {
    fn frame(&mut self, _: &Frame) -> Result<(), SinkError> {
        Ok(())
    }
    fn events(&mut self, _: &[Event]) -> Result<(), SinkError> {
        Ok(())
    }
}

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Progress {
    /// A fault of an earlier run was cleared.
    FaultCleared(Fault),
    /// The program is in the box and armed; the camera waits.
    Armed,
    /// Playing.
    Running {
        /// Triggers played.
        triggers: usize,
        /// Frames arrived.
        frames: usize,
        /// Frames planned.
        planned: usize,
    },
    /// The box is done; frames may still be on their way.
    Collecting {
        /// Frames arrived.
        frames: usize,
        /// Frames planned.
        planned: usize,
    },
}

/// How quickly frames reach the host; turns arrival into evidence for pairing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Latency {
    /// No frame is with the host sooner than this after its trigger.
    pub min: Duration,
    /// The quickest frame of a run is with the host within this.
    pub quickest: Duration,
    /// Every frame is with the host within this.
    pub max: Duration,
}

/// How a run is made.
#[derive(Debug, Clone, Copy)]
pub struct AcquireOptions {
    /// Between two requests for events; the box keeps 256.
    pub poll: Duration,
    /// How long to wait for the next frame once the box is done.
    pub frame_timeout: Duration,
    /// How long to look for frames too many once all are there.
    pub grace: Duration,
    /// Longest run; `None` waits for ever.
    pub run_timeout: Option<Duration>,
    /// Model of the box's clock; `None` takes no samples (a virtual clock keeps no time).
    pub clock: Option<ClockOptions>,
    /// Use arrival times for pairing; needs `clock`.
    pub latency: Option<Latency>,
    /// Clocks of camera and box.
    pub pairing: PairingOptions,
    /// Columns and rows that every frame must have, beside what the camera says of its sensor.
    pub size_px: Option<[u32; 2]>,
}

impl AcquireOptions {
    /// Polls every 10 ms, waits 5 s for frames, 50 ms for frames too many; no clock model.
    pub fn new(tick_hz: u32) -> Self {
        Self {
            poll: Duration::from_millis(10),
            frame_timeout: Duration::from_secs(5),
            grace: Duration::from_millis(50),
            run_timeout: None,
            clock: None,
            latency: None,
            pairing: PairingOptions::new(tick_hz),
            size_px: None,
        }
    }
}

/// Frames that wait for the sink; when it is full the camera's own buffer fills.
const QUEUE: usize = 16;

/// How long a run that was stopped may take to end its current instruction.
const STOP_PATIENCE: Duration = Duration::from_secs(2);
/// Between two looks at a box that is to end its run.
const STOP_POLL: Duration = Duration::from_millis(5);

/// Makes one run. `cancel` set to true stops it after the current instruction.
///
/// # Errors
/// [`RigError`]; the box was told to stop, the camera was stopped, and the sink holds everything
/// that came before.
#[allow(clippy::too_many_arguments)]
pub fn acquire(
    link: &mut Link,
    compiled: &Compiled,
    camera: &mut dyn Camera,
    settings: &CameraSettings,
    options: &AcquireOptions,
    sink: &mut dyn FrameSink,
    progress: &mut dyn FnMut(Progress),
    cancel: &AtomicBool,
) -> Result<Run, RigError> {
    let status = settled(link, cancel)?;
    match status.state {
        State::Faulted => {
            link.clear_fault()?;
            if let Some(fault) = status.fault {
                progress(Progress::FaultCleared(fault));
            }
        }
        State::Running => return Err(RigError::NotReady { state: status.state }),
        State::Empty | State::Loaded | State::Armed => {}
    }
    let sizes = [options.size_px, Some(camera.info().sensor_px).filter(|s| *s != [0, 0])];
    let hash = link.load(&compiled.program)?;
    link.arm(hash)?;
    let first_event = link.status()?.next_event;

    camera.configure(settings)?;
    camera.start()?;
    progress(Progress::Armed);
    let stop = AtomicBool::new(false);
    let mut collector = Collector {
        link,
        compiled,
        options,
        sink,
        progress,
        cancel,
        hash,
        sizes,
        events: Vec::new(),
        reader: EventReader::new(first_event),
        clock: options.clock.map(ClockModel::new),
        clock_error: None,
        stamps: Vec::new(),
        incomplete: Vec::new(),
    };
    let outcome = std::thread::scope(|scope| {
        let (sender, receiver) = sync_channel(QUEUE);
        let fetcher = &mut *camera;
        let stop = &stop;
        scope.spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                let next = fetcher.next(Duration::from_millis(50));
                let last = matches!(next, Err(FrameError::Exhausted | FrameError::Disconnected));
                let news = !matches!(next, Err(FrameError::Timeout { .. }));
                if (news && sender.send(next).is_err()) || last {
                    break;
                }
            }
        });
        let outcome = collector.run(&receiver);
        // Ends the fetcher, also where it waits for room in the queue.
        stop.store(true, Ordering::Relaxed);
        drop(receiver);
        outcome
    });
    if outcome.is_err() {
        collector.halt();
    }
    let finished = outcome.map(|()| collector.finish());
    let stats = camera.stop();
    let mut run = finished??;
    run.camera = stats?;
    Ok(run)
}

struct Collector<'a> {
    link: &'a mut Link,
    compiled: &'a Compiled,
    options: &'a AcquireOptions,
    sink: &'a mut dyn FrameSink,
    progress: &'a mut dyn FnMut(Progress),
    cancel: &'a AtomicBool,
    hash: u32,
    /// What every frame must measure, where it is known.
    sizes: [Option<[u32; 2]>; 2],
    events: Vec<Event>,
    reader: EventReader,
    clock: Option<ClockModel>,
    clock_error: Option<crate::clock::ClockError>,
    stamps: Vec<Stamp>,
    incomplete: Vec<u64>,
}

impl Collector<'_> {
    fn run(&mut self, frames: &Receiver<Result<Frame, FrameError>>) -> Result<(), RigError> {
        let planned = self.compiled.plan.frames.len();
        let mut samples = 0u64;
        let mut next_sample = Instant::now();
        // A first burst, so that the model is good before the first edge.
        while self.clock.is_some() && samples < 8 {
            self.sample()?;
            std::thread::sleep(Duration::from_millis(sample_period_ms(samples)));
            samples += 1;
        }
        self.link.start()?;
        let begin = Instant::now();
        let mut done = false;
        let mut open = true;
        let mut triggers = 0;
        let mut ids = HashSet::new();
        let mut last_news = Instant::now();
        loop {
            if open {
                open = self.fetch(frames, &mut ids, &mut last_news)?;
            } else {
                std::thread::sleep(self.options.poll);
            }
            if !done {
                let before = self.events.len();
                let result = self.reader.poll(self.link, &mut self.events);
                let news = self.events.get(before..).unwrap_or(&[]);
                if !news.is_empty() {
                    self.sink.events(news).map_err(|source| RigError::Sink { source })?;
                }
                result?;
                triggers += record::count_triggers(news, self.compiled.plan.camera_mask);
                done = judge(news, self.hash)?;
                if done {
                    last_news = Instant::now();
                }
                if self.clock.is_some() && Instant::now() >= next_sample {
                    self.sample()?;
                    next_sample = Instant::now() + Duration::from_millis(sample_period_ms(samples));
                    samples += 1;
                }
            }
            let (frames, all) = (self.stamps.len(), ids.len() >= planned);
            (self.progress)(if done {
                Progress::Collecting { frames, planned }
            } else {
                Progress::Running { triggers, frames, planned }
            });
            let quiet = last_news.elapsed();
            let enough = (all && quiet >= self.options.grace) || quiet >= self.options.frame_timeout;
            if done && (enough || !open) {
                return Ok(());
            }
            if self.cancel.load(Ordering::Relaxed) {
                return Err(RigError::Cancelled);
            }
            if !done && self.options.run_timeout.is_some_and(|limit| begin.elapsed() > limit) {
                let after_ms = u64::try_from(begin.elapsed().as_millis()).unwrap_or(u64::MAX);
                return Err(RigError::RunTimeout { after_ms });
            }
        }
    }

    /// Takes what frames are there, waiting at most one poll period; false when no more can come.
    fn fetch(
        &mut self,
        frames: &Receiver<Result<Frame, FrameError>>,
        ids: &mut HashSet<u64>,
        last_news: &mut Instant,
    ) -> Result<bool, RigError> {
        let mut wait = self.options.poll;
        // No more at once than the queue holds, so that events are read between.
        for _ in 0..QUEUE {
            match frames.recv_timeout(wait) {
                Ok(Ok(frame)) => {
                    let found = [frame.width, frame.height];
                    if let Some(expected) = self.sizes.into_iter().flatten().find(|size| *size != found) {
                        return Err(RigError::FrameSize { found, expected });
                    }
                    let host = frame.host.saturating_duration_since(self.link.epoch()).as_nanos();
                    let host_ns = Some(i64::try_from(host).unwrap_or(i64::MAX));
                    self.stamps.push(Stamp { id: frame.id, camera_ns: frame.camera_ns, host_ns });
                    ids.insert(frame.id);
                    *last_news = Instant::now();
                    self.sink.frame(&frame).map_err(|source| RigError::Sink { source })?;
                }
                Ok(Err(FrameError::Incomplete { id, .. })) => {
                    self.incomplete.push(id);
                    *last_news = Instant::now();
                }
                Ok(Err(FrameError::Exhausted)) | Err(RecvTimeoutError::Disconnected) => return Ok(false),
                Ok(Err(FrameError::Timeout { .. })) | Err(RecvTimeoutError::Timeout) => break,
                Ok(Err(error @ FrameError::Disconnected)) => return Err(error.into()),
            }
            wait = Duration::ZERO;
        }
        Ok(true)
    }

    fn sample(&mut self) -> Result<(), RigError> {
        if let (Some(sample), Some(model)) = (self.link.clock_sample()?, self.clock.as_mut()) {
            // A bad sample ends no run: the host times it would have given are refused instead.
            if let Err(error) = model.add(sample) {
                tracing::warn!(%error, "clock sample refused");
                self.clock_error = Some(error);
            }
        }
        Ok(())
    }

    /// Outputs safe, whatever went wrong, and the box ready for another run.
    fn halt(&mut self) {
        let stopped = match self.link.stop() {
            Ok(_) => self.wait_stopped(),
            Err(_) => self.link.abort().map(drop),
        };
        if let Err(error) = stopped {
            tracing::debug!(%error, "the box could not be stopped");
        }
    }

    /// `Stop` ends with the current instruction; one that takes too long is aborted.
    fn wait_stopped(&mut self) -> Result<(), LinkError> {
        let deadline = Instant::now() + STOP_PATIENCE;
        while self.link.status()?.state == State::Running {
            if Instant::now() >= deadline {
                return self.link.abort().map(drop);
            }
            // A simulated box plays on only as its events are read.
            self.reader.poll(self.link, &mut self.events)?;
            std::thread::sleep(STOP_POLL);
        }
        Ok(())
    }

    fn finish(self) -> Result<Run, RigError> {
        // One wrong sample says that the clocks are not what they were taken for.
        let clock = if self.clock_error.is_none() { self.clock } else { None };
        record::assemble(record::Parts {
            hello: self.link.hello().clone(),
            program: self.hash,
            plan: &self.compiled.plan,
            options: self.options,
            events: self.events,
            stamps: self.stamps,
            incomplete: self.incomplete,
            clock,
            link: self.link.stats(),
            camera: CameraStats::default(),
        })
    }
}

/// Status of the box; one that is just ending a run is waited for.
fn settled(link: &mut Link, cancel: &AtomicBool) -> Result<Status, RigError> {
    let deadline = Instant::now() + STOP_PATIENCE;
    loop {
        let status = link.status()?;
        if status.state != State::Running || Instant::now() >= deadline {
            return Ok(status);
        }
        if cancel.load(Ordering::Relaxed) {
            return Err(RigError::Cancelled);
        }
        std::thread::sleep(STOP_POLL);
    }
}

/// Whether the run has ended; an error if it ended badly.
fn judge(events: &[Event], hash: u32) -> Result<bool, RigError> {
    for event in events {
        match event.kind {
            EventKind::RunStarted { program, .. } if program != hash => {
                return Err(RigError::OtherProgram { running: program, loaded: hash });
            }
            EventKind::Faulted { cause, instruction } => {
                return Err(RigError::BoxFaulted { cause, tick: event.tick, instruction });
            }
            EventKind::RunDone { .. } => return Ok(true),
            _ => {}
        }
    }
    Ok(false)
}
