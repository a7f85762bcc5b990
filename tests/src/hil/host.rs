//! The host's side of every case.

use super::{Target, expected};
use crate::expansion::changes_only;
use daic_protocol::frame::{Decoder, Fed, encode_request};
use daic_protocol::limits::CHUNK_LEN;
use daic_protocol::message::*;
use daic_protocol::program::{Instruction, encode_instruction, hash};

/// A target and what the host knows of it.
pub struct Host {
    /// The target.
    pub target: Box<dyn Target>,
    decoder: Decoder,
    next_id: u32,
    /// Edges recorded in this case.
    edges: Vec<(u64, u32)>,
    watched: bool,
}

/// A run that has ended.
#[derive(Debug, Clone)]
pub struct Ran {
    /// First tick of the program on the board's clock.
    pub start: u64,
    /// Events of the run.
    pub events: Vec<Event>,
    /// Changes of the word of this run, on the recorder's clock; empty where nobody watches.
    pub edges: Vec<(u64, u32)>,
    /// Fault, if it ended in one.
    pub fault: Option<Fault>,
}

impl Host {
    /// Talks to `target`.
    pub fn new(target: Box<dyn Target>) -> Self {
        // A board that was not restarted must not take a request for one that it knows.
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let next_id = now.map_or(1, |t| t.as_secs() as u32) << 12;
        Self { target, decoder: Decoder::new(), next_id, edges: Vec::new(), watched: true }
    }

    /// A fresh board.
    pub fn restart(&mut self) {
        self.target.restart();
        self.decoder = Decoder::new();
        self.edges.clear();
        self.watched = self.target.edges().is_some();
        if !self.watched {
            // A real board: only a run that is under way has to end. What it answers does not matter.
            let _ = self.request(&Request::Abort);
            let _ = self.request(&Request::ClearFault);
        }
    }

    /// Whether edges can be seen.
    pub fn watched(&self) -> bool {
        self.watched
    }

    /// Bytes of a new request, and its id.
    pub fn frame(&mut self, request: &Request) -> (u32, Vec<u8>) {
        let id = self.next_id;
        self.next_id += 1;
        (id, encode_request(id, request).expect("requests fit").to_vec())
    }

    /// The reply to these bytes.
    ///
    /// # Errors
    /// No reply with this id.
    pub fn exchange(&mut self, id: u32, frame: &[u8]) -> Result<Reply, String> {
        for _ in 0..3 {
            for byte in self.target.exchange(frame) {
                if let Fed::Message { id: of, message, .. } = self.decoder.feed_reply(byte)
                    && of == id
                {
                    return Ok(message);
                }
            }
        }
        Err(format!("no reply to request {id}"))
    }

    /// The reply to a new request.
    ///
    /// # Errors
    /// No reply.
    pub fn request(&mut self, request: &Request) -> Result<Reply, String> {
        let (id, frame) = self.frame(request);
        self.exchange(id, &frame).map_err(|error| format!("{request:?}: {error}"))
    }

    /// State after a request that must be carried out.
    ///
    /// # Errors
    /// No reply, or a refusal.
    pub fn done(&mut self, request: &Request) -> Result<State, String> {
        match self.request(request)? {
            Reply::Done { state } => Ok(state),
            other => Err(format!("{request:?}: {other:?}")),
        }
    }

    /// Who is there.
    ///
    /// # Errors
    /// No reply.
    pub fn hello(&mut self) -> Result<Hello, String> {
        match self.request(&Request::Hello)? {
            Reply::Hello(hello) => Ok(hello),
            other => Err(format!("{other:?}")),
        }
    }

    /// State now.
    ///
    /// # Errors
    /// No reply.
    pub fn status(&mut self) -> Result<Status, String> {
        match self.request(&Request::Status)? {
            Reply::Status(status) => Ok(status),
            other => Err(format!("{other:?}")),
        }
    }

    /// How the board is doing.
    ///
    /// # Errors
    /// No reply.
    pub fn health(&mut self) -> Result<Health, String> {
        match self.request(&Request::Health)? {
            Reply::Health(health) => Ok(health),
            other => Err(format!("{other:?}")),
        }
    }

    /// Loads and commits.
    ///
    /// # Errors
    /// A refusal, or no reply.
    pub fn load(&mut self, program: &[Instruction]) -> Result<u32, String> {
        let bytes: Vec<u8> = program.iter().flat_map(encode_instruction).collect();
        let (length, hash) = (bytes.len() as u32, hash(&bytes));
        self.done(&Request::LoadBegin { length })?;
        for (index, chunk) in (0u16..).zip(bytes.chunks(CHUNK_LEN)) {
            self.done(&Request::LoadChunk { index, data: chunk.iter().copied().collect() })?;
        }
        self.done(&Request::LoadCommit { length, hash })?;
        Ok(hash)
    }

    /// Loads, arms and starts.
    ///
    /// # Errors
    /// A refusal, or no reply.
    pub fn start(&mut self, program: &[Instruction]) -> Result<(), String> {
        let hash = self.load(program)?;
        self.done(&Request::Arm { hash })?;
        self.recorded();
        self.edges.clear();
        self.done(&Request::Start)?;
        Ok(())
    }

    /// Replies to several requests that are sent at once.
    ///
    /// # Errors
    /// Fewer replies than requests.
    pub fn requests(&mut self, requests: &[Request]) -> Result<Vec<Reply>, String> {
        let mut ids = Vec::new();
        let mut bytes = Vec::new();
        for request in requests {
            let (id, frame) = self.frame(request);
            ids.push(id);
            bytes.extend(frame);
        }
        let mut replies = Vec::new();
        for _ in 0..2 * requests.len() {
            for byte in self.target.exchange(&bytes) {
                if let Fed::Message { id, message, .. } = self.decoder.feed_reply(byte)
                    && ids.contains(&id)
                {
                    replies.push(message);
                }
            }
            if replies.len() == requests.len() {
                return Ok(replies);
            }
            bytes.clear();
        }
        Err(format!("{} replies to {requests:?}", replies.len()))
    }

    /// Forgets what was recorded.
    pub fn forget(&mut self) {
        self.recorded();
        self.edges.clear();
    }

    /// Everything recorded so far in this run.
    pub fn recorded(&mut self) -> &[(u64, u32)] {
        if let Some(edges) = self.target.edges() {
            self.edges.extend(edges);
        }
        &self.edges
    }

    /// Waits for the end of the run that was started, `slice` ticks at a time.
    ///
    /// # Errors
    /// It does not end within `patience` ticks, or the board is silent.
    pub fn finish(&mut self, from: u32, slice: u64, patience: u64) -> Result<Ran, String> {
        let mut events = Vec::new();
        let mut from = from;
        let mut waited = 0;
        loop {
            let Reply::Events(reply) = self.request(&Request::ReadEvents { from })? else {
                return Err("no events".into());
            };
            let more = reply.events.len() == daic_protocol::limits::EVENTS_PER_REPLY;
            for event in reply.events {
                from = event.seq.wrapping_add(1);
                events.push(event);
            }
            let last = events.last().map(|e: &Event| e.kind);
            if matches!(last, Some(EventKind::RunDone { .. } | EventKind::Faulted { .. })) {
                break;
            }
            if !more {
                if waited > patience {
                    return Err(format!("not ended after {waited} ticks; last event {last:?}"));
                }
                self.target.pass(slice);
                waited += slice;
            }
        }
        self.target.pass(1000);
        let fault = self.status()?.fault;
        let start = events.iter().find(|e| matches!(e.kind, EventKind::RunStarted { .. }));
        let edges = changes_only(self.recorded());
        Ok(Ran { start: start.map_or(0, |e| e.tick), events, edges, fault })
    }

    /// Plays a program to its end.
    ///
    /// # Errors
    /// As of the parts.
    pub fn play(&mut self, program: &[Instruction]) -> Result<Ran, String> {
        let length = expected(program).last().map_or(0, |e| e.0);
        let from = self.status()?.next_event;
        self.start(program)?;
        self.finish(from, 125_000, 2 * length + 10_000_000)
    }

    /// Compares what was recorded with the independent expansion of the program; every edge must be
    /// there at its tick. Returns the recorder's tick of the program's first one.
    ///
    /// # Errors
    /// The first edge that differs, and by how much.
    pub fn compare(&self, program: &[Instruction], ran: &Ran) -> Result<i64, String> {
        let expected = expected(program);
        let origin = match (self.target.edges_on_board_clock(), ran.edges.first(), expected.first()) {
            (true, ..) => ran.start as i64,
            (false, Some(got), Some(wanted)) => got.0 as i64 - wanted.0 as i64,
            (false, None, None) => 0,
            (false, got, wanted) => return Err(format!("first edge {got:?}, expected {wanted:?}")),
        };
        let got: Vec<(i64, u32)> = ran.edges.iter().map(|&(t, w)| (t as i64 - origin, w)).collect();
        let wanted: Vec<(i64, u32)> = expected.iter().map(|&(t, w)| (t as i64, w)).collect();
        for (index, pair) in got.iter().zip(&wanted).enumerate() {
            if pair.0 != pair.1 {
                return Err(format!("edge {index}: {:?}, expected {:?}", pair.0, pair.1));
            }
        }
        if got.len() != wanted.len() {
            return Err(format!("{} edges, expected {}", got.len(), wanted.len()));
        }
        Ok(origin)
    }
}
