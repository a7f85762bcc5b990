//! Calibration boards in images: dot grids and checkerboards, found without help, to a few
//! thousandths of a pixel.
//!
//! Candidates (dots: regions beyond the local mid-level; checkerboards: saddles of the smoothed
//! image) grow into a lattice along two directions. Each point of it is then fitted in the image
//! itself: an ellipse with a blurred edge or the product of two blurred edges, both under light
//! with a gradient; their covariance gives the standard deviations. The centre of the image of a
//! circle is not the image of its centre: the difference follows from the local map from lattice to
//! image (perspective and distortion alike) and is taken away.
//!
//! Indices (i, j) count along the lattice, i to the right and j down as near as it goes, from 0 or
//! from a marked dot. A lattice of equal points does not tell its own symmetries: they are indices
//! up to a rotation of the board by multiples of 90° and, where part of it is out of the picture,
//! up to a shift.

mod checker;
mod dots;
mod lattice;
mod local;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::patch::GreyView;
use crate::patch::ellipse::Form;
use crate::patch::smooth::Plane;
use lattice::{Lattice, Node};
use local::LocalMap;

/// Column and row on the lattice.
pub type Index = [i32; 2];

/// What is on the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pattern {
    /// Round dots on a square grid.
    Dots,
    /// Alternating squares; the points are the corners where four of them meet.
    Checker,
}

/// Brightness of dots against their ground.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Polarity {
    /// Dark dots on light ground.
    Dark,
    /// Light dots on dark ground.
    Light,
}

/// What to look for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TargetSettings {
    /// What is on the board.
    pub pattern: Pattern,
    /// Of dots; none tries both.
    pub polarity: Option<Polarity>,
    /// Points of the whole board along both directions, in either order, if known. Less is found
    /// where part of the board is out of the picture; more is an error.
    pub size: Option<[usize; 2]>,
    /// Fewest points that make a board.
    pub least_points: usize,
}

impl TargetSettings {
    /// A board of any size with at least 12 points.
    pub fn new(pattern: Pattern) -> Self {
        Self { pattern, polarity: None, size: None, least_points: 12 }
    }
}

/// A point of the board.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TargetPoint {
    /// Column and row, see the [module](self).
    pub index: Index,
    /// Position, pixels.
    pub at_px: [f64; 2],
    /// Standard deviations of both coordinates from the image's noise, pixels.
    pub sigma_px: [f64; 2],
    /// What was taken away from the centre of the ellipse, pixels; zero for corners.
    pub correction_px: [f64; 2],
}

/// A board in an image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Target {
    /// The points, by row and column.
    pub points: Vec<TargetPoint>,
    /// Columns and rows that the points span.
    pub span: [usize; 2],
    /// Of dots.
    pub polarity: Option<Polarity>,
    /// The one dot that is clearly larger or smaller than the others; it has the index (0, 0).
    pub origin: Option<[f64; 2]>,
    /// Radius of the dots in lattice steps, median.
    pub radius_steps: Option<f64>,
    /// Median contrast, grey levels.
    pub contrast: f64,
    /// Median standard deviation of the grey values about the fitted models.
    pub noise: f64,
    /// Median distance of neighbours, pixels.
    pub step_px: f64,
}

/// Why there is no board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TargetError {
    /// No pixel is in use.
    #[error("no pixel of the image is in use: the mask leaves none, or none is finite")]
    Empty,
    /// Nothing that forms a lattice.
    #[error(
        "no board: of {candidates} possible points at most {found} form a lattice, {needed} are needed; is the board in focus, is it of the pattern asked for, and are its points at least 5 pixels wide?"
    )]
    NoBoard {
        /// Dots or corners found one by one.
        candidates: usize,
        /// Points of the largest lattice among them.
        found: usize,
        /// Fewest points that make a board.
        needed: usize,
    },
    /// More points than the board has.
    #[error(
        "the lattice found spans {} × {} points, the board is said to have {} × {}: wrong size stated, or something else in the image continues the board",
        found[0], found[1], stated[0], stated[1]
    )]
    LargerThanStated {
        /// Columns and rows found.
        found: [usize; 2],
        /// As stated.
        stated: [usize; 2],
    },
}

/// Candidates and the lattice among them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Found {
    nodes: Vec<Node>,
    lattice: Lattice,
    /// Of dots, one for each node.
    forms: Vec<Form>,
    polarity: Option<Polarity>,
    /// How much the image was reduced.
    scale: f64,
}

/// A point fitted in the image.
#[derive(Clone, Debug)]
pub(crate) struct Refined {
    index: Index,
    centre: [f64; 2],
    sigma: [f64; 2],
    contrast: f64,
    noise: f64,
    area: f64,
}

/// Dots that differ by this factor in radius from the median are marks.
const MARK: f64 = 1.2;

/// Residuals that the models leave on real dots and corners, as a share of the contrast.
const MISFIT: f64 = 0.05;
/// How far a point may be from where its neighbours have it, in steps.
const ROUGH: f64 = 0.015;

/// Finds the board in an image.
///
/// # Errors
/// [`TargetError`] where there is none, or a larger one than stated.
pub fn find_target(view: &GreyView<'_>, settings: &TargetSettings) -> Result<Target, TargetError> {
    let plane = Plane::of(view).ok_or(TargetError::Empty)?;
    let found = match settings.pattern {
        Pattern::Dots => dots::search(&plane, settings.polarity),
        Pattern::Checker => checker::search(&plane),
    };
    let mut points = match settings.pattern {
        Pattern::Dots => dots::refine(view, &found),
        Pattern::Checker => checker::refine(view, &plane, &found),
    };
    weed(&mut points);
    // Squares, letters, bubbles: what is no dot (no corner) leaves residuals beyond the noise.
    let misfit = median(points.iter().map(|p| p.noise).collect());
    let contrast = median(points.iter().map(|p| p.contrast.abs()).collect());
    if misfit > 2.0 * plane.noise() + MISFIT * contrast {
        points.clear();
    }
    let needed = settings.least_points.max(9);
    let span = span(points.iter().map(|p| p.index));
    if points.len() < needed || span[0] < 3 || span[1] < 3 || 2 * points.len() < span[0] * span[1] {
        return Err(TargetError::NoBoard { candidates: found.nodes.len(), found: points.len(), needed });
    }
    if let Some(stated) = settings.size {
        let fits = |a: usize, b: usize| span[0] <= a && span[1] <= b;
        if !fits(stated[0], stated[1]) && !fits(stated[1], stated[0]) {
            return Err(TargetError::LargerThanStated { found: span, stated });
        }
    }
    Ok(finish(points, &found, span))
}

/// Drops points that their own fit or their neighbours contradict, and what then hangs on nothing.
fn weed(points: &mut Vec<Refined>) {
    let usual = median(points.iter().map(|p| p.noise).collect());
    points.retain(|p| p.noise <= 3.0 * usual);
    for _ in 0..10 {
        let centres: BTreeMap<Index, [f64; 2]> = points.iter().map(|p| (p.index, p.centre)).collect();
        // How far a point is from where its neighbours have it, as a multiple of what is allowed.
        let off: BTreeMap<Index, f64> = points
            .iter()
            .filter_map(|p| {
                let others = |i: Index| centres.get(&i).filter(|_| i != p.index).copied();
                let map = LocalMap::fit(p.index, others)?;
                let step = map.determinant().abs().sqrt();
                let allowed = ROUGH * step + 8.0 * p.sigma[0].hypot(p.sigma[1]);
                Some((p.index, lattice::distance(map.at, p.centre) / allowed))
            })
            .collect();
        // A wrong point spoils its neighbours: only the worst of a neighbourhood goes.
        let worst = |p: &Refined| {
            let own = off.get(&p.index).copied().unwrap_or(0.0);
            let near = |i: &Index| (i[0] - p.index[0]).abs() <= 2 && (i[1] - p.index[1]).abs() <= 2;
            own > 1.0 && off.iter().filter(|(i, _)| near(i)).all(|(_, o)| *o <= own)
        };
        let before = points.len();
        points.retain(|p| !worst(p));
        let lattice: Lattice = points.iter().enumerate().map(|(k, p)| (p.index, k)).collect();
        let rest = lattice::connected(&lattice);
        points.retain(|p| rest.contains_key(&p.index));
        if points.len() == before {
            break;
        }
    }
}

fn span(indices: impl Iterator<Item = Index> + Clone) -> [usize; 2] {
    [0, 1].map(|axis| {
        let values = indices.clone().map(move |i| i[axis]);
        match (values.clone().min(), values.max()) {
            (Some(low), Some(high)) => (high - low) as usize + 1,
            _ => 0,
        }
    })
}

fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let half = values.len() / 2;
    *values.select_nth_unstable_by(half, f64::total_cmp).1
}

fn finish(points: Vec<Refined>, found: &Found, span: [usize; 2]) -> Target {
    let centres: BTreeMap<Index, [f64; 2]> = points.iter().map(|p| (p.index, p.centre)).collect();
    let at = |index: Index| centres.get(&index).copied();
    let maps: Vec<Option<LocalMap>> = points.iter().map(|p| LocalMap::fit(p.index, at)).collect();
    let step_px = median(
        points
            .iter()
            .flat_map(|p| [[1, 0], [0, 1]].map(|d| (p.centre, at([p.index[0] + d[0], p.index[1] + d[1]]))))
            .filter_map(|(a, b)| b.map(|b| lattice::distance(a, b)))
            .collect(),
    );
    let is_dots = found.polarity.is_some();
    let radii = if is_dots { dots::radii(&points, &maps) } else { vec![None; points.len()] };
    let radius_steps = is_dots.then(|| median(radii.iter().flatten().copied().collect()));
    let marks: Vec<usize> = match radius_steps {
        Some(usual) => (0..points.len())
            .filter(|&k| radii[k].is_some_and(|r| r > MARK * usual || r * MARK < usual))
            .collect(),
        None => Vec::new(),
    };
    let mark = (marks.len() == 1).then(|| marks[0]);
    let least = |axis: usize| points.iter().map(|p| p.index[axis]).min().unwrap_or(0);
    let zero = mark.map_or([least(0), least(1)], |k| points[k].index);
    let mut out: Vec<TargetPoint> = points
        .iter()
        .enumerate()
        .map(|(k, p)| {
            let shift = match (maps[k], radii[k]) {
                (Some(map), Some(radius)) => map.centre_shift(radius),
                _ => [0.0; 2],
            };
            TargetPoint {
                index: [p.index[0] - zero[0], p.index[1] - zero[1]],
                at_px: [p.centre[0] - shift[0], p.centre[1] - shift[1]],
                sigma_px: p.sigma,
                correction_px: shift,
            }
        })
        .collect();
    let origin = mark.map(|k| out[k].at_px);
    out.sort_by_key(|p| [p.index[1], p.index[0]]);
    Target {
        points: out,
        span,
        polarity: found.polarity,
        origin,
        radius_steps,
        contrast: median(points.iter().map(|p| p.contrast.abs()).collect()),
        noise: median(points.iter().map(|p| p.noise).collect()),
        step_px,
    }
}
