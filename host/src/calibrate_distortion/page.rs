//! Figures and report of a distortion calibration.

use super::summary::{image_kind, listed};
use super::write::maps;
use super::{Options, Outcome};
use crate::error::Error;
use daic_dataset::FloatMap;
use daic_report::{
    Cell, Chart, ColourScale, Figure, GridAxes, Heatmap, Report, Section, Series, SeriesStyle, TableBlock,
    plain, with_uncertainty,
};

/// e at the measured nodes and what belongs to it, as drawn.
struct Drawn {
    title: &'static str,
    quantity: &'static str,
    file: &'static str,
    caption: &'static str,
    values: Vec<f64>,
    signed: bool,
}

fn heatmap(like: &FloatMap, d: &Drawn) -> Heatmap {
    let a = &like.axes;
    Heatmap {
        title: d.title.to_owned(),
        width: like.width as usize,
        height: like.height as usize,
        scale: if d.signed { ColourScale::errors(&d.values) } else { ColourScale::values(&d.values) },
        values: d.values.clone(),
        axes: GridAxes { x0: a.x0, dx: a.dx, y0: a.y0, dy: a.dy, unit: a.unit.clone(), names: ["x", "y"] },
        quantity: d.quantity.to_owned(),
        unit: "px".to_owned(),
    }
}

/// Sections through the middle of the map, along x or along y.
fn section(all: &[FloatMap], along_x: bool) -> Chart {
    let (nx, ny) = (all[0].width as usize, all[0].height as usize);
    let a = &all[0].axes;
    let nodes: Vec<(f64, usize)> = if along_x {
        (0..nx).map(|i| (a.x0 + a.dx * i as f64, ny / 2 * nx + i)).collect()
    } else {
        (0..ny).map(|j| (a.y0 + a.dy * j as f64, j * nx + nx / 2)).collect()
    };
    let measured = |k: usize, v: f64| if all[6].data[k] > 0.5 { v } else { f64::NAN };
    let of =
        |map: usize| nodes.iter().map(|(p, k)| (*p, measured(*k, all[map].data[*k]))).collect::<Vec<_>>();
    let with_sigma = |name: &str, e: usize, sigma: usize| Series {
        sigma: nodes.iter().map(|(_, k)| all[sigma].data[*k]).collect(),
        ..Series::new(name, SeriesStyle::Line, of(e))
    };
    Chart {
        title: format!("Section through the middle along {}", if along_x { "x" } else { "y" }),
        x_label: format!("{} / px", if along_x { "x" } else { "y" }),
        y_label: "e / px".to_owned(),
        series: vec![
            with_sigma("e_x", 0, 2),
            with_sigma("e_y", 1, 3),
            Series::new("e_x, Brown", SeriesStyle::Dashed, of(4)),
            Series::new("e_y, Brown", SeriesStyle::Dashed, of(5)),
        ],
        y_limits: None,
    }
}

/// Names and texts of the files to write.
pub(super) fn draw(options: &Options, outcome: &Outcome) -> Result<Vec<(&'static str, String)>, Error> {
    let found = &outcome.found;
    let all = maps(found);
    let keep = |v: Vec<f64>| -> Vec<f64> {
        v.into_iter().zip(&found.measured).map(|(v, m)| if *m { v } else { f64::NAN }).collect()
    };
    let pairs = |a: usize, b: usize, f: fn(f64, f64) -> f64| {
        keep(all[a].data.iter().zip(&all[b].data).map(|(a, b)| f(*a, *b)).collect())
    };
    let drawn = [
        Drawn {
            title: "Distortion along x",
            quantity: "e_x",
            file: "e_x.svg",
            caption: "Observed less ideal position, to the right.",
            values: keep(all[0].data.clone()),
            signed: true,
        },
        Drawn {
            title: "Distortion along y",
            quantity: "e_y",
            file: "e_y.svg",
            caption: "Observed less ideal position, downwards.",
            values: keep(all[1].data.clone()),
            signed: true,
        },
        Drawn {
            title: "Magnitude",
            quantity: "|e|",
            file: "e_magnitude.svg",
            caption: "Length of (e_x, e_y).",
            values: pairs(0, 1, f64::hypot),
            signed: false,
        },
        Drawn {
            title: "Left by Brown's terms, along x",
            quantity: "e_x − Brown",
            file: "left_x.svg",
            caption: "What no lens model of five terms describes: the map holds it.",
            values: pairs(0, 4, |a, b| a - b),
            signed: true,
        },
        Drawn {
            title: "Left by Brown's terms, along y",
            quantity: "e_y − Brown",
            file: "left_y.svg",
            caption: "The same along y.",
            values: pairs(1, 5, |a, b| a - b),
            signed: true,
        },
    ];
    let mut files = Vec::new();
    let mut figures = Vec::new();
    for d in &drawn {
        let body = heatmap(&all[0], d).render_svg()?;
        files.push((d.file, body.as_str().to_owned()));
        figures.push(Figure {
            id: d.file.trim_end_matches(".svg").to_owned(),
            title: d.title.to_owned(),
            caption: d.caption.to_owned(),
            body,
        });
    }
    let left = figures.split_off(3);
    for (along_x, name) in [(true, "section_x.svg"), (false, "section_y.svg")] {
        let chart = section(&all, along_x);
        let body = chart.render_svg()?;
        files.push((name, body.as_str().to_owned()));
        figures.push(Figure {
            id: name.trim_end_matches(".svg").to_owned(),
            title: chart.title,
            caption: "Line: map with ±1 σ; dashed: Brown's terms.".to_owned(),
            body,
        });
    }
    files.push(("report.html", page(options, outcome, figures, left)?));
    Ok(files)
}

fn row(name: &str, [x, y]: [f64; 2]) -> Vec<Cell> {
    vec![Cell::Text(name.to_owned()), Cell::Number(plain(x, 3, "px")), Cell::Number(plain(y, 3, "px"))]
}

fn page(
    options: &Options,
    outcome: &Outcome,
    figures: Vec<Figure>,
    left: Vec<Figure>,
) -> Result<String, Error> {
    let found = &outcome.found;
    let (_, camera) = image_kind(&outcome.ideal);
    let numbers = TableBlock {
        caption: "Over the measured nodes".to_owned(),
        head: ["", "along x", "along y"].map(str::to_owned).into(),
        rows: vec![
            row("distortion, RMS", found.rms_px),
            row("distortion, largest", found.largest_px),
            row("left by Brown's terms, RMS", found.brown.left_px),
            row("left by the map, RMS", found.left.total_px()),
            row("of it: noise of the images", found.left.noise_px),
            row("of it: between the nodes", found.left.between_nodes_px),
            row("of it: detail that the window takes off", found.left.window_px),
        ],
    };
    let b = &found.brown.brown;
    let terms = [("k1", b.k1), ("k2", b.k2), ("k3", b.k3), ("p1", b.p1), ("p2", b.p2)];
    let brown = TableBlock {
        caption: format!(
            "Brown's terms for F = {:.1} px and the principal point ({:.1}, {:.1}) px",
            camera.focal_px, camera.principal_point_px[0], camera.principal_point_px[1]
        ),
        head: ["term", "value"].map(str::to_owned).into(),
        rows: terms
            .into_iter()
            .zip(found.brown.sigma)
            .map(|((name, value), sigma)| {
                let text = match sigma {
                    Some(sigma) => with_uncertainty(value, sigma, ""),
                    None => format!("{} (not fitted)", plain(value, 3, "")),
                };
                vec![Cell::Text(name.to_owned()), Cell::Number(text)]
            })
            .collect(),
    };
    let mut text = vec![
        "observed = ideal + e. Another scale, place or tilt of the target would change e by the terms below, in the target's axes; they are not determined and are removed."
            .to_owned(),
        listed(found.pose.removed()).join("; ") + ".",
    ];
    let shared = listed(found.pose.shared_with_tilt()).join("; ");
    text.push(format!("Shared with a tilt of the target out of the image plane: {shared}."));
    text.extend(outcome.warnings.iter().map(|w| format!("Warning: {w}.")));
    let images: Vec<String> = options.images.iter().map(|p| p.display().to_string()).collect();
    let report = Report {
        title: "Image distortion".to_owned(),
        subtitle: images.join(", "),
        verdict: None,
        sections: vec![
            Section { title: "Distortion".to_owned(), text, tables: vec![numbers], figures },
            Section {
                title: "Brown's terms beside it".to_owned(),
                text: Vec::new(),
                tables: vec![brown],
                figures: left,
            },
        ],
        provenance: vec![
            ("calibrated with".to_owned(), format!("daic {}", env!("CARGO_PKG_VERSION"))),
            (
                "window".to_owned(),
                format!("{}, {} pitches wide", options.phase.window.name(), options.phase.width),
            ),
            (
                "nodes".to_owned(),
                format!("{:?}, every {} px", found.map.grid().nodes, found.map.grid().step_px[0]),
            ),
        ],
    };
    Ok(report.render()?)
}
