//! Timing diagrams: digital lines, stage positions and light levels over time.
//!
//! Strobes last microseconds, moves milliseconds to seconds. So the diagram has two parts: the
//! whole run to one scale, in which a line that toggles faster than the drawing resolves is a
//! filled band; and below it windows (as a rule one around each camera trigger), all to one scale
//! of their own, with the time between them left out and marked.

use crate::axis::Ticks;
use crate::colour::line_colour;
use crate::error::ReportError;
use crate::line::GRID;
use crate::number::short;
use crate::svg::{Anchor, Markup, SMALL, Svg, TEXT};

/// A digital line.
#[derive(Debug, Clone, PartialEq)]
pub struct DigitalLine {
    /// Name at the left.
    pub name: String,
    /// Level before the first edge.
    pub initial: bool,
    /// (tick, level from then on), in time order.
    pub edges: Vec<(u64, bool)>,
}

/// Something that has a value at every time.
#[derive(Debug, Clone, PartialEq)]
pub struct AnalogTrace {
    /// Name at the left.
    pub name: String,
    /// Unit of the values.
    pub unit: String,
    /// (tick, value), in time order.
    pub points: Vec<(u64, f64)>,
    /// Whether the value jumps at each point (a level) or runs straight to the next (a position).
    pub steps: bool,
}

/// A timing diagram.
#[derive(Debug, Clone, PartialEq)]
pub struct Timeline {
    /// Title above the diagram.
    pub title: String,
    /// Ticks per second.
    pub tick_hz: f64,
    /// Digital lines, from the top.
    pub lines: Vec<DigitalLine>,
    /// Traces, below them.
    pub traces: Vec<AnalogTrace>,
    /// Windows drawn enlarged, (first, last tick); see [`Timeline::windows_around`].
    pub windows: Vec<(u64, u64)>,
}

const LEFT: f64 = 150.0;
const ROW: f64 = 26.0;
const TRACE: f64 = 52.0;
const WIDTH: f64 = 760.0;
/// More windows than this are not drawn: the figure says how many are left out.
const MOST_WINDOWS: usize = 12;

/// Least distance of tick labels in a window. Round steps are up to 2.5 times as far apart, so
/// that the narrowest window (130 px as a rule) has two labels at least.
const LABEL: f64 = 36.0;

/// How times are told below the rows.
#[derive(Clone, Copy)]
struct TimeAxis {
    /// Tick counted as 0.
    zero: f64,
    /// Name of the unit, and how many make a second.
    unit: (&'static str, f64),
}

/// A piece of the time axis on the drawing.
struct Span {
    from: f64,
    to: f64,
    x: f64,
    w: f64,
}

impl Span {
    fn at(&self, tick: f64) -> f64 {
        self.x + (tick - self.from) / (self.to - self.from) * self.w
    }
}

impl Timeline {
    /// Windows from `before` ticks before to `after` ticks after each of `ticks`; windows that
    /// overlap become one.
    #[must_use]
    pub fn windows_around(ticks: &[u64], before: u64, after: u64) -> Vec<(u64, u64)> {
        let mut all: Vec<(u64, u64)> =
            ticks.iter().map(|t| (t.saturating_sub(before), t.saturating_add(after))).collect();
        all.sort_unstable();
        let mut merged: Vec<(u64, u64)> = Vec::new();
        for (from, to) in all {
            match merged.last_mut() {
                Some(last) if from <= last.1 => last.1 = last.1.max(to),
                _ => merged.push((from, to)),
            }
        }
        merged
    }

    /// The diagram as SVG.
    ///
    /// # Errors
    /// [`ReportError::Empty`] if there is neither an edge nor a point, or no usable tick rate.
    pub fn render_svg(&self) -> Result<Markup, ReportError> {
        let (first, last) = self.extent()?;
        let rows = self.lines.len() as f64 * ROW + self.traces.len() as f64 * TRACE;
        let shown = &self.windows[..self.windows.len().min(MOST_WINDOWS)];
        let windows: Vec<(u64, u64)> = shown.iter().copied().filter(|(a, b)| b > a).collect();
        let spans = window_spans(&windows);
        let width = spans.last().map_or(LEFT + WIDTH, |s| (s.x + s.w).max(LEFT + WIDTH));
        let overview_top = 54.0;
        let windows_top = overview_top + rows + 78.0;
        let height = if spans.is_empty() { overview_top + rows + 40.0 } else { windows_top + rows + 26.0 };
        let mut svg = Svg::new(width + 24.0, height, &self.title);
        svg.title(&self.title);

        let room = ((last - first) as f64 * 0.01).max(1.0);
        let all = Span { from: first as f64 - room, to: last as f64 + room, x: LEFT, w: WIDTH };
        svg.text(LEFT, overview_top - 12.0, SMALL, Anchor::Start, "whole run, to scale");
        for (window, number) in windows.iter().zip(1..) {
            let (x0, x1) = (all.at(window.0 as f64), all.at(window.1 as f64));
            let style = "fill=\"currentColor\" fill-opacity=\"0.13\"";
            svg.rect(x0 - 1.0, overview_top, (x1 - x0 + 2.0).max(3.0), rows, style);
            svg.text(
                (x0 + x1) / 2.0,
                overview_top + rows + 34.0,
                SMALL,
                Anchor::Middle,
                &format!("{number}"),
            );
        }
        let s = |tick: f64| tick / self.tick_hz;
        let time = TimeAxis { zero: 0.0, unit: time_unit(s(all.to).abs().max(s(all.from).abs())) };
        self.axis(&mut svg, &all, overview_top, rows, &time, all.w / 8.0);
        self.rows(&mut svg, &all, overview_top);
        self.names(&mut svg, overview_top);

        if !spans.is_empty() {
            self.enlarged(&mut svg, &spans, &windows, windows_top, rows);
        }
        Ok(svg.finish())
    }

    fn enlarged(&self, svg: &mut Svg, spans: &[Span], windows: &[(u64, u64)], top: f64, rows: f64) {
        let left_out = self.windows.len() - windows.len();
        let note =
            if left_out > 0 { format!("; {left_out} further windows not drawn") } else { String::new() };
        let note = format!("windows to one scale, time between them left out{note}");
        svg.text(LEFT, top - 26.0, SMALL, Anchor::Start, &note);
        self.names(svg, top);
        // One unit for all headings and one for all axes: windows are there to be compared.
        let longest = windows.iter().map(|w| self.seconds(w.1 - w.0)).fold(0.0, f64::max);
        let latest = windows.iter().map(|w| self.seconds(w.0)).fold(0.0, f64::max);
        for (number, (span, window)) in spans.iter().zip(windows).enumerate() {
            let label = format!("{} at {}", number + 1, moment(self.seconds(window.0), time_unit(latest)));
            svg.text(span.x, top - 8.0, SMALL, Anchor::Start, &label);
            svg.rect(span.x, top, span.w, rows, "fill=\"currentColor\" fill-opacity=\"0.05\"");
            let time = TimeAxis { zero: window.0 as f64, unit: time_unit(longest) };
            self.axis(svg, span, top, rows, &time, LABEL.max(span.w / 10.0));
            self.rows(svg, span, top);
        }
        for (pair, times) in spans.windows(2).zip(windows.windows(2)) {
            let x = (pair[0].x + pair[0].w + pair[1].x) / 2.0;
            let gap = self.seconds(times[1].0 - times[0].1);
            svg.text_up(x + 4.0, top + rows / 2.0, SMALL, &format!("{} left out", duration(gap)));
        }
    }

    fn extent(&self) -> Result<(u64, u64), ReportError> {
        let edges = self.lines.iter().flat_map(|l| l.edges.iter().map(|e| e.0));
        let points = self.traces.iter().flat_map(|t| t.points.iter().map(|p| p.0));
        let windows = self.windows.iter().flat_map(|w| [w.0, w.1]);
        let all = || edges.clone().chain(points.clone()).chain(windows.clone());
        match (all().min(), all().max()) {
            (Some(first), Some(last)) if self.tick_hz.is_finite() && self.tick_hz > 0.0 => Ok((first, last)),
            _ => Err(ReportError::Empty { figure: self.title.clone() }),
        }
    }

    fn seconds(&self, ticks: u64) -> f64 {
        ticks as f64 / self.tick_hz
    }

    /// Time ticks below the rows, at least `apart` pixels from each other.
    fn axis(&self, svg: &mut Svg, span: &Span, top: f64, rows: f64, time: &TimeAxis, apart: f64) {
        let (TimeAxis { zero, unit: (unit, factor) }, hz) = (*time, self.tick_hz);
        let (low, high) = ((span.from - zero) / hz * factor, (span.to - zero) / hz * factor);
        let ticks = Ticks::spaced(low, high, (high - low) * apart / span.w);
        let bottom = top + rows;
        svg.line(
            (span.x, bottom),
            (span.x + span.w, bottom),
            "stroke=\"currentColor\" stroke-opacity=\"0.6\"",
        );
        for &value in &ticks.values {
            let x = span.at(value / factor * hz + zero);
            svg.line((x, top), (x, bottom), GRID);
            svg.line((x, bottom), (x, bottom + 4.0), "stroke=\"currentColor\" stroke-opacity=\"0.6\"");
            svg.text(x, bottom + 16.0, SMALL, Anchor::Middle, &ticks.label(value));
        }
        if span.x > LEFT {
            return;
        }
        let label = format!("t / {unit}");
        svg.text(LEFT - 10.0, bottom + 16.0, SMALL, Anchor::End, &label);
    }

    fn names(&self, svg: &mut Svg, top: f64) {
        let mut y = top;
        for line in &self.lines {
            svg.text(LEFT - 10.0, y + ROW * 0.66, TEXT, Anchor::End, &shorten(&line.name));
            y += ROW;
        }
        for trace in &self.traces {
            let name = if trace.unit.is_empty() {
                trace.name.clone()
            } else {
                format!("{} / {}", trace.name, trace.unit)
            };
            svg.text(LEFT - 10.0, y + TRACE * 0.42, TEXT, Anchor::End, &shorten(&name));
            if let Some((low, high)) = range(&trace.points) {
                let ends = format!("{} … {}", short(low), short(high));
                svg.text(LEFT - 10.0, y + TRACE * 0.42 + 14.0, 10.0, Anchor::End, &ends);
            }
            y += TRACE;
        }
    }

    fn rows(&self, svg: &mut Svg, span: &Span, top: f64) {
        let mut y = top;
        for (index, line) in self.lines.iter().enumerate() {
            draw_line(svg, span, line, y, line_colour(index));
            y += ROW;
        }
        for (index, trace) in self.traces.iter().enumerate() {
            draw_trace(svg, span, trace, y, line_colour(self.lines.len() + index));
            y += TRACE;
        }
    }
}

/// Places the windows side by side; all to one scale, wide enough to be read.
fn window_spans(windows: &[(u64, u64)]) -> Vec<Span> {
    let gap = 34.0;
    let total: f64 = windows.iter().map(|w| (w.1 - w.0) as f64).sum();
    let free = WIDTH - gap * (windows.len().max(1) - 1) as f64;
    let least = windows.iter().map(|w| (w.1 - w.0) as f64).fold(f64::INFINITY, f64::min);
    // The narrowest window holds its own heading; the drawing grows for many windows.
    let scale = (free / total).max(130.0 / least).min(4.0 * WIDTH / total);
    let mut x = LEFT;
    let mut spans = Vec::new();
    for w in windows {
        let wide = (w.1 - w.0) as f64 * scale;
        spans.push(Span { from: w.0 as f64, to: w.1 as f64, x, w: wide });
        x += wide + gap;
    }
    spans
}

fn draw_line(svg: &mut Svg, span: &Span, line: &DigitalLine, top: f64, colour: &str) {
    let (high, low) = (top + 5.0, top + ROW - 4.0);
    let y = |level: bool| if level { high } else { low };
    let before = line.edges.partition_point(|e| (e.0 as f64) < span.from);
    let mut level = before.checked_sub(1).map_or(line.initial, |i| line.edges[i].1);
    let inside: Vec<(f64, bool)> = line.edges[before..]
        .iter()
        .take_while(|e| e.0 as f64 <= span.to)
        .map(|e| (span.at(e.0 as f64), e.1))
        .collect();
    let mut points = vec![(span.x, y(level))];
    let mut filled: Vec<(f64, f64)> = Vec::new();
    let mut high_since = level.then_some(span.x);
    let mut at = 0;
    while at < inside.len() {
        // Edges closer than the drawing resolves become one filled band.
        let mut end = at;
        while end + 1 < inside.len() && inside[end + 1].0 - inside[end].0 < 1.2 {
            end += 1;
        }
        let (x0, x1) = (inside[at].0, inside[end].0);
        let after = inside[end].1;
        if end > at {
            if let Some(since) = high_since.take() {
                filled.push((since, x0));
            }
            svg.rect(
                x0,
                high,
                (x1 - x0).max(1.2),
                low - high,
                &format!("fill=\"{colour}\" fill-opacity=\"0.75\""),
            );
            points.extend([(x0, y(level)), (x0, y(after)), (x1, y(after))]);
        } else {
            points.extend([(x0, y(level)), (x0, y(after))]);
            if let Some(since) = high_since.take() {
                filled.push((since, x0));
            }
        }
        level = after;
        high_since = level.then_some(x1);
        at = end + 1;
    }
    if let Some(since) = high_since {
        filled.push((since, span.x + span.w));
    }
    points.push((span.x + span.w, y(level)));
    for (x0, x1) in filled.into_iter().filter(|(a, b)| b > a) {
        svg.rect(x0, high, x1 - x0, low - high, &format!("fill=\"{colour}\" fill-opacity=\"0.22\""));
    }
    svg.path(&points, false, &format!("fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.4\""));
}

fn range(points: &[(u64, f64)]) -> Option<(f64, f64)> {
    let finite = || points.iter().map(|p| p.1).filter(|v| v.is_finite());
    let low = finite().fold(f64::INFINITY, f64::min);
    low.is_finite().then(|| (low, finite().fold(f64::NEG_INFINITY, f64::max)))
}

fn draw_trace(svg: &mut Svg, span: &Span, trace: &AnalogTrace, top: f64, colour: &str) {
    let Some((low, high)) = range(&trace.points) else { return };
    let (upper, lower) = (top + 7.0, top + TRACE - 7.0);
    let y = |v: f64| {
        if high > low { lower - (v - low) / (high - low) * (lower - upper) } else { (upper + lower) / 2.0 }
    };
    let points: Vec<(f64, f64)> =
        trace.points.iter().filter(|p| p.1.is_finite()).map(|p| (p.0 as f64, p.1)).collect();
    let value_at = |tick: f64| {
        let next = points.partition_point(|p| p.0 <= tick);
        match (next.checked_sub(1).map(|i| points[i]), points.get(next)) {
            (None, Some(p)) => p.1,
            (Some(p), None) => p.1,
            (Some(p), _) if trace.steps => p.1,
            (Some(a), Some(b)) => a.1 + (b.1 - a.1) * (tick - a.0) / (b.0 - a.0),
            (None, None) => low,
        }
    };
    let mut path = vec![(span.x, y(value_at(span.from)))];
    let mut last = path[0].1;
    for &(tick, value) in points.iter().filter(|p| p.0 > span.from && p.0 < span.to) {
        let x = span.at(tick);
        if trace.steps {
            path.push((x, last));
        }
        last = y(value);
        // Points nearer than a third of a pixel add bytes, not information.
        if trace.steps || path.last().is_none_or(|p| x - p.0 > 0.33 || (last - p.1).abs() > 2.0) {
            path.push((x, last));
        }
    }
    path.push((span.x + span.w, y(value_at(span.to))));
    svg.path(&path, false, &format!("fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\""));
}

fn time_unit(seconds: f64) -> (&'static str, f64) {
    match seconds {
        s if s >= 1.0 => ("s", 1.0),
        s if s >= 2e-3 => ("ms", 1e3),
        s if s >= 1e-6 => ("µs", 1e6),
        _ => ("ns", 1e9),
    }
}

/// A time in the unit given, to the microsecond or finer.
fn moment(seconds: f64, (unit, factor): (&str, f64)) -> String {
    let decimals = if factor > 1.0 { 3 } else { 6 };
    format!("{:.decimals$} {unit}", seconds * factor)
}

fn duration(seconds: f64) -> String {
    let (unit, factor) = time_unit(seconds);
    let text = format!("{:.3}", seconds * factor);
    let text = text.trim_end_matches('0').trim_end_matches('.');
    format!("{text} {unit}")
}

/// Names longer than the margin are cut, visibly.
fn shorten(name: &str) -> String {
    const MOST: usize = 19;
    if name.chars().count() <= MOST {
        return name.to_string();
    }
    name.chars().take(MOST - 1).chain(['…']).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_merge_where_they_overlap() {
        let w = Timeline::windows_around(&[500, 100, 105, u64::MAX], 10, 20);
        assert_eq!(w, [(90, 125), (490, 520), (u64::MAX - 10, u64::MAX)]);
    }

    #[test]
    fn durations_for_people() {
        assert_eq!(duration(0.0124), "12.4 ms");
        assert_eq!(duration(20e-6), "20 µs");
        assert_eq!(duration(3.0), "3 s");
        assert_eq!(duration(8e-9), "8 ns");
    }

    #[test]
    fn one_scale_for_all_windows() {
        let spans = window_spans(&[(0, 100), (1000, 1200)]);
        assert!((spans[1].w / spans[0].w - 2.0).abs() < 1e-9);
        assert!(spans[1].x > spans[0].x + spans[0].w);
    }
}
