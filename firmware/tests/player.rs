//! What is played, against a second player written from the documentation.

mod common;

use common::*;
use daic_firmware::{Board, START_LEAD, verifier};
use daic_protocol::message::*;
use daic_protocol::program::{self, Instruction};
use proptest::prelude::*;

/// Plays a program on a rig that has already stood somewhere; compares all that came out.
fn compare(rig: &mut Rig, instructions: &[Instruction], cuts: Option<&[u64]>) -> naive::Run {
    let bytes = program::encode(instructions).unwrap();
    rig.out = Recorder::default();
    let first_event = rig.status().next_event;
    let position = rig.controller.position();
    let start = rig.start(instructions);
    let board = rig.controller.board().clone();
    let expected =
        naive::play(instructions, &board, start, position, rig.controller.run(), program::hash(&bytes));
    match cuts {
        None => rig.play_to(start + 1_000_000_000),
        Some(cuts) => {
            for cut in cuts.iter().cycle() {
                if rig.controller.next_due().is_none() {
                    break;
                }
                rig.play_to(rig.now + cut);
            }
        }
    }
    assert_eq!(rig.controller.state(), State::Loaded);
    assert_eq!(rig.out.words, expected.words);
    assert_eq!(rig.out.levels, expected.levels);
    assert_eq!(rig.controller.position(), expected.position);
    let kept: Vec<_> = rig.events().into_iter().filter(|e| e.seq >= first_event).collect();
    let expected_events = &expected.events[expected.events.len() - kept.len()..];
    assert_eq!(kept.iter().map(|e| (e.tick, e.kind)).collect::<Vec<_>>(), expected_events);
    expected
}

#[test]
fn strobed_frames_with_a_move_between() {
    let frame = [edge(0x100, 0x100, 1000), edge(1, 1, 125_000), edge(1, 0, 12_500), edge(0x100, 0, 500)];
    let mut p = vec![level(0, 40_000), Instruction::Settle { ticks: 12_500 }, begin(2)];
    p.extend(frame);
    p.extend([delay(1_000_000), END, Instruction::Mark { id: 7 }, go(0, 320)]);
    p.push(Instruction::Settle { ticks: 1_000_000 });
    p.extend(frame);
    let mut rig = Rig::new(Board::reference());
    let run = compare(&mut rig, &p, None);
    assert_eq!(run.words.len(), 8 + 1 + 640 + 4 + 1);
    assert_eq!(rig.controller.position(), [320, 0, 0, 0, 0, 0]);
    // Again: the move takes no time now, its events are still there.
    let run = compare(&mut rig, &p, None);
    assert_eq!(run.words.len(), 12);
    assert_eq!(run.broken, Default::default());
}

/// The end of a move beside the program makes way for the word that follows at once.
#[test]
fn a_word_right_after_a_move_beside_it() {
    let aside = Instruction::Go { axis: 0, target: 3, max_rate: 50_000, acceleration: 1_000_000, jerk: 0 };
    for after in 0..6 {
        let program = [aside, Instruction::Reach, edge(0x100, 0x100, after), edge(0x100, 0, 9)];
        let run = compare(&mut Rig::new(small_board()), &program, None);
        assert_eq!(run.broken, Default::default());
        for pair in run.words.windows(2) {
            assert!(pair[1].0 - pair[0].0 >= 4, "{after}: {pair:?}");
        }
    }
}

/// Played from one thing due to the next: each look makes progress, also where a step waits for a word.
#[test]
fn what_is_due_is_done() {
    let aside = Instruction::Go { axis: 0, target: 3, max_rate: 50_000, acceleration: 1_000_000, jerk: 0 };
    // The first step of this move is planned 4 + 625 ticks and 176 776 after its begin.
    for shift in 0..8 {
        let at = 4 + 625 + 176_776 - 4 + shift;
        let program = [aside, edge(0x100, 0x100, at), edge(0x100, 0, 9), Instruction::Reach];
        let mut rig = Rig::new(small_board());
        let expected = compare(&mut rig, &program, None);
        let mut rig = Rig::new(small_board());
        rig.start(&program);
        let mut looks = 0;
        while let Some(due) = rig.controller.next_due() {
            rig.play_to(due);
            looks += 1;
            assert!(looks < 1000, "{shift}: stuck at {due}");
        }
        assert_eq!(rig.out.words, expected.words);
    }
}

#[test]
fn the_first_tick_is_the_lead_after_start() {
    let mut rig = Rig::new(small_board());
    rig.now = 123_456;
    let start = rig.start(&[edge(0x100, 0x100, 0), edge(0x100, 0, 9)]);
    assert_eq!(start, 123_456 + START_LEAD);
    rig.play_to(start - 1);
    assert!(rig.out.words.is_empty());
    rig.play_to(start);
    assert_eq!(rig.out.words, [(start, 0x100)]);
    assert_eq!(rig.controller.next_due(), Some(start + 9));
}

#[test]
fn stop_ends_after_the_current_instruction() {
    let mut rig = Rig::new(small_board());
    let start =
        rig.start(&[edge(1, 1, 10), delay(40), edge(1, 0, 10), edge(0x100, 0x100, 100), edge(0x100, 0, 10)]);
    rig.play_to(start + 20);
    assert_eq!(rig.done(Request::Stop), State::Running);
    assert_eq!(rig.controller.next_due(), Some(start + 50));
    rig.finish();
    // The delay ends at 50; then the safe word, not the rest.
    assert_eq!(rig.out.words, [(start + 10, 1), (start + 50, 0)]);
    assert_eq!(rig.controller.state(), State::Loaded);
    let last = rig.events().pop().unwrap();
    assert_eq!((last.tick, last.kind), (start + 50, EventKind::RunDone { run: 1, words: 2, events: 4 }));
}

#[test]
fn stop_right_after_an_edge_keeps_the_smallest_step() {
    let mut rig = Rig::new(small_board());
    let start = rig.start(&[edge(1, 1, 100), edge(1, 0, 50)]);
    rig.play_to(start + 99);
    rig.done(Request::Stop);
    rig.finish();
    assert_eq!(rig.out.words, [(start + 100, 1), (start + 104, 0)]);
}

#[test]
fn stop_before_the_first_tick_plays_nothing() {
    let mut rig = Rig::new(small_board());
    let start = rig.start(&[edge(1, 1, 100), edge(1, 0, 50)]);
    rig.done(Request::Stop);
    rig.finish();
    assert!(rig.out.words.is_empty());
    let kinds: Vec<_> = rig.events().iter().map(|e| (e.tick, e.kind)).collect();
    let EventKind::RunStarted { run: 1, .. } = kinds[0].1 else { panic!() };
    assert_eq!(kinds[1], (start, EventKind::RunDone { run: 1, words: 0, events: 2 }));
}

#[test]
fn stop_finishes_a_move() {
    let mut rig = Rig::new(Board::reference());
    let start = rig.start(&[go(0, 100), go(1, 100)]);
    rig.play_to(start + 500_000);
    assert!((1..99).contains(&rig.controller.position()[0]));
    rig.done(Request::Stop);
    rig.finish();
    assert_eq!(rig.controller.position(), [100, 0, 0, 0, 0, 0]);
    assert_eq!(rig.controller.word(), 0);
}

#[test]
fn abort_goes_safe_at_once_and_knows_the_position() {
    let program = [level(0, 9), edge(0x100, 0x100, 0), go(0, 100), edge(0x100, 0, 0x10000), go(0, -100)];
    let mut whole = Rig::new(Board::reference());
    let start = whole.start(&program);
    whole.finish();
    let steps = |words: &[(u64, u32)], until: u64| {
        let mut before = 0;
        let rises = words.iter().filter(|(t, _)| *t <= until).filter(|(_, w)| {
            let rise = w & 0x1_0000 != 0 && before & 0x1_0000 == 0;
            before = *w;
            rise
        });
        rises.map(|(_, w)| if w & 0x2_0000 != 0 { 1 } else { -1 }).sum::<i32>()
    };
    let last = whole.out.words.last().unwrap().0;
    for i in 0..200 {
        let at = start + i * (last - start) / 200;
        let mut rig = Rig::new(Board::reference());
        assert_eq!(rig.start(&program), start);
        rig.play_to(at);
        assert_eq!(rig.done(Request::Abort), State::Faulted);
        assert_eq!((rig.controller.word(), rig.controller.levels()), (0, [0; 8]));
        let Some(fault) = rig.controller.fault() else { panic!() };
        assert_eq!(fault.cause, FaultCause::Aborted);
        assert!(fault.tick >= at && fault.tick <= at + 4, "at {at}: safe at {}", fault.tick);
        // Exact prefix of the whole run, then the safe word.
        let played: Vec<_> = whole.out.words.iter().copied().filter(|(t, _)| *t <= at).collect();
        assert_eq!(rig.out.words[..played.len()], played);
        assert!(rig.out.words[played.len()..].iter().all(|w| *w == (fault.tick, 0)));
        assert_eq!(rig.controller.position()[0], steps(&whole.out.words, at), "at {at}");
        // Nothing more happens, and the state stays.
        let n = rig.out.words.len();
        rig.play_to(at + 10_000_000);
        assert_eq!((rig.out.words.len(), rig.controller.next_due()), (n, None));
        let last = rig.events().pop().unwrap();
        assert_eq!(
            (last.tick, last.kind),
            (fault.tick, EventKind::Faulted { cause: FaultCause::Aborted, instruction: fault.instruction })
        );
        assert_eq!(rig.done(Request::ClearFault), State::Loaded);
        assert_eq!(rig.controller.fault(), None);
    }
}

proptest! {
    #![proptest_config(random::config(400))]

    /// Accepted programs, run twice from wherever the stage stands: what comes out is what the
    /// documentation says, and no rule is broken.
    #[test]
    fn plays_what_is_written(p in random::program(true)) {
        let board = small_board();
        if verifier::verify(&program::encode(&p).unwrap(), &board).is_ok() {
            let mut rig = Rig::new(board);
            for _ in 0..2 {
                let run = compare(&mut rig, &p, None);
                prop_assert_eq!(run.broken, Default::default());
                for pair in run.words.windows(2) {
                    prop_assert!(pair[1].0 - pair[0].0 >= 4, "{:?}", pair);
                }
            }
        }
    }

    /// How playing is cut up does not matter.
    #[test]
    fn cuts_do_not_matter(
        p in random::program(true),
        cuts in proptest::collection::vec(prop_oneof![4 => 1u64..50, 1 => 1000u64..100_000], 1..20),
    ) {
        let board = small_board();
        if verifier::verify(&program::encode(&p).unwrap(), &board).is_ok() {
            let cuts = cuts.into_iter().chain([50_000]).collect::<Vec<_>>();
            compare(&mut Rig::new(board), &p, Some(&cuts));
        }
    }
}
