//! What each command does: arguments to facade calls, results to an answer.

use super::arguments::{
    AreaArgs, CorrelateArgs, CriterionArg, DicArgs, DoctorArgs, GratingsArg, GuessArg, InitArgs,
    InterpolationArg, PhaseArgs, ProcessArgs, Roi, RunArgs, ShapeArg, SolverArg, UpdateArg,
};
#[cfg(feature = "sim")]
use super::arguments::{DemoArgs, SceneArg, SimulateArgs};
use super::output::{Answer, Output};
use daic::area::{self, Area};
use daic::measure::{self, Rectangle};
use daic::sequence::{self, Description};
use daic::{
    Error, Progress as _, doctor as checks, frames, images, pair, phase as gratings, process as processing,
};
use daic_correlate::{Guess, StartReport, StartWarning};
use daic_dataset::{Existing, GreyImage, atomic};
use daic_rig::experiment::{self, Experiment};
use serde_json::json;
use std::fmt::Write as _;
use std::path::Path;

#[cfg(feature = "sim")]
pub fn demo(arguments: &DemoArgs, output: &Output) -> Result<Answer, Error> {
    let move_mm = arguments.move_mm().map_err(|reason| Error::DemoOption { reason })?;
    let scene = match arguments.scene {
        SceneArg::Lightfield => return lightfield_demo(arguments, output),
        SceneArg::Macro => daic::demo::Scene::Macro,
        SceneArg::Microscope => daic::demo::Scene::Microscope,
    };
    let options = daic::demo::Options {
        scene,
        out: arguments.out.clone(),
        seed: arguments.seed,
        move_mm,
        pitch_factor: arguments.pitch_factor,
        calibrate: !arguments.no_calibration,
    };
    let summary = daic::demo::run(&options, output)?;
    let mut text = String::new();
    let m = &summary.measurement;
    let rows = [m.commanded_um, m.measured_um, m.rms_um, m.sigma_um];
    let [commanded, measured, rms, sigma] = rows.map(|r| r.unwrap_or([f64::NAN; 3]));
    writeln!(
        text,
        "{:<8}{:>14}{:>14}{:>16}{:>14}",
        "µm", "commanded", "measured", "difference RMS", "σ of a point"
    )
    .ok();
    for (i, axis) in ["x", "y", "h"].into_iter().enumerate() {
        let values = format!("{:>14.3}{:>14.3}{:>16.3}{:>14.3}", commanded[i], measured[i], rms[i], sigma[i]);
        writeln!(text, "{axis:<8}{values}").ok();
    }
    write_checks(&mut text, &summary.checks, &arguments.out);
    let passed = summary.passed;
    Ok(Answer::new(as_json(&summary)?, text).checked(passed))
}

#[cfg(feature = "sim")]
fn lightfield_demo(arguments: &DemoArgs, output: &Output) -> Result<Answer, Error> {
    let summary = daic::lightfield_demo::run(&arguments.out, arguments.seed, output)?;
    let mut text = String::new();
    writeln!(text, "{:<10}{:>8}{:>8}{:>8}{:>12}{:>8}{:>8}", "µm", "true x", "y", "z", "found x", "y", "z")
        .ok();
    for bead in &summary.beads {
        let [x, y, z] = bead.true_um;
        let [fx, fy, fz] = bead.found_um.unwrap_or([f64::NAN; 3]);
        writeln!(text, "{:<10}{x:>8.2}{y:>8.2}{z:>8.2}{fx:>12.2}{fy:>8.2}{fz:>8.2}", bead.frame).ok();
    }
    write_checks(&mut text, &summary.checks, &arguments.out);
    let passed = summary.passed;
    Ok(Answer::new(as_json(&summary)?, text).checked(passed))
}

#[cfg(feature = "sim")]
fn write_checks(text: &mut String, checks: &[processing::Check], out: &Path) {
    for check in checks {
        let mark = if check.passed { "ok  " } else { "FAIL" };
        writeln!(text, "{mark}  {}: {} (limit {})", check.name, check.found, check.limit).ok();
    }
    writeln!(text, "report: {}", out.join("report.html").display()).ok();
}

#[cfg(feature = "sim")]
pub fn simulate(arguments: &SimulateArgs, output: &Output) -> Result<Answer, Error> {
    let mut experiment = Experiment::load(&arguments.experiment)?;
    if let Some(seed) = arguments.seed {
        experiment.seed = seed;
    }
    output.stop_on_interrupt();
    let existing = if arguments.replace { Existing::Replace } else { Existing::Refuse };
    let recorded =
        daic::demo::simulate(&experiment, arguments.scene.as_deref(), &arguments.out, existing, output)?;
    recording_answer(&arguments.out, &recorded)
}

pub fn run(arguments: &RunArgs, output: &Output) -> Result<Answer, Error> {
    let experiment = Experiment::load(&arguments.experiment)?;
    output.stop_on_interrupt();
    let port = arguments.port.clone().unwrap_or_else(|| experiment.rig.port.clone());
    let frames = match (&arguments.frames, &experiment.rig.camera.source) {
        (Some(folder), _) | (None, experiment::CameraSource::Folder(folder)) => folder.clone(),
        (None, experiment::CameraSource::Sim) => return Err(Error::NoFrames),
    };
    let existing = if arguments.replace { Existing::Replace } else { Existing::Refuse };
    let recorded =
        daic::recording::run_at_port(&experiment, &port, &frames, &arguments.out, existing, output)?;
    recording_answer(&arguments.out, &recorded)
}

fn recording_answer(out: &Path, recorded: &processing::FrameCounts) -> Result<Answer, Error> {
    let json = json!({ "dataset": out.display().to_string(), "frames": as_json(recorded)? });
    let text = format!(
        "{}: {} frames paired, {} missing, {} extra, {} ambiguous\nnext: daic process {}",
        out.display(),
        recorded.paired,
        recorded.missing,
        recorded.extra,
        recorded.ambiguous,
        out.display()
    );
    Ok(Answer::new(json, text))
}

pub fn process(arguments: &ProcessArgs, output: &Output) -> Result<Answer, Error> {
    let optics = arguments.optics.as_deref().map(daic::optics_file::CalibratedOptics::load).transpose()?;
    let processed = processing::process(&arguments.dataset, arguments.fresh, optics.as_ref(), output)?;
    let mut text = String::new();
    for note in processed.summary.damage.iter().chain(processed.summary.failed.iter().map(|f| &f.reason)) {
        writeln!(text, "note: {note}").ok();
    }
    for frame in &processed.summary.measured {
        let [u, v, w] = frame.field.measured_um;
        let (name, ok, all) = (&frame.name, frame.field.ok, frame.field.points);
        writeln!(text, "{name}: u {u:.3} µm, v {v:.3} µm, w {w:.3} µm ({ok} of {all} points)").ok();
    }
    let report = arguments.dataset.join("report.html");
    writeln!(text, "{} results were there already; report: {}", processed.resumed, report.display()).ok();
    #[cfg(feature = "sim")]
    if let Some(summary) = daic::demo::complete(&arguments.dataset, &processed)? {
        return Ok(Answer::new(as_json(&summary)?, text));
    }
    Ok(Answer::new(as_json(&processed.summary)?, text))
}

pub fn correlate(arguments: &CorrelateArgs, output: &Output) -> Result<Answer, Error> {
    let one = match arguments.deformed.as_slice() {
        [one] if !frames::is_many(one) && arguments.update.is_none() && !arguments.overwrite => one,
        _ => return correlate_sequence(arguments, output),
    };
    let (reference, deformed) = images::read_pair(&arguments.reference, one)?;
    let roi = arguments.roi.map(|roi| rectangle(roi, &reference)).transpose()?;
    let writer = arguments.out.as_deref().map(table_writer).transpose()?;
    let mut dic = daic_correlate::Settings::default();
    let mut step = 5;
    apply(&arguments.dic, &mut dic, &mut step);
    let guess = match arguments.guess {
        _ if !arguments.seed.is_empty() => Guess::Seeds(&arguments.seed),
        GuessArg::Auto => Guess::Auto,
        GuessArg::Fft => Guess::Fft,
        GuessArg::Features => Guess::Features,
    };
    let area = area_of(&arguments.area, roi, &reference)?;
    let found = pair::correlate(&reference, &deformed, &dic, &guess, step, &area, output)?;
    let table = match arguments.description.into() {
        Description::Lagrangian => found.table()?,
        Description::Eulerian => found.eulerian_table()?,
    };
    if let (Some(path), Some(write)) = (&arguments.out, writer) {
        write(&table, path)?;
    }
    let seconds = |s: fn(&daic::usage::Seconds) -> f64| json!({ "init": s(&found.init), "prepare": s(&found.prepare), "solve": s(&found.solve), "total": s(&found.total) });
    let json = json!({
        "points": found.points.len(),
        "converged": found.converged(),
        "cpu_s": seconds(|s| s.cpu),
        "wall_s": seconds(|s| s.wall),
        "peak_rss_mb": daic::usage::peak_rss_mb(),
        "settings": as_json(&dic)?,
        "step": step,
        "start": start_json(&found.start),
        "out": arguments.out.as_ref().map(|p| p.display().to_string()),
    });
    let ok = || found.points.iter().filter(|p| p.status.is_ok());
    let (u, v) = (measure::spread(ok().map(|p| p.u)), measure::spread(ok().map(|p| p.v)));
    let mut text = format!(
        "{} of {} points converged in {:.2} s\nu {:.4} ± {:.4} px, v {:.4} ± {:.4} px (mean and scatter over the points)",
        found.converged(),
        found.points.len(),
        found.total.wall,
        u.mean,
        u.std,
        v.mean,
        v.std
    );
    text.push_str(&start_text(&found.start));
    Ok(Answer::new(json, text))
}

fn start_json(start: &StartReport) -> serde_json::Value {
    let attempts: Vec<_> = start
        .attempts
        .iter()
        .map(|a| json!({ "method": a.method.name(), "tried": a.tried, "accepted": a.accepted }))
        .collect();
    let rejected: Vec<_> =
        start.rejected.iter().map(|r| json!({ "seed": r.index, "status": r.status.name() })).collect();
    let groups = |f: &daic_correlate::FeatureStart| -> Vec<_> {
        f.groups
            .iter()
            .map(|g| {
                json!({
                    "inliers": g.inliers,
                    "rotation_deg": g.affine.rotation_deg(),
                    "stretches": g.affine.stretches(),
                })
            })
            .collect()
    };
    json!({
        "method": start.method().map(daic_correlate::StartMethod::name),
        "attempts": attempts,
        "seeds_rejected": rejected,
        "features": start.features.as_ref().map(|f| json!({ "matches": f.matches, "motions": groups(f) })),
        "no_guess": start.unreached,
        "warnings": start.warnings.iter().map(ToString::to_string).collect::<Vec<_>>(),
    })
}

/// Lines on the start: one if all is well, else what is wrong and the way out.
fn start_text(start: &StartReport) -> String {
    let mut text = String::new();
    for a in &start.attempts {
        write!(text, "\nstart by {}: {} of {} seeds confirmed", a.method, a.accepted, a.tried).ok();
    }
    let by_seeds = start.attempts.iter().any(|a| a.method == daic_correlate::StartMethod::Seeds);
    for warning in &start.warnings {
        let way_out = match warning {
            StartWarning::SeedsRejected { .. } => {
                let list: Vec<String> =
                    start.rejected.iter().map(|r| format!("seed {}: {}", r.index + 1, r.status)).collect();
                format!(" ({})", list.join(", "))
            }
            StartWarning::ShapeTooSimple { .. } => " (--shape affine)".to_owned(),
            _ if by_seeds => ": give further ones with --seed X,Y,U,V".to_owned(),
            _ => ": try --seed X,Y,U,V for a place whose displacement you know".to_owned(),
        };
        write!(text, "\nwarning: {warning}{way_out}").ok();
    }
    text
}

fn correlate_sequence(arguments: &CorrelateArgs, output: &Output) -> Result<Answer, Error> {
    if !arguments.seed.is_empty() || !matches!(arguments.guess, GuessArg::Auto) {
        return Err(Error::SeriesGuess);
    }
    let frames = frames::expand(&arguments.deformed, &arguments.reference)?;
    let Some(out) = &arguments.out else {
        return Err(Error::NoFolder { frames: frames.len(), reference: arguments.reference.clone() });
    };
    let roi = match arguments.roi {
        Some(roi) => Some(rectangle(roi, &images::read(&arguments.reference)?)?),
        None => None,
    };
    let mut settings = daic_correlate::Settings::default();
    let mut step = 5;
    apply(&arguments.dic, &mut settings, &mut step);
    let options = sequence::Options {
        reference: arguments.reference.clone(),
        frames,
        settings,
        step,
        roi,
        update: arguments.update.unwrap_or(UpdateArg::Fixed).into(),
        description: arguments.description.into(),
        out: out.clone(),
        overwrite: arguments.overwrite,
    };
    output.stop_on_interrupt();
    let done = sequence::correlate(&options, output)?;
    let mut text = String::new();
    for f in &done.summary.frames {
        let (name, ok, all) = (&f.file, f.converged, f.points);
        if let Some(reason) = &f.failed {
            writeln!(text, "{name}: left out: {reason}").ok();
            continue;
        }
        let px = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.4}"));
        let [u, su, v, sv] = [f.mean_u_px, f.std_u_px, f.mean_v_px, f.std_v_px].map(px);
        writeln!(text, "{name}: {ok} of {all} points, u {u} ± {su} px, v {v} ± {sv} px").ok();
    }
    let (resumed, failed) = (done.resumed, done.summary.failed);
    writeln!(text, "{resumed} frames were there already, {failed} left out; results: {}", out.display()).ok();
    let mut json = as_json(&done.summary)?;
    json["resumed"] = resumed.into();
    json["out"] = out.display().to_string().into();
    Ok(Answer::new(json, text).checked(failed == 0))
}

pub fn phase(arguments: &PhaseArgs, output: &Output) -> Result<Answer, Error> {
    use daic_correlate::phase::{Gratings, PhaseSettings};
    let settings = PhaseSettings {
        window: arguments.window.kind(),
        width: arguments.width,
        gratings: match arguments.gratings {
            GratingsArg::Auto => Gratings::Auto,
            GratingsArg::Line => Gratings::Line,
            GratingsArg::Cross => Gratings::Cross,
        },
        pitch: arguments.pitch,
        noise: arguments.noise,
        ..PhaseSettings::default()
    };
    let (image, deformed) = match &arguments.deformed {
        None => (images::read(&arguments.image)?, None),
        Some(path) => {
            let (a, b) = images::read_pair(&arguments.image, path)?;
            (a, Some(b))
        }
    };
    let clock = daic::usage::Clock::start();
    output.stage("finding phases", 0);
    let maps = gratings::analyse(&image, &settings)?;
    let moved = match &deformed {
        None => None,
        Some(deformed) => {
            let deformed = gratings::analyse(deformed, &settings)?;
            let shift = arguments.shift.map_or([0.0; 2], |s| s.0);
            let found = gratings::displacement(&maps, &deformed, shift, arguments.step as usize)?;
            let numbers = gratings::displacement_summary(&found)?;
            Some((found, numbers))
        }
    };
    let spent = clock.elapsed();
    let summary = gratings::summary(&maps);
    if let Some(out) = &arguments.out {
        make_folder(out)?;
        gratings::write_maps(out, &maps)?;
        if let Some((found, _)) = &moved {
            gratings::write_displacement(out, found)?;
        }
    }
    let mut text = String::new();
    for d in &summary.directions {
        writeln!(
            text,
            "pitch {:.4} px at {:.3}°: {} of {} pixels in {} parts, {} residues, σ of a phase {:.2e} rad = {:.2e} px, window {} px",
            d.pitch_px,
            d.angle_deg,
            d.valid,
            summary.pixels,
            d.components,
            d.residues,
            d.sigma_rad,
            d.sigma_px,
            d.window_px
        )
        .ok();
    }
    if let Some((_, m)) = &moved {
        let ([u, v], [du, dv], [su, sv]) = (m.mean_px, m.std_px, m.sigma_px);
        writeln!(
            text,
            "{} of {} points: u {u:.4} ± {du:.4} px, v {v:.4} ± {dv:.4} px (mean and scatter), σ from noise {su:.2e} and {sv:.2e} px",
            m.converged, m.points
        )
        .ok();
        if let Some([x, y]) = m.line_normal {
            writeln!(text, "a line grating: only the displacement along ({x:.3}, {y:.3}) is measured").ok();
        }
    }
    let json = json!({
        "phase": as_json(&summary)?,
        "displacement": moved.as_ref().map(|(_, m)| as_json(m)).transpose()?,
        "settings": as_json(&settings)?,
        "cpu_s": spent.cpu,
        "wall_s": spent.wall,
        "out": arguments.out.as_ref().map(|p| p.display().to_string()),
    });
    Ok(Answer::new(json, text))
}

pub type TableWriter = fn(&daic_dataset::Table, &Path) -> Result<(), daic_dataset::TableError>;

/// How a table is written, decided before the work begins.
pub fn table_writer(path: &Path) -> Result<TableWriter, Error> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("csv") => Ok(daic_dataset::Table::write_csv),
        Some("npz") => Ok(daic_dataset::Table::write_npz),
        _ => Err(Error::UnknownFormat { path: path.to_owned(), allowed: ".csv, .npz" }),
    }
}

pub fn rectangle(roi: Roi, image: &GreyImage) -> Result<Rectangle, Error> {
    let [x, y, w, h] = roi.0;
    let (width, height) = (image.width, image.height);
    let outside = Error::RoiOutside { x, y, w, h, width, height };
    let fits = |start: i64, length: i64, size: u32| {
        start >= 0 && length > 0 && start.checked_add(length).is_some_and(|end| end <= i64::from(size))
    };
    if !fits(x, w, width) || !fits(y, h, height) {
        return Err(outside);
    }
    let [x, y, width, height] = roi.0.map(|v| v as usize);
    Ok(Rectangle { x, y, width, height })
}

fn area_of(arguments: &AreaArgs, roi: Option<Rectangle>, image: &GreyImage) -> Result<Area, Error> {
    let (width, height) = (image.width as usize, image.height as usize);
    let drawn = arguments.regions.as_deref().map(|p| area::regions(p, width, height)).transpose()?;
    let image = arguments.mask.as_deref().map(|p| area::mask(p, width, height)).transpose()?;
    let mask = match (drawn, image) {
        (Some(a), Some(b)) => Some(area::both(&a, &b)?),
        (a, b) => a.or(b),
    };
    Ok(Area { roi, mask, min_inside: arguments.min_inside })
}

pub fn apply(arguments: &DicArgs, settings: &mut daic_correlate::Settings, step: &mut usize) {
    if let Some(subset) = arguments.subset {
        settings.subset = subset as usize;
    }
    if let Some(given) = arguments.step {
        *step = given as usize;
    }
    if let Some(given) = arguments.shape {
        settings.shape = shape(given);
    }
    match arguments.solver {
        Some(SolverArg::Auto) => settings.solver = daic_correlate::SolverChoice::Auto,
        Some(SolverArg::Dense) => settings.solver = daic_correlate::SolverChoice::Dense,
        Some(SolverArg::Exact) => settings.solver = daic_correlate::SolverChoice::Exact,
        None => {}
    }
    match arguments.criterion {
        Some(CriterionArg::Znssd) => settings.criterion = daic_correlate::Criterion::Znssd,
        Some(CriterionArg::Zssd) => settings.criterion = daic_correlate::Criterion::Zssd,
        None => {}
    }
    match arguments.interpolation {
        Some(InterpolationArg::Cubic) => settings.interpolation = daic_correlate::Interpolation::Cubic,
        Some(InterpolationArg::Quintic) => settings.interpolation = daic_correlate::Interpolation::Quintic,
        Some(InterpolationArg::Septic) => settings.interpolation = daic_correlate::Interpolation::Septic,
        None => {}
    }
}

pub fn shape(shape: ShapeArg) -> daic_correlate::Shape {
    match shape {
        ShapeArg::Affine => daic_correlate::Shape::Affine,
        ShapeArg::Quadratic => daic_correlate::Shape::Quadratic,
    }
}

pub fn make_folder(path: &Path) -> Result<(), Error> {
    std::fs::create_dir_all(path).map_err(|source| Error::Folder { path: path.to_owned(), source })
}

pub fn init(arguments: &InitArgs) -> Result<Answer, Error> {
    let path = &arguments.file;
    if path.exists() && !arguments.force {
        return Err(Error::Exists { path: path.clone() });
    }
    let template =
        if arguments.microscope { experiment::microscope_template() } else { experiment::template() };
    atomic::write_bytes(path, template.as_bytes())?;
    let text = format!("wrote {0}\nnext: daic simulate {0} --out dataset", path.display());
    Ok(Answer::new(json!({ "file": path.display().to_string() }), text))
}

pub fn schema() -> Result<Answer, Error> {
    let text = experiment::experiment_schema();
    let json = serde_json::from_str(&text)
        .map_err(|source| Error::Unwritable { path: "the schema".into(), reason: source.to_string() })?;
    Ok(Answer::new(json, text))
}

pub fn doctor(arguments: &DoctorArgs) -> Result<Answer, Error> {
    let found = checks::look(arguments.port.as_deref())?;
    let text = found.to_string();
    Ok(Answer::new(as_json(&found)?, text))
}

pub fn as_json(value: &impl serde::Serialize) -> Result<serde_json::Value, Error> {
    serde_json::to_value(value)
        .map_err(|source| Error::Unwritable { path: "the answer".into(), reason: source.to_string() })
}
