//! From displacement gradients to strain tensors.

use super::fit::Gradient;
use super::{Gradients, StrainStatus};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Strain measure. F = I + ∂u/∂X, C = FᵀF, U = √C, λ the principal stretches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Tensor {
    /// ½ (C − I), principal values ½ (λ² − 1); reference axes.
    #[default]
    GreenLagrange,
    /// ln U (true, logarithmic strain), ln λ; reference axes.
    Hencky,
    /// ½ (∂u + ∂uᵀ), the small-strain tensor; not free of rotation.
    Engineering,
    /// U − I, λ − 1 (nominal strain, free of rotation); reference axes.
    Biot,
    /// ½ (I − (F Fᵀ)⁻¹), ½ (1 − λ⁻²); deformed axes.
    EulerAlmansi,
}

impl Tensor {
    /// Every measure.
    pub const ALL: [Tensor; 5] =
        [Tensor::GreenLagrange, Tensor::Hencky, Tensor::Engineering, Tensor::Biot, Tensor::EulerAlmansi];

    /// Stable name.
    pub fn name(self) -> &'static str {
        match self {
            Tensor::GreenLagrange => "green-lagrange",
            Tensor::Hencky => "hencky",
            Tensor::Engineering => "engineering",
            Tensor::Biot => "biot",
            Tensor::EulerAlmansi => "euler-almansi",
        }
    }

    /// Components e_xx, e_yy, e_xy for a displacement gradient; `None` where det F ≤ 0, for which no
    /// strain exists.
    pub fn of(self, gradient: &[[f64; 2]; 2]) -> Option<[f64; 3]> {
        let [[ux, uy], [vx, vy]] = *gradient;
        let determinant = (1.0 + ux) * (1.0 + vy) - uy * vx;
        if determinant.is_nan() || determinant <= 0.0 {
            return None;
        }
        let green = [
            ux + 0.5 * (ux * ux + vx * vx),
            vy + 0.5 * (uy * uy + vy * vy),
            0.5 * (uy + vx + ux * uy + vx * vy),
        ];
        Some(match self {
            Tensor::Engineering => [ux, vy, 0.5 * (uy + vx)],
            Tensor::GreenLagrange => green,
            // with the principal values E of ½ (C − I): λ² = 1 + 2E; log1p and the like keep small strains
            // free of cancellation
            Tensor::Hencky => of_principal(green, |e| 0.5 * (2.0 * e).ln_1p(), |e| 1.0 / (1.0 + 2.0 * e)),
            Tensor::Biot => {
                let root = |e: f64| (1.0 + 2.0 * e).sqrt();
                of_principal(green, |e| 2.0 * e / (1.0 + root(e)), |e| 1.0 / root(e))
            }
            Tensor::EulerAlmansi => {
                // ½ (B − I), then E / (1 + 2E)
                let finger = [
                    ux + 0.5 * (ux * ux + uy * uy),
                    vy + 0.5 * (vx * vx + vy * vy),
                    0.5 * (uy + vx + ux * vx + uy * vy),
                ];
                of_principal(finger, |e| e / (1.0 + 2.0 * e), |e| (1.0 + 2.0 * e).powi(-2))
            }
        })
    }
}

impl fmt::Display for Tensor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Mean of the principal values and half their difference.
fn mohr([xx, yy, xy]: [f64; 3]) -> (f64, f64) {
    (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy))
}

/// f of a symmetric tensor: f applied to its principal values. `slope` is f′.
fn of_principal(t: [f64; 3], f: impl Fn(f64) -> f64, slope: impl Fn(f64) -> f64) -> [f64; 3] {
    let (mean, radius) = mohr(t);
    let (low, high) = (f(mean - radius), f(mean + radius));
    // f(T) = ½ (f₁ + f₂) I + (f₁ − f₂)/(e₁ − e₂) (T − mean I)
    let per = if radius > 1e-8 { (high - low) / (2.0 * radius) } else { slope(mean) };
    let half = 0.5 * (t[0] - t[1]);
    let middle = 0.5 * (low + high);
    [middle + per * half, middle - per * half, per * t[2]]
}

/// Strain at a point. Where the status is not ok every number is NaN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strain {
    /// Verdict.
    pub status: StrainStatus,
    /// Points that took part.
    pub used: u32,
    /// e_xx, e_yy, e_xy (component of the tensor, ½ γ).
    pub components: [f64; 3],
    /// Standard uncertainties of the components from the noise of the images; NaN where unknown.
    pub sigma: [f64; 3],
    /// Greater and smaller principal strain.
    pub principal: [f64; 2],
    /// Direction of the greater principal strain, −π/2…π/2, from x towards y.
    pub angle: f64,
    /// Equivalent strain after von Mises for a volume that does not change,
    /// (2/√3) √(e₁² + e₁e₂ + e₂²).
    pub von_mises: f64,
    /// Rotation of the material, from x towards y: the R of F = R U.
    pub rotation: f64,
}

impl Strain {
    fn failed(status: StrainStatus, used: u32) -> Self {
        let nan = f64::NAN;
        Self {
            status,
            used,
            components: [nan; 3],
            sigma: [nan; 3],
            principal: [nan; 2],
            angle: nan,
            von_mises: nan,
            rotation: nan,
        }
    }

    /// Strain from a gradient.
    pub fn of(point: &Gradient, tensor: Tensor) -> Self {
        if !point.status.is_ok() {
            return Self::failed(point.status, point.used);
        }
        let Some(components) = tensor.of(&point.gradient) else {
            return Self::failed(StrainStatus::Folded, point.used);
        };
        if components.iter().any(|c| !c.is_finite()) {
            return Self::failed(StrainStatus::Folded, point.used);
        }
        let [xx, yy, xy] = components;
        let (mean, radius) = mohr(components);
        let [e1, e2] = [mean + radius, mean - radius];
        let [[ux, uy], [vx, vy]] = point.gradient;
        Self {
            status: StrainStatus::Ok,
            used: point.used,
            components,
            sigma: sigma(point, tensor),
            principal: [e1, e2],
            angle: 0.5 * (2.0 * xy).atan2(xx - yy),
            von_mises: 2.0 / 3f64.sqrt() * (e1 * e1 + e1 * e2 + e2 * e2).max(0.0).sqrt(),
            rotation: (vx - uy).atan2(2.0 + ux + vy),
        }
    }
}

/// First-order propagation; the derivatives of the components by central differences.
fn sigma(point: &Gradient, tensor: Tensor) -> [f64; 3] {
    const H: f64 = 1e-5;
    let mut slopes = [[[0.0; 3]; 2]; 2];
    for (r, row) in slopes.iter_mut().enumerate() {
        for (c, slope) in row.iter_mut().enumerate() {
            let shifted = |h: f64| {
                let mut g = point.gradient;
                g[r][c] += h;
                tensor.of(&g)
            };
            let (Some(after), Some(before)) = (shifted(H), shifted(-H)) else {
                return [f64::NAN; 3];
            };
            *slope = std::array::from_fn(|k| (after[k] - before[k]) / (2.0 * H));
        }
    }
    std::array::from_fn(|k| {
        let variance: f64 = (0..2)
            .map(|r| {
                let (x, y) = (slopes[r][0][k], slopes[r][1][k]);
                let [xx, yy, xy] = point.covariance[r];
                // a component that does not depend on u needs no uncertainty of u
                if x == 0.0 && y == 0.0 { 0.0 } else { x * x * xx + y * y * yy + 2.0 * x * y * xy }
            })
            .sum();
        // rounding may leave a vanishing variance below zero; NaN stays NaN
        if variance < 0.0 { 0.0 } else { variance.sqrt() }
    })
}

impl Gradients {
    /// Strain at every node.
    pub fn strains(&self, tensor: Tensor) -> Vec<Strain> {
        self.points.par_iter().map(|point| Strain::of(point, tensor)).collect()
    }
}
