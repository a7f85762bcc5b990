//! How the interpolating splines pass white noise on; needed to turn residuals into uncertainties.

use crate::settings::Interpolation;
use crate::shape::Warp;
use std::sync::OnceLock;

/// Half length of the impulse responses kept; 0.54^40 is 1e-11.
const REACH: i64 = 40;
const STEPS: usize = 32;
/// Terms of the series in the sub-pixel position, the constant included.
const HARMONICS: usize = 4;

/// Noise properties of one interpolation.
#[derive(Debug, Clone)]
pub(crate) struct NoiseGain {
    /// Σ h(t + k)² over all k, the variance of an interpolated value per unit of pixel variance along
    /// one axis, as a Fourier series in t: Σ aₖ cos 2πkt.
    pub(crate) series: [f64; HARMONICS],
    /// Σ h′(k)² of the quintic: the variance of a gradient value.
    pub(crate) gradient: f64,
}

/// Centred B-spline of degree `n` by the de Boor recursion.
pub(crate) fn spline(n: u32, x: f64) -> f64 {
    if n == 0 {
        return if (-0.5..0.5).contains(&x) { 1.0 } else { 0.0 };
    }
    let half = f64::from(n + 1) / 2.0;
    if x.abs() >= half {
        return 0.0;
    }
    ((half + x) * spline(n - 1, x + 0.5) + (half - x) * spline(n - 1, x - 0.5)) / f64::from(n)
}

/// Coefficients c(k) of the cardinal spline: the inverse of the sampled B-spline.
fn cardinal(n: u32) -> Vec<f64> {
    let poles: &[f64] = match n {
        3 => &[-0.267_949_192_431_122_7],
        5 => &[-0.430_575_347_099_973_8, -0.043_096_288_203_264_65],
        _ => &[-0.535_280_430_796_438_2, -0.122_554_615_192_326_69, -0.009_148_694_809_608_277],
    };
    let len = (2 * REACH + 1) as usize;
    let mut c = vec![0.0; len];
    c[REACH as usize] = 1.0;
    for &z in poles {
        for k in 1..len {
            c[k] += z * c[k - 1];
        }
        for k in (0..len - 1).rev() {
            c[k] += z * c[k + 1];
        }
        let gain = (1.0 - z) * (1.0 - z);
        c.iter_mut().for_each(|v| *v *= gain);
    }
    c
}

impl NoiseGain {
    /// Properties of an interpolation, worked out once.
    pub(crate) fn of(kind: Interpolation) -> &'static Self {
        static CUBIC: OnceLock<NoiseGain> = OnceLock::new();
        static QUINTIC: OnceLock<NoiseGain> = OnceLock::new();
        static SEPTIC: OnceLock<NoiseGain> = OnceLock::new();
        match kind {
            Interpolation::Cubic => CUBIC.get_or_init(|| Self::new(kind)),
            Interpolation::Quintic => QUINTIC.get_or_init(|| Self::new(kind)),
            Interpolation::Septic => SEPTIC.get_or_init(|| Self::new(kind)),
        }
    }

    fn new(kind: Interpolation) -> Self {
        let n = match kind {
            Interpolation::Cubic => 3,
            Interpolation::Quintic => 5,
            Interpolation::Septic => 7,
        };
        let value = |c: &[f64], n: u32, x: f64| -> f64 {
            let near = x.round() as i64;
            (near - 4..=near + 4)
                .filter(|k| k.abs() <= REACH)
                .map(|k| c[(k + REACH) as usize] * spline(n, x - k as f64))
                .sum()
        };
        let c = cardinal(n);
        let mut energy = [0.0; STEPS + 1];
        for (i, e) in energy.iter_mut().enumerate() {
            let t = i as f64 / STEPS as f64;
            *e = (-20..=20).map(|k| value(&c, n, t + f64::from(k)).powi(2)).sum();
        }
        let c = cardinal(5);
        // β5′(x) = β4(x + ½) − β4(x − ½)
        let slope = |k: i64| -> f64 {
            (k - 3..=k + 3)
                .map(|j| {
                    let x = (k - j) as f64;
                    c[(j + REACH) as usize] * (spline(4, x + 0.5) - spline(4, x - 0.5))
                })
                .sum()
        };
        let gradient = (-20..=20).map(|k| slope(k).powi(2)).sum();
        let mut series = [0.0; HARMONICS];
        for (k, a) in series.iter_mut().enumerate() {
            let weight = if k == 0 { 1.0 } else { 2.0 } / STEPS as f64;
            for (i, e) in energy[..STEPS].iter().enumerate() {
                *a += weight * e * (std::f64::consts::TAU * (k * i) as f64 / STEPS as f64).cos();
            }
        }
        Self { series, gradient }
    }

    /// Variance of an interpolated value at a sub-pixel position, per unit of pixel variance.
    #[cfg(test)]
    fn interpolated(&self, u: f64, v: f64) -> f64 {
        self.over([u, 0.0, 0.0], 1.0) * self.over([v, 0.0, 0.0], 1.0)
    }

    /// Mean of the same over a subset of half width r that is displaced like `warp`.
    #[inline(always)]
    pub(crate) fn interpolated_over(&self, warp: &Warp, r: f64) -> f64 {
        let [u, v] = &warp.0;
        self.over([u[0], u[1], u[2]], r) * self.over([v[0], v[1], v[2]], r)
    }

    /// Mean over a square of half width r of the energy at c₀ + c₁ξ + c₂η.
    #[inline(always)]
    fn over(&self, c: [f64; 3], r: f64) -> f64 {
        let one = cosine(c[0]);
        let (mut last, mut now) = (1.0, one);
        let mut sum = self.series[0];
        for (k, a) in self.series.iter().enumerate().skip(1) {
            let turn = std::f64::consts::TAU * k as f64 * r;
            sum += a * now * sinc(turn * c[1]) * sinc(turn * c[2]);
            (last, now) = (now, 2.0 * one * now - last);
        }
        sum
    }
}

/// cos 2πt to 1e-7.
#[inline(always)]
fn cosine(t: f64) -> f64 {
    // sin 2π(¼ − |t|) for |t| ≤ ½ by its Taylor series; `round` would be a call on plain x86-64
    let f = (t - t as i64 as f64).abs();
    let s = std::f64::consts::TAU * (0.25 - f.min(1.0 - f));
    let q = s * s;
    s * (1.0
        + q * (-1.0 / 6.0
            + q * (1.0 / 120.0 + q * (-1.0 / 5040.0 + q * (1.0 / 362_880.0 - q / 39_916_800.0)))))
}

/// sin x / x up to |x| = 3, where it is 0.05; nothing beyond: a subset over which the phase of the
/// interpolation turns that often sees the mean.
#[inline(always)]
fn sinc(x: f64) -> f64 {
    let q = x * x;
    if q > 9.0 {
        return 0.0;
    }
    1.0 + q
        * (-1.0 / 6.0 + q * (1.0 / 120.0 + q * (-1.0 / 5040.0 + q * (1.0 / 362_880.0 - q / 39_916_800.0))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolated_noise_is_whole_at_pixels_and_less_between() {
        for kind in [Interpolation::Cubic, Interpolation::Quintic, Interpolation::Septic] {
            let g = NoiseGain::new(kind);
            // what the series leaves out: 3e-4 per axis for the cubic, 3e-6 for the quintic
            assert!((g.interpolated(3.0, -2.0) - 1.0).abs() < 1e-3);
            let half = g.interpolated(0.5, 0.0);
            assert!(half > 0.6 && half < 0.9, "{half}");
            assert!((g.interpolated(0.3, 0.0) - g.interpolated(0.7, 0.0)).abs() < 1e-9);
        }
        // π²/3 for an ideal band-limited derivative; the quintic rolls off near Nyquist
        let g = NoiseGain::new(Interpolation::Quintic).gradient;
        assert!(g > 1.0 && g < 3.29, "{g}");
    }
}
