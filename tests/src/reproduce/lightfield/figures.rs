//! What is reconstructed and measured for each figure of chapter 4.

use super::{
    Angle, BEAD, Boxed, Camera, Condition, Convergence, Data, Disturbance, FAR_UM, ITERATIONS, Models,
    Optics, PUPIL, Results, Run, SEVEN, VIRTUAL, View, Widths,
};
use crate::reproduce::{Extent, ReproduceError};

/// Iterations after which figure 20 looks at the volume.
const STEPS: [usize; 15] = [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 80, 96, 128];

pub(super) fn angle(
    view: &View,
    data: &Data,
    degrees: f64,
    radius: usize,
    models: Models,
    results: &mut Results,
) -> Result<(), ReproduceError> {
    let volume = view.reconstruct(&Camera::GOOD.take(&data.images[0], 1), ITERATIONS)?;
    let widths = view.widths(&volume, BEAD);
    results.angles.push(Angle { degrees, radius, models, widths });
    Ok(())
}

pub(super) fn boxed(
    name: &'static str,
    view: &View,
    data: &Data,
    results: &mut Results,
) -> Result<(), ReproduceError> {
    let volume = view.reconstruct(&Camera::GOOD.take(&data.images[1], 2), ITERATIONS)?;
    results.seven.push(in_box(name, view, volume));
    Ok(())
}

/// The seven beads as the voxels of a reconstruction hold them.
pub(super) fn seven_true(view: &View) -> Boxed {
    in_box("true", view, view.spheres(&SEVEN.to_vec()))
}

fn in_box(name: &'static str, view: &View, volume: Vec<f32>) -> Boxed {
    Boxed {
        name,
        widths: SEVEN.iter().map(|c| view.widths(&volume, *c)).collect(),
        shape: view.shape(),
        voxel_um: view.voxel_um(),
        first_um: view.first_um(),
        volume,
    }
}

/// Figures 18, 19 and 21, each with the virtual point and with the exact phase.
pub(super) fn conditions(both: [(&View, &Data); 2], results: &mut Results) -> Result<(), ReproduceError> {
    let noisy = |snr| Camera { snr: Some(snr), ..Camera::GOOD };
    let list = [
        (18, "z = 7.5 µm", 2, 7.5, Camera::GOOD),
        (18, "z = 20 µm", 0, 20.0, Camera::GOOD),
        (18, "z = 30 µm", 3, 30.0, Camera::GOOD),
        (19, "8 bits", 0, 20.0, Camera { bits: 8, snr: None }),
        (19, "16 bits", 0, 20.0, Camera::GOOD),
        (21, "SNR 1000", 0, 20.0, noisy(1000.0)),
        (21, "SNR 100", 0, 20.0, noisy(100.0)),
        (21, "SNR 20", 0, 20.0, noisy(20.0)),
    ];
    let clean =
        |(view, data): (&View, &Data)| view.reconstruct(&Camera::GOOD.take(&data.images[0], 3), ITERATIONS);
    let clean = [clean(both[0])?, clean(both[1])?];
    for (figure, name, scene, z_um, camera) in list {
        let centre = [0.0, 0.0, z_um];
        let measure = |k: usize| -> Result<(Widths, Disturbance), ReproduceError> {
            let (view, data) = both[k];
            let volume = view.reconstruct(&camera.take(&data.images[scene], 3), ITERATIONS)?;
            // volumes are in the camera's numbers
            let full = |c: &Camera| ((1u32 << c.bits) - 1) as f32;
            let factor = full(&Camera::GOOD) / full(&camera);
            let scaled: Vec<f32> = volume.iter().map(|v| v * factor).collect();
            let distance = distance(&scaled, &clean[k]);
            let outside = outside(view, &volume, centre);
            Ok((view.widths(&volume, centre), Disturbance { distance, outside }))
        };
        let ((virtual_point, one), (pupil, other)) = (measure(0)?, measure(1)?);
        let disturbance = (scene == 0 && figure != 18).then_some([one, other]);
        results.conditions.push(Condition { figure, name, z_um, virtual_point, pupil, disturbance });
    }
    Ok(())
}

/// Largest value farther than [`FAR_UM`] from a place, relative to the largest of all.
fn outside(view: &View, volume: &[f32], centre: [f64; 3]) -> f64 {
    let [_, ny, nx] = view.shape();
    let [dz, dx] = view.voxel_um();
    let (mut far, mut all) = (0f32, f32::MIN_POSITIVE);
    for (i, v) in volume.iter().enumerate() {
        let (x, y, z) = (i % nx, i / nx % ny, i / (nx * ny));
        let at = |i: usize, n: usize| (i as f64 + 0.5 - 0.5 * n as f64) * dx;
        let place = [at(x, nx), at(y, ny), view.first_um() + z as f64 * dz];
        let square: f64 = place.iter().zip(centre).map(|(p, c)| (p - c).powi(2)).sum();
        all = all.max(*v);
        if square > FAR_UM * FAR_UM {
            far = far.max(*v);
        }
    }
    f64::from(far / all)
}

/// ‖a − b‖/‖b‖.
fn distance(a: &[f32], b: &[f32]) -> f64 {
    let (d, n) = a.iter().zip(b).fold((0.0, 0.0), |(d, n), (a, b)| {
        (d + (f64::from(*a) - f64::from(*b)).powi(2), n + f64::from(*b).powi(2))
    });
    (d / n).sqrt()
}

/// Figure 20. Images are not scaled to a camera's numbers, so that volumes have the truth's scale.
pub(super) fn convergence(
    view: &View,
    data: &Data,
    extent: Extent,
    results: &mut Results,
) -> Result<(), ReproduceError> {
    let bead = vec![BEAD];
    let truth = view.spheres(&bead);
    let own = view.images(&bead)?;
    let steps: &[usize] = if extent == Extent::Full { &STEPS } else { &[1, 8, 16] };
    let mut states = [None, None];
    let mut iterates = Vec::new();
    for &n in steps {
        let [ours, crime] = [&data.images[0], &own];
        let [a, b] = states;
        let (ours, crime) = (view.go_on(ours, a, n)?, view.go_on(crime, b, n)?);
        let ends = |r: &[f64]| r.last().copied().unwrap_or(f64::NAN);
        results.convergence.push(Convergence {
            iterations: n,
            truth: distance(&ours.state.volume, &truth),
            last: f64::NAN,
            change: ends(&ours.changes),
            residual: ends(&ours.residuals),
            crime: [distance(&crime.state.volume, &truth), ends(&crime.residuals)],
        });
        iterates.push(ours.state.volume.clone());
        states = [Some(ours.state), Some(crime.state)];
    }
    if let Some(last) = iterates.last() {
        for (row, volume) in results.convergence.iter_mut().zip(&iterates) {
            row.last = distance(volume, last);
        }
    }
    Ok(())
}

/// Figure 15: grating of 2 µm (13°), lenslets of 125 µm, an 8-bit camera.
pub(super) fn real_setup(run: &mut Run<'_>) -> Result<(), ReproduceError> {
    let with = |m| Optics::REAL.with(2.0, 6, m);
    let depths = [7.5, 20.0];
    let scenes = depths.map(|z| vec![[0.0, 0.0, z]]);
    let of_pupil = run.images(with(PUPIL), 7, &scenes)?;
    let of_virtual = run.images(with(VIRTUAL), 7, &scenes)?;
    let plain = run.images(Optics::REAL, 6, &scenes)?;
    let views = [Optics::REAL, with(VIRTUAL), with(PUPIL)].map(|optics| run.view(optics));
    let [straight, of, exact] = views;
    let (straight, of, exact) = (straight?, of?, exact?);
    let list = [
        ("no grating", &straight, &plain),
        ("virtual", &of, &of_virtual),
        // light behaves as the exact phase says; the thesis reconstructs with the virtual point
        ("pupil as virtual", &of, &of_pupil),
        ("pupil", &exact, &of_pupil),
    ];
    for (name, view, data) in list {
        for (z, images) in depths.into_iter().zip(&data.images) {
            let camera = Camera { bits: 8, snr: Some(50.0) };
            let volume = view.reconstruct(&camera.take(images, 4), ITERATIONS)?;
            run.results.real.push((z, name, view.widths(&volume, [0.0, 0.0, z])));
        }
    }
    Ok(())
}
