//! A second player, written from docs/controller.md alone: it unrolls every loop, computes every
//! step from the closed formula, and finds broken rules by looking at what comes out.

use daic_firmware::Board;
use daic_protocol::message::{EventKind, Rule};
use daic_protocol::program::{Instruction, Timeout, TriggerEdge};
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
    /// Ended by a time-out that is a fault, at this tick.
    pub faulted: Option<u64>,
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

/// Slices of an S-curve: q, p, M and s, by trying one after the other.
pub fn slices(n: u128, v: u128, a: u128, j: u128) -> (u128, u128, u128, u32) {
    for s in 8.. {
        let up = |x: u128, y: u128| x.div_ceil(y).max(1);
        let m0 = up(n * F, v << s);
        let pa = up(n * F * F, a << (2 * s));
        let pj = up(n * F * F * F, j << (3 * s));
        for m in m0..=2048 {
            let q2 = pj.div_ceil(m);
            let root = (q2.isqrt()..).find(|r| r * r >= q2).unwrap();
            let p = pa.div_ceil(m).max(root);
            let q = pj.div_ceil(m * p).max(1).min(p);
            if p + q <= m {
                if p + q + m <= 2048 {
                    return (q, p, m, s);
                }
                break;
            }
        }
    }
    unreachable!()
}

/// Ticks of the steps of an S-curve after its origin and its length, from convolved boxes.
pub fn s_curve_ticks(n: u128, v: u128, a: u128, j: u128) -> (Vec<u64>, u64) {
    if n == 0 {
        return (Vec::new(), 0);
    }
    let (q, p, m, s) = slices(n, v, a, j);
    // Value i of the convolution with a box is the sum of the box's length of values up to i.
    let convolve = |x: &[u128], len: u128| {
        let mut sum = 0;
        let mut out = Vec::new();
        for i in 0..x.len() + len as usize - 1 {
            sum += x.get(i).copied().unwrap_or(0);
            if let Some(left) = i.checked_sub(len as usize) {
                sum -= x.get(left).copied().unwrap_or(0);
            }
            out.push(sum);
        }
        out
    };
    let w = convolve(&convolve(&vec![1; q as usize], p), m);
    let mut sums = vec![0];
    for x in &w {
        sums.push(sums.last().unwrap() + x);
    }
    assert_eq!(*sums.last().unwrap(), q * p * m);
    let tick = |k: u128| {
        let wanted = (2 * k - 1) * q * p * m;
        let i = (0..w.len()).rev().find(|&i| 2 * n * sums[i] < wanted).unwrap();
        ((i as u128) << s) + ((wanted - 2 * n * sums[i]) << s) / (2 * n * w[i])
    };
    ((1..=n).map(|k| tick(k) as u64).collect(), (w.len() as u64) << s)
}

/// A change of lines at a tick.
type Change = (u64, u32, u32);

struct Player<'a> {
    board: &'a Board,
    run: Run,
    now: u64,
    /// What the program puts out, and what moves do.
    words: Vec<Change>,
    steps: Vec<Change>,
    /// Places in `events` of the edges in `words`.
    edges: Vec<usize>,
    word: u32,
    last_word: Option<u64>,
    joined: Vec<(u8, i32)>,
    going: Option<(u64, Vec<u8>)>,
    level: [u16; 8],
    level_set: [Option<u64>; 8],
    lit_since: [Option<u64>; 8],
    owed: [(u64, u64); 8],
    /// Trigger input changes: tick and word, ascending.
    inputs: &'a [(u64, u32)],
    missed: [u32; 8],
    stopped: bool,
}

impl Player<'_> {
    fn put(&mut self, tick: u64, mask: u32, value: u32) {
        if self.last_word.is_some_and(|last| tick - last < 4) {
            self.broke(Rule::StepTooShort);
        }
        self.last_word = Some(tick);
        self.words.push((tick, mask, value));
        let word = self.word & !mask | value;
        let changed = self.word ^ word;
        self.word = word;
        self.edges.push(self.run.events.len());
        self.run.events.push((tick, EventKind::Edge { changed, word }));
        self.light(tick);
    }

    fn light(&mut self, tick: u64) {
        for (i, limits) in self.board.leds.iter().enumerate() {
            let on = self.word >> i & 1 == 1;
            let (mut max_pulse, mut cycle) = (u64::from(limits.max_pulse), 1);
            for row in limits.overdrive.iter().filter(|row| self.level[i] > row.above) {
                max_pulse = max_pulse.min(u64::from(row.max_pulse));
                cycle = cycle.max(u64::from(row.cycle));
            }
            match (self.lit_since[i], on) {
                (None, true) => {
                    self.lit_since[i] = Some(tick);
                    let (owed, at) = self.owed[i];
                    self.owed[i] = (owed.saturating_sub(tick - at), tick);
                    if self.level_set[i].is_some_and(|set| tick - set < u64::from(limits.settle)) {
                        self.broke(Rule::LevelNotSettled);
                    }
                }
                (Some(since), false) => {
                    self.lit_since[i] = None;
                    let owed = self.owed[i].0 + (tick - since) * (cycle - 1);
                    self.owed[i] = (owed, tick);
                    if tick - since > max_pulse {
                        self.broke(Rule::PulseTooLong);
                    }
                    if owed > u64::from(limits.window) {
                        self.broke(Rule::DutyExceeded);
                    }
                }
                _ => {}
            }
        }
    }

    fn broke(&mut self, rule: Rule) {
        self.run.broken.insert(format!("{rule:?}"));
    }

    fn event(&mut self, kind: EventKind) {
        self.run.events.push((self.now, kind));
    }

    fn play(&mut self, program: &[Instruction]) {
        let mut i = 0;
        while i < program.len() && !self.stopped {
            match program[i] {
                Instruction::Edge { mask, value, after } => {
                    self.now += u64::from(after);
                    self.put(self.now, mask, value);
                }
                Instruction::Delay { ticks } => self.now += u64::from(ticks),
                Instruction::Settle { ticks } => {
                    self.now += u64::from(ticks);
                    self.event(EventKind::Settled);
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
                Instruction::LoopEnd | Instruction::Home { .. } => unreachable!(),
                Instruction::Move { axis, target, max_rate, acceleration, jerk } => {
                    self.blocking(axis, target, max_rate, acceleration, jerk);
                }
                Instruction::Go { axis, target, max_rate, acceleration, jerk } => {
                    let (end, axes, _) = self.go(axis, target, max_rate, acceleration, jerk);
                    self.going = Some((end, axes));
                }
                Instruction::Reach => {
                    let (end, axes) = self.going.take().unwrap();
                    self.now = self.now.max(end);
                    self.arrive(&axes);
                }
                Instruction::Join { axis, target } => self.joined.push((axis, target)),
                Instruction::Capture {
                    axis,
                    target,
                    max_rate,
                    acceleration,
                    jerk,
                    settle,
                    cameras,
                    leds,
                    lead,
                    pulse,
                    hold,
                } => {
                    self.blocking(axis, target, max_rate, acceleration, jerk);
                    self.now += u64::from(settle);
                    self.event(EventKind::Settled);
                    for (mask, value, after) in
                        [(cameras, cameras, 0), (leds, leds, lead), (leds, 0, pulse), (cameras, 0, hold)]
                    {
                        self.now += u64::from(after);
                        self.put(self.now, mask, value);
                    }
                }
                Instruction::Level { led, level } => {
                    self.run.levels.push((self.now, led, level));
                    self.event(EventKind::Level { led, level });
                    self.level[usize::from(led)] = level;
                    self.level_set[usize::from(led)] = Some(self.now);
                    if self.lit_since[usize::from(led)].is_some() {
                        self.broke(Rule::LevelNotSettled);
                    }
                }
                Instruction::Mark { id } => self.event(EventKind::Mark { id }),
                Instruction::WaitTrigger { input, edge, skip, timeout } => {
                    let latency = self.board.input_latency;
                    self.wait(input, edge == TriggerEdge::Rising, skip, latency, timeout, Timeout::Fault);
                }
                Instruction::Wait { .. }
                | Instruction::Gate { .. }
                | Instruction::NoGate
                | Instruction::Policy(_) => unreachable!("tested elsewhere"),
                Instruction::Stop => {
                    if !self.joined.is_empty() {
                        self.broke(Rule::BadJoin);
                    }
                    if self.going.is_some() {
                        self.broke(Rule::MoveNotEnded);
                    }
                    self.stopped = true;
                }
            }
            i += 1;
        }
    }

    fn wait(&mut self, input: u8, rising: bool, skip: u32, delay: u32, timeout: u32, on_timeout: Timeout) {
        let deadline = if timeout == 0 { u64::MAX } else { self.now + u64::from(timeout) };
        let mut left = skip;
        let mut before = 0;
        for &(tick, word) in self.inputs {
            let (was, is) = (before >> input & 1 == 1, word >> input & 1 == 1);
            before = word;
            if tick < self.now || tick > deadline || was == is || is != rising {
                continue;
            }
            if left > 0 {
                left -= 1;
                continue;
            }
            let missed = self.missed[usize::from(input)];
            self.run.events.push((tick, EventKind::Triggered { input, missed }));
            self.now = tick + u64::from(delay);
            return;
        }
        self.now = deadline;
        self.event(EventKind::TimedOut { input });
        if on_timeout == Timeout::Fault {
            (self.run.faulted, self.stopped) = (Some(deadline), true);
        } else {
            self.now = deadline + u64::from(delay);
        }
    }

    fn blocking(&mut self, axis: u8, target: i32, v: u32, a: u32, j: u32) {
        let (end, axes, moves) = self.go(axis, target, v, a, j);
        self.now = end;
        if moves {
            self.last_word = Some(end);
        }
        self.arrive(&axes);
    }

    fn arrive(&mut self, axes: &[u8]) {
        for &axis in axes {
            let position = self.run.position[usize::from(axis)];
            self.event(EventKind::MoveDone { axis, position });
        }
    }

    /// Writes down the steps of a move; returns its end, its axes, and whether there are steps.
    fn go(&mut self, axis: u8, target: i32, v: u32, a: u32, j: u32) -> (u64, Vec<u8>, bool) {
        let mut all = vec![(axis, target)];
        all.append(&mut self.joined);
        for &(axis, target) in &all {
            self.event(EventKind::MoveStarted { axis, target });
        }
        let counts: Vec<u32> =
            all.iter().map(|&(axis, t)| self.run.position[usize::from(axis)].abs_diff(t)).collect();
        let n = *counts.iter().max().unwrap();
        let mut end = self.now;
        if n > 0 {
            let mut directions = (0, 0);
            for (&(axis, target), &count) in all.iter().zip(&counts) {
                if count > 0 {
                    let line = 0x2_0000 << (2 * axis);
                    directions.0 |= line;
                    if target > self.run.position[usize::from(axis)] {
                        directions.1 |= line;
                    }
                }
            }
            self.steps.push((self.now + 4, directions.0, directions.1));
            let origin = self.now + 4 + 625;
            let ticks = if j == 0 {
                let ticks = step_ticks(n.into(), v.into(), a.into());
                end = origin + ticks.last().unwrap() + 250;
                ticks
            } else {
                let (ticks, length) = s_curve_ticks(n.into(), v.into(), a.into(), j.into());
                end = origin + length + 250;
                ticks
            };
            // Step k of the axis with most steps carries one of another axis where that one's share
            // passes a half.
            let share = |k: u64, count: u32| (2 * k * u64::from(count) + u64::from(n)) / (2 * u64::from(n));
            for (k, t) in (1..).zip(ticks) {
                let mut lines = 0;
                for (&(axis, _), &count) in all.iter().zip(&counts) {
                    if share(k, count) > share(k - 1, count) {
                        lines |= 0x1_0000 << (2 * axis);
                    }
                }
                self.steps.push((origin + t, lines, lines));
                self.steps.push((origin + t + 250, lines, 0));
            }
        }
        for &(axis, target) in &all {
            self.run.position[usize::from(axis)] = target;
        }
        (end, all.iter().map(|(axis, _)| *axis).collect(), n > 0)
    }

    /// Puts the words of program and moves on one timeline.
    fn merge(&mut self) {
        let (mut word, mut last) = (0u32, None::<u64>);
        let (mut p, mut s) = (0, 0);
        let mut out: Vec<(u64, u32)> = Vec::new();
        let mut edge_words = Vec::new();
        while p < self.words.len() || s < self.steps.len() {
            let step = self.steps.get(s).map(|c| c.0.max(last.map_or(0, |l| l + 4)));
            let edge = self.words.get(p).map(|c| c.0);
            let alone = match (step, edge) {
                (Some(t), Some(e)) => t + 4 <= e,
                (step, _) => step.is_some(),
            };
            let tick;
            if alone {
                tick = step.unwrap();
                word = word & !self.steps[s].1 | self.steps[s].2;
                s += 1;
            } else {
                tick = edge.unwrap();
                let before = word;
                word = word & !self.words[p].1 | self.words[p].2;
                let lines = word;
                if step.is_some_and(|t| t <= tick) {
                    word = word & !self.steps[s].1 | self.steps[s].2;
                    s += 1;
                }
                p += 1;
                edge_words.push(((before ^ lines) & 0xf000_ffff, word));
            }
            last = Some(tick);
            out.push((tick, word));
        }
        for (&at, &(changed, word)) in self.edges.iter().zip(&edge_words) {
            self.run.events[at].1 = EventKind::Edge { changed, word };
        }
        self.run.events.retain(|(_, kind)| !matches!(kind, EventKind::Edge { changed: 0, .. }));
        (self.run.words, self.word, self.last_word) = (out, word, last);
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
    play_with(program, board, start, position, run, hash, &[])
}

/// The same with inputs that change: tick and word, ascending.
pub fn play_with(
    program: &[Instruction],
    board: &Board,
    start: u64,
    position: [i32; 6],
    run: u32,
    hash: u32,
    inputs: &[(u64, u32)],
) -> Run {
    let mut p = Player {
        board,
        run: Run { position, ..Run::default() },
        now: start,
        words: Vec::new(),
        steps: Vec::new(),
        edges: Vec::new(),
        word: 0,
        last_word: None,
        joined: Vec::new(),
        going: None,
        level: [0; 8],
        level_set: [None; 8],
        lit_since: [None; 8],
        owed: [(0, start); 8],
        inputs,
        missed: [0; 8],
        stopped: false,
    };
    p.run.events.push((start, EventKind::RunStarted { run, program: hash }));
    p.play(program);
    if p.word & 0xffff != 0 {
        p.broke(Rule::LeftOn);
        // A light that is left on owes what it owes.
        let (now, lit) = (p.now, p.word & 0xff);
        p.word &= !lit;
        p.light(now);
        p.word |= lit;
    }
    p.merge();
    let mut end = p.now;
    if p.word != 0 {
        end = end.max(p.last_word.unwrap() + 4);
        let changed = p.word & 0xf000_ffff;
        p.run.words.push((end, 0));
        if changed != 0 {
            p.run.events.push((end, EventKind::Edge { changed, word: 0 }));
        }
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
