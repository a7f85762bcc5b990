//! What the light passes: objective, grating, lenslets, and how finely it is described.
//!
//! Lengths are micrometres. Lateral coordinates in the object are those of the image divided by the
//! magnification: the inversion of the image is dropped. x runs to the right (columns), y down (rows).

use serde::{Deserialize, Serialize};

/// The objective with its tube lens.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Objective {
    /// Lateral magnification of object to lenslet plane.
    pub magnification: f64,
    /// Numerical aperture n sin α on the object side.
    pub na: f64,
    /// Refractive index of the medium that object and objective share (immersion).
    pub index: f64,
    /// Wavelength in vacuum, µm.
    pub wavelength_um: f64,
}

impl Objective {
    /// Wave number in the medium, 2πn/λ, per µm.
    pub fn wave_number(&self) -> f64 {
        std::f64::consts::TAU * self.index / self.wavelength_um
    }

    /// Half angle of the light that is collected, asin(NA/n).
    pub fn half_angle(&self) -> f64 {
        (self.na / self.index).asin()
    }
}

/// How the lenslets are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Packing {
    /// Square lattice; the cell is one lenslet.
    Square,
    /// Hexagonal lattice with rows along x; the cell is the rectangle `pitch` × √3 `pitch` with two
    /// lenslets, one at its centre and a quarter of one at each corner.
    Hexagonal,
}

/// The aperture of a lenslet.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Aperture {
    /// The whole cell of the lattice (square or hexagon): no light is lost.
    Full,
    /// A circle of this diameter; what is between the circles is opaque.
    Round {
        /// Diameter, µm.
        diameter_um: f64,
    },
}

/// The lenslet array, in the image plane of the objective, and the sensor behind it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lenslets {
    /// Distance of neighbouring lenslets, µm.
    pub pitch_um: f64,
    /// Focal length in air, µm.
    pub focal_um: f64,
    /// Distance of lenslets and sensor in air, µm.
    pub gap_um: f64,
    /// Packing.
    pub packing: Packing,
    /// Aperture.
    pub aperture: Aperture,
}

impl Lenslets {
    /// Square, full lenslets with the sensor in their focal plane.
    pub fn square(pitch_um: f64, focal_um: f64) -> Self {
        Self { pitch_um, focal_um, gap_um: focal_um, packing: Packing::Square, aperture: Aperture::Full }
    }

    /// Size (y, x) of the cell that repeats, µm.
    pub fn cell_um(&self) -> [f64; 2] {
        match self.packing {
            Packing::Square => [self.pitch_um; 2],
            Packing::Hexagonal => [3f64.sqrt() * self.pitch_um, self.pitch_um],
        }
    }
}

/// Model of what the grating does to the light of a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DiffractionModel {
    /// One virtual point (V₁ ∓ V₃ tan θ, V₂, V₃/cos³ θ), thesis (4.8). Right along the grating vector and
    /// near the axis only: across the vector the depth is V₃/cos θ.
    Virtual,
    /// The exact phase over the pupil, k₀ V₃ √(n² − (s+q)² − t²), amplitude of an isotropic emitter, the
    /// grating's efficiency taken as 1 at all angles.
    Pupil,
}

/// Which of the two first-order views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// The view whose image moves towards −x when the object moves away from the objective.
    Plus,
    /// Its mirror image in x.
    Minus,
}

/// A transmission grating between object and objective, its vector along x.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grating {
    /// Pitch, µm; sin θ = λ/(n pitch).
    pub pitch_um: f64,
    /// The view.
    pub order: Order,
    /// The model.
    pub model: DiffractionModel,
}

impl Grating {
    /// Sine of the diffraction angle of the axial ray.
    pub fn sine(&self, objective: &Objective) -> f64 {
        objective.wavelength_um / (objective.index * self.pitch_um)
    }
}

/// Which way depth grows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthSign {
    /// z > 0 is farther from the objective (the thesis).
    #[default]
    AwayFromObjective,
    /// z > 0 is nearer to the objective (several published programs).
    TowardsObjective,
}

impl DepthSign {
    /// Depth away from the objective.
    pub(crate) fn away(self, z: f64) -> f64 {
        match self {
            Self::AwayFromObjective => z,
            Self::TowardsObjective => -z,
        }
    }
}

/// From the lenslets to the sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Propagation {
    /// exp(−(i/4π) λ d (ω_x² + ω_y²)), thesis (4.6).
    #[default]
    Fresnel,
    /// exp(i d (√(k₀² − ω²) − k₀)); evanescent waves are dropped.
    AngularSpectrum,
}

/// The weight wᵢ of (4.7): how a voxel is made of points.
///
/// Sub-points lie at ((j + ½)/n − ½) of the voxel's width about its centre, laterally; along z a voxel is a
/// point at its plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum VoxelKernel {
    /// One point at the centre.
    Point,
    /// The mean of n × n sub-points.
    Box(usize),
    /// Raised cosine ½(1 + cos(2πt/3)), t in voxels, three voxels wide, with n sub-points a voxel and
    /// side; weights sum to 1. The thesis' choice. Neighbouring voxels overlap.
    RaisedCosine(usize),
}

impl VoxelKernel {
    /// Sub-points per voxel and side.
    pub(crate) fn points(self) -> usize {
        match self {
            Self::Point => 1,
            Self::Box(n) | Self::RaisedCosine(n) => n,
        }
    }

    /// One-dimensional weights: (sub-point counted from the first of the voxel, weight).
    pub(crate) fn weights(self) -> Vec<(isize, f64)> {
        match self {
            Self::Point => vec![(0, 1.0)],
            Self::Box(n) => (0..n as isize).map(|j| (j, 1.0 / n as f64)).collect(),
            Self::RaisedCosine(n) => {
                let m = n as isize;
                let weight = |j: isize| {
                    let t = (j as f64 + 0.5) / n as f64 - 0.5;
                    0.5 * (1.0 + (std::f64::consts::TAU * t / 3.0).cos())
                };
                let sum: f64 = (-m..2 * m).map(weight).sum();
                (-m..2 * m).map(|j| (j, weight(j) / sum)).collect()
            }
        }
    }
}

/// How many lenslets around its own a voxel's light is followed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Radius {
    /// So many cells on every side, in all planes.
    Cells(usize),
    /// For each plane as many as hold this share of the light, at most `max`.
    Energy {
        /// Share of the light, below 1.
        share: f64,
        /// Largest radius.
        max: usize,
    },
}

/// Field samples per pixel and side.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Oversampling {
    /// From dx ≤ λ f/(5 p) on, refined until the self-test holds.
    Auto,
    /// So many.
    Samples(usize),
}

/// Everything that determines a point spread function.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PsfParameters {
    /// The objective.
    pub objective: Objective,
    /// The lenslets.
    pub lenslets: Lenslets,
    /// The grating, if there is one.
    pub grating: Option<Grating>,
    /// Pixels (y, x) of a cell, Nnum.
    pub pixels: [usize; 2],
    /// Voxels (y, x) of a cell, S.
    pub voxels: [usize; 2],
    /// Depths of the planes, µm.
    pub planes_um: Vec<f64>,
    /// Which way depth grows.
    pub depth: DepthSign,
    /// Extent of the point spread function.
    pub radius: Radius,
    /// Field samples.
    pub oversampling: Oversampling,
    /// Cells beyond the radius in which the field is followed too, so that what wraps around stays outside.
    pub guard: usize,
    /// How a voxel is made of points.
    pub kernel: VoxelKernel,
    /// From lenslets to sensor.
    pub propagation: Propagation,
    /// Largest relative change (L2) of the self-test when the field is sampled 1.8 times as finely.
    pub sampling_tolerance: f64,
    /// Take the given sampling even when the self-test exceeds the tolerance.
    pub allow_under_sampling: bool,
}

impl PsfParameters {
    /// The thesis' simulated microscope (20×/0.5, 450 nm, lenslets 150 µm / 3000 µm, S = 3, 15 pixels) with
    /// these planes, without a grating.
    pub fn thesis(planes_um: Vec<f64>) -> Self {
        Self {
            objective: Objective { magnification: 20.0, na: 0.5, index: 1.0, wavelength_um: 0.45 },
            lenslets: Lenslets::square(150.0, 3000.0),
            grating: None,
            pixels: [15; 2],
            voxels: [3; 2],
            planes_um,
            depth: DepthSign::AwayFromObjective,
            radius: Radius::Cells(4),
            oversampling: Oversampling::Auto,
            guard: 2,
            kernel: VoxelKernel::Point,
            propagation: Propagation::Fresnel,
            sampling_tolerance: 0.01,
            allow_under_sampling: false,
        }
    }

    /// Voxel size (y, x) in the object, µm.
    pub fn voxel_um(&self) -> [f64; 2] {
        let cell = self.lenslets.cell_um();
        [0, 1].map(|a| cell[a] / self.objective.magnification / self.voxels[a] as f64)
    }
}
