//! From the solution to the result: covariance, residuals, and the check without each pose.

use nalgebra::Vector3;

use super::geometry::lay_all;
use super::problem::{Problem, State};
use super::{Known, LeftOut, RigCalibration, RigError, RigEstimate, ViewResiduals, Volume};
use crate::decode::{Decoder, PixelPair, pixel_covariance};
use crate::model::OpticalModel;
use crate::parameter::{Parameter, ParameterCovariance};
use crate::robust::Loss;
use crate::setup::{Optics, View};

/// Fewest poses of which one can be left out.
const LEAST_FOR_CHECK: usize = 4;

impl Problem<'_> {
    pub(super) fn finish(
        &self,
        start: &Optics,
        state: &State,
        active: &[bool],
        plate_scale: Option<Known>,
        iterations: usize,
    ) -> Result<RigCalibration, RigError> {
        let failed = |_| RigError::NotConverged { iterations };
        let residuals = self.residuals(state, active).map_err(failed)?;
        let normal = self.linearise(state, active, Loss::Squares).map_err(failed)?;
        let parameters: Vec<Parameter> = self.unknowns.iter().map(|u| u.parameter).collect();
        let weak = normal
            .weak(&parameters, &self.scales(state))
            .map_err(|combination| RigError::Undetermined { combination })?;
        let (chi2, used, unknowns) = self.chi_square(state, &residuals, active, &normal);
        let degrees_of_freedom = used.saturating_sub(unknowns);
        let chi_square_reduced = chi2 / degrees_of_freedom.max(1) as f64;

        let n = parameters.len();
        let all = self.covariance(&normal, state)?;
        let matrix = all.view((0, 0), (n, n)) * chi_square_reduced.max(1.0);
        let estimates = self
            .unknowns
            .iter()
            .enumerate()
            .map(|(j, u)| RigEstimate {
                parameter: u.parameter,
                start: u.parameter.get(start),
                prior_sigma: u.prior.map(|p| p.sigma),
                value: u.parameter.get(&state.optics),
                sigma: matrix[(j, j)].sqrt(),
            })
            .collect();
        let covariance = ParameterCovariance::new(parameters, 0.5 * (&matrix + matrix.transpose()))
            .map_err(|_| RigError::NotConverged { iterations })?;

        let square: f64 = residuals.iter().flatten().map(|r| r * r).sum();
        let pixels = 2 * active.iter().filter(|a| **a).count();
        let rejected = self
            .observations
            .iter()
            .zip(active)
            .filter(|(_, a)| !**a)
            .map(|(o, _)| (o.pose, o.point, o.view))
            .collect();
        Ok(RigCalibration {
            optics: state.optics,
            estimates,
            covariance,
            weak,
            poses: state.poses.clone(),
            plate_mm: state.plate.clone(),
            stage_axes_rad: self.stage_estimated().then_some(state.stage),
            plate_scale,
            residuals: self.of_views(&residuals, active),
            rms_px: (square / pixels.max(1) as f64).sqrt(),
            chi_square_reduced,
            degrees_of_freedom,
            rejected,
            left_out: self.leave_out(state, active)?,
            volume: self.volume(state, active),
            iterations,
        })
    }

    /// χ², the number of residuals and of unknowns.
    fn chi_square(
        &self,
        state: &State,
        residuals: &[[f64; 2]],
        active: &[bool],
        normal: &super::normal::Normal,
    ) -> (f64, usize, usize) {
        let normalised = self.normalised(residuals, active);
        let used = self.poses_in_use(active);
        let known = self.known(state, &used);
        let chi2: f64 = normalised.iter().chain(known.iter().map(|(_, r, _)| r)).map(|r| r * r).sum();
        (chi2, normalised.len() + known.len(), normal.rhs.len() + 2 * normal.blocks.len())
    }

    fn of_views(&self, residuals: &[[f64; 2]], active: &[bool]) -> Vec<ViewResiduals> {
        let mut all = Vec::new();
        for pose in 0..self.data.poses.len() {
            for view in View::BOTH {
                let own: Vec<[f64; 2]> = self
                    .observations
                    .iter()
                    .zip(residuals)
                    .zip(active)
                    .filter(|((o, _), a)| **a && o.pose == pose && o.view == view)
                    .map(|((_, r), _)| *r)
                    .collect();
                let n = own.len().max(1) as f64;
                let mean_px = [0, 1].map(|c| own.iter().map(|r| r[c]).sum::<f64>() / n);
                let rms_px = [0, 1].map(|c| (own.iter().map(|r| r[c] * r[c]).sum::<f64>() / n).sqrt());
                all.push(ViewResiduals { pose, view, points: own.len(), rms_px, mean_px });
            }
        }
        all
    }

    fn volume(&self, state: &State, active: &[bool]) -> Volume {
        let mut volume = Volume { from_mm: [f64::INFINITY; 3], to_mm: [f64::NEG_INFINITY; 3] };
        for (o, _) in self.observations.iter().zip(active).filter(|(_, a)| **a) {
            if let Some(xy) = state.plate[o.point] {
                let p = state.poses[o.pose].point_mm(xy);
                for i in 0..3 {
                    volume.from_mm[i] = volume.from_mm[i].min(p[i]);
                    volume.to_mm[i] = volume.to_mm[i].max(p[i]);
                }
            }
        }
        volume
    }

    fn leave_out(&self, state: &State, active: &[bool]) -> Result<Vec<LeftOut>, RigError> {
        let poses = self.data.poses.len();
        if !self.settings.leave_one_out || poses < LEAST_FOR_CHECK {
            return Ok(Vec::new());
        }
        let mut all = Vec::with_capacity(poses);
        for pose in (0..poses).filter(|k| *k != self.settings.reference_pose) {
            let others: Vec<bool> =
                self.observations.iter().zip(active).map(|(o, a)| *a && o.pose != pose).collect();
            let mut without = state.clone();
            // Points that only this pose shows would be predicted from themselves.
            let mut elsewhere = vec![false; state.plate.len()];
            for (o, _) in self.observations.iter().zip(&others).filter(|(_, a)| **a) {
                elsewhere[o.point] = true;
            }
            for (i, xy) in without.plate.iter_mut().enumerate() {
                if self.data.plate_mm[i].is_none() && !elsewhere[i] {
                    *xy = None;
                }
            }
            // the others may not determine everything: that is no fault of the calibration
            if self.minimise(&mut without, &others, false).is_ok() {
                all.extend(self.predict_pose(&without, active, pose)?);
            }
        }
        Ok(all)
    }

    /// Decodes a pose and lays the plate upon it; nothing if too few points remain.
    fn predict_pose(&self, state: &State, active: &[bool], pose: usize) -> Result<Option<LeftOut>, RigError> {
        let model = OpticalModel::with_maps(&state.optics, self.maps.clone())?;
        let used: Vec<_> = self
            .observations
            .iter()
            .zip(active)
            .filter_map(|(o, a)| (*a && o.pose == pose).then_some(o))
            .collect();
        let (mut plate, mut decoded, mut variance) = (Vec::new(), Vec::new(), Vector3::zeros());
        for both in used.windows(2).filter(|w| w[0].point == w[1].point) {
            let pair = PixelPair { minus_px: both[0].px, plus_px: both[1].px };
            let (Some([x, y]), Ok(d)) = (state.plate[both[0].point], model.decode(Decoder::Ray, pair)) else {
                continue;
            };
            plate.push(Vector3::new(x, y, 0.0));
            decoded.push(d.point_mm);
            variance += d.covariance_mm2(&pixel_covariance(both[0].sigma_px, both[1].sigma_px)).diagonal();
        }
        let all: Vec<usize> = (0..plate.len()).collect();
        let Some(laid) =
            (plate.len() >= super::geometry::FEWEST).then(|| lay_all(&all, &plate, &decoded)).flatten()
        else {
            return Ok(None);
        };
        let n = plate.len() as f64;
        let mut square = Vector3::zeros();
        for (from, to) in plate.iter().zip(&decoded) {
            let off = laid.point_mm([from.x, from.y]) - to;
            square += off.component_mul(&off) / n;
        }
        Ok(Some(LeftOut {
            pose,
            points: plate.len(),
            rms_mm: square.map(f64::sqrt).into(),
            expected_mm: (variance / n).map(f64::sqrt).into(),
        }))
    }
}
