//! Starting values of the poses and of unknown plate coordinates, and what they give away.

use nalgebra::Vector3;

use super::geometry::{FEWEST, lay, plane};
use super::problem::State;
use super::{PlatePose, Pose, RigData, RigError, RigSettings};
use crate::decode::{Decoder, PixelPair};
use crate::maps::DistortionMaps;
use crate::model::OpticalModel;
use crate::setup::{Optics, ReferenceFrame};

/// Least range of heights against d.
const LEAST_DEPTH: f64 = 0.002;

/// The state to start from, and `start` with the reference plane put in.
pub(super) fn find(
    start: &Optics,
    maps: &DistortionMaps,
    data: &RigData,
    settings: &RigSettings,
) -> Result<(State, Optics), RigError> {
    let reference = settings.reference_pose;
    let square = Optics { reference: ReferenceFrame::default(), ..*start };
    let model = OpticalModel::with_maps(&square, maps.clone())?;
    let decoded: Vec<_> = data.poses.iter().map(|p| Decoded::new(&model, p)).collect();
    let swapped: Vec<usize> =
        (0..decoded.len()).filter(|k| decoded[*k].swapped(&model, &data.poses[*k])).collect();
    if !swapped.is_empty() {
        return Err(RigError::SwappedOrders { poses: swapped });
    }
    if let Some(pose) = decoded.iter().position(|d| d.points.len() < FEWEST) {
        return Err(RigError::TooFewPoints { pose, found: decoded[pose].points.len(), needed: FEWEST });
    }

    let known = data.plate_mm.iter().any(Option::is_some);
    let home = if known {
        decoded[reference].lay(reference, &data.plate_mm, true)?
    } else {
        let points: Vec<Vector3<f64>> = decoded[reference].points.iter().map(|(_, p)| *p).collect();
        let not_enough = RigError::TooFewPoints { pose: reference, found: points.len(), needed: FEWEST };
        let plane = plane(&points).ok_or(not_enough)?;
        let normal = Vector3::new(-plane[1], -plane[2], 1.0).normalize();
        let rotation_rad = [(-normal.y).asin(), normal.x.atan2(normal.z), 0.0];
        Pose { rotation_rad, translation_mm: [0.0, 0.0, plane[0]] }
    };
    let mut optics = square;
    // Mirrored in h, the rotations about x and y change their sense.
    let [a, b, c] = home.rotation_rad;
    let [x, y, h] = home.translation_mm;
    optics.reference = ReferenceFrame { tilt_rad_xyz: [-a, -b, c], origin_mm: [x, y] };
    optics.grating_to_reference_mm -= h;

    let model = OpticalModel::with_maps(&optics, maps.clone())?;
    let decoded: Vec<_> = data.poses.iter().map(|p| Decoded::new(&model, p)).collect();
    let mut plate = data.plate_mm.clone();
    decoded[reference].place(&Pose::default(), &mut plate);
    let mut poses: Vec<Option<Pose>> = vec![None; decoded.len()];
    poses[reference] = Some(Pose::default());
    // Speckle: a pose may share points only with one that is laid later.
    loop {
        let mut failed = Ok(());
        let mut progress = false;
        for (k, d) in decoded.iter().enumerate() {
            if poses[k].is_some() {
                continue;
            }
            match d.lay(k, &plate, known) {
                Ok(pose) => {
                    d.place(&pose, &mut plate);
                    poses[k] = Some(pose);
                    progress = true;
                }
                Err(e) => failed = Err(e),
            }
        }
        if failed.is_ok() {
            break;
        }
        if !progress {
            failed?;
        }
    }
    let poses: Vec<Pose> = poses.into_iter().flatten().collect();

    let heights = || {
        decoded.iter().zip(&poses).flat_map(|(d, pose)| {
            d.points.iter().filter_map(|(i, _)| plate[*i].map(|xy| pose.point_mm(xy).z))
        })
    };
    let span_mm = heights().fold(f64::MIN, f64::max) - heights().fold(f64::MAX, f64::min);
    let needed_mm = LEAST_DEPTH * optics.grating_to_reference_mm;
    if !(span_mm >= needed_mm) {
        return Err(RigError::NoDepth { span_mm, needed_mm });
    }
    Ok((State { optics, poses, plate, stage: [0.0; 3], scale: 1.0 }, optics))
}

/// Points of one pose seen in both views, in object coordinates.
struct Decoded {
    pairs: usize,
    points: Vec<(usize, Vector3<f64>)>,
}

fn pairs(pose: &PlatePose) -> impl Iterator<Item = (usize, PixelPair)> {
    pose.sightings.iter().filter_map(|s| {
        let (minus, plus) = (s.minus?, s.plus?);
        Some((s.point, PixelPair { minus_px: minus.px, plus_px: plus.px }))
    })
}

impl Decoded {
    fn new(model: &OpticalModel, pose: &PlatePose) -> Self {
        let points = pairs(pose)
            .filter_map(|(i, pair)| Some((i, model.decode_point(Decoder::Ray, pair).ok()?)))
            .collect();
        Self { pairs: pairs(pose).count(), points }
    }

    /// Whether most pairs mean something only with the views exchanged.
    fn swapped(&self, model: &OpticalModel, pose: &PlatePose) -> bool {
        let exchanged = |pair: PixelPair| PixelPair { minus_px: pair.plus_px, plus_px: pair.minus_px };
        2 * self.points.len() < self.pairs && {
            let back = pairs(pose).filter(|(_, p)| model.decode_point(Decoder::Ray, exchanged(*p)).is_ok());
            2 * back.count() > self.pairs
        }
    }

    /// The plate's pose by the points whose plate coordinates are known.
    fn lay(&self, pose: usize, plate: &[Option<[f64; 2]>], given: bool) -> Result<Pose, RigError> {
        let (mut from, mut to) = (Vec::new(), Vec::new());
        for (i, p) in &self.points {
            if let Some([x, y]) = plate[*i] {
                from.push(Vector3::new(x, y, 0.0));
                to.push(*p);
            }
        }
        let found = from.len();
        let laid = lay(&from, &to).ok_or(if given {
            RigError::TooFewPoints { pose, found, needed: FEWEST }
        } else {
            RigError::NotLinked { pose, found, needed: FEWEST }
        })?;
        if laid.rotation()[(2, 2)] < 0.0 {
            return Err(RigError::Mirrored { pose });
        }
        Ok(laid)
    }

    /// Gives plate coordinates to the points that have none.
    fn place(&self, pose: &Pose, plate: &mut [Option<[f64; 2]>]) {
        let back = pose.rotation().inverse();
        for (i, p) in &self.points {
            plate[*i].get_or_insert_with(|| {
                let q = back * (p - Vector3::from(pose.translation_mm));
                [q.x, q.y]
            });
        }
    }
}
