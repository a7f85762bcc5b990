//! Programs that come while they are played.

mod common;

use common::*;
use daic_protocol::limits::{CHUNK_LEN, STREAM_BYTES};
use daic_protocol::message::*;
use daic_protocol::program::{self, Hasher, Instruction};
use proptest::prelude::*;

fn write(rig: &mut Rig, offset: u32, data: &[u8]) -> Reply {
    rig.ask(Request::StreamWrite { offset, data: data.iter().copied().collect() })
}

fn state(reply: Reply) -> StreamState {
    match reply {
        Reply::Stream(state) => state,
        other => panic!("{other:?}"),
    }
}

fn encode(instructions: &[Instruction]) -> Vec<u8> {
    instructions.iter().flat_map(|i| program::encode_instruction(i).into_iter()).collect()
}

fn hash(bytes: &[u8]) -> u32 {
    let mut hasher = Hasher::new();
    hasher.update(bytes);
    hasher.finish()
}

/// Streams `bytes`, always as much as there is credit for, playing `pace` ticks between two looks.
fn stream(rig: &mut Rig, bytes: &[u8], pace: u64) -> (u64, StreamState) {
    let mut got = state(rig.ask(Request::StreamBegin));
    let (mut offset, mut start) = (0usize, None);
    loop {
        while offset < bytes.len() && (got.limit as usize) > offset {
            let end = bytes.len().min(offset + CHUNK_LEN).min(got.limit as usize);
            got = state(write(rig, offset as u32, &bytes[offset..end]));
            offset = end;
        }
        if offset == bytes.len() && !got.ended {
            got = state(rig.ask(Request::StreamEnd { length: offset as u32, hash: hash(bytes) }));
        }
        if start.is_none() {
            assert_eq!(rig.done(Request::Start), State::Running);
            start = rig.controller.next_due();
        }
        if got.ended {
            break;
        }
        rig.play_to(rig.now + pace);
        got = state(rig.ask(Request::StreamStatus));
    }
    rig.finish();
    (start.unwrap(), got)
}

#[test]
fn a_program_longer_than_memory() {
    // 10 000 edges, 60 kB.
    let list: Vec<_> =
        (0..10_000u32).map(|i| edge(0x100, if i % 2 == 0 { 0x100 } else { 0 }, 20_000 + i % 7)).collect();
    let bytes = encode(&list);
    assert!(bytes.len() > 3 * STREAM_BYTES);
    let mut rig = Rig::new(small_board());
    let (start, last) = stream(&mut rig, &bytes, 1_000_000);
    let expected = naive::play(&list, &small_board(), start, [0; 6], 1, 0);
    assert_eq!(rig.out.words, expected.words);
    assert_eq!(rig.controller.state(), State::Empty);
    // Never less than the ring holds but for one pace: 16 384 bytes of 8 at 160 µs.
    assert!(last.min_lead > 30_000_000, "{last:?}");
    let events = rig.events();
    let lead = events.iter().find_map(|e| match e.kind {
        EventKind::StreamLead { ticks } => Some(ticks),
        _ => None,
    });
    assert_eq!(lead, Some(last.min_lead));
}

#[test]
fn an_under_run_is_safe_and_told() {
    let mut rig = Rig::new(small_board());
    rig.ask(Request::StreamBegin);
    let list = [edge(1, 1, 10), edge(1, 0, 50), edge(0x100, 0x100, 10)];
    write(&mut rig, 0, &encode(&list));
    rig.done(Request::Start);
    let start = rig.controller.next_due().unwrap();
    rig.finish();
    // At the end of the last instruction, and no sooner than the smallest step allows.
    assert_eq!(rig.out.words, [(start + 10, 1), (start + 60, 0), (start + 70, 0x100), (start + 74, 0)]);
    let fault = rig.controller.fault().unwrap();
    assert_eq!((fault.cause, fault.tick, fault.instruction), (FaultCause::Underrun, start + 74, 2));
    assert_eq!(
        rig.refused(Request::StreamWrite { offset: 0, data: Default::default() }),
        Refusal::NotStreaming
    );
    assert_eq!(rig.done(Request::ClearFault), State::Empty);
}

#[test]
fn repeats_do_no_harm_and_gaps_are_refused() {
    let mut rig = Rig::new(small_board());
    let bytes = encode(&[edge(0x100, 0x100, 300), edge(0x100, 0, 300)]);
    assert_eq!(rig.refused(Request::StreamStatus), Refusal::NotStreaming);
    rig.ask(Request::StreamBegin);
    assert_eq!(rig.refused(Request::Start), Refusal::StreamEnded { length: 0 });
    let first = state(write(&mut rig, 0, &bytes[..5]));
    assert_eq!(first.received, 5);
    assert_eq!(state(write(&mut rig, 0, &bytes[..5])), first);
    assert_eq!(write(&mut rig, 6, &bytes[6..]), Reply::Refused(Refusal::StreamGap { expected: 5, given: 6 }));
    // An overlap brings what is new.
    assert_eq!(state(write(&mut rig, 3, &bytes[3..])).received, bytes.len() as u32);
    let length = bytes.len() as u32;
    let wrong = Request::StreamEnd { length, hash: 1 };
    assert_eq!(rig.refused(wrong), Refusal::HashDiffers { computed: hash(&bytes), given: 1 });
    let short = Request::StreamEnd { length: 3, hash: 1 };
    assert_eq!(rig.refused(short), Refusal::LengthDiffers { begun: length, committed: 3 });
    assert!(state(rig.ask(Request::StreamEnd { length, hash: hash(&bytes) })).ended);
    assert_eq!(write(&mut rig, length, &bytes), Reply::Refused(Refusal::StreamEnded { length }));
    rig.done(Request::Start);
    rig.finish();
    assert_eq!(rig.out.words.len(), 2);
}

#[test]
fn a_wrong_instruction_is_refused_with_its_chunk() {
    let mut rig = Rig::new(small_board());
    rig.ask(Request::StreamBegin);
    let good = encode(&[edge(1, 1, 10)]);
    write(&mut rig, 0, &good);
    let long = encode(&[delay(5), edge(1, 0, 60)]);
    let Reply::Refused(Refusal::Invalid(v)) = write(&mut rig, good.len() as u32, &long) else { panic!() };
    assert_eq!((v.instruction, v.rule, v.value, v.limit), (2, Rule::PulseTooLong, 65, 60));
    let right = encode(&[delay(5), edge(1, 0, 50)]);
    assert_eq!(state(write(&mut rig, good.len() as u32, &right)).received, (good.len() + right.len()) as u32);
    let looped = encode(&[begin(2)]);
    let offset = (good.len() + right.len()) as u32;
    let Reply::Refused(Refusal::Invalid(v)) = write(&mut rig, offset, &looped) else { panic!() };
    assert_eq!(v.rule, Rule::LoopInStream);
    // More than there is room for.
    let mut offset = offset;
    let fill = vec![delay(5); CHUNK_LEN / 2];
    let refusal = loop {
        match write(&mut rig, offset, &encode(&fill)) {
            Reply::Stream(_) => offset += CHUNK_LEN as u32,
            Reply::Refused(refusal) => break refusal,
            other => panic!("{other:?}"),
        }
    };
    let limit = STREAM_BYTES as u32;
    assert_eq!(refusal, Refusal::StreamFull { limit, end: offset + CHUNK_LEN as u32 });
}

#[test]
fn the_committed_program_survives_a_stream() {
    let mut rig = Rig::new(small_board());
    let stored = program::encode(&[edge(0x100, 0x100, 5), edge(0x100, 0, 5)]).unwrap();
    rig.load_bytes(&stored);
    let bytes = encode(&[edge(0x1000, 0x1000, 5), edge(0x1000, 0, 5)]);
    stream(&mut rig, &bytes, 1000);
    assert_eq!(rig.controller.state(), State::Loaded);
    rig.out = Recorder::default();
    rig.start_again(&stored);
    rig.finish();
    assert_eq!(rig.out.words[0].1, 0x100);
    // Loading while a stream is played would take its memory.
    rig.ask(Request::StreamBegin);
    write(&mut rig, 0, &bytes);
    rig.done(Request::Start);
    assert_eq!(rig.refused(Request::LoadBegin { length: 9 }), Refusal::WrongState { state: State::Running });
}

proptest! {
    #![proptest_config(random::config(150))]

    /// Streamed in pieces of any size a program does what it does when it is stored; and what is
    /// refused as a stream breaks a rule or may.
    #[test]
    fn streamed_as_stored(p in random::program(true), piece in 1usize..60) {
        let list: Vec<_> = p.into_iter().filter(|i| !matches!(i, Instruction::LoopBegin { .. } | Instruction::LoopEnd | Instruction::Stop)).collect();
        prop_assume!(!list.is_empty());
        let bytes = encode(&list);
        let mut rig = Rig::new(small_board());
        rig.ask(Request::StreamBegin);
        for (i, data) in bytes.chunks(piece).enumerate() {
            match write(&mut rig, (i * piece) as u32, data) {
                Reply::Stream(_) => {}
                Reply::Refused(Refusal::Invalid(_)) => {
                    // Every position is known: nothing is refused that could be played.
                    let run = naive::play(&list, &small_board(), 0, [0; 6], 1, 0);
                    prop_assert!(!run.broken.is_empty());
                    return Ok(());
                }
                other => panic!("{other:?}"),
            }
        }
        match rig.ask(Request::StreamEnd { length: bytes.len() as u32, hash: hash(&bytes) }) {
            Reply::Stream(_) => {}
            Reply::Refused(Refusal::Invalid(v)) => {
                prop_assert_eq!(v.rule, Rule::LeftOn);
                return Ok(());
            }
            other => panic!("{other:?}"),
        }
        rig.done(Request::Start);
        let start = rig.controller.next_due().unwrap();
        rig.finish();
        let run = naive::play(&list, &small_board(), start, [0; 6], 1, 0);
        prop_assert_eq!(run.broken, Default::default());
        prop_assert_eq!(&rig.out.words, &run.words);
    }
}
