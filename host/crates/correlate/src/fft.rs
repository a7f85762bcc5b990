//! Initial guesses: zero-normalised cross-correlation over a range of whole-pixel shifts by FFT.

use crate::icgn::{Scratch, Solver};
use crate::image::Image;
use crate::subset::{LANES, Layout};
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftPlanner, num_complex::Complex32};
use std::sync::Arc;

/// Shifts to be searched, both ends included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Window {
    pub(crate) u: (i32, i32),
    pub(crate) v: (i32, i32),
}

impl Window {
    pub(crate) fn around(u: f64, v: f64, reach: i32) -> Self {
        let (u, v) = (u.round() as i32, v.round() as i32);
        Self { u: (u - reach, u + reach), v: (v - reach, v + reach) }
    }

    /// Whole pixels that hold the given ranges.
    pub(crate) fn range(u: (f64, f64), v: (f64, f64)) -> Self {
        let whole = |r: (f64, f64)| (r.0.floor() as i32, r.1.ceil() as i32);
        Self { u: whole(u), v: whole(v) }
    }

    fn size(&self) -> (usize, usize) {
        ((self.u.1 - self.u.0).max(0) as usize + 1, (self.v.1 - self.v.0).max(0) as usize + 1)
    }
}

/// Rows that are turned into columns together; divides all sizes.
const BLOCK: usize = 8;

/// Real two-dimensional FFT of a fixed size.
struct Fft2 {
    nx: usize,
    ny: usize,
    forward: Arc<dyn RealToComplex<f32>>,
    inverse: Arc<dyn ComplexToReal<f32>>,
    down: Arc<dyn Fft<f32>>,
    up: Arc<dyn Fft<f32>>,
}

/// Smallest size with small prime factors, even along x.
fn good_size(n: usize) -> usize {
    let mut m = n.max(8).next_multiple_of(8);
    loop {
        let mut k = m;
        for p in [2, 3, 5] {
            while k.is_multiple_of(p) {
                k /= p;
            }
        }
        if k == 1 {
            return m;
        }
        m += 8;
    }
}

impl Fft2 {
    fn new(nx: usize, ny: usize) -> Self {
        let (nx, ny) = (good_size(nx), good_size(ny));
        let mut real = RealFftPlanner::new();
        let mut complex = FftPlanner::new();
        Self {
            nx,
            ny,
            forward: real.plan_fft_forward(nx),
            inverse: real.plan_fft_inverse(nx),
            down: complex.plan_fft_forward(ny),
            up: complex.plan_fft_inverse(ny),
        }
    }

    fn half(&self) -> usize {
        self.nx / 2 + 1
    }

    /// Spectrum, stored column after column, of a plane whose rows from `used` on are zero.
    fn spectrum(&self, data: &mut [f32], used: usize) -> Vec<Complex32> {
        let (half, ny) = (self.half(), self.ny);
        let mut rows = vec![Complex32::default(); BLOCK * half];
        let mut scratch = self.forward.make_scratch_vec();
        let mut out = vec![Complex32::default(); half * ny];
        let blocks = data.chunks_mut(BLOCK * self.nx).take(used.div_ceil(BLOCK));
        for (block, src) in blocks.enumerate() {
            for (row, src) in rows.chunks_exact_mut(half).zip(src.chunks_exact_mut(self.nx)) {
                // lengths are those of the plan
                if self.forward.process_with_scratch(src, row, &mut scratch).is_err() {
                    row.fill(Complex32::default());
                }
            }
            for (x, column) in out.chunks_exact_mut(ny).enumerate() {
                for (o, row) in column[block * BLOCK..].iter_mut().zip(rows.chunks_exact(half)) {
                    *o = row[x];
                }
            }
        }
        self.down.process(&mut out);
        out
    }

    /// Correlation of two planes given by their spectra, not divided by the number of values.
    fn correlated(&self, template: &[Complex32], area: &[Complex32]) -> Vec<f32> {
        self.plane(template.iter().zip(area).map(|(t, a)| t.conj() * a).collect(), |_| true)
    }

    /// Inverse of [`Fft2::spectrum`], not divided by the number of values; rows that are not wanted are
    /// zero.
    fn plane(&self, mut spectrum: Vec<Complex32>, wanted: impl Fn(usize) -> bool) -> Vec<f32> {
        let (half, ny) = (self.half(), self.ny);
        self.up.process(&mut spectrum);
        let mut rows = vec![Complex32::default(); BLOCK * half];
        let mut scratch = self.inverse.make_scratch_vec();
        let mut out = vec![0.0; self.nx * ny];
        for (block, dst) in out.chunks_mut(BLOCK * self.nx).enumerate() {
            let first = block * BLOCK;
            if !(first..first + BLOCK).any(&wanted) {
                continue;
            }
            for (x, column) in spectrum.chunks_exact(ny).enumerate() {
                for (row, c) in rows.chunks_exact_mut(half).zip(&column[first..]) {
                    row[x] = *c;
                }
            }
            for (row, dst) in rows.chunks_exact_mut(half).zip(dst.chunks_exact_mut(self.nx)) {
                // what a real signal must have there
                row[0].im = 0.0;
                row[half - 1].im = 0.0;
                if self.inverse.process_with_scratch(row, dst, &mut scratch).is_err() {
                    dst.fill(0.0);
                }
            }
        }
        out
    }
}

/// Searches a subset in the deformed image over a window of shifts; planned once for all points
/// that have a window of the same size.
pub(crate) struct Search {
    fft: Fft2,
    size: (usize, usize),
}

impl Search {
    pub(crate) fn new(layout: &Layout, window: &Window) -> Self {
        let size = window.size();
        Self { fft: Fft2::new(size.0 + layout.width - 1, size.1 + layout.width - 1), size }
    }

    /// Best shift of the subset around (x, y) within a window of the planned size, and its ZNCC;
    /// `None` where no shift keeps the subset in the deformed image or nothing has texture.
    pub(crate) fn best(
        &self,
        solver: &Solver<'_>,
        scratch: &mut Scratch,
        (x, y): (i32, i32),
        window: &Window,
    ) -> Option<(i32, i32, f64)> {
        if window.size() != self.size || !solver.fits(x, y) {
            return None;
        }
        solver.load(scratch, x, y);
        let subset = &scratch.subset;
        if subset.sff <= 0.0 {
            return None;
        }
        let layout = &solver.layout;
        let r = layout.radius as i32;
        let target = &solver.target.image;
        let offset = solver.target.offset;
        let (nx, ny) = (self.fft.nx, self.fft.ny);
        // first pixel of the searched part of the target
        let (left, top) = (x - r + window.u.0, y - r + window.v.0);
        let cols = self.size.0 + layout.width - 1;
        let rows = self.size.1 + layout.width - 1;
        let mut area = vec![0.0f32; nx * ny];
        copy_area(target, offset, left, top, cols, rows, nx, &mut area);
        let (sum, square) = integrals(&area, nx, cols, rows);
        let mut template = vec![0.0f32; nx * ny];
        unpack(layout, &subset.f, nx, &mut template);
        let scale = 1.0 / (nx * ny) as f64;
        // under a cut subset the sums of the target have to be correlations too
        let under = (!subset.cut.is_empty()).then(|| {
            let mut cut = vec![0.0f32; nx * ny];
            unpack(layout, &subset.cut, nx, &mut cut);
            let cut = self.fft.spectrum(&mut cut, layout.width);
            let mut square: Vec<f32> = area.iter().map(|g| g * g).collect();
            let square = self.fft.correlated(&cut, &self.fft.spectrum(&mut square, rows));
            let values = self.fft.correlated(&cut, &self.fft.spectrum(&mut area.clone(), rows));
            (values, square)
        });
        let a = self.fft.spectrum(&mut area, rows);
        let map = self.fft.correlated(&self.fft.spectrum(&mut template, layout.width), &a);
        let n = subset.count as f64;
        let w = layout.width;
        let [x0, x1, y0, y1] = subset.extent.map(|e| e as i32 + r);
        let stride = cols + 1;
        let mut best: Option<(i32, i32, f64)> = None;
        let (iw, ih) = (target.width() as i32, target.height() as i32);
        for j in 0..self.size.1 {
            let py = top + j as i32;
            if py + y0 < 0 || py + y1 >= ih {
                continue;
            }
            for i in 0..self.size.0 {
                let px = left + i as i32;
                if px + x0 < 0 || px + x1 >= iw {
                    continue;
                }
                let over = |s: &[f64]| {
                    s[(j + w) * stride + i + w] + s[j * stride + i]
                        - s[j * stride + i + w]
                        - s[(j + w) * stride + i]
                };
                let (s, q) = match &under {
                    None => (over(&sum), over(&square)),
                    Some((sum, square)) => {
                        (f64::from(sum[j * nx + i]) * scale, f64::from(square[j * nx + i]) * scale)
                    }
                };
                let variance = q - s * s / n;
                // a flat target subset correlates with nothing
                if variance <= 1e-6 * subset.sff {
                    continue;
                }
                let z = f64::from(map[j * nx + i]) * scale / (subset.sff * variance).sqrt();
                if best.is_none_or(|b| z > b.2) {
                    best = Some((window.u.0 + i as i32, window.v.0 + j as i32, z));
                }
            }
        }
        best
    }
}

#[allow(clippy::too_many_arguments)]
fn copy_area(
    image: &Image,
    offset: f32,
    left: i32,
    top: i32,
    cols: usize,
    rows: usize,
    stride: usize,
    out: &mut [f32],
) {
    let first = left.max(0);
    let end = (left + cols as i32).min(image.width() as i32);
    if first >= end {
        return;
    }
    for j in 0..rows {
        let y = top + j as i32;
        if y < 0 || y >= image.height() as i32 {
            continue;
        }
        let src = &image.row(y as usize)[first as usize..end as usize];
        let at = j * stride + (first - left) as usize;
        for (o, g) in out[at..at + src.len()].iter_mut().zip(src) {
            *o = g - offset;
        }
    }
}

/// Summed-area tables of the values and their squares, one row and column of zeros first.
fn integrals(area: &[f32], nx: usize, cols: usize, rows: usize) -> (Vec<f64>, Vec<f64>) {
    let stride = cols + 1;
    let mut sum = vec![0.0; stride * (rows + 1)];
    let mut square = sum.clone();
    for j in 0..rows {
        let (mut s, mut q) = (0.0, 0.0);
        for i in 0..cols {
            let g = f64::from(area[j * nx + i]);
            s += g;
            q += g * g;
            let k = (j + 1) * stride + i + 1;
            sum[k] = sum[k - stride] + s;
            square[k] = square[k - stride] + q;
        }
    }
    (sum, square)
}

fn unpack(layout: &Layout, packed: &[f32], stride: usize, out: &mut [f32]) {
    let row_floats = layout.groups * LANES;
    let used = row_floats.min(layout.width);
    for d in 0..layout.width {
        out[d * stride..d * stride + used].copy_from_slice(&packed[d * row_floats..d * row_floats + used]);
        for c in 0..layout.columns {
            let at = layout.width * row_floats + c * layout.column_groups() * LANES;
            out[d * stride + row_floats + c] = packed[at + d];
        }
    }
}

/// Whole-image shifts, best first: cross-correlation of both images, reduced to at most `side`
/// pixels on a side and freed from their slow brightness variations. Shifts up to half the image
/// are found, none nearer than `apart` pixels to the next along both axes.
pub(crate) fn global_shifts(
    reference: &Image,
    target: &Image,
    count: usize,
    side: usize,
    apart: i32,
) -> Vec<[f64; 2]> {
    let largest = reference.width().max(reference.height());
    let factor = largest.div_ceil(side).max(1);
    let (w, h) = (reference.width() / factor, reference.height() / factor);
    if (reference.width(), reference.height()) != (target.width(), target.height()) || w < 4 || h < 4 {
        return Vec::new();
    }
    let fft = Fft2::new(2 * w, 2 * h);
    let spectrum = |image: &Image| fft.spectrum(&mut reduced(image, factor, fft.nx, fft.ny), h);
    let (sa, mut product) = rayon::join(|| spectrum(reference), || spectrum(target));
    for (t, s) in product.iter_mut().zip(&sa) {
        *t *= s.conj();
    }
    let (hu, hv) = (w / 2, h / 2);
    let map = fft.plane(product, |y| y <= hv || y + hv >= fft.ny);
    // the shifts of interest in one piece; chance correlation grows as the root of the overlap
    let by_overlap = |half: usize, size: usize| -> Vec<f32> {
        let overlap = |k: usize| 1.0 - k.abs_diff(half) as f32 / size as f32;
        (0..=2 * half).map(|k| 1.0 / overlap(k).sqrt()).collect()
    };
    let (across, down) = (by_overlap(hu, w), by_overlap(hv, h));
    let width = across.len();
    let mut likely = Vec::with_capacity(width * down.len());
    for (j, down) in down.iter().enumerate() {
        let row = &map[(j + fft.ny - hv) % fft.ny * fft.nx..][..fft.nx];
        let values = row[fft.nx - hu..].iter().chain(&row[..=hu]);
        likely.extend(values.zip(&across).map(|(z, a)| z * (a * down)));
    }
    let mut found = Vec::new();
    for _ in 0..count {
        let Some(at) = peak(&likely) else {
            break;
        };
        let (i, j) = (at % width, at / width);
        let shift = |k: usize, half: usize| (k as f64 - half as f64) * factor as f64;
        found.push([shift(i, hu), shift(j, hv)]);
        // what the neighbourhood of this shift covers is no other shift
        let reach = (apart as usize / factor).max(2);
        for row in likely.chunks_exact_mut(width).take(j + reach + 1).skip(j.saturating_sub(reach)) {
            row[i.saturating_sub(reach)..(i + reach + 1).min(width)].fill(f32::NEG_INFINITY);
        }
    }
    found
}

/// Index of the first largest value, if it is above 0.
fn peak(values: &[f32]) -> Option<usize> {
    const CHUNK: usize = 64;
    let largest = |c: &[f32]| c.iter().fold(0.0f32, |m, &v| if v > m { v } else { m });
    let mut best = (0.0f32, 0);
    for (k, c) in values.chunks(CHUNK).enumerate() {
        let m = largest(c);
        if m > best.0 {
            best = (m, k * CHUNK);
        }
    }
    values[best.1..].iter().position(|&v| best.0 > 0.0 && v == best.0).map(|k| best.1 + k)
}

/// An image averaged over squares of `factor` pixels, less the mean of the 9 × 9 around each value, in
/// the corner of a plane of zeros of `nx` columns and `ny` rows.
fn reduced(image: &Image, factor: usize, nx: usize, ny: usize) -> Vec<f32> {
    const REACH: usize = 4;
    let (w, h) = (image.width() / factor, image.height() / factor);
    let mut mean = vec![0.0f32; w * h];
    let mut lines = vec![0.0f32; image.width()];
    let inv = 1.0 / (factor * factor) as f32;
    for (y, out) in mean.chunks_exact_mut(w).enumerate() {
        lines.copy_from_slice(image.row(y * factor));
        for row in y * factor + 1..(y + 1) * factor {
            for (o, g) in lines.iter_mut().zip(image.row(row)) {
                *o += g;
            }
        }
        match factor {
            2 => binned::<2>(&lines, inv, out),
            4 => binned::<4>(&lines, inv, out),
            8 => binned::<8>(&lines, inv, out),
            _ => out
                .iter_mut()
                .zip(lines.chunks_exact(factor))
                .for_each(|(o, c)| *o = inv * c.iter().sum::<f32>()),
        }
    }
    // sums of nine along each row, then of nine rows
    let count = |k: usize, n: usize| (k + REACH + 1).min(n) - k.saturating_sub(REACH);
    let around = |sums: &mut [f64], sign: f64, y: usize| {
        let row = &mean[y * w..(y + 1) * w];
        let mut s: f64 = row[..REACH.min(w)].iter().map(|&v| f64::from(v)).sum();
        for x in 0..w {
            s += row.get(x + REACH).map_or(0.0, |&v| f64::from(v));
            s -= if x > REACH { f64::from(row[x - REACH - 1]) } else { 0.0 };
            sums[x] += sign * s;
        }
    };
    let columns: Vec<f64> = (0..w).map(|x| 1.0 / count(x, w) as f64).collect();
    let mut sums = vec![0.0f64; w];
    (0..REACH.min(h)).for_each(|y| around(&mut sums, 1.0, y));
    let mut out = vec![0.0f32; nx * ny];
    for (y, (row, out)) in mean.chunks_exact(w).zip(out.chunks_exact_mut(nx)).enumerate() {
        if y + REACH < h {
            around(&mut sums, 1.0, y + REACH);
        }
        if y > REACH {
            around(&mut sums, -1.0, y - REACH - 1);
        }
        let rows = 1.0 / count(y, h) as f64;
        for (((o, v), s), c) in out.iter_mut().zip(row).zip(&sums).zip(&columns) {
            *o = v - (s * (rows * c)) as f32;
        }
    }
    out
}

/// Sums of N values each, times `scale`.
fn binned<const N: usize>(values: &[f32], scale: f32, out: &mut [f32]) {
    let (groups, _) = values.as_chunks::<N>();
    for (o, g) in out.iter_mut().zip(groups) {
        *o = scale * g.iter().sum::<f32>();
    }
}
