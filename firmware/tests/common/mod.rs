//! A box on a fake clock.
#![allow(dead_code)]

pub mod naive;
pub mod random;

use daic_firmware::{AxisLimits, Board, Controller, LedLimits, Overdrive, Sink};
use daic_protocol::frame::{Decoder, Fed, encode_request};
use daic_protocol::limits::CHUNK_LEN;
use daic_protocol::message::*;
use daic_protocol::program::{self, Instruction};

/// Records what is played.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct Recorder {
    pub words: Vec<(u64, u32)>,
    pub levels: Vec<(u64, u8, u16)>,
}

impl Sink for Recorder {
    fn word(&mut self, tick: u64, word: u32) {
        self.words.push((tick, word));
    }
    fn level(&mut self, tick: u64, led: u8, level: u16) {
        self.levels.push((tick, led, level));
    }
}

/// A controller, its clock and its host.
pub struct Rig {
    pub controller: Controller,
    pub now: u64,
    pub out: Recorder,
    pub next_id: u32,
}

impl Rig {
    pub fn new(board: Board) -> Self {
        Self { controller: Controller::new(board, 0xb007), now: 1000, out: Recorder::default(), next_id: 1 }
    }

    /// Sends bytes; returns the bytes that come back.
    pub fn exchange(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut back = Vec::new();
        self.controller.receive(self.now, bytes, &mut self.out, &mut |frame| back.extend_from_slice(frame));
        back
    }

    /// Sends a request under the id given; panics unless there is exactly one reply to it.
    pub fn ask_as(&mut self, id: u32, request: &Request) -> Reply {
        let mut replies = decode_replies(&self.exchange(&encode_request(id, request).unwrap()));
        assert_eq!(replies.len(), 1, "{request:?}");
        let (replied, reply) = replies.pop().unwrap();
        assert_eq!(replied, id);
        reply
    }

    /// Sends a request under a new id.
    pub fn ask(&mut self, request: Request) -> Reply {
        self.next_id += 1;
        self.ask_as(self.next_id, &request)
    }

    /// Sends a request that must be done; returns the state.
    pub fn done(&mut self, request: Request) -> State {
        match self.ask(request.clone()) {
            Reply::Done { state } => state,
            other => panic!("{request:?} → {other:?}"),
        }
    }

    /// Sends a request that must be refused.
    pub fn refused(&mut self, request: Request) -> Refusal {
        match self.ask(request.clone()) {
            Reply::Refused(refusal) => refusal,
            other => panic!("{request:?} → {other:?}"),
        }
    }

    pub fn status(&mut self) -> Status {
        match self.ask(Request::Status) {
            Reply::Status(status) => status,
            other => panic!("{other:?}"),
        }
    }

    /// Stages and commits; returns the reply to the commit.
    pub fn load_bytes(&mut self, bytes: &[u8]) -> Reply {
        let length = bytes.len() as u32;
        self.done(Request::LoadBegin { length });
        for (index, data) in bytes.chunks(CHUNK_LEN).enumerate() {
            self.done(Request::LoadChunk { index: index as u16, data: data.iter().copied().collect() });
        }
        self.ask(Request::LoadCommit { length, hash: program::hash(bytes) })
    }

    /// Loads, arms and starts; returns the tick at which the program begins.
    pub fn start(&mut self, program: &[Instruction]) -> u64 {
        let bytes = program::encode(program).unwrap();
        assert_eq!(self.load_bytes(&bytes), Reply::Done { state: State::Loaded });
        self.start_again(&bytes)
    }

    pub fn start_again(&mut self, bytes: &[u8]) -> u64 {
        assert_eq!(self.done(Request::Arm { hash: program::hash(bytes) }), State::Armed);
        assert_eq!(self.done(Request::Start), State::Running);
        self.controller.next_due().unwrap()
    }

    /// Plays up to `tick`.
    pub fn play_to(&mut self, tick: u64) {
        self.now = tick;
        self.controller.play(tick, &mut self.out);
    }

    /// The inputs change.
    pub fn input(&mut self, tick: u64, word: u32) {
        self.now = self.now.max(tick);
        self.controller.inputs(tick, word, &mut self.out);
    }

    /// Plays to the end of the run, or until only an input can go on.
    pub fn finish(&mut self) {
        while let Some(due) = self.controller.next_due() {
            self.play_to(due);
        }
    }

    /// Every event still kept.
    pub fn events(&mut self) -> Vec<Event> {
        let (mut from, mut all) = (0, Vec::new());
        loop {
            let Reply::Events(got) = self.ask(Request::ReadEvents { from }) else { panic!() };
            all.extend_from_slice(&got.events);
            match got.events.last() {
                Some(last) => from = last.seq + 1,
                None => return all,
            }
        }
    }
}

pub fn decode_replies(bytes: &[u8]) -> Vec<(u32, Reply)> {
    let mut decoder = Decoder::new();
    let mut got = Vec::new();
    for &b in bytes {
        match decoder.feed_reply(b) {
            Fed::Message { id, message, .. } => got.push((id, message)),
            Fed::Pending => {}
            Fed::Rejected => panic!("the box sent nonsense"),
        }
    }
    got
}

/// A board whose limits are near enough that random programs meet them. LED 1 stands less when it is
/// bright.
pub fn small_board() -> Board {
    let axis = AxisLimits {
        min: -40,
        max: 40,
        max_rate: 250_000,
        max_acceleration: 1_000_000_000,
        max_jerk: u32::MAX,
        home: None,
    };
    let plain = LedLimits::new(60, 20);
    let mut bright = LedLimits { window: 200, ..LedLimits::new(60, 20) };
    bright.overdrive.push(Overdrive { above: 30_000, max_pulse: 40, cycle: 5 }).unwrap();
    Board {
        name: "small",
        capabilities: Capabilities::TRIGGER_INPUTS | Capabilities::JERK | Capabilities::STREAMING,
        axes: heapless::Vec::from_array([axis; 2]),
        leds: heapless::Vec::from_array([plain, bright]),
        cameras: 1,
        inputs: 2,
        input_latency: 20,
        start_lead: daic_firmware::START_LEAD,
    }
}

/// The same board without anything that needs a capability.
pub fn bare_board() -> Board {
    Board { capabilities: 0, inputs: 0, ..small_board() }
}

pub fn edge(mask: u32, value: u32, after: u32) -> Instruction {
    Instruction::Edge { mask, value, after }
}
pub fn delay(ticks: u32) -> Instruction {
    Instruction::Delay { ticks }
}
pub fn begin(count: u32) -> Instruction {
    Instruction::LoopBegin { count }
}
pub const END: Instruction = Instruction::LoopEnd;
pub fn level(led: u8, level: u16) -> Instruction {
    Instruction::Level { led, level }
}
pub fn go(axis: u8, target: i32) -> Instruction {
    Instruction::Move { axis, target, max_rate: 50_000, acceleration: 1_000_000, jerk: 0 }
}
