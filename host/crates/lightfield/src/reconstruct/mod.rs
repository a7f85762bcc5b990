//! Volumes from frames: Richardson–Lucy and ISRA.
//!
//! With the light model f ≈ H g + b, weights w of the pixels (0 = bad) and a variance v of the read noise
//! (in the units of f²/mean, so that the counts f + v are Poisson-like):
//!
//! - Richardson–Lucy: g ← g · Hᵀ(w (f + v)/(H g + b + v)) / Hᵀw
//! - ISRA (image space reconstruction algorithm): g ← g · Hᵀ(w (f − b)) / Hᵀ(w H g)
//!
//! Thesis (4.10), with its G⁻¹ read as the transpose, is ISRA, the least-squares relative of Richardson–Lucy.
//! Two first orders add up in numerator and denominator. Denominators are not let below 1e-12, estimates of
//! pixels not below the operator's rounding noise (1e-7 of the brightest pixel, 1e-5 in half precision), and
//! voxels of which the sensor sees less than 1e-6 of what it sees of the best are set to zero.

mod filters;
mod kernels;
mod passes;

use crate::error::{OperatorError, ReconstructError};
use crate::operator::{Normal, Operator};
use crate::optics::PsfParameters;
use passes::Passes;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Rule of iteration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Richardson–Lucy: most likely volume under Poisson noise.
    Rl,
    /// ISRA: least squares. The rule that the thesis prints.
    Isra,
}

/// How a volume is reconstructed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Rule.
    pub method: Method,
    /// Most iterations.
    pub iterations: usize,
    /// Stop when ‖f − Hg − b‖/‖f‖ is below this.
    pub residual_below: Option<f64>,
    /// Extrapolate along the last step (Biggs and Andrews 1997).
    pub momentum: bool,
    /// Weight of total variation (Dey et al. 2006), 0 for none; 0.002 to 0.02 is usual.
    pub total_variation: f64,
    /// Smooth each plane as coarsely as the lenslets sample it, after every iteration: factor of the width,
    /// 0 for none, 1 for the width of [`native_widths`].
    pub anti_artefact: f64,
    /// Variance v of the read noise over the conversion (see the module).
    pub read_variance: f32,
    /// Level at and above which a pixel is saturated.
    pub saturation: Option<f32>,
    /// Give saturated pixels the weight 0 instead of refusing the image.
    pub mask_saturated: bool,
    /// Take negative pixels for 0 instead of refusing the image.
    pub clip_negative: bool,
    /// Use a normal matrix that the model holds, where it is valid.
    pub use_normal: bool,
}

impl Settings {
    /// The plain rule, so many times.
    pub fn new(method: Method, iterations: usize) -> Self {
        Self {
            method,
            iterations,
            residual_below: None,
            momentum: false,
            total_variation: 0.0,
            anti_artefact: 0.0,
            read_variance: 0.0,
            saturation: None,
            mask_saturated: false,
            clip_negative: false,
            use_normal: true,
        }
    }
}

/// Operators of a measurement.
pub struct Model {
    /// The (plus) view.
    pub operator: Operator,
    /// 1, or 2: the second image is seen through the mirror image of the operator in x.
    pub orders: usize,
    /// Normal matrix, for ISRA.
    pub normal: Option<Normal>,
    /// Voxel size (z, y, x), for filters.
    pub voxel_um: [f64; 3],
    /// Width of [`native_widths`] of each plane.
    pub widths: Vec<f64>,
}

/// What is known of one moment.
#[derive(Debug, Clone, Default)]
pub struct Frame<'a> {
    /// One image for each order, `[y][x]`.
    pub images: Vec<&'a [f32]>,
    /// Weights of the pixels of each image, 0 for bad ones; none: all 1.
    pub weights: Option<Vec<&'a [f32]>>,
    /// Background b of each image; none: 0.
    pub background: Option<Vec<&'a [f32]>>,
}

/// From where a reconstruction goes on; gives the same numbers as one that was never interrupted.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// Iterations done.
    pub iterations: usize,
    /// The volume, `[z][y][x]`.
    pub volume: Vec<f32>,
    /// With momentum: by how much the next iteration starts ahead of the volume, and the last step.
    pub momentum: Option<[Vec<f32>; 2]>,
}

/// How an iteration was computed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Path {
    /// Projection and back-projection.
    TwoPasses {
        /// Why the normal matrix was not used, where it was asked for.
        reason: Option<String>,
    },
    /// One product with the stored normal matrix.
    Normal,
}

/// A reconstructed volume.
#[derive(Debug, Clone, PartialEq)]
pub struct Reconstruction {
    /// Volume and what is needed to go on.
    pub state: State,
    /// ‖f − Hg − b‖/‖f‖ before each iteration; empty where the normal matrix was used.
    pub residuals: Vec<f64>,
    /// ‖gⁿ⁺¹ − gⁿ‖/‖gⁿ⁺¹‖ of each iteration.
    pub changes: Vec<f64>,
}

/// What a progress function is told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Iterations done.
    pub done: usize,
    /// Most iterations.
    pub of: usize,
    /// Largest residual of the frames, where known.
    pub residual: Option<f64>,
    /// Largest change of the frames.
    pub change: f64,
}

/// Denominators are not let below this, and estimates of pixels not below the rounding noise of the operator
/// ([`Operator::rounding`]), relative to the brightest pixel: what is below may have any sign.
const FLOOR: f32 = 1e-12;
/// Share of the best seen voxel's light below which a voxel is not reconstructed.
const UNSEEN: f32 = 1e-6;

/// Lateral distance of samples at each plane, in voxels: about the cell near the lenslets' image at z = 0,
/// where all light of a cell goes through one lenslet, finer the more lenslets share it:
/// S · c/(c + 2 |z| tan α), c = cell/M.
pub fn native_widths(p: &PsfParameters) -> Vec<f64> {
    let cell = p.lenslets.cell_um()[1] / p.objective.magnification;
    let spread = 2.0 * p.objective.half_angle().tan();
    p.planes_um.iter().map(|z| p.voxels[1] as f64 * cell / (cell + spread * z.abs())).collect()
}

/// Reconstructs the volumes of several frames together.
///
/// `progress` is told after every iteration; `false` stops with what has been reached.
///
/// # Errors
/// [`ReconstructError`]: images of the wrong size, dark, saturated or negative ones, impossible settings.
pub fn reconstruct(
    model: &Model,
    frames: &[Frame<'_>],
    settings: &Settings,
    start: Option<&[State]>,
    progress: &mut dyn FnMut(&Step) -> bool,
) -> Result<(Vec<Reconstruction>, Path), ReconstructError> {
    check(model, frames, settings, start)?;
    let [volume, sensor] = model.operator.layouts();
    let orders = model.orders;
    // images of the second order are mirrored once: the operator is that of the first
    let pack = |list: &dyn Fn(&Frame<'_>) -> Option<Vec<Vec<f32>>>| -> Option<Vec<Vec<f32>>> {
        let lists: Option<Vec<Vec<Vec<f32>>>> = frames.iter().map(list).collect();
        Some(lists?.into_iter().flatten().collect())
    };
    let side = |image: &[f32], order: usize| -> Vec<f32> {
        let packed = sensor.pack(image);
        if order == 0 {
            return packed;
        }
        let mut out = vec![0f32; packed.len()];
        for (a, b) in packed.chunks_exact(sensor.row()).zip(out.chunks_exact_mut(sensor.row())) {
            sensor.mirror_row(a, b);
        }
        out
    };
    let all = |v: &[&[f32]]| v.iter().enumerate().map(|(o, i)| side(i, o)).collect::<Vec<_>>();
    let mut images = pack(&|f| Some(all(&f.images))).unwrap_or_default();
    let mut weights = pack(&|f| f.weights.as_ref().map(|w| all(w)));
    if weights.is_none() && frames.iter().any(|f| f.weights.is_some()) {
        let ones = vec![1f32; model.operator.image_shape().iter().product()];
        weights = pack(&|f| {
            let plain = vec![ones.as_slice(); orders];
            Some(all(f.weights.as_ref().unwrap_or(&plain)))
        });
    }
    let mut background = pack(&|f| f.background.as_ref().map(|b| all(b)));
    if background.is_none() && frames.iter().any(|f| f.background.is_some()) {
        let none = vec![0f32; model.operator.image_shape().iter().product()];
        background = pack(&|f| {
            let plain = vec![none.as_slice(); orders];
            Some(all(f.background.as_ref().unwrap_or(&plain)))
        });
    }
    if let Some(level) = settings.saturation.filter(|_| settings.mask_saturated)
        && images.iter().flatten().any(|&v| v >= level)
    {
        let weights = weights.get_or_insert_with(|| {
            let ones = sensor.pack(&vec![1f32; model.operator.image_shape().iter().product()]);
            vec![ones; images.len()]
        });
        for (w, image) in weights.iter_mut().zip(&images) {
            w.iter_mut().zip(image).filter(|(_, v)| **v >= level).for_each(|(w, _)| *w = 0.0);
        }
    }
    let (squares, largest): (Vec<f64>, Vec<f32>) =
        images.par_iter_mut().map(|image| kernels::clip(image)).unzip();

    let rounding = model.operator.rounding();
    let floors: Vec<f32> = largest.iter().map(|v| (rounding * v).max(FLOOR)).collect();
    let mut passes = Passes::new(model, frames.len());
    let path = choose(model, settings, weights.is_some());
    let normal = if path == Path::Normal { model.normal.as_ref() } else { None };
    let at = |row: usize| row * sensor.row()..(row + 1) * sensor.row();
    let seen_by = |image: usize, row: usize, values: &mut [f32]| match &weights {
        Some(w) => values.copy_from_slice(&w[image][at(row)]),
        None => values.fill(1.0),
    };
    // Hᵀw for Richardson–Lucy, Hᵀ(w (f − b)) for ISRA
    let fixed = passes.back_project(&volume, &|image, row, values| {
        if settings.method == Method::Rl {
            return seen_by(image, row, values);
        }
        values.copy_from_slice(&images[image][at(row)]);
        if let Some(b) = &background {
            for (v, b) in values.iter_mut().zip(&b[image][at(row)]) {
                *v = (*v - b).max(0.0);
            }
        }
        if let Some(w) = &weights {
            for (v, w) in values.iter_mut().zip(&w[image][at(row)]) {
                *v *= w;
            }
        }
    });
    // Hᵀw; none where it is `fixed` itself, or where a sensor that catches all light sees every voxel
    let seen = match (settings.method, &path) {
        (Method::Rl, _) | (Method::Isra, Path::Normal) => None,
        (Method::Isra, Path::TwoPasses { .. }) => Some(passes.back_project(&volume, &seen_by)),
    };
    let mut xs: Vec<Vec<f32>> = match start {
        Some(states) => states.iter().map(|s| volume.pack(&s.volume)).collect(),
        // the padding stays zero
        None => vec![volume.pack(&vec![1f32; model.operator.volume_shape().iter().product()]); frames.len()],
    };
    // factor of an update: 1/Hᵀw, or Hᵀ(w f); zero for voxels that are not seen
    let mut factors = fixed;
    let largest = |v: &[f32]| v.iter().copied().fold(0.0f32, f32::max);
    for (i, (factor, x)) in factors.iter_mut().zip(&mut xs).enumerate() {
        if settings.method == Method::Rl {
            let best = largest(factor);
            for (f, x) in factor.iter_mut().zip(x) {
                (*f, *x) = if *f <= UNSEEN * best { (0.0, 0.0) } else { (1.0 / f.max(FLOOR), *x) };
            }
        } else if let Some(seen) = seen.as_ref().map(|s| &s[i]) {
            let best = largest(seen);
            for ((f, x), _) in factor.iter_mut().zip(x).zip(seen).filter(|(_, s)| **s <= UNSEEN * best) {
                (*f, *x) = (0.0, 0.0);
            }
        }
    }
    let mut momentum: Vec<Option<[Vec<f32>; 2]>> = match start {
        Some(states) if settings.momentum => states
            .iter()
            .map(|s| s.momentum.as_ref().map(|m| [volume.pack(&m[0]), volume.pack(&m[1])]))
            .collect(),
        _ => vec![None; frames.len()],
    };
    let before = start.and_then(|s| s.first()).map_or(0, |s| s.iterations);
    let plain = !settings.momentum && settings.total_variation == 0.0 && settings.anti_artefact == 0.0;
    let mut residuals = vec![Vec::new(); frames.len()];
    let mut changes = vec![Vec::new(); frames.len()];
    let mut done = before;
    // where the next step is taken from; without momentum the volumes themselves
    let mut points = if settings.momentum { xs.clone() } else { std::mem::take(&mut xs) };
    if settings.momentum {
        for ((point, x), m) in points.iter_mut().zip(&xs).zip(&momentum) {
            if let Some([ahead, _]) = m {
                filters::go_ahead(point, x, ahead);
            }
        }
    }
    for iteration in before..settings.iterations {
        let last = iteration + 1 == settings.iterations;
        let variation: Option<Vec<Vec<f32>>> = (settings.total_variation > 0.0).then(|| {
            let weight = settings.total_variation as f32;
            points.iter().map(|x| filters::variation(&volume, x, weight, model.voxel_um)).collect()
        });
        if normal.is_none() {
            let rows = passes.forward(&points, &|image, row, values| {
                let f = &images[image][at(row)];
                let b = background.as_ref().map(|b| &b[image][at(row)]);
                let w = weights.as_ref().map(|w| &w[image][at(row)]);
                kernels::pixels(settings, floors[image], values, f, b, w)
            });
            for (i, list) in residuals.iter_mut().enumerate() {
                let of = i * orders..(i + 1) * orders;
                let sum: f64 = rows[of.clone()].iter().flatten().sum();
                list.push((sum / squares[of].iter().sum::<f64>()).sqrt());
            }
        }
        let old = if plain { Vec::new() } else { points.clone() };
        let rows = passes.update(normal, &mut points, plain && !last, &|frame, row, values, x| {
            let at = row * volume.row()..(row + 1) * volume.row();
            let tv = variation.as_ref().map(|v| &v[frame][at.clone()]);
            kernels::voxels(settings.method, values, &factors[frame][at], tv, x)
        });
        for (list, rows) in changes.iter_mut().zip(&rows) {
            let (d, n) = rows.iter().fold((0.0, 0.0), |a, r| (a.0 + r.0, a.1 + r.1));
            list.push((d / f64::max(n, f64::MIN_POSITIVE)).sqrt());
        }
        if !plain {
            for (i, point) in points.iter_mut().enumerate() {
                if settings.anti_artefact > 0.0 {
                    filters::smooth_planes(&volume, point, &model.widths, settings.anti_artefact);
                }
                if settings.momentum {
                    let step: Vec<f32> = point.iter().zip(&old[i]).map(|(a, b)| a - b).collect();
                    let factor = match &momentum[i] {
                        Some([_, earlier]) => filters::acceleration(&step, earlier),
                        None => 0.0,
                    };
                    let new = point.clone();
                    let previous = std::mem::replace(&mut xs[i], new);
                    let ahead = filters::ahead(&xs[i], &previous, factor);
                    filters::go_ahead(point, &xs[i], &ahead);
                    momentum[i] = Some([ahead, step]);
                }
            }
        }
        done = iteration + 1;
        let worst = |v: &[Vec<f64>]| v.iter().filter_map(|l| l.last().copied()).reduce(f64::max);
        let residual = worst(&residuals);
        let change = worst(&changes).unwrap_or(0.0);
        let go_on = progress(&Step { done, of: settings.iterations, residual, change });
        if !go_on || settings.residual_below.is_some_and(|limit| residual.is_some_and(|r| r < limit)) {
            break;
        }
    }
    let volumes = if settings.momentum { &xs } else { &points };
    let out = volumes
        .par_iter()
        .zip(&momentum)
        .zip(residuals.par_iter().zip(&changes))
        .map(|((x, m), (residuals, changes))| Reconstruction {
            state: State {
                iterations: done,
                volume: volume.unpack(x),
                momentum: m.as_ref().map(|[a, b]| [volume.unpack(a), volume.unpack(b)]),
            },
            residuals: residuals.clone(),
            changes: changes.clone(),
        })
        .collect();
    Ok((out, path))
}

/// Which way an iteration goes.
fn choose(model: &Model, settings: &Settings, weighted: bool) -> Path {
    if settings.method == Method::Rl {
        return Path::TwoPasses { reason: None };
    }
    let no = |reason: &str| Path::TwoPasses { reason: Some(reason.to_owned()) };
    let g = &model.operator.geometry;
    if !settings.use_normal {
        return Path::TwoPasses { reason: None };
    }
    if weighted {
        return no("pixels are weighted or masked");
    }
    if g.margin < g.shape.radius as isize {
        return no("the sensor does not catch all light of the volume");
    }
    if settings.residual_below.is_some() {
        return no("a residual is asked for, which the normal matrix does not give");
    }
    if model.normal.is_none() {
        return no("none is stored; of two orders it needs a point spread function with a mirror in y");
    }
    Path::Normal
}

fn check(
    model: &Model,
    frames: &[Frame<'_>],
    settings: &Settings,
    start: Option<&[State]>,
) -> Result<(), ReconstructError> {
    let setting = |what, range, value, good: bool| {
        if good { Ok(()) } else { Err(ReconstructError::Setting { what, range, value }) }
    };
    let n = settings.iterations as f64;
    setting("the number of iterations", "from 1 to 100 000", n, (1.0..=1e5).contains(&n))?;
    let tv = settings.total_variation;
    setting("the weight of total variation", "from 0 to below 0.2", tv, (0.0..0.2).contains(&tv))?;
    let aa = settings.anti_artefact;
    setting("the anti-artefact factor", "from 0 to 4", aa, (0.0..=4.0).contains(&aa))?;
    let v = f64::from(settings.read_variance);
    setting("the read variance", "not negative and finite", v, v >= 0.0 && v.is_finite())?;
    if let Some(r) = settings.residual_below {
        setting("the residual to stop at", "above 0", r, r > 0.0)?;
    }
    let orders = model.orders as f64;
    setting("the number of orders", "1 or 2", orders, model.orders == 1 || model.orders == 2)?;
    if frames.is_empty() {
        return Err(OperatorError::NoFrame.into());
    }
    let [_, width] = model.operator.image_shape();
    for frame in frames {
        let lists = [Some(&frame.images), frame.weights.as_ref(), frame.background.as_ref()];
        for list in lists.into_iter().flatten() {
            if list.len() != model.orders {
                let (found, expected) = (list.len(), model.orders);
                return Err(
                    OperatorError::Length { what: "a frame's list of orders", found, expected }.into()
                );
            }
            for (image, values) in list.iter().enumerate() {
                model.operator.geometry.check_image(values.len())?;
                let strange = kernels::any(values, |v| !v.is_finite());
                if let Some(i) = values.iter().position(|v| strange && !v.is_finite()) {
                    let (x, y) = (i % width, i / width);
                    return Err(ReconstructError::Pixel { image, x, y, value: values[i] });
                }
            }
        }
        for (image, values) in frame.images.iter().enumerate() {
            let good = |i: usize| frame.weights.as_ref().is_none_or(|w| w[image][i] > 0.0);
            let bad = |test: &dyn Fn(f32) -> bool| {
                let mut found = (0..values.len()).filter(|&i| test(values[i]) && good(i));
                found.next().map(|first| (first, found.count() + 1))
            };
            let negative = !settings.clip_negative && kernels::any(values, |v| v < 0.0);
            let level = settings.saturation.filter(|_| !settings.mask_saturated);
            let saturated = level.filter(|level| kernels::any(values, |v| v >= *level));
            if negative && let Some((i, count)) = bad(&|v| v < 0.0) {
                let (x, y, value) = (i % width, i / width, values[i]);
                return Err(ReconstructError::Negative { image, count, x, y, value });
            }
            if let Some(level) = saturated
                && let Some((i, count)) = bad(&|v| v >= level)
            {
                let (x, y) = (i % width, i / width);
                return Err(ReconstructError::Saturated { image, count, level, x, y });
            }
            if values.iter().all(|v| *v <= 0.0) {
                return Err(ReconstructError::Dark { image });
            }
        }
    }
    if let Some(states) = start {
        if states.len() != frames.len() {
            let (found, expected) = (states.len(), frames.len());
            return Err(OperatorError::Length { what: "the list of states", found, expected }.into());
        }
        for s in states {
            model.operator.geometry.check_volume(s.volume.len())?;
        }
    }
    Ok(())
}
