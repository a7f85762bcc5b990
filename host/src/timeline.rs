//! Programs and what was played as timing diagrams: SVG, HTML, value change dumps, and the difference of
//! the two.

use daic_protocol::channels;
use daic_protocol::limits::TICK_HZ;
use std::fmt::Write as _;

/// Word changes as (tick, word), ascending; all lines are low before the first.
pub type Words = [(u64, u32)];

/// Most changes of one line that are drawn one by one; beyond it the line is drawn as busy.
const DRAWN_MAX: usize = 2000;
const LANE_HEIGHT: f64 = 28.0;
const LABEL_WIDTH: f64 = 90.0;
const WIDTH: f64 = 1000.0;

/// Name of an output line.
pub fn line_name(bit: u8) -> String {
    match bit {
        0..=7 => format!("led{bit}"),
        8..=11 => format!("camera{}", bit - 8),
        12..=15 => format!("aux{}", bit - 12),
        16..=27 if bit.is_multiple_of(2) => format!("step{}", (bit - 16) / 2),
        16..=27 => format!("direction{}", (bit - 17) / 2),
        _ => format!("bit{bit}"),
    }
}

/// A change of the lines: tick from the begin of the run, and the lines' word from then on.
pub type Change = (u64, u32);

/// Where planned and played differ.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Difference {
    /// Changes planned and played.
    pub planned: usize,
    /// Changes played.
    pub played: usize,
    /// Largest shift of a change, in ticks, over those that both have in the same order.
    pub largest_shift_ticks: u64,
    /// The first change that only one of them has, or that differs: its number, planned, played.
    pub first: Option<(usize, Option<Change>, Option<Change>)>,
    /// Parts of the time (begin and end, in ticks) in which some line differs.
    pub spans: Vec<(u64, u64)>,
}

impl Difference {
    /// Both are the same to the tick.
    pub fn is_none(&self) -> bool {
        self.first.is_none()
    }
}

/// Compares what was planned with what was played, both counted from the begin of the run.
pub fn difference(planned: &Words, played: &Words) -> Difference {
    let longest = planned.len().max(played.len());
    let pairs = (0..longest).map(|i| (i, planned.get(i).copied(), played.get(i).copied()));
    let first = pairs.into_iter().find(|(_, a, b)| a != b);
    let shift = planned
        .iter()
        .zip(played)
        .take_while(|(a, b)| a.1 == b.1)
        .map(|(a, b)| a.0.abs_diff(b.0))
        .max()
        .unwrap_or(0);
    let mut spans: Vec<(u64, u64)> = Vec::new();
    let (mut i, mut j, mut a, mut b) = (0, 0, 0u32, 0u32);
    let mut open = None;
    while i < planned.len() || j < played.len() {
        let tick = planned.get(i).into_iter().chain(played.get(j)).map(|c| c.0).min().unwrap_or(0);
        if let Some(change) = planned.get(i).filter(|c| c.0 == tick) {
            (a, i) = (change.1, i + 1);
        }
        if let Some(change) = played.get(j).filter(|c| c.0 == tick) {
            (b, j) = (change.1, j + 1);
        }
        match (open, a == b) {
            (None, false) => open = Some(tick),
            (Some(begin), true) => {
                spans.push((begin, tick));
                open = None;
            }
            _ => {}
        }
    }
    if let Some(begin) = open {
        spans.push((begin, u64::MAX));
    }
    Difference { planned: planned.len(), played: played.len(), largest_shift_ticks: shift, first, spans }
}

/// A value change dump with one wire per line that ever changes; `scopes` are drawn one under another.
pub fn vcd(scopes: &[(&str, &Words)]) -> String {
    let mut text = String::from("$timescale 1 ns $end\n");
    let mut wires = Vec::new();
    for (scope, words) in scopes {
        let used = words.iter().fold(0, |used, (_, word)| used | word);
        writeln!(text, "$scope module {scope} $end").ok();
        for bit in (0..32u8).filter(|bit| used >> bit & 1 == 1) {
            // Printable characters from '!' on; two of them where there are many wires.
            let n = u32::try_from(wires.len()).unwrap_or(0);
            let digit = |d: u32| char::from_u32(33 + d % 94).unwrap_or('!');
            let id = if n < 94 { digit(n).to_string() } else { format!("{}{}", digit(n), digit(n / 94)) };
            writeln!(text, "$var wire 1 {id} {} $end", line_name(bit)).ok();
            wires.push((*words, bit, id));
        }
        writeln!(text, "$upscope $end").ok();
    }
    text.push_str("$enddefinitions $end\n#0\n");
    let mut changes: Vec<(u64, u32, &str)> = Vec::new();
    for (words, bit, id) in &wires {
        writeln!(text, "0{id}").ok();
        let mut before = 0;
        for &(tick, word) in *words {
            let level = word >> bit & 1;
            if level != before {
                changes.push((tick, level, id));
                before = level;
            }
        }
    }
    changes.sort_by_key(|c| c.0);
    let mut last = None;
    for (tick, level, id) in changes {
        if last != Some(tick) {
            writeln!(text, "#{}", u128::from(tick) * 1_000_000_000 / u128::from(TICK_HZ)).ok();
            last = Some(tick);
        }
        writeln!(text, "{level}{id}").ok();
    }
    text
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// A timing diagram: one lane per line that ever changes in any of `traces` (name, colour, words), the traces
/// over one another; `spans` are shaded.
pub fn svg(traces: &[(&str, &str, &Words)], spans: &[(u64, u64)]) -> String {
    let used = traces.iter().flat_map(|(_, _, w)| w.iter()).fold(0u32, |used, (_, word)| used | word);
    let lanes: Vec<u8> = (0..32u8).filter(|bit| used >> bit & 1 == 1).collect();
    let end = traces.iter().filter_map(|(_, _, w)| w.last()).map(|c| c.0).max().unwrap_or(1).max(1);
    let x = |tick: u64| LABEL_WIDTH + WIDTH * (tick.min(end) as f64) / end as f64;
    let height = 40.0 + LANE_HEIGHT * lanes.len() as f64;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {height}\" font-family=\"sans-serif\" font-size=\"11\">\n",
        LABEL_WIDTH + WIDTH + 30.0
    );
    for &(begin, finish) in spans.iter().take(DRAWN_MAX) {
        let width = (x(finish) - x(begin)).max(1.0);
        writeln!(
            out,
            "<rect x=\"{:.2}\" y=\"0\" width=\"{width:.2}\" height=\"{height}\" fill=\"#fdd\"/>",
            x(begin)
        )
        .ok();
    }
    for (row, &bit) in lanes.iter().enumerate() {
        let base = 8.0 + LANE_HEIGHT * (row as f64 + 1.0) - 6.0;
        writeln!(out, "<text x=\"4\" y=\"{:.1}\">{}</text>", base - 3.0, line_name(bit)).ok();
        for (_, colour, words) in traces {
            let mut path = format!("M{:.2} {base:.1}", x(0));
            let mut level = 0;
            let mut count = 0usize;
            for &(tick, word) in *words {
                let now = word >> bit & 1;
                if now != level {
                    count += 1;
                    let y = |level: u32| base - if level == 1 { 16.0 } else { 0.0 };
                    if count <= DRAWN_MAX {
                        write!(path, "H{:.3}V{:.1}", x(tick), y(now)).ok();
                    }
                    level = now;
                }
            }
            if count > DRAWN_MAX {
                writeln!(
                    out,
                    "<rect x=\"{:.2}\" y=\"{:.1}\" width=\"{WIDTH}\" height=\"16\" fill=\"{colour}\" opacity=\"0.3\"/><text x=\"{:.1}\" y=\"{:.1}\">{count} changes</text>",
                    LABEL_WIDTH, base - 16.0, LABEL_WIDTH + 6.0, base - 4.0
                )
                .ok();
            } else {
                write!(path, "H{:.2}", LABEL_WIDTH + WIDTH).ok();
                writeln!(out, "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\"/>").ok();
            }
        }
    }
    let foot = height - 10.0;
    let (step, unit, per_tick) = graduation(end);
    let mut value = 0.0;
    while value <= end as f64 * per_tick {
        let (at, digits) = (x((value / per_tick).round() as u64), usize::from(step < 1.0));
        let label = format!("{value:.digits$} {unit}");
        writeln!(out, "<text x=\"{at:.1}\" y=\"{foot}\" text-anchor=\"middle\">{label}</text>").ok();
        value += step;
    }
    out.push_str("</svg>\n");
    out
}

/// Graduation of a time axis of so many ticks: distance of the marks, its unit, units per tick.
fn graduation(end: u64) -> (f64, &'static str, f64) {
    let seconds = end as f64 / f64::from(TICK_HZ);
    let (unit, per_s) = match seconds {
        s if s >= 2.0 => ("s", 1.0),
        s if s >= 2e-3 => ("ms", 1e3),
        s if s >= 2e-6 => ("µs", 1e6),
        _ => ("ns", 1e9),
    };
    let least = (seconds * per_s / 10.0).max(1e-9);
    let power = 10f64.powf(least.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= least);
    (step.unwrap_or(least), unit, per_s / f64::from(TICK_HZ))
}

/// A page with the diagram, its legend and the difference.
pub fn html(title: &str, traces: &[(&str, &str, &Words)], found: Option<&Difference>) -> String {
    let none = Vec::new();
    let spans = found.map_or(&none, |d| &d.spans);
    let mut page = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>{0}</title><h1>{0}</h1>\n<p>",
        escape(title)
    );
    for (name, colour, words) in traces {
        write!(page, "<span style=\"color:{colour}\">▬ {} ({} changes)</span> ", escape(name), words.len())
            .ok();
    }
    page.push_str("</p>\n");
    if let Some(d) = found {
        match d.first {
            None => page.push_str("<p>Planned and played are the same to the tick.</p>\n"),
            Some((n, a, b)) => {
                writeln!(
                    page,
                    "<p>They differ from change {n} on: planned {a:?}, played {b:?} (tick, word); largest shift {} ticks; {} spans shaded.</p>",
                    d.largest_shift_ticks,
                    d.spans.len()
                )
                .ok();
            }
        }
    }
    page.push_str(&svg(traces, spans));
    page.push_str("</html>\n");
    page
}

/// What the events of a run say was played on all lines but those of the axes: changes counted from
/// `begin`.
pub fn played(events: &[daic_protocol::message::Event], begin: u64) -> Vec<(u64, u32)> {
    use daic_protocol::message::EventKind;
    let words = events.iter().filter_map(|event| match event.kind {
        EventKind::Edge { word, .. } => Some((event.tick.saturating_sub(begin), word & !channels::AXIS_MASK)),
        _ => None,
    });
    crate::expand::changes(&words.collect::<Vec<_>>())
}

/// How the waits of a run ended, in order; ticks counted from `begin`.
pub fn answers(events: &[daic_protocol::message::Event], begin: u64) -> Vec<crate::expand::Answer> {
    use crate::expand::Answer;
    use daic_protocol::message::EventKind;
    let answer = |event: &daic_protocol::message::Event| match event.kind {
        EventKind::Triggered { .. } => Some(Answer::Triggered(event.tick.saturating_sub(begin))),
        EventKind::TimedOut { .. } => Some(Answer::TimedOut),
        _ => None,
    };
    events.iter().filter_map(answer).collect()
}

/// The same lines of a plan.
pub fn without_axes(words: &Words) -> Vec<(u64, u32)> {
    let words: Vec<_> = words.iter().map(|&(tick, word)| (tick, word & !channels::AXIS_MASK)).collect();
    crate::expand::changes(&words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_tick_is_a_difference() {
        let planned = [(10, 1), (20, 0), (30, 0x100), (40, 0)];
        assert!(difference(&planned, &planned).is_none());
        let mut played = planned;
        played[1].0 = 21;
        let found = difference(&planned, &played);
        assert_eq!(found.first, Some((1, Some((20, 0)), Some((21, 0)))));
        assert_eq!((found.largest_shift_ticks, found.spans), (1, vec![(20, 21)]));
        let found = difference(&planned, &planned[..3]);
        assert_eq!(found.first, Some((3, Some((40, 0)), None)));
        assert_eq!(found.spans, [(40, u64::MAX)]);
    }

    #[test]
    fn a_dump_by_hand() {
        let text = vcd(&[("planned", &[(10, 1), (20, 0x100), (30, 0)])]);
        let expected = "$timescale 1 ns $end\n$scope module planned $end\n$var wire 1 ! led0 $end\n\
            $var wire 1 \" camera0 $end\n$upscope $end\n$enddefinitions $end\n#0\n0!\n0\"\n#80\n1!\n#160\n0!\n1\"\n#240\n0\"\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn time_is_graduated_in_round_numbers() {
        for (end, step, unit) in [
            (7_537_414, 10.0, "ms"),
            (625_000_000, 0.5, "s"),
            (62_500_000, 50.0, "ms"),
            (1250, 1.0, "µs"),
            (100, 100.0, "ns"),
        ] {
            let (found, name, _) = graduation(end);
            assert!((found - step).abs() < 1e-9 && name == unit, "{end}: {found} {name}");
        }
        assert!(svg(&[("planned", "#06c", &[(10, 1), (7_537_414, 0)])], &[]).contains(">60 ms<"));
    }

    #[test]
    fn a_diagram_has_a_lane_per_line() {
        let words = [(10, 1), (20, 0x100), (30, 0)];
        let picture = svg(&[("planned", "#06c", &words)], &[(10, 20)]);
        assert_eq!(picture.matches("<path").count(), 2);
        assert_eq!(picture.matches("<rect").count(), 1);
        // Half of the width is tick 15; led0 rises at a third.
        assert!(picture.contains(&format!("H{:.3}V", 90.0 + 1000.0 / 3.0)), "{picture}");
        let page = html("a < b", &[("planned", "#06c", &words)], Some(&difference(&words, &words)));
        assert!(page.contains("a &lt; b") && page.contains("same to the tick"));
    }
}
