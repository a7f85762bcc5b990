//! Levenberg–Marquardt's iteration, the selection of observations, and the check of the scale.

use super::check::moves_known;
use super::normal::{Normal, Step};
use super::problem::{Problem, State};
use super::{Known, RigCalibration, RigData, RigError, RigSettings};
use crate::maps::DistortionMaps;
use crate::model::Setup;
use crate::parameter::Parameter;
use crate::robust::{HUBER, Loss, spread};
use crate::setup::Optics;

/// Where a step leads.
struct Trial {
    step: Step,
    state: State,
    residuals: Vec<[f64; 2]>,
    cost: f64,
}

pub(super) fn calibrate(
    start: &Optics,
    mut state: State,
    maps: &DistortionMaps,
    data: &RigData,
    settings: &RigSettings,
) -> Result<RigCalibration, RigError> {
    let mut problem = Problem::new(start, maps, data, settings);
    let usable = problem.usable(&state)?;
    let mut iterations = 0;
    let mut plate_scale = None;
    if data.plate_mm.iter().any(Option::is_some) && moves_known(data, settings) {
        problem.free_scale(true);
        iterations += problem.minimise(&mut state, &usable, true)?.0;
        plate_scale = Some(problem.check_scale(&state, &usable)?);
        problem.free_scale(false);
        state.scale = 1.0;
    }
    let (made, normal) = problem.minimise(&mut state, &usable, true)?;
    iterations += made;
    let scale = problem.scales(&state);
    let parameters: Vec<Parameter> = problem.unknowns.iter().map(|u| u.parameter).collect();
    normal.weak(&parameters, &scale).map_err(|combination| RigError::Undetermined { combination })?;
    let mut active = usable.clone();
    for round in 0..10 {
        let selected = problem.select(&state, &usable)?;
        if round > 0 && selected == active {
            break;
        }
        active = selected;
        iterations += problem.minimise(&mut state, &active, false)?.0;
    }
    problem.finish(start, &state, &active, plate_scale, iterations)
}

impl Problem<'_> {
    /// Observations of points with coordinates that the starting values can project.
    fn usable(&self, state: &State) -> Result<Vec<bool>, RigError> {
        let plain = Setup::<f64>::new(&state.optics, self.maps);
        let newton = Setup::new(&state.optics, self.maps);
        let usable: Vec<bool> = self
            .observations
            .iter()
            .map(|o| self.predict(state, &plain, &newton, o).is_some_and(|p| p.is_ok()))
            .collect();
        let lost = usable.iter().filter(|u| !**u).count();
        self.check_outliers(lost)?;
        Ok(usable)
    }

    fn check_outliers(&self, rejected: usize) -> Result<(), RigError> {
        let observations = self.observations.len();
        let limit = (self.settings.max_outlier_fraction * observations as f64) as usize;
        if rejected > limit {
            return Err(RigError::TooManyOutliers { rejected, observations, limit });
        }
        Ok(())
    }

    /// Fits the state to the observations in use. Returns the linearisations made and the last.
    pub(super) fn minimise(
        &self,
        state: &mut State,
        active: &[bool],
        robust: bool,
    ) -> Result<(usize, Normal), RigError> {
        let failed = |iterations| RigError::NotConverged { iterations };
        // In units of the unknowns' own scales and of the χ² per residual: far from the minimum,
        // where the model's curvature and not the noise makes the residuals, no step may carry a
        // weak combination much farther than its prior.
        let mut damping = if robust { 1e-2 } else { 1e-5 };
        let mut residuals = self.residuals(state, active).map_err(|_| failed(0))?;
        let mut iteration = 0;
        while iteration < self.settings.max_iterations {
            iteration += 1;
            let normalised = self.normalised(&residuals, active);
            let loss =
                if robust { Loss::Huber(HUBER * spread(normalised.iter().copied())) } else { Loss::Squares };
            let cost = self.cost(state, &residuals, active, loss);
            let normal = self.linearise(state, active, loss).map_err(|_| failed(iteration))?;
            let sigma = self.covariance(&normal, state)?.diagonal().map(f64::sqrt);
            // At the minimum rounding alone decides whether the cost still falls.
            let limit = cost * (1.0 + 1e-12) + 1e-16 * normalised.len() as f64;
            // In standard deviations. A robust fit is only the start of another.
            let tolerance = if robust { 1e-2 } else { 1e-3 };
            loop {
                let from = (state as &State, &normal, cost);
                let mut trial = self.trial(from, damping, active, loss);
                // A heavily damped step is small anywhere.
                let small = damping < 2e-3
                    && trial.as_ref().is_some_and(|t| {
                        t.step.columns.iter().zip(sigma.iter()).all(|(by, s)| by.abs() <= tolerance * s)
                    });
                if let Some(high) = trial.take_if(|t| t.cost > limit && !small) {
                    // A step along a narrow, bent valley climbs its side; the next leads back to
                    // the bottom. Only the two together must go down.
                    iteration += 1;
                    trial = self.linearise(&high.state, active, loss).ok().and_then(|normal| {
                        self.trial((&high.state, &normal, high.cost), damping, active, loss)
                            .filter(|t| t.cost <= limit)
                    });
                }
                if let Some(next) = trial {
                    *state = next.state;
                    residuals = next.residuals;
                    damping *= 0.1;
                    if small {
                        return Ok((iteration, normal));
                    }
                    break;
                }
                damping *= 10.0;
                let exhausted = iteration >= self.settings.max_iterations;
                if robust && exhausted {
                    return Ok((iteration, normal));
                }
                if !(damping < 1e12) || exhausted {
                    return Err(failed(iteration));
                }
            }
            // With many outliers the robust fit creeps, but they stand out by now.
            if robust && iteration >= self.settings.max_iterations {
                return Ok((iteration, normal));
            }
        }
        Err(failed(iteration))
    }

    fn cost(&self, state: &State, residuals: &[[f64; 2]], active: &[bool], loss: Loss) -> f64 {
        let used = self.poses_in_use(active);
        let known = self.known(state, &used).iter().map(|(_, r, _)| r * r).sum::<f64>();
        self.normalised(residuals, active).iter().map(|r| loss.of(*r)).sum::<f64>() + known
    }

    /// Where a step from a state with these normal equations and cost leads, if anywhere.
    fn trial(
        &self,
        (state, normal, cost): (&State, &Normal, f64),
        damping: f64,
        active: &[bool],
        loss: Loss,
    ) -> Option<Trial> {
        let residuals = 2 * active.iter().filter(|a| **a).count();
        let excess = (cost / residuals.max(1) as f64).max(1.0);
        let step = normal.step(damping * excess)?;
        let next = self.moved(state, &step);
        next.optics.validate().ok()?;
        let residuals = self.residuals(&next, active).ok()?;
        let cost = self.cost(&next, &residuals, active, loss);
        Some(Trial { step, state: next, residuals, cost })
    }

    /// Observations that agree with the state.
    fn select(&self, state: &State, usable: &[bool]) -> Result<Vec<bool>, RigError> {
        let residuals =
            self.residuals(state, usable).map_err(|_| RigError::NotConverged { iterations: 0 })?;
        let limit = self.settings.outlier_limit * spread(self.normalised(&residuals, usable));
        let selected: Vec<bool> = self
            .observations
            .iter()
            .zip(&residuals)
            .zip(usable)
            .map(|((o, r), u)| *u && (0..2).all(|c| r[c].abs() <= limit * o.sigma_px[c]))
            .collect();
        self.check_outliers(selected.iter().filter(|s| !**s).count())?;
        Ok(selected)
    }

    /// The plate's size by the moves; an error where it contradicts what was stated.
    fn check_scale(&self, state: &State, active: &[bool]) -> Result<Known, RigError> {
        /// Difference that no lens or target is made to.
        const TOLERATED: f64 = 5e-4;
        let failed = |_| RigError::NotConverged { iterations: 0 };
        let normal = self.linearise(state, active, Loss::Squares).map_err(failed)?;
        let covariance = self.covariance(&normal, state)?;
        let sigma = self.scale_at.map_or(0.0, |at| covariance[(at, at)].sqrt());
        let ratio = state.scale;
        if (ratio - 1.0).abs() > TOLERATED.max(5.0 * sigma) {
            return Err(RigError::PitchConflict { ratio, sigma });
        }
        Ok(Known { value: ratio, sigma })
    }
}
