//! How a lattice is mapped into the image about one of its points, and what that does to the
//! centres of circles.

use nalgebra::{Matrix6, Matrix6x2, Vector6};

use super::Index;

/// Jacobian and second derivatives of image position by lattice index at one point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LocalMap {
    /// Image position of the point itself.
    pub(crate) at: [f64; 2],
    /// `jacobian[l][k]` = ∂X_l/∂u_k.
    pub(crate) jacobian: [[f64; 2]; 2],
    /// `second[l]` = [∂²X_l/∂u², ∂²X_l/∂u∂v, ∂²X_l/∂v²].
    pub(crate) second: [[f64; 3]; 2],
}

impl LocalMap {
    /// Quadratic fit through the points at most two steps away; none if they do not fix one.
    pub(crate) fn fit(index: Index, at: impl Fn(Index) -> Option<[f64; 2]>) -> Option<Self> {
        let mut a = Matrix6::<f64>::zeros();
        let mut b = Matrix6x2::<f64>::zeros();
        for dj in -2..=2 {
            for di in -2..=2 {
                if let Some([x, y]) = at([index[0] + di, index[1] + dj]) {
                    let (u, v) = (f64::from(di), f64::from(dj));
                    let row = Vector6::new(1.0, u, v, 0.5 * u * u, u * v, 0.5 * v * v);
                    a += row * row.transpose();
                    b += Matrix6x2::from_columns(&[row * x, row * y]);
                }
            }
        }
        let inverse = a.cholesky()?.inverse();
        // The entries of the normal matrix are whole numbers below 700: what is singular but for
        // rounding shows as an inverse beyond this.
        if !(inverse.amax() < 1e6) {
            return None;
        }
        let c = inverse * b;
        let column = |l: usize, k: usize| c[(k, l)];
        Some(Self {
            at: [column(0, 0), column(1, 0)],
            jacobian: [0, 1].map(|l| [column(l, 1), column(l, 2)]),
            second: [0, 1].map(|l| [column(l, 3), column(l, 4), column(l, 5)]),
        })
    }

    pub(crate) fn determinant(&self) -> f64 {
        let [[a, b], [c, d]] = self.jacobian;
        a * d - b * c
    }

    /// Where the centre of the image of a circle lies, minus the image of its centre; `radius` in
    /// lattice steps. To second order in the radius, for the centroid
    ///
    /// ```text
    /// ∫X |J| du / ∫|J| du − X(0) = r²/8 ∇²X + r²/4 J ∇ln|J|
    /// ```
    ///
    /// which for a homography is the centre of the ellipse.
    pub(crate) fn centre_shift(&self, radius: f64) -> [f64; 2] {
        let [[a, b], [c, d]] = self.jacobian;
        let det = self.determinant();
        let [x, y] = self.second;
        // ∂_k ln det J = tr(J⁻¹ ∂_k J)
        let by = |k: usize| {
            let (jx, jy) = ([x[k], x[k + 1]], [y[k], y[k + 1]]);
            (d * jx[0] - b * jy[0] - c * jx[1] + a * jy[1]) / det
        };
        let (gu, gv) = (by(0), by(1));
        let r2 = radius * radius;
        [0, 1].map(|l| {
            let s = self.second[l];
            let j = self.jacobian[l];
            r2 / 8.0 * (s[0] + s[2]) + r2 / 4.0 * (j[0] * gu + j[1] * gv)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix3;

    /// The exact centre of the conic that is the image of a circle under a homography.
    #[test]
    fn shift_of_a_circle_under_a_homography() {
        let h = Matrix3::new(40.0, 6.0, 300.0, -4.0, 25.0, 200.0, 0.004, 0.016, 1.0);
        let map = |u: f64, v: f64| {
            let p = h * nalgebra::Vector3::new(u, v, 1.0);
            [p.x / p.z, p.y / p.z]
        };
        let r = 0.3;
        let inverse = h.try_inverse().unwrap();
        let circle = Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -r * r);
        let conic = inverse.transpose() * circle * inverse;
        let centre = conic.fixed_view::<2, 2>(0, 0).try_inverse().unwrap() * -conic.fixed_view::<2, 1>(0, 2);
        let truth = map(0.0, 0.0);
        let shift = [centre.x - truth[0], centre.y - truth[1]];
        let local = LocalMap::fit([0, 0], |[i, j]| Some(map(f64::from(i), f64::from(j)))).unwrap();
        let found = local.centre_shift(r);
        // The shift is 0.03 px; terms of third order in the derivatives are left out.
        assert!(shift[0].hypot(shift[1]) > 0.02, "{shift:?}");
        for l in 0..2 {
            assert!((found[l] - shift[l]).abs() < 3e-4, "{found:?} {shift:?}");
        }
    }

    #[test]
    fn one_row_fixes_no_map() {
        assert!(LocalMap::fit([0, 0], |[i, j]| (j == 0).then_some([f64::from(i), 0.0])).is_none());
    }
}
