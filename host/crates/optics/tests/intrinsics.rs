//! Calibration of a camera: recovery, coverage of the standard deviations, refusals, images.

mod rendering;

use daic_optics::intrinsics::{
    BoardPoint, CameraError, CameraParameter, CameraSettings, calibrate_camera, pose_of_board,
};
use daic_optics::target::{Pattern, TargetSettings, find_target};
use daic_optics::{Brown, Camera, GreyView};
use rendering::{Noise, Pose, dots, render};

fn camera() -> Camera {
    Camera {
        focal_px: 1500.0,
        principal_point_px: [652.0, 471.0],
        brown: Brown { k1: -0.2, k2: 0.15, k3: -0.05, p1: 8e-4, p2: -6e-4 },
    }
}

const IMAGE: [usize; 2] = [1280, 960];

fn tilted(k: usize) -> Pose {
    let angles = [
        [0.0, 0.0, 0.0],
        [30.0, 0.0, 10.0],
        [-30.0, 5.0, -20.0],
        [0.0, 32.0, 0.0],
        [5.0, -30.0, 45.0],
        [22.0, 22.0, 90.0],
        [-22.0, 25.0, 5.0],
        [20.0, -25.0, -5.0],
    ];
    let mut pose = Pose::new(angles[k], [0.0; 3]);
    // The middle of the board on the axis, nearer and farther.
    let middle = pose.rotation * nalgebra::Vector3::new(42.0, 30.0, 0.0);
    pose.translation = nalgebra::Vector3::new(0.0, 0.0, 115.0 + 6.0 * k as f64) - middle;
    pose
}

/// 15 × 11 points, 6 mm apart, with noise of `sigma` px.
fn view(camera: &Camera, pose: &Pose, sigma: f64, random: &mut Noise) -> Vec<BoardPoint> {
    (0..165)
        .map(|k| [f64::from(k % 15) * 6.0, f64::from(k / 15) * 6.0])
        .map(|board_mm| BoardPoint {
            board_mm,
            pixel_px: pose.pixel(camera, board_mm).map(|v| v + sigma * random.normal()),
            sigma_px: [sigma.max(1e-3); 2],
        })
        .collect()
}

fn views(camera: &Camera, sigma: f64, random: &mut Noise) -> Vec<Vec<BoardPoint>> {
    (0..8).map(|k| view(camera, &tilted(k), sigma, random)).collect()
}

#[test]
fn exact_points_give_the_exact_camera() {
    let c = camera();
    let found = calibrate_camera(&views(&c, 0.0, &mut Noise::new(1)), &CameraSettings::new(IMAGE)).unwrap();
    for p in CameraParameter::ALL {
        let (a, b) = (p.get(&found.camera), p.get(&c));
        // Where the iteration stops: 1e-8 of a standard deviation's worth of cost.
        assert!((a - b).abs() < 1e-5 * (1.0 + b.abs()), "{p:?}: {a} {b}");
    }
    assert!(found.rms_px < 1e-6, "{}", found.rms_px);
    for (k, v) in found.views.iter().enumerate() {
        let truth = tilted(k);
        assert!((v.pose.translation - truth.translation).norm() < 1e-5);
        assert!((v.pose.rotation.matrix() - truth.rotation.matrix()).norm() < 1e-7);
    }
}

/// ±1σ is to cover the truth in 68.3 % of the runs: 500 runs × 8 parameters, which are correlated;
/// one parameter alone scatters by 2.1 %.
#[test]
fn standard_deviations_cover_the_truth() {
    const RUNS: usize = 500;
    let c = camera();
    let seed = 2;
    println!("seed {seed}");
    let mut random = Noise::new(seed);
    let settings = CameraSettings { start: Some(c), ..CameraSettings::new(IMAGE) };
    let mut inside = [0_usize; 8];
    let mut distance = 0_usize;
    for _ in 0..RUNS {
        // Five views suffice and are quicker.
        let views: Vec<_> = [1, 2, 3, 4, 7].map(|k| view(&c, &tilted(k), 0.05, &mut random)).into();
        let found = calibrate_camera(&views, &settings).unwrap();
        for (k, e) in found.estimates.iter().enumerate() {
            inside[k] += usize::from((e.value - e.parameter.get(&c)).abs() < e.sigma);
        }
        let pose = pose_of_board(&c, &views[0]).unwrap();
        let truth = tilted(1);
        let n = truth.rotation * nalgebra::Vector3::z();
        let [d, s] = pose.axial_distance_mm();
        distance += usize::from((d - n.dot(&truth.translation) / n.z).abs() < s);
    }
    let share = inside.map(|n| n as f64 / RUNS as f64);
    let mean = share.iter().sum::<f64>() / 8.0;
    let distance = distance as f64 / RUNS as f64;
    println!("inside ±1σ: {share:.3?}, mean {mean:.3}; distance of a board {distance:.3}");
    assert!((mean - 0.683).abs() < 0.03, "{mean}");
    // Three standard deviations of a binomial share, 0.0208.
    assert!(share.iter().all(|s| (s - 0.683).abs() < 0.063), "{share:?}");
    assert!((distance - 0.683).abs() < 0.063, "{distance}");
}

#[test]
fn a_long_lens_and_few_pixels_of_distortion_start_from_nothing() {
    // The macro set-up: field of ±4°, strong correlation of F and distance.
    let c = Camera {
        focal_px: 17347.0,
        principal_point_px: [1320.0, 950.0],
        brown: Brown { k1: -0.3, ..Brown::default() },
    };
    let mut random = Noise::new(3);
    let views: Vec<_> = (0..8)
        .map(|k| {
            let mut pose = tilted(k);
            let middle = pose.rotation * nalgebra::Vector3::new(42.0, 30.0, 0.0);
            pose.translation = nalgebra::Vector3::new(0.0, 0.0, 700.0) - middle;
            view(&c, &pose, 0.02, &mut random)
        })
        .collect();
    use CameraParameter::{Focal, K1, PrincipalX, PrincipalY};
    let settings =
        CameraSettings { free: vec![Focal, PrincipalX, PrincipalY, K1], ..CameraSettings::new([2592, 1944]) };
    let found = calibrate_camera(&views, &settings).unwrap();
    for e in &found.estimates {
        println!("{:?} {} ± {}", e.parameter, e.value, e.sigma);
        assert!((e.value - e.parameter.get(&c)).abs() < 4.0 * e.sigma, "{e:?}");
    }
    assert!((0.9..1.1).contains(&found.chi_square_reduced));
}

#[test]
fn wrong_points_are_left_out() {
    let c = camera();
    let mut data = views(&c, 0.05, &mut Noise::new(4));
    data[2][17].pixel_px[0] += 3.0;
    data[5][100].pixel_px[1] -= 1.0;
    let found = calibrate_camera(&data, &CameraSettings::new(IMAGE)).unwrap();
    assert!(found.views[2].rejected.contains(&17) && found.views[5].rejected.contains(&100));
    assert!(found.views.iter().map(|v| v.rejected.len()).sum::<usize>() < 5);
    assert!((0.9..1.1).contains(&found.chi_square_reduced), "{}", found.chi_square_reduced);
    // A board whose indices are mixed up fits no camera.
    for v in &mut data {
        for (k, p) in v.iter_mut().enumerate() {
            if k % 3 == 0 {
                p.board_mm[0] += 6.0;
            }
        }
    }
    let error = calibrate_camera(&data, &CameraSettings::new(IMAGE));
    assert!(
        matches!(error, Err(CameraError::TooManyOutliers { .. } | CameraError::NotConverged { .. }))
            || error.is_ok_and(|e| e.rms_px > 1.0)
    );
}

#[test]
fn what_views_cannot_fix_is_said() {
    let c = camera();
    let mut random = Noise::new(5);
    let data = views(&c, 0.05, &mut random);
    let settings = CameraSettings::new(IMAGE);
    assert_eq!(
        calibrate_camera(&data[..1], &settings).unwrap_err(),
        CameraError::TooFewViews { found: 1, needed: 2, parameters: 8 }
    );
    // Parallel boards: square to the camera, and all tilted alike.
    for tilt in [[0.0; 3], [25.0, -15.0, 0.0]] {
        let parallel: Vec<_> = (0..5)
            .map(|k| {
                let pose = Pose::new(tilt, [-40.0 + 3.0 * f64::from(k), -30.0, 120.0 + 8.0 * f64::from(k)]);
                view(&c, &pose, 0.05, &mut random)
            })
            .collect();
        let error = calibrate_camera(&parallel, &settings).unwrap_err();
        println!("{tilt:?}: {error}");
        assert!(matches!(error, CameraError::ParallelViews { .. }), "{error}");
    }
    // One row of the board.
    let mut line = data.clone();
    line[3].truncate(15);
    let error = calibrate_camera(&line, &settings).unwrap_err();
    assert_eq!(error, CameraError::DegenerateView { view: 3, points: 15 });
    // A lens without distortion: its coefficients are found not to matter.
    let plain = Camera { brown: Brown::default(), ..c };
    let found = calibrate_camera(&views(&plain, 0.05, &mut random), &settings).unwrap();
    let k3 = found.estimate(CameraParameter::K3).unwrap();
    assert!(!k3.determined, "{k3:?}");
    assert!(found.estimate(CameraParameter::Focal).unwrap().determined);
    let mut bad = data.clone();
    bad[1][2].sigma_px[0] = 0.0;
    assert_eq!(calibrate_camera(&bad, &settings).unwrap_err(), CameraError::Value { view: 1, point: 2 });
    let fixed = CameraSettings { free: vec![CameraParameter::K1], ..settings };
    assert!(matches!(calibrate_camera(&data, &fixed), Err(CameraError::Setting { name: "start", .. })));
}

/// Images in, camera out.
#[test]
fn from_rendered_images() {
    let c = Camera {
        focal_px: 800.0,
        principal_point_px: [327.0, 234.0],
        brown: Brown { k1: -0.12, k2: 0.08, k3: 0.0, p1: 5e-4, p2: -4e-4 },
    };
    let mut data = Vec::new();
    for (k, n) in [1, 2, 3, 4, 6].into_iter().enumerate() {
        let mut pose = tilted(n);
        let middle = pose.rotation * nalgebra::Vector3::new(42.0, 30.0, 0.0);
        pose.translation = nalgebra::Vector3::new(0.0, 0.0, 125.0) - middle;
        let image = render(&c, &pose, 640, 480, dots(15, 11, 6.0, 1.8))
            .blurred(0.8)
            .lit(200.0, 40.0, |x, y| 1.0 - 0.3 * (x / 640.0) - 0.1 * (y / 480.0))
            .recorded(2.0, 255.0, 100 + k as u64);
        let found =
            find_target(&GreyView::new(&image.data, 640, 480).unwrap(), &TargetSettings::new(Pattern::Dots))
                .unwrap();
        data.push(
            found
                .points
                .iter()
                .map(|p| BoardPoint {
                    board_mm: p.index.map(|i| f64::from(i) * 6.0),
                    pixel_px: p.at_px,
                    sigma_px: p.sigma_px,
                })
                .collect(),
        );
    }
    use CameraParameter::{Focal, K1, K2, P1, P2, PrincipalX, PrincipalY};
    let settings = CameraSettings {
        free: vec![Focal, PrincipalX, PrincipalY, K1, K2, P1, P2],
        ..CameraSettings::new([640, 480])
    };
    let found = calibrate_camera(&data, &settings).unwrap();
    println!("rms {:.4} px, χ² {:.3}", found.rms_px, found.chi_square_reduced);
    for e in &found.estimates {
        println!("{:?} {:.5} ± {:.5}, true {:.5}", e.parameter, e.value, e.sigma, e.parameter.get(&c));
        assert!((e.value - e.parameter.get(&c)).abs() < 3.5 * e.sigma, "{e:?}");
    }
    assert!(found.rms_px < 0.02, "{}", found.rms_px);
}
