//! Times of decoding, projecting and calibrating: `cargo run -p daic-optics --example decode_speed`.

use std::time::Instant;

use daic_optics::{
    Brown, Camera, Decoder, Grating, Observation, Optics, PixelPair, Settings, Substrate, SubstrateSide,
    TrackedPoint, View, calibrate,
};
use nalgebra::Vector3;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut grating = Grating::square(1.0 / 300.0);
    grating.tilt_rad_xyz = [0.02, 0.01, 0.005];
    grating.substrate = Substrate { thickness_mm: 3.0, index: 1.5, side: SubstrateSide::Object };
    let optics = Optics {
        camera: Camera {
            focal_px: 17956.2,
            principal_point_px: [1295.5, 971.5],
            brown: Brown { k1: -0.1, ..Brown::default() },
        },
        wavelength_mm: 633e-6,
        pinhole_to_grating_mm: 307.0,
        grating_to_reference_mm: 109.0,
        minus: grating,
        plus: grating,
        reference: Default::default(),
    };
    let model = optics.model()?;
    let points: Vec<_> = (0..100_000)
        .map(|i| {
            let (i, j) = (f64::from(i % 400), f64::from(i / 400));
            Vector3::new(0.045 * i - 9.0, 0.064 * j - 8.0, 0.1 * (0.1 * i).sin())
        })
        .collect();

    let clock = Instant::now();
    let mut pairs = Vec::with_capacity(points.len());
    for p in &points {
        pairs.push(PixelPair {
            minus_px: model.project(View::Minus, *p)?,
            plus_px: model.project(View::Plus, *p)?,
        });
    }
    println!("project 200 000 points: {:.3} s", clock.elapsed().as_secs_f64());

    for decoder in [Decoder::Ray, Decoder::Closed, Decoder::Linear] {
        let clock = Instant::now();
        let mut sum = 0.0;
        for pair in &pairs {
            let d = model.decode(decoder, *pair)?;
            sum += d.point_mm.z + d.jacobian[(2, 2)];
        }
        let s = clock.elapsed().as_secs_f64();
        println!("decode 100 000 pairs with Jacobian, {decoder:?}: {s:.3} s ({sum:.1})");
    }
    let clock = Instant::now();
    let mut sum = 0.0;
    for pair in &pairs {
        sum += model.decode_point(Decoder::Ray, *pair)?.z;
    }
    let s = clock.elapsed().as_secs_f64();
    println!("decode 100 000 pairs, points alone: {s:.3} s ({sum:.1})");

    let frame = optics.minus.frame();
    let clock = Instant::now();
    let mut sum = 0.0;
    for i in 0..10_000_000 {
        let k = Vector3::new(-0.05 + 1e-9 * f64::from(i), 0.01, 0.998);
        sum += frame.diffract(k, 1.0, optics.wavelength_mm)?.x;
    }
    let s = clock.elapsed().as_secs_f64();
    println!("diffract 10 000 000 rays: {s:.3} s ({sum:.1})");

    let moves = [
        [0.0, 0.0, 0.0],
        [0.5, 0.0, 0.0],
        [0.0, 0.5, 0.0],
        [0.0, 0.0, 0.5],
        [0.0, 0.0, -0.5],
        [0.3, 0.3, 0.3],
    ]
    .map(Vector3::from);
    let mut tracked = Vec::new();
    for p in points.iter().step_by(20) {
        let mut frames = Vec::new();
        for m in &moves {
            let mut pair = PixelPair {
                minus_px: model.project(View::Minus, p + m)?,
                plus_px: model.project(View::Plus, p + m)?,
            };
            // Something to fit that is neither noise-free nor random.
            pair.plus_px[0] += 0.01 * (1e3 * (p.x + m.y + m.z)).sin();
            frames.push(Some(Observation { pair, sigma_px: [0.01; 4] }));
        }
        tracked.push(TrackedPoint { frames });
    }
    let mut start = optics;
    for p in daic_optics::calibrate::SUPPORTED {
        let value = 1.01 * p.get(&optics);
        p.set(&mut start, value);
    }
    let clock = Instant::now();
    let c = calibrate(&start, &moves, &tracked, &Settings::default())?;
    let s = clock.elapsed().as_secs_f64();
    println!(
        "calibrate from {} points in {} frames: {s:.3} s, {} iterations, {:?}",
        tracked.len(),
        moves.len(),
        c.iterations,
        c.estimates
    );
    Ok(())
}
