//! `daic strain`, `daic probe` and `daic noise-floor` as a user runs them.

use daic_dataset::Table;
use daic_tests::program::{Run, daic};
use daic_tests::shared::shared;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

struct Place(TempDir);

impl Place {
    fn new() -> Self {
        Self(TempDir::new().expect("folder"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn run(&self, arguments: &[&str]) -> Run {
        daic(self.0.path(), arguments)
    }

    /// Points of a field in the form of `daic correlate`: `columns` × `rows`, 5 px apart from (20, 20).
    fn points(&self, name: &str, columns: usize, rows: usize, u: impl Fn(f64, f64) -> (f64, f64)) -> String {
        let mut text = String::from("x,y,u,v,sigma_u,sigma_v,zncc,iterations,status\n");
        for k in 0..columns * rows {
            let (x, y) = (20.0 + 5.0 * (k % columns) as f64, 20.0 + 5.0 * (k / columns) as f64);
            let (u, v) = u(x, y);
            text.push_str(&format!("{x:?},{y:?},{u:?},{v:?},0.005,0.004,0.99,3,ok\n"));
        }
        std::fs::write(self.path(name), &text).expect("written");
        text
    }

    /// Expects exit code 2, every one of `words` in the message, and no file beside the points.
    #[track_caller]
    fn refused(&self, arguments: &[&str], words: &[&str]) {
        let files = || std::fs::read_dir(self.0.path()).expect("readable").count();
        let before = files();
        let run = self.run(arguments).expect_code(2);
        assert_eq!(run.stdout, "", "an error belongs on stderr");
        let text = run.stderr.replace(['│', '×', '╭', '╰', '─'], " ");
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
        for word in words {
            assert!(text.contains(word), "`{word}` is not in:\n{text}");
        }
        assert!(!text.contains("panicked"), "{text}");
        assert_eq!(files(), before, "nothing half-written");
    }
}

fn affine(x: f64, y: f64) -> (f64, f64) {
    (0.02 * x + 0.004 * y, -0.006 * x - 0.01 * y)
}

fn number(value: &serde_json::Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

#[track_caller]
fn close(found: f64, truth: f64, tolerance: f64) {
    assert!((found - truth).abs() <= tolerance, "{found} instead of {truth}");
}

#[test]
fn strain_of_a_homogeneous_deformation() {
    let place = Place::new();
    place.points("points.csv", 24, 20, affine);
    let with = |more: &[&'static str]| {
        let base = ["strain", "points.csv", "--json", "--quiet", "--window", "7", "--subset", "21"];
        place.run(&[&base, more].concat()).expect_code(0).json()
    };
    let answer = with(&["--scale", "0.02", "--out", "strain.csv", "--figures", "maps"]);
    // (7 − 1) · 5 + 21
    assert_eq!(answer["gauge"]["gauge_px"], 51.0);
    close(number(&answer["gauge"]["gauge_mm"]), 1.02, 1e-12);
    assert_eq!(answer["subset_assumed"], false);
    assert_eq!(answer["tensor"], "green-lagrange");
    let (ux, uy, vx, vy) = (0.02, 0.004, -0.006, -0.01);
    let truth =
        [ux + 0.5 * (ux * ux + vx * vx), vy + 0.5 * (uy * uy + vy * vy), 0.5 * (uy + vx + ux * uy + vx * vy)];
    for (name, truth) in ["exx", "eyy", "exy"].into_iter().zip(truth) {
        close(number(&answer[name]["mean"]), truth, 1e-12);
        assert!(number(&answer[name]["std"]) < 1e-12 && number(&answer[name]["sigma"]) > 1e-6);
        let svg = std::fs::read_to_string(place.path(&format!("maps/{name}.svg"))).expect("a figure");
        assert!(svg.starts_with("<svg") && svg.contains(name));
    }
    let path = place.path("strain.csv");
    let text = std::fs::read_to_string(&path).expect("strain");
    let header = "x,y,u,v,exx,eyy,exy,sigma_exx,sigma_eyy,sigma_exy,e1,e2,angle_deg,von_mises,rotation_deg,used,status\n";
    assert!(text.starts_with(header));
    let table = Table::read_csv(&path).expect("strain");
    assert_eq!(table.rows(), 480);
    let status = table.texts("status", &path).expect("status");
    let exx = table.numbers("exx", &path).expect("exx");
    // the corners hold less than half a window
    assert_eq!(status[0], "too_few_points");
    assert!(exx[0].is_nan());
    assert_eq!(status.iter().filter(|s| *s == "ok").count() as u64, answer["ok"].as_u64().expect("a number"));
    for (status, exx) in status.iter().zip(exx) {
        if status == "ok" { close(exx, truth[0], 1e-12) } else { assert!(exx.is_nan()) }
    }
    for (tensor, exx) in [("engineering", ux), ("hencky", f64::NAN)] {
        let answer = with(&["--tensor", tensor, "--method", "savitzky-golay", "--order", "cubic"]);
        assert_eq!(answer["ok"], 480, "edges are one-sided");
        if exx.is_finite() {
            close(number(&answer["exx"]["mean"]), exx, 1e-11);
        } else {
            // ln √(λ₁² λ₂²) = ln det F
            let trace = number(&answer["exx"]["mean"]) + number(&answer["eyy"]["mean"]);
            close(trace, ((1.0 + ux) * (1.0 + vy) - uy * vx).ln(), 1e-11);
        }
    }
    // people are told the gauge, and that the subset was not known
    let run = place.run(&["strain", "points.csv", "--window", "7", "--scale", "0.02"]).expect_code(0);
    for words in ["63 px = 1.2600 mm", "(7 − 1) × 5 px step + 33 px subset", "33 px assumed"] {
        assert!(run.stdout.contains(words), "{words}: {}", run.stdout);
    }
}

#[test]
fn points_that_failed_are_left_out() {
    let place = Place::new();
    let text = place.points("points.csv", 24, 20, affine);
    let lines: Vec<String> = text
        .lines()
        .enumerate()
        .map(|(k, line)| {
            if k == 0 || k % 17 != 0 {
                return line.to_owned();
            }
            let mut cells: Vec<&str> = line.split(',').collect();
            (cells[2], cells[3], cells[8]) = ("1e4", "nan", "low_correlation");
            cells.join(",")
        })
        .collect();
    std::fs::write(place.path("holes.csv"), lines.join("\n") + "\n").expect("written");
    let answer = place.run(&["strain", "holes.csv", "--json", "-q", "--window", "7"]).expect_code(0).json();
    close(number(&answer["exx"]["mean"]), 0.02 + 0.5 * (0.02 * 0.02 + 0.006 * 0.006), 1e-12);
    assert_eq!(answer["status"]["no_displacement"], 480 / 17);
    // the same whatever the number of threads
    let out = |threads: &str, name: &str| {
        place
            .run(&["strain", "holes.csv", "-q", "--window", "7", "--threads", threads, "--out", name])
            .expect_code(0);
        std::fs::read(place.path(name)).expect("strain")
    };
    assert_eq!(out("1", "one.csv"), out("2", "two.csv"));
}

#[test]
fn bad_input() {
    let place = Place::new();
    let text = place.points("points.csv", 24, 20, affine);
    let strain = |more: &[&'static str]| [&["strain", "points.csv"], more].concat();
    place.refused(&strain(&["--window", "8"]), &["odd", "8", "7 or 9"]);
    place.refused(
        &strain(&["--window", "21"]),
        &["21 points", "24×20".replace('×', " ").as_str(), "at most 19"],
    );
    place.refused(&strain(&["--window", "1"]), &["1", "3..=1001"]);
    place.refused(&strain(&["--window", "0", "--out", "s.csv"]), &["0", "3..=1001"]);
    place.refused(&strain(&["--window", "7", "--order", "cubic"]), &["plane", "savitzky-golay", "3"]);
    place.refused(&strain(&["--window", "7", "--scale", "-1"]), &["-1", "above 0"]);
    place.refused(&strain(&["--window", "7", "--min-fraction", "nan"]), &["min_fraction"]);
    place.refused(&strain(&["--window", "7", "--max-jump", "-2"]), &["max_jump", "-2"]);
    place.refused(&strain(&["--window", "7", "--out", "s.xlsx"]), &["s.xlsx", ".csv, .npz"]);
    place.refused(&["strain", "absent.csv"], &["absent.csv"]);
    let write = |name: &str, text: String| std::fs::write(place.path(name), text).expect("written");
    let edited = |name: &str, line: usize, field: usize, cell: &str| {
        let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
        let mut cells: Vec<&str> = lines[line - 1].split(',').collect();
        cells[field] = cell;
        lines[line - 1] = cells.join(",");
        write(name, lines.join("\n") + "\n");
    };
    let check = |name: &str, words: &[&str]| place.refused(&["strain", name, "--window", "7"], words);
    write("noheader.csv", text.replacen("x,y,u,v", "x,y,dx,v", 1));
    check("noheader.csv", &["noheader.csv", "no column `u`", "dx"]);
    edited("word.csv", 31, 2, "much");
    check("word.csv", &["word.csv, line 31", "`u`", "`much`", "a number"]);
    edited("status.csv", 7, 8, "fine");
    check("status.csv", &["line 7", "`status`", "`fine`", "ok, not_converged"]);
    edited("nan.csv", 12, 3, "nan");
    check("nan.csv", &["line 12", "`v`", "NaN", "`ok`"]);
    edited("infinite.csv", 12, 0, "inf");
    check("infinite.csv", &["line 12", "`x`", "inf", "position"]);
    edited("sigma.csv", 12, 4, "-0.1");
    check("sigma.csv", &["line 12", "`sigma_u`", "-0.1"]);
    edited("twice.csv", 40, 0, "20.0");
    check("twice.csv", &["line 40", "line 26"]);
    edited("off.csv", 40, 0, "97.0");
    check("off.csv", &["apart"]);
    edited("far.csv", 40, 0, "900020.0");
    check("far.csv", &["nodes"]);
    write("empty.csv", text.lines().next().expect("a header").to_owned() + "\n");
    check("empty.csv", &["empty.csv", "no points"]);
    write("nothing.csv", String::new());
    check("nothing.csv", &["nothing.csv"]);
    write("failed.csv", text.replace(",ok", ",no_guess"));
    check("failed.csv", &["480 points", "`ok`"]);
    write(
        "nangrid.csv",
        text.lines().map(|l| l.to_owned() + "\n").collect::<String>().replace("0.99,3,ok", "nan,0,no_guess"),
    );
    check("nangrid.csv", &["nothing to compute"]);
    write("short.csv", text.replacen("0.99,3,ok", "0.99", 1));
    check("short.csv", &["short.csv", "line"]);
    write("binary.csv", "\u{0}\u{1}\u{2}".repeat(50));
    check("binary.csv", &["binary.csv"]);

    place.refused(&["probe", "points.csv"], &["--point", "--line", "--extensometer"]);
    place.refused(&["probe", "points.csv", "--point", "1,2,3"], &["1,2,3", "X,Y"]);
    place.refused(&["probe", "points.csv", "--point", "nan,2"], &["finite"]);
    place.refused(&["probe", "points.csv", "--extensometer", "30,30,30,30"], &["differ"]);
    place.refused(
        &["probe", "points.csv", "--extensometer", "30,30,60,30", "--radius", "-1"],
        &["radius", "-1"],
    );
    place.refused(&["probe", "points.csv", "--point", "30,30", "--window", "21"], &["21 points"]);
}

#[test]
fn probes() {
    let place = Place::new();
    place.points("points.csv", 24, 20, affine);
    let arguments = [
        "probe",
        "points.csv",
        "--json",
        "-q",
        "--window",
        "5",
        "--point",
        "51.5,63.25",
        "--point",
        "5,5",
        "--line",
        "20,20,135,115",
        "--extensometer",
        "40,60,100,60",
        "--extensometer",
        "60,30,60,100",
        "--out",
        "probes.csv",
        "--figures",
        "lines",
    ];
    let answer = place.run(&arguments).expect_code(0).json();
    let p = &answer["points"][0];
    assert_eq!(p["status"], "ok");
    close(number(&p["u"]), affine(51.5, 63.25).0, 1e-12);
    close(number(&p["v"]), affine(51.5, 63.25).1, 1e-12);
    close(number(&p["strain"]["exx"]), 0.02 + 0.5 * (0.02 * 0.02 + 0.006 * 0.006), 1e-12);
    assert!(number(&p["sigma_u"]) < 0.005 && number(&p["sigma_u"]) > 0.004);
    assert_eq!(answer["points"][1]["status"], "outside");
    assert!(answer["points"][1]["u"].is_null(), "no number where there is none");
    let line = answer["lines"][0].as_array().expect("samples");
    // 149 px, one per 5 px
    assert_eq!(line.len(), 31);
    close(number(&line[30]["distance"]), 115f64.hypot(95.0), 1e-9);
    close(number(&line[30]["u"]), affine(135.0, 115.0).0, 1e-12);
    let [e, f] = [&answer["extensometers"][0], &answer["extensometers"][1]];
    close(number(&e["strain"]), 1.02f64.hypot(0.006) - 1.0, 1e-12);
    close(number(&f["strain"]), 0.99f64.hypot(0.004) - 1.0, 1e-12);
    // ends further apart than a subset: √2 σ / L along x
    close(number(&e["sigma_strain"]), 2f64.sqrt() * 0.005 / 60.0, 1e-8);
    let table = Table::read_csv(&place.path("probes.csv")).expect("probes");
    assert_eq!(table.rows(), 2 + 31 + 2);
    for name in ["line-1-displacement.svg", "line-1-strain.svg"] {
        assert!(place.path("lines").join(name).exists(), "{name}");
    }
    // too small a field for the default window has no strain, and says so
    place.points("small.csv", 10, 10, affine);
    let answer = place.run(&["probe", "small.csv", "--json", "-q", "--point", "30,30"]).expect_code(0).json();
    assert!(answer["gauge"].is_null() && answer["points"][0]["strain"].is_null());
}

/// Smooth speckles with noise of about 2 grey levels of its own.
fn static_frame(path: &Path, noise_seed: u64, shift: f64) {
    const N: usize = 180;
    let random = |seed: u64| {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    };
    let mut place = random(7);
    let mut grey = vec![110.0; N * N];
    for _ in 0..N * N / 25 {
        let (cx, cy, a) = (place() * N as f64, place() * N as f64, 140.0 * place() - 70.0);
        let (cx, size) = (cx + shift, 2.0);
        let near = |c: f64| (c as i64 - 8).max(0) as usize..((c as i64 + 9).clamp(0, N as i64)) as usize;
        for y in near(cy) {
            for x in near(cx) {
                let d = (x as f64 - cx).powi(2) + (y as f64 - cy).powi(2);
                grey[y * N + x] += a * (-0.5 * d / (size * size)).exp();
            }
        }
    }
    let mut noise = random(noise_seed + 100);
    let pixels = grey
        .iter()
        // the sum of twelve has variance one
        .map(|g| (g + 2.0 * ((0..12).map(|_| noise()).sum::<f64>() - 6.0)).round().clamp(0.0, 255.0) as u8)
        .collect();
    image::GrayImage::from_raw(N as u32, N as u32, pixels).expect("pixels").save(path).expect("written");
}

#[test]
fn noise_floor_of_static_frames() {
    let place = Place::new();
    // the third frame has drifted by 0.15 px
    for k in 0..6u64 {
        static_frame(&place.path(&format!("f{k}.png")), k, if k == 2 { 0.15 } else { 0.0 });
    }
    let base = ["noise-floor", "f0.png", "f1.png", "f2.png", "f3.png", "f4.png", "f5.png", "--json", "-q"];
    let more = ["--subset", "21", "--step", "5", "--window", "9", "--out", "floor.csv", "--figures", "maps"];
    let answer = place.run(&[&base[..], &more].concat()).expect_code(0).json();
    let frames = answer["frames"].as_array().expect("frames");
    assert_eq!(frames.len(), 5);
    let sigma = number(&frames[0]["u"]["sigma"]);
    // the mean over some 40 subsets that share no pixels, at four standard deviations
    close(number(&frames[1]["rigid"]["u_px"]), 0.15, 4.0 * sigma / 40f64.sqrt());
    close(number(&frames[0]["rigid"]["u_px"]), 0.0, 4.0 * sigma / 40f64.sqrt());
    for f in frames {
        // some 60 independent subsets of a frame leave 10 % of chance
        let ratio = number(&f["u"]["sigma"]) / number(&f["u"]["std"]);
        eprintln!("spatial: said/seen {ratio:.3}");
        assert!((ratio - 1.0).abs() < 0.3, "{ratio}");
        // taking off a rotation lessens the scatter of both together
        let both = |u: &serde_json::Value, v: &serde_json::Value| number(u).hypot(number(v));
        let rest = both(&f["u_std_without_rigid"], &f["v_std_without_rigid"]);
        assert!(rest <= both(&f["u"]["std"], &f["v"]["std"]));
    }
    let t = &answer["temporal_u"];
    let ratio = number(&t["sigma_of_one_frame"]) / number(&t["rms"]);
    eprintln!("sigma {sigma:.4} px; temporal: said/seen {ratio:.3}");
    assert!((ratio - 1.0).abs() < 0.15, "{ratio}");
    for t in answer["temporal_strain"].as_array().expect("strain") {
        let ratio = number(&t["sigma_of_one_frame"]) / number(&t["rms"]);
        eprintln!("temporal strain: said/seen {ratio:.3}");
        assert!((ratio - 1.0).abs() < 0.25, "{ratio}");
    }
    let table = Table::read_csv(&place.path("floor.csv")).expect("floor");
    assert_eq!(table.rows() as u64, answer["points"].as_u64().expect("points"));
    assert!(place.path("maps/std_u.svg").exists() && place.path("maps/std_exx.svg").exists());
    // two frames have no scatter over time
    let two = ["noise-floor", "f0.png", "f1.png", "--json", "-q", "--window", "9", "--subset", "21"];
    let answer = place.run(&two).expect_code(0).json();
    assert!(answer["temporal_u"].is_null());

    place.refused(&["noise-floor", "f0.png"], &["2"]);
    place.refused(&["noise-floor", "f0.png", "absent.png"], &["absent.png"]);
    place.refused(&["noise-floor", "f0.png", "f1.png", "--window", "4"], &["odd"]);
    place.refused(
        &["noise-floor", "f0.png", "f1.png", "--step", "20", "--window", "15"],
        &["larger than the field"],
    );
    // another specimen is not a static frame
    let mut state = 1u32;
    image::GrayImage::from_fn(180, 180, |_, _| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        image::Luma([(state >> 24) as u8])
    })
    .save(place.path("other.png"))
    .expect("written");
    place.refused(&["noise-floor", "f0.png", "other.png", "--window", "9"], &["other.png", "unmoved"]);
}

#[test]
fn golden_strain() {
    let name = "golden_strain";
    let Some(folder) = shared(name, "golden/dic") else { return };
    let place = Place::new();
    let (ux, uy, vx, vy) = (0.01, 0.002, 0.002, -0.003);
    let truth =
        [ux + 0.5 * (ux * ux + vx * vx), vy + 0.5 * (uy * uy + vy * vy), 0.5 * (uy + vx + ux * uy + vx * vy)];
    // largest bias and scatter of a strain: measured 5e-7 and 7e-6 (n0), 4e-6 and 3.3e-5 (n2), cut windows at the
    // edges included
    for (noise, case, truth, bias, scatter) in
        [("n0", "aff1", truth, 2e-6, 9e-6), ("n2", "t02", [0.0; 3], 8e-6, 4e-5)]
    {
        let file = |what: &str| folder.join(format!("s1024_{noise}_{what}.png")).display().to_string();
        let (a, b) = (file("ref"), file(case));
        place.run(&["correlate", &a, &b, "-q", "--step", "8", "--out", "p.csv"]).expect_code(0);
        let answer = place.run(&["strain", "p.csv", "--json", "-q", "--subset", "33"]).expect_code(0).json();
        // (15 − 1) · 8 + 33
        assert_eq!(answer["gauge"]["gauge_px"], 145.0);
        for (name, truth) in ["exx", "eyy", "exy"].into_iter().zip(truth) {
            let [mean, std, sigma] = ["mean", "std", "sigma"].map(|k| number(&answer[name][k]));
            eprintln!("{noise} {case} {name}: bias {:.1e}, scatter {std:.2e}, σ {sigma:.2e}", mean - truth);
            close(mean, truth, bias);
            assert!(std < scatter, "{std}");
        }
    }
}
