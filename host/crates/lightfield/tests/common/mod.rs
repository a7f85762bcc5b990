//! Shared data and comparisons.
#![allow(dead_code)] // each test binary uses its own part

use std::path::PathBuf;

/// Folder of shared data, or a loud remark that a test does not run.
pub fn shared(test: &str, sub: &str) -> Option<PathBuf> {
    let root = std::env::var_os("DAIC_SHARED")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../../shared"), PathBuf::from);
    let path = root.join(sub);
    if path.exists() {
        return Some(path);
    }
    eprintln!("SKIPPED {test}: {sub} is not among the shared data");
    None
}

/// Elements of a NumPy array in C order: what follows its header, which must name the type.
fn npy<const N: usize>(path: &std::path::Path, kind: &str) -> Vec<[u8; N]> {
    let bytes = std::fs::read(path).unwrap();
    assert_eq!(&bytes[..7], b"\x93NUMPY\x01", "{}", path.display());
    let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let text = String::from_utf8_lossy(&bytes[10..header]);
    assert!(text.contains(kind) && text.contains("'fortran_order': False"), "{}: {text}", path.display());
    bytes[header..].chunks_exact(N).map(|c| c.try_into().unwrap()).collect()
}

/// An array of 32-bit numbers.
pub fn f32s(path: PathBuf) -> Vec<f32> {
    npy(&path, "'<f4'").into_iter().map(f32::from_le_bytes).collect()
}

/// An array of 64-bit numbers; complex ones give two each.
pub fn f64s(path: PathBuf) -> Vec<f64> {
    let kind = if path.to_string_lossy().contains("c128") { "'<c16'" } else { "'<f8'" };
    npy(&path, kind).into_iter().map(f64::from_le_bytes).collect()
}

/// An array of 16-bit counts.
pub fn u16s(path: PathBuf) -> Vec<u16> {
    npy(&path, "'<u2'").into_iter().map(u16::from_le_bytes).collect()
}

/// ‖a − b‖/‖b‖.
pub fn relative(a: impl IntoIterator<Item = f64>, b: impl IntoIterator<Item = f64>) -> f64 {
    let (mut d, mut n) = (0.0, 0.0);
    let (mut a, mut b) = (a.into_iter(), b.into_iter());
    loop {
        match (a.next(), b.next()) {
            (Some(a), Some(b)) => {
                d += (a - b) * (a - b);
                n += b * b;
            }
            (None, None) => return (d / n).sqrt(),
            _ => panic!("lengths differ"),
        }
    }
}
