//! A camera frame with outlines drawn on it.

use crate::colour::line_colour;
use crate::error::ReportError;
use crate::svg::{Anchor, Markup, SMALL, Svg, encode_png};

/// Something drawn on a frame; coordinates in pixels of the frame, pixel (0, 0) centred at (0, 0).
/// Marks of equal `colour` (an index) have equal colours.
#[derive(Debug, Clone, PartialEq)]
pub enum Mark {
    /// An outline through corners, closed.
    Outline {
        /// The corners.
        points: Vec<(f64, f64)>,
        /// Name, at the first corner; may be empty.
        label: String,
        /// Index of the colour.
        colour: usize,
    },
    /// A cross.
    Cross {
        /// Its centre, x.
        x: f64,
        /// Its centre, y.
        y: f64,
        /// Name beside it; may be empty.
        label: String,
        /// Index of the colour.
        colour: usize,
    },
    /// Small dots, such as measured points.
    Dots {
        /// Their centres.
        points: Vec<(f64, f64)>,
        /// Index of the colour.
        colour: usize,
    },
}

impl Mark {
    /// The outline of a rectangle of whole pixels, from the outer edge of pixel (`x`, `y`).
    #[must_use]
    pub fn rectangle(x: f64, y: f64, w: f64, h: f64, label: &str, colour: usize) -> Self {
        let (x, y) = (x - 0.5, y - 0.5);
        Mark::Outline {
            points: vec![(x, y), (x + w, y), (x + w, y + h), (x, y + h)],
            label: label.to_string(),
            colour,
        }
    }
}

/// A grey frame with marks.
#[derive(Debug, Clone, PartialEq)]
pub struct Overlay {
    /// Title above the frame.
    pub title: String,
    /// Width of the frame in pixels.
    pub width: usize,
    /// Height of the frame in pixels.
    pub height: usize,
    /// Grey values, row-major.
    pub grey: Vec<u16>,
    /// Grey values shown black and white; `None` takes the 0.1 % and 99.9 % quantiles. They are
    /// stated below the frame.
    pub display: Option<(u16, u16)>,
    /// What is drawn on it, in this order.
    pub marks: Vec<Mark>,
    /// Width of the drawing at most, in pixels; the frame is averaged down to it.
    pub most_pixels: usize,
}

/// The frame averaged down over blocks of `block × block` pixels.
struct Picture {
    cols: usize,
    rows: usize,
    block: usize,
    black: u16,
    white: u16,
    png: Vec<u8>,
}

impl Overlay {
    fn picture(&self) -> Result<Picture, ReportError> {
        if self.grey.is_empty() || self.width.checked_mul(self.height) != Some(self.grey.len()) {
            return Err(ReportError::Shape {
                figure: self.title.clone(),
                width: self.width,
                height: self.height,
                values: self.grey.len(),
            });
        }
        let n = self.width.max(self.height).div_ceil(self.most_pixels.clamp(16, 4000));
        let (w, h, grey) = average_down(&self.grey, self.width, self.height, n);
        let (black, white) = self.display.unwrap_or_else(|| quantiles(&self.grey));
        let range = (f64::from(white) - f64::from(black)).max(1.0);
        let rgba = grey.iter().flat_map(|g| {
            let v = ((g - f64::from(black)) / range * 255.0).round().clamp(0.0, 255.0) as u8;
            [v, v, v, 255]
        });
        let png = encode_png(&self.title, w, h, rgba.collect())?;
        Ok(Picture { cols: w, rows: h, block: n, black, white, png })
    }

    /// The bare frame, averaged down, as PNG.
    ///
    /// # Errors
    /// [`ReportError::Shape`], [`ReportError::Picture`].
    pub fn render_png(&self) -> Result<Vec<u8>, ReportError> {
        self.picture().map(|p| p.png)
    }

    /// The frame with its marks.
    ///
    /// # Errors
    /// [`ReportError::Shape`], [`ReportError::Picture`].
    pub fn render_svg(&self) -> Result<Markup, ReportError> {
        let Picture { cols, rows, block, black, white, png } = self.picture()?;
        let n = block as f64;
        // The last block may be cut off by the edge of the frame: the picture is drawn as wide as
        // its blocks, so that marks stay where they belong.
        let most = self.most_pixels.clamp(16, 4000) as f64;
        let zoom = most / (self.width.max(self.height) as f64);
        let (w, h) = (cols as f64 * n * zoom, rows as f64 * n * zoom);
        let top = 30.0;
        let mut svg = Svg::new(w.max(320.0) + 2.0, top + h + 24.0, &self.title);
        svg.title(&self.title);
        svg.picture(0.0, top, w, h, &png, zoom * n > 2.0);
        let to = |(x, y): (f64, f64)| ((x + 0.5) * zoom, top + (y + 0.5) * zoom);
        for mark in &self.marks {
            draw(&mut svg, mark, &to, w);
        }
        let size =
            format!("{} × {} px, shown black at grey {black}, white at {white}", self.width, self.height);
        svg.text(0.0, top + h + 17.0, SMALL, Anchor::Start, &size);
        Ok(svg.finish())
    }
}

fn draw(svg: &mut Svg, mark: &Mark, to: &dyn Fn((f64, f64)) -> (f64, f64), width: f64) {
    let finite = |p: &&(f64, f64)| p.0.is_finite() && p.1.is_finite();
    match mark {
        Mark::Outline { points, label, colour } => {
            let points: Vec<_> = points.iter().filter(finite).map(|&p| to(p)).collect();
            let colour = line_colour(*colour);
            // A dark line below the coloured one is seen on bright speckle too.
            svg.path(
                &points,
                true,
                "fill=\"none\" stroke=\"#000\" stroke-opacity=\"0.6\" stroke-width=\"4\"",
            );
            svg.path(&points, true, &format!("fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\""));
            if let (Some(&(x, y)), false) = (points.first(), label.is_empty()) {
                svg.text_on_picture(x.clamp(0.0, width - 40.0) + 6.0, y + 17.0, Anchor::Start, "#fff", label);
            }
        }
        Mark::Cross { x, y, label, colour } if x.is_finite() && y.is_finite() => {
            let (cx, cy) = to((*x, *y));
            for (style, r) in [
                ("stroke=\"#000\" stroke-opacity=\"0.7\" stroke-width=\"4\"".to_string(), 8.0),
                (format!("stroke=\"{}\" stroke-width=\"2\"", line_colour(*colour)), 7.0),
            ] {
                svg.line((cx - r, cy), (cx + r, cy), &style);
                svg.line((cx, cy - r), (cx, cy + r), &style);
            }
            if !label.is_empty() {
                let (anchor, dx) =
                    if cx > width - 120.0 { (Anchor::End, -10.0) } else { (Anchor::Start, 10.0) };
                let dy = if cy < 50.0 { 18.0 } else { -6.0 };
                svg.text_on_picture(cx + dx, cy + dy, anchor, "#fff", label);
            }
        }
        Mark::Cross { .. } => {}
        Mark::Dots { points, colour } => {
            let style = format!("fill=\"{}\" fill-opacity=\"0.8\"", line_colour(*colour));
            for &p in points.iter().filter(finite) {
                let (x, y) = to(p);
                svg.circle(x, y, 1.3, &style);
            }
        }
    }
}

/// Mean over blocks of `n × n` pixels (cut off at the right and lower edge).
fn average_down(grey: &[u16], width: usize, height: usize, n: usize) -> (usize, usize, Vec<f64>) {
    let (cols, rows) = (width.div_ceil(n), height.div_ceil(n));
    let mut sums = vec![(0u64, 0u32); cols * rows];
    for (row, line) in grey.chunks_exact(width).enumerate() {
        for (block, pixels) in line.chunks(n).enumerate() {
            let (sum, count) = &mut sums[row / n * cols + block];
            *sum += pixels.iter().map(|&v| u64::from(v)).sum::<u64>();
            *count += pixels.len() as u32;
        }
    }
    let means = sums.iter().map(|&(sum, count)| sum as f64 / f64::from(count.max(1)));
    (cols, rows, means.collect())
}

fn quantiles(grey: &[u16]) -> (u16, u16) {
    let mut counts = vec![0usize; 1 << 16];
    for &g in grey {
        counts[usize::from(g)] += 1;
    }
    let beyond = grey.len() / 1000;
    let reach = |order: &mut dyn Iterator<Item = usize>| {
        let mut seen = 0;
        let mut at = 0;
        for level in order {
            at = level;
            seen += counts[level];
            if seen > beyond {
                break;
            }
        }
        u16::try_from(at).unwrap_or(u16::MAX)
    };
    (reach(&mut (0..counts.len())), reach(&mut (0..counts.len()).rev()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn averages_areas() {
        let (w, h, v) = average_down(&[0, 2, 9, 4, 6, 11], 3, 2, 2);
        assert_eq!((w, h, v), (2, 1, vec![3.0, 10.0]));
    }

    #[test]
    fn quantiles_leave_outliers_out() {
        let mut grey: Vec<u16> = (0..10_000).map(|i| 100 + i % 200).collect();
        grey[3] = 65535;
        grey[4] = 0;
        assert_eq!(quantiles(&grey), (100, 299));
        assert_eq!(quantiles(&[7]), (7, 7));
    }
}
