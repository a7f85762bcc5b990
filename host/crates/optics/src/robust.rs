//! Loss functions of normalised residuals, and their spread.

/// Huber's constant: 95 % efficiency for normal errors.
pub(crate) const HUBER: f64 = 1.345;

/// Loss of the normalised residuals.
#[derive(Clone, Copy)]
pub(crate) enum Loss {
    Squares,
    /// Linear beyond this many standard deviations.
    Huber(f64),
}

impl Loss {
    pub(crate) fn of(self, r: f64) -> f64 {
        match self {
            Self::Huber(k) if r.abs() > k => k * (2.0 * r.abs() - k),
            _ => r * r,
        }
    }

    pub(crate) fn weight(self, r: f64) -> f64 {
        match self {
            Self::Huber(k) if r.abs() > k => k / r.abs(),
            _ => 1.0,
        }
    }
}

/// Robust standard deviation of the normalised residuals, at least 1.
pub(crate) fn spread(normalised: impl IntoIterator<Item = f64>) -> f64 {
    let mut magnitude: Vec<f64> = normalised.into_iter().map(f64::abs).collect();
    if magnitude.is_empty() {
        return 1.0;
    }
    let half = magnitude.len() / 2;
    let (_, middle, _) = magnitude.select_nth_unstable_by(half, f64::total_cmp);
    (1.4826 * *middle).max(1.0)
}
