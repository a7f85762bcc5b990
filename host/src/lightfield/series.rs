//! Volumes from a series of frames: what `daic lightfield reconstruct` does.

use super::error::LightFieldError;
use super::frames::{CellFrame, Corrections, FrameReader};
use super::numbers_file::{self, NumbersError};
use super::output::{self, Format};
use super::psf_file::{self, hash, hash_file};
use super::setup::Setup;
use crate::error::Error;
use crate::progress::Progress;
use daic_dataset::Volume;
use daic_lightfield::{
    Frame, MemoryEstimate, Method, Model, Normal, Operator, OperatorSettings, Psf, ReconstructError,
    Settings, State, Storage, native_widths, reconstruct,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

/// What is to be done.
#[derive(Debug, Clone)]
pub struct Options {
    /// Frames in order (the plus order, with a grating).
    pub frames: Vec<PathBuf>,
    /// Frames of the minus order.
    pub minus: Vec<PathBuf>,
    /// Folder of the results.
    pub out: PathBuf,
    /// Stored point spread function; else `psf.bin` in the folder.
    pub psf: Option<PathBuf>,
    /// Compute the point spread function anew even if the file holds another one.
    pub force_psf: bool,
    /// What frames are corrected with.
    pub corrections: Corrections,
    /// How volumes are reconstructed.
    pub settings: Settings,
    /// Level of the background in every pixel of the camera, part of the model; dark image taken off before.
    pub background: f32,
    /// Cells around the sensor in which light may start too; they are cut off afterwards.
    pub border: usize,
    /// Cells at the edge of the sensor above which no light starts. Where they are as many as the radius of the
    /// point spread function, the sensor catches all light.
    pub inset: usize,
    /// Storage of the operator.
    pub storage: Storage,
    /// Bytes that the operator may take.
    pub memory_limit: Option<u64>,
    /// Frames reconstructed together.
    pub batch: usize,
    /// Kinds of volume files.
    pub formats: Vec<Format>,
    /// Replace results that are there.
    pub overwrite: bool,
    /// Stop after the estimate of the memory.
    pub estimate_only: bool,
}

/// What was done.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// Memory of the operator.
    pub memory: MemoryEstimate,
    /// Bytes at the worst time.
    pub peak_bytes: u64,
    /// Whether the point spread function was there already.
    pub psf_reused: bool,
    /// Share of the light that it holds, plane by plane.
    pub psf_energy: Vec<f64>,
    /// Change of the point spread function when sampled more finely.
    pub psf_sampling_error: f64,
    /// Radius in cells.
    pub psf_radius: usize,
    /// Shape of each volume.
    pub volume: [usize; 3],
    /// Every frame.
    pub frames: Vec<Done>,
    /// Frames whose results were there already.
    pub resumed: usize,
    /// How iterations were computed, in words.
    pub path: String,
}

/// One frame.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Done {
    /// Its name.
    pub name: String,
    /// Iterations.
    pub iterations: usize,
    /// Residuals before each iteration.
    pub residuals: Vec<f64>,
    /// Changes of each iteration.
    pub changes: Vec<f64>,
    /// Files.
    pub files: Vec<PathBuf>,
}

/// What makes results comparable; another one means another run.
#[derive(Serialize)]
struct Key<'a> {
    parameters: &'a daic_lightfield::PsfParameters,
    settings: &'a Settings,
    background: f32,
    border: usize,
    inset: usize,
    psf: String,
    storage: Storage,
    lattice: &'a Option<daic_lightfield::lattice::Lattice>,
    crop: Option<[[usize; 2]; 2]>,
    /// What white, dark and bad-pixel images hold.
    corrections: Vec<Option<String>>,
    mask_saturated: bool,
}

/// Beside a finished volume: what it came from.
#[derive(Serialize, Deserialize)]
struct Finished {
    key: String,
    /// What the frame's files held.
    input: String,
    #[serde(flatten)]
    done: Done,
}

const STATE: &[u8; 8] = b"DAICLFS1";

#[derive(Serialize, Deserialize)]
struct StateHeader {
    key: String,
    input: String,
    iterations: usize,
    residuals: Vec<f64>,
    changes: Vec<f64>,
}

/// Reconstructs every frame. Frames whose results with the same settings are in the folder are not computed
/// again; an interrupted frame goes on where it stopped.
///
/// # Errors
/// Whatever is wrong with setup, frames or folder; nothing is left half-written.
pub fn run(setup: &Setup, options: &Options, progress: &dyn Progress) -> Result<Summary, Error> {
    let parameters = setup.parameters()?;
    let orders = if setup.two_orders() { 2 } else { 1 };
    let (plus, minus) = (options.frames.len(), options.minus.len());
    if (orders == 2) != (minus > 0) || (orders == 2 && plus != minus) {
        return Err(LightFieldError::Orders { plus, minus }.into());
    }
    let first = options.frames.first().ok_or(LightFieldError::Orders { plus, minus })?;
    let reader = FrameReader::new(parameters.pixels, options.corrections.clone())?;
    // a frame that cannot be read is told before anything takes long
    let cells = reader.read(first)?.cells;
    let psf_path = options.psf.clone().unwrap_or_else(|| options.out.join("psf.bin"));
    let (psf, psf_reused) = psf_file::obtain(Some(&psf_path), &parameters, options.force_psf, progress)?;
    if cells.iter().any(|c| *c <= 2 * options.inset) {
        return Err(LightFieldError::Inset { inset: options.inset, cells }.into());
    }
    let inner = cells.map(|c| c - 2 * options.inset);
    let operator_settings = OperatorSettings {
        margin: options.inset as isize - options.border as isize,
        storage: options.storage,
        memory_limit: options.memory_limit,
        ..OperatorSettings::new(inner.map(|c| c + 2 * options.border))
    };
    let memory = Operator::estimate(&psf, &operator_settings).map_err(LightFieldError::from)?;
    let voxels = parameters.voxels;
    let volume = [parameters.planes_um.len(), inner[0] * voxels[0], inner[1] * voxels[1]];
    let mut summary = Summary {
        memory,
        peak_bytes: memory.peak(),
        psf_reused,
        psf_energy: psf.report.energy.clone(),
        psf_sampling_error: psf.report.sampling_error,
        psf_radius: psf.radius,
        volume,
        frames: Vec::new(),
        resumed: 0,
        path: String::new(),
    };
    if options.estimate_only {
        return Ok(summary);
    }
    let corrections = [&options.corrections.white, &options.corrections.dark, &options.corrections.bad]
        .map(|path| path.as_deref().map(hash_file).transpose())
        .into_iter()
        .collect::<Result<_, _>>()?;
    let key = hash(&Key {
        parameters: &parameters,
        settings: &options.settings,
        background: options.background,
        border: options.border,
        inset: options.inset,
        psf: hash_file(&psf_path)?,
        storage: options.storage,
        lattice: &options.corrections.lattice,
        crop: options.corrections.crop,
        corrections,
        mask_saturated: options.corrections.mask_saturated,
    });
    let names = names(&options.frames);
    let mut left = Vec::new();
    let mut inputs = Vec::new();
    for (i, name) in names.iter().enumerate() {
        let files = [options.frames.get(i), options.minus.get(i)].into_iter().flatten();
        let input = files.map(|path| hash_file(path)).collect::<Result<Vec<_>, _>>()?.join(" ");
        let finished = finished(options, name, &key, &input)?;
        inputs.push(input);
        match finished {
            Some(done) => {
                summary.resumed += 1;
                summary.frames.push(done);
            }
            None => left.push(i),
        }
    }
    if left.is_empty() {
        return Ok(summary);
    }
    let mib = memory.peak() >> 20;
    let tiles = memory.tile.map_or(String::new(), |[y, x]| format!(", in tiles of {y} × {x} lenslets"));
    progress.stage(&format!("operator: {mib} MiB{tiles}"), 0);
    let model = model(&psf, &operator_settings, orders, &options.settings)?;
    for batch in left.chunks(options.batch.max(1)) {
        let run = Batch {
            options,
            reader: &reader,
            cells,
            names: &names,
            inputs: &inputs,
            key: &key,
            model: &model,
            psf: &psf,
        };
        let path = run.go(batch, &mut summary, progress)?;
        summary.path = path;
    }
    Ok(summary)
}

/// The operators, with a normal matrix where it will be used.
///
/// # Errors
/// An operator that cannot be built.
pub fn model(
    psf: &Psf,
    settings: &OperatorSettings,
    orders: usize,
    reconstruction: &Settings,
) -> Result<Model, Error> {
    let p = &psf.parameters;
    let [y, x] = p.voxel_um();
    let z = match p.planes_um[..] {
        [a, b, ..] => (b - a).abs(),
        _ => x,
    };
    let operator = Operator::new(psf, settings).map_err(LightFieldError::from)?;
    let catches_all = settings.margin >= psf.radius as isize;
    let wanted = reconstruction.method == Method::Isra && reconstruction.use_normal && catches_all;
    let normal = if wanted { Normal::new(psf, settings.cells, settings.storage, orders) } else { None };
    Ok(Model { operator, orders, normal, voxel_um: [z, y, x], widths: native_widths(p) })
}

struct Batch<'a> {
    options: &'a Options,
    reader: &'a FrameReader,
    cells: [usize; 2],
    names: &'a [String],
    /// What the files of each frame hold.
    inputs: &'a [String],
    key: &'a str,
    model: &'a Model,
    psf: &'a Psf,
}

impl Batch<'_> {
    fn read(&self, path: &Path) -> Result<CellFrame, Error> {
        let frame = self.reader.read(path)?;
        if frame.cells != self.cells {
            let [ny, nx] = self.psf.parameters.pixels;
            return Err(LightFieldError::Size {
                path: path.to_owned(),
                found_width: frame.cells[1] * nx,
                found_height: frame.cells[0] * ny,
                width: self.cells[1] * nx,
                height: self.cells[0] * ny,
            }
            .into());
        }
        Ok(frame)
    }

    fn go(&self, batch: &[usize], summary: &mut Summary, progress: &dyn Progress) -> Result<String, Error> {
        let mut images: Vec<Vec<CellFrame>> = Vec::new();
        for &i in batch {
            let mut list = vec![self.read(&self.options.frames[i])?];
            if let Some(path) = self.options.minus.get(i) {
                list.push(self.read(path)?);
            }
            images.push(list);
        }
        let ones: Vec<f32> = vec![1.0; images[0][0].values.len()];
        let level: Vec<f32> = vec![self.options.background * self.reader.area(); ones.len()];
        let frames: Vec<Frame<'_>> = images
            .iter()
            .map(|list| Frame {
                images: list.iter().map(|f| f.values.as_slice()).collect(),
                weights: list
                    .iter()
                    .any(|f| f.weights.is_some())
                    .then(|| list.iter().map(|f| f.weights.as_deref().unwrap_or(&ones)).collect()),
                background: (self.options.background > 0.0).then(|| vec![level.as_slice(); list.len()]),
            })
            .collect();
        let (states, before) = self.states(batch)?;
        let title = batch.iter().map(|&i| self.names[i].as_str()).collect::<Vec<_>>().join(", ");
        progress.stage(&title, self.options.settings.iterations as u64);
        let stop = progress.stop_requested();
        let (done, path) =
            reconstruct(self.model, &frames, &self.options.settings, states.as_deref(), &mut |step| {
                progress.advance(step.done as u64);
                !stop.load(Ordering::Relaxed)
            })
            .map_err(|source| self.named(batch, source))?;
        let interrupted = stop.load(Ordering::Relaxed);
        for (k, (&i, r)) in batch.iter().zip(done).enumerate() {
            let (mut residuals, mut changes) = before.get(k).cloned().unwrap_or_default();
            residuals.extend(&r.residuals);
            changes.extend(&r.changes);
            if interrupted && r.state.iterations < self.options.settings.iterations {
                self.save_state(i, &r.state, residuals, changes)?;
                continue;
            }
            summary.frames.push(self.write(i, r.state, residuals, changes)?);
        }
        if interrupted {
            let (finished, total) = (summary.frames.len(), self.options.frames.len());
            return Err(Error::Interrupted { done: finished, total, out: self.options.out.clone() });
        }
        Ok(match path {
            daic_lightfield::Path::Normal => "one product with the stored normal matrix".to_owned(),
            daic_lightfield::Path::TwoPasses { reason: None } => "projection and back-projection".to_owned(),
            daic_lightfield::Path::TwoPasses { reason: Some(why) } => {
                format!("projection and back-projection; not the normal matrix: {why}")
            }
        })
    }

    fn named(&self, batch: &[usize], source: ReconstructError) -> Error {
        let name = batch.iter().map(|&i| self.names[i].as_str()).collect::<Vec<_>>().join(", ");
        LightFieldError::Reconstruct { name, source }.into()
    }

    fn state_path(&self, i: usize) -> PathBuf {
        self.options.out.join(format!("{}.state", self.names[i]))
    }

    fn save_state(
        &self,
        i: usize,
        state: &State,
        residuals: Vec<f64>,
        changes: Vec<f64>,
    ) -> Result<(), Error> {
        let (key, input) = (self.key.to_owned(), self.inputs[i].clone());
        let header = StateHeader { key, input, iterations: state.iterations, residuals, changes };
        let mut arrays = vec![state.volume.as_slice()];
        if let Some([a, b]) = &state.momentum {
            arrays.extend([a.as_slice(), b.as_slice()]);
        }
        numbers_file::write(&self.state_path(i), STATE, &header, &arrays)
    }

    /// States to go on from, if all frames of the batch have one; and their curves so far.
    #[allow(clippy::type_complexity)] // two lists, told apart where they are used
    fn states(&self, batch: &[usize]) -> Result<(Option<Vec<State>>, Vec<(Vec<f64>, Vec<f64>)>), Error> {
        let mut states = Vec::new();
        let mut curves = Vec::new();
        for &i in batch {
            let path = self.state_path(i);
            if self.options.overwrite || !path.exists() {
                return Ok((None, Vec::new()));
            }
            let bad = |reason: String| LightFieldError::State { path: path.clone(), reason };
            let (header, arrays): (StateHeader, _) =
                numbers_file::read(&path, STATE).map_err(|e| match e {
                    NumbersError::Read(e) => bad(e.to_string()),
                    NumbersError::Damaged(e) => bad(e),
                })?;
            if header.key != self.key {
                return Err(bad("it belongs to a run with other settings".to_owned()).into());
            }
            if header.input != self.inputs[i] {
                return Err(bad(CHANGED.to_owned()).into());
            }
            let mut arrays = arrays.into_iter();
            let volume = arrays.next().unwrap_or_default();
            let momentum = match (arrays.next(), arrays.next()) {
                (Some(a), Some(b)) => Some([a, b]),
                _ => None,
            };
            states.push(State { iterations: header.iterations, volume, momentum });
            curves.push((header.residuals, header.changes));
        }
        // frames of a batch stop together
        if states.windows(2).any(|w| w[0].iterations != w[1].iterations) {
            return Ok((None, Vec::new()));
        }
        Ok((Some(states), curves))
    }

    fn write(&self, i: usize, state: State, residuals: Vec<f64>, changes: Vec<f64>) -> Result<Done, Error> {
        let (name, out) = (&self.names[i], &self.options.out);
        let p = &self.psf.parameters;
        let inner = self.cells.map(|c| c - 2 * self.options.inset);
        let shape = [p.planes_um.len(), inner[0] * p.voxels[0], inner[1] * p.voxels[1]];
        let values = without_border(&state.volume, shape, p.voxels.map(|v| v * self.options.border));
        let volume = Volume {
            shape,
            values: &values,
            voxel_um: self.model.voxel_um,
            first_um: p.planes_um.first().copied().unwrap_or(0.0),
        };
        let mut files = output::write(out, name, &volume, &self.options.formats)?;
        let page = out.join(format!("{name}.html"));
        let provenance = vec![
            ("frame".to_owned(), self.options.frames[i].display().to_string()),
            ("program".to_owned(), format!("daic {}", env!("CARGO_PKG_VERSION"))),
            ("settings".to_owned(), format!("{:?}", self.options.settings)),
            ("point spread function".to_owned(), hash(p)),
        ];
        let curves = [("residual", residuals.as_slice()), ("change", changes.as_slice())];
        output::write_report(&page, name, &volume, &curves, provenance)?;
        files.push(page);
        let done = Done { name: name.clone(), iterations: state.iterations, residuals, changes, files };
        let (key, input) = (self.key.to_owned(), self.inputs[i].clone());
        let finished = Finished { key, input, done: done.clone() };
        let path = out.join(format!("{name}.json"));
        let json = serde_json::to_vec_pretty(&finished)
            .map_err(|e| Error::Unwritable { path: path.clone(), reason: e.to_string() })?;
        daic_dataset::atomic::write_bytes(&path, &json)?;
        std::fs::remove_file(self.state_path(i)).ok();
        Ok(done)
    }
}

/// The inner part of a volume.
fn without_border(values: &[f32], [nz, ny, nx]: [usize; 3], [by, bx]: [usize; 2]) -> Vec<f32> {
    let (height, width) = (ny + 2 * by, nx + 2 * bx);
    let mut out = Vec::with_capacity(nz * ny * nx);
    for z in 0..nz {
        for y in 0..ny {
            let from = (z * height + y + by) * width + bx;
            out.extend_from_slice(&values[from..from + nx]);
        }
    }
    out
}

/// Names of the results: those of the files, told apart where they are equal.
fn names(frames: &[PathBuf]) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    for path in frames {
        let stem = path.file_stem().map_or_else(|| "frame".to_owned(), |s| s.to_string_lossy().into_owned());
        let mut name = stem.clone();
        let mut k = 2;
        while out.contains(&name) {
            name = format!("{stem}-{k}");
            k += 1;
        }
        out.push(name);
    }
    out
}

const CHANGED: &str = "the frame has changed since";

/// Results that are there, in all formats that are asked for, and belong to this run.
fn finished(options: &Options, name: &str, key: &str, input: &str) -> Result<Option<Done>, Error> {
    let path = options.out.join(format!("{name}.json"));
    if options.overwrite || !path.exists() {
        return Ok(None);
    }
    let text = std::fs::read(&path).map_err(|source| Error::Read { path: path.clone(), source })?;
    let bad = |reason: String| LightFieldError::State { path: path.clone(), reason };
    let found: Finished = serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))?;
    if found.key != key {
        return Err(bad("it was made with other settings".to_owned()).into());
    }
    if found.input != input {
        return Err(bad(CHANGED.to_owned()).into());
    }
    let stacks = options.formats.iter().map(|f| output::stack_path(&options.out, name, *f));
    let whole = found.done.files.iter().cloned().chain(stacks).all(|p| p.exists());
    Ok(whole.then_some(found.done))
}
