//! From the Lagrangian to the Eulerian description of a displacement field.

use crate::point::Point;
use crate::points::Points;
use crate::shape::Warp;

/// Displacement of the material that is at (x, y) in the deformed image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EulerianPoint {
    /// Position in the deformed image, pixels.
    pub x: f64,
    /// Position in the deformed image, pixels.
    pub y: f64,
    /// Displacement along x, pixels: the material was at (x − u, y − v) in the reference image.
    pub u: f64,
    /// Displacement along y, pixels.
    pub v: f64,
    /// Standard uncertainty of u, pixels.
    pub sigma_u: f32,
    /// Standard uncertainty of v, pixels.
    pub sigma_v: f32,
    /// Index of the Lagrangian point nearest to the material in the reference image.
    pub nearest: usize,
}

/// Newton steps for the inverse of the map.
const MAX_STEPS: usize = 20;
/// Motion at which it has arrived, pixels.
const CLOSE: f64 = 1e-9;
/// Motion of the last step that is allowed where the steps go to and fro over the seam between a
/// whole cell and a single shape function, pixels.
const SEAM: f64 = 0.01;

/// The Eulerian field u_E(x) = u(X) with x = X + u(X), at positions `at` of the deformed image,
/// from the Lagrangian results `found` at `points`.
///
/// Between the four points of a grid's cell the displacement is Σ wᵢ [uᵢ + ½ ∇uᵢ·(X − Xᵢ)] with
/// bilinear weights wᵢ: exact for fields of the second degree. Where a corner of the cell is not
/// `ok`, and for scattered points, it is the shape function of the nearest `ok` point, up to one
/// spacing from it. Beyond that, and where no material arrives, the answer is `None`. The
/// uncertainty is that of the nearest point through the inverse deformation gradient,
/// δu_E = (1 + ∇u)⁻¹ δu.
///
/// `found` has one entry per point, in their order; what is missing counts as not `ok`.
pub fn eulerian(points: &Points, found: &[Point], at: &[[f64; 2]]) -> Vec<Option<EulerianPoint>> {
    let field = Field::new(points, found);
    at.iter().map(|&x| field.inverse(x)).collect()
}

/// Lists of points by position.
struct Buckets {
    low: [f64; 2],
    cell: f64,
    columns: usize,
    rows: usize,
    starts: Vec<u32>,
    order: Vec<u32>,
}

impl Buckets {
    /// Of those positions that are given, about one per bucket.
    fn new(positions: &[(usize, [f64; 2])]) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for (_, p) in positions {
            for c in 0..2 {
                low[c] = low[c].min(p[c]);
                high[c] = high[c].max(p[c]);
            }
        }
        let count = positions.len().max(1) as f64;
        let (w, h) = ((high[0] - low[0]).max(1.0), (high[1] - low[1]).max(1.0));
        let cell = (w * h / count).sqrt().max(w.max(h) / (2.0 * count)).max(1e-3);
        let (columns, rows) = ((w / cell) as usize + 1, (h / cell) as usize + 1);
        let mut buckets =
            Self { low, cell, columns, rows, starts: vec![0; columns * rows + 1], order: Vec::new() };
        let mut keyed: Vec<(usize, u32)> =
            positions.iter().map(|(k, p)| (buckets.bucket(*p), *k as u32)).collect();
        keyed.sort_unstable();
        for (b, _) in &keyed {
            buckets.starts[b + 1] += 1;
        }
        for b in 0..columns * rows {
            buckets.starts[b + 1] += buckets.starts[b];
        }
        buckets.order = keyed.into_iter().map(|(_, k)| k).collect();
        buckets
    }

    fn place(&self, p: [f64; 2]) -> (usize, usize) {
        // positions outside belong to the outermost buckets: casts saturate
        let i = (((p[0] - self.low[0]) / self.cell) as usize).min(self.columns - 1);
        let j = (((p[1] - self.low[1]) / self.cell) as usize).min(self.rows - 1);
        (i, j)
    }

    fn bucket(&self, p: [f64; 2]) -> usize {
        let (i, j) = self.place(p);
        j * self.columns + i
    }

    /// The nearest point not farther than `reach` by `distance` (squared); ties go to the lower index.
    fn nearest(&self, p: [f64; 2], reach: f64, distance: impl Fn(usize) -> f64) -> Option<usize> {
        if self.order.is_empty() {
            return None;
        }
        let (a, b) = self.place([p[0] - reach, p[1] - reach]);
        let (c, d) = self.place([p[0] + reach, p[1] + reach]);
        let mut best: Option<(f64, usize)> = None;
        for j in b..=d {
            let row = j * self.columns;
            for &k in &self.order[self.starts[row + a] as usize..self.starts[row + c + 1] as usize] {
                let k = k as usize;
                let e = distance(k);
                if e <= reach * reach && best.is_none_or(|(s, m)| e < s || (e == s && k < m)) {
                    best = Some((e, k));
                }
            }
        }
        best.map(|b| b.1)
    }
}

/// A Lagrangian field that can be evaluated and inverted.
struct Field<'a> {
    points: &'a Points,
    found: &'a [Point],
    before: Buckets,
    after: Buckets,
    /// Farthest that a shape function is trusted, pixels.
    reach: f64,
    /// Farthest that neighbouring points come apart, pixels.
    stretched: f64,
}

struct Value {
    u: [f64; 2],
    gradient: [[f64; 2]; 2],
    nearest: usize,
}

fn square(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)
}

/// Displacement and derivatives about the point itself.
fn local(p: &Point) -> Warp {
    let mut warp = Warp::of(&p.shape).moved(p.x - p.x.round(), p.y - p.y.round());
    (warp.0[0][0], warp.0[1][0]) = (p.u, p.v);
    warp
}

impl<'a> Field<'a> {
    fn new(points: &'a Points, found: &'a [Point]) -> Self {
        let count = points.len().min(found.len());
        let ok = || (0..count).filter(|&k| found[k].status.is_ok());
        let before: Vec<(usize, [f64; 2])> = ok().map(|k| (k, points.positions()[k])).collect();
        let after: Vec<(usize, [f64; 2])> =
            ok().map(|k| (k, [found[k].x + found[k].u, found[k].y + found[k].v])).collect();
        let (before, after) = (Buckets::new(&before), Buckets::new(&after));
        let reach = points.as_grid().map_or(before.cell, |g| g.step as f64);
        // principal stretches up to e^0.7, as large as settings let them become
        Self { points, found, before, after, reach, stretched: 2.0 * reach }
    }

    fn ok(&self, k: usize) -> Option<&Point> {
        self.found.get(k).filter(|p| p.status.is_ok())
    }

    /// The field at a position of the reference image.
    fn at(&self, x: [f64; 2]) -> Option<Value> {
        let nearest = self.before.nearest(x, self.reach, |k| square(self.points.positions()[k], x))?;
        if let Some(value) = self.in_cell(x, nearest) {
            return Some(value);
        }
        let p = self.ok(nearest)?;
        let (dx, dy) = (x[0] - p.x, x[1] - p.y);
        let here = local(p).moved(dx, dy);
        let [[a, b], [c, d]] = here.deformation();
        Some(Value { u: [here.0[0][0], here.0[1][0]], gradient: [[a - 1.0, b], [c, d - 1.0]], nearest })
    }

    /// The same from the four corners of the grid's cell, if all of them are `ok`.
    fn in_cell(&self, x: [f64; 2], nearest: usize) -> Option<Value> {
        let grid = self.points.as_grid()?;
        let step = grid.step as f64;
        let (s, t) = ((x[0] - grid.x0 as f64) / step, (x[1] - grid.y0 as f64) / step);
        if !(s >= 0.0 && t >= 0.0) {
            return None;
        }
        // the last row and column belong to the cell before them
        let i = (s as usize).min(grid.columns.saturating_sub(2));
        let j = (t as usize).min(grid.rows.saturating_sub(2));
        let (s, t) = (s - i as f64, t - j as f64);
        if s > 1.0 || t > 1.0 {
            return None;
        }
        let (mut u, mut gradient) = ([0.0; 2], [[0.0; 2]; 2]);
        for (a, b) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let p = self.ok(grid.point(i + a, j + b)?)?;
            let (wx, wy) = (if a == 1 { s } else { 1.0 - s }, if b == 1 { t } else { 1.0 - t });
            let (sx, sy) = (if a == 1 { 1.0 } else { -1.0 }, if b == 1 { 1.0 } else { -1.0 });
            let slopes =
                [[p.shape.u[1], p.shape.u[2]], [p.shape.v[1], p.shape.v[2]]].map(|g| g.map(f64::from));
            for (c, value) in [p.u, p.v].into_iter().enumerate() {
                let [gx, gy] = slopes[c];
                let here = value + 0.5 * (gx * (x[0] - p.x) + gy * (x[1] - p.y));
                u[c] += wx * wy * here;
                gradient[c][0] += sx / step * wy * here + 0.5 * wx * wy * gx;
                gradient[c][1] += sy / step * wx * here + 0.5 * wx * wy * gy;
            }
        }
        Some(Value { u, gradient, nearest })
    }

    /// X with X + u(X) = x by Newton's method, from the point that arrives nearest to x.
    fn inverse(&self, x: [f64; 2]) -> Option<EulerianPoint> {
        if !x.iter().all(|c| c.is_finite()) {
            return None;
        }
        let arrives = |k: usize| [self.found[k].x + self.found[k].u, self.found[k].y + self.found[k].v];
        let start = self.ok(self.after.nearest(x, self.stretched, |k| square(arrives(k), x))?)?;
        let mut before = [start.x, start.y];
        for n in 1..=MAX_STEPS {
            let Value { u, gradient, nearest } = self.at(before)?;
            let rest = [x[0] - before[0] - u[0], x[1] - before[1] - u[1]];
            let (a, b) = (1.0 + gradient[0][0], gradient[0][1]);
            let (c, d) = (gradient[1][0], 1.0 + gradient[1][1]);
            let det = a * d - b * c;
            if det.is_nan() || det <= 1e-3 {
                return None;
            }
            let inverse = [[d / det, -b / det], [-c / det, a / det]];
            let step = inverse.map(|row| row[0] * rest[0] + row[1] * rest[1]);
            before = [before[0] + step[0], before[1] + step[1]];
            let motion = step[0].abs().max(step[1].abs());
            if motion < CLOSE || n == MAX_STEPS && motion < SEAM {
                let p = self.ok(nearest)?;
                let (su, sv) = (f64::from(p.sigma_u), f64::from(p.sigma_v));
                let sigma = inverse.map(|row| (row[0] * su).hypot(row[1] * sv) as f32);
                return Some(EulerianPoint {
                    x: x[0],
                    y: x[1],
                    u: x[0] - before[0],
                    v: x[1] - before[1],
                    sigma_u: sigma[0],
                    sigma_v: sigma[1],
                    nearest,
                });
            }
        }
        None
    }
}
