//! The inner loop: one sweep over a subset gives the sums of the residual that the Gauss–Newton
//! step needs.

use crate::plane::Plane;
use crate::sampler::{GENTLE, V, sample_lanes, sample_row};
use crate::subset::{LANES, Layout, Subset, monomial};
use fearless_simd::prelude::*;

/// Sums over the subset of the residual q = (f − f̄) − (g − f̄).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Sums {
    pub(crate) q: f64,
    pub(crate) qq: f64,
    pub(crate) fq: f64,
    /// Σ fx q, Σ fy q times the monomials of the shape, in ξ/r and η/r.
    pub(crate) slopes: [[f64; 6]; 2],
}

/// Where the subset is sampled: integer part of the position of its centre, and the displacement
/// polynomials with the rest, in pixels.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sampling {
    pub(crate) x: i32,
    pub(crate) y: i32,
    pub(crate) u: [f64; 6],
    pub(crate) v: [f64; 6],
    /// Mean of f minus what was subtracted from the target's coefficients.
    pub(crate) mean: f32,
}

impl Sampling {
    /// Polynomials of u and v along row η, about ξ.
    fn along_row(c: &[f64; 6], eta: f64, xi: f64) -> [f64; 3] {
        let (a, b) = (c[0] + (c[2] + c[5] * eta) * eta, c[1] + c[4] * eta);
        [a + (b + c[3] * xi) * xi, b + 2.0 * c[3] * xi, c[3]]
    }

    /// Whether displacements change slowly enough along every row for [`sample_row`].
    fn gentle(&self, r: f64) -> bool {
        [&self.u, &self.v].iter().all(|c| c[1].abs() + (2.0 * c[3].abs() + c[4].abs()) * r < GENTLE)
    }
}

/// One sweep; N = taps of the spline (N1 = N + 1), O = order of the shape function. `warped`
/// receives the interpolated grey levels in the subset's packed form.
#[inline(always)]
pub(crate) fn sweep<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    layout: &Layout,
    subset: &Subset,
    plane: &Plane,
    at: &Sampling,
    warped: &mut Vec<f32>,
) -> Sums {
    warped.resize(subset.f.len(), 0.0);
    let rows = layout.width * layout.groups * LANES;
    let (in_rows, in_columns) = warped.split_at_mut(rows);
    interpolate_rows::<S, N, N1, O>(s, layout, plane, at, in_rows);
    interpolate_columns::<S, N>(s, layout, plane, at, in_columns);
    if !subset.cut.is_empty() {
        // pixels left out have no residual
        warped.iter_mut().zip(&subset.cut).filter(|w| *w.1 == 0.0).for_each(|w| *w.0 = at.mean);
    }
    accumulate::<S, O>(s, layout, subset, at.mean, warped)
}

#[inline(always)]
fn interpolate_rows<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    layout: &Layout,
    plane: &Plane,
    at: &Sampling,
    out: &mut [f32],
) {
    let r = layout.radius as f64;
    let (x, y) = (at.x - layout.radius as i32, at.y - layout.radius as i32);
    let row_floats = layout.groups * LANES;
    let gentle = at.gentle(r);
    for (d, row) in out.chunks_exact_mut(row_floats).enumerate() {
        let eta = d as f64 - r;
        let u = Sampling::along_row(&at.u, eta, -r);
        let v = Sampling::along_row(&at.v, eta, -r);
        let y = y + d as i32;
        if gentle {
            sample_row::<S, N, N1, O>(s, plane, x, y, u, v, row);
        } else {
            steep_row::<S, N>(s, plane, x, y, u, v, row);
        }
        // unused lanes have no residual
        row[row_floats - LANES + layout.last..].fill(at.mean);
    }
}

/// A row whose displacement changes fast: every pixel by itself.
#[inline(always)]
fn steep_row<S: Simd, const N: usize>(
    s: S,
    plane: &Plane,
    x: i32,
    y: i32,
    u: [f64; 3],
    v: [f64; 3],
    out: &mut [f32],
) {
    let sp = |a: f64| V::splat(s, a as f32);
    let lanes = V::from_fn(s, |l| l as f32);
    for (k, o) in out.chunks_exact_mut(LANES).enumerate() {
        let d = (k * LANES) as f64;
        let polynomial = |c: [f64; 3]| {
            let (c0, c1) = (c[0] + (c[1] + c[2] * d) * d, c[1] + 2.0 * c[2] * d);
            sp(c[2]).mul_add(lanes, sp(c1)).mul_add(lanes, sp(c0))
        };
        let (du, dv) = (polynomial(u), polynomial(v));
        sample_lanes::<S, N>(s, plane, x + d as i32, y, 1, 0, du, dv).store_slice(o);
    }
}

#[inline(always)]
fn interpolate_columns<S: Simd, const N: usize>(
    s: S,
    layout: &Layout,
    plane: &Plane,
    at: &Sampling,
    out: &mut [f32],
) {
    let sp = |a: f64| V::splat(s, a as f32);
    let lanes = V::from_fn(s, |l| l as f32);
    let ri = layout.radius as i32;
    let column_floats = layout.column_groups() * LANES;
    for (c, column) in out.chunks_exact_mut(column_floats).enumerate() {
        let i = (layout.groups * LANES + c) as i32 - ri;
        let xi = f64::from(i);
        let line = |p: &[f64; 6]| [p[0] + (p[1] + p[3] * xi) * xi, p[2] + p[4] * xi, p[5]];
        let (u, v) = (line(&at.u), line(&at.v));
        for (k, o) in column.chunks_exact_mut(LANES).enumerate() {
            let first = k as i32 * LANES as i32 - ri;
            let eta = lanes + sp(f64::from(first));
            let du = sp(u[2]).mul_add(eta, sp(u[1])).mul_add(eta, sp(u[0]));
            let dv = sp(v[2]).mul_add(eta, sp(v[1])).mul_add(eta, sp(v[0]));
            let y = at.y + first;
            sample_lanes::<S, N>(s, plane, at.x + i, y, 0, 1, du, dv).store_slice(o);
        }
        column[layout.width..].fill(at.mean);
    }
}

#[inline(always)]
fn accumulate<S: Simd, const O: usize>(
    s: S,
    layout: &Layout,
    subset: &Subset,
    mean: f32,
    warped: &[f32],
) -> Sums {
    let sp = |a: f32| V::splat(s, a);
    let zero = sp(0.0);
    let lanes = V::from_fn(s, |l| l as f32);
    let r = layout.radius as f32;
    let rinv = 1.0 / r;
    let mean = sp(mean);
    let (mut sq, mut sqq, mut sfq) = (zero, zero, zero);
    let mut b = [[zero; 6]; 2];
    let row_floats = layout.groups * LANES;
    let rows = layout.width * row_floats;
    let first = (lanes - sp(r)) * sp(rinv);
    let advance = sp(LANES as f32 * rinv);
    let packed = subset.f[..rows]
        .chunks_exact(row_floats)
        .zip(subset.gx[..rows].chunks_exact(row_floats))
        .zip(subset.gy[..rows].chunks_exact(row_floats))
        .zip(warped[..rows].chunks_exact(row_floats));
    for (d, (((f, gx), gy), g)) in packed.enumerate() {
        let mut t = [[zero; 3]; 2];
        let mut e = first;
        let groups = f
            .chunks_exact(LANES)
            .zip(gx.chunks_exact(LANES))
            .zip(gy.chunks_exact(LANES))
            .zip(g.chunks_exact(LANES));
        for (((f, gx), gy), g) in groups {
            let fv = V::from_slice(s, f);
            let q = fv - (V::from_slice(s, g) - mean);
            sq += q;
            sqq = q.mul_add(q, sqq);
            sfq = fv.mul_add(q, sfq);
            let (qx, qy) = (q * V::from_slice(s, gx), q * V::from_slice(s, gy));
            t[0][0] += qx;
            t[1][0] += qy;
            if O >= 1 {
                t[0][1] = qx.mul_add(e, t[0][1]);
                t[1][1] = qy.mul_add(e, t[1][1]);
            }
            if O == 2 {
                let ee = e * e;
                t[0][2] = qx.mul_add(ee, t[0][2]);
                t[1][2] = qy.mul_add(ee, t[1][2]);
            }
            e += advance;
        }
        let n = sp((d as f32 - r) * rinv);
        for c in 0..2 {
            b[c][0] += t[c][0];
            if O >= 1 {
                b[c][1] += t[c][1];
                b[c][2] = t[c][0].mul_add(n, b[c][2]);
            }
            if O == 2 {
                b[c][3] += t[c][2];
                b[c][4] = t[c][1].mul_add(n, b[c][4]);
                b[c][5] = t[c][0].mul_add(n * n, b[c][5]);
            }
        }
    }
    let column_floats = layout.column_groups() * LANES;
    for c in 0..layout.columns {
        let e = sp(((layout.groups * LANES + c) as f32 - r) * rinv);
        let start = rows + c * column_floats;
        for k in (0..column_floats).step_by(LANES) {
            let at = start + k..start + k + LANES;
            let n = (lanes + sp(k as f32 - r)) * sp(rinv);
            let fv = V::from_slice(s, &subset.f[at.clone()]);
            let q = fv - (V::from_slice(s, &warped[at.clone()]) - mean);
            sq += q;
            sqq = q.mul_add(q, sqq);
            sfq = fv.mul_add(q, sfq);
            let gq = [q * V::from_slice(s, &subset.gx[at.clone()]), q * V::from_slice(s, &subset.gy[at])];
            for c in 0..2 {
                b[c][0] += gq[c];
                if O >= 1 {
                    let (ge, gn) = (gq[c] * e, gq[c] * n);
                    b[c][1] += ge;
                    b[c][2] += gn;
                    if O == 2 {
                        b[c][3] = ge.mul_add(e, b[c][3]);
                        b[c][4] = ge.mul_add(n, b[c][4]);
                        b[c][5] = gn.mul_add(n, b[c][5]);
                    }
                }
            }
        }
    }
    let mut sums = Sums {
        q: f64::from(sq.reduce_sum()),
        qq: f64::from(sqq.reduce_sum()),
        fq: f64::from(sfq.reduce_sum()),
        slopes: [[0.0; 6]; 2],
    };
    for c in 0..2 {
        for k in 0..=monomial(0, O) {
            sums.slopes[c][k] = f64::from(b[c][k].reduce_sum());
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Image;
    use crate::plane;
    use crate::prepared::Reference;
    use crate::scalar;
    use crate::settings::Interpolation;
    use crate::simd::dispatch;
    use fearless_simd::Level;

    /// A texture without symmetry.
    fn texture() -> Image {
        let (w, h) = (120, 110);
        let grey = (0..w * h)
            .map(|k| {
                let (x, y) = ((k % w) as f32, (k / w) as f32);
                let a = (0.61 * x + 0.2 * y).sin() + (0.47 * y - 0.33 * x).cos();
                100.0 + 40.0 * a + 12.0 * (0.9 * x + 0.7 * y).sin()
            })
            .collect();
        Image::from_f32(w, h, grey).unwrap()
    }

    fn compare(radius: usize, gradient: f64, order: usize, taps: usize, cut: &[bool]) {
        let kind = match taps {
            8 => Interpolation::Septic,
            6 => Interpolation::Quintic,
            _ => Interpolation::Cubic,
        };
        let reference = Reference::new(texture());
        let mut plane = Plane::default();
        let level = Level::new();
        plane::coefficients(level, reference.image(), 100.0, kind, &mut Default::default(), &mut plane);
        let layout = Layout::new(radius);
        let (x, y) = (55, 52);
        let second = if order == 2 { gradient / 100.0 } else { 0.0 };
        let first = if order >= 1 { gradient } else { 0.0 };
        let at = Sampling {
            x: x + 2,
            y: y - 1,
            u: [0.37, first, -0.7 * first, second, -second, 0.5 * second],
            v: [-0.21, 0.4 * first, -first, -second, 0.3 * second, second],
            mean: 0.0,
        };
        let (mut fast, mut slow) = (Subset::default(), Subset::default());
        scalar::load(&mut slow, &layout, &reference, x, y, order, cut);
        let at = Sampling { mean: (slow.mean - 100.0) as f32, ..at };
        let mut warped = Vec::new();
        macro_rules! go {
            ($n:literal, $n1:literal, $o:literal) => {
                dispatch!(level, s => {
                    fast.load::<_, $o>(s, &layout, &reference, x, y, cut);
                    sweep::<_, $n, $n1, $o>(s, &layout, &fast, &plane, &at, &mut warped)
                })
            };
        }
        let sums = match (taps, order) {
            (8, 0) => go!(8, 9, 0),
            (8, 1) => go!(8, 9, 1),
            (8, _) => go!(8, 9, 2),
            (6, 0) => go!(6, 7, 0),
            (6, 1) => go!(6, 7, 1),
            (6, 2) => go!(6, 7, 2),
            (4, 1) => go!(4, 5, 1),
            _ => go!(4, 5, 2),
        };
        let what = format!("radius {radius} gradient {gradient} order {order} taps {taps}");
        let expected = scalar::sweep(&layout, &slow, &plane, &at, taps, order, &mut Vec::new());
        // sums of n single-precision terms of either sign: relative to the sum of their sizes
        assert_eq!(fast.count, slow.count);
        let n = fast.count as f64;
        let q = (expected.qq / n).sqrt();
        let g = (slow.products[0][0] / n).sqrt();
        let close = |a: f64, b: f64, size: f64| {
            assert!((a - b).abs() <= 2e-6 * n * size, "{what}: {a} {b}");
        };
        close(sums.q, expected.q, q);
        close(sums.qq, expected.qq, q * q);
        close(sums.fq, expected.fq, q * (slow.sff / n).sqrt());
        close(fast.sff, slow.sff, slow.sff / n);
        for c in 0..2 {
            for k in 0..=monomial(0, order) {
                close(sums.slopes[c][k], expected.slopes[c][k], q * g);
                close(fast.slopes[c][k], slow.slopes[c][k], g);
                close(fast.slopes_f[c][k], slow.slopes_f[c][k], g * (slow.sff / n).sqrt());
            }
        }
        for c in 0..3 {
            for k in 0..=monomial(0, 2 * order) {
                close(fast.products[c][k], slow.products[c][k], g * g);
            }
        }
    }

    #[test]
    fn sums_agree_with_the_scalar_reference() {
        // 33 = 4·8 + 1, 25 = 3·8 + 1, 34 − 8 = 26 is even, 21 and 27 end in a partly filled group,
        // 23 = 2·8 + 7, 41 = 5·8 + 1
        for radius in [3, 5, 10, 11, 12, 13, 16, 20] {
            for (order, taps) in [(0, 8), (1, 8), (2, 8), (0, 6), (1, 6), (2, 6), (1, 4), (2, 4)] {
                // without carry, with carry, beyond the fast sampler
                for gradient in [0.0, 0.004, 0.08, 0.3] {
                    compare(radius, gradient, order, taps, &[]);
                }
            }
        }
    }

    #[test]
    fn sums_of_cut_subsets_agree_with_the_scalar_reference() {
        for radius in [3usize, 10, 12, 13, 16] {
            let width = 2 * radius + 1;
            // an oblique edge with a hole
            let used =
                |i: usize, d: usize| 2 * i + d > width && i.abs_diff(radius) + d.abs_diff(width - 3) > 2;
            let cut: Vec<bool> = (0..width * width).map(|k| used(k % width, k / width)).collect();
            for (order, taps) in [(1, 8), (0, 6), (1, 6), (2, 6), (1, 4)] {
                compare(radius, 0.02, order, taps, &cut);
            }
        }
    }

    #[test]
    fn splines_reproduce_polynomials() {
        // a cubic polynomial is its own spline, away from the mirrored borders
        let (w, h) = (160, 150);
        let f = |x: f64, y: f64| {
            let (x, y) = ((x - 80.0) / 40.0, (y - 75.0) / 40.0);
            20.0 * x * x * x - 10.0 * x * y * y + 15.0 * y * y + 8.0 * x
        };
        let grey = (0..w * h).map(|k| f((k % w) as f64, (k / w) as f64) as f32).collect();
        let image = Image::from_f32(w, h, grey).unwrap();
        for (kind, taps) in
            [(Interpolation::Cubic, 4), (Interpolation::Quintic, 6), (Interpolation::Septic, 8)]
        {
            let mut plane = Plane::default();
            plane::coefficients(Level::new(), &image, 0.0, kind, &mut Default::default(), &mut plane);
            for k in 0..50 {
                let (x, y) = (60.0 + 0.83 * f64::from(k), 60.0 + 0.57 * f64::from(k));
                let g = scalar::sample(&plane, taps, x, y);
                assert!((g - f(x, y)).abs() < 1e-4, "{kind:?} {x} {y}: {g} {}", f(x, y));
            }
        }
        let reference = Reference::new(image);
        let (x, y) = (90, 66);
        let k = reference.gx.index(x, y);
        let (x, y) = (f64::from(x), f64::from(y));
        let e = 1e-4;
        let dx = (f(x + e, y) - f(x - e, y)) / (2.0 * e);
        let dy = (f(x, y + e) - f(x, y - e)) / (2.0 * e);
        assert!((f64::from(reference.gx.data[k]) - dx).abs() < 1e-4);
        assert!((f64::from(reference.gy.data[k]) - dy).abs() < 1e-4);
    }
}
