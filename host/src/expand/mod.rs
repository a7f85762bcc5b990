//! What a program must put out, expanded on the host from `docs/controller.md` alone.
//!
//! It shares no code with the firmware: the difference between this and what was played is a check of
//! the box, and the picture of a program before it is run.

mod moves;

use daic_protocol::channels;
use daic_protocol::limits::MIN_STEP_TICKS;
use daic_protocol::program::{Instruction, Timeout};
use moves::Pace;

/// Word changes as (tick after the begin of the run, word), each differing from the one before; all
/// lines are low before the first.
pub type Edges = Vec<(u64, u32)>;

/// Ticks that a step line stays high.
const STEP_PULSE: u64 = 250;
/// Ticks from the end of the previous instruction to the direction word.
const DIRECTION_DELAY: u64 = 4;
/// Ticks from the direction word to the origin of the step times.
const DIRECTION_SETUP: u64 = 625;
const SPACING: u64 = MIN_STEP_TICKS as u64;

/// Longest program that is expanded, in words: beyond it nothing is drawn or compared.
pub const MAX_EDGES: usize = 50_000_000;
/// Most instructions that are gone through, every pass of every loop counted.
const MAX_INSTRUCTIONS: u64 = 1_000_000_000;

/// A program that cannot be expanded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ExpandError {
    /// More edges than [`MAX_EDGES`], or more passes of loops than anybody waits for.
    #[error(
        "instruction {instruction}: the program puts out more than {MAX_EDGES} edges, or plays more than {MAX_INSTRUCTIONS} instructions"
    )]
    TooLong {
        /// Where the limit was passed.
        instruction: usize,
    },
    /// A loop that does not close, an axis that does not exist, a rate of zero, a move that is not waited for.
    #[error("instruction {instruction} has no expansion: the box's verifier refuses it too")]
    Invalid {
        /// Which.
        instruction: usize,
    },
    /// Its end depends on an input.
    #[error("instruction {instruction} has no expansion: how long it takes depends on {on}")]
    DependsOnInput {
        /// Which.
        instruction: usize,
        /// On what.
        on: &'static str,
    },
}

/// How a wait for a trigger ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// Its trigger came at this tick after the begin of the run.
    Triggered(u64),
    /// None came in time.
    TimedOut,
}

/// What is assumed of waits for triggers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Waits<'a> {
    /// Nothing: a program with waits is refused.
    Unknown,
    /// Every trigger comes as soon as something waits for it.
    AtOnce,
    /// They ended so, in the order in which they were played.
    Ended(&'a [Answer]),
}

/// A change of some lines at a tick.
#[derive(Debug, Clone, Copy)]
struct Change {
    tick: u64,
    mask: u32,
    value: u32,
}

impl Change {
    fn of(self, word: u32) -> u32 {
        (word & !self.mask) | (self.value & self.mask)
    }
}

struct Expansion<'a> {
    now: u64,
    /// What the program puts out, and what its moves do, each in order of ticks.
    words: Vec<Change>,
    steps: Vec<Change>,
    position: [i32; 6],
    joined: Vec<(u8, i32)>,
    /// End of the move under way.
    going: Option<u64>,
    waits: Waits<'a>,
    waited: usize,
}

impl Expansion<'_> {
    fn edge(&mut self, mask: u32, value: u32, after: u32) {
        self.now = self.now.saturating_add(u64::from(after));
        self.words.push(Change { tick: self.now, mask, value });
    }

    /// Writes down a move of `axis` and of those that were joined to it; gives its end.
    fn travel(&mut self, axis: u8, target: i32, pace: Pace) -> Option<u64> {
        let mut axes = Vec::new();
        let mut directions = (0, 0);
        for (axis, target) in std::iter::once((axis, target)).chain(std::mem::take(&mut self.joined)) {
            let (step, direction) = (channels::step(axis)?, channels::direction(axis)?);
            let from = self.position.get_mut(usize::from(axis))?;
            let count = target.abs_diff(*from);
            if count > 0 {
                directions.0 |= direction;
                directions.1 |= if target > *from { direction } else { 0 };
            }
            *from = target;
            axes.push((step, u64::from(count)));
        }
        let most = axes.iter().map(|a| a.1).max()?;
        if pace.rate == 0 || pace.acceleration == 0 {
            return None;
        }
        if most == 0 {
            return Some(self.now);
        }
        let room = MAX_EDGES.saturating_sub(self.steps.len()) / 2;
        let (ticks, end) = moves::times(u32::try_from(most).ok()?, pace, room)?;
        let aimed = self.now + DIRECTION_DELAY;
        self.steps.push(Change { tick: aimed, mask: directions.0, value: directions.1 });
        let origin = aimed + DIRECTION_SETUP;
        for (k, t) in (1u64..).zip(ticks) {
            // steps of the other axes are spread over those of the one that has most
            let share = |k: u64, count: u64| (2 * k * count + most) / (2 * most);
            let lines = axes
                .iter()
                .filter(|&&(_, count)| share(k, count) > share(k - 1, count))
                .fold(0, |lines, &(step, _)| lines | step);
            self.steps.push(Change { tick: origin + t, mask: lines, value: lines });
            self.steps.push(Change { tick: origin + t + STEP_PULSE, mask: lines, value: 0 });
        }
        Some(origin + end + STEP_PULSE)
    }

    /// Whether the program goes on after a wait.
    fn wait(&mut self, delay: u32, timeout: u32, on_timeout: Timeout) -> Option<bool> {
        let answer = match self.waits {
            Waits::Unknown => None,
            Waits::AtOnce => Some(Answer::Triggered(self.now)),
            Waits::Ended(all) => all.get(self.waited).copied(),
        }?;
        self.waited += 1;
        Some(match answer {
            Answer::Triggered(tick) => {
                self.now = tick.saturating_add(u64::from(delay));
                true
            }
            Answer::TimedOut => {
                self.now = self.now.saturating_add(u64::from(timeout));
                if on_timeout == Timeout::Fault {
                    self.steps.retain(|step| step.tick < self.now);
                    return Some(false);
                }
                self.now = self.now.saturating_add(u64::from(delay));
                on_timeout == Timeout::Continue
            }
        })
    }

    /// Program and moves on one timeline: words of the program keep their ticks, words of a move make way.
    fn merged(self) -> Edges {
        let mut out = Edges::new();
        let (mut word, mut last) = (channels::SAFE_WORD, None::<u64>);
        let mut words = self.words.into_iter().peekable();
        let mut steps = self.steps.into_iter().peekable();
        loop {
            let earliest = last.map_or(0, |last| last + SPACING);
            let step = steps.peek().map(|change| change.tick.max(earliest));
            let tick = match (step, words.peek().map(|change| change.tick)) {
                (None, None) => break,
                (Some(step), None) => step,
                (Some(step), Some(edge)) if step + SPACING <= edge => step,
                (_, Some(edge)) => {
                    word = words.next().map_or(word, |change| change.of(word));
                    edge
                }
            };
            if step.is_some_and(|step| step <= tick) {
                word = steps.next().map_or(word, |change| change.of(word));
            }
            last = Some(tick);
            put(&mut out, tick, word);
        }
        if word != channels::SAFE_WORD {
            // a line that is still up falls a whole step after the last word
            put(&mut out, self.now.max(last.map_or(0, |last| last + SPACING)), channels::SAFE_WORD);
        }
        out
    }
}

/// Adds a word that changes something; of several at one tick the last counts.
fn put(edges: &mut Edges, tick: u64, word: u32) {
    if edges.last().is_some_and(|last| last.0 == tick) {
        edges.pop();
    }
    if edges.last().map_or(channels::SAFE_WORD, |last| last.1) != word {
        edges.push((tick, word));
    }
}

/// Expands a program that begins with all lines low and the axes at `position` (steps), and that waits for
/// no trigger.
///
/// # Errors
/// [`ExpandError`] names the instruction.
pub fn expand(program: &[Instruction], position: [i32; 6]) -> Result<Edges, ExpandError> {
    expand_with(program, position, Waits::Unknown)
}

/// The same, with what is known of the program's waits.
///
/// # Errors
/// [`ExpandError`] names the instruction.
pub fn expand_with(
    program: &[Instruction],
    position: [i32; 6],
    waits: Waits<'_>,
) -> Result<Edges, ExpandError> {
    let mut state = Expansion {
        now: 0,
        words: Vec::new(),
        steps: Vec::new(),
        position,
        joined: Vec::new(),
        going: None,
        waits,
        waited: 0,
    };
    let mut loops: Vec<(usize, u32)> = Vec::new();
    let (mut at, mut played) = (0, 0u64);
    while let Some(&instruction) = program.get(at) {
        played += 1;
        let invalid = ExpandError::Invalid { instruction: at };
        match instruction {
            Instruction::Edge { mask, value, after } => state.edge(mask, value, after),
            Instruction::Delay { ticks } | Instruction::Settle { ticks } => {
                state.now = state.now.saturating_add(u64::from(ticks));
            }
            Instruction::LoopBegin { count } => {
                if count == 0 {
                    return Err(invalid);
                }
                loops.push((at, count));
            }
            Instruction::LoopEnd => {
                let (begin, left) = loops.last_mut().ok_or(invalid)?;
                *left -= 1;
                if *left > 0 {
                    at = *begin;
                } else {
                    loops.pop();
                }
            }
            Instruction::Join { axis, target } => state.joined.push((axis, target)),
            Instruction::Move { axis, target, max_rate: rate, acceleration, jerk } => {
                let end = state.travel(axis, target, Pace { rate, acceleration, jerk });
                state.now = end.ok_or(invalid)?;
            }
            Instruction::Go { axis, target, max_rate: rate, acceleration, jerk } => {
                if state.going.is_some() {
                    return Err(invalid);
                }
                let end = state.travel(axis, target, Pace { rate, acceleration, jerk });
                state.going = Some(end.ok_or(invalid)?);
            }
            Instruction::Reach => state.now = state.now.max(state.going.take().ok_or(invalid)?),
            Instruction::Capture {
                axis,
                target,
                max_rate: rate,
                acceleration,
                jerk,
                settle,
                cameras,
                leds,
                lead,
                pulse,
                hold,
            } => {
                let end = state.travel(axis, target, Pace { rate, acceleration, jerk });
                state.now = end.ok_or(invalid)?.saturating_add(u64::from(settle));
                state.edge(cameras, cameras, 0);
                state.edge(leds, leds, lead);
                state.edge(leds, 0, pulse);
                state.edge(cameras, 0, hold);
            }
            Instruction::Wait { delay, timeout, on_timeout, .. } => {
                let on = "a trigger";
                let unknown = ExpandError::DependsOnInput { instruction: at, on };
                if !state.wait(delay, timeout, on_timeout).ok_or(unknown)? {
                    if on_timeout == Timeout::Stop
                        && let Some(end) = state.going
                    {
                        // the move is finished in the dark
                        state.words.push(Change { tick: state.now, mask: !channels::AXIS_MASK, value: 0 });
                        state.now = state.now.max(end);
                    }
                    break;
                }
            }
            Instruction::WaitTrigger { .. } => {
                let on = "a trigger and on the latency of the box; use Wait with a delay";
                return Err(ExpandError::DependsOnInput { instruction: at, on });
            }
            Instruction::Home { .. } => {
                let on = "where the home switch is";
                return Err(ExpandError::DependsOnInput { instruction: at, on });
            }
            Instruction::Level { .. }
            | Instruction::Mark { .. }
            | Instruction::Gate { .. }
            | Instruction::NoGate
            | Instruction::Policy(_) => {}
            Instruction::Stop => break,
        }
        if state.words.len() + state.steps.len() > MAX_EDGES || played > MAX_INSTRUCTIONS {
            return Err(ExpandError::TooLong { instruction: at });
        }
        at += 1;
    }
    Ok(state.merged())
}

/// Leaves out words that change nothing; of several at one tick the last counts.
pub fn changes(words: &[(u64, u32)]) -> Edges {
    let mut edges = Edges::new();
    for &(tick, word) in words {
        put(&mut edges, tick, word);
    }
    edges
}

/// Largest difference in ticks between two lists of edges that have the same words in the same order;
/// `None` if they have not.
pub fn largest_error(expected: &[(u64, u32)], played: &[(u64, u32)]) -> Option<u64> {
    if expected.len() != played.len() {
        return None;
    }
    expected
        .iter()
        .zip(played)
        .try_fold(0, |worst: u64, (e, p)| (e.1 == p.1).then(|| worst.max(e.0.abs_diff(p.0))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_tick_is_seen() {
        let program = [
            Instruction::LoopBegin { count: 3 },
            Instruction::Edge { mask: 1, value: 1, after: 100 },
            Instruction::Edge { mask: 1, value: 0, after: 10 },
            Instruction::LoopEnd,
        ];
        let expected = expand(&program, [0; 6]).expect("valid");
        assert_eq!(expected, [(100, 1), (110, 0), (210, 1), (220, 0), (320, 1), (330, 0)]);
        let mut played = expected.clone();
        assert_eq!(largest_error(&expected, &played), Some(0));
        played[3].0 += 1;
        assert_eq!(largest_error(&expected, &played), Some(1));
        played.pop();
        assert_eq!(largest_error(&expected, &played), None);
    }
}
