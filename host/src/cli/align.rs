//! `daic align`.

use super::arguments::{numbers, positive};
use super::camera::BoardArg;
use super::commands::as_json;
use super::output::Answer;
use clap::{Args, Subcommand};
use daic::Error;
use daic::align::{self, BoardOptions, Mark, Step};
use daic::camera_file::CameraFile;
use daic_optics::align::Measured;
use serde::Serialize;
use std::fmt::Write as _;
use std::path::PathBuf;

/// `VALUE` or `VALUE,SIGMA`.
fn measured(text: &str) -> Result<Measured, String> {
    let (value, sigma) = text.split_once(',').unwrap_or((text, "0"));
    let sigma: f64 =
        sigma.trim().parse().map_err(|_| format!("found `{text}`, wanted VALUE or VALUE,SIGMA"))?;
    if !(sigma >= 0.0 && sigma.is_finite()) {
        return Err(format!("the standard deviation is {sigma}, it must be 0 or above"));
    }
    Ok(Measured::new(positive(value.trim())?, sigma))
}

fn pair(text: &str) -> Result<Pair, String> {
    numbers(text, "NEAR,FAR in mm").map(Pair)
}

/// Two distances in millimetres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair(pub [f64; 2]);

#[derive(Debug, Args)]
pub struct AlignArgs {
    /// File of the calibrated camera (camera.toml of `daic calibrate camera`)
    #[arg(long, value_name = "FILE", global = true, default_value = "camera.toml")]
    pub camera: PathBuf,
    /// Add the step's result to this record (TOML)
    #[arg(long, value_name = "FILE", global = true)]
    pub record: Option<PathBuf>,
    #[command(subcommand)]
    pub step: AlignStep,
}

#[derive(Debug, Subcommand)]
pub enum AlignStep {
    /// Camera along the rail: an aperture on the rail, near and far
    Rail(RailArgs),
    /// Laser along the camera's axis: its spot on a card, near and far
    Laser(RailArgs),
    /// Grating square to the beam: the aperture, and the reflected spot beside it
    Reflection(ReflectionArgs),
    /// Grooves along y: the spots of orders -1, 0, +1, through one grating and the other
    Orders(OrdersArgs),
    /// Distances: D = L F/L' from a board, s = D - d
    Distance(DistanceArgs),
}

#[derive(Debug, Args)]
pub struct RailArgs {
    /// Image of the near mark
    pub near: PathBuf,
    /// Image of the far mark
    pub far: Option<PathBuf>,
    /// Distances of both marks from the pinhole in mm
    #[arg(long, value_name = "NEAR,FAR", value_parser = pair)]
    pub distances: Option<Pair>,
}

#[derive(Debug, Args)]
pub struct ReflectionArgs {
    /// Image of the aperture
    pub aperture: PathBuf,
    /// Image of the reflected spot
    pub reflected: PathBuf,
    /// Distance from the pinhole to the aperture in mm
    #[arg(long, value_name = "MM", value_parser = positive)]
    pub pinhole_to_aperture: f64,
    /// Distance from the grating to the aperture in mm
    #[arg(long, value_name = "MM", value_parser = positive)]
    pub grating_to_aperture: f64,
}

#[derive(Debug, Args)]
pub struct OrdersArgs {
    /// Image of the three spots
    pub image: PathBuf,
    /// The same through the other grating
    pub other: Option<PathBuf>,
    /// Wavelength over pitch, for the tilt that a bow of the spots means
    #[arg(long, value_name = "RATIO", value_parser = positive)]
    pub wavelength_over_pitch: Option<f64>,
}

#[derive(Debug, Args)]
pub struct DistanceArgs {
    /// Image of the board
    pub image: PathBuf,
    /// What is on the board
    #[arg(long)]
    pub board: BoardArg,
    /// Distance of dots or corners in mm, with its standard deviation
    #[arg(long, value_name = "MM[,SIGMA]", value_parser = measured)]
    pub pitch: Measured,
    /// d, from the gratings to the board in mm, with its standard deviation
    #[arg(long, value_name = "MM[,SIGMA]", value_parser = measured)]
    pub grating_to_board: Measured,
    /// Optics file to take wavelength and gratings from
    #[arg(long, value_name = "FILE", requires = "out")]
    pub optics: Option<PathBuf>,
    /// Write the optics file with camera and distances as found
    #[arg(long, value_name = "FILE", requires = "optics")]
    pub out: Option<PathBuf>,
}

pub fn align(arguments: &AlignArgs) -> Result<Answer, Error> {
    let camera = CameraFile::load(&arguments.camera)?;
    let mm = |m: &Measured| daic_report::with_uncertainty(m.value, m.sigma, "mm");
    let mrad = |m: &Measured| daic_report::with_uncertainty(1e3 * m.value, 1e3 * m.sigma, "mrad");
    let px = |m: &Measured| daic_report::with_uncertainty(m.value, m.sigma, "px");
    match &arguments.step {
        AlignStep::Rail(a) | AlignStep::Laser(a) => {
            let mark =
                if matches!(arguments.step, AlignStep::Rail(_)) { Mark::Aperture } else { Mark::Laser };
            let step = align::rail(&camera, mark, &a.near, a.far.as_deref(), a.distances.map(|d| d.0))?;
            let mut text = String::new();
            for (m, image) in step.found.marks.iter().zip(&step.images) {
                let [x, y] = &m.offset_px;
                writeln!(text, "{image}: mark at {}, {} from the principal point", px(x), px(y)).ok();
            }
            if let Some(axis) = &step.found.axis {
                let ([sx, sy], [ox, oy]) = (&axis.slope_rad, &axis.offset_mm);
                writeln!(text, "slope {}, {}; offset {}, {}", mrad(sx), mrad(sy), mm(ox), mm(oy)).ok();
            }
            answer(arguments, &step, text)
        }
        AlignStep::Reflection(a) => {
            let step = align::reflection(
                &camera,
                &a.aperture,
                &a.reflected,
                a.pinhole_to_aperture,
                a.grating_to_aperture,
            )?;
            let [x, y] = &step.found.tilt_rad;
            let text = format!("grating tilted about x by {}, about y by {}\n", mrad(x), mrad(y));
            answer(arguments, &step, text)
        }
        AlignStep::Orders(a) => {
            let step = align::orders(&camera, &a.image, a.other.as_deref(), a.wavelength_over_pitch)?;
            let f = &step.found;
            let mut text = format!(
                "orders at {} to the x axis, bow {}\n",
                mrad(&f.first.angle_rad),
                px(&f.first.bow_px)
            );
            if let Some(relative) = &f.relative_rad {
                writeln!(text, "second grating against the first {}", mrad(relative)).ok();
            }
            answer(arguments, &step, text)
        }
        AlignStep::Distance(a) => {
            let options = BoardOptions {
                pattern: a.board.into(),
                pitch_mm: a.pitch,
                grating_to_board_mm: a.grating_to_board,
            };
            let step = align::distance(&camera, &a.image, &options)?;
            let f = &step.found;
            let mut text = format!(
                "D = {} from L F/L', {} from the pose of the board (tilt {:.2}°)\ns = D - d = {}\n",
                mm(&f.line_mm),
                mm(&f.board_mm),
                f.tilt_deg,
                mm(&f.pinhole_to_grating_mm)
            );
            if let (Some(from), Some(to)) = (&a.optics, &a.out) {
                align::write_optics(from, to, &camera, &step)?;
                writeln!(text, "optics: {}", to.display()).ok();
            }
            answer(arguments, &step, text)
        }
    }
}

fn answer<T: Serialize>(arguments: &AlignArgs, step: &Step<T>, mut text: String) -> Result<Answer, Error> {
    if let Some(path) = &arguments.record {
        align::record(path, step)?;
    }
    for line in &step.advice {
        writeln!(text, "→ {line}").ok();
    }
    if step.aligned {
        writeln!(text, "nothing to correct").ok();
    }
    Ok(Answer::new(as_json(step)?, text))
}
