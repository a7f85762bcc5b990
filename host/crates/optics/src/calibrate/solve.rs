//! Levenberg–Marquardt on the reduced normal equations, and the selection of observations.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use super::normal::{Block, FREE, Normal};
use super::{CalibrateError, Calibration, Estimate, Observation, Settings, TrackedPoint};
use crate::decode::Decoder;
use crate::maps::DistortionMaps;
use crate::model::{OpticalModel, Setup, TraceError};
use crate::parameter::Parameter;
use crate::project::{near, project};
use crate::real::{Dual, Real};
use crate::robust::{HUBER, Loss, spread};
use crate::setup::{Optics, View};

/// Derivatives by a point's three coordinates, then by the parameters.
type D = Dual<{ 3 + FREE }>;

pub(super) struct Problem<'a> {
    displacements: &'a [Vector3<f64>],
    points: &'a [TrackedPoint],
    settings: &'a Settings,
    /// Parameters of the normal equations.
    free: Vec<Parameter>,
}

#[derive(Clone)]
struct State {
    optics: Optics,
    /// Points (x, y, h) at displacement zero.
    positions: Vec<Vector3<f64>>,
}

impl<'a> Problem<'a> {
    pub(super) fn new(
        displacements: &'a [Vector3<f64>],
        points: &'a [TrackedPoint],
        settings: &'a Settings,
    ) -> Self {
        let free =
            settings.parameters.iter().copied().filter(|p| *p != Parameter::GratingToReference).collect();
        Self { displacements, points, settings, free }
    }

    pub(super) fn solve(&self, start: &Optics) -> Result<Calibration, CalibrateError> {
        let model = OpticalModel::new(start)?;
        let (mut state, mut active) = self.initial(&model);
        let usable = active.clone();
        self.check_amount(&active)?;
        let mut iterations = self.minimise(&mut state, &active, true)?;
        for round in 0..10 {
            let selected = self.select(&state, &usable)?;
            if round > 0 && selected == active {
                break;
            }
            active = selected;
            self.check_amount(&active)?;
            iterations += self.minimise(&mut state, &active, false)?;
        }
        self.finish(start, state, &active, iterations)
    }

    fn observation(&self, point: usize, frame: usize) -> Option<&Observation> {
        self.points[point].frames[frame].as_ref()
    }

    fn slot(&self, point: usize, frame: usize) -> usize {
        point * self.displacements.len() + frame
    }

    /// Positions from the decoded pairs, and which observations can be used.
    fn initial(&self, model: &OpticalModel) -> (State, Vec<bool>) {
        let frames = self.displacements.len();
        let mut active = vec![false; self.points.len() * frames];
        let mut positions = vec![Vector3::zeros(); self.points.len()];
        for (i, position) in positions.iter_mut().enumerate() {
            let mut decoded = Vec::with_capacity(frames);
            for (k, shift) in self.displacements.iter().enumerate() {
                if let Some(o) = self.observation(i, k)
                    && let Ok(p) = model.decode_point(Decoder::Ray, o.pair)
                {
                    decoded.push(p - shift);
                    active[self.slot(i, k)] = true;
                }
            }
            if !decoded.is_empty() {
                *position = median(&decoded);
            }
            for (k, shift) in self.displacements.iter().enumerate() {
                let seen = |v| model.project(v, *position + shift).is_ok();
                if active[self.slot(i, k)] && !View::BOTH.into_iter().all(seen) {
                    active[self.slot(i, k)] = false;
                }
            }
        }
        let state = State { optics: *model.optics(), positions };
        (state, active)
    }

    /// (points, observations) in use.
    fn amount(&self, active: &[bool]) -> (usize, usize) {
        let frames = self.displacements.len().max(1);
        let points = active.chunks(frames).filter(|c| c.contains(&true)).count();
        (points, active.iter().filter(|a| **a).count())
    }

    fn check_amount(&self, active: &[bool]) -> Result<(), CalibrateError> {
        let (points, observations) = self.amount(active);
        let unknowns = 3 * points + self.settings.parameters.len();
        if 4 * observations <= unknowns {
            return Err(CalibrateError::TooFewData { points, residuals: 4 * observations, unknowns });
        }
        Ok(())
    }

    /// Residuals (observed − predicted) in pixels of the four coordinates of every slot in use.
    fn residuals(&self, state: &State, active: &[bool]) -> Result<Vec<[f64; 4]>, TraceError> {
        let plain = Setup::<f64>::new(&state.optics, &DistortionMaps::NONE);
        let newton = Setup::new(&state.optics, &DistortionMaps::NONE);
        let mut all = vec![[0.0; 4]; active.len()];
        for (i, position) in state.positions.iter().enumerate() {
            for (k, shift) in self.displacements.iter().enumerate() {
                let slot = self.slot(i, k);
                let Some(o) = self.observation(i, k).filter(|_| active[slot]) else {
                    continue;
                };
                for view in View::BOTH {
                    let seen = o.pair.pixel(view);
                    let p = (position + shift).into();
                    let pixel = project(&plain, &newton, view, p, near(&state.optics, seen))?;
                    for c in 0..2 {
                        all[slot][2 * view.index() + c] = seen[c] - pixel[c];
                    }
                }
            }
        }
        Ok(all)
    }

    /// The same divided by the standard deviations, for the slots in use only, flat.
    fn normalised(&self, residuals: &[[f64; 4]], active: &[bool]) -> Vec<f64> {
        let frames = self.displacements.len();
        let mut flat = Vec::with_capacity(4 * residuals.len());
        for (slot, r) in residuals.iter().enumerate().filter(|(s, _)| active[*s]) {
            if let Some(o) = self.observation(slot / frames, slot % frames) {
                flat.extend(r.iter().zip(o.sigma_px).map(|(r, sigma)| r / sigma));
            }
        }
        flat
    }

    /// The usable observations that agree with the state.
    fn select(&self, state: &State, usable: &[bool]) -> Result<Vec<bool>, CalibrateError> {
        let residuals =
            self.residuals(state, usable).map_err(|_| CalibrateError::NotConverged { iterations: 0 })?;
        let spread = spread(self.normalised(&residuals, usable));
        let limit = self.settings.outlier_limit * spread;
        let frames = self.displacements.len();
        let selected: Vec<bool> = (0..usable.len())
            .map(|slot| {
                usable[slot]
                    && self.observation(slot / frames, slot % frames).is_some_and(|o| {
                        residuals[slot].iter().zip(o.sigma_px).all(|(r, sigma)| r.abs() <= limit * sigma)
                    })
            })
            .collect();
        let (_, observations) = self.amount(usable);
        let rejected = observations - self.amount(&selected).1;
        let most = (self.settings.max_outlier_fraction * observations as f64) as usize;
        if rejected > most {
            return Err(CalibrateError::TooManyOutliers { rejected, observations, limit: most });
        }
        Ok(selected)
    }

    /// Normal equations at `state`.
    fn linearise(&self, state: &State, active: &[bool], loss: Loss) -> Result<Normal, TraceError> {
        let place = |p| self.free.iter().position(|f| *f == p);
        let setup = Setup::<D>::with(&state.optics, &DistortionMaps::NONE, |p, value| match place(p) {
            Some(j) => Dual::variable(value, 3 + j),
            None => Dual::constant(value),
        });
        let newton = Setup::new(&state.optics, &DistortionMaps::NONE);
        let n = self.free.len();
        let mut normal = Normal {
            a: DMatrix::zeros(n, n),
            rhs: DVector::zeros(n),
            blocks: Vec::with_capacity(self.points.len()),
        };
        for (i, position) in state.positions.iter().enumerate() {
            let mut block =
                Block { point: i, c: Matrix3::zeros(), b: [Vector3::zeros(); FREE], rhs: Vector3::zeros() };
            let mut used = false;
            for (k, shift) in self.displacements.iter().enumerate() {
                let slot = self.slot(i, k);
                let Some(o) = self.observation(i, k).filter(|_| active[slot]) else {
                    continue;
                };
                used = true;
                let at = [0, 1, 2].map(|c| {
                    let variable = D::variable(position[c], c);
                    variable + D::constant(shift[c])
                });
                for view in View::BOTH {
                    let seen = o.pair.pixel(view);
                    let pixel = project(&setup, &newton, view, at, near(&state.optics, seen))?;
                    for c in 0..2 {
                        let sigma = o.sigma_px[2 * view.index() + c];
                        let r = (seen[c] - pixel[c].value) / sigma;
                        let w = loss.weight(r);
                        let g = pixel[c].gradient.map(|g| g / sigma);
                        let by_point = Vector3::new(g[0], g[1], g[2]);
                        block.c += by_point * by_point.transpose() * w;
                        block.rhs += by_point * (w * r);
                        for j in 0..n {
                            let gj = g[3 + j];
                            block.b[j] += by_point * (w * gj);
                            normal.rhs[j] += w * gj * r;
                            for l in 0..n {
                                normal.a[(j, l)] += w * gj * g[3 + l];
                            }
                        }
                    }
                }
            }
            if used {
                normal.blocks.push(block);
            }
        }
        Ok(normal)
    }

    /// Fits the state to the observations in use. Returns the linearisations made.
    fn minimise(&self, state: &mut State, active: &[bool], robust: bool) -> Result<usize, CalibrateError> {
        let failed = |iterations| CalibrateError::NotConverged { iterations };
        // Damping relative to the diagonal. F and s are strongly correlated: what is left of the
        // diagonal after elimination is small, so the damping starts far below it.
        let mut damping = 1e-9;
        let mut residuals = self.residuals(state, active).map_err(|_| failed(0))?;
        for iteration in 1..=self.settings.max_iterations {
            let normalised = self.normalised(&residuals, active);
            let loss =
                if robust { Loss::Huber(HUBER * spread(normalised.iter().copied())) } else { Loss::Squares };
            let cost: f64 = normalised.iter().map(|r| loss.of(*r)).sum();
            let normal = self.linearise(state, active, loss).map_err(|_| failed(iteration))?;
            let covariance = self.covariance(&normal, &state.optics)?;
            loop {
                let trial =
                    normal.step(damping).map(|step| (step.0.clone(), self.moved(state, &normal, &step)));
                let next = trial.and_then(|(by, next)| {
                    next.optics.validate().ok()?;
                    let residuals = self.residuals(&next, active).ok()?;
                    let after: f64 = self.normalised(&residuals, active).iter().map(|r| loss.of(*r)).sum();
                    Some((by, next, residuals, after))
                });
                if let Some((by, next, new_residuals, after)) = next {
                    // At the minimum rounding alone decides whether the cost still falls.
                    let tolerance = if robust { 1e-3 } else { 1e-6 };
                    let rounding = 1e-12 * cost + 1e-16 * normalised.len() as f64;
                    // Without free parameters the points alone must have come to rest.
                    let small = if by.is_empty() {
                        cost - after <= tolerance * cost + rounding
                    } else {
                        // A heavily damped step is small anywhere.
                        damping < 1e-7
                            && (0..by.len()).all(|j| by[j].abs() <= tolerance * covariance[(j, j)].sqrt())
                    };
                    if after <= cost + rounding || small {
                        *state = next;
                        residuals = new_residuals;
                        damping *= 0.01;
                        if small {
                            return Ok(iteration);
                        }
                        break;
                    }
                }
                damping *= 100.0;
                if damping > 1e6 {
                    return Err(failed(iteration));
                }
            }
        }
        Err(failed(self.settings.max_iterations))
    }

    /// Covariance of the free parameters.
    fn covariance(&self, normal: &Normal, at: &Optics) -> Result<DMatrix<f64>, CalibrateError> {
        normal.covariance().map_err(|worst| {
            let parameter = self.free[worst];
            CalibrateError::Undetermined {
                parameter,
                sigma: f64::INFINITY,
                limit: self.settings.max_relative_sigma * parameter.get(at),
            }
        })
    }

    fn moved(&self, state: &State, normal: &Normal, step: &(DVector<f64>, Vec<Vector3<f64>>)) -> State {
        let mut next = state.clone();
        for (p, by) in self.free.iter().zip(step.0.iter()) {
            p.set(&mut next.optics, p.get(&state.optics) + by);
        }
        for (block, by) in normal.blocks.iter().zip(&step.1) {
            next.positions[block.point] += by;
        }
        next
    }

    fn finish(
        &self,
        start: &Optics,
        state: State,
        active: &[bool],
        iterations: usize,
    ) -> Result<Calibration, CalibrateError> {
        let failed = |_| CalibrateError::NotConverged { iterations };
        let residuals = self.residuals(&state, active).map_err(failed)?;
        let normal = self.linearise(&state, active, Loss::Squares).map_err(failed)?;
        let free_covariance = self.covariance(&normal, &state.optics)?;

        let (points, observations) = self.amount(active);
        let chi2: f64 = self.normalised(&residuals, active).iter().map(|r| r * r).sum();
        let square_px: f64 = residuals.iter().flatten().map(|r| r * r).sum();
        let degrees_of_freedom = 4 * observations - 3 * points - self.settings.parameters.len();
        let chi_square_reduced = chi2 / degrees_of_freedom as f64;

        let mut optics = state.optics;
        let (mut by_free, mut own_variance) = normal.mean_height();
        // d is along the axis, heights along the reference plane's normal.
        let [tilt_x, tilt_y, _] = optics.reference.tilt_rad_xyz;
        let slant = tilt_x.cos() * tilt_y.cos();
        by_free.iter_mut().for_each(|by| *by /= slant);
        own_variance /= slant * slant;
        if let Some(height) = self.settings.reference_height_mm
            && self.settings.parameters.contains(&Parameter::GratingToReference)
        {
            let sum: f64 = normal.blocks.iter().map(|b| state.positions[b.point].z).sum();
            // The points stay where they are in the world, z = s + d − h.
            optics.grating_to_reference_mm += (height - sum / points as f64) / slant;
        }
        // Rows of the estimates by the free parameters; the datum adds the points' own noise.
        let n = self.settings.parameters.len();
        let rows = DMatrix::from_fn(n, self.free.len(), |i, j| match self.settings.parameters[i] {
            Parameter::GratingToReference => by_free[j],
            p => f64::from(u8::from(p == self.free[j])),
        });
        let mut covariance = &rows * free_covariance * rows.transpose();
        for (i, p) in self.settings.parameters.iter().enumerate() {
            if *p == Parameter::GratingToReference {
                covariance[(i, i)] += own_variance;
            }
        }
        covariance *= chi_square_reduced.max(1.0);

        let mut estimates = Vec::with_capacity(n);
        for (i, parameter) in self.settings.parameters.iter().copied().enumerate() {
            let value = parameter.get(&optics);
            let sigma = covariance[(i, i)].sqrt();
            let limit = self.settings.max_relative_sigma * value.abs();
            if !(sigma <= limit) {
                return Err(CalibrateError::Undetermined { parameter, sigma, limit });
            }
            estimates.push(Estimate { parameter, start: parameter.get(start), value, sigma });
        }
        let frames = self.displacements.len();
        let rejected = (0..active.len())
            .filter(|s| !active[*s])
            .map(|s| (s / frames, s % frames))
            .filter(|(i, k)| self.observation(*i, *k).is_some())
            .collect();
        Ok(Calibration {
            optics,
            estimates,
            covariance,
            rms_px: (square_px / (4 * observations) as f64).sqrt(),
            chi_square_reduced,
            degrees_of_freedom,
            points,
            observations,
            rejected,
            iterations,
        })
    }
}

/// Component-wise median: one bad observation of a point does not spoil its start.
fn median(points: &[Vector3<f64>]) -> Vector3<f64> {
    Vector3::from_fn(|c, _| {
        let mut values: Vec<f64> = points.iter().map(|p| p[c]).collect();
        let half = values.len() / 2;
        *values.select_nth_unstable_by(half, f64::total_cmp).1
    })
}
