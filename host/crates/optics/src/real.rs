//! Scalars the optical model is written for: `f64`, and dual numbers that carry exact derivatives.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// What the model needs of a scalar.
pub(crate) trait Real:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    fn constant(value: f64) -> Self;
    fn value(self) -> f64;
    /// Whether every derivative is zero.
    fn is_constant(self) -> bool;
    fn sqrt(self) -> Self;
    fn sin_cos(self) -> (Self, Self);
}

impl Real for f64 {
    #[inline]
    fn constant(value: f64) -> Self {
        value
    }
    #[inline]
    fn value(self) -> f64 {
        self
    }
    #[inline]
    fn is_constant(self) -> bool {
        true
    }
    #[inline]
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }
    #[inline]
    fn sin_cos(self) -> (Self, Self) {
        f64::sin_cos(self)
    }
}

/// A value and its derivatives with respect to `N` independent variables (forward mode).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Dual<const N: usize> {
    pub(crate) value: f64,
    pub(crate) gradient: [f64; N],
}

impl<const N: usize> Dual<N> {
    /// The independent variable number `index`.
    #[inline]
    pub(crate) fn variable(value: f64, index: usize) -> Self {
        let mut gradient = [0.0; N];
        gradient[index] = 1.0;
        Self { value, gradient }
    }

    /// Chain rule for a function of one variable.
    #[inline]
    fn chain(self, value: f64, derivative: f64) -> Self {
        Self { value, gradient: self.gradient.map(|g| g * derivative) }
    }

    /// Chain rule for a function of two variables.
    #[inline]
    fn chain2(self, other: Self, value: f64, by_self: f64, by_other: f64) -> Self {
        let mut gradient = [0.0; N];
        for (g, (a, b)) in gradient.iter_mut().zip(self.gradient.iter().zip(&other.gradient)) {
            *g = a * by_self + b * by_other;
        }
        Self { value, gradient }
    }
}

impl<const N: usize> Real for Dual<N> {
    #[inline]
    fn constant(value: f64) -> Self {
        Self { value, gradient: [0.0; N] }
    }
    #[inline]
    fn value(self) -> f64 {
        self.value
    }
    #[inline]
    fn is_constant(self) -> bool {
        self.gradient.iter().all(|g| *g == 0.0)
    }
    #[inline]
    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        self.chain(root, 0.5 / root)
    }
    #[inline]
    fn sin_cos(self) -> (Self, Self) {
        let (s, c) = self.value.sin_cos();
        (self.chain(s, c), self.chain(c, -s))
    }
}

impl<const N: usize> Add for Dual<N> {
    type Output = Self;
    #[inline]
    fn add(self, o: Self) -> Self {
        self.chain2(o, self.value + o.value, 1.0, 1.0)
    }
}

impl<const N: usize> Sub for Dual<N> {
    type Output = Self;
    #[inline]
    fn sub(self, o: Self) -> Self {
        self.chain2(o, self.value - o.value, 1.0, -1.0)
    }
}

impl<const N: usize> Mul for Dual<N> {
    type Output = Self;
    #[inline]
    fn mul(self, o: Self) -> Self {
        self.chain2(o, self.value * o.value, o.value, self.value)
    }
}

impl<const N: usize> Div for Dual<N> {
    type Output = Self;
    #[inline]
    fn div(self, o: Self) -> Self {
        let q = self.value / o.value;
        self.chain2(o, q, 1.0 / o.value, -q / o.value)
    }
}

impl<const N: usize> Neg for Dual<N> {
    type Output = Self;
    #[inline]
    fn neg(self) -> Self {
        self.chain(-self.value, -1.0)
    }
}

#[inline]
pub(crate) fn dot<T: Real>(a: [T; 3], b: [T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline]
pub(crate) fn cross<T: Real>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// a + b·t
#[inline]
pub(crate) fn along<T: Real>(a: [T; 3], b: [T; 3], t: T) -> [T; 3] {
    [a[0] + b[0] * t, a[1] + b[1] * t, a[2] + b[2] * t]
}

#[inline]
pub(crate) fn sub<T: Real>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Solution of the 2×2 system `m · x = r`, or nothing if `m` is singular to working precision.
#[inline]
pub(crate) fn solve2<T: Real>(m: [[f64; 2]; 2], r: [T; 2]) -> Option<[T; 2]> {
    let det = m[0][0] * m[1][1] - m[0][1] * m[1][0];
    let size = (m[0][0].abs() + m[0][1].abs()) * (m[1][0].abs() + m[1][1].abs());
    // Written so that a NaN is refused as well.
    if !(det.abs() > 1e-12 * size) {
        return None;
    }
    let k = |v: f64| T::constant(v / det);
    Some([r[0] * k(m[1][1]) - r[1] * k(m[0][1]), r[1] * k(m[0][0]) - r[0] * k(m[1][0])])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every operation against central differences; error of the latter is about 1e-10 here.
    #[test]
    fn dual_operations_match_finite_differences() {
        fn f<T: Real>(x: T, y: T) -> T {
            let (s, c) = (x * y).sin_cos();
            (s / (c + T::constant(3.0)) - y).sqrt() * (-x) + x / y
        }
        let (x, y) = (0.7, -1.3);
        let exact = f(Dual::<2>::variable(x, 0), Dual::<2>::variable(y, 1));
        let e = 1e-6;
        let dx = (f(x + e, y) - f(x - e, y)) / (2.0 * e);
        let dy = (f(x, y + e) - f(x, y - e)) / (2.0 * e);
        assert_eq!(exact.value, f(x, y));
        assert!((exact.gradient[0] - dx).abs() < 1e-9, "{exact:?} {dx}");
        assert!((exact.gradient[1] - dy).abs() < 1e-9, "{exact:?} {dy}");
    }

    #[test]
    fn solve2_solves_and_refuses_singular() {
        let x = solve2([[2.0, 1.0], [-1.0, 3.0]], [5.0, 8.0]).unwrap();
        assert!((x[0] - 1.0).abs() < 1e-15 && (x[1] - 3.0).abs() < 1e-15);
        assert!(solve2([[1.0, 2.0], [2.0, 4.0]], [1.0, 1.0]).is_none());
        assert!(solve2([[f64::NAN, 2.0], [2.0, 4.0]], [1.0, 1.0]).is_none());
    }
}
