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

    /// Spectrum, stored column after column.
    fn spectrum(&self, data: &mut [f32]) -> Vec<Complex32> {
        let (half, ny) = (self.half(), self.ny);
        let mut row = vec![Complex32::default(); half];
        let mut out = vec![Complex32::default(); half * ny];
        for (y, src) in data.chunks_exact_mut(self.nx).enumerate() {
            // lengths are those of the plan
            if self.forward.process(src, &mut row).is_err() {
                continue;
            }
            for (x, c) in row.iter().enumerate() {
                out[x * ny + y] = *c;
            }
        }
        self.down.process(&mut out);
        out
    }

    /// Correlation of two planes given by their spectra, not divided by the number of values.
    fn correlated(&self, template: &[Complex32], area: &[Complex32]) -> Vec<f32> {
        self.plane(template.iter().zip(area).map(|(t, a)| t.conj() * a).collect())
    }

    /// Inverse of [`Fft2::spectrum`], not divided by the number of values.
    fn plane(&self, mut spectrum: Vec<Complex32>) -> Vec<f32> {
        let (half, ny) = (self.half(), self.ny);
        self.up.process(&mut spectrum);
        let mut row = vec![Complex32::default(); half];
        let mut out = vec![0.0; self.nx * ny];
        for (y, dst) in out.chunks_exact_mut(self.nx).enumerate() {
            for (x, c) in row.iter_mut().enumerate() {
                *c = spectrum[x * ny + y];
            }
            // what a real signal must have there
            row[0].im = 0.0;
            row[half - 1].im = 0.0;
            if self.inverse.process(&mut row, dst).is_err() {
                dst.fill(0.0);
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
            let cut = self.fft.spectrum(&mut cut);
            let mut square: Vec<f32> = area.iter().map(|g| g * g).collect();
            let square = self.fft.correlated(&cut, &self.fft.spectrum(&mut square));
            let values = self.fft.correlated(&cut, &self.fft.spectrum(&mut area.clone()));
            (values, square)
        });
        let a = self.fft.spectrum(&mut area);
        let map = self.fft.correlated(&self.fft.spectrum(&mut template), &a);
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
    let (a, w, h) = reduced(reference, factor);
    let (b, bw, bh) = reduced(target, factor);
    if (w, h) != (bw, bh) || w < 4 || h < 4 {
        return Vec::new();
    }
    let fft = Fft2::new(2 * w, 2 * h);
    let spread = |src: &[f32]| {
        let mut out = vec![0.0; fft.nx * fft.ny];
        for (o, s) in out.chunks_exact_mut(fft.nx).zip(src.chunks_exact(w)) {
            o[..w].copy_from_slice(s);
        }
        out
    };
    let sa = fft.spectrum(&mut spread(&a));
    let mut product = fft.spectrum(&mut spread(&b));
    for (t, s) in product.iter_mut().zip(&sa) {
        *t *= s.conj();
    }
    let mut map = fft.plane(product);
    let (hu, hv) = ((w / 2) as i32, (h / 2) as i32);
    let place = |u: i32, v: i32| {
        let x = u.rem_euclid(fft.nx as i32) as usize;
        v.rem_euclid(fft.ny as i32) as usize * fft.nx + x
    };
    let mut found = Vec::new();
    for _ in 0..count {
        let mut best = (f32::NEG_INFINITY, 0, 0);
        for v in -hv..=hv {
            for u in -hu..=hu {
                let overlap = (w as i32 - u.abs()) as f32 * (h as i32 - v.abs()) as f32 / (w * h) as f32;
                // chance correlation grows as the root of the overlap
                let z = map[place(u, v)] / overlap.max(0.1).sqrt();
                if z > best.0 {
                    best = (z, u, v);
                }
            }
        }
        if best.0 <= 0.0 {
            break;
        }
        let (u, v) = (best.1, best.2);
        found.push([f64::from(u) * factor as f64, f64::from(v) * factor as f64]);
        // what the neighbourhood of this shift covers is no other shift
        let reach = (apart / factor as i32).max(2);
        for dv in -reach..=reach {
            for du in -reach..=reach {
                map[place(u + du, v + dv)] = f32::NEG_INFINITY;
            }
        }
    }
    found
}

fn reduced(image: &Image, factor: usize) -> (Vec<f32>, usize, usize) {
    let (w, h) = (image.width() / factor, image.height() / factor);
    let mut out = vec![0.0f32; w * h];
    let mut column_sums = vec![0.0f32; image.width()];
    for (y, out) in out.chunks_exact_mut(w.max(1)).enumerate() {
        column_sums.fill(0.0);
        for row in y * factor..(y + 1) * factor {
            for (o, g) in column_sums.iter_mut().zip(image.row(row)) {
                *o += g;
            }
        }
        for (o, c) in out.iter_mut().zip(column_sums.chunks_exact(factor)) {
            *o = c.iter().sum::<f32>();
        }
    }
    let inv = 1.0 / (factor * factor) as f32;
    out.iter_mut().for_each(|v| *v *= inv);
    if w == 0 || h == 0 {
        return (out, w, h);
    }
    // minus the mean over 9×9
    let mean = out.iter().sum::<f32>() / out.len() as f32;
    out.iter_mut().for_each(|v| *v -= mean);
    let (sum, _) = integrals(&out, w, w, h);
    let stride = w + 1;
    for y in 0..h {
        let (y0, y1) = (y.saturating_sub(4), (y + 5).min(h));
        for x in 0..w {
            let (x0, x1) = (x.saturating_sub(4), (x + 5).min(w));
            let s =
                sum[y1 * stride + x1] + sum[y0 * stride + x0] - sum[y0 * stride + x1] - sum[y1 * stride + x0];
            out[y * w + x] -= (s / ((y1 - y0) * (x1 - x0)) as f64) as f32;
        }
    }
    (out, w, h)
}
