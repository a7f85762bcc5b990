//! What can be refused before anything is computed.

use super::{KnownPose, RigData, RigError, RigSettings};
use crate::parameter::Parameter;

pub(super) const REFERENCE: [Parameter; 6] = [
    Parameter::GratingToReference,
    Parameter::ReferenceTiltX,
    Parameter::ReferenceTiltY,
    Parameter::ReferenceTiltZ,
    Parameter::ReferenceOriginX,
    Parameter::ReferenceOriginY,
];

pub(super) fn settings(s: &RigSettings) -> Result<(), RigError> {
    for (i, e) in s.parameters.iter().enumerate() {
        let repeated = s.parameters[..i].iter().any(|f| f.parameter == e.parameter);
        if repeated || REFERENCE.contains(&e.parameter) {
            return Err(RigError::Parameter { name: e.parameter.name() });
        }
        if let Some(value) = e.prior_sigma.filter(|v| !(v.is_finite() && *v > 0.0)) {
            let allowed = "finite and above 0 (the parameter's prior standard deviation)";
            return Err(RigError::Setting { name: e.parameter.name(), value, allowed });
        }
    }
    for (name, value) in
        [("outlier_limit", s.outlier_limit), ("stage_axes_sigma_rad", s.stage_axes_sigma_rad)]
    {
        // Negated so that NaN is refused.
        if !(value > 0.0) {
            return Err(RigError::Setting { name, value, allowed: "above 0" });
        }
    }
    if !(0.0..1.0).contains(&s.max_outlier_fraction) {
        let (name, value) = ("max_outlier_fraction", s.max_outlier_fraction);
        return Err(RigError::Setting { name, value, allowed: "at least 0 and below 1" });
    }
    Ok(())
}

pub(super) fn data(d: &RigData, s: &RigSettings) -> Result<(), RigError> {
    if s.reference_pose >= d.poses.len().max(1) {
        let (name, value) = ("reference_pose", s.reference_pose as f64);
        return Err(RigError::Setting { name, value, allowed: "the number of a pose, from 0" });
    }
    let bad = |v: &[f64; 2]| !v.iter().all(|v| v.is_finite());
    if let Some(point) = d.plate_mm.iter().position(|p| p.as_ref().is_some_and(bad)) {
        return Err(RigError::PlateCoordinates { point });
    }
    for (pose, p) in d.poses.iter().enumerate() {
        let mut seen = vec![false; d.plate_mm.len()];
        for o in &p.sightings {
            let Some(before) = seen.get_mut(o.point) else {
                return Err(RigError::UnknownPoint { pose, point: o.point, points: d.plate_mm.len() });
            };
            if std::mem::replace(before, true) {
                return Err(RigError::RepeatedPoint { pose, point: o.point });
            }
            for seen in o.minus.iter().chain(&o.plus) {
                let sigma = seen.sigma_px.iter().all(|s| s.is_finite() && *s > 0.0);
                if bad(&seen.px) || !sigma {
                    return Err(RigError::Pixel { pose, point: o.point });
                }
            }
        }
        let KnownPose { translation_mm, rotation_rad } = &p.known;
        let fits = |k: &super::Known| k.value.is_finite() && k.sigma.is_finite() && k.sigma > 0.0;
        if !translation_mm.iter().chain(rotation_rad).flatten().all(fits) {
            return Err(RigError::KnownPose { pose });
        }
    }
    let known = d.plate_mm.iter().flatten().count();
    let moves = moves_known(d, s);
    // A plate of unknown scale needs the moves, and those a reference.
    let needed = 2;
    if d.poses.len() < needed {
        return Err(RigError::TooFewPoses { found: d.poses.len(), needed });
    }
    if known < 2 && !moves {
        return Err(RigError::NoScale);
    }
    Ok(())
}

/// Whether any pose but the reference has a known translation other than none.
pub(super) fn moves_known(d: &RigData, s: &RigSettings) -> bool {
    let of = |p: &super::PlatePose| p.known.translation_mm.iter().flatten().any(|k| k.value != 0.0);
    d.poses.iter().enumerate().any(|(k, p)| k != s.reference_pose && of(p))
}
