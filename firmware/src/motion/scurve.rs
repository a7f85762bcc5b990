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
        // In slices of one tick; wide divisions are dear on a small processor, so there are three in all.
        let (by_rate, by_acceleration, by_jerk) = (nf.div_ceil(v), nf2.div_ceil(a), nf3.div_ceil(j));
        for shift in MIN_SLICE_SHIFT..=MAX_SLICE_SHIFT {
            let up = |whole: u128, power: u32| {
                let bits = shift.saturating_mul(power);
                let floor = whole.checked_shr(bits).unwrap_or(0);
                let is_exact = floor.checked_shl(bits) == Some(whole);
                floor.saturating_add(u128::from(!is_exact)).max(1)
            };
            // Slices that would be needed at M = 1; all three are divided by M below.
            let wide = (up(by_rate, 1), up(by_acceleration, 2), up(by_jerk, 3));
            let limit = MAX_SLICES;
            let (square, cube) =
                (limit.saturating_mul(limit), limit.saturating_mul(limit).saturating_mul(limit));
            let fit = |x: u128, most: u64| u64::try_from(x).ok().filter(|x| *x <= most);
            // More than that does not fit, whatever M is.
            let (Some(rate_slices), Some(pa), Some(pj)) =
                (fit(wide.0, limit), fit(wide.1, square), fit(wide.2, cube))
            else {
                continue;
            };
            let boxes = |m: u64| {
                let root = pj.div_ceil(m);
                let floor = root.isqrt();
                let root = if floor.saturating_mul(floor) < root { floor.saturating_add(1) } else { floor };
                let p = pa.div_ceil(m).max(root);
                (p, pj.div_ceil(m.saturating_mul(p)).clamp(1, p))
            };
            let fits = |m: u64| {
                let (p, q) = boxes(m);
                p.saturating_add(q) <= m
            };
            if !fits(limit) {
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
                plan = Self { steps, shift, q, p, m: high };
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

    /// ⌊S x / width⌋ and the remainder; `width` is below 2⁶³. Bit by bit: S is a power of two, and a division of
    /// 128 bits is dear on a small processor.
    fn divide(&self, x: u64, width: u64) -> (u64, u64) {
        let width = width.max(1);
        let (mut quotient, mut rest) = if x < width {
            (0, x)
        } else {
            (x.checked_div(width).unwrap_or(0), x.checked_rem(width).unwrap_or(0))
        };
        for _ in 0..self.shift {
            // The remainder is below `width`.
            (quotient, rest) = (quotient << 1, rest << 1);
            if let Some(less) = rest.checked_sub(width) {
                (quotient, rest) = (quotient | 1, less);
            }
        }
        (quotient, rest)
    }
}

/// The values of box_q ∗ box_p ∗ box_M one after the other. Its generating function is
/// (1 − z^q) (1 − z^p) (1 − z^M) / (1 − z)³: eight corners, summed up three times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Convolution {
    /// Index of the value.
    at: u64,
    /// Corners, their sums, and the value.
    sums: [i64; 3],
}

impl Convolution {
    fn first(curve: &SCurve) -> Self {
        let mut first = Self { at: 0, sums: [0; 3] };
        first.take(curve);
        first
    }

    fn take(&mut self, curve: &SCurve) {
        let (i, q, p, m) = (self.at, curve.q, curve.p, curve.m);
        let is = |at: u64| i64::from(i == at);
        let (qp, qm, pm) = (q.saturating_add(p), q.saturating_add(m), p.saturating_add(m));
        let up = is(0).saturating_add(is(qp)).saturating_add(is(qm)).saturating_add(is(pm));
        let down = is(q).saturating_add(is(p)).saturating_add(is(m)).saturating_add(is(qp.saturating_add(m)));
        let [corners, slope, value] = &mut self.sums;
        *corners = corners.saturating_add(up).saturating_sub(down);
        *slope = slope.saturating_add(*corners);
        *value = value.saturating_add(*slope);
    }

    fn next(&mut self, curve: &SCurve) {
        self.at = self.at.saturating_add(1);
        self.take(curve);
    }

    fn value(&self) -> u64 {
        u64::try_from(self.sums[2]).unwrap_or(0)
    }
}

/// The ticks of all steps of an S-curve after its origin, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SCurveSteps {
    curve: SCurve,
    /// Steps yielded.
    done: u32,
    /// Slice under way, 2 N C at its begin and over its width.
    slice: Convolution,
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
        let slice = Convolution::first(&curve);
        let mut steps = Self { curve, done: 0, slice, begin: 0, width: 0, last: None, interval: (0, 0) };
        steps.width = steps.width_now();
        steps
    }

    fn width_now(&self) -> u64 {
        u64::from(self.curve.steps).saturating_mul(2).saturating_mul(self.slice.value())
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
        while self.begin.saturating_add(self.width) < wanted && self.slice.at < self.curve.count() {
            self.slice.next(&self.curve);
            self.begin = self.begin.saturating_add(self.width);
            self.width = self.width_now();
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
        Some(self.slice.at.checked_shl(self.curve.shift).unwrap_or(u64::MAX).saturating_add(within.0))
    }
}
