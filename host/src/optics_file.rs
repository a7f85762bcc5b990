//! Optics files with everything they refer to: covariance, distortion maps, calibrated volume.

use crate::distortion_file::{DistortionFile, IdealImage};
use crate::error::Error;
use crate::measure::{Instrument, MapQuality};
use crate::optics_section;
use daic_dataset::atomic;
use daic_optics::bundle::Volume;
use daic_optics::{Decoder, DistortionMaps, OpticalModel, Optics, ParameterCovariance, View};
use daic_rig::experiment::{MapFile, Maps, OpticsFile};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

const CRC: crc::Crc<u64> = crc::Crc::<u64>::new(&crc::CRC_64_XZ);

/// An optics file, read with its maps.
#[derive(Debug, Clone)]
pub struct CalibratedOptics {
    /// Where it was read.
    pub path: PathBuf,
    /// The file as it stands.
    pub file: OpticsFile,
    /// The set-up.
    pub optics: Optics,
    /// Covariance of its parameters, if stated.
    pub covariance: Option<ParameterCovariance>,
    /// Where it was calibrated, if stated.
    pub volume: Option<Volume>,
    /// Map of the sensor, of the −1 view, of the +1 view.
    maps: [Option<DistortionFile>; 3],
}

impl CalibratedOptics {
    /// Reads an optics file (an experiment file will do) and the maps it names.
    ///
    /// # Errors
    /// The file and the field that is to blame; [`Error::OpticsMap`] for a map that is not the one meant.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let file = OpticsFile::load(path)?;
        let named = file.maps.clone().unwrap_or_default();
        let read = |entry: &Option<MapFile>, name: &'static str, view: Option<View>| {
            entry.as_ref().map(|entry| read_map(path, name, entry, view)).transpose()
        };
        let maps = [
            read(&named.sensor, "sensor", None)?,
            read(&named.minus, "minus", Some(View::Minus))?,
            read(&named.plus, "plus", Some(View::Plus))?,
        ];
        let volume = file.volume.map(|v| {
            let end = |i: usize| [v.x[i], v.y[i], v.h[i]].map(|l| l.mm());
            Volume { from_mm: end(0), to_mm: end(1) }
        });
        Ok(Self {
            path: path.to_owned(),
            optics: optics_section::from_section(&file.optics)?,
            covariance: optics_section::covariance(&file, path)?,
            file,
            volume,
            maps,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Everything that results depend on, maps by their checksums, as text.
    ///
    /// # Errors
    /// If it cannot be written as TOML.
    pub fn key(&self) -> Result<String, Error> {
        self.file.to_toml().map_err(|e| Error::Unwritable { path: self.path.clone(), reason: e.to_string() })
    }

    /// All maps.
    pub fn maps(&self) -> DistortionMaps {
        let [sensor, minus, plus] = self.maps.each_ref().map(|m| m.as_ref().map(|m| Arc::new(m.e.clone())));
        DistortionMaps { sensor, minus, plus }
    }

    /// Ready to decode.
    ///
    /// # Errors
    /// [`Error::OpticsMap`] where a map of a view was not made for this decoder.
    pub fn instrument(&self, decoder: Decoder) -> Result<Instrument, Error> {
        let wanted = if decoder == Decoder::Ray { IdealImage::Ray } else { IdealImage::Pinhole };
        for (map, name) in self.maps[1..].iter().zip(["minus", "plus"]) {
            if map.as_ref().is_some_and(|m| m.ideal != wanted) {
                let (made, other) = match wanted {
                    IdealImage::Ray => ("straight lines", "ray"),
                    IdealImage::Pinhole => ("exact rays", "pinhole"),
                };
                let reason = format!(
                    "it was counted from {made}, which the decoder `{}` does not expect; make one with `daic calibrate distortion --view {name} --ideal {other}`",
                    format!("{decoder:?}").to_lowercase()
                );
                return Err(Error::OpticsMap { path: self.path.clone(), name, reason });
            }
        }
        self.with(decoder, self.maps(), |_| true)
    }

    /// For a comparison: as [`CalibratedOptics::instrument`], without the maps of views where they were made
    /// for another decoder.
    ///
    /// # Errors
    /// As [`CalibratedOptics::instrument`].
    pub fn instrument_for_comparison(&self, decoder: Decoder) -> Result<Instrument, Error> {
        match self.instrument(decoder) {
            Err(Error::OpticsMap { .. }) => {
                let sensor = DistortionMaps { sensor: self.maps().sensor, ..DistortionMaps::NONE };
                self.with(decoder, sensor, |view| view.is_none())
            }
            found => found,
        }
    }

    fn with(
        &self,
        decoder: Decoder,
        maps: DistortionMaps,
        used: impl Fn(Option<View>) -> bool,
    ) -> Result<Instrument, Error> {
        let quality = |m: &DistortionFile| MapQuality {
            view: m.view,
            grid: *m.e.grid(),
            sigma_px: m.sigma_px.clone(),
            measured: m.measured.clone(),
        };
        Ok(Instrument {
            model: OpticalModel::with_maps(&self.optics, maps)?,
            decoder,
            calibration: self.covariance.clone(),
            maps: self.maps.iter().flatten().filter(|m| used(m.view)).map(quality).collect(),
            volume: self.volume,
        })
    }
}

fn read_map(
    optics: &Path,
    name: &'static str,
    entry: &MapFile,
    view: Option<View>,
) -> Result<DistortionFile, Error> {
    let path = optics.parent().unwrap_or(Path::new("")).join(&entry.file);
    let wrong = |reason: String| Error::OpticsMap { path: optics.to_owned(), name, reason };
    let bytes = std::fs::read(&path).map_err(|source| Error::Read { path: path.clone(), source })?;
    let found = checksum(&bytes);
    if !found.eq_ignore_ascii_case(&entry.crc64) {
        return Err(wrong(format!(
            "{} has the checksum {found}, not {}: it has changed since, or is another map",
            path.display(),
            entry.crc64
        )));
    }
    let map = DistortionFile::load(&path)?;
    if map.view != view {
        let of = |view: Option<View>| match view {
            None => "the whole sensor",
            Some(View::Minus) => "the −1 view",
            Some(View::Plus) => "the +1 view",
        };
        return Err(wrong(format!("{} is a map of {}, not of {}", path.display(), of(map.view), of(view))));
    }
    Ok(map)
}

fn checksum(bytes: &[u8]) -> String {
    format!("{:016x}", CRC.checksum(bytes))
}

/// The entry of an optics file in `folder` for the map in the file `map`.
///
/// # Errors
/// If the map cannot be read.
pub fn map_entry(folder: &Path, map: &Path) -> Result<MapFile, Error> {
    let read = |path: &Path| {
        let source = |source| Error::Read { path: path.to_owned(), source };
        path.canonicalize().map_err(source)
    };
    let bytes = std::fs::read(map).map_err(|source| Error::Read { path: map.to_owned(), source })?;
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let file = relative(&read(folder)?, &read(map)?);
    Ok(MapFile { file: file.to_string_lossy().replace('\\', "/"), crc64: checksum(&bytes) })
}

/// Name of the entry of `[maps]` for a view; none is the whole sensor.
pub fn entry_name(view: Option<View>) -> &'static str {
    match view {
        None => "sensor",
        Some(View::Minus) => "minus",
        Some(View::Plus) => "plus",
    }
}

/// Whether a map that was made without the file's other maps can be named in it.
///
/// # Errors
/// The file, if it is not a readable optics file; [`Error::OpticsMap`] where it is a whole experiment or
/// another map would add up with this one.
pub fn can_name_map(optics: &Path, view: Option<View>) -> Result<(), Error> {
    let name = entry_name(view);
    let wrong = |name, reason: String| Error::OpticsMap { path: optics.to_owned(), name, reason };
    let maps = OpticsFile::load(optics)?.maps.unwrap_or_default();
    if document(optics, name)?.contains_key("rig") {
        let reason = "this is an experiment; maps are named in an optics file of its own".to_owned();
        return Err(wrong(name, reason));
    }
    let others: &[_] = match view {
        None => &[("minus", &maps.minus), ("plus", &maps.plus)],
        Some(_) => &[("sensor", &maps.sensor)],
    };
    match others.iter().find(|(_, map)| map.is_some()) {
        Some((other, _)) => Err(wrong(
            other,
            format!(
                "it would add up with the map for maps.{name}, which is counted without it: remove the entry first"
            ),
        )),
        None => Ok(()),
    }
}

/// Names a map in an optics file, in place of the one that was there; all else stays as it is, comments
/// included. The file is replaced in one step.
///
/// # Errors
/// As [`can_name_map`], and if the file cannot be written.
pub fn name_map(optics: &Path, view: Option<View>, entry: &MapFile) -> Result<(), Error> {
    can_name_map(optics, view)?;
    let name = entry_name(view);
    let mut document = document(optics, name)?;
    let maps = document.entry("maps").or_insert_with(|| {
        let mut table = toml_edit::Table::new();
        table.set_implicit(true);
        toml_edit::Item::Table(table)
    });
    let mut table = toml_edit::Table::new();
    table.insert("file", toml_edit::value(&entry.file));
    table.insert("crc64", toml_edit::value(&entry.crc64));
    if let Some(maps) = maps.as_table_like_mut() {
        maps.insert(name, toml_edit::Item::Table(table));
    }
    let text = document.to_string();
    OpticsFile::parse(&text, optics)?;
    Ok(atomic::write_bytes(optics, text.as_bytes())?)
}

fn document(path: &Path, name: &'static str) -> Result<toml_edit::DocumentMut, Error> {
    let text =
        std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    text.parse().map_err(|e: toml_edit::TomlError| Error::OpticsMap {
        path: path.to_owned(),
        name,
        reason: e.to_string(),
    })
}

/// The entries of a file in `from` for one in `to`: the same maps.
///
/// # Errors
/// If a map cannot be read.
pub fn moved_maps(maps: Option<&Maps>, from: &Path, to: &Path) -> Result<Option<Maps>, Error> {
    let Some(maps) = maps else { return Ok(None) };
    let moved = |entry: &Option<MapFile>| -> Result<Option<MapFile>, Error> {
        entry.as_ref().map(|m| map_entry(to, &from.join(&m.file))).transpose()
    };
    Ok(Some(Maps { sensor: moved(&maps.sensor)?, minus: moved(&maps.minus)?, plus: moved(&maps.plus)? }))
}

/// Path of `to` from the folder `from` on; both absolute.
fn relative(from: &Path, to: &Path) -> PathBuf {
    let (from, to): (Vec<Component<'_>>, Vec<_>) = (from.components().collect(), to.components().collect());
    let shared = from.iter().zip(&to).take_while(|(a, b)| a == b).count();
    // on another drive there is no relative path
    if shared == 0 {
        return to.iter().collect();
    }
    let up = from[shared..].iter().map(|_| Component::ParentDir);
    up.chain(to[shared..].iter().copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_paths_lead_from_folder_to_file() {
        let of = |a: &str, b: &str| relative(Path::new(a), Path::new(b));
        assert_eq!(of("/a/b", "/a/b/c.json"), Path::new("c.json"));
        assert_eq!(of("/a/b/d", "/a/c/e.json"), Path::new("../../c/e.json"));
        assert_eq!(of("/a", "/b.json"), Path::new("../b.json"));
    }
}
