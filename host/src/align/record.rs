//! The record of an alignment, and the optics file that comes of it.

use super::{Distance, Step};
use crate::camera_file::CameraFile;
use crate::error::Error;
use daic_dataset::atomic;
use daic_optics::View;
use daic_rig::experiment::{self, OpticsFile};
use daic_rig::units::{Angle, Length, Pixels};
use serde::Serialize;
use std::path::{Path, PathBuf};

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

/// Rotations about x, y and z that the record's steps found for the first and the second grating; those about x and y are
/// in common, for both stand on one holder. None before the steps are done.
fn recorded_tilts(record: &toml::Table) -> Option<[[f64; 3]; 2]> {
    let found = |step: &str| record.get(step)?.get("found");
    let value = |m: &toml::Value| m.get("value").and_then(toml::Value::as_float);
    let about = |axis: usize| value(found("reflection")?.get("tilt_rad")?.get(axis)?);
    let (x, y) = (about(0)?, about(1)?);
    let orders = found("orders_again").or_else(|| found("orders"))?;
    let grooves = |name: &str| value(orders.get(name)?.get("angle_rad")?);
    let first = grooves("first")?;
    let second = grooves("second").unwrap_or(first);
    Some([[x, y, first], [x, y, second]])
}

/// Writes the optics file `from` with camera and distances as found to `to`; d counts from the
/// board, which is the reference plane. With a `record` that holds the steps `reflection` and `orders` the gratings'
/// tilts go along, the first grating being that of `first`.
///
/// # Errors
/// A file that cannot be read or written.
pub fn write_optics(
    from: &Path,
    to: &Path,
    camera: &CameraFile,
    found: &Step<Distance>,
    record: Option<(&Path, View)>,
) -> Result<PathBuf, Error> {
    let mut file = OpticsFile::load(from)?;
    let tilts = match record {
        Some((path, first)) => recorded_tilts(&read_record(path)?).map(|tilts| (tilts, first)),
        None => None,
    };
    if let Some(([mut minus, mut plus], first)) = tilts {
        if first == View::Plus {
            std::mem::swap(&mut minus, &mut plus);
        }
        let gratings = file.optics.gratings().ok_or(Error::Gratings)?;
        let [a, b] = [(gratings[0], minus), (gratings[1], plus)]
            .map(|(g, tilt)| experiment::Grating { tilt: tilt.map(Angle::new), ..*g });
        (file.optics.grating, file.optics.grating_minus, file.optics.grating_plus) = (None, Some(a), Some(b));
    }
    let b = camera.camera.brown;
    let brown = experiment::Brown { k1: b.k1, k2: b.k2, k3: b.k3, p1: b.p1, p2: b.p2 };
    file.optics.focal = Pixels::new(camera.camera.focal_px);
    file.optics.principal_point = camera.camera.principal_point_px.map(Pixels::new);
    file.optics.brown = (brown != experiment::Brown::default()).then_some(brown);
    file.optics.pinhole_to_grating = Length::new(found.found.pinhole_to_grating_mm.value);
    file.optics.grating_to_reference = Length::new(found.found.grating_to_board_mm.value);
    // what an earlier calibration said of itself does not hold for these values
    (file.covariance, file.volume) = (None, None);
    let folder = |path: &Path| path.parent().unwrap_or(Path::new("")).to_owned();
    file.maps = crate::optics_file::moved_maps(file.maps.as_ref(), &folder(from), &folder(to))?;
    file.provenance = Some(format!(
        "camera of {} ({}), distances of {} ({}, {})",
        camera.date,
        camera.program,
        found.images.join(", "),
        found.date,
        found.program
    ));
    let text = toml::to_string(&file)
        .map_err(|e| Error::Unwritable { path: to.to_owned(), reason: e.to_string() })?;
    atomic::write_bytes(to, text.as_bytes())?;
    Ok(to.to_owned())
}
