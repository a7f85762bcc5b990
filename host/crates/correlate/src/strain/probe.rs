//! Values between the points of a field: single positions, lines, virtual extensometers.
//!
//! Displacements are interpolated linearly between the four grid points around a position (exact for a
//! homogeneous deformation); every point with a weight must have a value. Uncertainties follow from those
//! of the points and the correlation of overlapping subsets.

use super::error_correlation::ErrorCorrelation;
use super::fit::Gradient;
use super::{Field, Gradients, Strain, StrainError, StrainStatus, Tensor};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Verdict on a probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProbeStatus {
    /// Measured.
    Ok,
    /// The position lies outside the grid.
    Outside,
    /// A grid point that is needed has no displacement.
    MissingPoint,
}

impl ProbeStatus {
    /// Stable name: `ok`, else the reason.
    pub fn name(self) -> &'static str {
        match self {
            ProbeStatus::Ok => "ok",
            ProbeStatus::Outside => "outside",
            ProbeStatus::MissingPoint => "missing_point",
        }
    }

    /// Whether there is a value.
    pub fn is_ok(self) -> bool {
        self == ProbeStatus::Ok
    }
}

impl fmt::Display for ProbeStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Displacement and strain at a position. NaN where the status is not ok.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Probe {
    /// Position in the reference image, pixels.
    pub position: [f64; 2],
    /// Verdict on the displacement.
    pub status: ProbeStatus,
    /// (u, v), pixels.
    pub displacement: [f64; 2],
    /// Standard uncertainties of u and v; NaN where unknown.
    pub sigma: [f64; 2],
    /// Strain, where gradients were given; has its own status.
    pub strain: Option<Strain>,
}

/// Probes along a straight line.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Distance from the start, pixels.
    pub distance: Vec<f64>,
    /// The probes.
    pub points: Vec<Probe>,
}

/// Nodes and their weights, which sum to 1.
type Weights = Vec<(usize, f64)>;

fn usable(p: [f64; 2]) -> Result<(), StrainError> {
    if p.iter().all(|c| c.is_finite()) {
        return Ok(());
    }
    Err(StrainError::Probe { x: p[0], y: p[1], reason: "its coordinates must be finite numbers" })
}

/// The nodes around a position; weights that vanish are left out.
fn around(field: &Field, p: [f64; 2]) -> Result<Weights, ProbeStatus> {
    let cell = |c: f64, first: f64, nodes: usize| {
        let t = (c - first) / field.step;
        let last = nodes as f64 - 1.0;
        // positions on the border count as inside also where rounding took them a little out
        if nodes == 0 || !(-1e-9..=last + 1e-9).contains(&t) {
            return Err(ProbeStatus::Outside);
        }
        let t = t.clamp(0.0, last);
        let i = (t.floor() as usize).min(nodes.saturating_sub(2));
        Ok((i, t - i as f64))
    };
    let (i, s) = cell(p[0], field.x0, field.columns)?;
    let (j, t) = cell(p[1], field.y0, field.rows)?;
    let corner = |a: usize, b: usize, w: f64| ((j + b) * field.columns + i + a, w);
    let corners = [
        corner(0, 0, (1.0 - s) * (1.0 - t)),
        corner(1, 0, s * (1.0 - t)),
        corner(0, 1, (1.0 - s) * t),
        corner(1, 1, s * t),
    ];
    let weights: Weights = corners.into_iter().filter(|(_, w)| *w > 1e-12).collect();
    if weights.iter().all(|&(node, _)| field.is_valid(node)) {
        Ok(weights)
    } else {
        Err(ProbeStatus::MissingPoint)
    }
}

fn mean(values: &[f64], weights: &[(usize, f64)]) -> f64 {
    weights.iter().map(|&(node, w)| w * values[node]).sum()
}

/// Variance of Σ w f for values f with standard uncertainties `sigma`.
fn variance(field: &Field, sigma: &[f64], weights: &[(usize, f64)], correlation: &ErrorCorrelation) -> f64 {
    let mut sum = 0.0;
    for &(k, a) in weights {
        let (i, j) = (k % field.columns, k / field.columns);
        for &(l, b) in weights {
            let (m, n) = (l % field.columns, l / field.columns);
            sum += a * b * sigma[k] * sigma[l] * correlation.at(i.abs_diff(m), j.abs_diff(n));
        }
    }
    sum
}

fn root(variance: f64) -> f64 {
    // rounding may leave a vanishing variance below zero; NaN stays NaN
    if variance < 0.0 { 0.0 } else { variance.sqrt() }
}

fn gradient_at(gradients: &Gradients, weights: &[(usize, f64)]) -> Gradient {
    let first = weights.iter().map(|&(node, _)| &gradients.points[node]).find(|p| !p.status.is_ok());
    if let Some(failed) = first {
        return Gradient::failed(failed.status, failed.used);
    }
    let mut out = Gradient::failed(StrainStatus::Ok, u32::MAX);
    (out.displacement, out.gradient, out.covariance) = ([0.0; 2], [[0.0; 2]; 2], [[0.0; 3]; 2]);
    for &(node, w) in weights {
        let p = &gradients.points[node];
        out.used = out.used.min(p.used);
        for c in 0..2 {
            out.displacement[c] += w * p.displacement[c];
            for k in 0..2 {
                out.gradient[c][k] += w * p.gradient[c][k];
            }
            // windows one step apart share nearly all their points: their errors count as the same
            for k in 0..3 {
                out.covariance[c][k] += w * p.covariance[c][k];
            }
        }
    }
    out
}

fn probe(
    field: &Field,
    strain: Option<(&Gradients, Tensor)>,
    correlation: &ErrorCorrelation,
    position: [f64; 2],
) -> Probe {
    match around(field, position) {
        Ok(weights) => Probe {
            position,
            status: ProbeStatus::Ok,
            displacement: [mean(&field.u, &weights), mean(&field.v, &weights)],
            sigma: [&field.sigma_u, &field.sigma_v].map(|s| root(variance(field, s, &weights, correlation))),
            strain: strain.map(|(gradients, tensor)| Strain::of(&gradient_at(gradients, &weights), tensor)),
        },
        Err(status) => Probe {
            position,
            status,
            displacement: [f64::NAN; 2],
            sigma: [f64::NAN; 2],
            strain: strain
                .map(|(_, tensor)| Strain::of(&Gradient::failed(StrainStatus::NoDisplacement, 0), tensor)),
        },
    }
}

/// Displacement, and strain where gradients of the field are given, at a position in the reference image.
///
/// # Errors
/// [`StrainError`] for a position that is not finite, or arrays that do not fit the grid.
pub fn point(
    field: &Field,
    strain: Option<(&Gradients, Tensor)>,
    position: [f64; 2],
) -> Result<Probe, StrainError> {
    Ok(line(field, strain, position, position, 1)?.points[0])
}

/// Probes at `samples` equidistant positions from `from` to `to`, both included.
///
/// # Errors
/// As [`point`]; [`StrainError::Range`] for no sample or more than a million.
pub fn line(
    field: &Field,
    strain: Option<(&Gradients, Tensor)>,
    from: [f64; 2],
    to: [f64; 2],
    samples: usize,
) -> Result<Profile, StrainError> {
    const MOST: f64 = 1e6;
    field.validate()?;
    usable(from)?;
    usable(to)?;
    if !(1.0..=MOST).contains(&(samples as f64)) {
        return Err(StrainError::Range { name: "samples", value: samples as f64, min: 1.0, max: MOST });
    }
    if let Some((gradients, _)) = strain
        && gradients.points.len() != field.u.len()
    {
        let (columns, rows) = (field.columns, field.rows);
        return Err(StrainError::Length { name: "gradients", found: gradients.points.len(), columns, rows });
    }
    let correlation = ErrorCorrelation::new(field.subset, field.shape, field.step);
    let length = (to[0] - from[0]).hypot(to[1] - from[1]);
    let part = |k: usize| if samples == 1 { 0.0 } else { k as f64 / (samples - 1) as f64 };
    let points = (0..samples)
        .map(|k| {
            let t = part(k);
            let at = [0, 1].map(|c| from[c] * (1.0 - t) + to[c] * t);
            probe(field, strain, &correlation, at)
        })
        .collect();
    Ok(Profile { distance: (0..samples).map(|k| part(k) * length).collect(), points })
}

/// Two marks on the material whose distance is watched.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Extensometer {
    /// One end in the reference image, pixels.
    pub from: [f64; 2],
    /// The other end.
    pub to: [f64; 2],
    /// Radius of the area around each end over whose grid points the displacement is averaged, pixels; 0
    /// takes the value at the position itself.
    pub radius: f64,
}

/// What an [`Extensometer`] measured. NaN where the status is not ok.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Elongation {
    /// Verdict.
    pub status: ProbeStatus,
    /// The ends as they were used: with a radius the centroids of the grid points of each area.
    pub ends: [[f64; 2]; 2],
    /// Grid points per end.
    pub used: [usize; 2],
    /// Length in the reference image, pixels.
    pub length: f64,
    /// Length in the deformed image, pixels.
    pub deformed_length: f64,
    /// Engineering strain, deformed_length / length − 1.
    pub strain: f64,
    /// Standard uncertainty of the strain; NaN where unknown.
    pub sigma: f64,
}

impl Extensometer {
    fn end(&self, field: &Field, centre: [f64; 2]) -> Result<Weights, ProbeStatus> {
        if self.radius == 0.0 {
            return around(field, centre);
        }
        // the middle must lie in the field, so that an area that only touches it is not taken for one in it
        let inside = |c: f64, first: f64, nodes: usize| {
            let t = (c - first) / field.step;
            (-0.5..=nodes as f64 - 0.5).contains(&t)
        };
        if !inside(centre[0], field.x0, field.columns) || !inside(centre[1], field.y0, field.rows) {
            return Err(ProbeStatus::Outside);
        }
        let near: Vec<usize> = (0..field.u.len())
            .filter(|&node| {
                let p = field.position(node);
                (p[0] - centre[0]).hypot(p[1] - centre[1]) <= self.radius
            })
            .collect();
        let nodes: Vec<usize> = near.iter().copied().filter(|&node| field.is_valid(node)).collect();
        if nodes.is_empty() || 2 * nodes.len() < near.len() {
            return Err(ProbeStatus::MissingPoint);
        }
        let each = 1.0 / nodes.len() as f64;
        Ok(nodes.into_iter().map(|node| (node, each)).collect())
    }

    /// Measures the elongation in a field.
    ///
    /// # Errors
    /// [`StrainError::Probe`] for ends that are not finite or coincide, [`StrainError::Range`] for a
    /// radius below 0 or above 10⁴ px.
    pub fn measure(&self, field: &Field) -> Result<Elongation, StrainError> {
        const MOST: f64 = 1e4;
        field.validate()?;
        usable(self.from)?;
        usable(self.to)?;
        let [x, y] = self.to;
        if self.from == self.to {
            return Err(StrainError::Probe { x, y, reason: "the two ends of an extensometer must differ" });
        }
        if !(0.0..=MOST).contains(&self.radius) {
            return Err(StrainError::Range { name: "radius", value: self.radius, min: 0.0, max: MOST });
        }
        let nan = f64::NAN;
        let failed = |status| Elongation {
            status,
            ends: [self.from, self.to],
            used: [0; 2],
            length: nan,
            deformed_length: nan,
            strain: nan,
            sigma: nan,
        };
        let (a, b) = match (self.end(field, self.from), self.end(field, self.to)) {
            (Ok(a), Ok(b)) => (a, b),
            (Err(status), _) | (_, Err(status)) => return Ok(failed(status)),
        };
        let place = |weights: &[(usize, f64)], given: [f64; 2]| {
            if self.radius == 0.0 {
                return given;
            }
            [0, 1].map(|c| weights.iter().map(|&(node, w)| w * field.position(node)[c]).sum())
        };
        let ends: [[f64; 2]; 2] = [place(&a, self.from), place(&b, self.to)];
        let before: [f64; 2] = [0, 1].map(|c| ends[1][c] - ends[0][c]);
        let length = before[0].hypot(before[1]);
        if length <= 0.0 {
            // both areas hold the same points
            return Err(StrainError::Probe {
                x,
                y,
                reason: "both ends of the extensometer hold the same points",
            });
        }
        let moved = [&field.u, &field.v].map(|f| mean(f, &b) - mean(f, &a));
        let after = [before[0] + moved[0], before[1] + moved[1]];
        let deformed_length = after[0].hypot(after[1]);
        let correlation = ErrorCorrelation::new(field.subset, field.shape, field.step);
        let both: Weights = b.iter().copied().chain(a.iter().map(|&(node, w)| (node, -w))).collect();
        let sum: f64 = [(&field.sigma_u, after[0]), (&field.sigma_v, after[1])]
            .into_iter()
            .map(|(sigma, along)| {
                (along / deformed_length).powi(2) * variance(field, sigma, &both, &correlation)
            })
            .sum();
        Ok(Elongation {
            status: ProbeStatus::Ok,
            ends,
            used: [a.len(), b.len()],
            length,
            deformed_length,
            strain: (deformed_length - length) / length,
            sigma: root(sum) / length,
        })
    }
}
