//! The light-field microscope.

use daic_lightfield::{Lenslets, Objective, Oversampling, PsfParameters, Radius, VoxelKernel};
use serde::{Deserialize, Serialize};

/// A fluorescent bead.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BeadConfig {
    /// Centre with the stage at 0: x to the right, y down as on the sensor, z away from the objective, 0 in focus.
    pub centre_um: [f64; 3],
    /// Diameter.
    pub diameter_um: f64,
}

/// Beads under a light-field microscope: objective, lenslets in its image plane, sensor behind them.
///
/// The defaults are a 20×/0.5 objective with lenslets of 150 µm and 3 mm focal length, light of 450 nm, and a sensor
/// whose pixels lie 13.37 to a lenslet and 2 mrad turned. The stage moves the beads; its z points towards the
/// objective. Beyond `slide_mm` of the stage's x a uniform fluorescent slide takes their place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LightFieldConfig {
    /// Magnification of the objective.
    pub magnification: f64,
    /// Its numerical aperture.
    pub na: f64,
    /// Index of refraction around the beads.
    pub index: f64,
    /// Wavelength in vacuum.
    pub wavelength_um: f64,
    /// Pitch of the (square) lenslets.
    pub lenslet_pitch_um: f64,
    /// Their focal length, and their distance from the sensor.
    pub lenslet_focal_um: f64,
    /// Pitch of the lenslets on the sensor.
    pub pitch_px: f64,
    /// Angle from the sensor's rows to those of the lenslets.
    pub rotation_rad: f64,
    /// Where the centre of the middle lenslet is seen, which is on the axis.
    pub centre_px: [f64; 2],
    /// The beads.
    pub beads: Vec<BeadConfig>,
    /// Least and largest depth in which beads are rendered.
    pub depth_um: [f64; 2],
    /// From this position of the stage's x on the camera sees a uniform slide.
    pub slide_mm: f64,
    /// Brightness of the brightest pixel with the stage at 0, relative to the light's.
    pub peak: f64,
    /// Lenslets that a point's light is followed to.
    pub radius: usize,
}

impl Default for LightFieldConfig {
    fn default() -> Self {
        let bead = |x, y, z| BeadConfig { centre_um: [x, y, z], diameter_um: 5.0 };
        Self {
            magnification: 20.0,
            na: 0.5,
            index: 1.0,
            wavelength_um: 0.45,
            lenslet_pitch_um: 150.0,
            lenslet_focal_um: 3000.0,
            pitch_px: 13.37,
            rotation_rad: 0.002,
            centre_px: [92.3, 91.6],
            beads: vec![bead(-17.0, -14.0, -9.0), bead(15.0, -9.0, 8.0), bead(2.0, 17.0, 10.0)],
            depth_um: [-16.0, 16.0],
            slide_mm: 0.1,
            peak: 0.5,
            radius: 2,
        }
    }
}

/// Rendered voxels of a lenslet, pixels of the ideal sensor: twice as many as reconstructions use.
const FINE: [usize; 2] = [6, 30];
/// Distance of rendered planes.
pub(crate) const PLANE_UM: f64 = 1.0;

impl LightFieldConfig {
    /// What the images are rendered with: planes 1 µm apart, six voxels and thirty pixels a lenslet, 90 field samples.
    pub fn psf(&self) -> PsfParameters {
        let [from, to] = self.depth_um;
        let planes = ((to - from) / PLANE_UM).round().max(0.0) as u32;
        PsfParameters {
            objective: Objective {
                magnification: self.magnification,
                na: self.na,
                index: self.index,
                wavelength_um: self.wavelength_um,
            },
            lenslets: Lenslets::square(self.lenslet_pitch_um, self.lenslet_focal_um),
            voxels: [FINE[0]; 2],
            pixels: [FINE[1]; 2],
            radius: Radius::Cells(self.radius),
            oversampling: Oversampling::Samples(3),
            guard: 1,
            kernel: VoxelKernel::Point,
            sampling_tolerance: 0.02,
            ..PsfParameters::thesis((0..=planes).map(|i| from + f64::from(i) * PLANE_UM).collect())
        }
    }
}
