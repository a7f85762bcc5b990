//! `report.html` of a dataset.

use super::{Check, ReferenceResult, Summary, stored_program};
use crate::error::Error;
use crate::figures::{self, Unit};
use crate::measure::Rectangle;
use daic_dataset::{Dataset, FloatMap};
use daic_protocol::channels;
use daic_report::{
    AnalogTrace, Cell, DigitalLine, Figure, Report, Section, TableBlock, Timeline, Verdict, plain,
    with_uncertainty,
};
use daic_rig::experiment::Experiment;

const AXES: [&str; 3] = ["u (right)", "v (down)", "w (towards the camera)"];

/// The page, its figures drawn; the surface, which on the page can be turned, also as a file that stands still.
pub fn report(
    dataset: &Dataset,
    experiment: &Experiment,
    summary: &Summary,
    checks: Option<&[Check]>,
) -> Result<Report, Error> {
    let (records, _) = super::judged(dataset, experiment)?;
    let no_frame = || Error::NoPairedFrame { root: dataset.root().to_owned(), frames: records.len() };
    let reference_record = super::reference_of(&records).ok_or_else(no_frame)?;
    let result = dataset.frame_results(reference_record.id).join("result.json");
    let reference: ReferenceResult = super::read_json(&result).ok_or(Error::NoResult { path: result })?;
    let mut sections = Vec::new();
    if let Some(checks) = checks {
        sections.push(Section {
            title: "Checks".to_owned(),
            tables: vec![check_table(checks)],
            ..Section::default()
        });
    }
    let height = FloatMap::read_tiff(&dataset.frame_results(reference_record.id).join("h_mm.tif"))?;
    let gap = FloatMap::read_tiff(&dataset.frame_results(reference_record.id).join("gap_mm.tif"))?;
    figures::write_surface_svg(
        &dataset.results().join(super::FIGURES).join("surface.svg"),
        &height,
        "Surface",
    )?;
    if let Some(last) = summary.measured.last() {
        let mut figures = Vec::new();
        let directory = dataset.frame_results(last.id);
        for (name, symbol) in [("u_mm", "u"), ("v_mm", "v"), ("w_mm", "w")] {
            let map = FloatMap::read_tiff(&directory.join(format!("{name}.tif")))?;
            let title = format!("Displacement {symbol}");
            figures.push(figures::map_figure(&map, &title, symbol, Unit::Micrometre, "")?);
        }
        sections.push(Section {
            title: "Displacement".to_owned(),
            text: vec![
                "Each point of the reference is followed in both views to the deformed frame; both pixel pairs \
                 are decoded and subtracted (Lagrangian). Axes: x to the right and y down as on the sensor, h \
                 towards the camera. Maps lie on the pixel grid of the −1 view of the reference."
                    .to_owned(),
            ],
            tables: vec![move_table(summary)],
            figures,
        });
    }
    sections.push(Section {
        title: "Shape of the reference".to_owned(),
        text: vec![
            format!(
                "{} of {} points; σ of a single height {} from the match{}.",
                summary.profile.ok,
                summary.profile.points,
                plain(summary.profile.sigma_h_um, 2, "µm"),
                summary.profile.sigma_h_cal_um.map_or_else(String::new, |cal| format!(
                    ", {} from the calibration, in common for all points",
                    plain(cal, 2, "µm")
                )),
            ),
            summary.profile.gap.verdict(),
        ],
        tables: Vec::new(),
        figures: vec![
            figures::map_figure(
                &height,
                "Height",
                "h",
                Unit::Millimetre,
                "Height towards the camera over the reference plane.",
            )?,
            figures::surface_figure(&height, "Surface", "Drag to turn, scroll to zoom.")?,
            figures::map_figure(&gap, "Gap of the two rays", "gap", Unit::Micrometre, figures::GAP_CAPTION)?,
        ],
    });
    let frame = dataset.read_frame(reference_record)?;
    let rectangle = |c: [usize; 4]| Rectangle { x: c[0], y: c[1], width: c[2], height: c[3] };
    let overlay = figures::views_overlay(
        &frame,
        rectangle(reference.minus),
        rectangle(reference.plus),
        "Reference frame",
    );
    sections.push(Section {
        title: "The two views".to_owned(),
        text: Vec::new(),
        tables: Vec::new(),
        figures: vec![Figure {
            id: "views".to_owned(),
            title: "Views as the program found them".to_owned(),
            caption: "Check that each frame encloses one image of the specimen.".to_owned(),
            body: overlay.render_svg()?,
        }],
    });
    if let Some(figure) = timing(dataset, experiment)? {
        sections.push(Section {
            title: "Timing".to_owned(),
            text: vec![timing_text(summary)],
            tables: Vec::new(),
            figures: vec![figure],
        });
    }
    if let Some(table) = calibration_table(summary) {
        sections.push(Section {
            title: "Calibration".to_owned(),
            text: vec![
                if experiment.microscope.is_some() {
                    "β and the centre of perspective follow from the commanded moves, by least squares in image \
                     space. Heights count from the mean of the reference surface. All residuals: \
                     results/calibration/report.html."
                } else {
                    "F and s follow from the commanded moves; d, which only says from where heights are \
                     counted, from the height of the specimen on the optical axis that the experiment states."
                }
                .to_owned(),
            ],
            tables: vec![table],
            figures: Vec::new(),
        });
    }
    let frames = &summary.frames;
    Ok(Report {
        title: "daic measurement".to_owned(),
        subtitle: format!(
            "{} frames paired with their strobes, {} missing, {} extra, {} ambiguous",
            frames.paired, frames.missing, frames.extra, frames.ambiguous
        ),
        verdict: checks.map(verdict),
        sections,
        provenance: provenance(dataset, experiment, summary),
    })
}

fn verdict(checks: &[Check]) -> Verdict {
    let failed = checks.iter().filter(|c| !c.passed).count();
    let text = match failed {
        0 => "What was commanded is what was measured.".to_owned(),
        n => format!("{n} of {} checks failed.", checks.len()),
    };
    Verdict { pass: failed == 0, text }
}

pub(crate) fn check_table(checks: &[Check]) -> TableBlock {
    let rows = checks
        .iter()
        .map(|c| {
            let found = c.found.clone();
            vec![
                Cell::Text(c.name.clone()),
                if c.passed { Cell::Pass(found) } else { Cell::Fail(found) },
                Cell::Text(c.limit.clone()),
            ]
        })
        .collect();
    TableBlock { caption: String::new(), head: ["check", "found", "limit"].map(str::to_owned).to_vec(), rows }
}

fn move_table(summary: &Summary) -> TableBlock {
    let head = [
        "frame",
        "component",
        "commanded",
        "measured (mean)",
        "difference, RMS",
        "scatter",
        "σ of a point",
        "points",
    ];
    let mut rows = Vec::new();
    for frame in &summary.measured {
        for (i, axis) in AXES.iter().enumerate() {
            let number = |value: Option<f64>| {
                Cell::Number(value.map_or_else(|| "—".to_owned(), |v| plain(v, 3, "µm")))
            };
            // the mean of many points is as sure as the calibration and the stage, not as its standard error
            rows.push(vec![
                Cell::Text(if i == 0 { frame.name.clone() } else { String::new() }),
                Cell::Text((*axis).to_owned()),
                number(frame.commanded_um.map(|c| c[i])),
                Cell::Number(with_uncertainty(frame.field.measured_um[i], frame.field.sigma_um[i], "µm")),
                number(frame.rms_um.map(|r| r[i])),
                number(Some(frame.field.std_um[i])),
                number(Some(frame.field.sigma_um[i])),
                Cell::Number(if i == 0 {
                    format!("{} of {}", frame.field.ok, frame.field.points)
                } else {
                    String::new()
                }),
            ]);
        }
    }
    TableBlock {
        caption: "Displacement from the reference; ± is the standard deviation of a single point.".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows,
    }
}

fn calibration_table(summary: &Summary) -> Option<TableBlock> {
    let calibration = summary.calibration.as_ref()?;
    let rows = calibration
        .parameters
        .iter()
        .map(|p| {
            vec![
                Cell::Text(p.name.clone()),
                Cell::Number(p.start.map_or_else(|| "—".to_owned(), |v| format!("{v:.4}"))),
                Cell::Number(with_uncertainty(p.value, p.sigma, "")),
            ]
        })
        .collect();
    Some(TableBlock {
        caption: format!(
            "{} observations of {} points, {} left out; residual {:.4} px RMS, reduced χ² {:.2}",
            calibration.observations,
            calibration.points,
            calibration.rejected,
            calibration.rms_px,
            calibration.chi_square_reduced
        ),
        head: ["parameter", "before", "after"].map(str::to_owned).to_vec(),
        rows,
    })
}

fn timing_text(summary: &Summary) -> String {
    match summary.edge_error_ticks_max {
        Some(error) => format!(
            "{} edges were played; the largest distance of one from its place in the program is {error} ticks (8 ns each).",
            summary.edges_compared
        ),
        None if summary.edges_compared > 0 => "The edges played are not those of the program.".to_owned(),
        None => "Lines as the events of the trigger box report them.".to_owned(),
    }
}

fn line_name(bit: u32) -> String {
    match bit {
        0..8 => format!("LED {bit}"),
        8..12 => format!("camera {}", bit - 8),
        _ => format!("aux {}", bit - 12),
    }
}

/// The lines that were played, from the recorded edges or else from the box's events.
fn timing(dataset: &Dataset, experiment: &Experiment) -> Result<Option<Figure>, Error> {
    let recorded = dataset.edges()?;
    let words = match recorded {
        Some(edges) => edges,
        None => reported(dataset)?,
    };
    let begin = super::run_begin(dataset)?.unwrap_or(0);
    let words: Vec<(u64, u32)> =
        words.into_iter().filter(|w| w.0 >= begin).map(|(tick, word)| (tick - begin, word)).collect();
    if words.is_empty() {
        return Ok(None);
    }
    let used = words.iter().fold(0, |all, w| all | w.1);
    let lines = (0..16).filter(|bit| used >> bit & 1 == 1).map(|bit| digital_line(&words, bit)).collect();
    let camera = channels::CAMERA_MASK;
    let triggers: Vec<u64> = rising(&words, camera);
    let tick_hz = dataset.manifest().tick_hz.unwrap_or(f64::from(daic_protocol::limits::TICK_HZ));
    let margin = (tick_hz * 0.0002) as u64;
    let exposure = (experiment.rig.camera.exposure.ns() * 1e-9 * tick_hz) as u64;
    let timeline = Timeline {
        title: "Lines of the trigger box".to_owned(),
        tick_hz,
        lines,
        traces: stage_traces(dataset, experiment, &words),
        windows: Timeline::windows_around(&triggers, margin, exposure.min(20 * margin)),
    };
    Ok(Some(Figure {
        id: "timing".to_owned(),
        title: "Timing as played".to_owned(),
        caption: "Above the whole run, below a window around each camera trigger, to scale.".to_owned(),
        body: timeline.render_svg()?,
    }))
}

fn digital_line(words: &[(u64, u32)], bit: u32) -> DigitalLine {
    let mut level = false;
    let mut edges = Vec::new();
    for &(tick, word) in words {
        let now = word >> bit & 1 == 1;
        if now != level {
            level = now;
            edges.push((tick, now));
        }
    }
    DigitalLine { name: line_name(bit), initial: false, edges }
}

/// Ticks at which any line of `mask` rises.
fn rising(words: &[(u64, u32)], mask: u32) -> Vec<u64> {
    let mut before = 0;
    let mut ticks = Vec::new();
    for &(tick, word) in words {
        if word & !before & mask != 0 {
            ticks.push(tick);
        }
        before = word;
    }
    ticks
}

/// Position of each axis from its step pulses.
fn stage_traces(dataset: &Dataset, experiment: &Experiment, words: &[(u64, u32)]) -> Vec<AnalogTrace> {
    // enough points for a drawing
    const POINTS: usize = 400;
    let start = stored_program(dataset).map_or([0; 6], |p| p.1);
    let mut traces = Vec::new();
    for (number, (name, axis)) in (0u8..).zip(experiment.rig.axes.named()) {
        let (Some(axis), Some(step), Some(direction)) =
            (axis, channels::step(number), channels::direction(number))
        else {
            continue;
        };
        let mut position = f64::from(start[usize::from(number)]);
        let mut before = 0;
        let mut points = vec![(0, position / axis.steps_per_mm)];
        for &(tick, word) in words {
            if word & !before & step != 0 {
                if points.last().is_some_and(|p: &(u64, f64)| p.1 != position / axis.steps_per_mm) {
                    points.push((tick.saturating_sub(1), position / axis.steps_per_mm));
                }
                position += if word & direction != 0 { 1.0 } else { -1.0 };
                points.push((tick, position / axis.steps_per_mm));
            }
            before = word;
        }
        if points.len() < 2 {
            continue;
        }
        let end = words.last().map_or(0, |w| w.0);
        points.push((end, position / axis.steps_per_mm));
        traces.push(AnalogTrace {
            name: format!("stage {name}"),
            unit: "mm".to_owned(),
            points: thinned(&points, POINTS),
            steps: false,
        });
    }
    traces
}

/// Points at which a rest begins or ends, and some of those between.
fn thinned(points: &[(u64, f64)], wanted: usize) -> Vec<(u64, f64)> {
    let stride = points.len().div_ceil(wanted).max(1);
    let span = points.last().map_or(0, |p| p.0) / 200;
    let mut kept = Vec::new();
    for (k, p) in points.iter().enumerate() {
        let gap_before = k > 0 && p.0 - points[k - 1].0 > span;
        let gap_after = points.get(k + 1).is_some_and(|next| next.0 - p.0 > span);
        if gap_before && points[k - 1].1 != p.1 {
            kept.push((p.0 - 1, points[k - 1].1));
        }
        if gap_before || gap_after || k % stride == 0 || k + 1 == points.len() {
            kept.push(*p);
        }
    }
    kept
}

fn reported(dataset: &Dataset) -> Result<Vec<(u64, u32)>, Error> {
    let events = dataset.events()?.records;
    let word = |e: &daic_dataset::EventRecord| u32::try_from(e.data.get("word")?.as_u64()?).ok();
    Ok(events.iter().filter(|e| e.kind == "Edge").filter_map(|e| Some((e.tick, word(e)?))).collect())
}

fn provenance(dataset: &Dataset, experiment: &Experiment, summary: &Summary) -> Vec<(String, String)> {
    let p = &experiment.processing;
    let manifest = dataset.manifest();
    let mut all = vec![
        ("measured with".to_owned(), format!("daic {}", summary.daic)),
        ("recorded with".to_owned(), format!("{} {}", manifest.program, manifest.program_version)),
        ("subset, step".to_owned(), format!("{0} × {0} px, every {1} px", p.subset, p.step)),
        ("shape function".to_owned(), format!("{:?}", p.shape).to_lowercase()),
        ("interpolation".to_owned(), format!("{:?} B-spline", p.interpolation).to_lowercase()),
        ("decoder".to_owned(), format!("{:?}", p.decoder).to_lowercase()),
    ];
    if let Some(seed) = summary.seed {
        all.push(("seed".to_owned(), seed.to_string()));
    }
    all.extend(
        manifest
            .extra
            .iter()
            .filter(|(k, _)| *k != super::PROGRAM)
            .map(|(k, v)| (k.clone(), v.as_str().map_or_else(|| v.to_string(), str::to_owned))),
    );
    all
}
