//! Sections, histograms and other curves.

use crate::colour::line_colour;
use crate::error::ReportError;
use crate::heatmap::{AxisSpan, TICK};
use crate::svg::{Anchor, Markup, SMALL, Svg, TEXT};

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeriesStyle {
    /// Joined by lines; a NaN leaves a gap.
    Line,
    /// As `Line`, dashed: expected or commanded values.
    Dashed,
    /// Dots.
    Points,
    /// Bars from zero, each as wide as the distance to its neighbour.
    Bars,
}

/// One series of a chart.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend; none if empty.
    pub name: String,
    /// Points, in drawing order.
    pub points: Vec<(f64, f64)>,
    /// Standard uncertainty of y per point, drawn as a band of ± sigma; empty for none.
    pub sigma: Vec<f64>,
    /// How it is drawn.
    pub style: SeriesStyle,
}

impl Series {
    /// A series without uncertainty.
    #[must_use]
    pub fn new(name: &str, style: SeriesStyle, points: Vec<(f64, f64)>) -> Self {
        Series { name: name.into(), points, sigma: Vec::new(), style }
    }

    /// A histogram: how many finite values fall into each of `bins` equal bins between `low` and
    /// `high`; the last bin includes `high`, values outside are not counted.
    #[must_use]
    pub fn histogram(name: &str, values: &[f64], low: f64, high: f64, bins: usize) -> Self {
        let bins = bins.max(1);
        let width = (high - low) / bins as f64;
        let mut counts = vec![0u64; bins];
        for &v in values.iter().filter(|v| **v >= low && **v <= high) {
            counts[(((v - low) / width) as usize).min(bins - 1)] += 1;
        }
        let centre = |i: usize| low + (i as f64 + 0.5) * width;
        let points = counts.iter().enumerate().map(|(i, &n)| (centre(i), n as f64));
        Series::new(name, SeriesStyle::Bars, points.collect())
    }
}

/// Curves over a common pair of axes.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// Title above the chart.
    pub title: String,
    /// Label of the horizontal axis, with unit.
    pub x_label: String,
    /// Label of the vertical axis, with unit.
    pub y_label: String,
    /// The series.
    pub series: Vec<Series>,
    /// Limits of the vertical axis; `None` takes them from the points.
    pub y_limits: Option<(f64, f64)>,
}

/// Lowest and highest value on an axis.
type Range = (f64, f64);

/// Corner and size of the plot in the drawing.
struct Frame {
    left: f64,
    top: f64,
    w: f64,
    h: f64,
    x: (f64, f64),
    y: (f64, f64),
}

impl Frame {
    fn to(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (
            self.left + (x - self.x.0) / (self.x.1 - self.x.0) * self.w,
            self.top + (self.y.1 - y) / (self.y.1 - self.y.0) * self.h,
        )
    }
}

impl Chart {
    /// The chart as SVG.
    ///
    /// # Errors
    /// [`ReportError::Empty`] if there is no finite point.
    pub fn render_svg(&self) -> Result<Markup, ReportError> {
        let named: Vec<(usize, &Series)> =
            self.series.iter().enumerate().filter(|(_, s)| !s.name.is_empty()).collect();
        let legend_top = 36.0;
        let (w, h) = (464.0, 280.0);
        let left = 72.0;
        let rows = legend_rows(&named, left + w);
        let top = if rows.is_empty() { 32.0 } else { legend_top + 18.0 * rows.len() as f64 - 4.0 };
        let (x, y) = self.extent()?;
        let frame = Frame { left, top, w, h, x, y };
        let mut svg = Svg::new(left + w + 24.0, top + h + 46.0, &self.title);
        svg.title(&self.title);
        for (row, entries) in rows.iter().enumerate() {
            let y = legend_top + 18.0 * row as f64;
            for &(at, index, series) in entries {
                self.legend_entry(&mut svg, at, y, index, series);
            }
        }
        for (label, t) in (AxisSpan { at0: x.0, per: x.1 - x.0 }).ticks(9) {
            let at = left + t * w;
            svg.line((at, top), (at, top + h), GRID);
            svg.line((at, top + h), (at, top + h + 5.0), TICK);
            svg.text(at, top + h + 17.0, SMALL, Anchor::Middle, &label);
        }
        for (label, t) in (AxisSpan { at0: y.1, per: y.0 - y.1 }).ticks(8) {
            let at = top + t * h;
            svg.line((left, at), (left + w, at), GRID);
            svg.text(left - 7.0, at + 4.0, SMALL, Anchor::End, &label);
        }
        for (index, series) in self.series.iter().enumerate() {
            draw(&mut svg, &frame, index, series);
        }
        svg.rect(left, top, w, h, "fill=\"none\" stroke=\"currentColor\" stroke-opacity=\"0.6\"");
        svg.text(left + w / 2.0, top + h + 37.0, TEXT, Anchor::Middle, &self.x_label);
        svg.text_up(15.0, top + h / 2.0, TEXT, &self.y_label);
        Ok(svg.finish())
    }

    fn legend_entry(&self, svg: &mut Svg, x: f64, y: f64, index: usize, series: &Series) {
        let colour = line_colour(index);
        let dash = if series.style == SeriesStyle::Dashed { " stroke-dasharray=\"6 4\"" } else { "" };
        match series.style {
            SeriesStyle::Points => svg.circle(x + 11.0, y - 4.0, 3.0, &format!("fill=\"{colour}\"")),
            SeriesStyle::Bars => {
                svg.rect(x + 4.0, y - 10.0, 14.0, 11.0, &format!("fill=\"{colour}\" fill-opacity=\"0.7\""))
            }
            _ => svg.line(
                (x, y - 4.0),
                (x + 22.0, y - 4.0),
                &format!("stroke=\"{colour}\" stroke-width=\"2\"{dash}"),
            ),
        }
        svg.text(x + 28.0, y, SMALL, Anchor::Start, &series.name);
    }

    /// Limits of both axes.
    fn extent(&self) -> Result<(Range, Range), ReportError> {
        let mut x = (f64::INFINITY, f64::NEG_INFINITY);
        let mut y = x;
        let grow = |range: &mut (f64, f64), v: f64| {
            *range = (range.0.min(v), range.1.max(v));
        };
        for s in &self.series {
            let half_bar = if s.style == SeriesStyle::Bars { bar_width(s) / 2.0 } else { 0.0 };
            for (i, &(px, py)) in s.points.iter().enumerate() {
                if !(px.is_finite() && py.is_finite()) {
                    continue;
                }
                let sigma = s.sigma.get(i).copied().filter(|v| v.is_finite()).unwrap_or(0.0);
                grow(&mut x, px - half_bar);
                grow(&mut x, px + half_bar);
                grow(&mut y, py - sigma);
                grow(&mut y, py + sigma);
                if s.style == SeriesStyle::Bars {
                    grow(&mut y, 0.0);
                }
            }
        }
        if x.0 > x.1 {
            return Err(ReportError::Empty { figure: self.title.clone() });
        }
        let bars = self.series.iter().any(|s| s.style == SeriesStyle::Bars);
        let apart = |(low, high): (f64, f64), share: f64| {
            if high > low {
                let room = (high - low) * share;
                // Bars stand on the axis.
                (if bars && low == 0.0 { low } else { low - room }, high + room)
            } else {
                let room = if low == 0.0 { 1.0 } else { low.abs() * 1e-3 };
                (low - room, high + room)
            }
        };
        let y = match self.y_limits {
            Some((a, b)) if a.is_finite() && b.is_finite() && a != b => (a.min(b), a.max(b)),
            _ => apart(y, 0.05),
        };
        Ok((apart(x, 0.0), y))
    }
}

pub(crate) const GRID: &str = "stroke=\"currentColor\" stroke-opacity=\"0.12\"";

/// Legend entries as (x, index, series), broken into rows of the given width. There are no font
/// metrics here: 6.6 px per character is wide enough for the fonts named in the drawing.
fn legend_rows<'a>(named: &[(usize, &'a Series)], width: f64) -> Vec<Vec<(f64, usize, &'a Series)>> {
    let mut rows: Vec<Vec<(f64, usize, &Series)>> = Vec::new();
    let mut x = f64::INFINITY;
    for &(index, series) in named {
        let wide = 28.0 + 6.6 * series.name.chars().count() as f64 + 18.0;
        if x + wide > width {
            rows.push(Vec::new());
            x = 8.0;
        }
        if let Some(row) = rows.last_mut() {
            row.push((x, index, series));
        }
        x += wide;
    }
    rows
}

fn bar_width(series: &Series) -> f64 {
    let steps = series.points.windows(2).map(|p| (p[1].0 - p[0].0).abs());
    let least = steps.filter(|s| *s > 0.0).fold(f64::INFINITY, f64::min);
    if least.is_finite() { least } else { 1.0 }
}

fn draw(svg: &mut Svg, frame: &Frame, index: usize, series: &Series) {
    let colour = line_colour(index);
    // Keeps curves inside the frame when the limits are given and narrower than the points.
    let clamp = |p: (f64, f64)| (p.0, p.1.clamp(frame.y.0, frame.y.1));
    let inside = |p: &(f64, f64)| p.1 >= frame.y.0 && p.1 <= frame.y.1;
    let finite = |p: &(f64, f64)| p.0.is_finite() && p.1.is_finite();
    if series.sigma.len() == series.points.len() && !series.sigma.is_empty() {
        let both: Vec<_> = series.points.iter().zip(&series.sigma).collect();
        for run in both.split(|(p, s)| !finite(p) || !s.is_finite()) {
            let edge = |sign: f64| move |&(&(x, y), &s): &(&(f64, f64), &f64)| (x, y + sign * s);
            let upper = run.iter().map(edge(1.0));
            let lower = run.iter().rev().map(edge(-1.0));
            let band: Vec<_> = upper.chain(lower).map(|p| frame.to(clamp(p))).collect();
            svg.path(&band, true, &format!("fill=\"{colour}\" fill-opacity=\"0.2\""));
        }
    }
    match series.style {
        SeriesStyle::Line | SeriesStyle::Dashed => {
            let dash = if series.style == SeriesStyle::Dashed { " stroke-dasharray=\"6 4\"" } else { "" };
            for run in series.points.split(|p| !finite(p)) {
                let line: Vec<_> = run.iter().map(|&p| frame.to(clamp(p))).collect();
                svg.path(&line, false, &format!(
                    "fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\" stroke-linejoin=\"round\"{dash}"
                ));
            }
        }
        SeriesStyle::Points => {
            for &p in series.points.iter().filter(|p| finite(p) && inside(p)) {
                let (x, y) = frame.to(p);
                svg.circle(x, y, 2.2, &format!("fill=\"{colour}\""));
            }
        }
        SeriesStyle::Bars => {
            let wide = bar_width(series);
            for &(x, y) in series.points.iter().filter(|p| finite(p)) {
                let (x0, y0) = frame.to(clamp((x - wide / 2.0, 0.0)));
                let (x1, y1) = frame.to(clamp((x + wide / 2.0, y)));
                let (w, h) = ((x1 - x0 - 0.6).max(0.4), (y0 - y1).abs());
                svg.rect(x0, y0.min(y1), w, h, &format!("fill=\"{colour}\" fill-opacity=\"0.7\""));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn histogram_counts_everything_inside_once() {
        let s = Series::histogram("", &[0.0, 0.1, 0.5, 1.0, 1.1, -0.1, f64::NAN], 0.0, 1.0, 2);
        assert_eq!(s.points, [(0.25, 2.0), (0.75, 2.0)]);
    }

    #[test]
    fn nothing_to_draw_is_an_error() {
        let mut chart = Chart {
            title: "t".into(),
            x_label: String::new(),
            y_label: String::new(),
            series: vec![Series::new("s", SeriesStyle::Line, vec![(f64::NAN, 1.0)])],
            y_limits: None,
        };
        assert!(matches!(chart.render_svg(), Err(ReportError::Empty { .. })));
        chart.series[0].points.push((1.0, 1.0));
        chart.render_svg().unwrap();
    }
}
