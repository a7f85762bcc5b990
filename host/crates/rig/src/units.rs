//! Quantities as they are written in files: a number and its unit, `"633 nm"`.
//!
//! Each quantity is a newtype over one `f64` in one base unit, named by its accessor. A plain
//! number, a unit of another quantity, NaN, and numbers beyond any rig (±1e12 in the base unit, times
//! ±1e15 ns) are refused. `µ` (either code point) and
//! `u` mean the same, `²` and `^2`, `³` and `^3` too.

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Visitor;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::borrow::Cow;
use std::fmt;
use thiserror::Error;

/// A quantity could not be read.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum UnitError {
    /// A number without quotes and unit.
    #[error(
        "{kind} given as the plain number {value}; write it with its unit in quotes, such as \"{example}\" (units: {allowed})"
    )]
    Plain {
        /// Which quantity was wanted.
        kind: &'static str,
        /// The number found.
        value: String,
        /// How to write it.
        example: &'static str,
        /// Units that are understood.
        allowed: String,
    },
    /// Text that does not start with a number.
    #[error("{found:?} does not start with a number; write {kind} such as \"{example}\"")]
    NoNumber {
        /// Which quantity was wanted.
        kind: &'static str,
        /// The text found.
        found: String,
        /// How to write it.
        example: &'static str,
    },
    /// A number in quotes, but no unit after it.
    #[error("{found:?} has no unit; write {kind} such as \"{example}\" (units: {allowed})")]
    NoUnit {
        /// Which quantity was wanted.
        kind: &'static str,
        /// The text found.
        found: String,
        /// How to write it.
        example: &'static str,
        /// Units that are understood.
        allowed: String,
    },
    /// A unit that this quantity does not have.
    #[error("found the unit {found:?}, but {kind} is measured in {allowed}; write it such as \"{example}\"")]
    WrongUnit {
        /// Which quantity was wanted.
        kind: &'static str,
        /// The unit found.
        found: String,
        /// How to write it.
        example: &'static str,
        /// Units that are understood.
        allowed: String,
    },
    /// The number is beyond any rig, or infinite.
    #[error("{found} is out of range: {kind} is within ±{limit}; write it such as \"{example}\"")]
    OutOfRange {
        /// Which quantity was wanted.
        kind: &'static str,
        /// The value found, in short.
        found: String,
        /// Largest size allowed.
        limit: String,
        /// How to write it.
        example: &'static str,
    },
}

/// A unit: `value · multiply / divide` is the value in the base unit. One of the two factors is 1,
/// so that the conversion rounds once.
#[derive(Debug, Clone, Copy)]
struct Unit {
    symbol: &'static str,
    multiply: f64,
    divide: f64,
}

const fn unit(symbol: &'static str, multiply: f64, divide: f64) -> Unit {
    Unit { symbol, multiply, divide }
}

struct Kind {
    /// With its article, as in "a length".
    name: &'static str,
    example: &'static str,
    /// Largest size in the base unit.
    limit: f64,
    /// The base unit comes first.
    units: &'static [Unit],
}

impl Kind {
    fn allowed(&self) -> String {
        self.units.iter().map(|u| u.symbol).collect::<Vec<_>>().join(", ")
    }

    /// Value in the base unit.
    fn parse(&self, text: &str) -> Result<f64, UnitError> {
        let (kind, example) = (self.name, self.example);
        let plain = text.trim().replace('\u{2212}', "-");
        let split = plain
            .char_indices()
            .find(|&(i, c)| {
                // An `e` belongs to the number only if a digit or a sign follows it.
                let exponent = matches!(c, 'e' | 'E')
                    && plain[i + c.len_utf8()..]
                        .starts_with(|n: char| n.is_ascii_digit() || n == '-' || n == '+');
                !(c.is_ascii_digit() || matches!(c, '+' | '-' | '.') || exponent)
            })
            .map_or(plain.len(), |(i, _)| i);
        let (number, symbol) = plain.split_at(split);
        let value: f64 =
            number.parse().map_err(|_| UnitError::NoNumber { kind, found: text.to_owned(), example })?;
        let symbol = normalise(symbol);
        if symbol.is_empty() {
            return Err(UnitError::NoUnit { kind, found: text.to_owned(), example, allowed: self.allowed() });
        }
        let unit = self.units.iter().find(|u| u.symbol == symbol).ok_or_else(|| UnitError::WrongUnit {
            kind,
            found: symbol,
            example,
            allowed: self.allowed(),
        })?;
        let base = value * unit.multiply / unit.divide;
        // Also false for infinity.
        if base.abs() <= self.limit {
            Ok(base)
        } else {
            let limit = format!("{:e} {}", self.limit, self.units.first().map_or("", |u| u.symbol));
            Err(UnitError::OutOfRange { kind, found: format!("{value:.3e} {}", unit.symbol), limit, example })
        }
    }

    fn plain(&self, value: impl fmt::Display) -> UnitError {
        UnitError::Plain {
            kind: self.name,
            value: value.to_string(),
            example: self.example,
            allowed: self.allowed(),
        }
    }

    /// Pattern for the JSON schema (ECMA-262).
    fn pattern(&self) -> String {
        let units: Vec<String> = self
            .units
            .iter()
            .map(|u| {
                let escaped =
                    u.symbol.replace('/', "\\/").replace("^2", "(\\^2|²|2)").replace("^3", "(\\^3|³|3)");
                match escaped.strip_prefix('u') {
                    Some(rest) => format!("[uµμ]{rest}"),
                    None => escaped.replace("/u", "/[uµμ]"),
                }
            })
            .collect();
        format!("^\\s*[+\\-−]?(\\d+\\.?\\d*|\\.\\d+)([eE][+\\-]?\\d+)?\\s*({})\\s*$", units.join("|"))
    }
}

/// One spelling for each unit.
fn normalise(symbol: &str) -> String {
    let mut s: String =
        symbol.chars().filter(|c| !c.is_whitespace()).collect::<String>().replace(['µ', 'μ'], "u");
    s = s.replace('²', "^2").replace("s2", "s^2").replace('³', "^3").replace("s3", "s^3");
    match s.strip_prefix("lines").or_else(|| s.strip_prefix("steps")) {
        Some(rest) if rest.starts_with('/') => rest.to_owned(),
        _ if s == "°" => "deg".to_owned(),
        _ => s,
    }
}

macro_rules! quantity {
    ($(#[$doc:meta])* $name:ident, $accessor:ident, $base:literal, $kind:literal, $example:literal, $limit:literal, [$($unit:expr),+ $(,)?]) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
        pub struct $name(f64);

        impl $name {
            const KIND: Kind = Kind { name: $kind, example: $example, limit: $limit, units: &[$($unit),+] };

            #[doc = concat!("From a value in ", $base, ".")]
            pub const fn new(value: f64) -> Self {
                Self(value)
            }
            #[doc = concat!("Value in ", $base, ".")]
            pub const fn $accessor(self) -> f64 {
                self.0
            }
        }

        impl std::str::FromStr for $name {
            type Err = UnitError;
            fn from_str(text: &str) -> Result<Self, UnitError> {
                Self::KIND.parse(text).map(Self)
            }
        }

        impl fmt::Display for $name {
            /// Base unit, shortest digits that give the same value again.
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                let unit = Self::KIND.units[0].symbol;
                let size = self.0.abs();
                // Else a tiny or huge number would be hundreds of digits long.
                if size == 0.0 || (1e-9..1e15).contains(&size) {
                    write!(f, "{} {unit}", self.0)
                } else {
                    write!(f, "{:e} {unit}", self.0)
                }
            }
        }

        impl Serialize for $name {
            fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.collect_str(self)
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                deserializer.deserialize_any(QuantityVisitor(&Self::KIND)).map(Self)
            }
        }

        impl JsonSchema for $name {
            fn schema_name() -> Cow<'static, str> {
                stringify!($name).into()
            }
            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({
                    "type": "string",
                    "description": format!("{} with its unit ({}), such as \"{}\"", Self::KIND.name, Self::KIND.allowed(), Self::KIND.example),
                    "pattern": Self::KIND.pattern(),
                    "examples": [Self::KIND.example],
                })
            }
        }
    };
}

struct QuantityVisitor(&'static Kind);

impl Visitor<'_> for QuantityVisitor {
    type Value = f64;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} with its unit in quotes, such as \"{}\"", self.0.name, self.0.example)
    }
    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<f64, E> {
        self.0.parse(text).map_err(E::custom)
    }
    fn visit_i64<E: serde::de::Error>(self, value: i64) -> Result<f64, E> {
        Err(E::custom(self.0.plain(value)))
    }
    fn visit_u64<E: serde::de::Error>(self, value: u64) -> Result<f64, E> {
        Err(E::custom(self.0.plain(value)))
    }
    fn visit_f64<E: serde::de::Error>(self, value: f64) -> Result<f64, E> {
        Err(E::custom(self.0.plain(value)))
    }
}

quantity!(
    /// A length; base unit millimetre.
    Length, mm, "millimetres", "a length", "307 mm", 1e12,
    [unit("mm", 1.0, 1.0), unit("nm", 1.0, 1e6), unit("um", 1.0, 1e3), unit("cm", 10.0, 1.0), unit("m", 1e3, 1.0)]
);
quantity!(
    /// A time; base unit nanosecond.
    Time, ns, "nanoseconds", "a time", "20 ms", 1e15,
    [unit("ns", 1.0, 1.0), unit("us", 1e3, 1.0), unit("ms", 1e6, 1.0), unit("s", 1e9, 1.0), unit("min", 6e10, 1.0)]
);
quantity!(
    /// A length on the sensor; base unit pixel.
    Pixels, px, "pixels", "a length on the sensor", "17956.2 px", 1e12,
    [unit("px", 1.0, 1.0)]
);
quantity!(
    /// An angle; base unit radian.
    Angle, rad, "radians", "an angle", "1.5 mrad", 1e12,
    [
        unit("rad", 1.0, 1.0),
        unit("urad", 1.0, 1e6),
        unit("mrad", 1.0, 1e3),
        unit("deg", std::f64::consts::PI / 180.0, 1.0)
    ]
);
quantity!(
    /// A number per length, such as the lines of a grating; base unit per millimetre.
    PerLength, per_mm, "counts per millimetre", "a number per length", "300 /mm", 1e12,
    [unit("/mm", 1.0, 1.0), unit("/um", 1e3, 1.0), unit("/cm", 1.0, 10.0), unit("/m", 1.0, 1e3)]
);
quantity!(
    /// A speed; base unit millimetre per second.
    Speed, mm_per_s, "millimetres per second", "a speed", "5 mm/s", 1e12,
    [unit("mm/s", 1.0, 1.0), unit("um/s", 1.0, 1e3), unit("cm/s", 10.0, 1.0), unit("m/s", 1e3, 1.0)]
);
quantity!(
    /// An acceleration; base unit millimetre per second squared.
    Acceleration, mm_per_s2, "millimetres per second squared", "an acceleration", "50 mm/s^2", 1e12,
    [unit("mm/s^2", 1.0, 1.0), unit("um/s^2", 1.0, 1e3), unit("m/s^2", 1e3, 1.0)]
);
quantity!(
    /// A jerk; base unit millimetre per second cubed.
    Jerk, mm_per_s3, "millimetres per second cubed", "a jerk", "500 mm/s^3", 1e12,
    [unit("mm/s^3", 1.0, 1.0), unit("um/s^3", 1.0, 1e3), unit("m/s^3", 1e3, 1.0)]
);

impl Time {
    /// The nearest whole number of ticks of a clock of `tick_hz` (saturating; negative gives 0).
    pub fn ticks(self, tick_hz: u32) -> u64 {
        // A float-to-integer cast saturates.
        (self.0 * f64::from(tick_hz) / 1e9).round() as u64
    }
    /// As a duration of the standard library (negative gives zero, capped at one century).
    pub fn duration(self) -> std::time::Duration {
        std::time::Duration::from_nanos(self.0.round().clamp(0.0, 3.2e18) as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_convert_exactly() {
        // Each expected value is the double nearest to the decimal number.
        for (text, mm) in [
            ("633 nm", 0.000633),
            ("307 mm", 307.0),
            ("3.5 µm", 0.0035),
            ("3.5 μm", 0.0035),
            ("3.5um", 0.0035),
            ("-1.5e-1 cm", -1.5),
            ("\u{2212}30 um", -0.03),
            ("0.2 m", 200.0),
            (" 1e3 nm ", 0.001),
        ] {
            assert_eq!(text.parse::<Length>().map(Length::mm), Ok(mm), "{text}");
        }
        assert_eq!("20 ms".parse::<Time>().map(|t| t.ticks(125_000_000)), Ok(2_500_000));
        assert_eq!("8 ns".parse::<Time>().map(|t| t.ticks(125_000_000)), Ok(1));
        assert_eq!("17956.2 px".parse::<Pixels>().map(Pixels::px), Ok(17956.2));
        assert_eq!("1.5 mrad".parse::<Angle>().map(Angle::rad), Ok(0.0015));
        assert_eq!("180°".parse::<Angle>().map(Angle::rad), Ok(std::f64::consts::PI));
        assert_eq!("300 /mm".parse::<PerLength>().map(PerLength::per_mm), Ok(300.0));
        assert_eq!("300 lines/mm".parse::<PerLength>().map(PerLength::per_mm), Ok(300.0));
        assert_eq!("50 mm/s²".parse::<Acceleration>().map(Acceleration::mm_per_s2), Ok(50.0));
        assert_eq!("50 mm/s2".parse::<Acceleration>().map(Acceleration::mm_per_s2), Ok(50.0));
        assert_eq!("0.5 m/s³".parse::<Jerk>().map(Jerk::mm_per_s3), Ok(500.0));
        assert_eq!("500 mm/s3".parse::<Jerk>().map(Jerk::mm_per_s3), Ok(500.0));
    }

    #[test]
    fn wrong_text_says_what_was_found_and_what_is_allowed() {
        let message = |text: &str| text.parse::<Length>().map_err(|e| e.to_string()).expect_err(text);
        assert_eq!(
            message("20 ms"),
            "found the unit \"ms\", but a length is measured in mm, nm, um, cm, m; write it such as \"307 mm\""
        );
        assert!(message("20").contains("has no unit"), "{}", message("20"));
        assert!(message("mm").contains("does not start with a number"));
        assert!(message("").contains("does not start with a number"));
        assert!(message("1,5 mm").contains("\",5mm\""), "{}", message("1,5 mm"));
        for (text, found) in
            [("633e300 nm", "6.330e302 nm"), ("1e400 mm", "inf mm"), ("-1.1e12 mm", "-1.100e12 mm")]
        {
            assert_eq!(
                message(text),
                format!("{found} is out of range: a length is within ±1e12 mm; write it such as \"307 mm\"")
            );
        }
        assert_eq!(message(&format!("1{} nm", "0".repeat(300))), message("1e300 nm"));
        assert_eq!(Length::new(1e300).to_string(), "1e300 mm");
        assert!("24 min".parse::<Time>().is_ok() && "1e7 s".parse::<Time>().is_err());
        assert!(message("nan mm").contains("does not start with a number"));
        assert!(message("inf mm").contains("does not start with a number"));
    }

    #[test]
    fn plain_numbers_are_refused_with_the_way_out() {
        #[derive(Debug, Deserialize)]
        struct File {
            #[allow(dead_code)]
            wavelength: Length,
        }
        for text in ["wavelength = 633", "wavelength = 633.0"] {
            let e = toml::from_str::<File>(text).expect_err(text);
            assert!(e.message().contains("\"307 mm\""), "{}", e.message());
            assert_eq!(&text[e.span().expect("span")], &text[13..]);
        }
    }

    #[test]
    fn written_text_reads_back_to_the_same_bits() {
        for mm in [0.000633, 1.0 / 300.0, 109.0, -1e-17, 1e12] {
            let q = Length::new(mm);
            assert_eq!(q.to_string().parse::<Length>(), Ok(q));
        }
    }
}
