//! Steps of lining up a rig, each from stored images: what `daic align` does.
//!
//! Every step answers with measured numbers, what to turn or move and by how much. Its result can be
//! added to a record (TOML, a table for each step); the last step writes an optics file.

mod guide;
mod record;
mod watch;

pub use guide::{GuideStep, State, guide};
use record::read_record;
pub use record::{record, write_optics};
pub use watch::{Sight, Until, Watched, watch};

use crate::calibrate_camera::{board_points, find, grey};
use crate::camera_file::{self, CameraFile};
use crate::error::Error;
use crate::images;
use daic_dataset::GreyImage;
use daic_optics::GreyView;
use daic_optics::align::axis::{Axis, Offset, axis, grating_tilt, offset};
use daic_optics::align::distance::{pinhole_to_grating, pinhole_to_line};
use daic_optics::align::orders::{OrderLine, order_line};
use daic_optics::align::spots::{Spot, find_disc, find_spots};
use daic_optics::align::{AlignError, Measured};
use daic_optics::intrinsics::{CameraParameter, pose_of_board};
use daic_optics::target::{Pattern, TargetSettings};
use serde::Serialize;
use std::path::Path;

/// What a step found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Step<T> {
    /// Its name, as in the record.
    pub step: &'static str,
    /// When, UTC.
    pub date: String,
    /// Program.
    pub program: String,
    /// The images.
    pub images: Vec<String>,
    /// What to do, a sentence each.
    pub advice: Vec<String>,
    /// Whether all of it is within two standard deviations of aligned.
    pub aligned: bool,
    /// The numbers.
    pub found: T,
}

impl<T> Step<T> {
    fn new(step: &'static str, images: &[&Path], advice: Vec<String>, found: T) -> Self {
        Self {
            step,
            date: camera_file::now(),
            program: format!("daic {}", env!("CARGO_PKG_VERSION")),
            images: images.iter().map(|p| p.display().to_string()).collect(),
            aligned: advice.is_empty(),
            advice,
            found,
        }
    }
}

/// What carries the mark of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    /// An aperture on the rail: the camera is turned.
    Aperture,
    /// The spot of the laser on a card: the laser is turned.
    Laser,
}

/// A mark at one or two distances.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rail {
    /// Mark against principal point, each image.
    pub marks: Vec<Offset>,
    /// With two images: direction and offset of rail or beam.
    pub axis: Option<Axis>,
}

fn at(path: &Path) -> impl Fn(AlignError) -> Error + '_ {
    move |source| Error::Align { path: path.to_owned(), source }
}

fn with_view<T>(
    path: &Path,
    look: impl FnOnce(&GreyImage, &GreyView<'_>) -> Result<T, AlignError>,
) -> Result<T, Error> {
    let image = images::read(path)?;
    let data = grey(&image);
    let view = GreyView::new(&data, image.width as usize, image.height as usize)
        .map_err(|source| Error::Detector { path: path.to_owned(), source })?;
    look(&image, &view).map_err(at(path))
}

/// The level at which a camera of so many bits saturates.
fn saturation(image: &GreyImage) -> f64 {
    f64::from(2.0_f32.powi(i32::from(image.significant_bits))) - 1.0
}

fn spots(path: &Path, count: usize) -> Result<Vec<Spot>, Error> {
    with_view(path, |image, view| find_spots(view, count, saturation(image)))
}

fn principal_sigma(camera: &CameraFile) -> [f64; 2] {
    [CameraParameter::PrincipalX, CameraParameter::PrincipalY].map(|p| camera.measured(p).sigma)
}

/// `value ± sigma unit` for people.
fn say(m: Measured, factor: f64, unit: &str) -> String {
    daic_report::with_uncertainty(m.value.abs() * factor, m.sigma * factor, unit)
}

/// Below this many standard deviations there is nothing to correct.
const NOTHING: f64 = 2.0;

fn either<'a>(m: Measured, positive: &'a str, negative: &'a str) -> Option<&'a str> {
    m.stands_out(NOTHING).then_some(if m.value > 0.0 { positive } else { negative })
}

/// Camera along the rail (aperture), or laser along the camera's axis: a mark near and far;
/// `distances_mm` from the pinhole are needed for two.
///
/// # Errors
/// No mark in an image, distances missing or out of order.
pub fn rail(
    camera: &CameraFile,
    mark: Mark,
    near: &Path,
    far: Option<&Path>,
    distances_mm: Option<[f64; 2]>,
) -> Result<Step<Rail>, Error> {
    let look = |path: &Path| match mark {
        Mark::Aperture => with_view(path, |_, view| find_disc(view)),
        Mark::Laser => Ok(spots(path, 1)?[0]),
    };
    let sigma = principal_sigma(camera);
    let first = look(near)?;
    let mut marks = vec![offset(&camera.camera, sigma, &first).map_err(at(near))?];
    let name = match mark {
        Mark::Aperture => "rail",
        Mark::Laser => "laser",
    };
    let mut advice = Vec::new();
    let Some(far) = far else {
        for (o, (plus, minus)) in marks[0].offset_px.iter().zip([("left", "right"), ("up", "down")]) {
            if let Some(way) = either(*o, plus, minus) {
                advice.push(format!("move the mark {way} in the image by {}", say(*o, 1.0, "px")));
            }
        }
        return Ok(Step::new(name, &[near], advice, Rail { marks, axis: None }));
    };
    let Some([near_mm, far_mm]) = distances_mm else {
        let meaning = "the distances of both marks from the pinhole in mm";
        return Err(Error::AlignNeeds { option: "--distances NEAR,FAR", meaning });
    };
    let second = look(far)?;
    marks.push(offset(&camera.camera, sigma, &second).map_err(at(far))?);
    let found = axis(&camera.camera, sigma, [&first, &second], near_mm, far_mm).map_err(at(far))?;
    let [sx, sy] = found.slope_rad;
    let [ox, oy] = found.offset_mm;
    let turn = match mark {
        // The camera's axis is to go where the rail goes.
        Mark::Aperture => ["turn the camera to its", "right", "left", "tilt the camera", "down", "up"],
        // The beam, seen from the camera, comes from the side to which it slopes.
        Mark::Laser => [
            "turn the laser, seen from the camera, so that far away the beam moves to the",
            "left",
            "right",
            "tilt the laser so that far away the beam moves",
            "up",
            "down",
        ],
    };
    if let Some(way) = either(sx, turn[1], turn[2]) {
        advice.push(format!("{} {way} by {}", turn[0], say(sx, 1e3, "mrad")));
    }
    if let Some(way) = either(sy, turn[4], turn[5]) {
        advice.push(format!("{} {way} by {}", turn[3], say(sy, 1e3, "mrad")));
    }
    let thing = if mark == Mark::Aperture { "aperture" } else { "laser" };
    if let Some(way) = either(ox, "left", "right") {
        advice.push(format!("move the {thing} {way} (as the camera sees it) by {}", say(ox, 1.0, "mm")));
    }
    if let Some(way) = either(oy, "up", "down") {
        advice.push(format!("move the {thing} {way} by {}", say(oy, 1.0, "mm")));
    }
    Ok(Step::new(name, &[near, far], advice, Rail { marks, axis: Some(found) }))
}

/// Tilt of a grating from the reflected beam.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Reflection {
    /// Rotations about x and y, radians.
    pub tilt_rad: [Measured; 2],
}

fn turn_back(m: Measured, axis: &str) -> Option<String> {
    m.stands_out(NOTHING).then(|| {
        let sign = if m.value > 0.0 { '−' } else { '+' };
        format!("turn the grating about {axis} by {sign}{}", say(m, 1e3, "mrad"))
    })
}

/// Grating square to the beam: the aperture in one image, the reflected spot beside it in another.
///
/// # Errors
/// No aperture, no spot, distances that are not above 0.
pub fn reflection(
    camera: &CameraFile,
    aperture: &Path,
    reflected: &Path,
    pinhole_to_aperture_mm: f64,
    grating_to_aperture_mm: f64,
) -> Result<Step<Reflection>, Error> {
    let hole = with_view(aperture, |_, view| find_disc(view))?;
    let spot = spots(reflected, 1)?[0];
    let tilt_rad = grating_tilt(&camera.camera, &hole, &spot, pinhole_to_aperture_mm, grating_to_aperture_mm)
        .map_err(at(reflected))?;
    let advice = [turn_back(tilt_rad[0], "x"), turn_back(tilt_rad[1], "y")].into_iter().flatten().collect();
    Ok(Step::new("reflection", &[aperture, reflected], advice, Reflection { tilt_rad }))
}

/// Rotation of the grooves.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Orders {
    /// Of the grating of the first image.
    pub first: OrderLine,
    /// Tilt about x that its bow means, if λ/p was given, radians.
    pub tilt_x_rad: Option<Measured>,
    /// Of the grating of the second image.
    pub second: Option<OrderLine>,
    /// Rotation of the second against the first, radians.
    pub relative_rad: Option<Measured>,
}

/// By how much the grooves stand otherwise than in the record's step `orders`, in a sentence, if it stands out.
fn changed(record: &toml::Table, now: &OrderLine) -> Option<String> {
    let before = record.get("orders")?.get("found")?.get("first")?.get("angle_rad")?;
    let of = |name: &str| before.get(name).and_then(toml::Value::as_float);
    let before = Measured::new(of("value")?, of("sigma")?);
    let change = Measured::new(now.angle_rad.value - before.value, now.angle_rad.sigma.hypot(before.sigma));
    change.stands_out(NOTHING).then(|| {
        let sign = if change.value > 0.0 { '+' } else { '−' };
        format!("since step orders the gratings have turned about z by {sign}{}", say(change, 1e3, "mrad"))
    })
}

/// [`orders`] after the gratings came back onto the rail: also what has changed since that step of `record`.
///
/// # Errors
/// As [`orders`]; a record that cannot be read.
pub fn orders_again(
    camera: &CameraFile,
    image: &Path,
    other: Option<&Path>,
    shift: Option<f64>,
    record: &Path,
) -> Result<Step<Orders>, Error> {
    let record = read_record(record)?;
    let step = orders(camera, image, other, shift)?;
    let mut advice = step.advice;
    advice.extend(changed(&record, &step.found.first));
    let images: Vec<&Path> = [Some(image), other].into_iter().flatten().collect();
    Ok(Step::new("orders_again", &images, advice, step.found))
}

/// Grooves along y: the orders −1, 0, +1 of the beam through a grating, and through the other one.
///
/// # Errors
/// Not three spots, or not those of three orders.
pub fn orders(
    camera: &CameraFile,
    image: &Path,
    other: Option<&Path>,
    shift: Option<f64>,
) -> Result<Step<Orders>, Error> {
    let line = |path: &Path| order_line(&camera.camera, &spots(path, 3)?).map_err(at(path));
    let first = line(image)?;
    let tilt_x_rad = shift.map(|s| first.tilt_x_rad(&camera.camera, s)).transpose().map_err(at(image))?;
    let second = other.map(line).transpose()?;
    let relative_rad = second.map(|s| first.relative_rad(&s));
    let mut advice: Vec<String> = turn_back(first.angle_rad, "z").into_iter().collect();
    if first.bow_px.stands_out(4.0) {
        let tilt = tilt_x_rad.map_or_else(String::new, |t| format!(": about x by {}", say(t, 1e3, "mrad")));
        let px = say(first.bow_px, 1.0, "px");
        advice.push(format!(
            "the spots are not on a line ({px}): the grating is tilted{tilt}; repeat step reflection"
        ));
    }
    if let Some(relative) = relative_rad.filter(|r| r.stands_out(NOTHING)) {
        advice.push(format!(
            "the second grating is turned against the first by {}{}: seat it anew in its groove",
            if relative.value > 0.0 { '+' } else { '−' },
            say(relative, 1e3, "mrad")
        ));
    }
    let images: Vec<&Path> = [Some(image), other].into_iter().flatten().collect();
    Ok(Step::new("orders", &images, advice, Orders { first, tilt_x_rad, second, relative_rad }))
}

/// Distances to board and grating.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Distance {
    /// D by L F / L′ with the longest row of the board.
    pub line_mm: Measured,
    /// D along the optical axis from the pose of the board; with the standard deviation of F.
    pub board_mm: Measured,
    /// Angle between board and sensor, degrees.
    pub tilt_deg: f64,
    /// s = D − d, with D from the pose.
    pub pinhole_to_grating_mm: Measured,
    /// d, as measured by hand.
    pub grating_to_board_mm: Measured,
}

/// The board of the distance step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardOptions {
    /// Dots or corners.
    pub pattern: Pattern,
    /// Their distance and its standard deviation, millimetres.
    pub pitch_mm: Measured,
    /// d, millimetres.
    pub grating_to_board_mm: Measured,
}

/// D = L F / L′ and s = D − d from an image of a board.
///
/// # Errors
/// No board, or distances that do not go together.
pub fn distance(camera: &CameraFile, image: &Path, options: &BoardOptions) -> Result<Step<Distance>, Error> {
    let picture = images::read(image)?;
    let target = find(image, &picture, &TargetSettings::new(options.pattern))?;
    let pitch = options.pitch_mm;
    let fit = pose_of_board(&camera.camera, &board_points(&target, pitch.value))?;
    let focal = camera.measured(CameraParameter::Focal);
    // The longest row, from its first to its last point.
    let row = |p: &daic_optics::target::TargetPoint| p.index[1];
    let ends = target.points.chunk_by(|a, b| row(a) == row(b)).map(|r| (r[0], r[r.len() - 1]));
    // of the longest rows the one nearest the axis: D is counted along it
    let axis = camera.camera.principal_point_px[1];
    let off = |(a, b): &(daic_optics::target::TargetPoint, daic_optics::target::TargetPoint)| {
        (0.5 * (a.at_px[1] + b.at_px[1]) - axis).abs()
    };
    let longest = ends.clone().map(|(a, b)| b.index[0] - a.index[0]).max();
    let rows = ends.filter(|(a, b)| Some(b.index[0] - a.index[0]) == longest);
    let Some((a, b)) = rows.min_by(|p, q| off(p).total_cmp(&off(q))) else {
        return Err(at(image)(AlignError::Spots { found: 0, needed: 2 }));
    };
    let ideal = |p: [f64; 2]| camera.camera.undistort_px(p).map_err(|e| at(image)(e.into()));
    let (p, q) = (ideal(a.at_px)?, ideal(b.at_px)?);
    let pixels = Measured::new((p[0] - q[0]).hypot(p[1] - q[1]), a.sigma_px[0].hypot(b.sigma_px[0]));
    let steps = f64::from(b.index[0] - a.index[0]);
    let length = Measured::new(steps * pitch.value, steps * pitch.sigma);
    let line_mm = pinhole_to_line(focal, length, pixels).map_err(at(image))?;
    let [d, s] = fit.axial_distance_mm();
    let scale = (focal.sigma / focal.value).hypot(pitch.sigma / pitch.value);
    let board_mm = Measured::new(d, s.hypot(d * scale));
    let pinhole_to_grating_mm =
        pinhole_to_grating(board_mm, options.grating_to_board_mm).map_err(at(image))?;
    let tilt_deg = fit.pose.tilt_rad().to_degrees();
    let mut advice = Vec::new();
    // 1 − cos of it is what D = L F/L′ is wrong by.
    if tilt_deg > 1.0 {
        advice.push(format!("the board is tilted by {tilt_deg:.2}° against the sensor: set it square, or rely on D from its pose"));
    }
    let found = Distance {
        line_mm,
        board_mm,
        tilt_deg,
        pinhole_to_grating_mm,
        grating_to_board_mm: options.grating_to_board_mm,
    };
    Ok(Step::new("distance", &[image], advice, found))
}
