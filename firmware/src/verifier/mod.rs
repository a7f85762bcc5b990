//! Proves a program sound before it replaces the old one.
//!
//! Every instruction is looked at once, whatever the loop counts say. A stretch of instructions is
//! summed up in a block: how long it takes, and what it asks of what comes before it and leaves
//! to what comes after it. Two blocks in a row are one block, a block repeated is one block; the
//! rules are checked where blocks meet. Work is proportional to the number of instructions times
//! the depth of nesting, memory to the depth.
//!
//! Times are exact but for waits, homing, and moves whose starting position is not known: the position at
//! the start of a run is wherever the stage stands, that at the start of a loop's body depends on the
//! pass. Then the shortest time that is possible counts for distances and rest, the longest for pulses;
//! and of the levels that a program sets the highest counts everywhere.
//!
//! So what is accepted keeps every rule. What is not accepted breaks one for certain where everything
//! was exact; else the program is played out, at most [`MAX_PLAYED`] instructions at each end of what is
//! not known, to find a rule that it really breaks. If none is found the answer is
//! [`Rule::CannotProve`].

mod block;
mod checker;
mod rules;
mod witness;

pub(crate) use checker::{Checker, Choice};
pub use witness::MAX_PLAYED;

use crate::board::Board;
use crate::motion::{DIR_DELAY, STEP_PULSE};
use crate::outputs::{AXES, LEDS};
use crate::player::capture_edges;
use block::{Block, Limit, Limits};
use checker::{Range, Span, home_span, move_span, wait_span};
use daic_protocol::limits::{MAX_INSTRUCTIONS, MAX_LOOP_DEPTH};
use daic_protocol::message::{Rule, Violation};
use daic_protocol::program::{Instruction, decode, decode_instruction};
use witness::{Outcome, play_out};

/// Longest run in ticks without waits that have no time-out: 2⁶² (1169 years of 8 ns), so that ticks since
/// boot never overflow.
pub const MAX_RUN_TICKS: u64 = 1 << 62;
/// Longest time of a wait without time-out.
pub(crate) const FOREVER: u64 = u64::MAX;

/// Checks every rule of [`Rule`] for the program played on `board` from any position.
///
/// # Errors
/// The violation found first when reading from the front; one that only shows where a loop's end
/// meets its beginning is found at the loop's end.
pub fn verify(program: &[u8], board: &Board) -> Result<(), Violation> {
    let mut verifier = Verifier::new(program, board);
    match verifier.run(program) {
        Err(found) if !verifier.exact && depends_on_time(found.rule) => verifier.decide(program, found),
        verdict => verdict,
    }
}

/// Whether the rule depends on times, levels or positions, which may not be known exactly.
fn depends_on_time(rule: Rule) -> bool {
    use Rule::*;
    matches!(rule, StepTooShort | LevelNotSettled | PulseTooLong | DutyExceeded | EmptyLoop | TooLong)
}

pub(crate) fn violation(instruction: u16, rule: Rule, value: i64, limit: i64) -> Violation {
    Violation { instruction, rule, value, limit }
}

/// Numbers beyond what a violation can tell are told as the largest.
pub(crate) fn int(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

/// What an open stretch is.
#[derive(Debug, Clone, Copy)]
enum Kind {
    /// The body of a loop.
    Loop(u32),
    /// What happens beside a move that takes so long.
    Beside(Span),
}

/// A stretch that is open.
#[derive(Debug)]
struct Open {
    begin: u16,
    kind: Kind,
    block: Block,
}

struct Verifier<'a> {
    board: &'a Board,
    limits: Limits,
    program: Block,
    open: heapless::Vec<Open, { MAX_LOOP_DEPTH + 1 }>,
    positions: [Range; AXES],
    joined: heapless::Vec<(u8, i32), AXES>,
    /// Nothing was rounded to the safe side so far.
    exact: bool,
    /// A `Stop` has been reached: what follows is not played.
    ended: bool,
}

/// Limits of every LED at the highest level that the program sets, and whether that is exact.
fn led_limits(program: &[u8], board: &Board) -> (Limits, bool) {
    let mut highest = [0u16; LEDS];
    let mut lowest = [None::<u16>; LEDS];
    for (_, instruction) in decode(program) {
        if let Ok(Instruction::Level { led, level }) = instruction
            && let (Some(h), Some(l)) = (highest.get_mut(usize::from(led)), lowest.get_mut(usize::from(led)))
        {
            *h = (*h).max(level);
            *l = Some(l.map_or(level, |l| l.min(level)));
        }
    }
    let none = Limit { max_pulse: u32::MAX, cycle: 1, settle: 0, window: u32::MAX };
    let mut limits = [none; LEDS];
    let mut exact = true;
    for (((limit, led), high), low) in limits.iter_mut().zip(&board.leds).zip(highest).zip(lowest) {
        let (max_pulse, cycle) = led.at(high);
        // Before its first `Level` an LED has level 0.
        exact &= low.is_none() || led.at(0) == (max_pulse, cycle);
        *limit = Limit { max_pulse, cycle, settle: led.settle, window: led.window };
    }
    (limits, exact)
}

impl<'a> Verifier<'a> {
    fn new(program: &[u8], board: &'a Board) -> Self {
        let (limits, exact) = led_limits(program, board);
        Self {
            board,
            limits,
            program: Block::EMPTY,
            open: heapless::Vec::new(),
            positions: anywhere(board),
            joined: heapless::Vec::new(),
            exact,
            ended: false,
        }
    }

    fn run(&mut self, program: &[u8]) -> Result<(), Violation> {
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
            self.take(count, instruction, rest)?;
            count = count.saturating_add(1);
        }
        self.finish(count)
    }

    /// Finds out what a program does that could not be proven.
    fn decide(&self, program: &[u8], found: Violation) -> Result<(), Violation> {
        // Its structure must be sound to the end.
        structure(program, self.board)?;
        let all = anywhere(self.board);
        let low = all.map(|(low, _)| (low, low));
        let high = all.map(|(_, high)| (high, high));
        let near = first_targets(program, &all);
        let mut clean = true;
        for choice in [Choice::Shortest, Choice::Longest] {
            for start in [near, low, high] {
                match play_out(program, self.board, choice, start) {
                    Outcome::Broken(violation) => return Err(violation),
                    Outcome::TooLarge => clean = false,
                    Outcome::Clean => {}
                }
            }
        }
        if clean && !is_uncertain(program) {
            return Ok(());
        }
        Err(violation(found.instruction, Rule::CannotProve, found.rule as i64, i64::from(MAX_PLAYED)))
    }

    /// `rest` begins with the instruction itself.
    fn take(&mut self, index: u16, instruction: Instruction, rest: &[u8]) -> Result<(), Violation> {
        let err = |rule, value, limit| Err(violation(index, rule, value, limit));
        rules::check(index, &instruction, self.board)?;
        let moves = rules::pace_of(&instruction);
        let joins = matches!(instruction, Instruction::Join { .. });
        if !self.joined.is_empty() && moves.is_none() && !joins {
            return err(Rule::BadJoin, self.joined.len() as i64, 0);
        }
        if (moves.is_some() || matches!(instruction, Instruction::Home { .. })) && self.is_beside() {
            return err(Rule::MoveNotEnded, 0, 0);
        }
        match instruction {
            Instruction::Edge { mask, value, after } => {
                self.then(index, &Block::edge(index, mask, value, after, &self.limits))
            }
            Instruction::Delay { ticks } | Instruction::Settle { ticks } => {
                self.then(index, &Block::pause((u64::from(ticks), u64::from(ticks)), &self.limits))
            }
            Instruction::Wait { .. } | Instruction::WaitTrigger { .. } => {
                self.guess();
                let span = wait_span(&instruction, self.board).unwrap_or((0, 0));
                self.then(index, &Block::pause(span, &self.limits))
            }
            Instruction::LoopBegin { count } => {
                if count > 1 {
                    self.widen(rest);
                }
                let loops = self.open.iter().filter(|o| matches!(o.kind, Kind::Loop(_))).count();
                let open = Open { begin: index, kind: Kind::Loop(count), block: Block::EMPTY };
                if loops >= MAX_LOOP_DEPTH || self.open.push(open).is_err() {
                    let depth = MAX_LOOP_DEPTH as i64;
                    return err(Rule::LoopTooDeep, depth.saturating_add(1), depth);
                }
                Ok(())
            }
            Instruction::LoopEnd => {
                let Some(open) = self.open.pop() else { return err(Rule::UnmatchedLoopEnd, 0, 0) };
                let Kind::Loop(count) = open.kind else {
                    return Err(violation(open.begin, Rule::MoveNotEnded, 0, 0));
                };
                if self.ended {
                    return Ok(());
                }
                if open.block.is_timeless() {
                    return Err(violation(open.begin, Rule::EmptyLoop, 0, 1));
                }
                let repeated = open.block.repeat(count, index, &self.limits)?;
                self.then(index, &repeated)
            }
            Instruction::Join { axis, target } => {
                let full = self.joined.len().saturating_add(1) >= AXES;
                if full
                    || self.joined.iter().any(|(a, _)| *a == axis)
                    || self.joined.push((axis, target)).is_err()
                {
                    return err(Rule::BadJoin, i64::from(axis), 0);
                }
                Ok(())
            }
            Instruction::Move { .. } | Instruction::Go { .. } | Instruction::Capture { .. } => {
                let Some((axis, target, pace)) = moves else { return Ok(()) };
                self.moving(index, &instruction, (axis, target), pace)
            }
            Instruction::Reach => {
                let Some(Open { kind: Kind::Beside((low, high)), block, .. }) = self.open.last() else {
                    return err(Rule::NothingToReach, 0, 0);
                };
                let (least, most) = block.span();
                let rest = (low.saturating_sub(most), high.saturating_sub(least));
                if rest.0 != rest.1 {
                    self.guess();
                }
                self.then(index, &Block::pause(rest, &self.limits))?;
                match self.open.pop() {
                    Some(open) if !self.ended => self.then(index, &open.block),
                    _ => Ok(()),
                }
            }
            Instruction::Home { axis } => {
                self.guess();
                let homing = self.board.axes.get(usize::from(axis)).and_then(|a| a.home);
                if let (Some(homing), Some(range)) = (homing, self.positions.get_mut(usize::from(axis))) {
                    *range = (homing.position, homing.position);
                }
                let span = home_span(axis, self.board);
                self.then(index, &Block::motion(index, span, DIR_DELAY, STEP_PULSE, &self.limits))
            }
            Instruction::Level { led, .. } => self.then(index, &Block::level(index, led)),
            Instruction::Gate { .. }
            | Instruction::NoGate
            | Instruction::Policy(_)
            | Instruction::Mark { .. } => Ok(()),
            Instruction::Stop => {
                if self.is_beside() {
                    return err(Rule::MoveNotEnded, 0, 0);
                }
                if !self.ended {
                    // The program ends in the first pass of every loop that is open.
                    let open = core::mem::take(&mut self.open);
                    for o in &open {
                        self.program.then(&o.block, index, &self.limits)?;
                    }
                    self.open = open;
                    self.check_duty(index)?;
                    self.check_end(index)?;
                }
                self.ended = true;
                Ok(())
            }
        }
    }

    fn is_beside(&self) -> bool {
        self.open.iter().any(|o| matches!(o.kind, Kind::Beside(_)))
    }

    /// From here on something is rounded to the safe side.
    fn guess(&mut self) {
        self.exact = false;
    }

    fn moving(
        &mut self,
        index: u16,
        instruction: &Instruction,
        (axis, target): (u8, i32),
        pace: rules::Pace,
    ) -> Result<(), Violation> {
        let mut targets = core::mem::take(&mut self.joined);
        for &(other, _) in &targets {
            if other == axis {
                return Err(violation(index, Rule::BadJoin, i64::from(axis), 0));
            }
            rules::pace(index, other, pace, self.board)?;
        }
        // There is room: `Join` leaves it.
        let _ = targets.push((axis, target));
        let span = move_span(&self.positions, &targets, pace);
        if span.0 != span.1 {
            self.guess();
        }
        for &(axis, target) in &targets {
            if let Some(range) = self.positions.get_mut(usize::from(axis)) {
                *range = (target, target);
            }
        }
        if let Instruction::Go { .. } = instruction {
            let open = Open { begin: index, kind: Kind::Beside(span), block: Block::EMPTY };
            // There is one place more than loops, and no move beside another.
            let _ = self.open.push(open);
            return Ok(());
        }
        self.then(index, &Block::motion(index, span, DIR_DELAY, 0, &self.limits))?;
        let Instruction::Capture { settle, .. } = *instruction else { return Ok(()) };
        self.then(index, &Block::pause((u64::from(settle), u64::from(settle)), &self.limits))?;
        for edge in capture_edges(instruction).into_iter().flatten() {
            if let Instruction::Edge { mask, value, after } = edge {
                self.then(index, &Block::edge(index, mask, value, after, &self.limits))?;
            }
        }
        Ok(())
    }

    /// Appends to the innermost open stretch.
    fn then(&mut self, index: u16, next: &Block) -> Result<(), Violation> {
        if self.ended {
            return Ok(());
        }
        match self.open.last_mut() {
            Some(open) => open.block.then(next, index, &self.limits),
            None => {
                self.program.then(next, index, &self.limits)?;
                self.check_duty(index)
            }
        }
    }

    fn check_duty(&self, index: u16) -> Result<(), Violation> {
        match self.program.overdrawn(&self.limits) {
            Some((owed, window)) => Err(violation(index, Rule::DutyExceeded, owed, window)),
            None => Ok(()),
        }
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
                other => {
                    if let Some((axis, target)) = goes_to(&other, self.board)
                        && let Some(l) = last.get_mut(usize::from(axis))
                    {
                        *l = Some(target);
                    }
                }
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

    fn finish(&mut self, count: u16) -> Result<(), Violation> {
        let Some(last) = count.checked_sub(1) else { return Err(violation(0, Rule::EmptyProgram, 0, 1)) };
        if !self.joined.is_empty() {
            return Err(violation(last, Rule::BadJoin, self.joined.len() as i64, 0));
        }
        if let Some(open) = self.open.last() {
            return Err(match open.kind {
                Kind::Loop(_) => violation(open.begin, Rule::UnclosedLoop, self.open.len() as i64, 0),
                Kind::Beside(_) => violation(open.begin, Rule::MoveNotEnded, 0, 0),
            });
        }
        if self.ended { Ok(()) } else { self.check_end(last) }
    }
}

/// Whether what a program does depends on inputs or on where the stage stands.
fn is_uncertain(program: &[u8]) -> bool {
    decode(program).any(|(_, instruction)| match instruction {
        Ok(Instruction::Wait { .. } | Instruction::WaitTrigger { .. } | Instruction::Home { .. }) => true,
        Ok(other) => rules::pace_of(&other).is_some(),
        Err(_) => true,
    })
}

/// Any place between the limits, and where every axis is at boot.
fn anywhere(board: &Board) -> [Range; AXES] {
    let mut positions = [(0, 0); AXES];
    for (range, axis) in positions.iter_mut().zip(&board.axes) {
        *range = (axis.min.min(0), axis.max.max(0));
    }
    positions
}

/// Axis and place where an instruction leaves it.
fn goes_to(instruction: &Instruction, board: &Board) -> Option<(u8, i32)> {
    match *instruction {
        Instruction::Join { axis, target } => Some((axis, target)),
        Instruction::Home { axis } => {
            let homing = board.axes.get(usize::from(axis))?.home?;
            Some((axis, homing.position))
        }
        ref other => rules::pace_of(other).map(|(axis, target, _)| (axis, target)),
    }
}

/// Every axis where its first move goes, so that this move takes no time.
fn first_targets(program: &[u8], all: &[Range; AXES]) -> [Range; AXES] {
    let mut start = all.map(|(low, _)| (low, low));
    let mut seen = [false; AXES];
    for (_, instruction) in decode(program) {
        let Ok(instruction) = instruction else { break };
        let (axis, target) = match instruction {
            Instruction::Join { axis, target } => (axis, target),
            other => match rules::pace_of(&other) {
                Some((axis, target, _)) => (axis, target),
                None => continue,
            },
        };
        if let (Some(s), Some(seen)) = (start.get_mut(usize::from(axis)), seen.get_mut(usize::from(axis)))
            && !core::mem::replace(seen, true)
        {
            *s = (target, target);
        }
    }
    start
}

/// A second reading for what does not depend on time, to the end.
fn structure(program: &[u8], board: &Board) -> Result<(), Violation> {
    let mut count: u16 = 0;
    let mut loops: heapless::Vec<u16, MAX_LOOP_DEPTH> = heapless::Vec::new();
    for (offset, item) in decode(program) {
        let undecodable = violation(count, Rule::Undecodable, int(offset as u64), int(program.len() as u64));
        let instruction = item.map_err(|_| undecodable)?;
        if usize::from(count) >= MAX_INSTRUCTIONS {
            let value = i64::from(count).saturating_add(1);
            return Err(violation(count, Rule::TooManyInstructions, value, MAX_INSTRUCTIONS as i64));
        }
        rules::check(count, &instruction, board)?;
        match instruction {
            Instruction::LoopBegin { .. } => {
                let depth = MAX_LOOP_DEPTH as i64;
                let too_deep = violation(count, Rule::LoopTooDeep, depth.saturating_add(1), depth);
                loops.push(count).map_err(|_| too_deep)?;
            }
            Instruction::LoopEnd => {
                loops.pop().ok_or_else(|| violation(count, Rule::UnmatchedLoopEnd, 0, 0))?;
            }
            _ => {}
        }
        count = count.saturating_add(1);
    }
    match loops.last() {
        Some(begin) => Err(violation(*begin, Rule::UnclosedLoop, loops.len() as i64, 0)),
        None => Ok(()),
    }
}
