//! The reference frame brought to the focus of another one.
//!
//! A move along z or a tilt defocuses the slide. Blur by a round spot of variance σ² leaves a subset where it
//! is, but a window of w pixels takes part of the change σ²/2·∇²f for a displacement: what its rim adds
//! does not cancel, some hundredths of a pixel at w = 59 and 10 µm. So the sharper reference is blurred, place
//! by place, to the focus of the moved frame. How much is found from the two images alone: by the
//! variance of highest ZNCC in a bank of blurred references, smoothed by a quadratic over the view.

use super::super::ReproduceError;
use super::super::statistics::Quadratic;
use daic_correlate::{Guess, Image, Points, Reference, Settings, Target, correlate};
use rayon::prelude::*;

/// Standard deviations of the bank's blurs: 0 to 7 px, the defocus of 20 µm.
const LEVELS: usize = 15;
const LEVEL_PX: f64 = 0.5;
/// A Gaussian is cut off at this many standard deviations.
const REACH: f64 = 4.0;
/// Points at which the blur is looked for, in each view.
const PROBES: usize = 64;

/// References of one frame with rising blur.
pub struct Bank {
    width: usize,
    height: usize,
    levels: Vec<Reference>,
}

fn variance(level: usize) -> f64 {
    (level as f64 * LEVEL_PX).powi(2)
}

impl Bank {
    /// Blurs `frame`.
    ///
    /// # Errors
    /// None on a frame that has pixels.
    pub fn new(frame: &Image) -> Result<Self, ReproduceError> {
        let (width, height) = (frame.width(), frame.height());
        let levels = (0..LEVELS)
            .map(|k| Ok(Reference::new(blurred(frame, variance(k).sqrt())?)))
            .collect::<Result<_, ReproduceError>>()?;
        Ok(Self { width, height, levels })
    }

    /// The frame as it was taken.
    pub fn sharp(&self) -> &Reference {
        &self.levels[0]
    }

    /// The reference blurred to the focus of `target`. `views` are the places (px) of the −1 and +1 view at
    /// which subsets are correlated, and their displacements there as far as they are known.
    ///
    /// # Errors
    /// What the correlation refuses; too few places where it succeeds.
    pub fn focused(
        &self,
        target: &Target,
        views: [&[([f64; 2], [f64; 2])]; 2],
        settings: &Settings,
    ) -> Result<Reference, ReproduceError> {
        let mut fits = Vec::new();
        for places in views {
            fits.push(self.variances(target, places, settings)?);
        }
        let mut image = vec![0f32; self.width * self.height];
        image.par_chunks_mut(self.width).enumerate().for_each(|(y, row)| {
            for (x, out) in row.iter_mut().enumerate() {
                let fit = &fits[usize::from(2 * x >= self.width)];
                *out = self.grey([x, y], fit.at([x as f64, y as f64]));
            }
        });
        Ok(Reference::new(Image::from_f32(self.width, self.height, image)?))
    }

    /// Grey value with a blur between two levels: the mixture of both that has the variance.
    fn grey(&self, [x, y]: [usize; 2], wanted: f64) -> f32 {
        let level = ((wanted.max(0.0).sqrt() / LEVEL_PX) as usize).min(LEVELS - 2);
        let (low, high) = (variance(level), variance(level + 1));
        let share = ((wanted - low) / (high - low)).clamp(0.0, 1.0);
        let of = |k: usize| f64::from(self.levels[k].image().row(y)[x]);
        (of(level) * (1.0 - share) + of(level + 1) * share) as f32
    }

    /// Variance of the blur over a view.
    fn variances(
        &self,
        target: &Target,
        places: &[([f64; 2], [f64; 2])],
        settings: &Settings,
    ) -> Result<Quadratic, ReproduceError> {
        let every = places.len().div_ceil(PROBES).max(1);
        let (at, moved): (Vec<_>, Vec<_>) = places.iter().step_by(every).copied().unzip();
        let points = Points::scattered(at.clone())?;
        let moved: Vec<_> = moved.into_iter().map(Some).collect();
        let mut zncc = vec![[f64::NAN; LEVELS]; at.len()];
        for (k, reference) in self.levels.iter().enumerate() {
            let found = correlate(reference, target, &points, &Guess::Given(&moved), settings, &())?;
            for (z, p) in zncc.iter_mut().zip(&found.points) {
                z[k] = if p.status.is_ok() { f64::from(p.zncc) } else { f64::NAN };
            }
        }
        let best = at.into_iter().zip(&zncc).filter_map(|(at, z)| Some((at, summit(z)?)));
        let (at, best): (Vec<_>, Vec<_>) = best.unzip();
        Quadratic::fit(&at, &best).ok_or(ReproduceError::Few {
            what: "focus of a frame".to_owned(),
            found: at.len(),
            needed: Quadratic::TERMS,
        })
    }
}

/// Variance at which a parabola through the highest value and its neighbours peaks.
fn summit(zncc: &[f64; LEVELS]) -> Option<f64> {
    let best = (0..LEVELS).filter(|k| !zncc[*k].is_nan()).max_by(|a, b| zncc[*a].total_cmp(&zncc[*b]))?;
    let middle = best.clamp(1, LEVELS - 2);
    let [a, b, c] = [middle - 1, middle, middle + 1].map(|k| (variance(k), zncc[k]));
    let (left, right) = ((b.1 - a.1) / (b.0 - a.0), (c.1 - b.1) / (c.0 - b.0));
    let bend = (right - left) / (c.0 - a.0);
    // also where the summit lies beyond the bank's first level: noise must not push the mean up
    let peak = 0.5 * (a.0 + b.0) - 0.5 * left / bend;
    (bend < 0.0 && peak.is_finite()).then_some(peak)
}

/// An image through a Gaussian of standard deviation `sigma` pixels, edges repeated.
fn blurred(image: &Image, sigma: f64) -> Result<Image, ReproduceError> {
    let (width, height) = (image.width(), image.height());
    if sigma == 0.0 {
        return Ok(Image::from_f32(width, height, image.grey().to_vec())?);
    }
    let reach = (REACH * sigma).ceil() as isize;
    let mut kernel: Vec<f64> = (-reach..=reach).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
    let sum: f64 = kernel.iter().sum();
    kernel.iter_mut().for_each(|k| *k /= sum);
    let through = |get: &(dyn Fn(usize) -> f32 + Sync), at: usize, size: usize| {
        let place = |k: usize| (at as isize + k as isize - reach).clamp(0, size as isize - 1) as usize;
        kernel.iter().enumerate().map(|(k, w)| w * f64::from(get(place(k)))).sum::<f64>() as f32
    };
    let mut across = vec![0f32; width * height];
    across.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let from = image.row(y);
        for (x, out) in row.iter_mut().enumerate() {
            *out = through(&|i| from[i], x, width);
        }
    });
    let mut both = vec![0f32; width * height];
    both.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, out) in row.iter_mut().enumerate() {
            *out = through(&|j| across[j * width + x], y, height);
        }
    });
    Ok(Image::from_f32(width, height, both)?)
}
