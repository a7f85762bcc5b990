//! `daic calibrate distortion`: images of a line target in, distortion map and report out.
//!
//! Written into the folder: `distortion.json` (the map, [`DistortionFile`]), `distortion.npz` (`e_x`, `e_y`,
//! `sigma_x`, `sigma_y`, `brown_x`, `brown_y`, `measured` at the nodes), `distortion.svg`-figures and
//! `report.html`.

mod page;

pub use crate::distortion_file::{DistortionFile, IdealImage};

use crate::error::Error;
use crate::measure::{Rectangle, image_of};
use crate::{images, optics_section};
use daic_correlate::phase::{Gratings, PhaseMap, PhaseMaps, PhaseSettings, Window, WindowKind, phase_maps};
use daic_dataset::{FloatMap, GreyImage, MapAxes, atomic, map};
use daic_optics::distortion::{
    DistortionCalibration, DistortionWarning, Ideal, TargetPhase, TargetPhases, TargetPose,
    calibrate_distortion,
};
use daic_optics::{Brown, Camera, Optics, View};
use daic_rig::experiment::OpticsFile;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What to calibrate from.
#[derive(Debug, Clone)]
pub struct Options {
    /// A cross grating, or lines along x and lines along y in either order.
    pub images: Vec<PathBuf>,
    /// Optics file of the set-up.
    pub optics: Option<PathBuf>,
    /// View through the grating; none for images without it.
    pub view: Option<View>,
    /// Part of the image to use: x, y, width, height in pixels. Left out, all of it, or a view's half of
    /// the sensor.
    pub region: Option<[i64; 4]>,
    /// What e is counted from; left out, rays for a view whose optics are given, else a pinhole.
    pub ideal: Option<IdealImage>,
    /// Both images show the target in one plane.
    pub one_pose: bool,
    /// Line distance of the target, mm, to check the scale by.
    pub target_pitch_mm: Option<f64>,
    /// How the phases are found.
    pub phase: PhaseSettings,
    /// Folder for the results.
    pub out: PathBuf,
}

/// The phase analysis that suits a calibration of distortion: a window that leaves quadratic phase as it
/// is, no wider than noise demands.
pub fn phase_settings() -> PhaseSettings {
    PhaseSettings { window: WindowKind::GaussianFlat, width: 1.25, ..PhaseSettings::default() }
}

/// Something to be looked at.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Warning {
    /// Grey levels at the end of the scale.
    #[error("{:.1} % of the pixels of {} are saturated: expose less, clipped lines shift where blur is uneven", 100.0 * share, path.display())]
    Saturated {
        /// The image.
        path: PathBuf,
        /// Share of its pixels.
        share: f64,
    },
    /// The scale is not the one that the optics and the target's pitch give.
    #[error(
        "the line distance along {axis} comes out as {found_mm:.5} mm, the target is said to have {stated_mm:.5} mm ({:+.2} %): pitch, distances or F are wrong; the map does not depend on them",
        100.0 * (found_mm / stated_mm - 1.0)
    )]
    Scale {
        /// `x` or `y`.
        axis: &'static str,
        /// As the optics have it.
        found_mm: f64,
        /// As stated.
        stated_mm: f64,
    },
    /// See [`DistortionWarning::PartlyCovered`].
    #[error("the target covers {:.0} % of the image: there is no map elsewhere", 100.0 * share)]
    PartlyCovered {
        /// Share of the image within reach of the map.
        share: f64,
    },
    /// See [`DistortionWarning::PitchesDiffer`].
    #[error(
        "the lines crossed by y are {:.2} % farther apart than those crossed by x: not one target, not one distance, or pixels that are not square; e holds no trace of it",
        100.0 * (ratio - 1.0)
    )]
    PitchesDiffer {
        /// Ratio of the distances.
        ratio: f64,
    },
    /// See [`DistortionWarning::PartsLeftOut`].
    #[error(
        "parts of the target ({pixels} nodes) are cut off from the rest and were left out: their whole lines cannot be counted"
    )]
    PartsLeftOut {
        /// Nodes.
        pixels: usize,
    },
    /// A map through the grating without the optics.
    #[error(
        "no --optics given: this map is counted from a pinhole and goes with the decoders `linear` and `closed`, not with `ray`"
    )]
    NotForRays,
}

impl From<DistortionWarning> for Warning {
    fn from(w: DistortionWarning) -> Self {
        match w {
            DistortionWarning::PartlyCovered { share } => Self::PartlyCovered { share },
            DistortionWarning::PitchesDiffer { ratio } => Self::PitchesDiffer { ratio },
            DistortionWarning::PartsLeftOut { pixels } => Self::PartsLeftOut { pixels },
        }
    }
}

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
}

/// A calibration together with what it was made from.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// The calibration.
    pub found: DistortionCalibration,
    /// What e is counted from.
    pub ideal: Ideal,
    /// Whether F was given.
    pub focal_known: bool,
    /// Columns and rows of the images.
    pub image_px: [u32; 2],
    /// To be looked at.
    pub warnings: Vec<Warning>,
}

/// Part of an image's pixels at the end of the scale that passes without a warning.
const SATURATED: f64 = 0.005;
/// Part by which the target's scale may differ from the stated one without a warning.
const SCALE: f64 = 0.005;

/// Calibrates and writes the map, the arrays, the figures and the report.
///
/// # Errors
/// The image, the file or the setting that is to blame; [`Error::CalibrateDistortion`].
pub fn run(options: &Options) -> Result<Summary, Error> {
    let outcome = calibrate(options)?;
    let pages = page::draw(options, &outcome)?;
    std::fs::create_dir_all(&options.out)
        .map_err(|source| Error::Folder { path: options.out.clone(), source })?;
    let path = options.out.join("distortion.json");
    to_file(options, &outcome).save(&path)?;
    map::write_maps_npz(&options.out.join("distortion.npz"), &maps(&outcome.found))?;
    for (name, text) in pages {
        atomic::write_bytes(&options.out.join(name), text.as_bytes())?;
    }
    Ok(summary(options, &outcome, path))
}

/// Calibrates without writing anything.
///
/// # Errors
/// As [`run`].
pub fn calibrate(options: &Options) -> Result<Outcome, Error> {
    let frames = match &options.images[..] {
        [one] => vec![images::read(one)?],
        [a, b] => {
            let (a, b) = images::read_pair(a, b)?;
            vec![a, b]
        }
        all => return Err(Error::TargetImages { found: all.len() }),
    };
    let image_px = [frames[0].width, frames[0].height];
    let optics = options.optics.as_deref().map(read_optics).transpose()?;
    let ideal = ideal(options, optics.as_ref(), image_px)?;
    let region = region(options, image_px)?;
    let mut warnings = Vec::new();
    let mut phases = Vec::new();
    for (frame, path) in frames.iter().zip(&options.images) {
        let part = crop(frame, region);
        let share = saturated(frame, &part);
        if share > SATURATED {
            warnings.push(Warning::Saturated { path: path.clone(), share });
        }
        let gratings = if frames.len() == 1 { Gratings::Cross } else { Gratings::Line };
        let settings = PhaseSettings { gratings, ..options.phase.clone() };
        phases.push(
            phase_maps(&image_of(&part)?, None, &settings)
                .map_err(|source| Error::TargetPhase { path: path.clone(), source })?,
        );
    }
    let directions = directions(&phases);
    let pose = if frames.len() == 1 || options.one_pose { TargetPose::Common } else { TargetPose::Separate };
    let target = TargetPhases {
        width: region.width,
        height: region.height,
        origin_px: [region.x, region.y],
        directions: directions.map(|(map, window)| TargetPhase {
            phase_rad: &map.phase,
            sigma_rad: &map.sigma,
            part: &map.label,
            window: window.weights(),
        }),
        pose,
    };
    let found = calibrate_distortion(&target, &ideal)?;
    warnings.extend(found.warnings.iter().copied().map(Warning::from));
    if options.view.is_some() && optics.is_none() {
        warnings.push(Warning::NotForRays);
    }
    if let (Some(stated_mm), Some(optics)) = (options.target_pitch_mm, &optics) {
        warnings.extend(scale(&found, &ideal, optics, options.view, stated_mm));
    }
    Ok(Outcome { found, ideal, focal_known: optics.is_some(), image_px, warnings })
}

fn read_optics(path: &Path) -> Result<Optics, Error> {
    optics_section::from_section(&OpticsFile::load(path)?.optics)
}

fn ideal(options: &Options, optics: Option<&Optics>, [w, h]: [u32; 2]) -> Result<Ideal, Error> {
    let (w, h) = (f64::from(w), f64::from(h));
    // Without optics Brown's terms refer to the half diagonal: k1 is the distortion in the corner.
    let unknown = Camera {
        focal_px: 0.5 * w.hypot(h),
        principal_point_px: [0.5 * (w - 1.0), 0.5 * (h - 1.0)],
        brown: Brown::default(),
    };
    let pinhole = || Ideal::Camera(optics.map_or(unknown, |o| o.camera));
    match (options.ideal, options.view, optics) {
        (Some(IdealImage::Pinhole) | None, None, _) | (Some(IdealImage::Pinhole), _, _) | (None, _, None) => {
            Ok(pinhole())
        }
        (_, Some(view), Some(optics)) => Ok(Ideal::Grating { optics: *optics, view }),
        (Some(IdealImage::Ray), _, _) => Err(Error::IdealRay),
    }
}

fn region(options: &Options, [width, height]: [u32; 2]) -> Result<Rectangle, Error> {
    let half = width / 2;
    let whole = |x: u32, width: u32| Rectangle {
        x: x as usize,
        y: 0,
        width: width as usize,
        height: height as usize,
    };
    let Some([x, y, w, h]) = options.region else {
        return Ok(match options.view {
            None => whole(0, width),
            Some(View::Minus) => whole(0, half),
            Some(View::Plus) => whole(half, width - half),
        });
    };
    let fits = |start: i64, length: i64, size: u32| {
        start >= 0 && length > 0 && start.checked_add(length).is_some_and(|end| end <= i64::from(size))
    };
    if !fits(x, w, width) || !fits(y, h, height) {
        return Err(Error::RoiOutside { x, y, w, h, width, height });
    }
    Ok(Rectangle { x: x as usize, y: y as usize, width: w as usize, height: h as usize })
}

fn crop(frame: &GreyImage, r: Rectangle) -> GreyImage {
    let stride = frame.width as usize;
    let rows = frame.data.chunks_exact(stride).skip(r.y).take(r.height);
    GreyImage {
        width: r.width as u32,
        height: r.height as u32,
        container_bits: frame.container_bits,
        significant_bits: frame.significant_bits,
        data: rows.flat_map(|row| &row[r.x..r.x + r.width]).copied().collect(),
    }
}

/// Share of the pixels at the highest level, if that is the end of a scale of 8 to 16 bits.
fn saturated(whole: &GreyImage, part: &GreyImage) -> f64 {
    let top = whole.data.iter().copied().max().unwrap_or(0);
    let full = u32::from(top) + 1;
    if top < 255 || !full.is_power_of_two() {
        return 0.0;
    }
    part.data.iter().filter(|g| **g == top).count() as f64 / part.data.len() as f64
}

/// Lines crossed by x first, from one image of both or from two images in either order.
fn directions(phases: &[PhaseMaps]) -> [(&PhaseMap, &Window); 2] {
    let all: Vec<(&PhaseMap, &Window)> =
        phases.iter().flat_map(|p| p.directions.iter().zip(&p.windows)).collect();
    let (a, b) = (all[0], all[all.len() - 1]);
    if a.0.carrier.fx.abs() >= b.0.carrier.fx.abs() { [a, b] } else { [b, a] }
}

/// Whether the target's line distance is the stated one.
fn scale(
    found: &DistortionCalibration,
    ideal: &Ideal,
    optics: &Optics,
    view: Option<View>,
    stated_mm: f64,
) -> Vec<Warning> {
    let factor = match (ideal, view) {
        (Ideal::Grating { .. }, _) => 1.0,
        (Ideal::Camera(c), None) => {
            (optics.pinhole_to_grating_mm + optics.grating_to_reference_mm) / c.focal_px
        }
        // A pinhole has no scale that a view through the grating could be compared with.
        (Ideal::Camera(_), Some(_)) => return Vec::new(),
    };
    let wrong = |axis: &'static str, pitch: f64| {
        let found_mm = pitch * factor;
        ((found_mm / stated_mm - 1.0).abs() > SCALE).then_some(Warning::Scale { axis, found_mm, stated_mm })
    };
    [wrong("x", found.pitch[0]), wrong("y", found.pitch[1])].into_iter().flatten().collect()
}

fn listed(terms: [&'static [&'static str]; 3]) -> Vec<String> {
    let [x, y, both] = terms;
    let one =
        |name: &str, terms: &[&str]| (!terms.is_empty()).then(|| format!("{name}: {}", terms.join(", ")));
    [one("e_x", x), one("e_y", y), one("(e_x, e_y)", both)].into_iter().flatten().collect()
}

fn image_kind(ideal: &Ideal) -> (IdealImage, Camera) {
    match ideal {
        Ideal::Camera(c) => (IdealImage::Pinhole, *c),
        Ideal::Grating { optics, .. } => (IdealImage::Ray, optics.camera),
    }
}

fn to_file(options: &Options, outcome: &Outcome) -> DistortionFile {
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

/// Maps over the nodes: e, σ, Brown's e, and whether a node was measured.
fn maps(found: &DistortionCalibration) -> Vec<FloatMap> {
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
    ]
}

fn summary(options: &Options, outcome: &Outcome, map: PathBuf) -> Summary {
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
    }
}
