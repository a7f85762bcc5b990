//! A quantity over a grid in colours, with axes and colour bar.

use crate::axis::Ticks;
use crate::colour::{ColourMap, ColourScale};
use crate::error::ReportError;
use crate::svg::{Anchor, Markup, SMALL, Svg, TEXT, encode_png};

/// Where the nodes of a grid lie: node (column i, row j) is at (`x0 + i * dx`, `y0 + j * dy`).
#[derive(Debug, Clone, PartialEq)]
pub struct GridAxes {
    /// x of column 0.
    pub x0: f64,
    /// Distance between columns, not zero.
    pub dx: f64,
    /// y of row 0.
    pub y0: f64,
    /// Distance between rows, not zero.
    pub dy: f64,
    /// Unit of the axes, "px" or "mm".
    pub unit: String,
    /// Names of the axes to the right and down, mostly "x" and "y".
    pub names: [&'static str; 2],
}

/// A scalar over a grid. Row 0 is drawn on top and column 0 on the left, as in the image, whatever
/// the sign of the steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Heatmap {
    /// Title above the map.
    pub title: String,
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Values, `values[j * width + i]`; NaN is no value and is left out.
    pub values: Vec<f64>,
    /// Where the nodes lie.
    pub axes: GridAxes,
    /// Symbol of the quantity at the colour bar: "h".
    pub quantity: String,
    /// Unit of the quantity.
    pub unit: String,
    /// Colours and limits.
    pub scale: ColourScale,
}

/// Longest side of an embedded map in pixels; larger grids are averaged down.
const MOST_PIXELS: usize = 1000;
/// Longest side of a map saved as a picture of its own is enlarged to about this.
const PICTURE_PIXELS: usize = 800;

impl Heatmap {
    fn check(&self) -> Result<(), ReportError> {
        if self.values.is_empty() || self.width.checked_mul(self.height) != Some(self.values.len()) {
            return Err(ReportError::Shape {
                figure: self.title.clone(),
                width: self.width,
                height: self.height,
                values: self.values.len(),
            });
        }
        let a = &self.axes;
        let finite = [a.x0, a.dx, a.y0, a.dy].iter().all(|v| v.is_finite());
        if !finite || a.dx == 0.0 || a.dy == 0.0 {
            return Err(ReportError::Axes { figure: self.title.clone() });
        }
        Ok(())
    }

    /// The bare map as PNG: every node a square of `n × n` equal pixels (n = 1 for large grids),
    /// transparent where there is no value.
    ///
    /// # Errors
    /// [`ReportError::Shape`], [`ReportError::Axes`], [`ReportError::Picture`].
    pub fn render_png(&self) -> Result<Vec<u8>, ReportError> {
        self.check()?;
        let n = (PICTURE_PIXELS / self.width.max(self.height)).clamp(1, 32);
        let mut rgba = Vec::with_capacity(self.values.len() * n * n * 4);
        for row in self.values.chunks_exact(self.width) {
            let line: Vec<u8> =
                row.iter().flat_map(|&v| std::iter::repeat_n(self.scale.rgba(v), n)).flatten().collect();
            (0..n).for_each(|_| rgba.extend_from_slice(&line));
        }
        encode_png(&self.title, self.width * n, self.height * n, rgba)
    }

    /// The map with title, axes and colour bar.
    ///
    /// # Errors
    /// [`ReportError::Shape`], [`ReportError::Axes`], [`ReportError::Picture`].
    pub fn render_svg(&self) -> Result<Markup, ReportError> {
        self.check()?;
        let a = &self.axes;
        let (span_x, span_y) = (self.width as f64 * a.dx.abs(), self.height as f64 * a.dy.abs());
        // True to scale, within a frame; strips thinner than 1:6 are widened to stay readable.
        let ratio = (span_y / span_x).clamp(1.0 / 6.0, 6.0);
        let w = (400.0 / ratio).min(394.0);
        let h = w * ratio;
        let (left, top) = (62.0, 32.0);
        let mut svg = Svg::new(left + w + 104.0, top + h + 46.0, &self.title);
        svg.title(&self.title);
        svg.rect(left, top, w, h, "fill=\"#888\" fill-opacity=\"0.18\"");
        let block = self.width.max(self.height).div_ceil(MOST_PIXELS);
        let (cols, rows, values) = block_mean(&self.values, self.width, self.height, block);
        let rgba = values.iter().flat_map(|&v| self.scale.rgba(v)).collect();
        let png = encode_png(&self.title, cols, rows, rgba)?;
        svg.picture(left, top, w, h, &png, true);
        svg.rect(left, top, w, h, "fill=\"none\" stroke=\"currentColor\" stroke-opacity=\"0.6\"");
        // Nodes are cell centres: the frame reaches half a step beyond the outer ones.
        let x = AxisSpan { at0: a.x0 - a.dx / 2.0, per: self.width as f64 * a.dx };
        let y = AxisSpan { at0: a.y0 - a.dy / 2.0, per: self.height as f64 * a.dy };
        for (label, t) in x.ticks(((w / 52.0) as usize).max(3)) {
            let at = left + t * w;
            svg.line((at, top + h), (at, top + h + 5.0), TICK);
            svg.text(at, top + h + 17.0, SMALL, Anchor::Middle, &label);
        }
        for (label, t) in y.ticks(((h / 40.0) as usize).max(3)) {
            let at = top + t * h;
            svg.line((left - 5.0, at), (left, at), TICK);
            svg.text(left - 8.0, at + 4.0, SMALL, Anchor::End, &label);
        }
        svg.text(
            left + w / 2.0,
            top + h + 36.0,
            TEXT,
            Anchor::Middle,
            &format!("{} / {}", a.names[0], a.unit),
        );
        svg.text_up(14.0, top + h / 2.0, TEXT, &format!("{} / {}", a.names[1], a.unit));
        self.colour_bar(&mut svg, left + w + 18.0, top, h)?;
        Ok(svg.finish())
    }

    fn colour_bar(&self, svg: &mut Svg, x: f64, top: f64, h: f64) -> Result<(), ReportError> {
        let limits = self.scale.limits;
        let colours = (0..128).rev().flat_map(|i| {
            let [r, g, b] = self.scale.map.rgb(f64::from(i) / 127.0);
            [r, g, b, 255]
        });
        let png = encode_png(&self.title, 1, 128, colours.collect())?;
        svg.picture(x, top, 14.0, h, &png, false);
        svg.rect(x, top, 14.0, h, "fill=\"none\" stroke=\"currentColor\" stroke-opacity=\"0.6\"");
        let span = AxisSpan { at0: limits.high(), per: limits.low() - limits.high() };
        let ticks = span.ticks(((h / 36.0) as usize).clamp(3, 9));
        let widest = ticks.iter().map(|(label, _)| label.chars().count()).max().unwrap_or(0);
        for (label, t) in ticks {
            let at = top + t * h;
            svg.line((x + 14.0, at), (x + 18.0, at), TICK);
            svg.text(x + 21.0, at + 4.0, SMALL, Anchor::Start, &label);
        }
        let unit = if self.unit.is_empty() {
            self.quantity.clone()
        } else {
            format!("{} / {}", self.quantity, self.unit)
        };
        svg.text_up(x + 38.0 + 6.6 * widest as f64, top + h / 2.0, TEXT, &unit);
        Ok(())
    }
}

pub(crate) const TICK: &str = "stroke=\"currentColor\" stroke-opacity=\"0.6\"";

/// An axis from `at0`, `per` long (which may be negative).
pub(crate) struct AxisSpan {
    pub(crate) at0: f64,
    pub(crate) per: f64,
}

impl AxisSpan {
    /// Labels and where they stand, 0..=1 from the start of the axis.
    pub(crate) fn ticks(&self, most: usize) -> Vec<(String, f64)> {
        let end = self.at0 + self.per;
        let ticks = Ticks::between(self.at0.min(end), self.at0.max(end), most);
        ticks.values.iter().map(|&v| (ticks.label(v), (v - self.at0) / self.per)).collect()
    }
}

/// Mean of the finite values in blocks of `n × n`; NaN where a block has none.
pub(crate) fn block_mean(values: &[f64], width: usize, height: usize, n: usize) -> (usize, usize, Vec<f64>) {
    if n <= 1 {
        return (width, height, values.to_vec());
    }
    let (cols, rows) = (width.div_ceil(n), height.div_ceil(n));
    let mut sums = vec![(0.0, 0u32); cols * rows];
    for (at, &v) in values.iter().enumerate().filter(|(_, v)| v.is_finite()) {
        let (sum, count) = &mut sums[at / width / n * cols + at % width / n];
        *sum += v;
        *count += 1;
    }
    let mean = |(sum, count): &(f64, u32)| {
        if *count == 0 { f64::NAN } else { sum / f64::from(*count) }
    };
    (cols, rows, sums.iter().map(mean).collect())
}

impl ColourScale {
    /// The colours as hexadecimal digits, `n` stops.
    pub(crate) fn stops(map: ColourMap, n: u32) -> String {
        (0..n)
            .map(|i| {
                let [r, g, b] = map.rgb(f64::from(i) / f64::from(n - 1));
                format!("{r:02x}{g:02x}{b:02x}")
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_average_what_is_there() {
        let nan = f64::NAN;
        let (w, h, v) = block_mean(&[1.0, 3.0, nan, 5.0, nan, nan], 3, 2, 2);
        assert_eq!((w, h), (2, 1));
        assert_eq!(v[0], 3.0);
        assert!(v[1].is_nan());
    }
}
