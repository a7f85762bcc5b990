//! Colour maps and the limits between which they run.

/// A colour map that is monotonic in lightness (or, for errors, in lightness from the middle out)
/// and readable with colour-blind eyes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColourMap {
    /// Perceptually uniform, dark blue over green to yellow: measured values.
    Viridis,
    /// Perceptually uniform, blue to yellow, the same for red-green blind eyes: measured values.
    Cividis,
    /// Blue below, white at the middle, red above: errors and other signed values.
    Diverging,
}

impl ColourMap {
    /// Colour at `t` in 0..=1 (clamped; NaN gives the colour at 0).
    #[must_use]
    pub fn rgb(self, t: f64) -> [u8; 3] {
        let t = if t.is_nan() { 0.0 } else { t.clamp(0.0, 1.0) };
        let c = match self {
            ColourMap::Viridis => colorous::VIRIDIS.eval_continuous(t),
            ColourMap::Cividis => colorous::CIVIDIS.eval_continuous(t),
            ColourMap::Diverging => colorous::RED_BLUE.eval_continuous(1.0 - t),
        };
        [c.r, c.g, c.b]
    }
}

/// Values at the two ends of a colour map; `low < high`, both finite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    low: f64,
    high: f64,
}

impl Limits {
    /// Fixed limits; put in order, and set apart if they are equal. Limits that are not finite
    /// become 0 and 1.
    #[must_use]
    pub fn fixed(a: f64, b: f64) -> Self {
        if !(a.is_finite() && b.is_finite()) {
            return Limits { low: 0.0, high: 1.0 };
        }
        let (low, high) = (a.min(b), a.max(b));
        if high > low {
            return Limits { low, high };
        }
        let apart = if low == 0.0 { 1.0 } else { low.abs() * 1e-6 };
        Limits { low: low - apart, high: high + apart }
    }

    /// Smallest to largest finite value; 0 to 1 if there is none.
    #[must_use]
    pub fn of(values: &[f64]) -> Self {
        Self::quantiles(values, 0.0)
    }

    /// From the `fraction` quantile to the `1 - fraction` quantile of the finite values, so that
    /// single outliers do not take the colours away from the rest; 0 to 1 if there is none.
    #[must_use]
    pub fn quantiles(values: &[f64], fraction: f64) -> Self {
        let mut finite: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
        if finite.is_empty() {
            return Limits { low: 0.0, high: 1.0 };
        }
        finite.sort_by(f64::total_cmp);
        let last = finite.len() - 1;
        let cut = (fraction.clamp(0.0, 0.5) * last as f64).round() as usize;
        Limits::fixed(finite[cut.min(last)], finite[last - cut.min(last)])
    }

    /// From minus to plus the largest magnitude: for [`ColourMap::Diverging`].
    #[must_use]
    pub fn symmetric(values: &[f64]) -> Self {
        let largest = values.iter().filter(|v| v.is_finite()).fold(0.0_f64, |m, v| m.max(v.abs()));
        Limits::fixed(-largest, largest)
    }

    /// Value at the lower end.
    #[must_use]
    pub fn low(&self) -> f64 {
        self.low
    }

    /// Value at the upper end.
    #[must_use]
    pub fn high(&self) -> f64 {
        self.high
    }

    /// Where a value lies between the limits: 0 at the lower, 1 at the upper, not clamped.
    #[must_use]
    pub fn position(&self, value: f64) -> f64 {
        // Halves, so that limits of opposite sign and extreme size do not overflow.
        (value / 2.0 - self.low / 2.0) / (self.high / 2.0 - self.low / 2.0)
    }
}

/// A colour map between limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColourScale {
    /// The colours.
    pub map: ColourMap,
    /// The values at their ends.
    pub limits: Limits,
}

impl ColourScale {
    /// Viridis between the smallest and the largest value.
    #[must_use]
    pub fn values(values: &[f64]) -> Self {
        ColourScale { map: ColourMap::Viridis, limits: Limits::of(values) }
    }

    /// Diverging colours, symmetric about zero.
    #[must_use]
    pub fn errors(values: &[f64]) -> Self {
        ColourScale { map: ColourMap::Diverging, limits: Limits::symmetric(values) }
    }

    /// Red, green, blue and opacity of a value: transparent for NaN, the end colours beyond the
    /// limits.
    #[must_use]
    pub fn rgba(&self, value: f64) -> [u8; 4] {
        if value.is_nan() {
            return [0, 0, 0, 0];
        }
        let [r, g, b] = self.map.rgb(self.limits.position(value));
        [r, g, b, 255]
    }
}

/// Colours that are told apart on light and dark ground, for lines and marks.
pub(crate) fn line_colour(index: usize) -> &'static str {
    const COLOURS: [&str; 6] = ["#2f7fd0", "#e07b00", "#1f9e74", "#b457c4", "#d6453d", "#7f8790"];
    COLOURS[index % COLOURS.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_and_middle_are_the_published_colours() {
        // matplotlib: viridis(0) = #440154, viridis(1) = #fde725; cividis(0) = #00204c (8 bit).
        assert_eq!(ColourMap::Viridis.rgb(0.0), [0x44, 0x01, 0x54]);
        assert_eq!(ColourMap::Viridis.rgb(1.0), [0xfd, 0xe7, 0x25]);
        let [r, _, b] = ColourMap::Diverging.rgb(0.0);
        assert!(b > r, "blue below");
        let [r, _, b] = ColourMap::Diverging.rgb(1.0);
        assert!(r > b, "red above");
        assert!(ColourMap::Diverging.rgb(0.5).iter().all(|&c| c > 235), "white in the middle");
    }

    #[test]
    fn lightness_of_value_maps_rises_throughout() {
        for map in [ColourMap::Viridis, ColourMap::Cividis] {
            let light = |i: u32| {
                let [r, g, b] = map.rgb(f64::from(i) / 64.0).map(f64::from);
                0.2126 * r + 0.7152 * g + 0.0722 * b
            };
            assert!((0..64).all(|i| light(i + 1) > light(i)), "{map:?}");
        }
    }

    #[test]
    fn limits() {
        let values = [3.0, f64::NAN, -1.0, f64::INFINITY];
        assert_eq!((Limits::of(&values).low(), Limits::of(&values).high()), (-1.0, 3.0));
        let s = Limits::symmetric(&values);
        assert_eq!((s.low(), s.high(), s.position(0.0)), (-3.0, 3.0, 0.5));
        assert!(Limits::fixed(2.0, 2.0).low() < 2.0 && Limits::fixed(2.0, 2.0).high() > 2.0);
        assert_eq!(Limits::of(&[f64::NAN]), Limits::fixed(0.0, 1.0));
        assert_eq!(Limits::fixed(f64::MAX, -f64::MAX).position(0.0), 0.5);
        let mut many: Vec<f64> = (0..=100).map(f64::from).collect();
        many[0] = -1e9;
        assert_eq!(Limits::quantiles(&many, 0.02).low(), 2.0);
    }

    #[test]
    fn not_a_number_is_transparent_and_beyond_is_the_end() {
        let scale = ColourScale { map: ColourMap::Viridis, limits: Limits::fixed(0.0, 2.0) };
        assert_eq!(scale.rgba(f64::NAN), [0, 0, 0, 0]);
        assert_eq!(scale.rgba(9.0), scale.rgba(2.0));
        assert_eq!(scale.rgba(f64::NEG_INFINITY), scale.rgba(0.0));
    }
}
