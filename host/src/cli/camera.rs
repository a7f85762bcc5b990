//! `daic calibrate camera`.

use super::arguments::positive;
use super::commands::as_json;
use super::output::{Answer, Output};
use clap::{Args, ValueEnum};
use daic::calibrate_camera::{self, Options};
use daic::{Error, Progress as _};
use daic_optics::intrinsics::CameraParameter;
use daic_optics::target::Pattern;
use serde_json::json;
use std::fmt::Write as _;
use std::path::PathBuf;

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum BoardArg {
    /// Round dots on a square grid, dark or light
    Dots,
    /// Checkerboard; points are its inner corners
    Checker,
}

impl From<BoardArg> for Pattern {
    fn from(board: BoardArg) -> Self {
        match board {
            BoardArg::Dots => Self::Dots,
            BoardArg::Checker => Self::Checker,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum ParameterArg {
    /// Both coordinates, in the middle of the image
    Principal,
    K1,
    K2,
    K3,
    P1,
    P2,
}

impl ParameterArg {
    fn parameters(self) -> Vec<CameraParameter> {
        match self {
            Self::Principal => vec![CameraParameter::PrincipalX, CameraParameter::PrincipalY],
            Self::K1 => vec![CameraParameter::K1],
            Self::K2 => vec![CameraParameter::K2],
            Self::K3 => vec![CameraParameter::K3],
            Self::P1 => vec![CameraParameter::P1],
            Self::P2 => vec![CameraParameter::P2],
        }
    }
}

#[derive(Debug, Args)]
pub struct CameraArgs {
    /// Images of the board, held at different tilts
    #[arg(required = true)]
    pub images: Vec<PathBuf>,
    /// What is on the board
    #[arg(long)]
    pub board: BoardArg,
    /// Distance of dots or corners in mm
    #[arg(long, value_name = "MM", value_parser = positive, allow_negative_numbers = true)]
    pub pitch: f64,
    /// Dots or inner corners in a row, if known
    #[arg(long, requires = "rows", value_parser = clap::value_parser!(u16).range(3..))]
    pub columns: Option<u16>,
    /// Rows of dots or inner corners, if known
    #[arg(long, requires = "columns", value_parser = clap::value_parser!(u16).range(3..))]
    pub rows: Option<u16>,
    /// Parameters not to estimate: distortion stays 0
    #[arg(long, value_delimiter = ',')]
    pub fix: Vec<ParameterArg>,
    /// Folder for camera.toml and report.html
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

pub fn calibrate(arguments: &CameraArgs, output: &Output) -> Result<Answer, Error> {
    let options = Options {
        pattern: arguments.board.into(),
        pitch_mm: arguments.pitch,
        size: arguments.columns.zip(arguments.rows).map(|(c, r)| [usize::from(c), usize::from(r)]),
        fixed: arguments.fix.iter().flat_map(|p| p.parameters()).collect(),
    };
    let run = calibrate_camera::run(&arguments.images, &options, output)?;
    if let Some(folder) = &arguments.out {
        output.stage("drawing", 0);
        run.write(folder)?;
    }
    let f = &run.file;
    let mut text = String::new();
    for e in &f.estimates {
        let value = daic_report::with_uncertainty(e.value, e.sigma, e.parameter.unit());
        let note = if e.determined { "" } else { "   not determined by these views; consider --fix" };
        writeln!(text, "{:<12}{value}{note}", e.parameter.name()).ok();
    }
    for v in &f.views {
        let rejected = if v.rejected > 0 { format!(", {} left out", v.rejected) } else { String::new() };
        writeln!(
            text,
            "{}: {} points{rejected}, {:.4} px RMS, tilt {:.1}°, at {:.2} mm",
            v.image, v.points, v.rms_px, v.tilt_deg, v.distance_mm
        )
        .ok();
    }
    for (_, why) in &run.skipped {
        writeln!(text, "skipped {why}").ok();
    }
    writeln!(text, "residuals {:.4} px RMS, reduced χ² {:.2}", f.rms_px, f.chi_square_reduced).ok();
    // Residuals three times what the images' noise explains.
    if f.chi_square_reduced > 9.0 {
        text.push_str("the points do not fit the model within their noise: a board that is not plane, a lens that Brown's terms do not describe, or --fix of a parameter that matters\n");
    }
    let mut answer = as_json(f)?;
    let skipped =
        run.skipped.iter().map(|(p, why)| json!({ "image": p.display().to_string(), "reason": why }));
    answer["skipped"] = skipped.collect();
    if let Some(folder) = &arguments.out {
        writeln!(text, "report: {}", folder.join("report.html").display()).ok();
        answer["out"] = json!(folder.display().to_string());
    }
    Ok(Answer::new(answer, text))
}
