//! From frames with two first-order views to points in space.
//!
//! [`Reference`] finds the views of a frame and matches them; [`Reference::track`] follows the
//! matched points into another frame; [`profile`] and [`displacement`] decode. The steps are kept
//! apart because a calibration changes only the last.

mod decode;
mod files;
mod gap;
mod instrument;
mod live;
mod matching;
mod object;
mod statistics;
mod surface;

pub(crate) use decode::mark_gaps;
pub use decode::{Displacement, DisplacementPoint, Profile, ProfilePoint, displacement, profile};
pub use files::{
    ObjectOptions, displacement_maps, displacement_table, map_named, profile_maps, profile_table,
    write_displacement, write_profile,
};
pub use gap::{GapField, GapSummary};
pub use instrument::{Instrument, MapQuality};
pub use live::Live;
pub use matching::{Match, Rectangle, Reference, Settings, Track, Tracks, image_of, points_per_measurement};
pub use object::ObjectGrid;
pub use statistics::{Plane, Spread, plane_of, spread};
pub use surface::{SurfaceField, SurfaceSummary, strain_status, surface_strain};

/// Why a point has no result, or `ok`. Stable strings: they stand in files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PointStatus {
    /// Measured.
    Ok,
    /// The match between the views failed, with the correlation's reason.
    Match(&'static str),
    /// Tracking in the −1 view failed, with the correlation's reason.
    TrackMinus(&'static str),
    /// Tracking in the +1 view failed, with the correlation's reason.
    TrackPlus(&'static str),
    /// The optics has no such ray.
    Decode,
    /// The rays part, or meet on the camera's side of the grating: no specimen is there.
    BeforeGrating,
    /// Outside the distortion map or the volume in which the optics were calibrated.
    Outside,
    /// The two rays miss each other by more than those around, and than noise explains.
    Gap,
    /// The point lies far outside the heights that were searched.
    Range,
}

impl PointStatus {
    /// Whether the point has a result.
    pub fn is_ok(self) -> bool {
        self == Self::Ok
    }

    /// Whether the correlation found the point.
    pub(crate) fn is_matched(self) -> bool {
        !matches!(self, Self::Match(_) | Self::TrackMinus(_) | Self::TrackPlus(_))
    }
}

impl std::fmt::Display for PointStatus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Ok => f.write_str("ok"),
            Self::Match(reason) => write!(f, "match:{reason}"),
            Self::TrackMinus(reason) => write!(f, "minus:{reason}"),
            Self::TrackPlus(reason) => write!(f, "plus:{reason}"),
            Self::Decode => f.write_str("decode"),
            Self::BeforeGrating => f.write_str("before_grating"),
            Self::Outside => f.write_str("outside"),
            Self::Gap => f.write_str("gap"),
            Self::Range => f.write_str("range"),
        }
    }
}

/// How many points have which status, the most frequent first: `22910 ok, 790 match:out_of_image`.
pub fn status_counts(statuses: impl IntoIterator<Item = PointStatus>) -> String {
    let mut counts: std::collections::BTreeMap<String, usize> = std::collections::BTreeMap::new();
    for status in statuses {
        *counts.entry(status.to_string()).or_default() += 1;
    }
    let mut counts: Vec<(String, usize)> = counts.into_iter().collect();
    counts.sort_by_key(|(name, count)| (std::cmp::Reverse(*count), name.clone()));
    counts.iter().map(|(name, count)| format!("{count} {name}")).collect::<Vec<_>>().join(", ")
}

/// Points on the grid of the −1 view: column i, row j at pixel (x0 + i·step, y0 + j·step).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grid {
    /// Column of the first node, pixels.
    pub x0: usize,
    /// Row of the first node, pixels.
    pub y0: usize,
    /// Distance of nodes, pixels.
    pub step: usize,
    /// Nodes in a row.
    pub columns: usize,
    /// Rows of nodes.
    pub rows: usize,
    /// Which point stands at a node (row by row), if any.
    pub nodes: Vec<Option<usize>>,
}

impl Grid {
    /// No nodes: for points that need no map.
    pub const fn none() -> Self {
        Self { x0: 0, y0: 0, step: 1, columns: 0, rows: 0, nodes: Vec::new() }
    }

    /// The same nodes in an image of which the points' image is the part from pixel (x, y) on.
    pub(crate) fn moved(mut self, x: usize, y: usize) -> Self {
        self.x0 += x;
        self.y0 += y;
        self
    }

    /// Values of points, spread over the nodes; NaN at nodes without a point.
    pub fn spread_over_nodes(&self, value_of: impl Fn(usize) -> f64) -> Vec<f64> {
        self.nodes.iter().map(|node| node.map_or(f64::NAN, &value_of)).collect()
    }
}
