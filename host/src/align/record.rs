//! The record of an alignment, and the optics file that comes of it.

use super::{Distance, Step};
use crate::camera_file::CameraFile;
use crate::error::Error;
use daic_dataset::atomic;
use daic_optics::align::Measured;
use daic_optics::intrinsics::CameraParameter;
use daic_optics::{GratingParameter, Parameter, View};
use daic_rig::experiment::{self, Covariance, OpticsFile};
use daic_rig::units::{Angle, Length, Pixels};
use nalgebra::DMatrix;
use serde::Serialize;
use std::path::Path;

/// The tables of a record; none if there is no file yet.
pub(super) fn read_record(path: &Path) -> Result<toml::Table, Error> {
    match std::fs::read_to_string(path) {
        Ok(text) => text
            .parse::<toml::Table>()
            .map_err(|e| Error::AlignRecord { path: path.to_owned(), reason: e.to_string() }),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(toml::Table::new()),
        Err(source) => Err(Error::Read { path: path.to_owned(), source }),
    }
}

/// Adds a step to a record, in place of one of the same name.
///
/// # Errors
/// A record that cannot be read or written.
pub fn record<T: Serialize>(path: &Path, step: &Step<T>) -> Result<(), Error> {
    let unwritable = |reason: String| Error::Unwritable { path: path.to_owned(), reason };
    let mut table = read_record(path)?;
    table.insert("format".into(), "daic-alignment/1".into());
    table.insert("units".into(), "lengths mm, images px, angles rad unless the name says deg".into());
    let value = toml::Value::try_from(step).map_err(|e| unwritable(e.to_string()))?;
    table.insert(step.step.to_owned(), value);
    let text = toml::to_string(&table).map_err(|e| unwritable(e.to_string()))?;
    Ok(atomic::write_bytes(path, text.as_bytes())?)
}

/// What the record's steps found of the gratings.
struct Tilts {
    /// About x, y and z, of the first and of the second grating; those about x and y are in common, for both stand on one
    /// holder.
    of: [[Measured; 3]; 2],
    /// Whether both gratings have an angle of grooves of their own.
    both: bool,
    /// Steps with their dates, for the provenance.
    from: Vec<String>,
    /// Steps whose advice is open.
    open: Vec<&'static str>,
}

/// The gratings' tilts of a record; none before the steps `reflection` and `orders` are done.
fn recorded_tilts(record: &toml::Table) -> Option<Tilts> {
    let found = |step: &str| record.get(step)?.get("found");
    let measured = |m: &toml::Value| {
        let of = |name: &str| m.get(name).and_then(toml::Value::as_float);
        Some(Measured::new(of("value")?, of("sigma")?))
    };
    let about = |axis: usize| measured(found("reflection")?.get("tilt_rad")?.get(axis)?);
    let (x, y) = (about(0)?, about(1)?);
    let grooves_from = if record.contains_key("orders_again") { "orders_again" } else { "orders" };
    let orders = found(grooves_from)?;
    let grooves = |name: &str| measured(orders.get(name)?.get("angle_rad")?);
    let first = grooves("first")?;
    let second = grooves("second");
    let of_step = |step: &str, key: &str| record.get(step).and_then(|s| s.get(key));
    let steps = ["reflection", grooves_from];
    let date =
        |step: &str| of_step(step, "date").and_then(toml::Value::as_str).unwrap_or("no date").to_owned();
    let open = |step: &&str| !of_step(step, "aligned").and_then(toml::Value::as_bool).unwrap_or(false);
    Some(Tilts {
        of: [[x, y, first], [x, y, second.unwrap_or(first)]],
        both: second.is_some(),
        from: steps.iter().map(|step| format!("{step} ({})", date(step))).collect(),
        open: steps.into_iter().filter(open).collect(),
    })
}

/// The parameter of the set-up that a parameter of a camera alone is.
fn of_setup(parameter: CameraParameter) -> Parameter {
    match parameter {
        CameraParameter::Focal => Parameter::FocalPx,
        CameraParameter::PrincipalX => Parameter::PrincipalPointX,
        CameraParameter::PrincipalY => Parameter::PrincipalPointY,
        CameraParameter::K1 => Parameter::BrownK1,
        CameraParameter::K2 => Parameter::BrownK2,
        CameraParameter::K3 => Parameter::BrownK3,
        CameraParameter::P1 => Parameter::BrownP1,
        CameraParameter::P2 => Parameter::BrownP2,
    }
}

/// Covariance of camera, s, d and, in the order of the views, the gratings' tilts.
///
/// D is the board's distance, proportional to F: s = D − d goes with F by D/F, and with d by −1; what else makes D uncertain
/// (pitch, pose) is independent.
fn covariance(camera: &CameraFile, found: &Distance, tilts: Option<[[Measured; 3]; 2]>) -> Covariance {
    let n = camera.estimates.len();
    let mut names: Vec<String> =
        camera.estimates.iter().map(|e| of_setup(e.parameter).name().to_owned()).collect();
    names.extend([Parameter::PinholeToGrating, Parameter::GratingToReference].map(|p| p.name().to_owned()));
    // independent sources: the camera's parameters, the rest of D, d, the tilts
    let board = found.board_mm;
    let focal = camera.measured(CameraParameter::Focal);
    let by_focal = board.value / focal.value;
    let rest = (board.sigma.powi(2) - (by_focal * focal.sigma).powi(2)).max(0.0);
    let mut matrix = DMatrix::zeros(n + 2, n + 2);
    for i in 0..n {
        for j in 0..n {
            matrix[(i, j)] = camera.covariance[i][j];
        }
    }
    if let Some(f) = camera.estimates.iter().position(|e| e.parameter == CameraParameter::Focal) {
        for j in 0..n {
            let with = by_focal * camera.covariance[f][j];
            (matrix[(n, j)], matrix[(j, n)]) = (with, with);
        }
    }
    let d = found.grating_to_board_mm.sigma.powi(2);
    matrix[(n, n)] = (by_focal * focal.sigma).powi(2) + rest + d;
    matrix[(n + 1, n + 1)] = d;
    (matrix[(n, n + 1)], matrix[(n + 1, n)]) = (-d, -d);
    if let Some([minus, plus]) = tilts {
        let first = n + 2;
        matrix = matrix.resize(first + 6, first + 6, 0.0);
        let axes = [GratingParameter::TiltX, GratingParameter::TiltY, GratingParameter::TiltZ];
        for (view, own) in [(View::Minus, 0), (View::Plus, 3)] {
            for (axis, parameter) in axes.into_iter().enumerate() {
                names.push(Parameter::Grating(view, parameter).name().to_owned());
                let sigma = if own == 0 { minus } else { plus }[axis].sigma;
                matrix[(first + own + axis, first + own + axis)] = sigma * sigma;
            }
        }
        // one holder: what turns one about x or y turns the other
        for axis in 0..2 {
            let common = minus[axis].sigma * plus[axis].sigma;
            matrix[(first + axis, first + 3 + axis)] = common;
            matrix[(first + 3 + axis, first + axis)] = common;
        }
    }
    Covariance {
        parameters: names,
        matrix: matrix.row_iter().map(|row| row.iter().copied().collect()).collect(),
    }
}

/// Writes the optics file `from` with camera and distances as found, and the covariance of all that was measured, to
/// `to`; d counts from the board, which is the reference plane. With a `record` that holds the steps `reflection` and
/// `orders` the gratings' tilts go along, the first grating being that of `first`. Returns what the user should know.
///
/// # Errors
/// A file that cannot be read or written.
pub fn write_optics(
    from: &Path,
    to: &Path,
    camera: &CameraFile,
    found: &Step<Distance>,
    record: Option<(&Path, View)>,
) -> Result<Vec<String>, Error> {
    let mut file = OpticsFile::load(from)?;
    let mut notes = Vec::new();
    let mut provenance = format!(
        "camera of {} ({}), distances of {} ({}, {})",
        camera.date,
        camera.program,
        found.images.join(", "),
        found.date,
        found.program
    );
    let mut tilts = match record {
        Some((path, _)) => recorded_tilts(&read_record(path)?),
        None => None,
    };
    if let (Some(tilts), Some((_, View::Plus))) = (&mut tilts, record) {
        tilts.of.swap(0, 1);
    }
    if let Some(tilts) = &tilts {
        let gratings = file.optics.gratings().ok_or(Error::Gratings)?;
        let [a, b] = [(gratings[0], tilts.of[0]), (gratings[1], tilts.of[1])]
            .map(|(g, tilt)| experiment::Grating { tilt: tilt.map(|t| Angle::new(t.value)), ..*g });
        (file.optics.grating, file.optics.grating_minus, file.optics.grating_plus) = (None, Some(a), Some(b));
        provenance += &format!(", tilts of the gratings by {}", tilts.from.join(" and "));
        for step in &tilts.open {
            notes.push(format!(
                "the record's step {step} asked for a correction: the tilts written are those before it; repeat the step if the grating was turned since"
            ));
        }
        if !tilts.both {
            notes.push(
                "the grooves of one grating were measured and taken for both: give `daic align orders` an image of each"
                    .to_owned(),
            );
        }
    }
    let b = camera.camera.brown;
    let brown = experiment::Brown { k1: b.k1, k2: b.k2, k3: b.k3, p1: b.p1, p2: b.p2 };
    file.optics.focal = Pixels::new(camera.camera.focal_px);
    file.optics.principal_point = camera.camera.principal_point_px.map(Pixels::new);
    file.optics.brown = (brown != experiment::Brown::default()).then_some(brown);
    file.optics.pinhole_to_grating = Length::new(found.found.pinhole_to_grating_mm.value);
    file.optics.grating_to_reference = Length::new(found.found.grating_to_board_mm.value);
    // what an earlier calibration said of itself does not hold for these values
    file.covariance = Some(covariance(camera, &found.found, tilts.map(|t| t.of)));
    file.volume = None;
    let folder = |path: &Path| path.parent().unwrap_or(Path::new("")).to_owned();
    file.maps = crate::optics_file::moved_maps(file.maps.as_ref(), &folder(from), &folder(to))?;
    file.format = Some(OpticsFile::FORMAT.to_owned());
    file.date = Some(found.date.clone());
    file.provenance = Some(provenance);
    let text = toml::to_string(&file)
        .map_err(|e| Error::Unwritable { path: to.to_owned(), reason: e.to_string() })?;
    atomic::write_bytes(to, text.as_bytes())?;
    Ok(notes)
}
