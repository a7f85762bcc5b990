//! `daic correlate` with a series of images, as a user runs it.

use daic_dataset::Table;
use daic_tests::program::{Run, daic, program};
use daic_tests::shared::shared;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Smooth noise from a small generator, wide enough to be moved about.
fn texture(seed: u32) -> image::GrayImage {
    let mut state = seed;
    let noise = image::GrayImage::from_fn(260, 220, |_, _| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        image::Luma([(state >> 24) as u8])
    });
    image::imageops::blur(&noise, 1.5)
}

/// A folder with a reference `r.png` and frames `f1.png` … in which all is moved by (−3k, k) pixels.
struct Place(TempDir);

impl Place {
    fn new(frames: u32) -> Self {
        let place = Self(TempDir::new().expect("folder"));
        let texture = texture(1);
        let crop = |k: u32| image::imageops::crop_imm(&texture, 20 + 3 * k, 40 - k, 160, 140).to_image();
        crop(0).save(place.path("r.png")).expect("written");
        std::fs::create_dir(place.path("f")).expect("made");
        for k in 1..=frames {
            crop(k).save(place.path(&format!("f/f{k}.png"))).expect("written");
        }
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn run(&self, arguments: &[&str]) -> Run {
        daic(self.0.path(), [&["correlate", "r.png"], arguments].concat())
    }

    fn tables(&self, out: &str) -> Vec<(String, Vec<u8>)> {
        let mut all: Vec<(String, Vec<u8>)> = std::fs::read_dir(self.path(out).join("frames"))
            .expect("frames")
            .map(|e| {
                let path = e.expect("readable").path();
                (
                    path.file_name().expect("name").to_string_lossy().into_owned(),
                    std::fs::read(path).expect("table"),
                )
            })
            .collect();
        all.sort();
        all
    }

    fn files(&self, out: &str) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(self.path(out))
            .expect("readable")
            .map(|entry| entry.expect("readable").file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }
}

fn text(run: &Run) -> String {
    let text = run.stderr.replace(['│', '×', '╭', '╰', '─'], " ");
    assert!(!text.contains("panicked"), "{text}");
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// u and v of the points that are ok, by the name of the column.
fn column(path: &Path, name: &str) -> Vec<f64> {
    let table = Table::read_csv(path).expect("a table");
    let status = table.texts("status", path).expect("status");
    let values = table.numbers(name, path).expect("numbers");
    values.into_iter().zip(status).filter(|(_, s)| s == "ok").map(|(v, _)| v).collect()
}

#[test]
fn every_update_follows_the_motion() {
    let place = Place::new(4);
    for (update, description) in [
        ("fixed", "lagrangian"),
        ("incremental", "lagrangian"),
        ("auto", "lagrangian"),
        ("incremental", "eulerian"),
    ] {
        let out = format!("{update}-{description}");
        let run = place
            .run(&["f", "--out", &out, "--reference", update, "--description", description, "--json"])
            .expect_code(0);
        let answer = run.json();
        assert_eq!((&answer["failed"], &answer["resumed"]), (&0.into(), &0.into()));
        assert_eq!(answer["sequence"]["description"], description);
        assert_eq!(place.files(&out), ["frames", "resume.bin", "sequence.json", "summary.json"]);
        for k in 1..=4 {
            let path = place.path(&out).join(format!("frames/000{k}_f{k}.csv"));
            let text = std::fs::read_to_string(&path).expect("table");
            assert!(text.starts_with("x,y,u,v,sigma_u,sigma_v,zncc,iterations,status,solver,reference\n"));
            let (u, v) = (column(&path, "u"), column(&path, "v"));
            let points = answer["frames"][k - 1]["points"].as_u64().expect("points") as usize;
            let kept = u.len() as f64 / points as f64;
            let (tu, tv) = (-3.0 * k as f64, k as f64);
            let worst = |a: &[f64], t: f64| a.iter().fold(0.0f64, |w, x| w.max((x - t).abs()));
            eprintln!("{out} {k}: {kept:.3} ok, worst u {:.1e}, v {:.1e}", worst(&u, tu), worst(&v, tv));
            // columns within 3k px of the edge have left
            assert!(kept > 0.7 && worst(&u, tu) < 1e-3 && worst(&v, tv) < 1e-3);
            let reference = column(&path, "reference");
            let expected = if update == "incremental" { k - 1 } else { 0 };
            assert!(reference.iter().all(|&r| r == expected as f64));
        }
    }
}

#[test]
fn one_unreadable_frame_is_reported_and_the_rest_processed() {
    let place = Place::new(4);
    std::fs::write(place.path("f/f2.png"), b"no image").expect("written");
    image::GrayImage::new(50, 40).save(place.path("f/f4.png")).expect("written");
    let other = image::imageops::crop_imm(&texture(5), 0, 0, 100, 100).to_image();
    other.save(place.path("f/f5.png")).expect("written");
    for update in ["fixed", "incremental"] {
        let run = place.run(&["f", "--out", update, "--reference", update, "--json"]).expect_code(1);
        let answer = run.json();
        assert_eq!(answer["failed"], 3);
        for (k, word) in [(1, "f2.png"), (3, "blank"), (4, "100×100")] {
            let reason = answer["frames"][k]["failed"].as_str().expect("a reason");
            assert!(reason.contains(word) && reason.contains(&format!("f{}.png", k + 1)), "{reason}");
            assert!(answer["frames"][k]["table"].is_null());
        }
        let u = column(&place.path(update).join("frames/0003_f3.csv"), "u");
        assert!(u.len() > 200 && u.iter().all(|u| (u + 9.0).abs() < 1e-3));
        assert_eq!(place.tables(update).len(), 2);
    }
}

#[test]
fn an_interrupted_run_resumes() {
    let place = Place::new(5);
    for update in ["fixed", "incremental", "auto"] {
        let whole = format!("whole-{update}");
        let parts = format!("parts-{update}");
        place.run(&["f", "--out", &whole, "--reference", update, "--threads", "2"]).expect_code(0);
        // a list that grows is a run that was interrupted after its first frames
        let given = ["f/f1.png", "f/f2.png", "f/f3.png", "f/f4.png", "f/f5.png"];
        for upto in [2, 3, 5, 5] {
            let arguments =
                [&given[..upto], &["--out", &parts, "--reference", update, "--json", "--threads", "1"]]
                    .concat();
            let answer = place.run(&arguments).expect_code(0).json();
            assert_eq!(answer["frames"].as_array().expect("frames").len(), upto);
        }
        let last = place.run(&[&given[..], &["--out", &parts, "--reference", update, "--json"]].concat());
        assert_eq!(last.json()["resumed"], 5);
        assert!(place.tables(&whole) == place.tables(&parts), "{update}: tables differ");
        let summary = |out: &str| std::fs::read(place.path(out).join("summary.json")).expect("summary");
        assert!(summary(&whole) == summary(&parts), "{update}: summaries differ");
    }
    // other settings
    let run =
        place.run(&["f", "--out", "whole-auto", "--reference", "auto", "--subset", "21"]).expect_code(2);
    let said = text(&run);
    for word in ["settings.subset was 33, is 21", "--overwrite"] {
        assert!(said.contains(word), "{said}");
    }
    place
        .run(&["f", "--out", "whole-auto", "--reference", "auto", "--subset", "21", "--overwrite"])
        .expect_code(0);
    // another frame, fewer frames, a lost table, a damaged state
    std::fs::copy(place.path("f/f1.png"), place.path("f/f3.png")).expect("copied");
    let refused = |out: &str, words: &[&str]| {
        let said = text(&place.run(&["f", "--out", out]).expect_code(2));
        for word in words {
            assert!(said.contains(word), "{said}");
        }
    };
    refused("whole-fixed", &["frame 3", "f3.png", "has changed"]);
    std::fs::remove_file(place.path("f/f5.png")).expect("removed");
    refused("whole-fixed", &["frame 3", "f3.png"]);
    place.run(&["f", "--out", "again"]).expect_code(0);
    std::fs::remove_file(place.path("again/frames/0002_f2.csv")).expect("removed");
    refused("again", &["frame 2", "has lost its table"]);
    std::fs::write(place.path("again/resume.bin"), b"daicseq1 and more").expect("written");
    refused("again", &["resume.bin", "damaged", "--overwrite"]);
    // a folder of somebody's
    std::fs::create_dir(place.path("mine")).expect("made");
    std::fs::write(place.path("mine/thesis.txt"), b"precious").expect("written");
    refused("mine", &["mine", "something else"]);
    let run = place.run(&["f", "--out", "mine", "--overwrite"]).expect_code(2);
    assert!(text(&run).contains("something else"));
    assert_eq!(place.files("mine"), ["thesis.txt"]);
}

#[test]
fn a_series_needs_frames_and_a_folder() {
    let place = Place::new(2);
    let refused = |arguments: &[&str], words: &[&str]| {
        let said = text(&place.run(arguments).expect_code(2));
        for word in words {
            assert!(said.contains(word), "`{word}` is not in: {said}");
        }
    };
    refused(&["f"], &["2 images", "--out FOLDER"]);
    refused(&["f/f*.bmp", "--out", "o"], &["f*.bmp", "holds no images"]);
    std::fs::create_dir(place.path("empty")).expect("made");
    refused(&["empty", "--out", "o"], &["empty", "holds no images"]);
    refused(&["f", "--out", "r.png"], &["r.png"]);
    refused(&["f", "--out", "o", "--subset", "32"], &["odd"]);
    assert!(!place.path("o").exists());
    // a pattern that no shell has expanded, in the order in which people count
    let answer = place.run(&["f/f?.png", "--out", "o", "--json"]).expect_code(0).json();
    assert_eq!(
        (&answer["frames"][0]["file"], &answer["frames"][1]["file"]),
        (&"f1.png".into(), &"f2.png".into())
    );
    // a single pair in the other description
    place.run(&["f/f1.png", "--description", "eulerian", "--out", "e.csv"]).expect_code(0);
    let u = column(&place.path("e.csv"), "u");
    assert!(u.len() > 200 && u.iter().all(|u| (u + 3.0).abs() < 1e-3));
}

/// No file may grow beyond 64 KiB, as on a disk that is full.
#[cfg(unix)]
#[test]
fn a_full_disk_is_named_and_leaves_nothing_half_written() {
    let place = Place::new(2);
    let script = "ulimit -f 64; trap '' XFSZ; exec \"$0\" correlate r.png f --out o --step 2";
    let output = std::process::Command::new("bash")
        .args(["-c", script])
        .arg(program("daic"))
        .current_dir(place.0.path())
        .output()
        .expect("bash");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("0001_f1.csv") && said.contains("cannot write"), "{said}");
    assert_eq!(place.files("o"), ["frames", "sequence.json"]);
    assert_eq!(place.tables("o").len(), 0, "nothing half-written, no temporary file");
    // with room again the same command goes on
    place.run(&["f", "--out", "o", "--step", "2"]).expect_code(0);
}

#[cfg(unix)]
#[test]
fn ctrl_c_keeps_the_finished_frames() {
    use nix::sys::signal::{Signal, kill};
    let place = Place::new(3);
    // many passes over the same frames, so that there is time to interrupt
    let frames: Vec<&str> =
        std::iter::repeat_n(["f/f1.png", "f/f2.png", "f/f3.png"], 400).flatten().collect();
    let mut child = std::process::Command::new(program("daic"))
        .args(["correlate", "r.png", "--out", "o", "--step", "2"])
        .args(&frames)
        .current_dir(place.0.path())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("daic starts");
    let waited = std::time::Instant::now();
    while !place.path("o/summary.json").exists() {
        assert!(waited.elapsed().as_secs() < 60, "no frame in a minute");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    kill(nix::unistd::Pid::from_raw(child.id() as i32), Signal::SIGINT).expect("signalled");
    let status = child.wait().expect("ends");
    assert_eq!(status.code(), Some(130));
    let done = place.tables("o");
    let summary: serde_json::Value =
        serde_json::from_slice(&std::fs::read(place.path("o/summary.json")).expect("summary")).expect("JSON");
    let counted = summary["frames"].as_array().expect("frames").len();
    eprintln!("interrupted after {counted} frames");
    assert!(counted >= 1 && counted < frames.len());
    // a table may have been finished just before its line in the summary
    assert!(done.len() == counted || done.len() == counted + 1);
    assert!(done.iter().all(|(name, _)| name.ends_with(".csv")), "no temporary files");
    // it goes on with the frames it has
    let upto = [&["--out", "o", "--step", "2", "--json"], &frames[..counted + 1]].concat();
    assert_eq!(place.run(&upto).expect_code(0).json()["resumed"], counted);
}

/// A plate with a hole under tension (2D-DIC Challenge, sample 12): eleven real frames.
#[test]
fn a_real_series() {
    let Some(folder) = shared("a_real_series", "data/dic_challenge_12") else { return };
    let out = TempDir::new().expect("folder");
    let reference = folder.join("oht_cfrp_00.tiff");
    let (reference, frames) = (reference.display().to_string(), folder.display().to_string());
    let mut last = Vec::new();
    for update in ["fixed", "incremental", "auto"] {
        let arguments =
            ["correlate", &reference, &frames, "--roi", "60,60,270,400", "--step", "10", "--json"];
        let run = daic(out.path(), [&arguments[..], &["--out", update, "--reference", update]].concat());
        let answer = run.expect_code(0).json();
        let entries = answer["frames"].as_array().expect("frames");
        assert_eq!(entries.len(), 11, "the reference itself is no frame of the folder");
        assert_eq!(entries[10]["file"], "oht_cfrp_11.tiff");
        for entry in entries {
            let part =
                entry["converged"].as_f64().expect("number") / entry["points"].as_f64().expect("number");
            eprintln!("{update} {}: {part:.4} ok, reference {}", entry["file"], entry["reference"]);
            assert!(part > 0.98, "{entry}");
        }
        let path = out.path().join(update).join("frames/0011_oht_cfrp_11.csv");
        let table = Table::read_csv(&path).expect("table");
        let status = table.texts("status", &path).expect("status");
        let [u, v, s] = ["u", "v", "sigma_v"].map(|n| table.numbers(n, &path).expect("numbers"));
        last.push((u, v, status, s));
    }
    // The ways must lead to the same place. Found: 0.029 px in u (0.0055 of it scatter, the rest an
    // offset that grows by 0.003 px with every reference) and 0.010 px in v
    let (a, b) = (&last[0], &last[1]);
    let mut squares = [0.0; 4];
    let mut count = 0.0;
    for k in 0..a.0.len() {
        if a.2[k] == "ok" && b.2[k] == "ok" {
            count += 1.0;
            for (s, d) in squares.iter_mut().zip([a.0[k] - b.0[k], a.1[k] - b.1[k], a.3[k], b.3[k]]) {
                *s += d * d;
            }
        }
    }
    let [du, dv, fixed, incremental] = squares.map(|s: f64| (s / count).sqrt());
    eprintln!(
        "fixed and incremental differ by {du:.4}, {dv:.4} px RMS; σ {fixed:.4} and {incremental:.4} px"
    );
    assert!(count > 900.0 && du < 0.033 && dv < 0.012, "{count} points, {du} {dv}");
}
