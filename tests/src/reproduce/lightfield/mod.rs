//! Chapter 4: volumes from one shot, with and without the grating (figures 15–21).

mod course;
mod figures;
mod page;
mod simulate;
mod summary;

pub use course::Course;
pub use page::part;
pub use simulate::{BEAD_UM, Beads, Camera, Data, Optics, View, Widths, fwhm};

use super::{Extent, ReproduceError};
use daic_lightfield::DiffractionModel;
use figures::{angle, boxed, conditions, convergence, real_setup, seven_true};
use simulate::light_within;
use std::path::Path;

/// Iterations of Richardson–Lucy, as in the thesis.
pub const ITERATIONS: usize = 8;
/// Distance from a bead's centre beyond which light is noise, µm: the beads' diameter.
pub const FAR_UM: f64 = BEAD_UM;
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
    /// Radius of the reconstruction's point spread function, lenslets.
    pub radius: usize,
    /// Models.
    pub models: Models,
    /// What was measured.
    pub widths: Widths,
}

/// A reconstructed box.
#[derive(Debug)]
pub struct Boxed {
    /// `true`, `plain`, `virtual`, `pupil`, or `pupil as virtual`.
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
    /// What the camera does to the volumes with `virtual` and `pupil`; none of figure 18, which has no other to
    /// compare with.
    pub disturbance: Option<[Disturbance; 2]>,
}

/// A volume beside that of the same images with 16 bits and without noise.
#[derive(Debug, Clone, Copy)]
pub struct Disturbance {
    /// ‖g − g₀‖/‖g₀‖.
    pub distance: f64,
    /// Largest value farther than [`FAR_UM`] from the bead's centre, relative to the largest of all.
    pub outside: f64,
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
    /// Figure 16: both views of the seven beads, exact phase, square.
    pub views: Vec<Vec<f32>>,
    /// Figures 18, 19, 21.
    pub conditions: Vec<Condition>,
    /// Figure 20.
    pub convergence: Vec<Convergence>,
    /// Figure 15: bead depth, name, widths.
    pub real: Vec<(f64, &'static str, Widths)>,
    /// Each point spread function: what, least share of light held, sampling error.
    pub psfs: Vec<(String, f64, f64)>,
    /// Light of a point by radius.
    pub light: Vec<Light>,
}

/// A volume after so many iterations; all numbers are relative.
#[derive(Debug, Clone, Copy)]
pub struct Convergence {
    /// Iterations.
    pub iterations: usize,
    /// Distance to the truth.
    pub truth: f64,
    /// Distance to the last iterate looked at.
    pub last: f64,
    /// Change by the last iteration.
    pub change: f64,
    /// Distance of the images of the volume before the last iteration to those given.
    pub residual: f64,
    /// Distance to the truth, and the residual, of images made by the reconstruction's own projector.
    pub crime: [f64; 2],
}

/// Light of a point on the axis.
#[derive(Debug, Clone, Copy)]
pub struct Light {
    /// Diffraction angle.
    pub degrees: f64,
    /// Depth, µm.
    pub z_um: f64,
    /// Model.
    pub model: DiffractionModel,
    /// Share within each of [`RADII`].
    pub held: [f64; RADII.len()],
}

/// Radii in lenslets of the point spread functions under an angle: light that the radius of the reconstruction
/// does not hold is in the images all the same, where time allows.
struct Case {
    degrees: f64,
    reconstruction: usize,
    images_virtual: usize,
    images_pupil: usize,
}

const fn case(degrees: f64, reconstruction: usize, images_virtual: usize, images_pupil: usize) -> Case {
    Case { degrees, reconstruction, images_virtual, images_pupil }
}

const FULL: [Case; 4] =
    [case(0.0, 4, 5, 5), case(30.0, 8, 9, 11), case(15.0, 5, 6, 6), case(45.0, 11, 12, 15)];
const QUICK: [Case; 2] = [case(0.0, 3, 3, 3), case(30.0, 5, 5, 5)];
/// Of a second reconstruction at 30°, which shows what the radius changes.
const WIDER: usize = 11;
/// Radii of the table of light.
pub const RADII: [usize; 7] = [2, 4, 6, 8, 11, 15, 20];
/// Point spread functions and tables in a full run.
const STAGES: usize = 22;

fn described(optics: &Optics, what: &str) -> String {
    let grating = optics.grating.map_or("no grating".to_owned(), |(pitch, model)| {
        format!("grating {pitch:.3} µm, {}", format!("{model:?}").to_lowercase())
    });
    format!("{what}, lenslets {} µm, {grating}, radius {}", optics.lenslets[0], optics.radius)
}

/// What all parts of a run share.
struct Run<'a> {
    extent: Extent,
    course: Course<'a>,
    results: Results,
}

impl Run<'_> {
    fn images(&mut self, optics: Optics, radius: usize, scenes: &[Beads]) -> Result<Data, ReproduceError> {
        let optics = Optics { radius, ..optics };
        let what = described(&optics, "images");
        let data = Data::new(&optics, self.extent, scenes, &what, &self.course)?;
        self.results.psfs.push((what, data.energy, data.sampling_error));
        Ok(data)
    }

    fn view(&mut self, optics: Optics) -> Result<View, ReproduceError> {
        let what = described(&optics, "reconstruction");
        let view = View::coarse(&optics, self.extent, &what, &self.course)?;
        self.results.psfs.push((what, view.energy, view.sampling_error));
        Ok(view)
    }

    fn case(&mut self, case: &Case) -> Result<(), ReproduceError> {
        let (degrees, radius, full) = (case.degrees, case.reconstruction, self.extent == Extent::Full);
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
            let data = self.images(optics, case.images_virtual, &scenes)?;
            let view = self.view(optics)?;
            self.results.truth = view.widths(&view.spheres(&vec![BEAD]), BEAD);
            let models = Models { data: None, reconstruction: None };
            angle(&view, &data, degrees, radius, models, &mut self.results)?;
            if seven {
                self.results.seven.push(seven_true(&view));
                boxed("plain", &view, &data, &mut self.results)?;
            }
            return Ok(());
        }
        let pitch = WAVELENGTH_UM / degrees.to_radians().sin();
        let [of_virtual, of_pupil] = [VIRTUAL, PUPIL].map(|m| Optics::PLAIN.with(pitch, radius, m));
        let of = |data, reconstruction| Models { data: Some(data), reconstruction: Some(reconstruction) };
        let plain = self.images(of_virtual, case.images_virtual, &scenes)?;
        let view = self.view(of_virtual)?;
        angle(&view, &plain, degrees, radius, of(VIRTUAL, VIRTUAL), &mut self.results)?;
        if degrees == 30.0 {
            convergence(&view, &plain, self.extent, &mut self.results)?;
        }
        if !full {
            return Ok(());
        }
        let exact = self.images(of_pupil, case.images_pupil, &scenes)?;
        angle(&view, &exact, degrees, radius, of(PUPIL, VIRTUAL), &mut self.results)?;
        let other = self.view(of_pupil)?;
        angle(&other, &exact, degrees, radius, of(PUPIL, PUPIL), &mut self.results)?;
        if seven {
            self.results.views = exact.images[1].clone();
            boxed("virtual", &view, &plain, &mut self.results)?;
            boxed("pupil", &other, &exact, &mut self.results)?;
            boxed("pupil as virtual", &view, &exact, &mut self.results)?;
            conditions([(&view, &plain), (&other, &exact)], &mut self.results)?;
            let wider = self.view(Optics { radius: WIDER, ..of_pupil })?;
            angle(&wider, &exact, degrees, WIDER, of(PUPIL, PUPIL), &mut self.results)?;
        }
        Ok(())
    }

    /// Light of a point on the axis by radius.
    fn light(&mut self) -> Result<(), ReproduceError> {
        let objective = daic_lightfield::PsfParameters::thesis(Vec::new()).objective;
        let most = RADII[RADII.len() - 1];
        let mut cases = Vec::new();
        for degrees in [15.0, 30.0, 45.0] {
            for z_um in [7.5, 20.0, 30.0, 40.0] {
                cases.extend([VIRTUAL, PUPIL].map(|model| (degrees, z_um, model)));
            }
        }
        let (_, shares) =
            self.course.stage("light by radius", &format!("{objective:?} {cases:?} {most}"), || {
                let mut shares = Vec::new();
                for &(degrees, z_um, model) in &cases {
                    let held = light_within(&objective, degrees, model, z_um, most)?;
                    shares.extend(held.iter().map(|h| *h as f32));
                }
                Ok((String::new(), shares))
            })?;
        for ((degrees, z_um, model), held) in cases.into_iter().zip(shares.chunks_exact(most + 1)) {
            let held = RADII.map(|r| f64::from(held[r]));
            self.results.light.push(Light { degrees, z_um, model, held });
        }
        Ok(())
    }
}

/// Runs chapter 4. Point spread functions and images are kept in `folder`, if there is one, so that a run that was
/// interrupted goes on.
///
/// # Errors
/// What point spread functions, operators or reconstructions refuse; files that cannot be written.
pub fn run(
    extent: Extent,
    folder: Option<&Path>,
    said: &(dyn Fn(&str) + Sync),
) -> Result<Results, ReproduceError> {
    let nothing =
        Widths { fwhm_um: [f64::NAN; 3], peak_um: f64::NAN, lateral: Vec::new(), axial: Vec::new() };
    let results = Results {
        truth: nothing,
        angles: Vec::new(),
        seven: Vec::new(),
        views: Vec::new(),
        conditions: Vec::new(),
        convergence: Vec::new(),
        real: Vec::new(),
        psfs: Vec::new(),
        light: Vec::new(),
    };
    let full = extent == Extent::Full;
    let cases: &[Case] = if full { &FULL } else { &QUICK };
    let stages = if full { STAGES } else { 2 * QUICK.len() };
    let mut run = Run { extent, course: Course::new(folder, stages, said), results };
    for case in cases {
        run.case(case)?;
    }
    run.results.angles.sort_by(|a, b| a.degrees.total_cmp(&b.degrees));
    if full {
        real_setup(&mut run)?;
        run.light()?;
    }
    Ok(run.results)
}
