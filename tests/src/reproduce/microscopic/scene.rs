//! The microscope of chapter 3 in front of fluorescent particles.
//!
//! Each particle is a sphere that glows all through. Its centre is traced exactly through both
//! orders; its image is a Gaussian whose covariance is that of the glowing sphere in space (a fifth of
//! the squared radius along every direction) seen through the local derivatives of the exact
//! projection, plus diffraction, plus the disc of the defocused cone (a quarter of its squared
//! radius), plus the pixel (1/12 px²). Light adds up particle by particle: nothing is interpolated.

use super::super::ReproduceError;
use daic_correlate::Image;
use daic_hil_sim::config::CameraConfig;
use daic_hil_sim::hash::{mix, unit};
use daic_hil_sim::sensor::Sensor;
use daic_optics::microscope::{Geometry, Objective, RayMicroscope, Relay};
use daic_optics::{Grating, PairModel, View};
use nalgebra::{Matrix2, Vector3};
use rayon::prelude::*;

/// Size of the specimen's illuminated field (iris diaphragm), mm: the thesis' 320 × 340 µm.
pub const FIELD_MM: [f64; 2] = [0.320, 0.340];
/// Aperture on the specimen's side: that of objective 3, 0.4, through the relay of 0.9.
pub const APERTURE: f64 = 0.36;
/// Share of the well that the brightest pixels fill.
const FILL: f64 = 0.8;
/// Light of the mounting medium against a single particle's peak.
const BACKGROUND: f64 = 0.03;
/// Particles per mm².
const DENSITY: f64 = 45_000.0;
/// Diameters of the particles, mm.
const DIAMETERS_MM: [f64; 2] = [1e-3, 5e-3];
/// A Gaussian is cut off at this many standard deviations: 3·10⁻⁶ of its peak.
const REACH: f64 = 5.0;
/// Rows rendered by one thread at a time.
const BAND: usize = 24;

/// A fluorescent particle on the specimen.
#[derive(Clone, Copy, Debug)]
pub struct Particle {
    /// Its place on the specimen before any motion, mm.
    pub place: Vector3<f64>,
    /// Standard deviation of its glow along any direction, mm.
    sigma_mm: f64,
    /// Light: a sphere of twice the diameter has eight times it.
    light: f64,
}

/// The instrument and what it looks at.
pub struct Scene {
    /// The exact microscope.
    pub microscope: RayMicroscope,
    /// Columns and rows of the sensor.
    pub size: [usize; 2],
    particles: Vec<Particle>,
    focus_mm: f64,
    /// Electrons per unit of light.
    exposure: f64,
    seed: u64,
}

/// Chapter 3's geometry: 450 nm, grating of 2000 nm (13.00°), relay of two 20× objectives (9 mm over
/// 10 mm), 0.53 µm/px with pixels of 5.4 µm, not telecentric.
pub fn geometry(size: [usize; 2]) -> Geometry {
    let grating = Grating::square(2e-3);
    Geometry {
        relay: Relay { magnification: 0.9, index: 1.0, perspective_per_mm: -0.3 },
        grating_to_image_mm: 1.0,
        wavelength_mm: 450e-6,
        minus: grating,
        plus: grating,
        objective: Objective {
            magnification: 5.4e-3 / (0.53e-3 * 0.9),
            focus_mm: 1.08,
            perspective_per_mm: 0.08,
            pixel_mm: 5.4e-3,
            axis_px: size.map(|n| 0.5 * (n as f64 - 1.0)),
        },
    }
}

/// The camera of the comparison: 16 bit, full well of 25 000 e⁻ with photon noise, read noise of 10 e⁻.
fn camera(size: [usize; 2]) -> CameraConfig {
    CameraConfig {
        width: size[0],
        height: size[1],
        bits: 16,
        full_well_electrons: 25_000.0,
        electrons_per_dn: 0.4,
        offset_dn: 1000.0,
        read_noise_electrons: 10.0,
        photon_noise: true,
        ..CameraConfig::default()
    }
}

impl Scene {
    /// Particles of `seed` on the surface of height `surface` (mm, over x and y in mm) within
    /// ±`half_mm`, with the microscope focused at height `focus_mm`.
    ///
    /// # Errors
    /// If the microscope is impossible.
    pub fn new(
        seed: u64,
        half_mm: [f64; 2],
        focus_mm: f64,
        surface: impl Fn(f64, f64) -> f64,
    ) -> Result<Self, ReproduceError> {
        // both views, 0.97 mm/px apart, with some room
        let size = [half_mm[0], half_mm[1]].map(|h| (2.0 * h / 0.53e-3) as usize + 60);
        let size = [size[0] + 1020, size[1]];
        let count = (4.0 * half_mm[0] * half_mm[1] * DENSITY) as u64;
        let particles = (0..count)
            .map(|k| {
                let draw = |n: u64| unit(mix(mix(seed ^ 0x7061_7274_6963_6c65) ^ (4 * k + n)));
                let (x, y) = ((2.0 * draw(0) - 1.0) * half_mm[0], (2.0 * draw(1) - 1.0) * half_mm[1]);
                let radius = 0.5 * (DIAMETERS_MM[0] + (DIAMETERS_MM[1] - DIAMETERS_MM[0]) * draw(2));
                Particle {
                    place: Vector3::new(x, y, surface(x, y)),
                    sigma_mm: radius / 5f64.sqrt(),
                    light: radius.powi(3),
                }
            })
            .collect();
        let mut scene = Self {
            microscope: RayMicroscope::new(&geometry(size))?,
            size,
            particles,
            focus_mm,
            exposure: 1.0,
            seed,
        };
        let mut light = scene.light(&|p| p);
        let brightest = (light.len() as f64 * 0.999) as usize;
        let (_, bright, _) = light.select_nth_unstable_by(brightest, f32::total_cmp);
        scene.exposure = FILL * 25_000.0 / f64::from(*bright);
        Ok(scene)
    }

    /// Expected light at every pixel with the particles moved by `moved`.
    fn light(&self, moved: &(dyn Fn(Vector3<f64>) -> Vector3<f64> + Sync)) -> Vec<f32> {
        let [width, height] = self.size;
        let spots: Vec<Spot> = self
            .particles
            .par_iter()
            .flat_map_iter(|p| View::BOTH.into_iter().filter_map(|view| self.spot(view, p, moved(p.place))))
            .collect();
        let mut image = vec![0f32; width * height];
        image.par_chunks_mut(width * BAND).enumerate().for_each(|(band, rows)| {
            let (top, count) = ((band * BAND) as f64, rows.len() / width);
            let mut sums = vec![0f64; rows.len()];
            for s in &spots {
                s.add(&mut sums, width, top, count);
            }
            for (out, sum) in rows.iter_mut().zip(&sums) {
                *out = *sum as f32;
            }
        });
        image
    }

    /// Image of a particle that stands at `place`.
    fn spot(&self, view: View, p: &Particle, place: Vector3<f64>) -> Option<Spot> {
        let (centre, by) = self.microscope.project_point(view, place).ok()?;
        let pixel_mm = 0.53e-3;
        let diffraction = 0.21 * 450e-6 / APERTURE / pixel_mm;
        let cone = 0.5 * APERTURE * (place.z - self.focus_mm) / pixel_mm;
        let round = diffraction * diffraction + cone * cone + 1.0 / 12.0;
        let covariance = by * by.transpose() * p.sigma_mm.powi(2) + Matrix2::identity() * round;
        let inverse = covariance.try_inverse()?;
        let peak = p.light / (std::f64::consts::TAU * covariance.determinant().sqrt());
        let reach = [covariance[(0, 0)], covariance[(1, 1)]].map(|v| REACH * v.sqrt());
        Some(Spot { centre, inverse, peak, reach })
    }

    /// Frame number `frame` with the particles moved by `moved`.
    ///
    /// # Errors
    /// None on a sensor that has pixels.
    pub fn frame(
        &self,
        frame: u64,
        moved: &(dyn Fn(Vector3<f64>) -> Vector3<f64> + Sync),
    ) -> Result<(Image, Vec<u16>), ReproduceError> {
        let mut electrons = self.light(moved);
        let background = BACKGROUND * FILL * 25_000.0;
        for e in &mut electrons {
            *e = (f64::from(*e) * self.exposure + background) as f32;
        }
        let counts = Sensor::new(&camera(self.size), self.seed).read(frame, &electrons);
        Ok((Image::from_u16(self.size[0], self.size[1], &counts)?, counts))
    }
}

/// A Gaussian on the sensor.
struct Spot {
    centre: [f64; 2],
    inverse: Matrix2<f64>,
    peak: f64,
    reach: [f64; 2],
}

impl Spot {
    /// Adds it to `count` rows from row `top` on.
    fn add(&self, sums: &mut [f64], width: usize, top: f64, count: usize) {
        let [cx, cy] = self.centre;
        let from_y = (cy - self.reach[1] - top).ceil().max(0.0);
        let to_y = (cy + self.reach[1] - top).floor().min(count as f64 - 1.0);
        let from_x = (cx - self.reach[0]).ceil().max(0.0);
        let to_x = (cx + self.reach[0]).floor().min(width as f64 - 1.0);
        if from_y > to_y || from_x > to_x {
            return;
        }
        let (a, b, c) = (self.inverse[(0, 0)], self.inverse[(0, 1)], self.inverse[(1, 1)]);
        for j in from_y as usize..=to_y as usize {
            let dy = j as f64 + top - cy;
            let row = &mut sums[j * width..(j + 1) * width];
            for (i, sum) in row.iter_mut().enumerate().take(to_x as usize + 1).skip(from_x as usize) {
                let dx = i as f64 - cx;
                *sum += self.peak * (-0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy)).exp();
            }
        }
    }
}
