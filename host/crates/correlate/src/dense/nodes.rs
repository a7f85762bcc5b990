//! The displacement field between the passes: its values at the grid nodes and beyond the grid's
//! edge as far as subsets reach; bilinear between them.

use super::tiling::Tiling;
use crate::plane::resize;
use crate::shape::Warp;

/// A field on the nodes of a grid, `margin` more on every side, and some columns to spare for whole
/// vectors.
#[derive(Default, Clone)]
pub(crate) struct Nodes {
    pub(crate) stride: usize,
    /// Whole pixels taken out of the field, so that single precision is spent on the rest.
    pub(crate) base: [i32; 2],
    /// Displacement, less the base.
    pub(crate) u: Vec<f32>,
    pub(crate) v: Vec<f32>,
    /// What the linearised equations know the field by: (I + A)⁻¹ (w − w₀), with the affine field w₀
    /// of gradient A through all points. To first order the increment of a subset is taken in the
    /// reference's coordinates, where its gradients are.
    pub(crate) cu: Vec<f32>,
    pub(crate) cv: Vec<f32>,
    pub(crate) affine: Affine,
}

/// w₀ about node (0, 0), base not included, in pixels.
#[derive(Default, Clone, Copy, Debug)]
pub(crate) struct Affine {
    pub(crate) u: [f64; 3],
    pub(crate) v: [f64; 3],
}

impl Affine {
    pub(crate) fn at(&self, x: f64, y: f64) -> [f64; 2] {
        let f = |c: &[f64; 3]| c[0] + c[1] * x + c[2] * y;
        [f(&self.u), f(&self.v)]
    }

    /// I + A.
    pub(crate) fn matrix(&self) -> [[f64; 2]; 2] {
        [[1.0 + self.u[1], self.u[2]], [self.v[1], 1.0 + self.v[2]]]
    }

    fn inverse(&self) -> [[f64; 2]; 2] {
        let [[a, b], [c, d]] = self.matrix();
        let det = a * d - b * c;
        if det.abs() < 0.1 || !det.is_finite() {
            return [[1.0, 0.0], [0.0, 1.0]];
        }
        [[d / det, -b / det], [-c / det, a / det]]
    }
}

impl Nodes {
    fn resize(&mut self, tiling: &Tiling) {
        let e = tiling.margin();
        self.stride = tiling.columns.next_multiple_of(8) + 2 * e + 32;
        let n = self.stride * (tiling.rows + 2 * e + 1);
        for v in [&mut self.u, &mut self.v, &mut self.cu, &mut self.cv] {
            resize(v, n);
        }
    }

    /// Affine field and base from the mean of the known points.
    fn common(&mut self, tiling: &Tiling, known: impl Iterator<Item = (usize, usize, Warp)>) {
        let (mut n, mut x, mut y, mut m) = (0.0, 0.0, 0.0, [0.0; 6]);
        for (i, j, w) in known {
            n += 1.0;
            x += (i * tiling.step) as f64;
            y += (j * tiling.step) as f64;
            for c in 0..2 {
                for k in 0..3 {
                    m[3 * c + k] += w.0[c][k];
                }
            }
        }
        if n == 0.0 {
            return;
        }
        for e in &mut m {
            *e /= n;
        }
        self.base = [m[0].round() as i32, m[3].round() as i32];
        let at_origin = |k: usize, base: i32| m[k] - f64::from(base) - m[k + 1] * x / n - m[k + 2] * y / n;
        self.affine = Affine {
            u: [at_origin(0, self.base[0]), m[1], m[2]],
            v: [at_origin(3, self.base[1]), m[4], m[5]],
        };
    }

    /// Field through sparse points at grid columns `columns` × rows `rows` (ascending): a bilinear
    /// blend of the affine extrapolations of the four around each node.
    pub(crate) fn through_sparse(
        &mut self,
        tiling: &Tiling,
        columns: &[usize],
        rows: &[usize],
        known: &[Warp],
    ) {
        self.resize(tiling);
        let place = |k: usize| (columns[k % columns.len()], rows[k / columns.len()]);
        self.common(tiling, known.iter().enumerate().map(|(k, w)| (place(k).0, place(k).1, *w)));
        let e = tiling.margin() as i64;
        let step = tiling.step as f32;
        let around = |list: &[usize], i: i64| -> (usize, usize, f32) {
            if list.len() < 2 {
                return (0, 0, 0.0);
            }
            let k = list.partition_point(|&v| (v as i64) <= i).clamp(1, list.len() - 1);
            let (a, b) = (list[k - 1] as i64, list[k] as i64);
            (k - 1, k, ((i - a) as f32 / (b - a) as f32).clamp(0.0, 1.0))
        };
        let width = tiling.columns as i64 + 2 * e;
        let across: Vec<_> = (0..width).map(|i| around(columns, i - e)).collect();
        // single precision suffices for where the first pass starts
        let flat: Vec<[f32; 6]> = known
            .iter()
            .map(|w| {
                let c = |c: usize, k: usize| w.0[c][k] as f32;
                [
                    (w.0[0][0] - f64::from(self.base[0])) as f32,
                    c(0, 1),
                    c(0, 2),
                    (w.0[1][0] - f64::from(self.base[1])) as f32,
                    c(1, 1),
                    c(1, 2),
                ]
            })
            .collect();
        for j in 0..tiling.rows as i64 + 2 * e + 1 {
            let (b0, b1, tb) = around(rows, j - e);
            let at = j as usize * self.stride;
            for (i, &(a0, a1, ta)) in across.iter().enumerate() {
                let (mut u, mut v) = (0.0, 0.0);
                for (b, wb) in [(b0, 1.0 - tb), (b1, tb)] {
                    let dy = (j - e - rows[b] as i64) as f32 * step;
                    for (a, wa) in [(a0, 1.0 - ta), (a1, ta)] {
                        let dx = (i as i64 - e - columns[a] as i64) as f32 * step;
                        let p = &flat[b * columns.len() + a];
                        u += wa * wb * (p[0] + p[1] * dx + p[2] * dy);
                        v += wa * wb * (p[3] + p[4] * dx + p[5] * dy);
                    }
                }
                self.u[at + i] = u;
                self.v[at + i] = v;
            }
        }
        self.reduce(tiling);
    }

    /// Replaces the value at grid node (i, j); displacement with the base.
    #[inline(always)]
    pub(crate) fn set(&mut self, tiling: &Tiling, i: usize, j: usize, u: f64, v: f64) {
        let e = tiling.margin();
        let at = (j + e) * self.stride + i + e;
        self.u[at] = (u - f64::from(self.base[0])) as f32;
        self.v[at] = (v - f64::from(self.base[1])) as f32;
    }

    /// Extends the field beyond the grid with the gradients of the outermost points, and derives
    /// what the equations need of it.
    pub(crate) fn finish(&mut self, tiling: &Tiling, gradients: impl Fn(usize, usize) -> Option<[f64; 4]>) {
        let e = tiling.margin();
        let (columns, rows) = (tiling.columns, tiling.rows);
        for j in 0..rows + 2 * e {
            let inner = (j.max(e) - e).min(rows - 1);
            let outside_y = inner + e != j;
            let mut i = 0;
            while i < columns + 2 * e {
                if !outside_y && i == e && columns > 1 {
                    i = columns + e;
                }
                let near = (i.max(e) - e).min(columns - 1);
                if let Some(g) = gradients(near, inner) {
                    let dx = (i as f64 - (near + e) as f64) * tiling.step as f64;
                    let dy = (j as f64 - (inner + e) as f64) * tiling.step as f64;
                    let from = (inner + e) * self.stride + near + e;
                    let at = j * self.stride + i;
                    if at != from {
                        self.u[at] = self.u[from] + (g[0] * dx + g[1] * dy) as f32;
                        self.v[at] = self.v[from] + (g[2] * dx + g[3] * dy) as f32;
                    }
                }
                i += 1;
            }
        }
        self.reduce(tiling);
    }

    fn reduce(&mut self, tiling: &Tiling) {
        let e = tiling.margin() as f64;
        let step = tiling.step as f64;
        let m = self.affine.inverse();
        let width = tiling.columns + 2 * tiling.margin();
        let a = self.affine;
        for j in 0..self.u.len() / self.stride {
            let at = j * self.stride;
            let (u, v) = (&mut self.u[at..at + self.stride], &mut self.v[at..at + self.stride]);
            // columns to spare repeat the last one
            let (lu, lv) = (u[width - 1], v[width - 1]);
            u[width..].fill(lu);
            v[width..].fill(lv);
            let [u0, v0] = a.at(-e * step, (j as f64 - e) * step);
            let (cu, cv) = (&mut self.cu[at..at + self.stride], &mut self.cv[at..at + self.stride]);
            for i in 0..self.stride {
                let x = i as f64 * step;
                let du = f64::from(u[i]) - (u0 + a.u[1] * x);
                let dv = f64::from(v[i]) - (v0 + a.v[1] * x);
                cu[i] = (m[0][0] * du + m[0][1] * dv) as f32;
                cv[i] = (m[1][0] * du + m[1][1] * dv) as f32;
            }
        }
    }
}
