//! Analysis windows: separable, even, of unit sum.

use super::settings::WindowKind;

/// One axis of a separable analysis window; the window is its product along x and y.
#[derive(Debug, Clone, PartialEq)]
pub struct Window {
    /// Weights at −radius…radius pixels.
    weights: Vec<f32>,
    /// Σ w².
    energy: f64,
}

/// Where Gaussians are cut, in standard deviations. What is left there is taken off all weights, so
/// that the cut has no edge: background and harmonics leak by 4e-5 at a width of two pitches, 2.5e-4 at 0.75.
const CUT: f64 = 3.5;
/// The flat Gaussian has heavier tails.
const FLAT_CUT: f64 = 4.0;

impl Window {
    /// Window of `width` pixels: standard deviation of the Gaussians, half base of the triangle.
    pub fn new(kind: WindowKind, width: f64) -> Self {
        let gauss = |x: f64| (-0.5 * (x / width).powi(2)).exp();
        let half = match kind {
            WindowKind::Gaussian => CUT * width,
            WindowKind::GaussianFlat => FLAT_CUT * width,
            WindowKind::BiTriangular => width,
        };
        let radius = (half.ceil() as i64).max(1);
        let at = |f: &dyn Fn(f64) -> f64| -> Vec<f64> { (-radius..=radius).map(|k| f(k as f64)).collect() };
        let end = radius as f64;
        let mut w = match kind {
            WindowKind::Gaussian => at(&|x| gauss(x) - gauss(end)),
            WindowKind::GaussianFlat => {
                let base = at(&|x| gauss(x) - gauss(end));
                let moment = |n: i32| -> f64 {
                    base.iter().enumerate().map(|(i, b)| b * (i as f64 - end).powi(n)).sum()
                };
                // (1 − c x²) with Σ x² w = 0 exactly
                let c = moment(2) / moment(4);
                base.iter().enumerate().map(|(i, b)| b * (1.0 - c * (i as f64 - end).powi(2))).collect()
            }
            WindowKind::BiTriangular => at(&|x| (1.0 - x.abs() / width).max(0.0)),
        };
        let sum: f64 = w.iter().sum();
        w.iter_mut().for_each(|v| *v /= sum);
        let energy = w.iter().map(|v| v * v).sum();
        Self { weights: w.iter().map(|&v| v as f32).collect(), energy }
    }

    /// Pixels to each side of the centre.
    pub fn radius(&self) -> usize {
        self.weights.len() / 2
    }

    /// Weights at −radius…radius pixels; their sum is one.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// Sum of the squared weights along one axis; white noise of variance 1 passes the
    /// two-dimensional window with its square.
    pub fn energy(&self) -> f64 {
        self.energy
    }

    /// Part of a phase (and displacement) wave of `period` pixels along one axis that is left
    /// after the window: 1 for long waves. A wave oblique to the axes keeps the product of the
    /// parts of its periods along x and y.
    pub fn transfer(&self, period: f64) -> f64 {
        let r = self.radius() as f64;
        let at = |k: usize| (std::f64::consts::TAU * (k as f64 - r) / period).cos();
        self.weights.iter().enumerate().map(|(k, &w)| f64::from(w) * at(k)).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussian_agrees_with_its_integrals() {
        let w = Window::new(WindowKind::Gaussian, 16.0);
        // 1 / (2 √π σ), but for the cut at 3.5 σ (0.7 %)
        let energy = 1.0 / (2.0 * std::f64::consts::PI.sqrt() * 16.0);
        assert!((w.energy() / energy - 1.0).abs() < 8e-3, "{}", w.energy() / energy);
        let transfer = (-2.0 * (std::f64::consts::PI * 16.0 / 200.0).powi(2)).exp();
        // the cut narrows the window: 0.8839 against 0.8813
        assert!((w.transfer(200.0) - transfer).abs() < 3e-3, "{} {transfer}", w.transfer(200.0));
        // background and doubled carrier of a pitch of 8 px
        assert!(w.transfer(8.0).abs() < 1e-4 && w.transfer(4.0).abs() < 1e-4);
    }

    #[test]
    fn flat_gaussian_passes_quadratic_phase_and_costs_what_it_says() {
        let (flat, plain) =
            (Window::new(WindowKind::GaussianFlat, 16.0), Window::new(WindowKind::Gaussian, 16.0));
        let moment: f64 =
            flat.weights().iter().enumerate().map(|(k, &w)| f64::from(w) * (k as f64 - 64.0).powi(2)).sum();
        assert!(moment.abs() < 1e-3, "{moment}");
        // both axes: √(1.6875²) for uncut Gaussians
        let cost = flat.energy() / plain.energy();
        assert!((cost - 1.6875).abs() < 0.03, "{cost}");
        assert!(flat.transfer(600.0) > 0.9997 && plain.transfer(600.0) < 0.987);
    }

    #[test]
    fn triangle_has_zeros_at_the_harmonics() {
        let w = Window::new(WindowKind::BiTriangular, 24.0);
        for n in 1..=3 {
            assert!(w.transfer(8.0 / f64::from(n)).abs() < 1e-6);
        }
        let sum: f32 = w.weights().iter().sum();
        assert!((sum - 1.0).abs() < 1e-6);
    }
}
