//! The host's expansion of programs against the firmware's controller, which shares nothing with it but
//! `docs/controller.md`: random programs with loops, moves in step, S-curves and edges beside moves.

#[path = "../../firmware/tests/common/mod.rs"]
mod common;

use common::{Rig, random, small_board};
use daic::expand::{Answer, ExpandError, Waits, changes, expand, expand_with};
use daic_protocol::message::{Reply, State};
use daic_protocol::program::{Condition, Instruction, Timeout, encode};
use proptest::prelude::*;
use std::cell::Cell;

/// Word changes of a run, and where the axes stood before it.
type Played = (Vec<(u64, u32)>, [i32; 6]);

/// What the controller plays from the begin of the run, and where the axes stood before; `None` if it
/// refuses the program.
fn played(program: &[Instruction], inputs: &[(u64, u32)]) -> Option<Played> {
    let mut rig = Rig::new(small_board());
    let bytes = encode(program).ok()?;
    if rig.load_bytes(&bytes) != (Reply::Done { state: State::Loaded }) {
        return None;
    }
    let position = rig.status().position;
    let begin = rig.start_again(&bytes);
    for &(tick, word) in inputs {
        rig.play_to(begin + tick);
        rig.input(begin + tick, word);
    }
    rig.play_to(begin + (1 << 40));
    assert_eq!(rig.status().state, State::Loaded, "the run has not ended: {program:?}");
    let words: Vec<_> = rig.out.words.iter().map(|&(tick, word)| (tick - begin, word)).collect();
    Some((changes(&words), position))
}

#[test]
fn random_programs_come_out_as_expanded() {
    let accepted = Cell::new(0u32);
    let moving = Cell::new(0u32);
    proptest!(random::config(3000), |(program in random::program(true))| {
        if let Some((words, position)) = played(&program, &[]) {
            accepted.set(accepted.get() + 1);
            moving.set(moving.get() + u32::from(program.iter().any(|i| matches!(i, Instruction::Go { .. }))));
            prop_assert_eq!(expand(&program, position), Ok(words));
        }
    });
    eprintln!("{} programs accepted, {} of them with edges beside a move", accepted.get(), moving.get());
    assert!(accepted.get() > 300 && moving.get() > 30);
}

#[test]
fn a_wait_ends_where_its_trigger_came() {
    let wait = |on_timeout| Instruction::Wait {
        input: 0,
        condition: Condition::Rising,
        skip: 0,
        delay: 1000,
        timeout: 50_000,
        on_timeout,
    };
    let pulse = [
        Instruction::Edge { mask: 1, value: 1, after: 0 },
        Instruction::Edge { mask: 1, value: 0, after: 20 },
    ];
    let program = [&[wait(Timeout::Continue)], &pulse[..], &[wait(Timeout::Continue)], &pulse].concat();
    let (words, position) = played(&program, &[(300, 1), (400, 0)]).expect("accepted");
    assert_eq!(
        expand(&program, position),
        Err(ExpandError::DependsOnInput { instruction: 0, on: "a trigger" })
    );
    let ended = [Answer::Triggered(300), Answer::TimedOut];
    let expected = vec![(1300, 1), (1320, 0), (52_320, 1), (52_340, 0)];
    assert_eq!(
        (expand_with(&program, position, Waits::Ended(&ended)), words),
        (Ok(expected.clone()), expected)
    );
    let at_once = expand_with(&program, position, Waits::AtOnce);
    assert_eq!(at_once, Ok(vec![(1000, 1), (1020, 0), (2020, 1), (2040, 0)]));
}
