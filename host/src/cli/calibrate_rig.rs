//! `daic calibrate rig`.

use super::arguments::positive;
use super::commands::as_json;
use super::output::Answer;
use clap::Args;
use daic::{Error, calibrate_rig};
use std::fmt::Write as _;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct RigArgs {
    /// Optics file to start from: right to some percent and degrees
    #[arg(long, value_name = "FILE")]
    optics: PathBuf,
    /// Table (CSV) of tracked points: pose, point, plate_x_mm, plate_y_mm, minus_x, minus_y, plus_x, plus_y and
    /// perhaps sigma_px; cells may be empty
    points: PathBuf,
    /// Table (CSV) of known moves against the reference pose: pose, x_mm, y_mm, h_mm and perhaps rx_deg, ry_deg, rz_deg,
    /// sigma_deg; cells may be empty
    #[arg(long, value_name = "FILE")]
    moves: Option<PathBuf>,
    /// Standard deviation of a known move
    #[arg(long, value_name = "MM", default_value_t = 0.001, value_parser = positive)]
    move_sigma: f64,
    /// Standard deviation of a pixel where the table states none
    #[arg(long, value_name = "PX", default_value_t = 0.02, value_parser = positive)]
    sigma: f64,
    /// Pose that becomes the reference plane (default: the first)
    #[arg(long, value_name = "POSE")]
    reference: Option<i64>,
    /// Folder for optics.toml and the report
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub fn calibrate(arguments: &RigArgs) -> Result<Answer, Error> {
    let options = calibrate_rig::Options {
        optics: arguments.optics.clone(),
        points: arguments.points.clone(),
        moves: arguments.moves.clone(),
        move_sigma_mm: arguments.move_sigma,
        sigma_px: arguments.sigma,
        reference: arguments.reference,
        out: arguments.out.clone(),
    };
    let summary = calibrate_rig::run(&options)?;
    let mut text = String::new();
    for p in &summary.parameters {
        writeln!(text, "{:<32}{:>18.7} ± {:.7}", p.name, p.value, p.sigma).ok();
    }
    writeln!(
        text,
        "residual {:.4} px RMS, χ² {:.3} per degree of freedom, {} pixels left out",
        summary.rms_px, summary.chi_square_reduced, summary.rejected
    )
    .ok();
    for combination in &summary.left_to_priors {
        writeln!(text, "left to priors: {combination}").ok();
    }
    if let Some([scale, sigma]) = summary.plate_scale {
        writeln!(text, "size of the plate by the moves over its stated size: {scale:.6} ± {sigma:.6}").ok();
    }
    if let Some([x, y, z]) = summary.stage_axes_mrad {
        writeln!(text, "axes of the stage turned against the plate by {x:.3}, {y:.3}, {z:.3} mrad").ok();
    }
    for l in &summary.left_out {
        writeln!(
            text,
            "pose {} predicted without itself: h to {:.2} µm RMS, noise {:.2} µm",
            l.pose, l.rms_h_um, l.expected_h_um
        )
        .ok();
    }
    write!(text, "optics: {}", summary.optics.display()).ok();
    Ok(Answer::new(as_json(&summary)?, text))
}
