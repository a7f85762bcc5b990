//! Bad input: errors and statuses, never a panic, never a number that looks valid.

mod common;
use common::*;
use daic_correlate::*;
use std::sync::atomic::{AtomicUsize, Ordering};

const N: usize = 96;

fn speckles(seed: u64) -> Image {
    image(N, N, &Speckles::new(seed, N, N).image(N, N, |_, _| (0.0, 0.0)))
}

fn run(a: Image, b: Image, points: &Points, settings: &Settings) -> Correlation {
    let target = Target::new(b, settings.interpolation);
    correlate(&Reference::new(a), &target, points, &Guess::Fft, settings, &()).unwrap()
}

#[test]
fn blank_images_have_no_texture() {
    let flat = Image::from_u8(N, N, &[90; N * N]).unwrap();
    let settings = Settings::default();
    let points = Points::grid(N, N, 33, 5, &Roi::default()).unwrap();
    for (a, b) in [(flat.clone(), flat.clone()), (flat.clone(), speckles(1)), (speckles(1), flat.clone())] {
        let c = run(a, b, &points, &settings);
        assert_eq!(c.converged(), 0);
        assert!(c.points.iter().all(|p| p.status != Status::Converged));
    }
    let xy = points.positions().to_vec();
    let given = vec![Some([0.0; 2]); xy.len()];
    let target = Target::new(speckles(1), settings.interpolation);
    let reference = Reference::new(flat);
    let guess = Guess::Given(&given);
    let c = correlate(&reference, &target, &points, &guess, &settings, &()).unwrap();
    assert!(c.points.iter().all(|p| p.status == Status::LowTexture));
    assert!(c.points.iter().all(|p| p.u.is_nan() && p.sigma_u.is_nan()));
}

#[test]
fn stripes_are_singular_or_refused() {
    // stripes do not determine the displacement along them
    let grey: Vec<f64> = (0..N * N).map(|k| 100.0 + 50.0 * ((k % N) as f64 * 0.9).sin()).collect();
    let (a, b) = (image(N, N, &grey), image(N, N, &grey));
    let settings = Settings::default();
    let points = Points::grid(N, N, 33, 7, &Roi::default()).unwrap();
    assert_eq!(run(a, b, &points, &settings).converged(), 0);
}

#[test]
fn unrelated_speckles_do_not_match() {
    // fifteen pixels hold some ten speckles: one in two hundred may look like another
    for (subset, shape, per_mille) in
        [(15, Shape::Affine, 5), (21, Shape::Affine, 1), (33, Shape::Affine, 1), (33, Shape::Quadratic, 1)]
    {
        let settings = Settings { subset, shape, ..Settings::default() };
        let points = Points::grid(N, N, subset, 2, &Roi::default()).unwrap();
        let (mut ok, mut by) = (0, [0; 3]);
        for seed in 0..4 {
            let c = run(speckles(100 + seed), speckles(200 + seed), &points, &settings);
            ok += c.converged();
            for p in c.points.iter().filter(|p| p.status.is_ok()) {
                by[p.solver as usize] += 1;
            }
        }
        println!("{subset} {shape:?}: {ok} of {} (exact, dense, split: {by:?})", 4 * points.len());
        assert!(ok * 1000 <= 4 * per_mille * points.len());
    }
}

#[test]
fn subsets_that_leave_the_image_say_so() {
    let s = Speckles::new(3, N, N);
    let a = image(N, N, &s.image(N, N, |_, _| (0.0, 0.0)));
    let b = image(N, N, &s.image(N, N, |_, _| (12.0, 0.0)));
    let settings = Settings { subset: 21, ..Settings::default() };
    let mut xy: Vec<[f64; 2]> = (0..60).map(|k| [12.0 + f64::from(k), 40.0 + f64::from(k % 7)]).collect();
    xy.push([-50.0, 20.0]);
    xy.push([3.0, 40.0]);
    xy.push([1e6, 1e6]);
    let points = Points::scattered(xy).unwrap();
    let c = run(a, b, &points, &settings);
    for p in &c.points {
        if p.x < 10.0 || p.x + 12.0 + 10.0 > N as f64 {
            assert!(!p.status.is_ok(), "{p:?}");
        } else {
            assert!(p.status.is_ok(), "{p:?}");
        }
    }
    assert!(c.points.iter().any(|p| p.status == Status::OutOfImage));
}

#[test]
fn unusable_settings_are_refused() {
    let with = |f: fn(&mut Settings)| {
        let mut s = Settings::default();
        f(&mut s);
        s.validate_for(N, N)
    };
    assert!(matches!(with(|s| s.subset = 32), Err(SettingsError::EvenSubset { subset: 32 })));
    assert!(matches!(with(|s| s.subset = 0), Err(SettingsError::SubsetRange { .. })));
    assert!(matches!(with(|s| s.subset = usize::MAX), Err(SettingsError::SubsetRange { .. })));
    assert!(matches!(with(|s| s.subset = 97), Err(SettingsError::SubsetLargerThanImage { .. })));
    assert!(matches!(with(|s| s.tolerance = f64::NAN), Err(SettingsError::Range { name: "tolerance", .. })));
    assert!(matches!(with(|s| s.max_iterations = 0), Err(SettingsError::Range { .. })));
    assert!(matches!(with(|s| s.noise = Some(-1.0)), Err(SettingsError::Range { name: "noise", .. })));
    assert_eq!(with(|_| {}), Ok(()));
}

#[test]
fn unusable_regions_and_points_are_refused() {
    let rectangle = |x, y, width, height| Rectangle { x, y, width, height };
    let grid = |step, rectangle: Option<Rectangle>, mask: Option<&Mask>| {
        Points::grid(N, N, 33, step, &Roi { rectangle, mask }).map(|p| p.len())
    };
    assert_eq!(grid(0, None, None), Err(PointsError::ZeroStep));
    for r in [
        rectangle(0, 0, N + 1, N),
        rectangle(N, 0, 1, 1),
        rectangle(5, 5, 0, 10),
        rectangle(usize::MAX, 0, 2, 2),
    ] {
        assert!(matches!(grid(5, Some(r), None), Err(PointsError::RoiOutside { .. })));
    }
    assert!(matches!(grid(5, Some(rectangle(0, 0, 5, 5)), None), Err(PointsError::Empty { subset: 33 })));
    let small = Mask::new(4, 4, vec![true; 16]).unwrap();
    assert!(matches!(grid(5, None, Some(&small)), Err(PointsError::MaskSize { .. })));
    let nothing = Mask::new(N, N, vec![false; N * N]).unwrap();
    assert!(matches!(grid(5, None, Some(&nothing)), Err(PointsError::Empty { .. })));
    assert!(matches!(
        Points::scattered(vec![[0.0, 0.0], [f64::NAN, 1.0]]).map(|p| p.len()),
        Err(PointsError::Position { index: 1, .. })
    ));
    assert!(matches!(Image::from_u8(3, 3, &[0; 8]), Err(ImageError::Length { found: 8, .. })));
    assert!(matches!(Image::from_u8(0, 3, &[]), Err(ImageError::Empty { .. })));
    assert!(matches!(Image::from_f32(2, 1, vec![0.0, f32::NAN]), Err(ImageError::NotFinite { x: 1, y: 0 })));
}

#[test]
fn grid_starts_where_the_first_subset_fits() {
    // half the subset and the border of 4 px
    assert_eq!(Points::BORDER, 4);
    let points = Points::grid(N, N, 33, 5, &Roi::default()).unwrap();
    assert_eq!(points.positions()[0], [20.0, 20.0]);
    let last = points.positions().last().unwrap();
    assert!(last[0] + 20.0 < N as f64 && last[0] + 25.0 >= N as f64);
    let rectangle = Some(Rectangle { x: 30, y: 4, width: 20, height: 40 });
    let roi = Roi { rectangle, mask: None };
    let points = Points::grid(N, N, 33, 5, &roi).unwrap();
    assert_eq!(points.positions()[0], [30.0, 20.0]);
    assert_eq!(points.positions().last(), Some(&[45.0, 40.0]));
}

#[test]
fn mismatched_calls_are_refused() {
    let reference = Reference::new(speckles(1));
    let settings = Settings::default();
    let points = Points::grid(N, N, 33, 5, &Roi::default()).unwrap();
    let small = Image::from_u8(40, 40, &[0; 1600]).unwrap();
    let call = |target: &Target, guess: &Guess<'_>| {
        correlate(&reference, target, &points, guess, &settings, &()).map(|c| c.points.len())
    };
    let target = Target::new(small, Interpolation::Quintic);
    assert!(matches!(call(&target, &Guess::Fft), Err(CorrelateError::ImageSize { .. })));
    let target = Target::new(speckles(1), Interpolation::Cubic);
    assert!(matches!(call(&target, &Guess::Fft), Err(CorrelateError::Interpolation { .. })));
    let target = Target::new(speckles(1), Interpolation::Quintic);
    assert!(matches!(call(&target, &Guess::Given(&[])), Err(CorrelateError::GuessCount { .. })));
    let mut list = vec![None; points.len()];
    list[3] = Some([f64::INFINITY, 0.0]);
    assert!(matches!(call(&target, &Guess::Given(&list)), Err(CorrelateError::GuessValue { index: 3, .. })));
    let range = |u, v| Guess::Search { u, v };
    assert!(matches!(call(&target, &range((5.0, 1.0), (0.0, 0.0))), Err(CorrelateError::SearchRange { .. })));
    assert!(matches!(
        call(&target, &range((-6e4, 6e4), (-6e4, 6e4))),
        Err(CorrelateError::SearchRange { .. })
    ));
    assert!(matches!(
        call(&target, &range((f64::NAN, 1.0), (0.0, 0.0))),
        Err(CorrelateError::GuessValue { .. })
    ));
    // a wild guess is a status, not a panic
    let wild = vec![Some([6e4, -6e4]); points.len()];
    let c = correlate(&reference, &target, &points, &Guess::Given(&wild), &settings, &()).unwrap();
    assert!(c.points.iter().filter(|p| p.status.is_ok()).all(|p| p.u.abs() < 1e-3));
}

struct Watch {
    done: AtomicUsize,
    stop: bool,
}

impl Observer for Watch {
    fn points(&self, done: usize, total: usize) {
        assert!(done <= total);
        assert!(done >= self.done.swap(done, Ordering::SeqCst));
    }

    fn cancelled(&self) -> bool {
        self.stop && self.done.load(Ordering::SeqCst) > 0
    }
}

#[test]
fn progress_is_told_and_a_run_can_be_stopped() {
    let reference = Reference::new(speckles(1));
    let target = Target::new(speckles(1), Interpolation::Quintic);
    let settings = Settings::default();
    let points = Points::grid(N, N, 33, 1, &Roi::default()).unwrap();
    for stop in [false, true] {
        let watch = Watch { done: AtomicUsize::new(0), stop };
        let c = correlate(&reference, &target, &points, &Guess::Fft, &settings, &watch);
        if stop {
            assert!(matches!(c, Err(CorrelateError::Cancelled { done, total }) if done < total));
        } else {
            assert_eq!(c.unwrap().converged(), points.len());
            assert_eq!(watch.done.load(Ordering::SeqCst), points.len());
        }
    }
}

#[test]
fn tiny_images_do_not_panic() {
    for (w, h) in [(1, 1), (1, 50), (7, 7), (9, 200)] {
        let i = Image::from_u8(w, h, &vec![7; w * h]).unwrap();
        let (reference, target) = (Reference::new(i.clone()), Target::new(i.clone(), Interpolation::Quintic));
        let settings = Settings { subset: 7, ..Settings::default() };
        let points = Points::scattered(vec![[0.0, 0.0], [3.0, 3.0]]).unwrap();
        if let Ok(c) = correlate(&reference, &target, &points, &Guess::Fft, &settings, &()) {
            assert_eq!(c.converged(), 0);
        }
        assert!(find_views(&i).is_err());
    }
}

/// A frame with textured rectangles on a dark, slightly noisy background.
fn frame(regions: &[(usize, usize, usize, usize)]) -> Image {
    let (w, h) = (480, 240);
    let s = Speckles::new(9, w, h);
    let grey = (0..w * h)
        .map(|k| {
            let (x, y) = (k % w, k / w);
            let lit = regions.iter().any(|r| x >= r.0 && x < r.2 && y >= r.1 && y < r.3);
            if lit { s.at(x as f64, y as f64) } else { 12.0 + ((x * 7919 + y * 104_729) % 5) as f64 }
        })
        .collect::<Vec<f64>>();
    image(w, h, &grey)
}

#[test]
fn views_are_found_or_the_reason_is_given() {
    let v = find_views(&frame(&[(20, 40, 200, 200), (280, 40, 460, 200)])).unwrap();
    for (b, x) in [(v.minus.bounds, 20), (v.plus.bounds, 280)] {
        assert!(b.x.abs_diff(x) <= 8 && b.width.abs_diff(180) <= 16, "{b:?}");
        assert!(b.y.abs_diff(40) <= 8 && b.height.abs_diff(160) <= 16, "{b:?}");
    }
    // they touch in a neck
    let v = find_views(&frame(&[(20, 40, 230, 200), (230, 90, 250, 140), (250, 40, 460, 200)])).unwrap();
    assert!(v.minus.bounds.x + v.minus.bounds.width <= 252);
    assert!(v.plus.bounds.x >= 228);

    assert!(matches!(find_views(&frame(&[])), Err(ViewsError::NoRegion { .. })));
    assert!(matches!(find_views(&frame(&[(20, 40, 200, 200)])), Err(ViewsError::OneRegion { .. })));
    assert!(matches!(
        find_views(&frame(&[(0, 0, 480, 240)])),
        Err(ViewsError::NoRegion { .. } | ViewsError::OneRegion { .. })
    ));
    assert!(matches!(
        find_views(&frame(&[(10, 40, 90, 200), (140, 40, 220, 200)])),
        Err(ViewsError::SameSide { .. })
    ));
    assert!(matches!(
        find_views(&frame(&[(10, 40, 130, 200), (180, 40, 300, 200), (340, 40, 460, 200)])),
        Err(ViewsError::ManyRegions { bounds }) if bounds.len() == 3
    ));
}

#[test]
fn statuses_have_stable_names() {
    let names: Vec<&str> = Status::ALL.iter().map(|s| s.name()).collect();
    assert_eq!(
        names,
        [
            "ok",
            "not_converged",
            "out_of_image",
            "low_correlation",
            "low_texture",
            "singular",
            "distorted",
            "inconsistent",
            "discontinuous",
            "no_guess"
        ]
    );
}
