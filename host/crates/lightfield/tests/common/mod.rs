//! Shared data and comparisons.
#![allow(dead_code)] // each test binary uses its own part

use daic_lightfield::{
    Model, Normal, Operator, OperatorSettings, Oversampling, Psf, PsfParameters, PsfReport, Radius,
    Reduction, native_widths,
};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
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

/// A point spread function of given values and sizes.
pub fn psf_of(pixels: [usize; 2], voxels: [usize; 2], planes: usize, radius: usize, values: Vec<f32>) -> Psf {
    let planes_um = (0..planes).map(|z| z as f64).collect();
    let parameters = PsfParameters {
        pixels,
        voxels,
        radius: Radius::Cells(radius),
        oversampling: Oversampling::Samples(5),
        ..PsfParameters::thesis(planes_um)
    };
    let report = PsfReport {
        samples: 5,
        dx_um: 2.0,
        sampling_error: 0.0,
        quadrature_error: 0.0,
        plane_radius: vec![radius; planes],
        energy: vec![1.0; planes],
        evanescent: 0.0,
    };
    Psf::from_values(parameters, report, radius, values).unwrap()
}

/// Sizes of a random point spread function and the symmetry it is given.
#[derive(Debug, Clone, Copy)]
pub struct Case {
    pub pixels: [usize; 2],
    pub voxels: [usize; 2],
    pub planes: usize,
    pub radius: usize,
    pub cells: [usize; 2],
    pub margin: isize,
    pub symmetry: Reduction,
}

/// The smallest case worth the name; others differ from it.
pub const SMALL: Case = Case {
    pixels: [5, 5],
    voxels: [3, 3],
    planes: 2,
    radius: 1,
    cells: [4, 4],
    margin: 0,
    symmetry: Reduction::RealSquare,
};

pub fn random(rng: &mut ChaCha8Rng, n: usize) -> Vec<f32> {
    (0..n).map(|_| rng.random_range(0.0..1.0)).collect()
}

/// Random values with exactly the symmetry of a reduction.
pub fn symmetric(rng: &mut ChaCha8Rng, case: &Case) -> Psf {
    let side = 2 * case.radius + 1;
    let ([vy, vx], [py, px]) = (case.voxels, case.pixels);
    let count = case.planes * vy * vx * side * side * py * px;
    let noise = random(rng, count);
    let mut values = vec![0f32; count];
    let place = |z: usize, y: [usize; 3], x: [usize; 3]| {
        (((((z * vy + y[0]) * vx + x[0]) * side + y[1]) * side + x[1]) * py + y[2]) * px + x[2]
    };
    let flip = |v: [usize; 3], n: [usize; 3]| [n[0] - 1 - v[0], n[1] - 1 - v[1], n[2] - 1 - v[2]];
    let (ny, nx) = ([vy, side, py], [vx, side, px]);
    for z in 0..case.planes {
        for i in 0..vy * side * py {
            for j in 0..vx * side * px {
                let y = [i / (side * py), i / py % side, i % py];
                let x = [j / (side * px), j / px % side, j % px];
                let mut images = vec![(y, x)];
                let s = case.symmetry;
                if matches!(s, Reduction::ComplexMirrorY | Reduction::RealMirrors | Reduction::RealSquare) {
                    images.extend(images.clone().iter().map(|&(y, x)| (flip(y, ny), x)));
                }
                if matches!(s, Reduction::ComplexMirrorX | Reduction::RealMirrors | Reduction::RealSquare) {
                    images.extend(images.clone().iter().map(|&(y, x)| (y, flip(x, nx))));
                }
                if s == Reduction::RealSquare {
                    images.extend(images.clone().iter().map(|&(y, x)| (x, y)));
                }
                if s == Reduction::Real {
                    images.push((flip(y, ny), flip(x, nx)));
                }
                let mut places: Vec<usize> = images.iter().map(|&(y, x)| place(z, y, x)).collect();
                places.sort_unstable();
                values[place(z, y, x)] = noise[places[0]];
            }
        }
    }
    psf_of(case.pixels, case.voxels, case.planes, case.radius, values)
}

/// A model of a point spread function; with its normal matrix if `normal`.
pub fn model(psf: &Psf, settings: &OperatorSettings, orders: usize, normal: bool) -> Model {
    Model {
        operator: Operator::new(psf, settings).unwrap(),
        orders,
        normal: normal.then(|| Normal::new(psf, settings.cells, settings.storage, orders).unwrap()),
        voxel_um: [5.0, 2.5, 2.5],
        widths: native_widths(&psf.parameters),
    }
}

pub fn up(v: &[f32]) -> Vec<f64> {
    v.iter().map(|&v| f64::from(v)).collect()
}
