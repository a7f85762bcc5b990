//! Chapter 2: profiles of machined surfaces and of a face-like form, simulated and measured.

mod measure;
mod page;
mod rig;
mod specimens;
mod target;

pub use measure::Decoded;
pub use page::part;
pub use specimens::CONFINED_PX;

use super::statistics::{largest, rms};
use super::{Extent, ReproduceError};
use daic_correlate::Shape;
use daic_optics::{Decoder, OpticalModel, Optics, PixelPair, RigCalibration};
use measure::{Way, decode, matched};
use rig::Rig;
use specimens::Specimen;

/// Shape functions side by side.
pub const SHAPES: [Shape; 2] = [Shape::Affine, Shape::Quadratic];
/// Errors above this, µm, are those of a discontinuity: the thesis' RMS elsewhere.
const LARGE_UM: f64 = 10.0;
/// Radial distortion of the second lens: 0.1 % in the corner of the sensor.
const LENS_K1: f64 = -0.115;

/// How pairs are decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decoding {
    /// The thesis' formulas with the nominal set-up.
    Linear,
    /// The same with a map of each view taken through the grating.
    LinearMap,
    /// Exact rays, nominal set-up.
    Ray,
    /// The same with maps.
    RayMap,
    /// Exact rays through the set-up as our calibration found it.
    Calibrated,
}

impl Decoding {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Linear, Self::LinearMap, Self::Ray, Self::RayMap, Self::Calibrated];
}

/// One surface with one shape function.
#[derive(Debug)]
pub struct Case {
    /// Name of the specimen.
    pub name: &'static str,
    /// Its name in files.
    pub file: &'static str,
    /// Shape function.
    pub shape: Shape,
    /// Nodes of the grid, and points that the correlation accepted.
    pub points: [usize; 2],
    /// RMS of measured minus exact disparity u away from discontinuities, px: the correlation's own error.
    pub correlation_px: f64,
    /// RMS error of h away from discontinuities, µm, by [`Decoding::ALL`]: registered, as it stands.
    pub measured_um: [[f64; 2]; 5],
    /// The same from exact pairs: what the model and the maps alone leave.
    pub exact_um: [[f64; 2]; 5],
    /// Largest distance from the discontinuity at which the calibrated rays are off by more than 10 µm, px.
    pub spread_px: f64,
    /// Decoded by `Linear`, `LinearMap`, `Calibrated`; for the figures.
    surfaces: [Vec<Decoded>; 3],
}

impl Case {
    /// Registered RMS error of a decoding, µm.
    pub fn um(&self, decoding: Decoding) -> f64 {
        Decoding::ALL.iter().position(|d| *d == decoding).map_or(f64::NAN, |k| self.measured_um[k][0])
    }

    /// The same from exact pairs.
    pub fn exact(&self, decoding: Decoding) -> f64 {
        Decoding::ALL.iter().position(|d| *d == decoding).map_or(f64::NAN, |k| self.exact_um[k][0])
    }
}

/// A rig with everything that was measured on it.
#[derive(Debug)]
pub struct Bench {
    /// Distance of points, px.
    pub step: usize,
    /// What it really is.
    pub truth: Optics,
    /// What our calibration found.
    pub calibration: RigCalibration,
    /// Size of the maps (RMS and largest, px) for the thesis' formulas and for rays.
    pub maps_px: [(f64, f64); 2],
    /// (x₋, y₋, e_x, e_y), px, of the −1 view's map for the thesis' formulas.
    map: Vec<[f64; 4]>,
    /// The cases.
    pub cases: Vec<Case>,
}

impl Bench {
    /// A case by its file name.
    pub fn case(&self, file: &str, shape: Shape) -> Option<&Case> {
        self.cases.iter().find(|c| c.file == file && c.shape == shape)
    }
}

/// Everything that chapter 2 gives.
#[derive(Debug)]
pub struct Results {
    /// Without lens distortion.
    pub ideal: Bench,
    /// With a lens that distorts: the cylinder alone; not in a quick run.
    pub lens: Option<Bench>,
    /// A frame for the figures: size and grey values.
    face: Option<([usize; 2], Vec<u16>)>,
}

/// Runs chapter 2; `progress` is told what is done.
///
/// # Errors
/// What the correlation, a calibration or a ray refuses.
pub fn run(extent: Extent, progress: &dyn Fn(&str)) -> Result<Results, ReproduceError> {
    let folder =
        tempfile::tempdir().map_err(|source| ReproduceError::File { path: std::env::temp_dir(), source })?;
    let specimens = match extent {
        Extent::Full => vec![
            specimens::cylinder(),
            specimens::cone(),
            specimens::step(true),
            specimens::step(false),
            specimens::face(folder.path())?,
        ],
        Extent::Quick => vec![specimens::cylinder(), specimens::step(true)],
    };
    let (ideal, face) = bench(&Rig::new(extent, 0.0), extent, &specimens, progress)?;
    let lens = match extent {
        Extent::Full => Some(bench(&Rig::new(extent, LENS_K1), extent, &specimens[..1], progress)?.0),
        Extent::Quick => None,
    };
    Ok(Results { ideal, lens, face })
}

type Frame = ([usize; 2], Vec<u16>);

fn bench(
    rig: &Rig,
    extent: Extent,
    specimens: &[Specimen],
    progress: &dyn Fn(&str),
) -> Result<(Bench, Option<Frame>), ReproduceError> {
    progress("calibration of the rig");
    let calibration = target::calibrate(rig, extent)?;
    progress("maps through the grating");
    let nominal = rig.nominal();
    let maps = target::maps(rig, &nominal)?;
    let models = [
        OpticalModel::new(&nominal)?,
        OpticalModel::with_maps(&nominal, maps.carrier)?,
        OpticalModel::with_maps(&nominal, maps.ray)?,
        OpticalModel::new(&calibration.optics)?,
    ];
    let [plain, carrier, posed, calibrated] = &models;
    let ways = [
        Way { model: plain, decoder: Decoder::Linear },
        Way { model: carrier, decoder: Decoder::Linear },
        Way { model: plain, decoder: Decoder::Ray },
        Way { model: posed, decoder: Decoder::Ray },
        Way { model: calibrated, decoder: Decoder::Ray },
    ];
    let truth = OpticalModel::new(&rig.truth)?;
    let mut cases = Vec::new();
    let mut face = None;
    for (k, specimen) in specimens.iter().enumerate() {
        progress(specimen.name);
        let shot = rig.shoot(k as u64, rig.specimen(specimen.surface.clone()))?;
        for shape in SHAPES {
            cases.push(case(rig, &truth, &ways, specimen, &shot, shape)?);
        }
        face = Some(([rig::WIDTH, rig.rows], shot.grey));
    }
    let maps_px = [maps.size_px, maps.ray_size_px];
    Ok((Bench { step: rig.step, truth: rig.truth, calibration, maps_px, map: maps.minus, cases }, face))
}

fn case(
    rig: &Rig,
    truth: &OpticalModel,
    ways: &[Way<'_>; 5],
    specimen: &Specimen,
    shot: &rig::Shot,
    shape: Shape,
) -> Result<Case, ReproduceError> {
    let found = matched(rig, shot, shape)?;
    let smooth = |px, point| specimen.is_smooth(truth, px, point);
    let pairs: Vec<PixelPair> = found.points.iter().map(|m| m.pair).collect();
    let exact_pairs: Vec<PixelPair> = found
        .points
        .iter()
        .filter_map(|m| Some(PixelPair { minus_px: m.pair.minus_px, plus_px: m.exact_plus_px? }))
        .collect();
    let mut measured = Vec::new();
    let mut exact = Vec::new();
    for way in ways {
        measured.push(decode(way, &shot.scene, &pairs, &smooth)?);
        exact.push(decode(way, &shot.scene, &exact_pairs, &smooth)?);
    }
    let mut disparity_errors = Vec::new();
    for m in &found.points {
        let Some(q) = m.exact_plus_px else { continue };
        let p = truth.decode_point(Decoder::Ray, PixelPair { minus_px: m.pair.minus_px, plus_px: q })?;
        if smooth(m.pair.minus_px, p.into())? {
            disparity_errors.push(m.pair.plus_px[0] - q[0]);
        }
    }
    let correlation_px = rms(disparity_errors);
    let mut spread = Vec::new();
    for p in measured[4].points.iter().filter(|p| 1e3 * p.registered_mm.abs() > LARGE_UM) {
        spread.push(specimen.edge_distance_px(truth, p.minus_px, p.point_mm)?);
    }
    let of = |s: &[measure::Surface]| std::array::from_fn(|i| s[i].rms_um());
    let (measured_um, exact_um) = (of(&measured), of(&exact));
    let mut kept = measured.into_iter().map(|s| s.points);
    let mut next = |skip: usize| kept.nth(skip).unwrap_or_default();
    Ok(Case {
        name: specimen.name,
        file: specimen.file,
        shape,
        points: [found.grid, found.points.len()],
        correlation_px,
        measured_um,
        exact_um,
        spread_px: largest(spread),
        surfaces: [next(0), next(0), next(2)],
    })
}
