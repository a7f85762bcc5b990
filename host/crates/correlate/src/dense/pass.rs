//! One dense pass: every pixel is warped once with the common field, and the normal equations of
//! all overlapping subsets follow from window sums.
//!
//! With w(x) the common field and p(x) the polynomial of one subset, to first order
//! g(x + p) = g(x + w) + ∇f·δ, (I + ∇w) δ = p − w. Minimising ZNSSD over p then needs only window
//! sums of G r and G h, with r = f − g(x + w) and h = ∇f·(I + A)⁻¹(w − w₀). That w is not the
//! subset's own polynomial is not neglected, only the square of the difference is.

use super::nodes::Nodes;
use super::reference::{self, FIELD_BLOCK, Line, Prepared, corner, lines};
use super::sums::{Group, SumBuffers, flush};
use super::tiling::{DEGREES, LANES, Task, Tiling, moments};
use super::warp::{RowField, Spread, warp_row};
use crate::plane::{Plane, resize};
use crate::prepared::Reference;
use crate::sampler::V;
use crate::settings::{Criterion, Interpolation};
use crate::simd::dispatch;
use fearless_simd::{Level, prelude::*};
use fearless_simd_macros::simd;

/// What a pass leaves for eight neighbouring subsets, in vectors: the increments of the parameters
/// (in (I + A)⁻¹ p − w₀, coordinates ξ/r and η/r), then these.
pub(crate) const ZNCC: usize = 0;
/// Gain from deformed to reference grey levels.
pub(crate) const GAIN: usize = 1;
/// Largest distance, in pixels, between the subset's polynomial and the field it was solved in.
pub(crate) const DISTANCE: usize = 2;
const EXTRA: usize = 3;

/// Vectors per eight subsets.
pub(crate) const fn outputs(order: usize) -> usize {
    2 * moments(order) + EXTRA
}

/// Working memory of one thread.
#[derive(Default)]
pub(crate) struct Buffers {
    pub(crate) sums: SumBuffers,
    pub(crate) line: Line,
    rows: Rows,
}

/// One row of pixels.
#[derive(Default)]
struct Rows {
    /// Deformed image, in the order of the pixels and of the tiles.
    g: Vec<f32>,
    g_split: Vec<f32>,
    /// Displacement and field of the equations at the nodes of this row, and the difference to the
    /// next node (of the displacement: per pixel).
    nodes: [[Vec<f32>; 2]; 4],
}

/// What is common to all tasks of a pass.
pub(crate) struct Pass<'a> {
    pub(crate) tiling: &'a Tiling,
    pub(crate) reference: &'a Reference,
    pub(crate) nodes: &'a Nodes,
    pub(crate) plane: &'a Plane,
    /// Reference grey levels hold f − `f_offset`, coefficients g − `g_offset`.
    pub(crate) criterion: Criterion,
    pub(crate) interpolation: Interpolation,
    pub(crate) order: usize,
}

impl Pass<'_> {
    pub(crate) fn run(
        &self,
        level: Level,
        task: &Task,
        data: &Prepared,
        buffers: &mut Buffers,
        out: &mut Vec<f32>,
    ) {
        resize(out, task.rows * task.width * outputs(self.order));
        macro_rules! go {
            ($n:literal, $n1:literal, $o:literal) => {
                dispatch!(level, s => run::<_, $n, $n1, $o>(s, self, task, data, buffers, out))
            };
        }
        use Interpolation::{Cubic, Quintic, Septic};
        match (self.interpolation, self.order) {
            (Septic, 0) => go!(8, 9, 0),
            (Septic, 1) => go!(8, 9, 1),
            (Septic, _) => go!(8, 9, 2),
            (Quintic, 0) => go!(6, 7, 0),
            (Quintic, 1) => go!(6, 7, 1),
            (Quintic, _) => go!(6, 7, 2),
            (Cubic, 0) => go!(4, 5, 0),
            (Cubic, 1) => go!(4, 5, 1),
            (Cubic, _) => go!(4, 5, 2),
        }
    }
}

#[simd]
fn run<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    pass: &Pass<'_>,
    task: &Task,
    data: &Prepared,
    buffers: &mut Buffers,
    out: &mut [f32],
) {
    let tiling = pass.tiling;
    let groups = [Group { count: 4, degree: O }, Group { count: 4, degree: 0 }];
    let planes = groups.iter().map(|g| g.planes()).sum();
    let Buffers { sums, rows, line } = buffers;
    sums.prepare(tiling, task, planes);
    rows.prepare(tiling, task);
    let powers: Vec<[f32; DEGREES]> = (0..tiling.step).map(|p| tiling.powers(p)).collect();
    let (step, lead) = (tiling.step, tiling.lead());
    let phases: Vec<Phase> = (0..step)
        .map(|p| Phase { node: (p + lead) / step, t: ((p + lead) % step) as f32 / step as f32, x: powers[p] })
        .collect();
    let spread = Spread::new(step, lead);
    let places = places(tiling);
    let rem = tiling.whole().1;
    let last = tiling.last();
    let mut next = 0..lines(tiling, task);
    let block = reference::Layout::new(O).len() * LANES;
    let (x, y) = corner(tiling, task);
    let (x, y) = (x + pass.nodes.base[0], y + pass.nodes.base[1]);
    for b in 0..task.rows + last {
        let whole = b + 1 < task.rows + last || rem == 0;
        for down in 0..if whole { step } else { rem } {
            if down == rem {
                sums.part(s, tiling, task, &groups, b);
            }
            if let Some(n) = next.next() {
                line.load(tiling, task, pass.reference, n);
                rows.field(s, tiling, task, pass.nodes, n);
                let Rows { g, g_split, nodes } = &mut *rows;
                let [[u, su], [v, sv], ..] = &*nodes;
                let field = RowField { u, su, v, sv, spread: &spread };
                warp_row::<S, N, N1>(s, pass.plane, x, y + n as i32, &field, g);
                reference::split(step, g, LANES, 0, g_split);
                let input = Input { fields: &line.fields, g: g_split, nodes, phases: &phases, rem };
                let y = (&powers[down], down == 0);
                accumulate::<S, O>(s, &input, y, &mut sums.tiles, task.tiles);
            }
        }
        if !whole {
            sums.part(s, tiling, task, &groups, b);
        }
        if sums.close(s, tiling, task, &groups, b, whole) {
            let j = b - last;
            let vectors = task.width / LANES;
            let constants = &data.constants[j * vectors * block..(j + 1) * vectors * block];
            let size = outputs(O) * LANES;
            let out = &mut out[j * vectors * size..(j + 1) * vectors * size];
            for (group, (c, o)) in constants.chunks_exact(block).zip(out.chunks_exact_mut(size)).enumerate() {
                increments::<S, O>(s, pass, &sums.subsets, task.width, group * LANES, c, o);
                distance::<S, O>(s, pass, task, &places, j, group * LANES, o);
            }
        }
    }
}

impl Rows {
    fn prepare(&mut self, tiling: &Tiling, task: &Task) {
        let pixels = task.tiles * tiling.step;
        self.g.resize(pixels, 0.0);
        self.g_split.resize(pixels, 0.0);
        for n in self.nodes.iter_mut().flatten() {
            n.resize(task.tiles + 2 * LANES, 0.0);
        }
    }

    /// The field at the nodes along row `line` of the task's pixels.
    #[inline(always)]
    fn field<S: Simd>(&mut self, s: S, tiling: &Tiling, task: &Task, nodes: &Nodes, line: usize) {
        let step = tiling.step;
        let down = line + tiling.lead();
        let t = V::splat(s, (down % step) as f32 / step as f32);
        let at = (task.row + down / step) * nodes.stride + task.column;
        let n = task.tiles + 2 * LANES;
        let (upper, lower) = (at..at + n, at + nodes.stride..at + nodes.stride + n);
        let per_pixel = V::splat(s, 1.0 / step as f32);
        let one = V::splat(s, 1.0);
        let fields = [(&nodes.u, per_pixel), (&nodes.v, per_pixel), (&nodes.cu, one), (&nodes.cv, one)];
        for ((field, scale), [value, difference]) in fields.into_iter().zip(&mut self.nodes) {
            let rows = field[upper.clone()].chunks_exact(LANES).zip(field[lower.clone()].chunks_exact(LANES));
            for ((a, b), o) in rows.zip(value.chunks_exact_mut(LANES)) {
                let a = V::from_slice(s, a);
                (V::from_slice(s, b) - a).mul_add(t, a).store_slice(o);
            }
            let next = value[1..].chunks_exact(LANES);
            for ((a, b), o) in value.chunks_exact(LANES).zip(next).zip(difference.chunks_exact_mut(LANES)) {
                ((V::from_slice(s, b) - V::from_slice(s, a)) * scale).store_slice(o);
            }
        }
    }
}

/// One phase of the tiles.
struct Phase {
    /// Node left of it, counted from the tile's own: 0 or 1.
    node: usize,
    /// Way from there to the next node.
    t: f32,
    /// Powers of the tile-local coordinate.
    x: [f32; DEGREES],
}

struct Input<'a> {
    fields: &'a [f32],
    g: &'a [f32],
    nodes: &'a [[Vec<f32>; 2]; 4],
    phases: &'a [Phase],
    rem: usize,
}

/// Adds one row of pixels to the tiles: fx r, fy r, fx h, fy h; r, h, r², f r.
#[inline(always)]
fn accumulate<S: Simd, const O: usize>(
    s: S,
    input: &Input<'_>,
    (y, is_first): (&[f32; DEGREES], bool),
    tiles: &mut [f32],
    stride: usize,
) {
    let zero = V::splat(s, 0.0);
    let step = input.phases.len();
    let half = tiles.len() / 2;
    let (whole, part) = tiles.split_at_mut(half);
    let rem = input.rem;
    let [_, _, [nu, du], [nv, dv]] = input.nodes;
    let blocks = input.fields.chunks_exact(step * FIELD_BLOCK).zip(input.g.chunks_exact(step * LANES));
    for (group, (block, g)) in blocks.enumerate() {
        let k = group * LANES;
        // the field at the tiles' own nodes and at the next ones
        let mut nodes = [[zero; 4]; 2];
        for (i, n) in nodes.iter_mut().enumerate() {
            let window = k + i..k + i + LANES;
            *n = [
                V::from_slice(s, &nu[window.clone()]),
                V::from_slice(s, &du[window.clone()]),
                V::from_slice(s, &nv[window.clone()]),
                V::from_slice(s, &dv[window]),
            ];
        }
        let mut a = [[zero; O_MAX]; 4];
        let mut q = [zero; 4];
        macro_rules! pixels {
            ($f:expr, $g:expr, $phases:expr) => {
                for ((f, g), phase) in $f.chunks_exact(FIELD_BLOCK).zip($g.chunks_exact(LANES)).zip($phases) {
                    let fv = V::from_slice(s, &f[..LANES]);
                    let xv = V::from_slice(s, &f[LANES..2 * LANES]);
                    let yv = V::from_slice(s, &f[2 * LANES..]);
                    let t = V::splat(s, phase.t);
                    let [nu, du, nv, dv] = nodes[phase.node & 1];
                    let h = xv.mul_add(t.mul_add(du, nu), yv * t.mul_add(dv, nv));
                    let r = fv - V::from_slice(s, g);
                    let products = [xv * r, yv * r, xv * h, yv * h];
                    for c in 0..4 {
                        a[c][0] += products[c];
                        for i in 1..=O {
                            a[c][i] = products[c].mul_add(V::splat(s, phase.x[i]), a[c][i]);
                        }
                    }
                    q[0] += r;
                    q[1] += h;
                    q[2] = r.mul_add(r, q[2]);
                    q[3] = fv.mul_add(r, q[3]);
                }
            };
        }
        macro_rules! add_to {
            ($tiles:expr) => {{
                let mut planes = &mut *$tiles;
                for c in &a {
                    flush::<S, O>(s, is_first, c, y, planes, stride, k);
                    planes = &mut planes[moments(O) * stride..];
                }
                for c in &q {
                    flush::<S, 0>(s, is_first, std::slice::from_ref(c), y, planes, stride, k);
                    planes = &mut planes[stride..];
                }
            }};
        }
        let (f0, f1) = block.split_at(rem * FIELD_BLOCK);
        let (g0, g1) = g.split_at(rem * LANES);
        let (p0, p1) = input.phases.split_at(rem);
        if rem > 0 {
            pixels!(f0, g0, p0);
            add_to!(part);
        }
        pixels!(f1, g1, p1);
        add_to!(whole);
    }
}

const O_MAX: usize = 3;

/// Solves eight subsets.
#[inline(always)]
fn increments<S: Simd, const O: usize>(
    s: S,
    pass: &Pass<'_>,
    sums: &[f32],
    stride: usize,
    k: usize,
    constants: &[f32],
    out: &mut [f32],
) {
    let layout = reference::Layout::new(O);
    let m = moments(O);
    let p = 2 * m;
    macro_rules! at {
        ($plane:expr) => {{
            let o = ($plane) * stride + k;
            V::from_slice(s, &sums[o..o + LANES])
        }};
    }
    macro_rules! constant {
        ($index:expr) => {{
            let o = ($index) * LANES;
            V::from_slice(s, &constants[o..o + LANES])
        }};
    }
    let width = (2 * pass.tiling.radius + 1) as f32;
    let inv_n = V::splat(s, 1.0 / (width * width));
    let one = V::splat(s, 1.0);
    let (r, h, rr, fr) = (at!(2 * p), at!(2 * p + 1), at!(2 * p + 2), at!(2 * p + 3));
    let (mr, mh) = (r * inv_n, h * inv_n);
    let sff = constant!(layout.sff());
    let srr = rr - r * mr;
    let sfr = fr - constant!(layout.mean()) * r;
    let sgg = (sff - sfr - sfr + srr).max(V::splat(s, 1e-20));
    let zncc = (sff - sfr) / (sff * sgg).sqrt();
    let gain = match pass.criterion {
        Criterion::Znssd => (sff / sgg).sqrt(),
        Criterion::Zssd => one,
    };
    let mut b = [V::splat(s, 0.0); 12];
    for a in 0..p {
        let g = constant!(layout.g() + a);
        let (gr, gh) = (at!(a) - mr * g, at!(p + a) - mh * g);
        b[a] = (one - gain) * constant!(layout.gf() + a) + gain.mul_add(gr, gh);
    }
    let b = reference::solve::<S, O>(s, constants, b);
    for a in 0..p {
        b[a].store_slice(&mut out[a * LANES..(a + 1) * LANES]);
    }
    zncc.store_slice(&mut out[(p + ZNCC) * LANES..][..LANES]);
    gain.store_slice(&mut out[(p + GAIN) * LANES..][..LANES]);
}

/// A place along one axis of the subset, on the nodes of the field.
struct Place {
    /// Node before it, counted from the subset's own, and the way from there to the next.
    node: i32,
    t: f32,
    /// In units of the radius.
    x: f32,
}

/// Five places from edge to edge.
fn places(tiling: &Tiling) -> [Place; 5] {
    let (r, step) = (tiling.radius as f64, tiling.step as f64);
    [-1.0, -0.5, 0.0, 0.5, 1.0].map(|x| {
        let at = x * r / step;
        Place { node: at.floor() as i32, t: (at - at.floor()) as f32, x: x as f32 }
    })
}

/// Largest difference between eight subsets' polynomials and the field, over 5 × 5 places from edge to
/// edge of the subset.
#[inline(always)]
fn distance<S: Simd, const O: usize>(
    s: S,
    pass: &Pass<'_>,
    task: &Task,
    places: &[Place; 5],
    j: usize,
    k: usize,
    out: &mut [f32],
) {
    let m = moments(O);
    let e = pass.tiling.margin();
    let stride = pass.nodes.stride;
    let mut worst = V::splat(s, 0.0);
    for y in places {
        let row = ((task.row + j + e) as i32 + y.node) as usize * stride;
        for x in places {
            let at = row + ((task.column + k + e) as i32 + x.node) as usize;
            let basis = [1.0, x.x, y.x, x.x * x.x, x.x * y.x, y.x * y.x];
            let (tx, ty) = (V::splat(s, x.t), V::splat(s, y.t));
            for (c, field) in [&pass.nodes.cu, &pass.nodes.cv].into_iter().enumerate() {
                macro_rules! along {
                    ($at:expr) => {{
                        let o = $at;
                        let a = V::from_slice(s, &field[o..o + LANES]);
                        (V::from_slice(s, &field[o + 1..o + 1 + LANES]) - a).mul_add(tx, a)
                    }};
                }
                let (upper, lower) = (along!(at), along!(at + stride));
                let mut d = (upper - lower).mul_add(ty, V::splat(s, 0.0) - upper);
                for a in 0..m {
                    let o = (c * m + a) * LANES;
                    d = V::splat(s, basis[a]).mul_add(V::from_slice(s, &out[o..o + LANES]), d);
                }
                worst = worst.max(d.abs());
            }
        }
    }
    worst.store_slice(&mut out[(2 * m + DISTANCE) * LANES..][..LANES]);
}
