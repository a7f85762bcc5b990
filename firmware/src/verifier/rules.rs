//! Rules that one instruction keeps or breaks by itself.

use super::violation;
use crate::board::Board;
use crate::motion::{MAX_ACCELERATION, MAX_STEP_RATE};
use daic_protocol::channels::{CAMERA_MASK, LED_MASK};
use daic_protocol::message::{Capabilities, Rule, Violation};
use daic_protocol::program::{Condition, Instruction, Reaction};

/// Pace of a move.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    pub(super) rate: u32,
    pub(super) acceleration: u32,
    pub(super) jerk: u32,
}

/// A move's own axis, target and pace.
pub(super) fn pace_of(instruction: &Instruction) -> Option<(u8, i32, Pace)> {
    match *instruction {
        Instruction::Move { axis, target, max_rate, acceleration, jerk }
        | Instruction::Go { axis, target, max_rate, acceleration, jerk }
        | Instruction::Capture { axis, target, max_rate, acceleration, jerk, .. } => {
            Some((axis, target, Pace { rate: max_rate, acceleration, jerk }))
        }
        _ => None,
    }
}

/// Checks what can be said of an instruction without its neighbours.
pub(super) fn check(index: u16, instruction: &Instruction, board: &Board) -> Result<(), Violation> {
    let err = |rule, value, limit| Err(violation(index, rule, value, limit));
    let input = |input: u8| {
        if board.capabilities & Capabilities::TRIGGER_INPUTS == 0 {
            err(Rule::Unsupported, 0, 0)
        } else if input >= board.inputs {
            err(Rule::NoSuchInput, i64::from(input), i64::from(board.inputs))
        } else {
            Ok(())
        }
    };
    if let Some((axis, position, pace)) = pace_of(instruction) {
        target(index, axis, position, board)?;
        self::pace(index, axis, pace, board)?;
    }
    match *instruction {
        Instruction::Edge { mask, value, .. } => {
            let allowed = board.edge_mask();
            if mask & !allowed != 0 {
                return err(Rule::ForbiddenBits, i64::from(mask), i64::from(allowed));
            }
            if value & !mask != 0 {
                return err(Rule::ValueOutsideMask, i64::from(value), i64::from(mask));
            }
        }
        Instruction::WaitTrigger { input: i, .. } | Instruction::Gate { input: i, .. } => return input(i),
        Instruction::Wait { input: i, condition, skip, delay, .. } => {
            input(i)?;
            let level = matches!(condition, Condition::High | Condition::Low);
            if level && skip != 0 {
                return err(Rule::SkipOfLevel, i64::from(skip), 0);
            }
            if delay < board.input_latency {
                return err(Rule::DelayTooShort, i64::from(delay), i64::from(board.input_latency));
            }
        }
        Instruction::Join { axis, target: position } => return target(index, axis, position, board),
        Instruction::Home { axis } => {
            let Some(limits) = board.axes.get(usize::from(axis)) else {
                return err(Rule::NoSuchAxis, i64::from(axis), board.axes.len() as i64);
            };
            if limits.home.is_none() {
                return err(Rule::NoHomeSwitch, i64::from(axis), 0);
            }
        }
        Instruction::Capture { cameras, leds, .. } => {
            let cameras_there = board.edge_mask() & CAMERA_MASK;
            let leds_there = board.edge_mask() & LED_MASK;
            if cameras & !cameras_there != 0 {
                return err(Rule::ForbiddenBits, i64::from(cameras), i64::from(cameras_there));
            }
            if leds & !leds_there != 0 {
                return err(Rule::ForbiddenBits, i64::from(leds), i64::from(leds_there));
            }
        }
        Instruction::Policy(policy) => {
            for reaction in [policy.interlock, policy.underrun] {
                if reaction == Reaction::Continue {
                    return err(Rule::BadPolicy, reaction as i64, Reaction::Safe as i64);
                }
            }
        }
        Instruction::Level { led, .. } if usize::from(led) >= board.leds.len() => {
            return err(Rule::NoSuchLed, i64::from(led), board.leds.len() as i64);
        }
        Instruction::LoopBegin { count: 0 } => return err(Rule::ZeroLoop, 0, 1),
        _ => {}
    }
    Ok(())
}

/// Whether an axis may go there.
fn target(index: u16, axis: u8, target: i32, board: &Board) -> Result<(), Violation> {
    let err = |rule, value, limit| Err(violation(index, rule, value, limit));
    let Some(limits) = board.axes.get(usize::from(axis)) else {
        return err(Rule::NoSuchAxis, i64::from(axis), board.axes.len() as i64);
    };
    if target < limits.min {
        return err(Rule::TargetOutOfRange, i64::from(target), i64::from(limits.min));
    }
    if target > limits.max {
        return err(Rule::TargetOutOfRange, i64::from(target), i64::from(limits.max));
    }
    Ok(())
}

/// Whether an axis may go at that pace, alone or as one of several.
pub(super) fn pace(index: u16, axis: u8, pace: Pace, board: &Board) -> Result<(), Violation> {
    let err = |rule, value: u32, limit: u32| Err(violation(index, rule, i64::from(value), i64::from(limit)));
    let Some(limits) = board.axes.get(usize::from(axis)) else { return Ok(()) };
    let (rate, acceleration) =
        (limits.max_rate.min(MAX_STEP_RATE), limits.max_acceleration.min(MAX_ACCELERATION));
    if pace.rate == 0 || pace.rate > rate {
        return err(Rule::RateOutOfRange, pace.rate, rate);
    }
    if pace.acceleration == 0 || pace.acceleration > acceleration {
        return err(Rule::AccelerationOutOfRange, pace.acceleration, acceleration);
    }
    if pace.jerk != 0 && board.capabilities & Capabilities::JERK == 0 {
        return err(Rule::Unsupported, pace.jerk, 0);
    }
    if pace.jerk > limits.max_jerk {
        return err(Rule::JerkOutOfRange, pace.jerk, limits.max_jerk);
    }
    Ok(())
}
