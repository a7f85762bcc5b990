//! The lattice from a white image: period from the spectrum, then every lenslet's phase, then a linear fit.

use super::{Lattice, Measured};
use crate::error::LatticeError;
use crate::optics::Packing;
use rayon::prelude::*;
use rustfft::FftPlannerScalar;
use rustfft::num_complex::Complex64;

/// Smallest side of an image.
const LEAST: usize = 64;
/// Largest crop for the spectrum.
const CROP: usize = 2048;
/// Ratio of the strongest period's amplitude to the median amplitude of its ring.
const CONTRAST: f64 = 8.0;
/// Share of pixels at the largest value above which an image counts as saturated.
const SATURATED: f64 = 0.01;

/// Finds the lattice in a white image (uniform light on the lenslets), `[y][x]`, after a dark image of the
/// same size is taken off. `saturation`: level at which a pixel is saturated, if known.
///
/// The centre of a lenslet is where its image is symmetric, which is measured by the phase of both basic
/// periods in a Gaussian window of one pitch; vignetting does not move it.
///
/// # Errors
/// [`LatticeError`]: image too small, dark, saturated, without a lattice.
pub fn find(
    white: &[f32],
    dark: Option<&[f32]>,
    size: [usize; 2],
    saturation: Option<f32>,
) -> Result<Lattice, LatticeError> {
    let [width, height] = size;
    if width < LEAST || height < LEAST {
        return Err(LatticeError::Small { width, height, least: LEAST });
    }
    for (what, image) in [("the white image", Some(white)), ("the dark image", dark)] {
        if let Some(image) = image.filter(|i| i.len() != width * height) {
            let (found_width, found_height) = (image.len() / height, height);
            return Err(LatticeError::Size { what, found_width, found_height, width, height });
        }
    }
    if let Some(level) = saturation {
        let share = white.iter().filter(|v| **v >= level).count() as f64 / white.len() as f64;
        if share > SATURATED {
            return Err(LatticeError::Saturated { share, level });
        }
    }
    let light: Vec<f32> = match dark {
        Some(dark) => white.iter().zip(dark).map(|(w, d)| w - d).collect(),
        None => white.to_vec(),
    };
    let mean = light.iter().map(|v| f64::from(*v)).sum::<f64>() / light.len() as f64;
    if mean.is_nan() || mean <= 0.0 {
        return Err(LatticeError::Dark);
    }
    let (packing, waves) = periods(&light, size)?;
    let mut sides = sides_of(waves);
    let mut origin = [0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0)];
    // the nearest centre to the middle, then outwards: the first fit only near the middle
    origin = centre(&light, size, origin, sides).map_or(origin, |c| c.0);
    let mut fit = None;
    for (reach, stride) in [(6, 1), (20, 2), (usize::MAX, 3), (usize::MAX, 3)] {
        let found = fit_lattice(&light, size, origin, sides, reach, stride)?;
        origin = found.origin;
        sides = found.sides;
        fit = Some(found);
    }
    let Some(fit) = fit else { return Err(LatticeError::Dark) };
    Ok(finish(fit, packing, size))
}

/// Wave vectors (radians per pixel) of the two basic periods.
fn periods(light: &[f32], size: [usize; 2]) -> Result<(Packing, [[f64; 2]; 2]), LatticeError> {
    let n = size[0].min(size[1]).min(CROP);
    let spectrum = amplitude(light, size, n);
    let at = |i: isize, j: isize| -> f64 {
        let (x, y) = (i.rem_euclid(n as isize) as usize, j.rem_euclid(n as isize) as usize);
        f64::from(spectrum[y * n + x])
    };
    // from periods of half the crop's tenth down to 3 pixels; the upper half plane is enough
    let (low, high) = (12.0f64.max(n as f64 / 200.0), n as f64 / 3.0);
    let mut peaks: Vec<(f64, isize, isize)> = Vec::new();
    for j in 0..=(high as isize) {
        for i in -(high as isize)..=(high as isize) {
            let r = (i as f64).hypot(j as f64);
            if r < low || r > high || (j == 0 && i < 0) {
                continue;
            }
            let v = at(i, j);
            let peak = (-1..=1).all(|b| (-1..=1).all(|a| (a, b) == (0, 0) || at(i + a, j + b) < v));
            if peak {
                peaks.push((v, i, j));
            }
        }
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    let ring = |r: f64| -> f64 {
        let mut values: Vec<f64> = (0..360)
            .map(|k| {
                let (sin, cos) = f64::from(k).to_radians().sin_cos();
                at((r * cos).round() as isize, (r * sin).round() as isize)
            })
            .collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2].max(f64::MIN_POSITIVE)
    };
    let none = |contrast| LatticeError::NoPattern { contrast, needed: CONTRAST };
    let &(strongest, ..) = peaks.first().ok_or(none(0.0))?;
    // among the strong ones the longest period is the basic one
    let strong: Vec<&(f64, isize, isize)> =
        peaks.iter().take(24).filter(|p| p.0 > 0.25 * strongest).collect();
    let length = |p: &(f64, isize, isize)| (p.1 as f64).hypot(p.2 as f64);
    let first = strong.iter().min_by(|a, b| length(a).total_cmp(&length(b))).ok_or(none(0.0))?;
    let contrast = first.0 / ring(length(first));
    if contrast < CONTRAST {
        return Err(none(contrast));
    }
    let angle = |p: &(f64, isize, isize)| {
        let cross = first.1 * p.2 - first.2 * p.1;
        let dot = first.1 * p.1 + first.2 * p.2;
        (cross as f64).atan2(dot as f64).to_degrees().abs()
    };
    let second = peaks
        .iter()
        .take(24)
        .filter(|p| (length(p) / length(first) - 1.0).abs() < 0.1)
        .filter(|p| [60.0, 90.0, 120.0].iter().any(|a| (angle(p) - a).abs() < 8.0))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .ok_or(none(contrast))?;
    let packing = if (angle(second) - 90.0).abs() < 8.0 { Packing::Square } else { Packing::Hexagonal };
    let wave = |p: &(f64, isize, isize)| -> [f64; 2] {
        // parabola through the logarithms of neighbouring amplitudes
        let step = |a: f64, b: f64, c: f64| {
            let (a, b, c) = (a.max(1e-30).ln(), b.max(1e-30).ln(), c.max(1e-30).ln());
            let bend = a - 2.0 * b + c;
            if bend < 0.0 { 0.5 * (a - c) / bend } else { 0.0 }
        };
        let (v, i, j) = *p;
        let x = i as f64 + step(at(i - 1, j), v, at(i + 1, j));
        let y = j as f64 + step(at(i, j - 1), v, at(i, j + 1));
        [x, y].map(|f| std::f64::consts::TAU * f / n as f64)
    };
    let mut waves = [wave(first), wave(second)];
    // x first, both pointing to growing coordinates
    if waves[0][0].abs() < waves[1][0].abs() {
        waves.swap(0, 1);
    }
    for (k, w) in waves.iter_mut().enumerate() {
        if w[k] < 0.0 {
            *w = [-w[0], -w[1]];
        }
    }
    Ok((packing, waves))
}

/// Amplitudes of the spectrum of the middle of an image under a Hann window.
fn amplitude(light: &[f32], size: [usize; 2], n: usize) -> Vec<f32> {
    let (x0, y0) = ((size[0] - n) / 2, (size[1] - n) / 2);
    let window: Vec<f32> =
        (0..n).map(|i| (std::f64::consts::PI * (i as f64 + 0.5) / n as f64).sin().powi(2) as f32).collect();
    let mean = light.iter().map(|v| f64::from(*v)).sum::<f64>() / light.len() as f64;
    let mut field: Vec<Complex64> = (0..n * n)
        .map(|i| {
            let (y, x) = (i / n, i % n);
            let v = light[(y0 + y) * size[0] + x0 + x] - mean as f32;
            Complex64::new(f64::from(v * window[x] * window[y]), 0.0)
        })
        .collect();
    let fft = FftPlannerScalar::new().plan_fft_forward(n);
    for _ in 0..2 {
        field.par_chunks_mut(n).for_each(|row| fft.process(row));
        let mut turned = vec![Complex64::default(); n * n];
        for y in 0..n {
            for x in 0..n {
                turned[x * n + y] = field[y * n + x];
            }
        }
        field = turned;
    }
    field.iter().map(|c| c.norm() as f32).collect()
}

/// Cell sides of wave vectors: k_i · a_j = 2π δ_ij.
fn sides_of(waves: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
    let [k, l] = waves;
    let det = k[0] * l[1] - k[1] * l[0];
    let f = std::f64::consts::TAU / det;
    [[f * l[1], -f * l[0]], [-f * k[1], f * k[0]]]
}

/// The lenslet centre near a place, and the weaker of both periods' relative amplitudes; none at the border.
fn centre(light: &[f32], size: [usize; 2], at: [f64; 2], sides: [[f64; 2]; 2]) -> Option<([f64; 2], f64)> {
    let lengths = sides.map(|s| s[0].hypot(s[1]));
    let sigma = lengths[0].min(lengths[1]);
    let reach = (2.5 * sigma).ceil() as isize;
    let middle = [at[0].round() as isize, at[1].round() as isize];
    for axis in 0..2 {
        if middle[axis] - reach < 0 || middle[axis] + reach >= size[axis] as isize {
            return None;
        }
    }
    let waves = {
        let [a, b] = sides;
        let f = std::f64::consts::TAU / (a[0] * b[1] - a[1] * b[0]);
        [[f * b[1], -f * b[0]], [-f * a[1], f * a[0]]]
    };
    // a window that ends smoothly
    let weight = |d: f64| {
        let t = d / (reach as f64 + 1.0);
        (-0.5 * (d / sigma).powi(2)).exp() * (1.0 - t * t).max(0.0)
    };
    let axis = |k: usize| -> Vec<(f64, f64)> {
        (-reach..=reach)
            .map(|i| {
                let d = (middle[k] + i) as f64 - at[k];
                (d, weight(d))
            })
            .collect()
    };
    let (xs, ys) = (axis(0), axis(1));
    let phases =
        waves.map(|w| xs.iter().map(|(d, g)| Complex64::from_polar(*g, -w[0] * d)).collect::<Vec<_>>());
    let mut sums = [Complex64::default(); 2];
    let mut total = 0.0;
    let first = (middle[0] - reach) as usize;
    for (i, (d, g)) in ys.iter().enumerate() {
        let y = (middle[1] - reach) as usize + i;
        let row = &light[y * size[0] + first..][..xs.len()];
        for k in 0..2 {
            let part: Complex64 = row.iter().zip(&phases[k]).map(|(v, p)| p * f64::from(*v)).sum();
            sums[k] += part * Complex64::from_polar(*g, -waves[k][1] * d);
        }
        total += g * row.iter().zip(&xs).map(|(v, (_, g))| f64::from(*v) * g).sum::<f64>();
    }
    let [p, q] = sums.map(|s| -s.arg() / std::f64::consts::TAU);
    let strength = sums[0].norm().min(sums[1].norm()) / total.abs().max(f64::MIN_POSITIVE);
    Some(([0, 1].map(|k| at[k] + p * sides[0][k] + q * sides[1][k]), strength))
}

struct Fit {
    origin: [f64; 2],
    sides: [[f64; 2]; 2],
    /// Standard uncertainties of (origin, side x, side y), the same for both coordinates' terms.
    sigma: [[f64; 2]; 3],
    /// Covariance factor of (origin, side x, side y).
    rms: f64,
    used: usize,
    rejected: usize,
}

/// Centres of every `stride`-th cell up to `reach` cells from the origin, and the lattice through them.
fn fit_lattice(
    light: &[f32],
    size: [usize; 2],
    origin: [f64; 2],
    sides: [[f64; 2]; 2],
    reach: usize,
    stride: usize,
) -> Result<Fit, LatticeError> {
    let shortest = sides.iter().map(|s| s[0].hypot(s[1])).fold(f64::INFINITY, f64::min);
    let most = (size[0].max(size[1]) as f64 * 1.5 / shortest) as usize;
    let n = reach.min(most) as isize;
    let n = n - n % stride as isize;
    let cells: Vec<(isize, isize)> =
        (-n..=n).step_by(stride).flat_map(|j| (-n..=n).step_by(stride).map(move |i| (i, j))).collect();
    let found: Vec<([f64; 2], [f64; 2], f64)> = cells
        .par_iter()
        .filter_map(|&(i, j)| {
            let (i, j) = (i as f64, j as f64);
            let at = [0, 1].map(|k| origin[k] + i * sides[0][k] + j * sides[1][k]);
            centre(light, size, at, sides).map(|(c, strength)| ([i, j], c, strength))
        })
        .collect();
    let expected = found.len();
    let mut strengths: Vec<f64> = found.iter().map(|f| f.2).collect();
    strengths.sort_by(f64::total_cmp);
    let typical = strengths.get(expected / 2).copied().unwrap_or(0.0);
    let mut good: Vec<bool> = found.iter().map(|f| f.2 > 0.3 * typical && typical > 0.01).collect();
    let mut result = None;
    for _ in 0..4 {
        let list: Vec<_> = found.iter().zip(&good).filter(|(_, g)| **g).map(|(f, _)| (f.0, f.1)).collect();
        let few = LatticeError::NoLattice { found: list.len(), expected };
        if list.len() < 9 || 2 * list.len() < expected {
            return Err(few);
        }
        let (p, covariance) = least_squares(&list).ok_or(few)?;
        let distance = |f: &([f64; 2], [f64; 2], f64)| {
            let [i, j] = f.0;
            let d = [0, 1].map(|k| f.1[k] - p[k][0] - i * p[k][1] - j * p[k][2]);
            d[0].hypot(d[1])
        };
        let mut distances: Vec<f64> = list.iter().map(|&(a, b)| distance(&(a, b, 0.0))).collect();
        let square: [f64; 2] = [0, 1].map(|k| {
            let sum: f64 =
                list.iter().map(|(c, x)| (x[k] - p[k][0] - c[0] * p[k][1] - c[1] * p[k][2]).powi(2)).sum();
            sum / (list.len() as f64 - 3.0)
        });
        distances.sort_by(f64::total_cmp);
        let limit = 4.0 * distances[distances.len() / 2].max(1e-6) + 1e-3;
        result = Some(Fit {
            origin: [p[0][0], p[1][0]],
            sides: [[p[0][1], p[1][1]], [p[0][2], p[1][2]]],
            sigma: covariance.map(|c| square.map(|s| (s * c).sqrt())),
            rms: (square[0] + square[1]).sqrt(),
            used: list.len(),
            rejected: expected - list.len(),
        });
        for (g, f) in good.iter_mut().zip(&found) {
            *g = f.2 > 0.3 * typical && typical > 0.01 && distance(f) <= limit;
        }
    }
    result.ok_or(LatticeError::NoLattice { found: 0, expected })
}

/// Coefficients [coordinate][1, i, j] and the diagonal of the inverse normal matrix.
fn least_squares(list: &[([f64; 2], [f64; 2])]) -> Option<([[f64; 3]; 2], [f64; 3])> {
    let mut m = [[0.0; 3]; 3];
    let mut right = [[0.0; 3]; 2];
    for ([i, j], x) in list {
        let row = [1.0, *i, *j];
        for a in 0..3 {
            for b in 0..3 {
                m[a][b] += row[a] * row[b];
            }
            for k in 0..2 {
                right[k][a] += row[a] * x[k];
            }
        }
    }
    let minor = |a: usize, b: usize| {
        let r: Vec<usize> = (0..3).filter(|i| *i != a).collect();
        let c: Vec<usize> = (0..3).filter(|i| *i != b).collect();
        let v = m[r[0]][c[0]] * m[r[1]][c[1]] - m[r[0]][c[1]] * m[r[1]][c[0]];
        if (a + b).is_multiple_of(2) { v } else { -v }
    };
    let det = (0..3).map(|b| m[0][b] * minor(0, b)).sum::<f64>();
    if det.abs() < 1e-9 {
        return None;
    }
    let inverse = |a: usize, b: usize| minor(b, a) / det;
    let p = [0, 1].map(|k| [0, 1, 2].map(|a| (0..3).map(|b| inverse(a, b) * right[k][b]).sum()));
    Some((p, [0, 1, 2].map(|a| inverse(a, a))))
}

/// The rectangular cell of a hexagonal lattice: the shortest vector nearest to x, and the one across it.
fn rectangular(fit: Fit) -> Fit {
    let [a, b] = fit.sides;
    // of a ± b the shorter is the third of the shortest vectors
    let combine = |s: f64| [a[0] + s * b[0], a[1] + s * b[1]];
    let length = |v: [f64; 2]| v[0].hypot(v[1]);
    let third = if length(combine(-1.0)) < length(combine(1.0)) { combine(-1.0) } else { combine(1.0) };
    let mut list = [a, b, third];
    list.sort_by(|p, q| (p[1] / p[0]).abs().total_cmp(&(q[1] / q[0]).abs()));
    let point = |v: [f64; 2], k: usize| if v[k] < 0.0 { [-v[0], -v[1]] } else { v };
    let along = point(list[0], 0);
    let other = point(list[1], 1);
    // ± along + 2 other is at right angles
    let dot = (along[0] * other[0] + along[1] * other[1]) / (along[0] * along[0] + along[1] * along[1]);
    let turns = -(2.0 * dot).round();
    let across = [2.0 * other[0] + turns * along[0], 2.0 * other[1] + turns * along[1]];
    let side = [0, 1].map(|k| fit.sigma[1][k].max(fit.sigma[2][k]));
    let sigma = [fit.sigma[0], side, side.map(|s| 5f64.sqrt() * s)];
    Fit { sides: [along, across], sigma, ..fit }
}

fn finish(fit: Fit, packing: Packing, size: [usize; 2]) -> Lattice {
    let fit = if packing == Packing::Hexagonal { rectangular(fit) } else { fit };
    let [a, b] = fit.sides;
    let length = |v: [f64; 2], s: [f64; 2]| {
        let value = v[0].hypot(v[1]);
        Measured { value, sigma: (v[0] * s[0]).hypot(v[1] * s[1]) / value }
    };
    let angle = |v: [f64; 2], s: [f64; 2]| {
        let square = v[0] * v[0] + v[1] * v[1];
        Measured { value: v[1].atan2(v[0]), sigma: (v[1] * s[0]).hypot(v[0] * s[1]) / square }
    };
    let (x, y) = (angle(a, fit.sigma[1]), angle(b, fit.sigma[2]));
    let mut lattice = Lattice {
        size_px: size,
        packing,
        origin_px: fit.origin,
        origin_sigma_px: fit.sigma[0],
        along_x_px: a,
        along_y_px: b,
        sides_sigma_px: [fit.sigma[1], fit.sigma[2]],
        pitch_px: [length(a, fit.sigma[1]), length(b, fit.sigma[2])],
        rotation_rad: x,
        skew_rad: Measured {
            value: y.value - x.value - std::f64::consts::FRAC_PI_2,
            sigma: x.sigma.hypot(y.sigma),
        },
        rms_px: fit.rms,
        used: fit.used,
        rejected: fit.rejected,
    };
    let middle = size.map(|n| 0.5 * (n as f64 - 1.0));
    let [u, v] = lattice.cell_of(middle).map(f64::round);
    lattice.origin_px = lattice.at(u, v);
    lattice
}
