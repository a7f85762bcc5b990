//! `daic calibrate microscope`.

use super::commands::as_json;
use super::output::{Answer, Output};
use clap::Args;
use daic::{Error, Progress as _, microscope};
use daic_dataset::atomic;
use std::fmt::Write as _;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct MicroscopeArgs {
    /// TOML file of the moves, each with the CSV file of its field (see docs/microscope.md)
    pub moves: PathBuf,
    /// Calibration to this file (.toml)
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Page with tables and residuals to this file (.html)
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
}

pub fn calibrate(arguments: &MicroscopeArgs, output: &Output) -> Result<Answer, Error> {
    output.stage("calibrating", 0);
    let done = microscope::run(&arguments.moves)?;
    // whatever can fail does so before the first file
    let page = match &arguments.report {
        Some(_) => Some(microscope::page(&done, &arguments.moves.display().to_string())?),
        None => None,
    };
    let mut written = Vec::new();
    if let (Some(path), Some(file)) = (&arguments.out, &done.file) {
        file.write(path)?;
        written.push(path.display().to_string());
    }
    if let (Some(path), Some(page)) = (&arguments.report, page) {
        atomic::write_bytes(path, page.as_bytes())?;
        written.push(path.display().to_string());
    }
    let s = &done.summary;
    let mut text = String::new();
    for v in &s.values {
        let value = if v.value.abs() < 0.01 { format!("{:.5e}", v.value) } else { format!("{:.6}", v.value) };
        writeln!(text, "{:<14}{value:>14} ± {:<10.2e} {}", v.name, v.sigma, v.unit).ok();
    }
    writeln!(
        text,
        "\n{:<20}{:>7}{:>12}{:>12}{:>12}  µm RMS, decoded − imposed",
        "motion", "points", "u", "v", "w"
    )
    .ok();
    let cells = |rms: &[Option<f64>; 3]| -> String {
        rms.iter().map(|v| v.map_or_else(|| format!("{:>12}", "–"), |v| format!("{v:>12.4}"))).collect()
    };
    for m in &s.motions {
        let how = if m.fitted { "fitted" } else { "predicted, not in the fit" };
        writeln!(text, "{:<20}{:>7}{}  {how}", m.name, m.points, cells(&m.rms_um)).ok();
        if let Some(predicted) = &m.predicted_rms_um {
            writeln!(text, "{:<20}{:>7}{}  predicted from the others", "", "", cells(predicted)).ok();
        }
    }
    let [rms, chi] = [s.rms_px, s.chi_square_reduced];
    writeln!(text, "\nresiduals {rms:.4} px RMS, reduced χ² {chi:.3}, {} points left out", s.rejected).ok();
    for note in &s.notes {
        writeln!(text, "note: {note}").ok();
    }
    if !s.complete {
        writeln!(text, "not determined by these motions: {}", s.undetermined.join(", ")).ok();
        writeln!(text, "add {}", s.add.join(" and ")).ok();
        if let Some(path) = &arguments.out {
            writeln!(text, "{} is not written", path.display()).ok();
        }
    }
    for path in &written {
        writeln!(text, "wrote {path}").ok();
    }
    let mut json = as_json(s)?;
    json["written"] = written.into();
    Ok(Answer::new(json, text).checked(s.complete))
}
