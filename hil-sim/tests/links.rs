//! End to end over every way to reach the box: load, run, take frames; one host after another.

mod support;

use std::fs::OpenOptions;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use daic_hil_sim::{SimError, SimFrame, SimRig, Transport};
use daic_protocol::message::EventKind;
use daic_protocol::program::Instruction;
use support::*;

/// A tty opened as a plain file, read by a thread so that reading can time out.
struct Tty {
    write: std::fs::File,
    bytes: std::sync::mpsc::Receiver<u8>,
    closed: Arc<AtomicBool>,
    reader: Option<JoinHandle<()>>,
}

impl Drop for Tty {
    /// The reader must end with its host, or it would eat the next one's bytes.
    fn drop(&mut self) {
        self.closed.store(true, Ordering::Relaxed);
        if let Some(reader) = self.reader.take() {
            reader.join().ok();
        }
    }
}

impl Tty {
    fn open(path: &str) -> Self {
        let open = || {
            OpenOptions::new()
                .read(true)
                .write(true)
                .custom_flags(nix::libc::O_NOCTTY)
                .open(path)
                .expect("opens")
        };
        let (send, bytes) = channel();
        let mut reader = OpenOptions::new()
            .read(true)
            .custom_flags(nix::libc::O_NOCTTY | nix::libc::O_NONBLOCK)
            .open(path)
            .expect("opens");
        let closed = Arc::new(AtomicBool::new(false));
        let end = Arc::clone(&closed);
        let reader = std::thread::spawn(move || {
            let mut buffer = [0; 512];
            while !end.load(Ordering::Relaxed) {
                match reader.read(&mut buffer) {
                    Ok(0) => return,
                    Ok(count) => {
                        for &byte in &buffer[..count] {
                            if send.send(byte).is_err() {
                                return;
                            }
                        }
                    }
                    Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => {
                        std::thread::sleep(Duration::from_millis(1))
                    }
                    Err(_) => return,
                }
            }
        });
        Self { write: open(), bytes, closed, reader: Some(reader) }
    }
}

impl Read for Tty {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        match self.bytes.recv_timeout(Duration::from_millis(100)) {
            Ok(byte) => {
                buffer[0] = byte;
                Ok(1)
            }
            Err(RecvTimeoutError::Timeout) => Err(std::io::ErrorKind::TimedOut.into()),
            Err(RecvTimeoutError::Disconnected) => Ok(0),
        }
    }
}

impl Write for Tty {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.write.write(bytes)
    }
    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

fn two_frames() -> Vec<Instruction> {
    let mut program = level(u16::MAX).to_vec();
    program.extend(strobed(100, 50));
    program.extend([go(0, 320), go(1, -192), go(2, 1280)]);
    program.extend(strobed(100, 50));
    program
}

/// Runs the program and checks events, frames and the record against each other.
fn exercise<S: Read + Write>(rig: &SimRig, host: &mut Host<S>) -> [SimFrame; 2] {
    let words_before = rig.played().len();
    let events = host.run(&two_frames());
    let Some(EventKind::RunDone { words, .. }) = events.last().map(|e| e.kind) else { panic!("{events:?}") };
    assert_eq!(words as usize, rig.played().len() - words_before);
    let edges: Vec<(u64, u32)> = events
        .iter()
        .filter_map(|e| if let EventKind::Edge { word, .. } = e.kind { Some((e.tick, word)) } else { None })
        .collect();
    assert!(!edges.is_empty());
    let played = rig.played();
    for edge in edges {
        assert!(played[words_before..].contains(&edge), "{edge:?} reported but not played");
    }
    let frame = || rig.next_frame(Duration::from_secs(20)).expect("frame");
    let frames = [frame(), frame()];
    assert_eq!(frames[1].truth.stage_mm, Some([0.05, -0.03, 0.2]));
    assert_eq!((frames[0].width, frames[0].height, frames[0].data.len()), (324, 243, 324 * 243));
    frames
}

#[test]
fn pty_end_to_end_with_two_hosts_after_each_other() {
    let directory = tempfile::tempdir().expect("directory");
    let link = directory.path().join("box");
    let rig = SimRig::start(small(), Transport::Pty { link: Some(link.clone()) }).expect("starts");
    assert!(rig.port().starts_with("/dev/"), "{}", rig.port());
    let mut first = Host::new(Tty::open(rig.port()));
    exercise(&rig, &mut first);
    let boot_id = first.boot_id();
    drop(first);
    let mut second = Host::new(Tty::open(link.to_str().expect("utf-8")));
    assert_eq!(second.boot_id(), boot_id, "a new host is no reset");
    assert_eq!(second.status().position[..3], [320, -192, 1280]);
    drop(second);
    rig.stop();
    assert!(link.symlink_metadata().is_err(), "the link goes with the rig");

    std::fs::write(&link, b"mine").expect("written");
    let refused = SimRig::start(small(), Transport::Pty { link: Some(link.clone()) });
    assert!(matches!(refused, Err(SimError::PtyLink { .. })), "a file is not replaced");
    assert_eq!(std::fs::read(&link).expect("still there"), b"mine");
}

#[test]
fn tcp_with_two_hosts_after_each_other() {
    let rig = SimRig::start(small(), Transport::Tcp { address: "127.0.0.1:0".into() }).expect("starts");
    let connect = || {
        let stream = std::net::TcpStream::connect(rig.port().strip_prefix("tcp://").expect("prefix"))
            .expect("connects");
        stream.set_read_timeout(Some(Duration::from_millis(100))).expect("set");
        stream
    };
    let mut first = Host::new(connect());
    exercise(&rig, &mut first);
    drop(first);
    let mut half = connect();
    half.write_all(&[7, 1, 2]).expect("half a frame");
    drop(half);
    Host::new(connect()).status();
    assert!(matches!(
        SimRig::start(small(), Transport::Tcp { address: rig.port().into() }),
        Err(SimError::Tcp { .. })
    ));
}

/// Same seed, same bytes, whatever the threads and however the bytes were cut; another seed, others.
#[test]
fn frames_depend_on_the_seed_and_on_nothing_else() {
    let run = |seed, threads, transport| {
        let mut config = small();
        (config.seed, config.threads) = (seed, threads);
        let rig = SimRig::start(config, transport).expect("starts");
        let frames = match rig.connect() {
            Some(end) => exercise(&rig, &mut Host::new(end)),
            None => exercise(&rig, &mut Host::new(Tty::open(rig.port()))),
        };
        (frames, rig.played())
    };
    let (frames, played) = run(5, 1, Transport::InProcess);
    let (again, played_again) = run(5, 2, Transport::InProcess);
    assert!(frames == again && played == played_again, "threads");
    // Over the PTY the host asks for events as often as it likes after the run; up to then bytes are the same.
    let (over_pty, played_pty) = run(5, 2, Transport::Pty { link: None });
    assert!(frames == over_pty && played == played_pty, "transport");
    let (other, _) = run(6, 1, Transport::InProcess);
    assert!(frames[0].data != other[0].data);
    assert!(frames[0].data != frames[1].data);
}

#[test]
fn wall_clock_mode_takes_real_time() {
    let mut config = small();
    config.clock = daic_hil_sim::config::ClockMode::Wall { rate: 1.0 };
    let rig = SimRig::start(config, Transport::InProcess).expect("starts");
    let mut host = Host::new(rig.connect().expect("in-process"));
    let start = Instant::now();
    host.run(&[Instruction::Delay { ticks: 300_000 * US }]);
    assert!(start.elapsed() >= Duration::from_millis(300), "{:?}", start.elapsed());
    exercise(&rig, &mut host);
}

/// More events than the box keeps: stepped time waits for the host, and none is lost.
#[test]
fn no_event_is_lost_however_long_the_program() {
    let pulses = 200;
    let mut program = Vec::new();
    for id in 0..pulses {
        program.push(Instruction::Mark { id });
        program.extend([
            set(led(), 100 * US),
            clear(led(), 100 * US),
            Instruction::Delay { ticks: 1000 * US },
        ]);
    }
    let run = |polls: u32| {
        let rig = SimRig::start(small(), Transport::InProcess).expect("starts");
        let mut host = Host::new(rig.connect().expect("in-process"));
        // Events left over by a host that never read must not disturb the next one.
        host.run(&program[..4]);
        let first = host.status().next_event;
        host.start(&program);
        for _ in 0..polls {
            host.status();
        }
        let mut events: Vec<daic_protocol::message::Event> = Vec::new();
        while !events.last().is_some_and(|e| matches!(e.kind, EventKind::RunDone { .. })) {
            let from = events.last().map_or(first, |e| e.seq + 1);
            let reply = host.request(&daic_protocol::message::Request::ReadEvents { from });
            let daic_protocol::message::Reply::Events(reply) = reply else { panic!("{reply:?}") };
            assert_eq!(reply.dropped, 0);
            events.extend(reply.events);
        }
        (first, events, rig.played())
    };
    let (first, events, played) = run(0);
    assert!(events.len() > 600, "{}", events.len());
    assert!(events.iter().zip(first..).all(|(e, seq)| e.seq == seq), "none is missing");
    let Some(EventKind::RunDone { events: announced, .. }) = events.last().map(|e| e.kind) else { panic!() };
    assert_eq!(announced as usize, events.len());
    assert!(run(50) == (first, events, played), "what is played does not depend on when the host reads");
}

/// An endless program can be aborted in stepped mode too, where it is played faster than time.
#[test]
fn endless_program_can_be_aborted() {
    let rig = SimRig::start(small(), Transport::InProcess).expect("starts");
    let mut host = Host::new(rig.connect().expect("in-process"));
    host.start(&[
        Instruction::LoopBegin { count: u32::MAX },
        set(led(), 1000 * US),
        clear(led(), 1000 * US),
        Instruction::LoopEnd,
    ]);
    host.request(&daic_protocol::message::Request::Abort);
    assert_eq!(host.status().state, daic_protocol::message::State::Faulted);
    assert_eq!(rig.played().last().map(|w| w.1), Some(0));
}

// ---- the program ----

struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

fn program(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_hil-sim"));
    command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

#[test]
fn program_prints_its_port_serves_and_writes_frames() {
    let directory = tempfile::tempdir().expect("directory");
    let at = |name: &str| directory.path().join(name).to_str().expect("utf-8").to_owned();
    std::fs::write(at("scene.toml"), small().to_toml().expect("written")).expect("written");
    let arguments =
        ["--scene", &at("scene.toml"), "--frames", &at("frames"), "--vcd", &at("out.vcd"), "--until-eof"];
    let mut running = Running(program(&arguments).spawn().expect("runs"));
    let mut line = String::new();
    BufReader::new(running.0.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
    let port = line.strip_prefix("port: ").expect("port line").trim().to_owned();
    Host::new(Tty::open(&port)).run(&two_frames());
    let list = directory.path().join("frames/frames.jsonl");
    let end = Instant::now() + Duration::from_secs(20);
    let lines = loop {
        let text = std::fs::read_to_string(&list).unwrap_or_default();
        if text.lines().count() == 2 {
            break text;
        }
        assert!(Instant::now() < end, "frames: {text:?}");
        std::thread::sleep(Duration::from_millis(20));
    };
    for line in lines.lines() {
        let line: serde_json::Value = serde_json::from_str(line).expect("json");
        let image = image::open(directory.path().join("frames").join(line["file"].as_str().expect("name")))
            .expect("image");
        assert_eq!((image.width(), image.height(), image.color()), (324, 243, image::ColorType::L16));
    }
    drop(running.0.stdin.take());
    assert!(running.0.wait().expect("ends").success());
    let vcd = std::fs::read_to_string(at("out.vcd")).expect("dump");
    assert!(vcd.contains("camera0") && vcd.contains("step2"), "{vcd}");
    let left: Vec<_> = std::fs::read_dir(directory.path().join("frames")).expect("directory").collect();
    assert_eq!(left.len(), 3, "two frames, one list, nothing half-written: {left:?}");
}

#[test]
fn program_ends_on_a_signal_and_refuses_bad_scenes() {
    let running = Running(program(&["--tcp", "127.0.0.1:0"]).spawn().expect("runs"));
    let mut running = running;
    let mut line = String::new();
    BufReader::new(running.0.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
    assert!(line.starts_with("port: tcp://127.0.0.1:"), "{line}");
    let id = nix::unistd::Pid::from_raw(running.0.id() as i32);
    nix::sys::signal::kill(id, nix::sys::signal::Signal::SIGTERM).expect("sent");
    assert!(running.0.wait().expect("ends").success());

    let directory = tempfile::tempdir().expect("directory");
    let scene = directory.path().join("scene.toml");
    std::fs::write(&scene, "[camera]\nexposure = 3\n").expect("written");
    let refused = program(&["--scene", scene.to_str().expect("utf-8")]).output().expect("runs");
    assert_eq!(refused.status.code(), Some(2));
    let message = String::from_utf8_lossy(&refused.stderr);
    assert!(message.contains("exposure") && message.contains("line 2"), "{message}");
    let absent = program(&["--scene", "absent.toml"]).output().expect("runs");
    assert_eq!(absent.status.code(), Some(2));
    let address = program(&["--tcp", "256.0.0.1:1"]).output().expect("runs");
    assert_eq!(address.status.code(), Some(2));
    // A file stands where the directory should be.
    let frames = program(&["--frames", scene.to_str().expect("utf-8")]).output().expect("runs");
    assert_eq!(frames.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&frames.stderr).contains("--frames"));
    std::fs::write(&scene, "[light]\nled_electrons_per_s = [inf, 0, 0, 0, 0, 0, 0, 0]\n").expect("written");
    let light = program(&["--scene", scene.to_str().expect("utf-8")]).output().expect("runs");
    let message = String::from_utf8_lossy(&light.stderr);
    assert!(message.contains("light.led_electrons_per_s = inf"), "{message}");

    let printed = program(&["--print-scene", "--seed", "9"]).output().expect("runs");
    let config = daic_hil_sim::SimConfig::from_toml(&String::from_utf8(printed.stdout).expect("utf-8"))
        .expect("valid");
    assert_eq!(config, daic_hil_sim::SimConfig { seed: 9, ..Default::default() });
}
