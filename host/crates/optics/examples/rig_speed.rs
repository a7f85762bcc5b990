//! Time of a bundle adjustment, ten poses of 2000 dots: `cargo run --release -p daic-optics --example rig_speed`.

use std::time::Instant;

use daic_optics::bundle::{KnownPose, PlatePose, Pose, Seen, Sighting};
use daic_optics::{
    Camera, DistortionMaps, Grating, Optics, ReferenceFrame, RigData, RigSettings, View, calibrate_rig,
};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let grating = Grating { tilt_rad_xyz: [0.03, -0.04, 0.01], ..Grating::square(1.0 / 300.0) };
    let truth = Optics {
        camera: Camera { focal_px: 17956.2, principal_point_px: [1295.5, 971.5], brown: Default::default() },
        wavelength_mm: 633e-6,
        pinhole_to_grating_mm: 307.0,
        grating_to_reference_mm: 109.0,
        minus: grating,
        plus: grating,
        reference: ReferenceFrame::default(),
    };
    let model = truth.model()?;
    let plate: Vec<[f64; 2]> =
        (0..2000).map(|i| [f64::from(i % 50) * 0.36 - 8.8, f64::from(i / 50) * 0.36 - 7.0]).collect();
    let mut data = RigData { plate_mm: plate.iter().map(|p| Some(*p)).collect(), poses: Vec::new() };
    for k in 0..10_u32 {
        let (turn, t) = (f64::from(k) * 0.7, f64::from(k % 3) - 1.0);
        let pose = if k == 0 {
            Pose::default()
        } else {
            Pose {
                rotation_rad: [0.2 * turn.cos(), 0.2 * turn.sin(), 0.0],
                translation_mm: [0.0, 0.0, 2.0 * t],
            }
        };
        let mut sightings = Vec::new();
        for (point, xy) in plate.iter().enumerate() {
            let seen = |view| -> Result<_, daic_optics::TraceError> {
                let px = model.project(view, pose.point_mm(*xy))?;
                Ok(Some(Seen { px, sigma_px: [0.01; 2] }))
            };
            sightings.push(Sighting { point, minus: seen(View::Minus)?, plus: seen(View::Plus)? });
        }
        data.poses.push(PlatePose { sightings, known: KnownPose::default() });
    }
    let mut start = truth;
    start.camera.focal_px *= 1.01;
    start.pinhole_to_grating_mm += 3.0;
    start.minus.tilt_rad_xyz = [0.0; 3];
    start.plus.tilt_rad_xyz = [0.0; 3];
    for (what, speckle, leave_one_out) in [
        ("dots", false, false),
        ("dots, each pose left out", false, true),
        ("speckle with known moves", true, false),
    ] {
        let mut data = data.clone();
        if speckle {
            data.plate_mm.fill(None);
            for (k, pose) in data.poses.iter_mut().enumerate() {
                let t = f64::from(u32::try_from(k)? % 3) - 1.0;
                let value = if k == 0 { 0.0 } else { 2.0 * t };
                pose.known.translation_mm[2] = Some(daic_optics::bundle::Known { value, sigma: 1e-3 });
            }
        }
        let settings = RigSettings { leave_one_out, ..RigSettings::usual(&start) };
        let begin = Instant::now();
        let c = calibrate_rig(&start, &DistortionMaps::NONE, &data, &settings)?;
        println!("{what}: {:.2?}, {} linearisations", begin.elapsed(), c.iterations);
    }
    Ok(())
}
