//! Standard uncertainties of a point from the noise of the images and the gradients of the subset.

use crate::domain::Cut;
use crate::icgn::Solver;
use crate::normal::{EXPONENTS, MAX, Normal};
use crate::settings::Criterion;
use crate::shape::Warp;
use crate::subset::Subset;
use crate::verdict::Numbers;

/// Share of noise in the energy of the gradients above which it is taken out of the normal matrix.
pub(crate) const EXCESS: f64 = 0.1;
/// Largest such share that can be told from all of it.
pub(crate) const MOST_EXCESS: f64 = 0.8;

impl Solver<'_> {
    /// Standard uncertainties of u and v; the offset of the grey levels is free, and so is their gain
    /// unless the criterion fixes it.
    pub(crate) fn sigma(&self, warp: &Warp, numbers: &Numbers) -> ([f32; 2], f64) {
        let n = numbers.count;
        let r = self.layout.radius as f64;
        let Numbers { energy, variance, gain, .. } = *numbers;
        let gain2 = gain * gain;
        // share of the noise that the interpolation of the deformed image lets through
        let passed = self.noise.interpolated_over(warp, r);
        let noise = self.noise_variance(numbers, passed);
        let mut out = [f32::NAN; 2];
        let mut largest = 0.0f64;
        for (c, o) in out.iter_mut().enumerate() {
            // Noise in the gradients makes the normal matrix H look better than it is: the true one is
            // H₀ = H (1 − excess). The right-hand side is Σ G (n_f − gain n_g). The reference's own
            // product of noise and gradient noise sums to nothing, which leaves s² H₀. The deformed
            // image's noise meets true gradients, which lie where the spline passes all, and those of
            // noise, of which it passes what it passes of white noise (to 0.3 % of it; cubic: 6 %).
            let excess = (n * self.noise.gradient * noise / energy[c]).min(MOST_EXCESS);
            largest = largest.max(excess);
            let honest = 1.0 - excess;
            let right = honest + gain2 * (honest + excess * passed);
            *o = (noise * variance[c] * right).max(0.0).sqrt() as f32 / honest as f32;
        }
        (out, largest)
    }

    /// Variance of the noise of one image, the same in both; `passed` is the share of it that the
    /// interpolation lets through.
    fn noise_variance(&self, numbers: &Numbers, passed: f64) -> f64 {
        match self.settings.noise {
            Some(s) => s * s,
            None => {
                let spread = 1.0 + numbers.gain * numbers.gain * passed;
                numbers.left.max(0.0) / self.freedom(numbers.count) / spread
            }
        }
    }

    /// Degrees of freedom of the residuals of a subset of `count` pixels.
    pub(crate) fn freedom(&self, count: f64) -> f64 {
        let m = self.settings.shape.parameters_per_component();
        // offset, and gain where it is free
        let levels = if self.settings.criterion == Criterion::Znssd { 2.0 } else { 1.0 };
        (count - levels - 2.0 * m as f64).max(1.0)
    }

    /// As [`Solver::sigma`] where noise makes up so much of the gradients that its part of the normal
    /// matrix, Γ s² Φ, cannot be treated as a small share of each element: it is taken out of the
    /// matrix itself. Φ are the moments of the monomials, Γ the gradient filter's noise gain.
    /// `None` where next to nothing is left of it.
    pub(crate) fn sigma_in_noise(
        &self,
        (subset, cut): (&Subset, &Cut),
        warp: &Warp,
        offset: [f64; 2],
        numbers: &Numbers,
    ) -> Option<[f32; 2]> {
        let n = numbers.count;
        let r = self.layout.radius as f64;
        let m = self.settings.shape.parameters_per_component();
        let gain2 = numbers.gain * numbers.gain;
        let passed = self.noise.interpolated_over(warp, r);
        let noise = self.noise_variance(numbers, passed);
        let moments = self.moments(cut);
        let mut true_matrix = Normal::matrix(subset, m, n);
        let mut of_noise = [[0.0; MAX]; MAX];
        for a in 0..m {
            for b in 0..=a {
                let ((ia, ja), (ib, jb)) = (EXPONENTS[a], EXPONENTS[b]);
                let phi = self.noise.gradient * noise * moments[ia + ib][ja + jb];
                for c in 0..2 {
                    true_matrix[c * m + a][c * m + b] -= phi;
                    of_noise[c * m + a][c * m + b] = phi;
                    of_noise[c * m + b][c * m + a] = phi;
                }
            }
        }
        let normal = Normal::factor(true_matrix, 2 * m)?;
        // next to nothing left of a combination of parameters: what is left is chance itself
        if normal.least_part_of(&Normal::new(subset, m, n)?) < 1.0 - MOST_EXCESS {
            return None;
        }
        let variance = self.variance(subset, &normal, offset);
        let basis = self.basis(offset);
        let mut out = [f32::NAN; 2];
        for (c, o) in out.iter_mut().enumerate() {
            let mut b = [0.0; MAX];
            b[c * m..c * m + m].copy_from_slice(&basis[..m]);
            let x = normal.solve(b);
            let met: f64 =
                (0..2 * m).map(|i| x[i] * (0..2 * m).map(|k| of_noise[i][k] * x[k]).sum::<f64>()).sum();
            *o = (noise * ((1.0 + gain2) * variance[c] + gain2 * passed * met)).max(0.0).sqrt() as f32;
        }
        Some(out)
    }

    /// Σ ξ^i η^j over the pixels used (`cut` row by row; all if it is empty), in units of the radius.
    fn moments(&self, cut: &Cut) -> [[f64; 5]; 5] {
        let r = self.layout.radius as i32;
        let powers = |x: i32| -> [f64; 5] {
            let x = f64::from(x) / f64::from(r);
            std::array::from_fn(|i| x.powi(i as i32))
        };
        let mut sums = [[0.0; 5]; 5];
        for (j, eta) in (-r..=r).enumerate() {
            let mut row = [0.0; 5];
            for (i, xi) in (-r..=r).enumerate() {
                if cut.is_empty() || cut[j * self.layout.width + i] {
                    row.iter_mut().zip(powers(xi)).for_each(|(s, p)| *s += p);
                }
            }
            let eta = powers(eta);
            for i in 0..5 {
                for k in 0..5 {
                    sums[i][k] += row[i] * eta[k];
                }
            }
        }
        sums
    }

    /// Monomials at an offset from the centre.
    fn basis(&self, offset: [f64; 2]) -> [f64; 6] {
        let r = self.layout.radius as f64;
        let (dx, dy) = (offset[0] / r, offset[1] / r);
        [1.0, dx, dy, dx * dx, dx * dy, dy * dy]
    }

    /// Variances of u and v at an offset from the centre per unit of residual variance, from the
    /// inverse normal matrix; the offset of the grey levels is free, and so is their gain unless the
    /// criterion fixes it.
    pub(crate) fn variance(&self, subset: &Subset, normal: &Normal, offset: [f64; 2]) -> [f64; 2] {
        let m = self.settings.shape.parameters_per_component();
        let basis = self.basis(offset);
        let mut slopes_f = [0.0; MAX];
        slopes_f[..m].copy_from_slice(&subset.slopes_f[0][..m]);
        slopes_f[m..2 * m].copy_from_slice(&subset.slopes_f[1][..m]);
        let coupled = normal.solve(slopes_f);
        [0, 1].map(|c| {
            let mut b = [0.0; MAX];
            b[c * m..c * m + m].copy_from_slice(&basis[..m]);
            let own = normal.quadratic_form(b);
            let through_gain: f64 = b.iter().zip(&coupled).map(|(a, e)| a * e).sum();
            match self.settings.criterion {
                Criterion::Znssd => own + through_gain * through_gain / subset.sff,
                Criterion::Zssd => own,
            }
        })
    }
}
