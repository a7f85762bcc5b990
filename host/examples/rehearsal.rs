//! Simulated inputs for the commands that calibrate, align and decode: `rehearsal OUT`; and whether what the commands
//! of `examples/tour.sh` made of them is the truth: `rehearsal --check OUT`.

#[path = "../crates/optics/tests/rendering/mod.rs"]
mod rendering;

use daic::camera_file::CameraFile;
use daic::microscope::MicroscopeFile;
use daic_dataset::Table;
use daic_optics::bundle::Pose as PlatePose;
use daic_optics::{Brown, Camera, OpticalModel, Optics, View};
use daic_rig::experiment::OpticsFile;
use nalgebra::Vector3;
use rendering::{Image, Pose, dots, render};
use std::error::Error;
use std::fmt::Write as _;
use std::path::Path;

const WIDTH: usize = 480;
const HEIGHT: usize = 360;

/// The camera in front of which the boards and the laser stand.
fn camera() -> Camera {
    Camera {
        focal_px: 600.0,
        principal_point_px: [243.0, 176.0],
        brown: Brown { k1: -0.1, ..Brown::default() },
    }
}

fn save(path: &Path, image: &Image) -> Result<(), Box<dyn Error>> {
    let grey = image.data.iter().map(|v| *v as u8).collect();
    let picture = image::GrayImage::from_raw(image.width as u32, image.height as u32, grey);
    Ok(picture.ok_or("an image without its pixels")?.save(path)?)
}

/// 13 × 9 dots 6 mm apart, in five poses and once square to the camera at 130 mm.
fn boards(folder: &Path) -> Result<(), Box<dyn Error>> {
    let tilts =
        [[28.0, 0.0, 4.0], [-28.0, 4.0, -8.0], [0.0, 30.0, 0.0], [4.0, -30.0, 12.0], [20.0, 20.0, 0.0]];
    let mut poses: Vec<_> =
        tilts.iter().zip(1..).map(|(tilt, k)| (format!("board-{k}.png"), *tilt, 110.0)).collect();
    poses.push(("square.png".to_owned(), [0.4, -0.2, 1.0], 130.0));
    for (seed, (name, degrees, distance)) in (1..).zip(poses) {
        let mut pose = Pose::new(degrees, [0.0; 3]);
        let middle = pose.rotation * Vector3::new(36.0, 24.0, 0.0);
        pose.translation = Vector3::new(0.0, 0.0, distance) - middle;
        let clean = render(&camera(), &pose, WIDTH, HEIGHT, dots(13, 9, 6.0, 1.8));
        let image = clean.blurred(0.8).lit(200.0, 40.0, |x, _| 1.0 - 0.0005 * x).recorded(2.0, 255.0, seed);
        save(&folder.join(name), &image)?;
    }
    Ok(())
}

/// Light of `shape(distance from a mark)` at every mark.
fn marks(at: &[[f64; 2]], seed: u64, shape: impl Fn(f64) -> f64) -> Image {
    let value = |k: usize| {
        let (x, y) = ((k % WIDTH) as f64, (k / WIDTH) as f64);
        let sum: f64 = at.iter().map(|p| shape((x - p[0]).hypot(y - p[1]))).sum();
        (20.0 + 180.0 * sum) as f32
    };
    let data = (0..WIDTH * HEIGHT).map(value).collect();
    Image { width: WIDTH, height: HEIGHT, data }.recorded(2.0, 255.0, seed)
}

/// A rail that leans by 4 and −2 mrad, a beam by 3 mrad, a grating tilted by 2 mrad about y, grooves turned by 5 mrad.
fn alignment(folder: &Path) -> Result<(), Box<dyn Error>> {
    let disc = |r: f64| 1.0 / (1.0 + ((r - 12.0) / 0.6).exp());
    let spot = |r: f64| (-r * r / 18.0).exp();
    let at = |x: f64, y: f64, z: f64| camera().pixel([x / z, y / z]);
    for (name, z, seed) in [("near", 300.0, 20), ("far", 1200.0, 21)] {
        let aperture = at(1.0 + 4e-3 * (z - 300.0), 0.5 - 2e-3 * (z - 300.0), z);
        save(&folder.join(format!("aperture-{name}.png")), &marks(&[aperture], seed, disc))?;
        let beam = at(0.2 + 3e-3 * z, -0.1, z);
        save(&folder.join(format!("laser-{name}.png")), &marks(&[beam], seed + 10, spot))?;
    }
    let shift = 600.0 * (2.0 * 2e-3 * 300.0) / 400.0;
    save(&folder.join("aperture.png"), &marks(&[[250.0, 180.0]], 22, disc))?;
    save(&folder.join("reflected.png"), &marks(&[[250.0 + shift, 180.0]], 23, spot))?;
    let orders = [-120.0, 0.0, 120.0].map(|x| camera().pixel([x / 600.0, x * 5e-3 / 600.0]));
    save(&folder.join("orders.png"), &marks(&orders, 24, spot))
}

/// Numbers in −0.5 … 0.5 that are the same everywhere.
struct Noise(u32);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(self.0 >> 8) / f64::from(1 << 24) - 0.5
    }
}

fn pixels(model: &OpticalModel, p: Vector3<f64>, noise: &mut Noise) -> Result<[f64; 4], Box<dyn Error>> {
    let [[a, b], [c, d]] = [model.project(View::Minus, p)?, model.project(View::Plus, p)?];
    // uniform, σ = 0.01 px
    Ok([a, b, c, d].map(|v| v + 0.01 * 12_f64.sqrt() * noise.next()))
}

/// Dots of a plate in seven poses before a rig whose gratings are tilted and whose distances are off, and points of a
/// cylinder seen by the same rig.
fn rig(folder: &Path, start: &Path) -> Result<(), Box<dyn Error>> {
    let mut o: Optics = daic::optics_section::from_section(&OpticsFile::load(start)?.optics)?;
    o.camera.focal_px *= 1.006;
    o.pinhole_to_grating_mm += 1.5;
    o.grating_to_reference_mm -= 1.0;
    o.minus.tilt_rad_xyz = [0.02, -0.03, 0.01];
    o.plus.tilt_rad_xyz = [0.015, -0.03, 0.011];
    let model = OpticalModel::new(&o)?;
    let mut noise = Noise(1);
    let poses = [
        ([0.0; 3], [0.0; 3]),
        ([0.0; 3], [0.0, 0.0, 2.5]),
        ([0.0; 3], [0.1, 0.0, -2.5]),
        ([0.2, 0.0, 0.0], [0.0; 3]),
        ([-0.2, 0.0, 0.0], [0.0, 0.2, 0.0]),
        ([0.0, 0.2, 0.0], [0.0; 3]),
        ([0.0, -0.2, 0.05], [0.0; 3]),
    ];
    let mut text = String::from("pose,point,plate_x_mm,plate_y_mm,minus_x,minus_y,plus_x,plus_y\n");
    for (k, (rotation_rad, translation_mm)) in poses.into_iter().enumerate() {
        let plate = PlatePose { rotation_rad, translation_mm };
        for point in 0..63 {
            let [x, y] = [f64::from(point % 9) * 2.0 - 8.0, f64::from(point / 9) * 2.0 - 6.0];
            let [a, b, c, d] = pixels(&model, plate.point_mm([x, y]), &mut noise)?;
            writeln!(text, "{k},{point},{x},{y},{a},{b},{c},{d}")?;
        }
    }
    std::fs::write(folder.join("plate.csv"), text)?;
    let mut text = String::from("minus_x,minus_y,plus_x,plus_y,sigma_px\n");
    for k in 0..1200 {
        let (x, y) = (0.4 * f64::from(k % 40) - 7.8, 0.4 * f64::from(k / 40) - 5.8);
        let h = (36.0_f64.powi(2) - x * x).sqrt() - 35.0;
        let [a, b, c, d] = pixels(&model, Vector3::new(x, y, h), &mut noise)?;
        writeln!(text, "{a},{b},{c},{d},0.01")?;
    }
    Ok(std::fs::write(folder.join("pairs.csv"), text)?)
}

/// Fields of a z move, an in-plane move and a tilt under the microscope of the literature, (3.1)–(3.2).
fn microscope(folder: &Path) -> Result<(), Box<dyn Error>> {
    let (b1, b2, b3, b4, xc, yc) = (2.295, 0.53, 2.12e-4, 2.0e-4, 322.0, 287.5);
    let (sin, cos) = 6.0_f64.to_radians().sin_cos();
    let mut noise = Noise(2);
    type Motion = Box<dyn Fn(f64) -> [f64; 3]>;
    let motions: [(&str, Motion); 3] = [
        ("z.csv", Box::new(|_| [0.0, 0.0, 10.0])),
        ("x.csv", Box::new(|_| [10.0, 0.0, 0.0])),
        ("tilt.csv", Box::new(move |x| [x * (cos - 1.0), 0.0, -x * sin])),
    ];
    for (name, motion) in motions {
        let mut text = String::from("x_px,y_px,u_minus_px,v_minus_px,u_plus_px,v_plus_px,status\n");
        for k in 0..400 {
            let (x, y) = (20.0 + 32.0 * f64::from(k % 20), 10.0 + 28.0 * f64::from(k / 20));
            let [u, v, w] = motion(b2 * (x - xc));
            let across = v / b2 + b4 / b2 * (y - yc) * w;
            let common = u / b2 + b3 / b2 * (x - xc) * w;
            let mut noisy = |v: f64| v + 0.01 * 12_f64.sqrt() * noise.next();
            let moved = [common + w / b1, across, common - w / b1, across].map(&mut noisy);
            writeln!(text, "{x},{y},{},{},{},{},ok", moved[0], moved[1], moved[2], moved[3])?;
        }
        std::fs::write(folder.join(name), text)?;
    }
    let moves = "\
format = \"daic-moves/1\"
sigma = \"0.01 px\"
provenance = \"rehearsal\"

[[motion]]
name = \"z\"
field = \"z.csv\"
translation = [\"0 um\", \"0 um\", \"10 um\"]

[[motion]]
name = \"x\"
field = \"x.csv\"
translation = [\"10 um\", \"0 um\", \"0 um\"]

# not fitted: it says how well the others predict it
[[motion]]
name = \"tilt\"
field = \"tilt.csv\"
rotation = [\"0 deg\", \"6 deg\", \"0 deg\"]
fit = false
";
    Ok(std::fs::write(folder.join("moves.toml"), moves)?)
}

/// A value against the truth, within four of its standard deviations.
struct Check {
    failed: usize,
}

impl Check {
    fn near(&mut self, what: &str, value: f64, sigma: f64, truth: f64) {
        let off = (value - truth).abs() / sigma;
        let good = off < 4.0;
        println!("{} {what}: {value:.6} ± {sigma:.6}, true {truth:.6}", if good { "ok   " } else { "WRONG" });
        self.failed += usize::from(!good);
    }

    fn below(&mut self, what: &str, value: f64, limit: f64) {
        let good = value < limit;
        println!("{} {what}: {value:.3e}, limit {limit:.3e}", if good { "ok   " } else { "WRONG" });
        self.failed += usize::from(!good);
    }
}

/// Value and standard deviation of a measured quantity of the alignment's record.
fn recorded(record: &toml::Table, path: &[&str]) -> Result<[f64; 2], Box<dyn Error>> {
    let mut at = record.get(path[0]).ok_or(path[0])?;
    for key in &path[1..] {
        at = match key.parse::<usize>() {
            Ok(k) => at.get(k),
            Err(_) => at.get(key),
        }
        .ok_or_else(|| path.join("."))?;
    }
    let of = |name: &str| at.get(name).and_then(toml::Value::as_float).ok_or_else(|| path.join("."));
    Ok([of("value")?, of("sigma")?])
}

fn check(out: &Path) -> Result<usize, Box<dyn Error>> {
    let mut check = Check { failed: 0 };
    let file = CameraFile::load(&out.join("camera-found/camera.toml"))?;
    for e in &file.estimates {
        check.near(e.parameter.name(), e.value, e.sigma, e.parameter.get(&camera()));
    }
    let record: toml::Table = std::fs::read_to_string(out.join("align.toml"))?.parse()?;
    for (path, truth) in [
        (&["rail", "found", "axis", "slope_rad", "0"][..], 4e-3),
        (&["rail", "found", "axis", "slope_rad", "1"], -2e-3),
        (&["laser", "found", "axis", "slope_rad", "0"], 3e-3),
        (&["laser", "found", "axis", "slope_rad", "1"], 0.0),
        (&["reflection", "found", "tilt_rad", "0"], 0.0),
        (&["reflection", "found", "tilt_rad", "1"], 2e-3),
        (&["orders", "found", "first", "angle_rad"], 5e-3),
        (&["distance", "found", "pinhole_to_grating_mm"], 90.0),
    ] {
        let [value, sigma] = recorded(&record, path)?;
        check.near(&path.join("."), value, sigma, truth);
    }
    let points = Table::read_csv(&out.join("points.csv"))?;
    let path = out.join("points.csv");
    let column = |name: &str| points.numbers(name, &path);
    let (x, h) = (column("x_mm")?, column("h_mm")?);
    let sigma: Vec<f64> =
        column("sigma_h_mm")?.iter().zip(column("sigma_h_cal_mm")?).map(|(a, b)| a.hypot(b)).collect();
    let rms =
        |values: &mut dyn Iterator<Item = f64>| (values.map(|v| v * v).sum::<f64>() / x.len() as f64).sqrt();
    let error = rms(&mut x.iter().zip(&h).map(|(x, h)| h - ((36.0_f64.powi(2) - x * x).sqrt() - 35.0)));
    // 1 200 points' own noise, and one draw of the calibration's
    check.below("height of the cylinder, RMS over stated σ", error / rms(&mut sigma.iter().copied()), 1.6);
    let scope = MicroscopeFile::load(&out.join("microscope.toml"))?.microscope;
    let found = [
        ("beta1", scope.beta1_um_per_px, 2.295),
        ("beta2", scope.beta2_um_per_px, 0.53),
        ("beta3", scope.beta3_per_px, 2.12e-4),
        ("beta4", scope.beta4_per_px, 2.0e-4),
        ("centre_x", scope.centre_px[0], 322.0),
        ("centre_y", scope.centre_px[1], 287.5),
    ];
    for (k, (name, value, truth)) in found.into_iter().enumerate() {
        check.near(name, value, scope.covariance[k][k].sqrt(), truth);
    }
    Ok(check.failed)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    let out = match arguments.as_slice() {
        [flag, out] if flag == "--check" => {
            let failed = check(Path::new(out))?;
            return if failed == 0 {
                Ok(())
            } else {
                Err(format!("{failed} results are not the truth").into())
            };
        }
        [out] => Path::new(out),
        _ => return Err("rehearsal OUT or rehearsal --check OUT".into()),
    };
    let start = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/golden-macro.toml");
    for folder in ["camera", "align", "rig", "microscope"] {
        std::fs::create_dir_all(out.join(folder))?;
    }
    boards(&out.join("camera"))?;
    alignment(&out.join("align"))?;
    rig(&out.join("rig"), &start)?;
    microscope(&out.join("microscope"))?;
    println!("inputs in {}", out.display());
    Ok(())
}
