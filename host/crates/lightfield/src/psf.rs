//! The point spread function: the light of every voxel of a cell in every pixel around.

use crate::debye::{DebyeTable, RadialField, pupil_field};
use crate::error::PsfError;
use crate::lenslets::transmission;
use crate::optics::{DiffractionModel, Order, Oversampling, Packing, PsfParameters, Radius, VoxelKernel};
use crate::propagate::{Buffers, Propagator, each};
use rustfft::num_complex::Complex64;
use serde::{Deserialize, Serialize};

/// Largest number of pixels or voxels of a cell and side.
const MOST: usize = 512;
/// Largest window of a field, samples: 1 GiB of complex numbers.
const MOST_SAMPLES: usize = 1 << 26;

/// What was found while the point spread function was computed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PsfReport {
    /// Field samples per pixel and side.
    pub samples: usize,
    /// Distance of samples, µm in the lenslet plane.
    pub dx_um: f64,
    /// Relative change (L2) of the self-test with 1.8 times finer samples.
    pub sampling_error: f64,
    /// Absolute error of the Debye integral (its value on the axis is about α²/2).
    pub quadrature_error: f64,
    /// Radius of each plane, in cells.
    pub plane_radius: Vec<usize>,
    /// Share of the objective's light within the radius, for each plane, least over the voxels.
    pub energy: Vec<f64>,
    /// Share of the pupil that is evanescent behind the grating (pupil model).
    pub evanescent: f64,
}

/// Light of each voxel of a cell in the pixels of the cells around.
///
/// `values[((((z·Sy + sy)·Sx + sx)·D + dy)·D + dx)·Ny·Nx + ny·Nx + nx]`, D = 2 `radius` + 1: share of the
/// light that the objective (and the grating) sends from voxel (z, sy, sx) of cell l to the image plane and
/// that reaches pixel (ny, nx) of cell l + (dy − radius, dx − radius). Nothing is rescaled: the sum over all
/// pixels is below 1 by what falls outside the radius and by what opaque parts between lenslets take.
///
/// The centre of a cell, where a lenslet has its centre, is the origin: voxel s lies at
/// ((s + ½)/S − ½) · cell/M, pixel n at ((n + ½)/N − ½) · cell.
#[derive(Debug, Clone, PartialEq)]
pub struct Psf {
    /// What it was computed from.
    pub parameters: PsfParameters,
    /// What was found on the way.
    pub report: PsfReport,
    /// Extent in cells.
    pub radius: usize,
    /// Values as above.
    pub values: Vec<f32>,
}

/// The shape of a [`Psf`]'s values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PsfShape {
    /// Planes.
    pub planes: usize,
    /// Voxels (y, x) of a cell.
    pub voxels: [usize; 2],
    /// Radius in cells.
    pub radius: usize,
    /// Pixels (y, x) of a cell.
    pub pixels: [usize; 2],
}

impl PsfShape {
    /// Cells along a side of the point spread function.
    pub fn side(&self) -> usize {
        2 * self.radius + 1
    }

    /// Number of values.
    pub fn len(&self) -> usize {
        self.planes * self.voxels[0] * self.voxels[1] * self.side().pow(2) * self.pixels[0] * self.pixels[1]
    }

    /// Whether there is nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Values of one voxel.
    pub(crate) fn voxel(&self) -> usize {
        self.side().pow(2) * self.pixels[0] * self.pixels[1]
    }
}

/// A window of fields: how it is sampled, and the lenslets on it.
struct Window {
    samples: [usize; 2],
    over: usize,
    radius: usize,
    guard: usize,
    /// Sample distance (y, x) in the lenslet plane.
    spacing: [f64; 2],
    lenslets: Vec<Complex64>,
    propagator: Propagator,
}

impl Window {
    fn new(p: &PsfParameters, over: usize, radius: usize) -> Result<Self, PsfError> {
        let cell = p.lenslets.cell_um();
        let samples = p.pixels.map(|n| n * over);
        let cells = 2 * (radius + p.guard) + 1;
        let size = samples.map(|n| n * cells);
        if size[0].saturating_mul(size[1]) > MOST_SAMPLES {
            return Err(PsfError::Memory {
                what: "a field",
                needed_mib: (size[0].saturating_mul(size[1]) / (1 << 16)) as u64,
                limit_mib: (MOST_SAMPLES / (1 << 16)) as u64,
            });
        }
        let spacing = [cell[0] / samples[0] as f64, cell[1] / samples[1] as f64];
        let wavelength = p.objective.wavelength_um;
        Ok(Self {
            samples,
            over,
            radius,
            guard: p.guard,
            spacing,
            lenslets: transmission(&p.lenslets, wavelength, samples),
            propagator: Propagator::new(size, spacing, wavelength, p.lenslets.gap_um, p.propagation),
        })
    }

    fn cells(&self) -> usize {
        2 * (self.radius + self.guard) + 1
    }

    /// Positions of the samples along an axis in the lenslet plane.
    fn positions(&self, axis: usize) -> Vec<f64> {
        let n = self.samples[axis];
        let first = -(((self.radius + self.guard) * n) as f64) - 0.5 * (n as f64 - 1.0);
        (0..n * self.cells()).map(|i| (first + i as f64) * self.spacing[axis]).collect()
    }

    /// Light in the pixels within the radius, `[dy][dx][ny][nx]`, of the field in front of the lenslets that the
    /// buffers hold.
    fn pixels(&self, buffers: &mut Buffers) -> Vec<f64> {
        let [sy, sx] = self.samples;
        let width = sx * self.cells();
        for (y, row) in buffers.field.chunks_exact_mut(width).enumerate() {
            let lens = &self.lenslets[(y % sy) * sx..][..sx];
            for part in row.chunks_exact_mut(sx) {
                for (v, l) in part.iter_mut().zip(lens) {
                    *v *= l;
                }
            }
        }
        let keep = self.guard * sx..(self.guard + 2 * self.radius + 1) * sx;
        let side = 2 * self.radius + 1;
        let [ny, nx] = [sy / self.over, sx / self.over];
        let mut out = vec![0.0; side * side * ny * nx];
        let area = self.spacing[0] * self.spacing[1];
        self.propagator.propagate(buffers, keep, |x, column| {
            let (dx, px) = (x / sx, x % sx / self.over);
            let rows = column[self.guard * sy..][..side * sy].chunks_exact(self.over);
            for (row, samples) in rows.enumerate() {
                let (dy, py) = (row / ny, row % ny);
                let light: f64 = samples.iter().map(Complex64::norm_sqr).sum();
                out[((dy * side + dx) * ny + py) * nx + px] += light * area;
            }
        });
        out
    }
}

/// Fields of points in the image plane.
enum Source<'a> {
    /// Rotationally symmetric about the (virtual) point, which is shifted along x by so many µm.
    Radial { field: &'a RadialField, shift: f64 },
    /// A pupil seen through a grating.
    Pupil { q: f64, depth: f64 },
}

/// Field of a plane, and where the window of each sub-point begins on it.
struct Plane {
    field: Vec<Complex64>,
    width: usize,
    shifts: [Vec<usize>; 2],
}

/// Sub-points of a voxel plane: the weights take care of the rest.
struct Points<'a> {
    p: &'a PsfParameters,
    tables: DebyeTable,
    shifts: Vec<f64>,
    /// Signed q of the pupil model.
    q: Option<f64>,
}

impl<'a> Points<'a> {
    fn new(p: &'a PsfParameters, radius: usize) -> Result<Self, PsfError> {
        let (mut depths, mut shifts, mut q) = (Vec::new(), Vec::new(), None);
        for z in p.planes_um.iter().map(|&z| p.depth.away(z)) {
            let (mut depth, mut shift) = (z, 0.0);
            if let Some(grating) = &p.grating {
                let sine = grating.sine(&p.objective);
                let cosine = (1.0 - sine * sine).sqrt();
                let sign = if grating.order == Order::Plus { -1.0 } else { 1.0 };
                match grating.model {
                    DiffractionModel::Virtual => {
                        depth = z / cosine.powi(3);
                        shift = sign * z * sine / cosine;
                    }
                    DiffractionModel::Pupil => q = Some(sign * sine * p.objective.index),
                }
            }
            depths.push(depth);
            shifts.push(shift);
        }
        let cell = p.lenslets.cell_um();
        let half = (radius + p.guard) as f64 + 1.0;
        let far = shifts.iter().fold(0.0f64, |a, s| a.max(s.abs()));
        let reach = (half * cell[0] / p.objective.magnification)
            .hypot(half * cell[1] / p.objective.magnification + far);
        // the pupil model needs no table
        let tables = if q.is_some() {
            DebyeTable { planes: Vec::new(), error: 0.0 }
        } else {
            DebyeTable::new(&p.objective, reach, &depths)?
        };
        Ok(Self { p, tables, shifts, q })
    }

    fn source(&self, z: usize) -> Source<'_> {
        match (self.q, self.tables.planes.get(z)) {
            (None, Some(field)) => Source::Radial { field, shift: self.shifts[z] },
            (q, _) => Source::Pupil { q: q.unwrap_or(0.0), depth: self.p.depth.away(self.p.planes_um[z]) },
        }
    }

    /// Where sub-point `i` of `n` voxels' worth of sub-points along an axis is, in the object.
    fn position(&self, axis: usize, i: usize) -> f64 {
        let n = (self.p.voxels[axis] * self.p.kernel.points()) as f64;
        ((i as f64 + 0.5) / n - 0.5) * self.p.lenslets.cell_um()[axis] / self.p.objective.magnification
    }

    /// The field of a plane seen through a pupil, on a grid that holds the windows of all sub-points; none
    /// where sub-points do not lie on the samples, or the field is radial.
    fn pupil_plane(&self, window: &Window, z: usize, fine: [usize; 2]) -> Result<Option<Plane>, PsfError> {
        let Source::Pupil { q, depth } = self.source(z) else { return Ok(None) };
        let m = self.p.objective.magnification;
        let mut axes: [Vec<f64>; 2] = [Vec::new(), Vec::new()];
        let mut shifts: [Vec<usize>; 2] = [Vec::new(), Vec::new()];
        for axis in 0..2 {
            let step = window.spacing[axis] / m;
            let last = self.position(axis, fine[axis] - 1);
            for i in 0..fine[axis] {
                let shift = (last - self.position(axis, i)) / step;
                if (shift - shift.round()).abs() > 1e-6 {
                    return Ok(None);
                }
                shifts[axis].push(shift.round() as usize);
            }
            let at = window.positions(axis);
            let first = at.first().copied().unwrap_or(0.0) / m - last;
            let count = at.len() + shifts[axis].first().copied().unwrap_or(0);
            axes[axis] = (0..count).map(|i| first + i as f64 * step).collect();
        }
        let field = pupil_field(&self.p.objective, q, depth, &axes[1], &axes[0])?.0;
        Ok(Some(Plane { field, width: axes[1].len(), shifts }))
    }

    /// Light of a sub-point of a plane of [`Points::pupil_plane`].
    fn light_of(window: &Window, plane: &Plane, at: [usize; 2], buffers: &mut Buffers) -> Vec<f64> {
        let [height, width] = [0, 1].map(|a| window.samples[a] * window.cells());
        let (y0, x0) = (plane.shifts[0][at[0]], plane.shifts[1][at[1]]);
        buffers.field.clear();
        for y in 0..height {
            buffers.field.extend_from_slice(&plane.field[(y0 + y) * plane.width + x0..][..width]);
        }
        window.pixels(buffers)
    }

    /// Light of sub-point (z, y, x) in the pixels.
    fn light(
        &self,
        window: &Window,
        z: usize,
        at: [usize; 2],
        buffers: &mut Buffers,
    ) -> Result<Vec<f64>, PsfError> {
        let m = self.p.objective.magnification;
        let xs: Vec<f64> = window.positions(1).iter().map(|x| x / m - self.position(1, at[1])).collect();
        let ys: Vec<f64> = window.positions(0).iter().map(|y| y / m - self.position(0, at[0])).collect();
        match self.source(z) {
            Source::Radial { field, shift } => {
                let squares: Vec<f64> = xs.iter().map(|x| (x - shift) * (x - shift)).collect();
                buffers.field.clear();
                for y in &ys {
                    buffers.field.extend(squares.iter().map(|s| field.at((s + y * y).sqrt())));
                }
            }
            Source::Pupil { q, depth } => {
                buffers.field = pupil_field(&self.p.objective, q, depth, &xs, &ys)?.0;
            }
        }
        Ok(window.pixels(buffers))
    }
}

impl Psf {
    /// Computes the point spread function.
    ///
    /// # Errors
    /// [`PsfError`]: impossible parameters, an evanescent order, a field that would be under-sampled, a
    /// radius that does not hold the light.
    pub fn compute(parameters: &PsfParameters) -> Result<Self, PsfError> {
        Self::compute_with(parameters, &|_, _| {})
    }

    /// As [`Psf::compute`]; `progress` is called with (done, all) fields, from any thread.
    ///
    /// # Errors
    /// As [`Psf::compute`].
    pub fn compute_with(
        parameters: &PsfParameters,
        progress: &(dyn Fn(usize, usize) + Sync),
    ) -> Result<Self, PsfError> {
        let p = parameters;
        check(p)?;
        let (over, sampling_error) = sampling(p)?;
        let plane_radius = radii(p, over)?;
        // sub-points of a neighbouring cell reach one cell farther
        let margin = usize::from(matches!(p.kernel, VoxelKernel::RaisedCosine(_)));
        let radius = plane_radius.iter().copied().max().unwrap_or(0) + margin;
        let inner = radius - margin;
        let points = Points::new(p, inner)?;
        let window = Window::new(p, over, inner)?;
        let n = p.kernel.points();
        let fine = p.voxels.map(|s| s * n);
        let folds = Folds::of(p);
        let unique = folds.unique(fine);
        let all = p.planes_um.len() * unique.len();
        let done = std::sync::atomic::AtomicUsize::new(0);
        let count = || progress(done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1, all);
        let mut lights: Vec<Vec<f64>> = Vec::with_capacity(all);
        if points.q.is_some() {
            // one field serves all sub-points of a plane
            for z in 0..p.planes_um.len() {
                let plane = points.pupil_plane(&window, z, fine)?;
                let part = each(&unique, |buffers, &at| {
                    let light = match &plane {
                        Some(plane) => Ok(Points::light_of(&window, plane, at, buffers)),
                        None => points.light(&window, z, at, buffers),
                    };
                    count();
                    light
                });
                for light in part {
                    lights.push(light?);
                }
            }
        } else {
            let jobs: Vec<(usize, [usize; 2])> =
                (0..p.planes_um.len()).flat_map(|z| unique.iter().map(move |&at| (z, at))).collect();
            let part = each(&jobs, |buffers, &(z, at)| {
                let light = points.light(&window, z, at, buffers);
                count();
                light
            });
            lights = part.into_iter().collect::<Result<_, _>>()?;
        }

        let shape = PsfShape { planes: p.planes_um.len(), voxels: p.voxels, radius, pixels: p.pixels };
        let inner_shape = PsfShape { radius: inner, ..shape };
        let mut values = vec![0f32; shape.len()];
        let mut energy = Vec::new();
        let weights = p.kernel.weights();
        let (side, pixels) = (shape.side(), p.pixels[0] * p.pixels[1]);
        for z in 0..shape.planes {
            let reach = plane_radius[z] + margin;
            let mut least = f64::INFINITY;
            for sy in 0..p.voxels[0] {
                for sx in 0..p.voxels[1] {
                    let mut sum = vec![0f64; shape.voxel()];
                    for &(jy, wy) in &weights {
                        for &(jx, wx) in &weights {
                            let (cy, fy) = wrap(sy, n, jy, fine[0]);
                            let (cx, fx) = wrap(sx, n, jx, fine[1]);
                            let (at, fold) = folds.reduce([fy, fx], fine);
                            let index = unique.iter().position(|u| *u == at).unwrap_or(0);
                            let light = &lights[z * unique.len() + index];
                            fold.add(&inner_shape, light, wy * wx, &mut sum, radius, [cy, cx]);
                        }
                    }
                    let first = ((z * p.voxels[0] + sy) * p.voxels[1] + sx) * shape.voxel();
                    let mut total = 0.0;
                    for (d, part) in sum.chunks_exact(pixels).enumerate() {
                        let far = (d / side).abs_diff(radius).max((d % side).abs_diff(radius));
                        if far <= reach {
                            total += part.iter().sum::<f64>();
                            for (v, s) in values[first + d * pixels..].iter_mut().zip(part) {
                                *v = *s as f32;
                            }
                        }
                    }
                    least = least.min(total);
                }
            }
            energy.push(least);
        }
        let evanescent = match points.q {
            Some(q) => pupil_field(&p.objective, q, 0.0, &[0.0], &[0.0])?.1,
            None => 0.0,
        };
        let report = PsfReport {
            samples: over,
            dx_um: window.spacing[0].max(window.spacing[1]),
            sampling_error,
            quadrature_error: points.tables.error,
            plane_radius: plane_radius.iter().map(|r| r + margin).collect(),
            energy,
            evanescent,
        };
        Ok(Self { parameters: p.clone(), report, radius, values })
    }

    /// A point spread function from stored or measured values, `values` as documented above.
    ///
    /// # Errors
    /// [`PsfError::Shape`] if their number does not fit.
    pub fn from_values(
        parameters: PsfParameters,
        report: PsfReport,
        radius: usize,
        values: Vec<f32>,
    ) -> Result<Self, PsfError> {
        let psf = Self { parameters, report, radius, values };
        if psf.shape().len() != psf.values.len() {
            return Err(PsfError::Shape { found: psf.values.len(), expected: psf.shape().len() });
        }
        Ok(psf)
    }

    /// Shape of the values.
    pub fn shape(&self) -> PsfShape {
        PsfShape {
            planes: self.parameters.planes_um.len(),
            voxels: self.parameters.voxels,
            radius: self.radius,
            pixels: self.parameters.pixels,
        }
    }
}

/// Cell and place in it of sub-point `j` counted from the first of voxel `s`.
fn wrap(s: usize, n: usize, j: isize, fine: usize) -> (isize, usize) {
    let i = (s * n) as isize + j;
    (i.div_euclid(fine as isize), i.rem_euclid(fine as isize) as usize)
}

/// Symmetries of the optics, which save fields: mirrors and the exchange of both axes.
struct Folds {
    mirror: [bool; 2],
    exchange: bool,
}

/// How the light of one sub-point comes from that of another.
struct Fold {
    mirror: [bool; 2],
    exchange: bool,
}

impl Folds {
    fn of(p: &PsfParameters) -> Self {
        let straight = p.grating.is_none();
        Self {
            mirror: [true, straight],
            exchange: straight
                && p.lenslets.packing == Packing::Square
                && p.pixels[0] == p.pixels[1]
                && p.voxels[0] == p.voxels[1],
        }
    }

    /// The sub-point that stands for `at`, and how.
    fn reduce(&self, at: [usize; 2], fine: [usize; 2]) -> ([usize; 2], Fold) {
        let mut to = at;
        let mut mirror = [false; 2];
        for axis in 0..2 {
            if self.mirror[axis] && to[axis] > fine[axis] - 1 - to[axis] {
                to[axis] = fine[axis] - 1 - to[axis];
                mirror[axis] = true;
            }
        }
        let exchange = self.exchange && to[0] > to[1];
        if exchange {
            to.swap(0, 1);
        }
        (to, Fold { mirror, exchange })
    }

    fn unique(&self, fine: [usize; 2]) -> Vec<[usize; 2]> {
        let all = (0..fine[0]).flat_map(|y| (0..fine[1]).map(move |x| [y, x]));
        all.filter(|&at| self.reduce(at, fine).0 == at).collect()
    }
}

impl Fold {
    /// Adds the light of the folded sub-point, which lies `cell` cells away, to `sum` of radius `radius`.
    fn add(
        &self,
        inner: &PsfShape,
        light: &[f64],
        weight: f64,
        sum: &mut [f64],
        radius: usize,
        cell: [isize; 2],
    ) {
        let (from, to) = (inner.side(), 2 * radius + 1);
        let [ny, nx] = inner.pixels;
        let grow = radius as isize - inner.radius as isize;
        for dy in 0..from {
            for dx in 0..from {
                let (ty, tx) = (dy as isize + grow + cell[0], dx as isize + grow + cell[1]);
                if ty < 0 || tx < 0 || ty >= to as isize || tx >= to as isize {
                    continue;
                }
                let out = &mut sum[(ty as usize * to + tx as usize) * ny * nx..][..ny * nx];
                for py in 0..ny {
                    for px in 0..nx {
                        let (mut y, mut x) = ([dy, py], [dx, px]);
                        if self.mirror[0] {
                            y = [from - 1 - dy, ny - 1 - py];
                        }
                        if self.mirror[1] {
                            x = [from - 1 - dx, nx - 1 - px];
                        }
                        if self.exchange {
                            (y, x) = (x, y);
                        }
                        out[py * nx + px] += weight * light[((y[0] * from + x[0]) * ny + y[1]) * nx + x[1]];
                    }
                }
            }
        }
    }
}

fn check(p: &PsfParameters) -> Result<(), PsfError> {
    let o = &p.objective;
    let positive = [
        ("the magnification", o.magnification),
        ("the numerical aperture", o.na),
        ("the refractive index", o.index),
        ("the wavelength", o.wavelength_um),
        ("the lenslet pitch", p.lenslets.pitch_um),
        ("the lenslets' focal length", p.lenslets.focal_um),
        ("the gap of lenslets and sensor", p.lenslets.gap_um),
        ("the sampling tolerance", p.sampling_tolerance),
    ];
    let grating = p.grating.map(|g| ("the grating pitch", g.pitch_um));
    let round = match p.lenslets.aperture {
        crate::optics::Aperture::Full => None,
        crate::optics::Aperture::Round { diameter_um } => Some(("the lenslet diameter", diameter_um)),
    };
    for (what, value) in positive.into_iter().chain(grating).chain(round) {
        if !(value.is_finite() && value > 0.0) {
            return Err(PsfError::NotPositive { what, value });
        }
    }
    if o.na >= o.index {
        return Err(PsfError::Aperture { na: o.na, index: o.index });
    }
    if let Some(g) = &p.grating {
        let sine = g.sine(o);
        if sine >= 1.0 {
            return Err(PsfError::Evanescent { pitch_um: g.pitch_um, sine });
        }
    }
    let count = |what, value, least, most| {
        if (least..=most).contains(&value) {
            Ok(())
        } else {
            Err(PsfError::Count { what, value, least, most })
        }
    };
    for n in p.pixels {
        count("pixels of a cell and side", n, 1, MOST)?;
    }
    for s in p.voxels {
        count("voxels of a cell and side", s, 1, MOST)?;
    }
    count("planes", p.planes_um.len(), 1, 4096)?;
    count("sub-points of a voxel and side", p.kernel.points(), 1, 64)?;
    count("guard cells", p.guard, 0, 64)?;
    match p.radius {
        Radius::Cells(r) => count("cells of the radius", r, 0, 64)?,
        Radius::Energy { share, max } => {
            count("cells of the largest radius", max, 0, 64)?;
            if !(share > 0.0 && share < 1.0) {
                return Err(PsfError::Share { share });
            }
        }
    }
    if let Oversampling::Samples(n) = p.oversampling {
        count("samples per pixel and side", n, 1, 256)?;
    }
    for (plane, &value) in p.planes_um.iter().enumerate() {
        if !value.is_finite() {
            return Err(PsfError::Plane { plane, value });
        }
    }
    // last, because the sizes above bound the product
    let bytes = p.pixels[0] * p.pixels[1] * p.voxels[0] * p.voxels[1] * p.planes_um.len() * 4;
    if bytes > 1 << 36 {
        return Err(PsfError::Memory {
            what: "the point spread function",
            needed_mib: (bytes >> 20) as u64,
            limit_mib: 1 << 16,
        });
    }
    Ok(())
}

/// λ f/(5 p): the sample distance to start from.
fn advice(p: &PsfParameters) -> f64 {
    p.objective.wavelength_um * p.lenslets.focal_um / (5.0 * p.lenslets.pitch_um)
}

/// Samples per pixel, and the change of the self-test with 1.8 times as many.
fn sampling(p: &PsfParameters) -> Result<(usize, f64), PsfError> {
    let cell = p.lenslets.cell_um();
    let pixel = (cell[0] / p.pixels[0] as f64).max(cell[1] / p.pixels[1] as f64);
    let start = match p.oversampling {
        Oversampling::Samples(n) => n,
        // rounding errors must not cost a sample
        Oversampling::Auto => (pixel / advice(p) - 1e-9).ceil().max(1.0) as usize,
    };
    // the deepest plane, which fills the lenslets and is the most demanding
    let depth = |z: &usize| p.planes_um[*z].abs();
    let z = (0..p.planes_um.len()).max_by(|a, b| depth(a).total_cmp(&depth(b))).unwrap_or(0);
    let trial = PsfParameters {
        planes_um: vec![p.planes_um[z]],
        radius: Radius::Cells(2),
        guard: p.guard.min(2),
        kernel: VoxelKernel::Point,
        ..p.clone()
    };
    let points = Points::new(&trial, 2)?;
    let light = |over: usize| -> Result<Vec<f64>, PsfError> {
        points.light(&Window::new(&trial, over, 2)?, 0, [0, 0], &mut Buffers::default())
    };
    let mut over = start;
    loop {
        let finer = (over * 9).div_ceil(5);
        let (a, b) = (light(over)?, light(finer)?);
        let difference: f64 = a.iter().zip(&b).map(|(a, b)| (a - b) * (a - b)).sum();
        let error = (difference / b.iter().map(|b| b * b).sum::<f64>()).sqrt();
        if error <= p.sampling_tolerance
            || (p.allow_under_sampling && matches!(p.oversampling, Oversampling::Samples(_)))
        {
            return Ok((over, error));
        }
        if matches!(p.oversampling, Oversampling::Samples(_)) || finer > 4 * start {
            return Err(PsfError::UnderSampled {
                samples: over,
                dx_um: pixel / over as f64,
                error,
                tolerance: p.sampling_tolerance,
                advice_um: advice(p),
            });
        }
        over = (over * 3).div_ceil(2);
    }
}

/// Radius of each plane.
fn radii(p: &PsfParameters, over: usize) -> Result<Vec<usize>, PsfError> {
    let (share, max) = match p.radius {
        Radius::Cells(r) => return Ok(vec![r; p.planes_um.len()]),
        Radius::Energy { share, max } => (share, max),
    };
    // half as fine is enough for an energy
    let over = over.div_ceil(2);
    let trial = PsfParameters { kernel: VoxelKernel::Point, ..p.clone() };
    let points = Points::new(&trial, max)?;
    let window = Window::new(&trial, over, max)?;
    let side = 2 * max + 1;
    let pixels = p.pixels[0] * p.pixels[1];
    let planes: Vec<usize> = (0..p.planes_um.len()).collect();
    let held = each(&planes, |buffers, &z| -> Result<Vec<f64>, PsfError> {
        let light = points.light(&window, z, [0, 0], buffers)?;
        let mut shares = vec![0.0; max + 1];
        for (d, part) in light.chunks_exact(pixels).enumerate() {
            let far = (d / side).abs_diff(max).max((d % side).abs_diff(max));
            for s in &mut shares[far..] {
                *s += part.iter().sum::<f64>();
            }
        }
        Ok(shares)
    });
    let mut out = Vec::new();
    for (z, shares) in held.into_iter().enumerate() {
        let shares = shares?;
        let radius = shares.iter().position(|&s| s >= share).ok_or(PsfError::Spread {
            z_um: p.planes_um[z],
            max,
            found: shares.last().copied().unwrap_or(0.0),
            wanted: share,
        })?;
        out.push(radius);
    }
    Ok(out)
}
