//! A box behind a line that loses, doubles, flips, delays and cuts bytes, with hosts that stall and die and
//! a box that is reset: what must hold whatever happens, checked on the edges themselves.
//!
//! `DAIC_FAULTS` sets the number of runs (500), `DAIC_FAULTS_FIRST` the first seed (1), `DAIC_FAULTS_TOTALS`
//! a JSON file to which the totals are added.

use daic_firmware::{Board, Controller, START_LEAD, Sink};
use daic_protocol::message::{Event, EventKind, State};
use daic_protocol::program::{self, Instruction};
use daic_rig::link::{EventReader, Link, LinkError, LinkOptions, Outcome, Transport};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Ticks of a byte at 1 MBd.
const BYTE: u64 = 1250;

#[derive(Default)]
struct Wires {
    words: Vec<(u64, u32)>,
}

impl Sink for Wires {
    fn word(&mut self, tick: u64, word: u32) {
        self.words.push((tick, word));
    }
    fn level(&mut self, _: u64, _: u8, _: u16) {}
}

/// Chances per byte, in millionths.
#[derive(Clone, Copy)]
struct Chances {
    lost: u32,
    doubled: u32,
    flipped: u32,
    /// The rest of what was written is gone.
    cut: u32,
    /// What was written comes with the next writing.
    delayed: u32,
}

/// One boot of the box: what it put out.
struct Boot {
    words: Vec<(u64, u32)>,
    /// Runs begun: number and first tick.
    starts: Vec<(u32, u64)>,
}

struct World {
    rng: ChaCha8Rng,
    chances: Chances,
    /// Of the box's clock, in millionths.
    drift_ppm: i64,
    controller: Controller,
    wires: Wires,
    now: u64,
    boots: u32,
    done: Vec<Boot>,
    starts: Vec<(u32, u64)>,
    to_host: VecDeque<u8>,
    held: Vec<u8>,
    alive: bool,
}

impl World {
    fn pass(&mut self, ticks: u64) {
        let drift = i64::try_from(ticks).unwrap() * self.drift_ppm / 1_000_000;
        let until = self.now + ticks.saturating_add_signed(drift);
        self.now = until;
        self.controller.play(until, &mut self.wires);
    }

    fn garble(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        for &byte in bytes {
            let mut hit = |chance: u32| self.rng.random_range(0..1_000_000) < chance;
            if hit(self.chances.cut) {
                break;
            }
            if hit(self.chances.lost) {
                continue;
            }
            let flipped = hit(self.chances.flipped);
            let copies = 1 + usize::from(hit(self.chances.doubled));
            let byte = if flipped { byte ^ (1 << self.rng.random_range(0..8)) } else { byte };
            out.extend(std::iter::repeat_n(byte, copies));
        }
        out
    }

    fn receive(&mut self, bytes: &[u8]) {
        let mut back = Vec::new();
        for &byte in bytes {
            self.pass(BYTE);
            let now = self.now;
            let run = self.controller.run();
            self.controller
                .receive(now, &[byte], &mut self.wires, &mut |frame| back.extend_from_slice(frame));
            if self.controller.run() != run
                && let Some(due) = self.controller.next_due()
            {
                self.starts.push((self.controller.run(), due));
            }
        }
        let back = self.garble(&back);
        self.to_host.extend(back);
    }

    fn reset(&mut self) {
        let words = std::mem::take(&mut self.wires.words);
        let starts = std::mem::take(&mut self.starts);
        self.done.push(Boot { words, starts });
        self.boots += 1;
        self.controller = Controller::new(Board::reference(), self.boots);
        // Ticks count from boot.
        self.now = 0;
        self.to_host.clear();
        self.held.clear();
    }
}

fn lock(world: &Mutex<World>) -> MutexGuard<'_, World> {
    world.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A host's end of the line.
struct Line(Arc<Mutex<World>>);

impl Transport for Line {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize> {
        let mut world = lock(&self.0);
        if !world.alive {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        if world.to_host.is_empty() {
            // Nothing comes by itself: time passes on the box and, briefly, here.
            world.pass(125_000);
            drop(world);
            std::thread::sleep(timeout.min(Duration::from_millis(1)));
            return Ok(0);
        }
        let count = buffer.len().min(world.to_host.len());
        for (to, from) in buffer.iter_mut().zip(world.to_host.drain(..count)) {
            *to = from;
        }
        Ok(count)
    }

    fn write(&mut self, bytes: &[u8], _: Duration) -> io::Result<()> {
        let mut world = lock(&self.0);
        if !world.alive {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        let garbled = world.garble(bytes);
        let mut all = std::mem::take(&mut world.held);
        all.extend(garbled);
        let delayed = world.chances.delayed;
        if world.rng.random_range(0..1_000_000) < delayed {
            world.held = all;
        } else {
            world.receive(&all);
        }
        Ok(())
    }
}

fn connect(world: &Arc<Mutex<World>>) -> Result<Link, LinkError> {
    let options = LinkOptions { timeout: Duration::from_millis(2), attempts: 6, ..LinkOptions::default() };
    Link::over(Box::new(Line(world.clone())), "line", options)
}

/// Blinking that every board allows; what it must put out, counted from its first tick.
fn blink(rng: &mut ChaCha8Rng) -> (Vec<u8>, Vec<(u64, u32)>) {
    let mut list = Vec::new();
    let mut expected = Vec::new();
    let mut tick = 0u64;
    for _ in 0..rng.random_range(1..30) {
        let mask = [1u32, 2, 0x100, 0x1000][rng.random_range(0..4)];
        let (gap, length) = (rng.random_range(100..200_000u32), rng.random_range(100..100_000u32));
        list.push(Instruction::Edge { mask, value: mask, after: gap });
        list.push(Instruction::Edge { mask, value: 0, after: length });
        tick += u64::from(gap);
        expected.push((tick, mask));
        tick += u64::from(length);
        expected.push((tick, 0));
    }
    (program::encode(&list).unwrap().to_vec(), expected)
}

/// Numbers of a campaign.
#[derive(Default, Debug)]
struct Totals {
    runs: u64,
    requests: u64,
    outcomes: BTreeMap<&'static str, u64>,
    started: u64,
    resets: u64,
    reconnects: u64,
    gaps_told: u64,
    events: u64,
}

impl Totals {
    /// Counts what a request came to; the error, if any.
    fn count<T>(&mut self, result: Result<T, LinkError>) -> Result<T, LinkError> {
        self.requests += 1;
        let name = match &result {
            Ok(_) => "Done",
            Err(error) => match error.outcome() {
                Outcome::NotSent => "NotSent",
                Outcome::Refused => "Refused",
                _ => "Unknown",
            },
        };
        *self.outcomes.entry(name).or_default() += 1;
        result
    }
}

/// One host after the other tries to have one program played.
fn campaign_run(seed: u64, totals: &mut Totals) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let level = [0, 20, 200, 2000][rng.random_range(0..4usize)];
    let mut chance = || if level == 0 { 0 } else { rng.random_range(0..level) };
    let chances = Chances {
        lost: chance(),
        doubled: chance(),
        flipped: chance(),
        cut: chance(),
        delayed: chance() * 20,
    };
    let (program, expected) = blink(&mut rng);
    let world = Arc::new(Mutex::new(World {
        rng: ChaCha8Rng::seed_from_u64(seed ^ 0x5eed),
        chances,
        drift_ppm: rng.random_range(-200..=200),
        controller: Controller::new(Board::reference(), 0),
        wires: Wires::default(),
        now: 1000,
        boots: 0,
        done: Vec::new(),
        starts: Vec::new(),
        to_host: VecDeque::new(),
        held: Vec::new(),
        alive: true,
    }));
    let begin = Instant::now();
    // Starts that this host asked for: at most so many runs may begin.
    let mut asked = 0u32;
    for host in 0..4 {
        if host > 0 {
            totals.reconnects += 1;
        }
        lock(&world).alive = true;
        let Ok(mut link) = totals.count(connect(&world)) else { continue };
        let fault = rng.random_range(0..10);
        let mut talk = || -> Result<(), LinkError> {
            let status = totals.count(link.status())?;
            if status.state == State::Faulted {
                totals.count(link.clear_fault())?;
            }
            if status.state == State::Running {
                totals.count(link.abort())?;
                totals.count(link.clear_fault())?;
            }
            let first = totals.count(link.status())?.next_event;
            let hash = totals.count(link.load(&program))?;
            if fault == 0 {
                lock(&world).reset();
                totals.resets += 1;
            }
            totals.count(link.arm(hash))?;
            let before = lock(&world).controller.run();
            asked += 1;
            let started = totals.count(link.start());
            let begun = lock(&world).controller.run() - before;
            match &started {
                Ok(_) => assert_eq!(begun, 1, "seed {seed}: done is done, once"),
                Err(error) => match error.outcome() {
                    Outcome::NotSent | Outcome::Refused => assert_eq!(begun, 0, "seed {seed}: {error}"),
                    _ => assert!(begun <= 1, "seed {seed}: {error}"),
                },
            }
            started?;
            totals.started += 1;
            if fault == 1 {
                // Killed in mid-run.
                lock(&world).alive = false;
            }
            if fault == 2 {
                lock(&world).pass(60 * 125_000_000);
            }
            if fault == 4 {
                let run = lock(&world).controller.run();
                let again = totals.count(link.start());
                assert!(again.is_err(), "seed {seed}: started while it ran");
                assert_eq!(lock(&world).controller.run(), run, "seed {seed}");
            }
            let mut reader = EventReader::new(first);
            let mut events: Vec<Event> = Vec::new();
            let mut gap = false;
            for round in 0..400 {
                match totals.count(reader.poll(&mut link, &mut events)) {
                    Ok(_) => {}
                    Err(LinkError::EventsLost { .. }) => {
                        gap = true;
                        totals.gaps_told += 1;
                    }
                    Err(error) => return Err(error),
                }
                if fault == 3 && round == 2 {
                    totals.count(link.abort())?;
                    assert_eq!(lock(&world).controller.word(), 0, "seed {seed}: abort is safe at once");
                }
                let end = events
                    .iter()
                    .rev()
                    .find(|e| matches!(e.kind, EventKind::RunDone { .. } | EventKind::Faulted { .. }));
                if let Some(end) = end {
                    if let EventKind::RunDone { events: announced, run, .. } = end.kind {
                        let begin = events
                            .iter()
                            .position(|e| matches!(e.kind, EventKind::RunStarted { run: r, .. } if r == run));
                        let seen = begin.map(|b| events.len() - b);
                        // What was lost is known to be lost.
                        assert!(
                            gap || seen == Some(announced as usize),
                            "seed {seed}: {seen:?} of {announced}"
                        );
                    }
                    break;
                }
                lock(&world).pass(1_250_000);
            }
            totals.events += events.len() as u64;
            assert!(events.windows(2).all(|p| p[1].seq > p[0].seq), "seed {seed}");
            Ok(())
        };
        let result = talk();
        if result.is_ok() {
            break;
        }
    }
    assert!(begin.elapsed() < Duration::from_secs(20), "seed {seed}: a host hangs");

    // After the longest program every output is safe, host or no host.
    let mut world = lock(&world);
    world.pass(START_LEAD + 40 * 400_000 + 1);
    assert_eq!(world.controller.word(), 0, "seed {seed}");
    world.reset();
    let runs: usize = world.done.iter().map(|b| b.starts.len()).sum();
    assert!(runs <= asked as usize, "seed {seed}: {runs} runs, {asked} asked for");
    for boot in &world.done {
        check_edges(seed, boot, &expected);
    }
    totals.runs += 1;
}

/// Every word of every run is one of the program's, at its tick and in its order, up to some point; then at most
/// the safe word. Nothing is put out outside of a run.
fn check_edges(seed: u64, boot: &Boot, expected: &[(u64, u32)]) {
    let mut words = boot.words.as_slice();
    for (i, &(run, start)) in boot.starts.iter().enumerate() {
        let next = boot.starts.get(i + 1).map_or(u64::MAX, |s| s.1);
        let count = words.iter().take_while(|w| w.0 < next).count();
        let (mine, rest) = words.split_at(count);
        words = rest;
        let same = mine.iter().zip(expected).take_while(|(w, e)| **w == (start + e.0, e.1)).count();
        let safe_end = mine.len() == same || (mine.len() == same + 1 && mine[same].1 == 0);
        assert!(safe_end, "seed {seed}, run {run}: word {same} is {:?}", mine.get(same));
        assert!(mine.last().is_none_or(|w| w.1 == 0) || i + 1 == boot.starts.len(), "seed {seed}, run {run}");
    }
    assert!(words.is_empty(), "seed {seed}: words without a run");
}

fn from_env(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(otherwise)
}

#[test]
fn whatever_happens_on_the_line() {
    let (count, first) = (from_env("DAIC_FAULTS", 500), from_env("DAIC_FAULTS_FIRST", 1));
    eprintln!("seeds {first} … {}", first + count - 1);
    let mut totals = Totals::default();
    for seed in first..first + count {
        campaign_run(seed, &mut totals);
    }
    eprintln!("{totals:?}");
    // It must have been a campaign: things went wrong, and things went right.
    assert!(totals.started * 2 > count, "{totals:?}");
    if count >= 100 {
        for outcome in ["Done", "Refused", "Unknown", "NotSent"] {
            assert!(totals.outcomes.contains_key(outcome), "{outcome}: {totals:?}");
        }
    }
    if let Ok(path) = std::env::var("DAIC_FAULTS_TOTALS") {
        let line = serde_json::json!({
            "seeds": [first, first + count - 1],
            "runs": totals.runs,
            "requests": totals.requests,
            "outcomes": totals.outcomes,
            "runs_started": totals.started,
            "resets": totals.resets,
            "reconnects": totals.reconnects,
            "gaps_told": totals.gaps_told,
            "events": totals.events,
        });
        std::fs::write(path, format!("{line:#}\n")).unwrap();
    }
}

/// The check can fail: one tick, one word more, one word twice.
#[test]
fn the_check_notices() {
    let expected = [(100, 1), (200, 0)];
    let boot = |words: &[(u64, u32)]| Boot { words: words.to_vec(), starts: vec![(1, 1000)] };
    let fails = |words: &[(u64, u32)]| {
        let boot = boot(words);
        std::panic::catch_unwind(|| check_edges(0, &boot, &expected)).is_err()
    };
    assert!(!fails(&[(1100, 1), (1200, 0)]));
    assert!(!fails(&[(1100, 1), (1150, 0)]), "cut off safe");
    assert!(fails(&[(1101, 1), (1200, 0)]));
    assert!(fails(&[(1100, 1), (1200, 0), (1300, 1)]));
    assert!(fails(&[(1100, 1), (1150, 3), (1200, 0)]));
    let before = Boot { words: vec![(5, 1)], starts: Vec::new() };
    assert!(std::panic::catch_unwind(|| check_edges(0, &before, &expected)).is_err());
}
