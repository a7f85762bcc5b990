//! The file that describes a light-field microscope and the volume to be reconstructed.

use super::error::LightFieldError;
use crate::error::Error;
use daic_lightfield::{
    Aperture, DepthSign, DiffractionModel, Grating, Lenslets, Objective, Order, Oversampling, Packing,
    Propagation, PsfParameters, Radius, VoxelKernel,
};
use serde::Deserialize;
use std::path::Path;

/// A commented setup file: the microscope of the published simulation.
pub const TEMPLATE: &str = include_str!("template.toml");

/// A setup file.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Setup {
    objective: Objective,
    lenslets: LensletSection,
    grating: Option<GratingSection>,
    volume: VolumeSection,
    #[serde(default)]
    psf: PsfSection,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct LensletSection {
    pitch_um: f64,
    focal_um: f64,
    gap_um: Option<f64>,
    #[serde(default = "square")]
    packing: Packing,
    /// Round lenslets of this diameter; else full cells.
    diameter_um: Option<f64>,
    /// Pixels per lenslet of rectified images.
    pixels: usize,
}

fn square() -> Packing {
    Packing::Square
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct GratingSection {
    pitch_um: f64,
    #[serde(default = "virtual_model")]
    model: DiffractionModel,
}

fn virtual_model() -> DiffractionModel {
    DiffractionModel::Virtual
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct VolumeSection {
    first_um: f64,
    last_um: f64,
    step_um: f64,
    /// Voxels per lenslet and side.
    voxels: usize,
    #[serde(default)]
    depth: DepthSign,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct PsfSection {
    radius: Option<usize>,
    energy: f64,
    largest_radius: usize,
    samples: Option<usize>,
    guard: usize,
    kernel: VoxelKernel,
    propagation: Propagation,
    tolerance: f64,
    allow_under_sampling: bool,
}

impl Default for PsfSection {
    fn default() -> Self {
        Self {
            radius: None,
            energy: 0.98,
            largest_radius: 12,
            samples: None,
            guard: 2,
            kernel: VoxelKernel::Point,
            propagation: Propagation::Fresnel,
            tolerance: 0.02,
            allow_under_sampling: false,
        }
    }
}

impl Setup {
    /// Reads a setup file.
    ///
    /// # Errors
    /// The file and what is wrong with it.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let text =
            std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        Self::parse(&text).map_err(|reason| LightFieldError::Setup { path: path.to_owned(), reason }.into())
    }

    /// Reads the text of a setup file; the error says line and column.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|e| e.to_string().trim_end().to_owned())
    }

    /// Whether a grating splits the image into two orders.
    pub fn two_orders(&self) -> bool {
        self.grating.is_some()
    }

    /// What the point spread function is computed from.
    ///
    /// # Errors
    /// [`LightFieldError::Planes`].
    pub fn parameters(&self) -> Result<PsfParameters, Error> {
        let v = &self.volume;
        let steps = ((v.last_um - v.first_um) / v.step_um).round();
        if !(v.step_um.is_finite() && (0.0..4096.0).contains(&steps)) {
            return Err(
                LightFieldError::Planes { first: v.first_um, last: v.last_um, step: v.step_um }.into()
            );
        }
        let planes_um = (0..=steps as usize).map(|k| v.first_um + k as f64 * v.step_um).collect();
        let l = &self.lenslets;
        // a hexagonal cell is √3 times as tall as wide
        let tall = |n: usize| match l.packing {
            Packing::Square => n,
            Packing::Hexagonal => (n as f64 * 3f64.sqrt()).round() as usize,
        };
        let p = &self.psf;
        Ok(PsfParameters {
            objective: self.objective,
            lenslets: Lenslets {
                pitch_um: l.pitch_um,
                focal_um: l.focal_um,
                gap_um: l.gap_um.unwrap_or(l.focal_um),
                packing: l.packing,
                aperture: l.diameter_um.map_or(Aperture::Full, |diameter_um| Aperture::Round { diameter_um }),
            },
            grating: self.grating.as_ref().map(|g| Grating {
                pitch_um: g.pitch_um,
                order: Order::Plus,
                model: g.model,
            }),
            pixels: [tall(l.pixels), l.pixels],
            voxels: [tall(v.voxels), v.voxels],
            planes_um,
            depth: v.depth,
            radius: match p.radius {
                Some(r) => Radius::Cells(r),
                None => Radius::Energy { share: p.energy, max: p.largest_radius },
            },
            oversampling: p.samples.map_or(Oversampling::Auto, Oversampling::Samples),
            guard: p.guard,
            kernel: p.kernel,
            propagation: p.propagation,
            sampling_tolerance: p.tolerance,
            allow_under_sampling: p.allow_under_sampling,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_template_is_the_published_microscope() {
        let parameters = Setup::parse(TEMPLATE).unwrap().parameters().unwrap();
        let thesis = PsfParameters::thesis((0..17).map(|z| -20.0 + 2.5 * f64::from(z)).collect());
        assert_eq!(parameters.objective, thesis.objective);
        assert_eq!(parameters.lenslets, thesis.lenslets);
        assert_eq!(parameters.planes_um, thesis.planes_um);
        assert_eq!((parameters.pixels, parameters.voxels), (thesis.pixels, thesis.voxels));
    }

    #[test]
    fn mistakes_are_named() {
        let error = Setup::parse(&TEMPLATE.replace("focal_um", "focal_mm")).unwrap_err();
        assert!(error.contains("focal_mm") && error.contains("line"), "{error}");
        let planes = Setup::parse(&TEMPLATE.replace("step_um = 2.5", "step_um = 0.0")).unwrap().parameters();
        assert!(planes.is_err());
    }
}
