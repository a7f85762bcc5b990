//! Between the `[optics]` section of a file, which states units, and the optics crate's numbers.

use crate::error::Error;
use daic_optics::{Brown, Camera, Grating, Optics, Substrate, SubstrateSide};
use daic_rig::experiment;
use daic_rig::units::{Angle, Length, Pixels};

/// The optics that a checked section describes.
///
/// # Errors
/// [`Error::Optics`] names the field that no set-up can have.
pub fn from_section(section: &experiment::Optics) -> Result<Optics, Error> {
    let gratings = section.gratings().ok_or(Error::Gratings)?;
    let [minus, plus] = gratings.map(grating);
    let brown = section.brown.unwrap_or_default();
    let optics = Optics {
        camera: Camera {
            focal_px: section.focal.px(),
            principal_point_px: section.principal_point.map(Pixels::px),
            brown: Brown { k1: brown.k1, k2: brown.k2, k3: brown.k3, p1: brown.p1, p2: brown.p2 },
        },
        wavelength_mm: section.wavelength.mm(),
        pinhole_to_grating_mm: section.pinhole_to_grating.mm(),
        grating_to_reference_mm: section.grating_to_reference.mm(),
        minus: minus?,
        plus: plus?,
    };
    optics.validate()?;
    Ok(optics)
}

fn grating(section: &experiment::Grating) -> Result<Grating, Error> {
    Ok(Grating {
        pitch_mm: section.pitch_mm().ok_or(Error::Gratings)?,
        tilt_rad_xyz: section.tilt.map(Angle::rad),
        substrate: section.substrate.map_or(Substrate::NONE, |glass| Substrate {
            thickness_mm: glass.thickness.mm(),
            index: glass.index,
            side: SubstrateSide::Object,
        }),
    })
}

/// `section` with the three values that a calibration of distances and F sets.
pub fn with_calibrated(section: &experiment::Optics, optics: &Optics) -> experiment::Optics {
    experiment::Optics {
        focal: Pixels::new(optics.camera.focal_px),
        pinhole_to_grating: Length::new(optics.pinhole_to_grating_mm),
        grating_to_reference: Length::new(optics.grating_to_reference_mm),
        ..section.clone()
    }
}
