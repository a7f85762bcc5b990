//! Alignment steps on simulated images, misaligned on purpose.

mod rendering;

use daic_optics::align::axis::{axis, grating_tilt, offset};
use daic_optics::align::distance::{pinhole_to_grating, pinhole_to_line};
use daic_optics::align::orders::order_line;
use daic_optics::align::spots::{Spot, find_disc, find_spots};
use daic_optics::align::{AlignError, Measured};
use daic_optics::intrinsics::{BoardPoint, pose_of_board};
use daic_optics::target::{Pattern, TargetSettings, find_target};
use daic_optics::{Brown, Camera, Grating, GreyView};
use rendering::{Image, Noise, Pose, dots, render};

const W: usize = 800;
const H: usize = 600;

fn camera() -> Camera {
    Camera {
        focal_px: 1400.0,
        principal_point_px: [405.0, 294.0],
        brown: Brown { k1: -0.1, ..Brown::default() },
    }
}

fn empty(level: impl Fn(f64, f64) -> f64) -> Image {
    let data = (0..W * H).map(|k| level((k % W) as f64, (k / W) as f64) as f32).collect();
    Image { width: W, height: H, data }
}

/// Adds a Gaussian spot, integrated over the pixels by 3 × 3 points.
fn add_spot(image: &mut Image, at: [f64; 2], peak: f64, widths: [f64; 2]) {
    for k in 0..W * H {
        let (x, y) = ((k % W) as f64 - at[0], (k / W) as f64 - at[1]);
        if x.abs() < 60.0 && y.abs() < 60.0 {
            let mut sum = 0.0;
            for i in -1..=1 {
                for j in -1..=1 {
                    let (x, y) = (x + f64::from(i) / 3.0, y + f64::from(j) / 3.0);
                    sum += (-0.5 * ((x / widths[0]).powi(2) + (y / widths[1]).powi(2))).exp();
                }
            }
            image.data[k] += (peak * sum / 9.0) as f32;
        }
    }
}

/// A disc with a soft rim.
fn add_disc(image: &mut Image, at: [f64; 2], radius: f64, contrast: f64) {
    let mut disc = empty(|_, _| 0.0);
    for k in 0..W * H {
        let (x, y) = ((k % W) as f64 - at[0], (k / W) as f64 - at[1]);
        if (x.hypot(y) - radius).abs() < 2.0 {
            let n = (0..64).filter(|s| {
                let (i, j) = (f64::from(s % 8), f64::from(s / 8));
                (x + (i - 3.5) / 8.0).hypot(y + (j - 3.5) / 8.0) < radius
            });
            disc.data[k] = n.count() as f32 / 64.0;
        } else if x.hypot(y) < radius {
            disc.data[k] = 1.0;
        }
    }
    for (v, d) in image.data.iter_mut().zip(disc.blurred(1.2).data) {
        *v += contrast as f32 * d;
    }
}

fn view(image: &Image) -> GreyView<'_> {
    GreyView::new(&image.data, image.width, image.height).unwrap()
}

fn close(found: Measured, truth: f64, what: &str) {
    println!("{what}: {:.6} ± {:.6}, true {truth:.6}", found.value, found.sigma);
    assert!((found.value - truth).abs() < 4.0 * found.sigma, "{what}: {found:?}, true {truth}");
}

#[test]
fn spots_to_a_fiftieth_of_a_pixel() {
    let mut random = Noise::new(1);
    let (mut sum, mut pulls, mut n) = (0.0, 0.0, 0.0);
    for seed in 0..6 {
        let mut image = empty(|x, y| 20.0 + 0.02 * x + 0.01 * y);
        let mut truth: Vec<[f64; 2]> = [200.0, 400.0, 600.0]
            .map(|x| [x + 10.0 * random.uniform(), 300.0 + 20.0 * random.uniform()])
            .into();
        truth.sort_by(|a, b| a[0].total_cmp(&b[0]));
        // The middle one overexposed: its top is cut off at 255.
        for (k, (at, peak)) in truth.iter().zip([60.0, 420.0, 90.0]).enumerate() {
            add_spot(&mut image, *at, peak, [4.0 + k as f64, 5.0]);
        }
        let image = image.recorded(2.0, 255.0, seed);
        let spots = find_spots(&view(&image), 3, 250.0).unwrap();
        for (s, t) in spots.iter().zip(&truth) {
            for ((at, sigma), t) in s.at_px.iter().zip(&s.sigma_px).zip(t) {
                let e = at - t;
                sum += e * e;
                pulls += (e / sigma).powi(2);
                n += 1.0;
            }
        }
    }
    let (rms, pull) = ((sum / n).sqrt(), (pulls / n).sqrt());
    println!("spots: {rms:.4} px RMS, pull {pull:.2}");
    assert!(rms < 0.02, "{rms}");
    // 36 values: the RMS of the pulls scatters by 12 %.
    assert!((0.65..1.35).contains(&pull), "{pull}");
}

#[test]
fn discs_bright_and_dark() {
    for (seed, (ground, contrast)) in [(30.0, 150.0), (180.0, -140.0)].into_iter().enumerate() {
        let mut image = empty(|x, _| ground * (1.0 + 0.0002 * x));
        add_disc(&mut image, [433.37, 251.81], 23.4, contrast);
        let image = image.recorded(3.0, 255.0, seed as u64);
        let disc = find_disc(&view(&image)).unwrap();
        println!("{disc:?}");
        assert!((disc.at_px[0] - 433.37).hypot(disc.at_px[1] - 251.81) < 0.02, "{disc:?}");
        assert!((disc.radius_px - 23.4).abs() < 0.05 && (disc.contrast > 0.0) == (contrast > 0.0));
    }
}

#[test]
fn nothing_to_see_is_an_error() {
    let image = empty(|_, _| 100.0).recorded(3.0, 255.0, 9);
    assert!(matches!(find_disc(&view(&image)), Err(AlignError::NoDisc)));
    assert!(matches!(
        find_spots(&view(&image), 3, 255.0),
        Err(AlignError::Spots { .. } | AlignError::Unfit { .. })
    ));
    let mut two = empty(|_, _| 20.0);
    add_spot(&mut two, [200.0, 300.0], 100.0, [4.0, 4.0]);
    add_spot(&mut two, [400.0, 300.0], 100.0, [4.0, 4.0]);
    let two = two.recorded(2.0, 255.0, 10);
    assert_eq!(find_spots(&view(&two), 3, 255.0).unwrap_err(), AlignError::Spots { found: 2, needed: 3 });
}

/// A rail 3 mrad to the right and 2 mrad up of the optical axis, the aperture 1.5 and 0.8 mm off.
#[test]
fn camera_and_rail() {
    let c = camera();
    let (slope, start) = ([3e-3, -2e-3], [1.5, -0.8]);
    let distances = [80.0, 600.0];
    let marks = distances.map(|z| {
        let at = c.pixel([0, 1].map(|l| start[l] / z + slope[l]));
        let mut image = empty(|x, _| 40.0 + 0.01 * x);
        add_disc(&mut image, at, 2000.0 / z + 8.0, 120.0);
        find_disc(&view(&image.recorded(2.0, 255.0, 11))).unwrap()
    });
    let found = axis(&c, [0.3, 0.3], [&marks[0], &marks[1]], distances[0], distances[1]).unwrap();
    for l in 0..2 {
        close(found.slope_rad[l], slope[l], "slope");
        close(found.offset_mm[l], start[l], "offset");
        // The error of the principal point is what limits.
        assert!((found.slope_rad[l].sigma * c.focal_px - 0.3).abs() < 0.02);
    }
    let near = offset(&c, [0.3, 0.3], &marks[0]).unwrap();
    close(near.angle_rad[0], start[0] / 80.0 + slope[0], "angle");
    assert!(matches!(axis(&c, [0.3; 2], [&marks[0], &marks[1]], 600.0, 80.0), Err(AlignError::Value { .. })));
}

/// The reflected spot beside the hole of the aperture, for a grating turned by −1.2 and 0.9 mrad;
/// exact reflection.
#[test]
fn reflection_into_the_aperture() {
    let c = camera();
    let (tilt, far, way) = ([-1.2e-3, 0.9e-3], 500.0, 380.0);
    let mut grating = Grating::square(1.0 / 300.0);
    grating.tilt_rad_xyz = [tilt[0], tilt[1], 4e-3];
    let n = grating.frame().normal();
    let beam = nalgebra::Vector3::new(0.0, 0.0, -1.0);
    let back = beam - n * (2.0 * beam.dot(&n));
    let hole = c.pixel([2.0 / far, 1.0 / far]);
    let spot = c.pixel([(2.0 + back.x / back.z * way) / far, (1.0 + back.y / back.z * way) / far]);
    let mut image = empty(|_, _| 15.0);
    add_spot(&mut image, spot, 120.0, [3.0, 3.0]);
    let reflection = find_spots(&view(&image.recorded(2.0, 255.0, 12)), 1, 255.0).unwrap()[0];
    let aperture = Spot { at_px: hole, sigma_px: [0.02; 2], radius_px: 5.0, contrast: 100.0 };
    let found = grating_tilt(&c, &aperture, &reflection, far, way).unwrap();
    close(found[0], tilt[0], "θ_x");
    close(found[1], tilt[1], "θ_y");
}

/// Orders of a parallel beam through a grating rotated by 4 and tilted by 6 mrad, by the grating
/// equation written out here.
#[test]
fn rotation_of_the_grooves() {
    let c = camera();
    let shift = 633e-6 * 300.0;
    let look = |tilt: [f64; 3], seed: u64| {
        let mut grating = Grating::square(1.0 / 300.0);
        grating.tilt_rad_xyz = tilt;
        let r = grating.frame().rotation();
        let mut image = empty(|x, _| 18.0 + 0.01 * x);
        for (order, peak) in [(-1.0, 90.0), (0.0, 400.0), (1.0, 80.0)] {
            let k = r.transpose() * nalgebra::Vector3::new(0.0, 0.0, 1.0);
            let (a, b) = (k.x + order * shift, k.y);
            let out = r * nalgebra::Vector3::new(a, b, (1.0 - a * a - b * b).sqrt());
            add_spot(&mut image, c.pixel([out.x / out.z, out.y / out.z]), peak, [4.0, 4.5]);
        }
        let image = image.recorded(2.0, 255.0, seed);
        order_line(&c, &find_spots(&view(&image), 3, 250.0).unwrap()).unwrap()
    };
    let first = look([6e-3, 0.0, 4e-3], 13);
    close(first.angle_rad, 4e-3, "θ_z");
    // 0.02 px on spots 540 px apart
    assert!(first.angle_rad.sigma < 6e-5, "{}", first.angle_rad.sigma);
    close(first.tilt_x_rad(&c, shift).unwrap(), 6e-3, "θ_x from the bow");
    let second = look([0.0, 0.0, 5e-3], 14);
    close(first.relative_rad(&second), 1e-3, "between the gratings");
    let spot = |x: f64| Spot { at_px: [x, 300.0], sigma_px: [0.01; 2], radius_px: 4.0, contrast: 50.0 };
    let wrong = order_line(&c, &[spot(100.0), spot(300.0), spot(700.0)]);
    assert!(matches!(wrong, Err(AlignError::NotOrders { .. })));
}

/// D from a board, square to the axis but for 0.5°, by L F/L′ and by its pose; then s.
#[test]
fn distance_from_a_board() {
    let c = camera();
    let mut pose = Pose::new([0.5, -0.3, 2.0], [0.0; 3]);
    let middle = pose.rotation * nalgebra::Vector3::new(42.0, 30.0, 0.0);
    pose.translation = nalgebra::Vector3::new(0.0, 0.0, 210.0) - middle;
    let image = render(&c, &pose, W, H, dots(15, 11, 6.0, 1.8))
        .blurred(0.9)
        .lit(200.0, 40.0, |x, _| 1.0 - 0.2 * x / 800.0)
        .recorded(2.0, 255.0, 15);
    let target = find_target(&view(&image), &TargetSettings::new(Pattern::Dots)).unwrap();
    let points: Vec<BoardPoint> = target
        .points
        .iter()
        .map(|p| BoardPoint {
            board_mm: p.index.map(|i| f64::from(i) * 6.0),
            pixel_px: p.at_px,
            sigma_px: p.sigma_px,
        })
        .collect();
    let fit = pose_of_board(&c, &points).unwrap();
    let n = pose.rotation * nalgebra::Vector3::z();
    let [d, s] = fit.axial_distance_mm();
    let board = Measured::new(d, s);
    close(board, n.dot(&pose.translation) / n.z, "D from the pose");
    assert!((fit.pose.tilt_rad() - n.x.hypot(n.y)).abs() < 2e-3);
    // The middle row, 84 mm long.
    let end = |i: i32| target.points.iter().find(|p| p.index == [i, 5]).unwrap();
    let [a, b] = [end(0), end(14)].map(|p| c.undistort_px(p.at_px).unwrap());
    let length = (a[0] - b[0]).hypot(a[1] - b[1]);
    let line =
        pinhole_to_line(Measured::new(1400.0, 0.7), Measured::new(84.0, 0.01), Measured::new(length, 0.02))
            .unwrap();
    close(line, 210.0, "D = L F/L′");
    assert!((line.sigma / line.value - 5.2e-4).abs() < 1e-4);
    let grating = pinhole_to_grating(board, Measured::new(109.0, 0.05)).unwrap();
    assert!((grating.value - (d - 109.0)).abs() < 1e-12 && grating.sigma > 0.05);
    assert!(pinhole_to_grating(board, Measured::new(300.0, 0.05)).is_err());
    assert!(
        pinhole_to_line(Measured::new(f64::NAN, 0.0), Measured::new(1.0, 0.0), Measured::new(1.0, 0.0))
            .is_err()
    );
}
