//! The whole simulated rig: start it, reach it, take its frames, ask for the truth, stop it.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, channel, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::board::{BoardThread, Shared, Truth, lock};
use crate::config::SimConfig;
use crate::error::SimError;
use crate::frame::{Imager, SimFrame};
use crate::record::Record;
use crate::transport::{self, DuplexEnd, Transport};
use crate::world::ExposureRecord;

/// Frames that wait for the host before rendering pauses.
const FRAMES_WAITING: usize = 8;

/// A running simulated rig. Dropping it stops it.
pub struct SimRig {
    port: String,
    connector: Option<transport::Connector>,
    shared: Arc<Shared>,
    frames: Option<Receiver<SimFrame>>,
    threads: Vec<JoinHandle<()>>,
}

impl std::fmt::Debug for SimRig {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SimRig").field("port", &self.port).finish_non_exhaustive()
    }
}

impl SimRig {
    /// Starts the rig and offers its box over `transport`.
    ///
    /// # Errors
    /// If the configuration is refused, the height map cannot be read, or the port cannot be opened.
    pub fn start(config: SimConfig, transport: Transport) -> Result<Self, SimError> {
        let mut imager = Imager::new(&config)?;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(config.threads)
            .thread_name(|i| format!("sim-render-{i}"))
            .build()
            .map_err(|e| SimError::Thread { cause: std::io::Error::other(e) })?;
        let opened = transport::open(&transport)?;
        let shared = Arc::new(Shared::new());
        let (to_imager, exposures) = channel();
        let (to_host, frames) = sync_channel(FRAMES_WAITING);
        let board = BoardThread::new(&config, opened.link, to_imager, Arc::clone(&shared));
        let mut rig = Self {
            port: opened.port,
            connector: opened.connector,
            shared: Arc::clone(&shared),
            frames: Some(frames),
            threads: Vec::new(),
        };
        rig.spawn("sim-board", move || board.run())?;
        let faults = config.faults;
        rig.spawn("sim-camera", move || {
            while let Ok(exposure) = exposures.recv() {
                let copies = if faults.drop_frames.contains(&exposure.id) {
                    0
                } else {
                    1 + usize::from(faults.duplicate_frames.contains(&exposure.id))
                };
                if copies > 0 && !shared.stopping() && shared.rendering() {
                    deliver(&pool, &mut imager, &exposure, copies, &to_host, &shared);
                }
                shared.pending.fetch_sub(1, Ordering::SeqCst);
            }
        })?;
        Ok(rig)
    }

    fn spawn(&mut self, name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), SimError> {
        let thread = std::thread::Builder::new().name(name.to_owned()).spawn(work);
        self.threads.push(thread.map_err(|cause| SimError::Thread { cause })?);
        Ok(())
    }

    /// Where the box is: a device path, `tcp://host:port`, or "in-process".
    pub fn port(&self) -> &str {
        &self.port
    }

    /// A host's end of an in-process rig, its input empty; `None` for the other transports. Hosts
    /// may connect one after the other.
    pub fn connect(&self) -> Option<DuplexEnd> {
        self.connector.as_ref().map(transport::Connector::connect)
    }

    /// The next frame, in the order of exposure; waits for it up to `timeout`.
    ///
    /// # Errors
    /// [`RecvTimeoutError::Timeout`] if none came in time, [`RecvTimeoutError::Disconnected`] if the
    /// frames have been taken by [`SimRig::take_frames`].
    pub fn next_frame(&self, timeout: Duration) -> Result<SimFrame, RecvTimeoutError> {
        self.frames.as_ref().ok_or(RecvTimeoutError::Disconnected)?.recv_timeout(timeout)
    }

    /// The stream of frames, to be used from another thread. It can be taken once.
    pub fn take_frames(&mut self) -> Option<Receiver<SimFrame>> {
        self.frames.take()
    }

    /// Exposures that have ended and whose frames are not yet in the stream.
    ///
    /// 0 after the end of a run (in stepped mode: after any answer that followed it) means that
    /// every frame there will be is already waiting in the stream.
    pub fn frames_in_work(&self) -> u64 {
        self.shared.pending.load(Ordering::SeqCst)
    }

    /// Whether exposures become frames; without anybody to take them that is wasted work.
    pub fn set_rendering(&self, on: bool) {
        self.shared.render.store(on, Ordering::Relaxed);
    }

    /// Sets the exposure of the camera in nanoseconds (at least 8), from the next trigger on.
    pub fn set_exposure(&self, ns: u64) {
        self.shared.exposure_ns.store(ns.max(8), Ordering::Relaxed);
    }

    /// Sets the levels of trigger inputs (bits 0 to 7) and interlock (bit 24, high = closed).
    pub fn set_inputs(&self, word: u32) {
        self.shared.inputs.store(u64::from(word), Ordering::Relaxed);
    }

    /// Every word put out so far as (tick, word). Ticks count from the start of the rig, which is
    /// also the first boot of the box.
    pub fn played(&self) -> Vec<(u64, u32)> {
        lock(&self.shared.record).words.clone()
    }

    /// Words and levels put out so far.
    pub fn record(&self) -> Record {
        lock(&self.shared.record).clone()
    }

    /// Where everything really is.
    pub fn truth(&self) -> Truth {
        lock(&self.shared.truth).clone()
    }

    /// Resets the box, as its watchdog would: outputs off, program gone, a new boot id.
    pub fn reset_board(&self) {
        self.shared.reset.store(true, Ordering::Relaxed);
    }

    /// Lets the box receive but say nothing, or speak again.
    pub fn set_silent(&self, silent: bool) {
        self.shared.silent.store(silent, Ordering::Relaxed);
    }

    /// Stops all threads and removes the port.
    pub fn stop(mut self) {
        self.shut_down();
    }

    fn shut_down(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A panic there has been printed by its own thread.
            thread.join().ok();
        }
    }
}

impl Drop for SimRig {
    fn drop(&mut self) {
        self.shut_down();
    }
}

/// Renders a frame and puts it into the stream; waits while that is full.
fn deliver(
    pool: &rayon::ThreadPool,
    imager: &mut Imager,
    exposure: &ExposureRecord,
    copies: usize,
    to_host: &SyncSender<SimFrame>,
    shared: &Shared,
) {
    let frame = pool.install(|| imager.frame(exposure));
    for copy in std::iter::repeat_n(frame, copies) {
        let mut waiting = copy;
        loop {
            match to_host.try_send(waiting) {
                Ok(()) | Err(TrySendError::Disconnected(_)) => break,
                Err(TrySendError::Full(_)) if shared.stopping() => return,
                Err(TrySendError::Full(frame)) => waiting = frame,
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
