//! What a player in hardware is given: words before their time, in blocks, from several links.

mod common;

use common::*;
use daic_firmware::blocks::{BLOCK, Block, MAX_HOLD, Packer, TooClose};
use daic_firmware::links::FrameGate;
use daic_firmware::pico::{LINES, ONBOARD, OUT_BASE, pin_word};
use daic_firmware::{Board, Reached};
use daic_protocol::frame::{MAX_FRAME, encode_request};
use daic_protocol::limits::MIN_STEP_TICKS;
use daic_protocol::message::*;
use daic_protocol::program::{self, Condition, Instruction, Timeout};
use proptest::prelude::*;

/// Words of the run under way as the look-ahead finds them.
fn words_ahead(rig: &Rig) -> (Vec<(u64, u32)>, Reached) {
    let mut ahead = rig.controller.ahead().unwrap();
    let mut out = Recorder::default();
    loop {
        let due = ahead.due(&rig.controller);
        match ahead.play(due, rig.now, &rig.controller, &mut out) {
            Reached::Waiting(tick) => assert!(tick > due),
            end => return (out.words, end),
        }
    }
}

/// A program that waits for inputs again and again.
fn waiting() -> impl Strategy<Value = Vec<Instruction>> {
    let conditions = [Condition::Rising, Condition::Falling, Condition::High, Condition::Low];
    let kinds = [Timeout::Continue, Timeout::Continue, Timeout::Stop, Timeout::Fault];
    let wait =
        (0u8..2, 0usize..4, 0u32..2, 20u32..60, prop_oneof![2 => 100u32..900, 1 => Just(0)], 0usize..4)
            .prop_map(move |(input, condition, skip, delay, timeout, kind)| Instruction::Wait {
                input,
                condition: conditions[condition],
                skip: if condition < 2 { skip } else { 0 },
                delay,
                timeout,
                on_timeout: kinds[kind],
            })
            .prop_map(|wait| vec![wait]);
    let pulse = (0usize..3, 4u32..200, 4u32..40).prop_map(|(line, before, length)| {
        let mask = [1, 0x100, 0x1000][line];
        vec![edge(mask, mask, before), edge(mask, 0, length)]
    });
    let gate = prop_oneof![
        Just(Instruction::NoGate),
        any::<bool>().prop_map(|open_high| Instruction::Gate { input: 1, open_high })
    ]
    .prop_map(|gate| vec![gate]);
    let part = prop_oneof![3 => wait, 1 => gate, 2 => random::program(true), 4 => pulse];
    prop::collection::vec(part, 1..8).prop_map(|parts| parts.concat())
}

proptest! {
    #![proptest_config(ProptestConfig { max_global_rejects: 20_000, ..random::config(400) })]

    /// The look-ahead finds what the controller then plays, at any time in the run.
    #[test]
    fn look_ahead_finds_what_is_played(instructions in random::program(true), cut in 0u64..3000) {
        let mut rig = Rig::new(small_board());
        let bytes = program::encode(&instructions).unwrap();
        prop_assume!(matches!(rig.load_bytes(&bytes), Reply::Done { .. }));
        let start = rig.start_again(&bytes);
        let (words, end) = words_ahead(&rig);
        rig.play_to(start + cut);
        let (later, again) = match rig.controller.ahead() {
            Some(_) => words_ahead(&rig),
            None => (vec![], end),
        };
        prop_assert_eq!(end, again);
        prop_assert!(words.ends_with(&later));
        rig.finish();
        prop_assert_eq!(&rig.out.words, &words);
        let done = rig.events().pop().unwrap();
        prop_assert_eq!(end, Reached::Ended(done.tick));
    }

    /// A stop that takes effect where the player in hardware has got to: both end alike, and
    /// nothing that was handed over is missing.
    #[test]
    fn a_stop_beyond_what_is_handed_over(instructions in random::program(true), handed in 0u64..2000, at in 0u64..2000) {
        let mut rig = Rig::new(small_board());
        let bytes = program::encode(&instructions).unwrap();
        prop_assume!(matches!(rig.load_bytes(&bytes), Reply::Done { .. }));
        let start = rig.start_again(&bytes);
        let mut ahead = rig.controller.ahead().unwrap();
        let mut out = Recorder::default();
        let mut ended = None;
        while ended.is_none() && ahead.due(&rig.controller) <= start + handed {
            let due = ahead.due(&rig.controller);
            if let Reached::Ended(tick) = ahead.play(due, rig.now, &rig.controller, &mut out) {
                ended = Some(tick);
            }
        }
        rig.controller.committed(ahead.due(&rig.controller));
        rig.play_to(start + at.min(handed));
        if rig.controller.state() == State::Running && ended.is_none() {
            rig.done(Request::Stop);
        }
        while ended.is_none() {
            let due = ahead.due(&rig.controller);
            if let Reached::Ended(tick) = ahead.play(due, rig.now, &rig.controller, &mut out) {
                ended = Some(tick);
            }
        }
        rig.finish();
        prop_assert_eq!(&rig.out.words, &out.words);
        let done = rig.events().pop().unwrap();
        prop_assert_eq!(Some(done.tick), ended);
    }

    /// A player that is told of its inputs late and filled in advance puts out what the controller says,
    /// and is never asked for a word whose time has come. So with a stop at any time.
    #[test]
    fn a_player_in_hardware_answers_inputs(
        instructions in waiting(),
        changes in prop::collection::vec((1u64..200, 0u32..4), 0..40),
        turns in prop::collection::vec(1u64..18, 20),
        stop in prop_oneof![Just(u64::MAX), 0u64..4000],
    ) {
        let mut rig = Rig::new(small_board());
        let bytes = program::encode(&instructions).unwrap();
        prop_assume!(matches!(rig.load_bytes(&bytes), Reply::Done { .. }));
        let start = rig.start_again(&bytes);
        let mut ahead = rig.controller.ahead().unwrap();
        let mut out = Recorder::default();
        let mut at = start;
        let mut changes: Vec<_> = changes.iter().map(|&(gap, word)| { at += gap; (at, word) }).collect();
        changes.reverse();
        let mut over = false;
        for turn in turns.iter().cycle().take(3000) {
            let before = rig.now;
            let now = before + turn + start.saturating_sub(before);
            while let Some((tick, word)) = changes.pop_if(|change| change.0 <= now) {
                rig.input(tick, word);
                if rig.controller.state() == State::Running && !over {
                    ahead.inputs(tick, word, &rig.controller, &mut out);
                }
            }
            rig.play_to(now);
            if rig.controller.state() != State::Running {
                break;
            }
            let had = out.words.len();
            let reach = now + 100;
            if !over {
                match ahead.play(reach, now, &rig.controller, &mut out) {
                    Reached::Waiting(_) => {}
                    Reached::Ended(_) => over = true,
                    other => return Err(TestCaseError::fail(format!("{other:?}"))),
                }
            }
            if before >= start {
                prop_assert!(out.words[had..].iter().all(|w| w.0 > now), "too late: {:?} at {now}", &out.words[had..]);
            }
            rig.controller.committed(ahead.due(&rig.controller));
            if now >= start + stop.min(1 << 40) && stop != u64::MAX && rig.controller.state() == State::Running {
                let reply = rig.ask(Request::Stop);
                prop_assert!(matches!(reply, Reply::Done { .. }), "{reply:?}");
            }
        }
        match rig.controller.state() {
            State::Running => {
                // Waits for an input for ever: what came so far is the same.
                let common = rig.out.words.len();
                prop_assert_eq!(&rig.out.words[..], &out.words[..common]);
            }
            // A fault by an input ends at once, whatever has been handed over.
            State::Faulted => {
                let common = rig.out.words.len().saturating_sub(1);
                prop_assert!(out.words.len() >= common);
                prop_assert_eq!(&rig.out.words[..common], &out.words[..common]);
            }
            _ => prop_assert_eq!(&rig.out.words, &out.words),
        }
    }

    /// Blocks hold the timeline, without gaps, whatever it is and however often time is filled.
    #[test]
    fn blocks_hold_the_timeline(
        gaps in prop::collection::vec(prop_oneof![4u64..12, 4u64..2000, 30_000u64..33_000, 60_000u64..3_000_000], 1..60),
        quiet in 1u64..100_000,
    ) {
        let start = 1_000_000_007;
        let mut blocks = Vec::new();
        let mut take = |block: &Block| blocks.push(block.clone());
        let mut packer = Packer::new(start);
        let (mut tick, mut word) = (start, 0u32);
        let mut wanted = vec![(start, 0)];
        for gap in gaps {
            tick += gap;
            while packer.upto() + quiet < tick {
                let before = packer.upto();
                packer.quiet(before + quiet, &mut take);
                if packer.upto() == before {
                    break;
                }
            }
            word = word.wrapping_mul(5).wrapping_add(1);
            packer.word(tick, word, &mut take).unwrap();
            wanted.push((tick, word));
        }
        tick += 100;
        packer.finish(tick, &mut take);
        wanted.push((tick, 0));
        let mut at = start;
        let mut got: Vec<(u64, u32)> = Vec::new();
        for block in &blocks {
            prop_assert_eq!(block.records.len(), BLOCK);
            for record in block.records {
                prop_assert!((MIN_STEP_TICKS..=MAX_HOLD + 3).contains(&record.ticks));
                if got.last().is_none_or(|last| last.1 != record.word) {
                    got.push((at, record.word));
                }
                at += u64::from(record.ticks);
            }
            prop_assert_eq!(block.end, at);
            prop_assert_eq!(block.last, at - u64::from(block.records[BLOCK - 1].ticks));
        }
        prop_assert_eq!(got, wanted);
        // Behind the end the safe word stands for more than one block.
        let last = &blocks[blocks.len() - 1];
        prop_assert!(last.records.iter().all(|record| record.word == 0));
    }
}

#[test]
fn words_too_close_are_not_packed() {
    let mut packer = Packer::new(100);
    let mut none = |_: &Block| {};
    assert_eq!(packer.word(99, 1, &mut none), Err(TooClose));
    assert_eq!(packer.word(103, 1, &mut none), Err(TooClose));
    assert_eq!(packer.word(104, 1, &mut none), Ok(()));
    assert_eq!(packer.word(107, 0, &mut none), Err(TooClose));
}

/// Bytes of two links in any order: the controller sees whole frames.
#[test]
fn two_links() {
    let mut rig = Rig::new(Board::reference());
    let mut gates = [FrameGate::new(), FrameGate::new()];
    let streams: Vec<Vec<u8>> = (0..2u32)
        .map(|link| {
            (0..50).flat_map(|n| encode_request(1000 * link + n, &Request::Status).unwrap()).collect()
        })
        .collect();
    let mut answered = [0, 0];
    let (mut at, mut turn) = ([0usize, 0], 1usize);
    while at.iter().zip(&streams).any(|(at, stream)| *at < stream.len()) {
        turn = turn * 5 % 13;
        let link = turn % 2;
        let Some(&byte) = streams[link].get(at[link]) else { continue };
        at[link] += 1;
        let frame = gates[link].feed(byte).map(<[u8]>::to_vec);
        for (id, _) in frame.map(|frame| decode_replies(&rig.exchange(&frame))).unwrap_or_default() {
            assert_eq!(id / 1000, link as u32);
            answered[link] += 1;
        }
    }
    assert_eq!(answered, [50, 50]);
    assert_eq!(rig.controller.rejected(), Rejected::default());
}

/// What is longer than any frame counts once, and the next frame is whole.
#[test]
fn noise_of_any_length_on_a_link() {
    for length in [1, MAX_FRAME - 1, MAX_FRAME, MAX_FRAME + 1, 5000] {
        let mut rig = Rig::new(Board::reference());
        let mut gate = FrameGate::new();
        let mut noise = vec![0xaa; length];
        noise.push(0);
        noise.extend(encode_request(7, &Request::Hello).unwrap());
        let mut answers = vec![];
        for byte in noise {
            if let Some(frame) = gate.feed(byte) {
                let frame = frame.to_vec();
                answers.extend(decode_replies(&rig.exchange(&frame)));
            }
        }
        assert_eq!(answers.len(), 1, "{length}");
        let rejected = rig.controller.rejected();
        let all = rejected.oversized + rejected.cobs + rejected.length + rejected.crc;
        assert_eq!(all, 1, "{length}: {rejected:?}");
    }
}

/// Every line of the board has its pin, and no other.
#[test]
fn lines_and_pins() {
    let board = Board::pico();
    let axes: u32 = (0..board.axes.len() as u8)
        .map(|i| daic_protocol::channels::step(i).unwrap() | daic_protocol::channels::direction(i).unwrap())
        .sum();
    let all = board.edge_mask() | axes;
    assert_eq!(LINES.iter().map(|line| 1 << line.0).sum::<u32>(), all);
    for bit in 0..32 {
        let pins = pin_word(1 << bit);
        let expected: u32 =
            LINES.iter().filter(|line| line.0 == bit).map(|line| 1 << (line.1 - OUT_BASE)).sum();
        // LED 0 shows on the board too.
        let onboard = if bit == 0 { 1 << (ONBOARD - OUT_BASE) } else { 0 };
        assert_eq!(pins, expected | onboard, "bit {bit}");
    }
}

/// What the board finds out by itself ends the run where it happened.
#[test]
fn a_trip_ends_the_run() {
    let mut rig = Rig::new(Board::pico());
    rig.input(1, daic_protocol::channels::INTERLOCK);
    let edge = |value, after| Instruction::Edge { mask: 0x100, value, after };
    let start = rig.start(&[edge(0x100, 1000), edge(0, 1000), edge(0x100, 1000), edge(0, 1000)]);
    rig.play_to(start + 10);
    rig.controller.trip(FaultCause::Interlock, start + 3500, &mut rig.out);
    assert_eq!(rig.controller.state(), State::Faulted);
    let words: Vec<_> = rig.out.words.iter().map(|&(t, w)| (t - start, w)).collect();
    assert_eq!(words, [(1000, 0x100), (2000, 0), (3000, 0x100), (3500, 0)]);
    let last = rig.events().pop().unwrap();
    assert_eq!(
        (last.tick, last.kind),
        (start + 3500, EventKind::Faulted { cause: FaultCause::Interlock, instruction: 3 })
    );
    // Only of a run.
    rig.done(Request::ClearFault);
    rig.controller.trip(FaultCause::Heartbeat, start + 9000, &mut rig.out);
    assert_eq!(rig.controller.state(), State::Loaded);
}
