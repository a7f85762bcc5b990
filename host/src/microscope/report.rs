//! The page of a calibration.

use super::Calibrated;
use crate::error::Error;
use daic_optics::microscope::calibrate::residuals_px;
use daic_report::{Cell, Chart, Figure, Report, Section, Series, SeriesStyle, TableBlock, Verdict};

/// Points drawn per motion; more are thinned out evenly.
const DRAWN: usize = 400;

/// Tables of parameters and motions, and the residuals of every motion across the field.
///
/// # Errors
/// If a figure cannot be drawn.
pub fn page(done: &Calibrated, source: &str) -> Result<String, Error> {
    let s = &done.summary;
    let text = |t: &str| Cell::Text(t.to_owned());
    let number = |v: f64| Cell::Number(format!("{v:.6}"));
    let maybe =
        |v: Option<f64>| v.map_or_else(|| Cell::Text("–".to_owned()), |v| Cell::Number(format!("{v:.4}")));
    let parameters = TableBlock {
        caption: "What the motions determine, with one standard deviation.".to_owned(),
        head: ["quantity", "value", "σ", "unit"].map(str::to_owned).to_vec(),
        rows: s
            .values
            .iter()
            .map(|v| {
                vec![text(v.name), number(v.value), Cell::Number(format!("{:.2e}", v.sigma)), text(v.unit)]
            })
            .collect(),
    };
    let head = [
        "motion",
        "in the fit",
        "points",
        "residual (u₋) px",
        "u µm",
        "v µm",
        "w µm",
        "predicted u µm",
        "v µm",
        "w µm",
    ];
    let motions = TableBlock {
        caption: "RMS of decoded minus imposed displacement; predicted: with this motion left out of the fit. Components whose translation is not known have their mean taken off.".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: s
            .motions
            .iter()
            .map(|m| {
                let mut row = vec![
                    text(&m.name),
                    text(if m.fitted { "yes" } else { "no" }),
                    Cell::Number(m.points.to_string()),
                    number(m.rms_px[0]),
                ];
                row.extend(m.rms_um.map(maybe));
                let predicted = if m.fitted { m.predicted_rms_um } else { Some(m.rms_um) };
                row.extend(predicted.unwrap_or([None; 3]).map(maybe));
                row
            })
            .collect(),
    };
    let mut lines = s.notes.clone();
    if !s.complete {
        lines.push(format!("Not determined: {}. Add {}.", s.undetermined.join(", "), s.add.join(" and ")));
    }
    Ok(Report {
        title: "daic calibrate microscope".to_owned(),
        subtitle: "β and the centre of perspective from known motions, by least squares in image space"
            .to_owned(),
        verdict: Some(Verdict {
            pass: s.complete,
            text: if s.complete {
                "All six parameters are determined.".to_owned()
            } else {
                "The motions leave parameters open.".to_owned()
            },
        }),
        sections: vec![
            Section {
                title: "Parameters".to_owned(),
                text: lines,
                tables: vec![parameters],
                figures: Vec::new(),
            },
            Section {
                title: "Motions".to_owned(),
                text: Vec::new(),
                tables: vec![motions],
                figures: residual_figures(done)?,
            },
        ],
        provenance: vec![
            ("calibrated with".to_owned(), format!("daic {}", env!("CARGO_PKG_VERSION"))),
            ("moves".to_owned(), source.to_owned()),
            ("form".to_owned(), s.form.to_owned()),
        ],
    }
    .render()?)
}

fn residual_figures(done: &Calibrated) -> Result<Vec<Figure>, Error> {
    let Some(parameters) = done.calibration.parameters else { return Ok(Vec::new()) };
    let mut figures = Vec::new();
    for (i, (motion, result)) in done.motions.iter().zip(&done.calibration.motions).enumerate() {
        let residuals = residuals_px(motion, &parameters, done.calibration.form, result.translation_mm)?;
        let every = residuals.len().div_ceil(DRAWN).max(1);
        let series = ["u₋", "v₋", "u₊", "v₊"].iter().enumerate().map(|(c, name)| {
            let points = motion.points.iter().zip(&residuals).step_by(every);
            let xy = points.map(|(p, r)| (p.middle_px[0], r[c])).collect();
            Series::new(name, SeriesStyle::Points, xy)
        });
        let chart = Chart {
            title: motion.name.clone(),
            x_label: "x of the midpoint / px".to_owned(),
            y_label: "observed − model / px".to_owned(),
            series: series.collect(),
            y_limits: None,
        };
        figures.push(Figure {
            id: format!("motion-{i}"),
            title: format!("Residuals of {}", motion.name),
            caption: "Image displacement of every point in both views, observed minus forward model; outliers included. Structure means that the model or the motion is not as told.".to_owned(),
            body: chart.render_svg()?,
        });
    }
    Ok(figures)
}
