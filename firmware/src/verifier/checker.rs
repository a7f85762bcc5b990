//! One instruction after the other, with the shortest and the longest time each can take.

use super::rules::{self, Pace};
use super::{FOREVER, MAX_RUN_TICKS, int, violation};
use crate::board::{Board, LedLimits};
use crate::motion::{DIR_DELAY, DIR_SETUP, Profile, STEP_PULSE};
use crate::outputs::{AXES, LEDS};
use crate::player::{SHORTEST_HOMING, capture_edges, longest_homing};
use daic_protocol::channels;
use daic_protocol::limits::MIN_STEP_TICKS;
use daic_protocol::message::{Rule, Violation};
use daic_protocol::program::Instruction;

/// Shortest and longest time.
pub(super) type Span = (u64, u64);
/// Lowest and highest position.
pub(crate) type Range = (i32, i32);

/// How long a wait can last.
pub(super) fn wait_span(instruction: &Instruction, board: &Board) -> Option<Span> {
    let (delay, timeout) = match *instruction {
        Instruction::Wait { delay, timeout, .. } => (delay, timeout),
        Instruction::WaitTrigger { timeout, .. } => (board.input_latency, timeout),
        _ => return None,
    };
    let high = if timeout == 0 { FOREVER } else { u64::from(timeout).saturating_add(u64::from(delay)) };
    Some((u64::from(delay), high))
}

/// How long a move can last that begins anywhere in `from`.
pub(super) fn move_span(from: &[Range; AXES], targets: &[(u8, i32)], pace: Pace) -> Span {
    let (mut near, mut far) = (0, 0);
    for &(axis, target) in targets {
        let (low, high) = from.get(usize::from(axis)).copied().unwrap_or((target, target));
        far = far.max(low.abs_diff(target)).max(high.abs_diff(target));
        if !(low..=high).contains(&target) {
            near = near.max(low.abs_diff(target).min(high.abs_diff(target)));
        }
    }
    let Pace { rate, acceleration, jerk } = pace;
    let ticks = |steps| Profile::new(steps, rate, acceleration, jerk).duration();
    if near == far {
        let exact = ticks(near);
        return (exact, exact);
    }
    let low = match (near, jerk) {
        (0, _) => 0,
        (_, 0) => ticks(near),
        _ => DIR_DELAY + DIR_SETUP + STEP_PULSE,
    };
    (low, Profile::longest(far, rate, acceleration, jerk))
}

/// How long homing can last.
pub(super) fn home_span(axis: u8, board: &Board) -> Span {
    let homing = board.axes.get(usize::from(axis)).and_then(|a| a.home);
    homing.map_or((0, 0), |h| (SHORTEST_HOMING, longest_homing(&h)))
}

/// One LED.
#[derive(Debug, Clone, Copy)]
struct Lamp {
    /// Longest time it can have been on.
    lit: Option<u64>,
    level: u16,
    /// Shortest time since its level was set.
    age: Option<u64>,
    /// Most rest that can be owed.
    owed: u64,
}

/// What can be said after some instructions.
#[derive(Debug, Clone)]
pub(crate) struct Checker {
    /// Which end of a span is taken; both for a proof.
    choice: Choice,
    /// A pulse is too long as soon as it is, not when it ends.
    strict: bool,
    elapsed: Span,
    /// Shortest time since the last word of the program.
    quiet: Option<u64>,
    word: u32,
    lamps: [Lamp; LEDS],
    position: [Range; AXES],
    joined: heapless::Vec<(u8, i32), AXES>,
    /// What is left of a move that runs beside the program.
    going: Option<Span>,
}

/// Which end of a span is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Choice {
    /// Both: what is accepted keeps the rules whatever happens.
    Both,
    /// The shortest.
    Shortest,
    /// The longest.
    Longest,
}

impl Checker {
    /// Before the first instruction, with the axes where `position` says.
    pub(crate) fn new(choice: Choice, position: [Range; AXES]) -> Self {
        let lamp = Lamp { lit: None, level: 0, age: None, owed: 0 };
        Self {
            choice,
            strict: false,
            elapsed: (0, 0),
            quiet: None,
            word: 0,
            lamps: [lamp; LEDS],
            position,
            joined: heapless::Vec::new(),
            going: None,
        }
    }

    /// For a program whose end is not known yet.
    pub(crate) fn strict(mut self) -> Self {
        self.strict = true;
        self
    }

    /// Shortest time that the instructions so far can take.
    pub(crate) fn shortest(&self) -> u64 {
        self.elapsed.0
    }

    pub(super) fn elapsed(&self) -> Span {
        self.elapsed
    }

    /// The next instruction; loops are for the caller.
    pub(crate) fn take(
        &mut self,
        index: u16,
        instruction: &Instruction,
        board: &Board,
    ) -> Result<(), Violation> {
        rules::check(index, instruction, board)?;
        let err = |rule, value, limit| Err(violation(index, rule, value, limit));
        let moves = rules::pace_of(instruction);
        if moves.is_none() && !matches!(instruction, Instruction::Join { .. }) && !self.joined.is_empty() {
            return err(Rule::BadJoin, self.joined.len() as i64, 0);
        }
        if self.going.is_some() && (moves.is_some() || matches!(instruction, Instruction::Home { .. })) {
            return err(Rule::MoveNotEnded, 0, 0);
        }
        match *instruction {
            Instruction::Edge { mask, value, after } => {
                let after = u64::from(after);
                self.pass(index, (after, after), board)?;
                self.edge(index, mask, value, board)
            }
            Instruction::Delay { ticks } | Instruction::Settle { ticks } => {
                self.pass(index, (u64::from(ticks), u64::from(ticks)), board)
            }
            Instruction::Wait { .. } | Instruction::WaitTrigger { .. } => {
                let span = wait_span(instruction, board).unwrap_or((0, 0));
                self.pass(index, span, board)
            }
            Instruction::LoopBegin { .. } | Instruction::LoopEnd => err(Rule::LoopInStream, 0, 0),
            Instruction::Level { led, level } => {
                if let Some(lamp) = self.lamps.get_mut(usize::from(led)) {
                    if lamp.lit.is_some() {
                        let settle = board.leds.get(usize::from(led)).map_or(0, |l| l.settle);
                        return err(Rule::LevelNotSettled, 0, i64::from(settle));
                    }
                    (lamp.level, lamp.age) = (level, Some(0));
                }
                Ok(())
            }
            Instruction::Join { axis, target } => {
                let full = self.joined.len().saturating_add(1) >= AXES;
                if full || self.joined.iter().any(|(a, _)| *a == axis) {
                    return err(Rule::BadJoin, i64::from(axis), 0);
                }
                let _ = self.joined.push((axis, target));
                Ok(())
            }
            Instruction::Move { .. } => {
                let span = self.plan(index, moves, board)?;
                self.moved(index, span, board)
            }
            Instruction::Go { .. } => {
                let span = self.plan(index, moves, board)?;
                self.going = Some(span);
                Ok(())
            }
            Instruction::Reach => {
                let Some(left) = self.going.take() else { return err(Rule::NothingToReach, 0, 0) };
                self.pass(index, left, board)
            }
            Instruction::Home { axis } => {
                let homing = board.axes.get(usize::from(axis)).and_then(|a| a.home);
                if let (Some(homing), Some(range)) = (homing, self.position.get_mut(usize::from(axis))) {
                    *range = (homing.position, homing.position);
                }
                self.pass(index, home_span(axis, board), board)?;
                // Its last word lies a step pulse before its end, at least.
                self.quiet = Some(STEP_PULSE);
                Ok(())
            }
            Instruction::Capture { settle, .. } => {
                let span = self.plan(index, moves, board)?;
                self.moved(index, span, board)?;
                self.pass(index, (u64::from(settle), u64::from(settle)), board)?;
                for edge in capture_edges(instruction).into_iter().flatten() {
                    if let Instruction::Edge { mask, value, after } = edge {
                        let after = u64::from(after);
                        self.pass(index, (after, after), board)?;
                        self.edge(index, mask, value, board)?;
                    }
                }
                Ok(())
            }
            Instruction::Gate { .. }
            | Instruction::NoGate
            | Instruction::Policy(_)
            | Instruction::Mark { .. } => Ok(()),
            Instruction::Stop => self.end(index),
        }
    }

    /// The program ends after instruction `index`.
    pub(crate) fn end(&self, index: u16) -> Result<(), Violation> {
        if !self.joined.is_empty() {
            return Err(violation(index, Rule::BadJoin, self.joined.len() as i64, 0));
        }
        if self.going.is_some() {
            return Err(violation(index, Rule::MoveNotEnded, 0, 0));
        }
        if self.word != 0 {
            return Err(violation(index, Rule::LeftOn, i64::from(self.word), 0));
        }
        Ok(())
    }

    fn plan(&mut self, index: u16, moves: Option<(u8, i32, Pace)>, board: &Board) -> Result<Span, Violation> {
        let Some((axis, target, pace)) = moves else { return Ok((0, 0)) };
        for &(other, _) in &self.joined {
            if other == axis {
                return Err(violation(index, Rule::BadJoin, i64::from(axis), 0));
            }
            rules::pace(index, other, pace, board)?;
        }
        let _ = self.joined.push((axis, target));
        let targets = core::mem::take(&mut self.joined);
        let span = move_span(&self.position, &targets, pace);
        for &(axis, target) in &targets {
            if let Some(range) = self.position.get_mut(usize::from(axis)) {
                *range = (target, target);
            }
        }
        Ok(span)
    }

    fn moved(&mut self, index: u16, span: Span, board: &Board) -> Result<(), Violation> {
        let (_, high) = self.choose(span);
        self.pass(index, span, board)?;
        if high > 0 {
            // The last word is the end of the last step pulse, and that ends the move.
            self.quiet = Some(0);
        }
        Ok(())
    }

    fn choose(&self, (low, high): Span) -> Span {
        match self.choice {
            Choice::Both => (low, high),
            Choice::Shortest => (low, low),
            Choice::Longest => (high, high),
        }
    }

    fn pass(&mut self, index: u16, span: Span, board: &Board) -> Result<(), Violation> {
        let (low, high) = self.choose(span);
        self.elapsed = (self.elapsed.0.saturating_add(low), self.elapsed.1.saturating_add(high));
        if self.elapsed.1 > MAX_RUN_TICKS && self.elapsed.1 != FOREVER {
            return Err(violation(index, Rule::TooLong, int(self.elapsed.1), int(MAX_RUN_TICKS)));
        }
        self.quiet = self.quiet.map(|q| q.saturating_add(low));
        self.going = self.going.map(|(l, h)| (l.saturating_sub(high), h.saturating_sub(low)));
        for (lamp, limits) in self.lamps.iter_mut().zip(&board.leds) {
            lamp.age = lamp.age.map(|age| age.saturating_add(low));
            if let Some(lit) = &mut lamp.lit {
                *lit = lit.saturating_add(high);
                let (_, cycle) = limits.at(lamp.level);
                let cost = u64::from(cycle.saturating_sub(1));
                lamp.owed = lamp.owed.saturating_add(high.saturating_mul(cost));
                if self.strict {
                    lamp.check(index, limits)?;
                }
            } else {
                lamp.owed = lamp.owed.saturating_sub(low);
            }
        }
        Ok(())
    }

    fn edge(&mut self, index: u16, mask: u32, value: u32, board: &Board) -> Result<(), Violation> {
        if let Some(quiet) = self.quiet
            && quiet < u64::from(MIN_STEP_TICKS)
        {
            return Err(violation(index, Rule::StepTooShort, int(quiet), i64::from(MIN_STEP_TICKS)));
        }
        self.quiet = Some(0);
        self.word = (self.word & !mask) | (value & mask);
        for ((led, lamp), limits) in (0u8..).zip(&mut self.lamps).zip(&board.leds) {
            let on = channels::led(led).is_some_and(|bit| self.word & bit != 0);
            match (on, lamp.lit) {
                (true, None) => {
                    if let Some(age) = lamp.age
                        && age < u64::from(limits.settle)
                    {
                        let settle = i64::from(limits.settle);
                        return Err(violation(index, Rule::LevelNotSettled, int(age), settle));
                    }
                    lamp.lit = Some(0);
                }
                (false, Some(_)) => {
                    lamp.check(index, limits)?;
                    lamp.lit = None;
                }
                _ => {}
            }
        }
        Ok(())
    }
}

impl Lamp {
    fn check(&self, index: u16, limits: &LedLimits) -> Result<(), Violation> {
        let (max_pulse, _) = limits.at(self.level);
        if let Some(lit) = self.lit
            && lit > u64::from(max_pulse)
        {
            return Err(violation(index, Rule::PulseTooLong, int(lit), i64::from(max_pulse)));
        }
        if self.owed > u64::from(limits.window) {
            return Err(violation(index, Rule::DutyExceeded, int(self.owed), i64::from(limits.window)));
        }
        Ok(())
    }
}
