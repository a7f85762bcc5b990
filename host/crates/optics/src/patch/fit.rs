//! Least squares on the pixels of a patch (Levenberg–Marquardt).

use nalgebra::{SMatrix, SVector};

/// A grey value and its position relative to the middle of the patch.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pixel {
    pub(crate) at: [f64; 2],
    pub(crate) grey: f64,
}

/// A model fitted to a patch.
#[derive(Clone, Debug)]
pub(crate) struct Fitted<const N: usize> {
    pub(crate) parameters: [f64; N],
    /// Scaled by the variance of the residuals.
    pub(crate) covariance: SMatrix<f64, N, N>,
    /// Standard deviation of the residuals, grey levels.
    pub(crate) noise: f64,
}

/// Minimises the squared residuals of `model(parameters, position)` = (value, gradient), starting
/// at `start`; `valid` refuses parameters out of range. Nothing if there are too few pixels, the
/// normal equations are singular or the iteration does not settle.
pub(crate) fn least_squares<const N: usize>(
    pixels: &[Pixel],
    start: [f64; N],
    model: impl Fn(&[f64; N], [f64; 2]) -> (f64, [f64; N]),
    valid: impl Fn(&[f64; N]) -> bool,
) -> Option<Fitted<N>> {
    if pixels.len() < 2 * N || !valid(&start) {
        return None;
    }
    let evaluate = |p: &[f64; N]| {
        let mut a = SMatrix::<f64, N, N>::zeros();
        let mut b = SVector::<f64, N>::zeros();
        let mut cost = 0.0;
        for pixel in pixels {
            let (value, gradient) = model(p, pixel.at);
            let r = pixel.grey - value;
            cost += r * r;
            for i in 0..N {
                b[i] += gradient[i] * r;
                for j in 0..=i {
                    a[(i, j)] += gradient[i] * gradient[j];
                }
            }
        }
        for i in 0..N {
            for j in 0..i {
                a[(j, i)] = a[(i, j)];
            }
        }
        (a, b, cost)
    };
    let mut p = start;
    let (mut a, mut b, mut cost) = evaluate(&p);
    let mut damping = 1e-3;
    for _ in 0..40 {
        let mut damped = a;
        for i in 0..N {
            damped[(i, i)] *= 1.0 + damping;
        }
        let step = damped.cholesky()?.solve(&b);
        let mut next = p;
        for i in 0..N {
            next[i] += step[i];
        }
        let expected = step.dot(&b);
        if !(expected.is_finite() && cost.is_finite()) {
            return None;
        }
        let tried = valid(&next).then(|| evaluate(&next)).filter(|t| t.2 <= cost);
        match tried {
            Some((na, nb, nc)) => {
                (p, a, b, cost) = (next, na, nb, nc);
                damping = (damping * 0.1_f64).max(1e-12);
            }
            None => damping *= 10.0,
        }
        // Of the cost that is left the step promised to take only this share.
        if expected <= 1e-9 * cost || (tried.is_none() && damping > 1e8) {
            let noise2 = cost / (pixels.len() - N) as f64;
            let covariance = a.cholesky()?.inverse() * noise2;
            return Some(Fitted { parameters: p, covariance, noise: noise2.sqrt() });
        }
    }
    None
}

#[cfg(test)]
pub(crate) mod tests {
    /// Largest deviation of the gradient of a model from central differences, relative to the
    /// largest entry.
    pub(crate) fn gradient_error<const N: usize>(
        model: impl Fn(&[f64; N], [f64; 2]) -> (f64, [f64; N]),
        p: [f64; N],
        positions: &[[f64; 2]],
    ) -> f64 {
        let (mut worst, mut largest) = (0.0_f64, 0.0_f64);
        for &at in positions {
            let (_, g) = model(&p, at);
            for i in 0..N {
                let e = 1e-6 * p[i].abs().max(1e-2);
                let (mut up, mut down) = (p, p);
                up[i] += e;
                down[i] -= e;
                let d = (model(&up, at).0 - model(&down, at).0) / (2.0 * e);
                worst = worst.max((d - g[i]).abs() / (1.0 + d.abs()));
                largest = largest.max(d.abs());
            }
        }
        assert!(largest > 0.0);
        worst
    }
}
