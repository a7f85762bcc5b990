//! What the given motions determine, and which motion would determine the rest.

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use serde::{Deserialize, Serialize};

/// A quantity of the linear model, or a ratio that some motions determine where they leave its
/// parts open.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// β₁, mm/px.
    Beta1,
    /// β₂, mm/px.
    Beta2,
    /// β₃, 1/px.
    Beta3,
    /// β₄, 1/px.
    Beta4,
    /// x_c, px.
    CentreX,
    /// y_c, px.
    CentreY,
    /// β₃/β₂, 1/mm.
    Beta3OverBeta2,
    /// β₄/β₂, 1/mm.
    Beta4OverBeta2,
    /// β₁/β₂.
    Beta1OverBeta2,
}

impl Quantity {
    /// The six parameters in the order of [`super::Parameters::to_array`], then the ratios.
    pub const ALL: [Self; 9] = [
        Self::Beta1,
        Self::Beta2,
        Self::Beta3,
        Self::Beta4,
        Self::CentreX,
        Self::CentreY,
        Self::Beta3OverBeta2,
        Self::Beta4OverBeta2,
        Self::Beta1OverBeta2,
    ];

    /// Name in files and messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Beta1 => "beta1",
            Self::Beta2 => "beta2",
            Self::Beta3 => "beta3",
            Self::Beta4 => "beta4",
            Self::CentreX => "centre_x",
            Self::CentreY => "centre_y",
            Self::Beta3OverBeta2 => "beta3/beta2",
            Self::Beta4OverBeta2 => "beta4/beta2",
            Self::Beta1OverBeta2 => "beta1/beta2",
        }
    }

    /// Unit, in millimetres and pixels.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Beta1 | Self::Beta2 => "mm/px",
            Self::Beta3 | Self::Beta4 => "1/px",
            Self::CentreX | Self::CentreY => "px",
            Self::Beta3OverBeta2 | Self::Beta4OverBeta2 => "1/mm",
            Self::Beta1OverBeta2 => "1",
        }
    }

    /// Value and derivatives as a function of [`Image`].
    pub(super) fn of(self, a: &Image) -> (f64, [f64; 6]) {
        let [a1, a2, a3, a4, bx, by] = a.values;
        let mut d = [0.0; 6];
        let value = match self {
            Self::Beta1 => {
                d[0] = -1.0 / (a1 * a1);
                1.0 / a1
            }
            Self::Beta2 => {
                d[1] = -1.0 / (a2 * a2);
                1.0 / a2
            }
            Self::Beta3 => {
                d[2] = 1.0 / a2;
                d[1] = -a3 / (a2 * a2);
                a3 / a2
            }
            Self::Beta4 => {
                d[3] = 1.0 / a2;
                d[1] = -a4 / (a2 * a2);
                a4 / a2
            }
            // No spread at all: any centre will do, the middle of the points is as good as another. It
            // is known to be of no consequence only where the spread is.
            Self::CentreX if a3 == 0.0 => {
                (d[2], d[4]) = (1.0, 1.0);
                a.middle_px[0]
            }
            Self::CentreX => {
                d[4] = 1.0 / a3;
                d[2] = -bx / (a3 * a3);
                a.middle_px[0] + bx / a3
            }
            Self::CentreY if a4 == 0.0 => {
                (d[3], d[5]) = (1.0, 1.0);
                a.middle_px[1]
            }
            Self::CentreY => {
                d[5] = 1.0 / a4;
                d[3] = -by / (a4 * a4);
                a.middle_px[1] + by / a4
            }
            Self::Beta3OverBeta2 => {
                d[2] = 1.0;
                a3
            }
            Self::Beta4OverBeta2 => {
                d[3] = 1.0;
                a4
            }
            Self::Beta1OverBeta2 => {
                d[1] = 1.0 / a1;
                d[0] = -a2 / (a1 * a1);
                a2 / a1
            }
        };
        (value, d)
    }
}

/// The parameters of the forward model as the images show them, in which a translation is linear:
/// a₁ = 1/β₁, a₂ = 1/β₂ (px/mm), a₃ = β₃/β₂, a₄ = β₄/β₂ (1/mm), b_x = a₃ (x_c − x₀),
/// b_y = a₄ (y_c − y₀) (px/mm), with (x₀, y₀) the middle of the points.
#[derive(Clone, Copy, Debug)]
pub(super) struct Image {
    pub(super) values: [f64; 6],
    pub(super) middle_px: [f64; 2],
}

/// A motion that can be added.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Candidate {
    /// A known move along z.
    MoveZ,
    /// A known in-plane move along x.
    MoveX,
    /// A known in-plane move along y.
    MoveY,
    /// A known tilt about x; where its axis lies need not be known.
    TiltX,
    /// A known tilt about y; where its axis lies need not be known.
    TiltY,
}

impl Candidate {
    /// All of them, the simplest first.
    pub const ALL: [Self; 5] = [Self::MoveX, Self::MoveZ, Self::MoveY, Self::TiltY, Self::TiltX];

    /// What to do.
    pub const fn advice(self) -> &'static str {
        match self {
            Self::MoveZ => "a known move along z",
            Self::MoveX => "a known in-plane move along x",
            Self::MoveY => "a known in-plane move along y",
            Self::TiltX => "a known tilt about the x axis",
            Self::TiltY => "a known tilt about the y axis",
        }
    }
}

/// Eigenvalues of the unit-diagonal information below this are what rounding leaves of zero.
const ZERO: f64 = 1e-10;

/// Information (inverse covariance) scaled to a unit diagonal, decomposed.
pub(super) struct Information {
    /// 1/√diagonal; 0 where there is no information at all.
    scale: DVector<f64>,
    eigen: SymmetricEigen<f64, nalgebra::Dyn>,
}

impl Information {
    pub(super) fn new(h: &DMatrix<f64>) -> Self {
        let n = h.nrows();
        let scale = DVector::from_fn(n, |i, _| if h[(i, i)] > 0.0 { 1.0 / h[(i, i)].sqrt() } else { 0.0 });
        let scaled = DMatrix::from_fn(n, n, |i, j| h[(i, j)] * scale[i] * scale[j]);
        Self { scale, eigen: SymmetricEigen::new(scaled) }
    }

    fn known(&self, k: usize) -> bool {
        self.eigen.eigenvalues[k] > ZERO
    }

    /// (H + μ·diag)⁻¹ g within what is determined; the rest stays where it is.
    pub(super) fn step(&self, g: &DVector<f64>, damping: f64) -> DVector<f64> {
        let mut step = DVector::zeros(g.len());
        for k in (0..g.len()).filter(|k| self.known(*k)) {
            let v = self.eigen.eigenvectors.column(k);
            let along = v.iter().zip(g).zip(&self.scale).map(|((v, g), s)| v * g * s).sum::<f64>();
            step.axpy(along / (self.eigen.eigenvalues[k] + damping), &v, 1.0);
        }
        step.component_mul(&self.scale)
    }

    /// Covariance within what is determined.
    pub(super) fn covariance(&self) -> DMatrix<f64> {
        let n = self.scale.len();
        let mut c = DMatrix::zeros(n, n);
        for k in (0..n).filter(|k| self.known(*k)) {
            let v = self.eigen.eigenvectors.column(k).component_mul(&self.scale);
            c += &v * v.transpose() / self.eigen.eigenvalues[k];
        }
        c
    }

    /// Whether a quantity with this gradient is determined: it must not change along any direction
    /// that leaves the images as they are.
    pub(super) fn determines(&self, gradient: &[f64]) -> bool {
        let n = self.scale.len();
        // in scaled coordinates; a parameter without information has none and is open by itself
        let mut size = 0.0;
        for (g, s) in gradient.iter().zip(&self.scale) {
            if *g != 0.0 && *s == 0.0 {
                return false;
            }
            size += (g * s).powi(2);
        }
        let limit = 1e-5 * size.sqrt();
        (0..n).filter(|k| !self.known(*k)).all(|k| {
            let v = self.eigen.eigenvectors.column(k);
            let along: f64 = (0..n).map(|i| v[i] * gradient[i] * self.scale[i]).sum();
            along.abs() <= limit
        })
    }
}

/// Of the six parameters those that the information leaves open.
pub(super) fn open(h: &DMatrix<f64>, at: &Image) -> Vec<Quantity> {
    let information = Information::new(h);
    Quantity::ALL[..6].iter().copied().filter(|q| !information.determines(&q.of(at).1)).collect()
}

/// The shortest list of motions that closes everything, found greedily; each candidate comes with
/// the information it would add.
pub(super) fn remedy(
    h: &DMatrix<f64>,
    at: &Image,
    candidates: &[(Candidate, DMatrix<f64>)],
) -> Vec<Candidate> {
    let mut h = h.clone();
    let mut added = Vec::new();
    let mut left = open(&h, at).len();
    while left > 0 {
        let mut best: Option<(usize, usize)> = None;
        for (i, (candidate, more)) in candidates.iter().enumerate() {
            let rest = open(&(&h + more), at).len();
            if !added.contains(candidate) && rest < best.map_or(left, |(_, rest)| rest) {
                best = Some((i, rest));
            }
        }
        let Some((i, rest)) = best else { break };
        added.push(candidates[i].0);
        h += &candidates[i].1;
        left = rest;
    }
    added
}
