//! Ticks at round values.

use crate::number::minus;

/// Values at which an axis is labelled.
#[derive(Debug, Clone, PartialEq)]
pub struct Ticks {
    /// The values, ascending.
    pub values: Vec<f64>,
    /// Distance between them: 1, 2 or 5 times a power of ten.
    pub step: f64,
}

impl Ticks {
    /// Round values from `low` to `high`, at most `most` of them (two or more).
    #[must_use]
    pub fn between(low: f64, high: f64, most: usize) -> Self {
        let span = high - low;
        if !(span.is_finite() && span > 0.0) {
            return Ticks { values: if low.is_finite() { vec![low] } else { vec![] }, step: 1.0 };
        }
        Self::spaced(low, high, span / (most.max(2) as f64 - 1.0))
    }

    /// Round values from `low` to `high`, the least round step of at least `least` apart.
    #[must_use]
    pub fn spaced(low: f64, high: f64, least: f64) -> Self {
        let valid = low.is_finite() && high > low && high.is_finite() && least > 0.0 && least.is_finite();
        if !valid {
            return Ticks { values: if low.is_finite() { vec![low] } else { vec![] }, step: 1.0 };
        }
        let mut step = 10f64.powf(least.log10().floor());
        let factors = [1.0, 2.0, 5.0, 10.0];
        if let Some(f) = factors.iter().find(|&f| step * f >= least * (1.0 - 1e-9)) {
            step *= f;
        }
        // Multiples of the step, not sums: sums drift off the round values.
        let first = (low / step - 1e-9).ceil();
        let last = (high / step + 1e-9).floor();
        let count = (last - first).clamp(0.0, 100.0) as usize;
        let values = (0..=count).map(|i| (first + i as f64) * step);
        Ticks { values: values.filter(|v| *v <= high + step * 1e-6).collect(), step }
    }

    /// Label of a tick, with just the decimals that the step needs.
    #[must_use]
    pub fn label(&self, value: f64) -> String {
        let exponent = (self.step.log10() + 1e-9).floor() as i32;
        let value = if value.abs() < self.step * 1e-6 { 0.0 } else { value };
        if !(-6..=6).contains(&exponent) {
            if value == 0.0 {
                return "0".into();
            }
            return minus(&format!("{value:.3e}").replace(".000e", "e"));
        }
        let decimals = usize::try_from(-exponent).unwrap_or(0);
        minus(&format!("{value:.decimals$}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_values() {
        let t = Ticks::between(-9.7, 9.7, 6);
        assert_eq!(t.values, [-5.0, 0.0, 5.0]);
        let t = Ticks::between(0.0, 1.0, 6);
        assert_eq!(
            t.values.iter().map(|&v| t.label(v)).collect::<Vec<_>>(),
            ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
        );
        let t = Ticks::between(199.98, 200.03, 6);
        assert_eq!(t.label(t.values[0]), "199.98");
        let t = Ticks::between(-2e-9, 2e-9, 5);
        assert_eq!(t.label(t.values[0]), "−2e−9");
        assert_eq!(t.label(t.values[2]), "0");
    }

    #[test]
    fn steps_are_the_least_round_ones_that_keep_the_distance() {
        assert_eq!(Ticks::spaced(0.0, 4.2, 1.1).values, [0.0, 2.0, 4.0]);
        assert_eq!(Ticks::spaced(0.0, 700.0, 200.0).values, [0.0, 200.0, 400.0, 600.0]);
        assert_eq!(Ticks::spaced(0.0, 700.0, 201.0).values, [0.0, 500.0]);
        assert_eq!(Ticks::spaced(0.0, 1.0, f64::NAN).values, [0.0]);
    }

    #[test]
    fn never_more_than_asked_and_never_outside() {
        for i in 1..2000u32 {
            let low = f64::from(i).sin() * 10f64.powi((i % 25) as i32 - 12);
            let high = low + f64::from(i).cos().abs() * 10f64.powi((i % 17) as i32 - 8) + 1e-13;
            // Spans near the resolution of f64 have no round values inside.
            if high - low < 1e-10 * low.abs() {
                continue;
            }
            let t = Ticks::between(low, high, 6);
            assert!(t.values.len() <= 6, "{low} {high} {t:?}");
            let slack = (high - low) * 1e-6;
            assert!(t.values.iter().all(|v| *v >= low - slack && *v <= high + slack), "{low} {high} {t:?}");
        }
        for bad in [f64::NAN, f64::INFINITY, 0.0] {
            assert!(Ticks::between(0.0, bad, 5).values.len() <= 1);
        }
    }
}
