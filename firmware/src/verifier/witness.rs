//! Playing a program out, up to a limit, to find what it really does.

use super::checker::{Checker, Choice, Range};
use super::{MAX_RUN_TICKS, violation};
use crate::board::Board;
use crate::outputs::AXES;
use daic_protocol::limits::MAX_LOOP_DEPTH;
use daic_protocol::message::{Rule, Violation};
use daic_protocol::program::{Instruction, decode_instruction};

/// Most instructions that are played out, every pass of every loop counted.
pub const MAX_PLAYED: u32 = 20_000;

/// What planning an S-curve costs in instructions, so that a program of nothing else is not played out for minutes.
const S_CURVE: u32 = 100;

/// What playing out has shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Outcome {
    /// No rule is broken.
    Clean,
    /// A rule is broken.
    Broken(Violation),
    /// Too long to be played out.
    TooLarge,
}

#[derive(Clone, Copy)]
struct Pass {
    begin: u16,
    offset: usize,
    index: u16,
    left: u32,
    /// Time at its begin.
    since: u64,
}

/// What planning the move of an instruction costs, in instructions.
fn plans(instruction: &Instruction) -> u32 {
    match instruction {
        Instruction::Move { jerk, .. } | Instruction::Go { jerk, .. } | Instruction::Capture { jerk, .. }
            if *jerk > 0 =>
        {
            S_CURVE
        }
        _ => 0,
    }
}

/// Plays a program of sound structure with the axes at `position` and every wait at one end of its span.
pub(super) fn play_out(program: &[u8], board: &Board, choice: Choice, position: [Range; AXES]) -> Outcome {
    let mut checker = Checker::new(choice, position);
    let mut loops: heapless::Vec<Pass, MAX_LOOP_DEPTH> = heapless::Vec::new();
    let (mut offset, mut next, mut index, mut played) = (0usize, 0u16, 0u16, 0u32);
    while let Some(rest) = program.get(offset..).filter(|rest| !rest.is_empty()) {
        let Ok((instruction, length)) = decode_instruction(rest) else { return Outcome::TooLarge };
        played = played.saturating_add(1);
        if played > MAX_PLAYED {
            return Outcome::TooLarge;
        }
        index = next;
        next = next.saturating_add(1);
        offset = offset.saturating_add(length);
        match instruction {
            Instruction::LoopBegin { count } => {
                let since = checker.elapsed().0;
                let pass = Pass { begin: index, offset, index: next, left: count.saturating_sub(1), since };
                if loops.push(pass).is_err() {
                    return Outcome::TooLarge;
                }
            }
            Instruction::LoopEnd => {
                let Some(pass) = loops.last_mut() else { return Outcome::TooLarge };
                // Behind a wait without end time cannot be counted any more.
                if checker.elapsed().0 == pass.since && pass.since < MAX_RUN_TICKS {
                    return Outcome::Broken(violation(pass.begin, Rule::EmptyLoop, 0, 1));
                }
                pass.since = checker.elapsed().0;
                if let Some(left) = pass.left.checked_sub(1) {
                    pass.left = left;
                    (offset, next) = (pass.offset, pass.index);
                } else {
                    loops.pop();
                }
            }
            Instruction::Stop => break,
            other => {
                played = played.saturating_add(plans(&other));
                if let Err(violation) = checker.take(index, &other, board) {
                    return Outcome::Broken(violation);
                }
            }
        }
    }
    match checker.end(index) {
        Ok(()) => Outcome::Clean,
        Err(violation) => Outcome::Broken(violation),
    }
}
