//! The real controller on a virtual clock.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use daic_firmware::{AxisLimits, Board, Controller, Homing, LedLimits, Overdrive, Sink};
use daic_protocol::channels::{self, AXES, LEDS, SAFE_WORD};
use daic_protocol::limits::{EVENT_RING, EVENTS_PER_REPLY, MAX_SLOTS, STREAM_BYTES, TICK_HZ};
use daic_protocol::message::{Autostart, Capabilities, SlotError, SlotInfo, State};
use daic_protocol::program::ProgramBytes;

use crate::config::{BoardConfig, ClockMode, FaultsConfig, HomeConfig, OverdriveConfig, SimConfig};
use crate::hash::mix;
use crate::record::Record;
use crate::slots::Slots;
use crate::transport::Link;
use crate::world::{ExposureRecord, Wiring, World};

/// In stepped mode a program is played for so many virtual seconds before the link is polled in between.
pub const STEPPED_PATIENCE_S: f64 = 60.0;

/// Unread events of a run at which stepped time stands still until a host reads: what is left of the
/// ring takes what one tick brings, and keeps the last replies' events for a host that asks again.
const UNREAD_MAX: u32 = (EVENT_RING - 4 * EVENTS_PER_REPLY) as u32;
/// Bytes of a stream below which stepped time stands still until more come.
const STREAM_LOW: u32 = STREAM_BYTES as u32 / 2;
/// Without a host that reads or sends, stepped time stands still no longer than this (by the wall clock).
const UNREAD_PATIENCE: Duration = Duration::from_secs(5);

/// Longest sleep of the loop, which bounds the delay of a stop.
const NAP: Duration = Duration::from_millis(10);
/// Outputs or events played between two looks at the link once patience has run out.
const SLICE: usize = 4096;

/// State of the simulated rig that no part of it could know by itself.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Truth {
    /// Ticks since the rig started; unlike the box's own count it goes on when the box is reset.
    pub tick: u64,
    /// Steps made by each axis since the rig started.
    pub stage_steps: [i64; AXES as usize],
    /// Where the stage stands: x right, y down, h towards the camera.
    pub stage_mm: [f64; 3],
    /// Exposures begun.
    pub exposures: u64,
    /// Triggers that came while the camera was busy, and had no effect.
    pub missed_triggers: u64,
    /// Times the box has booted.
    pub boots: u32,
}

/// What board thread and rig share.
#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) stop: AtomicBool,
    pub(crate) reset: AtomicBool,
    pub(crate) silent: AtomicBool,
    pub(crate) render: AtomicBool,
    /// New exposure in nanoseconds, 0 for none.
    pub(crate) exposure_ns: AtomicU64,
    /// New levels of trigger inputs and interlock, `u64::MAX` for none.
    pub(crate) inputs: AtomicU64,
    /// Exposures ended and not yet turned into frames.
    pub(crate) pending: AtomicU64,
    pub(crate) record: Mutex<Record>,
    pub(crate) truth: Mutex<Truth>,
}

impl Shared {
    pub(crate) fn new() -> Self {
        Self {
            stop: AtomicBool::new(false),
            reset: AtomicBool::new(false),
            silent: AtomicBool::new(false),
            render: AtomicBool::new(true),
            exposure_ns: AtomicU64::new(0),
            inputs: AtomicU64::new(u64::MAX),
            pending: AtomicU64::new(0),
            record: Mutex::default(),
            truth: Mutex::new(Truth {
                tick: 0,
                stage_steps: [0; AXES as usize],
                stage_mm: [0.0; 3],
                exposures: 0,
                missed_triggers: 0,
                boots: 1,
            }),
        }
    }

    pub(crate) fn rendering(&self) -> bool {
        self.render.load(Ordering::Relaxed)
    }

    pub(crate) fn stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// The data behind the lock are whole after any panic.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Passes what the controller puts out to the world and the record.
struct Wires<'a> {
    world: &'a mut World,
    record: MutexGuard<'a, Record>,
    slots: &'a mut Slots,
    boot_tick: u64,
}

impl Sink for Wires<'_> {
    fn word(&mut self, tick: u64, word: u32) {
        let tick = self.boot_tick.saturating_add(tick);
        self.world.word(tick, word);
        self.record.word(tick, word);
    }
    fn level(&mut self, tick: u64, led: u8, level: u16) {
        let tick = self.boot_tick.saturating_add(tick);
        self.world.level(tick, led, level);
        self.record.levels.push((tick, led, level));
    }
    fn store(&mut self, slot: u8, program: &[u8], autostart: Autostart) -> Result<(), SlotError> {
        self.slots.store(slot, program, autostart)
    }
    fn fetch(&mut self, slot: u8, program: &mut ProgramBytes) -> Result<(), SlotError> {
        self.slots.fetch(slot, program)
    }
    fn erase(&mut self, slot: u8) -> Result<(), SlotError> {
        self.slots.erase(slot)
    }
    fn slots(&mut self) -> heapless::Vec<SlotInfo, MAX_SLOTS> {
        self.slots.list()
    }
}

pub(crate) struct BoardThread {
    config: SimConfig,
    controller: Controller,
    world: World,
    wiring: Wiring,
    slots: Slots,
    link: Box<dyn Link>,
    exposures: Sender<ExposureRecord>,
    shared: Arc<Shared>,
    /// Simulated time in ticks since the rig started.
    now: u64,
    /// When the box last booted; its own ticks count from there.
    boot_tick: u64,
    boots: u32,
    answered: u32,
    reading: Reading,
    /// Trigger inputs as they were last seen.
    inputs: u32,
}

/// Whether the host keeps up with reading events and sending a stream.
#[derive(Debug, Default)]
struct Reading {
    /// Sequence number of the run's first event.
    first: u32,
    /// Where reading stood when last looked at.
    read: u32,
    /// Bytes of a stream that had come when last looked at.
    received: Option<u32>,
    /// Since when stepped time stands still.
    held: Option<Instant>,
    /// Patience has run out, and nothing has been read since.
    given_up: bool,
}

impl Reading {
    /// Whether playing on may overwrite what a host has yet to read, or play what it has yet to send.
    fn behind(&mut self, next: u32, read: u32, received: Option<u32>, dry: bool) -> bool {
        if (read, received) != (self.read, self.received) {
            *self = Self { first: self.first, read, received, ..Self::default() };
        }
        // Sequence numbers wrap; what came before the run does not count.
        let unread = next.wrapping_sub(self.first).min(next.wrapping_sub(read));
        if self.given_up || (unread < UNREAD_MAX && !dry) {
            self.held = None;
            return false;
        }
        self.given_up = self.held.get_or_insert_with(Instant::now).elapsed() >= UNREAD_PATIENCE;
        !self.given_up
    }
}

impl BoardThread {
    pub(crate) fn new(
        config: &SimConfig,
        link: Box<dyn Link>,
        exposures: Sender<ExposureRecord>,
        shared: Arc<Shared>,
    ) -> Self {
        Self {
            controller: boot(config, 1),
            world: World::new(config),
            wiring: Wiring::new(&config.board),
            slots: Slots::new(config.board.slots),
            config: config.clone(),
            link,
            exposures,
            shared,
            now: 0,
            boot_tick: 0,
            boots: 1,
            answered: 0,
            reading: Reading::default(),
            inputs: 0,
        }
    }

    /// Runs until the rig stops.
    pub(crate) fn run(mut self) {
        match self.config.clock {
            ClockMode::Stepped { baud } => {
                let byte_ticks = (10 * u64::from(TICK_HZ)).div_ceil(u64::from(baud));
                self.run_stepped(byte_ticks);
            }
            ClockMode::Wall { rate } => self.run_wall(rate),
        }
        self.link.drain();
    }

    fn run_stepped(&mut self, byte_ticks: u64) {
        let mut buffer = [0; 1024];
        while !self.shared.stopping() {
            self.take_commands();
            let nap = if self.due().is_some() && !self.held() {
                self.play_on(SLICE, 0);
                Duration::ZERO
            } else {
                NAP
            };
            let count = self.link.read(&mut buffer, nap);
            self.before_bytes();
            for &byte in &buffer[..count] {
                // Byte by byte, so that nothing depends on how the stream was cut.
                self.pass(byte_ticks);
                let idle = self.due().is_none();
                let answer = self.receive(&[byte]);
                let started = idle && self.due().is_some();
                if started {
                    let (first, read) = (self.controller.next_event(), self.controller.events_read());
                    self.reading = Reading { first, read, ..Reading::default() };
                }
                self.pass(byte_ticks * answer.len() as u64);
                if !answer.is_empty() {
                    // Whoever reads the answer may rely on the state published.
                    self.publish();
                    self.link.write(&answer);
                }
                if started {
                    self.play_on(0, (STEPPED_PATIENCE_S * f64::from(TICK_HZ)) as u64);
                }
                if self.shared.stopping() {
                    return;
                }
            }
            self.publish();
        }
    }

    /// Plays what is due: `outputs` of them, and whatever comes within `ticks` from now.
    fn play_on(&mut self, outputs: usize, ticks: u64) {
        let end = self.now.saturating_add(ticks);
        let mut played = 0usize;
        while let Some(due) = self.due() {
            if (due > end && played >= outputs) || self.held() {
                return;
            }
            self.play_until(due);
            self.now = self.now.max(due);
            played += 1;
            if played.is_multiple_of(SLICE) {
                self.publish();
                if self.shared.stopping() {
                    return;
                }
            }
        }
        // Playing includes letting the camera finish: else the last frame would wait for the host
        // to say something.
        if let Some(free) = self.world.camera_free_at() {
            self.now = self.now.max(free);
            self.world.advance(self.now);
        }
    }

    /// Lets stepped time pass, which stands still before the next output while the host is behind.
    fn pass(&mut self, ticks: u64) {
        let end = self.now.saturating_add(ticks);
        while let Some(due) = self.due().filter(|&due| due <= end) {
            if self.held() {
                self.now = self.now.max(due.saturating_sub(1));
                return;
            }
            self.play_until(due);
            self.now = self.now.max(due);
        }
        self.now = end;
        self.play_until(end);
    }

    /// Stepped time is the host's: it stands still while a host has yet to read events that would be
    /// overwritten, or to send more of a stream that would run dry.
    fn held(&mut self) -> bool {
        let stream = self.controller.stream().filter(|stream| !stream.ended);
        let received = stream.map(|stream| stream.received);
        let dry = stream.is_some_and(|s| s.received.saturating_sub(s.consumed) < STREAM_LOW);
        self.reading.behind(self.controller.next_event(), self.controller.events_read(), received, dry)
    }

    fn run_wall(&mut self, rate: f64) {
        let start = Instant::now();
        let ticks_per_s = f64::from(TICK_HZ) * rate;
        let mut buffer = [0; 1024];
        while !self.shared.stopping() {
            self.take_commands();
            self.now = self.now.max((start.elapsed().as_secs_f64() * ticks_per_s) as u64);
            self.play_until(self.now);
            self.world.advance(self.now);
            self.publish();
            let next = self.due().into_iter().chain(self.world.camera_free_at()).min();
            let nap = next.map_or(NAP, |due| {
                Duration::from_secs_f64(
                    (due.saturating_sub(self.now) as f64 / ticks_per_s).min(NAP.as_secs_f64()),
                )
            });
            let count = self.link.read(&mut buffer, nap);
            if count > 0 {
                self.before_bytes();
                self.now = self.now.max((start.elapsed().as_secs_f64() * ticks_per_s) as u64);
                self.play_until(self.now);
                let answer = self.receive(&buffer[..count]);
                self.publish();
                self.link.write(&answer);
            }
        }
    }

    /// Tick of the next thing that happens by itself, in simulated time: an output or event of the
    /// controller, or an input that it may be waiting for.
    fn due(&self) -> Option<u64> {
        let output = self.controller.next_due().map(|tick| self.boot_tick.saturating_add(tick));
        let awaited = self.controller.state() == State::Running || self.slots.await_input();
        let input = self.wiring.due(&self.world).filter(|_| awaited);
        output.into_iter().chain(input).min()
    }

    fn play_until(&mut self, tick: u64) {
        loop {
            let next = self.due().map_or(tick, |due| due.min(tick));
            let here = next.saturating_sub(self.boot_tick);
            // Only inputs that something is wired to need the world to keep up.
            if self.wiring.is_wired() {
                // An input that changes now may be what is waited for up to now.
                let known = here.saturating_sub(1);
                self.with_controller(|controller, wires| controller.play_ahead(here, known, wires));
                self.world.advance(next);
                let word = self.wiring.word(next, &self.world);
                self.with_controller(|controller, wires| controller.inputs(here, word, wires));
                let risen = word & !std::mem::replace(&mut self.inputs, word);
                self.autostart(here, |autostart| match autostart {
                    Autostart::Input { input } => {
                        channels::trigger_input(input).is_some_and(|bit| risen & bit != 0)
                    }
                    _ => false,
                });
            }
            self.with_controller(|controller, wires| controller.play(here, wires));
            if next >= tick {
                return;
            }
        }
    }

    /// Starts the first slot that starts by itself `when` this is the case; a box that refuses stays as it is.
    fn autostart(&mut self, here: u64, when: impl Fn(Autostart) -> bool) {
        if matches!(self.controller.state(), State::Running | State::Faulted) {
            return;
        }
        if let Some(slot) = self.slots.list().into_iter().find(|slot| when(slot.autostart)) {
            self.with_controller(|controller, wires| controller.autostart(here, slot.slot, wires)).ok();
        }
    }

    fn with_controller<T>(&mut self, act: impl FnOnce(&mut Controller, &mut Wires<'_>) -> T) -> T {
        let mut wires = Wires {
            world: &mut self.world,
            record: lock(&self.shared.record),
            slots: &mut self.slots,
            boot_tick: self.boot_tick,
        };
        act(&mut self.controller, &mut wires)
    }

    /// Gives bytes to the controller and returns what it answers.
    fn receive(&mut self, bytes: &[u8]) -> Vec<u8> {
        let FaultsConfig { reset_after_requests, silent_after_requests, .. } = self.config.faults;
        let mut answer = Vec::new();
        let mut reset = false;
        let mut silent = self.shared.silent.load(Ordering::Relaxed);
        let mut answered = self.answered;
        {
            let mut wires = Wires {
                world: &mut self.world,
                record: lock(&self.shared.record),
                slots: &mut self.slots,
                boot_tick: self.boot_tick,
            };
            self.controller.receive(self.now - self.boot_tick, bytes, &mut wires, &mut |reply| {
                reset |= reset_after_requests == Some(answered) && self.boots == 1;
                silent |= silent_after_requests.is_some_and(|limit| answered >= limit);
                answered = answered.saturating_add(1);
                if !silent && !reset {
                    answer.extend_from_slice(reply);
                }
            });
        }
        self.answered = answered;
        if reset {
            self.reboot();
        }
        answer
    }

    /// What was set before these bytes were sent must hold for them, and a new host must not find
    /// its first frame glued to half a frame of the one before.
    fn before_bytes(&mut self) {
        self.take_commands();
        if self.link.restarted() {
            self.controller.link_restarted();
        }
    }

    fn take_commands(&mut self) {
        let levels = self.shared.inputs.swap(u64::MAX, Ordering::Relaxed);
        if let Ok(levels) = u32::try_from(levels) {
            self.wiring.set_levels(levels);
        }
        let exposure = self.shared.exposure_ns.swap(0, Ordering::Relaxed);
        if exposure > 0 {
            self.world.camera_mut().set_exposure_ns(exposure);
        }
        if self.shared.reset.swap(false, Ordering::Relaxed) {
            self.reboot();
        }
    }

    /// The box starts anew with all outputs off; stage and camera stay as they are.
    fn reboot(&mut self) {
        self.boots += 1;
        self.boot_tick = self.now;
        self.controller = boot(&self.config, self.boots);
        self.reading = Reading::default();
        self.world.word(self.now, SAFE_WORD);
        for led in 0..LEDS {
            self.world.level(self.now, led, 0);
        }
        lock(&self.shared.record).word(self.now, SAFE_WORD);
        self.autostart(0, |autostart| autostart == Autostart::PowerUp);
    }

    fn publish(&mut self) {
        for exposure in self.world.take_exposures() {
            self.shared.pending.fetch_add(1, Ordering::SeqCst);
            if self.exposures.send(exposure).is_err() {
                self.shared.pending.fetch_sub(1, Ordering::SeqCst);
            }
        }
        let truth = Truth {
            tick: self.now,
            stage_steps: self.world.stage().steps(),
            stage_mm: self.world.stage().position_mm(),
            exposures: self.world.camera().exposures(),
            missed_triggers: self.world.camera().missed_triggers(),
            boots: self.boots,
        };
        *lock(&self.shared.truth) = truth;
    }
}

fn boot(config: &SimConfig, boots: u32) -> Controller {
    // A new id at every boot, the same ones for the same seed.
    let boot_id = mix(mix(config.seed) ^ u64::from(boots)) as u32;
    Controller::new(board(&config.board), boot_id)
}

fn board(config: &BoardConfig) -> Board {
    // The numbers of axes, LEDs and inputs have been checked against the protocol's by validation.
    let homing = |h: &HomeConfig| Homing {
        high_end: h.high_end,
        rate: h.rate,
        travel: h.travel,
        position: h.position,
    };
    let row = |o: &OverdriveConfig| Overdrive { above: o.above, max_pulse: o.max_pulse, cycle: o.cycle };
    let interlock = if config.interlock { Capabilities::INTERLOCK } else { 0 };
    Board {
        name: "hil-sim",
        capabilities: Capabilities::SIMULATED
            | Capabilities::TRIGGER_INPUTS
            | Capabilities::JERK
            | Capabilities::STREAMING
            | Capabilities::FLASH
            | Capabilities::EXPOSURE_ACTIVE
            | interlock,
        axes: config
            .axes
            .iter()
            .take(usize::from(AXES))
            .map(|a| AxisLimits {
                min: a.min,
                max: a.max,
                max_rate: a.max_rate,
                max_acceleration: a.max_acceleration,
                max_jerk: a.max_jerk,
                home: a.home.as_ref().map(homing),
            })
            .collect(),
        leds: config
            .leds
            .iter()
            .take(usize::from(LEDS))
            .map(|l| LedLimits {
                max_pulse: l.max_pulse,
                settle: l.settle,
                window: l.window,
                overdrive: l.overdrive.iter().take(4).map(row).collect(),
            })
            .collect(),
        cameras: config.cameras,
        inputs: config.inputs,
        input_latency: config.input_latency,
        start_lead: daic_firmware::START_LEAD,
    }
}
