//! A flat glass slide with particles, moved by known amounts.

use super::super::statistics::rms;
use super::super::{ReproduceError, SUBSET};
use super::SEED;
use super::field::{Matched, Tracked};
use super::page::{Drawn, Picture};
use super::scene::Scene;
use daic_correlate::{Image, Shape};
use daic_optics::microscope::calibrate::{Calibration, FieldPoint, Motion, Settings, calibrate};
use daic_optics::microscope::{Form, Microscope, Parameters};
use daic_optics::{PairModel, PixelPair, View};
use nalgebra::{Matrix4, Rotation3, Vector3, Vector4};

/// A rigid motion about the middle of the field.
struct Move {
    name: &'static str,
    translation_mm: [f64; 3],
    rotation_deg: [f64; 3],
    /// Whether it is for the calibration.
    calibrates: bool,
}

const fn shift(name: &'static str, translation_mm: [f64; 3], calibrates: bool) -> Move {
    Move { name, translation_mm, rotation_deg: [0.0; 3], calibrates }
}

/// The calibration's own moves, then the two of Table 1, which it does not see.
const MOVES: [Move; 7] = [
    shift("+6 µm along z", [0.0, 0.0, 0.006], true),
    shift("−7 µm along z", [0.0, 0.0, -0.007], true),
    shift("+9 µm along x", [0.009, 0.0, 0.0], true),
    shift("−8 µm along y", [0.0, -0.008, 0.0], true),
    Move { name: "3° about x", translation_mm: [0.0; 3], rotation_deg: [3.0, 0.0, 0.0], calibrates: true },
    shift("translation of 10 µm", [0.0, 0.0, 0.010], false),
    Move { name: "tilt of 6°", translation_mm: [0.0; 3], rotation_deg: [0.0, 6.0, 0.0], calibrates: false },
];

impl Move {
    fn rotation(&self) -> Rotation3<f64> {
        let [a, b, c] = self.rotation_deg.map(f64::to_radians);
        Rotation3::from_euler_angles(a, b, c)
    }

    /// Displacement of the point p, mm.
    fn of(&self, p: Vector3<f64>) -> Vector3<f64> {
        self.rotation() * p - p + Vector3::from(self.translation_mm)
    }
}

/// How displacements were decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// Chapter 3's formulas, calibrated by other moves.
    Linear,
    /// The same with the perspective denominator, calibrated by other moves.
    Perspective,
    /// As `Perspective`, calibrated with the motion itself among the moves, as the thesis did.
    OwnFit,
    /// Exact rays through the true geometry.
    Rays,
}

/// Errors of one motion.
#[derive(Clone, Debug)]
pub struct MotionErrors {
    /// Its name.
    pub name: &'static str,
    /// Shape function of the correlation.
    pub shape: Shape,
    /// How it was decoded.
    pub way: Way,
    /// Points.
    pub points: usize,
    /// RMS of decoded minus imposed (u, v, w), µm.
    pub rms_um: [f64; 3],
    /// What photon and read noise alone make of it: RMS of the correlation's σ, decoded.
    pub noise_um: [f64; 3],
}

/// The slide and its frames.
pub struct Plate {
    scene: Scene,
    half_mm: [f64; 2],
    step: usize,
    reference: Image,
    counts: Vec<u16>,
    moved: Vec<Image>,
}

impl Plate {
    /// Takes all frames; points at every `step` pixels.
    pub fn new(half_mm: [f64; 2], step: usize) -> Result<Self, ReproduceError> {
        let scene = Scene::new(SEED, half_mm, 0.0, |_, _| 0.0)?;
        let (reference, counts) = scene.frame(0, &|p| p)?;
        let mut moved = Vec::new();
        for (k, by) in MOVES.iter().enumerate() {
            moved.push(scene.frame(k as u64 + 1, &|p| p + by.of(p))?.0);
        }
        Ok(Self { scene, half_mm, step, reference, counts, moved })
    }

    /// The parameters that the geometry has.
    pub fn truth(&self) -> Result<Parameters, ReproduceError> {
        Ok(self.scene.microscope.parameters()?.0)
    }

    /// The size of a pixel along y in that along x that the geometry has at the middle of the field.
    pub fn true_aspect(&self) -> Result<f64, ReproduceError> {
        let mut magnification = [0.0; 2];
        for view in View::BOTH {
            let (_, by) = self.scene.microscope.project_point(view, Vector3::zeros())?;
            magnification[0] += by[(0, 0)];
            magnification[1] += by[(1, 1)];
        }
        Ok(magnification[0] / magnification[1])
    }

    /// The reference frame as a picture.
    pub fn picture(&self) -> Picture {
        Picture {
            title: "Flat slide: −1 view (left), +1 view (right)",
            size: self.scene.size,
            grey: self.counts.clone(),
        }
    }

    /// Matches the views and follows all moves.
    pub fn measure(&self, shape: Shape) -> Result<Measured<'_>, ReproduceError> {
        let matched =
            Matched::new(&self.scene, self.reference.clone(), (shape, self.step), self.half_mm, [0.0; 2])?;
        let tracked: Vec<Vec<Tracked>> =
            self.moved.iter().map(|frame| matched.track(frame.clone())).collect::<Result<_, _>>()?;
        for (by, t) in MOVES.iter().zip(&tracked) {
            if t.len() < 100 {
                return Err(ReproduceError::Few { what: by.name.to_owned(), found: t.len(), needed: 100 });
            }
        }
        let pairs: Vec<_> = matched.pairs.iter().flatten().collect();
        let n = pairs.len() as f64;
        let mean = |f: &dyn Fn(usize) -> f64| pairs.iter().enumerate().map(|(k, _)| f(k)).sum::<f64>() / n;
        let disparity_px = [0, 1].map(|i| mean(&|k| pairs[k].plus_px[i] - pairs[k].minus_px[i]));
        let aspect = aspect(&tracked)?;
        Ok(Measured { plate: self, shape, tracked, disparity_px, aspect })
    }
}

/// Tracked fields of all moves.
pub struct Measured<'a> {
    plate: &'a Plate,
    shape: Shape,
    tracked: Vec<Vec<Tracked>>,
    /// Disparity of the slide, px: that of h = 0.
    pub disparity_px: [f64; 2],
    /// Size of a pixel along y in that along x.
    pub aspect: f64,
}

/// Size of a pixel along y in that along x on the specimen, from the moves in the plane.
///
/// (3.1) has one M_xy. But behind the grating the intermediate image stands at D/cos³θ along the grating
/// vector and at D/cos θ across it, and an objective that is not telecentric (κ per mm) magnifies the two
/// differently: by about κ D (1/cos³θ − 1/cos θ), here 0.4 %, 0.07 px in 17. So y is counted in pixels of x
/// before the six parameters are fitted.
fn aspect(tracked: &[Vec<Tracked>]) -> Result<f64, ReproduceError> {
    let mut size_mm = [f64::NAN; 2];
    for (by, tracked) in MOVES.iter().zip(tracked).filter(|(by, _)| by.calibrates) {
        let points = motion(by, tracked, 1.0).points;
        for (i, size) in size_mm.iter_mut().enumerate() {
            let [a, b] = [by.translation_mm[1 - i], by.translation_mm[2]];
            if by.translation_mm[i] != 0.0 && a == 0.0 && b == 0.0 {
                let sum: f64 = points.iter().map(|p| 0.5 * (p.moved_px[i] + p.moved_px[2 + i])).sum();
                *size = by.translation_mm[i] * points.len() as f64 / sum;
            }
        }
    }
    let aspect = size_mm[1] / size_mm[0];
    if aspect.is_finite() { Ok(aspect) } else { Err(ReproduceError::Open) }
}

/// A pair with y in pixels of x.
pub fn square(pair: PixelPair, aspect: f64) -> PixelPair {
    let of = |[x, y]: [f64; 2]| [x, y * aspect];
    PixelPair { minus_px: of(pair.minus_px), plus_px: of(pair.plus_px) }
}

fn motion(by: &Move, tracked: &[Tracked], aspect: f64) -> Motion {
    let points = tracked
        .iter()
        .map(|t| {
            let (a, b) = (square(t.before, aspect), square(t.after, aspect));
            let [s0, s1, s2, s3] = t.sigma_px;
            FieldPoint {
                middle_px: [0, 1].map(|i| 0.5 * (a.minus_px[i] + a.plus_px[i])),
                height_mm: 0.0,
                moved_px: [
                    b.minus_px[0] - a.minus_px[0],
                    b.minus_px[1] - a.minus_px[1],
                    b.plus_px[0] - a.plus_px[0],
                    b.plus_px[1] - a.plus_px[1],
                ],
                sigma_px: [s0, s1 * aspect, s2, s3 * aspect],
            }
        })
        .collect();
    if by.rotation_deg == [0.0; 3] {
        Motion::translation(by.name, by.translation_mm, points)
    } else {
        Motion::tilt(by.name, by.rotation_deg.map(f64::to_radians), points)
    }
}

impl Measured<'_> {
    /// Names of the calibration's moves.
    pub fn moves(&self) -> Vec<&'static str> {
        MOVES.iter().filter(|m| m.calibrates).map(|m| m.name).collect()
    }

    fn calibrate_with(&self, form: Form, own: Option<usize>) -> Result<Calibration, ReproduceError> {
        let motions: Vec<Motion> = MOVES
            .iter()
            .zip(&self.tracked)
            .enumerate()
            .filter(|(k, (by, _))| by.calibrates || own == Some(*k))
            .map(|(_, (by, tracked))| motion(by, tracked, self.aspect))
            .collect();
        let shared = (SUBSET as f64 / self.plate.step as f64).powi(2);
        Ok(calibrate(&motions, &Settings { form, shared, ..Settings::default() })?)
    }

    /// Calibrates by the calibration's own moves.
    pub fn calibrate(&self, form: Form) -> Result<Calibration, ReproduceError> {
        self.calibrate_with(form, None)
    }

    /// The calibrated microscope; for pairs with y in pixels of x.
    pub fn model(&self, calibration: &Calibration) -> Result<Microscope, ReproduceError> {
        let parameters = calibration.parameters.ok_or(ReproduceError::Open)?;
        let [x, y] = self.disparity_px;
        Ok(Microscope::new(parameters, calibration.form, [x, y * self.aspect])?)
    }

    /// Decoded displacement and its error, µm, at every point (x, y in µm) of move `k`.
    fn decoded(&self, k: usize, model: &dyn PairModel, aspect: f64) -> Result<Vec<Decoded>, ReproduceError> {
        let none = Matrix4::zeros();
        let mut out = Vec::with_capacity(self.tracked[k].len());
        for t in &self.tracked[k] {
            let place = self.plate.scene.microscope.decode_pair(t.before)?.point_mm;
            let noise = Matrix4::from_diagonal(&Vector4::from(t.sigma_px.map(|s| s * s)));
            let (before, after) = (square(t.before, aspect), square(t.after, aspect));
            let found = model.track(before, after, &none, &noise)?;
            let truth = MOVES[k].of(place);
            out.push(Decoded {
                place_um: [1e3 * place.x, 1e3 * place.y],
                found_um: (found.displacement_mm * 1e3).into(),
                sigma_um: [0, 1, 2].map(|i| 1e3 * found.covariance_mm2[(i, i)].sqrt()),
                truth_um: (truth * 1e3).into(),
            });
        }
        Ok(out)
    }

    /// Errors of the two motions of Table 1.
    pub fn errors(
        &self,
        linear: &Calibration,
        perspective: &Calibration,
    ) -> Result<Vec<MotionErrors>, ReproduceError> {
        let mut out = Vec::new();
        for (k, by) in MOVES.iter().enumerate().filter(|(_, m)| !m.calibrates) {
            let own = self.calibrate_with(Form::Perspective, Some(k))?;
            let models: [(Way, Box<dyn PairModel>, f64); 4] = [
                (Way::Linear, Box::new(self.model(linear)?), self.aspect),
                (Way::Perspective, Box::new(self.model(perspective)?), self.aspect),
                (Way::OwnFit, Box::new(self.model(&own)?), self.aspect),
                (Way::Rays, Box::new(self.plate.scene.microscope.clone()), 1.0),
            ];
            for (way, model, aspect) in models {
                let decoded = self.decoded(k, model.as_ref(), aspect)?;
                let rms_um = [0, 1, 2].map(|i| rms(decoded.iter().map(|d| d.found_um[i] - d.truth_um[i])));
                out.push(MotionErrors {
                    name: by.name,
                    shape: self.shape,
                    way,
                    points: decoded.len(),
                    rms_um,
                    noise_um: [0, 1, 2].map(|i| rms(decoded.iter().map(|d| d.sigma_um[i]))),
                });
            }
        }
        Ok(out)
    }

    /// What the figures show of the two motions.
    pub fn drawn(&self, perspective: &Calibration) -> Result<Drawn, ReproduceError> {
        let model = self.model(perspective)?;
        let mut drawn = Drawn::default();
        for (k, _) in MOVES.iter().enumerate().filter(|(_, m)| !m.calibrates) {
            drawn.motions.push(self.decoded(k, &model, self.aspect)?);
            let moved = motion(&MOVES[k], &self.tracked[k], 1.0).points;
            drawn.moved_px.push(moved.iter().map(|p| (p.middle_px, p.moved_px)).collect());
        }
        Ok(drawn)
    }
}

/// A decoded displacement, µm.
#[derive(Clone, Copy, Debug)]
pub struct Decoded {
    /// Where, x and y.
    pub place_um: [f64; 2],
    /// (u, v, w) found.
    pub found_um: [f64; 3],
    /// Their σ from the images' noise.
    pub sigma_um: [f64; 3],
    /// (u, v, w) imposed.
    pub truth_um: [f64; 3],
}
