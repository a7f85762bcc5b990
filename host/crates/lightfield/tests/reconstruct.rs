//! Reconstructions against independent arrays and their own laws.

mod common;
use common::{f32s, f64s, model, relative, shared, u16s, up};
use daic_lightfield::{
    Frame, Method, Model, Normal, Operator, OperatorSettings, Oversampling, Path, Psf, PsfParameters,
    PsfReport, Radius, ReconstructError, Reconstruction, Settings, Storage, reconstruct,
};

fn golden_psf(name: &str, radius: usize) -> Option<Psf> {
    let dir = shared("reconstruct", "golden/lightfield")?;
    let parameters = PsfParameters {
        radius: Radius::Cells(radius),
        oversampling: Oversampling::Samples(5),
        ..PsfParameters::thesis(vec![-10.0, -5.0, 0.0, 5.0, 10.0])
    };
    let report = PsfReport {
        samples: 5,
        dx_um: 2.0,
        sampling_error: 0.006,
        quadrature_error: 0.0,
        plane_radius: vec![radius; 5],
        energy: vec![1.0; 5],
        evanescent: 0.0,
    };
    Some(Psf::from_values(parameters, report, radius, f32s(dir.join(name))).unwrap())
}

fn image(name: &str) -> Vec<f32> {
    let dir = shared("reconstruct", "golden/lightfield").unwrap();
    f64s(dir.join(name)).iter().map(|&v| v as f32).collect()
}

/// From (y, x, z) to (z, y, x).
fn truth(name: &str) -> Vec<f64> {
    let dir = shared("reconstruct", "golden/lightfield").unwrap();
    let golden = f64s(dir.join(name));
    (0..5).flat_map(|z| (0..27 * 27).map(move |p| p * 5 + z)).map(|i| golden[i]).collect()
}

fn run(model: &Model, images: Vec<&[f32]>, settings: &Settings) -> (Reconstruction, Path) {
    let frame = Frame { images, ..Frame::default() };
    let (mut out, path) = reconstruct(model, &[frame], settings, None, &mut |_| true).unwrap();
    (out.remove(0), path)
}

#[test]
fn golden_reconstructions() {
    let Some(psf) = golden_psf("H_f32.npy", 3) else { return };
    let dir = shared("reconstruct", "golden/lightfield").unwrap();
    let settings = OperatorSettings::new([9, 9]);
    let whole = model(&psf, &settings, 1, false);
    let limit = whole.operator.memory().peak() * 9 / 10;
    let tiled = model(&psf, &OperatorSettings { memory_limit: Some(limit), ..settings }, 1, false);
    assert!(tiled.operator.memory().tile.is_some());
    let forward = image("forward_f64.npy");
    let poisson: Vec<f32> = u16s(dir.join("forward_poisson_u16.npy")).iter().map(|&v| f32::from(v)).collect();
    for (method, f, name) in [
        (Method::Rl, &forward, "recon_RL8_f64.npy"),
        (Method::Isra, &forward, "recon_ISRA8_f64.npy"),
        (Method::Rl, &poisson, "recon_RL8_poisson_f64.npy"),
    ] {
        for m in [&whole, &tiled] {
            let (out, _) = run(m, vec![f], &Settings::new(method, 8));
            let error = relative(up(&out.state.volume), truth(name));
            println!(
                "{name} tiles {:?} {error:.1e}, residuals {:?}",
                m.operator.memory().tile,
                out.residuals
            );
            // 1.0e-6 is the worst measured, of f32 sums over 8 iterations
            assert!(error < 1.4e-6, "{error:e}");
        }
    }
}

#[test]
fn golden_reconstructions_of_two_orders() {
    let Some(psf) = golden_psf("H_plus_f32.npy", 4) else { return };
    let m = model(&psf, &OperatorSettings::new([9, 9]), 2, false);
    let tiled = OperatorSettings {
        memory_limit: Some(m.operator.memory().peak() * 9 / 10),
        ..OperatorSettings::new([9, 9])
    };
    let tiled = model(&psf, &tiled, 2, false);
    assert!(tiled.operator.memory().tile.is_some());
    let (plus, minus) = (image("forward_plus_f64.npy"), image("forward_minus_f64.npy"));
    for (method, name) in [(Method::Isra, "recon_DLFM_ISRA8_f64.npy"), (Method::Rl, "recon_DLFM_RL8_f64.npy")]
    {
        for m in [&m, &tiled] {
            let (out, _) = run(m, vec![&plus, &minus], &Settings::new(method, 8));
            let error = relative(up(&out.state.volume), truth(name));
            println!("{name} {error:.1e}");
            // 1.7e-6 is the worst measured
            assert!(error < 2.2e-6, "{error:e}");
        }
    }
}

/// Where the sensor catches all light, the stored normal matrix does the same as both passes.
#[test]
fn the_normal_matrix_does_the_same() {
    for (name, radius, orders) in [("H_f32.npy", 3, 1), ("H_plus_f32.npy", 4, 1), ("H_plus_f32.npy", 4, 2)] {
        let Some(psf) = golden_psf(name, radius) else { return };
        let settings = OperatorSettings { margin: radius as isize, ..OperatorSettings::new([5, 6]) };
        let m = model(&psf, &settings, orders, true);
        let [d, h, w] = m.operator.volume_shape();
        let g: Vec<f32> = (0..d * h * w).map(|i| if i % 37 == 5 { 900.0 } else { 1.0 }).collect();
        let mut images = m.operator.project(&[&g]).unwrap();
        if orders == 2 {
            // the mirrored view of the volume
            let mirrored: Vec<f32> =
                g.chunks_exact(w).flat_map(|r| r.iter().rev().copied().collect::<Vec<_>>()).collect();
            let width = m.operator.image_shape()[1];
            let other = m.operator.project(&[&mirrored]).unwrap().remove(0);
            images.push(
                other.chunks_exact(width).flat_map(|r| r.iter().rev().copied().collect::<Vec<_>>()).collect(),
            );
        }
        let refs: Vec<&[f32]> = images.iter().map(Vec::as_slice).collect();
        // projections of darkness have both signs by rounding
        let isra = Settings { clip_negative: true, ..Settings::new(Method::Isra, 8) };
        let (one, path) = run(&m, refs.clone(), &isra);
        assert_eq!(path, Path::Normal);
        let (two, path) = run(&m, refs.clone(), &Settings { use_normal: false, ..isra });
        assert_eq!(path, Path::TwoPasses { reason: None });
        let error = relative(up(&one.state.volume), up(&two.state.volume));
        println!("{name} {orders} {:?} {error:.1e}", m.normal.as_ref().map(Normal::reduction));
        // 5.2e-7 is the worst measured
        assert!(error < 8e-7, "{error:e}");
        // a cropped sensor is told
        let cropped = Model { operator: Operator::new(&psf, &OperatorSettings::new([5, 6])).unwrap(), ..m };
        let small = vec![vec![1f32; cropped.operator.image_shape().iter().product()]; orders];
        let (_, path) =
            run(&cropped, small.iter().map(Vec::as_slice).collect(), &Settings::new(Method::Isra, 1));
        assert!(matches!(path, Path::TwoPasses { reason: Some(_) }), "{path:?}");
    }
}

/// Frames together are the frames alone; half precision changes little; an interrupted run goes on as if it
/// had not been.
#[test]
fn batches_storage_and_resumption() {
    let Some(psf) = golden_psf("H_f32.npy", 3) else { return };
    let m = model(&psf, &OperatorSettings::new([9, 9]), 1, false);
    let f = image("forward_f64.npy");
    let other: Vec<f32> = f.iter().rev().copied().collect();
    let rl = Settings::new(Method::Rl, 8);
    let frames = [&f, &other].map(|f| Frame { images: vec![f.as_slice()], ..Frame::default() });
    let (both, _) = reconstruct(&m, &frames, &rl, None, &mut |_| true).unwrap();
    for (i, f) in [&f, &other].into_iter().enumerate() {
        assert_eq!(both[i].state.volume, run(&m, vec![f], &rl).0.state.volume);
    }
    let half =
        model(&psf, &OperatorSettings { storage: Storage::F16, ..OperatorSettings::new([9, 9]) }, 1, false);
    let error = relative(up(&run(&half, vec![&f], &rl).0.state.volume), up(&both[0].state.volume));
    println!("f16 {error:.1e}");
    assert!(error < 2e-4, "{error:e}");
    for momentum in [false, true] {
        let settings = Settings { momentum, total_variation: 0.01, ..rl.clone() };
        let (whole, _) = run(&m, vec![&f], &settings);
        let mut left = 3;
        let (part, _) = reconstruct(&m, &frames[..1], &settings, None, &mut |_| {
            left -= 1;
            left > 0
        })
        .unwrap();
        assert_eq!(part[0].state.iterations, 3);
        let states: Vec<_> = part.into_iter().map(|r| r.state).collect();
        let (rest, _) = reconstruct(&m, &frames[..1], &settings, Some(&states), &mut |_| true).unwrap();
        assert_eq!(rest[0].state, whole.state, "momentum {momentum}");
    }
}

/// Momentum reaches in 8 iterations a smaller residual than without; a stop by the residual comes as soon as
/// it is below.
#[test]
fn momentum_and_a_stop_by_the_residual() {
    let Some(psf) = golden_psf("H_f32.npy", 3) else { return };
    let m = model(&psf, &OperatorSettings::new([9, 9]), 1, false);
    let f = image("forward_f64.npy");
    let rl = Settings::new(Method::Rl, 8);
    let plain = run(&m, vec![&f], &rl).0;
    let fast = run(&m, vec![&f], &Settings { momentum: true, ..rl.clone() }).0;
    println!("{:?}\n{:?}", plain.residuals, fast.residuals);
    assert!(fast.residuals[7] < 0.9 * plain.residuals[7]);
    let limit = 0.5 * (plain.residuals[3] + plain.residuals[4]);
    let stopped = run(&m, vec![&f], &Settings { residual_below: Some(limit), ..rl.clone() }).0;
    assert_eq!(stopped.state.iterations, 5);
}

/// div(∇g/|∇g|) of a volume of 5 × 27 × 27 voxels of 5 × 2.5 × 2.5 µm, and |∇g|, in units of the lateral voxel.
fn curvature(g: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (n, h) = ([5, 27, 27], [0.5, 1.0, 1.0]);
    let stride = [27 * 27, 27, 1];
    let floor = 1e-3 * g.iter().sum::<f64>() / g.len() as f64;
    let mut divergence = vec![0.0; g.len()];
    let mut length = vec![0.0; g.len()];
    for i in 0..g.len() {
        let place = [i / stride[0], i / stride[1] % 27, i % 27];
        let d = [0, 1, 2].map(|a| if place[a] + 1 < n[a] { (g[i + stride[a]] - g[i]) * h[a] } else { 0.0 });
        let l = (d.iter().map(|d| d * d).sum::<f64>() + floor * floor).sqrt();
        length[i] = d.iter().map(|d| d * d).sum::<f64>().sqrt();
        for a in 0..3 {
            // minus the adjoint of the differences
            divergence[i] += h[a] * d[a] / l;
            if place[a] + 1 < n[a] {
                divergence[i + stride[a]] -= h[a] * d[a] / l;
            }
        }
    }
    (divergence, length)
}

/// The rule with total variation keeps Σ s g (1 − λ div(∇q/|∇q|)) = Σ f, s = Hᵀ1, q the volume before: from
/// g s (1 − λ div) = q Hᵀ(f/Hq) and Σ q Hᵀ(f/Hq) = Σ f. A larger weight gives a smaller variation.
#[test]
fn total_variation_obeys_its_law() {
    let Some(psf) = golden_psf("H_f32.npy", 3) else { return };
    let m = model(&psf, &OperatorSettings::new([9, 9]), 1, false);
    let f = image("forward_f64.npy");
    let ones = vec![1f32; f.len()];
    let s = up(&m.operator.back_project(&[&ones]).unwrap()[0]);
    let light: f64 = up(&f).iter().sum();
    let mut last = f64::INFINITY;
    for weight in [0.0, 0.01, 0.05] {
        let after = |iterations| {
            let settings = Settings { total_variation: weight, ..Settings::new(Method::Rl, iterations) };
            up(&run(&m, vec![&f], &settings).0.state.volume)
        };
        let (before, g) = (after(7), after(8));
        let divergence = curvature(&before).0;
        let kept: f64 = (0..g.len()).map(|i| s[i] * g[i] * (1.0 - weight * divergence[i])).sum();
        let variation = curvature(&g).1.iter().sum::<f64>() / g.iter().sum::<f64>();
        let plain: f64 = (0..g.len()).map(|i| s[i] * g[i]).sum();
        println!(
            "{weight}: {:.2e}, without the term {:.2e}, variation {variation:.4}",
            kept / light - 1.0,
            plain / light - 1.0
        );
        assert!((kept / light - 1.0).abs() < 1e-5, "{weight}: {}", kept / light);
        assert!(variation < last, "{weight}: {variation} {last}");
        last = variation;
    }
}

/// In the lenslets' image all light of a cell goes through one lenslet: voxels of a cell are not told apart and
/// reconstructions show steps from cell to cell. The anti-artefact filter takes them away and keeps the light.
#[test]
fn the_native_plane_is_without_steps() {
    let Some(psf) = golden_psf("H_f32.npy", 3) else { return };
    let m = model(&psf, &OperatorSettings::new([9, 9]), 1, false);
    // a smooth blob at z = 0
    let bell = |i: usize| (-0.5 * ((i as f32 - 13.0) / 6.0).powi(2)).exp();
    let g: Vec<f32> = (0..5 * 729)
        .map(|i| if i / 729 == 2 { 1000.0 * bell(i / 27 % 27) * bell(i % 27) } else { 0.0 })
        .collect();
    let f = m.operator.project(&[&g]).unwrap().remove(0);
    // differences across the borders of cells to those within
    let steps = |v: &[f32]| {
        let (mut across, mut within) = (0.0, 0.0);
        for row in up(&v[2 * 729..3 * 729]).chunks_exact(27) {
            for x in 3..24 {
                let d = (row[x + 1] - row[x]).abs();
                if x % 3 == 2 { across += d } else { within += 0.5 * d }
            }
        }
        across / within
    };
    let rl = Settings { clip_negative: true, ..Settings::new(Method::Rl, 8) };
    let plain = run(&m, vec![&f], &rl).0;
    let smooth = run(&m, vec![&f], &Settings { anti_artefact: 1.0, ..rl }).0;
    let light = |r: &Reconstruction| up(&r.state.volume).iter().sum::<f64>();
    let (a, b, t) = (steps(&plain.state.volume), steps(&smooth.state.volume), steps(&g));
    println!(
        "steps {a:.3}, with the filter {b:.3}, truth {t:.3}; light {:.5}",
        light(&smooth) / light(&plain)
    );
    assert!((t - 1.0).abs() < 0.05, "{t}");
    assert!(a > 30.0 && (b - t).abs() < 0.02, "{a} {b}");
    // at the border the light that the filter would spread outside is given back
    assert!((light(&smooth) / light(&plain) - 1.0).abs() < 2e-3);
}

/// A background in the model, and pixels that are bad and masked, leave the volume as it was without.
#[test]
fn background_and_bad_pixels() {
    let Some(psf) = golden_psf("H_f32.npy", 3) else { return };
    let m = model(&psf, &OperatorSettings::new([9, 9]), 1, false);
    let f = image("forward_f64.npy");
    let g = up(&run(&m, vec![&f], &Settings::new(Method::Isra, 8)).0.state.volume);
    let lifted: Vec<f32> = f.iter().map(|v| v + 50.0).collect();
    let background = vec![50f32; f.len()];
    let frame = Frame { images: vec![&lifted], background: Some(vec![&background]), ..Frame::default() };
    let isra = Settings::new(Method::Isra, 8);
    let (out, _) = reconstruct(&m, &[frame], &isra, None, &mut |_| true).unwrap();
    let error = relative(up(&out[0].state.volume), g.iter().copied());
    // f32 rounds 50 + f
    assert!(error < 1e-4, "{error:e}");
    let mut broken = f.clone();
    let mut weights = vec![1f32; f.len()];
    for i in (7..f.len()).step_by(101) {
        broken[i] = 60_000.0;
        weights[i] = 0.0;
    }
    let frame = Frame { images: vec![&broken], weights: Some(vec![&weights]), ..Frame::default() };
    let (out, _) = reconstruct(&m, &[frame], &isra, None, &mut |_| true).unwrap();
    let masked = relative(up(&out[0].state.volume), g.iter().copied());
    let ruined = relative(up(&run(&m, vec![&broken], &isra).0.state.volume), g.iter().copied());
    println!("masked {masked:.3}, not masked {ruined:.3}");
    assert!(masked < 0.05 && ruined > 1.0, "{masked} {ruined}");
    let saturation = Settings { saturation: Some(60_000.0), ..isra.clone() };
    let frame = [Frame { images: vec![&broken], ..Frame::default() }];
    let error = reconstruct(&m, &frame, &saturation, None, &mut |_| true);
    assert!(matches!(error, Err(ReconstructError::Saturated { .. })), "{error:?}");
    let settings = Settings { mask_saturated: true, ..saturation };
    let (again, _) = reconstruct(&m, &frame, &settings, None, &mut |_| true).unwrap();
    assert_eq!(again[0].state.volume, out[0].state.volume);
}

#[test]
fn impossible_input_is_refused() {
    let Some(psf) = golden_psf("H_f32.npy", 3) else { return };
    let m = model(&psf, &OperatorSettings::new([9, 9]), 1, false);
    let good = vec![1f32; 135 * 135];
    let with = |i: usize, v: f32| {
        let mut f = good.clone();
        f[i] = v;
        f
    };
    let error = |f: &[f32], settings: &Settings| {
        let frame = Frame { images: vec![f], ..Frame::default() };
        reconstruct(&m, &[frame], settings, None, &mut |_| true).unwrap_err()
    };
    let rl = Settings::new(Method::Rl, 2);
    assert!(matches!(error(&with(140, -1.0), &rl), ReconstructError::Negative { x: 5, y: 1, count: 1, .. }));
    assert!(matches!(error(&with(3, f32::NAN), &rl), ReconstructError::Pixel { x: 3, y: 0, .. }));
    assert!(matches!(error(&good[1..], &rl), ReconstructError::Operator(_)));
    assert!(matches!(error(&vec![0.0; 135 * 135], &rl), ReconstructError::Dark { .. }));
    for settings in [
        Settings { iterations: 0, ..rl.clone() },
        Settings { total_variation: f64::NAN, ..rl.clone() },
        Settings { read_variance: -1.0, ..rl.clone() },
    ] {
        assert!(matches!(error(&good, &settings), ReconstructError::Setting { .. }));
    }
    let stopped = {
        let frame = Frame { images: vec![good.as_slice()], ..Frame::default() };
        reconstruct(&m, &[frame], &rl, None, &mut |_| false)
    };
    // what has been reached is given back
    assert_eq!(stopped.map(|(r, _)| r[0].state.iterations), Ok(1));
}
