//! The state machine, loading, retries, events.

mod common;

use common::*;
use daic_firmware::{Board, Controller, READ_CACHE, START_LEAD};
use daic_protocol::frame::{encode_reply, encode_request};
use daic_protocol::limits::*;
use daic_protocol::message::*;
use daic_protocol::program::{self, Instruction};
use proptest::prelude::*;

fn blink(n: u32) -> Vec<Instruction> {
    vec![begin(n), edge(0x100, 0x100, 10), edge(0x100, 0, 10), END]
}

fn hash(p: &[Instruction]) -> u32 {
    program::hash(&program::encode(p).unwrap())
}

fn chunk(index: u16, data: &[u8]) -> Request {
    Request::LoadChunk { index, data: data.iter().copied().collect() }
}

#[test]
fn hello_tells_what_the_box_is() {
    let mut rig = Rig::new(Board::reference().simulated());
    let Reply::Hello(hello) = rig.ask(Request::Hello) else { panic!() };
    assert_eq!((hello.magic, hello.protocol, hello.schema), (Hello::MAGIC, PROTOCOL_VERSION, SCHEMA_HASH));
    assert_eq!((hello.board.as_str(), hello.firmware.as_str()), ("reference", env!("CARGO_PKG_VERSION")));
    assert_eq!(
        (hello.boot_id, hello.tick_hz, hello.capabilities),
        (0xb007, TICK_HZ, Board::reference().capabilities | Capabilities::SIMULATED)
    );
    assert_eq!((hello.leds, hello.cameras, hello.axes, hello.inputs), (4, 2, 3, 2));
    // It is answered under any id, also one that is taken, and every time anew.
    rig.ask_as(7, &Request::LoadAbort);
    assert!(matches!(rig.ask_as(7, &Request::Hello), Reply::Hello(_)));
    assert!(matches!(rig.ask_as(7, &Request::LoadAbort), Reply::Done { .. }));
}

#[test]
fn a_long_board_name_is_cut() {
    let mut board = small_board();
    board.name = "µ-controller of the rig";
    let Reply::Hello(hello) = Rig::new(board).ask(Request::Hello) else { panic!() };
    assert_eq!(hello.board.as_str(), "µ-controller of");
}

/// Which requests are refused in which state.
#[test]
fn every_request_in_every_state() {
    use State::*;
    let p = blink(1000);
    let reach = |state: State| {
        let mut rig = Rig::new(small_board());
        if state != Empty {
            rig.load_bytes(&program::encode(&p).unwrap());
        }
        if matches!(state, Armed | Running | Faulted) {
            rig.done(Request::Arm { hash: hash(&p) });
        }
        if matches!(state, Running | Faulted) {
            rig.done(Request::Start);
        }
        if state == Faulted {
            rig.done(Request::Abort);
        }
        assert_eq!(rig.controller.state(), state);
        rig
    };
    let states = [Empty, Loaded, Armed, Running, Faulted];
    // What each request makes of each state; `None`: refused.
    let table: [(Request, [Option<State>; 5]); 8] = [
        (Request::LoadBegin { length: 9 }, states.map(Some)),
        (Request::LoadAbort, states.map(Some)),
        (Request::LoadCommit { length: 0, hash: 0 }, [Some(Loaded), Some(Loaded), Some(Loaded), None, None]),
        (Request::Arm { hash: hash(&p) }, [None, Some(Armed), Some(Armed), None, None]),
        (Request::Start, [None, None, Some(Running), None, None]),
        (Request::Stop, [None, None, Some(Loaded), Some(Running), None]),
        (Request::Abort, [Some(Empty), Some(Loaded), Some(Loaded), Some(Faulted), Some(Faulted)]),
        (Request::ClearFault, [None, None, None, None, Some(Loaded)]),
    ];
    for (request, expected) in &table {
        for (state, after) in states.into_iter().zip(expected) {
            let mut rig = reach(state);
            let request = match request {
                Request::LoadCommit { .. } => {
                    let bytes = program::encode(&p).unwrap();
                    rig.done(Request::LoadBegin { length: bytes.len() as u32 });
                    rig.done(chunk(0, &bytes));
                    Request::LoadCommit { length: bytes.len() as u32, hash: program::hash(&bytes) }
                }
                other => other.clone(),
            };
            let reply = rig.ask(request.clone());
            match after {
                Some(after) => assert_eq!(reply, Reply::Done { state: *after }, "{request:?} in {state:?}"),
                None => {
                    assert_eq!(reply, Reply::Refused(Refusal::WrongState { state }), "{request:?}");
                    assert_eq!(rig.controller.state(), state);
                }
            }
        }
    }
    for state in states {
        let mut rig = reach(state);
        assert_eq!(rig.status().state, state);
        rig.now += 5;
        assert_eq!(rig.ask(Request::Clock), Reply::Clock { tick: rig.now });
    }
    let mut rig = reach(Loaded);
    let wrong = Refusal::HashDiffers { computed: hash(&p), given: 1 };
    assert_eq!(rig.refused(Request::Arm { hash: 1 }), wrong);
}

#[test]
fn loading_is_staged() {
    let mut rig = Rig::new(small_board());
    let old = blink(1);
    rig.load_bytes(&program::encode(&old).unwrap());

    let new: Vec<_> = (0..60).flat_map(|_| blink(2)).collect();
    let bytes = program::encode(&new).unwrap();
    let (length, given) = (bytes.len() as u32, program::hash(&bytes));
    let parts: Vec<_> = bytes.chunks(CHUNK_LEN).collect();
    assert!(parts.len() >= 3 && parts.last().unwrap().len() < CHUNK_LEN);
    let commit = Request::LoadCommit { length, hash: given };

    let max = MAX_PROGRAM_BYTES as u32;
    for length in [max + 1, u32::MAX] {
        assert_eq!(rig.refused(Request::LoadBegin { length }), Refusal::ProgramTooLong { length, max });
    }
    assert_eq!(rig.refused(chunk(0, parts[0])), Refusal::NotStaging);
    assert_eq!(rig.refused(commit.clone()), Refusal::NotStaging);

    rig.done(Request::LoadBegin { length });
    assert_eq!(rig.refused(commit.clone()), Refusal::ChunkMissing { index: 0 });
    // In any order, repeated identically.
    let last = parts.len() as u16 - 1;
    rig.done(chunk(last, parts[usize::from(last)]));
    rig.done(chunk(0, parts[0]));
    rig.done(chunk(0, parts[0]));
    assert_eq!(rig.refused(commit.clone()), Refusal::ChunkMissing { index: 1 });
    let mut other = parts[0].to_vec();
    other[5] ^= 1;
    assert_eq!(rig.refused(chunk(0, &other)), Refusal::ChunkChanged { index: 0 });
    let bad = |index, length, expected| Refusal::BadChunk { index, length, expected };
    assert_eq!(rig.refused(chunk(1, &parts[1][1..])), bad(1, CHUNK_LEN as u16 - 1, CHUNK_LEN as u16));
    assert_eq!(
        rig.refused(chunk(last, parts[0])),
        bad(last, CHUNK_LEN as u16, parts[usize::from(last)].len() as u16)
    );
    assert_eq!(rig.refused(chunk(last + 1, parts[0])), bad(last + 1, CHUNK_LEN as u16, 0));
    assert_eq!(rig.refused(chunk(u16::MAX, &[])), bad(u16::MAX, 0, 0));
    for (i, part) in parts.iter().enumerate() {
        rig.done(chunk(i as u16, part));
    }
    let differs = Refusal::LengthDiffers { begun: length, committed: length + 1 };
    assert_eq!(rig.refused(Request::LoadCommit { length: length + 1, hash: given }), differs);
    let differs = Refusal::HashDiffers { computed: given, given: !given };
    assert_eq!(rig.refused(Request::LoadCommit { length, hash: !given }), differs);
    assert_eq!(rig.status().program, Some(hash(&old)), "nothing refused has touched the old program");
    assert_eq!(rig.done(commit.clone()), State::Loaded);
    assert_eq!(rig.status().program, Some(given));
    assert_eq!(rig.refused(commit), Refusal::NotStaging);
    assert!(rig.out.words.is_empty(), "loading never executes");
}

#[test]
fn an_invalid_program_leaves_the_old_one() {
    let mut rig = Rig::new(small_board());
    let old = program::encode(&blink(3)).unwrap();
    rig.load_bytes(&old);
    let bad = program::encode(&[edge(1, 1, 0)]).unwrap();
    let violation = Violation { instruction: 0, rule: Rule::LeftOn, value: 1, limit: 0 };
    assert_eq!(rig.load_bytes(&bad), Reply::Refused(Refusal::Invalid(violation)));
    let empty = Violation { instruction: 0, rule: Rule::EmptyProgram, value: 0, limit: 1 };
    assert_eq!(rig.load_bytes(&[]), Reply::Refused(Refusal::Invalid(empty)));
    rig.start_again(&old);
    rig.finish();
    assert_eq!(rig.out.words.len(), 6);
}

#[test]
fn staging_survives_a_run_and_can_be_dropped() {
    let mut rig = Rig::new(small_board());
    let (old, new) = (program::encode(&blink(3)).unwrap(), program::encode(&blink(4)).unwrap());
    rig.load_bytes(&old);
    rig.start_again(&old);
    rig.done(Request::LoadBegin { length: new.len() as u32 });
    rig.done(chunk(0, &new));
    let commit = Request::LoadCommit { length: new.len() as u32, hash: program::hash(&new) };
    assert_eq!(rig.refused(commit.clone()), Refusal::WrongState { state: State::Running });
    rig.finish();
    assert_eq!(rig.out.words.len(), 6);
    rig.done(commit.clone());
    rig.done(Request::LoadBegin { length: new.len() as u32 });
    rig.done(Request::LoadAbort);
    assert_eq!(rig.refused(commit), Refusal::NotStaging);
    // Committing disarms: what was armed is no longer there.
    rig.done(Request::Arm { hash: program::hash(&new) });
    rig.load_bytes(&old);
    assert_eq!(rig.refused(Request::Start), Refusal::WrongState { state: State::Loaded });
}

#[test]
fn a_retry_never_repeats_an_effect() {
    let mut rig = Rig::new(small_board());
    let bytes = program::encode(&blink(2)).unwrap();
    rig.load_bytes(&bytes);
    rig.done(Request::Arm { hash: program::hash(&bytes) });
    let start = encode_request(500, &Request::Start).unwrap();
    let first = rig.exchange(&start);
    // The reply is lost; the host asks again, at once, while running, and after the end.
    assert_eq!(rig.exchange(&start), first);
    let due = rig.controller.next_due();
    rig.now += START_LEAD / 2;
    assert_eq!(rig.exchange(&start), first);
    assert_eq!(rig.controller.next_due(), due, "the start is not put off");
    rig.finish();
    assert_eq!(rig.exchange(&start), first);
    assert_eq!((rig.status().run, rig.out.words.len()), (1, 4));
    // Armed again, an old copy of the frame comes out of some buffer: no second run.
    rig.done(Request::Arm { hash: program::hash(&bytes) });
    assert_eq!(rig.exchange(&start), first);
    assert_eq!(rig.controller.state(), State::Armed);
    // However often the host polls in between.
    for _ in 0..50 {
        rig.status();
        rig.ask(Request::Clock);
        rig.ask(Request::ReadEvents { from: 0 });
    }
    assert_eq!(rig.exchange(&start), first);
    assert_eq!(rig.controller.state(), State::Armed);
}

#[test]
fn an_id_is_not_for_two_requests() {
    let mut rig = Rig::new(small_board());
    let reused = Reply::Refused(Refusal::IdReused);
    assert_eq!(rig.ask_as(1, &Request::LoadBegin { length: 8 }), Reply::Done { state: State::Empty });
    assert_eq!(rig.ask_as(1, &Request::LoadBegin { length: 9 }), reused);
    assert_eq!(rig.ask_as(1, &Request::Status), reused);
    assert_eq!(rig.ask_as(1, &Request::LoadBegin { length: 8 }), Reply::Done { state: State::Empty });
    assert!(matches!(rig.ask_as(2, &Request::Clock), Reply::Clock { .. }));
    assert_eq!(rig.ask_as(2, &Request::LoadAbort), reused);
    // The cache holds so many, then forgets the oldest.
    for id in 0..REPLY_CACHE as u32 - 1 {
        rig.ask_as(100 + id, &Request::LoadAbort);
        assert_eq!(rig.ask_as(1, &Request::LoadAbort), reused);
    }
    rig.ask_as(200, &Request::LoadAbort);
    assert_eq!(rig.ask_as(1, &Request::LoadAbort), Reply::Done { state: State::Empty });
    for id in 0..READ_CACHE as u32 {
        assert_eq!(rig.ask_as(2, &Request::LoadAbort), reused);
        rig.ask_as(300 + id, &Request::Status);
    }
    assert_eq!(rig.ask_as(2, &Request::LoadAbort), Reply::Done { state: State::Empty });
}

#[test]
fn a_repeated_read_gives_the_same_bytes() {
    let mut rig = Rig::new(small_board());
    for request in [Request::Status, Request::Clock, Request::ReadEvents { from: 0 }] {
        rig.next_id += 1;
        let frame = encode_request(rig.next_id, &request).unwrap();
        let first = rig.exchange(&frame);
        rig.now += 1000;
        assert_eq!(rig.exchange(&frame), first, "{request:?}");
    }
}

#[test]
fn a_refused_request_may_be_retried_too() {
    let mut rig = Rig::new(small_board());
    let frame = encode_request(9, &Request::Start).unwrap();
    let refused = rig.exchange(&frame);
    let bytes = program::encode(&blink(2)).unwrap();
    rig.load_bytes(&bytes);
    rig.done(Request::Arm { hash: program::hash(&bytes) });
    assert_eq!(rig.exchange(&frame), refused, "the answer to id 9 has been given");
    assert_eq!(rig.controller.state(), State::Armed);
}

#[test]
fn noise_is_counted_and_answered_by_silence() {
    let mut rig = Rig::new(small_board());
    assert!(rig.exchange(&[1, 2, 3, 0, 0, 5, 0]).is_empty());
    // A reply is no request, not even the box's own.
    let echo = encode_reply(1, &Reply::Clock { tick: 1 }).unwrap();
    assert!(rig.exchange(&echo).is_empty());
    let rejected = rig.status().rejected;
    assert_eq!((rejected.cobs + rejected.length, rejected.header), (2, 1));
    assert_eq!(rig.controller.rejected(), rejected);
    // Half a frame, then the link is opened anew.
    let frame = encode_request(77, &Request::Clock).unwrap();
    rig.exchange(&frame[..5]);
    rig.controller.link_restarted();
    assert_eq!(decode_replies(&rig.exchange(&frame)).len(), 1);
}

#[test]
fn two_requests_in_one_read() {
    let mut rig = Rig::new(small_board());
    let mut bytes = encode_request(1, &Request::Clock).unwrap().to_vec();
    bytes.extend_from_slice(&encode_request(2, &Request::Status).unwrap());
    let ids: Vec<_> = decode_replies(&rig.exchange(&bytes)).iter().map(|r| r.0).collect();
    assert_eq!(ids, [1, 2]);
}

#[test]
fn receiving_plays_what_is_due_first() {
    let p = [edge(0x100, 0x100, 10), edge(0x100, 0, 10), delay(100)];
    let mut rig = Rig::new(small_board());
    let start = rig.start(&p);
    rig.now = start + 15;
    rig.done(Request::Abort);
    assert_eq!(rig.out.words, [(start + 10, 0x100), (start + 15, 0)]);
    // Or later, when it would come too soon after the last word.
    let mut rig = Rig::new(small_board());
    let start = rig.start(&p);
    rig.now = start + 12;
    rig.done(Request::Abort);
    assert_eq!(rig.out.words, [(start + 10, 0x100), (start + 14, 0)]);
    assert_eq!(rig.controller.fault().unwrap().tick, start + 14);
}

#[test]
fn time_never_runs_backwards() {
    let mut rig = Rig::new(small_board());
    rig.play_to(1_000_000);
    rig.now = 500;
    let start = rig.start(&blink(1));
    assert_eq!(start, 1_000_000 + START_LEAD);
    assert_eq!(rig.ask(Request::Clock), Reply::Clock { tick: 500 });
    assert_eq!(rig.status().tick, 1_000_000);
}

#[test]
fn events_can_be_read_again_and_losses_are_known() {
    let mut rig = Rig::new(small_board());
    let marks: Vec<_> = (0..100).flat_map(|id| [Instruction::Mark { id }, delay(10)]).collect();
    rig.start(&marks);
    rig.finish();
    // 1 started, 100 marks, 1 done.
    let all = rig.events();
    assert_eq!(all.len(), 102);
    assert_eq!(all.iter().map(|e| e.seq).collect::<Vec<_>>(), (0..102).collect::<Vec<_>>());
    assert_eq!(rig.events(), all, "read again");
    let Reply::Events(got) = rig.ask(Request::ReadEvents { from: 50 }) else { panic!() };
    assert_eq!((got.oldest, got.next, got.dropped), (0, 102, 0));
    assert_eq!(got.events.as_slice(), &all[50..50 + EVENTS_PER_REPLY]);
    let Reply::Events(got) = rig.ask(Request::ReadEvents { from: 102 }) else { panic!() };
    assert!(got.events.is_empty());
    let Reply::Events(got) = rig.ask(Request::ReadEvents { from: 100_000 }) else { panic!() };
    assert!(got.events.is_empty(), "not there yet");

    // Overflow: 3 runs more make 306 events more, 152 of the 408 have been overwritten, 50 of them unread.
    let bytes = program::encode(&marks).unwrap();
    for _ in 0..3 {
        rig.start_again(&bytes);
        rig.finish();
    }
    let Reply::Events(got) = rig.ask(Request::ReadEvents { from: 102 }) else { panic!() };
    assert_eq!((got.oldest, got.next, got.dropped), (408 - EVENT_RING as u32, 408, 50));
    assert_eq!(got.events[0].seq, got.oldest, "the host sees the gap");
    let kept = rig.events();
    assert_eq!(kept.len(), EVENT_RING);
    let done = kept.last().unwrap();
    assert_eq!(done.kind, EventKind::RunDone { run: 4, words: 0, events: 102 });
}

#[test]
fn status_names_the_instruction() {
    let mut rig = Rig::new(small_board());
    let start = rig.start(&[delay(10), begin(2), delay(10), delay(10), END, delay(10)]);
    for (after, instruction) in [(5, 0), (15, 2), (25, 3), (35, 2), (45, 3), (55, 5)] {
        rig.play_to(start + after);
        assert_eq!(rig.status().instruction, instruction, "{after}");
    }
    let status = rig.status();
    assert_eq!((status.run, status.state, status.boot_id), (1, State::Running, 0xb007));
}

/// RAM of the box: two program buffers, the ring, the reply caches.
#[test]
fn the_controller_is_small() {
    let size = size_of::<Controller>();
    assert_eq!(size, SIZE, "pinned: change it knowingly");
}
const SIZE: usize = 48_080;

proptest! {
    #![proptest_config(common::random::config(256))]

    /// Any requests in any order, each frame doubled, at any time: no panic, no word too close, and
    /// doubling changes nothing.
    #[test]
    fn doubled_frames_change_nothing(
        moves in proptest::collection::vec((0u8..11, 0u64..200_000), 1..60),
    ) {
        let p = [edge(1, 1, 0), edge(1, 0, 50), go(0, 20), begin(3), edge(0x100, 0x100, 20_000), edge(0x100, 0, 20_000), END];
        let bytes = program::encode(&p).unwrap();
        let requests = [
            Request::LoadBegin { length: bytes.len() as u32 },
            chunk(0, &bytes),
            Request::LoadCommit { length: bytes.len() as u32, hash: program::hash(&bytes) },
            Request::Arm { hash: program::hash(&bytes) },
            Request::Start,
            Request::Stop,
            Request::Abort,
            Request::ClearFault,
            Request::LoadAbort,
            Request::Status,
            Request::Start,
        ];
        let mut rigs = [Rig::new(Board::reference()), Rig::new(Board::reference())];
        for rig in &mut rigs {
            rig.load_bytes(&bytes);
        }
        for (which, wait) in moves {
            let mut replies = Vec::new();
            for (copies, rig) in (1..).zip(&mut rigs) {
                rig.next_id += 1;
                let frame = encode_request(rig.next_id, &requests[usize::from(which)]).unwrap();
                for _ in 0..copies {
                    replies.push(rig.exchange(&frame));
                    rig.play_to(rig.now + wait / copies);
                }
                // Both clocks read the same again.
                rig.play_to(rig.now + wait % copies);
            }
            prop_assert!(which == 9 || replies.iter().all(|r| *r == replies[0]));
        }
        prop_assert_eq!(&rigs[0].out, &rigs[1].out);
        prop_assert_eq!(rigs[0].events(), rigs[1].events());
        for pair in rigs[0].out.words.windows(2) {
            prop_assert!(pair[1].0 >= pair[0].0 + 4);
        }
    }
}
