//! What can go wrong, and the way out.

use std::path::PathBuf;

/// Every error of the facade and the program.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Live matching of a mosaic sensor.
    #[error(
        "live matching takes whole images: take the pixels of one channel out of each frame first (Lattice::of)"
    )]
    LiveMosaic,
    /// An option that the demo's scene does not have.
    #[error("{reason}")]
    DemoOption {
        /// What, and what is allowed.
        reason: String,
    },
    /// An experiment under the microscope, where the macro set-up's optics are wanted.
    #[error(
        "this experiment describes a microscope or a light-field microscope: it has no [optics] (frames of the latter: `daic lightfield reconstruct`)"
    )]
    NoOptics,
    /// The microscope's frames have been measured without a calibration.
    #[error(
        "a microscope is calibrated by its own moves: give frames with role = \"calibration\" (a z move and an in-plane move) and processing.calibrate = true"
    )]
    NoMoves,
    /// The moves of a dataset leave parameters of the microscope open.
    #[error("the calibration frames leave open: {}; add {}", open.join(", "), add.join(" and "))]
    MovesOpen {
        /// Parameters that are not determined.
        open: Vec<&'static str>,
        /// Motions that would determine them.
        add: Vec<&'static str>,
    },
    /// An experiment or optics file.
    #[error(transparent)]
    Config(#[from] daic_rig::experiment::ConfigError),
    /// A frame of another size than the ones before it.
    #[error(
        "the frame has {}×{} pixels, the frames before it {}×{}", found.0, found.1, expected.0, expected.1
    )]
    FrameSize {
        /// Columns and rows.
        found: (usize, usize),
        /// Columns and rows of the first frame.
        expected: (usize, usize),
    },
    /// An image in which no board was found.
    #[error("{}: {source}", path.display())]
    Target {
        /// The image.
        path: PathBuf,
        /// Why.
        source: daic_optics::target::TargetError,
    },
    /// An image that no detector can work on.
    #[error("{}: {source}", path.display())]
    Detector {
        /// The image.
        path: PathBuf,
        /// Why.
        source: daic_optics::GreyError,
    },
    /// Not one image with a board.
    #[error("none of the {images} images shows a board; the first: {reason}")]
    NoBoards {
        /// Images given.
        images: usize,
        /// Why the first does not.
        reason: String,
    },
    /// A camera that the views do not give.
    #[error("the camera cannot be calibrated: {0}")]
    Intrinsics(#[from] daic_optics::intrinsics::CameraError),
    /// A file of a camera that cannot be used.
    #[error("{} is no file of a camera: {reason}", path.display())]
    CameraFile {
        /// The file.
        path: PathBuf,
        /// Line or field, and what is wrong.
        reason: String,
    },
    /// A step of the alignment without an answer.
    #[error("{}: {source}", path.display())]
    Align {
        /// The image.
        path: PathBuf,
        /// Why.
        source: daic_optics::align::AlignError,
    },
    /// A step that needs a number that was not given.
    #[error("this step needs {option}: {meaning}")]
    AlignNeeds {
        /// The flag.
        option: &'static str,
        /// What it says.
        meaning: &'static str,
    },
    /// Optics of a grating set-up for a dataset under the microscope.
    #[error("{} is an optics file, the dataset {} was taken under a microscope and is calibrated by its own moves", optics.display(), root.display())]
    NotForMicroscope {
        /// The optics file.
        optics: PathBuf,
        /// The dataset.
        root: PathBuf,
    },
    /// Two inputs whose results would have the same name.
    #[error("{} and {} would both be written as {}; rename one, or give them folders of their own with --out", first.display(), second.display(), file.display())]
    SameName {
        /// The first.
        first: PathBuf,
        /// The second.
        second: PathBuf,
        /// The result.
        file: PathBuf,
    },
    /// A folder in which no image appeared.
    #[error("{}: no new image came within {seconds} s; let the camera's program write into this folder", folder.display())]
    NoImageCame {
        /// The folder.
        folder: PathBuf,
        /// How long it was watched.
        seconds: f64,
    },
    /// A record of the alignment that cannot be read.
    #[error("{} is no record of an alignment: {reason}", path.display())]
    AlignRecord {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Optics that no set-up can have.
    #[error("the optics cannot be used: {0}")]
    Optics(#[from] daic_optics::OpticsError),
    /// A covariance in an optics file that is none.
    #[error("{}: covariance: {reason}", path.display())]
    OpticsCovariance {
        /// The file.
        path: PathBuf,
        /// What is wrong, with the parameter's name.
        reason: String,
    },
    /// A distortion map that the optics file names and that is not the one meant.
    #[error("{}: maps.{name}: {reason}", path.display())]
    OpticsMap {
        /// The optics file.
        path: PathBuf,
        /// `sensor`, `minus` or `plus`.
        name: &'static str,
        /// What is wrong, and the way out.
        reason: String,
    },
    /// A file of a distortion map that cannot be used.
    #[error("{} is no usable distortion map: {reason}; write it anew with `daic calibrate distortion`", path.display())]
    DistortionFile {
        /// The file.
        path: PathBuf,
        /// What is wrong, with the field's name.
        reason: String,
    },
    /// The −1 and the +1 view taken for each other.
    #[error(
        "the −1 and +1 views are mistaken for each other: the lines of sight of {points} pairs meet on the camera's side of the grating or not at all. The −1 view is the one on the left of the sensor; exchange the pixels of the two views, or turn the images"
    )]
    SwappedOrders {
        /// Pairs of which this is so.
        points: usize,
    },
    /// A step of the grid of object coordinates that gives none, or too large a one.
    #[error(
        "no grid of object coordinates: {nodes} nodes at a step of {step_mm} mm; give --object-step between the distance of the points and a hundredth of it"
    )]
    ObjectGrid {
        /// Distance of nodes.
        step_mm: f64,
        /// How many there would be.
        nodes: f64,
    },
    /// A map that every result has.
    #[error("the results hold no map `{name}`")]
    NoMap {
        /// Its name.
        name: &'static str,
    },
    /// Strain on the surface.
    #[error("the strain on the surface cannot be computed: {0}")]
    SurfaceStrain(#[from] daic_optics::surface::SurfaceError),
    /// The rig could not be calibrated.
    #[error("{}: no calibration of the rig: {source}{}", path.display(), own_numbers(*pose, *point))]
    CalibrateRig {
        /// The table of points.
        path: PathBuf,
        /// Why; its poses and points count from 0 in the order of the table's numbers.
        source: daic_optics::RigError,
        /// The table's own number of the pose to blame, if one is.
        pose: Option<i64>,
        /// The table's own number of the point.
        point: Option<i64>,
    },
    /// The distortion could not be calibrated.
    #[error("no calibration of the distortion: {0}")]
    CalibrateDistortion(#[from] daic_optics::DistortionError),
    /// An image of a line target without usable phases.
    #[error("{}: no phases of a line target: {source}", path.display())]
    TargetPhase {
        /// The image.
        path: PathBuf,
        /// Why.
        source: daic_correlate::phase::PhaseError,
    },
    /// One image, and only one direction of lines in it.
    #[error(
        "{} shows lines in one direction only (their normal at {angle_deg:.1}°, {pitch_px:.2} px apart): a single image must be of a cross grating; of lines give two, along x and along y",
        path.display()
    )]
    OneImageOfLines {
        /// The image.
        path: PathBuf,
        /// Distance of the lines.
        pitch_px: f64,
        /// Angle of their normal against x.
        angle_deg: f64,
    },
    /// Neither one image nor two.
    #[error(
        "{found} images of a target given: give one of a cross grating, or two, of lines along x and of lines along y"
    )]
    TargetImages {
        /// Images given.
        found: usize,
    },
    /// Rays through the grating were asked for without what they need.
    #[error("--ideal ray traces rays through the grating: it needs --optics FILE and --view minus or plus")]
    IdealRay,
    /// A row of a table of tracked points or moves that cannot be used.
    #[error("{}, row {row}: {column} is {value}, it must be {allowed}", path.display())]
    TrackedPoint {
        /// The table.
        path: PathBuf,
        /// Row from 1, without the header.
        row: usize,
        /// Its column.
        column: &'static str,
        /// The value found.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// Neither one grating nor one for each view.
    #[error(
        "the optics state no complete grating: give `grating`, or both `grating_minus` and `grating_plus`"
    )]
    Gratings,
    /// An image file.
    #[error(transparent)]
    Image(#[from] daic_dataset::ImageFileError),
    /// Two images of one pair differ in size.
    #[error("{} has {found_width}×{found_height} pixels, {} has {width}×{height}: both must have the same size", path.display(), other.display())]
    SizesDiffer {
        /// The second image.
        path: PathBuf,
        /// The first image.
        other: PathBuf,
        /// Of the second.
        found_width: u32,
        /// Of the second.
        found_height: u32,
        /// Of the first.
        width: u32,
        /// Of the first.
        height: u32,
    },
    /// A region of interest that the image does not hold.
    #[error(
        "the region of interest {x},{y},{w},{h} does not lie inside the image of {width}×{height} pixels: x + w must be at most {width}, y + h at most {height}"
    )]
    RoiOutside {
        /// Left.
        x: i64,
        /// Top.
        y: i64,
        /// Width.
        w: i64,
        /// Height.
        h: i64,
        /// Of the image.
        width: u32,
        /// Of the image.
        height: u32,
    },
    /// A file of regions that cannot be read as such.
    #[error("{}:{line}: {reason}; a region is a [[region]] table with kind = \"rectangle\", \"circle\", \"ellipse\" or \"polygon\"", path.display())]
    RegionsFile {
        /// The file.
        path: PathBuf,
        /// Line from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// A region that cannot be used.
    #[error("{}: {source}", path.display())]
    Regions {
        /// The file.
        path: PathBuf,
        /// Which field of which region.
        source: daic_correlate::RegionError,
    },
    /// A mask of another size than the images.
    #[error("the mask {} has {found_width}×{found_height} pixels, the images have {width}×{height}: both must have the same size", path.display())]
    MaskSize {
        /// The mask.
        path: PathBuf,
        /// Of the mask.
        found_width: usize,
        /// Of the mask.
        found_height: usize,
        /// Of the images.
        width: usize,
        /// Of the images.
        height: usize,
    },
    /// An image without contrast.
    #[error("{} is blank: every pixel has grey level {level}; there is nothing to correlate", path.display())]
    Blank {
        /// The image.
        path: PathBuf,
        /// Its one grey level.
        level: u16,
    },
    /// A program for the box that cannot be read or is too long.
    #[error("{}: {reason}", path.display())]
    BoxProgram {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A file name whose ending says no known format.
    #[error("{} ends in no format that can be written here: use one of {allowed}", path.display())]
    UnknownFormat {
        /// The file.
        path: PathBuf,
        /// Endings that can be used.
        allowed: &'static str,
    },
    /// A file that is there already.
    #[error("{} exists already; choose another name, or overwrite it with --force", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// A dataset folder.
    #[error(transparent)]
    Dataset(#[from] daic_dataset::DatasetError),
    /// A table.
    #[error(transparent)]
    Table(#[from] daic_dataset::TableError),
    /// A map.
    #[error(transparent)]
    Map(#[from] daic_dataset::MapError),
    /// A file that could not be written.
    #[error(transparent)]
    Write(#[from] daic_dataset::WriteError),
    /// A folder or a pattern without images.
    #[error("{} holds no images: TIFF, PNG and BMP files are looked for", path.display())]
    NoFrameFiles {
        /// The folder or the pattern.
        path: PathBuf,
    },
    /// A pattern that cannot be one.
    #[error("{} is no pattern for file names: {reason}", path.display())]
    Pattern {
        /// The pattern.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// A series of images whose results have no place.
    #[error("{frames} images are correlated with {}: name a folder for the results with --out FOLDER", reference.display())]
    NoFolder {
        /// Images given.
        frames: usize,
        /// The first image.
        reference: PathBuf,
    },
    /// First displacements of a series, which come from the frame before.
    #[error(
        "--guess and --seed belong to two images; each image of a series begins where the one before it ended"
    )]
    SeriesGuess,
    /// A folder with something else in it.
    #[error("{} holds something else than a sequence of daic; choose another folder", path.display())]
    FolderTaken {
        /// The folder.
        path: PathBuf,
    },
    /// Results of a sequence with other settings.
    #[error("{} belongs to another run ({what}); choose another folder, or replace its results with --overwrite", path.display())]
    SequenceDiffers {
        /// The file with the settings.
        path: PathBuf,
        /// What differs.
        what: String,
    },
    /// A frame of an interrupted sequence that is not what it was.
    #[error("the results in {} cannot be continued: frame {frame} ({file}) {reason}; choose another folder, or replace its results with --overwrite", out.display())]
    ResumeFrame {
        /// Number of the frame.
        frame: usize,
        /// Its image when it was measured.
        file: String,
        /// The folder.
        out: PathBuf,
        /// What has changed.
        reason: &'static str,
    },
    /// The state of an interrupted sequence cannot be read.
    #[error("{} is damaged, the sequence cannot be continued; begin anew with --overwrite", path.display())]
    ResumeDamaged {
        /// The file.
        path: PathBuf,
    },
    /// Stopped by the user.
    #[error("interrupted after {done} of {total} frames; the same command goes on where it stopped (results in {})", out.display())]
    Interrupted {
        /// Frames done.
        done: usize,
        /// Frames in all.
        total: usize,
        /// The folder.
        out: PathBuf,
    },
    /// A folder that could not be made.
    #[error("cannot make folder {}: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// An image that the correlation cannot take.
    #[error("the image cannot be correlated: {0}")]
    Grey(#[from] daic_correlate::ImageError),
    /// A correlation setting.
    #[error("the correlation cannot run: {0}")]
    Settings(#[from] daic_correlate::SettingsError),
    /// The points of interest.
    #[error("no points can be laid out: {0}; choose a smaller subset or a larger region")]
    Points(#[from] daic_correlate::PointsError),
    /// The correlation.
    #[error(transparent)]
    Correlate(#[from] daic_correlate::CorrelateError),
    /// A file of points.
    #[error(transparent)]
    ResultFile(#[from] crate::result_file::ResultFileError),
    /// Strain or a probe.
    #[error("the strain cannot be computed: {0}")]
    Strain(#[from] daic_correlate::strain::StrainError),
    /// A polynomial that the virtual strain gauge does not have.
    #[error(
        "the virtual strain gauge fits a plane or a quadratic, not order {order}: use --order plane or --order quadratic, or --method savitzky-golay"
    )]
    VsgOrder {
        /// Order asked for.
        order: u8,
    },
    /// No probe was named.
    #[error(
        "no probe was given: add --point X,Y, --line X0,Y0,X1,Y1 or --extensometer X0,Y0,X1,Y1 (repeatable)"
    )]
    NoProbe,
    /// One frame, where noise needs two.
    #[error("a noise floor needs at least two images, {found} given")]
    TooFewFrames {
        /// Images given.
        found: usize,
    },
    /// Static frames of which one has nothing in common with the first.
    #[error(
        "{}: only {ok} of {points} points could be correlated with the first frame; are these frames of the same, unmoved specimen?", path.display()
    )]
    NotStatic {
        /// The frame.
        path: PathBuf,
        /// Points with a result.
        ok: usize,
        /// Points.
        points: usize,
    },
    /// The phases of a grating.
    #[error("no phases: {0}")]
    Phase(#[from] daic_correlate::phase::PhaseError),
    /// A series of images.
    #[error(transparent)]
    Sequence(#[from] daic_correlate::SequenceError),
    /// The two views.
    #[error("the two first-order views were not found: {0}")]
    Views(#[from] daic_correlate::ViewsError),
    /// A ray that the optics do not have.
    #[error("the optics do not reach the frame: {0}; check distances, pitch and wavelength")]
    Trace(#[from] daic_optics::TraceError),
    /// The calibration.
    #[error("the calibration failed: {0}")]
    Calibrate(#[from] daic_optics::calibrate::CalibrateError),
    /// The calibration of a microscope.
    #[error("the calibration failed: {0}")]
    CalibrateMicroscope(#[from] daic_optics::microscope::calibrate::CalibrateError),
    /// A parameter that no microscope has.
    #[error("microscope: {0}")]
    Microscope(#[from] daic_optics::microscope::MicroscopeError),
    /// A file of motions or of a microscope.
    #[error(transparent)]
    MicroscopeFile(#[from] crate::microscope::MicroscopeFileError),
    /// A light field.
    #[error(transparent)]
    LightField(#[from] crate::lightfield::LightFieldError),
    /// A plan.
    #[error("no plan: {0}")]
    SetUp(#[from] daic_optics::plan::PlanError),
    /// No surface where the datum of heights is.
    #[error(
        "the calibration needs the surface near the optical axis for its height datum: {found} points lie within {radius_mm} mm of it, {needed} are needed; move the specimen or the principal point"
    )]
    NoAxisPoints {
        /// Points there.
        found: usize,
        /// Points needed.
        needed: usize,
        /// How near.
        radius_mm: f64,
    },
    /// A dataset in which nothing can be measured.
    #[error("none of the {frames} frames of {} is paired with its strobe: there is nothing to measure; see frames.jsonl", root.display())]
    NoPairedFrame {
        /// The dataset.
        root: PathBuf,
        /// Frames in it.
        frames: usize,
    },
    /// The plan in a manifest.
    #[error(
        "the plan in dataset.json cannot be read ({reason}); frames of an interrupted recording cannot be told apart without it"
    )]
    Plan {
        /// What is wrong.
        reason: String,
    },
    /// No point came out.
    #[error(
        "no point could be measured ({reasons}): do the optics fit this frame, and do both frames show the same specimen?"
    )]
    NothingMeasured {
        /// How many points failed for which reason.
        reasons: String,
    },
    /// An axis that the experiment does not describe.
    #[error("the experiment has no axis {axis}; describe it under [rig.axes.{axis}]")]
    StageAxis {
        /// Name.
        axis: &'static str,
    },
    /// Travel beyond the limits of the axis, or none.
    #[error(
        "calibrating axis {axis} needs the travel from {:.4} to {:.4} mm, [rig.axes.{axis}] allows {} to {} mm; choose another --travel or --centre",
        needs_mm[0], needs_mm[1], limits_mm[0], limits_mm[1]
    )]
    StageTravel {
        /// Name.
        axis: &'static str,
        /// Lowest and highest position.
        needs_mm: [f64; 2],
        /// Limits of the experiment.
        limits_mm: [f64; 2],
    },
    /// The legs did not begin far enough beyond their first position.
    #[error(
        "the backlash of {backlash_um:.1} µm is more than the {beyond_um:.1} µm that the legs begin beyond their positions; choose a longer --travel"
    )]
    StageTravelTooShort {
        /// Backlash found, perhaps too small.
        backlash_um: f64,
        /// Way before the first position of a leg.
        beyond_um: f64,
    },
    /// Too few frames to tell scale, play and their scatter.
    #[error(
        "only {frames} frames of the stage could be measured, {least} are wanted, counting up and counting down"
    )]
    StageFrames {
        /// Frames measured.
        frames: usize,
        /// Frames wanted.
        least: usize,
    },
    /// The box saw nothing of the camera.
    #[error(
        "no exposure was seen after {triggers} triggers of camera line {line}: is the camera's exposure-active output wired to the box, and does the camera wait for triggers?"
    )]
    NoExposures {
        /// Camera line.
        line: u8,
        /// Triggers given.
        triggers: u32,
    },
    /// No folder of frames.
    #[error(
        "where do frames come from? Give --frames FOLDER, or `source = {{ folder = \"…\" }}` in [rig.camera]; `daic simulate` is for the simulated rig"
    )]
    NoFrames,
    /// A result that should be there is not.
    #[error("{} is missing or damaged; run `daic process --fresh` on the dataset", path.display())]
    NoResult {
        /// The file.
        path: PathBuf,
    },
    /// A stored program that cannot be expanded.
    #[error("the dataset's program cannot be expanded: {0}")]
    Expand(#[from] crate::expand::ExpandError),
    /// The rig.
    #[error(transparent)]
    Rig(#[from] daic_rig::RigError),
    /// The simulated rig.
    #[cfg(feature = "sim")]
    #[error(transparent)]
    Sim(#[from] daic_hil_sim::SimError),
    /// A scene of the simulated rig.
    #[cfg(feature = "sim")]
    #[error(transparent)]
    Scene(#[from] daic_hil_sim::ConfigError),
    /// The frames of a simulated rig were asked for twice.
    #[error("the frames of the simulated rig have been taken already")]
    FramesTaken,
    /// A figure.
    #[error("a figure cannot be drawn: {0}")]
    Report(#[from] daic_report::ReportError),
    /// A file that could not be read.
    #[error("cannot read {}: {source}; check the path and its permissions", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Something that has no form as a file.
    #[error("cannot write {}: {reason}", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// Threads that the system does not give.
    #[error("cannot start {threads} threads: {reason}")]
    Threads {
        /// How many.
        threads: usize,
        /// Why.
        reason: String,
    },
}

impl Error {
    /// Exit code of the program: 2 for input, 3 for the rig, 130 after an interruption.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Interrupted { .. } => 130,
            Self::Rig(error) if !error.is_input() => 3,
            #[cfg(feature = "sim")]
            Self::Sim(daic_hil_sim::SimError::Config(_)) => 2,
            #[cfg(feature = "sim")]
            Self::Sim(_) | Self::FramesTaken => 3,
            _ => 2,
        }
    }

    /// The experiment or optics file that is to blame, with the places in it.
    pub fn config(&self) -> Option<&daic_rig::experiment::ConfigError> {
        match self {
            Self::Config(error) | Self::Rig(daic_rig::RigError::Config(error)) => Some(error),
            _ => None,
        }
    }
}

/// How the numbers of a message that counts from 0 read in the user's table.
fn own_numbers(pose: Option<i64>, point: Option<i64>) -> String {
    match (pose, point) {
        (Some(pose), Some(point)) => format!(" (in the table: pose {pose}, point {point})"),
        (Some(pose), None) => format!(" (in the table: pose {pose})"),
        (None, Some(point)) => format!(" (in the table: point {point})"),
        (None, None) => String::new(),
    }
}
