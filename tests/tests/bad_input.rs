//! Bad input: a clear one-paragraph error with the way out, exit code 2, nothing half-written.

use daic_tests::program::{Run, daic};
use daic_tests::shared::root;
use std::path::Path;
use tempfile::TempDir;

/// A speckle-like image: noise from a small generator.
fn speckles(path: &Path, width: u32, height: u32, seed: u32) {
    let mut state = seed;
    let image = image::GrayImage::from_fn(width, height, |_, _| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        image::Luma([(state >> 24) as u8])
    });
    image.save(path).expect("written");
}

struct Place(TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(TempDir::new().expect("folder"));
        speckles(&place.path("a.png"), 120, 100, 1);
        speckles(&place.path("b.png"), 120, 100, 2);
        place
    }

    fn path(&self, name: &str) -> std::path::PathBuf {
        self.0.path().join(name)
    }

    fn files(&self) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(self.0.path())
            .expect("readable")
            .map(|entry| entry.expect("readable").file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }

    /// Runs, expects exit code 2, every one of `words` in the message, and no new file.
    #[track_caller]
    fn refused(&self, arguments: &[&str], words: &[&str]) -> Run {
        let before = self.files();
        let run = daic(self.0.path(), arguments).expect_code(2);
        assert_eq!(run.stdout, "", "an error belongs on stderr");
        // the drawing wraps and indents; words are looked for in the text as it reads
        let text = run.stderr.replace(['│', '×', '╭', '╰', '─'], " ");
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
        for word in words {
            assert!(text.contains(word), "`{word}` is not in:\n{text}");
        }
        assert!(!text.contains("panicked"), "{text}");
        assert_eq!(self.files(), before, "nothing half-written");
        run
    }
}

#[test]
fn image_files() {
    let place = Place::new();
    place.refused(&["correlate", "absent.png", "b.png"], &["absent.png", "does not exist"]);
    std::fs::write(place.path("empty.png"), b"").expect("written");
    place.refused(&["correlate", "a.png", "empty.png"], &["empty.png", "empty"]);
    std::fs::write(place.path("text.tif"), b"this is no image").expect("written");
    place.refused(&["correlate", "text.tif", "b.png"], &["text.tif"]);
    let whole = std::fs::read(place.path("a.png")).expect("readable");
    std::fs::write(place.path("cut.png"), &whole[..whole.len() / 2]).expect("written");
    place.refused(&["correlate", "cut.png", "b.png"], &["cut.png", "truncated"]);
    speckles(&place.path("small.png"), 119, 100, 3);
    place.refused(&["correlate", "a.png", "small.png"], &["small.png", "119", "120", "same size"]);
    image::GrayImage::from_pixel(120, 100, image::Luma([77])).save(place.path("blank.png")).expect("written");
    place.refused(&["correlate", "a.png", "blank.png"], &["blank.png", "blank", "77"]);
    place.refused(&["correlate", "a.png", "."], &["."]);
}

#[test]
fn correlation_settings() {
    let place = Place::new();
    let with = |more: &[&'static str]| [&["correlate", "a.png", "b.png"], more].concat();
    place.refused(
        &with(&["--roi", "100,0,40,40"]),
        &["region of interest", "100,0,40,40", "120×100".replace('×', " ").as_str()],
    );
    place.refused(&with(&["--roi", "-1,0,40,40"]), &["region of interest"]);
    place.refused(&with(&["--roi", "1,2,3"]), &["1,2,3", "X,Y,WIDTH,HEIGHT"]);
    place.refused(&with(&["--subset", "201"]), &["201", "does not fit"]);
    place.refused(&with(&["--subset", "32"]), &["odd", "32"]);
    place.refused(&with(&["--step", "0"]), &["step", "at least one"]);
    place.refused(&with(&["--out", "points.xls"]), &["points.xls", ".csv"]);
    place.refused(&with(&["--out", "no/such/folder/../points.csv", "--subset", "3"]), &["subset"]);
}

#[test]
fn demo_arguments() {
    let place = Place::new();
    place.refused(&["demo", "--move", "0.1,0.2"], &["0.1,0.2", "X,Y,Z"]);
    place.refused(&["demo", "--move", "0,0,99"], &["99", "-2 to 2"]);
    place.refused(&["demo", "--move", "0,NaN,0"], &["NaN"]);
}

/// The template with one change.
fn experiment(place: &Place, from: &str, to: &str) -> String {
    daic(place.0.path(), ["init", "made.toml", "--force"]).expect_code(0);
    let text = std::fs::read_to_string(place.path("made.toml")).expect("a template");
    assert!(text.contains(from), "the template has no `{from}`");
    std::fs::write(place.path("made.toml"), text.replacen(from, to, 1)).expect("written");
    "made.toml".to_owned()
}

#[test]
fn experiment_files() {
    let place = Place::new();
    let cases: [(&str, &str, &[&str]); 7] = [
        ("seed = 1", "sede = 1", &["sede", "made.toml:8:1"]),
        ("wavelength = \"633 nm\"", "wavelength = \"633 s\"", &["633 s", "nm"]),
        ("wavelength = \"633 nm\"", "wavelength = 633", &["unit"]),
        (
            "pinhole_to_grating = \"307 mm\"",
            "pinhole_to_grating = \"-307 mm\"",
            &["pinhole_to_grating", "-307"],
        ),
        ("lines = \"300 /mm\"", "lines = \"3000 /mm\"", &["grating", "wavelength"]),
        ("subset = ", "subset = 2", &["subset"]),
        ("exposure = \"5 ms\"", "exposure = \"1 ms\"", &["strobe"]),
    ];
    for (from, to, words) in cases {
        let file = experiment(&place, from, to);
        place.refused(&["simulate", &file, "--out", "dataset"], words);
    }
    place.refused(&["simulate", "absent.toml", "--out", "dataset"], &["absent.toml"]);
    std::fs::write(place.path("binary.toml"), [0xff, 0xfe, 0x00, 0x80]).expect("written");
    place.refused(&["simulate", "binary.toml", "--out", "dataset"], &["binary.toml", "UTF-8"]);
}

#[test]
fn optics_files() {
    let place = Place::new();
    let good = std::fs::read_to_string(root().join("examples/golden-macro.toml")).expect("the example");
    let cases: [(&str, &str, &[&str]); 4] = [
        ("[optics]", "[optics]\nfoo = 1", &["foo", "bad.toml"]),
        ("307 mm", "307 kg", &["307 kg", "mm"]),
        ("307 mm", "-307 mm", &["pinhole_to_grating"]),
        ("300 /mm", "1600 /mm", &["wavelength"]),
    ];
    for (from, to, words) in cases {
        assert!(good.contains(from), "{from}");
        std::fs::write(place.path("bad.toml"), good.replacen(from, to, 1)).expect("written");
        place.refused(&["profile", "--optics", "bad.toml", "a.png", "--out", "out"], words);
        place.refused(&["displacement", "--optics", "bad.toml", "a.png", "b.png", "--out", "out"], words);
    }
    // noise over the whole frame is not two views
    std::fs::write(place.path("good.toml"), &good).expect("written");
    place.refused(&["profile", "--optics", "good.toml", "a.png", "--out", "out"], &["views"]);
}

#[test]
fn datasets() {
    let place = Place::new();
    place.refused(&["process", "absent"], &["absent", "not a dataset"]);
    std::fs::create_dir(place.path("other")).expect("made");
    std::fs::write(place.path("other/dataset.json"), b"{\"format\":\"something\"}").expect("written");
    place.refused(&["process", "other"], &["not a dataset"]);
    std::fs::write(place.path("other/dataset.json"), b"{\"format\":\"daic-dataset\",\"format_version\":99}")
        .expect("written");
    place.refused(&["process", "other"], &["99", "newer"]);
}

/// A recorded dataset of somebody's is not overwritten by the demo, nor a folder that only looks like one.
#[test]
fn the_demo_replaces_demos_only() {
    let place = Place::new();
    for manifest in [
        "{\"format\":\"daic-dataset\",\"format_version\":1,\"program\":\"daic\",\"program_version\":\"0\"}",
        "{broken",
    ] {
        std::fs::create_dir_all(place.path("mine/results")).expect("made");
        std::fs::write(place.path("mine/dataset.json"), manifest).expect("written");
        std::fs::write(place.path("mine/results/thesis.txt"), b"precious").expect("written");
        place.refused(&["demo", "--out", "mine"], &["mine"]);
        assert_eq!(std::fs::read(place.path("mine/results/thesis.txt")).expect("kept"), b"precious");
    }
}

#[test]
fn usage_errors_are_one_json_object_too() {
    let place = Place::new();
    for arguments in [
        &["correlate", "--json"][..],
        &["demo", "--json", "--move", "1,2"],
        &["doctor", "--json", "--threads", "100000"],
    ] {
        let run = daic(place.0.path(), arguments).expect_code(2);
        assert_eq!(run.json()["exit_code"], 2, "{arguments:?}");
    }
}

/// Frames that show nothing in common: no files, and the reasons counted.
#[test]
fn frames_without_a_match() {
    let test = "frames_without_a_match";
    let Some(flat) = daic_tests::shared::shared(test, "golden/daic/flat.png") else { return };
    let place = Place::new();
    let frame = image::open(&flat).expect("an image").to_luma8();
    let (width, height) = frame.dimensions();
    let mut exchanged = frame.clone();
    for (x, y, pixel) in exchanged.enumerate_pixels_mut() {
        *pixel = *frame.get_pixel((x + width / 2) % width, y.min(height - 1));
    }
    exchanged.save(place.path("exchanged.png")).expect("written");
    let optics = root().join("examples/golden-macro.toml").display().to_string();
    let flat = flat.display().to_string();
    place.refused(
        &["displacement", "--optics", &optics, &flat, "exchanged.png", "--out", "out"],
        &["no point", "gap"],
    );
}

#[test]
fn existing_files_are_kept() {
    let place = Place::new();
    std::fs::write(place.path("mine.toml"), b"precious").expect("written");
    place.refused(&["init", "mine.toml"], &["mine.toml", "exists", "--force"]);
    assert_eq!(std::fs::read(place.path("mine.toml")).expect("readable"), b"precious");
    // a folder with other files in it is not taken for a dataset
    let file = experiment(&place, "seed = 1", "seed = 1");
    std::fs::create_dir(place.path("full")).expect("made");
    std::fs::write(place.path("full/thesis.txt"), b"precious").expect("written");
    place.refused(&["simulate", &file, "--out", "full"], &["full", "not empty"]);
    assert_eq!(std::fs::read_dir(place.path("full")).expect("readable").count(), 1);
}

#[test]
fn errors_are_one_json_object_too() {
    let place = Place::new();
    let run = daic(place.0.path(), ["correlate", "absent.png", "b.png", "--json"]).expect_code(2);
    let answer = run.json();
    assert_eq!(answer["exit_code"], 2);
    assert!(answer["error"].as_str().expect("text").contains("absent.png"));
}
