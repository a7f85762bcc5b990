//! `daic align`.

use super::arguments::{numbers, positive};
use super::camera::BoardArg;
use super::commands::as_json;
use super::output::{Answer, Output};
use clap::{Args, Subcommand, ValueEnum};
use daic::Error;
use daic::align::{self, BoardOptions, Mark, Sight, State, Step, Until, Watched};
use daic::camera_file::CameraFile;
use daic_optics::View;
use daic_optics::align::Measured;
use serde::Serialize;
use serde_json::json;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

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
    /// The eleven steps, what is done of them and what comes next
    Guide,
    /// Looks at every new image in a folder and says what to turn, until it is aligned
    Watch(WatchArgs),
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum WatchedArg {
    /// An aperture on the rail
    Aperture,
    /// The laser's spot
    Laser,
    /// The spots of orders -1, 0, +1
    Orders,
}

#[derive(Debug, Args)]
pub struct WatchArgs {
    /// What is looked for
    pub mark: WatchedArg,
    /// Folder into which the camera's program writes images
    pub folder: PathBuf,
    /// End after so many images (default: when it is aligned)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub images: Option<u32>,
    /// End when no image has come for so long, seconds
    #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = positive)]
    pub idle: f64,
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
    /// The gratings are back on the rail: say what has changed since the record's step `orders`
    #[arg(long, requires = "record")]
    pub again: bool,
}

/// A view.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum FirstGrating {
    /// The -1 view, on the left of the sensor
    Minus,
    /// The +1 view
    Plus,
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
    /// View of the grating that the steps `reflection` and `orders` of the record had first
    #[arg(long, value_name = "VIEW", default_value = "minus")]
    pub first_grating: FirstGrating,
    /// Write the optics file with camera and distances as found, and the gratings' tilts of the record
    #[arg(long, value_name = "FILE", requires = "optics")]
    pub out: Option<PathBuf>,
}

fn guide(arguments: &AlignArgs) -> Result<Answer, Error> {
    let steps = align::guide(&arguments.camera, arguments.record.as_deref())?;
    let mut text = String::new();
    for step in &steps {
        let date = step.date.as_deref().map_or_else(String::new, |d| format!(" ({d})"));
        writeln!(text, "{:2} {} {}{date}", step.number, step.state.mark(), step.what).ok();
        for advice in &step.advice {
            writeln!(text, "           → {advice}").ok();
        }
    }
    // a step by hand shows in a later one; the next is the first that nothing shows
    let last = steps.iter().rposition(|s| s.state != State::ToDo).map_or(0, |k| k + 1);
    let next = steps
        .iter()
        .find(|s| s.state == State::Correct)
        .or_else(|| steps.iter().take(last).find(|s| s.state == State::ToDo).or_else(|| steps.get(last)));
    if let Some(next) = next {
        let command = next.command.unwrap_or("by hand");
        write!(text, "next: step {}, {}\n      {command}", next.number, next.what).ok();
    }
    if arguments.record.is_none() {
        write!(text, "\nwith --record FILE in every step the guide knows what is done").ok();
    }
    Ok(Answer::new(json!({ "steps": as_json(&steps)?, "next": next.map(|s| s.number) }), text))
}

fn watch(a: &WatchArgs, camera: &CameraFile, output: &Output) -> Result<Answer, Error> {
    let what = match a.mark {
        WatchedArg::Aperture => Watched::Mark(Mark::Aperture),
        WatchedArg::Laser => Watched::Mark(Mark::Laser),
        WatchedArg::Orders => Watched::Orders,
    };
    output.stop_on_interrupt();
    let until = Until { images: a.images.map(|n| n as usize), idle: Duration::from_secs_f64(a.idle) };
    let line = |s: &Sight| {
        let what = if s.aligned { "nothing to correct".to_owned() } else { s.advice.join("; ") };
        format!("{}: {what}", s.image)
    };
    let sights = align::watch(camera, what, &a.folder, until, output, &mut |s| output.note(&line(s)))?;
    let aligned = sights.last().is_some_and(|s| s.aligned);
    let text = sights.last().map_or_else(String::new, |s| format!("{} images; {}", sights.len(), line(s)));
    Ok(Answer::new(json!({ "images": as_json(&sights)?, "aligned": aligned }), text).checked(aligned))
}

pub fn align(arguments: &AlignArgs, output: &Output) -> Result<Answer, Error> {
    // the guide's first step is the camera's calibration
    if matches!(arguments.step, AlignStep::Guide) {
        return guide(arguments);
    }
    let camera = CameraFile::load(&arguments.camera)?;
    let mm = |m: &Measured| daic_report::with_uncertainty(m.value, m.sigma, "mm");
    let mrad = |m: &Measured| daic_report::with_uncertainty(1e3 * m.value, 1e3 * m.sigma, "mrad");
    let px = |m: &Measured| daic_report::with_uncertainty(m.value, m.sigma, "px");
    match &arguments.step {
        AlignStep::Guide => guide(arguments),
        AlignStep::Watch(a) => watch(a, &camera, output),
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
            let (other, shift) = (a.other.as_deref(), a.wavelength_over_pitch);
            let step = match &arguments.record {
                Some(record) if a.again => align::orders_again(&camera, &a.image, other, shift, record)?,
                _ => align::orders(&camera, &a.image, other, shift)?,
            };
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
                let first = match a.first_grating {
                    FirstGrating::Minus => View::Minus,
                    FirstGrating::Plus => View::Plus,
                };
                let record = arguments.record.as_deref().map(|path| (path, first));
                for note in align::write_optics(from, to, &camera, &step, record)? {
                    writeln!(text, "note: {note}").ok();
                }
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
