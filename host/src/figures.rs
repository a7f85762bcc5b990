//! Figures of results.

use crate::error::Error;
use crate::measure::Rectangle;
use daic_dataset::{FloatMap, GreyImage, atomic};
use daic_report::{ColourScale, Figure, GridAxes, Heatmap, HeightSurface, Mark, Markup, Overlay};
use std::path::Path;

fn axes(map: &FloatMap) -> GridAxes {
    let a = &map.axes;
    GridAxes { x0: a.x0, dx: a.dx, y0: a.y0, dy: a.dy, unit: a.unit.clone(), names: ["x", "y"] }
}

fn heatmap(map: &FloatMap, title: &str, quantity: &str, unit: &str, factor: f64) -> Heatmap {
    let values: Vec<f64> = map.data.iter().map(|v| v * factor).collect();
    let scale = ColourScale::values(&values);
    Heatmap {
        title: title.to_owned(),
        width: map.width as usize,
        height: map.height as usize,
        values,
        axes: axes(map),
        quantity: quantity.to_owned(),
        unit: unit.to_owned(),
        scale,
    }
}

/// What a map of the gap says.
pub const GAP_CAPTION: &str = "Distance at which the two rays of a point pass each other, above 0 where the +1 view's passes at larger y. Noise alone is the same everywhere; a slope, a bow or a constant is a calibration that does not fit.";

/// Writes the bare map as a picture, a square per node, transparent where there is no value.
///
/// # Errors
/// The file that could not be written.
pub fn write_map_png(path: &Path, map: &FloatMap) -> Result<(), Error> {
    let png = heatmap(map, &map.name, &map.name, &map.unit, 1.0).render_png()?;
    Ok(atomic::write_bytes(path, &png)?)
}

/// Writes the map with title, axes and colour bar, in its own unit.
///
/// # Errors
/// If the figure cannot be drawn or written.
pub fn write_map_svg(path: &Path, map: &FloatMap, title: &str, quantity: &str) -> Result<(), Error> {
    let figure = heatmap(map, title, quantity, &map.unit, 1.0).render_svg()?;
    Ok(atomic::write_bytes(path, figure.as_str().as_bytes())?)
}

/// A map of millimetres, drawn in micrometres or millimetres, with axes and colour bar.
///
/// # Errors
/// If the figure cannot be drawn.
pub fn map_figure(
    map: &FloatMap,
    title: &str,
    quantity: &str,
    unit: Unit,
    caption: &str,
) -> Result<Figure, Error> {
    let (name, factor) = match unit {
        Unit::Micrometre => ("µm", 1e3),
        Unit::Millimetre => ("mm", 1.0),
    };
    Ok(Figure {
        id: map.name.clone(),
        title: title.to_owned(),
        caption: caption.to_owned(),
        body: heatmap(map, title, quantity, name, factor).render_svg()?,
    })
}

/// A map as it is, with axes and colour bar.
///
/// # Errors
/// If the figure cannot be drawn.
pub fn map_drawing(map: &FloatMap, title: &str, quantity: &str) -> Result<Markup, Error> {
    Ok(heatmap(map, title, quantity, &map.unit, 1.0).render_svg()?)
}

/// A map as it is, with axes and colour bar, as an SVG document.
///
/// # Errors
/// If the figure cannot be drawn.
pub fn map_svg(map: &FloatMap, title: &str, quantity: &str) -> Result<String, Error> {
    Ok(map_drawing(map, title, quantity)?.as_str().to_owned())
}

/// Unit in which a map of millimetres is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// Values times 1000.
    Micrometre,
    /// Values as they are.
    Millimetre,
}

fn surface(height: &FloatMap, title: &str) -> HeightSurface {
    HeightSurface {
        title: title.to_owned(),
        width: height.width as usize,
        height: height.height as usize,
        values: height.data.clone(),
        axes: axes(height),
        quantity: "h".to_owned(),
        unit: "mm".to_owned(),
        scale: ColourScale::values(&height.data),
    }
}

/// The surface, to be turned with the mouse.
///
/// # Errors
/// If the figure cannot be drawn.
pub fn surface_figure(height: &FloatMap, title: &str, caption: &str) -> Result<Figure, Error> {
    Ok(Figure {
        id: "surface".to_owned(),
        title: title.to_owned(),
        caption: caption.to_owned(),
        body: surface(height, title).render_html()?,
    })
}

/// Writes the surface as a drawing that stands still.
///
/// # Errors
/// If the figure cannot be drawn or written.
pub fn write_surface_svg(path: &Path, height: &FloatMap, title: &str) -> Result<(), Error> {
    Ok(atomic::write_bytes(path, surface(height, title).render_svg()?.as_str().as_bytes())?)
}

/// The frame with the two views as they were found.
///
/// # Errors
/// If the figure cannot be drawn.
pub fn views_overlay(frame: &GreyImage, minus: Rectangle, plus: Rectangle, title: &str) -> Overlay {
    let mark = |r: Rectangle, label: &str, colour| {
        Mark::rectangle(r.x as f64, r.y as f64, r.width as f64, r.height as f64, label, colour)
    };
    Overlay {
        title: title.to_owned(),
        width: frame.width as usize,
        height: frame.height as usize,
        grey: frame.data.clone(),
        display: None,
        marks: vec![mark(minus, "−1 view", 0), mark(plus, "+1 view", 1)],
        most_pixels: 900,
    }
}
