//! Real images: the DIC Challenge.

mod common;
use common::*;
use daic_correlate::*;

#[test]
fn sample_14_follows_the_commanded_wave() {
    let name = "sample_14_follows_the_commanded_wave";
    let Some(dir) = shared(name, "data/dic_challenge_14") else {
        return;
    };
    let command = std::fs::read_to_string(dir.join("command.csv")).unwrap();
    let truth: Vec<f64> =
        command.lines().map(|l| l.split(',').nth(5).unwrap().trim().parse().unwrap()).collect();
    let settings = Settings { subset: 21, ..Settings::default() };
    let reference = Reference::new(load(&dir.join("Sample14 Reference.tif")));
    let target = Target::new(load(&dir.join("Sample14 L5 Amp0.1b.tif")), settings.interpolation);
    let (w, h) = (reference.image().width(), reference.image().height());
    let points = Points::grid(w, h, 21, 10, &Roi::default()).unwrap();
    let c = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
    assert!(c.converged() * 1000 >= c.points.len() * 999);
    let grid = points.as_grid().unwrap();
    let mut square = 0.0;
    for i in 0..grid.columns {
        let column: Vec<&Point> = (0..grid.rows)
            .filter_map(|j| grid.point(i, j))
            .map(|k| &c.points[k])
            .filter(|p| p.status.is_ok())
            .collect();
        let mean = column.iter().map(|p| p.u).sum::<f64>() / column.len() as f64;
        square += (mean - truth[grid.x0 + i * grid.step]).powi(2);
    }
    let rms = (square / grid.columns as f64).sqrt();
    println!("RMS of the column means {rms:.5} px");
    assert!(rms <= 0.0048, "{rms}");
}

#[test]
fn sample_5_gives_the_commanded_shift() {
    let name = "sample_5_gives_the_commanded_shift";
    let Some(dir) = shared(name, "data/dic_challenge_5") else {
        return;
    };
    let settings = Settings::default();
    let reference = Reference::new(load(&dir.join("Sample5 Reference.tif")));
    let (w, h) = (reference.image().width(), reference.image().height());
    let points = Points::grid(w, h, settings.subset, 5, &Roi::default()).unwrap();
    for (file, shift) in
        [("Sample5-000 X0.00 Y0.00 N2 C75 R10.tif", 0.0), ("Sample5-001 X0.10 Y0.10 N2 C100 R20.tif", 0.1)]
    {
        let target = Target::new(load(&dir.join(file)), settings.interpolation);
        let c = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
        let (u, v) = errors(&c.points, |_, _| (shift, shift));
        let (bu, bv) = (mean_std(&u).0, mean_std(&v).0);
        println!("{file}: {} of {} ok, {bu:.4} {bv:.4} px", c.converged(), points.len());
        assert!(c.converged() * 100 >= points.len() * 98);
        assert!(bu.abs() < 0.01 && bv.abs() < 0.01);
    }
}

#[test]
fn sample_12_converges_everywhere_on_the_specimen() {
    let name = "sample_12_converges_everywhere_on_the_specimen";
    let Some(dir) = shared(name, "data/dic_challenge_12") else {
        return;
    };
    let frame = |k: usize| load(&dir.join(format!("oht_cfrp_{k:02}.tiff")));
    let reference = Reference::new(frame(0));
    let (w, h) = (reference.image().width(), reference.image().height());
    // edges of the plate at x = 38 and 353, hole of radius 52 about (193, 541); the plate moves by
    // up to 10 px along y
    let inside = (0..w * h)
        .map(|k| {
            let (x, y) = ((k % w) as f64, (k / w) as f64);
            (42.0..348.0).contains(&x) && (20.0..1020.0).contains(&y) && (x - 193.0).hypot(y - 541.0) > 56.0
        })
        .collect();
    let mask = Mask::new(w, h, inside).unwrap();
    let roi = Roi { rectangle: None, mask: Some(&mask) };
    let settings = Settings::default();
    let points = Points::grid(w, h, settings.subset, 10, &roi).unwrap();
    for k in 1..12 {
        let target = Target::new(frame(k), settings.interpolation);
        let c = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
        println!("frame {k}: {} of {} ok", c.converged(), points.len());
        assert!(c.converged() * 100 >= points.len() * 98);
        // a plate under tension moves smoothly: no point is far from its neighbours' mean
        for (i, p) in c.points.iter().enumerate().filter(|(_, p)| p.status.is_ok()) {
            let near: Vec<f64> = points
                .neighbours(i)
                .iter()
                .map(|&n| &c.points[n as usize])
                .filter(|q| q.status.is_ok())
                .map(|q| q.v)
                .collect();
            let mean = near.iter().sum::<f64>() / near.len() as f64;
            assert!((p.v - mean).abs() < 0.5, "{p:?} {mean}");
        }
    }
}

#[test]
fn unrelated_images_give_nothing() {
    let name = "unrelated_images_give_nothing";
    let (Some(data), Some(golden)) = (shared(name, "data"), shared(name, "golden/dic")) else {
        return;
    };
    let synthetic = load(&golden.join("s1024_n2_ref.png"));
    let sample5 = load(&data.join("dic_challenge_5/Sample5 Reference.tif"));
    let sample12 = load(&data.join("dic_challenge_12/oht_cfrp_00.tiff"));
    let sample14 = load(&data.join("dic_challenge_14/Sample14 Reference.tif"));
    let settings = Settings::default();
    for (a, b, names) in [
        (&sample5, &synthetic, "5, synthetic"),
        (&synthetic, &sample5, "synthetic, 5"),
        (&sample14, &synthetic, "14, synthetic"),
        (&synthetic, &sample14, "synthetic, 14"),
        (&synthetic, &sample12, "synthetic, 12"),
        (&sample14, &sample5, "14, 5"),
    ] {
        let (w, h) = (a.width().min(b.width()), a.height().min(b.height()));
        let reference = Reference::new(crop(a, w, h));
        let target = Target::new(crop(b, w, h), settings.interpolation);
        for step in [5, 10] {
            let points = Points::grid(w, h, settings.subset, step, &Roi::default()).unwrap();
            let zero = vec![Some([0.0; 2]); points.len()];
            // by search, and every point by itself from where it is
            let guess = if step == 5 { Guess::Fft } else { Guess::Given(&zero) };
            let c = correlate(&reference, &target, &points, &guess, &settings, &()).unwrap();
            println!("{names}: {} of {} ok", c.converged(), points.len());
            assert!(c.converged() * 1000 <= points.len());
        }
    }
}
