//! When each step of a move is made.
//!
//! A move of `N` steps with rate `v` (steps/s) and acceleration `a` (steps/s²) follows the symmetric
//! trapezoid x(t) of continuous motion; step `k` (1 … N) is made when x = k. In ticks after the
//! origin of the move, with f = [`TICK_HZ`], ⌊·⌋ the floor, and A(j) = ⌊√(2 j f² / a)⌋:
//!
//! * trapezoid, if v² < a N, with total time T = ⌊f (N a + v²) / (a v)⌋:
//!   * 2 a k ≤ v²: tick A(k);
//!   * else, 2 a (N − k) ≤ v²: tick T − A(N − k);
//!   * else tick ⌊f (2 a k + v²) / (2 a v)⌋;
//! * triangle, if v² ≥ a N, with T = ⌊√(4 N f² / a)⌋:
//!   * 2 k ≤ N: tick A(k);
//!   * else tick T − A(N − k).
//!
//! A move with a limit on jerk follows an [`SCurve`] instead.
//!
//! All of it is integer arithmetic. [`Trapezoid::tick_of`] and [`SCurve::tick_of`] are the definitions
//! as they stand; [`Steps`] yields the same ticks one after the other at a small cost per step (none
//! with wide divisions), which a core without a divider can afford.

mod scurve;
mod trapezoid;

pub use scurve::{MAX_JERK, MAX_SLICES, MIN_SLICE_SHIFT, SCurve, SCurveSteps};
pub use trapezoid::{Trapezoid, TrapezoidSteps};

use daic_protocol::limits::{MIN_STEP_TICKS, TICK_HZ};

/// Ticks that a step line stays high (2 µs); it also stays low at least about as long.
pub const STEP_PULSE: u64 = 250;
/// Ticks from the direction word of a move to the origin of its step times (5 µs).
pub const DIR_SETUP: u64 = 625;
/// Ticks from the end of the previous instruction to the direction word of a move.
pub const DIR_DELAY: u64 = MIN_STEP_TICKS as u64;
/// Highest step rate any axis may have, in steps per second: twice [`STEP_PULSE`] per step.
pub const MAX_STEP_RATE: u32 = TICK_HZ / (2 * STEP_PULSE as u32);
/// Highest acceleration any axis may have, in steps per second squared.
///
/// With it and [`MAX_STEP_RATE`] every intermediate value of [`TrapezoidSteps`] fits 64 bits:
/// an accelerating axis has a·t ≤ v f ≤ 250 000 · 125 000 000 < 2⁴⁵, so the remainders stay below
/// 2 f² + 2 v f + a < 2⁵⁵, and the divisor of the cruise 2 a v ≤ 2⁴⁹.
pub const MAX_ACCELERATION: u32 = 1_000_000_000;

/// The planned motion of one move, or of the axis that has most steps of several.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Profile {
    /// Without a limit on jerk.
    Trapezoid(Trapezoid),
    /// With one.
    SCurve(SCurve),
}

impl Profile {
    /// Plans a move of `steps` steps; `jerk` 0 plans a trapezoid.
    pub fn new(steps: u32, rate: u32, acceleration: u32, jerk: u32) -> Self {
        if jerk == 0 {
            Self::Trapezoid(Trapezoid::new(steps, rate, acceleration))
        } else {
            Self::SCurve(SCurve::new(steps, rate, acceleration, jerk))
        }
    }

    /// Number of steps.
    pub fn steps(&self) -> u32 {
        match self {
            Self::Trapezoid(p) => p.steps(),
            Self::SCurve(p) => p.steps(),
        }
    }

    /// Ticks from the end of the previous instruction to the end of the move; 0 without steps.
    pub fn duration(&self) -> u64 {
        match self {
            Self::Trapezoid(p) => p.duration(),
            Self::SCurve(p) => p.duration(),
        }
    }

    /// No move of at most `steps` steps takes longer, in ticks.
    pub fn longest(steps: u32, rate: u32, acceleration: u32, jerk: u32) -> u64 {
        let whole = Self::new(steps, rate, acceleration, jerk).duration();
        // A shorter S-curve may be cut into other slices, which are rounded up.
        if jerk == 0 { whole } else { whole.saturating_mul(2) }
    }
}

/// The ticks of all steps of a move after its origin, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Steps {
    /// Without a limit on jerk.
    Trapezoid(TrapezoidSteps),
    /// With one.
    SCurve(SCurveSteps),
}

impl Steps {
    /// Begins with the first step.
    pub fn new(profile: Profile) -> Self {
        match profile {
            Profile::Trapezoid(p) => Self::Trapezoid(TrapezoidSteps::new(p)),
            Profile::SCurve(p) => Self::SCurve(SCurveSteps::new(p)),
        }
    }
}

impl Iterator for Steps {
    type Item = u64;

    fn next(&mut self) -> Option<u64> {
        match self {
            Self::Trapezoid(steps) => steps.next(),
            Self::SCurve(steps) => steps.next(),
        }
    }
}
