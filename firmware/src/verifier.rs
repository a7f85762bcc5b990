//! Proves a program sound before it replaces the old one.
//!
//! Every instruction is looked at once, whatever the loop counts say. A stretch of instructions is
//! summed up in a block: how long it takes, and what it asks of what comes before it and leaves
//! to what comes after it. Two blocks in a row are one block, a block repeated is one block; the
//! rules are checked where blocks meet. Work is proportional to the number of instructions times
//! the depth of nesting, memory to the depth.
//!
//! Times are exact but for moves whose starting position is not known: the position at the start of
//! a run is wherever the stage stands, that at the start of a loop's body depends on the pass. Then
//! the shortest time that is possible counts for distances, the longest for pulses.

mod block;

use crate::board::Board;
use crate::motion::{DIR_DELAY, MAX_ACCELERATION, MAX_STEP_RATE, Profile};
use crate::outputs::AXES;
use block::{Block, Limits};
use daic_protocol::limits::{MAX_INSTRUCTIONS, MAX_LOOP_DEPTH};
use daic_protocol::message::{Capabilities, Rule, Violation};
use daic_protocol::program::{Instruction, decode, decode_instruction};

/// Longest run in ticks: 2⁶² (1169 years of 8 ns), so that ticks since boot never overflow.
pub const MAX_RUN_TICKS: u64 = 1 << 62;

/// Capabilities that this firmware plays; a board may claim no other.
pub(crate) const PLAYED: u32 = Capabilities::SIMULATED;

/// Checks every rule of [`Rule`] for the program played on `board` from any position.
///
/// # Errors
/// The violation found first when reading from the front; one that only shows where a loop's end
/// meets its beginning is found at the loop's end.
pub fn verify(program: &[u8], board: &Board) -> Result<(), Violation> {
    let mut verifier = Verifier::new(board);
    let mut count: u16 = 0;
    for (offset, item) in decode(program) {
        if usize::from(count) >= MAX_INSTRUCTIONS {
            let value = i64::from(count).saturating_add(1);
            return Err(violation(count, Rule::TooManyInstructions, value, MAX_INSTRUCTIONS as i64));
        }
        let instruction = item.map_err(|_| {
            violation(count, Rule::Undecodable, int(offset as u64), int(program.len() as u64))
        })?;
        let rest = program.get(offset..).unwrap_or(&[]);
        verifier.take(count, instruction, rest)?;
        count = count.saturating_add(1);
    }
    verifier.finish(count)
}

pub(crate) fn violation(instruction: u16, rule: Rule, value: i64, limit: i64) -> Violation {
    Violation { instruction, rule, value, limit }
}

/// Numbers beyond what a violation can tell are told as the largest.
pub(crate) fn int(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

/// A loop that is open, or the program itself (`count` 1).
#[derive(Debug)]
struct Open {
    begin: u16,
    count: u32,
    block: Block,
}

/// Positions that an axis may be in.
type Range = (i32, i32);

struct Verifier<'a> {
    board: &'a Board,
    limits: Limits<'a>,
    program: Block,
    loops: heapless::Vec<Open, MAX_LOOP_DEPTH>,
    positions: [Range; AXES],
    /// A `Stop` has been reached: what follows is not played.
    ended: bool,
}

impl<'a> Verifier<'a> {
    fn new(board: &'a Board) -> Self {
        let mut positions = [(0, 0); AXES];
        for (range, axis) in positions.iter_mut().zip(&board.axes) {
            // Any place between the limits, and where every axis is at boot.
            *range = (axis.min.min(0), axis.max.max(0));
        }
        Self {
            board,
            limits: Limits { leds: &board.leds },
            program: Block::EMPTY,
            loops: heapless::Vec::new(),
            positions,
            ended: false,
        }
    }

    /// `rest` begins with the instruction itself.
    fn take(&mut self, index: u16, instruction: Instruction, rest: &[u8]) -> Result<(), Violation> {
        let err = |rule, value, limit| Err(violation(index, rule, value, limit));
        match instruction {
            Instruction::Edge { mask, value, after } => {
                let allowed = self.board.edge_mask();
                if mask & !allowed != 0 {
                    return err(Rule::ForbiddenBits, i64::from(mask), i64::from(allowed));
                }
                if value & !mask != 0 {
                    return err(Rule::ValueOutsideMask, i64::from(value), i64::from(mask));
                }
                self.then(index, &Block::edge(index, mask, value, after))
            }
            Instruction::Delay { ticks } | Instruction::Settle { ticks } => {
                self.then(index, &Block::pause(ticks))
            }
            Instruction::LoopBegin { count } => {
                if count == 0 {
                    return err(Rule::ZeroLoop, 0, 1);
                }
                if count > 1 {
                    self.widen(rest);
                }
                if self.loops.push(Open { begin: index, count, block: Block::EMPTY }).is_err() {
                    let depth = MAX_LOOP_DEPTH as i64;
                    return err(Rule::LoopTooDeep, depth.saturating_add(1), depth);
                }
                Ok(())
            }
            Instruction::LoopEnd => {
                let Some(open) = self.loops.pop() else { return err(Rule::UnmatchedLoopEnd, 0, 0) };
                if self.ended {
                    return Ok(());
                }
                if open.block.is_timeless() {
                    return Err(violation(open.begin, Rule::EmptyLoop, 0, 1));
                }
                let repeated = open.block.repeat(open.count, index, self.limits)?;
                self.then(index, &repeated)
            }
            Instruction::WaitTrigger { .. } => err(Rule::Unsupported, 0, 0),
            Instruction::Move { axis, target, max_rate, acceleration, jerk } => {
                let Some(limits) = self.board.axes.get(usize::from(axis)) else {
                    return err(Rule::NoSuchAxis, i64::from(axis), self.board.axes.len() as i64);
                };
                let (rate_limit, acceleration_limit) =
                    (limits.max_rate.min(MAX_STEP_RATE), limits.max_acceleration.min(MAX_ACCELERATION));
                if target < limits.min {
                    return err(Rule::TargetOutOfRange, i64::from(target), i64::from(limits.min));
                }
                if target > limits.max {
                    return err(Rule::TargetOutOfRange, i64::from(target), i64::from(limits.max));
                }
                if max_rate == 0 || max_rate > rate_limit {
                    return err(Rule::RateOutOfRange, i64::from(max_rate), i64::from(rate_limit));
                }
                if acceleration == 0 || acceleration > acceleration_limit {
                    return err(
                        Rule::AccelerationOutOfRange,
                        i64::from(acceleration),
                        i64::from(acceleration_limit),
                    );
                }
                if jerk != 0 {
                    return err(Rule::Unsupported, i64::from(jerk), 0);
                }
                let Some(range) = self.positions.get_mut(usize::from(axis)) else { return Ok(()) };
                let (low, high) = core::mem::replace(range, (target, target));
                let far = low.abs_diff(target).max(high.abs_diff(target));
                let near = if (low..=high).contains(&target) {
                    0
                } else {
                    low.abs_diff(target).min(high.abs_diff(target))
                };
                let ticks = |steps| Profile::new(steps, max_rate, acceleration).duration();
                self.then(index, &Block::motion(index, ticks(near), ticks(far), DIR_DELAY))
            }
            Instruction::Level { led, .. } => {
                if usize::from(led) >= self.board.leds.len() {
                    return err(Rule::NoSuchLed, i64::from(led), self.board.leds.len() as i64);
                }
                self.then(index, &Block::level(index, led))
            }
            Instruction::Mark { .. } => Ok(()),
            Instruction::Stop => {
                if !self.ended {
                    // The program ends in the first pass of every loop that is open.
                    let open = core::mem::take(&mut self.loops);
                    for l in &open {
                        self.program.then(&l.block, index, self.limits)?;
                    }
                    self.loops = open;
                    self.check_end(index)?;
                }
                self.ended = true;
                Ok(())
            }
        }
    }

    /// Appends to the innermost open loop.
    fn then(&mut self, index: u16, next: &Block) -> Result<(), Violation> {
        if self.ended {
            return Ok(());
        }
        let limits = self.limits;
        self.loops.last_mut().map_or(&mut self.program, |open| &mut open.block).then(next, index, limits)
    }

    /// At the beginning of a loop: each axis is where it was, or where the body leaves it.
    fn widen(&mut self, rest: &[u8]) {
        let mut rest = rest;
        let mut depth = 0u32;
        let mut last = [None; AXES];
        while let Ok((instruction, length)) = decode_instruction(rest) {
            match instruction {
                Instruction::LoopBegin { .. } => depth = depth.saturating_add(1),
                Instruction::LoopEnd => depth = depth.saturating_sub(1),
                Instruction::Move { axis, target, .. } => {
                    if let Some(l) = last.get_mut(usize::from(axis)) {
                        *l = Some(target);
                    }
                }
                _ => {}
            }
            if depth == 0 {
                break;
            }
            rest = rest.get(length..).unwrap_or(&[]);
        }
        for ((low, high), target) in self.positions.iter_mut().zip(last) {
            if let Some(target) = target {
                (*low, *high) = ((*low).min(target), (*high).max(target));
            }
        }
    }

    fn check_end(&self, index: u16) -> Result<(), Violation> {
        match self.program.left_on() {
            0 => Ok(()),
            word => Err(violation(index, Rule::LeftOn, i64::from(word), 0)),
        }
    }

    fn finish(self, count: u16) -> Result<(), Violation> {
        let Some(last) = count.checked_sub(1) else { return Err(violation(0, Rule::EmptyProgram, 0, 1)) };
        if let Some(open) = self.loops.last() {
            return Err(violation(open.begin, Rule::UnclosedLoop, self.loops.len() as i64, 0));
        }
        if self.ended { Ok(()) } else { self.check_end(last) }
    }
}
