//! `daic calibrate distortion`.

use super::arguments::{Roi, WindowArg, parse_roi, positive};
use super::commands::as_json;
use super::output::{Answer, Output};
use clap::{Args, ValueEnum};
use daic::calibrate_distortion::{self, IdealImage, Options, phase_settings};
use daic::{Error, Progress as _};
use daic_optics::View;
use std::fmt::Write as _;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct DistortionArgs {
    /// Image of a cross grating, or two images, of lines along x and of lines along y
    #[arg(required = true, num_args = 1..=2)]
    images: Vec<PathBuf>,
    /// Optics file: F, principal point, Brown's terms that the map comes on top of; with --view the rays that
    /// it is counted from
    #[arg(long, value_name = "FILE")]
    optics: Option<PathBuf>,
    /// Optics file that the map is named in, in one step with its checksum; also read as --optics is
    #[arg(long, value_name = "FILE", conflicts_with = "optics")]
    into: Option<PathBuf>,
    /// The images show the target through the grating, in this view
    #[arg(long)]
    view: Option<ViewArg>,
    /// Part of the images to use (default: all, or the view's half of the sensor)
    #[arg(long, value_name = "X,Y,W,H", value_parser = parse_roi, allow_hyphen_values = true)]
    region: Option<Roi>,
    /// What the map is counted from (default: ray with --view and --optics, else pinhole)
    #[arg(long)]
    ideal: Option<IdealArg>,
    /// Both images show the target in one plane (it was turned on its holder): fewer terms are left open
    #[arg(long)]
    one_pose: bool,
    /// The target lies square to the camera, or in the reference plane of the set-up: nothing of a tilt is removed
    #[arg(long, conflicts_with = "one_pose")]
    square: bool,
    /// Distance of the target's lines, to check the scale by (with --optics)
    #[arg(long, value_name = "MM", value_parser = positive)]
    target_pitch: Option<f64>,
    /// Distance of the lines in the images, to within 25 % (default: the strongest pattern)
    #[arg(long, value_name = "PX", value_parser = positive)]
    pitch: Option<f64>,
    /// Window of the phase analysis
    #[arg(long, value_enum, default_value_t = WindowArg::GaussianFlat)]
    window: WindowArg,
    /// Width of the window in line distances
    #[arg(long, value_name = "PITCHES", default_value_t = 1.25, value_parser = positive)]
    width: f64,
    /// Standard deviation of the image noise (default: from the images)
    #[arg(long, value_name = "GREY", value_parser = positive)]
    noise: Option<f64>,
    /// Folder for the map, the figures and the report
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum ViewArg {
    /// The −1 view, on the left of the sensor
    Minus,
    /// The +1 view, on the right of the sensor
    Plus,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum IdealArg {
    /// Straight lines stay straight: for images without grating, and for the decoders linear and closed
    Pinhole,
    /// Exact rays through the grating of the view: for the decoder ray
    Ray,
}

pub fn calibrate(arguments: &DistortionArgs, output: &Output) -> Result<Answer, Error> {
    output.stage("finding phases", 0);
    let mut phase = phase_settings();
    phase.window = arguments.window.kind();
    (phase.width, phase.pitch, phase.noise) = (arguments.width, arguments.pitch, arguments.noise);
    let summary = calibrate_distortion::run(&Options {
        images: arguments.images.clone(),
        optics: arguments.into.clone().or_else(|| arguments.optics.clone()),
        into: arguments.into.is_some(),
        view: arguments.view.map(|v| match v {
            ViewArg::Minus => View::Minus,
            ViewArg::Plus => View::Plus,
        }),
        region: arguments.region.map(|r| r.0),
        ideal: arguments.ideal.map(|i| match i {
            IdealArg::Pinhole => IdealImage::Pinhole,
            IdealArg::Ray => IdealImage::Ray,
        }),
        one_pose: arguments.one_pose,
        square: arguments.square,
        target_pitch_mm: arguments.target_pitch,
        phase,
        out: arguments.out.clone(),
    })?;
    let mut text = String::new();
    let mut line = |name: &str, [x, y]: [f64; 2]| {
        writeln!(text, "{name:<44}{x:>9.4} {y:>9.4} px").ok();
    };
    line("distortion along x and y, RMS", summary.rms_px);
    line("largest", summary.largest_px);
    line("left by Brown's terms, RMS", summary.brown.left_px);
    line("left by the map, RMS", summary.left_px);
    line("  noise of the images", summary.left_noise_px);
    line("  between the nodes", summary.left_between_nodes_px);
    line("  detail that the window takes off", summary.left_window_px);
    let b = &summary.brown;
    let terms =
        [("k1", b.terms.k1), ("k2", b.terms.k2), ("k3", b.terms.k3), ("p1", b.terms.p1), ("p2", b.terms.p2)];
    for ((name, value), sigma) in terms.into_iter().zip(b.sigma) {
        if let Some(sigma) = sigma {
            writeln!(text, "{name} {value:.6e} ± {sigma:.1e} (F = {:.1} px)", b.focal_px).ok();
        }
    }
    writeln!(text, "removed, as not determined: {}", summary.removed.join("; ")).ok();
    writeln!(text, "of these shared with a tilt of the target: {}", summary.shared_with_tilt.join("; ")).ok();
    for warning in &summary.warnings {
        writeln!(text, "warning: {warning}").ok();
    }
    writeln!(text, "map: {}", summary.map.display()).ok();
    match &summary.into {
        Some(into) => write!(text, "named as {} in {}", summary.entry_name, into.display()),
        None => {
            writeln!(text, "in an optics file (--into FILE writes it):\n").ok();
            writeln!(text, "[{}]", summary.entry_name).ok();
            write!(text, "file = {:?}\ncrc64 = {:?}", summary.entry.file, summary.entry.crc64)
        }
    }
    .ok();
    Ok(Answer::new(as_json(&summary)?, text))
}
