//! Displacement gradients by local least squares.
//!
//! Where all points of a (clipped or moved) window count, the fit is separable: moments along the rows
//! with the Gram polynomials of the stretch, then down the columns. Everywhere else the normal equations
//! are solved for the points that are there (`scattered.rs`). Every point is computed from its own window
//! alone, in a fixed order: results do not depend on the number of threads.

use super::error_correlation::ErrorCorrelation;
use super::gram::{Gram, MOST};
use super::scattered::{Scattered, Scratch};
use super::{Field, Method, Settings, StrainError, StrainStatus};
use rayon::prelude::*;

/// Fitted displacement and its gradient at a node. Where the status is not ok every number is NaN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gradient {
    /// Verdict.
    pub status: StrainStatus,
    /// Points that took part.
    pub used: u32,
    /// Fitted displacement (u, v), pixels.
    pub displacement: [f64; 2],
    /// [∂u/∂x, ∂u/∂y], [∂v/∂x, ∂v/∂y].
    pub gradient: [[f64; 2]; 2],
    /// Variance of ∂/∂x, of ∂/∂y and their covariance, for u and for v, from the uncertainties of the
    /// displacements and the correlation of overlapping subsets; NaN where an uncertainty is unknown.
    /// Errors of u and v count as independent.
    pub covariance: [[f64; 3]; 2],
}

impl Gradient {
    pub(crate) fn failed(status: StrainStatus, used: u32) -> Self {
        let nan = f64::NAN;
        Self { status, used, displacement: [nan; 2], gradient: [[nan; 2]; 2], covariance: [[nan; 3]; 2] }
    }
}

/// Gradients at all nodes of a field.
#[derive(Debug, Clone, PartialEq)]
pub struct Gradients {
    /// Nodes along x.
    pub columns: usize,
    /// Nodes along y.
    pub rows: usize,
    /// One entry per node, row by row.
    pub points: Vec<Gradient>,
}

impl Gradients {
    /// Number of nodes with a gradient.
    pub fn ok(&self) -> usize {
        self.points.iter().filter(|p| p.status.is_ok()).count()
    }
}

/// The window of a node along one axis: points start..start + len, the node is number `at` of them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stretch {
    pub(crate) start: usize,
    pub(crate) len: usize,
    pub(crate) at: usize,
}

fn stretches(points: usize, settings: &Settings) -> Vec<Stretch> {
    let (w, m) = (settings.window, settings.window / 2);
    (0..points)
        .map(|i| {
            let (start, end) = match settings.method {
                Method::Vsg(_) => (i.saturating_sub(m), (i + m + 1).min(points)),
                // moved inwards; the window fits, that was checked
                Method::SavitzkyGolay(_) => {
                    let start = i.saturating_sub(m).min(points - w);
                    (start, start + w)
                }
            };
            Stretch { start, len: end - start, at: i - start }
        })
        .collect()
}

/// How many of a rectangle's nodes have a property, in constant time.
struct Counts {
    sums: Vec<u32>,
    columns: usize,
}

impl Counts {
    fn new(columns: usize, rows: usize, has: impl Fn(usize, usize) -> bool) -> Self {
        let mut sums = vec![0u32; (columns + 1) * (rows + 1)];
        for j in 0..rows {
            let mut row = 0;
            for i in 0..columns {
                row += u32::from(has(i, j));
                sums[(j + 1) * (columns + 1) + i + 1] = sums[j * (columns + 1) + i + 1] + row;
            }
        }
        Self { sums, columns }
    }

    fn of(&self, x: (usize, usize), y: (usize, usize)) -> u32 {
        let at = |i: usize, j: usize| self.sums[j * (self.columns + 1) + i];
        at(x.1, y.1) + at(x.0, y.0) - at(x.0, y.1) - at(x.1, y.0)
    }
}

/// Which neighbours a node is linked to.
pub(crate) struct Links<'a> {
    pub(crate) field: &'a Field,
    pub(crate) valid: &'a [bool],
    max_jump: f64,
}

impl Links<'_> {
    /// Whether the material between two adjacent nodes is whole.
    pub(crate) fn linked(&self, a: usize, b: usize) -> bool {
        let f = self.field;
        self.valid[a]
            && self.valid[b]
            && (f.u[a] - f.u[b]).abs() <= self.max_jump
            && (f.v[a] - f.v[b]).abs() <= self.max_jump
    }
}

/// What depends on the length of a stretch alone.
struct Basis {
    gram: Gram,
    /// Σ_ik p_a(i) p_c(k) r_t(|i − k|) for every term t of the error correlation: [x-part, y-part].
    noise: Vec<[[[f64; MOST]; MOST]; 2]>,
}

impl Basis {
    fn new(length: usize, degree: usize, correlation: &ErrorCorrelation) -> Option<Self> {
        let gram = Gram::new(length, degree)?;
        let form = |r: &[f64]| {
            let mut out = [[0.0; MOST]; MOST];
            for a in 0..=degree {
                for c in 0..=degree {
                    let (p, q) = (&gram.values[a], &gram.values[c]);
                    for (i, p) in p.iter().enumerate() {
                        let low = i.saturating_sub(r.len() - 1);
                        let high = (i + r.len()).min(length);
                        out[a][c] += (low..high).map(|k| p * q[k] * r[i.abs_diff(k)]).sum::<f64>();
                    }
                }
            }
            out
        };
        let noise = correlation.terms.iter().map(|(x, y)| [form(x), form(y)]).collect();
        Some(Self { gram, noise })
    }
}

/// Number of quantities whose moments are taken: u, v, and their variances (order 0 only).
const FIELDS: usize = 2;

/// Displacement gradients at every node of `field`.
///
/// Runs on the current rayon thread pool; the result does not depend on its size.
///
/// # Errors
/// [`StrainError`] for settings or arrays that cannot be used; what fails at single points is their
/// [`StrainStatus`].
pub fn gradients(field: &Field, settings: &Settings) -> Result<Gradients, StrainError> {
    settings.validate()?;
    field.validate()?;
    let (columns, rows) = (field.columns, field.rows);
    if settings.window > columns || settings.window > rows {
        return Err(StrainError::WindowLargerThanField { window: settings.window, columns, rows });
    }
    let valid: Vec<bool> = (0..columns * rows).map(|node| field.is_valid(node)).collect();
    let links = Links { field, valid: &valid, max_jump: settings.max_jump.unwrap_or(f64::INFINITY) };
    let work = Work::new(field, settings, &links);
    let mut points = vec![Gradient::failed(StrainStatus::NoDisplacement, 0); columns * rows];
    points.par_chunks_mut(columns).enumerate().for_each_init(Scratch::default, |scratch, (j, row)| {
        for (i, out) in row.iter_mut().enumerate() {
            *out = work.point(i, j, scratch);
        }
    });
    Ok(Gradients { columns, rows, points })
}

struct Work<'a> {
    field: &'a Field,
    settings: &'a Settings,
    links: &'a Links<'a>,
    degree: usize,
    x: Vec<Stretch>,
    y: Vec<Stretch>,
    /// By length.
    bases: Vec<Option<Basis>>,
    correlation: ErrorCorrelation,
    missing: Counts,
    cut_right: Counts,
    cut_below: Counts,
    unknown: [Counts; 2],
    /// Row moments: [quantity][degree][node].
    moments: [Vec<Vec<f64>>; FIELDS],
    /// Σ σ² along the row's stretch.
    variances: [Vec<f64>; FIELDS],
}

impl<'a> Work<'a> {
    fn new(field: &'a Field, settings: &'a Settings, links: &'a Links<'a>) -> Self {
        let (columns, rows) = (field.columns, field.rows);
        let degree = settings.method.degree();
        let correlation = ErrorCorrelation::new(field.subset, field.shape, field.step);
        let (x, y) = (stretches(columns, settings), stretches(rows, settings));
        let mut used = vec![false; settings.window + 1];
        x.iter().chain(&y).for_each(|s| used[s.len] = true);
        let bases: Vec<Option<Basis>> = used
            .par_iter()
            .enumerate()
            .map(|(length, used)| used.then(|| Basis::new(length, degree, &correlation)).flatten())
            .collect();
        let node = |i: usize, j: usize| j * columns + i;
        let missing = Counts::new(columns, rows, |i, j| !links.valid[node(i, j)]);
        let parted = |a: usize, b: usize| links.valid[a] && links.valid[b] && !links.linked(a, b);
        let cut_right =
            Counts::new(columns, rows, |i, j| i + 1 < columns && parted(node(i, j), node(i + 1, j)));
        let cut_below = Counts::new(columns, rows, |i, j| j + 1 < rows && parted(node(i, j), node(i, j + 1)));
        let unknown = [&field.sigma_u, &field.sigma_v].map(|sigma| {
            Counts::new(columns, rows, |i, j| {
                let s = sigma[node(i, j)];
                links.valid[node(i, j)] && !(s.is_finite() && s >= 0.0)
            })
        });
        let mut work = Self {
            field,
            settings,
            links,
            degree,
            x,
            y,
            bases,
            correlation,
            missing,
            cut_right,
            cut_below,
            unknown,
            moments: Default::default(),
            variances: Default::default(),
        };
        work.moments = [&field.u, &field.v].map(|values| work.row_moments(values));
        work.variances = [&field.sigma_u, &field.sigma_v].map(|sigma| work.row_variances(sigma));
        work
    }

    /// Σ_k p_a(k) f over each node's stretch of its row; nodes without a value count as zero (windows that
    /// hold one are not evaluated from these).
    fn row_moments(&self, values: &[f64]) -> Vec<Vec<f64>> {
        let columns = self.field.columns;
        (0..=self.degree)
            .map(|a| {
                let mut out = vec![0.0; values.len()];
                out.par_chunks_mut(columns).enumerate().for_each(|(j, out)| {
                    let nodes = j * columns..(j + 1) * columns;
                    let row: Vec<f64> =
                        nodes.map(|n| if self.links.valid[n] { values[n] } else { 0.0 }).collect();
                    for (i, out) in out.iter_mut().enumerate() {
                        let s = self.x[i];
                        if let Some(basis) = &self.bases[s.len] {
                            let p = &basis.gram.values[a];
                            *out = p.iter().zip(&row[s.start..s.start + s.len]).map(|(p, f)| p * f).sum();
                        }
                    }
                });
                out
            })
            .collect()
    }

    fn row_variances(&self, sigma: &[f64]) -> Vec<f64> {
        let columns = self.field.columns;
        let mut out = vec![0.0; sigma.len()];
        out.par_chunks_mut(columns).enumerate().for_each(|(j, out)| {
            for (i, out) in out.iter_mut().enumerate() {
                let s = self.x[i];
                let nodes = j * columns + s.start..j * columns + s.start + s.len;
                *out = nodes
                    .filter(|&n| self.links.valid[n] && sigma[n].is_finite())
                    .map(|n| sigma[n] * sigma[n])
                    .sum();
            }
        });
        out
    }

    fn point(&self, i: usize, j: usize, scratch: &mut Scratch) -> Gradient {
        let (x, y) = (self.x[i], self.y[j]);
        if !self.links.valid[j * self.field.columns + i] {
            return Gradient::failed(StrainStatus::NoDisplacement, 0);
        }
        let (from, to) = ((x.start, y.start), (x.start + x.len, y.start + y.len));
        let whole = self.missing.of((from.0, to.0), (from.1, to.1)) == 0
            && self.cut_right.of((from.0, to.0 - 1), (from.1, to.1)) == 0
            && self.cut_below.of((from.0, to.0), (from.1, to.1 - 1)) == 0;
        let area = x.len * y.len;
        let least = self.settings.min_fraction * (self.settings.window * self.settings.window) as f64;
        if whole && (area as f64) < least {
            return Gradient::failed(StrainStatus::TooFewPoints, area as u32);
        }
        if whole {
            return match (&self.bases[x.len], &self.bases[y.len]) {
                (Some(along_x), Some(along_y)) => self.rectangle(i, j, along_x, along_y),
                _ => Gradient::failed(StrainStatus::IllConditioned, area as u32),
            };
        }
        if let Method::SavitzkyGolay(_) = self.settings.method {
            let there = area as u32 - self.missing.of((from.0, to.0), (from.1, to.1));
            return Gradient::failed(StrainStatus::IncompleteWindow, there);
        }
        Scattered {
            links: self.links,
            correlation: &self.correlation,
            quadratic: self.degree == 2,
            half: (self.settings.window / 2) as f64,
            least,
        }
        .fit(x, y, scratch)
    }

    fn rectangle(&self, i: usize, j: usize, along_x: &Basis, along_y: &Basis) -> Gradient {
        let (x, y) = (self.x[i], self.y[j]);
        let (px, dx) = along_x.gram.at(x.at);
        let (py, dy) = along_y.gram.at(y.at);
        let n = self.degree;
        let columns = self.field.columns;
        let (mut displacement, mut gradient) = ([0.0; 2], [[0.0; 2]; 2]);
        for c in 0..FIELDS {
            for a in 0..=n {
                let moments = &self.moments[c][a];
                for b in 0..=n - a {
                    let p = &along_y.gram.values[b];
                    let moment: f64 =
                        p.iter().enumerate().map(|(k, p)| p * moments[(y.start + k) * columns + i]).sum();
                    displacement[c] += px[a] * py[b] * moment;
                    gradient[c][0] += dx[a] * py[b] * moment;
                    gradient[c][1] += px[a] * dy[b] * moment;
                }
            }
            gradient[c] = gradient[c].map(|g| g / self.field.step);
        }
        let factors = self.noise_factors(along_x, along_y, [(&dx, &py), (&px, &dy)]);
        let area = x.len * y.len;
        let covariance = std::array::from_fn(|c| {
            if self.unknown[c].of((x.start, x.start + x.len), (y.start, y.start + y.len)) > 0 {
                return [f64::NAN; 3];
            }
            let sum: f64 = (0..y.len).map(|k| self.variances[c][(y.start + k) * columns + i]).sum();
            factors.map(|f| f * sum / area as f64 / (self.field.step * self.field.step))
        });
        Gradient { status: StrainStatus::Ok, used: area as u32, displacement, gradient, covariance }
    }

    /// Variances of the slopes along x and y and their covariance for points of unit variance, per
    /// grid step.
    fn noise_factors(
        &self,
        along_x: &Basis,
        along_y: &Basis,
        w: [(&[f64; MOST], &[f64; MOST]); 2],
    ) -> [f64; 3] {
        let n = self.degree;
        let mut out = [0.0; 3];
        for (out, (f, g)) in out.iter_mut().zip([(w[0], w[0]), (w[1], w[1]), (w[0], w[1])]) {
            for (x, y) in along_x.noise.iter().zip(&along_y.noise) {
                for a in 0..=n {
                    for b in 0..=n - a {
                        let left = f.0[a] * f.1[b];
                        for c in 0..=n {
                            for d in 0..=n - c {
                                *out += left * g.0[c] * g.1[d] * x[0][a][c] * y[1][b][d];
                            }
                        }
                    }
                }
            }
        }
        out
    }
}
