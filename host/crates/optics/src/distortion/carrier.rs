//! The ideal target's image: a homography, fitted together with Brown's terms where asked for.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{DistortionError, Ideal, TargetPose};
use crate::camera::{Brown, Camera, CameraModel};
use crate::model::OpticalModel;
use crate::real::{Dual, solve2};
use crate::setup::View;

/// Two coordinates, or one value of each grating direction.
type Pair = [f64; 2];

/// Where a point of the plane is seen: pixels of the ideal camera, or millimetres on the reference
/// plane and the exact rays through the grating.
pub(super) struct Prediction {
    /// Without its Brown terms.
    camera: Camera,
    rays: Option<(OpticalModel, View)>,
}

/// A predicted pixel with its derivatives.
struct Predicted {
    pixel: [f64; 2],
    by_plane: [[f64; 2]; 2],
    by_brown: [[f64; 5]; 2],
}

impl Prediction {
    pub(super) fn new(ideal: &Ideal) -> Result<Self, DistortionError> {
        let straight = |c: &Camera| Camera { brown: Brown::default(), ..*c };
        Ok(match ideal {
            Ideal::Camera(camera) => {
                let finite = camera.principal_point_px.iter().all(|v| v.is_finite());
                if !(camera.focal_px > 0.0 && camera.focal_px.is_finite() && finite) {
                    return Err(DistortionError::Camera { focal_px: camera.focal_px });
                }
                Self { camera: straight(camera), rays: None }
            }
            Ideal::Grating { optics, view } => {
                let camera = straight(&optics.camera);
                let model = OpticalModel::new(&crate::setup::Optics { camera, ..*optics })?;
                Self { camera, rays: Some((model, *view)) }
            }
        })
    }

    /// Coordinates on the plane that the observed pixel sees.
    pub(super) fn plane(&self, observed: [f64; 2], brown: &Brown) -> Option<[f64; 2]> {
        let pixel = Camera { brown: *brown, ..self.camera }.undistort_px(observed).ok()?;
        match &self.rays {
            None => Some(pixel),
            Some((model, view)) => {
                let p = model.point_at_height(*view, pixel, 0.0).ok()?;
                Some([p.x, p.y])
            }
        }
    }

    /// Pixel that sees the place on the plane.
    fn pixel(&self, plane: [f64; 2], brown: &Brown) -> Option<Predicted> {
        let (straight, by_plane) = match &self.rays {
            None => (plane, [[1.0, 0.0], [0.0, 1.0]]),
            Some((model, view)) => {
                let point = Vector3::new(plane[0], plane[1], 0.0);
                let (pixel, d) = model.project_with_jacobian(*view, point).ok()?;
                (pixel, [[d[(0, 0)], d[(0, 1)]], [d[(1, 0)], d[(1, 1)]]])
            }
        };
        let [cx, cy] = self.camera.principal_point_px;
        let f = self.camera.focal_px;
        let b = [brown.k1, brown.k2, brown.k3, brown.p1, brown.p2];
        let coefficients = std::array::from_fn(|k| Dual::<7>::variable(b[k], 2 + k));
        let constant = |v| Dual { value: v, gradient: [0.0; 7] };
        let lens = CameraModel::of(constant(f), [constant(cx), constant(cy)], coefficients);
        let q =
            [Dual::<7>::variable((straight[0] - cx) / f, 0), Dual::<7>::variable((straight[1] - cy) / f, 1)];
        let seen = lens.pixel(q);
        let d = seen.map(|s| [s.gradient[0] / f, s.gradient[1] / f]);
        let chain = |row: [f64; 2]| [0, 1].map(|j| row[0] * by_plane[0][j] + row[1] * by_plane[1][j]);
        let pixel = seen.map(|s| s.value);
        pixel.iter().all(|v| v.is_finite()).then(|| Predicted {
            pixel,
            by_plane: d.map(chain),
            by_brown: seen.map(|s| std::array::from_fn(|k| s.gradient[2 + k])),
        })
    }
}

/// A pixel with both of the target's coordinates.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    pub(super) pixel: [f64; 2],
    /// Phases, turns.
    pub(super) turns: [f64; 2],
    /// Their standard deviations, turns.
    pub(super) sigma: [f64; 2],
}

/// φ = (n·q) / (1 + d·q) for both directions, in scaled coordinates.
#[derive(Clone, Debug)]
pub(super) struct Carrier {
    centre: [f64; 2],
    scale: f64,
    turns_centre: [f64; 2],
    turns_scale: [f64; 2],
    /// Numerators, three each, then denominators.
    h: Vec<f64>,
}

/// e at a sample, and its derivatives.
pub(super) struct Distortion {
    pub(super) e: [f64; 2],
    /// Change of e_i per standard deviation of phase k.
    pub(super) by_noise: [[f64; 2]; 2],
    by_carrier: [[f64; 10]; 2],
    by_brown: [[f64; 5]; 2],
}

impl Distortion {
    /// Derivatives of (e_x, e_y) by the first `carrier` terms of the carrier, then by those of Brown's terms
    /// that are `free`.
    pub(super) fn terms(&self, carrier: usize, free: &[usize]) -> [DVector<f64>; 2] {
        [0, 1].map(|i| {
            let brown = free.iter().map(|k| self.by_brown[i][*k]);
            let all = self.by_carrier[i][..carrier].iter().copied().chain(brown);
            DVector::from_iterator(carrier + free.len(), all)
        })
    }
}

impl Carrier {
    /// Number of its terms.
    pub(super) fn terms(&self) -> usize {
        self.h.len()
    }

    /// The planes through both phases.
    pub(super) fn start(
        samples: &[Sample],
        prediction: &Prediction,
        brown: &Brown,
        pose: TargetPose,
    ) -> Result<Self, DistortionError> {
        let seen: Vec<(Pair, Pair)> =
            samples.iter().filter_map(|s| Some((prediction.plane(s.pixel, brown)?, s.turns))).collect();
        let undetermined = DistortionError::TooFew { found: seen.len(), needed: super::LEAST_SAMPLES };
        if seen.len() < super::LEAST_SAMPLES {
            return Err(undetermined);
        }
        let n = seen.len() as f64;
        let mean = |f: &dyn Fn(&(Pair, Pair)) -> f64| seen.iter().map(f).sum::<f64>() / n;
        let centre = [0, 1].map(|i| mean(&|s| s.0[i]));
        let turns_centre = [0, 1].map(|i| mean(&|s| s.1[i]));
        let scale = mean(&|s| (s.0[0] - centre[0]).hypot(s.0[1] - centre[1]));
        let product =
            |i: usize, j: usize| mean(&|s| (s.0[i] - centre[i]) * (s.0[j] - centre[j]) / (scale * scale));
        let m = [[product(0, 0), product(0, 1)], [product(0, 1), product(1, 1)]];
        let mut turns_scale = [1.0; 2];
        let terms = match pose {
            TargetPose::Square => 6,
            TargetPose::Common => 8,
            TargetPose::Separate => 10,
        };
        let mut h = vec![0.0; terms];
        for k in 0..2 {
            let r = [0, 1].map(|i| mean(&|s| (s.0[i] - centre[i]) / scale * (s.1[k] - turns_centre[k])));
            let slope = solve2(m, r).ok_or_else(|| undetermined.clone())?;
            let size = slope[0].hypot(slope[1]);
            if !(size > 0.0 && size.is_finite()) {
                return Err(undetermined);
            }
            turns_scale[k] = size;
            h[3 * k] = slope[0] / size;
            h[3 * k + 1] = slope[1] / size;
        }
        Ok(Self { centre, scale, turns_centre, turns_scale, h })
    }

    /// Places of the two denominators; none without tilt.
    fn denominators(&self) -> Option<[usize; 2]> {
        match self.h.len() {
            6 => None,
            8 => Some([6, 6]),
            _ => Some([6, 8]),
        }
    }

    /// Coefficients of x and y in the denominator of phase k.
    fn denominator(&self, k: usize) -> [f64; 2] {
        self.denominators().map_or([0.0; 2], |den| [self.h[den[k]], self.h[den[k] + 1]])
    }

    /// Coordinates on the plane from both phases; A⁻¹ for scaled coordinates.
    fn plane(&self, turns: [f64; 2]) -> Option<(Pair, Pair, [Pair; 2])> {
        let t = [0, 1].map(|k| (turns[k] - self.turns_centre[k]) / self.turns_scale[k]);
        let a = [0, 1].map(|k| {
            let den = self.denominator(k);
            [self.h[3 * k] - t[k] * den[0], self.h[3 * k + 1] - t[k] * den[1]]
        });
        let q = solve2(a, [0, 1].map(|k| t[k] - self.h[3 * k + 2]))?;
        let first = solve2(a, [1.0, 0.0])?;
        let second = solve2(a, [0.0, 1.0])?;
        Some((q, t, [[first[0], second[0]], [first[1], second[1]]]))
    }

    /// Phases of a place on the plane, turns.
    pub(super) fn turns(&self, plane: [f64; 2]) -> [f64; 2] {
        let [x, y] = [0, 1].map(|i| (plane[i] - self.centre[i]) / self.scale);
        [0, 1].map(|k| {
            let den = self.denominator(k);
            let n = self.h[3 * k] * x + self.h[3 * k + 1] * y + self.h[3 * k + 2];
            let d = 1.0 + den[0] * x + den[1] * y;
            self.turns_centre[k] + self.turns_scale[k] * n / d
        })
    }

    /// e = observed − predicted.
    pub(super) fn distortion(
        &self,
        s: &Sample,
        prediction: &Prediction,
        brown: &Brown,
    ) -> Option<Distortion> {
        let (q, t, inverse) = self.plane(s.turns)?;
        let plane = [0, 1].map(|i| self.centre[i] + self.scale * q[i]);
        let seen = prediction.pixel(plane, brown)?;
        // ∂e/∂φ̂ but for the sign; the carrier's own terms are multiples of it.
        let m = [0, 1].map(|i| {
            [0, 1].map(|k| {
                self.scale * (seen.by_plane[i][0] * inverse[0][k] + seen.by_plane[i][1] * inverse[1][k])
            })
        });
        let den = self.denominators();
        let mut by_carrier = [[0.0; 10]; 2];
        for i in 0..2 {
            for k in 0..2 {
                for (j, v) in [q[0], q[1], 1.0].into_iter().enumerate() {
                    by_carrier[i][3 * k + j] += m[i][k] * v;
                }
                if let Some(den) = den {
                    for j in 0..2 {
                        by_carrier[i][den[k] + j] -= m[i][k] * t[k] * q[j];
                    }
                }
            }
        }
        let sigma_t = [0, 1].map(|k| s.sigma[k] / self.turns_scale[k]);
        Some(Distortion {
            e: [0, 1].map(|i| s.pixel[i] - seen.pixel[i]),
            by_noise: m.map(|m| [m[0] * sigma_t[0], m[1] * sigma_t[1]]),
            by_carrier,
            by_brown: seen.by_brown.map(|b| b.map(|v| -v)),
        })
    }

    /// Line distances at the centre of the samples, in units of the plane.
    pub(super) fn pitch(&self) -> [f64; 2] {
        [0, 1].map(|k| self.scale / (self.turns_scale[k] * self.gradient(k)[0].hypot(self.gradient(k)[1])))
    }

    fn gradient(&self, k: usize) -> [f64; 2] {
        let den = self.denominator(k);
        [0, 1].map(|j| self.h[3 * k + j] - self.h[3 * k + 2] * den[j])
    }

    /// Angle of the normals of the lines against x, radians.
    pub(super) fn angle(&self) -> [f64; 2] {
        [0, 1].map(|k| self.gradient(k)[1].atan2(self.gradient(k)[0]))
    }

    /// How the inverse distance to the plane changes along x and y, per unit of the plane.
    pub(super) fn tilt(&self) -> [[f64; 2]; 2] {
        [0, 1].map(|k| self.denominator(k).map(|d| d / self.scale))
    }
}

/// A fit of the carrier, perhaps with Brown's terms.
#[derive(Clone, Debug)]
pub(super) struct Fit {
    pub(super) carrier: Carrier,
    pub(super) brown: Brown,
    /// e left at the samples, pixels.
    pub(super) left: Vec<[f64; 2]>,
    /// Covariance of the free Brown terms for residuals of variance 1 that do not know each other.
    pub(super) covariance: DMatrix<f64>,
}

fn array(b: &Brown) -> [f64; 5] {
    [b.k1, b.k2, b.k3, b.p1, b.p2]
}

/// Least squares of e over the samples by the carrier and those of k1, k2, k3, p1, p2 that are `free`.
pub(super) fn fit(
    samples: &[Sample],
    prediction: &Prediction,
    mut carrier: Carrier,
    mut brown: Brown,
    free: [bool; 5],
) -> Result<Fit, DistortionError> {
    let nh = carrier.h.len();
    let terms: Vec<usize> = (0..5).filter(|k| free[*k]).collect();
    let n = nh + terms.len();
    // One round more than it takes to double the digits of a start within a part in ten.
    for _ in 0..40 {
        let mut normal = DMatrix::<f64>::zeros(n, n);
        let mut rhs = DVector::<f64>::zeros(n);
        let mut left = Vec::with_capacity(samples.len());
        for s in samples {
            let d = carrier
                .distortion(s, prediction, &brown)
                .ok_or(DistortionError::Unpredictable { pixel_px: s.pixel })?;
            for i in 0..2 {
                let at = |p: usize| {
                    if p < nh { d.by_carrier[i][p] } else { d.by_brown[i][terms[p - nh]] }
                };
                for a in 0..n {
                    let va = at(a);
                    rhs[a] -= va * d.e[i];
                    for b in 0..=a {
                        normal[(a, b)] += va * at(b);
                    }
                }
            }
            left.push(d.e);
        }
        normal.fill_upper_triangle_with_lower_triangle();
        let scale: Vec<f64> = (0..n).map(|k| normal[(k, k)].sqrt()).collect();
        if !scale.iter().all(|s| *s > 0.0 && s.is_finite()) {
            return Err(DistortionError::Undetermined);
        }
        let scaled = DMatrix::from_fn(n, n, |a, b| normal[(a, b)] / (scale[a] * scale[b]));
        let factor = scaled.cholesky().ok_or(DistortionError::Undetermined)?;
        // Pivots: how much of a term the others do not explain.
        if factor.l_dirty().diagonal().iter().any(|p| *p < 1e-6) {
            return Err(DistortionError::Undetermined);
        }
        let step = factor.solve(&DVector::from_fn(n, |k, _| rhs[k] / scale[k]));
        let moved = step.norm() / (2.0 * samples.len() as f64).sqrt();
        if !moved.is_finite() {
            return Err(DistortionError::Undetermined);
        }
        if moved < 1e-9 {
            let inverse = factor.inverse();
            let covariance = DMatrix::from_fn(terms.len(), terms.len(), |a, b| {
                inverse[(nh + a, nh + b)] / (scale[nh + a] * scale[nh + b])
            });
            return Ok(Fit { carrier, brown, left, covariance });
        }
        for k in 0..nh {
            carrier.h[k] += step[k] / scale[k];
        }
        let mut b = array(&brown);
        for (k, t) in terms.iter().enumerate() {
            b[*t] += step[nh + k] / scale[nh + k];
        }
        let [k1, k2, k3, p1, p2] = b;
        brown = Brown { k1, k2, k3, p1, p2 };
    }
    Err(DistortionError::NotConverged)
}

/// RMS of either component.
pub(super) fn rms(values: &[[f64; 2]]) -> [f64; 2] {
    let n = values.len().max(1) as f64;
    [0, 1].map(|i| (values.iter().map(|v| v[i] * v[i]).sum::<f64>() / n).sqrt())
}
