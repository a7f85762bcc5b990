//! Inputs, slots and streams of the simulated box on its stepped clock.

mod support;

use daic_hil_sim::config::{AxisConfig, HomeConfig, Stimulus};
use daic_hil_sim::{SimConfig, SimRig, Transport};
use daic_protocol::limits::{CHUNK_LEN, STREAM_BYTES};
use daic_protocol::message::{Autostart, Event, EventKind, Reply, Request, State, StreamState};
use daic_protocol::program::{Condition, Instruction, Timeout, encode_instruction, hash};
use std::time::{Duration, Instant};
use support::*;

fn start(config: SimConfig) -> (SimRig, Host<daic_hil_sim::DuplexEnd>) {
    let rig = SimRig::start(config, Transport::InProcess).expect("starts");
    let host = Host::new(rig.connect().expect("in-process"));
    (rig, host)
}

/// Events after a run that nobody started over the link.
fn wait_for_run(host: &mut Host<daic_hil_sim::DuplexEnd>, from: u32) -> Vec<Event> {
    let end = Instant::now() + Duration::from_secs(10);
    while Instant::now() < end {
        let Reply::Events(reply) = host.request(&Request::ReadEvents { from }) else { panic!("no events") };
        if reply.events.iter().any(|e| matches!(e.kind, EventKind::RunDone { .. })) {
            return reply.events.to_vec();
        }
    }
    panic!("nothing was played");
}

#[test]
fn a_trigger_at_the_last_tick_of_a_wait_counts_and_one_later_does_not() {
    let timeout = 1_000_000;
    let program = [
        Instruction::Wait {
            input: 1,
            condition: Condition::Rising,
            skip: 0,
            delay: 7000,
            timeout,
            on_timeout: Timeout::Continue,
        },
        set(led(), 0),
        clear(led(), 100),
    ];
    let play = |tick: u64| {
        let mut config = small();
        config.board.stimulus = vec![Stimulus { tick, word: 1 << 24 | 1 << 1 }];
        let (rig, mut host) = start(config);
        let events = host.run(&program);
        let begin =
            events.iter().find(|e| matches!(e.kind, EventKind::RunStarted { .. })).expect("begin").tick;
        let rise = rig.played().iter().find(|(_, word)| word & led() != 0).expect("lit").0;
        let found = events.iter().find_map(|e| match e.kind {
            EventKind::Triggered { input: 1, .. } => Some(Some(e.tick - begin)),
            EventKind::TimedOut { input: 1 } => Some(None),
            _ => None,
        });
        (begin, found.expect("triggered or timed out"), rise - begin)
    };
    // The same bytes make the same begin of the run.
    let (begin, found, _) = play(u64::from(u32::MAX));
    assert_eq!(found, None);
    let last = begin + u64::from(timeout);
    assert_eq!(play(last), (begin, Some(u64::from(timeout)), u64::from(timeout) + 7000));
    assert_eq!(play(last + 1), (begin, None, u64::from(timeout) + 7000));
    assert_eq!(play(begin), (begin, Some(0), 7000));
}

#[test]
fn a_slot_starts_at_power_up_or_by_an_input() {
    let (rig, mut host) = start(small());
    let program = [set(led(), 1000), clear(led(), 100)];
    host.run(&program);
    let on_input = Autostart::Input { input: 1 };
    for (slot, autostart) in [(0, Autostart::Off), (1, Autostart::PowerUp), (2, on_input)] {
        let stored = host.request(&Request::SlotStore { slot, autostart });
        assert_eq!(stored, Reply::Done { state: State::Loaded });
    }
    rig.reset_board();
    let events = wait_for_run(&mut host, 0);
    let begin = events[0].tick;
    assert!(matches!(events[0].kind, EventKind::RunStarted { run: 1, .. }), "{events:?}");
    assert_eq!(events[1].tick - begin, 1000);
    let from = events.last().expect("events").seq + 1;
    rig.set_inputs(1 << 24 | 1 << 1);
    let events = wait_for_run(&mut host, from);
    assert!(matches!(events[0].kind, EventKind::RunStarted { run: 2, .. }), "{events:?}");
    // what is erased does not start
    host.request(&Request::SlotErase { slot: 1 });
    rig.reset_board();
    assert_eq!(host.status().state, State::Empty);
}

#[test]
fn an_axis_finds_its_home_switch_and_moves_only_then() {
    let mut config = small();
    let home = HomeConfig { high_end: false, rate: 2000, travel: 3000, position: 0, switch_at: -700 };
    config.board.axes[0] = AxisConfig { home: Some(home), ..config.board.axes[0].clone() };
    let (rig, mut host) = start(config);
    let bytes = |program: &[Instruction]| program.iter().flat_map(encode_instruction).collect::<Vec<u8>>();
    // neither stored nor streamed
    assert_eq!(host.request(&Request::StreamBegin).stream().limit as usize, STREAM_BYTES);
    let moving = bytes(&[go(0, 100)]);
    let refused = host.request(&Request::StreamWrite { offset: 0, data: moving.iter().copied().collect() });
    assert!(
        matches!(refused, Reply::Refused(daic_protocol::message::Refusal::NotHomed { axis: 0 })),
        "{refused:?}"
    );
    let events = host.run(&[Instruction::Home { axis: 0 }, go(0, 100)]);
    let correction = events.iter().find_map(|e| match e.kind {
        EventKind::Homed { axis: 0, correction } => Some(correction),
        _ => None,
    });
    // the switch is released one step above where it is pressed, and that is called 0
    assert_eq!(correction.map(i32::abs), Some(699), "{events:?}");
    assert_eq!(rig.truth().stage_steps[0], -699 + 100);
}

trait AsStream {
    fn stream(self) -> StreamState;
}

impl AsStream for Reply {
    fn stream(self) -> StreamState {
        match self {
            Reply::Stream(state) => state,
            other => panic!("{other:?}"),
        }
    }
}

/// Stepped time waits for the host (see `STREAM_LOW` in `board.rs`): what is shown is that it does, and that a stream is
/// played as it was sent. How fast a host must be is shown where time does not wait.
#[test]
fn ten_thousand_edges_are_streamed_on_the_stepped_clock() {
    let mut config = small();
    config.board.leds[0].max_pulse = u32::MAX;
    let (rig, mut host) = start(config);
    // 3000 edges a second, of uneven length so that a shift would be seen
    let program: Vec<Instruction> =
        (0..5000u32).flat_map(|k| [set(led(), 41_000 + k % 701), clear(led(), 40_000 + k % 907)]).collect();
    let mut expected = Vec::new();
    let mut now = 0u64;
    for instruction in &program {
        if let Instruction::Edge { value, after, .. } = instruction {
            now += u64::from(*after);
            expected.push((now, *value));
        }
    }
    let bytes: Vec<u8> = program.iter().flat_map(encode_instruction).collect();
    let mut state = host.request(&Request::StreamBegin).stream();
    let (mut offset, mut from, mut started, mut events) = (0, 0, false, Vec::new());
    let end = Instant::now() + Duration::from_secs(60);
    while !events
        .iter()
        .any(|e: &Event| matches!(e.kind, EventKind::RunDone { .. } | EventKind::Faulted { .. }))
    {
        assert!(Instant::now() < end, "{state:?}");
        while offset < bytes.len() && (state.limit as usize) > offset {
            let upto = bytes.len().min(offset + CHUNK_LEN).min(state.limit as usize);
            let data = bytes[offset..upto].iter().copied().collect();
            state = host.request(&Request::StreamWrite { offset: offset as u32, data }).stream();
            offset = upto;
        }
        if offset == bytes.len() && !state.ended {
            let length = bytes.len() as u32;
            state = host.request(&Request::StreamEnd { length, hash: hash(&bytes) }).stream();
        }
        if !started {
            assert_eq!(host.request(&Request::Start), Reply::Done { state: State::Running });
            started = true;
        }
        let Reply::Events(reply) = host.request(&Request::ReadEvents { from }) else { panic!("no events") };
        assert_eq!(reply.oldest.max(from), from, "events were lost");
        for event in reply.events {
            from = event.seq + 1;
            events.push(event);
        }
        if !state.ended
            && let Reply::Stream(now) = host.request(&Request::StreamStatus)
        {
            state = now;
        }
    }
    assert!(matches!(events.last().map(|e| e.kind), Some(EventKind::RunDone { .. })), "{:?}", events.last());
    let begin = events.iter().find(|e| matches!(e.kind, EventKind::RunStarted { .. })).expect("begin").tick;
    let played: Vec<_> = rig.played().into_iter().map(|(tick, word)| (tick - begin, word)).collect();
    assert_eq!(played.len(), 10_000);
    assert!(
        played == expected,
        "first difference at {:?}",
        played.iter().zip(&expected).position(|(a, b)| a != b)
    );
    assert_eq!(events.iter().filter(|e| matches!(e.kind, EventKind::Edge { .. })).count(), 10_000);
}
