//! Point spread functions as files, used again when they fit.

use super::error::LightFieldError;
use super::numbers_file::{self, NumbersError};
use crate::error::Error;
use crate::progress::Progress;
use daic_lightfield::{Psf, PsfParameters, PsfReport};
use serde::{Deserialize, Serialize};
use std::path::Path;

const MAGIC: &[u8; 8] = b"DAICPSF1";

#[derive(Serialize, Deserialize)]
struct Header {
    parameters: PsfParameters,
    report: PsfReport,
    radius: usize,
    parameters_hash: String,
}

/// Hash of anything that has a form as JSON: its CRC-64, in hexadecimal.
pub fn hash(value: &impl Serialize) -> String {
    hash_bytes(serde_json::to_string(value).unwrap_or_default().as_bytes())
}

fn hash_bytes(bytes: &[u8]) -> String {
    format!("{:016x}", crc::Crc::<u64>::new(&crc::CRC_64_XZ).checksum(bytes))
}

/// CRC-64/XZ of what a file holds, as 16 hexadecimal digits.
///
/// # Errors
/// A file that cannot be read.
pub fn hash_file(path: &Path) -> Result<String, Error> {
    let bytes = std::fs::read(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    Ok(hash_bytes(&bytes))
}

/// Writes a point spread function.
///
/// # Errors
/// A file that cannot be written; nothing is left half-written.
pub fn write(path: &Path, psf: &Psf) -> Result<(), Error> {
    let header = Header {
        parameters: psf.parameters.clone(),
        report: psf.report.clone(),
        radius: psf.radius,
        parameters_hash: hash(&psf.parameters),
    };
    numbers_file::write(path, MAGIC, &header, &[&psf.values])
}

/// Reads a point spread function.
///
/// # Errors
/// [`LightFieldError::PsfFile`] for a file that is not one, or not whole.
pub fn read(path: &Path) -> Result<Psf, Error> {
    let damaged = |reason: String| LightFieldError::PsfFile { path: path.to_owned(), reason };
    let (header, mut arrays): (Header, _) = match numbers_file::read(path, MAGIC) {
        Ok(found) => found,
        Err(NumbersError::Read(source)) => return Err(Error::Read { path: path.to_owned(), source }),
        Err(NumbersError::Damaged(reason)) => return Err(damaged(reason).into()),
    };
    let values = arrays.pop().unwrap_or_default();
    Psf::from_values(header.parameters, header.report, header.radius, values)
        .map_err(|e| damaged(e.to_string()).into())
}

/// The stored point spread function if it belongs to these parameters, else a new one, which is stored.
/// Returns whether it was there.
///
/// # Errors
/// [`LightFieldError::PsfDiffers`] if the file holds another one and `force` is not given, a damaged file,
/// parameters that cannot be.
pub fn obtain(
    path: Option<&Path>,
    parameters: &PsfParameters,
    force: bool,
    progress: &dyn Progress,
) -> Result<(Psf, bool), Error> {
    if let Some(path) = path.filter(|p| p.exists() && !force) {
        let psf = read(path)?;
        return match difference(&psf.parameters, parameters) {
            None => Ok((psf, true)),
            Some(what) => Err(LightFieldError::PsfDiffers { path: path.to_owned(), what }.into()),
        };
    }
    progress.stage("point spread function", 0);
    let started = std::sync::Once::new();
    let psf = Psf::compute_with(parameters, &|done, all| {
        started.call_once(|| progress.stage("point spread function", all as u64));
        progress.advance(done as u64);
    })
    .map_err(LightFieldError::from)?;
    if let Some(path) = path {
        write(path, &psf)?;
    }
    Ok((psf, false))
}

/// The first part in which parameters differ.
fn difference(a: &PsfParameters, b: &PsfParameters) -> Option<&'static str> {
    let parts = [
        (a.objective == b.objective, "objective"),
        (a.lenslets == b.lenslets && a.pixels == b.pixels, "lenslets"),
        (a.grating == b.grating, "grating"),
        (a.planes_um == b.planes_um && a.voxels == b.voxels && a.depth == b.depth, "volume"),
        (a == b, "psf"),
    ];
    parts.into_iter().find(|(same, _)| !same).map(|(_, what)| what)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Silent;
    use daic_lightfield::{Oversampling, Radius};

    #[test]
    fn stored_functions_are_used_again_and_damage_is_told() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.psf");
        let parameters = PsfParameters {
            radius: Radius::Cells(0),
            guard: 1,
            pixels: [5; 2],
            voxels: [1; 2],
            oversampling: Oversampling::Samples(15),
            allow_under_sampling: true,
            ..PsfParameters::thesis(vec![0.0])
        };
        let (first, there) = obtain(Some(&path), &parameters, false, &Silent).unwrap();
        assert!(!there);
        let (again, there) = obtain(Some(&path), &parameters, false, &Silent).unwrap();
        assert!(there && again == first);
        let other = PsfParameters { planes_um: vec![1.0], ..parameters.clone() };
        let error = obtain(Some(&path), &other, false, &Silent).unwrap_err().to_string();
        assert!(error.contains("volume"), "{error}");
        let bytes = std::fs::read(&path).unwrap();
        for cut in [0, 5, 12, 40, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            let error = read(&path).unwrap_err().to_string();
            assert!(error.contains("damaged"), "{error}");
        }
    }
}
