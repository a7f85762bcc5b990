//! How a run began: what was tried, what was accepted, and what was never reached.

use crate::features::AffineGroup;
use crate::point::{Point, Status};
use crate::shape::{Shape, Warp};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Displacement of one place as the user knows it, good to about ten pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seed {
    /// Position in the reference image, pixels.
    pub x: f64,
    /// Position in the reference image, pixels.
    pub y: f64,
    /// Displacement along x, pixels.
    pub u: f64,
    /// Displacement along y, pixels.
    pub v: f64,
    /// Displacement gradient u_x, u_y, v_x, v_y, where the material has turned or changed its size:
    /// for a rotation by θ (from x towards y) cos θ − 1, −sin θ, sin θ, cos θ − 1. Good to about 0.1.
    pub gradient: Option<[f64; 4]>,
}

impl Seed {
    /// Shape function about the pixel (x, y).
    pub(crate) fn warp(&self, x: f64, y: f64) -> Warp {
        let [ux, uy, vx, vy] = self.gradient.unwrap_or_default();
        Warp([[self.u, ux, uy, 0.0, 0.0, 0.0], [self.v, vx, vy, 0.0, 0.0, 0.0]]).moved(x - self.x, y - self.y)
    }

    pub(crate) fn numbers(&self) -> impl Iterator<Item = f64> {
        [self.x, self.y, self.u, self.v].into_iter().chain(self.gradient.unwrap_or_default())
    }
}

/// Way to a first displacement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StartMethod {
    /// Cross-correlation by FFT.
    Fft,
    /// Matched features.
    Features,
    /// Search over the range given.
    Search,
    /// Displacements given per point.
    Given,
    /// The user's seeds.
    Seeds,
    /// What the frame before left at each point.
    Shapes,
}

impl StartMethod {
    /// Stable name.
    pub fn name(self) -> &'static str {
        match self {
            StartMethod::Fft => "fft",
            StartMethod::Features => "features",
            StartMethod::Search => "search",
            StartMethod::Given => "given",
            StartMethod::Seeds => "seeds",
            StartMethod::Shapes => "shapes",
        }
    }
}

impl fmt::Display for StartMethod {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One way that was tried.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StartAttempt {
    /// Which.
    pub method: StartMethod,
    /// Points that were started in this way.
    pub tried: usize,
    /// Points whose own correlation confirmed the start.
    pub accepted: usize,
}

/// A seed of the user that did not lead to an accepted point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RejectedSeed {
    /// Index in the list of seeds.
    pub index: usize,
    /// The point nearest to it that has a subset in the reference image, if there is one.
    pub point: Option<usize>,
    /// What its correlation ended with.
    pub status: Status,
}

/// What matching of features found, where it was needed.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FeatureStart {
    /// Features matched between the images.
    pub matches: usize,
    /// Affine maps that explain them, the one with most matches first.
    pub groups: Vec<AffineGroup>,
}

/// What the user should know about the start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StartWarning {
    /// No start was accepted at all.
    NothingAccepted,
    /// Seeds of the user were not confirmed.
    SeedsRejected {
        /// Seeds not confirmed.
        rejected: usize,
        /// Seeds given.
        given: usize,
    },
    /// A good part of the points was never reached.
    Unreached {
        /// Points without an initial guess.
        points: usize,
        /// Points in all.
        total: usize,
    },
    /// The material has turned or stretched so much that a subset which only moves cannot follow.
    ShapeTooSimple {
        /// Rotation found from features, degrees.
        rotation_deg: f64,
        /// Principal stretches found from features.
        stretches: [f64; 2],
    },
}

impl fmt::Display for StartWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            StartWarning::NothingAccepted => {
                f.write_str("no initial guess was confirmed: check that the images belong together")
            }
            StartWarning::SeedsRejected { rejected, given } => {
                write!(f, "{rejected} of {given} seeds were not confirmed by their correlation")
            }
            StartWarning::Unreached { points, total } => {
                write!(f, "no initial guess for {points} of {total} points")
            }
            StartWarning::ShapeTooSimple { rotation_deg, stretches: [large, small] } => write!(
                f,
                "the material has turned by {rotation_deg:.1}° (stretches {large:.2}, {small:.2}), which a subset without deformation cannot follow: use an affine one"
            ),
        }
    }
}

/// How a run began.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StartReport {
    /// What was tried, in this order.
    pub attempts: Vec<StartAttempt>,
    /// The user's seeds that were not accepted.
    pub rejected: Vec<RejectedSeed>,
    /// Matching of features, where it took place.
    pub features: Option<FeatureStart>,
    /// Points that no guess has reached ([`Status::NoGuess`]).
    pub unreached: usize,
    /// Points in all.
    pub total: usize,
    /// Reasons not to trust the start.
    pub warnings: Vec<StartWarning>,
}

/// Part of the points that may stay without a guess before it is worth a warning.
const UNREACHED: f64 = 0.02;
/// Motion of a subset's edge, in pixels, that a subset without deformation cannot follow.
const RIGID: f64 = 2.0;

impl StartReport {
    /// The way that gave most of the accepted starts; `None` where there are none.
    pub fn method(&self) -> Option<StartMethod> {
        let best = self.attempts.iter().rev().max_by_key(|a| a.accepted)?;
        (best.accepted > 0).then_some(best.method)
    }

    /// Starts tried in all.
    pub fn seeds_tried(&self) -> usize {
        self.attempts.iter().map(|a| a.tried).sum()
    }

    /// Starts accepted in all.
    pub fn seeds_accepted(&self) -> usize {
        self.attempts.iter().map(|a| a.accepted).sum()
    }

    /// Looks at the finished run.
    pub(crate) fn close(&mut self, points: &[Point], shape: Shape, radius: usize) {
        self.total = points.len();
        self.unreached = points.iter().filter(|p| p.status == Status::NoGuess).count();
        if self.seeds_accepted() == 0 && !points.iter().any(|p| p.status.is_ok()) && self.total > 0 {
            self.warnings.push(StartWarning::NothingAccepted);
        }
        if !self.rejected.is_empty() {
            let given = self.seeds_tried();
            self.warnings.push(StartWarning::SeedsRejected { rejected: self.rejected.len(), given });
        }
        if self.unreached as f64 > UNREACHED * self.total as f64 {
            self.warnings.push(StartWarning::Unreached { points: self.unreached, total: self.total });
        }
        let affine = self.features.as_ref().and_then(|f| f.groups.first()).map(|g| g.affine);
        if let Some(a) = affine
            && shape == Shape::Translation
            && a.gradient().iter().any(|g| g.abs() * radius as f64 > RIGID)
        {
            let warning =
                StartWarning::ShapeTooSimple { rotation_deg: a.rotation_deg(), stretches: a.stretches() };
            self.warnings.push(warning);
        }
    }
}
