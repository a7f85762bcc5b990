//! Axes that move together.

use crate::motion::{DIR_DELAY, DIR_SETUP, Profile, STEP_PULSE, Steps};
use crate::outputs::{AXES, Outputs};
use daic_protocol::channels;
use daic_protocol::message::EventKind;

/// Where an axis goes.
pub(crate) type Target = (u8, i32);

/// How fast.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pace {
    pub(crate) rate: u32,
    pub(crate) acceleration: u32,
    pub(crate) jerk: u32,
}

/// One axis of a move. Its steps are spread evenly over those of the axis that has most.
#[derive(Debug, Clone, Copy)]
struct Axis {
    axis: u8,
    positive: bool,
    steps: u32,
    /// Twice the steps due, modulo twice those of the axis that has most.
    due: i64,
}

/// What a move does next, and when.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Line {
    Direction(u64),
    Rise(u64),
    Fall(u64),
    Done,
}

/// A move under way.
#[derive(Debug, Clone)]
pub(crate) struct Motion {
    axes: heapless::Vec<Axis, AXES>,
    /// Steps of the axis that has most.
    most: u32,
    origin: u64,
    steps: Steps,
    next: Line,
    /// Step lines that are up.
    up: u32,
    /// Planned end.
    end: u64,
}

impl Motion {
    /// Plans a move that begins at `tick`; `None` without steps.
    pub(crate) fn plan(tick: u64, targets: &[Target], pace: Pace, out: &Outputs) -> Option<Option<Self>> {
        let mut axes = heapless::Vec::new();
        for &(axis, target) in targets {
            let from = out.axis(axis);
            let moving = Axis { axis, positive: target > from, steps: from.abs_diff(target), due: 0 };
            axes.push(moving).ok()?;
        }
        let most = axes.iter().map(|a| a.steps).max().unwrap_or(0);
        if most == 0 {
            return Some(None);
        }
        let profile = Profile::new(most, pace.rate, pace.acceleration, pace.jerk);
        let direction = tick.checked_add(DIR_DELAY)?;
        Some(Some(Self {
            axes,
            most,
            origin: direction.checked_add(DIR_SETUP)?,
            steps: Steps::new(profile),
            next: Line::Direction(direction),
            up: 0,
            end: tick.checked_add(profile.duration())?,
        }))
    }

    /// Planned tick of the next word; `None` when all are out.
    pub(crate) fn due(&self) -> Option<u64> {
        match self.next {
            Line::Direction(t) | Line::Rise(t) | Line::Fall(t) => Some(t),
            Line::Done => None,
        }
    }

    pub(crate) fn end(&self) -> u64 {
        self.end
    }

    /// An axis that moves towards a limit switch that is pressed.
    pub(crate) fn blocked(&self, out: &Outputs) -> Option<u8> {
        let moving = |a: &&Axis| a.steps > 0 && self.next != Line::Done;
        self.axes.iter().filter(moving).find(|a| out.inputs.at_limit(a.axis, a.positive)).map(|a| a.axis)
    }

    /// The axes take part in it, moving or not.
    pub(crate) fn axes(&self) -> impl Iterator<Item = u8> + '_ {
        self.axes.iter().filter(|a| a.steps > 0).map(|a| a.axis)
    }

    /// Makes the next change in `word`. `None`: the plan is broken.
    pub(crate) fn advance(&mut self, word: u32, out: &mut Outputs) -> Option<u32> {
        let mut word = word;
        match self.next {
            Line::Direction(_) => {
                for a in self.axes.iter().filter(|a| a.steps > 0) {
                    let line = channels::direction(a.axis)?;
                    word = if a.positive { word | line } else { word & !line };
                }
            }
            Line::Rise(planned) => {
                let most = i64::from(self.most);
                for a in &mut self.axes {
                    a.due = a.due.checked_add(i64::from(a.steps).checked_mul(2)?)?;
                    if a.due >= most {
                        a.due = a.due.checked_sub(most.checked_mul(2)?)?;
                        out.step(a.axis, a.positive);
                        self.up |= channels::step(a.axis)?;
                    }
                }
                word |= self.up;
                self.next = Line::Fall(planned.checked_add(STEP_PULSE)?);
                return Some(word);
            }
            Line::Fall(_) => {
                word &= !self.up;
                self.up = 0;
            }
            Line::Done => return None,
        }
        // After the direction word and after each falling edge: the next step, or the end.
        self.next = match self.steps.next() {
            Some(offset) => Line::Rise(self.origin.checked_add(offset)?),
            None => Line::Done,
        };
        Some(word)
    }

    /// Tells that it has ended.
    pub(crate) fn report(tick: u64, targets: &[Target], out: &mut Outputs) {
        for &(axis, _) in targets {
            let position = out.axis(axis);
            out.note(tick, EventKind::MoveDone { axis, position });
        }
    }
}
