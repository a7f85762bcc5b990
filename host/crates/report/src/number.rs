//! Numbers for people: value, uncertainty, unit.

/// `value ± sigma unit`, both rounded to the decimal place of the second significant digit of
/// sigma: `12.346 ± 0.067 µm`. Very small and very large pairs share a power of ten:
/// `(1.234 ± 0.056)e-9 m`. Without a usable sigma (zero, negative, not finite) the value stands
/// with six significant digits and `± 0` or `± ?`.
#[must_use]
pub fn with_uncertainty(value: f64, sigma: f64, unit: &str) -> String {
    if !value.is_finite() {
        return join("—", unit);
    }
    if sigma == 0.0 {
        return join(&format!("{} ± 0", significant(value, 6)), unit);
    }
    if !sigma.is_finite() || sigma < 0.0 {
        return join(&format!("{} ± ?", significant(value, 6)), unit);
    }
    let place = second_digit(sigma);
    let largest = exponent(value.abs().max(sigma));
    if place < -9 || largest > 9 {
        let scaled = |v: f64| scale_down(v, largest);
        let digits = usize::try_from(largest - place).unwrap_or(0).min(17);
        let pair = format!("({:.digits$} ± {:.digits$})e{largest}", scaled(value), scaled(sigma));
        return join(&minus(&pair), unit);
    }
    let text = if place >= 0 {
        let step = 10f64.powi(place);
        format!("{} ± {}", no_minus_zero((value / step).round() * step), (sigma / step).round() * step)
    } else {
        let digits = usize::try_from(-place).unwrap_or(0);
        format!("{} ± {sigma:.digits$}", fixed(value, digits))
    };
    join(&minus(&text), unit)
}

/// A value with so many significant digits and its unit; `—` if it is not finite.
#[must_use]
pub fn plain(value: f64, digits: usize, unit: &str) -> String {
    if !value.is_finite() {
        return join("—", unit);
    }
    join(&significant(value, digits), unit)
}

fn join(text: &str, unit: &str) -> String {
    // A no-break space keeps the unit with its number.
    if unit.is_empty() { text.to_string() } else { format!("{text}\u{a0}{unit}") }
}

fn significant(value: f64, digits: usize) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let digits = digits.clamp(1, 17);
    // Formatting rounds first, so that 9.9996 with four digits counts as 10.00.
    let text = format!("{value:.*e}", digits - 1);
    let exponent = text.split_once('e').and_then(|(_, e)| e.parse::<i32>().ok()).unwrap_or(0);
    if !(-5..=9).contains(&exponent) {
        return minus(&text);
    }
    let decimals = usize::try_from(digits as i32 - 1 - exponent).unwrap_or(0);
    minus(&fixed(value, decimals))
}

/// Decimal exponent of a positive number.
fn exponent(value: f64) -> i32 {
    format!("{value:e}").split_once('e').and_then(|(_, e)| e.parse().ok()).unwrap_or(0)
}

/// Decimal place of the second significant digit, after rounding to two digits.
fn second_digit(sigma: f64) -> i32 {
    let text = format!("{sigma:.1e}");
    text.split_once('e').and_then(|(_, e)| e.parse::<i32>().ok()).unwrap_or(0) - 1
}

/// `value / 10^exponent` without leaving the range of f64 on the way.
fn scale_down(value: f64, exponent: i32) -> f64 {
    let half = exponent / 2;
    value / 10f64.powi(half) / 10f64.powi(exponent - half)
}

fn fixed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(rest) if rest.bytes().all(|b| matches!(b, b'0' | b'.')) => rest.to_string(),
        _ => text,
    }
}

fn no_minus_zero(value: f64) -> f64 {
    if value == 0.0 { 0.0 } else { value }
}

/// Four digits at most, without trailing zeros.
pub(crate) fn short(value: f64) -> String {
    let text = plain(value, 4, "");
    if !text.contains('.') || text.contains('e') {
        return text;
    }
    text.trim_end_matches('0').trim_end_matches('.').to_string()
}

/// The typographic minus sign, which is as wide as a plus.
pub(crate) fn minus(text: &str) -> String {
    text.replace('-', "\u{2212}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with(value: f64, sigma: f64) -> String {
        with_uncertainty(value, sigma, "")
    }

    #[test]
    fn two_digits_of_sigma() {
        assert_eq!(with_uncertainty(12.3456, 0.0673, "µm"), "12.346 ± 0.067\u{a0}µm");
        assert_eq!(with(200.013, 1.26), "200.0 ± 1.3");
        assert_eq!(with(-49.98, 0.0996), "−49.98 ± 0.10");
        assert_eq!(with(0.0001, 0.25), "0.00 ± 0.25");
        assert_eq!(with(-0.0001, 0.25), "0.00 ± 0.25");
        assert_eq!(with(56789.0, 1234.0), "56800 ± 1200");
        assert_eq!(with(-4.0, 1234.0), "0 ± 1200");
        assert_eq!(with(12.0, 12.0), "12 ± 12");
        assert_eq!(with(1.0, 9.96), "1 ± 10");
    }

    #[test]
    fn extremes() {
        assert_eq!(with(1.2345e-9, 5.6e-11), "(1.234 ± 0.056)e−9");
        assert_eq!(with(2.5e20, 1.0e19), "(2.50 ± 0.10)e20");
        assert_eq!(with(1.5, 0.0), "1.50000 ± 0");
        assert_eq!(with(1.5, f64::NAN), "1.50000 ± ?");
        assert_eq!(with_uncertainty(f64::NAN, 1.0, "mm"), "—\u{a0}mm");
        // Nothing may panic, whatever the numbers.
        let odd = [0.0, 5e-324, 1e-308, f64::MAX, -f64::MAX, f64::INFINITY, 1e9, 1e10, 9.99e9];
        for v in odd {
            for s in odd {
                assert!(!with(v, s).is_empty());
            }
        }
    }

    #[test]
    fn significant_digits() {
        assert_eq!(plain(0.0, 4, "mm"), "0\u{a0}mm");
        assert_eq!(plain(9.9996, 4, ""), "10.00");
        assert_eq!(plain(-0.012345, 3, "px"), "−0.0123\u{a0}px");
        assert_eq!(plain(1.5e-9, 2, ""), "1.5e−9");
        assert_eq!(plain(123456.0, 3, ""), "123456");
    }
}
