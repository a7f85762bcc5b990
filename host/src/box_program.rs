//! Where programs for the box come from.

use crate::Error;
use daic_protocol::limits::MAX_PROGRAM_BYTES;
use daic_protocol::program::{self, Instruction};
use daic_rig::compile::compile;
use daic_rig::experiment::Experiment;
use daic_rig::link::Link;
use std::path::Path;

/// Reads a program: an experiment file (`.toml`, compiled for the box behind `link`), a list of
/// instructions (`.json`), or encoded instructions (any other name).
///
/// # Errors
/// The file cannot be read, or does not hold a program.
pub fn read(path: &Path, link: &mut Link) -> Result<Vec<Instruction>, Error> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("toml") => {
            let experiment = Experiment::load(path)?;
            let position = link.status().map_err(daic_rig::RigError::from)?.position;
            let compiled = compile(&experiment, link.hello(), position).map_err(daic_rig::RigError::from)?;
            Ok(compiled.instructions)
        }
        _ => read_instructions(path),
    }
}

/// The same without a box: no experiment files.
///
/// # Errors
/// The file cannot be read, or does not hold a program.
pub fn read_instructions(path: &Path) -> Result<Vec<Instruction>, Error> {
    let unreadable = |reason: String| Error::BoxProgram { path: path.to_owned(), reason };
    let bytes = std::fs::read(path).map_err(|e| unreadable(e.to_string()))?;
    if path.extension().is_some_and(|e| e == "json") {
        return serde_json::from_slice(&bytes).map_err(|e| unreadable(e.to_string()));
    }
    program::decode(&bytes)
        .map(|(offset, item)| item.map_err(|e| unreadable(format!("byte {offset}: {e}"))))
        .collect()
}

/// Encodes a program that the box is to hold.
///
/// # Errors
/// It is too long.
pub fn encode(instructions: &[Instruction]) -> Result<Vec<u8>, Error> {
    let bytes = program::encode(instructions).map_err(|_| {
        let length: usize = instructions.iter().map(|i| program::encode_instruction(i).len()).sum();
        let reason = format!("{length} bytes, a box holds {MAX_PROGRAM_BYTES}; use `daic rig stream`");
        Error::BoxProgram { path: "the program".into(), reason }
    })?;
    Ok(bytes.to_vec())
}
