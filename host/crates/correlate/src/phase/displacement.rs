//! Displacement from the phases of two images.

use super::carrier::Carrier;
use super::interpolate::{Sample, inverse};
use super::map::{PhaseMap, PhaseMaps};
use super::settings::PhaseError;
use crate::point::{Point, ShapeParameters, SolvedBy, Status};
use crate::points::Points;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Iterations after which a point counts as not converged; three are usual.
const MOST_ITERATIONS: u16 = 20;
/// Increment at which the iteration stops, pixels.
const TOLERANCE: f64 = 1e-7;
/// How far two wave vectors of one grating may be apart, relative to their length.
const DIFFERENT: f64 = 0.4;

/// Displacement of every pixel of the reference image, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct PhaseField {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Displacement along x in pixels, Lagrangian; NaN where the status is not `Converged`.
    pub u: Vec<f64>,
    /// Displacement along y in pixels.
    pub v: Vec<f64>,
    /// Standard uncertainty of u from image noise, pixels.
    pub sigma_u: Vec<f32>,
    /// Standard uncertainty of v from image noise, pixels.
    pub sigma_v: Vec<f32>,
    /// Verdict on each pixel.
    pub status: Vec<Status>,
}

/// A grating direction in both images.
struct Direction<'a> {
    reference: &'a PhaseMap,
    deformed: &'a PhaseMap,
    /// −1 where the deformed image's wave vector points the other way.
    sign: f64,
    /// For every part of the reference (index 0: none): the part of the deformed image that shows
    /// it, and the whole turns between their phases.
    parts: Vec<(u32, f64)>,
}

/// Reference and deformed image of one grating, ready to give displacements.
///
/// The grating moves with the material, so that Φ_def(x + u) = Φ_ref(x): solved for u by the
/// iteration u ← u − G⁻¹(Φ_def(x + u) − Φ_ref(x)) with the gradients G of the deformed phases (the
/// fixed point of Grédiac, Sur & Blaysat, Strain 52 (2016) 205, there with G = 2π/p).
pub struct PhasePair<'a> {
    width: usize,
    height: usize,
    directions: Vec<Direction<'a>>,
}

/// Result at one position.
struct Solved {
    u: [f64; 2],
    sigma: [f64; 2],
    /// ∂u/∂x, ∂u/∂y, ∂v/∂x, ∂v/∂y.
    gradient: [f64; 4],
    iterations: u16,
}

impl<'a> PhasePair<'a> {
    /// Pairs the directions and the connected parts of both images.
    ///
    /// A grating repeats itself after one pitch: the displacement of each connected part is found
    /// up to whole pitches, and of the possible ones that nearest to `shift` (pixels, in the median
    /// over the part) is taken.
    ///
    /// # Errors
    /// [`PhaseError::SizesDiffer`], [`PhaseError::DifferentGratings`].
    pub fn new(
        reference: &'a PhaseMaps,
        deformed: &'a PhaseMaps,
        shift: [f64; 2],
    ) -> Result<Self, PhaseError> {
        let (width, height) = (reference.width, reference.height);
        if (deformed.width, deformed.height) != (width, height) {
            return Err(PhaseError::SizesDiffer {
                found_width: deformed.width,
                found_height: deformed.height,
                width,
                height,
            });
        }
        let mut directions: Vec<Direction<'a>> = Vec::new();
        for r in &reference.directions {
            let gap = |c: &Carrier, sign: f64| {
                (sign * c.fx - r.carrier.fx).hypot(sign * c.fy - r.carrier.fy) / r.carrier.frequency()
            };
            let nearest = deformed
                .directions
                .iter()
                .filter(|d| !directions.iter().any(|used| std::ptr::eq(used.deformed, *d)))
                .flat_map(|d| [1.0, -1.0].map(|sign| (gap(&d.carrier, sign), sign, d)))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let other = nearest.map_or(r, |n| n.2);
            match nearest {
                Some((gap, sign, d)) if gap < DIFFERENT => {
                    let parts = pair_parts(width, r, d, sign, shift);
                    directions.push(Direction { reference: r, deformed: d, sign, parts });
                }
                _ => {
                    return Err(PhaseError::DifferentGratings {
                        reference: r.carrier.pitch(),
                        reference_deg: r.carrier.angle().to_degrees(),
                        deformed: other.carrier.pitch(),
                        deformed_deg: other.carrier.angle().to_degrees(),
                    });
                }
            }
        }
        Ok(Self { width, height, directions })
    }

    /// Unit normal of the lines where both images show a line grating: displacements are then the
    /// component along it, as a vector, and say nothing about the component along the lines.
    pub fn line_normal(&self) -> Option<[f64; 2]> {
        match &self.directions[..] {
            [one] => {
                let c = one.reference.carrier;
                Some([c.fx / c.frequency(), c.fy / c.frequency()])
            }
            _ => None,
        }
    }

    /// Displacement of every pixel of the reference image.
    pub fn field(&self) -> PhaseField {
        let n = self.width * self.height;
        let mut field = PhaseField {
            width: self.width,
            height: self.height,
            u: vec![f64::NAN; n],
            v: vec![f64::NAN; n],
            sigma_u: vec![f32::NAN; n],
            sigma_v: vec![f32::NAN; n],
            status: vec![Status::OutOfImage; n],
        };
        field
            .u
            .par_chunks_mut(self.width)
            .zip(field.v.par_chunks_mut(self.width))
            .zip(field.sigma_u.par_chunks_mut(self.width))
            .zip(field.sigma_v.par_chunks_mut(self.width))
            .zip(field.status.par_chunks_mut(self.width))
            .enumerate()
            .for_each(|(y, ((((u, v), su), sv), status))| {
                let mut start = [0.0; 2];
                for x in 0..self.width {
                    match self.solve(x as f64, y as f64, start) {
                        Ok(s) => {
                            (u[x], v[x]) = (s.u[0], s.u[1]);
                            (su[x], sv[x]) = (s.sigma[0] as f32, s.sigma[1] as f32);
                            status[x] = Status::Converged;
                            start = s.u;
                        }
                        Err(reason) => status[x] = reason,
                    }
                }
            });
        field
    }

    /// Displacement at points of interest, in their order. `zncc` is NaN; `shape` holds the
    /// displacement and, for cross gratings, its first derivatives.
    pub fn points(&self, points: &Points) -> Vec<Point> {
        points
            .positions()
            .par_iter()
            .map(|&[x, y]| {
                let mut point = Point {
                    x,
                    y,
                    u: f64::NAN,
                    v: f64::NAN,
                    sigma_u: f32::NAN,
                    sigma_v: f32::NAN,
                    zncc: f32::NAN,
                    iterations: 0,
                    status: Status::Converged,
                    solver: SolvedBy::Phase,
                    shape: ShapeParameters::default(),
                };
                match self.solve(x, y, [0.0; 2]) {
                    Ok(s) => {
                        [point.u, point.v] = s.u;
                        [point.sigma_u, point.sigma_v] = s.sigma.map(|v| v as f32);
                        point.iterations = s.iterations;
                        let g = s.gradient.map(|v| v as f32);
                        point.shape.u = [s.u[0] as f32, g[0], g[1], 0.0, 0.0, 0.0];
                        point.shape.v = [s.u[1] as f32, g[2], g[3], 0.0, 0.0, 0.0];
                    }
                    Err(status) => point.status = status,
                }
                point
            })
            .collect()
    }

    /// Displacement of the material at (x, y); the start only saves iterations.
    fn solve(&self, x: f64, y: f64, start: [f64; 2]) -> Result<Solved, Status> {
        match &self.directions[..] {
            [a] => self.along_normal(a, x, y, start),
            [a, b] => self.both(a, b, x, y, start),
            _ => Err(Status::NoGuess),
        }
    }

    fn both(
        &self,
        a: &Direction<'_>,
        b: &Direction<'_>,
        x: f64,
        y: f64,
        start: [f64; 2],
    ) -> Result<Solved, Status> {
        let (ra, rb) = (a.at_reference(self.width, x, y)?, b.at_reference(self.width, x, y)?);
        let mut u = start;
        for iteration in 1..=MOST_ITERATIONS {
            let (px, py) = (x + u[0], y + u[1]);
            let (da, db) =
                (a.at_deformed(self.width, px, py, ra.part)?, b.at_deformed(self.width, px, py, rb.part)?);
            let g = inverse([da.gradient, db.gradient]).ok_or(Status::Singular)?;
            let e = [da.phase - ra.sample.phase, db.phase - rb.sample.phase];
            let d = [0, 1].map(|i| -(g[i][0] * e[0] + g[i][1] * e[1]));
            u = [u[0] + d[0], u[1] + d[1]];
            if d[0].abs().max(d[1].abs()) <= TOLERANCE {
                let sa = ra.sigma.hypot(a.deformed_sigma(self.width, px, py));
                let sb = rb.sigma.hypot(b.deformed_sigma(self.width, px, py));
                let sigma = [0, 1].map(|i| (g[i][0] * sa).hypot(g[i][1] * sb));
                // ∇Φ_ref = ∇Φ_def (1 + ∇u)
                let [ga, gb] = [ra.sample.gradient, rb.sample.gradient];
                let f = |i: usize, j: usize| g[i][0] * ga[j] + g[i][1] * gb[j];
                let gradient = [f(0, 0) - 1.0, f(0, 1), f(1, 0), f(1, 1) - 1.0];
                return Ok(Solved { u, sigma, gradient, iterations: iteration });
            }
        }
        Err(Status::NotConverged)
    }

    fn along_normal(&self, a: &Direction<'_>, x: f64, y: f64, start: [f64; 2]) -> Result<Solved, Status> {
        let r = a.at_reference(self.width, x, y)?;
        let c = a.reference.carrier;
        let n = [c.fx / c.frequency(), c.fy / c.frequency()];
        let mut along = start[0] * n[0] + start[1] * n[1];
        for iteration in 1..=MOST_ITERATIONS {
            let (px, py) = (x + along * n[0], y + along * n[1]);
            let d = a.at_deformed(self.width, px, py, r.part)?;
            let slope = d.gradient[0] * n[0] + d.gradient[1] * n[1];
            if slope.abs() < 0.1 * TAU * c.frequency() {
                return Err(Status::Singular);
            }
            let step = -(d.phase - r.sample.phase) / slope;
            along += step;
            if step.abs() <= TOLERANCE {
                let sigma = r.sigma.hypot(a.deformed_sigma(self.width, px, py)) / slope.abs();
                return Ok(Solved {
                    u: [along * n[0], along * n[1]],
                    sigma: [(sigma * n[0]).abs(), (sigma * n[1]).abs()],
                    gradient: [0.0; 4],
                    iterations: iteration,
                });
            }
        }
        Err(Status::NotConverged)
    }
}

/// Phase of the reference at a material point.
struct AtReference {
    sample: Sample,
    part: u32,
    sigma: f64,
}

impl Direction<'_> {
    fn at_reference(&self, width: usize, x: f64, y: f64) -> Result<AtReference, Status> {
        let map = self.reference;
        let k = map.pixel(width, x, y).ok_or(Status::OutOfImage)?;
        if !map.status[k].is_ok() {
            return Err(map.status[k]);
        }
        let part = map.label[k];
        let sample = map.sample(width, x, y, part).ok_or(Status::OutOfImage)?;
        Ok(AtReference { sample, part, sigma: f64::from(map.sigma[k]) })
    }

    /// Phase of the deformed image in the sense and with the turns of the reference.
    fn at_deformed(&self, width: usize, x: f64, y: f64, part: u32) -> Result<Sample, Status> {
        let (label, turns) = self.parts[part as usize];
        if label == 0 {
            return Err(Status::NoGuess);
        }
        let Some(s) = self.deformed.sample(width, x, y, label) else {
            let status = self.deformed.pixel(width, x, y).map(|k| self.deformed.status[k]);
            return Err(status.filter(|s| !s.is_ok()).unwrap_or(Status::OutOfImage));
        };
        Ok(Sample { phase: self.sign * s.phase - turns, gradient: s.gradient.map(|g| self.sign * g) })
    }

    fn deformed_sigma(&self, width: usize, x: f64, y: f64) -> f64 {
        self.deformed.pixel(width, x, y).map_or(f64::NAN, |k| f64::from(self.deformed.sigma[k]))
    }
}

/// For every part of the reference, the part of the deformed image found `shift` away at most of its
/// pixels, and the turns that leave the smallest median difference.
fn pair_parts(
    width: usize,
    reference: &PhaseMap,
    deformed: &PhaseMap,
    sign: f64,
    shift: [f64; 2],
) -> Vec<(u32, f64)> {
    let parts = reference.components;
    let mut votes = vec![std::collections::BTreeMap::<u32, Vec<f64>>::new(); parts + 1];
    for (k, &part) in reference.label.iter().enumerate() {
        if part == 0 {
            continue;
        }
        let (x, y) = ((k % width) as f64 + shift[0], (k / width) as f64 + shift[1]);
        let Some(m) = deformed.pixel(width, x, y) else { continue };
        if deformed.label[m] == 0 {
            continue;
        }
        // from the pixel to the position itself
        let (dx, dy) = (x - x.round(), y - y.round());
        let c = deformed.carrier;
        let phase = deformed.phase[m] + TAU * (c.fx * dx + c.fy * dy);
        votes[part as usize].entry(deformed.label[m]).or_default().push(sign * phase - reference.phase[k]);
    }
    votes
        .into_iter()
        .map(|found| {
            let most = found.into_iter().max_by(|a, b| a.1.len().cmp(&b.1.len()).then(b.0.cmp(&a.0)));
            let Some((label, mut differences)) = most else { return (0, 0.0) };
            let middle = differences.len() / 2;
            let median = *differences.select_nth_unstable_by(middle, f64::total_cmp).1;
            (label, TAU * (median / TAU).round())
        })
        .collect()
}
