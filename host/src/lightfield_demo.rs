//! The light-field microscope against the simulated rig: beads that are moved come back where they were moved to.

use crate::demo::record;
use crate::error::Error;
use crate::lightfield::frames::Corrections;
use crate::lightfield::output::Format;
use crate::lightfield::series::{self, Options};
use crate::lightfield::setup::Setup;
use crate::lightfield::{LightFieldError, calibration, spots};
use crate::process::{Check, FrameCounts, check_table, edge_error};
use crate::progress::Progress;
use crate::simulated;
use daic_dataset::{Dataset, Existing, FrameRecord, Verdict, atomic, read_stack};
use daic_hil_sim::config::LightFieldConfig;
use daic_lightfield::lattice::Lattice;
use daic_lightfield::{Method, Settings, Storage};
use daic_report::{Cell, Report, Section, TableBlock};
use daic_rig::experiment::{self, Experiment};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Kind of the datasets: one may replace another.
const KIND: &str = "lightfield-demo";
/// Found pitch of the lenslets against the simulated one.
const PITCH_LIMIT: f64 = 1e-3;
/// Found bead against the commanded place, RMS over beads and frames: across, along z. Voxels are 2.5 µm wide and
/// high.
const LATERAL_LIMIT_UM: f64 = 0.5;
const DEPTH_LIMIT_UM: f64 = 1.0;
/// Iterations of Richardson–Lucy.
const ITERATIONS: usize = 20;

/// A bead in a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BeadResult {
    /// The frame.
    pub frame: String,
    /// Where the bead was: x right, y down, z away from the objective, from the axis.
    pub true_um: [f64; 3],
    /// Where it was found; none if it was not.
    pub found_um: Option<[f64; 3]>,
}

/// `summary.json` of the demo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LightFieldSummary {
    /// Version of the program.
    pub daic: String,
    /// Seed of the noise.
    pub seed: u64,
    /// Frames by verdict.
    pub frames: FrameCounts,
    /// Found pitch of the lenslets, x and y.
    pub pitch_px: [f64; 2],
    /// Every bead in every frame.
    pub beads: Vec<BeadResult>,
    /// Found minus true, RMS over all beads.
    pub rms_um: [f64; 3],
    /// What was checked.
    pub checks: Vec<Check>,
    /// Whether every check held.
    pub passed: bool,
    /// Wall time.
    pub wall_s: Option<f64>,
}

/// Runs the demo; dataset, volumes (`results/lightfield`), `summary.json` and `report.html` are in `out` afterwards.
///
/// # Errors
/// Whatever keeps the chain from running to its end; a check that fails is no error.
pub fn run(out: &Path, seed: u64, progress: &dyn Progress) -> Result<LightFieldSummary, Error> {
    let begin = Instant::now();
    let mut experiment =
        Experiment::parse(experiment::lightfield_template(), Path::new("the built-in template"))?;
    experiment.seed = seed;
    let config = simulated::lightfield(&experiment);
    let truth = config.scene.lightfield.clone().unwrap_or_default();
    let (dataset, frames) = record(&experiment, config, out, Existing::ReplaceKind(KIND), progress)?;
    let records: Vec<FrameRecord> =
        dataset.frames()?.records.into_iter().filter(|r| r.verdict == Verdict::Paired).collect();
    let file = |r: &FrameRecord| r.file.as_ref().map(|f| dataset.root().join(f));
    let named = |name: &str| {
        let found = records.iter().find(|r| r.name == name).and_then(&file);
        found.ok_or(Error::NoPairedFrame { root: out.to_owned(), frames: records.len() })
    };
    let (white, dark) = (named("white")?, named("dark")?);
    let folder = dataset.results().join("lightfield");
    let (lattice, image) = calibration::calibrate(&white, Some(&dark))?;
    calibration::write(&folder.join("lattice.toml"), &lattice)?;
    calibration::write_overlay(&folder.join("overlay.svg"), &lattice, &image)?;
    let setup_path = dataset.root().join("microscope.toml");
    atomic::write_bytes(&setup_path, include_bytes!("lightfield/demo.toml"))?;
    let setup = Setup::load(&setup_path)?;
    let moved: Vec<&FrameRecord> =
        records.iter().filter(|r| r.role == daic_dataset::FrameRole::Measurement).collect();
    let options = options(moved.iter().copied().filter_map(&file).collect(), &folder, &lattice, white, dark);
    let done = series::run(&setup, &options, progress)?;
    let mut beads = Vec::new();
    for (record, result) in moved.iter().zip(&done.frames) {
        let stack = result.files.first().cloned().unwrap_or_default();
        let (values, shape) = read_stack(&stack)
            .map_err(|e| LightFieldError::Stack { path: stack.clone(), reason: e.to_string() })?;
        let found = places(&values, shape, &setup, &lattice, &truth)?;
        beads.extend(compared(record, &found, &truth));
    }
    let summary = LightFieldSummary {
        daic: env!("CARGO_PKG_VERSION").to_owned(),
        seed,
        frames,
        pitch_px: lattice.pitch_px.map(|p| p.value),
        rms_um: rms(&beads),
        beads,
        checks: Vec::new(),
        passed: false,
        wall_s: None,
    };
    let checks = checks(&summary, &truth, edge_error(&dataset)?.0);
    let passed = checks.iter().all(|c| c.passed);
    let summary =
        LightFieldSummary { checks, passed, wall_s: Some(begin.elapsed().as_secs_f64()), ..summary };
    dataset.write_summary(&summary)?;
    write_report(&dataset, &summary, &done.frames)?;
    Ok(summary)
}

fn options(frames: Vec<PathBuf>, folder: &Path, lattice: &Lattice, white: PathBuf, dark: PathBuf) -> Options {
    Options {
        batch: frames.len(),
        frames,
        minus: Vec::new(),
        out: folder.to_owned(),
        psf: None,
        force_psf: false,
        corrections: Corrections {
            lattice: Some(lattice.clone()),
            white: Some(white),
            dark: Some(dark),
            ..Corrections::default()
        },
        settings: Settings { clip_negative: true, ..Settings::new(Method::Rl, ITERATIONS) },
        background: 0.0,
        border: 0,
        inset: 0,
        storage: Storage::F32,
        memory_limit: None,
        formats: vec![Format::Tiff],
        overwrite: true,
        estimate_only: false,
    }
}

/// Beads of a volume in micrometres from the axis of the simulated rig, along the sensor.
fn places(
    values: &[f32],
    shape: [usize; 3],
    setup: &Setup,
    lattice: &Lattice,
    truth: &LightFieldConfig,
) -> Result<Vec<[f64; 3]>, Error> {
    let p = setup.parameters()?;
    let [first_u, first_v] = lattice.whole_cells().map(|r| r[0] as f64);
    let pixel_um = p.lenslets.pitch_um
        / p.objective.magnification
        / (lattice.pitch_px[0].value * lattice.pitch_px[1].value).sqrt();
    let step = p.planes_um.get(1).zip(p.planes_um.first()).map_or(0.0, |(b, a)| b - a);
    let start = p.planes_um.first().copied().unwrap_or(0.0);
    // beads lie 25 µm apart at least: 10 voxels
    Ok(spots::find(values, shape, 0.15, 5.0)
        .into_iter()
        .map(|spot| {
            let [z, y, x] = spot.place;
            let cell = |v: f64, first: f64, n: usize| first - 0.5 + (v + 0.5) / n as f64;
            let [px, py] = lattice.at(cell(x, first_u, p.voxels[1]), cell(y, first_v, p.voxels[0]));
            [(px - truth.centre_px[0]) * pixel_um, (py - truth.centre_px[1]) * pixel_um, start + z * step]
        })
        .collect())
}

/// Every simulated bead with the nearest one that was found.
fn compared(record: &FrameRecord, found: &[[f64; 3]], truth: &LightFieldConfig) -> Vec<BeadResult> {
    let [sx, sy, sz] = record.commanded_um.unwrap_or_default();
    let distance = |a: &[f64; 3], b: &[f64; 3]| (a[0] - b[0]).hypot(a[1] - b[1]);
    truth
        .beads
        .iter()
        .map(|bead| {
            let [x, y, z] = bead.centre_um;
            // the stage's z points towards the objective
            let true_um = [x + sx, y + sy, z - sz];
            let nearest = found
                .iter()
                .min_by(|a, b| distance(a, &true_um).total_cmp(&distance(b, &true_um)))
                .filter(|f| distance(f, &true_um) < 5.0);
            BeadResult { frame: record.name.clone(), true_um, found_um: nearest.copied() }
        })
        .collect()
}

fn rms(beads: &[BeadResult]) -> [f64; 3] {
    let pairs: Vec<_> = beads.iter().filter_map(|b| Some((b.true_um, b.found_um?))).collect();
    [0, 1, 2].map(|k| {
        let sum: f64 = pairs.iter().map(|(t, f)| (f[k] - t[k]).powi(2)).sum();
        (sum / pairs.len() as f64).sqrt()
    })
}

fn checks(summary: &LightFieldSummary, truth: &LightFieldConfig, edges: Option<u64>) -> Vec<Check> {
    let f = &summary.frames;
    let lost = summary.beads.iter().filter(|b| b.found_um.is_none()).count();
    let pitch = summary.pitch_px.map(|p| (p / truth.pitch_px - 1.0).abs()).into_iter().fold(0.0, f64::max);
    let [x, y, z] = summary.rms_um;
    let mut checks = vec![
        Check {
            name: "frames paired with their strobes".to_owned(),
            found: format!("{} of {}", f.paired, f.paired + f.missing),
            limit: "all, none extra or ambiguous".to_owned(),
            passed: f.paired > 0 && f.missing + f.extra + f.ambiguous == 0,
        },
        Check {
            name: "edges as the program says".to_owned(),
            found: edges.map_or_else(|| "other words were played".to_owned(), |t| format!("{t} ticks off")),
            limit: "0 ticks".to_owned(),
            passed: edges == Some(0),
        },
        Check {
            name: "pitch of the lenslets from the white frame".to_owned(),
            found: format!("{:.4} % off", 100.0 * pitch),
            limit: format!("{} %", 100.0 * PITCH_LIMIT),
            passed: pitch <= PITCH_LIMIT,
        },
        Check {
            name: "beads found".to_owned(),
            found: format!("{} of {}", summary.beads.len() - lost, summary.beads.len()),
            limit: "all".to_owned(),
            passed: lost == 0 && !summary.beads.is_empty(),
        },
    ];
    for (axis, value, limit) in
        [("x", x, LATERAL_LIMIT_UM), ("y", y, LATERAL_LIMIT_UM), ("z", z, DEPTH_LIMIT_UM)]
    {
        checks.push(Check {
            name: format!("beads, RMS of found minus true {axis}"),
            found: format!("{value:.3} µm"),
            limit: format!("{limit} µm"),
            passed: value <= limit,
        });
    }
    checks
}

fn write_report(
    dataset: &Dataset,
    summary: &LightFieldSummary,
    frames: &[series::Done],
) -> Result<(), Error> {
    let um = |v: f64| Cell::Number(format!("{v:.2}"));
    let rows = summary
        .beads
        .iter()
        .map(|b| {
            let found = b.found_um.unwrap_or([f64::NAN; 3]);
            let mut row = vec![Cell::Text(b.frame.clone())];
            row.extend(b.true_um.iter().chain(&found).map(|v| um(*v)));
            row
        })
        .collect();
    let head = ["frame", "true x", "y", "z", "found x", "y", "z"].map(str::to_owned).to_vec();
    let table = TableBlock { caption: "Beads, µm from the axis".to_owned(), head, rows };
    let pages = frames
        .iter()
        .map(|f| format!("{}: results/lightfield/{0}.html", f.name))
        .collect::<Vec<_>>()
        .join("; ");
    let report = Report {
        title: "Light field: beads under the simulated microscope".to_owned(),
        subtitle: String::new(),
        verdict: None,
        sections: vec![
            Section {
                title: "Checks".to_owned(),
                tables: vec![check_table(&summary.checks)],
                ..Section::default()
            },
            Section {
                title: "Beads".to_owned(),
                text: vec![
                    "The simulated camera sees beads through twice as many pixels and voxels as the \
                     reconstruction has, on a lattice that is turned and no whole number of pixels wide. The lattice \
                     is found in the white frame, frames are rectified and reconstructed, beads are centroids."
                        .to_owned(),
                    format!("Volumes: {pages}"),
                ],
                tables: vec![table],
                ..Section::default()
            },
        ],
        provenance: vec![
            ("program".to_owned(), format!("daic {}", summary.daic)),
            ("seed".to_owned(), summary.seed.to_string()),
        ],
    };
    Ok(atomic::write_bytes(&dataset.report_path(), report.render()?.as_bytes())?)
}
