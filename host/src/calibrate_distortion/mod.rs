//! `daic calibrate distortion`: images of a line target in, distortion map and report out.
//!
//! Written into the folder: `distortion.json` (the map, [`DistortionFile`]), `distortion.npz` (`e_x`, `e_y`,
//! `sigma_x`, `sigma_y`, `brown_x`, `brown_y`, `measured`, `noise_x`, `noise_y` at the nodes), figures and
//! `report.html`.

mod page;
mod summary;
mod warning;
mod write;

pub use crate::distortion_file::{DistortionFile, IdealImage};
pub use summary::{BrownSummary, Summary};
pub use warning::Warning;

use crate::error::Error;
use crate::measure::{Rectangle, image_of};
use crate::{images, optics_file, optics_section};
use daic_correlate::phase::{
    Gratings, PhaseError, PhaseMap, PhaseMaps, PhaseSettings, Window, WindowKind, phase_maps,
};
use daic_dataset::{GreyImage, atomic, map};
use daic_optics::distortion::{
    DistortionCalibration, Ideal, TargetPhase, TargetPhases, TargetPose, calibrate_distortion,
};
use daic_optics::{Brown, Camera, Optics, View};
use daic_rig::experiment::OpticsFile;
use std::path::{Path, PathBuf};

/// What to calibrate from.
#[derive(Debug, Clone)]
pub struct Options {
    /// A cross grating, or lines along x and lines along y in either order.
    pub images: Vec<PathBuf>,
    /// Optics file of the set-up.
    pub optics: Option<PathBuf>,
    /// Name the map in that file.
    pub into: bool,
    /// View through the grating; none for images without it.
    pub view: Option<View>,
    /// Part of the image to use: x, y, width, height in pixels. Left out, all of it, or a view's half of
    /// the sensor.
    pub region: Option<[i64; 4]>,
    /// What e is counted from; left out, rays for a view whose optics are given, else a pinhole.
    pub ideal: Option<IdealImage>,
    /// Both images show the target in one plane.
    pub one_pose: bool,
    /// The target lies square to the camera, or in the reference plane: nothing of a tilt is removed.
    pub square: bool,
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

/// Calibrates and writes the map, the arrays, the figures and the report.
///
/// # Errors
/// The image, the file or the setting that is to blame; [`Error::CalibrateDistortion`].
pub fn run(options: &Options) -> Result<Summary, Error> {
    let optics = options.optics.as_deref().filter(|_| options.into);
    if let Some(optics) = optics {
        // Before the work, not after it.
        optics_file::can_name_map(optics, options.view)?;
    }
    let outcome = calibrate(options)?;
    let pages = page::draw(options, &outcome)?;
    std::fs::create_dir_all(&options.out)
        .map_err(|source| Error::Folder { path: options.out.clone(), source })?;
    let path = options.out.join("distortion.json");
    write::to_file(options, &outcome).save(&path)?;
    map::write_maps_npz(&options.out.join("distortion.npz"), &write::maps(&outcome.found))?;
    for (name, text) in pages {
        atomic::write_bytes(&options.out.join(name), text.as_bytes())?;
    }
    let folder = options.optics.as_deref().and_then(Path::parent).unwrap_or(Path::new(""));
    let entry = optics_file::map_entry(folder, &path)?;
    if let Some(optics) = optics {
        optics_file::name_map(optics, options.view, &entry)?;
    }
    Ok(summary::summary(options, &outcome, path, entry))
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
        warnings.extend(warning::saturated(frame, &part, path));
        let gratings = if frames.len() == 1 { Gratings::Cross } else { Gratings::Line };
        let settings = PhaseSettings { gratings, ..options.phase.clone() };
        let path = path.clone();
        phases.push(phase_maps(&image_of(&part)?, None, &settings).map_err(|source| match source {
            PhaseError::OneDirection { pitch, angle_deg } => {
                Error::OneImageOfLines { path, pitch_px: pitch, angle_deg }
            }
            source => Error::TargetPhase { path, source },
        })?);
    }
    let directions = directions(&phases);
    let pose = match (options.square, frames.len() == 1 || options.one_pose) {
        (true, _) => TargetPose::Square,
        (false, true) => TargetPose::Common,
        (false, false) => TargetPose::Separate,
    };
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
        warnings.extend(warning::scale(&found, &ideal, optics, options.view, stated_mm));
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

/// Lines crossed by x first, from one image of both or from two images in either order.
fn directions(phases: &[PhaseMaps]) -> [(&PhaseMap, &Window); 2] {
    let all: Vec<(&PhaseMap, &Window)> =
        phases.iter().flat_map(|p| p.directions.iter().zip(&p.windows)).collect();
    let (a, b) = (all[0], all[all.len() - 1]);
    if a.0.carrier.fx.abs() >= b.0.carrier.fx.abs() { [a, b] } else { [b, a] }
}
