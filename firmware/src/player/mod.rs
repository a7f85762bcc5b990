//! The player: one program on one timeline.
//!
//! It does one thing after another, each at its tick. A move begun by `Go` runs beside the program: the
//! program's words keep their ticks, those of the move make way by a few ticks (see [`Player::play`]).
//! How often and how far it is asked to play cannot be told from what it puts out.

mod homing;
mod motion;
mod trigger;

use homing::{Found, Search};
pub(crate) use homing::{SHORTEST as SHORTEST_HOMING, longest as longest_homing, unhomed};
use motion::{Motion, Pace, Target};
use trigger::{Gate, Wait, is_open};

use crate::Sink;
use crate::board::Board;
use crate::motion::DIR_DELAY;
use crate::outputs::{AXES, Outputs};
use crate::stream::{Fetched, Source};
use daic_protocol::channels::{self, AXIS_MASK, LED_MASK, LIMIT_MASK};
use daic_protocol::limits::{MAX_LOOP_DEPTH, MIN_STEP_TICKS, TICK_HZ};
use daic_protocol::message::{EventKind, FaultCause};
use daic_protocol::program::{Condition, Instruction, Policy, Reaction, Timeout};

/// Ticks per millisecond.
const TICKS_PER_MS: u64 = TICK_HZ as u64 / 1000;
const STEP: u64 = MIN_STEP_TICKS as u64;

/// What playing up to some tick came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Progress {
    /// More to come.
    Waiting,
    /// The program has ended at the tick given: outputs can be made safe then, not before.
    Ended(u64),
    /// It cannot go on: outputs are to be made safe at the tick given, or as soon as possible.
    Failed(FaultCause, u64),
    /// The next instruction, at the tick given, has not come yet.
    Later(u64),
    /// The program does something that the verifier should have refused.
    Broken,
}

/// What a player plays on, and what it knows.
pub(crate) struct Stage<'a> {
    pub(crate) board: &'a Board,
    pub(crate) out: &'a mut Outputs,
    pub(crate) sink: &'a mut dyn Sink,
    /// When the host was last heard.
    pub(crate) host: u64,
    /// Limit switches are left aside: what is played has been played, or somebody else looks after them.
    pub(crate) blind: bool,
}

#[derive(Debug, Clone, Copy)]
struct Loop {
    /// Where its body begins.
    offset: usize,
    index: u32,
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
    /// The move ends at this tick.
    Reach(u64),
    Trigger(Wait),
    Home(Search),
    /// A move that begins once the words of the one before are out.
    Begin(Instruction),
    /// The end of the program, once the words of a move are out.
    End,
    /// The same after something went wrong.
    Fail(FaultCause),
    /// Outputs go safe at this tick.
    Ending(u64),
}

/// What the program wants next.
enum Next {
    /// A word at this tick.
    Word(u64),
    /// Something else at this tick.
    Act(u64),
    /// Something that comes when all words of the move are out.
    Still,
    /// Nothing until an input changes.
    Input,
}

/// Where a program has got to.
#[derive(Debug, Clone)]
pub(crate) struct Player {
    /// End of the last instruction.
    now: u64,
    /// Byte after the current instruction.
    offset: usize,
    /// Index of the current instruction, and of the next to be read.
    index: u32,
    next: u32,
    /// Instructions begun.
    begun: u32,
    loops: heapless::Vec<Loop, MAX_LOOP_DEPTH>,
    current: Current,
    /// What is left of a compound instruction, in order.
    parts: heapless::Deque<Instruction, 6>,
    /// Axes of the next move, of the one under way.
    joined: heapless::Vec<Target, AXES>,
    moving: heapless::Vec<Target, AXES>,
    motion: Option<Motion>,
    gate: Gate,
    policy: Policy,
    /// Since when that is the policy.
    policy_since: u64,
    /// Ticks that the board needs to act on an input.
    latency: u64,
    /// Ticks spent waiting beyond the shortest time the program can take.
    waited: u64,
    /// The host's silence has been dealt with.
    host_lost: bool,
    /// End after the instruction that is current at this tick.
    stopping: Option<u64>,
}

impl Player {
    /// A player whose first instruction begins at `start`.
    pub(crate) const fn new(start: u64, latency: u32) -> Self {
        Self {
            now: start,
            offset: 0,
            index: 0,
            next: 0,
            begun: 0,
            loops: heapless::Vec::new(),
            current: Current::None,
            parts: heapless::Deque::new(),
            joined: heapless::Vec::new(),
            moving: heapless::Vec::new(),
            motion: None,
            gate: None,
            policy: Policy::DEFAULT,
            policy_since: start,
            latency: latency as u64,
            waited: 0,
            host_lost: false,
            stopping: None,
        }
    }

    /// Index of the current instruction.
    pub(crate) fn index(&self) -> u32 {
        self.index
    }

    /// Ticks waited up to tick `now` beyond the shortest time the program can take.
    pub(crate) fn waited(&self, now: u64) -> u64 {
        let current = match &self.current {
            Current::Trigger(wait) if wait.fired.is_none() => now.saturating_sub(wait.since),
            _ => 0,
        };
        self.waited.saturating_add(current)
    }

    /// End after the instruction that is current at tick `from`; a wait that nothing has ended by now ends
    /// then.
    pub(crate) fn stop(&mut self, from: u64) {
        self.stopping.get_or_insert(from);
    }

    /// From which tick on the run is to end.
    pub(crate) fn stop_from(&self) -> Option<u64> {
        self.stopping
    }

    /// Axes that move now.
    pub(crate) fn moving_axes(&self) -> impl Iterator<Item = u8> + '_ {
        let homing = if let Current::Home(search) = &self.current { Some(search.axis()) } else { None };
        self.motion.iter().filter(|m| m.due().is_some()).flat_map(Motion::axes).chain(homing)
    }

    /// The axis that moves into its limit switch.
    pub(crate) fn blocked(&self, out: &Outputs) -> Option<u8> {
        self.motion.as_ref().and_then(|m| m.blocked(out))
    }

    /// Tick of the next thing to be done; `None` while only an input can bring one.
    pub(crate) fn due(&self, out: &Outputs, host: u64) -> Option<u64> {
        self.due_knowing(out, host, u64::MAX)
    }

    /// Nothing is done before this tick, if inputs are known up to tick `known`.
    pub(crate) fn due_knowing(&self, out: &Outputs, host: u64, known: u64) -> Option<u64> {
        let step = self.step_due(out);
        // A trigger that is still to come is answered so much later.
        let begun = if let Current::Trigger(wait) = &self.current { wait.since } else { 0 };
        let answer = known.checked_add(1).and_then(|t| t.max(begun).checked_add(self.latency));
        let (step, program) = match self.wanted(known) {
            // A step too close before a word comes with it.
            Next::Word(t) => (step.filter(|s| s.saturating_add(STEP) <= t), Some(t)),
            Next::Act(t) => (step, Some(t)),
            Next::Still => (step, step.or(Some(self.now))),
            Next::Input => (step, answer),
        };
        let light = out.light_deadline().map(|(t, _)| t);
        let host = self.host_deadline(host);
        [step, program, light, host].into_iter().flatten().min()
    }

    fn step_due(&self, out: &Outputs) -> Option<u64> {
        self.motion.as_ref().and_then(Motion::due).map(|t| out.earliest(t))
    }

    fn host_deadline(&self, host: u64) -> Option<u64> {
        if self.host_lost || self.policy.host_timeout_ms == 0 || self.policy.host_loss == Reaction::Continue {
            return None;
        }
        let silence = u64::from(self.policy.host_timeout_ms).saturating_mul(TICKS_PER_MS);
        // Silence from before counts, but nothing can be done about it before there is a policy.
        Some(host.saturating_add(silence).max(self.policy_since))
    }

    /// What the program wants; inputs are known up to tick `known`.
    fn wanted(&self, known: u64) -> Next {
        match &self.current {
            Current::None => Next::Act(self.now),
            // The last word of a move may have to make way for one that the program puts out at once.
            Current::Wait(tick, _) | Current::Ending(tick) | Current::Reach(tick) => Next::Act(*tick),
            Current::Edge { tick, .. } => Next::Word(*tick),
            Current::Begin(_) | Current::End | Current::Fail(_) => Next::Still,
            Current::Home(search)
                if search.decides() && search.due() > known.saturating_add(self.latency) =>
            {
                Next::Input
            }
            Current::Home(search) => Next::Act(search.due()),
            Current::Trigger(wait) => match (wait.fired, self.stopping, wait.deadline) {
                (Some(tick), ..) => Next::Act(tick.saturating_add(u64::from(wait.delay))),
                // A wait would never end by itself.
                (None, Some(from), _) => Next::Act(from.max(wait.since)),
                (None, None, Some(deadline)) if deadline <= known => Next::Act(deadline),
                (None, None, _) => Next::Input,
            },
        }
    }

    /// Does everything due up to and including `until`; inputs are known up to and including `known`.
    ///
    /// Words of a move that would come less than the smallest step before a word of the program are
    /// put into that word; those that would come less than it after one, or after each other, come as soon
    /// as they can. So the program's words are exact, and a step is late by at most 6 ticks.
    pub(crate) fn play(
        &mut self,
        until: u64,
        known: u64,
        mut source: Source<'_>,
        stage: &mut Stage<'_>,
    ) -> Progress {
        self.look(known, stage.out);
        loop {
            if stage.sink.is_full() {
                return Progress::Waiting;
            }
            if self.plain(until, &mut source, stage).is_some() {
                continue;
            }
            let step = self.step_due(stage.out);
            // How far the program may be read: to within the smallest step after a step.
            let horizon =
                step.filter(|t| *t <= until).map_or(until, |t| until.max(t.saturating_add(STEP - 1)));
            let wanted = self.wanted(known);
            let before = |tick: u64| step.filter(|t| t.saturating_add(STEP) <= tick);
            let (tick, is_step) = match wanted {
                Next::Word(tick) | Next::Act(tick) => before(tick).map_or((tick, false), |t| (t, true)),
                Next::Still => step.map_or((self.now, false), |t| (t, true)),
                Next::Input => match step {
                    Some(t) => (t, true),
                    None => (u64::MAX, false),
                },
            };
            if let Some(failed) = self.deadlines(tick, until, stage) {
                match failed {
                    Progress::Waiting => continue,
                    other => return other,
                }
            }
            let limit = if is_step || matches!(wanted, Next::Word(_)) { until } else { horizon };
            if tick > limit || (matches!(wanted, Next::Input) && !is_step) {
                return Progress::Waiting;
            }
            let done =
                if is_step { self.step(tick, stage) } else { self.act(tick, known, &mut source, stage) };
            match done {
                Some(Progress::Waiting) => {}
                Some(other) => return other,
                None => return Progress::Broken,
            }
        }
    }

    /// The commonest things in a few cycles: a word of the program with no move beside it, a word of a move with
    /// nothing beside it, while no deadline counts. `None`: it is something else.
    fn plain(&mut self, until: u64, source: &mut Source<'_>, stage: &mut Stage<'_>) -> Option<()> {
        if stage.out.word & LED_MASK != 0 || self.policy.host_timeout_ms != 0 {
            return None;
        }
        match self.current {
            Current::None if self.stopping.is_none() && self.parts.is_empty() && self.now <= until => {
                if self.is_moving() {
                    return None;
                }
                let Fetched::Instruction(Instruction::Edge { mask, value, after }, length) =
                    source.fetch(self.offset)
                else {
                    return None;
                };
                let tick = self.now.checked_add(u64::from(after)).filter(|t| *t <= until)?;
                let next = self.next.checked_add(1)?;
                self.offset = self.offset.checked_add(length)?;
                (self.index, self.next) = (self.next, next);
                self.begun = self.begun.saturating_add(1);
                source.consume(self.offset, self.begun);
                stage.out.put(tick, (stage.out.word & !mask) | (value & mask), stage.sink);
                self.now = tick;
                Some(())
            }
            Current::Reach(end) if stage.blind || stage.out.inputs.word & LIMIT_MASK == 0 => {
                let motion = self.motion.as_mut()?;
                let tick = stage.out.earliest(motion.due()?);
                if tick > until || tick.saturating_add(STEP) > end {
                    return None;
                }
                let word = motion.advance(stage.out.word, stage.out)?;
                stage.out.put(tick, word, stage.sink);
                Some(())
            }
            _ => None,
        }
    }

    /// What must not wait for the next thing to be done, at `tick`.
    fn deadlines(&mut self, tick: u64, until: u64, stage: &mut Stage<'_>) -> Option<Progress> {
        let next = tick.min(until.saturating_add(1));
        if let Some((deadline, led)) = stage.out.light_deadline()
            && deadline < next
        {
            return Some(Progress::Failed(FaultCause::LedLimit { led }, deadline));
        }
        if let Some(deadline) = self.host_deadline(stage.host)
            && deadline < next
        {
            self.host_lost = true;
            let reaction = self.policy.host_loss;
            return Some(self.react(deadline, FaultCause::HostLost, reaction, stage));
        }
        None
    }

    /// Something went wrong at `tick`. `Waiting`: the move under way is finished first.
    pub(crate) fn react(
        &mut self,
        tick: u64,
        cause: FaultCause,
        reaction: Reaction,
        stage: &mut Stage<'_>,
    ) -> Progress {
        if reaction == Reaction::FinishMove && self.is_moving() {
            self.finish_moving(tick, Current::Fail(cause), stage);
            return Progress::Waiting;
        }
        Progress::Failed(cause, tick)
    }

    fn is_moving(&self) -> bool {
        self.motion.as_ref().is_some_and(|m| m.due().is_some())
    }

    /// Nothing is played any more from `tick` on but the move under way: all other lines go low at once.
    fn finish_moving(&mut self, tick: u64, then: Current, stage: &mut Stage<'_>) {
        let dark = stage.out.word & AXIS_MASK;
        if self.is_moving() && dark != stage.out.word {
            let tick = stage.out.earliest(tick);
            stage.out.put(tick, dark, stage.sink);
        }
        self.current = then;
    }

    /// When the host's silence counts, if it was last heard at tick `host`.
    pub(crate) fn silence_ends(&self, host: u64) -> Option<u64> {
        self.host_deadline(host)
    }

    pub(crate) fn policy(&self) -> Policy {
        self.policy
    }

    /// An edge of a trigger input at `tick`; false if nothing waited for it.
    pub(crate) fn trigger(&mut self, tick: u64, input: u8, rising: bool, out: &Outputs) -> bool {
        match &mut self.current {
            Current::Trigger(wait)
                if wait.input == input && self.stopping.is_none() && is_open(self.gate, &out.inputs) =>
            {
                wait.edge(tick, rising)
            }
            _ => false,
        }
    }

    /// A wait for a level looks at inputs that are known up to `known` and have not changed since it
    /// began.
    pub(crate) fn look(&mut self, known: u64, out: &Outputs) {
        if let Current::Trigger(wait) = &mut self.current
            && wait.since <= known
            && self.stopping.is_none()
        {
            wait.look(self.gate, wait.since, &out.inputs);
        }
    }

    /// Inputs have changed at `tick`: a level may be there now, or a gate may have opened.
    pub(crate) fn look_again(&mut self, tick: u64, out: &Outputs) {
        if let Current::Trigger(wait) = &mut self.current
            && wait.since <= tick
            && self.stopping.is_none()
        {
            wait.look(self.gate, tick, &out.inputs);
        }
    }

    fn step(&mut self, tick: u64, stage: &mut Stage<'_>) -> Option<Progress> {
        let motion = self.motion.as_mut()?;
        if let Some(axis) = motion.blocked(stage.out).filter(|_| !stage.blind) {
            return Some(Progress::Failed(FaultCause::LimitSwitch { axis }, tick));
        }
        let word = motion.advance(stage.out.word, stage.out)?;
        stage.out.put(tick, word, stage.sink);
        Some(Progress::Waiting)
    }

    fn finish(&mut self, tick: u64) {
        self.now = tick;
        self.current = Current::None;
    }

    fn act(
        &mut self,
        tick: u64,
        known: u64,
        source: &mut Source<'_>,
        stage: &mut Stage<'_>,
    ) -> Option<Progress> {
        match self.current {
            Current::None => {
                if let Some(part) = self.parts.pop_front() {
                    self.begin(tick, part, known, stage)?;
                } else if self.stopping.is_some_and(|from| tick >= from) {
                    self.finish_moving(tick, Current::End, stage);
                } else {
                    return self.read(tick, known, source, stage);
                }
            }
            Current::Wait(_, settle) => {
                if settle {
                    stage.out.note(tick, EventKind::Settled);
                }
                self.finish(tick);
            }
            Current::Edge { mask, value, .. } => {
                let mut word = (stage.out.word & !mask) | (value & mask);
                // A step that would come too close before it comes with it.
                if self.step_due(stage.out).is_some_and(|t| t <= tick) {
                    let motion = self.motion.as_mut()?;
                    if let Some(axis) = motion.blocked(stage.out).filter(|_| !stage.blind) {
                        return Some(Progress::Failed(FaultCause::LimitSwitch { axis }, tick));
                    }
                    word = motion.advance(word, stage.out)?;
                }
                stage.out.put(tick, word, stage.sink);
                self.finish(tick);
            }
            Current::Reach(_) => {
                let moving = core::mem::take(&mut self.moving);
                Motion::report(tick, &moving, stage.out);
                self.finish(tick);
            }
            Current::Trigger(wait) if wait.fired.is_none() && self.stopping.is_some() => self.finish(tick),
            Current::Trigger(wait) => return self.triggered(tick, wait, stage),
            Current::Home(mut search) => match search.advance(tick, stage.out, stage.sink)? {
                Found::Searching => self.current = Current::Home(search),
                Found::Home(tick) => {
                    let beyond = tick.saturating_sub(self.now).saturating_sub(SHORTEST_HOMING);
                    self.waited = self.waited.saturating_add(beyond);
                    self.finish(tick);
                }
                Found::Failed(cause) => return Some(Progress::Failed(cause, tick)),
            },
            Current::Begin(instruction) => {
                self.motion = None;
                self.current = Current::None;
                self.begin(self.now, instruction, known, stage)?;
            }
            Current::End => self.current = Current::Ending(stage.out.earliest_safe(self.now)),
            Current::Fail(cause) => return Some(Progress::Failed(cause, stage.out.last())),
            Current::Ending(_) => return Some(Progress::Ended(tick)),
        }
        Some(Progress::Waiting)
    }

    fn triggered(&mut self, tick: u64, wait: Wait, stage: &mut Stage<'_>) -> Option<Progress> {
        let input = wait.input;
        let until = wait.fired.unwrap_or(tick);
        self.waited = self.waited.saturating_add(until.saturating_sub(wait.since));
        if let Some(stamp) = wait.fired {
            let missed = stage.out.inputs.missed(input);
            stage.out.note(stamp, EventKind::Triggered { input, missed });
            self.finish(tick);
            return Some(Progress::Waiting);
        }
        stage.out.note(tick, EventKind::TimedOut { input });
        // As after a trigger, so that a player in hardware can be filled.
        let end = tick.saturating_add(u64::from(wait.delay));
        match wait.on_timeout {
            Timeout::Fault => {
                // What a player in hardware has been given goes on until it is halted.
                self.current = Current::Ending(u64::MAX);
                return Some(Progress::Failed(FaultCause::TriggerTimeout { input }, tick));
            }
            Timeout::Continue => self.current = Current::Wait(end, false),
            Timeout::Stop => {
                self.current = Current::Wait(end, false);
                self.stopping.get_or_insert(end);
            }
        }
        Some(Progress::Waiting)
    }

    /// Reads the next instruction and begins it at `tick`. `None`: the program is broken.
    fn read(
        &mut self,
        tick: u64,
        known: u64,
        source: &mut Source<'_>,
        stage: &mut Stage<'_>,
    ) -> Option<Progress> {
        let (instruction, length) = match source.fetch(self.offset) {
            Fetched::Instruction(instruction, length) => (instruction, length),
            Fetched::End => {
                self.finish_moving(tick, Current::End, stage);
                return Some(Progress::Waiting);
            }
            Fetched::Dry => {
                let reaction = self.policy.underrun;
                return Some(self.react(tick, FaultCause::Underrun, reaction, stage));
            }
            Fetched::Later => return Some(Progress::Later(tick)),
            Fetched::Broken => return None,
        };
        self.index = self.next;
        self.next = self.index.checked_add(1)?;
        self.begun = self.begun.saturating_add(1);
        self.offset = self.offset.checked_add(length)?;
        source.consume(self.offset, self.begun);
        self.begin(tick, instruction, known, stage)?;
        Some(Progress::Waiting)
    }

    fn begin(
        &mut self,
        tick: u64,
        instruction: Instruction,
        known: u64,
        stage: &mut Stage<'_>,
    ) -> Option<()> {
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
            Instruction::Level { led, level } => {
                stage.out.set_level(tick, led, level, stage.board, stage.sink);
            }
            Instruction::Mark { id } => stage.out.note(tick, EventKind::Mark { id }),
            Instruction::Stop => {
                self.now = tick;
                self.current = Current::End;
            }
            Instruction::WaitTrigger { input, edge, skip, timeout } => {
                let condition = match edge {
                    daic_protocol::program::TriggerEdge::Rising => Condition::Rising,
                    daic_protocol::program::TriggerEdge::Falling => Condition::Falling,
                };
                let (delay, on_timeout) = (stage.board.input_latency, Timeout::Fault);
                let wait = Instruction::Wait { input, condition, skip, delay, timeout, on_timeout };
                return self.begin(tick, wait, known, stage);
            }
            Instruction::Wait { input, condition, skip, delay, timeout, on_timeout } => {
                let deadline = if timeout > 0 { Some(tick.checked_add(u64::from(timeout))?) } else { None };
                let mut wait =
                    Wait { input, condition, skip, delay, since: tick, deadline, on_timeout, fired: None };
                if known >= tick && self.stopping.is_none() {
                    wait.look(self.gate, tick, &stage.out.inputs);
                }
                self.current = Current::Trigger(wait);
            }
            Instruction::Gate { input, open_high } => self.gate = Some((input, open_high)),
            Instruction::NoGate => self.gate = None,
            Instruction::Policy(policy) => (self.policy, self.policy_since) = (policy, tick),
            Instruction::Join { axis, target } => self.joined.push((axis, target)).ok()?,
            Instruction::Move { axis, target, max_rate, acceleration, jerk } => {
                let pace = Pace { rate: max_rate, acceleration, jerk };
                let end = self.go(tick, (axis, target), pace, instruction, stage)?;
                if let Some(end) = end {
                    self.current = Current::Reach(end);
                }
            }
            Instruction::Go { axis, target, max_rate, acceleration, jerk } => {
                let pace = Pace { rate: max_rate, acceleration, jerk };
                self.go(tick, (axis, target), pace, instruction, stage)?;
            }
            Instruction::Reach => {
                let end = self.motion.as_ref().map_or(tick, |m| m.end().max(tick));
                self.current = Current::Reach(end);
            }
            Instruction::Home { axis } => {
                if self.is_moving() {
                    self.now = tick;
                    self.current = Current::Begin(instruction);
                    return Some(());
                }
                stage.out.set_homed(axis, false);
                let homing = stage.board.axes.get(usize::from(axis))?.home?;
                self.now = tick;
                let direction = stage.out.earliest(tick.checked_add(DIR_DELAY)?);
                self.current = Current::Home(Search::new(direction, axis, homing));
            }
            Instruction::Capture { axis, target, max_rate, acceleration, jerk, settle, .. } => {
                self.now = tick;
                let [up, on, off, down] = capture_edges(&instruction)?;
                let go = Instruction::Move { axis, target, max_rate, acceleration, jerk };
                let parts = [go, Instruction::Settle { ticks: settle }, up, on, off, down];
                for part in parts {
                    self.parts.push_back(part).ok()?;
                }
            }
        }
        Some(())
    }

    /// Begins a move; tells its end, `None` if the words of the one before are not out yet.
    fn go(
        &mut self,
        tick: u64,
        target: Target,
        pace: Pace,
        instruction: Instruction,
        stage: &mut Stage<'_>,
    ) -> Option<Option<u64>> {
        if self.is_moving() {
            self.now = tick;
            self.current = Current::Begin(instruction);
            return Some(None);
        }
        self.joined.push(target).ok()?;
        self.joined.rotate_right(1);
        self.moving = core::mem::take(&mut self.joined);
        for &(axis, target) in &self.moving {
            stage.out.note(tick, EventKind::MoveStarted { axis, target });
        }
        self.motion = Motion::plan(tick, &self.moving, pace, stage.out)?;
        self.now = tick;
        Some(Some(self.motion.as_ref().map_or(tick, Motion::end)))
    }
}

/// The four edges of a `Capture`: camera up, light on, light off, camera down.
pub(crate) fn capture_edges(instruction: &Instruction) -> Option<[Instruction; 4]> {
    let Instruction::Capture { cameras, leds, lead, pulse, hold, .. } = *instruction else { return None };
    let edge = |mask: u32, value: u32, after: u32| Instruction::Edge { mask, value, after };
    Some([edge(cameras, cameras, 0), edge(leds, leds, lead), edge(leds, 0, pulse), edge(cameras, 0, hold)])
}

/// Trigger inputs that a change of the input word touches, and whether they rise.
pub(crate) fn trigger_edges(before: u32, after: u32) -> impl Iterator<Item = (u8, bool)> {
    (0..channels::INPUTS).filter_map(move |input| {
        let bit = channels::trigger_input(input)?;
        ((before ^ after) & bit != 0).then_some((input, after & bit != 0))
    })
}
