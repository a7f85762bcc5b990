//! The link against the real controller: over a pipe, a pseudo-terminal and TCP, with faults.

mod common;

use common::TestBox;
use daic_protocol::frame::{Decoder, Fed, encode_reply};
use daic_protocol::message::{Event, EventKind, Hello, Refusal, Reply, Request, Rule, SCHEMA_HASH, State};
use daic_protocol::program::Instruction;
use daic_rig::compile::encode;
use daic_rig::link::{EventReader, Link, LinkError, LinkOptions, Outcome, StreamTransport, Transport, pipe};
use std::io::{Read, Write};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;

/// Patient enough for a loaded machine, yet quick where silence is wanted.
fn options() -> LinkOptions {
    LinkOptions { timeout: Duration::from_millis(100), attempts: 4, ..LinkOptions::default() }
}

fn connect() -> (TestBox, Link) {
    let (rig, end) = TestBox::piped();
    let link = Link::over(Box::new(end), "pipe", options()).expect("hello");
    (rig, link)
}

fn blink(times: u32) -> Vec<u8> {
    encode(&[
        Instruction::Level { led: 0, level: 65_535 },
        Instruction::Settle { ticks: 100_000 },
        Instruction::LoopBegin { count: times },
        Instruction::Edge { mask: 1, value: 1, after: 1000 },
        Instruction::Edge { mask: 1, value: 0, after: 1000 },
        Instruction::LoopEnd,
    ])
}

fn wait_for(link: &mut Link, state: State) {
    for _ in 0..500 {
        if link.status().expect("status").state == state {
            return;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    panic!("the box never was {state:?}");
}

#[test]
fn a_program_is_loaded_armed_started_and_its_events_read() {
    let (rig, mut link) = connect();
    assert_eq!(link.hello().magic, Hello::MAGIC);
    assert_eq!(link.status().expect("status").state, State::Empty);
    // More than one chunk.
    let mut long = blink(30);
    long.extend(encode(&[Instruction::Delay { ticks: 1000 }; 200]));
    assert!(long.len() > 500, "{}", long.len());
    let hash = link.load(&long).expect("load");
    assert_eq!(link.status().expect("status").program, Some(hash));
    assert_eq!(link.arm(hash).expect("arm"), State::Armed);
    let mut reader = EventReader::new(link.status().expect("status").next_event);
    link.start().expect("start");
    wait_for(&mut link, State::Loaded);
    let mut events = Vec::new();
    let n = reader.poll(&mut link, &mut events).expect("events");
    assert_eq!(n, events.len());
    // Run started, level, settled, 60 edges, level off, run done.
    assert_eq!(n, 65, "{events:?}");
    assert!(events.windows(2).all(|w| w[1].seq == w[0].seq + 1 && w[1].tick >= w[0].tick));
    assert_eq!(rig.faults.starts.load(SeqCst), 1);
    assert_eq!(link.stats().retries, 0);
}

#[test]
fn lost_replies_are_asked_for_again_and_nothing_happens_twice() {
    let (rig, mut link) = connect();
    let hash = link.load(&blink(3)).expect("load");
    link.arm(hash).expect("arm");
    rig.faults.lose_replies.store(3, SeqCst);
    link.start().expect("start after three lost replies");
    assert_eq!(rig.faults.starts.load(SeqCst), 1);
    assert_eq!(link.stats().retries, 3);
    assert_eq!(link.status().expect("status").run, 1);
    // And a clock sample whose request was repeated is none.
    rig.faults.lose_replies.store(1, SeqCst);
    assert_eq!(link.clock_sample().expect("clock"), None);
    assert!(link.clock_sample().expect("clock").is_some());
}

#[test]
fn a_second_copy_of_a_reply_is_ignored() {
    let (rig, mut link) = connect();
    rig.faults.double_replies.store(5, SeqCst);
    let hash = link.load(&blink(3)).expect("load");
    link.arm(hash).expect("arm");
    for _ in 0..5 {
        assert_eq!(link.status().expect("status").state, State::Armed);
    }
    assert_eq!((link.stats().stale, link.stats().retries), (5, 0));
}

#[test]
fn a_refusal_names_instruction_and_rule_and_changes_nothing() {
    let (_rig, mut link) = connect();
    let good = link.load(&blink(3)).expect("load");
    let bad =
        encode(&[Instruction::Delay { ticks: 10 }, Instruction::Edge { mask: 1 << 31, value: 0, after: 10 }]);
    let error = link.load(&bad).expect_err("forbidden bit");
    let LinkError::Refused { request: "LoadCommit", refusal: Refusal::Invalid(v) } = error else {
        panic!("{error:?}")
    };
    assert_eq!((v.instruction, v.rule), (1, Rule::ForbiddenBits));
    assert!(error.is_input() && error.outcome() == Outcome::Refused);
    assert!(error.to_string().contains("instruction 1 breaks the rule ForbiddenBits"), "{error}");
    assert_eq!(link.status().expect("status").program, Some(good));
    let error = link.start().expect_err("not armed");
    assert!(
        matches!(error, LinkError::Refused { request: "Start", refusal: Refusal::WrongState { .. } }),
        "{error:?}"
    );
    let error = link.load(&vec![0; 100_000]).expect_err("too long");
    assert!(matches!(error, LinkError::ProgramTooLong { length: 100_000, .. }), "{error:?}");
    assert_eq!(error.outcome(), Outcome::NotSent);
}

#[test]
fn a_box_that_falls_silent_is_named_after_a_bounded_time() {
    let (rig, mut link) = connect();
    rig.faults.silent.store(true, SeqCst);
    let error = link.status().expect_err("silent");
    let LinkError::Silent { request: "Status", attempts: 4, after_ms, .. } = error else {
        panic!("{error:?}")
    };
    assert!((400..10_000).contains(&after_ms), "{after_ms}");
    assert_eq!(error.outcome(), Outcome::Unknown);
    rig.faults.silent.store(false, SeqCst);
    link.status().expect("speaks again");
}

#[test]
fn a_reset_in_the_middle_is_noticed_by_every_request() {
    type Action = fn(&mut Link) -> Result<(), LinkError>;
    let actions: [(&str, Action); 7] = [
        ("status", |l| l.status().map(drop)),
        ("load", |l| l.load(&blink(2)).map(drop)),
        ("arm", |l| l.arm(0).map(drop)),
        ("start", |l| l.start().map(drop)),
        ("events", |l| EventReader::new(5).poll(l, &mut Vec::new()).map(drop)),
        ("clock", |l| l.clock_sample().map(drop)),
        ("clear", |l| l.clear_fault().map(drop)),
    ];
    for (name, action) in actions {
        let (rig, mut link) = connect();
        let hash = link.load(&blink(3)).expect("load");
        link.arm(hash).expect("arm");
        rig.faults.reset.store(true, SeqCst);
        let error = action(&mut link).expect_err(name);
        assert!(matches!(error, LinkError::BoardReset { before: 1, after: 2 }), "{name}: {error:?}");
        assert_eq!(rig.faults.starts.load(SeqCst), 0, "{name}");
    }
}

#[test]
fn overwritten_events_are_reported_with_their_numbers() {
    let (_rig, mut link) = connect();
    let hash = link.load(&blink(400)).expect("load");
    link.arm(hash).expect("arm");
    link.start().expect("start");
    wait_for(&mut link, State::Loaded);
    let mut reader = EventReader::new(0);
    let mut events = Vec::new();
    let error = reader.poll(&mut link, &mut events).expect_err("805 events in a ring of 256");
    let LinkError::EventsLost { from: 0, to } = error else { panic!("{error:?}") };
    assert_eq!(reader.next(), to + 1);
    reader.poll(&mut link, &mut events).expect("the rest");
    assert_eq!(events.first().map(|e| e.seq), Some(to + 1));
    assert_eq!(reader.next(), 805);
}

#[test]
fn what_is_not_a_box_is_refused() {
    // An echo: our own request is no reply.
    let (rig, end) = TestBox::piped();
    rig.faults.echo.store(true, SeqCst);
    let error = Link::over(Box::new(end), "echo", options()).expect_err("echo");
    assert!(matches!(error, LinkError::NotOurs { heard: 1.., .. }), "{error:?}");
    // Nobody.
    let (end, _other) = pipe();
    let error = Link::over(Box::new(end), "nobody", options()).expect_err("nobody");
    assert!(matches!(error, LinkError::Silent { request: "Hello", .. }), "{error:?}");
    // A closed pipe.
    let (end, other) = pipe();
    drop(other);
    let error = Link::over(Box::new(end), "closed", options()).expect_err("closed");
    assert!(matches!(error, LinkError::Disconnected { .. }), "{error:?}");
}

#[test]
fn another_magic_version_or_schema_is_refused_by_name() {
    let hello = || {
        let (_rig, link) = connect();
        link.hello().clone()
    };
    type Change = fn(&mut Hello);
    let cases: [(Change, &str); 4] = [
        (|h| h.magic = 1, "is not a daic trigger box"),
        (|h| h.tick_hz = 0, "is not a daic trigger box"),
        (|h| h.protocol += 1, "the box speaks protocol 2, this program 1"),
        (|h| h.schema = SCHEMA_HASH ^ 1, "the box's messages"),
    ];
    for (change, text) in cases {
        let (end, mut other) = pipe();
        let mut changed = hello();
        change(&mut changed);
        let peer = std::thread::spawn(move || {
            let mut decoder = Decoder::new();
            let mut byte = [0];
            loop {
                assert!(
                    other.read(&mut byte, Duration::from_secs(5)).expect("request") > 0,
                    "no request came"
                );
                if let Fed::Message { id, message: Request::Hello, .. } = decoder.feed_request(byte[0]) {
                    let reply = encode_reply(id, &Reply::Hello(changed)).expect("reply");
                    return other.write(&reply, Duration::from_secs(1)).map(|()| other);
                }
            }
        });
        let error = Link::over(Box::new(end), "other", options()).expect_err(text).to_string();
        assert!(error.contains(text), "{error}");
        drop(peer.join().expect("peer"));
    }
}

#[cfg(unix)]
#[test]
fn over_a_pseudo_terminal_the_port_is_opened_locked_and_used() {
    let (master, path) = common::pty::open();
    let rig = TestBox::serve(Box::new(master));
    let mut link = Link::open(&path, options()).expect("open");
    let hash = link.load(&blink(30)).expect("load");
    link.arm(hash).expect("arm");
    rig.faults.lose_replies.store(2, SeqCst);
    link.start().expect("start");
    assert_eq!(rig.faults.starts.load(SeqCst), 1);

    let error = Link::open(&path, options()).expect_err("busy");
    assert!(matches!(error, LinkError::PortBusy { .. }), "{error:?}");
    assert!(!error.is_input());

    rig.faults.silent.store(true, SeqCst);
    let error = link.status().expect_err("silent");
    assert!(matches!(error, LinkError::Silent { .. }), "{error:?}");
    rig.faults.silent.store(false, SeqCst);
    rig.faults.reset.store(true, SeqCst);
    let error = link.status().expect_err("reset");
    assert!(matches!(error, LinkError::BoardReset { .. }), "{error:?}");
    drop(link);

    // Opened again: a new session finds the new boot, whatever bytes were left over.
    let link = Link::open(&path, options()).expect("open again");
    assert_eq!(link.hello().boot_id, 2);
    drop(link);
    rig.faults.echo.store(true, SeqCst);
    let error = Link::open(&path, options()).expect_err("echo");
    assert!(matches!(error, LinkError::NotOurs { .. }), "{error:?}");
    rig.faults.echo.store(false, SeqCst);

    // The cable is pulled.
    let mut link = Link::open(&path, options()).expect("open a third time");
    drop(rig);
    let error = link.status().expect_err("gone");
    assert!(matches!(error, LinkError::Disconnected { .. } | LinkError::Silent { .. }), "{error:?}");
}

#[test]
fn ports_that_are_absent_or_no_ports_are_refused_with_the_way_out() {
    let error = Link::open("/dev/daic-no-such-port", options()).expect_err("absent");
    assert!(matches!(error, LinkError::PortAbsent { .. }), "{error:?}");
    let text = error.to_string();
    assert!(text.contains("/dev/daic-no-such-port") && text.contains("tcp://host:port"), "{text}");
    assert!(text.contains("`daic simulate`") && !text.contains("or sim"), "{text}");
    let error = Link::open("sim", options()).expect_err("no port");
    assert!(matches!(error, LinkError::SimulatedRig) && error.is_input(), "{error:?}");
    assert!(error.to_string().contains("`daic simulate`"), "{error}");
    let file = tempfile::NamedTempFile::new().expect("file");
    let error = Link::open(&file.path().to_string_lossy(), options()).expect_err("a file");
    assert!(matches!(error, LinkError::PortRefused { .. }), "{error:?}");
    for text in ["tcp://", "tcp://nowhere", "tcp://host:port", "tcp://:7000"] {
        let error = Link::open(text, options()).expect_err(text);
        assert!(matches!(error, LinkError::BadAddress { .. }) && error.is_input(), "{error:?}");
    }
    // A port that was free a moment ago: nobody listens there.
    let free = std::net::TcpListener::bind("127.0.0.1:0").expect("bind").local_addr().expect("address");
    let error = Link::open(&format!("tcp://{free}"), options()).expect_err("nobody listens");
    assert!(matches!(error, LinkError::Unreachable { .. }) && !error.is_input(), "{error:?}");
}

#[test]
fn over_tcp_and_over_any_stream() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("bind");
    let address = listener.local_addr().expect("address");
    let accept = std::thread::spawn(move || listener.accept().expect("accept").0);
    let opener = std::thread::spawn(move || Link::open(&format!("tcp://{address}"), options()));
    let stream = accept.join().expect("accepted");
    stream.set_read_timeout(Some(Duration::from_millis(1))).expect("timeout");
    let rig = TestBox::serve(Box::new(StreamTransport::new(stream)));
    let mut link = opener.join().expect("opener").expect("hello");
    assert_eq!(link.status().expect("status").state, State::Empty);
    drop(rig);
    let error = link.status().expect_err("closed");
    assert!(matches!(error, LinkError::Disconnected { .. } | LinkError::Silent { .. }), "{error:?}");
}

/// The box's side of a line that is pulled out and plugged in again, many times.
struct Loose<T, F> {
    line: Option<T>,
    /// Makes a new line, or not yet.
    plug: F,
    /// Set: pull it out.
    pull: Arc<AtomicBool>,
}

impl<T: Transport, F: FnMut() -> Option<T> + Send> Transport for Loose<T, F> {
    fn read(&mut self, buffer: &mut [u8], timeout: Duration) -> std::io::Result<usize> {
        if self.pull.swap(false, SeqCst) {
            self.line = None;
        }
        if self.line.is_none() {
            self.line = (self.plug)();
        }
        let Some(line) = &mut self.line else {
            std::thread::sleep(timeout);
            return Ok(0);
        };
        Ok(line.read(buffer, timeout).unwrap_or_else(|_| {
            self.line = None;
            0
        }))
    }
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> std::io::Result<()> {
        // what is written to a line that is not there is lost, and the box goes on
        if self.line.as_mut().is_some_and(|line| line.write(bytes, timeout).is_err()) {
            self.line = None;
        }
        Ok(())
    }
}

/// Plays 400 events while the line is pulled out again and again; none is lost, nothing happens twice.
fn survives(port: &str, line: Box<dyn Transport>, pull: &AtomicBool) {
    let rig = TestBox::serve(line);
    let mut link = Link::open(port, options()).expect("hello");
    let program = encode(&[
        Instruction::LoopBegin { count: 100 },
        Instruction::Edge { mask: 1, value: 1, after: 625_000 },
        Instruction::Edge { mask: 1, value: 0, after: 1000 },
        Instruction::LoopEnd,
    ]);
    pull.store(true, SeqCst);
    let hash = link.load(&program).expect("load");
    pull.store(true, SeqCst);
    link.arm(hash).expect("arm");
    let mut reader = EventReader::new(0);
    pull.store(true, SeqCst);
    link.start().expect("start");
    let mut events = Vec::new();
    let mut pulls = 3;
    while !events.iter().any(|e: &Event| matches!(e.kind, EventKind::RunDone { .. })) {
        reader.poll(&mut link, &mut events).expect("events");
        std::thread::sleep(Duration::from_millis(30));
        pull.store(true, SeqCst);
        pulls += 1;
    }
    assert_eq!(events.len(), 202, "{port}");
    assert!(events.iter().zip(0..).all(|(event, seq)| event.seq == seq));
    assert_eq!(rig.faults.starts.load(SeqCst), 1, "{port}");
    let stats = link.stats();
    eprintln!("{port}: pulled {pulls} times, {stats:?}");
    assert!(stats.reconnects >= 5, "{stats:?}");
}

/// A TCP port whose line can be pulled out: its name, the box's side, what pulls.
fn loose_tcp() -> (String, Box<dyn Transport>, Arc<AtomicBool>) {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("bind");
    let address = listener.local_addr().expect("address");
    listener.set_nonblocking(true).expect("nonblocking");
    let plug = move || {
        let (stream, _) = listener.accept().ok()?;
        stream.set_read_timeout(Some(Duration::from_millis(1))).ok()?;
        Some(StreamTransport::new(stream))
    };
    let pull = Arc::new(AtomicBool::new(false));
    let line = Loose { line: None, plug, pull: pull.clone() };
    (format!("tcp://{address}"), Box::new(line), pull)
}

#[test]
fn a_line_that_is_pulled_out_loses_no_event() {
    let (port, line, pull) = loose_tcp();
    survives(&port, line, &pull);
}

#[cfg(unix)]
#[test]
fn a_serial_line_that_is_pulled_out_loses_no_event() {
    let folder = tempfile::TempDir::new().expect("folder");
    let path = folder.path().join("box");
    let link = path.clone();
    let plug = move || {
        let (master, name) = common::pty::open();
        std::fs::remove_file(&link).ok();
        std::os::unix::fs::symlink(name, &link).expect("link");
        Some(master)
    };
    let pull = Arc::new(AtomicBool::new(false));
    let mut loose = Loose { line: None, plug, pull: pull.clone() };
    // the port must be there before a host opens it
    assert_eq!(loose.read(&mut [0; 8], Duration::ZERO).expect("nothing"), 0);
    survives(path.to_str().expect("utf-8"), Box::new(loose), &pull);
}

#[test]
fn a_box_that_was_reset_while_it_was_unplugged_is_told() {
    let (port, line, pull) = loose_tcp();
    let rig = TestBox::serve(line);
    let mut link = Link::open(&port, options()).expect("hello");
    rig.faults.reset.store(true, SeqCst);
    pull.store(true, SeqCst);
    std::thread::sleep(Duration::from_millis(20));
    let error = link.request(&Request::Inputs).expect_err("another boot");
    assert!(matches!(error, LinkError::BoardReset { .. }), "{error:?}");
}

/// A stream that takes one byte at a time and gives one byte at a time.
struct Trickle(daic_rig::link::PipeEnd);

impl Read for Trickle {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let n = buffer.len().min(1);
        Transport::read(&mut self.0, &mut buffer[..n], Duration::ZERO)
    }
}
impl Write for Trickle {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let n = bytes.len().min(1);
        Transport::write(&mut self.0, &bytes[..n], Duration::ZERO).map(|()| n)
    }
    fn flush(&mut self) -> std::io::Result<()> {
        panic!("the link must never flush")
    }
}

#[test]
fn bytes_may_trickle_and_are_never_flushed() {
    let (_rig, end) = TestBox::piped();
    let mut link =
        Link::over(Box::new(StreamTransport::new(Trickle(end))), "trickle", options()).expect("hello");
    let hash = link.load(&blink(3)).expect("load");
    assert_eq!(link.arm(hash).expect("arm"), State::Armed);
}
