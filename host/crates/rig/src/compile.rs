//! A sequence becomes a program for the box and a plan of the frames to expect.
//!
//! Times are rounded to whole ticks, moves to whole steps; the plan says what was asked and what
//! will be played. What the box (its `Hello`) cannot hold or does not have is refused here, before
//! anything is sent.

use crate::experiment::{Experiment, FrameStep, Role, Step, Strobe};
use crate::units::Time;
use daic_protocol::limits::MAX_LOOP_DEPTH;
use daic_protocol::message::Hello;
use daic_protocol::{channels, program::Instruction};
use thiserror::Error;

/// Most frames one plan may hold.
pub const MAX_FRAMES: usize = 1_000_000;
/// Stage axes that an experiment can name (x, y, z).
pub const AXES: usize = 3;

/// The sequence cannot be played by this box.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CompileError {
    /// The box has fewer LEDs.
    #[error("LED {led} is asked for, the box has LEDs 0 to {last}; change led in the sequence", last = i32::from(*leds) - 1)]
    NoSuchLed {
        /// LED asked for.
        led: u8,
        /// LEDs of the box.
        leds: u8,
    },
    /// The box has fewer camera lines.
    #[error("camera line {line} is asked for, the box has lines 0 to {last}; change rig.camera.line", last = i32::from(*cameras) - 1)]
    NoSuchCamera {
        /// Line asked for.
        line: u8,
        /// Lines of the box.
        cameras: u8,
    },
    /// The box or the rig has no such axis.
    #[error(
        "axis {axis} is to be moved, but the box has {axes} axes and rig.axes must describe each that moves"
    )]
    NoSuchAxis {
        /// Axis asked for.
        axis: usize,
        /// Axes of the box.
        axes: u8,
    },
    /// A target is too many steps from home.
    #[error("axis {axis} is to move to {mm} mm, more steps from home than the box can count")]
    TargetTooFar {
        /// Axis.
        axis: usize,
        /// Target in millimetres.
        mm: f64,
    },
    /// A move cannot go past its target before it arrives.
    #[error(
        "axis {axis} is to arrive at {mm} mm from the other side, by way of {by_way_mm} mm, which is beyond its travel; leave room for twice its backlash, or change its approach"
    )]
    NoRoomToApproach {
        /// Axis.
        axis: usize,
        /// Target in millimetres.
        mm: f64,
        /// Where it has to turn, millimetres.
        by_way_mm: f64,
    },
    /// Two edges of one frame are closer than the box can play.
    #[error(
        "frame {frame:?} needs two edges {ticks} ticks apart, the box needs {min} ticks between them; lengthen trigger_width, strobe delay or strobe width"
    )]
    EdgesTooClose {
        /// Name of the frame.
        frame: String,
        /// Distance in ticks.
        ticks: u64,
        /// Least distance in ticks.
        min: u32,
    },
    /// Repeats are nested too deep.
    #[error("repeats are nested {depth} deep, the box plays {max}")]
    LoopTooDeep {
        /// Depth asked for.
        depth: usize,
        /// Deepest nesting.
        max: usize,
    },
    /// More instructions than the box holds.
    #[error("the sequence needs {count} instructions, the box holds {max}; use repeat for what comes again")]
    TooManyInstructions {
        /// Instructions needed.
        count: usize,
        /// Instructions that fit.
        max: usize,
    },
    /// More bytes than the box holds.
    #[error("the program needs {length} bytes, the box holds {max}; use repeat for what comes again")]
    ProgramTooLong {
        /// Bytes needed.
        length: usize,
        /// Bytes that fit.
        max: usize,
    },
    /// More frames than a plan may hold.
    #[error("the sequence asks for more than {max} frames; split it")]
    TooManyFrames {
        /// Frames allowed.
        max: usize,
    },
}

/// A program and the frames it will cause.
#[derive(Debug, Clone, PartialEq)]
pub struct Compiled {
    /// What is loaded into the box.
    pub instructions: Vec<Instruction>,
    /// The same, encoded.
    pub program: Vec<u8>,
    /// What is expected back.
    pub plan: Plan,
}

/// Frames to expect, in the order of their triggers.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Ticks per second of the box.
    pub tick_hz: u32,
    /// Mask of the camera trigger line in the output word.
    pub camera_mask: u32,
    /// The frames.
    pub frames: Vec<PlannedFrame>,
}

/// One frame to expect.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedFrame {
    /// Number of its trigger, from 0.
    pub index: usize,
    /// Name, unique in the plan.
    pub name: String,
    /// What it is for.
    pub role: Role,
    /// Stage position as asked for, in millimetres (x, y, z; 0 for an axis the rig does not describe).
    pub asked_mm: [f64; AXES],
    /// Stage position as played, in steps.
    pub position_steps: [i32; AXES],
    /// Stage position as played, in millimetres.
    pub position_mm: [f64; AXES],
    /// Ticks from the begin of the run to the rising trigger edge; `None` behind a move, whose
    /// duration the box plans.
    pub trigger_offset: Option<u64>,
    /// The strobe.
    pub strobe: PlannedStrobe,
}

/// The strobe of a planned frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlannedStrobe {
    /// LED line.
    pub led: u8,
    /// Level of full scale 65 535.
    pub level: u16,
    /// Ticks from the rising trigger edge to LED on.
    pub delay_ticks: u64,
    /// Ticks the LED is on.
    pub width_ticks: u64,
}

/// Compiles the sequence of an experiment for the box that said `hello`, whose axes stand at
/// `start` (in steps, as in its `Status`).
///
/// # Errors
/// [`CompileError`]: the sequence asks for what this box does not have or cannot hold.
pub fn compile(experiment: &Experiment, hello: &Hello, start: [i32; 6]) -> Result<Compiled, CompileError> {
    let mut emitter =
        Emitter { experiment, hello, levels: [None; channels::LEDS as usize], arrived: [None; AXES] };
    let nodes = emitter.steps(&experiment.sequence, 0)?;

    let mut instructions = Vec::new();
    flatten(&nodes, &mut instructions);
    let max = usize::from(hello.max_instructions);
    if instructions.len() > max {
        return Err(CompileError::TooManyInstructions { count: instructions.len(), max });
    }
    let program = encode(&instructions);
    let max = hello.max_program_bytes as usize;
    if program.len() > max {
        return Err(CompileError::ProgramTooLong { length: program.len(), max });
    }

    let steps_per_mm = experiment.rig.axes.named().map(|(_, axis)| axis.map_or(0.0, |a| a.steps_per_mm));
    let steps = std::array::from_fn(|i| start.get(i).copied().unwrap_or(0));
    let mut planner = Planner {
        steps_per_mm,
        steps,
        asked: std::array::from_fn(|i| to_mm(steps[i], steps_per_mm[i])),
        elapsed: Some(0),
        counts: std::collections::HashMap::new(),
        frames: Vec::new(),
    };
    planner.walk(&nodes)?;
    let camera_mask = emitter.camera()?;
    Ok(Compiled {
        instructions,
        program,
        plan: Plan { tick_hz: hello.tick_hz, camera_mask, frames: planner.frames },
    })
}

/// A program as it goes over the wire.
pub fn encode(instructions: &[Instruction]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for instruction in instructions {
        // An instruction is one byte of variant and at most five varints of five bytes.
        let mut buffer = [0u8; 64];
        if let Ok(encoded) = postcard::to_slice(instruction, &mut buffer) {
            bytes.extend_from_slice(encoded);
        }
    }
    bytes
}

fn to_mm(steps: i32, per_mm: f64) -> f64 {
    if per_mm > 0.0 { f64::from(steps) / per_mm } else { 0.0 }
}

/// The program as a tree, with what the plan needs beside it.
enum Node<'a> {
    Play(Instruction),
    /// A move to `target` steps, asked for as `mm`.
    Move {
        play: Instruction,
        axis: usize,
        target: i32,
        mm: f64,
    },
    /// The next edge triggers this frame.
    Frame {
        step: &'a FrameStep,
        strobe: PlannedStrobe,
        numbered: bool,
    },
    Loop {
        count: u32,
        body: Vec<Node<'a>>,
    },
}

struct Emitter<'a> {
    experiment: &'a Experiment,
    hello: &'a Hello,
    /// Levels known at this point of the program.
    levels: [Option<u16>; channels::LEDS as usize],
    /// Steps at which axes stand that have come there in their direction of approach, where that is known.
    arrived: [Option<i32>; AXES],
}

impl<'a> Emitter<'a> {
    fn ticks(&self, time: Time) -> u64 {
        time.ticks(self.hello.tick_hz)
    }

    fn steps(&mut self, steps: &'a [Step], depth: usize) -> Result<Vec<Node<'a>>, CompileError> {
        let mut nodes = Vec::new();
        for step in steps {
            match step {
                Step::Move(m) => {
                    for (axis, target) in m.targets().into_iter().enumerate() {
                        if let Some(target) = target {
                            self.travel(axis, target.mm(), &mut nodes)?;
                        }
                    }
                }
                Step::Settle(time) => settle(self.ticks(*time), &mut nodes),
                Step::Level(l) => self.level(l.led, fraction(l.level), l.settle, &mut nodes)?,
                Step::Frame(frame) => self.frame(frame, depth > 0, &mut nodes)?,
                Step::Repeat(repeat) => {
                    if depth >= MAX_LOOP_DEPTH {
                        return Err(CompileError::LoopTooDeep { depth: depth + 1, max: MAX_LOOP_DEPTH });
                    }
                    // The second pass begins with the levels that the first one left.
                    self.levels = [None; channels::LEDS as usize];
                    let before = std::mem::take(&mut self.arrived);
                    let body = self.steps(&repeat.steps, depth + 1)?;
                    for (now, before) in self.arrived.iter_mut().zip(before) {
                        *now = now.or(before);
                    }
                    nodes.push(Node::Loop { count: repeat.times, body });
                }
            }
        }
        Ok(nodes)
    }

    /// Moves an axis to `mm`; against its direction of approach, or from where it has come in an unknown one,
    /// past the target and back.
    fn travel(&mut self, axis: usize, mm: f64, nodes: &mut Vec<Node<'a>>) -> Result<(), CompileError> {
        let missing = CompileError::NoSuchAxis { axis, axes: self.hello.axes };
        let described = self.experiment.rig.axes.named().get(axis).and_then(|(_, a)| *a);
        let (Some(limits), Ok(number)) = (described, u8::try_from(axis)) else { return Err(missing) };
        if number >= self.hello.axes {
            return Err(missing);
        }
        let per_mm = limits.steps_per_mm;
        let steps = (mm * per_mm).round();
        if steps.is_nan() || steps.abs() > f64::from(i32::MAX) {
            return Err(CompileError::TargetTooFar { axis, mm });
        }
        // Float-to-integer casts saturate; the range was checked.
        let target = steps as i32;
        let go = |to: i32| Node::Move {
            play: Instruction::Move {
                axis: number,
                target: to,
                max_rate: (limits.rate.mm_per_s() * per_mm).round() as u32,
                acceleration: (limits.acceleration.mm_per_s2() * per_mm).round() as u32,
                jerk: limits.jerk.map_or(0, |jerk| (jerk.mm_per_s3() * per_mm).round() as u32),
            },
            axis,
            target: to,
            mm,
        };
        if limits.backlash.mm() > 0.0 {
            let sign = limits.approach.sign();
            let with = self.arrived.get(axis).copied().flatten();
            if with.is_none_or(|from| i64::from(sign) * (i64::from(target) - i64::from(from)) < 0) {
                let past = steps - f64::from(sign) * (2.0 * limits.backlash.mm() * per_mm).ceil();
                let by_way_mm = past / per_mm;
                if by_way_mm < limits.min.mm() || by_way_mm > limits.max.mm() {
                    return Err(CompileError::NoRoomToApproach { axis, mm, by_way_mm });
                }
                nodes.push(go(past as i32));
            }
            if let Some(arrived) = self.arrived.get_mut(axis) {
                *arrived = Some(target);
            }
        }
        nodes.push(go(target));
        Ok(())
    }

    fn level(
        &mut self,
        led: u8,
        level: u16,
        time: Time,
        nodes: &mut Vec<Node<'a>>,
    ) -> Result<(), CompileError> {
        self.led(led)?;
        nodes.push(Node::Play(Instruction::Level { led, level }));
        settle(self.ticks(time), nodes);
        if let Some(known) = self.levels.get_mut(usize::from(led)) {
            *known = Some(level);
        }
        Ok(())
    }

    fn led(&self, led: u8) -> Result<u32, CompileError> {
        let missing = CompileError::NoSuchLed { led, leds: self.hello.leds };
        if led >= self.hello.leds { Err(missing) } else { channels::led(led).ok_or(missing) }
    }

    fn camera(&self) -> Result<u32, CompileError> {
        let line = self.experiment.rig.camera.line;
        let missing = CompileError::NoSuchCamera { line, cameras: self.hello.cameras };
        if line >= self.hello.cameras { Err(missing) } else { channels::camera(line).ok_or(missing) }
    }

    fn frame(
        &mut self,
        step: &'a FrameStep,
        numbered: bool,
        nodes: &mut Vec<Node<'a>>,
    ) -> Result<(), CompileError> {
        let experiment = self.experiment;
        let strobe: &Strobe = step.strobe.as_ref().unwrap_or(&experiment.rig.strobe);
        let (camera, led) = (self.camera()?, self.led(strobe.led)?);
        let known = self.levels.get(usize::from(strobe.led)).copied().flatten();
        let level = strobe.level.map(fraction).or(known).unwrap_or(u16::MAX);
        if known != Some(level) {
            self.level(strobe.led, level, strobe.level_settle, nodes)?;
        }

        let section = &experiment.rig.camera;
        let planned = PlannedStrobe {
            led: strobe.led,
            level,
            delay_ticks: self.ticks(strobe.delay),
            width_ticks: self.ticks(strobe.width),
        };
        let off = planned.delay_ticks.saturating_add(planned.width_ticks);
        let low = self.ticks(section.trigger_width);
        let mut edges =
            [(0, camera, camera), (low, camera, 0), (planned.delay_ticks, led, led), (off, led, 0)];
        edges.sort_by_key(|&(tick, mask, _)| (tick, mask));

        nodes.push(Node::Frame { step, strobe: planned, numbered });
        let min = self.hello.min_step_ticks;
        let too_close = |ticks| CompileError::EdgesTooClose { frame: step.name.clone(), ticks, min };
        let mut now = 0;
        let mut rest = edges.as_slice();
        while let Some(&(tick, mut mask, mut value)) = rest.first() {
            rest = &rest[1..];
            // Edges of one tick are one word.
            while let Some(&(_, other, high)) = rest.first().filter(|e| e.0 == tick) {
                if mask & other != 0 {
                    return Err(too_close(0));
                }
                mask |= other;
                value |= high;
                rest = &rest[1..];
            }
            // The word before the trigger may be a step pulse or the end of the frame before.
            let after = if tick == 0 { u64::from(min) } else { tick - now };
            if after < u64::from(min) {
                return Err(too_close(after));
            }
            edge(mask, value, after, nodes);
            now = tick;
        }
        let busy = [section.exposure_delay, section.exposure, section.rolling(), section.readout]
            .iter()
            .fold(0u64, |sum, &time| sum.saturating_add(self.ticks(time)));
        delay(busy.saturating_sub(now), nodes);
        Ok(())
    }
}

fn fraction(level: f64) -> u16 {
    (level * f64::from(u16::MAX)).round() as u16
}

const LONGEST: u32 = u32::MAX / 2;

/// Splits off what does not fit the 32 bits of one instruction.
fn split(mut ticks: u64, nodes: &mut Vec<Node<'_>>, play: impl Fn(u32) -> Instruction) -> u32 {
    while ticks > u64::from(u32::MAX) {
        nodes.push(Node::Play(play(LONGEST)));
        ticks -= u64::from(LONGEST);
    }
    u32::try_from(ticks).unwrap_or(u32::MAX)
}

fn edge(mask: u32, value: u32, after: u64, nodes: &mut Vec<Node<'_>>) {
    let after = split(after, nodes, |ticks| Instruction::Delay { ticks });
    nodes.push(Node::Play(Instruction::Edge { mask, value, after }));
}

fn delay(ticks: u64, nodes: &mut Vec<Node<'_>>) {
    let ticks = split(ticks, nodes, |ticks| Instruction::Delay { ticks });
    if ticks > 0 {
        nodes.push(Node::Play(Instruction::Delay { ticks }));
    }
}

fn settle(ticks: u64, nodes: &mut Vec<Node<'_>>) {
    let ticks = split(ticks, nodes, |ticks| Instruction::Settle { ticks });
    if ticks > 0 {
        nodes.push(Node::Play(Instruction::Settle { ticks }));
    }
}

fn flatten(nodes: &[Node<'_>], out: &mut Vec<Instruction>) {
    for node in nodes {
        match node {
            Node::Play(play) | Node::Move { play, .. } => out.push(*play),
            Node::Frame { .. } => {}
            Node::Loop { count, body } => {
                out.push(Instruction::LoopBegin { count: *count });
                flatten(body, out);
                out.push(Instruction::LoopEnd);
            }
        }
    }
}

/// Walks the tree as the box will, loop by loop.
struct Planner {
    steps_per_mm: [f64; AXES],
    steps: [i32; AXES],
    asked: [f64; AXES],
    /// Ticks since the begin of the run, while they are known.
    elapsed: Option<u64>,
    counts: std::collections::HashMap<String, usize>,
    frames: Vec<PlannedFrame>,
}

impl Planner {
    fn walk(&mut self, nodes: &[Node<'_>]) -> Result<(), CompileError> {
        let mut triggered = None;
        for node in nodes {
            match node {
                Node::Play(instruction) => {
                    let ticks = match *instruction {
                        Instruction::Edge { after, .. } => after,
                        Instruction::Delay { ticks } | Instruction::Settle { ticks } => ticks,
                        _ => 0,
                    };
                    self.elapsed = self.elapsed.and_then(|e| e.checked_add(u64::from(ticks)));
                    // The first edge behind the frame's node is its trigger.
                    if matches!(instruction, Instruction::Edge { .. })
                        && let Some(index) = triggered.take()
                    {
                        let elapsed = self.elapsed;
                        if let Some(frame) = self.frames.get_mut::<usize>(index) {
                            frame.trigger_offset = elapsed;
                        }
                    }
                }
                Node::Move { axis, target, mm, .. } => {
                    self.steps[*axis] = *target;
                    self.asked[*axis] = *mm;
                    self.elapsed = None;
                }
                Node::Frame { step, strobe, numbered } => {
                    if self.frames.len() >= MAX_FRAMES {
                        return Err(CompileError::TooManyFrames { max: MAX_FRAMES });
                    }
                    let mut name = step.name.clone();
                    if *numbered {
                        let count = self.counts.entry(name.clone()).or_insert(0);
                        name = format!("{name}_{count:04}");
                        *count += 1;
                    }
                    triggered = Some(self.frames.len());
                    self.frames.push(PlannedFrame {
                        index: self.frames.len(),
                        name,
                        role: step.role,
                        asked_mm: self.asked,
                        position_steps: self.steps,
                        position_mm: std::array::from_fn(|i| to_mm(self.steps[i], self.steps_per_mm[i])),
                        trigger_offset: None,
                        strobe: *strobe,
                    });
                }
                Node::Loop { count, body } => {
                    for _ in 0..*count {
                        let before = self.frames.len();
                        self.walk(body)?;
                        // Nothing to plan in a body without frames, however often it is played.
                        if self.frames.len() == before {
                            self.skip(body, count - 1);
                            break;
                        }
                    }
                }
            }
        }
        Ok(())
    }

    /// Further passes of a loop without frames: only time goes by.
    fn skip(&mut self, body: &[Node<'_>], passes: u32) {
        self.elapsed = duration(body)
            .and_then(|d| d.checked_mul(u64::from(passes)))
            .and_then(|d| self.elapsed.and_then(|e| e.checked_add(d)));
    }
}

/// Ticks that nodes take, if no move is among them.
fn duration(nodes: &[Node<'_>]) -> Option<u64> {
    nodes.iter().try_fold(0u64, |sum, node| {
        let ticks = match node {
            Node::Play(Instruction::Edge { after, .. }) => u64::from(*after),
            Node::Play(Instruction::Delay { ticks } | Instruction::Settle { ticks }) => u64::from(*ticks),
            Node::Move { .. } => return None,
            Node::Loop { count, body } => duration(body)?.checked_mul(u64::from(*count))?,
            Node::Play(_) | Node::Frame { .. } => 0,
        };
        sum.checked_add(ticks)
    })
}
