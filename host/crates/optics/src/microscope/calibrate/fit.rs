//! The least-squares problem in image space.

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix};

use super::{
    CalibrateError, Calibration, Estimate, Motion, MotionResult, Settings, decoded_errors, rotation,
};
use crate::microscope::determined::{Candidate, Image, Information, Quantity, open, remedy};
use crate::microscope::linear::{Form, Parameters};
use crate::real::{Dual, Real};

/// Unknowns that a residual depends on: the six of [`Image`] and the translation of its motion.
const LOCAL: usize = 9;
const SHARED: usize = 6;

pub(super) struct Problem<'a> {
    motions: &'a [Motion],
    settings: &'a Settings,
    rotations: Vec<Matrix3<f64>>,
    /// Index of each unknown translation component among the unknowns.
    free: Vec<[Option<usize>; 3]>,
    unknowns: usize,
    middle_px: [f64; 2],
    /// Start of every point among all points.
    offsets: Vec<usize>,
}

/// Normal equations at one state.
struct Normal {
    h: DMatrix<f64>,
    g: DVector<f64>,
    cost: f64,
}

/// How a point counts.
struct Weights<'a> {
    active: &'a [bool],
    /// Huber's limit in standard deviations; infinite for least squares.
    huber: f64,
}

/// (u₋, v₋, u₊, v₊) of a point. `a` as [`Image`], `t` the translation, `place` and `pivot` as
/// (x, y, h) with x, y in pixels from the middle of the points.
fn forward<T: Real>(
    form: Form,
    a: [T; 6],
    t: [T; 3],
    turn: &Matrix3<f64>,
    place: [f64; 3],
    pivot: [f64; 3],
) -> [T; 4] {
    let k = T::constant;
    let [a1, a2, a3, a4, bx, by] = a;
    // spread of the image along x and y per height at a place, px/mm
    let spread = |p: [f64; 3]| [a3 * k(p[0]) - bx, a4 * k(p[1]) - by];
    let (s, s0) = (spread(place), spread(pivot));
    let h = k(place[2]);
    // (P − pivot), from X = (m − c)(1 − a₃ h)/a₂ without the centre itself
    let arm = [
        (k(place[0] - pivot[0]) - h * s[0] + k(pivot[2]) * s0[0]) / a2,
        (k(place[1] - pivot[1]) - h * s[1] + k(pivot[2]) * s0[1]) / a2,
        k(place[2] - pivot[2]),
    ];
    let d: [T; 3] = std::array::from_fn(|i| {
        let mut sum = t[i];
        for j in 0..3 {
            let r = turn[(i, j)] - if i == j { 1.0 } else { 0.0 };
            sum = sum + k(r) * arm[j];
        }
        sum
    });
    let mut approach = a1 * d[2];
    let mut along = a2 * d[0] + s[0] * d[2];
    let mut across = a2 * d[1] + s[1] * d[2];
    if form == Form::Perspective {
        let after = h + d[2];
        let shrink = |a: T| k(1.0) - a * after;
        approach = approach / (shrink(a3) * (k(1.0) - a3 * h));
        along = along / shrink(a3);
        across = across / shrink(a4);
    }
    [along + approach, across, along - approach, across]
}

impl<'a> Problem<'a> {
    pub(super) fn new(motions: &'a [Motion], settings: &'a Settings) -> Self {
        let mut unknowns = SHARED;
        let mut offsets = vec![0];
        let mut free = Vec::with_capacity(motions.len());
        let (mut middle_px, mut count) = ([0.0; 2], 0.0);
        for m in motions {
            free.push(m.translation_mm.map(|t| {
                (m.fit && t.is_none()).then(|| {
                    unknowns += 1;
                    unknowns - 1
                })
            }));
            offsets.push(offsets[offsets.len() - 1] + m.points.len());
            for p in m.points.iter().filter(|_| m.fit) {
                count += 1.0;
                for (mean, m) in middle_px.iter_mut().zip(p.middle_px) {
                    *mean += (m - *mean) / count;
                }
            }
        }
        let rotations = motions.iter().map(Motion::rotation).collect();
        Self { motions, settings, rotations, free, unknowns, middle_px, offsets }
    }

    fn place(&self, m: [f64; 2], h: f64) -> [f64; 3] {
        [m[0] - self.middle_px[0], m[1] - self.middle_px[1], h]
    }

    /// Residuals in pixels, observed − model, and their derivatives of the model.
    fn residuals(&self, state: &DVector<f64>, motion: usize, point: usize) -> ([f64; 4], [[f64; LOCAL]; 4]) {
        let m = &self.motions[motion];
        let p = &m.points[point];
        let a = std::array::from_fn(|i| Dual::<LOCAL>::variable(state[i], i));
        let t = std::array::from_fn(|c| match (self.free[motion][c], m.translation_mm[c]) {
            (Some(index), _) => Dual::variable(state[index], SHARED + c),
            (None, given) => Dual::constant(given.unwrap_or(0.0)),
        });
        let place = self.place(p.middle_px, p.height_mm);
        let pivot = self.place(m.pivot_px, m.pivot_height_mm);
        let model = forward(self.settings.form, a, t, &self.rotations[motion], place, pivot);
        (std::array::from_fn(|i| p.moved_px[i] - model[i].value), model.map(|v| v.gradient))
    }

    fn normal(&self, state: &DVector<f64>, weights: &Weights<'_>) -> Normal {
        let n = self.unknowns;
        let mut normal = Normal { h: DMatrix::zeros(n, n), g: DVector::zeros(n), cost: 0.0 };
        for (k, m) in self.motions.iter().enumerate().filter(|(_, m)| m.fit) {
            let mut index = [0; LOCAL];
            for (i, slot) in index.iter_mut().enumerate() {
                *slot = if i < SHARED { i } else { self.free[k][i - SHARED].unwrap_or(usize::MAX) };
            }
            let mut h = [[0.0; LOCAL]; LOCAL];
            let mut g = [0.0; LOCAL];
            for j in (0..m.points.len()).filter(|j| weights.active[self.offsets[k] + j]) {
                let (r, d) = self.residuals(state, k, j);
                for c in 0..4 {
                    let sigma = m.points[j].sigma_px[c];
                    let z = (r[c] / sigma).abs();
                    let part = if z > weights.huber { weights.huber / z } else { 1.0 };
                    // Huber's loss itself, so that a step that lowers it is a step to accept
                    normal.cost += if part < 1.0 { weights.huber * (2.0 * z - weights.huber) } else { z * z };
                    let w = part / (sigma * sigma);
                    for a in 0..LOCAL {
                        g[a] += w * r[c] * d[c][a];
                        for b in 0..=a {
                            h[a][b] += w * d[c][a] * d[c][b];
                        }
                    }
                }
            }
            for a in (0..LOCAL).filter(|a| index[*a] != usize::MAX) {
                normal.g[index[a]] += g[a];
                for b in (0..LOCAL).filter(|b| index[*b] != usize::MAX) {
                    normal.h[(index[a], index[b])] += h[a.max(b)][a.min(b)];
                }
            }
        }
        normal
    }

    fn minimise(&self, state: &mut DVector<f64>, weights: &Weights<'_>) -> Result<usize, CalibrateError> {
        let mut damping = 1e-6;
        let mut normal = self.normal(state, weights);
        for iteration in 1..=self.settings.max_iterations {
            let information = Information::new(&normal.h);
            loop {
                let step = information.step(&normal.g, damping);
                // length of the step in standard deviations of each unknown alone
                let size: f64 = (0..self.unknowns).map(|i| step[i] * step[i] * normal.h[(i, i)]).sum();
                let trial = &*state + &step;
                let next = self.normal(&trial, weights);
                // negated: a cost that is no number is no improvement
                let better = next.cost <= normal.cost * (1.0 + 1e-12) && trial[0].is_finite();
                if better {
                    *state = trial;
                    normal = next;
                    damping = (damping * 0.1_f64).max(1e-15);
                }
                // in units of σ; below the rounding of what is compared nothing improves any more
                if size < 1e-14 || (!better && size < 1e-9) {
                    return Ok(iteration);
                }
                if better {
                    break;
                }
                damping *= 10.0;
                if damping > 1e12 {
                    return Err(CalibrateError::NotConverged { iterations: iteration });
                }
            }
        }
        Err(CalibrateError::NotConverged { iterations: self.settings.max_iterations })
    }

    fn start(&self) -> DVector<f64> {
        let mut state = DVector::zeros(self.unknowns);
        state[1] = 1.0 / self.settings.start_pixel_mm;
        // the tangent of a usual first-order angle
        state[0] = 0.2 * state[1];
        state
    }

    /// Largest residual of a point in standard deviations.
    fn worst(&self, state: &DVector<f64>, k: usize, j: usize) -> f64 {
        let (r, _) = self.residuals(state, k, j);
        let sigma = self.motions[k].points[j].sigma_px;
        (0..4).map(|c| (r[c] / sigma[c]).abs()).fold(0.0, f64::max)
    }

    fn fitted(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let motions = self.motions.iter().enumerate().filter(|(_, m)| m.fit);
        motions.flat_map(|(k, m)| (0..m.points.len()).map(move |j| (k, j)))
    }

    fn select(&self, state: &DVector<f64>) -> Vec<bool> {
        let mut all: Vec<f64> = self
            .fitted()
            .flat_map(|(k, j)| {
                let (r, _) = self.residuals(state, k, j);
                let sigma = self.motions[k].points[j].sigma_px;
                (0..4).map(move |c| (r[c] / sigma[c]).abs())
            })
            .collect();
        let middle = all.len() / 2;
        // 1.4826: from the median of absolute values to σ of a normal distribution
        let robust = 1.4826 * *all.select_nth_unstable_by(middle, f64::total_cmp).1;
        let limit = self.settings.outlier_limit * robust.max(1.0);
        let mut active = vec![false; self.offsets[self.motions.len()]];
        for (k, j) in self.fitted() {
            active[self.offsets[k] + j] = self.worst(state, k, j) <= limit;
        }
        active
    }

    pub(super) fn solve(&self) -> Result<Calibration, CalibrateError> {
        let points = self.fitted().count();
        let mut active = vec![false; self.offsets[self.motions.len()]];
        for (k, j) in self.fitted() {
            active[self.offsets[k] + j] = true;
        }
        let mut state = self.start();
        // least squares first: it is linear for translations and brings the residuals to their size
        let mut iterations = self.minimise(&mut state, &Weights { active: &active, huber: f64::INFINITY })?;
        iterations += self.minimise(&mut state, &Weights { active: &active, huber: 1.5 })?;
        let limit = (self.settings.max_outlier_fraction * points as f64) as usize;
        let mut rejected = 0;
        for _ in 0..20 {
            let next = self.select(&state);
            rejected = points - next.iter().filter(|a| **a).count();
            if rejected > limit {
                return Err(CalibrateError::TooManyOutliers { rejected, points, limit });
            }
            let same = next == active;
            active = next;
            iterations += self.minimise(&mut state, &Weights { active: &active, huber: f64::INFINITY })?;
            if same {
                break;
            }
        }
        self.result(&state, &active, points - rejected, iterations)
    }

    /// Information of the six shared unknowns, the translations eliminated.
    fn shared_information(&self, h: &DMatrix<f64>) -> DMatrix<f64> {
        let t = self.unknowns - SHARED;
        let mut a = h.view((0, 0), (SHARED, SHARED)).into_owned();
        if t > 0 {
            let b = h.view((0, SHARED), (SHARED, t));
            let inverse = Information::new(&h.view((SHARED, SHARED), (t, t)).into_owned()).covariance();
            a -= b * inverse * b.transpose();
            // what elimination leaves of zero
            for i in 0..SHARED {
                if a[(i, i)] < 1e-10 * h[(i, i)] {
                    a.row_mut(i).fill(0.0);
                    a.column_mut(i).fill(0.0);
                }
            }
        }
        a
    }

    fn result(
        &self,
        state: &DVector<f64>,
        active: &[bool],
        points: usize,
        iterations: usize,
    ) -> Result<Calibration, CalibrateError> {
        let normal = self.normal(state, &Weights { active, huber: f64::INFINITY });
        let at = Image { values: std::array::from_fn(|i| state[i]), middle_px: self.middle_px };
        let shared = self.shared_information(&normal.h);
        let information = Information::new(&shared);
        let mut undetermined = open(&shared, &at);
        let degrees_of_freedom = (4 * points).saturating_sub(self.unknowns);
        let chi_square_reduced = normal.cost / degrees_of_freedom.max(1) as f64;
        let inflate = chi_square_reduced.max(1.0) * self.settings.shared;
        let covariance = information.covariance() * inflate;
        let sigma = |d: &[f64; 6]| {
            let d = DVector::from_column_slice(d);
            (&covariance * &d).dot(&d).max(0.0).sqrt()
        };
        let mut estimates: Vec<Estimate> = Vec::new();
        for quantity in Quantity::ALL {
            let (value, gradient) = quantity.of(&at);
            if !information.determines(&gradient) {
                continue;
            }
            let sigma = sigma(&gradient);
            let scale = matches!(quantity, Quantity::Beta1 | Quantity::Beta2);
            // negated so that NaN counts as open
            if scale && !(sigma <= self.settings.max_relative_sigma * value.abs()) {
                undetermined.push(quantity);
                continue;
            }
            estimates.push(Estimate { quantity, value, sigma });
        }
        undetermined.sort_by_key(|q| Quantity::ALL.iter().position(|x| x == q));
        undetermined.dedup();
        if let Some(e) = estimates.iter().find(|e| e.quantity == Quantity::Beta1 && e.value < 0.0) {
            return Err(CalibrateError::Swapped { beta1_mm_per_px: e.value });
        }
        let add = if undetermined.is_empty() {
            Vec::new()
        } else {
            let found = remedy(&shared, &at, &self.candidates(state, active));
            // determined in principle, but too weakly: more of what gives the scale
            let weak = |q| undetermined.contains(&q);
            match (found.is_empty(), weak(Quantity::Beta1), weak(Quantity::Beta2)) {
                (true, true, true) => vec![Candidate::MoveZ, Candidate::MoveX],
                (true, true, false) => vec![Candidate::MoveZ],
                (true, false, _) => vec![Candidate::MoveX],
                _ => found,
            }
        };
        let complete = undetermined.is_empty();
        let jacobian = SMatrix::<f64, 6, 6>::from_fn(|i, j| Quantity::ALL[i].of(&at).1[j]);
        let parameters =
            complete.then(|| Parameters::from_array(std::array::from_fn(|i| Quantity::ALL[i].of(&at).0)));
        let c6 = SMatrix::<f64, 6, 6>::from_fn(|i, j| covariance[(i, j)]);
        let square: f64 = self
            .fitted()
            .filter(|(k, j)| active[self.offsets[*k] + j])
            .flat_map(|(k, j)| self.residuals(state, k, j).0)
            .map(|r| r * r)
            .sum();
        let rejected = self.fitted().filter(|(k, j)| !active[self.offsets[*k] + j]).collect();
        let unit = |i: usize| std::array::from_fn(|j| if i == j { 1.0 } else { 0.0 });
        Ok(Calibration {
            form: self.settings.form,
            parameters,
            covariance: complete.then(|| jacobian * c6 * jacobian.transpose()),
            estimates,
            undetermined,
            add,
            telecentric: [2, 3].map(|i| state[i].abs() <= 3.0 * sigma(&unit(i))),
            rms_px: (square / (4 * points).max(1) as f64).sqrt(),
            chi_square_reduced,
            degrees_of_freedom,
            rejected,
            iterations,
            motions: (0..self.motions.len())
                .map(|k| self.motion_result(k, state, active, parameters.as_ref()))
                .collect::<Result<_, _>>()?,
        })
    }

    fn motion_result(
        &self,
        k: usize,
        state: &DVector<f64>,
        active: &[bool],
        parameters: Option<&Parameters>,
    ) -> Result<MotionResult, CalibrateError> {
        let m = &self.motions[k];
        let counts = |j: usize| !m.fit || active[self.offsets[k] + j];
        let used: Vec<usize> = (0..m.points.len()).filter(|j| counts(*j)).collect();
        let n = used.len().max(1) as f64;
        let mut rms_mm = [f64::NAN; 3];
        let mut mean_mm = [f64::NAN; 3];
        let mut translation_mm = std::array::from_fn(|c| match self.free[k][c] {
            Some(i) => state[i],
            None => m.translation_mm[c].unwrap_or(f64::NAN),
        });
        if let Some(parameters) = parameters {
            let (errors, translation) = decoded_errors(m, parameters, self.settings.form, counts)?;
            rms_mm = std::array::from_fn(|c| (errors.iter().map(|e| e[c] * e[c]).sum::<f64>() / n).sqrt());
            mean_mm = std::array::from_fn(|c| errors.iter().map(|e| e[c]).sum::<f64>() / n);
            if !m.fit {
                translation_mm = translation;
            }
        }
        // the image residuals of a motion that was not fitted, with its translation as found
        let mut told = m.clone();
        told.translation_mm = translation_mm.map(Some);
        let motions = [told];
        let alone = Problem { unknowns: SHARED, ..Problem::new(&motions, self.settings) };
        let mut alone_state = state.rows(0, SHARED).into_owned();
        // its own middle: b = a (c − middle)
        for i in 0..2 {
            alone_state[4 + i] += state[2 + i] * (self.middle_px[i] - alone.middle_px[i]);
        }
        let mut rms_px = [0.0; 4];
        for &j in &used {
            let (r, _) = alone.residuals(&alone_state, 0, j);
            for c in 0..4 {
                rms_px[c] += r[c] * r[c] / n;
            }
        }
        Ok(MotionResult {
            name: m.name.clone(),
            fitted: m.fit,
            points: used.len(),
            rms_px: rms_px.map(f64::sqrt),
            rms_mm,
            mean_mm,
            translation_mm,
        })
    }

    /// Information that each candidate would add at the points of the fit (at most some hundred), for
    /// moves and tilts of a usual size: only what it is zero of matters.
    fn candidates(&self, state: &DVector<f64>, active: &[bool]) -> Vec<(Candidate, DMatrix<f64>)> {
        let all: Vec<_> = self.fitted().filter(|(k, j)| active[self.offsets[*k] + j]).collect();
        let every = all.len().div_ceil(300).max(1);
        let points: Vec<_> = all.iter().step_by(every).map(|(k, j)| self.motions[*k].points[*j]).collect();
        // 10 px of motion and 0.1 rad
        let move_mm = 10.0 / state[1].abs().max(f64::MIN_POSITIVE);
        Candidate::ALL
            .into_iter()
            .map(|candidate| {
                let (translation, turn) = match candidate {
                    Candidate::MoveX => ([Some(move_mm), Some(0.0), Some(0.0)], [0.0; 3]),
                    Candidate::MoveY => ([Some(0.0), Some(move_mm), Some(0.0)], [0.0; 3]),
                    Candidate::MoveZ => ([Some(0.0), Some(0.0), Some(move_mm)], [0.0; 3]),
                    Candidate::TiltX => ([None; 3], [0.1, 0.0, 0.0]),
                    Candidate::TiltY => ([None; 3], [0.0, 0.1, 0.0]),
                };
                let motion = Motion {
                    translation_mm: translation,
                    rotation_rad: turn,
                    pivot_px: self.middle_px,
                    ..Motion::translation(candidate.advice(), [0.0; 3], points.clone())
                };
                debug_assert!(rotation(turn) == motion.rotation());
                let motions = [motion];
                let one = Problem { middle_px: self.middle_px, ..Problem::new(&motions, self.settings) };
                let mut at = DVector::zeros(one.unknowns);
                at.rows_mut(0, SHARED).copy_from(&state.rows(0, SHARED));
                let everything = vec![true; points.len()];
                let weights = Weights { active: &everything, huber: f64::INFINITY };
                (candidate, one.shared_information(&one.normal(&at, &weights).h))
            })
            .collect()
    }
}
