//! The map's file and the arrays at its nodes.

use super::summary::{image_kind, listed};
use super::{DistortionFile, Options, Outcome};
use daic_dataset::{FloatMap, MapAxes};
use daic_optics::distortion::DistortionCalibration;

pub(super) fn to_file(options: &Options, outcome: &Outcome) -> DistortionFile {
    let (ideal, camera) = image_kind(&outcome.ideal);
    let found = &outcome.found;
    let names: Vec<String> = options
        .images
        .iter()
        .filter_map(|p| p.file_name())
        .map(|n| n.to_string_lossy().into_owned())
        .collect();
    let [x, y] = found.left.total_px();
    DistortionFile {
        format: DistortionFile::FORMAT.to_owned(),
        provenance: format!(
            "daic {} calibrate distortion: {}, left {x:.4} and {y:.4} px RMS",
            env!("CARGO_PKG_VERSION"),
            names.join(", ")
        ),
        date: humantime::format_rfc3339_seconds(std::time::SystemTime::now()).to_string(),
        image_px: outcome.image_px,
        view: options.view,
        ideal,
        camera,
        removed: listed(found.pose.removed()),
        e: found.map.clone(),
        sigma_px: found.sigma_px.clone(),
        measured: found.measured.clone(),
    }
}

/// Maps over the nodes: e, σ, its part from noise, Brown's e, and whether a node was measured.
pub(super) fn maps(found: &DistortionCalibration) -> Vec<FloatMap> {
    let grid = found.map.grid();
    let [nx, ny] = grid.nodes;
    let axes = MapAxes {
        x0: grid.origin_px[0],
        dx: grid.step_px[0],
        y0: grid.origin_px[1],
        dy: grid.step_px[1],
        unit: "px".to_owned(),
    };
    let one = |name: &str, unit: &str, data: Vec<f64>| FloatMap {
        name: name.to_owned(),
        unit: unit.to_owned(),
        width: nx as u32,
        height: ny as u32,
        data,
        axes: axes.clone(),
    };
    let e: Vec<[f64; 2]> =
        (0..nx * ny).map(|k| found.map.e_px(grid.node_px(k % nx, k / nx)).unwrap_or([f64::NAN; 2])).collect();
    let component = |v: &[[f64; 2]], i: usize| v.iter().map(|v| v[i]).collect::<Vec<f64>>();
    vec![
        one("e_x", "px", component(&e, 0)),
        one("e_y", "px", component(&e, 1)),
        one("sigma_x", "px", component(&found.sigma_px, 0)),
        one("sigma_y", "px", component(&found.sigma_px, 1)),
        one("brown_x", "px", component(&found.brown.e_px, 0)),
        one("brown_y", "px", component(&found.brown.e_px, 1)),
        one("measured", "1", found.measured.iter().map(|m| f64::from(u8::from(*m))).collect()),
        one("noise_x", "px", component(&found.noise_px, 0)),
        one("noise_y", "px", component(&found.noise_px, 1)),
    ]
}
