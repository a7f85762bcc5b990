//! Commands and their flags.

use super::align::AlignArgs;
use super::calibrate::CalibrateArgs;
use super::lightfield::LightFieldArgs;
use super::plan::PlanArgs;
use super::rig::RigArgs;
use super::strain::{NoiseFloorArgs, ProbeArgs, StrainArgs};
use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;

/// Measures 3D shape and displacement with one camera behind a transmission grating.
#[derive(Debug, Parser)]
#[command(version, about, max_term_width = 100, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
    /// Print exactly one JSON object on stdout
    #[arg(long, global = true)]
    pub json: bool,
    /// No progress on stderr
    #[arg(long, short, global = true)]
    pub quiet: bool,
    /// Threads to compute with (default: all cores); results do not depend on it
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub threads: Option<u16>,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the whole instrument against the simulated rig: a commanded move comes back as a measured one
    #[cfg(feature = "sim")]
    Demo(DemoArgs),
    /// Run an experiment on the simulated rig and write a dataset
    #[cfg(feature = "sim")]
    Simulate(SimulateArgs),
    /// Run an experiment on a rig at a port and write a dataset
    Run(RunArgs),
    /// Measure everything in a recorded dataset; takes up where it was interrupted
    Process(ProcessArgs),
    /// Correlate two images or a series (2D-DIC); takes up a series that was interrupted
    Correlate(CorrelateArgs),
    /// Points from pixel pairs that were matched elsewhere
    Decode(DecodeArgs),
    /// Strain from the points of `daic correlate`
    Strain(StrainArgs),
    /// Values at points and along lines, virtual extensometers, from the points of `daic correlate`
    Probe(ProbeArgs),
    /// Noise of displacement and strain, from frames of a specimen that does not move
    NoiseFloor(NoiseFloorArgs),
    /// Phases of a line or cross grating; with a second image, the displacement between both
    Phase(PhaseArgs),
    /// Height map of one frame with both first-order views
    Profile(ProfileArgs),
    /// 3D displacement from one frame with both views to another
    Displacement(DisplacementArgs),
    /// Follow the points of a frame in both first-order views; makes the fields of `daic calibrate microscope`
    Track(TrackArgs),
    /// Calibrate an instrument from measurements of something known
    Calibrate(CalibrateArgs),
    /// Volumes from light-field frames: lattice, point spread function, reconstruction
    Lightfield(LightFieldArgs),
    /// What a set-up will be able to measure: field, overlaps, uncertainty, light, and what to change
    Plan(PlanArgs),
    /// Line up camera, laser and gratings, step by step, from stored images
    Align(AlignArgs),
    /// Write a commented experiment file
    Init(InitArgs),
    /// Print the JSON schema of the experiment file
    Schema,
    /// Say what is here: ports, board, camera, threads, SIMD
    Doctor(DoctorArgs),
    /// The trigger box by itself: load, play, stream, watch, home, move, store, draw
    Rig(RigArgs),
}

/// What the demo simulates.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum SceneArg {
    /// One camera behind a grating, 20 mm of field
    Macro,
    /// The microscope with a grating, 0.3 mm of field
    Microscope,
    /// The light-field microscope: volumes of moving beads
    Lightfield,
}

#[derive(Debug, Args)]
pub struct DemoArgs {
    /// What is simulated
    #[arg(long, default_value = "macro")]
    pub scene: SceneArg,
    /// Folder for the dataset and the report
    #[arg(long, value_name = "DIR", default_value = "demo")]
    pub out: PathBuf,
    /// Seed of speckle and noise
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Stage move in mm: right, down, towards the camera (default: 0.050,-0.030,0.200; under the microscope
    /// 0.004,-0.003,0.006)
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_move, allow_hyphen_values = true)]
    pub r#move: Option<Move>,
    /// Pitch that the host believes, relative to the rig's true one (for trying out what a wrong one does)
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    pub pitch_factor: f64,
    /// Do not calibrate; decode with the experiment's values as they stand
    #[arg(long)]
    pub no_calibration: bool,
}

#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// Experiment file (see `daic init`)
    pub experiment: PathBuf,
    /// Folder for the dataset
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Scene file of the simulated rig (see `hil-sim --print-scene`); default: the experiment's optics and a cylinder
    #[arg(long, value_name = "FILE")]
    pub scene: Option<PathBuf>,
    /// Seed of speckle and noise (default: the experiment's)
    #[arg(long)]
    pub seed: Option<u64>,
    /// Replace a dataset that is in the folder already
    #[arg(long)]
    pub replace: bool,
}

#[derive(Debug, Args)]
pub struct RunArgs {
    /// Experiment file (see `daic init`)
    pub experiment: PathBuf,
    /// Folder for the dataset
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Serial port or tcp://HOST:PORT of the trigger box (default: the experiment's)
    #[arg(long)]
    pub port: Option<String>,
    /// Folder into which the camera's program (or `hil-sim --frames`) writes its frames (default: the
    /// experiment's `rig.camera.source`)
    #[arg(long, value_name = "DIR")]
    pub frames: Option<PathBuf>,
    /// Replace a dataset that is in the folder already
    #[arg(long)]
    pub replace: bool,
}

#[derive(Debug, Args)]
pub struct ProcessArgs {
    /// Dataset folder
    pub dataset: PathBuf,
    /// Decode with this optics file, with its covariance, distortion maps and volume, instead of calibrating by the
    /// dataset's own moves
    #[arg(long, value_name = "FILE")]
    pub optics: Option<PathBuf>,
    /// Measure anew what has been measured already
    #[arg(long)]
    pub fresh: bool,
}

#[derive(Debug, Args)]
pub struct CorrelateArgs {
    /// Reference image (8 or 16 bit TIFF, PNG, BMP)
    pub reference: PathBuf,
    /// Deformed images in order: files, folders or 'patterns'; with more than one, --out is a folder
    #[arg(required = true)]
    pub deformed: Vec<PathBuf>,
    #[command(flatten)]
    pub dic: DicArgs,
    /// Which image a series is correlated with; displacements always count from the first
    #[arg(long = "reference", value_name = "WHICH")]
    pub update: Option<UpdateArg>,
    /// Where displacements are stated
    #[arg(long, default_value = "lagrangian")]
    pub description: DescriptionArg,
    /// Replace the results of another run in the folder
    #[arg(long)]
    pub overwrite: bool,
    /// Region of interest in pixels: X,Y,WIDTH,HEIGHT
    #[arg(long, value_name = "X,Y,W,H", value_parser = parse_roi, allow_hyphen_values = true)]
    pub roi: Option<Roi>,
    /// Where first displacements of two images come from
    #[arg(long, default_value = "auto", conflicts_with = "seed")]
    pub guess: GuessArg,
    /// Known displacement of a place, good to about 10 px: X,Y,U,V, or X,Y,U,V,UX,UY,VX,VY where the
    /// material has turned; may be given several times
    #[arg(long, value_name = "X,Y,U,V[,UX,UY,VX,VY]", value_parser = parse_seed, allow_hyphen_values = true)]
    pub seed: Vec<daic_correlate::Seed>,
    #[command(flatten)]
    pub area: AreaArgs,
    /// Points to this file (.csv or .npz); of a series, to this folder
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct PhaseArgs {
    /// Image of a grating; the reference where there are two
    pub image: PathBuf,
    /// Deformed image of the same grating
    pub deformed: Option<PathBuf>,
    /// Pitch in pixels to look for, to within 25 % (default: the strongest pattern)
    #[arg(long, value_name = "PX")]
    pub pitch: Option<f64>,
    /// Directions to look for
    #[arg(long, default_value = "auto")]
    pub gratings: GratingsArg,
    /// Analysis window
    #[arg(long, default_value = "gaussian")]
    pub window: WindowArg,
    /// Width of the window in pitches: standard deviation of the Gaussians, half base of the triangle
    #[arg(long, value_name = "PITCHES", default_value_t = 2.5)]
    pub width: f64,
    /// Noise of an image in grey levels (default: estimated from its spectrum)
    #[arg(long, value_name = "GREY")]
    pub noise: Option<f64>,
    /// Displacement in pixels to start from; without it, it must be less than half a pitch in the median
    #[arg(long, value_name = "U,V", value_parser = parse_shift, allow_hyphen_values = true)]
    pub shift: Option<Shift>,
    /// Distance of the points in points.csv in pixels
    #[arg(long, value_name = "PX", default_value_t = 5)]
    pub step: u32,
    /// Folder for maps, points and figures
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum GratingsArg {
    /// What the spectrum shows
    Auto,
    /// Parallel lines
    Line,
    /// Two directions
    Cross,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum WindowArg {
    /// Gaussian
    Gaussian,
    /// Gaussian that leaves quadratic phase as it is, at more noise
    GaussianFlat,
    /// Product of two triangles
    BiTriangular,
}

impl WindowArg {
    pub fn kind(self) -> daic_correlate::phase::WindowKind {
        use daic_correlate::phase::WindowKind;
        match self {
            Self::Gaussian => WindowKind::Gaussian,
            Self::GaussianFlat => WindowKind::GaussianFlat,
            Self::BiTriangular => WindowKind::BiTriangular,
        }
    }
}

/// Which pixels are used.
#[derive(Debug, Args)]
pub struct AreaArgs {
    /// Regions to use: a TOML file of [[region]] tables (rectangle, circle, ellipse, polygon)
    #[arg(long, value_name = "FILE")]
    pub regions: Option<PathBuf>,
    /// Mask image of the same size: pixels that are not black are used
    #[arg(long, value_name = "FILE")]
    pub mask: Option<PathBuf>,
    /// Share of a subset that must be inside, 0.1 to 1; default 0.5 with regions or a mask, else 1
    #[arg(long, value_name = "SHARE")]
    pub min_inside: Option<f64>,
}

/// Subset settings; what is not given comes from the optics or experiment file, or the default.
#[derive(Debug, Args)]
pub struct DicArgs {
    /// Subset side in pixels, odd
    #[arg(long, value_name = "PX")]
    pub subset: Option<u32>,
    /// Distance of points in pixels
    #[arg(long, value_name = "PX")]
    pub step: Option<u32>,
    /// Shape function
    #[arg(long)]
    pub shape: Option<ShapeArg>,
    /// Interpolating B-spline
    #[arg(long)]
    pub interpolation: Option<InterpolationArg>,
    /// What is minimised
    #[arg(long)]
    pub criterion: Option<CriterionArg>,
    /// Which form of the optimisation solves the points (default: auto)
    #[arg(long)]
    pub solver: Option<SolverArg>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum SolverArg {
    /// Dense where it agrees with exact, exact everywhere else
    Auto,
    /// All overlapping subsets at once; points where that is not valid have no result
    Dense,
    /// Every subset by its own iteration
    Exact,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum CriterionArg {
    /// Blind to brightness and contrast
    Znssd,
    /// Blind to brightness alone
    Zssd,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum GuessArg {
    /// Cross-correlation, and features where it does not lead to most of the points
    Auto,
    /// Cross-correlation alone: shifts up to half the image
    Fft,
    /// Matched features: any rotation, change of size, large shifts
    Features,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum ShapeArg {
    Affine,
    Quadratic,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum InterpolationArg {
    Cubic,
    Quintic,
    Septic,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum UpdateArg {
    /// The first, always
    Fixed,
    /// The one before
    Incremental,
    /// The first, until a frame is recognised badly; then the last good one
    Auto,
}

impl From<UpdateArg> for daic_correlate::Update {
    fn from(update: UpdateArg) -> Self {
        match update {
            UpdateArg::Fixed => Self::Fixed,
            UpdateArg::Incremental => Self::Incremental,
            UpdateArg::Auto => Self::AUTOMATIC,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum DescriptionArg {
    /// At the material's position in the first image
    Lagrangian,
    /// At the material's position in the deformed image
    Eulerian,
}

impl From<DescriptionArg> for daic::sequence::Description {
    fn from(description: DescriptionArg) -> Self {
        match description {
            DescriptionArg::Lagrangian => Self::Lagrangian,
            DescriptionArg::Eulerian => Self::Eulerian,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum DecoderArg {
    /// Exact rays through the grating equation
    Ray,
    /// Virtual object, not linearised
    Closed,
    /// Virtual object, linearised (the literature)
    Linear,
}

#[derive(Debug, Args)]
pub struct DecodeArgs {
    /// Optics file (examples/golden-macro.toml), or a microscope's (of `daic calibrate microscope`)
    #[arg(long, value_name = "FILE")]
    pub optics: PathBuf,
    /// Table (CSV) of pixel pairs: minus_x, minus_y, plus_x, plus_y and perhaps sigma_px
    pub pairs: PathBuf,
    /// How pixel pairs become points
    #[arg(long, default_value = "ray")]
    pub decoder: DecoderArg,
    /// Standard deviation of a pixel coordinate where the table states none
    #[arg(long, value_name = "PX", default_value_t = 0.01, value_parser = positive)]
    pub sigma: f64,
    /// Points to this file (.csv or .npz)
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

#[derive(Debug, Args)]
pub struct ProfileArgs {
    /// Optics file (examples/golden-macro.toml), or a microscope's (of `daic calibrate microscope`)
    #[arg(long, value_name = "FILE")]
    pub optics: PathBuf,
    /// Frame with both first-order views
    pub frame: PathBuf,
    /// How pixel pairs become points
    #[arg(long, default_value = "ray")]
    pub decoder: DecoderArg,
    /// Frames of a colour sensor as it recorded them: pattern and channel that is used, such as rggb:r
    #[arg(long, value_name = "PATTERN:CHANNEL")]
    pub bayer: Option<daic_rig::experiment::Bayer>,
    /// Under a microscope: how far the matches between the views may lie from where the views' outlines coincide, pixels
    #[arg(long, value_name = "PX", default_value_t = 40.0, value_parser = positive)]
    pub search: f64,
    #[command(flatten)]
    pub dic: DicArgs,
    /// Distance of the nodes in object coordinates (default: as far as the points are)
    #[arg(long, value_name = "MM", value_parser = positive)]
    pub object_step: Option<f64>,
    /// Folder for points, maps and the report
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

#[derive(Debug, Args)]
pub struct DisplacementArgs {
    /// Optics file (examples/golden-macro.toml), or a microscope's (of `daic calibrate microscope`)
    #[arg(long, value_name = "FILE")]
    pub optics: PathBuf,
    /// Reference frame with both first-order views
    pub reference: PathBuf,
    /// Deformed frame
    pub deformed: PathBuf,
    /// How pixel pairs become points
    #[arg(long, default_value = "ray")]
    pub decoder: DecoderArg,
    /// Frames of a colour sensor as it recorded them: pattern and channel that is used, such as rggb:r
    #[arg(long, value_name = "PATTERN:CHANNEL")]
    pub bayer: Option<daic_rig::experiment::Bayer>,
    /// Under a microscope: how far the matches between the views may lie from where the views' outlines coincide, pixels
    #[arg(long, value_name = "PX", default_value_t = 40.0, value_parser = positive)]
    pub search: f64,
    #[command(flatten)]
    pub dic: DicArgs,
    /// Distance of the nodes in object coordinates (default: as far as the points are)
    #[arg(long, value_name = "MM", value_parser = positive)]
    pub object_step: Option<f64>,
    /// Strain on the measured surface as well: Green–Lagrange in the local tangent plane
    #[arg(long)]
    pub surface_strain: bool,
    /// Points along the side of the strain window, odd
    #[arg(long, value_name = "POINTS", default_value_t = 11, requires = "surface_strain")]
    pub strain_window: u16,
    /// Folder for points, maps and the report
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

#[derive(Debug, Args)]
pub struct TrackArgs {
    /// Reference frame with both first-order views
    pub reference: PathBuf,
    /// Frames with the specimen elsewhere
    #[arg(required = true)]
    pub frames: Vec<PathBuf>,
    /// How far the matches between the views may lie from where the views' outlines coincide, pixels
    #[arg(long, value_name = "PX", default_value_t = 40.0, value_parser = positive)]
    pub search: f64,
    /// Where points may lie in the -1 view: X,Y,WIDTH,HEIGHT in pixels (default: the view found)
    #[arg(long, value_name = "X,Y,W,H", value_parser = parse_roi)]
    pub roi: Option<Roi>,
    /// Frames of a colour sensor as it recorded them: pattern and channel that is used, such as rggb:r
    #[arg(long, value_name = "PATTERN:CHANNEL")]
    pub bayer: Option<daic_rig::experiment::Bayer>,
    #[command(flatten)]
    pub dic: DicArgs,
    /// Also write the table (CSV) that `daic calibrate rig` takes: the frames show a flat speckled plate, pose 0 is the
    /// reference, pose 1 the first frame
    #[arg(long, value_name = "FILE")]
    pub plate: Option<PathBuf>,
    /// Folder for the fields, a CSV file per frame
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

#[derive(Debug, Args)]
pub struct InitArgs {
    /// An experiment under the microscope
    #[arg(long)]
    pub microscope: bool,
    /// File to write
    #[arg(default_value = "experiment.toml")]
    pub file: PathBuf,
    /// Overwrite an existing file
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Args)]
pub struct DoctorArgs {
    /// Also ask the box at this port who it is
    #[arg(long)]
    pub port: Option<String>,
}

/// Three stage coordinates in mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move(pub [f64; 3]);

/// Rectangle in pixels: x, y, width, height.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Roi(pub [i64; 4]);

/// Displacement in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shift(pub [f64; 2]);

/// A number above 0.
pub fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v > 0.0 && v.is_finite() => Ok(v),
        _ => Err(format!("found `{text}`, wanted a number above 0")),
    }
}

pub fn numbers<T: std::str::FromStr, const N: usize>(text: &str, form: &str) -> Result<[T; N], String> {
    let parsed: Option<Vec<T>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    parsed
        .and_then(|values| <[T; N]>::try_from(values).ok())
        .ok_or_else(|| format!("found `{text}`, wanted {N} numbers {form}"))
}

fn parse_move(text: &str) -> Result<Move, String> {
    let values = numbers::<f64, 3>(text, "X,Y,Z in mm, for example 0.050,-0.030,0.200")?;
    within(values, SceneArg::Macro)?;
    Ok(Move(values))
}

/// Refuses moves that take the specimen out of the demo's scene.
fn within(values: [f64; 3], scene: SceneArg) -> Result<(), String> {
    // both views stay on the sensor and the specimen in range within these
    let limits_mm = match scene {
        SceneArg::Macro | SceneArg::Lightfield => [0.5, 0.5, 2.0],
        SceneArg::Microscope => [0.012, 0.012, 0.015],
    };
    for ((value, limit), axis) in values.iter().zip(limits_mm).zip(["X", "Y", "Z"]) {
        // not-a-number is refused too
        if value.is_nan() || value.abs() > limit {
            return Err(format!("{axis} is {value} mm; allowed are -{limit} to {limit} mm"));
        }
    }
    Ok(())
}

impl DemoArgs {
    /// The move, within the limits of the scene.
    pub fn move_mm(&self) -> Result<[f64; 3], String> {
        let default = match self.scene {
            SceneArg::Macro | SceneArg::Lightfield => [0.050, -0.030, 0.200],
            SceneArg::Microscope => [0.004, -0.003, 0.006],
        };
        let given = self.r#move.is_some() || self.no_calibration || self.pitch_factor != 1.0;
        if matches!(self.scene, SceneArg::Lightfield) && given {
            return Err("--move, --no-calibration and --pitch-factor do not belong to --scene lightfield, whose moves are those of a series".to_owned());
        }
        if matches!(self.scene, SceneArg::Microscope) && (self.no_calibration || self.pitch_factor != 1.0) {
            return Err("--no-calibration and --pitch-factor belong to --scene macro: the microscope has nothing to go by but its own moves".to_owned());
        }
        let values = self.r#move.map_or(default, |m| m.0);
        within(values, self.scene)?;
        Ok(values)
    }
}

pub fn parse_roi(text: &str) -> Result<Roi, String> {
    numbers(text, "X,Y,WIDTH,HEIGHT in pixels").map(Roi)
}

fn parse_shift(text: &str) -> Result<Shift, String> {
    let values = numbers(text, "U,V in pixels, for example 12.5,-3")?;
    if values.iter().all(|v: &f64| v.abs() <= 65_536.0) {
        Ok(Shift(values))
    } else {
        Err(format!("found `{text}`, allowed are -65536 to 65536 pixels"))
    }
}

fn parse_seed(text: &str) -> Result<daic_correlate::Seed, String> {
    let seed = |[x, y, u, v]: [f64; 4], gradient| daic_correlate::Seed { x, y, u, v, gradient };
    if text.split(',').count() > 4 {
        let form = "X,Y,U,V,UX,UY,VX,VY: a place, its displacement in pixels and the displacement's gradient";
        let [x, y, u, v, ux, uy, vx, vy] = numbers(text, form)?;
        return Ok(seed([x, y, u, v], Some([ux, uy, vx, vy])));
    }
    numbers(text, "X,Y,U,V: a place and its displacement in pixels").map(|place| seed(place, None))
}
