//! When the steps of a move come: the closed definitions of `docs/controller.md`.

use daic_protocol::limits::TICK_HZ;

const F: u128 = TICK_HZ as u128;
/// Most slices of an S-curve.
const SLICES: u128 = 2048;

/// Rate, acceleration and jerk of a move, in steps and seconds; no jerk limit where it is 0.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    pub(super) rate: u32,
    pub(super) acceleration: u32,
    pub(super) jerk: u32,
}

/// Ticks after the origin of a move of `steps` steps (at least 1), at most `most` of them, and the tick at
/// which the motion ends; `None` if there are more, or a limit is zero.
pub(super) fn times(steps: u32, pace: Pace, most: usize) -> Option<(Vec<u64>, u64)> {
    if pace.rate == 0 || pace.acceleration == 0 || usize::try_from(steps).ok()? > most {
        return None;
    }
    if pace.jerk > 0 {
        return s_curve(u128::from(steps), pace);
    }
    let ticks: Vec<u64> = (1..=steps).map(|k| trapezoid(k, steps, pace.rate, pace.acceleration)).collect();
    let end = *ticks.last()?;
    Some((ticks, end))
}

/// Tick of step `k` of `n`, after the origin of the move.
fn trapezoid(k: u32, n: u32, rate: u32, acceleration: u32) -> u64 {
    let [k, n, v, a] = [k, n, rate, acceleration].map(u128::from);
    let accelerated = |j: u128| (2 * j * F * F / a).isqrt();
    let tick = if v * v < a * n {
        if 2 * a * k <= v * v {
            accelerated(k)
        } else if 2 * a * (n - k) <= v * v {
            F * (n * a + v * v) / (a * v) - accelerated(n - k)
        } else {
            F * (2 * a * k + v * v) / (2 * a * v)
        }
    } else if 2 * k <= n {
        accelerated(k)
    } else {
        (4 * n * F * F / a).isqrt() - accelerated(n - k)
    };
    u64::try_from(tick).unwrap_or(u64::MAX)
}

/// Numbers of slices q, p, M and the shift s of their length.
fn slices(n: u128, pace: Pace) -> Option<(u128, u128, u128, u32)> {
    let [v, a, j] = [pace.rate, pace.acceleration, pace.jerk].map(u128::from);
    (8..=40).find_map(|s| {
        let [one, two, three] = [n * F, n * F * F, n * F * F * F];
        let least = one.div_ceil(v << s).max(1);
        let (pa, pj) = (two.div_ceil(a << (2 * s)).max(1), three.div_ceil((j << s) << (2 * s)).max(1));
        let boxes = |m: u128| {
            let square = pj.div_ceil(m);
            let root = square.isqrt();
            let root = if root * root < square { root + 1 } else { root };
            let p = pa.div_ceil(m).max(root);
            (pj.div_ceil(m * p).max(1).min(p), p)
        };
        let m = (least..=SLICES).find(|&m| {
            let (q, p) = boxes(m);
            p + q <= m
        })?;
        let (q, p) = boxes(m);
        (p + q + m <= SLICES).then_some((q, p, m, s))
    })
}

/// The running sum of `length` values up to each place: the convolution with a box.
fn convolve(values: &[u128], length: usize) -> Vec<u128> {
    let mut sum = 0;
    (0..values.len() + length - 1)
        .map(|i| {
            sum += values.get(i).copied().unwrap_or(0);
            sum -= i.checked_sub(length).and_then(|left| values.get(left)).copied().unwrap_or(0);
            sum
        })
        .collect()
}

fn s_curve(n: u128, pace: Pace) -> Option<(Vec<u64>, u64)> {
    let (q, p, m, s) = slices(n, pace)?;
    let [boxes, ramps] = [p, m].map(|x| usize::try_from(x).unwrap_or(usize::MAX));
    let widths = convolve(&convolve(&vec![1; usize::try_from(q).ok()?], boxes), ramps);
    let (mut i, mut before) = (0, 0);
    let mut ticks = Vec::new();
    for k in 1..=n {
        let wanted = (2 * k - 1) * q * p * m;
        // the last slice that begins before the step
        while 2 * n * (before + widths[i]) < wanted {
            before += widths[i];
            i += 1;
        }
        let within = ((wanted - 2 * n * before) << s) / (2 * n * widths[i]);
        ticks.push(u64::try_from(((i as u128) << s) + within).ok()?);
    }
    Some((ticks, (widths.len() as u64) << s))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_follow_the_trapezoid_of_continuous_motion() {
        // x(t) for 1000 steps at 8000 steps/s and 100 000 steps/s²: 80 ms up over 320 steps, 45 ms of
        // cruise over 360 steps, 80 ms down
        let (n, v, a) = (1000u32, 8000u32, 100_000u32);
        let f = f64::from(TICK_HZ);
        for k in 1..=n {
            let x = f64::from(k);
            let seconds = if x <= 320.0 {
                (2.0 * x / f64::from(a)).sqrt()
            } else if x <= 680.0 {
                0.08 + (x - 320.0) / f64::from(v)
            } else {
                0.205 - (2.0 * (1000.0 - x) / f64::from(a)).sqrt()
            };
            let difference = trapezoid(k, n, v, a) as f64 - seconds * f;
            assert!(difference.abs() <= 1.0, "step {k}: {difference} ticks");
        }
    }

    /// An S-curve that speeds up over `t` seconds of constant jerk and as much of the opposite one stands
    /// at j t³ after 2 t; the steps of the plan pass there when continuous motion does, within the slices
    /// by which the plan is rounded.
    #[test]
    fn steps_follow_the_s_curve_of_continuous_motion() {
        let (n, jerk, t) = (40_000u32, 4_000_000u32, 0.1f64);
        // rate j t², acceleration j t: neither has a part at its limit
        let pace = Pace { rate: 40_000, acceleration: 400_000, jerk };
        let (ticks, end) = times(n, pace, 1 << 20).expect("a move");
        let f = f64::from(TICK_HZ);
        let slice = (1u64 << slices(u128::from(n), pace).expect("slices").3) as f64 / f;
        // 4 t of speeding up and slowing down for 2 j t³ steps, the others at 40 000 steps/s
        let length = 4.0 * t + (f64::from(n) - 8000.0) / 40_000.0;
        let excess = end as f64 / f - length;
        // the three boxes are rounded up by less than a slice each, their convolution is two shorter than they
        assert!((-2.0 * slice..=slice).contains(&excess), "{excess} s longer, slices of {slice} s");
        for (steps, seconds) in [(4000u32, 2.0 * t), (20_000, length / 2.0), (36_000, length - 2.0 * t)] {
            let found = ticks[steps as usize - 1] as f64 / f;
            assert!((found - seconds).abs() <= 3.0 * slice, "{steps}: {found} s, wanted {seconds} s");
        }
    }
}
