//! `daic strain`, `daic probe`, `daic noise-floor`: flags and answers.

use super::arguments::{DicArgs, Roi, ShapeArg, numbers, parse_roi};
use super::commands::{apply, as_json, rectangle, shape, table_writer};
use super::output::{Answer, Output};
use clap::{Args, ValueEnum};
use daic::noise_floor::{self, Scatter, Temporal};
use daic::probe::{Probes, probe as look};
use daic::strain::{Options, StrainField, write_figures};
use daic::{Error, images, result_file};
use daic_correlate::strain::{Extensometer, Method, Order, Settings, Tensor};
use serde_json::json;
use std::fmt::Write as _;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct StrainArgs {
    /// Points written by `daic correlate --out FILE.csv`
    pub result: PathBuf,
    #[command(flatten)]
    pub fit: FitArgs,
    #[command(flatten)]
    pub origin: OriginArgs,
    /// Strain to this file (.csv or .npz)
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Maps of exx, eyy and exy as SVG into this folder
    #[arg(long, value_name = "DIR")]
    pub figures: Option<PathBuf>,
}

/// How strain is computed.
#[derive(Debug, Args)]
pub struct FitArgs {
    /// Side of the strain window in points, odd [default: 15]
    #[arg(long, value_name = "N")]
    pub window: Option<u32>,
    /// Fit to the points that are there, or filter of whole windows
    #[arg(long, default_value = "vsg")]
    pub method: MethodArg,
    /// Polynomial of the fit; cubic and quartic for Savitzky–Golay only
    #[arg(long, default_value = "plane")]
    pub order: OrderArg,
    /// Strain measure
    #[arg(long, default_value = "green-lagrange")]
    pub tensor: TensorArg,
    /// Size of a pixel on the object in mm, to state lengths in mm
    #[arg(long, value_name = "MM/PX", value_parser = parse_scale, allow_hyphen_values = true)]
    pub scale: Option<f64>,
    /// Part of a whole window's points that a VSG fit must find, 0 to 1
    #[arg(long, value_name = "FRACTION", default_value_t = 0.5, allow_hyphen_values = true)]
    pub min_fraction: f64,
    /// Difference between adjacent points in pixels from which on the material counts as parted there
    #[arg(long, value_name = "PX", allow_hyphen_values = true)]
    pub max_jump: Option<f64>,
}

/// What a file of points does not say about how it was measured.
#[derive(Debug, Args)]
pub struct OriginArgs {
    /// Subset side in pixels with which the points were measured [default: that of `daic correlate`, 33]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(1..=1001))]
    pub subset: Option<u32>,
    /// Shape function with which the points were measured
    #[arg(long, default_value = "affine")]
    pub shape: ShapeArg,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum MethodArg {
    /// Virtual strain gauge
    Vsg,
    /// Savitzky–Golay
    SavitzkyGolay,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum OrderArg {
    #[value(alias = "1")]
    Plane,
    #[value(alias = "2")]
    Quadratic,
    #[value(alias = "3")]
    Cubic,
    #[value(alias = "4")]
    Quartic,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum TensorArg {
    /// ½ (FᵀF − I)
    GreenLagrange,
    /// ln U, logarithmic
    Hencky,
    /// Small strain, ½ (∂u + ∂uᵀ)
    Engineering,
    /// U − I
    Biot,
    /// ½ (I − (F Fᵀ)⁻¹), on the deformed axes
    EulerAlmansi,
}

#[derive(Debug, Args)]
pub struct ProbeArgs {
    /// Points written by `daic correlate --out FILE.csv`
    pub result: PathBuf,
    /// A position in pixels (repeatable)
    #[arg(long, value_name = "X,Y", value_parser = parse_point, allow_hyphen_values = true)]
    pub point: Vec<Coordinates<2>>,
    /// A line from (X0, Y0) to (X1, Y1) in pixels (repeatable)
    #[arg(long, value_name = "X0,Y0,X1,Y1", value_parser = parse_segment, allow_hyphen_values = true)]
    pub line: Vec<Coordinates<4>>,
    /// A virtual extensometer between (X0, Y0) and (X1, Y1) in pixels (repeatable)
    #[arg(long, value_name = "X0,Y0,X1,Y1", value_parser = parse_segment, allow_hyphen_values = true)]
    pub extensometer: Vec<Coordinates<4>>,
    /// Radius in pixels of the area over which each end of an extensometer is averaged
    #[arg(long, value_name = "PX", default_value_t = 0.0, allow_hyphen_values = true)]
    pub radius: f64,
    /// Positions along a line (default: one per point of the grid)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    pub samples: Option<u32>,
    #[command(flatten)]
    pub fit: FitArgs,
    #[command(flatten)]
    pub origin: OriginArgs,
    /// Values to this file (.csv or .npz)
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Curves along the lines as SVG into this folder
    #[arg(long, value_name = "DIR")]
    pub figures: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct NoiseFloorArgs {
    /// Two or more images of a specimen that does not move; three for the scatter over time
    #[arg(required = true, num_args = 2.., value_name = "IMAGE")]
    pub images: Vec<PathBuf>,
    #[command(flatten)]
    pub dic: DicArgs,
    /// Region of interest in pixels: X,Y,WIDTH,HEIGHT
    #[arg(long, value_name = "X,Y,W,H", value_parser = parse_roi, allow_hyphen_values = true)]
    pub roi: Option<Roi>,
    #[command(flatten)]
    pub fit: FitArgs,
    /// Scatter at every point to this file (.csv or .npz)
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Maps of the scatter as SVG into this folder
    #[arg(long, value_name = "DIR")]
    pub figures: Option<PathBuf>,
}

/// Coordinates in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coordinates<const N: usize>(pub [f64; N]);

fn coordinates<const N: usize>(text: &str, form: &str) -> Result<Coordinates<N>, String> {
    let values = numbers::<f64, N>(text, form)?;
    match values.iter().find(|v| !v.is_finite()) {
        Some(value) => Err(format!("found `{value}`, wanted finite coordinates {form}")),
        None => Ok(Coordinates(values)),
    }
}

fn parse_point(text: &str) -> Result<Coordinates<2>, String> {
    coordinates(text, "X,Y in pixels")
}

fn parse_segment(text: &str) -> Result<Coordinates<4>, String> {
    coordinates(text, "X0,Y0,X1,Y1 in pixels")
}

fn parse_scale(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(scale) if scale.is_finite() && scale > 0.0 => Ok(scale),
        _ => Err(format!("found `{text}`, wanted the size of a pixel in mm, above 0")),
    }
}

fn options(arguments: &FitArgs) -> Result<Options, Error> {
    let order = match arguments.order {
        OrderArg::Plane => 1,
        OrderArg::Quadratic => 2,
        OrderArg::Cubic => 3,
        OrderArg::Quartic => 4,
    };
    let method = match (arguments.method, order) {
        (MethodArg::Vsg, 1) => Method::Vsg(Order::Plane),
        (MethodArg::Vsg, 2) => Method::Vsg(Order::Quadratic),
        (MethodArg::Vsg, order) => return Err(Error::VsgOrder { order }),
        (MethodArg::SavitzkyGolay, order) => Method::SavitzkyGolay(order),
    };
    let tensor = match arguments.tensor {
        TensorArg::GreenLagrange => Tensor::GreenLagrange,
        TensorArg::Hencky => Tensor::Hencky,
        TensorArg::Engineering => Tensor::Engineering,
        TensorArg::Biot => Tensor::Biot,
        TensorArg::EulerAlmansi => Tensor::EulerAlmansi,
    };
    let settings = Settings {
        window: arguments.window.map_or(Settings::default().window, |w| w as usize),
        method,
        min_fraction: arguments.min_fraction,
        max_jump: arguments.max_jump,
    };
    settings.validate()?;
    Ok(Options { settings, tensor, mm_per_px: arguments.scale })
}

fn read(arguments: &OriginArgs, path: &std::path::Path) -> Result<daic_correlate::strain::Field, Error> {
    let subset = arguments.subset.map_or(daic_correlate::Settings::default().subset, |s| s as usize);
    result_file::read(path, subset, shape(arguments.shape))
}

/// The file does not say which subsets it was measured with: where nobody does, people are told.
fn assumed(arguments: &OriginArgs, text: &mut String) {
    if arguments.subset.is_none() {
        let subset = daic_correlate::Settings::default().subset;
        writeln!(
            text,
            "note: subsets of {subset} px assumed; give --subset if the points were measured with others"
        )
        .ok();
    }
}

fn listed(files: &[PathBuf]) -> serde_json::Value {
    files.iter().map(|path| path.display().to_string()).collect()
}

pub fn strain(arguments: &StrainArgs, output: &Output) -> Result<Answer, Error> {
    use daic::Progress as _;
    let options = options(&arguments.fit)?;
    let writer = arguments.out.as_deref().map(table_writer).transpose()?;
    let field = read(&arguments.origin, &arguments.result)?;
    output.stage("computing strain", 0);
    let found = StrainField::new(field, options)?;
    let summary = found.summary();
    // whatever can fail does so before the first file
    let (table, drawn) = (found.table()?, arguments.figures.as_ref().map(|_| found.figures()).transpose()?);
    if let (Some(path), Some(write)) = (&arguments.out, writer) {
        write(&table, path)?;
    }
    let files = match (&arguments.figures, drawn) {
        (Some(folder), Some(drawn)) => write_figures(folder, &drawn)?,
        _ => Vec::new(),
    };
    let mut text = String::new();
    writeln!(
        text,
        "{} strain at {} of {} points\n{}",
        summary.tensor, summary.ok, summary.points, summary.gauge
    )
    .ok();
    for (name, c) in [("exx", &summary.exx), ("eyy", &summary.eyy), ("exy", &summary.exy)] {
        writeln!(
            text,
            "{name} {:.3e}, scatter over the points {:.2e}, σ of a point {:.2e}",
            c.mean, c.std, c.sigma
        )
        .ok();
    }
    let failed: Vec<String> = summary
        .status
        .iter()
        .filter(|(name, _)| **name != "ok")
        .map(|(name, n)| format!("{n} {name}"))
        .collect();
    if !failed.is_empty() {
        writeln!(text, "without strain: {}", failed.join(", ")).ok();
    }
    assumed(&arguments.origin, &mut text);
    let mut answer = as_json(&summary)?;
    answer["subset_assumed"] = json!(arguments.origin.subset.is_none());
    answer["out"] = json!(arguments.out.as_ref().map(|p| p.display().to_string()));
    answer["figures"] = listed(&files);
    Ok(Answer::new(answer, text))
}

pub fn probe(arguments: &ProbeArgs) -> Result<Answer, Error> {
    let options = options(&arguments.fit)?;
    let writer = arguments.out.as_deref().map(table_writer).transpose()?;
    let segment = |c: &Coordinates<4>| [[c.0[0], c.0[1]], [c.0[2], c.0[3]]];
    let probes = Probes {
        points: arguments.point.iter().map(|c| c.0).collect(),
        lines: arguments.line.iter().map(segment).collect(),
        samples: arguments.samples.map(|n| n as usize),
        extensometers: arguments
            .extensometer
            .iter()
            .map(segment)
            .map(|[from, to]| Extensometer { from, to, radius: arguments.radius })
            .collect(),
    };
    let field = read(&arguments.origin, &arguments.result)?;
    // a field that is too small for the default window still has displacements; a window that was asked
    // for is not left out in silence
    let fits = options.settings.window <= field.columns.min(field.rows);
    let with = (fits || arguments.fit.window.is_some()).then_some(&options);
    let found = look(&field, &probes, with)?;
    let table = found.table()?;
    let drawn = arguments.figures.as_ref().map(|_| found.figures()).transpose()?;
    if let (Some(path), Some(write)) = (&arguments.out, writer) {
        write(&table, path)?;
    }
    let files = match (&arguments.figures, drawn) {
        (Some(folder), Some(drawn)) => write_figures(folder, &drawn)?,
        _ => Vec::new(),
    };
    let mut text = String::new();
    match &found.gauge {
        Some(gauge) => writeln!(text, "strain: {}, {gauge}", options.tensor).ok(),
        None => {
            writeln!(text, "no strain: the field is smaller than the window of {}", options.settings.window)
                .ok()
        }
    };
    for p in &found.points {
        let [x, y] = p.position;
        let ([u, v], [su, sv]) = (p.displacement, p.sigma);
        write!(text, "point ({x}, {y}): {}, u {u:.4} ± {su:.4} px, v {v:.4} ± {sv:.4} px", p.status).ok();
        if let Some(s) = p.strain.filter(|s| s.status.is_ok()) {
            let [xx, yy, xy] = s.components;
            write!(text, ", exx {xx:.3e}, eyy {yy:.3e}, exy {xy:.3e}").ok();
        }
        writeln!(text).ok();
    }
    for (k, line) in found.lines.iter().enumerate() {
        let ok = line.points.iter().filter(|p| p.status.is_ok()).count();
        let length = line.distance.last().copied().unwrap_or(0.0);
        writeln!(
            text,
            "line {}: {length:.1} px, {ok} of {} positions have a value",
            k + 1,
            line.points.len()
        )
        .ok();
    }
    for (k, e) in found.extensometers.iter().enumerate() {
        writeln!(
            text,
            "extensometer {}: {}, {:.3} px → {:.3} px, strain {:.4e} ± {:.1e}",
            k + 1,
            e.status,
            e.length,
            e.deformed_length,
            e.strain,
            e.sigma
        )
        .ok();
    }
    assumed(&arguments.origin, &mut text);
    let mut answer = found.json();
    answer["tensor"] = json!(options.tensor.name());
    answer["subset_assumed"] = json!(arguments.origin.subset.is_none());
    answer["out"] = json!(arguments.out.as_ref().map(|p| p.display().to_string()));
    answer["figures"] = listed(&files);
    Ok(Answer::new(answer, text))
}

pub fn noise_floor(arguments: &NoiseFloorArgs, output: &Output) -> Result<Answer, Error> {
    let options = options(&arguments.fit)?;
    let writer = arguments.out.as_deref().map(table_writer).transpose()?;
    let mut dic = daic_correlate::Settings::default();
    let mut step = 5;
    apply(&arguments.dic, &mut dic, &mut step);
    let roi = match (arguments.roi, arguments.images.first()) {
        (Some(roi), Some(first)) => Some(rectangle(roi, &images::read(first)?)?),
        _ => None,
    };
    let found = noise_floor::measure(&arguments.images, &dic, step, roi, &options, output)?;
    let table = found.table()?;
    let drawn = arguments.figures.as_ref().map(|_| found.figures()).transpose()?;
    if let (Some(path), Some(write)) = (&arguments.out, writer) {
        write(&table, path)?;
    }
    let files = match (&arguments.figures, drawn) {
        (Some(folder), Some(drawn)) => write_figures(folder, &drawn)?,
        _ => Vec::new(),
    };
    let s = &found.summary;
    let mut text = String::new();
    writeln!(
        text,
        "{} static frames against {}, {} points\n{}",
        s.frames.len(),
        s.reference,
        s.points,
        s.gauge
    )
    .ok();
    let px = |name: &str, f: &Scatter, rest: f64| {
        format!(
            "{name} {:+.4} px, scatter {:.4} ({rest:.4} without rigid motion, σ {:.4})",
            f.mean, f.std, f.sigma
        )
    };
    for f in &s.frames {
        writeln!(text, "{}: {} ok, rotation {:.1} µrad", f.image, f.ok, f.rigid.rotation_urad).ok();
        writeln!(text, "  {}", px("u", &f.u, f.u_std_without_rigid)).ok();
        writeln!(text, "  {}", px("v", &f.v, f.v_std_without_rigid)).ok();
        for (name, e) in ["exx", "eyy", "exy"].into_iter().zip(&f.strain) {
            writeln!(text, "  {name} {:+.2e}, scatter {:.2e} (σ {:.2e})", e.mean, e.std, e.sigma).ok();
        }
    }
    let time = |name: &str, t: &Temporal| {
        format!(
            "over the frames: {name} median {:.3e}, RMS {:.3e}, 95 % below {:.3e} (σ of one frame {:.3e})",
            t.median, t.rms, t.p95, t.sigma_of_one_frame
        )
    };
    if let (Some(u), Some(v), Some(strain)) = (&s.temporal_u, &s.temporal_v, &s.temporal_strain) {
        writeln!(text, "{}\n{}", time("u / px", u), time("v / px", v)).ok();
        for (name, t) in ["exx", "eyy", "exy"].into_iter().zip(strain) {
            writeln!(text, "{}", time(name, t)).ok();
        }
    } else {
        writeln!(text, "the scatter over time needs three images or more").ok();
    }
    let mut answer = as_json(s)?;
    answer["settings"] = as_json(&dic)?;
    answer["out"] = json!(arguments.out.as_ref().map(|p| p.display().to_string()));
    answer["figures"] = listed(&files);
    Ok(Answer::new(answer, text))
}
