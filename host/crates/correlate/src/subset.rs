//! One reference subset, packed for streaming, with the moments that make its normal equations.

use crate::domain::extent;
use crate::prepared::Reference;
use crate::sampler::V;
use fearless_simd::prelude::*;

pub(crate) const LANES: usize = 8;

/// How a square subset is cut into groups of eight pixels: along its rows, with one or two columns
/// left over cut down the columns (33 = 4·8 + 1), or with a partly filled group at each row's end.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Layout {
    pub(crate) radius: usize,
    pub(crate) width: usize,
    /// Groups per row.
    pub(crate) groups: usize,
    /// Pixels in the last group of each row.
    pub(crate) last: usize,
    /// Columns treated downwards.
    pub(crate) columns: usize,
}

impl Layout {
    pub(crate) fn new(radius: usize) -> Self {
        let width = 2 * radius + 1;
        let rest = width % LANES;
        if width > LANES && rest <= 2 {
            Self { radius, width, groups: width / LANES, last: LANES, columns: rest }
        } else {
            Self {
                radius,
                width,
                groups: width.div_ceil(LANES),
                last: if rest == 0 { LANES } else { rest },
                columns: 0,
            }
        }
    }

    /// Pixels of the subset.
    pub(crate) fn count(&self) -> usize {
        self.width * self.width
    }

    /// Groups down one column.
    pub(crate) fn column_groups(&self) -> usize {
        self.width.div_ceil(LANES)
    }

    pub(crate) fn floats(&self) -> usize {
        (self.width * self.groups + self.columns * self.column_groups()) * LANES
    }

    /// Position of pixel (column i, row d) of the subset in its packed form.
    pub(crate) fn place(&self, i: usize, d: usize) -> usize {
        let row_floats = self.groups * LANES;
        if i >= row_floats {
            let c = i - row_floats;
            (self.width * self.groups + c * self.column_groups()) * LANES + d
        } else {
            d * row_floats + i
        }
    }
}

/// Monomials ξ^i η^j in the order 1, ξ, η, ξ², ξη, η², ξ³, …
pub(crate) const fn monomial(i: usize, j: usize) -> usize {
    let d = i + j;
    d * (d + 1) / 2 + j
}

/// A reference subset: grey levels minus their mean and the gradients, group after group; unused
/// lanes and the pixels that a cut leaves out are zero. Coordinates in the moments are ξ/r and η/r.
#[derive(Default, Clone)]
pub(crate) struct Subset {
    pub(crate) centre: Option<(i32, i32)>,
    pub(crate) f: Vec<f32>,
    pub(crate) gx: Vec<f32>,
    pub(crate) gy: Vec<f32>,
    /// 1 for a used pixel, 0 for one left out, packed likewise; empty for a whole subset.
    pub(crate) cut: Vec<f32>,
    /// Pixels used.
    pub(crate) count: usize,
    /// Bounding box of the pixels used: smallest and largest ξ and η.
    pub(crate) extent: [f64; 4],
    pub(crate) mean: f64,
    /// Σ (f − mean)².
    pub(crate) sff: f64,
    /// Σ fx², Σ fx fy, Σ fy², each times the monomials up to twice the shape's order.
    pub(crate) products: [[f64; 15]; 3],
    /// Σ fx, Σ fy times the monomials of the shape.
    pub(crate) slopes: [[f64; 6]; 2],
    /// Σ fx (f − mean), Σ fy (f − mean) times the monomials of the shape.
    pub(crate) slopes_f: [[f64; 6]; 2],
}

impl Subset {
    /// Copies the subset around (x, y) and sums its moments for a shape function of order O. Its
    /// centre, and all of a whole subset or the used pixels of a cut one, must lie in the image.
    #[inline(always)]
    pub(crate) fn load<S: Simd, const O: usize>(
        &mut self,
        s: S,
        layout: &Layout,
        reference: &Reference,
        x: i32,
        y: i32,
        cut: &[bool],
    ) {
        self.select(layout, cut);
        if cut.is_empty() {
            self.copy(s, layout, reference, x, y);
        } else {
            self.copy_cut(layout, reference, x, y, cut);
        }
        let zero = V::splat(s, 0.0);
        let n = self.count as f64;
        let mut sum = zero;
        for c in self.f.chunks_exact(LANES) {
            sum += V::from_slice(s, c);
        }
        // grey levels were copied relative to the centre pixel: the sum stays small
        let shift = f64::from(sum.reduce_sum()) / n;
        self.mean += shift;
        self.subtract(s, layout, shift as f32);
        if !cut.is_empty() {
            self.f.iter_mut().zip(&self.cut).for_each(|(f, c)| *f *= c);
        }
        self.moments::<S, O>(s, layout);
        self.centre = Some((x, y));
    }

    /// Notes which pixels are used.
    pub(crate) fn select(&mut self, layout: &Layout, cut: &[bool]) {
        self.cut.clear();
        if cut.is_empty() {
            let r = layout.radius as f64;
            self.extent = [-r, r, -r, r];
            self.count = layout.count();
            return;
        }
        self.cut.resize(layout.floats(), 0.0);
        for (k, _) in cut.iter().enumerate().filter(|c| *c.1) {
            self.cut[layout.place(k % layout.width, k / layout.width)] = 1.0;
        }
        self.extent = extent(cut, layout.radius);
        self.count = cut.iter().filter(|&&c| c).count();
    }

    fn copy_cut(&mut self, layout: &Layout, reference: &Reference, x: i32, y: i32, cut: &[bool]) {
        for v in [&mut self.f, &mut self.gx, &mut self.gy] {
            v.clear();
            v.resize(layout.floats(), 0.0);
        }
        let r = layout.radius as i32;
        let centre = reference.image.row(y as usize)[x as usize];
        self.mean = f64::from(centre);
        for (k, _) in cut.iter().enumerate().filter(|c| *c.1) {
            let (i, d) = (k % layout.width, k / layout.width);
            let (a, b) = (x - r + i as i32, y - r + d as i32);
            let (at, o) = (layout.place(i, d), reference.gx.index(a, b));
            self.f[at] = reference.image.row(b as usize)[a as usize] - centre;
            self.gx[at] = reference.gx.data[o];
            self.gy[at] = reference.gy.data[o];
        }
    }

    #[inline(always)]
    fn copy<S: Simd>(&mut self, s: S, layout: &Layout, reference: &Reference, x: i32, y: i32) {
        let floats = layout.floats();
        if self.f.len() != floats {
            for v in [&mut self.f, &mut self.gx, &mut self.gy] {
                v.clear();
                v.resize(floats, 0.0);
            }
        }
        let r = layout.radius;
        let (x0, y0) = (x as usize - r, y as usize - r);
        let image = &reference.image;
        let centre = image.row(y as usize)[x as usize];
        self.mean = f64::from(centre);
        let row_floats = layout.groups * LANES;
        let used = (layout.groups - 1) * LANES + layout.last;
        let level = V::splat(s, centre);
        let whole = if layout.last == LANES { row_floats } else { row_floats - LANES };
        for d in 0..layout.width {
            let at = d * row_floats;
            let src = &image.row(y0 + d)[x0..x0 + layout.width];
            let o = reference.gx.index(x0 as i32, (y0 + d) as i32);
            let (sx, sy) = (&reference.gx.data[o..], &reference.gy.data[o..]);
            let f = &mut self.f[at..at + row_floats];
            let gx = &mut self.gx[at..at + row_floats];
            let gy = &mut self.gy[at..at + row_floats];
            // by vectors: rows are too short for calls to memcpy
            for k in (0..whole).step_by(LANES) {
                (V::from_slice(s, &src[k..k + LANES]) - level).store_slice(&mut f[k..k + LANES]);
                V::from_slice(s, &sx[k..k + LANES]).store_slice(&mut gx[k..k + LANES]);
                V::from_slice(s, &sy[k..k + LANES]).store_slice(&mut gy[k..k + LANES]);
            }
            for k in whole..used {
                f[k] = src[k] - centre;
                gx[k] = sx[k];
                gy[k] = sy[k];
            }
        }
        for c in 0..layout.columns {
            let at = layout.width * row_floats + c * layout.column_groups() * LANES;
            let col = x0 + layout.groups * LANES + c;
            for d in 0..layout.width {
                self.f[at + d] = image.row(y0 + d)[col] - centre;
                let o = reference.gx.index(col as i32, (y0 + d) as i32);
                self.gx[at + d] = reference.gx.data[o];
                self.gy[at + d] = reference.gy.data[o];
            }
        }
    }

    #[inline(always)]
    fn subtract<S: Simd>(&mut self, s: S, layout: &Layout, mean: f32) {
        let m = V::splat(s, mean);
        for c in self.f.chunks_exact_mut(LANES) {
            (V::from_slice(s, c) - m).store_slice(c);
        }
        let row_floats = layout.groups * LANES;
        let rows = layout.width * row_floats;
        if layout.last < LANES {
            for row in self.f[..rows].chunks_exact_mut(row_floats) {
                row[row_floats - LANES + layout.last..].fill(0.0);
            }
        }
        for column in self.f[rows..].chunks_exact_mut(layout.column_groups() * LANES) {
            column[layout.width..].fill(0.0);
        }
    }

    #[inline(always)]
    fn moments<S: Simd, const O: usize>(&mut self, s: S, layout: &Layout) {
        let zero = V::splat(s, 0.0);
        let lanes = V::from_fn(s, |l| l as f32);
        let r = layout.radius as f32;
        let rinv = 1.0 / r;
        let mut h = [[zero; 15]; 3];
        let mut g = [[zero; 6]; 2];
        let mut gf = [[zero; 6]; 2];
        let mut sff = zero;
        let row_floats = layout.groups * LANES;
        let rows = layout.width * row_floats;
        for d in 0..layout.width {
            let (mut th, mut tg, mut tf) = ([[zero; 5]; 3], [[zero; 3]; 2], [[zero; 3]; 2]);
            let at = d * row_floats;
            let f = &self.f[at..at + row_floats];
            let gx = &self.gx[at..at + row_floats];
            let gy = &self.gy[at..at + row_floats];
            for k in (0..row_floats).step_by(LANES) {
                let e = (lanes + V::splat(s, k as f32 - r)) * V::splat(s, rinv);
                let fv = V::from_slice(s, &f[k..k + LANES]);
                let xv = V::from_slice(s, &gx[k..k + LANES]);
                let yv = V::from_slice(s, &gy[k..k + LANES]);
                sff = fv.mul_add(fv, sff);
                let mut p = [xv * xv, xv * yv, yv * yv];
                let mut q = [xv, yv];
                for i in 0..=2 * O {
                    for c in 0..3 {
                        th[c][i] += p[c];
                        p[c] *= e;
                    }
                }
                for i in 0..=O {
                    for c in 0..2 {
                        tg[c][i] += q[c];
                        tf[c][i] = q[c].mul_add(fv, tf[c][i]);
                        q[c] *= e;
                    }
                }
            }
            let eta = V::splat(s, (d as f32 - r) * rinv);
            let mut power = V::splat(s, 1.0);
            for j in 0..=2 * O {
                for i in 0..=2 * O - j {
                    for c in 0..3 {
                        h[c][monomial(i, j)] = th[c][i].mul_add(power, h[c][monomial(i, j)]);
                    }
                }
                if j <= O {
                    for i in 0..=O - j {
                        for c in 0..2 {
                            let m = monomial(i, j);
                            g[c][m] = tg[c][i].mul_add(power, g[c][m]);
                            gf[c][m] = tf[c][i].mul_add(power, gf[c][m]);
                        }
                    }
                }
                power *= eta;
            }
        }
        let column_floats = layout.column_groups() * LANES;
        for c in 0..layout.columns {
            let at = rows + c * column_floats;
            let e = V::splat(s, ((layout.groups * LANES + c) as f32 - r) * rinv);
            for k in (0..column_floats).step_by(LANES) {
                let eta = (lanes + V::splat(s, k as f32 - r)) * V::splat(s, rinv);
                let fv = V::from_slice(s, &self.f[at + k..at + k + LANES]);
                let xv = V::from_slice(s, &self.gx[at + k..at + k + LANES]);
                let yv = V::from_slice(s, &self.gy[at + k..at + k + LANES]);
                sff = fv.mul_add(fv, sff);
                let (pp, qq) = ([xv * xv, xv * yv, yv * yv], [xv, yv]);
                let mut power = V::splat(s, 1.0);
                for j in 0..=2 * O {
                    let mut m = power;
                    for i in 0..=2 * O - j {
                        for c in 0..3 {
                            h[c][monomial(i, j)] = pp[c].mul_add(m, h[c][monomial(i, j)]);
                        }
                        if i + j <= O {
                            for c in 0..2 {
                                let a = monomial(i, j);
                                let t = qq[c] * m;
                                g[c][a] += t;
                                gf[c][a] = t.mul_add(fv, gf[c][a]);
                            }
                        }
                        m *= e;
                    }
                    power *= eta;
                }
            }
        }
        self.sff = f64::from(sff.reduce_sum());
        for c in 0..3 {
            for k in 0..monomial(0, 2 * O) + 1 {
                self.products[c][k] = f64::from(h[c][k].reduce_sum());
            }
        }
        for c in 0..2 {
            for k in 0..monomial(0, O) + 1 {
                self.slopes[c][k] = f64::from(g[c][k].reduce_sum());
                self.slopes_f[c][k] = f64::from(gf[c][k].reduce_sum());
            }
        }
    }
}
