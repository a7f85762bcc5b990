//! Rules between values: each finding names field, value and allowed range.

use super::problem::Finding;
use super::{
    Axis, Experiment, FrameStep, Grating, Microscope, Optics, OpticsFile, Processing, Rig, Step, Strobe,
};
use crate::units::{Length, Time};
use daic_protocol::{channels, limits::MAX_LOOP_DEPTH};
use std::fmt::Display;

/// Most frames one sequence may ask for.
pub(super) const MAX_FRAMES: u64 = 1_000_000;
/// Longest time of one step: far below where tick arithmetic could overflow.
const LONGEST: Time = Time::new(24.0 * 3600e9);

#[derive(Default)]
struct Findings(Vec<Finding>);

impl Findings {
    fn require(
        &mut self,
        good: bool,
        field: impl Into<String>,
        value: impl Display,
        allowed: impl Into<String>,
    ) {
        if !good {
            self.0.push(Finding { field: field.into(), value: value.to_string(), allowed: allowed.into() });
        }
    }

    fn positive(&mut self, field: &str, value: Length) {
        self.require(value.mm() > 0.0, field, value, "more than 0 mm");
    }

    fn time(&mut self, field: impl Into<String>, value: Time, positive: bool) {
        let ns = value.ns();
        let enough = if positive { ns > 0.0 } else { ns >= 0.0 };
        let lowest = if positive { "more than 0 ns" } else { "at least 0 ns" };
        self.require(enough && value <= LONGEST, field, value, format!("{lowest}, at most 24 h"));
    }
}

pub(super) fn experiment(e: &Experiment) -> Vec<Finding> {
    let mut f = Findings::default();
    rig(&e.rig, &mut f);
    const ONE: &str = "one of [optics], [microscope] and [lightfield]";
    let given = [
        ("optics", e.optics.is_some()),
        ("microscope", e.microscope.is_some()),
        ("lightfield", e.lightfield.is_some()),
    ];
    let mut given = given.into_iter().filter(|(_, there)| *there).map(|(name, _)| name);
    match (given.next(), given.next()) {
        (None, _) => f.require(false, "optics", "left out", ONE),
        (Some(first), Some(second)) => f.require(false, second, format!("given besides [{first}]"), ONE),
        (Some(_), None) => {}
    }
    if let Some(o) = &e.optics {
        optics(o, &mut f);
    }
    if let Some(m) = &e.microscope {
        microscope(m, &mut f);
    }
    if let Some(l) = &e.lightfield {
        let named = !l.setup.trim().is_empty();
        f.require(named, "lightfield.setup", "empty", "the path of a setup file");
    }
    processing(&e.processing, &mut f);
    sequence(e, &mut f);
    f.0
}

pub(super) fn optics_file(file: &OpticsFile) -> Vec<Finding> {
    let mut f = Findings::default();
    if let Some(format) = &file.format {
        f.require(
            format == OpticsFile::FORMAT,
            "format",
            format!("{format:?}"),
            format!("{:?}", OpticsFile::FORMAT),
        );
    }
    if let Some(date) = &file.date {
        let b = date.as_bytes();
        let digits = |from: usize, to: usize| b[from..to].iter().all(u8::is_ascii_digit);
        let fits =
            b.len() >= 10 && digits(0, 4) && b[4] == b'-' && digits(5, 7) && b[7] == b'-' && digits(8, 10);
        f.require(fits, "date", format!("{date:?}"), "a date such as \"2026-03-31\"");
    }
    optics(&file.optics, &mut f);
    if let Some(c) = &file.covariance {
        let n = c.parameters.len();
        f.require(
            c.matrix.len() == n,
            "covariance.matrix",
            format!("{} rows", c.matrix.len()),
            format!("a row for each of the {n} parameters"),
        );
        for (i, row) in c.matrix.iter().enumerate() {
            let field = format!("covariance.matrix[{i}]");
            f.require(row.len() == n, &field, format!("{} numbers", row.len()), format!("{n} numbers"));
            if let Some(value) = row.iter().find(|v| !v.is_finite()) {
                f.require(false, &field, value, "finite numbers");
            }
        }
    }
    let maps = file.maps.clone().unwrap_or_default();
    for (name, map) in [("sensor", maps.sensor), ("minus", maps.minus), ("plus", maps.plus)] {
        let Some(map) = map else { continue };
        f.require(!map.file.trim().is_empty(), format!("maps.{name}.file"), "empty", "the path of a map");
        let hex = map.crc64.len() == 16 && map.crc64.bytes().all(|b| b.is_ascii_hexdigit());
        f.require(hex, format!("maps.{name}.crc64"), format!("{:?}", map.crc64), "16 hexadecimal digits");
    }
    if let Some(v) = &file.volume {
        for (name, [from, to]) in [("x", v.x), ("y", v.y), ("h", v.h)] {
            let text = format!("{from} to {to}");
            f.require(from.mm() < to.mm(), format!("volume.{name}"), text, "from the smaller to the larger");
        }
    }
    f.0
}

fn rig(rig: &Rig, f: &mut Findings) {
    f.require(!rig.port.trim().is_empty(), "rig.port", "empty", "a serial port, tcp://host:port or sim");
    f.require(rig.baud > 0, "rig.baud", rig.baud, "more than 0");
    f.time("rig.reply_timeout", rig.reply_timeout, true);
    f.time("rig.frame_timeout", rig.frame_timeout, true);

    let camera = &rig.camera;
    f.require(
        camera.line < channels::CAMERAS,
        "rig.camera.line",
        camera.line,
        format!("0 to {}", channels::CAMERAS - 1),
    );
    for (name, size) in [("width", camera.width), ("height", camera.height)] {
        f.require((16..=65_535).contains(&size), format!("rig.camera.{name}"), size, "16 to 65535 pixels");
    }
    f.require((8..=16).contains(&camera.bits), "rig.camera.bits", camera.bits, "8 to 16");
    f.time("rig.camera.trigger_width", camera.trigger_width, true);
    f.time("rig.camera.exposure_delay", camera.exposure_delay, false);
    f.time("rig.camera.exposure", camera.exposure, true);
    f.time("rig.camera.readout", camera.readout, false);
    f.time("rig.camera.row_time", camera.row_time, false);
    f.time("rig.camera.row_time, times the rows", camera.rolling(), false);
    let busy =
        camera.exposure_delay.ns() + camera.exposure.ns() + camera.rolling().ns() + camera.readout.ns();
    f.require(
        camera.trigger_width.ns() < busy,
        "rig.camera.trigger_width",
        camera.trigger_width,
        format!("less than exposure_delay + exposure + readout, {busy} ns"),
    );
    strobe(rig, &rig.strobe, "rig.strobe", f);

    for (name, axis) in rig.axes.named() {
        if let Some(axis) = axis {
            self::axis(&format!("rig.axes.{name}"), axis, f);
        }
    }
}

fn axis(field: &str, axis: &Axis, f: &mut Findings) {
    let per_mm = axis.steps_per_mm;
    f.require(
        per_mm > 0.0 && per_mm <= 1e6,
        format!("{field}.steps_per_mm"),
        per_mm,
        "more than 0, at most 1000000",
    );
    f.require(axis.min < axis.max, format!("{field}.min"), axis.min, format!("less than max, {}", axis.max));
    for (name, end) in [("min", axis.min), ("max", axis.max)] {
        f.require(
            (end.mm() * per_mm).abs() <= f64::from(i32::MAX),
            format!("{field}.{name}"),
            end,
            "at most 2147483647 steps from home",
        );
    }
    let travel = axis.max.mm() - axis.min.mm();
    f.require(
        axis.backlash.mm() >= 0.0 && 2.0 * axis.backlash.mm() < travel,
        format!("{field}.backlash"),
        axis.backlash,
        format!("0 mm to less than half of the travel, {travel} mm"),
    );
    let mut rates = vec![
        ("rate", axis.rate.mm_per_s(), axis.rate.to_string(), "step/s"),
        ("acceleration", axis.acceleration.mm_per_s2(), axis.acceleration.to_string(), "step/s^2"),
    ];
    rates.extend(axis.jerk.map(|jerk| ("jerk", jerk.mm_per_s3(), jerk.to_string(), "step/s^3")));
    for (name, mm, text, unit) in rates {
        let steps = mm * per_mm;
        f.require(
            steps >= 1.0 && steps <= f64::from(u32::MAX),
            format!("{field}.{name}"),
            text,
            format!("1 to 4294967295 {unit}, which is {steps} here"),
        );
    }
}

/// The strobe must lie where all rows are exposed.
fn strobe(rig: &Rig, strobe: &Strobe, field: &str, f: &mut Findings) {
    f.require(
        strobe.led < channels::LEDS,
        format!("{field}.led"),
        strobe.led,
        format!("0 to {}", channels::LEDS - 1),
    );
    f.time(format!("{field}.delay"), strobe.delay, false);
    f.time(format!("{field}.width"), strobe.width, true);
    f.time(format!("{field}.level_settle"), strobe.level_settle, false);
    if let Some(level) = strobe.level {
        f.require((0.0..=1.0).contains(&level), format!("{field}.level"), level, "0 to 1");
    }
    let first = rig.camera.exposure_delay.ns();
    let end = first + rig.camera.exposure.ns();
    let rolling = rig.camera.rolling().ns();
    let begin = first + rolling;
    let inside = if rolling > 0.0 {
        format!("where all rows are exposed, {begin} ns to {end} ns after the trigger (rolling shutter)")
    } else {
        format!("inside the exposure, {begin} ns to {end} ns after the trigger")
    };
    f.require(strobe.delay.ns() >= begin, format!("{field}.delay"), strobe.delay, inside.clone());
    f.require(
        strobe.delay.ns() + strobe.width.ns() <= end,
        format!("{field}.width"),
        format!("{} (LED off {} ns after the trigger)", strobe.width, strobe.delay.ns() + strobe.width.ns()),
        inside,
    );
}

fn microscope(m: &Microscope, f: &mut Findings) {
    f.positive("microscope.pixel", m.pixel);
    let search = m.search.px();
    f.require((1.0..=10_000.0).contains(&search), "microscope.search", m.search, "1 px to 10000 px");
}

fn optics(o: &Optics, f: &mut Findings) {
    f.positive("optics.wavelength", o.wavelength);
    f.positive("optics.pinhole_to_grating", o.pinhole_to_grating);
    f.positive("optics.grating_to_reference", o.grating_to_reference);
    f.require(o.focal.px() > 0.0, "optics.focal", o.focal, "more than 0 px");
    if let Some(pixel) = o.pixel {
        f.positive("optics.pixel", pixel);
    }
    if let Some(r) = o.reference {
        for (i, tilt) in r.tilt.iter().enumerate() {
            // About z the plate may lie in any direction.
            let limit = if i == 2 { std::f64::consts::PI } else { std::f64::consts::FRAC_PI_4 };
            let allowed = format!("-{limit:.4} rad to {limit:.4} rad");
            f.require(tilt.rad().abs() <= limit, format!("optics.reference.tilt[{i}]"), tilt, allowed);
        }
        for (i, origin) in r.origin.iter().enumerate() {
            f.require(origin.mm().is_finite(), format!("optics.reference.origin[{i}]"), origin, "finite");
        }
    }
    if let Some(b) = o.brown {
        for (name, value) in [("k1", b.k1), ("k2", b.k2), ("k3", b.k3), ("p1", b.p1), ("p2", b.p2)] {
            f.require(value.is_finite(), format!("optics.brown.{name}"), value, "a finite number");
        }
    }
    match (&o.grating, &o.grating_minus, &o.grating_plus) {
        (Some(g), None, None) => grating("optics.grating", g, o.wavelength, f),
        (None, Some(minus), Some(plus)) => {
            grating("optics.grating_minus", minus, o.wavelength, f);
            grating("optics.grating_plus", plus, o.wavelength, f);
        }
        (both, minus, plus) => {
            let given: Vec<&str> = [("grating", both), ("grating_minus", minus), ("grating_plus", plus)]
                .iter()
                .filter(|(_, g)| g.is_some())
                .map(|(name, _)| *name)
                .collect();
            let given = if given.is_empty() {
                "without a grating".to_owned()
            } else {
                format!("given {}", given.join(" and "))
            };
            f.require(false, "optics", given, "either grating, or both grating_minus and grating_plus");
        }
    }
}

fn grating(field: &str, g: &Grating, wavelength: Length, f: &mut Findings) {
    match g.pitch_mm() {
        None => {
            let given = if g.pitch.is_some() {
                "given both pitch and lines"
            } else {
                "given neither pitch nor lines"
            };
            f.require(false, field, given, "either pitch or lines");
        }
        Some(pitch) => {
            let (key, value) = match (g.pitch, g.lines) {
                (Some(pitch), _) => ("pitch", pitch.to_string()),
                (_, Some(lines)) => ("lines", format!("{lines} (a pitch of {pitch} mm)")),
                _ => ("pitch", String::new()),
            };
            // Also false for NaN and for a negative pitch.
            let diffracts = pitch > wavelength.mm() && pitch.is_finite() && pitch > 0.0;
            f.require(
                diffracts,
                format!("{field}.{key}"),
                value,
                format!("a pitch above the wavelength, {wavelength}: a finer grating has no first order"),
            );
        }
    }
    for (i, tilt) in g.tilt.iter().enumerate() {
        // 45° is far beyond any mount, and the two views would not be there any more.
        f.require(
            tilt.rad().abs() <= std::f64::consts::FRAC_PI_4,
            format!("{field}.tilt[{i}]"),
            tilt,
            "-0.7854 rad to 0.7854 rad (45 deg)",
        );
    }
    if let Some(offset) = g.offset {
        f.require(offset.mm().is_finite(), format!("{field}.offset"), offset, "a finite length");
    }
    if let Some(s) = g.substrate {
        f.require(
            s.thickness.mm() >= 0.0,
            format!("{field}.substrate.thickness"),
            s.thickness,
            "at least 0 mm",
        );
        f.require((1.0..=5.0).contains(&s.index), format!("{field}.substrate.index"), s.index, "1 to 5");
    }
}

fn processing(p: &Processing, f: &mut Findings) {
    f.require(
        (5..=255).contains(&p.subset) && p.subset % 2 == 1,
        "processing.subset",
        p.subset,
        "an odd number, 5 to 255 pixels",
    );
    f.require((1..=1000).contains(&p.step), "processing.step", p.step, "1 to 1000 pixels");
    if let Some(noise) = p.noise {
        f.require((0.0..=65_535.0).contains(&noise), "processing.noise", noise, "0 to 65535 grey levels");
    }
    f.require(
        (1..=1000).contains(&p.max_iterations),
        "processing.max_iterations",
        p.max_iterations,
        "1 to 1000",
    );
    f.require(
        p.convergence > 0.0 && p.convergence <= 1.0,
        "processing.convergence",
        p.convergence,
        "more than 0, at most 1 pixel",
    );
    f.require((0.0..=1.0).contains(&p.min_zncc), "processing.min_zncc", p.min_zncc, "0 to 1");
    if let Some([x0, x1, y0, y1]) = p.roi {
        f.require(
            x0 < x1 && y0 < y1,
            "processing.roi",
            format!("[{x0}, {x1}, {y0}, {y1}]"),
            "[first column, last column, first row, last row], each first below its last",
        );
    }
}

/// Names of frames and whether a running number is appended to them.
struct Named {
    field: String,
    name: String,
    repeated: bool,
}

fn sequence(e: &Experiment, f: &mut Findings) {
    let mut names = Vec::new();
    let frames = steps(e, &e.sequence, "sequence", 0, &mut names, f);
    f.require(frames > 0, "sequence", "without a frame", "at least one frame");
    f.require(
        frames <= MAX_FRAMES,
        "sequence",
        format!("{frames} frames long"),
        format!("at most {MAX_FRAMES} frames"),
    );

    let mut seen = std::collections::HashMap::new();
    for (i, named) in names.iter().enumerate() {
        let first = *seen.entry(named.name.as_str()).or_insert(i);
        f.require(
            first == i,
            &named.field,
            format!("{:?}, used before", named.name),
            "a name of its own for each frame",
        );
    }
    // "run_0007" beside a repeated "run" would meet the number that is appended to the latter.
    for named in &names {
        let clash = named.name.rsplit_once('_').is_some_and(|(stem, digits)| {
            digits.bytes().all(|b| b.is_ascii_digit()) && names.iter().any(|n| n.repeated && n.name == stem)
        });
        f.require(
            !clash,
            &named.field,
            format!("{:?}", named.name),
            "a name that is not a repeated frame's name with a number",
        );
    }
}

/// Checks steps; gives the number of frames they ask for (saturating).
fn steps(
    e: &Experiment,
    list: &[Step],
    path: &str,
    depth: usize,
    names: &mut Vec<Named>,
    f: &mut Findings,
) -> u64 {
    let mut frames = 0u64;
    for (i, step) in list.iter().enumerate() {
        let field = format!("{path}[{i}]");
        match step {
            Step::Move(m) => {
                let targets = m.targets();
                f.require(
                    targets.iter().any(Option::is_some),
                    format!("{field}.move"),
                    "empty",
                    "at least one of x, y, z",
                );
                for ((name, axis), target) in e.rig.axes.named().into_iter().zip(targets) {
                    let Some(target) = target else { continue };
                    let field = format!("{field}.move.{name}");
                    match axis {
                        None => f.require(
                            false,
                            field,
                            target,
                            format!("axes that the rig has; describe this one under [rig.axes.{name}]"),
                        ),
                        Some(axis) => f.require(
                            target >= axis.min && target <= axis.max,
                            field,
                            target,
                            format!("{} to {}, the travel of axis {name}", axis.min, axis.max),
                        ),
                    }
                }
            }
            Step::Settle(time) => f.time(format!("{field}.settle"), *time, true),
            Step::Level(level) => {
                f.require(
                    level.led < channels::LEDS,
                    format!("{field}.level.led"),
                    level.led,
                    format!("0 to {}", channels::LEDS - 1),
                );
                f.require(
                    (0.0..=1.0).contains(&level.level),
                    format!("{field}.level.level"),
                    level.level,
                    "0 to 1",
                );
                f.time(format!("{field}.level.settle"), level.settle, false);
            }
            Step::Frame(frame) => {
                frames = frames.saturating_add(1);
                self::frame(e, frame, &format!("{field}.frame"), depth > 0, names, f);
            }
            Step::Repeat(repeat) => {
                f.require(repeat.times > 0, format!("{field}.repeat.times"), repeat.times, "at least 1");
                f.require(
                    !repeat.steps.is_empty(),
                    format!("{field}.repeat.steps"),
                    "empty",
                    "at least one step",
                );
                if depth >= MAX_LOOP_DEPTH {
                    f.require(
                        false,
                        format!("{field}.repeat"),
                        format!("nested {} deep", depth + 1),
                        format!("at most {MAX_LOOP_DEPTH} deep"),
                    );
                    continue;
                }
                let inner = steps(e, &repeat.steps, &format!("{field}.repeat.steps"), depth + 1, names, f);
                frames = frames.saturating_add(inner.saturating_mul(u64::from(repeat.times)));
            }
        }
    }
    frames
}

fn frame(
    e: &Experiment,
    frame: &FrameStep,
    field: &str,
    repeated: bool,
    names: &mut Vec<Named>,
    f: &mut Findings,
) {
    let name = &frame.name;
    // Names become file names.
    let good = (1..=64).contains(&name.len())
        && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
    f.require(good, format!("{field}.name"), format!("{name:?}"), "1 to 64 letters, digits, - and _");
    names.push(Named { field: format!("{field}.name"), name: name.clone(), repeated });
    if let Some(own) = &frame.strobe {
        strobe(&e.rig, own, &format!("{field}.strobe"), f);
    }
}
