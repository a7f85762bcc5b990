//! Step times: the incremental generator, the closed definition, and the continuous motion.

mod common;

use common::naive::{s_curve_ticks, slices, step_ticks};
use daic_firmware::motion::*;
use proptest::prelude::*;

fn generated(n: u32, v: u32, a: u32) -> Vec<u64> {
    TrapezoidSteps::new(Trapezoid::new(n, v, a)).collect()
}

/// Inverse of x(t) in ticks, in floating point.
fn analytic(n: u32, v: u32, a: u32, k: u32) -> f64 {
    let (n, v, a, k, f) = (f64::from(n), f64::from(v), f64::from(a), f64::from(k), 125e6);
    let seconds = if v * v < a * n {
        let ramp = v * v / (2.0 * a);
        if k <= ramp {
            (2.0 * k / a).sqrt()
        } else if n - k <= ramp {
            n / v + v / a - (2.0 * (n - k) / a).sqrt()
        } else {
            k / v + v / (2.0 * a)
        }
    } else if 2.0 * k <= n {
        (2.0 * k / a).sqrt()
    } else {
        2.0 * (n / a).sqrt() - (2.0 * (n - k) / a).sqrt()
    };
    f * seconds
}

fn check(n: u32, v: u32, a: u32) {
    let profile = Trapezoid::new(n, v, a);
    let ticks = generated(n, v, a);
    assert_eq!(
        ticks,
        step_ticks(n.into(), v.into(), a.into()),
        "n {n} v {v} a {a}: generator and formula differ"
    );
    for (k, &t) in (1..=n).zip(&ticks) {
        assert_eq!(profile.tick_of(k), Some(t));
        let exact = analytic(n, v, a, k);
        // The floors cost less than one tick; the rest is the rounding of f64.
        assert!(
            (t as f64 - exact).abs() < 1.0 + 4e-16 * exact,
            "n {n} v {v} a {a} k {k}: {t} against {exact}"
        );
    }
    // No step comes sooner than the rate allows, but for the floors.
    let shortest = 125_000_000 / u64::from(v);
    for pair in ticks.windows(2) {
        assert!(pair[1] - pair[0] + 2 >= shortest, "n {n} v {v} a {a}: {pair:?}");
        assert!(pair[1] - pair[0] >= STEP_PULSE + 4);
    }
    let expected = ticks.last().map_or(0, |last| last + DIR_DELAY + DIR_SETUP + STEP_PULSE);
    assert_eq!(profile.duration(), expected);
    let peak = f64::from(v).min((f64::from(a) * f64::from(n)).sqrt());
    assert!((profile.peak_rate().to_num::<f64>() - peak).abs() < 1e-6 * peak + 1e-9);
}

#[test]
fn worked_examples() {
    // By hand, a = 2 000 000: A(1) = 125 000 000 √(2/a) = 125 000, A(2) = 176 776.
    assert_eq!(generated(1, 64_000, 2_000_000), [176_776]); // T = 2 f √(1/a)
    assert_eq!(generated(2, 64_000, 2_000_000), [125_000, 250_000]);
    assert_eq!(generated(4, 64_000, 2_000_000), [125_000, 176_776, 228_553, 353_553]);
    // v²/(2a) = 0.25: all cruise but the last; f/v = 125 000, start-up v/(2a) = 31 250.
    assert_eq!(generated(3, 1000, 2_000_000), [156_250, 281_250, 437_500]);
    assert!(generated(0, 1000, 2_000_000).is_empty());
    assert_eq!(Trapezoid::new(0, 1000, 1000).duration(), 0);
}

#[test]
fn extremes() {
    for v in [1, 2, 3, 999, 64_000, MAX_STEP_RATE] {
        for a in [1, 2, 7, 1_000_003, MAX_ACCELERATION - 1, MAX_ACCELERATION] {
            for n in [1, 2, 3, 4, 5, 100, 4097] {
                check(n, v, a);
            }
        }
    }
}

#[test]
fn a_million_steps_at_full_speed() {
    check(1_000_000, MAX_STEP_RATE, 123_457);
    check(640_000, 64_000, 2_000_000);
}

#[test]
fn longest_moves_do_not_overflow() {
    for (v, a) in [(1, 1), (MAX_STEP_RATE, 1), (1, MAX_ACCELERATION), (MAX_STEP_RATE, MAX_ACCELERATION)] {
        let p = Trapezoid::new(u32::MAX, v, a);
        let exact = analytic(u32::MAX, v, a, u32::MAX);
        let last = p.tick_of(u32::MAX).unwrap();
        assert!((last as f64 - exact).abs() <= 1.0 + 1e-15 * exact);
        let mut steps = TrapezoidSteps::new(p);
        for k in 1..1000 {
            assert_eq!(steps.next(), p.tick_of(k));
        }
    }
}

proptest! {
    #![proptest_config(common::random::config(256))]

    #[test]
    fn any_move(n in 0u32..3000, v in 1..=MAX_STEP_RATE, log_a in 0f64..9.0) {
        check(n, v, 10f64.powf(log_a) as u32);
    }

    /// A longer move never takes less time: the verifier relies on it.
    #[test]
    fn duration_grows_with_the_distance(n in 0u32..1_000_000, more in 0u32..100, v in 1..=MAX_STEP_RATE, a in 1..=MAX_ACCELERATION) {
        prop_assert!(Trapezoid::new(n + more, v, a).duration() >= Trapezoid::new(n, v, a).duration());
    }

    #[test]
    fn any_s_curve(n in 0u32..2000, v in 1..=MAX_STEP_RATE, log_a in 0f64..9.0, log_j in 0f64..9.6) {
        check_s_curve(n, v, 10f64.powf(log_a) as u32, 10f64.powf(log_j) as u32);
    }

    /// The bound that the verifier uses where it does not know how far a move goes.
    #[test]
    fn no_shorter_s_curve_takes_longer(n in 1u32..1_000_000, less in 0f64..1.0, v in 1..=MAX_STEP_RATE, log_a in 0f64..9.0, log_j in 0f64..9.6) {
        let (a, j) = (10f64.powf(log_a) as u32, 10f64.powf(log_j) as u32);
        let shorter = (f64::from(n) * less) as u32;
        prop_assert!(Profile::new(shorter, v, a, j).duration() <= Profile::longest(n, v, a, j));
    }
}

/// Every step of an S-curve against the boxes convolved one by one; rate, acceleration and jerk
/// within their limits; no slower than 4 slices and rounding need beyond the time-optimal motion.
fn check_s_curve(n: u32, v: u32, a: u32, j: u32) {
    let curve = SCurve::new(n, v, a, j);
    let generated: Vec<u64> = SCurveSteps::new(curve).collect();
    let (expected, length) = s_curve_ticks(n.into(), v.into(), a.into(), j.into());
    assert_eq!(generated, expected, "n {n} v {v} a {a} j {j}");
    for (k, &t) in (1..=n).zip(&generated) {
        assert_eq!(curve.tick_of(k), Some(t));
    }
    if n == 0 {
        assert_eq!(curve.duration(), 0);
        return;
    }
    assert_eq!(curve.duration(), length + DIR_DELAY + DIR_SETUP + STEP_PULSE);
    assert!(generated.windows(2).all(|p| p[1] - p[0] + 2 >= 125_000_000 / u64::from(v)));
    let (q, p, m, s) = slices(n.into(), v.into(), a.into(), j.into());
    let ([cq, cp, cm], ticks) = curve.slices();
    assert_eq!((u128::from(cq), u128::from(cp), u128::from(cm), ticks), (q, p, m, 1 << s));
    // In seconds: the convolution's height, slope and curvature against the limits.
    let (n, q, p, m) = (f64::from(n), q as f64, p as f64, m as f64);
    let slice = ticks as f64 / 125e6;
    let eps = 1.0 + 1e-12;
    assert!(n / (m * slice) <= f64::from(v) * eps);
    assert!(n / (m * p * slice.powi(2)) <= f64::from(a) * eps);
    assert!(n / (m * p * q * slice.powi(3)) <= f64::from(j) * eps);
}

#[test]
fn s_curves_take_little_longer_than_the_best() {
    // N = 6400, v = 64 000, a = 2·10⁶, j = 10⁹ by hand: j-ramp a/j = 2 ms, v/a = 32 ms, N/v = 100 ms:
    // T = 100 + 32 + 2 = 134 ms.
    let curve = SCurve::new(6400, 64_000, 2_000_000, 1_000_000_000);
    let seconds = (curve.duration() - DIR_DELAY - DIR_SETUP - STEP_PULSE) as f64 / 125e6;
    // At most a slice of 2¹⁴ ticks (131 µs) lost in each of the three boxes.
    assert!((0.134 - 3e-4..0.134 + 4e-4).contains(&seconds), "{seconds}");
    check_s_curve(6400, 64_000, 2_000_000, 1_000_000_000);
    // Short and jerk-limited alone: T = 4 ∛(N/2j) = 4 ∛(1/2·10⁹·10) ...
    let curve = SCurve::new(20, 250_000, 1_000_000_000, 1_000_000_000);
    let seconds = (curve.duration() - DIR_DELAY - DIR_SETUP - STEP_PULSE) as f64 / 125e6;
    let best = 4.0 * (20.0f64 / 2e9).cbrt();
    // Convolved boxes of q, p and M slices are q + p + M − 2 slices long, where continuous ones are q + p + M.
    let (_, slice) = curve.slices();
    let least = best - 2.0 * slice as f64 / 125e6;
    assert!(seconds >= least && seconds < best * 1.01, "{seconds} against {best}");
}

#[test]
fn extreme_s_curves() {
    for v in [1, 999, MAX_STEP_RATE] {
        for a in [1, 1_000_003, MAX_ACCELERATION] {
            for j in [1, 1_000_000, MAX_JERK] {
                for n in [1, 2, 5, 300] {
                    check_s_curve(n, v, a, j);
                }
            }
        }
    }
    for j in [1, MAX_JERK] {
        let curve = SCurve::new(u32::MAX, MAX_STEP_RATE, MAX_ACCELERATION, j);
        let mut steps = SCurveSteps::new(curve);
        for k in 1..1000 {
            assert_eq!(steps.next(), curve.tick_of(k));
        }
        assert!(curve.tick_of(u32::MAX).unwrap() < curve.duration());
    }
}
