//! Random messages for the property tests.
#![allow(dead_code)]

use daic_protocol::limits::{CHUNK_LEN, EVENTS_PER_REPLY};
use daic_protocol::message::*;
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

/// Configuration of a property test with so many cases. The seed is fixed and printed, so that two
/// runs test the same; `DAIC_SEED` sets another, `DAIC_CASES` another number of cases.
pub fn config(cases: u32) -> ProptestConfig {
    let from_env = |name| std::env::var(name).ok().and_then(|v| v.parse::<u64>().ok());
    let seed = from_env("DAIC_SEED").unwrap_or(1);
    let cases = from_env("DAIC_CASES").map_or(cases, |n| n as u32);
    eprintln!("seed {seed}, {cases} cases");
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(seed),
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

pub fn request() -> impl Strategy<Value = Request> {
    prop_oneof![
        Just(Request::Hello),
        Just(Request::Status),
        any::<u32>().prop_map(|length| Request::LoadBegin { length }),
        (any::<u16>(), vec(any::<u8>(), 0..=CHUNK_LEN))
            .prop_map(|(index, data)| { Request::LoadChunk { index, data: data.into_iter().collect() } }),
        // Chunks full of zeros and of 0xff put the most strain on COBS.
        (any::<u16>(), prop_oneof![Just(0u8), Just(0xff), Just(1)], 0..=CHUNK_LEN).prop_map(
            |(index, b, n)| Request::LoadChunk { index, data: std::iter::repeat_n(b, n).collect() }
        ),
        (any::<u32>(), any::<u32>()).prop_map(|(length, hash)| Request::LoadCommit { length, hash }),
        Just(Request::LoadAbort),
        any::<u32>().prop_map(|hash| Request::Arm { hash }),
        Just(Request::Start),
        Just(Request::Stop),
        Just(Request::Abort),
        Just(Request::ClearFault),
        any::<u32>().prop_map(|from| Request::ReadEvents { from }),
        Just(Request::Clock),
        Just(Request::Health),
    ]
}

pub fn event() -> impl Strategy<Value = Event> {
    let kind = prop_oneof![
        (any::<u32>(), any::<u32>()).prop_map(|(run, program)| EventKind::RunStarted { run, program }),
        (any::<u32>(), any::<u32>()).prop_map(|(changed, word)| EventKind::Edge { changed, word }),
        (any::<u8>(), any::<u16>()).prop_map(|(led, level)| EventKind::Level { led, level }),
        any::<u16>().prop_map(|id| EventKind::Mark { id }),
        (any::<u8>(), any::<i32>()).prop_map(|(axis, target)| EventKind::MoveStarted { axis, target }),
        (any::<u8>(), any::<i32>()).prop_map(|(axis, position)| EventKind::MoveDone { axis, position }),
        Just(EventKind::Settled),
        (any::<u32>(), any::<u32>(), any::<u32>()).prop_map(|(run, words, events)| EventKind::RunDone {
            run,
            words,
            events
        }),
        any::<u16>().prop_map(|instruction| EventKind::Faulted { cause: FaultCause::Underrun, instruction }),
    ];
    (any::<u32>(), any::<u64>(), kind).prop_map(|(seq, tick, kind)| Event { seq, tick, kind })
}

pub fn reply() -> impl Strategy<Value = Reply> {
    prop_oneof![
        any::<u64>().prop_map(|tick| Reply::Clock { tick }),
        Just(Reply::Done { state: State::Armed }),
        (any::<u16>(), any::<i64>(), any::<i64>()).prop_map(|(instruction, value, limit)| {
            Reply::Refused(Refusal::Invalid(Violation {
                instruction,
                rule: Rule::PulseTooLong,
                value,
                limit,
            }))
        }),
        // One event fewer than fit: a full list of the longest events exceeds a frame.
        (any::<u32>(), any::<u32>(), any::<u32>(), vec(event(), 0..EVENTS_PER_REPLY)).prop_map(
            |(oldest, next, dropped, events)| {
                Reply::Events(Events { oldest, next, dropped, events: events.into_iter().collect() })
            }
        ),
        (any::<u64>(), any::<u32>(), any::<Option<u32>>(), any::<[i32; 6]>()).prop_map(
            |(tick, boot_id, program, position)| {
                Reply::Status(Status {
                    state: State::Running,
                    tick,
                    boot_id,
                    program,
                    position,
                    next_event: 1,
                    run: 2,
                    instruction: 3,
                    fault: Some(Fault { cause: FaultCause::Internal, tick, instruction: 4 }),
                    rejected: Rejected { oversized: 1, cobs: 2, length: 3, crc: 4, header: 5, body: 6 },
                })
            }
        ),
    ]
}
