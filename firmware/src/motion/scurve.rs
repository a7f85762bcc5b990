//! S-curves: motion with a limit on jerk.
//!
//! Time after the origin is cut into slices of S = 2ˢ ticks. The steps made per slice follow
//! N · (box_q ∗ box_p ∗ box_M) / (q p M), the convolution of three boxes of q ≤ p and p + q ≤ M slices: smooth
//! at both ends, exactly N steps in all, rate at most N / M per slice, acceleration at most N / (p M)
//! per slice², jerk at most N / (q p M) per slice³. The numbers of slices are the smallest that keep
//! these within the limits asked for (rounded up, so limits are kept, never met by chance):
//!
//! * M ≥ N f / (S v), p ≥ N f² / (S² a M), p ≥ √(N f³ / (S³ j M)), q ≥ N f³ / (S³ j p M),
//! * M is the smallest with p + q ≤ M, s the smallest from [`MIN_SLICE_SHIFT`] on with p + q + M ≤ [`MAX_SLICES`].
//!
//! Within a slice the rate is constant. With C(i) the sum of the convolution's first i values, step k is
//! made where the motion passes k − ½:
//!
//! > tick(k) = S i + ⌊S ((2k − 1) q p M − 2 N C(i)) / (2 N (C(i+1) − C(i)))⌋,  i the last slice with 2 N C(i) < (2k − 1) q p M.

use super::{DIR_DELAY, DIR_SETUP, MAX_ACCELERATION, MAX_STEP_RATE, STEP_PULSE};
use daic_protocol::limits::TICK_HZ;

/// Most slices of a move. With it 2 N q p M < 2⁶²: everything per step fits 64 bits.
pub const MAX_SLICES: u64 = 2048;
/// The shortest slice is 2 to this power ticks (2 µs).
pub const MIN_SLICE_SHIFT: u32 = 8;
/// Longest slice: 2 to this power ticks (2.4 h).
const MAX_SLICE_SHIFT: u32 = 40;
/// Highest jerk, in steps per second cubed.
pub const MAX_JERK: u32 = u32::MAX;

const F: u128 = TICK_HZ as u128;

/// The planned motion of one move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SCurve {
    steps: u32,
    shift: u32,
    q: u64,
    p: u64,
    m: u64,
}

impl SCurve {
    /// Plans a move of `steps` steps. Limits are taken into 1 … [`MAX_STEP_RATE`], 1 … [`MAX_ACCELERATION`] and
    /// 1 … [`MAX_JERK`].
    pub fn new(steps: u32, rate: u32, acceleration: u32, jerk: u32) -> Self {
        let n = u128::from(steps);
        let v = u128::from(rate.clamp(1, MAX_STEP_RATE));
        let a = u128::from(acceleration.clamp(1, MAX_ACCELERATION));
        let j = u128::from(jerk.max(1));
        // N f³ < 2³² 2⁸¹: nothing below reaches 2¹²⁸.
        let nf = n.saturating_mul(F);
        let (nf2, nf3) = (nf.saturating_mul(F), nf.saturating_mul(F).saturating_mul(F));
        let mut plan = Self { steps, shift: MAX_SLICE_SHIFT, q: 1, p: 1, m: 2 };
        if steps == 0 {
            return plan;
        }
        for shift in MIN_SLICE_SHIFT..=MAX_SLICE_SHIFT {
            let up = |numerator: u128, divisor: u128, power: u32| {
                let divisor = divisor.checked_shl(shift.saturating_mul(power)).unwrap_or(u128::MAX);
                numerator.div_ceil(divisor.max(1)).max(1)
            };
            // Slices that would be needed at M = 1; all three are divided by M below.
            let (rate_slices, pa, pj) = (up(nf, v, 1), up(nf2, a, 2), up(nf3, j, 3));
            let boxes = |m: u128| {
                let root = pj.div_ceil(m);
                let floor = root.isqrt();
                let root = if floor.saturating_mul(floor) < root { floor.saturating_add(1) } else { floor };
                let p = pa.div_ceil(m).max(root);
                (p, pj.div_ceil(m.saturating_mul(p)).clamp(1, p))
            };
            let fits = |m: u128| {
                let (p, q) = boxes(m);
                p.saturating_add(q) <= m
            };
            let limit = u128::from(MAX_SLICES);
            if rate_slices > limit || !fits(limit) {
                continue;
            }
            let (mut low, mut high) = (rate_slices, limit);
            while low < high {
                let middle = low.saturating_add(high) >> 1;
                if fits(middle) {
                    high = middle;
                } else {
                    low = middle.saturating_add(1);
                }
            }
            let (p, q) = boxes(high);
            if p.saturating_add(q).saturating_add(high) <= limit {
                let narrow = |x: u128| u64::try_from(x).unwrap_or(u64::MAX);
                plan = Self { steps, shift, q: narrow(q), p: narrow(p), m: narrow(high) };
                break;
            }
        }
        plan
    }

    /// Number of steps.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// Slices of the three boxes q, p and M, and ticks of a slice.
    pub fn slices(&self) -> ([u64; 3], u64) {
        ([self.q, self.p, self.m], 1u64.checked_shl(self.shift).unwrap_or(0))
    }

    /// Slices of the whole move.
    fn count(&self) -> u64 {
        self.q.saturating_add(self.p).saturating_add(self.m).saturating_sub(2)
    }

    /// Ticks from the end of the previous instruction to the end of the move; 0 without steps.
    pub fn duration(&self) -> u64 {
        if self.steps == 0 {
            return 0;
        }
        let motion = self.count().checked_shl(self.shift).unwrap_or(u64::MAX);
        motion.saturating_add(DIR_DELAY + DIR_SETUP + STEP_PULSE)
    }

    /// q p M.
    fn total(&self) -> u64 {
        self.q.saturating_mul(self.p).saturating_mul(self.m)
    }

    /// Sum of the first `i` values of the convolution: Σ over the four corners of box_p ∗ box_M of the
    /// sums of box_q, each a polynomial of third degree.
    fn sum(&self, i: u64) -> u64 {
        // Number of (a, b, c) ≥ 0 with a + b + c < i: i (i + 1) (i + 2) / 6 .. by inclusion and
        // exclusion of the three upper ends.
        let free = |i: u64| {
            let product = u128::from(i)
                .saturating_mul(u128::from(i.saturating_add(1)))
                .saturating_mul(u128::from(i.saturating_add(2)));
            product / 6
        };
        let (q, p, m) = (self.q, self.p, self.m);
        let at = |less: u64| i.checked_sub(less).map_or(0, free);
        let (qp, qm, pm) = (q.saturating_add(p), q.saturating_add(m), p.saturating_add(m));
        let plus = free(i).saturating_add(at(qp)).saturating_add(at(qm)).saturating_add(at(pm));
        let minus =
            at(q).saturating_add(at(p)).saturating_add(at(m)).saturating_add(at(qp.saturating_add(m)));
        u64::try_from(plus.saturating_sub(minus)).unwrap_or(u64::MAX)
    }

    /// Tick of step `k` (1 … N) after the origin: the definition, word for word. `None` beyond.
    pub fn tick_of(&self, k: u32) -> Option<u64> {
        if k == 0 || k > self.steps {
            return None;
        }
        let n2 = u64::from(self.steps).saturating_mul(2);
        let wanted = u64::from(k).saturating_mul(2).saturating_sub(1).saturating_mul(self.total());
        let (mut low, mut high) = (0, self.count());
        // The last slice whose beginning lies before the step.
        while low < high {
            let middle = low.saturating_add(high).saturating_add(1) >> 1;
            if n2.saturating_mul(self.sum(middle)) < wanted {
                low = middle;
            } else {
                high = middle.saturating_sub(1);
            }
        }
        let before = n2.saturating_mul(self.sum(low));
        let width = n2.saturating_mul(self.sum(low.saturating_add(1))).saturating_sub(before);
        let (within, _) = self.divide(wanted.saturating_sub(before), width);
        Some(low.checked_shl(self.shift).unwrap_or(u64::MAX).saturating_add(within))
    }

    /// ⌊S x / width⌋ and the remainder.
    fn divide(&self, x: u64, width: u64) -> (u64, u64) {
        let scaled = u128::from(x).checked_shl(self.shift).unwrap_or(0);
        let width = u128::from(width.max(1));
        let narrow = |x: u128| u64::try_from(x).unwrap_or(u64::MAX);
        (narrow(scaled.checked_div(width).unwrap_or(0)), narrow(scaled.checked_rem(width).unwrap_or(0)))
    }
}

/// The ticks of all steps of an S-curve after its origin, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SCurveSteps {
    curve: SCurve,
    /// Steps yielded.
    done: u32,
    /// Slice under way, 2 N C at its begin and over its width; `None` before the first.
    slice: u64,
    begin: u64,
    width: u64,
    /// Time of the last step within the slice and its remainder over `width`; `None` before the first
    /// step of the slice.
    last: Option<(u64, u64)>,
    /// Time between two steps of this slice: whole ticks and remainder over `width`.
    interval: (u64, u64),
}

impl SCurveSteps {
    /// Begins with the first step.
    pub fn new(curve: SCurve) -> Self {
        let mut steps = Self { curve, done: 0, slice: 0, begin: 0, width: 0, last: None, interval: (0, 0) };
        steps.width = steps.end_of(0);
        steps
    }

    fn end_of(&self, slice: u64) -> u64 {
        u64::from(self.curve.steps).saturating_mul(2).saturating_mul(self.curve.sum(slice.saturating_add(1)))
    }
}

impl Iterator for SCurveSteps {
    type Item = u64;

    fn next(&mut self) -> Option<u64> {
        if self.done >= self.curve.steps {
            return None;
        }
        self.done = self.done.saturating_add(1);
        let total = self.curve.total();
        let wanted = u64::from(self.done).saturating_mul(2).saturating_sub(1).saturating_mul(total);
        while self.begin.saturating_add(self.width) < wanted && self.slice < self.curve.count() {
            self.slice = self.slice.saturating_add(1);
            self.begin = self.begin.saturating_add(self.width);
            self.width = self.end_of(self.slice).saturating_sub(self.begin);
            self.last = None;
        }
        let within = match self.last {
            None => {
                self.interval = (0, 0);
                self.curve.divide(wanted.saturating_sub(self.begin), self.width)
            }
            Some((tick, rest)) => {
                if self.interval == (0, 0) {
                    self.interval = self.curve.divide(total.saturating_mul(2), self.width);
                }
                let (tick, rest) =
                    (tick.saturating_add(self.interval.0), rest.saturating_add(self.interval.1));
                if rest >= self.width {
                    (tick.saturating_add(1), rest.saturating_sub(self.width))
                } else {
                    (tick, rest)
                }
            }
        };
        self.last = Some(within);
        Some(self.slice.checked_shl(self.curve.shift).unwrap_or(u64::MAX).saturating_add(within.0))
    }
}
