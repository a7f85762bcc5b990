//! The player: one program on one timeline.
//!
//! It does one thing after another, each at its tick, and never looks at more than the instruction
//! it is in; how often and how far it is asked to play cannot be told from what it puts out.

use crate::Sink;
use crate::motion::{DIR_DELAY, DIR_SETUP, Profile, STEP_PULSE, Steps};
use crate::outputs::Outputs;
use daic_protocol::channels;
use daic_protocol::limits::MAX_LOOP_DEPTH;
use daic_protocol::message::EventKind;
use daic_protocol::program::{Instruction, decode_instruction};

/// What playing up to some tick came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Progress {
    /// More to come, next at the tick given.
    Waiting(u64),
    /// The program has ended at the tick given: outputs can be made safe then, not before.
    Ended(u64),
    /// The program does something that the verifier should have refused.
    Broken,
}

#[derive(Debug, Clone, Copy)]
struct Loop {
    /// Where its body begins.
    offset: usize,
    index: u16,
    /// Passes still to come after this one.
    left: u32,
}

/// The instruction under way.
#[derive(Debug, Clone, Copy)]
enum Current {
    /// The next one is still to be read, at tick `now`.
    None,
    /// Nothing before this tick. True: to be reported as settled.
    Wait(u64, bool),
    /// This tick brings a new word.
    Edge {
        tick: u64,
        mask: u32,
        value: u32,
    },
    Move(Move),
    /// Outputs go safe at this tick.
    End(u64),
}

#[derive(Debug, Clone, Copy)]
struct Move {
    axis: u8,
    positive: bool,
    /// Step times count from here.
    origin: u64,
    steps: Steps,
    next: Line,
}

/// What a move does next, and when.
#[derive(Debug, Clone, Copy)]
enum Line {
    Direction(u64),
    Rise(u64),
    Fall(u64),
}

/// Where a program has got to.
#[derive(Debug, Clone)]
pub(crate) struct Player {
    /// End of the last instruction.
    now: u64,
    /// Byte after the current instruction.
    offset: usize,
    /// Index of the current instruction, and of the next to be read.
    index: u16,
    next: u16,
    loops: heapless::Vec<Loop, MAX_LOOP_DEPTH>,
    current: Current,
    /// End after the instruction that is current at this tick.
    stopping: Option<u64>,
}

impl Player {
    /// A player whose first instruction begins at `start`.
    pub(crate) const fn new(start: u64) -> Self {
        Self {
            now: start,
            offset: 0,
            index: 0,
            next: 0,
            loops: heapless::Vec::new(),
            current: Current::None,
            stopping: None,
        }
    }

    pub(crate) fn index(&self) -> u16 {
        self.index
    }

    /// Ends after the instruction that is current at tick `from`.
    pub(crate) fn stop(&mut self, from: u64) {
        self.stopping.get_or_insert(from);
    }

    pub(crate) fn stop_from(&self) -> Option<u64> {
        self.stopping
    }

    /// Tick of the next thing to be done.
    pub(crate) fn due(&self) -> u64 {
        match self.current {
            Current::None => self.now,
            Current::Wait(tick, _) | Current::Edge { tick, .. } | Current::End(tick) => tick,
            Current::Move(m) => match m.next {
                Line::Direction(t) | Line::Rise(t) | Line::Fall(t) => t,
            },
        }
    }

    /// Does everything due up to and including `until`.
    pub(crate) fn play(
        &mut self,
        until: u64,
        program: &[u8],
        out: &mut Outputs,
        sink: &mut dyn Sink,
    ) -> Progress {
        loop {
            let tick = self.due();
            if tick > until {
                return Progress::Waiting(tick);
            }
            match self.current {
                Current::None => {
                    if self.stopping.is_some_and(|from| tick >= from) {
                        self.current = Current::End(out.earliest_safe(tick));
                    } else if self.read(tick, program, out, sink).is_none() {
                        return Progress::Broken;
                    }
                }
                Current::Wait(_, settle) => {
                    if settle {
                        out.note(tick, EventKind::Settled);
                    }
                    self.finish(tick);
                }
                Current::Edge { mask, value, .. } => {
                    out.put(tick, (out.word & !mask) | (value & mask), sink);
                    self.finish(tick);
                }
                Current::Move(m) => {
                    if self.advance(tick, m, out, sink).is_none() {
                        return Progress::Broken;
                    }
                }
                Current::End(_) => return Progress::Ended(tick),
            }
        }
    }

    fn finish(&mut self, tick: u64) {
        self.now = tick;
        self.current = Current::None;
    }

    /// Reads the next instruction and begins it at `tick`. `None`: the program is broken.
    fn read(&mut self, tick: u64, program: &[u8], out: &mut Outputs, sink: &mut dyn Sink) -> Option<()> {
        let rest = program.get(self.offset..)?;
        if rest.is_empty() {
            self.current = Current::End(out.earliest_safe(tick));
            return Some(());
        }
        let (instruction, length) = decode_instruction(rest).ok()?;
        self.index = self.next;
        self.next = self.index.checked_add(1)?;
        self.offset = self.offset.checked_add(length)?;
        match instruction {
            Instruction::Edge { mask, value, after } => {
                self.current = Current::Edge { tick: tick.checked_add(u64::from(after))?, mask, value };
            }
            Instruction::Delay { ticks } => {
                self.current = Current::Wait(tick.checked_add(u64::from(ticks))?, false);
            }
            Instruction::Settle { ticks } => {
                self.current = Current::Wait(tick.checked_add(u64::from(ticks))?, true);
            }
            Instruction::LoopBegin { count } => {
                let left = count.checked_sub(1)?;
                self.loops.push(Loop { offset: self.offset, index: self.next, left }).ok()?;
            }
            Instruction::LoopEnd => {
                let last = self.loops.last_mut()?;
                if let Some(left) = last.left.checked_sub(1) {
                    last.left = left;
                    (self.offset, self.next) = (last.offset, last.index);
                } else {
                    self.loops.pop();
                }
            }
            Instruction::Move { axis, target, max_rate, acceleration, jerk: 0 } => {
                let from = out.axis(axis);
                out.note(tick, EventKind::MoveStarted { axis, target });
                let profile = Profile::new(from.abs_diff(target), max_rate, acceleration);
                if profile.steps() == 0 {
                    out.note(tick, EventKind::MoveDone { axis, position: from });
                } else {
                    let direction = tick.checked_add(DIR_DELAY)?;
                    self.current = Current::Move(Move {
                        axis,
                        positive: target > from,
                        origin: direction.checked_add(DIR_SETUP)?,
                        steps: Steps::new(profile),
                        next: Line::Direction(direction),
                    });
                }
            }
            Instruction::Level { led, level } => out.set_level(tick, led, level, sink),
            Instruction::Mark { id } => out.note(tick, EventKind::Mark { id }),
            Instruction::Stop => self.current = Current::End(out.earliest_safe(tick)),
            Instruction::WaitTrigger { .. } | Instruction::Move { .. } => return None,
        }
        Some(())
    }

    fn advance(&mut self, tick: u64, mut m: Move, out: &mut Outputs, sink: &mut dyn Sink) -> Option<()> {
        let step = channels::step(m.axis)?;
        match m.next {
            Line::Direction(_) => {
                let line = channels::direction(m.axis)?;
                let word = if m.positive { out.word | line } else { out.word & !line };
                out.put(tick, word, sink);
            }
            Line::Rise(_) => {
                out.step(m.axis, if m.positive { 1 } else { -1 });
                out.put(tick, out.word | step, sink);
                m.next = Line::Fall(tick.checked_add(STEP_PULSE)?);
                self.current = Current::Move(m);
                return Some(());
            }
            Line::Fall(_) => out.put(tick, out.word & !step, sink),
        }
        // After the direction word and after each falling edge: the next step, or the end.
        if let Some(offset) = m.steps.next() {
            m.next = Line::Rise(m.origin.checked_add(offset)?);
            self.current = Current::Move(m);
        } else {
            let position = out.axis(m.axis);
            out.note(tick, EventKind::MoveDone { axis: m.axis, position });
            self.finish(tick);
        }
        Some(())
    }
}
