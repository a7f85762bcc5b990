//! What the verifier refuses, and that it is right.

mod common;

use common::*;
use daic_firmware::{Board, verifier};
use daic_protocol::limits::*;
use daic_protocol::message::*;
use daic_protocol::program::{self, Instruction, TriggerEdge};
use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;

fn verdict(program: &[Instruction], board: &Board) -> Result<(), Violation> {
    verifier::verify(&program::encode(program).unwrap(), board)
}

fn refused(program: &[Instruction], instruction: u16, rule: Rule, value: i64, limit: i64) {
    let expected = Violation { instruction, rule, value, limit };
    assert_eq!(verdict(program, &small_board()), Err(expected), "{program:?}");
}

fn accepted(program: &[Instruction]) {
    assert_eq!(verdict(program, &small_board()), Ok(()), "{program:?}");
}

fn full_move(axis: u8, target: i32, max_rate: u32, acceleration: u32, jerk: u32) -> Instruction {
    Instruction::Move { axis, target, max_rate, acceleration, jerk }
}

#[test]
fn bytes_and_structure() {
    assert_eq!(
        verifier::verify(&[4, 99], &small_board()),
        Err(Violation { instruction: 0, rule: Rule::Undecodable, value: 0, limit: 2 }),
        "no such trigger edge"
    );
    let mut bytes = program::encode(&[delay(5), delay(6)]).unwrap();
    bytes.push(1).unwrap();
    let broken = Violation { instruction: 2, rule: Rule::Undecodable, value: 4, limit: 5 };
    assert_eq!(verifier::verify(&bytes, &small_board()), Err(broken), "a delay that is cut off");

    refused(&[], 0, Rule::EmptyProgram, 0, 1);
    accepted(&vec![delay(1); MAX_INSTRUCTIONS]);
    refused(&vec![delay(1); MAX_INSTRUCTIONS + 1], 1024, Rule::TooManyInstructions, 1025, 1024);
    refused(&[delay(1), begin(0), delay(1), END], 1, Rule::ZeroLoop, 0, 1);
    refused(&[delay(1), END], 1, Rule::UnmatchedLoopEnd, 0, 0);
    refused(&[begin(1), begin(2), delay(1), END], 0, Rule::UnclosedLoop, 1, 0);
    let nested = |depth: usize| [vec![begin(2); depth], vec![delay(1)], vec![END; depth]].concat();
    accepted(&nested(MAX_LOOP_DEPTH));
    refused(&nested(MAX_LOOP_DEPTH + 1), 8, Rule::LoopTooDeep, 9, 8);
    refused(&[begin(1), Instruction::Mark { id: 0 }, END], 0, Rule::EmptyLoop, 0, 1);
    // Only the first pass of this loop would move.
    refused(&[begin(u32::MAX), go(0, 10), END], 0, Rule::EmptyLoop, 0, 1);
    accepted(&[begin(3), go(0, 10), go(0, 0), END]);
}

#[test]
fn single_instructions() {
    refused(&[edge(0x204, 0, 4)], 0, Rule::ForbiddenBits, 0x204, 0xf103);
    refused(&[edge(0x1_0000, 0, 4)], 0, Rule::ForbiddenBits, 0x1_0000, 0xf103);
    refused(&[edge(0x8000_0000, 0, 4)], 0, Rule::ForbiddenBits, 0x8000_0000, 0xf103);
    accepted(&[edge(0xf103, 0, 0)]);
    refused(&[edge(1, 3, 4)], 0, Rule::ValueOutsideMask, 3, 1);
    refused(&[level(2, 0)], 0, Rule::NoSuchLed, 2, 2);
    accepted(&[level(1, 0)]);
    refused(&[full_move(2, 0, 1, 1, 0)], 0, Rule::NoSuchAxis, 2, 2);
    accepted(&[full_move(1, 40, 250_000, 1_000_000_000, 0)]);
    refused(&[full_move(1, 41, 1, 1, 0)], 0, Rule::TargetOutOfRange, 41, 40);
    refused(&[full_move(1, i32::MIN, 1, 1, 0)], 0, Rule::TargetOutOfRange, i64::from(i32::MIN), -40);
    refused(&[full_move(1, 0, 0, 1, 0)], 0, Rule::RateOutOfRange, 0, 250_000);
    refused(&[full_move(1, 0, 250_001, 1, 0)], 0, Rule::RateOutOfRange, 250_001, 250_000);
    refused(&[full_move(1, 0, 1, 0, 0)], 0, Rule::AccelerationOutOfRange, 0, 1_000_000_000);
    refused(
        &[full_move(1, 0, 1, u32::MAX, 0)],
        0,
        Rule::AccelerationOutOfRange,
        u32::MAX.into(),
        1_000_000_000,
    );
    let unsupported = |i: Instruction, value| {
        let expected = Violation { instruction: 0, rule: Rule::Unsupported, value, limit: 0 };
        assert_eq!(verdict(&[i], &bare_board()), Err(expected));
    };
    unsupported(full_move(1, 0, 1, 1, 5), 5);
    let wait = Instruction::WaitTrigger { input: 0, edge: TriggerEdge::Rising, skip: 0, timeout: 0 };
    unsupported(wait, 0);
    accepted(&[wait, full_move(1, 0, 1, 1, 5)]);
    let mut board = small_board();
    board.axes[0].max_rate = u32::MAX;
    board.axes[0].max_jerk = 4;
    assert_eq!(verdict(&[full_move(0, 0, 1, 1, 5)], &board).unwrap_err().rule, Rule::JerkOutOfRange);
    let limit = i64::from(daic_firmware::motion::MAX_STEP_RATE);
    assert_eq!(verdict(&[full_move(0, 0, 250_001, 1, 0)], &board).unwrap_err().limit, limit);
}

#[test]
fn smallest_step() {
    let camera = |v: u32, after| edge(0x100, v << 8, after);
    accepted(&[camera(1, 0), camera(0, 4)]);
    refused(&[camera(1, 0), camera(0, 3)], 1, Rule::StepTooShort, 3, 4);
    accepted(&[camera(1, 0), delay(2), camera(0, 2)]);
    refused(&[camera(1, 0), delay(1), level(0, 0), camera(0, 2)], 3, Rule::StepTooShort, 3, 4);
    // Round the seam of a loop, also through loops without words.
    accepted(&[begin(2), camera(1, 2), camera(0, 4), delay(2), END]);
    refused(&[begin(2), camera(1, 2), camera(0, 4), delay(1), END], 1, Rule::StepTooShort, 3, 4);
    accepted(&[begin(1), camera(1, 2), camera(0, 4), delay(1), END]);
    refused(&[begin(2), begin(3), delay(1), END, camera(0, 0), END], 4, Rule::StepTooShort, 3, 4);
    accepted(&[begin(2), begin(4), delay(1), END, camera(0, 0), END]);
    // After the last step pulse of a move; and a move that may not be one.
    refused(&[go(0, 9), camera(0, 3)], 1, Rule::StepTooShort, 3, 4);
    accepted(&[go(0, 9), camera(0, 4)]);
    accepted(&[camera(0, 0), go(0, 9), camera(0, 4)]);
    refused(&[go(0, 9), camera(0, 100), go(0, 9), camera(0, 3)], 3, Rule::StepTooShort, 3, 4);
}

#[test]
fn level_must_settle() {
    let pulse = |after| [edge(1, 1, after), edge(1, 0, 10)];
    let p = |parts: &[&[Instruction]]| parts.concat();
    accepted(&p(&[&[level(0, 5)], &pulse(20)]));
    refused(&p(&[&[level(0, 5)], &pulse(19)]), 1, Rule::LevelNotSettled, 19, 20);
    accepted(&p(&[&[level(1, 5)], &pulse(0)]));
    // The second pass meets the level set at the end of the first.
    accepted(&p(&[&[begin(2)], &pulse(5), &[level(0, 5), delay(15), END]]));
    refused(&p(&[&[begin(2)], &pulse(5), &[level(0, 5), delay(14), END]]), 1, Rule::LevelNotSettled, 19, 20);
    accepted(&p(&[&[begin(1)], &pulse(5), &[level(0, 5), delay(14), END]]));
    // While it shines, by whatever way.
    refused(&[edge(1, 1, 0), level(0, 5), edge(1, 0, 20)], 1, Rule::LevelNotSettled, 0, 20);
    refused(&[begin(2), level(0, 5), edge(1, 1, 30), END, edge(1, 0, 9)], 1, Rule::LevelNotSettled, 0, 20);
    // A move that may take no time settles nothing.
    refused(&p(&[&[level(0, 5), go(0, 9)], &pulse(10)]), 2, Rule::LevelNotSettled, 10, 20);
    accepted(&p(&[&[go(0, 0), level(0, 5), go(0, 9)], &pulse(10)]));
}

#[test]
fn pulses_must_end() {
    accepted(&[edge(1, 1, 0), edge(1, 0, 60)]);
    refused(&[edge(1, 1, 0), delay(1), edge(1, 0, 60)], 2, Rule::PulseTooLong, 61, 60);
    // Setting it again does not begin a new pulse.
    refused(&[edge(1, 1, 0), edge(1, 1, 30), edge(1, 0, 31)], 2, Rule::PulseTooLong, 61, 60);
    accepted(&[edge(1, 1, 0), edge(0x102, 0x102, 30), edge(0x103, 0, 30)]);
    // On at the end of the pass, off at the beginning of the next.
    accepted(&[begin(3), edge(1, 0, 20), edge(1, 1, 40), delay(40), END, edge(1, 0, 4)]);
    refused(
        &[begin(3), edge(1, 0, 20), edge(1, 1, 40), delay(41), END, edge(1, 0, 4)],
        1,
        Rule::PulseTooLong,
        61,
        60,
    );
    // Through a loop that leaves the LED alone, and through one that sets it.
    refused(&[edge(1, 1, 0), begin(1000), delay(1), END, edge(1, 0, 4)], 4, Rule::PulseTooLong, 1004, 60);
    refused(&[begin(7), edge(1, 1, 10), END, edge(1, 0, 4)], 3, Rule::PulseTooLong, 64, 60);
    accepted(&[begin(6), edge(1, 1, 10), END, edge(1, 0, 10)]);
    // From wherever the stage stands: as long as the longest move.
    let mut board = small_board();
    let p = [edge(1, 1, 0), go(0, 0), edge(1, 0, 4)];
    let v = verdict(&p, &board).unwrap_err();
    assert_eq!((v.instruction, v.rule), (2, Rule::PulseTooLong));
    board.leds[0].max_pulse = v.value as u32;
    assert_eq!(verdict(&p, &board), Ok(()));
    let mut rig = Rig::new(board);
    rig.start(&[go(0, -40)]);
    rig.finish();
    rig.out = Recorder::default();
    rig.start(&p);
    rig.finish();
    let lit: Vec<_> = rig.out.words.iter().filter(|w| w.1 & 1 == 1).collect();
    let off = rig.out.words.iter().rev().find(|w| w.1 & 1 == 0 && w.0 > lit[0].0).unwrap();
    assert!(i64::try_from(off.0 - lit[0].0).unwrap() <= v.value + 4);
    assert!(i64::try_from(off.0 - lit[0].0).unwrap() >= v.value - 4, "the bound is reached");
}

#[test]
fn the_end_is_safe() {
    refused(&[edge(0x101, 0x101, 0), edge(1, 0, 9)], 1, Rule::LeftOn, 0x100, 0);
    refused(&[edge(0x100, 0x100, 0), Instruction::Stop, edge(0x100, 0, 9)], 1, Rule::LeftOn, 0x100, 0);
    refused(
        &[begin(2), edge(0x100, 0x100, 9), Instruction::Stop, END, edge(0x100, 0, 9)],
        2,
        Rule::LeftOn,
        0x100,
        0,
    );
    accepted(&[begin(2), edge(0x100, 0, 9), Instruction::Stop, edge(0x100, 0x100, 9), END]);
    // What follows the end is still read.
    refused(&[Instruction::Stop, level(9, 0)], 1, Rule::NoSuchLed, 9, 2);
    refused(&[Instruction::Stop, END], 1, Rule::UnmatchedLoopEnd, 0, 0);
}

#[test]
fn huge_loops_are_no_work_and_no_overflow() {
    let big = begin(u32::MAX);
    let limit = verifier::MAX_RUN_TICKS as i64;
    accepted(&[big, edge(0x100, 0x100, 10), edge(0x100, 0, 10), END]);
    refused(&[big, big, delay(1), END, END], 4, Rule::TooLong, i64::MAX, limit);
    let deep = [vec![big; 8], vec![edge(0x100, 0, u32::MAX)], vec![END; 8]].concat();
    let v = verdict(&deep, &small_board()).unwrap_err();
    assert_eq!((v.instruction, v.rule, v.value, v.limit), (9, Rule::TooLong, i64::MAX, limit));
    // An LED lit through a loop of 2³² − 1 passes.
    refused(
        &[edge(1, 1, 0), big, delay(2), END, edge(1, 0, 4)],
        4,
        Rule::PulseTooLong,
        2 * i64::from(u32::MAX) + 4,
        60,
    );
}

/// Where nothing is unknown (no moves), the verifier says yes exactly when playing the program breaks
/// no rule; and the rule it names is one that is broken.
#[test]
fn agrees_with_brute_force() {
    let board = small_board();
    let (yes, no) = (Cell::new(0), RefCell::new(BTreeMap::<String, u32>::new()));
    let mut runner = TestRunner::new(random::config(10_000));
    runner
        .run(&random::program(false), |p| {
            let run = naive::play(&p, &board, 1000, [0; 6], 1, 0);
            match verdict(&p, &board) {
                Ok(()) => {
                    prop_assert_eq!(run.broken, Default::default());
                    yes.set(yes.get() + 1);
                }
                Err(v) => {
                    let rule = format!("{:?}", v.rule);
                    prop_assert!(run.broken.contains(&rule), "{:?}, but {:?} broken", v, run.broken);
                    *no.borrow_mut().entry(rule).or_default() += 1;
                }
            }
            Ok(())
        })
        .unwrap();
    let (yes, no) = (yes.get(), no.into_inner());
    eprintln!("accepted {yes}, refused {no:?}");
    // The programs must be of both kinds, or nothing was tested.
    assert!(yes > 400, "{yes}");
    for rule in ["StepTooShort", "LevelNotSettled", "PulseTooLong", "LeftOn", "EmptyLoop"] {
        assert!(no.get(rule).is_some_and(|n| *n > 20), "{rule}: {no:?}");
    }
}

/// With moves, from any position: what is accepted breaks no rule; what is refused breaks one from some
/// position, unless the verifier says that it cannot prove it.
#[test]
fn with_moves_from_any_position() {
    let board = small_board();
    let counts = RefCell::new([0u32; 3]);
    let mut runner = TestRunner::new(random::config(10_000));
    runner
        .run(&(random::program(true), -40i32..=40, -40i32..=40), |(p, x, y)| {
            let broken = |x: i32, y: i32| naive::play(&p, &board, 1000, [x, y, 0, 0, 0, 0], 1, 0).broken;
            let which = match verdict(&p, &board) {
                Ok(()) => {
                    prop_assert_eq!(broken(x, y), Default::default());
                    0
                }
                Err(v) if v.rule == Rule::CannotProve => 2,
                Err(v) => {
                    // Where it is broken: at either end, or where no first move is needed.
                    let first = |axis: u8| {
                        let goes = p.iter().find_map(|i| match *i {
                            Instruction::Move { axis: a, target, .. }
                            | Instruction::Go { axis: a, target, .. }
                            | Instruction::Capture { axis: a, target, .. }
                            | Instruction::Join { axis: a, target }
                                if a == axis =>
                            {
                                Some(target)
                            }
                            _ => None,
                        });
                        goes.unwrap_or(-40)
                    };
                    let places = [(first(0), first(1)), (-40, -40), (40, 40)];
                    let rule = format!("{:?}", v.rule);
                    let found = places.iter().any(|&(x, y)| broken(x, y).contains(&rule));
                    prop_assert!(found, "{v:?} is broken nowhere");
                    1
                }
            };
            counts.borrow_mut()[which] += 1;
            Ok(())
        })
        .unwrap();
    let [accepted, refused, unproven] = counts.into_inner();
    let rate = f64::from(unproven) / f64::from(accepted + refused + unproven);
    eprintln!("accepted {accepted}, refused {refused}, cannot prove {unproven} ({:.2} %)", 100.0 * rate);
    // 682 of 350 000 programs: 19.5 of 10 000, and five standard deviations of such a count.
    assert!(rate < (19.5 + 5.0 * 4.4) * 1e-4, "{rate}");
    if let Ok(path) = std::env::var("DAIC_TOTALS") {
        let totals =
            format!("{{\"accepted\": {accepted}, \"refused\": {refused}, \"cannot_prove\": {unproven}}}\n");
        std::fs::write(path, totals).unwrap();
    }
    // The programs must be of both kinds, or nothing was tested.
    let all = accepted + refused + unproven;
    assert!(accepted * 20 > all && refused * 20 > all, "{accepted} {refused}");
}

proptest! {
    #![proptest_config(random::config(1000))]

    /// Bytes of any kind: a verdict, no panic.
    #[test]
    fn random_bytes_get_a_verdict(bytes in proptest::collection::vec(0u8..12, 0..400)) {
        let _ = verifier::verify(&bytes, &small_board());
    }
}
