//! A surface over a grid that can be turned on the page, with a still picture for print and for
//! readers without scripts.
//!
//! Seen from the camera's side: x to the right, y towards the viewer (down in the image), height
//! up. Projection without perspective, so that parallel edges stay parallel.

use serde_json::json;

use crate::colour::{ColourScale, Limits};
use crate::error::ReportError;
use crate::heatmap::{GridAxes, block_mean};
use crate::number::short;
use crate::svg::{Anchor, Markup, SMALL, Svg, encode_png, escape};

/// A surface of heights over a grid.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightSurface {
    /// Title above the view.
    pub title: String,
    /// Number of columns, two or more.
    pub width: usize,
    /// Number of rows, two or more.
    pub height: usize,
    /// Heights, `values[j * width + i]`; NaN is a hole.
    pub values: Vec<f64>,
    /// Where the nodes lie.
    pub axes: GridAxes,
    /// Symbol of the height: "h".
    pub quantity: String,
    /// Unit of the heights.
    pub unit: String,
    /// Colours and limits.
    pub scale: ColourScale,
}

/// More nodes than this on a side are averaged down.
const MOST_NODES: usize = 72;
const WIDTH: f64 = 620.0;
const HEIGHT: f64 = 420.0;
const AZIMUTH: f64 = -0.55;
const ELEVATION: f64 = 0.62;
const SCRIPT: &str = include_str!("scene3d.js");

/// What is drawn: everything in units of the longer side of the grid.
struct Scene {
    cols: usize,
    rows: usize,
    /// Height as a fraction of the range, per node.
    level: Vec<f64>,
    /// Position on the colour map, per node.
    colour: Vec<f64>,
    /// Brightness of the cell to the lower right of a node.
    shade: Vec<f64>,
    /// Extent in x, y and height.
    size: (f64, f64, f64),
    labels: Vec<(f64, f64, f64, String)>,
}

/// Orthographic view; the same formula as in the script.
struct View {
    azimuth: f64,
    elevation: f64,
    factor: f64,
}

impl View {
    /// Pixel x, pixel y (down), and nearness to the viewer.
    fn project(&self, (x, y, z): (f64, f64, f64)) -> (f64, f64, f64) {
        let (ca, sa) = (self.azimuth.cos(), self.azimuth.sin());
        let (ce, se) = (self.elevation.cos(), self.elevation.sin());
        let (u, v) = (x * ca - y * sa, x * sa + y * ca);
        (WIDTH / 2.0 + u * self.factor, HEIGHT / 2.0 + (v * se - z * ce) * self.factor, v * ce + z * se)
    }
}

impl HeightSurface {
    /// The view as HTML: a still SVG, and data and script (no library, no request) that put a
    /// canvas in its place: drag to turn, wheel to zoom, double click to reset.
    ///
    /// # Errors
    /// [`ReportError::Shape`] for fewer than 2 × 2 nodes, [`ReportError::Axes`],
    /// [`ReportError::Empty`] without any height, [`ReportError::Picture`].
    pub fn render_html(&self) -> Result<Markup, ReportError> {
        let scene = self.scene()?;
        let view = self.view(&scene);
        let still = self.still(&scene, &view)?;
        let round = |v: &f64| {
            if v.is_finite() { json!((v * 2000.0).round() / 2000.0) } else { json!(null) }
        };
        let list = |v: &[f64]| v.iter().map(round).collect::<Vec<_>>();
        let data = json!({
            "title": self.title, "w": WIDTH, "h": HEIGHT,
            "az": view.azimuth, "el": view.elevation, "f": view.factor,
            "cols": scene.cols, "rows": scene.rows,
            "ax": scene.size.0, "ay": scene.size.1, "az3": scene.size.2,
            "z": list(&scene.level), "c": list(&scene.colour), "s": list(&scene.shade),
            "lut": ColourScale::stops(self.scale.map, 64),
            "labels": scene.labels,
        });
        // Inside <script> only "</" and "<!" matter; no "<" at all is safest.
        let data = data.to_string().replace('<', "\\u003c");
        Ok(Markup(format!(
            "<div class=\"scene3d\"><p class=\"scene-title\">{}</p>\n<div class=\"still\">{}</div>\n<script type=\"application/json\">{data}</script>\n<script>{SCRIPT}</script></div>",
            escape(&self.title),
            still.as_str(),
        )))
    }

    /// The still view alone, as SVG.
    ///
    /// # Errors
    /// As [`HeightSurface::render_html`].
    pub fn render_svg(&self) -> Result<Markup, ReportError> {
        let scene = self.scene()?;
        let view = self.view(&scene);
        self.still(&scene, &view)
    }

    fn scene(&self) -> Result<Scene, ReportError> {
        let shape = self.width.checked_mul(self.height) == Some(self.values.len());
        if !shape || self.width < 2 || self.height < 2 {
            return Err(ReportError::Shape {
                figure: self.title.clone(),
                width: self.width,
                height: self.height,
                values: self.values.len(),
            });
        }
        let a = &self.axes;
        if !(a.dx.is_finite() && a.dy.is_finite() && a.dx != 0.0 && a.dy != 0.0) {
            return Err(ReportError::Axes { figure: self.title.clone() });
        }
        let n = self.width.max(self.height).div_ceil(MOST_NODES);
        let (mut cols, mut rows, mut heights) = block_mean(&self.values, self.width, self.height, n);
        // A strip narrower than one block still needs two nodes across.
        if cols < 2 || rows < 2 {
            (cols, rows, heights) = (self.width, self.height, self.values.clone());
        }
        if !heights.iter().any(|v| v.is_finite()) {
            return Err(ReportError::Empty { figure: self.title.clone() });
        }
        // The labels give the range of the measured values, not of their averages.
        let range = Limits::of(&self.values);
        let extent = ((self.width - 1) as f64 * a.dx.abs(), (self.height - 1) as f64 * a.dy.abs());
        let longest = extent.0.max(extent.1);
        // Thin strips are widened, and heights always fill a fixed share of the view: the labels
        // give the true extents.
        let size = ((extent.0 / longest).max(0.25), (extent.1 / longest).max(0.25), 0.36);
        let level: Vec<f64> = heights.iter().map(|&v| range.position(v)).collect();
        let colour = heights.iter().map(|&v| self.scale.limits.position(v).clamp(0.0, 1.0));
        let shade = shades(&level, cols, rows, size);
        let at = |name: &str, v: f64, unit: &str| format!("{name} = {} {unit}", short(v));
        let (sx, sy, sz) = size;
        let (x1, y1) = (a.x0 + (self.width - 1) as f64 * a.dx, a.y0 + (self.height - 1) as f64 * a.dy);
        let (left, right, near) = (-sx / 2.0, sx / 2.0, sy / 2.0);
        let (far, low, high) = (-sy / 2.0, -sz / 2.0, sz / 2.0);
        let labels = vec![
            (left, near + 0.09, low, at("x", a.x0, &a.unit)),
            (right, near + 0.09, low, at("x", x1, &a.unit)),
            (right + 0.26, far, low, at("y", a.y0, &a.unit)),
            (right + 0.16, near, low, at("y", y1, &a.unit)),
            (left - 0.18, far, high, at(&self.quantity, range.high(), &self.unit)),
            (left - 0.18, far, low, at(&self.quantity, range.low(), &self.unit)),
        ];
        Ok(Scene { cols, rows, level, colour: colour.collect(), shade, size, labels })
    }

    fn view(&self, scene: &Scene) -> View {
        let (x, y, z) = scene.size;
        let diagonal = (x * x + y * y).sqrt();
        let rise = diagonal * ELEVATION.sin() + z * ELEVATION.cos();
        let factor = ((WIDTH - 190.0) / diagonal).min((HEIGHT - 70.0) / rise);
        View { azimuth: AZIMUTH, elevation: ELEVATION, factor }
    }

    fn still(&self, scene: &Scene, view: &View) -> Result<Markup, ReportError> {
        let mut svg = Svg::new(WIDTH, HEIGHT, &self.title);
        let (x, y, z) = (scene.size.0 / 2.0, scene.size.1 / 2.0, scene.size.2 / 2.0);
        let corners = [(-x, -y), (x, -y), (x, y), (-x, y)];
        let flat = |p: (f64, f64, f64)| {
            let (u, v, _) = view.project(p);
            (u, v)
        };
        let style = "stroke=\"currentColor\" stroke-opacity=\"0.45\"";
        for (i, &(cx, cy)) in corners.iter().enumerate() {
            let (nx, ny) = corners[(i + 1) % 4];
            svg.line(flat((cx, cy, -z)), flat((nx, ny, -z)), style);
            svg.line(flat((cx, cy, -z)), flat((cx, cy, z)), style);
        }
        let png = self.paint(scene, view)?;
        svg.picture(0.0, 0.0, WIDTH, HEIGHT, &png, false);
        for (lx, ly, lz, text) in &scene.labels {
            let (u, v) = flat((*lx, *ly, *lz));
            svg.text(u, v + 4.0, SMALL, Anchor::Middle, text);
        }
        Ok(svg.finish())
    }

    /// Paints the cells from the farthest to the nearest, at twice the resolution.
    fn paint(&self, scene: &Scene, view: &View) -> Result<Vec<u8>, ReportError> {
        let (w, h) = (2 * WIDTH as usize, 2 * HEIGHT as usize);
        let mut rgba = vec![0u8; w * h * 4];
        let points: Vec<(f64, f64, f64)> = (0..scene.level.len())
            .map(|at| {
                let (i, j) = ((at % scene.cols) as f64, (at / scene.cols) as f64);
                let x = (i / (scene.cols - 1) as f64 - 0.5) * scene.size.0;
                let y = (j / (scene.rows - 1) as f64 - 0.5) * scene.size.1;
                let (u, v, near) = view.project((x, y, (scene.level[at] - 0.5) * scene.size.2));
                (2.0 * u, 2.0 * v, near)
            })
            .collect();
        let mut cells: Vec<(f64, [usize; 4])> = (0..scene.rows - 1)
            .flat_map(|j| (0..scene.cols - 1).map(move |i| j * scene.cols + i))
            .map(|o| [o, o + 1, o + 1 + scene.cols, o + scene.cols])
            .filter(|cell| cell.iter().all(|&p| points[p].0.is_finite() && points[p].1.is_finite()))
            .map(|cell| (cell.iter().map(|&p| points[p].2).sum(), cell))
            .collect();
        cells.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, cell) in cells {
            let t = cell.iter().map(|&p| scene.colour[p]).sum::<f64>() / 4.0;
            let shade = scene.shade[cell[0]];
            let rgb = self.scale.map.rgb(t).map(|c| (f64::from(c) * shade).round() as u8);
            let corners = cell.map(|p| (points[p].0, points[p].1));
            fill(&mut rgba, w, h, [corners[0], corners[1], corners[2]], rgb);
            fill(&mut rgba, w, h, [corners[0], corners[2], corners[3]], rgb);
        }
        encode_png(&self.title, w, h, rgba)
    }
}

/// Brightness 0.55..=1 of each cell by the slope towards a light from the upper left.
fn shades(level: &[f64], cols: usize, rows: usize, size: (f64, f64, f64)) -> Vec<f64> {
    let (step_x, step_y) = (size.0 / (cols - 1) as f64, size.1 / (rows - 1) as f64);
    let light = {
        let (x, y, z) = (-0.5f64, -0.35f64, 0.8f64);
        let norm = (x * x + y * y + z * z).sqrt();
        (x / norm, y / norm, z / norm)
    };
    let at = |i: usize, j: usize| level[j.min(rows - 1) * cols + i.min(cols - 1)] * size.2;
    (0..rows * cols)
        .map(|o| {
            let (i, j) = (o % cols, o / cols);
            let (gx, gy) = ((at(i + 1, j) - at(i, j)) / step_x, (at(i, j + 1) - at(i, j)) / step_y);
            let norm = (gx * gx + gy * gy + 1.0).sqrt();
            let cos = (-gx * light.0 - gy * light.1 + light.2) / norm;
            if cos.is_finite() { (0.55 + 0.5 * cos.max(0.0)).min(1.0) } else { 1.0 }
        })
        .collect()
}

/// Fills a triangle; pixels whose centre lies inside or within half a pixel of its edge, so that
/// neighbouring cells leave no seam.
fn fill(rgba: &mut [u8], w: usize, h: usize, t: [(f64, f64); 3], rgb: [u8; 3]) {
    let edge =
        |a: (f64, f64), b: (f64, f64), p: (f64, f64)| (b.0 - a.0) * (p.1 - a.1) - (b.1 - a.1) * (p.0 - a.0);
    let area = edge(t[0], t[1], t[2]);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    let sign = area.signum();
    let bounds = |values: [f64; 3], most: usize| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min).floor().max(0.0);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max).ceil();
        (low as usize, (high.clamp(0.0, most as f64) as usize).min(most))
    };
    let (x0, x1) = bounds(t.map(|p| p.0), w);
    let (y0, y1) = bounds(t.map(|p| p.1), h);
    for y in y0..y1 {
        for x in x0..x1 {
            let p = (x as f64 + 0.5, y as f64 + 0.5);
            let inside = (0..3).all(|i| {
                let (a, b) = (t[i], t[(i + 1) % 3]);
                let length = ((b.0 - a.0).powi(2) + (b.1 - a.1).powi(2)).sqrt();
                sign * edge(a, b, p) >= -0.5 * length
            });
            if inside {
                let at = (y * w + x) * 4;
                rgba[at..at + 3].copy_from_slice(&rgb);
                rgba[at + 3] = 255;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    #[test]
    fn script_is_small_and_asks_nobody() {
        assert!(SCRIPT.len() < 10_000, "{} bytes", SCRIPT.len());
        for word in ["http", "fetch(", "XMLHttp", "import", "eval", "</script"] {
            assert!(!SCRIPT.contains(word), "{word}");
        }
    }

    #[test]
    fn seen_from_the_camera() {
        let view = View { azimuth: 0.0, elevation: PI / 2.0, factor: 100.0 };
        let (u0, v0, _) = view.project((0.0, 0.0, 0.0));
        let (u1, v1, _) = view.project((1.0, 1.0, 0.0));
        // From straight above the view is the image: x right, y down.
        assert!((u1 - u0 - 100.0).abs() < 1e-9 && (v1 - v0 - 100.0).abs() < 1e-9);
        let view = View { azimuth: 0.0, elevation: 0.3, factor: 100.0 };
        assert!(view.project((0.0, 0.0, 1.0)).1 < view.project((0.0, 0.0, 0.0)).1, "height is up");
        assert!(view.project((0.0, 1.0, 0.0)).2 > view.project((0.0, 0.0, 0.0)).2, "y is near");
    }
}
