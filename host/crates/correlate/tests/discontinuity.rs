//! Steps, cracks and edges of objects are found and solved from their own side; smooth fields are
//! left alone.

mod common;
use common::*;
use daic_correlate::*;
use std::path::Path;

fn golden(dir: &Path, noise: &str, case: &str, step: usize, settings: &Settings) -> Correlation {
    let read = |name: &str| load(&dir.join(format!("s1024_{noise}_{name}.png")));
    let reference = Reference::new(read("ref"));
    let target = Target::new(read(case), settings.interpolation);
    let roi = Roi { rectangle: Some(Rectangle { x: 40, y: 40, width: 944, height: 944 }), mask: None };
    let points = Points::grid(1024, 1024, settings.subset, step, &roi).unwrap();
    correlate(&reference, &target, &points, &Guess::Fft, settings, &()).unwrap()
}

/// Whether a point says that something is wrong with it.
fn flagged(p: &Point) -> bool {
    !p.status.is_ok()
}

#[test]
fn a_step_is_solved_from_both_sides() {
    let Some(dir) = shared("a_step_is_solved_from_both_sides", "golden/dic") else {
        return;
    };
    for noise in ["n0", "n2"] {
        let with = golden(&dir, noise, "step", 5, &Settings::default());
        let plain = Settings { discontinuities: false, ..Settings::default() };
        let without = golden(&dir, noise, "step", 5, &plain);
        let truth = |p: &Point| if p.y > 511.5 { 1.0 } else { -1.0 };
        let error = |p: &Point| (p.u - truth(p)).hypot(p.v);
        let wrong =
            |c: &Correlation, limit: f64| c.points.iter().filter(|p| !flagged(p) && error(p) > limit).count();
        // the subset's outermost row of pixels reaches 16 px from its centre
        let straddling: Vec<&Point> = with.points.iter().filter(|p| (p.y - 511.5).abs() < 16.0).collect();
        let good = straddling.iter().filter(|p| !flagged(p) && error(p) <= 0.1).count();
        let split = straddling.iter().filter(|p| p.solver == SolvedBy::Split).count();
        let marked = straddling.iter().filter(|p| p.status == Status::Discontinuous).count();
        println!(
            "{noise}: wrong by > 0.5 px {} (was {}), by > 1 px {} (was {}); of {} straddling {split} split, {marked} marked, {good} within 0.1 px",
            wrong(&with, 0.5),
            wrong(&without, 0.5),
            wrong(&with, 1.0),
            wrong(&without, 1.0),
            straddling.len()
        );
        let (mut far, mut far_flagged) = (0, 0);
        for (p, q) in with.points.iter().zip(&without.points) {
            if (p.y - 511.5).abs() > 17.0 {
                far += 1;
                far_flagged += usize::from(flagged(p));
                assert!(p.u == q.u && p.v == q.v && p.solver == q.solver, "{p:?} {q:?}");
            }
        }
        println!("{noise}: {far_flagged} of {far} points clear of the step flagged");
        // σ of the new solutions is honest: the centre may lie at the very end of its part
        let ratios: Vec<f64> = straddling
            .iter()
            .filter(|p| p.solver == SolvedBy::Split && !flagged(p))
            .map(|p| (p.u - truth(p)) / f64::from(p.sigma_u))
            .collect();
        println!("{noise}: error over sigma {:?}", mean_std(&ratios));
        assert!(wrong(&with, 0.5) <= 30 && wrong(&with, 1.0) == 0);
        assert!(good * 100 >= straddling.len() * 80);
        assert!(far_flagged * 100 <= far * 2);
    }
}

#[test]
fn smooth_fields_are_left_alone() {
    let Some(dir) = shared("smooth_fields_are_left_alone", "golden/dic") else {
        return;
    };
    for noise in ["n0", "n2"] {
        for case in ["t02", "aff1", "quad", "sin60", "star"] {
            let c = golden(&dir, noise, case, 10, &Settings::default());
            let touched = c
                .points
                .iter()
                .filter(|p| p.solver == SolvedBy::Split || p.status == Status::Discontinuous)
                .count();
            println!("{noise} {case}: {touched} of {} touched", c.points.len());
            // Measured: sin60 1 and 0, star 332 and 3. Where periods are shorter than two subsets, two
            // flat pieces, of a crest and of a trough, explain a subset as well as any jump does.
            let limit = match (case, noise) {
                ("sin60", _) => 2,
                ("star", "n0") => 340,
                ("star", _) => 5,
                _ => 0,
            };
            assert!(touched <= limit, "{noise} {case}: {touched}");
        }
    }
}

const N: usize = 200;

/// A disc that moves over a background that stays.
fn disc(seed: u64, contrast: f64, moved: (f64, f64)) -> (Vec<f64>, Vec<f64>) {
    let (s, back) = (Speckles::new(seed, N, N), Speckles::new(seed + 1, N, N));
    let one = |d: (f64, f64)| {
        (0..N * N)
            .map(|k| {
                let (x, y) = ((k % N) as f64, (k / N) as f64);
                let (a, b) = (x - d.0, y - d.1);
                let inside = (a - 100.0).hypot(b - 100.0) <= 55.0;
                if inside { s.at(a, b) } else { 40.0 + contrast * (back.at(x, y) - 128.0) }
            })
            .collect()
    };
    (one((0.0, 0.0)), one(moved))
}

#[test]
fn edges_of_objects_do_not_mislead() {
    let moved = (2.3, -1.4);
    for (seed, contrast) in [(60, 0.7), (62, 0.05)] {
        let (a, b) = disc(seed, contrast, moved);
        let (reference, target) =
            (Reference::new(image(N, N, &a)), Target::new(image(N, N, &b), Interpolation::Quintic));
        let settings = Settings { subset: 25, ..Settings::default() };
        let points = Points::grid(N, N, 25, 3, &Roi::default()).unwrap();
        let run = |settings: &Settings| {
            correlate(&reference, &target, &points, &Guess::Fft, settings, &()).unwrap()
        };
        let plain = run(&Settings { discontinuities: false, ..settings.clone() });
        let c = run(&settings);
        let distance = |p: &Point| (p.x - 100.0).hypot(p.y - 100.0) - 55.0;
        let error = |p: &Point| {
            if distance(p) <= 0.0 { (p.u - moved.0).hypot(p.v - moved.1) } else { p.u.hypot(p.v) }
        };
        // what the disc has covered or bared is nobody's
        let counted = |p: &&Point| distance(p) <= -1.0 || (contrast > 0.5 && distance(p) > 4.0);
        let wrong = |c: &Correlation, limit: f64| {
            c.points.iter().filter(counted).filter(|p| !flagged(p) && error(p) > limit).count()
        };
        let edge: Vec<&Point> =
            c.points.iter().filter(counted).filter(|p| distance(p).abs() < 12.0).collect();
        let good = edge.iter().filter(|p| !flagged(p) && error(p) <= 0.1).count();
        println!(
            "contrast {contrast}: wrong by > 0.5 px {} (was {}), > 0.1 px {} (was {}), {good} of {} at the edge good",
            wrong(&c, 0.5),
            wrong(&plain, 0.5),
            wrong(&c, 0.1),
            wrong(&plain, 0.1),
            edge.len()
        );
        // Measured 25 (was 473) and 94 %; over the faint background 35 (was 98) and 72 %.
        assert!(wrong(&c, 0.5) * 5 <= wrong(&plain, 0.5) * 2);
        assert!(good * 100 >= edge.len() * if contrast > 0.5 { 92 } else { 70 });
    }
}

#[test]
fn scattered_points_cross_a_crack_with_any_number_of_threads() {
    // an oblique crack that opens by 1.5 px
    let s = Speckles::new(66, N, N);
    let side = |x: f64, y: f64| x - 100.0 + 0.4 * (y - 100.0) > 0.0;
    let a = s.image(N, N, |_, _| (0.0, 0.0));
    let mut b = Vec::new();
    for k in 0..N * N {
        let (x, y) = ((k % N) as f64, (k / N) as f64);
        let (l, r) = ((x + 0.7, y - 0.2), (x - 0.8, y + 0.3));
        b.push(if side(r.0, r.1) {
            s.at(r.0, r.1)
        } else if side(l.0, l.1) {
            20.0
        } else {
            s.at(l.0, l.1)
        });
    }
    let truth = |p: &Point| if side(p.x, p.y) { (0.8, -0.3) } else { (-0.7, 0.2) };
    let (reference, target) =
        (Reference::new(image(N, N, &a)), Target::new(image(N, N, &b), Interpolation::Quintic));
    let xy = (0..700u32).map(|k| {
        let k = f64::from(k);
        [24.0 + (k * 37.37) % 152.0, 24.0 + (k * 23.91) % 152.0]
    });
    let points = Points::scattered(xy.collect()).unwrap();
    let settings = Settings { subset: 27, ..Settings::default() };
    let run = || correlate(&reference, &target, &points, &Guess::Fft, &settings, &()).unwrap();
    let c = with_threads(1, run);
    assert_eq!(format!("{:?}", c.points), format!("{:?}", with_threads(3, run).points));
    let error = |p: &Point| (p.u - truth(p).0).hypot(p.v - truth(p).1);
    let near = |p: &&Point| ((p.x - 100.0 + 0.4 * (p.y - 100.0)) / 1.077).abs() < 12.0;
    let straddling: Vec<&Point> = c.points.iter().filter(near).collect();
    let good = straddling.iter().filter(|p| !flagged(p) && error(p) < 0.1).count();
    let wrong = c.points.iter().filter(|p| !flagged(p) && error(p) > 0.5).count();
    println!("{good} of {} straddling good, {wrong} wrong", straddling.len());
    assert!(good * 100 >= straddling.len() * 80 && wrong <= 2);
}
