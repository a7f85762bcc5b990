//! Arrays of numbers behind a header, with a checksum.
//!
//! Magic (8 bytes), length of the header (u64), header (JSON), then for each array its length (u64) and its
//! numbers (f32), then the CRC-32 of everything before; all little-endian.

use crate::error::Error;
use daic_dataset::atomic;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::Path;

/// Why a file of numbers could not be read.
#[derive(Debug)]
pub enum NumbersError {
    /// The system refused.
    Read(std::io::Error),
    /// It is not what it should be.
    Damaged(String),
}

fn checksum(bytes: &[u8]) -> u32 {
    crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(bytes)
}

/// Writes a file in one step.
///
/// # Errors
/// A file that cannot be written; nothing is left half-written.
pub fn write(path: &Path, magic: &[u8; 8], header: &impl Serialize, arrays: &[&[f32]]) -> Result<(), Error> {
    let json = serde_json::to_vec(header)
        .map_err(|e| Error::Unwritable { path: path.to_owned(), reason: e.to_string() })?;
    let numbers: usize = arrays.iter().map(|a| 4 * a.len() + 8).sum();
    let mut bytes = Vec::with_capacity(json.len() + numbers + 20);
    bytes.extend(magic);
    bytes.extend((json.len() as u64).to_le_bytes());
    bytes.extend(json);
    for array in arrays {
        bytes.extend((array.len() as u64).to_le_bytes());
        bytes.extend(array.iter().flat_map(|v| v.to_le_bytes()));
    }
    bytes.extend(checksum(&bytes).to_le_bytes());
    Ok(atomic::write_bytes(path, &bytes)?)
}

/// Reads a file.
///
/// # Errors
/// [`NumbersError`].
pub fn read<H: DeserializeOwned>(path: &Path, magic: &[u8; 8]) -> Result<(H, Vec<Vec<f32>>), NumbersError> {
    let bytes = std::fs::read(path).map_err(NumbersError::Read)?;
    let damaged = |reason: &str| NumbersError::Damaged(reason.to_owned());
    let (body, sum) = bytes.split_last_chunk::<4>().ok_or_else(|| damaged("it is empty"))?;
    let rest = body.strip_prefix(magic).ok_or_else(|| damaged("it is a file of another kind"))?;
    if checksum(body) != u32::from_le_bytes(*sum) {
        return Err(damaged("its checksum is wrong: it was cut off or changed"));
    }
    let ends = || damaged("it ends too early");
    let number = |rest: &[u8]| -> Option<usize> {
        usize::try_from(u64::from_le_bytes(*rest.first_chunk::<8>()?)).ok()
    };
    let (json, mut rest) = number(rest).and_then(|n| rest.get(8..)?.split_at_checked(n)).ok_or_else(ends)?;
    let header = serde_json::from_slice(json).map_err(|e| damaged(&format!("its header: {e}")))?;
    let mut arrays = Vec::new();
    while !rest.is_empty() {
        let (values, after) =
            number(rest).and_then(|n| rest.get(8..)?.split_at_checked(n.checked_mul(4)?)).ok_or_else(ends)?;
        arrays.push(values.chunks_exact(4).map(|c| f32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect());
        rest = after;
    }
    Ok((header, arrays))
}
