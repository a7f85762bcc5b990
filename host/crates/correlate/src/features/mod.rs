//! Initial guesses from features: blobs of the speckle pattern, described independently of
//! brightness, contrast, rotation and scale, matched over the whole image, and grouped by the affine
//! map that they follow.
//!
//! Where cross-correlation fails because the material has turned or changed its size, this says
//! where to begin; it is accurate to a fraction of a pixel, not more, and every point that begins
//! there is judged by its own correlation.

mod affine;
mod describe;
mod matching;
mod scale;

pub use affine::Affine;

use crate::image::{Image, Mask};
use describe::Feature;
use rayon::prelude::*;
use scale::{Blob, Layer};

/// Features of the reference image, at most.
const BUDGET: usize = 2500;
/// Features of the deformed image, at most.
const TARGET_BUDGET: usize = 20_000;
/// Larger regions are reduced to about this many pixels first.
const PIXELS: f64 = 1.5e6;
/// Tiles along each side of the image that share the features evenly.
const TILES: usize = 8;
/// Groups of matches with an affine map of their own, at most.
const GROUPS: usize = 4;
/// Matches that make a local map.
const NEAREST: usize = 12;

/// The same blob in both images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeatureMatch {
    /// Position in the reference image, pixels.
    pub reference: [f64; 2],
    /// Position in the deformed image, pixels.
    pub target: [f64; 2],
    /// Size of the blob in the reference image: standard deviation of the smoothing at which it
    /// stands out most, pixels.
    pub scale: f64,
    /// Rotation of its surroundings from the reference to the deformed image, radians.
    pub rotation: f64,
    /// Cosine between the two descriptions: 1 for equal ones.
    pub similarity: f32,
    /// Which of [`FeatureMatches::groups`] explains it; `None` for mismatches.
    pub group: Option<usize>,
}

/// Matches that follow one affine map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AffineGroup {
    /// Least-squares map through all of them.
    pub affine: Affine,
    /// How many they are.
    pub inliers: usize,
}

/// Result of [`match_features`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FeatureMatches {
    /// Matches in the order of the reference image's features.
    pub matches: Vec<FeatureMatch>,
    /// Motions found, the one with most matches first; none where the images have nothing in common.
    pub groups: Vec<AffineGroup>,
    /// Features in the reference image.
    pub reference_features: usize,
    /// Features in the deformed image.
    pub target_features: usize,
    /// Pixels of the images that were taken as one along each side.
    pub reduction: usize,
}

impl FeatureMatches {
    /// The map that explains most matches, and how many.
    pub fn affine(&self) -> Option<AffineGroup> {
        self.groups.first().copied()
    }

    /// Affine map around (x, y) of the reference image: through the nearest matches of one group, or
    /// where they do not determine it, the group's own.
    pub fn local(&self, x: f64, y: f64) -> Option<Affine> {
        let mut near: Vec<(f64, &FeatureMatch)> = self
            .matches
            .iter()
            .filter(|m| m.group.is_some())
            .map(|m| ((m.reference[0] - x).powi(2) + (m.reference[1] - y).powi(2), m))
            .collect();
        if near.is_empty() {
            return None;
        }
        let count = NEAREST.min(near.len());
        // the sort is stable: equal distances keep the order of the matches
        near.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut votes = [0usize; GROUPS];
        for g in near[..count].iter().filter_map(|m| m.1.group) {
            votes[g] += 1;
        }
        let most = (0..GROUPS).rev().max_by_key(|&g| votes[g])?;
        let own: Vec<&FeatureMatch> =
            near.iter().map(|m| m.1).filter(|m| m.group == Some(most)).take(count).collect();
        Affine::trimmed(own).or_else(|| self.groups.get(most).map(|g| g.affine))
    }
}

/// Matches blobs of the reference image with those of the deformed image.
///
/// Blobs are extrema of differences of Gaussians, described by histograms of gradient directions
/// in a frame of their own orientation and scale (Lowe, IJCV 60 (2004) 91): rotations by any angle,
/// scales of about 0.6–1.6, shifts as long as a good part of the image remains in view, and changes
/// of brightness and contrast do not matter. The strongest ones, spread evenly, are matched if each
/// is the other's best and clearly better than the second; up to four affine maps are found among
/// them (RANSAC with a fixed sequence of draws).
///
/// `region`: the pixels of the reference image whose features are used; `None` for all, and where
/// its size is not the image's. Positions are good to about 0.3 px of the image, or of its reduction.
/// Runs on the current rayon thread pool; the result does not depend on its size.
pub fn match_features(reference: &Image, target: &Image, region: Option<&Mask>) -> FeatureMatches {
    let whole = (0, 0, reference.width(), reference.height());
    match region {
        Some(m) if (m.width(), m.height()) == (reference.width(), reference.height()) => {
            match_within(reference, target, m.count() as f64, &|x, y| m.contains(x, y))
        }
        _ => match_within(reference, target, (whole.2 * whole.3) as f64, &|_, _| true),
    }
}

/// As [`match_features`]; `inside` tells the pixels to be used, `area` their number.
pub(crate) fn match_within(
    reference: &Image,
    target: &Image,
    area: f64,
    inside: &(dyn Fn(usize, usize) -> bool + Sync),
) -> FeatureMatches {
    let mut reduction = (area / PIXELS).sqrt().ceil().max(1.0) as usize;
    loop {
        let found = match_reduced(reference, target, area, inside, reduction);
        // fine speckles may not survive the reduction
        if !found.groups.is_empty() || reduction == 1 {
            return found;
        }
        reduction /= 2;
    }
}

fn match_reduced(
    reference: &Image,
    target: &Image,
    area: f64,
    inside: &(dyn Fn(usize, usize) -> bool + Sync),
    reduction: usize,
) -> FeatureMatches {
    let a = features(reference, reduction, BUDGET, inside);
    // as densely chosen as in the reference
    let share = (target.width() * target.height()) as f64 / area.max(1.0);
    let budget = (a.len() as f64 * share).min(TARGET_BUDGET as f64) as usize;
    let b = features(target, reduction, budget.max(BUDGET), &|_, _| true);
    let mut found = FeatureMatches {
        matches: matching::mutual(&a, &b),
        groups: Vec::new(),
        reference_features: a.len(),
        target_features: b.len(),
        reduction,
    };
    let mut open: Vec<usize> = (0..found.matches.len()).collect();
    for g in 0..GROUPS {
        let Some((affine, inliers)) = affine::consensus(&found.matches, &open) else {
            break;
        };
        // what is left over after the first must not be a few mismatches that happen to agree
        if g > 0 && inliers.len() < 2 * affine::FEWEST {
            break;
        }
        for &k in &inliers {
            found.matches[k].group = Some(g);
        }
        found.groups.push(AffineGroup { affine, inliers: inliers.len() });
        open.retain(|&k| found.matches[k].group.is_none());
    }
    found
}

/// The strongest blobs of an image in even distribution, described; positions and scales in pixels
/// of the image.
fn features(
    image: &Image,
    reduction: usize,
    budget: usize,
    inside: &(dyn Fn(usize, usize) -> bool + Sync),
) -> Vec<Feature> {
    let octaves = scale::octaves(reduced(image, reduction));
    let f = reduction as f32;
    let shift = 0.5 * (f - 1.0);
    let position = |b: &Blob| {
        let s = octaves[b.octave].spacing;
        [b.x * s * f + shift, b.y * s * f + shift]
    };
    let pixel = |c: f32, size: usize| (c.round().max(0.0) as usize).min(size - 1);
    let mut blobs: Vec<([f32; 2], Blob)> = scale::blobs(&octaves)
        .into_iter()
        .map(|b| (position(&b), b))
        .filter(|(p, _)| inside(pixel(p[0], image.width()), pixel(p[1], image.height())))
        .collect();
    let (mut lo, mut hi) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
    for (p, _) in &blobs {
        for c in 0..2 {
            lo[c] = lo[c].min(p[c]);
            hi[c] = hi[c].max(p[c]);
        }
    }
    let tile = |p: &[f32; 2]| {
        let along = |c: usize| {
            let size = (hi[c] - lo[c]).max(1.0) / TILES as f32;
            (((p[c] - lo[c]) / size) as usize).min(TILES - 1)
        };
        along(1) * TILES + along(0)
    };
    // stable: equal responses keep their order
    blobs.sort_by(|a, b| b.1.response.abs().total_cmp(&a.1.response.abs()));
    let quota = budget.div_ceil(TILES * TILES);
    let mut taken = [0usize; TILES * TILES];
    blobs.retain(|(p, _)| {
        let t = &mut taken[tile(p)];
        *t += 1;
        *t <= quota
    });
    let described: Vec<Vec<Feature>> =
        blobs.par_iter().map(|(_, b)| describe::describe(&octaves, b)).collect();
    let mut out: Vec<Feature> = described.into_iter().flatten().collect();
    for feature in &mut out {
        feature.x = feature.x * f + shift;
        feature.y = feature.y * f + shift;
        feature.scale *= f;
    }
    out
}

/// Means of squares of `factor` pixels.
fn reduced(image: &Image, factor: usize) -> Layer {
    let (width, height) = (image.width() / factor, image.height() / factor);
    let mut data = vec![0.0f32; width * height];
    for y in 0..height * factor {
        let row = &mut data[y / factor * width..][..width];
        for (o, c) in row.iter_mut().zip(image.row(y).chunks_exact(factor)) {
            *o += c.iter().sum::<f32>();
        }
    }
    let inverse = 1.0 / (factor * factor) as f32;
    data.iter_mut().for_each(|g| *g *= inverse);
    Layer { width, height, data }
}
