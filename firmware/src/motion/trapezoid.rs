//! Trapezoids: constant acceleration, constant rate, constant deceleration.

use super::{DIR_DELAY, DIR_SETUP, MAX_ACCELERATION, MAX_STEP_RATE, STEP_PULSE};
use daic_protocol::limits::TICK_HZ;
use fixed::types::U32F32;

const F: u64 = TICK_HZ as u64;
/// 2 f²: what one step adds to the radicand times `a`.
const STEP_SQUARE: u64 = 2 * F * F;

/// The planned motion of one move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trapezoid {
    steps: u32,
    rate: u32,
    acceleration: u32,
    /// Ticks from the origin to the last step.
    last: u64,
    /// Steps 1 … `rising` accelerate.
    rising: u32,
    /// Steps `falling` … N decelerate.
    falling: u32,
}

impl Trapezoid {
    /// Plans a move of `steps` steps. Rate and acceleration are taken into 1 … [`MAX_STEP_RATE`] and
    /// 1 … [`MAX_ACCELERATION`]; the verifier refuses programs that ask for more.
    pub fn new(steps: u32, rate: u32, acceleration: u32) -> Self {
        let rate = rate.clamp(1, MAX_STEP_RATE);
        let acceleration = acceleration.clamp(1, MAX_ACCELERATION);
        let (n, v, a) = (u128::from(steps), u128::from(rate), u128::from(acceleration));
        let f = u128::from(F);
        // n, v and a are 32-bit numbers, f a 27-bit one: nothing below reaches 2¹²⁸.
        let (v2, an) = (v.saturating_mul(v), a.saturating_mul(n));
        let (last, rising, falling) = if v2 < an {
            let numerator = f.saturating_mul(an.saturating_add(v2));
            let last = numerator.checked_div(a.saturating_mul(v)).unwrap_or(0);
            let rising = narrow(v2.checked_div(a.saturating_mul(2)).unwrap_or(0));
            (last, rising, steps.saturating_sub(rising))
        } else {
            let radicand = n.saturating_mul(4).saturating_mul(f).saturating_mul(f);
            let half = steps / 2;
            (radicand.checked_div(a).unwrap_or(0).isqrt(), half, half.saturating_add(1))
        };
        let last = u64::try_from(last).unwrap_or(u64::MAX);
        Self { steps, rate, acceleration, last, rising, falling }
    }

    /// Number of steps.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// Ticks from the end of the previous instruction to the end of the move; 0 without steps.
    pub fn duration(&self) -> u64 {
        if self.steps == 0 { 0 } else { self.last.saturating_add(DIR_DELAY + DIR_SETUP + STEP_PULSE) }
    }

    /// Highest rate that the move reaches, in steps per second (rounded down to 2⁻³²).
    pub fn peak_rate(&self) -> U32F32 {
        let rate = U32F32::from_num(self.rate);
        let square = u128::from(self.acceleration).saturating_mul(u128::from(self.steps));
        let reached = square.checked_shl(64).unwrap_or(0).isqrt();
        rate.min(U32F32::from_bits(u64::try_from(reached).unwrap_or(u64::MAX)))
    }

    /// Tick of step `k` (1 … N) after the origin: the definition, word for word. `None` beyond.
    pub fn tick_of(&self, k: u32) -> Option<u64> {
        let left = self.steps.checked_sub(k)?;
        if k == 0 {
            None
        } else if k <= self.rising {
            Some(root(self.acceleration, k))
        } else if k >= self.falling {
            Some(self.last.saturating_sub(root(self.acceleration, left)))
        } else {
            Some(self.cruise(k).0)
        }
    }

    /// ⌊f (2 a k + v²) / (2 a v)⌋ and the remainder.
    fn cruise(&self, k: u32) -> (u64, u64) {
        let (k, v, a) = (u128::from(k), u128::from(self.rate), u128::from(self.acceleration));
        let a2 = a.saturating_mul(2);
        let numerator =
            u128::from(F).saturating_mul(a2.saturating_mul(k).saturating_add(v.saturating_mul(v)));
        let divisor = a2.saturating_mul(v);
        let tick = numerator.checked_div(divisor).unwrap_or(0);
        let rest = numerator.checked_rem(divisor).unwrap_or(0);
        (u64::try_from(tick).unwrap_or(u64::MAX), u64::try_from(rest).unwrap_or(0))
    }
}

fn narrow(value: u128) -> u32 {
    u32::try_from(value).unwrap_or(u32::MAX)
}

/// A(j) = ⌊√(2 j f² / a)⌋.
fn root(a: u32, j: u32) -> u64 {
    let radicand = u128::from(j).saturating_mul(u128::from(STEP_SQUARE));
    let root = radicand.checked_div(u128::from(a)).unwrap_or(0).isqrt();
    u64::try_from(root).unwrap_or(u64::MAX)
}

/// A(j) for successive j, without wide divisions.
///
/// Holds t = A(j) and the exact remainder e = 2 j f² − a t², 0 ≤ e < a (2 t + 1). The next t is
/// found by Heron's iteration for the integer square root, written in the difference d to the
/// last t so that no square of t occurs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Root {
    a: u64,
    j: u32,
    t: u64,
    e: u64,
    /// Last difference: where the iteration starts.
    d: u64,
}

/// Heron's iteration halves the distance at least; 64 bits need no more.
const MAX_ITERATIONS: u32 = 64;

impl Root {
    fn at(a: u32, j: u32) -> Self {
        let t = root(a, j);
        let square = u128::from(a).saturating_mul(u128::from(t)).saturating_mul(u128::from(t));
        let e = u128::from(j).saturating_mul(u128::from(STEP_SQUARE)).saturating_sub(square);
        Self { a: u64::from(a), j, t, e: u64::try_from(e).unwrap_or(0), d: 0 }
    }

    /// To j + 1: the largest d with a d (2 t + d) ≤ e + 2 f².
    fn up(&mut self) {
        let e = self.e.saturating_add(STEP_SQUARE);
        let q = e.checked_div(self.a).unwrap_or(0);
        // Differences shrink, but for the floors: the last one + 2 is not below the one wanted.
        let mut d = if self.j == 0 { q.isqrt() } else { self.d.saturating_add(2) };
        for _ in 0..MAX_ITERATIONS {
            let divisor = self.t.saturating_add(d).saturating_mul(2);
            let next = d.saturating_mul(d).saturating_add(q).checked_div(divisor).unwrap_or(0);
            if next >= d {
                break;
            }
            d = next;
        }
        let used = self.a.saturating_mul(d).saturating_mul(self.t.saturating_mul(2).saturating_add(d));
        self.e = e.saturating_sub(used);
        self.t = self.t.saturating_add(d);
        self.d = d;
        self.j = self.j.saturating_add(1);
    }

    /// To j − 1: the smallest d with a d (2 t − d) ≥ 2 f² − e.
    fn down(&mut self) {
        self.j = self.j.saturating_sub(1);
        if self.j == 0 {
            (self.d, self.t, self.e) = (self.t, 0, 0);
            return;
        }
        let missing = STEP_SQUARE.saturating_sub(self.e);
        let p =
            missing.checked_add(self.a.saturating_sub(1)).and_then(|m| m.checked_div(self.a)).unwrap_or(0);
        // Differences grow, but for the floors: the last one − 2 is not above the one wanted.
        let mut d = self.d.saturating_sub(2);
        for _ in 0..MAX_ITERATIONS {
            let divisor = self.t.saturating_sub(d).saturating_mul(2).max(1);
            let next = p.saturating_sub(d.saturating_mul(d)).div_ceil(divisor);
            if next <= d {
                break;
            }
            d = next;
        }
        let gained = self.a.saturating_mul(d).saturating_mul(self.t.saturating_mul(2).saturating_sub(d));
        self.e = gained.saturating_sub(missing);
        self.t = self.t.saturating_sub(d);
        self.d = d;
    }
}

/// The ticks of all steps of a move after its origin, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrapezoidSteps {
    profile: Trapezoid,
    /// Steps yielded.
    done: u32,
    root: Root,
    /// Tick of the last cruise step, and its remainder over 2 a v.
    tick: u64,
    rest: u64,
}

impl TrapezoidSteps {
    /// Begins with the first step.
    pub fn new(profile: Trapezoid) -> Self {
        Self { profile, done: 0, root: Root::at(profile.acceleration, 0), tick: 0, rest: 0 }
    }

    /// Steps yielded so far.
    pub fn done(&self) -> u32 {
        self.done
    }

    fn cruise(&mut self, k: u32) -> u64 {
        let p = &self.profile;
        if k == p.rising.saturating_add(1) {
            (self.tick, self.rest) = p.cruise(k);
            return self.tick;
        }
        let a2 = u64::from(p.acceleration).saturating_mul(2);
        let v = u64::from(p.rate);
        let divisor = a2.saturating_mul(v);
        // f / v is f 2 a / (2 a v): whole ticks, and a remainder over the same divisor.
        let (whole, part) = (F.checked_div(v).unwrap_or(0), F.checked_rem(v).unwrap_or(0));
        self.tick = self.tick.saturating_add(whole);
        self.rest = self.rest.saturating_add(part.saturating_mul(a2));
        if self.rest >= divisor {
            self.rest = self.rest.saturating_sub(divisor);
            self.tick = self.tick.saturating_add(1);
        }
        self.tick
    }
}

impl Iterator for TrapezoidSteps {
    type Item = u64;

    fn next(&mut self) -> Option<u64> {
        let p = self.profile;
        if self.done >= p.steps {
            return None;
        }
        let k = self.done.saturating_add(1);
        self.done = k;
        if k <= p.rising {
            self.root.up();
            Some(self.root.t)
        } else if k >= p.falling {
            if k == p.falling {
                self.root = Root::at(p.acceleration, p.steps.saturating_sub(k));
            } else {
                self.root.down();
            }
            Some(p.last.saturating_sub(self.root.t))
        } else {
            Some(self.cruise(k))
        }
    }
}
