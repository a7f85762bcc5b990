//! A material point on its way through a series of references.

use crate::point::{Point, ShapeParameters, Status};
use crate::shape::Warp;
use serde::{Deserialize, Serialize};

/// A point of the first frame, seen in a later frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) enum Track {
    /// Found.
    Found {
        /// Displacement from the first frame and its derivatives, about the point itself.
        warp: Warp,
        /// Variances of u and v, square pixels.
        variance: [f64; 2],
    },
    /// Lost for good.
    Lost {
        /// Why.
        status: Status,
        /// Reference in which it was still seen.
        reference: u32,
    },
}

impl Track {
    /// Of the first frame itself.
    pub(super) const HERE: Track = Track::Found { warp: Warp([[0.0; 6]; 2]), variance: [0.0; 2] };

    pub(super) fn is_found(&self) -> bool {
        matches!(self, Track::Found { .. })
    }

    /// Position of the material point (x, y) of the first frame.
    pub(super) fn position(&self, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        match self {
            Track::Found { warp, .. } => Some([x + warp.0[0][0], y + warp.0[1][0]]),
            Track::Lost { .. } => None,
        }
    }

    /// Whether a stored track can be continued.
    pub(super) fn is_sound(&self) -> bool {
        match self {
            Track::Found { warp, variance } => {
                warp.0.iter().flatten().all(|c| c.is_finite()) && variance.iter().all(|&v| v >= 0.0)
            }
            Track::Lost { status, .. } => !status.is_ok(),
        }
    }

    /// Goes on by what was measured against the present reference: `step`, a result at the moved
    /// position.
    ///
    /// x₁ = X + U(X), x₂ = x₁ + u(x₁): displacements add, deformation gradients multiply, variances
    /// add.
    pub(super) fn then(&self, step: &Point, reference: u32) -> Track {
        match self {
            Track::Found { .. } if !step.status.is_ok() => Track::Lost { status: step.status, reference },
            Track::Found { warp, variance } => {
                let mut total = warp.then(&jet(step));
                // not through the single precision of the shape
                total.0[0][0] = warp.0[0][0] + step.u;
                total.0[1][0] = warp.0[1][0] + step.v;
                let sigma = [f64::from(step.sigma_u), f64::from(step.sigma_v)];
                Track::Found { warp: total, variance: [0, 1].map(|c| variance[c] + sigma[c] * sigma[c]) }
            }
            lost @ Track::Lost { .. } => *lost,
        }
    }
}

/// Displacement and derivatives about the point itself, which may lie between pixels.
fn jet(point: &Point) -> Warp {
    let (ox, oy) = (point.x - point.x.round(), point.y - point.y.round());
    let mut warp = Warp::of(&point.shape).moved(ox, oy);
    (warp.0[0][0], warp.0[1][0]) = (point.u, point.v);
    warp
}

/// The same as single-precision derivatives, for the next frame to start from.
pub(super) fn start(point: &Point) -> Option<ShapeParameters> {
    let usable = point.status.is_ok();
    usable.then(|| jet(point).parameters()).filter(|s| s.u.iter().chain(&s.v).all(|c| c.is_finite()))
}

/// Displacement from where the material is in `from` to where it is in `to`, both counted from the
/// first frame; first derivatives F₂ F₁⁻¹ − 1.
pub(super) fn between(from: &Track, to: &Track) -> Option<ShapeParameters> {
    let (Track::Found { warp: a, .. }, Track::Found { warp: b, .. }) = (from, to) else {
        return None;
    };
    let ([[p, q], [r, s]], f) = (a.deformation(), b.deformation());
    let det = p * s - q * r;
    if det.is_nan() || det.abs() <= 1e-3 {
        return None;
    }
    let inverse = [[s / det, -q / det], [-r / det, p / det]];
    let g = |i: usize, j: usize| f[i][0] * inverse[0][j] + f[i][1] * inverse[1][j];
    let d = [b.0[0][0] - a.0[0][0], b.0[1][0] - a.0[1][0]];
    let warp = Warp([[d[0], g(0, 0) - 1.0, g(0, 1), 0., 0., 0.], [d[1], g(1, 0), g(1, 1) - 1.0, 0., 0., 0.]]);
    let all_finite = warp.0.iter().flatten().all(|c| c.is_finite());
    all_finite.then(|| warp.parameters())
}

/// The result for the point (x, y) of the first frame: `track` is the whole way, `step` what was
/// measured against the present reference, if the point was still there to be sought.
pub(super) fn composed([x, y]: [f64; 2], track: &Track, step: Option<&Point>) -> Point {
    let lost = |status| Point {
        x,
        y,
        u: f64::NAN,
        v: f64::NAN,
        sigma_u: f32::NAN,
        sigma_v: f32::NAN,
        zncc: f32::NAN,
        iterations: 0,
        status,
        solver: crate::SolvedBy::Exact,
        shape: ShapeParameters::default(),
    };
    match (track, step) {
        (Track::Found { warp, variance }, Some(step)) => Point {
            x,
            y,
            u: warp.0[0][0],
            v: warp.0[1][0],
            sigma_u: variance[0].sqrt() as f32,
            sigma_v: variance[1].sqrt() as f32,
            shape: warp.moved(x.round() - x, y.round() - y).parameters(),
            ..*step
        },
        (Track::Lost { status, .. }, Some(step)) => {
            Point { zncc: step.zncc, iterations: step.iterations, ..lost(*status) }
        }
        (Track::Lost { status, .. }, None) => lost(*status),
        (Track::Found { .. }, None) => lost(Status::NoGuess),
    }
}
