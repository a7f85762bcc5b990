//! Programs that come while they are played.

use super::*;
use daic_protocol::limits::CHUNK_LEN;
use daic_protocol::program::{encode_instruction, hash};

fn state(reply: Option<Reply>) -> Result<StreamState, String> {
    match reply {
        Some(Reply::Stream(state)) => Ok(state),
        other => Err(format!("{other:?}")),
    }
}

/// Sends what there is credit for, at most one message; events are read in the same breath.
struct Sender {
    bytes: Vec<u8>,
    sent: usize,
    state: StreamState,
    from: u32,
    events: Vec<Event>,
    dropped: u32,
}

impl Sender {
    fn new(host: &mut Host, program: &[Instruction]) -> Result<Self, String> {
        let bytes: Vec<u8> = program.iter().flat_map(encode_instruction).collect();
        let from = host.status()?.next_event;
        let state = state(Some(host.request(&Request::StreamBegin)?))?;
        Ok(Self { bytes, sent: 0, state, from, events: Vec::new(), dropped: 0 })
    }

    fn turn(&mut self, host: &mut Host, end: bool) -> Result<(), String> {
        let mut requests = vec![Request::ReadEvents { from: self.from }];
        let room = (self.state.limit as usize).saturating_sub(self.sent).min(CHUNK_LEN);
        let rest = &self.bytes[self.sent..];
        let length = rest.len().min(room);
        let data = rest[..length].iter().copied().collect();
        if self.sent == self.bytes.len() && end && !self.state.ended {
            let (length, hash) = (self.bytes.len() as u32, hash(&self.bytes));
            requests.push(Request::StreamEnd { length, hash });
        } else if length > 0 && (length == CHUNK_LEN || self.sent + length == self.bytes.len()) {
            requests.push(Request::StreamWrite { offset: self.sent as u32, data });
            self.sent += length;
        } else if !self.state.ended {
            requests.push(Request::StreamStatus);
        }
        for reply in host.requests(&requests)? {
            match reply {
                Reply::Stream(state) => self.state = state,
                Reply::Events(read) => {
                    self.dropped = read.dropped;
                    for event in read.events {
                        check(event.seq == self.from, || format!("event {} after {}", event.seq, self.from))?;
                        self.from = event.seq.wrapping_add(1);
                        self.events.push(event);
                    }
                }
                // The run is over.
                Reply::Refused(Refusal::NotStreaming) => {}
                other => return Err(format!("{other:?}")),
            }
        }
        Ok(())
    }

    fn over(&self) -> bool {
        let last = self.events.last().map(|e| e.kind);
        matches!(last, Some(EventKind::RunDone { .. } | EventKind::Faulted { .. }))
    }
}

/// 10 000 edges at 3 125 a second, every one of them told and read; more than the box can hold.
pub(super) fn edges(host: &mut Host, long: bool) -> Result<Outcome, String> {
    let pairs = if long { 50_000 } else { 5_000 };
    let mut program = Vec::new();
    for n in 0..pairs {
        let mask = if n % 7 == 0 { lamp(1) } else { 1 << 12 };
        let jitter = (n * 7919) % 5000;
        program.extend([set(mask, 40_000 + jitter), clear(mask, 40_000 - jitter)]);
    }
    let mut sender = Sender::new(host, &program)?;
    while sender.state.limit as usize > sender.sent && sender.sent < 12_000 {
        sender.turn(host, true)?;
    }
    host.forget();
    host.done(&Request::Start)?;
    while !sender.over() {
        sender.turn(host, true)?;
        host.recorded();
    }
    host.target.pass(1000);
    let fault = host.status()?.fault;
    check(fault.is_none(), || format!("{fault:?} after {} events", sender.events.len()))?;
    check(sender.dropped == 0, || format!("{} events lost", sender.dropped))?;
    let start = sender.events.iter().find(|e| matches!(e.kind, EventKind::RunStarted { .. }));
    let start = start.map_or(0, |e| e.tick);
    let edges = crate::expansion::changes_only(host.recorded());
    same_by_events(&program, &sender.events, start)?;
    let lead = sender.events.iter().find_map(|e| match e.kind {
        EventKind::StreamLead { ticks } => Some(ticks),
        _ => None,
    });
    if !host.watched() {
        return Ok(Outcome::Cannot(NOT_WATCHED));
    }
    let ran = super::super::host::Ran { start, events: sender.events, edges, fault };
    host.compare(&program, &ran)?;
    Ok(Outcome::Passed(vec![
        ("edges", ran.edges.len() as f64, ""),
        ("edges per second", 3125.0, ""),
        ("edge error", 0.0, "ticks"),
        ("least lead of the stream", lead.unwrap_or(0) as f64, "ticks"),
    ]))
}

/// What has come is played to its end, and the box says where it ran dry.
pub(super) fn dry(host: &mut Host, _: bool) -> Result<Outcome, String> {
    if host.target.waits_for_streams() {
        return Ok(Outcome::Cannot("its clock waits for the stream"));
    }
    let mut program = vec![];
    for _ in 0..60 {
        program.extend([set(lamp(1), 300 * US), clear(lamp(1), 40 * US)]);
    }
    let mut sender = Sender::new(host, &program)?;
    while sender.sent < sender.bytes.len() {
        sender.turn(host, false)?;
    }
    host.forget();
    host.done(&Request::Start)?;
    while !sender.over() {
        host.target.pass(250_000);
        sender.turn(host, false)?;
    }
    let fault = host.status()?.fault;
    check(fault.is_some_and(|f| f.cause == FaultCause::Underrun), || format!("{fault:?}"))?;
    if !host.watched() {
        return Ok(Outcome::Cannot(NOT_WATCHED));
    }
    let start = sender.events.iter().find(|e| matches!(e.kind, EventKind::RunStarted { .. }));
    let start = start.map_or(0, |e| e.tick);
    let last = expected(&program).last().map_or(0, |e| e.0);
    let told = fault.map_or(0, |f| f.tick) - start;
    check(told == last, || format!("dry at {told}, the last edge at {last}"))?;
    let edges = crate::expansion::changes_only(host.recorded());
    let ran = super::super::host::Ran { start, events: sender.events, edges, fault };
    host.compare(&program, &ran)?;
    Ok(Outcome::Passed(vec![("edges", ran.edges.len() as f64, "")]))
}
