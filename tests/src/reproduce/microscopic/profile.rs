//! The top of a steel ball of 0.68 mm in diameter.

use super::super::ReproduceError;
use super::super::statistics::{Registration, rms};
use super::SEED;
use super::field::Matched;
use super::page::Picture;
use super::rigid::{Measured, square};
use super::scene::Scene;
use daic_correlate::{Image, Shape};
use daic_optics::PairModel;
use daic_optics::microscope::calibrate::Calibration;

/// Radius of the ball, mm.
const RADIUS_MM: f64 = 0.34;
/// Height that is sharp, mm: near the top, as in the thesis.
const FOCUS_MM: f64 = -0.004;
/// Largest distance from the top that counts, mm: the half width of the field, where the ball's slope is 0.53.
const RIM_MM: f64 = 0.16;

fn height(x: f64, y: f64) -> f64 {
    let r2 = x * x + y * y;
    -r2 / ((RADIUS_MM * RADIUS_MM - r2).max(0.0).sqrt() + RADIUS_MM)
}

/// Errors between two distances from the top.
#[derive(Clone, Copy, Debug)]
pub struct Ring {
    /// Outer distance from the top, µm.
    pub to_um: f64,
    /// Radius of the defocus disc there, px.
    pub blur_px: f64,
    /// Points.
    pub points: usize,
    /// RMS of the height error, µm.
    pub rms_um: f64,
}

/// The ball as measured.
#[derive(Clone, Debug)]
pub struct Ball {
    /// Shape function of the correlation.
    pub shape: Shape,
    /// Points within the rim, and grid points there.
    pub points: usize,
    /// RMS of the height error over them, µm, registered by a rigid motion: by chapter 3's formulas,
    /// with the perspective denominator, by exact rays.
    pub rms_um: [f64; 3],
    /// The thesis' way: heights at the −1 coordinate, β₂ alone; registered.
    pub at_minus_um: f64,
    /// What photon and read noise alone make of h by the correlation's σ, µm (RMS).
    pub noise_um: f64,
    /// Errors over the distance from the top (perspective).
    pub rings: Vec<Ring>,
    /// (x, y, h, error) of every point, µm (perspective, registered).
    pub surface_um: Vec<[f64; 4]>,
}

/// The ball and its frame.
pub struct Specimen {
    scene: Scene,
    half_mm: [f64; 2],
    step: usize,
    frame: Image,
    counts: Vec<u16>,
}

impl Specimen {
    /// Takes the frame; points at every `step` pixels.
    pub fn new(half_mm: [f64; 2], step: usize) -> Result<Self, ReproduceError> {
        let scene = Scene::new(SEED + 1, half_mm, FOCUS_MM, height)?;
        let (frame, counts) = scene.frame(0, &|p| p)?;
        Ok(Self { scene, half_mm, step, frame, counts })
    }

    /// The frame as a picture.
    pub fn picture(&self) -> Picture {
        Picture {
            title: "Ball of 0.68 mm: −1 view (left), +1 view (right)",
            size: self.scene.size,
            grey: self.counts.clone(),
        }
    }

    /// Matches the views and decodes.
    pub fn measure(
        &self,
        shape: Shape,
        plate: &Measured<'_>,
        linear: &Calibration,
        perspective: &Calibration,
    ) -> Result<Ball, ReproduceError> {
        let low = height(self.half_mm[0], self.half_mm[1]);
        let matched =
            Matched::new(&self.scene, self.frame.clone(), (shape, self.step), self.half_mm, [low, 0.0])?;
        let pairs: Vec<_> = matched.pairs.iter().flatten().copied().collect();
        let rim = RIM_MM.min(self.half_mm[0]);
        let registered = |points: Vec<[f64; 3]>| {
            let inside: Vec<[f64; 3]> = points.into_iter().filter(|p| p[0].hypot(p[1]) <= rim).collect();
            let found = Registration::of(&inside, &height);
            let error = |p: &[f64; 3]| {
                let [x, y, h] = found.of_point(*p);
                [x, y, h, h - height(x, y)]
            };
            inside.iter().map(error).collect::<Vec<_>>()
        };
        let decode = |model: &dyn PairModel, aspect: f64| -> Result<Vec<[f64; 4]>, ReproduceError> {
            let points = pairs.iter().map(|p| Ok(model.decode_pair(square(*p, aspect))?.point_mm.into()));
            Ok(registered(points.collect::<Result<_, ReproduceError>>()?))
        };
        let (l, p) = (plate.model(linear)?, plate.model(perspective)?);
        let aspect = plate.aspect;
        let all = [decode(&l, aspect)?, decode(&p, aspect)?, decode(&self.scene.microscope, 1.0)?];
        let of = |points: &[[f64; 4]]| 1e3 * rms(points.iter().map(|p| p[3]));
        let beta = l.parameters();
        let centre = super::field::centre(&self.scene, daic_optics::View::Minus)?;
        let at_minus = pairs.iter().map(|p| {
            let h = -0.5 * beta.beta1_mm_per_px * (p.plus_px[0] - p.minus_px[0] - plate.disparity_px[0]);
            let [x, y] = [0, 1].map(|i| beta.beta2_mm_per_px * (p.minus_px[i] - centre[i]));
            let y = y * aspect;
            [x, y, h]
        });
        let at_minus_um = of(&registered(at_minus.collect()));
        let best = &all[1];
        if best.len() < 100 {
            return Err(ReproduceError::Few { what: "ball".to_owned(), found: best.len(), needed: 100 });
        }
        let edges = [0.0, 0.25, 0.5, 0.75, 1.0].map(|share| share * rim);
        let rings = edges
            .windows(2)
            .map(|e| {
                let inside = |p: &&[f64; 4]| (e[0]..e[1]).contains(&p[0].hypot(p[1]));
                let ring: Vec<[f64; 4]> = best.iter().filter(inside).copied().collect();
                let blur = super::scene::APERTURE * (height(e[1], 0.0) - FOCUS_MM).abs();
                Ring { to_um: 1e3 * e[1], blur_px: blur / 0.53e-3, points: ring.len(), rms_um: of(&ring) }
            })
            .collect();
        Ok(Ball {
            shape,
            points: best.len(),
            rms_um: [of(&all[0]), of(best), of(&all[2])],
            at_minus_um,
            noise_um: 1e3 * 0.5 * beta.beta1_mm_per_px * rms(matched.sigma_px.iter().flatten().copied()),
            rings,
            surface_um: best.iter().map(|p| p.map(|v| 1e3 * v)).collect(),
        })
    }
}
