//! What a program must put out, expanded on the host from `docs/controller.md` alone.
//!
//! It shares no code with the firmware: the difference between this and what was played is a check of
//! the box, and the picture of a program before it is run.

use daic_protocol::channels;
use daic_protocol::limits::{MIN_STEP_TICKS, TICK_HZ};
use daic_protocol::program::Instruction;

/// Word changes as (tick after the begin of the run, word), each differing from the one before; all
/// lines are low before the first.
pub type Edges = Vec<(u64, u32)>;

/// Ticks that a step line stays high.
const STEP_PULSE: u64 = 250;
/// Ticks from the end of the previous instruction to the direction word.
const DIRECTION_DELAY: u64 = 4;
/// Ticks from the direction word to the origin of the step times.
const DIRECTION_SETUP: u64 = 625;

/// Longest program that is expanded, in word changes: beyond it nothing is drawn or compared.
pub const MAX_EDGES: usize = 50_000_000;

/// A program that cannot be expanded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ExpandError {
    /// More edges than [`MAX_EDGES`].
    #[error("instruction {instruction}: the program puts out more than {MAX_EDGES} edges")]
    TooLong {
        /// Where the limit was passed.
        instruction: usize,
    },
    /// A loop that does not close, an axis that does not exist, a rate of zero, an instruction without
    /// a fixed duration.
    #[error("instruction {instruction} has no expansion: the box's verifier refuses it too")]
    Invalid {
        /// Which.
        instruction: usize,
    },
}

struct Expansion {
    edges: Edges,
    now: u64,
    /// Tick of the last word, whether it changed anything or not.
    last: u64,
    word: u32,
    position: [i32; 6],
}

impl Expansion {
    fn put(&mut self, tick: u64, word: u32) {
        self.last = tick;
        if word != self.word {
            self.word = word;
            // an instruction may change the word again at the tick at which the last one ended
            match self.edges.last_mut() {
                Some(last) if last.0 == tick => last.1 = word,
                _ => self.edges.push((tick, word)),
            }
        }
    }

    fn advance(&mut self, ticks: u32) {
        self.now = self.now.saturating_add(u64::from(ticks));
    }

    fn travel(&mut self, axis: u8, target: i32, rate: u32, acceleration: u32) -> Option<()> {
        let (step, direction) = (channels::step(axis)?, channels::direction(axis)?);
        let from = self.position.get_mut(usize::from(axis))?;
        let (steps, positive) = (target.abs_diff(*from), target > *from);
        *from = target;
        if rate == 0 || acceleration == 0 {
            return None;
        }
        if steps == 0 {
            return Some(());
        }
        self.now += DIRECTION_DELAY;
        let aimed = if positive { self.word | direction } else { self.word & !direction };
        self.put(self.now, aimed);
        let origin = self.now + DIRECTION_SETUP;
        for k in 1..=steps {
            let at = origin + step_tick(k, steps, rate, acceleration);
            self.put(at, self.word | step);
            self.put(at + STEP_PULSE, self.word & !step);
            self.now = at + STEP_PULSE;
        }
        Some(())
    }
}

/// Tick of step `k` of `n`, after the origin of the move: the closed definition of
/// `docs/controller.md`.
fn step_tick(k: u32, n: u32, rate: u32, acceleration: u32) -> u64 {
    let [k, n, v, a, f] = [k, n, rate, acceleration, TICK_HZ].map(u128::from);
    let accelerated = |j: u128| (2 * j * f * f / a).isqrt();
    let tick = if v * v < a * n {
        if 2 * a * k <= v * v {
            accelerated(k)
        } else if 2 * a * (n - k) <= v * v {
            f * (n * a + v * v) / (a * v) - accelerated(n - k)
        } else {
            f * (2 * a * k + v * v) / (2 * a * v)
        }
    } else if 2 * k <= n {
        accelerated(k)
    } else {
        (4 * n * f * f / a).isqrt() - accelerated(n - k)
    };
    u64::try_from(tick).unwrap_or(u64::MAX)
}

/// Expands a program that begins with all lines low and the axes at `position` (steps).
///
/// # Errors
/// [`ExpandError`] names the instruction.
pub fn expand(program: &[Instruction], position: [i32; 6]) -> Result<Edges, ExpandError> {
    let mut state = Expansion { edges: Vec::new(), now: 0, last: 0, word: channels::SAFE_WORD, position };
    let mut loops: Vec<(usize, u32)> = Vec::new();
    let mut at = 0;
    while let Some(&instruction) = program.get(at) {
        let invalid = ExpandError::Invalid { instruction: at };
        match instruction {
            Instruction::Edge { mask, value, after } => {
                state.advance(after);
                state.put(state.now, (state.word & !mask) | (value & mask));
            }
            Instruction::Delay { ticks } | Instruction::Settle { ticks } => state.advance(ticks),
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
            Instruction::Move { axis, target, max_rate, acceleration, jerk: 0 } => {
                state.travel(axis, target, max_rate, acceleration).ok_or(invalid)?;
            }
            Instruction::Move { .. }
            | Instruction::WaitTrigger { .. }
            | Instruction::Wait { .. }
            | Instruction::Join { .. }
            | Instruction::Go { .. }
            | Instruction::Reach
            | Instruction::Home { .. }
            | Instruction::Capture { .. } => return Err(invalid),
            Instruction::Level { .. }
            | Instruction::Mark { .. }
            | Instruction::Gate { .. }
            | Instruction::NoGate
            | Instruction::Policy(_) => {}
            Instruction::Stop => break,
        }
        if state.edges.len() > MAX_EDGES {
            return Err(ExpandError::TooLong { instruction: at });
        }
        at += 1;
    }
    // a direction line that is still up falls a whole step after the last word
    let end = state.now.max(state.last + u64::from(MIN_STEP_TICKS));
    state.put(end, channels::SAFE_WORD);
    Ok(state.edges)
}

/// Leaves out words that change nothing; of several at one tick the last counts.
pub fn changes(words: &[(u64, u32)]) -> Edges {
    let mut all =
        Expansion { edges: Vec::new(), now: 0, last: 0, word: channels::SAFE_WORD, position: [0; 6] };
    for &(tick, word) in words {
        all.put(tick, word);
    }
    all.edges
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
    fn steps_follow_the_trapezoid_of_continuous_motion() {
        // x(t) for 1000 steps at 8000 steps/s and 100 000 steps/s²: 80 ms up over 320 steps, 45 ms of
        // cruise over 360 steps, 80 ms down
        let (n, v, a) = (1000u32, 8000u32, 100_000u32);
        let f = f64::from(TICK_HZ);
        for k in 1..=n {
            let x = f64::from(k);
            let seconds = if x <= 320.0 {
                (2.0 * x / f64::from(a)).sqrt()
            } else if x <= 680.0 {
                0.08 + (x - 320.0) / f64::from(v)
            } else {
                0.205 - (2.0 * (1000.0 - x) / f64::from(a)).sqrt()
            };
            let difference = step_tick(k, n, v, a) as f64 - seconds * f;
            assert!(difference.abs() <= 1.0, "step {k}: {difference} ticks");
        }
    }

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
