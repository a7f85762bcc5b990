//! A small host written by hand, and small rigs to test with.
#![allow(dead_code, reason = "every test file uses its own part of it")]

use std::io::{ErrorKind, Read, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use daic_hil_sim::SimConfig;
use daic_protocol::channels;
use daic_protocol::frame::{Decoder, Fed, encode_request};
use daic_protocol::limits::CHUNK_LEN;
use daic_protocol::message::{Event, EventKind, Reply, Request, State};
use daic_protocol::program::{Instruction, encode_instruction, hash};

/// Directory of the published reference data, if it is there.
pub fn shared() -> Option<PathBuf> {
    let path = std::env::var_os("DAIC_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")), PathBuf::from);
    path.join("golden").is_dir().then_some(path)
}

/// The macro set-up with everything on the sensor eight times smaller: 324 × 243 pixels.
pub fn small() -> SimConfig {
    let mut config = SimConfig { seed: 11, ..SimConfig::default() };
    config.camera.width = 324;
    config.camera.height = 243;
    config.scene.optics.focal_px /= 8.0;
    config.scene.texture.speckle_mm *= 8.0;
    config
}

/// No noise at all: counts follow from light alone.
pub fn noiseless(mut config: SimConfig) -> SimConfig {
    config.camera.photon_noise = false;
    config.camera.read_noise_electrons = 0.0;
    config
}

/// Talks to a box over anything that can be read and written.
pub struct Host<S> {
    stream: S,
    decoder: Decoder,
    next_id: u32,
}

impl<S: Read + Write> Host<S> {
    pub fn new(stream: S) -> Self {
        // Ids of one host must not look like repeats of those of the host before it.
        static HOSTS: AtomicU32 = AtomicU32::new(1);
        let next_id = HOSTS.fetch_add(1, Ordering::Relaxed) << 16;
        Self { stream, decoder: Decoder::new(), next_id }
    }

    /// The reply to a request, or `None` after two seconds of silence.
    pub fn try_request(&mut self, request: &Request) -> Option<Reply> {
        let id = self.next_id;
        self.next_id += 1;
        self.stream.write_all(&encode_request(id, request).expect("fits")).ok()?;
        let end = Instant::now() + Duration::from_secs(2);
        let mut byte = [0];
        while Instant::now() < end {
            match self.stream.read(&mut byte) {
                Ok(1) => match self.decoder.feed_reply(byte[0]) {
                    Fed::Message { id: of, message, .. } if of == id => return Some(message),
                    Fed::Rejected => panic!("reply rejected: {:?}", self.decoder.rejected),
                    _ => {}
                },
                Ok(_) => return None,
                Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock) => {}
                Err(e) => panic!("link: {e}"),
            }
        }
        None
    }

    pub fn request(&mut self, request: &Request) -> Reply {
        self.try_request(request).unwrap_or_else(|| panic!("no reply to {request:?}"))
    }

    fn done(&mut self, request: &Request) -> State {
        match self.request(request) {
            Reply::Done { state } => state,
            other => panic!("{request:?}: {other:?}"),
        }
    }

    /// Loads, arms and starts a program.
    pub fn start(&mut self, program: &[Instruction]) {
        let bytes: Vec<u8> = program.iter().flat_map(encode_instruction).collect();
        let (length, hash) = (bytes.len() as u32, hash(&bytes));
        self.done(&Request::LoadBegin { length });
        for (index, chunk) in (0u16..).zip(bytes.chunks(CHUNK_LEN)) {
            self.done(&Request::LoadChunk { index, data: chunk.iter().copied().collect() });
        }
        assert_eq!(self.done(&Request::LoadCommit { length, hash }), State::Loaded);
        assert_eq!(self.done(&Request::Arm { hash }), State::Armed);
        self.done(&Request::Start);
    }

    /// Runs a program to its end and returns its events.
    pub fn run(&mut self, program: &[Instruction]) -> Vec<Event> {
        let mut from = self.status().next_event;
        self.start(program);
        let mut events = Vec::new();
        let end = Instant::now() + Duration::from_secs(20);
        while Instant::now() < end {
            let Reply::Events(reply) = self.request(&Request::ReadEvents { from }) else {
                panic!("no events")
            };
            for event in reply.events {
                from = event.seq + 1;
                events.push(event);
                if matches!(event.kind, EventKind::RunDone { .. } | EventKind::Faulted { .. }) {
                    return events;
                }
            }
        }
        panic!("the program did not end; events so far: {events:?}");
    }

    pub fn status(&mut self) -> daic_protocol::message::Status {
        match self.request(&Request::Status) {
            Reply::Status(status) => status,
            other => panic!("{other:?}"),
        }
    }

    pub fn boot_id(&mut self) -> u32 {
        match self.request(&Request::Hello) {
            Reply::Hello(hello) => hello.boot_id,
            other => panic!("{other:?}"),
        }
    }
}

/// Ticks of a microsecond.
pub const US: u32 = 125;

pub fn led() -> u32 {
    channels::led(0).expect("there")
}
pub fn camera() -> u32 {
    channels::camera(0).expect("there")
}

pub fn set(mask: u32, after: u32) -> Instruction {
    Instruction::Edge { mask, value: mask, after }
}
pub fn clear(mask: u32, after: u32) -> Instruction {
    Instruction::Edge { mask, value: 0, after }
}
pub fn level(level: u16) -> [Instruction; 2] {
    [Instruction::Level { led: 0, level }, Instruction::Settle { ticks: 12_500 }]
}
pub fn go(axis: u8, target: i32) -> Instruction {
    Instruction::Move { axis, target, max_rate: 64_000, acceleration: 640_000, jerk: 0 }
}

/// Trigger, `delay_us` later a strobe of `pulse_us`, then time to read out.
pub fn strobed(delay_us: u32, pulse_us: u32) -> Vec<Instruction> {
    vec![
        set(camera(), 1000),
        set(led(), delay_us * US),
        clear(led(), pulse_us * US),
        clear(camera(), 10 * US),
        Instruction::Delay { ticks: 15_000 * US },
    ]
}
