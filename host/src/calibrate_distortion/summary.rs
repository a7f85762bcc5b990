//! What came out, in numbers.

use super::{IdealImage, Options, Outcome};
use crate::optics_file::entry_name;
use daic_optics::distortion::Ideal;
use daic_optics::{Brown, Camera, View};
use daic_rig::experiment::MapFile;
use serde::Serialize;
use std::path::PathBuf;

/// Brown's terms with their uncertainty.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BrownSummary {
    /// F that they refer to, pixels.
    pub focal_px: f64,
    /// Principal point that they refer to, pixels.
    pub principal_point_px: [f64; 2],
    /// k1, k2, k3, p1, p2.
    pub terms: Brown,
    /// Their standard deviations; none for terms that are not fitted.
    pub sigma: [Option<f64>; 5],
    /// RMS of (e_x, e_y) that they leave, pixels.
    pub left_px: [f64; 2],
}

/// What came out, for the answer of the program.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// RMS of (e_x, e_y), pixels.
    pub rms_px: [f64; 2],
    /// Largest |e_x|, |e_y|, pixels.
    pub largest_px: [f64; 2],
    /// RMS left by the map, all together, pixels.
    pub left_px: [f64; 2],
    /// Of it: between the nodes.
    pub left_between_nodes_px: [f64; 2],
    /// Of it: image noise.
    pub left_noise_px: [f64; 2],
    /// Of it: detail that the window takes off.
    pub left_window_px: [f64; 2],
    /// Brown's terms beside it.
    pub brown: BrownSummary,
    /// `pinhole` or `ray`.
    pub ideal: IdealImage,
    /// The view; none for the whole sensor.
    pub view: Option<View>,
    /// Terms that are not determined and were removed.
    pub removed: Vec<String>,
    /// Those of them that are shared with tilt.
    pub shared_with_tilt: Vec<String>,
    /// Line distances at the middle: pixels, or mm for `ray`.
    pub pitch: [f64; 2],
    /// Angles of the lines' normals against x and y, degrees.
    pub rotation_deg: [f64; 2],
    /// Apparent tilt of the target in both exposures, degrees; only where F is known.
    pub tilt_deg: Option<[f64; 2]>,
    /// Nodes of the map, and those measured.
    pub nodes: [usize; 2],
    /// Nodes with phases.
    pub measured: usize,
    /// Distance between nodes, pixels.
    pub step_px: f64,
    /// Warnings.
    pub warnings: Vec<String>,
    /// The map's file.
    pub map: PathBuf,
    /// Name of the entry for it in an optics file: `maps.sensor`, `maps.minus` or `maps.plus`.
    pub entry_name: String,
    /// The entry, its path counted from the folder of the optics file (else from where the program runs).
    pub entry: MapFile,
    /// The optics file that it was written into.
    pub into: Option<PathBuf>,
}

pub(super) fn listed(terms: [&'static [&'static str]; 3]) -> Vec<String> {
    let [x, y, both] = terms;
    let one =
        |name: &str, terms: &[&str]| (!terms.is_empty()).then(|| format!("{name}: {}", terms.join(", ")));
    [one("e_x", x), one("e_y", y), one("(e_x, e_y)", both)].into_iter().flatten().collect()
}

pub(super) fn image_kind(ideal: &Ideal) -> (IdealImage, Camera) {
    match ideal {
        Ideal::Camera(c) => (IdealImage::Pinhole, *c),
        Ideal::Grating { optics, .. } => (IdealImage::Ray, optics.camera),
    }
}

pub(super) fn summary(options: &Options, outcome: &Outcome, map: PathBuf, entry: MapFile) -> Summary {
    let found = &outcome.found;
    let (ideal, camera) = image_kind(&outcome.ideal);
    let [a, b] = found.angle_rad.map(f64::to_degrees);
    let tilt = |t: [f64; 2]| (camera.focal_px * t[0].hypot(t[1])).atan().to_degrees();
    let known = outcome.focal_known && ideal == IdealImage::Pinhole;
    Summary {
        rms_px: found.rms_px,
        largest_px: found.largest_px,
        left_px: found.left.total_px(),
        left_between_nodes_px: found.left.between_nodes_px,
        left_noise_px: found.left.noise_px,
        left_window_px: found.left.window_px,
        brown: BrownSummary {
            focal_px: camera.focal_px,
            principal_point_px: camera.principal_point_px,
            terms: found.brown.brown,
            sigma: found.brown.sigma,
            left_px: found.brown.left_px,
        },
        ideal,
        view: options.view,
        removed: listed(found.pose.removed()),
        shared_with_tilt: listed(found.pose.shared_with_tilt()),
        pitch: found.pitch,
        rotation_deg: [a, b - 90.0],
        tilt_deg: known.then(|| found.tilt.map(tilt)),
        nodes: found.map.grid().nodes,
        measured: found.measured.iter().filter(|m| **m).count(),
        step_px: found.map.grid().step_px[0],
        warnings: outcome.warnings.iter().map(ToString::to_string).collect(),
        map,
        entry_name: format!("maps.{}", entry_name(options.view)),
        entry,
        into: options.optics.clone().filter(|_| options.into),
    }
}
