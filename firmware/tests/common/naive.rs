//! A second player, written from docs/controller.md alone: it unrolls every loop, computes every
//! step from the closed formula, and finds broken rules by looking at what comes out.

use daic_firmware::Board;
use daic_protocol::message::{EventKind, Rule};
use daic_protocol::program::Instruction;
use std::collections::BTreeSet;

const F: u128 = 125_000_000;

/// What a program comes to.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct Run {
    pub words: Vec<(u64, u32)>,
    pub levels: Vec<(u64, u8, u16)>,
    pub events: Vec<(u64, EventKind)>,
    pub position: [i32; 6],
    /// Rules that were broken.
    pub broken: BTreeSet<String>,
}

/// Ticks of the steps of a move after its origin, from the formulas.
pub fn step_ticks(n: u128, v: u128, a: u128) -> Vec<u64> {
    let root = |j: u128| (2 * j * F * F / a).isqrt();
    let tick = |k: u128| {
        if v * v < a * n {
            let total = F * (n * a + v * v) / (a * v);
            if 2 * a * k <= v * v {
                root(k)
            } else if 2 * a * (n - k) <= v * v {
                total - root(n - k)
            } else {
                F * (2 * a * k + v * v) / (2 * a * v)
            }
        } else {
            let total = (4 * n * F * F / a).isqrt();
            if 2 * k <= n { root(k) } else { total - root(n - k) }
        }
    };
    (1..=n).map(|k| tick(k) as u64).collect()
}

struct Player<'a> {
    board: &'a Board,
    run: Run,
    now: u64,
    word: u32,
    last_word: Option<u64>,
    level_set: [Option<u64>; 8],
    lit_since: [Option<u64>; 8],
    stopped: bool,
}

impl Player<'_> {
    fn put(&mut self, tick: u64, word: u32) {
        if self.last_word.is_some_and(|last| tick - last < 4) {
            self.broke(Rule::StepTooShort);
        }
        self.last_word = Some(tick);
        self.run.words.push((tick, word));
        let changed = (self.word ^ word) & 0xf000_ffff;
        self.word = word;
        if changed != 0 {
            self.run.events.push((tick, EventKind::Edge { changed, word }));
        }
        for (i, limits) in self.board.leds.iter().enumerate() {
            let on = word >> i & 1 == 1;
            match (self.lit_since[i], on) {
                (None, true) => {
                    self.lit_since[i] = Some(tick);
                    if self.level_set[i].is_some_and(|set| tick - set < u64::from(limits.settle)) {
                        self.broke(Rule::LevelNotSettled);
                    }
                }
                (Some(since), false) => {
                    self.lit_since[i] = None;
                    if tick - since > u64::from(limits.max_pulse) {
                        self.broke(Rule::PulseTooLong);
                    }
                }
                _ => {}
            }
        }
    }

    fn broke(&mut self, rule: Rule) {
        self.run.broken.insert(format!("{rule:?}"));
    }

    fn play(&mut self, program: &[Instruction]) {
        let mut i = 0;
        while i < program.len() && !self.stopped {
            match program[i] {
                Instruction::Edge { mask, value, after } => {
                    self.now += u64::from(after);
                    self.put(self.now, self.word & !mask | value);
                }
                Instruction::Delay { ticks } => self.now += u64::from(ticks),
                Instruction::Settle { ticks } => {
                    self.now += u64::from(ticks);
                    self.run.events.push((self.now, EventKind::Settled));
                }
                Instruction::LoopBegin { count } => {
                    let mut depth = 0;
                    let length = program[i..]
                        .iter()
                        .position(|x| {
                            depth += match x {
                                Instruction::LoopBegin { .. } => 1,
                                Instruction::LoopEnd => -1,
                                _ => 0,
                            };
                            depth == 0
                        })
                        .unwrap();
                    for _ in 0..count {
                        let before = self.now;
                        self.play(&program[i + 1..i + length]);
                        if self.now == before && !self.stopped {
                            self.broke(Rule::EmptyLoop);
                        }
                    }
                    i += length;
                }
                Instruction::LoopEnd | Instruction::WaitTrigger { .. } => unreachable!(),
                Instruction::Move { axis, target, max_rate, acceleration, .. } => {
                    self.go(axis, target, max_rate, acceleration)
                }
                Instruction::Level { led, level } => {
                    self.run.levels.push((self.now, led, level));
                    self.run.events.push((self.now, EventKind::Level { led, level }));
                    self.level_set[usize::from(led)] = Some(self.now);
                    if self.lit_since[usize::from(led)].is_some() {
                        self.broke(Rule::LevelNotSettled);
                    }
                }
                Instruction::Mark { id } => self.run.events.push((self.now, EventKind::Mark { id })),
                Instruction::Stop => self.stopped = true,
            }
            i += 1;
        }
    }

    fn go(&mut self, axis: u8, target: i32, v: u32, a: u32) {
        let position = self.run.position[usize::from(axis)];
        self.run.events.push((self.now, EventKind::MoveStarted { axis, target }));
        let steps = position.abs_diff(target);
        if steps > 0 {
            let (step, direction) = (0x1_0000 << (2 * axis), 0x2_0000 << (2 * axis));
            let forward = target > position;
            self.put(self.now + 4, if forward { self.word | direction } else { self.word & !direction });
            let origin = self.now + 4 + 625;
            for t in step_ticks(steps.into(), v.into(), a.into()) {
                self.put(origin + t, self.word | step);
                self.put(origin + t + 250, self.word & !step);
                self.now = origin + t + 250;
            }
        }
        self.run.position[usize::from(axis)] = target;
        self.run.events.push((self.now, EventKind::MoveDone { axis, position: target }));
    }
}

/// Plays `program` from `start`; `run` and `hash` go into the events.
pub fn play(
    program: &[Instruction],
    board: &Board,
    start: u64,
    position: [i32; 6],
    run: u32,
    hash: u32,
) -> Run {
    let mut p = Player {
        board,
        run: Run { position, ..Run::default() },
        now: start,
        word: 0,
        last_word: None,
        level_set: [None; 8],
        lit_since: [None; 8],
        stopped: false,
    };
    p.run.events.push((start, EventKind::RunStarted { run, program: hash }));
    p.play(program);
    if p.word & 0xffff != 0 {
        p.broke(Rule::LeftOn);
    }
    let mut end = p.now;
    if p.word != 0 {
        end = end.max(p.last_word.unwrap() + 4);
        p.put(end, 0);
    }
    let mut levels = [0; 8];
    for &(_, led, level) in &p.run.levels {
        levels[usize::from(led)] = level;
    }
    for (led, level) in (0u8..).zip(levels) {
        if level != 0 {
            p.run.levels.push((end, led, 0));
            p.run.events.push((end, EventKind::Level { led, level: 0 }));
        }
    }
    let (words, events) = (p.run.words.len() as u32, p.run.events.len() as u32 + 1);
    p.run.events.push((end, EventKind::RunDone { run, words, events }));
    p.run
}
