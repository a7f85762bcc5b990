//! Whole runs against the real controller, with a camera that sees its trigger line.

mod common;

use common::{Faults, TestBox};
use daic_protocol::message::{Event, State};
use daic_rig::RigError;
use daic_rig::acquire::{AcquireOptions, FrameSink, NullSink, Progress, Run, SinkError, acquire};
use daic_rig::camera::{
    Camera, CameraError, CameraInfo, CameraSettings, CameraStats, Frame, FrameError, ReplayCamera,
};
use daic_rig::clock::ClockOptions;
use daic_rig::compile::{Compiled, compile};
use daic_rig::experiment::{Experiment, template};
use daic_rig::link::{Link, LinkError, LinkOptions};
use daic_rig::pairing::{Counts, Verdict};
use daic_rig::units::Time;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::time::{Duration, Instant};

/// Uneven times, so that a lost frame leaves no doubt.
const SEQUENCE: &str = r#"
[[sequence]]
frame = { name = "first", role = "reference" }
[[sequence]]
move = { x = "0.05 mm", z = "0.2 mm" }
[[sequence]]
frame = { name = "second", role = "deformed" }
[[sequence]]
settle = "70 ms"
[[sequence]]
frame = { name = "third", role = "deformed", strobe = { led = 2, delay = "2 ms", width = "30 us" } }
[[sequence]]
settle = "10 ms"
[[sequence]]
repeat = { times = 3, steps = [{ frame = { name = "run", role = "series" } }] }
[[sequence]]
settle = "33 ms"
[[sequence]]
frame = { name = "last", role = "deformed" }
"#;
const FRAMES: usize = 7;
/// Ten seconds of one instruction at the slow rate.
const SLOW: &str = "0.5 mm/s";
const LONG: &str = r#"
[[sequence]]
frame = { name = "first", role = "reference" }
[[sequence]]
move = { x = "5 mm" }
"#;

/// Frames as the trigger line says, by a clock of its own that is 150 ppm fast.
struct WatchCamera {
    faults: Arc<Faults>,
    info: CameraInfo,
    seen: usize,
    id: u64,
    again: Option<Frame>,
    lose: Vec<u64>,
    double: Vec<u64>,
    gone_at: Option<u64>,
    stats: CameraStats,
}

impl WatchCamera {
    fn new(faults: &Arc<Faults>) -> Self {
        let info = CameraInfo {
            vendor: "test".to_owned(),
            model: "watch".to_owned(),
            serial: "1".to_owned(),
            sensor_px: [4, 2],
            pixel_um: None,
            has_clock: true,
        };
        Self {
            faults: faults.clone(),
            info,
            seen: 0,
            id: 0,
            again: None,
            lose: vec![],
            double: vec![],
            gone_at: None,
            stats: CameraStats::default(),
        }
    }

    fn trigger(&mut self) -> Option<u64> {
        let words = self.faults.words.lock().expect("words");
        while let Some(&(_, tick, word)) = words.get(self.seen) {
            let before = self.seen.checked_sub(1).and_then(|i| words.get(i)).map_or(0, |w| w.2);
            self.seen += 1;
            if word & !before & 1 << 8 != 0 {
                return Some(tick);
            }
        }
        None
    }
}

impl Camera for WatchCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }
    fn configure(&mut self, settings: &CameraSettings) -> Result<CameraSettings, CameraError> {
        Ok(*settings)
    }
    fn start(&mut self) -> Result<(), CameraError> {
        self.seen = self.faults.words.lock().expect("words").len();
        Ok(())
    }
    fn next(&mut self, timeout: Duration) -> Result<Frame, FrameError> {
        if let Some(frame) = self.again.take() {
            return Ok(frame);
        }
        let deadline = Instant::now() + timeout;
        while Instant::now() < deadline {
            let Some(tick) = self.trigger() else {
                std::thread::sleep(Duration::from_millis(1));
                continue;
            };
            let id = self.id;
            self.id += 1;
            if self.gone_at == Some(id) {
                return Err(FrameError::Disconnected);
            }
            if self.lose.contains(&id) {
                continue;
            }
            self.stats.completed += 1;
            let frame = Frame {
                id,
                camera_ns: Some(7_000_000_000 + (tick as f64 * 8.0 * 1.00015) as u64),
                host: Instant::now(),
                width: 4,
                height: 2,
                bits: 8,
                data: vec![id as u16; 8],
            };
            if self.double.contains(&id) {
                self.again = Some(frame.clone());
            }
            return Ok(frame);
        }
        Err(FrameError::Timeout { after_ms: timeout.as_millis() as u64 })
    }
    fn stop(&mut self) -> Result<CameraStats, CameraError> {
        Ok(self.stats)
    }
}

#[derive(Default)]
struct Keep {
    frames: Vec<u64>,
    events: Vec<Event>,
    full_at: Option<usize>,
}

impl FrameSink for Keep {
    fn frame(&mut self, frame: &Frame) -> Result<(), SinkError> {
        if self.full_at == Some(self.frames.len()) {
            return Err("no space left".into());
        }
        self.frames.push(frame.id);
        Ok(())
    }
    fn events(&mut self, events: &[Event]) -> Result<(), SinkError> {
        self.events.extend_from_slice(events);
        Ok(())
    }
}

struct Bench {
    rig: TestBox,
    link: Link,
    compiled: Compiled,
    camera: WatchCamera,
    options: AcquireOptions,
    cancel: AtomicBool,
}

impl Bench {
    fn new() -> Self {
        Self::playing("5 mm/s", SEQUENCE)
    }

    fn playing(rate: &str, sequence: &str) -> Self {
        let head = template().split("# --- what is played").next().expect("head");
        let head = head.replace("\"5 mm/s\"", &format!("{rate:?}"));
        let text = format!("{head}{sequence}");
        let experiment = Experiment::parse(&text, Path::new("e.toml")).unwrap_or_else(|e| panic!("{e}"));
        let (rig, end) = TestBox::piped();
        let options =
            LinkOptions { timeout: Duration::from_millis(100), attempts: 4, ..LinkOptions::default() };
        let mut link = Link::over(Box::new(end), "pipe", options).expect("hello");
        let start = link.status().expect("status").position;
        let compiled = compile(&experiment, link.hello(), start).expect("compile");
        let camera = WatchCamera::new(&rig.faults);
        let options = AcquireOptions {
            frame_timeout: Duration::from_millis(300),
            ..AcquireOptions::new(link.hello().tick_hz)
        };
        Self { rig, link, compiled, camera, options, cancel: AtomicBool::new(false) }
    }

    fn run(&mut self, sink: &mut dyn FrameSink, progress: &mut dyn FnMut(Progress)) -> Result<Run, RigError> {
        let Self { link, compiled, camera, options, cancel, .. } = self;
        acquire(link, compiled, camera, &settings(), options, sink, progress, cancel)
    }

    /// Runs, and calls `at` once when the first trigger has been played.
    fn disturbed(&mut self, at: impl Fn(&Faults, &AtomicBool)) -> RigError {
        let Self { rig, link, compiled, camera, options, cancel } = self;
        let mut once = false;
        acquire(
            link,
            compiled,
            camera,
            &settings(),
            options,
            &mut NullSink,
            &mut |p| {
                if matches!(p, Progress::Running { triggers: 1.., .. }) && !once {
                    once = true;
                    at(&rig.faults, cancel);
                }
            },
            cancel,
        )
        .expect_err("disturbed")
    }
}

fn settings() -> CameraSettings {
    CameraSettings { exposure: Time::new(5e6), bits: 8, hardware_trigger: true }
}

#[test]
fn every_frame_of_an_undisturbed_run_is_paired_with_its_strobe() {
    let mut bench = Bench::new();
    bench.options.clock = Some(ClockOptions::new(bench.link.hello().tick_hz));
    let (mut keep, mut seen) = (Keep::default(), vec![]);
    let run = bench.run(&mut keep, &mut |p| seen.push(p)).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(run.pairing.counts, Counts { paired: FRAMES, ..Counts::default() });
    assert_eq!(keep.frames, (0..FRAMES as u64).collect::<Vec<_>>());
    assert_eq!(keep.events, run.events);
    assert_eq!(run.camera.completed, FRAMES as u64);
    assert_eq!(seen.first(), Some(&Progress::Armed));
    assert_eq!(seen.last(), Some(&Progress::Collecting { frames: FRAMES, planned: FRAMES }));
    for (index, frame) in run.frames.iter().enumerate() {
        assert_eq!(frame.planned, Some(index));
        let Verdict::Paired { strobe: Some(pulse), .. } = frame.verdict else { panic!("{frame:?}") };
        let planned = bench.compiled.plan.frames[index].strobe;
        assert_eq!((pulse.led, pulse.off - pulse.on), (planned.led, planned.width_ticks));
    }
    assert_eq!(run.frames[2].planned.map(|p| bench.compiled.plan.frames[p].strobe.led), Some(2));
    let clock = run.clock.as_ref().expect("the clocks are what they are said to be");
    assert!(clock.len() >= 8);
    // No frame can have come before its trigger.
    for (trigger, frame) in run.triggers.iter().zip(&run.frames) {
        if let (Some(time), Some(host)) = (trigger.host, frame.stamp.host_ns) {
            assert!(host as f64 >= time.ns - time.bound_ns, "{host} {time:?}");
        }
    }
    // A second run on the same box.
    let run = bench.run(&mut NullSink, &mut |_| {}).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!((run.run, run.pairing.counts.paired), (2, FRAMES));
}

#[test]
fn lost_and_doubled_frames_are_told_apart() {
    let mut bench = Bench::new();
    bench.camera.lose = vec![2];
    bench.camera.double = vec![4];
    let run = bench.run(&mut NullSink, &mut |_| {}).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(run.pairing.counts, Counts { paired: FRAMES - 1, missing: 1, extra: 1, ambiguous: 0 });
    assert_eq!(run.pairing.triggers[2], None);
    let planned: Vec<Option<usize>> = run.frames.iter().map(|f| f.planned).collect();
    assert_eq!(planned, [Some(0), Some(1), Some(3), Some(4), None, Some(5), Some(6)]);
}

#[test]
fn lost_replies_do_not_disturb_a_run() {
    let mut bench = Bench::new();
    bench.rig.faults.lose_replies.store(4, SeqCst);
    let run = bench.run(&mut NullSink, &mut |_| {});
    // Four in a row exhaust the attempts of the first request.
    assert!(matches!(run, Err(RigError::Link(LinkError::Silent { .. }))), "{run:?}");
    bench.rig.faults.lose_replies.store(3, SeqCst);
    let run = bench.run(&mut NullSink, &mut |_| {}).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(run.pairing.counts.paired, FRAMES);
    assert_eq!(bench.rig.faults.starts.load(SeqCst), 1);
}

#[test]
fn a_board_that_resets_or_falls_silent_in_the_middle_ends_the_run() {
    let error = Bench::new().disturbed(|f, _| f.reset.store(true, SeqCst));
    assert!(matches!(error, RigError::Link(LinkError::BoardReset { .. })), "{error:?}");
    assert!(!error.is_input());
    let error = Bench::new().disturbed(|f, _| f.silent.store(true, SeqCst));
    assert!(matches!(error, RigError::Link(LinkError::Silent { .. })), "{error:?}");
    assert!(!error.is_input());
}

#[test]
fn a_run_can_be_cancelled_and_is_stopped_when_it_takes_too_long() {
    let mut bench = Bench::new();
    let error = bench.disturbed(|_, cancel| cancel.store(true, SeqCst));
    assert!(matches!(error, RigError::Cancelled), "{error:?}");
    // At once, without waiting: the next run must find the box ready.
    assert_eq!(bench.link.status().expect("status").state, State::Loaded);
    assert_stopped(&mut bench);
    bench.cancel.store(false, SeqCst);
    let run = bench.run(&mut NullSink, &mut |_| {}).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(run.pairing.counts.paired, FRAMES);

    // An instruction that would take too long is aborted.
    let mut bench = Bench::playing(SLOW, LONG);
    let error = bench.disturbed(|_, cancel| {
        // the frame before it takes 40 ms: cancelled within that, the run would end without it
        std::thread::sleep(Duration::from_millis(300));
        cancel.store(true, SeqCst);
    });
    assert!(matches!(error, RigError::Cancelled), "{error:?}");
    assert_eq!(bench.link.status().expect("status").state, State::Faulted);

    let mut bench = Bench::new();
    bench.options.run_timeout = Some(Duration::from_millis(20));
    let error = bench.run(&mut NullSink, &mut |_| {}).expect_err("too long");
    assert!(matches!(error, RigError::RunTimeout { after_ms: 20.. }), "{error:?}");
    assert_stopped(&mut bench);
}

/// `Stop` ends with the current instruction: soon, and without a fault.
fn assert_stopped(bench: &mut Bench) {
    for _ in 0..500 {
        let status = bench.link.status().expect("status");
        if status.state == State::Loaded {
            let words = bench.rig.faults.words.lock().expect("words");
            assert_eq!(words.last().map(|w| w.2 & 0xffff), Some(0), "outputs are off");
            assert!(words.iter().filter(|w| w.2 & 1 << 8 != 0).count() < 2 * FRAMES);
            return;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    panic!("the box never stopped");
}

#[test]
fn a_full_disk_stops_the_run_and_is_not_blamed_on_the_rig() {
    let mut bench = Bench::new();
    let mut keep = Keep { full_at: Some(2), ..Keep::default() };
    let error = bench.run(&mut keep, &mut |_| {}).expect_err("full");
    assert!(matches!(&error, RigError::Sink { .. }) && error.is_input(), "{error:?}");
    assert!(error.to_string().contains("no space left"), "{error}");
    assert_eq!(keep.frames, [0, 1]);
    assert_stopped(&mut bench);
}

#[test]
fn a_camera_that_disappears_ends_the_run() {
    let mut bench = Bench::new();
    bench.camera.gone_at = Some(2);
    let error = bench.run(&mut NullSink, &mut |_| {}).expect_err("gone");
    assert!(matches!(error, RigError::Frame(FrameError::Disconnected)), "{error:?}");
    assert_stopped(&mut bench);
}

#[test]
fn a_frame_of_another_size_ends_the_run_and_blames_the_input() {
    let mut bench = Bench::new();
    bench.options.size_px = Some([4, 3]);
    let mut keep = Keep::default();
    let error = bench.run(&mut keep, &mut |_| {}).expect_err("size");
    assert!(matches!(error, RigError::FrameSize { found: [4, 2], expected: [4, 3] }), "{error:?}");
    assert!(error.is_input() && error.to_string().contains("4 × 2 pixels, not 4 × 3"), "{error}");
    assert!(keep.frames.is_empty());
    let mut bench = Bench::new();
    bench.camera.info.sensor_px = [8, 2];
    let error = bench.run(&mut NullSink, &mut |_| {}).expect_err("size");
    assert!(matches!(error, RigError::FrameSize { found: [4, 2], expected: [8, 2] }), "{error:?}");
}

#[test]
fn a_run_that_is_just_ending_is_waited_for() {
    let mut bench = Bench::new();
    let hash = bench.link.load(&bench.compiled.program).expect("load");
    bench.link.arm(hash).expect("arm");
    bench.link.start().expect("start");
    let run = bench.run(&mut NullSink, &mut |_| {}).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!((run.run, run.pairing.counts.paired), (2, FRAMES));
}

#[test]
fn a_fault_left_over_is_cleared_and_said() {
    let mut bench = Bench::playing(SLOW, LONG);
    let hash = bench.link.load(&bench.compiled.program).expect("load");
    bench.link.arm(hash).expect("arm");
    bench.link.start().expect("start");
    let error = bench.run(&mut NullSink, &mut |_| {}).expect_err("still running");
    assert!(matches!(error, RigError::NotReady { state: State::Running }), "{error:?}");
    bench.link.abort().expect("abort");
    bench.compiled = Bench::new().compiled;
    let mut cleared = 0;
    let run =
        bench.run(&mut NullSink, &mut |p| cleared += usize::from(matches!(p, Progress::FaultCleared(_))));
    assert_eq!(run.unwrap_or_else(|e| panic!("{e}")).pairing.counts.paired, FRAMES);
    assert_eq!(cleared, 1);
}

#[test]
fn a_replay_of_too_few_frames_leaves_triggers_missing() {
    let mut bench = Bench::new();
    let recorded = {
        let mut keep = Collect::default();
        bench.run(&mut keep, &mut |_| {}).unwrap_or_else(|e| panic!("{e}"));
        keep.0
    };
    // Behind the move, which the stage has made already, a second run has the pattern of the first.
    let faults = vec![
        Ok(recorded[1].clone()),
        Err(FrameError::Incomplete { id: 2, missing_bytes: 3 }),
        Ok(recorded[3].clone()),
        Ok(recorded[6].clone()),
    ];
    let mut camera = ReplayCamera::with_faults(faults);
    let Bench { link, compiled, options, cancel, .. } = &mut bench;
    let run = acquire(link, compiled, &mut camera, &settings(), options, &mut NullSink, &mut |_| {}, cancel)
        .unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(run.pairing.counts, Counts { paired: 3, missing: 4, ..Counts::default() });
    let planned: Vec<Option<usize>> = run.frames.iter().map(|f| f.planned).collect();
    assert_eq!(planned, [Some(1), Some(3), Some(6)]);
    assert_eq!(run.incomplete, [2]);
    assert_eq!(run.camera.failed, 1);
}

#[derive(Default)]
struct Collect(Vec<Frame>);
impl FrameSink for Collect {
    fn frame(&mut self, frame: &Frame) -> Result<(), SinkError> {
        self.0.push(frame.clone());
        Ok(())
    }
    fn events(&mut self, _: &[Event]) -> Result<(), SinkError> {
        Ok(())
    }
}
