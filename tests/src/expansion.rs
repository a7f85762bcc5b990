//! An expansion of programs that shares no code with firmware or host: the program as a tree, step
//! times by bisection of the inequality that defines them. Written from `docs/controller.md`.

use daic_protocol::program::Instruction;

enum Node {
    Leaf(Instruction),
    Repeat(u32, Vec<Node>),
}

fn tree(program: &mut std::slice::Iter<'_, Instruction>) -> Vec<Node> {
    let mut nodes = Vec::new();
    while let Some(instruction) = program.next() {
        match instruction {
            Instruction::LoopBegin { count } => nodes.push(Node::Repeat(*count, tree(program))),
            Instruction::LoopEnd => break,
            other => nodes.push(Node::Leaf(*other)),
        }
    }
    nodes
}

/// Largest t < 2⁴⁸ (26 days) with t² · a ≤ 2 · j · f²: ⌊√(2 j f²/a)⌋ without a root.
fn ramp(j: u64, a: u64) -> u64 {
    let f = 125_000_000u128;
    let bound = 2 * u128::from(j) * f * f;
    let (mut low, mut high) = (0u128, 1u128 << 48);
    while low < high {
        let middle = (low + high).div_ceil(2);
        if middle * middle * u128::from(a) <= bound { low = middle } else { high = middle - 1 }
    }
    low as u64
}

fn step_times(n: u64, v: u64, a: u64) -> Vec<u64> {
    let f = 125_000_000u128;
    let (v2, an) = (u128::from(v) * u128::from(v), u128::from(a) * u128::from(n));
    // a triangle of n steps lasts twice as long as it takes to speed up over half of them
    let total =
        if v2 < an { (f * (an + v2) / (u128::from(a) * u128::from(v))) as u64 } else { ramp(2 * n, a) };
    (1..=n)
        .map(|k| {
            let (done, left) = (u128::from(a * 2 * k), u128::from(a * 2 * (n - k)));
            let (rising, falling) = if v2 < an { (done <= v2, left <= v2) } else { (2 * k <= n, 2 * k > n) };
            if rising {
                ramp(k, a)
            } else if falling {
                total - ramp(n - k, a)
            } else {
                (f * (done + v2) / (2 * u128::from(a) * u128::from(v))) as u64
            }
        })
        .collect()
}

#[derive(Default)]
struct Lines {
    now: u64,
    word: u32,
    position: [i64; 6],
    changes: Vec<(u64, u32)>,
    stopped: bool,
}

impl Lines {
    fn set(&mut self, tick: u64, word: u32) {
        self.word = word;
        self.changes.push((tick, word));
    }

    fn play(&mut self, nodes: &[Node]) {
        for node in nodes {
            if self.stopped {
                return;
            }
            match node {
                Node::Repeat(count, body) => (0..*count).for_each(|_| self.play(body)),
                Node::Leaf(Instruction::Edge { mask, value, after }) => {
                    self.now += u64::from(*after);
                    self.set(self.now, self.word & !mask | value & mask);
                }
                Node::Leaf(Instruction::Delay { ticks } | Instruction::Settle { ticks }) => {
                    self.now += u64::from(*ticks);
                }
                Node::Leaf(Instruction::Move { axis, target, max_rate, acceleration, jerk }) => {
                    assert_eq!(*jerk, 0, "no definition for jerk-limited moves");
                    self.travel(
                        usize::from(*axis),
                        i64::from(*target),
                        u64::from(*max_rate),
                        u64::from(*acceleration),
                    );
                }
                Node::Leaf(Instruction::Stop) => self.stopped = true,
                Node::Leaf(_) => {}
            }
        }
    }

    fn travel(&mut self, axis: usize, target: i64, rate: u64, acceleration: u64) {
        let distance = target - self.position[axis];
        self.position[axis] = target;
        if distance == 0 {
            return;
        }
        let (step, direction) = (1u32 << (16 + 2 * axis), 1u32 << (17 + 2 * axis));
        self.now += 4;
        self.set(self.now, if distance > 0 { self.word | direction } else { self.word & !direction });
        let origin = self.now + 625;
        for t in step_times(distance.unsigned_abs(), rate, acceleration) {
            self.set(origin + t, self.word | step);
            self.set(origin + t + 250, self.word & !step);
            self.now = origin + t + 250;
        }
    }
}

/// Changes of the output word as (tick after the begin of the run, word).
pub fn expand(program: &[Instruction]) -> Vec<(u64, u32)> {
    let mut lines = Lines::default();
    lines.play(&tree(&mut program.iter()));
    let last = lines.changes.last().map_or(0, |change| change.0);
    lines.set(lines.now.max(last + 4), 0);
    changes_only(&lines.changes)
}

/// Leaves out words that change nothing and keeps the last of several at one tick.
pub fn changes_only(words: &[(u64, u32)]) -> Vec<(u64, u32)> {
    let mut last_of_tick: Vec<(u64, u32)> = Vec::new();
    for &(tick, word) in words {
        match last_of_tick.last_mut() {
            Some(last) if last.0 == tick => last.1 = word,
            _ => last_of_tick.push((tick, word)),
        }
    }
    let mut before = 0;
    last_of_tick.retain(|&(_, word)| std::mem::replace(&mut before, word) != word);
    last_of_tick
}
