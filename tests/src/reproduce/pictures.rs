//! Maps and sections in object coordinates.

use super::ReproduceError;
use daic_report::{Chart, ColourMap, ColourScale, GridAxes, Heatmap, Limits, Markup, Series, SeriesStyle};

/// A quantity at points of the object.
pub struct Field<'a> {
    /// Title of the map.
    pub title: &'a str,
    /// Symbol of the quantity.
    pub quantity: &'a str,
    /// Its unit.
    pub unit: &'a str,
    /// Unit of the coordinates.
    pub length: &'a str,
    /// (x, y, value).
    pub points: Vec<[f64; 3]>,
    /// Distance of the map's nodes.
    pub pitch: f64,
    /// Colours that run from − to + this; `None` for those of measured values.
    pub symmetric: Option<f64>,
}

impl Field<'_> {
    /// The map: values averaged over square cells.
    pub fn map(&self) -> Result<Markup, ReproduceError> {
        let mut from = [f64::INFINITY; 2];
        let mut to = [f64::NEG_INFINITY; 2];
        for p in &self.points {
            for i in 0..2 {
                (from[i], to[i]) = (from[i].min(p[i]), to[i].max(p[i]));
            }
        }
        if self.points.is_empty() {
            return Err(ReproduceError::Few { what: self.title.to_owned(), found: 0, needed: 1 });
        }
        let cells = [0, 1].map(|i| ((to[i] - from[i]) / self.pitch).floor() as usize + 1);
        let mut sums = vec![(0.0, 0u32); cells[0] * cells[1]];
        for p in &self.points {
            let [i, j] = [0, 1].map(|k| ((p[k] - from[k]) / self.pitch) as usize);
            let (sum, count) = &mut sums[j * cells[0] + i];
            *sum += p[2];
            *count += 1;
        }
        let values: Vec<f64> =
            sums.iter().map(|(s, n)| if *n == 0 { f64::NAN } else { s / f64::from(*n) }).collect();
        let scale = match self.symmetric {
            Some(most) => ColourScale { map: ColourMap::Diverging, limits: Limits::fixed(-most, most) },
            None => ColourScale::values(&values),
        };
        let half = 0.5 * self.pitch;
        let heatmap = Heatmap {
            title: self.title.to_owned(),
            width: cells[0],
            height: cells[1],
            values,
            axes: GridAxes {
                x0: from[0] + half,
                dx: self.pitch,
                y0: from[1] + half,
                dy: self.pitch,
                unit: self.length.to_owned(),
                names: ["x", "y"],
            },
            quantity: self.quantity.to_owned(),
            unit: self.unit.to_owned(),
            scale,
        };
        Ok(heatmap.render_svg()?)
    }

    /// Points within a third of a node of the line where coordinate `across` is `at`, along the other one:
    /// a single row of a grid whose step is two thirds of a node.
    pub fn section(&self, across: usize, at: f64) -> Vec<(f64, f64)> {
        let mut line: Vec<(f64, f64)> = self
            .points
            .iter()
            .filter(|p| (p[across] - at).abs() <= self.pitch / 3.0)
            .map(|p| (p[1 - across], p[2]))
            .collect();
        line.sort_by(|a, b| a.0.total_cmp(&b.0));
        line
    }
}

/// Name, style and points of a curve.
pub type Curve<'a> = (&'a str, SeriesStyle, Vec<(f64, f64)>);

/// Curves over one axis.
pub fn chart(
    title: &str,
    x_label: &str,
    y_label: &str,
    series: Vec<Curve<'_>>,
    y_limits: Option<(f64, f64)>,
) -> Result<Markup, ReproduceError> {
    let series = series.into_iter().map(|(name, style, points)| Series::new(name, style, points)).collect();
    let (title, x_label, y_label) = (title.to_owned(), x_label.to_owned(), y_label.to_owned());
    Ok(Chart { title, x_label, y_label, series, y_limits }.render_svg()?)
}
