//! The reference implementation: the same sums in double precision, one pixel after another. Slow;
//! the tests hold the vector kernels to it.

use crate::kernel::{Sampling, Sums};
use crate::plane::{PAD, Plane};
use crate::prepared::Reference;
use crate::subset::{Layout, Subset, monomial};

fn powers(order: usize, xi: f64, eta: f64) -> [f64; 15] {
    let mut p = [0.0; 15];
    for i in 0..=order {
        for j in 0..=order - i {
            p[monomial(i, j)] = xi.powi(i as i32) * eta.powi(j as i32);
        }
    }
    p
}

/// [`Subset::load`].
pub(crate) fn load(
    subset: &mut Subset,
    layout: &Layout,
    reference: &Reference,
    x: i32,
    y: i32,
    order: usize,
    cut: &[bool],
) {
    let r = layout.radius as i32;
    let width = layout.width;
    let total = layout.floats();
    *subset = Subset::default();
    subset.select(layout, cut);
    subset.f = vec![0.0; total];
    subset.gx = vec![0.0; total];
    subset.gy = vec![0.0; total];
    let n = subset.count as f64;
    let used = |i: usize, d: usize| cut.get(d * width + i).copied().unwrap_or(true);
    let grey =
        |i: usize, d: usize| f64::from(reference.image.row((y - r) as usize + d)[(x - r) as usize + i]);
    for d in 0..width {
        for i in (0..width).filter(|&i| used(i, d)) {
            subset.mean += grey(i, d) / n;
        }
    }
    for d in 0..width {
        for i in (0..width).filter(|&i| used(i, d)) {
            let f = grey(i, d) - subset.mean;
            let o = reference.gx.index(x - r + i as i32, y - r + d as i32);
            let g = [reference.gx.data[o], reference.gy.data[o]];
            let k = layout.place(i, d);
            subset.f[k] = f as f32;
            subset.gx[k] = g[0];
            subset.gy[k] = g[1];
            subset.sff += f * f;
            let (xi, eta) =
                ((i as f64 - f64::from(r)) / f64::from(r), (d as f64 - f64::from(r)) / f64::from(r));
            let g = [f64::from(g[0]), f64::from(g[1])];
            let p = powers(2 * order, xi, eta);
            for (c, product) in [g[0] * g[0], g[0] * g[1], g[1] * g[1]].iter().enumerate() {
                for (s, q) in subset.products[c].iter_mut().zip(&p) {
                    *s += product * q;
                }
            }
            for c in 0..2 {
                for k in 0..=monomial(0, order) {
                    subset.slopes[c][k] += g[c] * p[k];
                    subset.slopes_f[c][k] += g[c] * p[k] * f;
                }
            }
        }
    }
    subset.centre = Some((x, y));
}

/// Centred B-spline of degree `taps` − 1 in truncated powers.
pub(crate) fn basis(taps: usize, x: f64) -> f64 {
    let x = x.abs();
    if taps == 4 {
        if x < 1.0 { 2.0 / 3.0 - x * x * (1.0 - 0.5 * x) } else { (2.0 - x).max(0.0).powi(3) / 6.0 }
    } else if taps == 6 {
        let p = |a: f64| (a - x).max(0.0).powi(5);
        (p(3.0) - 6.0 * p(2.0) + 15.0 * p(1.0)) / 120.0
    } else {
        let p = |a: f64| (a - x).max(0.0).powi(7);
        (p(4.0) - 8.0 * p(3.0) + 28.0 * p(2.0) - 56.0 * p(1.0)) / 5040.0
    }
}

/// Value of the spline at (x, y).
pub(crate) fn sample(plane: &Plane, taps: usize, x: f64, y: f64) -> f64 {
    let half = taps as i32 / 2 - 1;
    let (ix, iy) = (x.floor() as i32, y.floor() as i32);
    let inside = |i: i32, n: usize| i.clamp(-(PAD as i32), n as i32 - PAD as i32 - 1);
    let mut g = 0.0;
    for j in -half..=half + 1 {
        for i in -half..=half + 1 {
            let o = plane.index(inside(ix + i, plane.stride), inside(iy + j, plane.rows));
            g += f64::from(plane.data[o])
                * basis(taps, x - f64::from(ix + i))
                * basis(taps, y - f64::from(iy + j));
        }
    }
    g
}

/// [`crate::kernel::sweep`].
pub(crate) fn sweep(
    layout: &Layout,
    subset: &Subset,
    plane: &Plane,
    at: &Sampling,
    taps: usize,
    order: usize,
    warped: &mut Vec<f32>,
) -> Sums {
    warped.resize(layout.floats(), 0.0);
    let r = layout.radius as f64;
    let mut sums = Sums::default();
    for d in 0..layout.width {
        for i in 0..layout.width {
            let (xi, eta) = (i as f64 - r, d as f64 - r);
            let p = powers(2, xi, eta);
            let sum = |c: &[f64; 6]| -> f64 { c.iter().zip(&p).map(|(a, b)| a * b).sum() };
            let g =
                sample(plane, taps, f64::from(at.x) + xi + sum(&at.u), f64::from(at.y) + eta + sum(&at.v));
            let k = layout.place(i, d);
            if subset.cut.get(k) == Some(&0.0) {
                continue;
            }
            warped[k] = g as f32;
            let f = f64::from(subset.f[k]);
            let q = f - (g - f64::from(at.mean));
            sums.q += q;
            sums.qq += q * q;
            sums.fq += f * q;
            let p = powers(order, xi / r, eta / r);
            for (c, slope) in [subset.gx[k], subset.gy[k]].iter().enumerate() {
                for k in 0..=monomial(0, order) {
                    sums.slopes[c][k] += f64::from(*slope) * q * p[k];
                }
            }
        }
    }
    sums
}
