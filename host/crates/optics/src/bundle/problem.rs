//! What is estimated from what: columns, residuals and their derivatives.

use nalgebra::{DMatrix, Matrix2, Vector2};

use super::check::{REFERENCE, moves_known};
use super::normal::{Block, Normal, Step};
use super::{Known, Pose, RigData, RigError, RigSettings};
use crate::grating::Axes;
use crate::maps::DistortionMaps;
use crate::model::{Setup, TraceError};
use crate::parameter::{GratingParameter, OF_ONE_VIEW, Parameter};
use crate::project::{near, project};
use crate::real::{Dual, Real, dot};
use crate::robust::Loss;
use crate::setup::{Optics, View};

/// Derivatives by the object point, then by the parameters of one view.
type D = Dual<{ 3 + OF_ONE_VIEW }>;
/// Derivatives of an object point by the pose's angles and translation, the plate coordinates and
/// the plate's scale.
type OfPlate = Dual<9>;

/// Usual uncertainty of an angle or of a length of a rig before it is calibrated.
const ANGLE_RAD: f64 = 0.1;
const LENGTH_MM: f64 = 5.0;

/// Derivatives by column, residual, and whether it is a parameter's own prior.
type PriorRow = (Vec<(usize, f64)>, f64, bool);

/// Everything that is estimated.
#[derive(Clone)]
pub(super) struct State {
    pub(super) optics: Optics,
    pub(super) poses: Vec<Pose>,
    pub(super) plate: Vec<Option<[f64; 2]>>,
    pub(super) stage: [f64; 3],
    pub(super) scale: f64,
}

/// A pixel of one point in one pose.
pub(super) struct Observation {
    pub(super) point: usize,
    pub(super) pose: usize,
    pub(super) view: View,
    pub(super) px: [f64; 2],
    pub(super) sigma_px: [f64; 2],
}

/// A parameter and its prior: value and standard deviation.
pub(super) struct Unknown {
    pub(super) parameter: Parameter,
    pub(super) prior: Option<Known>,
}

pub(super) struct Problem<'a> {
    pub(super) maps: &'a DistortionMaps,
    pub(super) data: &'a RigData,
    pub(super) settings: &'a RigSettings,
    pub(super) unknowns: Vec<Unknown>,
    /// Ordered by point, pose, view.
    pub(super) observations: Vec<Observation>,
    /// First column of each pose; none for the reference.
    poses_at: Vec<Option<usize>>,
    stage_at: Option<usize>,
    pub(super) scale_at: Option<usize>,
    columns: usize,
}

impl<'a> Problem<'a> {
    pub(super) fn new(
        start: &Optics,
        maps: &'a DistortionMaps,
        data: &'a RigData,
        settings: &'a RigSettings,
    ) -> Self {
        let mut unknowns: Vec<Unknown> = settings
            .parameters
            .iter()
            .map(|e| Unknown {
                parameter: e.parameter,
                prior: e.prior_sigma.map(|sigma| Known { value: e.parameter.get(start), sigma }),
            })
            .collect();
        // Without plate coordinates nothing says where on the plate the origin is.
        let of_plane = if data.plate_mm.iter().any(Option::is_some) { 6 } else { 3 };
        unknowns.extend(REFERENCE[..of_plane].iter().map(|p| Unknown { parameter: *p, prior: None }));
        let mut observations = Vec::new();
        for (pose, p) in data.poses.iter().enumerate() {
            for s in &p.sightings {
                for view in View::BOTH {
                    if let Some(seen) = s.view(view) {
                        let (px, sigma_px) = (seen.px, seen.sigma_px);
                        observations.push(Observation { point: s.point, pose, view, px, sigma_px });
                    }
                }
            }
        }
        observations.sort_by_key(|o| (o.point, o.pose, o.view == View::Plus));
        let mut columns = unknowns.len();
        let mut take = |n: usize| {
            columns += n;
            columns - n
        };
        let poses_at =
            (0..data.poses.len()).map(|k| (k != settings.reference_pose).then(|| take(6))).collect();
        let stage_at = moves_known(data, settings).then(|| take(3));
        Self { maps, data, settings, unknowns, observations, poses_at, stage_at, scale_at: None, columns }
    }

    /// Whether the directions of the stage's axes are estimated.
    pub(super) fn stage_estimated(&self) -> bool {
        self.stage_at.is_some()
    }

    /// Whether the size of the plate is estimated.
    pub(super) fn free_scale(&mut self, free: bool) {
        match (self.scale_at.take(), free) {
            (None, true) => {
                self.scale_at = Some(self.columns);
                self.columns += 1;
            }
            (Some(_), false) => self.columns -= 1,
            (before, _) => self.scale_at = before,
        }
    }

    /// The pixel that the state predicts, if the point has coordinates.
    pub(super) fn predict(
        &self,
        state: &State,
        plain: &Setup<f64>,
        newton: &Setup<Dual<2>>,
        o: &Observation,
    ) -> Option<Result<[f64; 2], TraceError>> {
        let [x, y] = state.plate[o.point]?;
        let size = self.size_of(o.point, state);
        let p = state.poses[o.pose].point_mm([x * size, y * size]);
        Some(project(plain, newton, o.view, p.into(), near(&state.optics, o.px)))
    }

    /// The scale applies to coordinates that were stated.
    fn size_of(&self, point: usize, state: &State) -> f64 {
        if self.data.plate_mm[point].is_some() { state.scale } else { 1.0 }
    }

    /// Residuals (observed − predicted, px) of the observations in use; zero for others.
    pub(super) fn residuals(&self, state: &State, active: &[bool]) -> Result<Vec<[f64; 2]>, TraceError> {
        let plain = Setup::<f64>::new(&state.optics, self.maps);
        let newton = Setup::new(&state.optics, self.maps);
        let mut all = vec![[0.0; 2]; active.len()];
        for ((o, r), _) in self.observations.iter().zip(&mut all).zip(active).filter(|(_, a)| **a) {
            if let Some(p) = self.predict(state, &plain, &newton, o) {
                let p = p?;
                *r = [o.px[0] - p[0], o.px[1] - p[1]];
            }
        }
        Ok(all)
    }

    /// Residuals divided by their standard deviations, of the observations in use.
    pub(super) fn normalised(&self, residuals: &[[f64; 2]], active: &[bool]) -> Vec<f64> {
        let used = self.observations.iter().zip(residuals).zip(active).filter(|(_, a)| **a);
        used.flat_map(|((o, r), _)| [r[0] / o.sigma_px[0], r[1] / o.sigma_px[1]]).collect()
    }

    pub(super) fn poses_in_use(&self, active: &[bool]) -> Vec<bool> {
        let mut used = vec![false; self.data.poses.len()];
        for (o, _) in self.observations.iter().zip(active).filter(|(_, a)| **a) {
            used[o.pose] = true;
        }
        used
    }

    /// Residuals of what is known beforehand: derivatives and value, each divided by its standard
    /// deviation; the parameters' own come first and are marked.
    pub(super) fn known(&self, state: &State, used: &[bool]) -> Vec<PriorRow> {
        let mut all = Vec::new();
        for (j, u) in self.unknowns.iter().enumerate() {
            if let Some(Known { value, sigma }) = u.prior {
                let r = (value - u.parameter.get(&state.optics)) / sigma;
                all.push((vec![(j, 1.0 / sigma)], r, true));
            }
        }
        if let Some(at) = self.stage_at {
            let sigma = self.settings.stage_axes_sigma_rad;
            for (i, angle) in state.stage.into_iter().enumerate() {
                all.push((vec![(at + i, 1.0 / sigma)], -angle / sigma, false));
            }
        }
        let v = |i: usize, value: f64| Dual::<6>::variable(value, i);
        let axes = Axes::new([0, 1, 2].map(|i| v(3 + i, state.stage[i])));
        for (k, pose) in self.data.poses.iter().enumerate() {
            let Some(at) = self.poses_at[k].filter(|_| used[k]) else { continue };
            for (i, known) in pose.known.rotation_rad.iter().enumerate() {
                if let Some(Known { value, sigma }) = known {
                    let r = (value - state.poses[k].rotation_rad[i]) / sigma;
                    all.push((vec![(at + i, 1.0 / sigma)], r, false));
                }
            }
            let t = [0, 1, 2].map(|i| v(i, state.poses[k].translation_mm[i]));
            let along = [dot(axes.across, t), dot(axes.along, t), dot(axes.normal, t)];
            for (known, along) in pose.known.translation_mm.iter().zip(along) {
                if let Some(Known { value, sigma }) = known {
                    let mut row: Vec<_> = (0..3).map(|i| (at + 3 + i, along.gradient[i] / sigma)).collect();
                    if let Some(stage) = self.stage_at {
                        row.extend((0..3).map(|i| (stage + i, along.gradient[3 + i] / sigma)));
                    }
                    all.push((row, (value - along.value) / sigma, false));
                }
            }
        }
        all
    }

    /// Normal equations at `state`.
    pub(super) fn linearise(&self, state: &State, active: &[bool], loss: Loss) -> Result<Normal, TraceError> {
        let place = |p| self.unknowns.iter().position(|u| u.parameter == p);
        let setups = View::BOTH.map(|view| {
            Setup::<D>::with(&state.optics, self.maps, |p, value| match (place(p), p.index_in(view)) {
                (Some(_), Some(slot)) => Dual::variable(value, 3 + slot),
                _ => Dual::constant(value),
            })
        });
        let newton = Setup::new(&state.optics, self.maps);
        let slots = View::BOTH.map(|view| -> Vec<(usize, usize)> {
            let unknowns = self.unknowns.iter().enumerate();
            unknowns.filter_map(|(j, u)| Some((j, 3 + u.parameter.index_in(view)?))).collect()
        });
        let axes: Vec<Axes<OfPlate>> = state
            .poses
            .iter()
            .map(|p| Axes::new([0, 1, 2].map(|i| OfPlate::variable(p.rotation_rad[i], i))))
            .collect();

        let mut normal = Normal::new(self.columns);
        for (unit, scale) in normal.unit.iter_mut().zip(self.scales(state)) {
            *unit = scale;
        }
        for at in self.poses_at.iter().flatten() {
            normal.unit.rows_mut(at + 3, 3).fill(LENGTH_MM);
        }
        let mut row: Vec<(usize, f64)> = Vec::new();
        for (group, active) in self.by_point(active) {
            let point = group[0].point;
            let Some(xy) = state.plate[point] else { continue };
            let stated = self.data.plate_mm[point].is_some();
            let mut block = Block { point, c: Matrix2::zeros(), rhs: Vector2::zeros(), by: Vec::new() };
            let mut by = vec![Vector2::zeros(); if stated { 0 } else { self.columns }];
            for (o, _) in group.iter().zip(active).filter(|(_, a)| **a) {
                let size = OfPlate::variable(self.size_of(point, state), 8);
                let (x, y) = (OfPlate::variable(xy[0], 6) * size, OfPlate::variable(xy[1], 7) * size);
                let t = state.poses[o.pose].translation_mm;
                let at = [0, 1, 2].map(|i| {
                    let a = &axes[o.pose];
                    a.across[i] * x + a.along[i] * y + OfPlate::variable(t[i], 3 + i)
                });
                let p = [0, 1, 2].map(|i| D::variable(at[i].value, i));
                let pixel = project(&setups[o.view.index()], &newton, o.view, p, near(&state.optics, o.px))?;
                for (c, pixel) in pixel.iter().enumerate() {
                    let sigma = o.sigma_px[c];
                    let g = &pixel.gradient;
                    let r = (o.px[c] - pixel.value) / sigma;
                    let w = loss.weight(r);
                    let of_plate = |i: usize| (0..3).map(|k| g[k] * at[k].gradient[i]).sum::<f64>() / sigma;
                    row.clear();
                    row.extend(slots[o.view.index()].iter().map(|(j, slot)| (*j, g[*slot] / sigma)));
                    if let Some(first) = self.poses_at[o.pose] {
                        row.extend((0..6).map(|i| (first + i, of_plate(i))));
                    }
                    if let Some(scale) = self.scale_at.filter(|_| stated) {
                        row.push((scale, of_plate(8)));
                    }
                    normal.add(&row, r, w);
                    if !stated {
                        let own = Vector2::new(of_plate(6), of_plate(7));
                        block.c += own * own.transpose() * w;
                        block.rhs += own * (w * r);
                        for (j, g) in &row {
                            by[*j] += own * (w * g);
                        }
                    }
                }
            }
            if !stated && block.c != Matrix2::zeros() {
                let touched = by.into_iter().enumerate().filter(|(_, b)| *b != Vector2::zeros());
                block.by = touched.collect();
                normal.blocks.push(block);
            }
        }
        let used = self.poses_in_use(active);
        for (row, r, prior) in self.known(state, &used) {
            if let ([(j, g)], true) = (row.as_slice(), prior) {
                normal.prior[*j] += g * g;
                normal.rhs[*j] += g * r;
            } else {
                normal.add(&row, r, 1.0);
            }
        }
        // A pose without data stays where it is.
        for at in self.poses_at.iter().zip(&used).filter_map(|(at, used)| at.filter(|_| !used)) {
            for i in 0..6 {
                normal.a[(at + i, at + i)] += 1.0;
            }
        }
        Ok(normal)
    }

    /// Observations of each point, and which of them are in use.
    fn by_point<'b>(&'b self, active: &'b [bool]) -> impl Iterator<Item = (&'b [Observation], &'b [bool])> {
        let mut at = 0;
        self.observations.chunk_by(|a, b| a.point == b.point).map(move |group| {
            let from = at;
            at += group.len();
            (group, &active[from..at])
        })
    }

    pub(super) fn moved(&self, state: &State, step: &Step) -> State {
        let mut next = state.clone();
        let by = &step.columns;
        for (j, u) in self.unknowns.iter().enumerate() {
            u.parameter.set(&mut next.optics, u.parameter.get(&state.optics) + by[j]);
        }
        for (pose, at) in next.poses.iter_mut().zip(&self.poses_at) {
            if let Some(at) = at {
                for i in 0..3 {
                    pose.rotation_rad[i] += by[at + i];
                    pose.translation_mm[i] += by[at + 3 + i];
                }
            }
        }
        if let Some(at) = self.stage_at {
            (0..3).for_each(|i| next.stage[i] += by[at + i]);
        }
        if let Some(at) = self.scale_at {
            next.scale += by[at];
        }
        for (point, by) in &step.points {
            if let Some([x, y]) = &mut next.plate[*point] {
                *x += by.x;
                *y += by.y;
            }
        }
        next
    }

    /// Covariance of all columns, or what is not determined.
    pub(super) fn covariance(&self, normal: &Normal, state: &State) -> Result<DMatrix<f64>, RigError> {
        normal.covariance().ok_or_else(|| {
            let parameters: Vec<Parameter> = self.unknowns.iter().map(|u| u.parameter).collect();
            let found = normal.weak(&parameters, &self.scales(state));
            let combination = match found {
                Err(combination) => combination,
                Ok(weak) => weak.into_iter().next().map_or_else(Vec::new, |w| w.components),
            };
            RigError::Undetermined { combination }
        })
    }

    /// Unit of each parameter: its prior's standard deviation, or a usual one.
    pub(super) fn scales(&self, state: &State) -> Vec<f64> {
        let of = |u: &Unknown| match (u.prior, u.parameter.unit()) {
            (Some(prior), _) => prior.sigma,
            (None, "rad") => ANGLE_RAD,
            (None, "px") => 50.0,
            (None, "mm") => match u.parameter {
                Parameter::Wavelength | Parameter::Grating(_, GratingParameter::Pitch) => {
                    1e-3 * u.parameter.get(&state.optics)
                }
                _ => LENGTH_MM,
            },
            (None, _) => 1.0,
        };
        self.unknowns.iter().map(of).collect()
    }
}
