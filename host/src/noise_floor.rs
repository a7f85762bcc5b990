//! What a measurement can resolve, from frames of a specimen that does not move: what `daic noise-floor`
//! does.
//!
//! Every frame is correlated with the first. What is then not zero is drift (the same for all points: a
//! rigid motion, taken off), and noise: its scatter over the points of one frame (spatial) and over the
//! frames at one point (temporal). The noise of the first frame is in all of them alike, so the temporal
//! scatter holds the noise of one image and not of two: it is to be compared with σ/√2.

use crate::error::Error;
use crate::images;
use crate::measure::{Rectangle, image_of, spread};
use crate::progress::Progress;
use crate::strain::{COMPONENTS, Gauge, Options, StrainField, map_of};
use daic_correlate::strain::Field;
use daic_correlate::{Guess, Points, Reference, Roi, Settings, Target, correlate};
use daic_dataset::{Column, Table};
use serde::Serialize;
use std::path::PathBuf;

/// Part of the points that must correlate in every frame.
const LEAST_OK: f64 = 0.5;

/// Scatter of a quantity over the points, and what was said about it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Scatter {
    /// Mean over the points: bias.
    pub mean: f64,
    /// Standard deviation over the points.
    pub std: f64,
    /// Root mean square of the stated uncertainties.
    pub sigma: f64,
}

/// Rigid motion of a frame against the first, least squares over its points.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RigidMotion {
    /// Translation of the middle of the points along x, pixels.
    pub u_px: f64,
    /// Translation of the middle of the points along y, pixels.
    pub v_px: f64,
    /// Rotation from x towards y, microradians.
    pub rotation_urad: f64,
}

/// One frame against the first.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameFloor {
    /// The image.
    pub image: String,
    /// Points with a displacement.
    pub ok: usize,
    /// u, pixels: drift and noise together.
    pub u: Scatter,
    /// v, pixels.
    pub v: Scatter,
    /// Drift.
    pub rigid: RigidMotion,
    /// Standard deviation of u over the points without the rigid motion, pixels.
    pub u_std_without_rigid: f64,
    /// Standard deviation of v over the points without the rigid motion, pixels.
    pub v_std_without_rigid: f64,
    /// Strain e_xx, e_yy, e_xy over the points.
    pub strain: [Scatter; 3],
}

/// Scatter over the frames at every point, without rigid motion.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Temporal {
    /// Points with a value in every frame.
    pub points: usize,
    /// Median over the points of the standard deviation over the frames.
    pub median: f64,
    /// Root mean square over the points of the standard deviation over the frames.
    pub rms: f64,
    /// Nineteen of twenty points scatter less.
    pub p95: f64,
    /// Root mean square of the stated uncertainties over √2 (the first frame's noise does not vary).
    pub sigma_of_one_frame: f64,
}

/// What was found; lengths in pixels.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// The first frame.
    pub reference: String,
    /// Points of interest.
    pub points: usize,
    /// Side of the subsets, pixels.
    pub subset_px: usize,
    /// Distance of points, pixels.
    pub step_px: usize,
    /// Strain window.
    pub gauge: Gauge,
    /// Strain measure.
    pub tensor: &'static str,
    /// The other frames.
    pub frames: Vec<FrameFloor>,
    /// u over the frames; needs three images.
    pub temporal_u: Option<Temporal>,
    /// v over the frames.
    pub temporal_v: Option<Temporal>,
    /// e_xx, e_yy, e_xy over the frames.
    pub temporal_strain: Option<[Temporal; 3]>,
}

/// Sums over the frames at one node.
#[derive(Debug, Clone, Copy, Default)]
struct Series {
    count: usize,
    mean: f64,
    squares: f64,
    variances: f64,
}

impl Series {
    /// Welford's update.
    fn push(&mut self, value: f64, sigma: f64) {
        if !value.is_finite() {
            return;
        }
        self.count += 1;
        let off = value - self.mean;
        self.mean += off / self.count as f64;
        self.squares += off * (value - self.mean);
        self.variances += sigma * sigma;
    }

    fn std(&self, frames: usize) -> f64 {
        if frames < 2 || self.count < frames { f64::NAN } else { (self.squares / (frames - 1) as f64).sqrt() }
    }

    fn mean(&self, frames: usize) -> f64 {
        if self.count < frames { f64::NAN } else { self.mean }
    }

    fn sigma(&self) -> f64 {
        (self.variances / self.count as f64).sqrt()
    }
}

/// A noise floor with its maps.
#[derive(Debug, Clone)]
pub struct NoiseFloor {
    /// The numbers.
    pub summary: Summary,
    /// Grid of the points.
    field: Field,
    /// u, v, e_xx, e_yy, e_xy at every node.
    series: [Vec<Series>; 5],
}

/// Least-squares rigid motion of small rotation, and the displacements without it.
fn without_rigid(field: &Field) -> (RigidMotion, Vec<[f64; 2]>) {
    let nodes: Vec<usize> = (0..field.u.len()).filter(|&n| field.is_valid(n)).collect();
    let n = nodes.len() as f64;
    let mean = |f: &dyn Fn(usize) -> f64| nodes.iter().map(|&k| f(k)).sum::<f64>() / n;
    let (mx, my) = (mean(&|k| field.position(k)[0]), mean(&|k| field.position(k)[1]));
    let (mu, mv) = (mean(&|k| field.u[k]), mean(&|k| field.v[k]));
    let (mut turn, mut inertia) = (0.0, 0.0);
    for &k in &nodes {
        let [x, y] = field.position(k);
        let (x, y) = (x - mx, y - my);
        turn += x * (field.v[k] - mv) - y * (field.u[k] - mu);
        inertia += x * x + y * y;
    }
    let rotation = if inertia > 0.0 { turn / inertia } else { 0.0 };
    let rest = (0..field.u.len())
        .map(|k| {
            if !field.is_valid(k) {
                return [f64::NAN; 2];
            }
            let [x, y] = field.position(k);
            [field.u[k] - mu + rotation * (y - my), field.v[k] - mv - rotation * (x - mx)]
        })
        .collect();
    (RigidMotion { u_px: mu, v_px: mv, rotation_urad: rotation * 1e6 }, rest)
}

fn scatter(values: impl Iterator<Item = f64>, sigma: impl Iterator<Item = f64>) -> Scatter {
    let (values, sigma) = (spread(values), spread(sigma));
    Scatter { mean: values.mean, std: values.std, sigma: sigma.rms }
}

fn temporal(series: &[Series], frames: usize) -> Option<Temporal> {
    if frames < 2 {
        return None;
    }
    let mut stds: Vec<f64> = series.iter().map(|s| s.std(frames)).filter(|s| s.is_finite()).collect();
    stds.sort_by(f64::total_cmp);
    let at = |part: f64| {
        stds.get((part * (stds.len() as f64 - 1.0)).round() as usize).copied().unwrap_or(f64::NAN)
    };
    let sigma = spread(series.iter().filter(|s| s.count == frames).map(Series::sigma)).rms;
    Some(Temporal {
        points: stds.len(),
        median: at(0.5),
        rms: spread(stds.iter().copied()).rms,
        p95: at(0.95),
        sigma_of_one_frame: sigma / 2f64.sqrt(),
    })
}

/// Correlates every image with the first and says how much of what is found is noise.
///
/// # Errors
/// Images that cannot be used or have nothing in common with the first; settings.
pub fn measure(
    paths: &[PathBuf],
    dic: &Settings,
    step: usize,
    roi: Option<Rectangle>,
    options: &Options,
    progress: &dyn Progress,
) -> Result<NoiseFloor, Error> {
    let Some((first, others)) = paths.split_first() else { return Err(Error::TooFewFrames { found: 0 }) };
    let first_image = images::read(first)?;
    let image = image_of(&first_image)?;
    dic.validate_for(image.width(), image.height())?;
    let roi = Roi { rectangle: roi, mask: None };
    let points = Points::grid(image.width(), image.height(), dic.subset, step, &roi)?;
    let reference = Reference::new(image);
    let mut floor: Option<(Field, [Vec<Series>; 5])> = None;
    let mut frames = Vec::with_capacity(others.len());
    progress.stage("correlating static frames", others.len() as u64);
    for (done, path) in others.iter().enumerate() {
        let frame = images::read_like(path, &first_image, first)?;
        let target = Target::new(image_of(&frame)?, dic.interpolation);
        let found = correlate(&reference, &target, &points, &Guess::Fft, dic, &())?;
        let ok = found.converged();
        if (ok as f64) < LEAST_OK * points.len() as f64 {
            return Err(Error::NotStatic { path: path.clone(), ok, points: points.len() });
        }
        let strain = StrainField::new(Field::of(&points, &found, dic.subset, dic.shape)?, options.clone())?;
        let field = &strain.field;
        let (rigid, rest) = without_rigid(field);
        let (_, series) = floor.get_or_insert_with(|| {
            (field.clone(), std::array::from_fn(|_| vec![Series::default(); field.u.len()]))
        });
        for (node, rest) in rest.iter().enumerate() {
            series[0][node].push(rest[0], field.sigma_u[node]);
            series[1][node].push(rest[1], field.sigma_v[node]);
            let s = &strain.strains[node];
            for (series, (e, sigma)) in series[2..].iter_mut().zip(s.components.into_iter().zip(s.sigma)) {
                series[node].push(e, sigma);
            }
        }
        let valid = || (0..field.u.len()).filter(|&n| field.is_valid(n));
        frames.push(FrameFloor {
            image: path.display().to_string(),
            ok,
            u: scatter(valid().map(|n| field.u[n]), valid().map(|n| field.sigma_u[n])),
            v: scatter(valid().map(|n| field.v[n]), valid().map(|n| field.sigma_v[n])),
            rigid,
            u_std_without_rigid: spread(rest.iter().map(|r| r[0])).std,
            v_std_without_rigid: spread(rest.iter().map(|r| r[1])).std,
            strain: [0, 1, 2].map(|c| {
                scatter(
                    strain.strains.iter().map(|s| s.components[c]),
                    strain.strains.iter().map(|s| s.sigma[c]),
                )
            }),
        });
        progress.advance(done as u64 + 1);
    }
    let Some((field, series)) = floor else { return Err(Error::TooFewFrames { found: 1 }) };
    let over_time = |k: usize| temporal(&series[k], frames.len());
    let strain = match [over_time(2), over_time(3), over_time(4)] {
        [Some(xx), Some(yy), Some(xy)] => Some([xx, yy, xy]),
        _ => None,
    };
    let summary = Summary {
        reference: first.display().to_string(),
        points: points.len(),
        subset_px: dic.subset,
        step_px: step,
        gauge: Gauge::of(options, &field),
        tensor: options.tensor.name(),
        temporal_u: over_time(0),
        temporal_v: over_time(1),
        temporal_strain: strain,
        frames,
    };
    Ok(NoiseFloor { summary, field, series })
}

impl NoiseFloor {
    /// `x,y,frames,mean_u,mean_v,std_u,std_v,sigma_u,sigma_v,mean_exx,std_exx,sigma_exx,…`: at every node how
    /// many frames have it, mean and standard deviation over the frames (without rigid motion; NaN
    /// where a frame lacks it or there is but one), and the stated uncertainty.
    ///
    /// # Errors
    /// Only if two columns had one name.
    pub fn table(&self) -> Result<Table, Error> {
        let frames = self.summary.frames.len();
        let nodes = || 0..self.field.u.len();
        let place = |c: usize| Column::F64(nodes().map(|n| self.field.position(n)[c]).collect());
        let column =
            |k: usize, f: &dyn Fn(&Series) -> f64| Column::F64(self.series[k].iter().map(f).collect());
        let counts = self.series[0].iter().map(|s| s.count as i64).collect();
        let mut table = Table::new()
            .with("x", place(0))?
            .with("y", place(1))?
            .with("frames", Column::I64(counts))?
            .with("mean_u", column(0, &|s| s.mean(frames)))?
            .with("mean_v", column(1, &|s| s.mean(frames)))?
            .with("std_u", column(0, &|s| s.std(frames)))?
            .with("std_v", column(1, &|s| s.std(frames)))?
            .with("sigma_u", column(0, &Series::sigma))?
            .with("sigma_v", column(1, &Series::sigma))?;
        for (c, name) in COMPONENTS.into_iter().enumerate() {
            table.push(&format!("mean_{name}"), column(2 + c, &|s| s.mean(frames)))?;
            table.push(&format!("std_{name}"), column(2 + c, &|s| s.std(frames)))?;
            table.push(&format!("sigma_{name}"), column(2 + c, &Series::sigma))?;
        }
        Ok(table)
    }

    /// Maps of the scatter over the frames (of the values themselves, if there is but one frame).
    ///
    /// # Errors
    /// If a figure cannot be drawn.
    pub fn figures(&self) -> Result<Vec<(&'static str, String)>, Error> {
        let frames = self.summary.frames.len();
        let names = if frames > 1 {
            ["std_u", "std_v", "std_exx", "std_eyy", "std_exy"]
        } else {
            ["u", "v", "exx", "eyy", "exy"]
        };
        let draw = |(k, name): (usize, &'static str)| {
            let value = |s: &Series| if frames > 1 { s.std(frames) } else { s.mean(frames) };
            let unit = if k < 2 { "px" } else { "" };
            let map = map_of(&self.field, name, unit, self.series[k].iter().map(value).collect());
            let title = format!("{name}, {frames} static frame(s) without rigid motion");
            Ok((name, crate::figures::map_svg(&map, &title, name)?))
        };
        names.into_iter().enumerate().map(draw).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use daic_correlate::Shape;

    #[test]
    fn a_rigid_motion_is_taken_off_and_nothing_else() {
        let mut f = Field::empty(12, 9, [30.0, 40.0], 7.0, 33, Shape::Affine);
        let (middle, turn) = ([30.0 + 5.5 * 7.0, 40.0 + 4.0 * 7.0], 3e-4);
        for n in 0..f.valid.len() {
            let [x, y] = f.position(n);
            let (x, y) = (x - middle[0], y - middle[1]);
            // a shear without rotation stays
            f.u[n] = 0.1 - turn * y + 1e-3 * y;
            f.v[n] = -0.2 + turn * x + 1e-3 * x;
            f.valid[n] = true;
        }
        let (rigid, rest) = without_rigid(&f);
        // the shear turns a field that is wider than high
        let (xx, yy): (f64, f64) = (0..f.u.len()).fold((0.0, 0.0), |(a, b), n| {
            let [x, y] = f.position(n);
            (a + (x - middle[0]).powi(2), b + (y - middle[1]).powi(2))
        });
        let extra = 1e-3 * (xx - yy) / (xx + yy);
        assert!((rigid.u_px - 0.1).abs() < 1e-12 && (rigid.v_px + 0.2).abs() < 1e-12);
        assert!((rigid.rotation_urad - (turn + extra) * 1e6).abs() < 1e-6, "{}", rigid.rotation_urad);
        let [x, y] = f.position(17);
        assert!((rest[17][0] - (1e-3 + extra) * (y - middle[1])).abs() < 1e-12);
        assert!((rest[17][1] - (1e-3 - extra) * (x - middle[0])).abs() < 1e-12);
    }

    #[test]
    fn series_are_means_and_deviations() {
        let mut s = Series::default();
        for v in [1.0, 4.0, f64::NAN, 7.0] {
            s.push(v, 2.0);
        }
        assert_eq!((s.mean(3), s.std(3), s.sigma()), (4.0, 3.0, 2.0));
        // a frame is missing
        assert!(s.std(4).is_nan() && s.mean(4).is_nan());
    }
}
