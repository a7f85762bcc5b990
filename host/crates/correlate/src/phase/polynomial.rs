//! Polynomials in x and y over an image, fitted by least squares.

/// Σ c_ij X^i Y^j, i + j ≤ degree, in coordinates scaled to −1…1 over the image.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Polynomial {
    degree: usize,
    c: Vec<f64>,
    centre: [f64; 2],
    half: f64,
}

/// A value to be fitted.
#[derive(Debug, Clone, Copy)]
pub(super) struct Node {
    pub(super) x: f64,
    pub(super) y: f64,
    pub(super) value: f64,
    pub(super) weight: f64,
    /// Which constant belongs to it.
    pub(super) group: usize,
}

/// Legendre polynomials P₀…P_n at t.
fn legendre(n: usize, t: f64, out: &mut [f64]) {
    out[0] = 1.0;
    if n > 0 {
        out[1] = t;
    }
    for k in 2..=n {
        let k1 = k as f64;
        out[k] = ((2.0 * k1 - 1.0) * t * out[k - 1] - (k1 - 1.0) * out[k - 2]) / k1;
    }
}

const MOST: usize = 9;

impl Polynomial {
    /// Zero polynomial over `width` × `height` pixels.
    pub(super) fn zero(width: usize, height: usize, degree: usize) -> Self {
        let centre = [0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0)];
        let degree = degree.min(MOST - 1);
        let terms = (degree + 1) * (degree + 2) / 2;
        Self { degree, c: vec![0.0; terms], centre, half: 0.5 * width.max(height) as f64 }
    }

    fn basis(&self, x: f64, y: f64, out: &mut Vec<f64>) {
        let (mut px, mut py) = ([0.0; MOST], [0.0; MOST]);
        legendre(self.degree, (x - self.centre[0]) / self.half, &mut px);
        legendre(self.degree, (y - self.centre[1]) / self.half, &mut py);
        out.clear();
        for j in 0..=self.degree {
            for i in 0..=self.degree - j {
                out.push(px[i] * py[j]);
            }
        }
    }

    /// Weighted least squares through `nodes`, with a constant of its own for each of `groups` groups
    /// of them, that of the first being zero; `None` where the nodes do not determine the
    /// coefficients. Returns the polynomial and the constants.
    pub(super) fn fit(mut self, nodes: &[Node], groups: usize) -> Option<(Self, Vec<f64>)> {
        let terms = self.c.len();
        let n = terms + groups.saturating_sub(1);
        let mut a = vec![0.0; n * n];
        let mut b = vec![0.0; n];
        let mut p = Vec::with_capacity(n);
        for node in nodes {
            self.basis(node.x, node.y, &mut p);
            p.extend((1..groups).map(|g| f64::from(g == node.group)));
            for i in 0..n {
                b[i] += node.weight * p[i] * node.value;
                for j in 0..=i {
                    a[i * n + j] += node.weight * p[i] * p[j];
                }
            }
        }
        let mut solution = cholesky(a, b, n)?;
        let constants = std::iter::once(0.0).chain(solution.drain(terms..)).collect();
        self.c = solution;
        Some((self, constants))
    }

    /// Value at (x, y).
    pub(super) fn at(&self, x: f64, y: f64) -> f64 {
        let row = self.row(y);
        row.at(x)
    }

    /// The polynomial along row y.
    pub(super) fn row(&self, y: f64) -> Row {
        let mut py = [0.0; MOST];
        legendre(self.degree, (y - self.centre[1]) / self.half, &mut py);
        let mut legendre_c = [0.0; MOST];
        let mut k = 0;
        for j in 0..=self.degree {
            for i in 0..=self.degree - j {
                legendre_c[i] += self.c[k] * py[j];
                k += 1;
            }
        }
        // to powers of t, for Horner's scheme
        let (mut p0, mut p1) = ([0.0; MOST], [0.0; MOST]);
        (p0[0], p1[1]) = (1.0, 1.0);
        let mut c = [0.0; MOST];
        for i in 0..=self.degree {
            for k in 0..=i {
                c[k] += legendre_c[i] * p0[k];
            }
            let n = i as f64 + 1.0;
            let mut p2 = [0.0; MOST];
            for k in 0..MOST {
                let shifted = if k > 0 { p1[k - 1] } else { 0.0 };
                p2[k] = ((2.0 * n + 1.0) * shifted - n * p0[k]) / (n + 1.0);
            }
            (p0, p1) = (p1, p2);
        }
        Row { c, degree: self.degree, centre: self.centre[0], inverse: 1.0 / self.half }
    }
}

/// A polynomial in x alone.
pub(super) struct Row {
    c: [f64; MOST],
    degree: usize,
    centre: f64,
    inverse: f64,
}

impl Row {
    /// Value at x.
    pub(super) fn at(&self, x: f64) -> f64 {
        let t = (x - self.centre) * self.inverse;
        self.c[..=self.degree].iter().rev().fold(0.0, |s, c| s.mul_add(t, *c))
    }
}

/// Solves the symmetric positive definite system whose lower triangle is `a`.
fn cholesky(mut a: Vec<f64>, mut b: Vec<f64>, n: usize) -> Option<Vec<f64>> {
    for j in 0..n {
        let largest = a[j * n + j];
        for k in 0..j {
            a[j * n + j] -= a[j * n + k] * a[j * n + k];
        }
        let d = a[j * n + j];
        if d.is_nan() || d <= 1e-12 * largest {
            return None;
        }
        let inverse = 1.0 / d.sqrt();
        a[j * n + j] = d.sqrt();
        for i in j + 1..n {
            for k in 0..j {
                a[i * n + j] -= a[i * n + k] * a[j * n + k];
            }
            a[i * n + j] *= inverse;
        }
    }
    for i in 0..n {
        for k in 0..i {
            b[i] -= a[i * n + k] * b[k];
        }
        b[i] /= a[i * n + i];
    }
    for i in (0..n).rev() {
        for k in i + 1..n {
            b[i] -= a[k * n + i] * b[k];
        }
        b[i] /= a[i * n + i];
    }
    Some(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fits_what_it_can_represent() {
        let f = |x: f64, y: f64| 3.0 + 0.1 * x - 2e-4 * x * y + 1e-6 * x * x * y - 3e-9 * y.powi(4);
        let mut nodes = Vec::new();
        for y in (0..200).step_by(7) {
            for x in (0..300).step_by(11) {
                let (group, x, y) = (usize::from(x > 150), f64::from(x), f64::from(y));
                nodes.push(Node { x, y, value: f(x, y) + 7.5 * group as f64, weight: 1.0, group });
            }
        }
        let (p, constants) = Polynomial::zero(300, 200, 5).fit(&nodes, 2).unwrap();
        assert!(constants[0] == 0.0 && (constants[1] - 7.5).abs() < 1e-8);
        for (x, y) in [(0.0, 0.0), (299.0, 3.5), (120.25, 199.0)] {
            assert!((p.at(x, y) - f(x, y)).abs() < 1e-9, "{} {}", p.at(x, y), f(x, y));
            assert!((p.row(y).at(x) - f(x, y)).abs() < 1e-9);
        }
    }

    #[test]
    fn too_few_points_are_refused() {
        let node = Node { x: 1.0, y: 1.0, value: 2.0, weight: 1.0, group: 0 };
        assert!(Polynomial::zero(10, 10, 2).fit(&[node; 9], 1).is_none());
    }
}
