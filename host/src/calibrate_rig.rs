//! `daic calibrate rig`: tables of tracked points in, optics file and report out.
//!
//! The table of points has a row for each point of the plate in each pose: `pose`, `point`
//! (numbers of one's own choice, the same point the same number in every pose), `plate_x_mm`,
//! `plate_y_mm` (empty where unknown), `minus_x`, `minus_y`, `plus_x`, `plus_y` (pixels, empty where
//! a view does not show it) and, if not one for all, `sigma_px`. The table of moves, where the stage's are known,
//! has `pose`, `x_mm`, `y_mm`, `h_mm` against the reference pose (empty where unknown) and perhaps `rx_deg`, `ry_deg`,
//! `rz_deg` with `sigma_deg`: the plate's rotation about x, then y, then z.

use crate::error::Error;
use crate::optics_file::{self, CalibratedOptics};
use crate::optics_section;
use daic_dataset::{Table, atomic};
use daic_optics::bundle::{Known, PlatePose, Seen, Sighting};
use daic_optics::{RigCalibration, RigData, RigSettings, View, calibrate_rig};
use daic_report::{Cell, Chart, Figure, Report, Section, Series, SeriesStyle, TableBlock};
use daic_rig::experiment::{Covariance, OpticsFile, Volume};
use daic_rig::units::Length;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What to calibrate from.
#[derive(Debug, Clone)]
pub struct Options {
    /// Optics file to start from.
    pub optics: PathBuf,
    /// Table of tracked points.
    pub points: PathBuf,
    /// Table of known moves.
    pub moves: Option<PathBuf>,
    /// Standard deviation of a move, mm.
    pub move_sigma_mm: f64,
    /// Standard deviation of a pixel where the table states none, px.
    pub sigma_px: f64,
    /// The pose that becomes the reference plane; the first if none.
    pub reference: Option<i64>,
    /// Folder for the results.
    pub out: PathBuf,
}

/// An estimated value.
#[derive(Debug, Clone, Serialize)]
pub struct Value {
    /// Name of the field.
    pub name: &'static str,
    /// Value it started from.
    pub start: f64,
    /// Estimate.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// How many standard deviations of the prior it lies from the start.
    pub pull: Option<f64>,
}

/// A pose predicted without itself.
#[derive(Debug, Clone, Serialize)]
pub struct Predicted {
    /// Its number in the table.
    pub pose: i64,
    /// RMS of the heights against the plate, µm.
    pub rms_h_um: f64,
    /// What the noise of the pixels makes of it, µm.
    pub expected_h_um: f64,
}

/// What came out, for the answer of the program.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// Estimates.
    pub parameters: Vec<Value>,
    /// Combinations that the data leave to the priors, as text, weakest first.
    pub left_to_priors: Vec<String>,
    /// RMS of the residuals, pixels.
    pub rms_px: f64,
    /// χ² divided by the degrees of freedom.
    pub chi_square_reduced: f64,
    /// Pixels left out.
    pub rejected: usize,
    /// Poses predicted without themselves; one without which the others leave something open is not among them.
    pub left_out: Vec<Predicted>,
    /// Size of the plate by the moves over its stated size, and its standard deviation, where both are known.
    pub plate_scale: Option<[f64; 2]>,
    /// Angles of the stage's axes against the object frame, mrad, where moves are known.
    pub stage_axes_mrad: Option<[f64; 3]>,
    /// The optics file.
    pub optics: PathBuf,
}

/// Calibrates and writes `optics.toml` and `report.html`.
///
/// # Errors
/// The file or the value that is to blame, or [`Error::CalibrateRig`].
pub fn run(options: &Options) -> Result<Summary, Error> {
    let from = CalibratedOptics::load(&options.optics)?;
    let (file, start) = (&from.file, from.optics);
    let (mut data, poses, points) = read_points(&options.points, options.sigma_px)?;
    if let Some(moves) = &options.moves {
        read_moves(moves, options.move_sigma_mm, &poses, &mut data)?;
    }
    let mut settings = RigSettings::usual(&start);
    if let Some(reference) = options.reference {
        settings.reference_pose = poses.iter().position(|p| *p == reference).ok_or_else(|| {
            let (path, value) = (options.points.clone(), reference as f64);
            Error::TrackedPoint {
                path,
                row: 0,
                column: "pose",
                value,
                allowed: "a pose of the table (--reference)",
            }
        })?;
    }
    let found = calibrate_rig(&start, &from.maps(), &data, &settings).map_err(|source| {
        let (pose, point) = source.place();
        let own = |numbers: &[i64], at: Option<usize>| at.and_then(|at| numbers.get(at).copied());
        let (pose, point) = (own(&poses, pose), own(&points, point));
        Error::CalibrateRig { path: options.points.clone(), source, pose, point }
    })?;
    let page = page(&found, &poses)?;
    let path = options.out.join("optics.toml");
    std::fs::create_dir_all(&options.out)
        .map_err(|source| Error::Folder { path: options.out.clone(), source })?;
    let mut made = to_file(file, &found, poses.len());
    let folder = options.optics.parent().unwrap_or(Path::new(""));
    made.maps = optics_file::moved_maps(file.maps.as_ref(), folder, &options.out)?;
    let text = made
        .to_toml()
        .map_err(|source| Error::Unwritable { path: path.clone(), reason: source.to_string() })?;
    atomic::write_bytes(&path, text.as_bytes())?;
    atomic::write_bytes(&options.out.join("report.html"), page.as_bytes())?;
    Ok(summary(&found, &poses, path))
}

/// Tracked points, and the numbers of the poses in the order used.
///
/// # Errors
/// The file, or the row and column that cannot be used.
pub fn read_points(path: &Path, sigma_px: f64) -> Result<(RigData, Vec<i64>, Vec<i64>), Error> {
    let table = Table::read_csv(path)?;
    let column = |name: &str| table.numbers(name, path);
    let poses = whole(path, "pose", &column("pose")?)?;
    let points = whole(path, "point", &column("point")?)?;
    let plate = [column("plate_x_mm")?, column("plate_y_mm")?];
    let minus = [column("minus_x")?, column("minus_y")?];
    let plus = [column("plus_x")?, column("plus_y")?];
    let sigma = match table.column("sigma_px") {
        Some(_) => column("sigma_px")?,
        None => vec![sigma_px; table.rows()],
    };
    let numbers = |all: &[i64]| -> BTreeMap<i64, usize> {
        let mut order: BTreeMap<i64, usize> = all.iter().map(|n| (*n, 0)).collect();
        order.values_mut().enumerate().for_each(|(i, place)| *place = i);
        order
    };
    let (pose_at, point_at) = (numbers(&poses), numbers(&points));
    let mut data =
        RigData { plate_mm: vec![None; point_at.len()], poses: vec![PlatePose::default(); pose_at.len()] };
    let both = |pair: &[Vec<f64>; 2], row: usize| {
        let [x, y] = [pair[0][row], pair[1][row]];
        (!x.is_nan() && !y.is_nan()).then_some([x, y])
    };
    for row in 0..table.rows() {
        let point = point_at[&points[row]];
        if let Some(xy) = both(&plate, row) {
            let before = data.plate_mm[point].get_or_insert(xy);
            if *before != xy {
                let allowed = "the same for a point in every pose";
                let (path, value) = (path.to_owned(), xy[0]);
                return Err(Error::TrackedPoint { path, row: row + 1, column: "plate_x_mm", value, allowed });
            }
        }
        let seen = |pair| both(pair, row).map(|px| Seen { px, sigma_px: [sigma[row]; 2] });
        let sighting = Sighting { point, minus: seen(&minus), plus: seen(&plus) };
        data.poses[pose_at[&poses[row]]].sightings.push(sighting);
    }
    Ok((data, pose_at.into_keys().collect(), point_at.into_keys().collect()))
}

fn read_moves(path: &Path, sigma: f64, poses: &[i64], data: &mut RigData) -> Result<(), Error> {
    let table = Table::read_csv(path)?;
    let numbers = whole(path, "pose", &table.numbers("pose", path)?)?;
    let columns = [table.numbers("x_mm", path)?, table.numbers("y_mm", path)?, table.numbers("h_mm", path)?];
    // rotations of a goniometer are known to a sigma of their own, or not at all
    let number = |name: &str| table.numbers(name, path);
    let turned = match table.column("rx_deg") {
        Some(_) => Some(([number("rx_deg")?, number("ry_deg")?, number("rz_deg")?], number("sigma_deg")?)),
        None => None,
    };
    for (row, number) in numbers.iter().enumerate() {
        let Some(k) = poses.iter().position(|p| p == number) else {
            let (path, value) = (path.to_owned(), *number as f64);
            let allowed = "a pose of the table of points";
            return Err(Error::TrackedPoint { path, row: row + 1, column: "pose", value, allowed });
        };
        data.poses[k].known.translation_mm = [0, 1, 2]
            .map(|i| Some(columns[i][row]).filter(|v| !v.is_nan()).map(|value| Known { value, sigma }));
        if let Some((angles, sigma_deg)) = &turned {
            let sigma = sigma_deg[row].to_radians();
            data.poses[k].known.rotation_rad = [0, 1, 2].map(|i| {
                let angle = Some(angles[i][row]).filter(|v| !v.is_nan());
                angle.map(|deg| Known { value: deg.to_radians(), sigma })
            });
        }
    }
    Ok(())
}

fn whole(path: &Path, column: &'static str, values: &[f64]) -> Result<Vec<i64>, Error> {
    let fits = |v: f64| v.fract() == 0.0 && v.abs() < 1e15;
    if let Some(row) = values.iter().position(|v| !fits(*v)) {
        let (path, value) = (path.to_owned(), values[row]);
        return Err(Error::TrackedPoint { path, row: row + 1, column, value, allowed: "a whole number" });
    }
    Ok(values.iter().map(|v| *v as i64).collect())
}

fn to_file(start: &OpticsFile, found: &RigCalibration, poses: usize) -> OpticsFile {
    let names = found.covariance.parameters().iter().map(|p| p.name().to_owned());
    let matrix = found.covariance.matrix();
    let side = |i: usize| [found.volume.from_mm[i], found.volume.to_mm[i]].map(Length::new);
    OpticsFile {
        format: Some(OpticsFile::FORMAT.to_owned()),
        provenance: Some(format!(
            "daic {} calibrate rig: {poses} poses, residual {:.4} px RMS, chi-square {:.3} per degree of freedom",
            env!("CARGO_PKG_VERSION"),
            found.rms_px,
            found.chi_square_reduced
        )),
        date: Some(crate::camera_file::now()),
        optics: optics_section::to_section(&start.optics, &found.optics),
        covariance: Some(Covariance {
            parameters: names.collect(),
            matrix: matrix.row_iter().map(|row| row.iter().copied().collect()).collect(),
        }),
        maps: None,
        volume: Some(Volume { x: side(0), y: side(1), h: side(2) }),
    }
}

fn combinations(found: &RigCalibration) -> Vec<String> {
    let one = |w: &daic_optics::bundle::WeakCombination| {
        let terms: Vec<String> =
            w.components.iter().map(|c| format!("{:+.2} {}", c.weight, c.parameter.name())).collect();
        format!("{} (σ from the data alone: {:.1} times the prior's)", terms.join(" "), w.data_sigma)
    };
    found.weak.iter().map(one).collect()
}

fn summary(found: &RigCalibration, poses: &[i64], optics: PathBuf) -> Summary {
    Summary {
        parameters: found
            .estimates
            .iter()
            .map(|e| Value {
                name: e.parameter.name(),
                start: e.start,
                value: e.value,
                sigma: e.sigma,
                pull: e.pull(),
            })
            .collect(),
        left_to_priors: combinations(found),
        plate_scale: found.plate_scale.map(|s| [s.value, s.sigma]),
        stage_axes_mrad: found.stage_axes_rad.map(|axes| axes.map(|a| 1e3 * a)),
        rms_px: found.rms_px,
        chi_square_reduced: found.chi_square_reduced,
        rejected: found.rejected.len(),
        left_out: found
            .left_out
            .iter()
            .map(|l| Predicted {
                pose: poses[l.pose],
                rms_h_um: 1e3 * l.rms_mm[2],
                expected_h_um: 1e3 * l.expected_mm[2],
            })
            .collect(),
        optics,
    }
}

fn page(found: &RigCalibration, poses: &[i64]) -> Result<String, Error> {
    let estimates = TableBlock {
        caption: "Estimates; angles in radians".to_owned(),
        head: ["parameter", "start", "value", "σ"].map(str::to_owned).into(),
        rows: found
            .estimates
            .iter()
            .map(|e| {
                let cell = |v: f64| Cell::Text(format!("{v:.7} {}", e.parameter.unit()));
                vec![Cell::Text(e.parameter.name().to_owned()), cell(e.start), cell(e.value), cell(e.sigma)]
            })
            .collect(),
    };
    let of = |view: View, axis: usize| {
        let own = found.residuals.iter().filter(|r| r.view == view);
        own.map(|r| (poses[r.pose] as f64, r.rms_px[axis])).collect::<Vec<_>>()
    };
    let series = |name: &str, view, axis| Series::new(name, SeriesStyle::Points, of(view, axis));
    let residuals = Chart {
        title: "Residuals".to_owned(),
        x_label: "pose".to_owned(),
        y_label: "RMS / px".to_owned(),
        series: vec![
            series("x, −1 view", View::Minus, 0),
            series("y, −1 view", View::Minus, 1),
            series("x, +1 view", View::Plus, 0),
            series("y, +1 view", View::Plus, 1),
        ],
        y_limits: None,
    };
    let mut figures = vec![Figure {
        id: "residuals".to_owned(),
        title: "Residuals of each pose and view".to_owned(),
        caption: "A pose that stands out was tracked badly, or its plate was bent.".to_owned(),
        body: residuals.render_svg()?,
    }];
    if !found.left_out.is_empty() {
        let of = |value: fn(&daic_optics::bundle::LeftOut) -> f64| {
            found.left_out.iter().map(|l| (poses[l.pose] as f64, 1e3 * value(l))).collect::<Vec<_>>()
        };
        let chart = Chart {
            title: "Heights of poses left out".to_owned(),
            x_label: "pose".to_owned(),
            y_label: "RMS / µm".to_owned(),
            series: vec![
                Series::new("found", SeriesStyle::Points, of(|l| l.rms_mm[2])),
                Series::new("noise of the pixels", SeriesStyle::Dashed, of(|l| l.expected_mm[2])),
            ],
            y_limits: None,
        };
        figures.push(Figure {
            id: "left-out".to_owned(),
            title: "Each pose predicted by a calibration without it".to_owned(),
            caption: "Far above the noise, the model does not describe the rig.".to_owned(),
            body: chart.render_svg()?,
        });
    }
    let mut text =
        vec!["The plate in the reference pose is the plane h = 0; its coordinates are x and y.".to_owned()];
    if !found.weak.is_empty() {
        text.push("What the data leave to the priors: ".to_owned() + &combinations(found).join("; ") + ".");
    }
    let report = Report {
        title: "Calibration of the rig".to_owned(),
        subtitle: format!("{} poses", poses.len()),
        verdict: None,
        provenance: vec![
            ("calibrated with".to_owned(), format!("daic {}", env!("CARGO_PKG_VERSION"))),
            ("residual".to_owned(), format!("{:.4} px RMS", found.rms_px)),
            ("χ² per degree of freedom".to_owned(), format!("{:.3}", found.chi_square_reduced)),
            ("pixels left out".to_owned(), found.rejected.len().to_string()),
        ],
        sections: vec![Section { title: "Result".to_owned(), text, tables: vec![estimates], figures }],
    };
    Ok(report.render()?)
}
