//! The light of a point in the image plane of the objective: the Debye integral and its generalisation
//! over a two-dimensional pupil.

use crate::error::PsfError;
use crate::optics::Objective;
use rayon::prelude::*;
use rustfft::num_complex::Complex64;

/// Nodes and weights of the Gauss–Legendre rule of `n` points on [−1, 1].
pub(crate) fn gauss_legendre(n: usize) -> Vec<(f64, f64)> {
    (0..n)
        .map(|i| {
            let mut x = (std::f64::consts::PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
            let mut slope = 1.0;
            for _ in 0..100 {
                let (mut p, mut q) = (1.0, 0.0);
                for k in 0..n {
                    let k = k as f64;
                    (p, q) = (((2.0 * k + 1.0) * x * p - k * q) / (k + 1.0), p);
                }
                slope = n as f64 * (x * p - q) / (x * x - 1.0);
                let step = p / slope;
                x -= step;
                if step.abs() < 1e-16 {
                    break;
                }
            }
            (x, 2.0 / ((1.0 - x * x) * slope * slope))
        })
        .collect()
}

/// The largest of values that are not negative; NaN if any is, so that it does not count as settled.
fn largest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(0.0, |a, b| if a.is_nan() || b <= a { a } else { b })
}

/// Points of the rule in each panel.
const RULE: usize = 16;
/// Phase that one panel covers to begin with; 16 points integrate it to 1e-15.
const PHASE_OF_PANEL: f64 = 12.0;
/// Error of the integral that is accepted; its value on the axis is about α²/2.
const QUADRATURE_ERROR: f64 = 1e-11;
const MOST_NODES: usize = 1 << 16;

/// Composite Gauss–Legendre rule on [a, b].
fn composite(a: f64, b: f64, panels: usize) -> Vec<(f64, f64)> {
    let rule = gauss_legendre(RULE);
    let half = 0.5 * (b - a) / panels as f64;
    (0..panels)
        .flat_map(|p| {
            let middle = a + (2 * p + 1) as f64 * half;
            rule.iter().map(move |&(x, w)| (middle + half * x, half * w)).collect::<Vec<_>>()
        })
        .collect()
}

/// I(r, z) = ∫₀^α √cosθ exp(−i u sin²(θ/2)/(2 sin²(α/2))) J₀(k r sinθ) sinθ dθ, u = 4 k z sin²(α/2), for
/// one depth and many radii, with a statement of its error.
#[derive(Debug, Clone)]
pub struct RadialField {
    step: f64,
    values: Vec<Complex64>,
}

/// [`RadialField`]s of several depths.
#[derive(Debug, Clone)]
pub struct DebyeTable {
    /// One for each depth.
    pub planes: Vec<RadialField>,
    /// Absolute error of the integral, from halving the panels.
    pub error: f64,
}

/// The integral at given radii (object side, µm) and depths (away from the objective, µm): `[z][r]`, and the
/// largest change when the panels are halved.
///
/// # Errors
/// [`PsfError::Quadrature`] if 65 536 nodes do not reach 1e-11.
pub fn debye_integral(
    objective: &Objective,
    radii: &[f64],
    depths: &[f64],
) -> Result<(Vec<Vec<Complex64>>, f64), PsfError> {
    let k = objective.wave_number();
    let alpha = objective.half_angle();
    let far = radii.iter().fold(0.0f64, |a, r| a.max(r.abs()));
    let deep = depths.iter().fold(0.0f64, |a, z| a.max(z.abs()));
    let phase = k * (far * alpha.sin() + deep * (1.0 - alpha.cos()));
    let mut panels = ((phase / PHASE_OF_PANEL) as usize).max(2);
    // radii on which the rule is tried: the phase varies fastest at the largest
    let probes: Vec<f64> = (0..8).map(|i| far * f64::from(i) / 7.0).collect();
    let mut coarse = sums(objective, &probes, depths, panels);
    loop {
        let fine = sums(objective, &probes, depths, 2 * panels);
        let error = largest(coarse.iter().flatten().zip(fine.iter().flatten()).map(|(a, b)| (a - b).norm()));
        if error <= QUADRATURE_ERROR {
            return Ok((sums(objective, radii, depths, panels), error));
        }
        panels *= 2;
        // more nodes do not mend what is not a number
        if error.is_nan() || 2 * panels * RULE > MOST_NODES {
            return Err(PsfError::Quadrature { error, nodes: 2 * panels * RULE });
        }
        coarse = fine;
    }
}

fn sums(objective: &Objective, radii: &[f64], depths: &[f64], panels: usize) -> Vec<Vec<Complex64>> {
    let k = objective.wave_number();
    let nodes = composite(0.0, objective.half_angle(), panels);
    let amplitude: Vec<(f64, f64)> =
        nodes.iter().map(|&(t, w)| (k * t.sin(), w * t.cos().sqrt() * t.sin())).collect();
    let phases: Vec<Vec<Complex64>> = depths
        .iter()
        // −i u sin²(θ/2)/(2 sin²(α/2)) = −2 i k z sin²(θ/2)
        .map(|z| {
            nodes
                .iter()
                .map(|&(t, _)| Complex64::from_polar(1.0, -2.0 * k * z * (t / 2.0).sin().powi(2)))
                .collect()
        })
        .collect();
    let columns: Vec<Vec<Complex64>> = radii
        .par_iter()
        .map(|r| {
            let bessel: Vec<f64> = amplitude.iter().map(|&(ks, w)| w * libm::j0(r * ks)).collect();
            phases
                .iter()
                .map(|p| {
                    let (mut re, mut im) = (0.0, 0.0);
                    for (b, p) in bessel.iter().zip(p) {
                        re += b * p.re;
                        im += b * p.im;
                    }
                    Complex64::new(re, im)
                })
                .collect()
        })
        .collect();
    (0..depths.len()).map(|z| columns.iter().map(|c| c[z]).collect()).collect()
}

/// Square root of the energy of I over the image plane: |I|² integrates to 2π(1 − cos α)/k² in the object,
/// M² times that in the image.
pub(crate) fn unit_energy(objective: &Objective) -> f64 {
    let k = objective.wave_number();
    let energy = std::f64::consts::TAU * (1.0 - objective.half_angle().cos()) / (k * k);
    1.0 / (energy.sqrt() * objective.magnification)
}

/// Table step times the highest lateral frequency k NA/n: six-point interpolation is then good to 2e-8.
const TABLE_STEP: f64 = 0.12;

impl DebyeTable {
    /// Table up to radius `far` (object side), normalised to unit energy over the image plane.
    ///
    /// # Errors
    /// [`PsfError::Quadrature`].
    pub fn new(objective: &Objective, far: f64, depths: &[f64]) -> Result<Self, PsfError> {
        let step = TABLE_STEP / (objective.wave_number() * objective.half_angle().sin());
        let count = (far / step).ceil() as usize + 5;
        let radii: Vec<f64> = (0..count).map(|i| i as f64 * step).collect();
        let (values, error) = debye_integral(objective, &radii, depths)?;
        let scale = unit_energy(objective);
        let planes = values
            .into_iter()
            .map(|v| RadialField { step, values: v.into_iter().map(|c| c * scale).collect() })
            .collect();
        Ok(Self { planes, error })
    }
}

impl RadialField {
    /// Field at radius `r` by six-point Lagrange interpolation; even in r, zero beyond the table.
    #[inline]
    pub fn at(&self, r: f64) -> Complex64 {
        let position = r / self.step;
        let cell = position.floor();
        let t = position - cell;
        let cell = cell as isize;
        // weights of nodes −2 … 3
        let (a, b, c, d, e, f) = (t + 2.0, t + 1.0, t, t - 1.0, t - 2.0, t - 3.0);
        let w = [
            -b * c * d * e * f / 120.0,
            a * c * d * e * f / 24.0,
            -a * b * d * e * f / 12.0,
            a * b * c * e * f / 12.0,
            -a * b * c * d * f / 24.0,
            a * b * c * d * e / 120.0,
        ];
        let mut sum = Complex64::new(0.0, 0.0);
        for (j, w) in w.into_iter().enumerate() {
            let node = (cell + j as isize - 2).unsigned_abs();
            if let Some(v) = self.values.get(node) {
                sum += v * w;
            }
        }
        sum
    }
}

/// The field of a point at depth `z` on a grid, for light that a grating of q = ±λ/p turns before the
/// objective: ∬ A(s, t) exp(i k₀ z √(n² − (s+q)² − t²)) exp(i k₀ (s x + t y)) ds dt over s² + t² ≤ NA²,
/// A = (1 − ((s+q)² + t²)/n²)^(−1/4), zero where the bracket is not positive.
///
/// `xs`, `ys`: equidistant object-side coordinates relative to the point. Normalised to unit energy over
/// the image plane. Returns the field, `[y][x]`, and the share of the pupil's area that is evanescent.
///
/// # Errors
/// [`PsfError::Quadrature`] where halving the node distance still changes the field at the corners by more
/// than 1e-5 of its maximum.
pub fn pupil_field(
    objective: &Objective,
    q: f64,
    z: f64,
    xs: &[f64],
    ys: &[f64],
) -> Result<(Vec<Complex64>, f64), PsfError> {
    let spacing = 0.5 * objective.wavelength_um / objective.na / INTERPOLATION_OVERSAMPLING;
    let interpolations = [xs, ys].map(|v| Interpolation::over(v, spacing));
    let [lx, ly] = &interpolations;
    let (xs, ys) = (lx.as_ref().map_or(xs, |l| &l.nodes), ly.as_ref().map_or(ys, |l| &l.nodes));
    let k0 = std::f64::consts::TAU / objective.wavelength_um;
    let far = |v: &[f64]| v.iter().fold(0.0f64, |a, x| a.max(x.abs()));
    // a panel of 32 points integrates 50 rad; near grazing light more is needed, which the test finds
    let phase = k0 * objective.na * 2.0 * (far(xs).max(far(ys)) + z.abs());
    let mut nodes = ((phase * 0.65) as usize).clamp(64, 8192);
    let ends = |v: &[f64]| match v {
        [a, .., b] => vec![*a, 0.5 * (a + b), *b],
        other => other.to_vec(),
    };
    let (px, py) = (ends(xs), ends(ys));
    let largest = |v: &[Complex64]| largest(v.iter().map(|c| c.norm()));
    loop {
        let (mut coarse, _) = pupil_sum(objective, q, z, &px, &py, nodes);
        let (fine, _) = pupil_sum(objective, q, z, &px, &py, nodes * 3 / 2);
        for (a, b) in coarse.iter_mut().zip(&fine) {
            *a -= b;
        }
        let centre = pupil_sum(objective, 0.0, 0.0, &[0.0], &[0.0], 64).0;
        let error = largest(&coarse) / largest(&centre);
        if error < 1e-5 {
            let (mut field, evanescent) = pupil_sum(objective, q, z, xs, ys, nodes);
            let width = xs.len();
            if let Some(l) = ly {
                field = l.columns(&field, width);
            }
            if let Some(l) = lx {
                field = field.chunks_exact(width).flat_map(|row| l.columns(row, 1)).collect();
            }
            return Ok((field, evanescent));
        }
        if error.is_nan() || nodes > 12_000 {
            return Err(PsfError::Quadrature { error, nodes });
        }
        nodes *= 2;
    }
}

/// Nodes a period of the highest frequency that the pupil passes, over the two that suffice in principle.
const INTERPOLATION_OVERSAMPLING: f64 = 1.6;
/// Nodes to either side that take part in an interpolation.
const INTERPOLATION_REACH: usize = 14;

/// Equidistant nodes, and how positions are interpolated between them by a sinc in a Kaiser window. The pupil
/// limits the field's frequencies to NA/λ, so that what is finer than that need not be integrated; the
/// window's stop band, exp(−π reach (1 − 1/oversampling)), is 7e-8.
struct Interpolation {
    nodes: Vec<f64>,
    /// First node and weights of every position.
    taps: Vec<(usize, [f64; 2 * INTERPOLATION_REACH])>,
}

impl Interpolation {
    /// Nodes for positions that are denser than `spacing`; none where there is nothing to gain.
    fn over(positions: &[f64], spacing: f64) -> Option<Self> {
        let (&first, &last) = (positions.first()?, positions.last()?);
        let count = ((last - first) / spacing).ceil() as usize + 2 * INTERPOLATION_REACH;
        if positions.len() < count + count / 4 {
            return None;
        }
        let reach = INTERPOLATION_REACH as f64;
        let beta = std::f64::consts::PI * reach * (1.0 - 1.0 / INTERPOLATION_OVERSAMPLING);
        let weight = |t: f64| {
            let inside = (1.0 - (t / reach).powi(2)).max(0.0);
            let angle = std::f64::consts::PI * t;
            let sinc = if t.abs() < 1e-12 { 1.0 } else { angle.sin() / angle };
            sinc * bessel_i0(beta * inside.sqrt()) / bessel_i0(beta)
        };
        let start = first - (reach - 1.0) * spacing;
        let nodes = (0..count).map(|i| start + i as f64 * spacing).collect();
        let taps = positions
            .iter()
            .map(|x| {
                let place = (x - first) / spacing;
                let cell = place.floor();
                let mut weights = [0.0; 2 * INTERPOLATION_REACH];
                for (j, w) in weights.iter_mut().enumerate() {
                    *w = weight(place - cell - (j as f64 + 1.0 - reach));
                }
                (cell as usize, weights)
            })
            .collect();
        Some(Self { nodes, taps })
    }

    /// Interpolates along the rows of a matrix, `width` values each.
    fn columns(&self, values: &[Complex64], width: usize) -> Vec<Complex64> {
        let mut out = vec![Complex64::new(0.0, 0.0); self.taps.len() * width];
        for (row, (first, weights)) in out.chunks_exact_mut(width.max(1)).zip(&self.taps) {
            let near = values.chunks_exact(width.max(1)).skip(*first);
            for (line, w) in near.zip(weights) {
                for (o, v) in row.iter_mut().zip(line) {
                    *o += v * w;
                }
            }
        }
        out
    }
}

/// The modified Bessel function I₀ by its series.
fn bessel_i0(x: f64) -> f64 {
    let square = 0.25 * x * x;
    let (mut term, mut sum) = (1.0, 1.0);
    for k in 1..200 {
        term *= square / f64::from(k * k);
        sum += term;
        if term < 1e-17 * sum {
            break;
        }
    }
    sum
}

/// cos² of the direction at the end of a chord below which it counts as nearly grazing.
const NEARLY_GRAZING: f64 = 0.1;

/// One chord of the pupil at given t: nodes (s, weight), where the bracket is positive.
fn chord(objective: &Objective, q: f64, t: f64, rule: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let half = (objective.na * objective.na - t * t).max(0.0).sqrt();
    let edge = (objective.index * objective.index - t * t).max(0.0).sqrt();
    let (low, high) = ((-half).max(-edge - q), half.min(edge - q));
    if low >= high {
        return Vec::new();
    }
    let width = high - low;
    // share of n² that is left at an end: towards light that is, or nearly is, evanescent the nodes thicken,
    // s = end ∓ width v², which takes away the square root of phase and amplitude
    let left = |s: f64| 1.0 - ((s + q) * (s + q) + t * t) / (objective.index * objective.index);
    let (thick_high, thick_low) = (left(high) < NEARLY_GRAZING, left(low) < NEARLY_GRAZING);
    rule.iter()
        .map(|&(x, w)| {
            let (x, w) = (0.5 * (x + 1.0), 0.5 * w);
            if thick_high {
                (high - width * (1.0 - x) * (1.0 - x), 2.0 * width * (1.0 - x) * w)
            } else if thick_low {
                (low + width * x * x, 2.0 * width * x * w)
            } else {
                (low + width * x, width * w)
            }
        })
        .collect()
}

/// Values of a chord's field that are worked on together.
const TOGETHER: usize = 8;

fn pupil_sum(
    objective: &Objective,
    q: f64,
    z: f64,
    xs: &[f64],
    ys: &[f64],
    nodes: usize,
) -> (Vec<Complex64>, f64) {
    let k0 = std::f64::consts::TAU / objective.wavelength_um;
    let n2 = objective.index * objective.index;
    let rule = gauss_legendre_cached(nodes);
    // t = NA sin φ takes away the square root at the pupil's rim; the field is even in t
    let quarter = std::f64::consts::FRAC_PI_4;
    let chords: Vec<(f64, f64, Vec<Complex64>, f64, f64)> = rule
        .par_iter()
        .map(|&(x, w)| {
            let angle = quarter * (x + 1.0);
            let t = objective.na * angle.sin();
            let dt = quarter * w * objective.na * angle.cos();
            let mut row = vec![Complex64::new(0.0, 0.0); xs.len()];
            let (mut energy, mut area) = (0.0, 0.0);
            let step = match xs {
                [a, b, ..] => b - a,
                _ => 0.0,
            };
            for (s, ds) in chord(objective, q, t, &rule) {
                let bracket = n2 - (s + q) * (s + q) - t * t;
                if bracket <= 0.0 {
                    continue;
                }
                let amplitude = (bracket / n2).powf(-0.25) * ds;
                energy += amplitude * amplitude / ds;
                area += ds;
                let first = xs.first().copied().unwrap_or(0.0);
                let value = Complex64::from_polar(amplitude, k0 * (z * bracket.sqrt() + s * first));
                let turn = |n: usize| Complex64::from_polar(1.0, k0 * s * step * n as f64);
                // several at a time, because each waits for its last product
                let mut values: [Complex64; TOGETHER] = std::array::from_fn(|i| value * turn(i));
                let turn = turn(TOGETHER);
                for out in row.chunks_mut(TOGETHER) {
                    for (o, v) in out.iter_mut().zip(&mut values) {
                        *o += *v;
                        *v *= turn;
                    }
                }
            }
            (t, dt, row, energy, area)
        })
        .collect();
    // ∬|A|² ds dt over both halves; a plane wave spectrum A gives ∫|U|² dx dy = (2π/k₀)² ∬|A|²
    let energy: f64 = chords.iter().map(|c| 2.0 * c.1 * c.3).sum();
    let area: f64 = chords.iter().map(|c| 2.0 * c.1 * c.4).sum();
    let scale = k0 / std::f64::consts::TAU / energy.sqrt() / objective.magnification;
    let field: Vec<Complex64> = ys
        .par_iter()
        .flat_map_iter(|y| {
            let mut row = vec![Complex64::new(0.0, 0.0); xs.len()];
            for (t, dt, chord, _, _) in &chords {
                let weight = 2.0 * dt * (k0 * t * y).cos() * scale;
                for (out, c) in row.iter_mut().zip(chord) {
                    *out += c * weight;
                }
            }
            row
        })
        .collect();
    let pupil = std::f64::consts::PI * objective.na * objective.na;
    (field, (1.0 - area / pupil).max(0.0))
}

/// Large rules are composed of 32-point panels, which is as good and needs no large root finding.
fn gauss_legendre_cached(nodes: usize) -> Vec<(f64, f64)> {
    let panels = nodes.div_ceil(32);
    let rule = gauss_legendre(32);
    let half = 1.0 / panels as f64;
    (0..panels)
        .flat_map(|p| {
            let middle = -1.0 + (2 * p + 1) as f64 * half;
            rule.iter().map(move |&(x, w)| (middle + half * x, half * w)).collect::<Vec<_>>()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_a_number_does_not_settle() {
        assert_eq!(largest([0.5, 2.0, 1.0].into_iter()), 2.0);
        for values in [[f64::NAN, 1.0], [1.0, f64::NAN]] {
            assert!(largest(values.into_iter()).is_nan());
        }
        let objective = Objective { magnification: 20.0, na: 0.5, index: 1.0, wavelength_um: 0.45 };
        let refused = debye_integral(&objective, &[0.0, 1.0], &[f64::NAN]);
        assert!(matches!(refused, Err(PsfError::Quadrature { error, .. }) if error.is_nan()));
        let refused = pupil_field(&objective, 0.0, f64::NAN, &[0.0], &[0.0]);
        assert!(matches!(refused, Err(PsfError::Quadrature { error, .. }) if error.is_nan()));
    }
}
