//! A camera from images of a board: what `daic calibrate camera` does.

use crate::camera_file::{Board, CameraFile};
use crate::error::Error;
use crate::images;
use crate::progress::Progress;
use daic_dataset::{GreyImage, atomic};
use daic_optics::GreyView;
use daic_optics::intrinsics::{
    BoardPoint, CameraCalibration, CameraParameter, CameraSettings, calibrate_camera,
};
use daic_optics::target::{Pattern, Target, TargetSettings, find_target};
use daic_report::{
    Cell, Chart, Figure, Mark, Overlay, Report, Section, Series, SeriesStyle, TableBlock, plain,
    with_uncertainty,
};
use std::path::{Path, PathBuf};

/// What to look for and what to estimate.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// On the board.
    pub pattern: Pattern,
    /// Distance of dots or corners, millimetres.
    pub pitch_mm: f64,
    /// Points of the whole board along both directions, if known.
    pub size: Option<[usize; 2]>,
    /// Parameters held at zero (the principal point: in the middle of the image).
    pub fixed: Vec<CameraParameter>,
}

/// A calibration and what it came from.
#[derive(Debug)]
pub struct Run {
    /// As it goes to the file.
    pub file: CameraFile,
    /// Images in which no board was found, and why.
    pub skipped: Vec<(PathBuf, String)>,
    calibration: CameraCalibration,
    seen: Vec<(GreyImage, Target)>,
}

/// Grey values as the detectors take them.
pub fn grey(image: &GreyImage) -> Vec<f32> {
    image.data.iter().map(|v| f32::from(*v)).collect()
}

/// The board in an image file.
///
/// # Errors
/// [`Error::Target`] where there is none.
pub fn find(path: &Path, image: &GreyImage, settings: &TargetSettings) -> Result<Target, Error> {
    let data = grey(image);
    let small = |source| Error::Detector { path: path.to_owned(), source };
    let view = GreyView::new(&data, image.width as usize, image.height as usize).map_err(small)?;
    find_target(&view, settings).map_err(|source| Error::Target { path: path.to_owned(), source })
}

/// Points of a board for the adjustment.
pub fn board_points(target: &Target, pitch_mm: f64) -> Vec<BoardPoint> {
    let point = |p: &daic_optics::target::TargetPoint| BoardPoint {
        board_mm: p.index.map(|i| f64::from(i) * pitch_mm),
        pixel_px: p.at_px,
        sigma_px: p.sigma_px,
    };
    target.points.iter().map(point).collect()
}

/// Finds the board in every image and calibrates the camera. Images without a board are skipped and
/// named in the result.
///
/// # Errors
/// An image that cannot be read or differs in size, no image with a board, or views that do not
/// determine the camera.
pub fn run(paths: &[PathBuf], options: &Options, progress: &dyn Progress) -> Result<Run, Error> {
    progress.stage("finding boards", paths.len() as u64);
    let settings = TargetSettings { size: options.size, ..TargetSettings::new(options.pattern) };
    let (mut seen, mut names, mut skipped) = (Vec::new(), Vec::new(), Vec::new());
    let mut first: Option<GreyImage> = None;
    for (k, path) in paths.iter().enumerate() {
        let image = match &first {
            None => images::read(path)?,
            Some(first) => images::read_like(path, first, &paths[0])?,
        };
        if first.is_none() {
            first = Some(image.clone());
        }
        match find(path, &image, &settings) {
            Ok(target) => {
                names.push(path.display().to_string());
                seen.push((image, target));
            }
            // Nothing to go on with.
            Err(error) if paths.len() == 1 => return Err(error),
            Err(error @ Error::Target { .. }) => skipped.push((path.clone(), error.to_string())),
            Err(error) => return Err(error),
        }
        progress.advance(k as u64 + 1);
    }
    if seen.is_empty() {
        return Err(Error::NoBoards {
            images: paths.len(),
            reason: skipped.first().map_or_else(String::new, |s| s.1.clone()),
        });
    }
    let image_px = first.map_or([0; 2], |i| [i.width as usize, i.height as usize]);
    let mut settings = CameraSettings::new(image_px);
    settings.free.retain(|p| !options.fixed.contains(p));
    let views: Vec<_> = seen.iter().map(|(_, t)| board_points(t, options.pitch_mm)).collect();
    progress.stage("calibrating", 0);
    let calibration = calibrate_camera(&views, &settings)?;
    let board = Board { pattern: options.pattern, pitch_mm: options.pitch_mm };
    let file = CameraFile::new(&calibration, &names, image_px, board);
    Ok(Run { file, skipped, calibration, seen })
}

impl Run {
    /// Writes `camera.toml` and `report.html` into a folder.
    ///
    /// # Errors
    /// A file that cannot be written, a figure that cannot be drawn.
    pub fn write(&self, folder: &Path) -> Result<(), Error> {
        let page = self.report()?;
        self.file.write(&folder.join("camera.toml"))?;
        Ok(atomic::write_bytes(&folder.join("report.html"), page.as_bytes())?)
    }

    fn report(&self) -> Result<String, Error> {
        let text = |t: &str| Cell::Text(t.to_owned());
        let c = &self.calibration;
        let estimates = c
            .estimates
            .iter()
            .map(|e| {
                let fixed = if e.determined { Cell::Pass("yes".into()) } else { Cell::Fail("no".into()) };
                let value = with_uncertainty(e.value, e.sigma, e.parameter.unit());
                vec![text(e.parameter.name()), Cell::Number(value), fixed]
            })
            .collect();
        let views = self
            .file
            .views
            .iter()
            .map(|v| {
                vec![
                    text(&v.image),
                    Cell::Number(format!("{}", v.points)),
                    Cell::Number(format!("{}", v.rejected)),
                    Cell::Number(plain(v.rms_px, 4, "px")),
                    Cell::Number(plain(v.tilt_deg, 1, "°")),
                    Cell::Number(plain(v.distance_mm, 2, "mm")),
                ]
            })
            .collect();
        let heads = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect();
        let mut figures = vec![Figure {
            id: "residuals".to_owned(),
            title: "Residuals".to_owned(),
            caption:
                "Observed minus model of every point, a colour for each view; without structure they form \
                      one round cloud."
                    .to_owned(),
            body: self.residuals().render_svg()?,
        }];
        for (k, name) in self.file.views.iter().enumerate() {
            figures.push(Figure {
                id: format!("view-{k}"),
                title: name.image.clone(),
                caption: format!("Points found; lines are residuals, {}× enlarged.", ENLARGED),
                body: self.overlay(k, &name.image).render_svg()?,
            });
        }
        let skipped = self.skipped.iter().map(|(_, why)| format!("Skipped: {why}")).collect();
        let report = Report {
            title: "daic calibrate camera".to_owned(),
            subtitle: format!(
                "{} views, residuals {:.4} px RMS, reduced χ² {:.2}",
                c.views.len(),
                c.rms_px,
                c.chi_square_reduced
            ),
            verdict: None,
            sections: vec![Section {
                title: "Camera".to_owned(),
                text: skipped,
                tables: vec![
                    TableBlock {
                        caption: "Parameters".to_owned(),
                        head: heads(&["parameter", "value", "determined"]),
                        rows: estimates,
                    },
                    TableBlock {
                        caption: "Views".to_owned(),
                        head: heads(&["image", "points", "left out", "RMS", "tilt", "distance"]),
                        rows: views,
                    },
                ],
                figures,
            }],
            provenance: vec![
                ("measured with".to_owned(), self.file.program.clone()),
                ("date".to_owned(), self.file.date.clone()),
                ("pitch".to_owned(), format!("{} mm", self.file.board.pitch_mm)),
            ],
        };
        Ok(report.render()?)
    }

    fn residuals(&self) -> Chart {
        let series = self
            .calibration
            .views
            .iter()
            .map(|v| {
                let points = v.residuals_px.iter().enumerate().filter(|(k, _)| !v.rejected.contains(k));
                Series::new("", SeriesStyle::Points, points.map(|(_, r)| (r[0], r[1])).collect())
            })
            .collect();
        Chart {
            title: "Residuals".to_owned(),
            x_label: "x / px".to_owned(),
            y_label: "y / px".to_owned(),
            series,
            y_limits: None,
        }
    }

    fn overlay(&self, k: usize, title: &str) -> Overlay {
        let (image, target) = &self.seen[k];
        let at = |p: &daic_optics::target::TargetPoint| (p.at_px[0], p.at_px[1]);
        let mut marks = vec![Mark::Dots { points: target.points.iter().map(at).collect(), colour: 0 }];
        for (p, r) in target.points.iter().zip(&self.calibration.views[k].residuals_px) {
            let (x, y) = at(p);
            marks.push(Mark::Outline {
                points: vec![(x, y), (x + ENLARGED * r[0], y + ENLARGED * r[1])],
                label: String::new(),
                colour: 1,
            });
        }
        let named = |i: [i32; 2]| target.points.iter().find(|p| p.index == i).map(at);
        for (index, label) in [([0, 0], "0,0"), ([1, 0], "1,0")] {
            if let Some((x, y)) = named(index) {
                marks.push(Mark::Cross { x, y, label: label.to_owned(), colour: 2 });
            }
        }
        Overlay {
            title: title.to_owned(),
            width: image.width as usize,
            height: image.height as usize,
            grey: image.data.clone(),
            display: None,
            marks,
            most_pixels: 900,
        }
    }
}

/// Enlargement of residuals in the overlays.
const ENLARGED: f64 = 500.0;
