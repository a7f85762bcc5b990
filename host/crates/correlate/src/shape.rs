//! Shape functions: how a subset is displaced and deformed.

use crate::point::ShapeParameters;
use serde::{Deserialize, Serialize};

/// Order of the shape function.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// Order 0: the subset moves without deforming (2 parameters).
    Translation,
    /// Order 1: displacement and its first derivatives (6 parameters).
    #[default]
    Affine,
    /// Order 2: first and second derivatives (12 parameters).
    Quadratic,
}

impl Shape {
    /// Parameters of one displacement component: 1, 3 or 6.
    pub fn parameters_per_component(self) -> usize {
        match self {
            Shape::Translation => 1,
            Shape::Affine => 3,
            Shape::Quadratic => 6,
        }
    }
}

/// Displacement polynomial of a subset about its centre, in pixels:
/// `c[0] + c[1] ξ + c[2] η + c[3] ξ² + c[4] ξη + c[5] η²` for u (`warp.0[0]`) and v (`warp.0[1]`).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Warp(pub(crate) [[f64; 6]; 2]);

type Poly = [f64; 6];

/// Product, terms above the second degree dropped.
fn product(a: &Poly, b: &Poly) -> Poly {
    [
        a[0] * b[0],
        a[0] * b[1] + a[1] * b[0],
        a[0] * b[2] + a[2] * b[0],
        a[0] * b[3] + a[3] * b[0] + a[1] * b[1],
        a[0] * b[4] + a[4] * b[0] + a[1] * b[2] + a[2] * b[1],
        a[0] * b[5] + a[5] * b[0] + a[2] * b[2],
    ]
}

/// `p(X(ξ, η), Y(ξ, η))`, terms above the second degree dropped.
fn substitute(p: &Poly, x: &Poly, y: &Poly) -> Poly {
    let mut out = [0.0; 6];
    out[0] = p[0];
    let mut add = |factor: f64, q: &Poly| {
        for (o, c) in out.iter_mut().zip(q) {
            *o += factor * c;
        }
    };
    add(p[1], x);
    add(p[2], y);
    if p[3] != 0.0 || p[4] != 0.0 || p[5] != 0.0 {
        add(p[3], &product(x, x));
        add(p[4], &product(x, y));
        add(p[5], &product(y, y));
    }
    out
}

impl Warp {
    pub(crate) fn translation(u: f64, v: f64) -> Self {
        let mut w = [[0.0; 6]; 2];
        w[0][0] = u;
        w[1][0] = v;
        Warp(w)
    }

    /// Displacement at (ξ, η) from the subset's centre.
    pub(crate) fn at(&self, xi: f64, eta: f64) -> [f64; 2] {
        let f =
            |c: &Poly| c[0] + c[1] * xi + c[2] * eta + c[3] * xi * xi + c[4] * xi * eta + c[5] * eta * eta;
        [f(&self.0[0]), f(&self.0[1])]
    }

    /// The same displacement field seen from a centre (dx, dy) further.
    pub(crate) fn moved(&self, dx: f64, dy: f64) -> Self {
        let f = |c: &Poly| {
            [
                c[0] + c[1] * dx + c[2] * dy + c[3] * dx * dx + c[4] * dx * dy + c[5] * dy * dy,
                c[1] + 2.0 * c[3] * dx + c[4] * dy,
                c[2] + c[4] * dx + 2.0 * c[5] * dy,
                c[3],
                c[4],
                c[5],
            ]
        };
        Warp([f(&self.0[0]), f(&self.0[1])])
    }

    /// From value and derivatives at the centre.
    pub(crate) fn of(parameters: &ShapeParameters) -> Self {
        let f = |d: &[f32; 6]| {
            let [a, x, y, xx, xy, yy] = d.map(f64::from);
            [a, x, y, 0.5 * xx, xy, 0.5 * yy]
        };
        Warp([f(&parameters.u), f(&parameters.v)])
    }

    /// Value and derivatives at the centre.
    pub(crate) fn parameters(&self) -> ShapeParameters {
        let f = |c: &Poly| [c[0], c[1], c[2], 2.0 * c[3], c[4], 2.0 * c[5]].map(|d| d as f32);
        ShapeParameters { u: f(&self.0[0]), v: f(&self.0[1]) }
    }

    /// Displacement by this field, then by `next`, which is centred where this one takes the
    /// centre; terms above the second degree dropped.
    pub(crate) fn then(&self, next: &Warp) -> Warp {
        let [p, q] = &self.0;
        let x = [0.0, 1.0 + p[1], p[2], p[3], p[4], p[5]];
        let y = [0.0, q[1], 1.0 + q[2], q[3], q[4], q[5]];
        let mut u = substitute(&next.0[0], &x, &y);
        let mut v = substitute(&next.0[1], &x, &y);
        for k in 0..6 {
            u[k] += p[k];
            v[k] += q[k];
        }
        Warp([u, v])
    }

    /// Deformation gradient at the centre, row by row.
    pub(crate) fn deformation(&self) -> [[f64; 2]; 2] {
        let [u, v] = &self.0;
        [[1.0 + u[1], u[2]], [v[1], 1.0 + v[2]]]
    }

    /// Keeps the parameters that the shape function has.
    pub(crate) fn restricted(&self, shape: Shape) -> Self {
        let m = shape.parameters_per_component();
        let mut w = *self;
        for c in &mut w.0 {
            c[m..].fill(0.0);
        }
        w
    }

    /// Inverse-compositional update W(p) ← W(p) ∘ W(Δp)⁻¹, to second order; `None` where the
    /// increment cannot be inverted. Any rule that is exact to first order in Δp has the same fixed
    /// point; this one is exact for affine shape functions.
    pub(crate) fn updated(&self, increment: &Warp) -> Option<Warp> {
        let [du, dv] = &increment.0;
        let (a, b, c, d) = (1.0 + du[1], du[2], dv[1], 1.0 + dv[2]);
        let det = a * d - b * c;
        if !(det.abs() > 1e-3 && det.is_finite()) {
            return None;
        }
        let inv = [d / det, -b / det, -c / det, a / det];
        // z = A⁻¹ (y − t), then x = z − A⁻¹ Q(z)
        let apply = |m: &[f64; 4], x: &Poly, y: &Poly| {
            let (mut p, mut q) = ([0.0; 6], [0.0; 6]);
            for k in 0..6 {
                p[k] = m[0] * x[k] + m[1] * y[k];
                q[k] = m[2] * x[k] + m[3] * y[k];
            }
            (p, q)
        };
        let (zx, zy) = apply(&inv, &[-du[0], 1.0, 0.0, 0.0, 0.0, 0.0], &[-dv[0], 0.0, 1.0, 0.0, 0.0, 0.0]);
        let (mut x, mut y) = (zx, zy);
        if du[3..].iter().chain(&dv[3..]).any(|&q| q != 0.0) {
            let second = |c: &Poly| [0.0, 0.0, 0.0, c[3], c[4], c[5]];
            let qx = substitute(&second(du), &zx, &zy);
            let qy = substitute(&second(dv), &zx, &zy);
            let (ex, ey) = apply(&inv, &qx, &qy);
            for k in 0..6 {
                x[k] -= ex[k];
                y[k] -= ey[k];
            }
        }
        // displacement of the composed map: X(y) − y + p(X(y))
        let mut u = substitute(&self.0[0], &x, &y);
        let mut v = substitute(&self.0[1], &x, &y);
        for k in 0..6 {
            u[k] += x[k];
            v[k] += y[k];
        }
        u[1] -= 1.0;
        v[2] -= 1.0;
        let all_finite = u.iter().chain(&v).all(|c| c.is_finite());
        all_finite.then_some(Warp([u, v]))
    }

    /// Whether [`Warp::log_stretch`] is at most `limit`.
    #[inline(always)]
    pub(crate) fn stretches_less(&self, limit: f64) -> bool {
        let [u, v] = &self.0;
        let largest = u[1].abs().max(u[2].abs()).max(v[1].abs().max(v[2].abs()));
        // stretches differ from 1 by at most the norm of the gradient, 2 · largest
        4.0 * largest < limit.min(1.0) || self.log_stretch() <= limit
    }

    /// Largest departure from 1 of the two principal stretches of the deformation gradient at the
    /// centre, as |ln λ|; infinite where the subset is turned inside out.
    pub(crate) fn log_stretch(&self) -> f64 {
        let (a, b) = (1.0 + self.0[0][1], self.0[0][2]);
        let (c, d) = (self.0[1][1], 1.0 + self.0[1][2]);
        let det = a * d - b * c;
        if det <= 0.0 || !det.is_finite() {
            return f64::INFINITY;
        }
        let half = 0.5 * (a * a + b * b + c * c + d * d);
        let root = (half * half - det * det).max(0.0).sqrt();
        let large = (half + root).sqrt();
        large.ln().abs().max((det / large).ln().abs())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn update_composes_with_the_inverse_of_the_increment() {
        // W(p) ∘ W(Δp)⁻¹ ∘ W(Δp) must be W(p) again: checked pointwise.
        let p = Warp([[1.3, 0.02, -0.01, 1e-4, -2e-4, 5e-5], [-0.4, 0.005, 0.03, -1e-4, 1e-4, 2e-4]]);
        let affine = Warp([[0.2, 0.01, 0.02, 0., 0., 0.], [-0.1, 0.015, -0.02, 0., 0., 0.]]);
        let small = Warp([[2e-3, 1e-4, -2e-4, 1e-5, 2e-5, -1e-5], [-1e-3, 2e-4, 1e-4, -2e-5, 1e-5, 1e-5]]);
        // Affine: exact. Quadratic: what is dropped is third degree in products of second-order
        // terms, 16³ · 2e-4 · 4e-5 ≈ 3e-5.
        for (increment, base, tol) in [(affine, p.restricted(Shape::Affine), 1e-12), (small, p, 2e-4)] {
            let q = base.updated(&increment).unwrap();
            for (xi, eta) in [(0.0, 0.0), (16.0, -16.0), (-7.0, 12.0), (16.0, 16.0)] {
                let d = increment.at(xi, eta);
                let (x, y) = (xi + d[0], eta + d[1]);
                let e = q.at(x, y);
                let expected = base.at(xi, eta);
                assert!((x + e[0] - xi - expected[0]).abs() < tol, "{xi} {eta}");
                assert!((y + e[1] - eta - expected[1]).abs() < tol, "{xi} {eta}");
            }
        }
    }

    #[test]
    fn composition_applies_one_field_after_the_other() {
        let p = Warp([[1.3, 0.02, -0.01, 1e-4, -2e-4, 5e-5], [-0.4, 0.005, 0.03, -1e-4, 1e-4, 2e-4]]);
        let q = Warp([[0.2, 0.01, 0.02, 2e-4, 1e-4, 0.], [-0.1, 0.015, -0.02, 0., 1e-4, -1e-4]]);
        // affine: exact; quadratic: third degree dropped, about 2 · 2e-4 · 4e-4 · 8³
        for (p, q, tol) in [(p.restricted(Shape::Affine), q.restricted(Shape::Affine), 1e-12), (p, q, 1e-4)] {
            let both = p.then(&q);
            for (xi, eta) in [(0.0, 0.0), (8.0, -5.0), (-3.0, 7.0)] {
                let a = p.at(xi, eta);
                let b = q.at(xi + a[0] - p.0[0][0], eta + a[1] - p.0[1][0]);
                let c = both.at(xi, eta);
                assert!((a[0] + b[0] - c[0]).abs() < tol && (a[1] + b[1] - c[1]).abs() < tol);
            }
        }
    }

    #[test]
    fn moved_field_is_the_same_field() {
        let p = Warp([[1.3, 0.02, -0.01, 1e-4, -2e-4, 5e-5], [-0.4, 0.005, 0.03, -1e-4, 1e-4, 2e-4]]);
        let q = p.moved(3.0, -5.0);
        let (a, b) = (p.at(4.0, 2.0), q.at(1.0, 7.0));
        assert!((a[0] - b[0]).abs() < 1e-12 && (a[1] - b[1]).abs() < 1e-12);
    }

    #[test]
    fn stretch_of_a_rotation_is_one() {
        let (s, c) = 0.5f64.sin_cos();
        let turn = Warp([[0.0, c - 1.0, -s, 0., 0., 0.], [0.0, s, c - 1.0, 0., 0., 0.]]);
        assert!(turn.log_stretch() < 1e-7);
        let long = Warp([[0.0, 0.1, 0.0, 0., 0., 0.], [0.0; 6]]);
        assert!((long.log_stretch() - 1.1f64.ln()).abs() < 1e-12);
    }
}
