//! What the dense form needs of the reference: its grey levels and gradients in tile order, and for
//! every subset the factored normal matrix.

use super::sums::{Group, SumBuffers, flush};
use super::tiling::{DEGREES, LANES, Task, Tiling, moments, monomial};
use crate::normal::EXPONENTS;
use crate::plane::resize;
use crate::prepared::Reference;
use crate::sampler::V;
use crate::simd::dispatch;
use fearless_simd::{Level, prelude::*};
use fearless_simd_macros::simd;

/// Grey level and two gradients.
const FIELDS: usize = 3;
pub(crate) const FIELD_BLOCK: usize = FIELDS * LANES;
/// A pivot below this part of its diagonal is rounding.
const PIVOT: f32 = 1e-5;
/// Grey-level variance below this part of the mean square leaves too few digits.
const VARIANCE: f32 = 1e-4;

/// Where the constants of eight neighbouring subsets stand in their block, in vectors.
pub(crate) struct Layout {
    /// Parameters.
    pub(crate) p: usize,
}

impl Layout {
    pub(crate) const fn new(order: usize) -> Self {
        Self { p: 2 * moments(order) }
    }
    /// Element (i, j), j < i, of the unit lower triangle.
    pub(crate) const fn l(&self, i: usize, j: usize) -> usize {
        i * (i - 1) / 2 + j
    }
    /// Inverse of the diagonal.
    pub(crate) const fn d(&self) -> usize {
        self.p * (self.p - 1) / 2
    }
    /// Σ G.
    pub(crate) const fn g(&self) -> usize {
        self.d() + self.p
    }
    /// Σ G (f − mean).
    pub(crate) const fn gf(&self) -> usize {
        self.g() + self.p
    }
    /// Mean of f.
    pub(crate) const fn mean(&self) -> usize {
        self.gf() + self.p
    }
    /// Σ (f − mean)².
    pub(crate) const fn sff(&self) -> usize {
        self.mean() + 1
    }
    /// Variances of u and v per unit of residual variance, gain and offset free.
    pub(crate) const fn variance(&self, c: usize) -> usize {
        self.sff() + 1 + c
    }
    /// Σ fx², Σ fy².
    pub(crate) const fn energy(&self, c: usize) -> usize {
        self.sff() + 3 + c
    }
    pub(crate) const fn len(&self) -> usize {
        self.sff() + 5
    }
}

/// One task's share of the reference.
#[derive(Default, Clone)]
pub(crate) struct Prepared {
    /// Per row of nodes and eight nodes: the constants of [`Layout`]. Σ (f − mean)² is negative where
    /// the normal equations are not safely solvable.
    pub(crate) constants: Vec<f32>,
}

/// Rows of pixels that a task covers.
pub(crate) fn lines(tiling: &Tiling, task: &Task) -> usize {
    (task.rows - 1) * tiling.step + 2 * tiling.radius + 1
}

/// First pixel of a task's first tile.
pub(crate) fn corner(tiling: &Tiling, task: &Task) -> (i32, i32) {
    let x = (tiling.x0 + task.column * tiling.step) as i32 - tiling.radius as i32;
    let y = (tiling.y0 + task.row * tiling.step) as i32 - tiling.radius as i32;
    (x, y)
}

/// Sorts values that follow each other along x into blocks of eight tiles, phase after phase: `width`
/// floats per phase, of which the eight from `offset` on are written.
#[inline(always)]
pub(crate) fn split(step: usize, row: &[f32], width: usize, offset: usize, out: &mut [f32]) {
    macro_rules! fixed {
        ($($n:literal)*) => {
            match step {
                $($n => {
                    let (src, _) = row.as_chunks::<{ $n * LANES }>();
                    for (src, dst) in src.iter().zip(out.chunks_exact_mut($n * width)) {
                        for (phase, d) in dst.chunks_exact_mut(width).enumerate() {
                            if let Some(d) = d[offset..].first_chunk_mut::<LANES>() {
                                for l in 0..LANES {
                                    d[l] = src[(l * $n + phase).min($n * LANES - 1)];
                                }
                            }
                        }
                    }
                    return;
                })*
                _ => {}
            }
        };
    }
    fixed!(1 2 3 4 5 6 7 8 10);
    for (src, dst) in row.chunks_exact(step * LANES).zip(out.chunks_exact_mut(step * width)) {
        for (phase, d) in dst.chunks_exact_mut(width).enumerate() {
            for (l, v) in d[offset..].iter_mut().take(LANES).enumerate() {
                *v = src[l * step + phase];
            }
        }
    }
}

impl Prepared {
    pub(crate) fn fill(
        &mut self,
        level: Level,
        tiling: &Tiling,
        task: &Task,
        reference: &Reference,
        order: usize,
        (buffers, line): (&mut SumBuffers, &mut Line),
    ) {
        let block = Layout::new(order).len() * LANES;
        resize(&mut self.constants, task.rows * task.width / LANES * block);
        match order {
            0 => dispatch!(level, s => factor::<_, 0, 0>(s, self, tiling, task, reference, buffers, line)),
            1 => dispatch!(level, s => factor::<_, 1, 2>(s, self, tiling, task, reference, buffers, line)),
            _ => dispatch!(level, s => factor::<_, 2, 4>(s, self, tiling, task, reference, buffers, line)),
        }
    }
}

/// Grey levels and gradients of one row of pixels.
#[derive(Default)]
pub(crate) struct Line {
    row: Vec<f32>,
    /// Per eight tiles and phase: eight values each of f, fx, fy.
    pub(crate) fields: Vec<f32>,
}

impl Line {
    /// Loads row `line` of a task's pixels.
    #[inline(always)]
    pub(crate) fn load(&mut self, tiling: &Tiling, task: &Task, reference: &Reference, line: usize) {
        let (x, y) = corner(tiling, task);
        let pixels = task.tiles * tiling.step;
        self.row.resize(pixels, 0.0);
        self.fields.resize(pixels * FIELDS, 0.0);
        let image = &reference.image;
        let used = pixels.min(image.width().saturating_sub(x as usize));
        let y = y as usize + line;
        let src = &image.row(y)[x as usize..x as usize + used];
        for (o, f) in self.row.iter_mut().zip(src) {
            *o = f - reference.mean;
        }
        split(tiling.step, &self.row, FIELD_BLOCK, 0, &mut self.fields);
        for (c, plane) in [&reference.gx, &reference.gy].into_iter().enumerate() {
            let at = plane.index(x, y as i32);
            self.row[..used].copy_from_slice(&plane.data[at..at + used]);
            split(tiling.step, &self.row, FIELD_BLOCK, (c + 1) * LANES, &mut self.fields);
        }
    }
}

/// Adds one row of pixels to the tiles: products of the gradients, the gradients alone and times f,
/// f and f².
#[inline(always)]
fn accumulate<S: Simd, const O: usize, const O2: usize>(
    s: S,
    tiling: &Tiling,
    fields: &[f32],
    x: &[[f32; DEGREES]],
    (y, is_first): (&[f32; DEGREES], bool),
    tiles: &mut [f32],
    stride: usize,
) {
    let zero = V::splat(s, 0.0);
    let rem = tiling.whole().1;
    let half = tiles.len() / 2;
    let (whole, part) = tiles.split_at_mut(half);
    for (group, block) in fields.chunks_exact(tiling.step * FIELD_BLOCK).enumerate() {
        let k = group * LANES;
        let mut a = [[zero; DEGREES]; 3];
        let mut g = [[zero; DEGREES]; 4];
        let mut f = [zero; 2];
        let (first, second) = block.split_at(rem * FIELD_BLOCK);
        let (x_first, x_second) = x.split_at(rem);
        for (is_part, pixels, powers) in [(true, first, x_first), (false, second, x_second)] {
            for (c, p) in pixels.chunks_exact(FIELD_BLOCK).zip(powers) {
                let fv = V::from_slice(s, &c[..LANES]);
                let xv = V::from_slice(s, &c[LANES..2 * LANES]);
                let yv = V::from_slice(s, &c[2 * LANES..]);
                let products = [xv * xv, xv * yv, yv * yv];
                for q in 0..3 {
                    a[q][0] += products[q];
                    for i in 1..=O2 {
                        a[q][i] = products[q].mul_add(V::splat(s, p[i]), a[q][i]);
                    }
                }
                let vectors = [xv, yv, xv * fv, yv * fv];
                for q in 0..4 {
                    g[q][0] += vectors[q];
                    for i in 1..=O {
                        g[q][i] = vectors[q].mul_add(V::splat(s, p[i]), g[q][i]);
                    }
                }
                f[0] += fv;
                f[1] = fv.mul_add(fv, f[1]);
            }
            if is_part && rem == 0 {
                continue;
            }
            let mut planes = if is_part { &mut *part } else { &mut *whole };
            for q in &a {
                flush::<S, O2>(s, is_first, q, y, planes, stride, k);
                planes = &mut planes[moments(O2) * stride..];
            }
            for q in &g {
                flush::<S, O>(s, is_first, q, y, planes, stride, k);
                planes = &mut planes[moments(O) * stride..];
            }
            for q in &f {
                flush::<S, 0>(s, is_first, std::slice::from_ref(q), y, planes, stride, k);
                planes = &mut planes[stride..];
            }
        }
    }
}

fn groups(order: usize) -> [Group; 3] {
    [Group { count: 3, degree: 2 * order }, Group { count: 4, degree: order }, Group { count: 2, degree: 0 }]
}

#[simd]
fn factor<S: Simd, const O: usize, const O2: usize>(
    s: S,
    data: &mut Prepared,
    tiling: &Tiling,
    task: &Task,
    reference: &Reference,
    buffers: &mut SumBuffers,
    line: &mut Line,
) {
    let groups = groups(O);
    let planes = groups.iter().map(|g| g.planes()).sum();
    buffers.prepare(tiling, task, planes);
    let powers: Vec<[f32; DEGREES]> = (0..tiling.step).map(|p| tiling.powers(p)).collect();
    let rem = tiling.whole().1;
    let last = tiling.last();
    let mut next = 0..lines(tiling, task);
    let block = Layout::new(O).len() * LANES;
    for b in 0..task.rows + last {
        let whole = b + 1 < task.rows + last || rem == 0;
        for y in 0..if whole { tiling.step } else { rem } {
            if y == rem {
                buffers.part(s, tiling, task, &groups, b);
            }
            if let Some(n) = next.next() {
                line.load(tiling, task, reference, n);
                let y = (&powers[y], y == 0);
                accumulate::<S, O, O2>(s, tiling, &line.fields, &powers, y, &mut buffers.tiles, task.tiles);
            }
        }
        if !whole {
            buffers.part(s, tiling, task, &groups, b);
        }
        if buffers.close(s, tiling, task, &groups, b, whole) {
            let row = (b - last) * task.width / LANES * block;
            let out = &mut data.constants[row..row + task.width / LANES * block];
            for (group, out) in out.chunks_exact_mut(block).enumerate() {
                constants::<S, O, O2>(s, tiling, &buffers.subsets, task.width, group * LANES, out);
            }
        }
    }
}

/// Factors the normal matrices of eight subsets.
#[inline(always)]
fn constants<S: Simd, const O: usize, const O2: usize>(
    s: S,
    tiling: &Tiling,
    sums: &[f32],
    stride: usize,
    k: usize,
    out: &mut [f32],
) {
    let layout = Layout::new(O);
    let (m, m2) = (moments(O), moments(O2));
    let p = 2 * m;
    let zero = V::splat(s, 0.0);
    let one = V::splat(s, 1.0);
    macro_rules! at {
        ($plane:expr) => {{
            let o = ($plane) * stride + k;
            V::from_slice(s, &sums[o..o + LANES])
        }};
    }
    macro_rules! put {
        ($index:expr, $value:expr) => {{
            let o = ($index) * LANES;
            $value.store_slice(&mut out[o..o + LANES]);
        }};
    }
    let width = (2 * tiling.radius + 1) as f32;
    let inv_n = V::splat(s, 1.0 / (width * width));
    let (sf, sff) = (at!(3 * m2 + 4 * m), at!(3 * m2 + 4 * m + 1));
    let mean = sf * inv_n;
    let variance = sff - sf * mean;
    let mut g = [zero; 12];
    let mut gf = [zero; 12];
    for a in 0..p {
        g[a] = at!(3 * m2 + a);
        gf[a] = at!(3 * m2 + p + a) - mean * g[a];
    }
    let mut l = [[zero; 12]; 12];
    let mut d = [zero; 12];
    let mut safe = variance.simd_gt(V::splat(s, VARIANCE) * sff);
    for j in 0..p {
        for i in j..p {
            let ((ia, ja), (ib, jb)) = (EXPONENTS[i % m], EXPONENTS[j % m]);
            let mut t = at!((i / m + j / m) * m2 + monomial(ia + ib, ja + jb)) - g[i] * g[j] * inv_n;
            let original = t;
            for e in 0..j {
                t -= l[i][e] * l[j][e] * d[e];
            }
            if i == j {
                safe &= t.simd_gt(V::splat(s, PIVOT) * original);
                d[j] = t;
                put!(layout.d() + j, one / t);
            } else {
                l[i][j] = t / d[j];
                put!(layout.l(i, j), l[i][j]);
            }
        }
    }
    for a in 0..p {
        put!(layout.g() + a, g[a]);
        put!(layout.gf() + a, gf[a]);
    }
    put!(layout.mean(), mean);
    put!(layout.sff(), safe.select(variance, V::splat(s, -1.0)));
    // variance of a parameter: (H⁻¹)ᵢᵢ + (H⁻¹ Σ G f)ᵢ² / Σ f²
    let coupled = solve::<S, O>(s, out, gf);
    for c in 0..2 {
        let mut e = [zero; 12];
        e[c * m] = one;
        let own = solve::<S, O>(s, out, e)[c * m];
        let through = coupled[c * m];
        put!(layout.variance(c), own + through * through / variance);
        put!(layout.energy(c), at!(2 * c * m2));
    }
}

/// Solves the normal equations of eight subsets.
#[inline(always)]
pub(crate) fn solve<S: Simd, const O: usize>(s: S, constants: &[f32], mut b: [V<S>; 12]) -> [V<S>; 12] {
    let layout = Layout::new(O);
    let p = layout.p;
    macro_rules! at {
        ($index:expr) => {{
            let o = ($index) * LANES;
            V::from_slice(s, &constants[o..o + LANES])
        }};
    }
    for i in 1..p {
        let mut t = b[i];
        for j in 0..i {
            t -= at!(layout.l(i, j)) * b[j];
        }
        b[i] = t;
    }
    for i in 0..p {
        b[i] *= at!(layout.d() + i);
    }
    for i in (0..p - 1).rev() {
        let mut t = b[i];
        for j in i + 1..p {
            t -= at!(layout.l(j, i)) * b[j];
        }
        b[i] = t;
    }
    b
}
