//! Between the `[optics]` section of a file, which states units, and the optics crate's numbers.

use crate::error::Error;
use daic_optics::{
    Brown, Camera, Grating, Optics, Parameter, ParameterCovariance, ReferenceFrame, Substrate, SubstrateSide,
};
use daic_rig::experiment;
use daic_rig::units::{Angle, Length, Pixels};
use nalgebra::DMatrix;
use std::path::Path;

/// The `[optics]` of an experiment.
///
/// # Errors
/// [`Error::NoOptics`] for an experiment under the microscope.
pub fn of(experiment: &experiment::Experiment) -> Result<&experiment::Optics, Error> {
    experiment.optics.as_ref().ok_or(Error::NoOptics)
}

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
        reference: section.reference.map_or_else(ReferenceFrame::default, |r| ReferenceFrame {
            tilt_rad_xyz: r.tilt.map(Angle::rad),
            origin_mm: r.origin.map(Length::mm),
        }),
    };
    optics.validate()?;
    Ok(optics)
}

fn grating(section: &experiment::Grating) -> Result<Grating, Error> {
    Ok(Grating {
        pitch_mm: section.pitch_mm().ok_or(Error::Gratings)?,
        tilt_rad_xyz: section.tilt.map(Angle::rad),
        offset_mm: section.offset.map_or(0.0, Length::mm),
        substrate: section.substrate.map_or(Substrate::NONE, |glass| Substrate {
            thickness_mm: glass.thickness.mm(),
            index: glass.index,
            side: match glass.side {
                Some(experiment::Side::Camera) => SubstrateSide::Camera,
                Some(experiment::Side::Object) | None => SubstrateSide::Object,
            },
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

/// The section of any set-up; `pixel` of the sensor is taken from `section`.
pub fn to_section(section: &experiment::Optics, optics: &Optics) -> experiment::Optics {
    let b = &optics.camera.brown;
    let grating = |g: &Grating| experiment::Grating {
        pitch: Some(Length::new(g.pitch_mm)),
        lines: None,
        tilt: g.tilt_rad_xyz.map(Angle::new),
        offset: (g.offset_mm != 0.0).then(|| Length::new(g.offset_mm)),
        substrate: (g.substrate.thickness_mm > 0.0).then(|| experiment::Substrate {
            thickness: Length::new(g.substrate.thickness_mm),
            index: g.substrate.index,
            side: Some(match g.substrate.side {
                SubstrateSide::Camera => experiment::Side::Camera,
                SubstrateSide::Object => experiment::Side::Object,
            }),
        }),
    };
    experiment::Optics {
        wavelength: Length::new(optics.wavelength_mm),
        pinhole_to_grating: Length::new(optics.pinhole_to_grating_mm),
        grating_to_reference: Length::new(optics.grating_to_reference_mm),
        focal: Pixels::new(optics.camera.focal_px),
        principal_point: optics.camera.principal_point_px.map(Pixels::new),
        pixel: section.pixel,
        brown: (*b != Brown::default()).then_some(experiment::Brown {
            k1: b.k1,
            k2: b.k2,
            k3: b.k3,
            p1: b.p1,
            p2: b.p2,
        }),
        grating: None,
        grating_minus: Some(grating(&optics.minus)),
        grating_plus: Some(grating(&optics.plus)),
        reference: (optics.reference != ReferenceFrame::default()).then(|| experiment::Reference {
            tilt: optics.reference.tilt_rad_xyz.map(Angle::new),
            origin: optics.reference.origin_mm.map(Length::new),
        }),
    }
}

/// The covariance that a file states, if any.
///
/// # Errors
/// [`Error::OpticsCovariance`] if it names unknown parameters or is no covariance.
pub fn covariance(file: &experiment::OpticsFile, path: &Path) -> Result<Option<ParameterCovariance>, Error> {
    file.covariance.as_ref().map(|c| covariance_of(c, path)).transpose()
}

/// The covariance that a section states; `path` is only named in errors.
///
/// # Errors
/// As [`covariance`].
pub fn covariance_of(c: &experiment::Covariance, path: &Path) -> Result<ParameterCovariance, Error> {
    let wrong = |reason: String| Error::OpticsCovariance { path: path.to_owned(), reason };
    let parameters = c.parameters.iter().map(|name| Parameter::from_name(name));
    let parameters = parameters.collect::<Result<Vec<_>, _>>().map_err(|e| wrong(e.to_string()))?;
    let n = parameters.len();
    let value = |i: usize, j: usize| c.matrix.get(i).and_then(|row| row.get(j)).copied().unwrap_or(f64::NAN);
    let matrix = DMatrix::from_fn(n, n, value);
    ParameterCovariance::new(parameters, matrix).map_err(|e| wrong(e.to_string()))
}
