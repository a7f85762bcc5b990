//! `daic lightfield`.

use super::commands::as_json;
use super::output::{Answer, Output};
use clap::{Args, Subcommand, ValueEnum};
use daic::lightfield::frames::Corrections;
use daic::lightfield::output::Format;
use daic::lightfield::series::{self, Options};
use daic::lightfield::setup::{Setup, TEMPLATE};
use daic::lightfield::{calibration, psf_file};
use daic::{Error, frames};
use daic_dataset::atomic;
use daic_lightfield::{Method, Settings, Storage};
use serde_json::json;
use std::fmt::Write as _;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct LightFieldArgs {
    #[command(subcommand)]
    what: LightField,
}

#[derive(Debug, Subcommand)]
enum LightField {
    /// Write a commented setup file of a light-field microscope
    Init(InitArgs),
    /// Compute the point spread function of a setup and store it
    Psf(PsfArgs),
    /// Find the lenslet lattice in a white image
    Calibrate(CalibrateArgs),
    /// Reconstruct volumes from frames; takes up a series that was interrupted
    Reconstruct(Box<ReconstructArgs>),
}

#[derive(Debug, Args)]
struct InitArgs {
    /// File to write
    #[arg(default_value = "microscope.toml")]
    file: PathBuf,
    /// Replace a file that is there
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Args)]
struct PsfArgs {
    /// Setup file (see `daic lightfield init`)
    setup: PathBuf,
    /// File of the point spread function; used again when it belongs to the setup
    #[arg(long, value_name = "FILE", default_value = "psf.bin")]
    out: PathBuf,
    /// Replace the point spread function of another setup
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Args)]
struct CalibrateArgs {
    /// Image of uniform light on the lenslets
    white: PathBuf,
    /// Image without light
    #[arg(long, value_name = "FILE")]
    dark: Option<PathBuf>,
    /// Lattice to this file (.toml)
    #[arg(long, value_name = "FILE", default_value = "lattice.toml")]
    out: PathBuf,
    /// Picture of the lattice on the white image to this file (.svg), to look at
    #[arg(long, value_name = "FILE")]
    overlay: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum MethodArg {
    /// Richardson–Lucy: most likely volume under Poisson noise
    Rl,
    /// Image space reconstruction algorithm: least squares, the rule that the thesis prints
    Isra,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum StorageArg {
    F32,
    F16,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum FormatArg {
    Tiff,
    OmeTiff,
    OmeZarr,
}

#[derive(Debug, Args)]
struct ReconstructArgs {
    /// Setup file (see `daic lightfield init`)
    setup: PathBuf,
    /// Frames in order: files, folders or 'patterns'
    #[arg(required = true)]
    frames: Vec<PathBuf>,
    /// Frames of the second order, for a setup with a grating (repeatable)
    #[arg(long, value_name = "FRAMES")]
    minus: Vec<PathBuf>,
    /// Folder for the volumes
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Lattice of the camera (see `daic lightfield calibrate`); without it, frames must be whole lenslets
    #[arg(long, value_name = "FILE")]
    lattice: Option<PathBuf>,
    /// White image: its lenslets' brightness is divided out
    #[arg(long, value_name = "FILE", requires = "lattice")]
    white: Option<PathBuf>,
    /// Dark image, taken off
    #[arg(long, value_name = "FILE")]
    dark: Option<PathBuf>,
    /// Image that is not zero at bad pixels
    #[arg(long, value_name = "FILE")]
    bad: Option<PathBuf>,
    /// Only these lenslets of a rectified frame: first row and column, number of rows and columns
    #[arg(long, value_name = "Y,X,NY,NX", value_parser = parse_crop, requires = "lattice")]
    crop: Option<[[usize; 2]; 2]>,
    /// Stored point spread function (default: psf.bin in the folder)
    #[arg(long, value_name = "FILE")]
    psf: Option<PathBuf>,
    /// Replace the point spread function of another setup
    #[arg(long)]
    force_psf: bool,
    /// Rule of iteration
    #[arg(long, value_enum, default_value = "rl")]
    method: MethodArg,
    /// Most iterations
    #[arg(long, default_value_t = 8)]
    iterations: usize,
    /// Stop when ‖f − Hg‖/‖f‖ is below this
    #[arg(long, value_name = "SHARE")]
    residual: Option<f64>,
    /// Extrapolate along the last step
    #[arg(long)]
    momentum: bool,
    /// Weight of total variation, below 0.2
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.0)]
    total_variation: f64,
    /// Smooth each plane as coarsely as the lenslets sample it; factor of the width
    #[arg(long, value_name = "FACTOR", default_value_t = 0.0)]
    anti_artefact: f64,
    /// Background in every pixel, in counts: what is not from the volume
    #[arg(long, value_name = "COUNTS", default_value_t = 0.0, value_parser = parse_background)]
    background: f32,
    /// Variance of the read noise, in counts
    #[arg(long, value_name = "V", default_value_t = 0.0)]
    read_variance: f32,
    /// Leave saturated pixels out instead of refusing the frame
    #[arg(long)]
    mask_saturated: bool,
    /// Take negative pixels for 0 instead of refusing the frame (always so with --dark and --lattice)
    #[arg(long)]
    clip_negative: bool,
    /// Lenslets around the sensor from which light may come too
    #[arg(long, value_name = "CELLS", default_value_t = 0)]
    border: u16,
    /// Lenslets at the edge of the sensor above which nothing is that gives light; as many as the point spread
    /// function's radius, and `isra` goes through the stored normal matrix
    #[arg(long, value_name = "CELLS", default_value_t = 0, conflicts_with = "border")]
    inset: u16,
    /// Storage of the operator
    #[arg(long, value_enum, default_value = "f32")]
    storage: StorageArg,
    /// Memory for the operator, MiB; beyond, it works in tiles
    #[arg(long, value_name = "MIB")]
    memory: Option<u64>,
    /// Frames reconstructed together
    #[arg(long, default_value_t = 4)]
    batch: usize,
    /// Kinds of volume files
    #[arg(long, value_enum, value_delimiter = ',', default_value = "tiff")]
    format: Vec<FormatArg>,
    /// Replace results that are there
    #[arg(long)]
    overwrite: bool,
    /// Say what memory it would take, and stop
    #[arg(long)]
    estimate: bool,
}

fn parse_background(text: &str) -> Result<f32, String> {
    let value: f32 = text.parse().map_err(|e| format!("{e}"))?;
    if value >= 0.0 && value.is_finite() { Ok(value) } else { Err("a number from 0 on is needed".to_owned()) }
}

fn parse_crop(text: &str) -> Result<[[usize; 2]; 2], String> {
    let numbers: Vec<usize> = text
        .split(',')
        .map(|p| p.trim().parse().map_err(|e| format!("`{p}`: {e}")))
        .collect::<Result<_, _>>()?;
    match numbers[..] {
        [y, x, ny, nx] if ny > 0 && nx > 0 => Ok([[y, x], [ny, nx]]),
        _ => Err("four whole numbers are needed, the last two above 0".to_owned()),
    }
}

pub fn lightfield(arguments: &LightFieldArgs, output: &Output) -> Result<Answer, Error> {
    match &arguments.what {
        LightField::Init(a) => init(a),
        LightField::Psf(a) => psf(a, output),
        LightField::Calibrate(a) => calibrate(a),
        LightField::Reconstruct(a) => reconstruct(a, output),
    }
}

fn init(a: &InitArgs) -> Result<Answer, Error> {
    if a.file.exists() && !a.force {
        return Err(Error::Exists { path: a.file.clone() });
    }
    atomic::write_bytes(&a.file, TEMPLATE.as_bytes())?;
    let file = a.file.display().to_string();
    Ok(Answer::new(json!({ "written": file }), format!("wrote {file}")))
}

fn psf(a: &PsfArgs, output: &Output) -> Result<Answer, Error> {
    let parameters = Setup::load(&a.setup)?.parameters()?;
    let (psf, reused) = psf_file::obtain(Some(&a.out), &parameters, a.force, output)?;
    let r = &psf.report;
    let mut text = String::new();
    writeln!(
        text,
        "sampling {} per pixel ({:.3} µm), error {:.2e}; integral error {:.1e}; radius {} lenslets",
        r.samples, r.dx_um, r.sampling_error, r.quadrature_error, psf.radius
    )
    .ok();
    for ((z, energy), radius) in parameters.planes_um.iter().zip(&r.energy).zip(&r.plane_radius) {
        writeln!(text, "z {z:>8.2} µm: radius {radius}, {energy:.4} of the light").ok();
    }
    if r.evanescent > 0.0 {
        writeln!(text, "{:.3} of the pupil is evanescent behind the grating", r.evanescent).ok();
    }
    let file = a.out.display().to_string();
    writeln!(text, "{} {file}", if reused { "was there already:" } else { "wrote" }).ok();
    let json = json!({
        "file": file, "reused": reused, "radius": psf.radius, "report": as_json(r)?,
        "hash": psf_file::hash(&parameters),
    });
    Ok(Answer::new(json, text))
}

fn calibrate(a: &CalibrateArgs) -> Result<Answer, Error> {
    let (lattice, white) = calibration::calibrate(&a.white, a.dark.as_deref())?;
    calibration::write(&a.out, &lattice)?;
    let mut written = vec![a.out.display().to_string()];
    if let Some(path) = &a.overlay {
        calibration::write_overlay(path, &lattice, &white)?;
        written.push(path.display().to_string());
    }
    let mut text = String::new();
    let [x, y] = lattice.pitch_px;
    writeln!(text, "{:?} packing", lattice.packing).ok();
    writeln!(
        text,
        "pitch     {:.5} ± {:.5} px along x, {:.5} ± {:.5} px along y",
        x.value, x.sigma, y.value, y.sigma
    )
    .ok();
    let mrad =
        |m: daic_lightfield::lattice::Measured| format!("{:.4} ± {:.4} mrad", 1e3 * m.value, 1e3 * m.sigma);
    writeln!(text, "rotation  {}, skew {}", mrad(lattice.rotation_rad), mrad(lattice.skew_rad)).ok();
    let ([ox, oy], [sx, sy]) = (lattice.origin_px, lattice.origin_sigma_px);
    writeln!(text, "origin    ({ox:.4} ± {sx:.4}, {oy:.4} ± {sy:.4}) px").ok();
    let [u, v] = lattice.whole_cells();
    writeln!(text, "lenslets  {} × {} whole", u[1] - u[0] + 1, v[1] - v[0] + 1).ok();
    let (rms, used, rejected) = (lattice.rms_px, lattice.used, lattice.rejected);
    writeln!(text, "residuals {rms:.4} px RMS of {used} lenslets, {rejected} left out").ok();
    for file in &written {
        writeln!(text, "wrote {file}").ok();
    }
    let mut json = as_json(&lattice)?;
    json["written"] = written.into();
    Ok(Answer::new(json, text))
}

fn reconstruct(a: &ReconstructArgs, output: &Output) -> Result<Answer, Error> {
    let setup = Setup::load(&a.setup)?;
    let lattice = a.lattice.as_ref().map(|p| calibration::read(p)).transpose()?;
    let nothing = PathBuf::new();
    let options = Options {
        frames: frames::expand(&a.frames, &nothing)?,
        minus: frames::expand(&a.minus, &nothing)?,
        out: a.out.clone(),
        psf: a.psf.clone(),
        force_psf: a.force_psf,
        corrections: Corrections {
            lattice,
            white: a.white.clone(),
            dark: a.dark.clone(),
            bad: a.bad.clone(),
            crop: a.crop,
            mask_saturated: a.mask_saturated,
        },
        settings: Settings {
            residual_below: a.residual,
            momentum: a.momentum,
            total_variation: a.total_variation,
            anti_artefact: a.anti_artefact,
            read_variance: a.read_variance,
            // noise about a dark level has both signs, and so has cubic interpolation beside a bright spot
            clip_negative: a.clip_negative || a.dark.is_some() || a.lattice.is_some(),
            ..Settings::new(
                match a.method {
                    MethodArg::Rl => Method::Rl,
                    MethodArg::Isra => Method::Isra,
                },
                a.iterations,
            )
        },
        background: a.background,
        border: a.border.into(),
        inset: a.inset.into(),
        storage: match a.storage {
            StorageArg::F32 => Storage::F32,
            StorageArg::F16 => Storage::F16,
        },
        memory_limit: a.memory.map(|mib| mib.saturating_mul(1 << 20)),
        batch: a.batch,
        formats: a
            .format
            .iter()
            .map(|f| match f {
                FormatArg::Tiff => Format::Tiff,
                FormatArg::OmeTiff => Format::OmeTiff,
                FormatArg::OmeZarr => Format::OmeZarr,
            })
            .collect(),
        overwrite: a.overwrite,
        estimate_only: a.estimate,
    };
    output.stop_on_interrupt();
    let summary = series::run(&setup, &options, output)?;
    let mut text = String::new();
    let m = &summary.memory;
    let [nz, ny, nx] = summary.volume;
    writeln!(
        text,
        "volume {nz} × {ny} × {nx}; operator {} MiB at most ({:?}, {} × {} frequencies{})",
        summary.peak_bytes >> 20,
        m.reduction,
        m.grid[0],
        m.grid[1],
        m.tile.map_or(String::new(), |[y, x]| format!(", tiles of {y} × {x}"))
    )
    .ok();
    for f in &summary.frames {
        let last = f.residuals.last().map_or(String::new(), |r| format!(", residual {r:.4}"));
        writeln!(text, "{}: {} iterations{last}", f.name, f.iterations).ok();
    }
    if !summary.path.is_empty() {
        writeln!(text, "computed by {}", summary.path).ok();
    }
    if summary.resumed > 0 {
        writeln!(text, "{} results were there already", summary.resumed).ok();
    }
    if !a.estimate {
        writeln!(text, "volumes, projections and pages are in {}", a.out.display()).ok();
    }
    Ok(Answer::new(as_json(&summary)?, text))
}
