//! Chapter 4: volumes from one shot, with and without the grating (figures 15–21).

mod page;
mod simulate;

pub use page::part;
pub use simulate::{BEAD_UM, Camera, Optics, View, Widths, fwhm};

use super::{Extent, ReproduceError};
use daic_lightfield::DiffractionModel;

/// Iterations of Richardson–Lucy, as in the thesis.
pub const ITERATIONS: usize = 8;
/// Wavelength, µm.
const WAVELENGTH_UM: f64 = 0.45;
const VIRTUAL: DiffractionModel = DiffractionModel::Virtual;
const PUPIL: DiffractionModel = DiffractionModel::Pupil;
/// The bead of figures 17, 19, 20, 21.
const BEAD: [f64; 3] = [0.0, 0.0, 20.0];
/// Seven beads, drawn once: random in the box, none touching another.
pub const SEVEN: [[f64; 3]; 7] = [
    [-78.0, -52.0, 9.0],
    [-25.0, 61.0, 14.0],
    [12.0, -18.0, 22.0],
    [66.0, 33.0, 29.0],
    [47.0, -74.0, 11.0],
    [-61.0, 24.0, 31.0],
    [3.0, 15.0, 7.5],
];

/// How the images of a case were made and reconstructed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Models {
    /// Of the images; none without a grating.
    pub data: Option<DiffractionModel>,
    /// Of the reconstruction.
    pub reconstruction: Option<DiffractionModel>,
}

/// A bead under one angle.
#[derive(Debug)]
pub struct Angle {
    /// Diffraction angle, degrees; 0 without a grating.
    pub degrees: f64,
    /// Models.
    pub models: Models,
    /// What was measured.
    pub widths: Widths,
}

/// A reconstructed box.
#[derive(Debug)]
pub struct Boxed {
    /// `plain`, `virtual`, `pupil`, or `pupil as virtual`.
    pub name: &'static str,
    /// Each bead.
    pub widths: Vec<Widths>,
    /// (planes, rows, columns).
    pub shape: [usize; 3],
    /// Voxels (z, lateral), µm.
    pub voxel_um: [f64; 2],
    /// First plane, µm.
    pub first_um: f64,
    /// The volume.
    pub volume: Vec<f32>,
}

/// A bead under one condition of figures 18, 19 or 21.
#[derive(Debug)]
pub struct Condition {
    /// The figure.
    pub figure: u32,
    /// The condition.
    pub name: &'static str,
    /// Depth of the bead, µm.
    pub z_um: f64,
    /// With the virtual point.
    pub virtual_point: Widths,
    /// With the exact phase.
    pub pupil: Widths,
}

/// Everything that chapter 4 gives.
#[derive(Debug)]
pub struct Results {
    /// The bead as the voxels of a reconstruction hold it.
    pub truth: Widths,
    /// Figures 16 and 17.
    pub angles: Vec<Angle>,
    /// Figure 16.
    pub seven: Vec<Boxed>,
    /// Figures 18, 19, 21.
    pub conditions: Vec<Condition>,
    /// Figure 20: iterations, distance to the truth, distance to the last iterate.
    pub convergence: Vec<[f64; 3]>,
    /// Figure 15: bead depth, name, widths.
    pub real: Vec<(f64, &'static str, Widths)>,
    /// Each point spread function: what, least share of light held, sampling error.
    pub psfs: Vec<(String, f64, f64)>,
}

/// Images of one kind of data: the bead at 20 µm, and what else is asked for.
struct Data {
    images: Vec<Vec<Vec<f32>>>,
}

impl Data {
    fn new(
        optics: &Optics,
        extent: Extent,
        scenes: &[Vec<[f64; 3]>],
        results: &mut Results,
    ) -> Result<Self, ReproduceError> {
        let depths: Vec<f64> = scenes.iter().flatten().map(|b| b[2]).collect();
        let view = View::fine(optics, extent, &depths)?;
        results.psfs.push((described(optics, "images"), view.energy, view.sampling_error));
        let images = scenes.iter().map(|s| view.images(s)).collect::<Result<_, _>>()?;
        Ok(Self { images })
    }
}

fn described(optics: &Optics, what: &str) -> String {
    let grating = optics.grating.map_or("no grating".to_owned(), |(pitch, model)| {
        format!("grating {pitch:.3} µm, {}", format!("{model:?}").to_lowercase())
    });
    format!("{what}, lenslets {} µm, {grating}, radius {}", optics.lenslets[0], optics.radius)
}

fn coarse(optics: &Optics, extent: Extent, results: &mut Results) -> Result<View, ReproduceError> {
    let view = View::coarse(optics, extent)?;
    results.psfs.push((described(optics, "reconstruction"), view.energy, view.sampling_error));
    Ok(view)
}

/// Runs chapter 4.
///
/// # Errors
/// What point spread functions, operators or reconstructions refuse.
pub fn run(extent: Extent, said: &dyn Fn(&str)) -> Result<Results, ReproduceError> {
    let nothing = Widths { fwhm_um: [f64::NAN; 3], peak_um: f64::NAN, axial: Vec::new() };
    let mut results = Results {
        truth: nothing,
        angles: Vec::new(),
        seven: Vec::new(),
        conditions: Vec::new(),
        convergence: Vec::new(),
        real: Vec::new(),
        psfs: Vec::new(),
    };
    let full = extent == Extent::Full;
    // radii are a compromise with time; the shares of light they hold are on the page
    let list: &[(f64, usize)] =
        if full { &[(0.0, 4), (30.0, 8), (15.0, 5), (45.0, 11)] } else { &[(0.0, 3), (30.0, 5)] };
    for &(degrees, radius) in list {
        said(&format!("{degrees}°"));
        let seven = full && (degrees == 0.0 || degrees == 30.0);
        let mut scenes = vec![vec![BEAD]];
        if seven {
            scenes.push(SEVEN.to_vec());
        }
        if full && degrees == 30.0 {
            scenes.extend([vec![[0.0, 0.0, 7.5]], vec![[0.0, 0.0, 30.0]]]);
        }
        if degrees == 0.0 {
            let optics = Optics { radius, ..Optics::PLAIN };
            let data = Data::new(&optics, extent, &scenes, &mut results)?;
            let view = coarse(&optics, extent, &mut results)?;
            results.truth = view.widths(&view.spheres(&vec![BEAD]), BEAD);
            let models = Models { data: None, reconstruction: None };
            angle(&view, &data, degrees, models, &mut results)?;
            if seven {
                boxed("plain", &view, &data, &mut results)?;
            }
            continue;
        }
        let pitch = WAVELENGTH_UM / degrees.to_radians().sin();
        let [of_virtual, of_pupil] = [VIRTUAL, PUPIL].map(|m| Optics::PLAIN.with(pitch, radius, m));
        let plain = Data::new(&of_virtual, extent, &scenes, &mut results)?;
        let exact = full.then(|| Data::new(&of_pupil, extent, &scenes, &mut results)).transpose()?;
        let view = coarse(&of_virtual, extent, &mut results)?;
        let of = |data, reconstruction| Models { data: Some(data), reconstruction: Some(reconstruction) };
        angle(&view, &plain, degrees, of(VIRTUAL, VIRTUAL), &mut results)?;
        if let Some(exact) = &exact {
            angle(&view, exact, degrees, of(PUPIL, VIRTUAL), &mut results)?;
            let other = coarse(&of_pupil, extent, &mut results)?;
            angle(&other, exact, degrees, of(PUPIL, PUPIL), &mut results)?;
            if seven {
                boxed("virtual", &view, &plain, &mut results)?;
                boxed("pupil", &other, exact, &mut results)?;
                boxed("pupil as virtual", &view, exact, &mut results)?;
                conditions([(&view, &plain), (&other, exact)], &mut results)?;
            }
        }
        if degrees == 30.0 {
            convergence(&view, &plain, extent, &mut results)?;
        }
    }
    results.angles.sort_by(|a, b| a.degrees.total_cmp(&b.degrees));
    if full {
        said("the set-up of §4.3");
        real_setup(extent, &mut results)?;
    }
    Ok(results)
}

fn angle(
    view: &View,
    data: &Data,
    degrees: f64,
    models: Models,
    results: &mut Results,
) -> Result<(), ReproduceError> {
    let volume = view.reconstruct(&Camera::GOOD.take(&data.images[0], 1), ITERATIONS)?;
    let widths = view.widths(&volume, BEAD);
    results.angles.push(Angle { degrees, models, widths });
    Ok(())
}

fn boxed(name: &'static str, view: &View, data: &Data, results: &mut Results) -> Result<(), ReproduceError> {
    let volume = view.reconstruct(&Camera::GOOD.take(&data.images[1], 2), ITERATIONS)?;
    results.seven.push(Boxed {
        name,
        widths: SEVEN.iter().map(|c| view.widths(&volume, *c)).collect(),
        shape: view.shape(),
        voxel_um: view.voxel_um(),
        first_um: view.first_um(),
        volume,
    });
    Ok(())
}

/// Figures 18, 19 and 21, each with the virtual point and with the exact phase.
fn conditions(both: [(&View, &Data); 2], results: &mut Results) -> Result<(), ReproduceError> {
    let noisy = |snr| Camera { snr: Some(snr), ..Camera::GOOD };
    let list = [
        (18, "z = 7.5 µm", 2, 7.5, Camera::GOOD),
        (18, "z = 20 µm", 0, 20.0, Camera::GOOD),
        (18, "z = 30 µm", 3, 30.0, Camera::GOOD),
        (19, "8 bits", 0, 20.0, Camera { bits: 8, snr: None }),
        (19, "16 bits", 0, 20.0, Camera::GOOD),
        (21, "SNR 1000", 0, 20.0, noisy(1000.0)),
        (21, "SNR 100", 0, 20.0, noisy(100.0)),
        (21, "SNR 20", 0, 20.0, noisy(20.0)),
    ];
    for (figure, name, scene, z_um, camera) in list {
        let measure = |(view, data): (&View, &Data)| -> Result<Widths, ReproduceError> {
            let volume = view.reconstruct(&camera.take(&data.images[scene], 3), ITERATIONS)?;
            Ok(view.widths(&volume, [0.0, 0.0, z_um]))
        };
        let (virtual_point, pupil) = (measure(both[0])?, measure(both[1])?);
        results.conditions.push(Condition { figure, name, z_um, virtual_point, pupil });
    }
    Ok(())
}

/// Figure 20.
fn convergence(
    view: &View,
    data: &Data,
    extent: Extent,
    results: &mut Results,
) -> Result<(), ReproduceError> {
    // at the scale of the truth
    let images = &data.images[0];
    let truth = view.spheres(&vec![BEAD]);
    let steps: &[usize] =
        if extent == Extent::Full { &[1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64] } else { &[1, 8, 16] };
    let iterates: Vec<Vec<f32>> =
        steps.iter().map(|&n| view.reconstruct(images, n)).collect::<Result<_, _>>()?;
    let distance = |a: &[f32], b: &[f32]| {
        let (d, n) = a.iter().zip(b).fold((0.0, 0.0), |(d, n), (a, b)| {
            (d + (f64::from(*a) - f64::from(*b)).powi(2), n + f64::from(*b).powi(2))
        });
        (d / n).sqrt()
    };
    let last = iterates.last().map_or(&truth, |l| l);
    for (n, g) in steps.iter().zip(&iterates) {
        results.convergence.push([*n as f64, distance(g, &truth), distance(g, last)]);
    }
    Ok(())
}

/// Figure 15: grating of 2 µm (13°), lenslets of 125 µm, an 8-bit camera.
fn real_setup(extent: Extent, results: &mut Results) -> Result<(), ReproduceError> {
    let with = |m| Optics::REAL.with(2.0, 6, m);
    let depths = [7.5, 20.0];
    let scenes = depths.map(|z| vec![[0.0, 0.0, z]]);
    let of_pupil = Data::new(&with(PUPIL), extent, &scenes, results)?;
    let of_virtual = Data::new(&with(VIRTUAL), extent, &scenes, results)?;
    let plain = Data::new(&Optics::REAL, extent, &scenes, results)?;
    let mut measure = |view: &View, data: &Data, name: &'static str| -> Result<(), ReproduceError> {
        for (z, images) in depths.into_iter().zip(&data.images) {
            let camera = Camera { bits: 8, snr: Some(50.0) };
            let volume = view.reconstruct(&camera.take(images, 4), ITERATIONS)?;
            results.real.push((z, name, view.widths(&volume, [0.0, 0.0, z])));
        }
        Ok(())
    };
    measure(&View::coarse(&Optics::REAL, extent)?, &plain, "no grating")?;
    let view = View::coarse(&with(VIRTUAL), extent)?;
    measure(&view, &of_virtual, "virtual")?;
    // light behaves as the exact phase says; the thesis reconstructs with the virtual point
    measure(&view, &of_pupil, "pupil as virtual")?;
    measure(&View::coarse(&with(PUPIL), extent)?, &of_pupil, "pupil")
}
