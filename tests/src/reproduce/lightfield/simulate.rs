//! The microscope of chapter 4: images with finer sampling than reconstructions use.

use super::course::{Course, garbled, json};
use crate::reproduce::{Extent, ReproduceError};
use daic_lightfield::debye::{DebyeTable, pupil_field};
use daic_lightfield::{
    DiffractionModel, Frame, Grating, Lenslets, Method, Model, Objective, Operator, OperatorSettings, Order,
    Oversampling, Psf, PsfParameters, Radius, Reconstruction, Settings, State, native_widths, reconstruct,
};

/// Diameter of a bead, µm.
pub const BEAD_UM: f64 = 12.0;
/// Depths of the reconstructed box, µm: from 0, in focus, in steps of 2.5.
const STEP_UM: f64 = 2.5;
const FINE_STEP_UM: f64 = 2.0;

/// Which optics.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Optics {
    /// Pitch and focal length of the lenslets, µm.
    pub lenslets: [f64; 2],
    /// Grating pitch, if there is one, with the model of diffraction.
    pub grating: Option<(f64, DiffractionModel)>,
    /// Cells of the point spread function.
    pub radius: usize,
}

impl Optics {
    /// The thesis' simulated microscope without grating.
    pub const PLAIN: Self = Self { lenslets: [150.0, 3000.0], grating: None, radius: 4 };
    /// The set-up of §4.3 without grating.
    pub const REAL: Self = Self { lenslets: [125.0, 2500.0], grating: None, radius: 5 };

    /// With a grating.
    pub fn with(self, pitch_um: f64, radius: usize, model: DiffractionModel) -> Self {
        Self { grating: Some((pitch_um, model)), radius, ..self }
    }

    fn parameters(&self, extent: Extent, planes_um: Vec<f64>, fine: bool) -> PsfParameters {
        let samples = match (extent, fine) {
            (Extent::Full, true) => 5,
            (Extent::Full, false) => 4,
            (Extent::Quick, true) => 4,
            (Extent::Quick, false) => 3,
        };
        PsfParameters {
            lenslets: Lenslets::square(self.lenslets[0], self.lenslets[1]),
            grating: self.grating.map(|(pitch_um, model)| Grating { pitch_um, order: Order::Plus, model }),
            voxels: if fine { [5; 2] } else { [3; 2] },
            radius: Radius::Cells(self.radius),
            oversampling: Oversampling::Samples(samples),
            // the deepest virtual points at 45° are deeper than the sampling rule is made for; the error is told
            allow_under_sampling: true,
            ..PsfParameters::thesis(planes_um)
        }
    }
}

/// Centres (x, y, z) of beads, µm from the middle of the field.
pub type Beads = Vec<[f64; 3]>;

/// Images of several scenes.
pub struct Data {
    /// Of each scene, those of all orders.
    pub images: Vec<Vec<Vec<f32>>>,
    /// Least share of a plane's light that the point spread function holds.
    pub energy: f64,
    /// Change of the point spread function when sampled 1.8 times as finely.
    pub sampling_error: f64,
}

impl Data {
    /// Images with five voxels a lenslet, planes 2 µm apart near the beads, and finer fields.
    ///
    /// # Errors
    /// What point spread function or operator refuse.
    pub fn new(
        optics: &Optics,
        extent: Extent,
        scenes: &[Beads],
        what: &str,
        course: &Course<'_>,
    ) -> Result<Self, ReproduceError> {
        let near =
            |z: f64| scenes.iter().flatten().any(|b| (b[2] - z).abs() <= 0.5 * (BEAD_UM + FINE_STEP_UM));
        let planes = (0..=21).map(|z| f64::from(z) * FINE_STEP_UM).filter(|z| near(*z)).collect();
        let parameters = optics.parameters(extent, planes, true);
        let key = format!("{} {extent:?} {scenes:?}", json(&parameters)?);
        let (text, numbers) = course.stage(what, &key, || {
            let psf = course.compute(&parameters)?;
            let view = View::new(optics, extent, &psf, FINE_STEP_UM)?;
            let mut numbers = Vec::new();
            for scene in scenes {
                numbers.extend(view.images(scene)?.concat());
            }
            let text = serde_json::to_string(&(view.energy, view.sampling_error)).map_err(garbled)?;
            Ok((text, numbers))
        })?;
        let (energy, sampling_error) = serde_json::from_str(&text).map_err(garbled)?;
        let orders = if optics.grating.is_some() { 2 } else { 1 };
        let all: Vec<Vec<f32>> = numbers
            .chunks_exact((numbers.len() / scenes.len() / orders).max(1))
            .map(<[f32]>::to_vec)
            .collect();
        Ok(Self { images: all.chunks_exact(orders).map(<[_]>::to_vec).collect(), energy, sampling_error })
    }
}

/// Share of the light of a point at depth `z_um` in the lenslets up to 0, 1 … `most` around its own, before the
/// lenslets.
///
/// # Errors
/// Integrals that do not settle.
pub fn light_within(
    objective: &Objective,
    degrees: f64,
    model: DiffractionModel,
    z_um: f64,
    most: usize,
) -> Result<Vec<f64>, ReproduceError> {
    // the field's highest frequency, NA/λ, asks for 17 a lenslet of 7.5 µm in the object
    const SAMPLES: usize = 18;
    const CELL_UM: f64 = 7.5;
    let (sine, cosine) = degrees.to_radians().sin_cos();
    let count = (2 * most + 1) * SAMPLES;
    let step = CELL_UM / SAMPLES as f64;
    let xs: Vec<f64> = (0..count).map(|i| (i as f64 + 0.5 - 0.5 * count as f64) * step).collect();
    let field = match model {
        DiffractionModel::Pupil => pupil_field(objective, -sine * objective.index, z_um, &xs, &xs)?.0,
        DiffractionModel::Virtual => {
            let shift = z_um * sine / cosine;
            let far = (0.5 * count as f64 * step).hypot(0.5 * count as f64 * step + shift);
            let table = DebyeTable::new(objective, far, &[z_um / cosine.powi(3)])?;
            let at = |x: f64, y: f64| table.planes.first().map(|f| f.at((x + shift).hypot(y)));
            xs.iter().flat_map(|y| xs.iter().filter_map(|x| at(*x, *y)).collect::<Vec<_>>()).collect()
        }
    };
    let mut held = vec![0.0; most + 1];
    let area = (step * objective.magnification).powi(2);
    for (i, v) in field.iter().enumerate() {
        let (y, x) = (i / count / SAMPLES, i % count / SAMPLES);
        let far = y.abs_diff(most).max(x.abs_diff(most));
        held[far..].iter_mut().for_each(|h| *h += v.norm_sqr() * area);
    }
    Ok(held)
}

/// A projector with its geometry.
pub struct View {
    model: Model,
    planes: Vec<f64>,
    voxel_um: f64,
    /// Least share of a plane's light that the point spread function holds.
    pub energy: f64,
    /// Change of the point spread function when sampled 1.8 times as finely.
    pub sampling_error: f64,
}

/// A measured bead.
#[derive(Debug, Clone)]
pub struct Widths {
    /// FWHM along x, y and z, µm; NaN where the profile does not fall to half within the box.
    pub fwhm_um: [f64; 3],
    /// Where the profile along z is highest.
    pub peak_um: f64,
    /// Profile along x.
    pub lateral: Vec<(f64, f64)>,
    /// Profile along z.
    pub axial: Vec<(f64, f64)>,
}

impl View {
    /// For reconstructions: all planes of the box.
    ///
    /// # Errors
    /// What point spread function or operator refuse.
    pub fn coarse(
        optics: &Optics,
        extent: Extent,
        what: &str,
        course: &Course<'_>,
    ) -> Result<Self, ReproduceError> {
        let planes = match extent {
            Extent::Full => 0..17,
            Extent::Quick => 4..13,
        };
        let planes = planes.map(|z| f64::from(z) * STEP_UM).collect();
        let psf = course.psf(what, &optics.parameters(extent, planes, false))?;
        Self::new(optics, extent, &psf, STEP_UM)
    }

    fn new(optics: &Optics, extent: Extent, psf: &Psf, step_um: f64) -> Result<Self, ReproduceError> {
        let parameters = &psf.parameters;
        let [voxel_um, _] = parameters.voxel_um();
        let cells = match extent {
            // 35 · 7.5 µm cover the box of 256 µm
            Extent::Full => 35,
            Extent::Quick => 11,
        };
        let model = Model {
            operator: Operator::new(psf, &OperatorSettings::new([cells; 2]))?,
            orders: if optics.grating.is_some() { 2 } else { 1 },
            normal: None,
            voxel_um: [step_um, voxel_um, voxel_um],
            widths: native_widths(parameters),
        };
        let energy = psf.report.energy.iter().copied().fold(1.0, f64::min);
        let sampling_error = psf.report.sampling_error;
        Ok(Self { model, planes: parameters.planes_um.clone(), voxel_um, energy, sampling_error })
    }

    /// Size of voxels (z, lateral), µm.
    pub fn voxel_um(&self) -> [f64; 2] {
        [self.model.voxel_um[0], self.voxel_um]
    }

    /// (planes, rows, columns) of the volume.
    pub fn shape(&self) -> [usize; 3] {
        self.model.operator.volume_shape()
    }

    /// First plane, µm.
    pub fn first_um(&self) -> f64 {
        self.planes.first().copied().unwrap_or(0.0)
    }

    /// Spheres of light 1 per µm³, 4³ sub-points a voxel.
    pub fn spheres(&self, beads: &Beads) -> Vec<f32> {
        let [nz, ny, nx] = self.shape();
        let dz = self.model.voxel_um[0];
        let part = |i: usize| (i as f64 + 0.5) / 4.0 - 0.5;
        let mut out = vec![0f32; nz * ny * nx];
        for (i, out) in out.iter_mut().enumerate() {
            let (x, y, z) = (i % nx, i / nx % ny, i / (nx * ny));
            let at = [(x, nx), (y, ny)].map(|(i, n)| (i as f64 + 0.5 - 0.5 * n as f64) * self.voxel_um);
            let p = [at[0], at[1], self.planes[z]];
            let near = |c: &&[f64; 3]| (0..3).all(|k| (c[k] - p[k]).abs() < 0.5 * BEAD_UM + 3.0);
            let mut inside = 0;
            for c in beads.iter().filter(near) {
                for s in 0..64 {
                    let d = [
                        p[0] + part(s % 4) * self.voxel_um - c[0],
                        p[1] + part(s / 4 % 4) * self.voxel_um - c[1],
                        p[2] + part(s / 16) * dz - c[2],
                    ];
                    inside += usize::from(d.iter().map(|d| d * d).sum::<f64>() <= 0.25 * BEAD_UM * BEAD_UM);
                }
            }
            // light per volume, whatever the voxels' size
            *out = (f64::from(inside as u32) / 64.0 * self.voxel_um * self.voxel_um * dz) as f32;
        }
        out
    }

    /// Images of beads, of all orders.
    ///
    /// # Errors
    /// None that sizes which fit could give.
    pub fn images(&self, beads: &Beads) -> Result<Vec<Vec<f32>>, ReproduceError> {
        let volume = self.spheres(beads);
        let operator = &self.model.operator;
        let mut images = operator.project(&[&volume])?;
        if self.model.orders == 2 {
            let turned = mirror(&volume, self.shape()[2]);
            let image = operator.project(&[&turned])?.remove(0);
            images.push(mirror(&image, operator.image_shape()[1]));
        }
        Ok(images)
    }

    /// Richardson–Lucy from a uniform volume.
    ///
    /// # Errors
    /// Images that cannot be reconstructed.
    pub fn reconstruct(&self, images: &[Vec<f32>], iterations: usize) -> Result<Vec<f32>, ReproduceError> {
        Ok(self.go_on(images, None, iterations)?.state.volume)
    }

    /// Richardson–Lucy up to so many iterations, from a state or from a uniform volume.
    ///
    /// # Errors
    /// Images that cannot be reconstructed.
    pub fn go_on(
        &self,
        images: &[Vec<f32>],
        from: Option<State>,
        iterations: usize,
    ) -> Result<Reconstruction, ReproduceError> {
        let frame = Frame { images: images.iter().map(Vec::as_slice).collect(), ..Frame::default() };
        let settings = Settings { clip_negative: true, ..Settings::new(Method::Rl, iterations) };
        let from = from.map(|s| [s]);
        let start = from.as_ref().map(<[State; 1]>::as_slice);
        let (mut out, _) = reconstruct(&self.model, &[frame], &settings, start, &mut |_| true)?;
        Ok(out.remove(0))
    }

    /// Widths of a bead: profiles through the voxel nearest to its true centre.
    pub fn widths(&self, volume: &[f32], centre: [f64; 3]) -> Widths {
        let [nz, ny, nx] = self.shape();
        let place =
            |v: f64, n: usize| ((v / self.voxel_um + 0.5 * n as f64 - 0.5).round() as usize).min(n - 1);
        let at = |i: usize, n: usize| (i as f64 + 0.5 - 0.5 * n as f64) * self.voxel_um;
        let (x, y) = (place(centre[0], nx), place(centre[1], ny));
        let z = (((centre[2] - self.first_um()) / self.model.voxel_um[0]).round() as usize).min(nz - 1);
        let value = |z: usize, y: usize, x: usize| f64::from(volume[(z * ny + y) * nx + x]);
        let window = |c: usize, n: usize| c.saturating_sub(6)..(c + 7).min(n);
        let lateral = [
            window(x, nx).map(|i| (at(i, nx), value(z, y, i))).collect::<Vec<_>>(),
            window(y, ny).map(|i| (at(i, ny), value(z, i, x))).collect(),
        ];
        let axial: Vec<(f64, f64)> = (0..nz).map(|i| (self.planes[i], value(i, y, x))).collect();
        let peak_um = axial.iter().copied().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(f64::NAN, |p| p.0);
        let fwhm_um = [fwhm(&lateral[0]), fwhm(&lateral[1]), fwhm(&axial)];
        let [lateral, _] = lateral;
        Widths { fwhm_um, peak_um, lateral, axial }
    }
}

fn mirror(values: &[f32], width: usize) -> Vec<f32> {
    values.chunks_exact(width).flat_map(|r| r.iter().rev().copied().collect::<Vec<_>>()).collect()
}

/// Full width at half maximum of a profile's highest peak, linear between samples; NaN where it does not fall
/// to half on both sides.
pub fn fwhm(profile: &[(f64, f64)]) -> f64 {
    let Some(top) = (0..profile.len()).max_by(|&a, &b| profile[a].1.total_cmp(&profile[b].1)) else {
        return f64::NAN;
    };
    let half = 0.5 * profile[top].1;
    let cross = |a: (f64, f64), b: (f64, f64)| a.0 + (half - a.1) / (b.1 - a.1) * (b.0 - a.0);
    let right =
        (top + 1..profile.len()).find(|&i| profile[i].1 < half).map(|i| cross(profile[i - 1], profile[i]));
    let left = (0..top).rev().find(|&i| profile[i].1 < half).map(|i| cross(profile[i + 1], profile[i]));
    match (left, right) {
        (Some(l), Some(r)) => r - l,
        _ => f64::NAN,
    }
}

/// A camera.
#[derive(Debug, Clone, Copy)]
pub struct Camera {
    /// Bits.
    pub bits: u32,
    /// Largest value over the standard deviation of white noise, if there is noise.
    pub snr: Option<f64>,
}

impl Camera {
    /// 16 bits, no noise.
    pub const GOOD: Self = Self { bits: 16, snr: None };

    /// Scales images to 95 % of full scale, adds noise, rounds to whole numbers.
    pub fn take(&self, images: &[Vec<f32>], seed: u64) -> Vec<Vec<f32>> {
        let mut noise = Noise(seed);
        let largest = images.iter().flatten().copied().fold(f32::MIN_POSITIVE, f32::max);
        let top = f64::from((1u32 << self.bits) - 1);
        let full = 0.95 * top;
        let pixel = |v: f32, noise: &mut Noise| {
            let clean = f64::from(v) / f64::from(largest) * full;
            let noisy = self.snr.map_or(clean, |snr| clean + full / snr * noise.normal());
            noisy.round().clamp(0.0, top) as f32
        };
        images.iter().map(|image| image.iter().map(|v| pixel(*v, &mut noise)).collect()).collect()
    }
}

/// Nearly normal numbers (sums of twelve), the same in every run.
struct Noise(u64);

impl Noise {
    fn normal(&mut self) -> f64 {
        let mut sum = 0.0;
        for _ in 0..12 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            sum += (self.0 >> 11) as f64 / (1u64 << 53) as f64;
        }
        sum - 6.0
    }
}
