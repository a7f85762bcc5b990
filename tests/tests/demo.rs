//! The demo as a user runs it: a commanded move comes back as a measured one.

use daic_dataset::{Dataset, FrameRole, Table, Verdict};
use daic_tests::expansion;
use daic_tests::program::{Run, daic};
use serde_json::Value;
use std::path::Path;
use std::sync::OnceLock;
use tempfile::TempDir;

struct Demo {
    folder: TempDir,
    run: Run,
}

fn demo(arguments: &[&str]) -> Demo {
    let folder = TempDir::new().expect("a folder for the demo");
    let out = folder.path().join("demo");
    let mut all = vec!["demo", "--json", "--quiet", "--out", out.to_str().expect("UTF-8")];
    all.extend(arguments);
    let run = daic(folder.path(), all);
    Demo { folder, run }
}

impl Demo {
    fn dataset(&self) -> Dataset {
        Dataset::open(&self.folder.path().join("demo")).expect("the demo wrote a dataset")
    }
}

/// The default demo, run once for several tests.
fn default_demo() -> &'static Demo {
    static DEMO: OnceLock<Demo> = OnceLock::new();
    DEMO.get_or_init(|| demo(&[]))
}

fn triple(value: &Value) -> [f64; 3] {
    let list = value.as_array().unwrap_or_else(|| panic!("{value} is no list"));
    std::array::from_fn(|i| list[i].as_f64().expect("a number"))
}

/// The limits of the specification: 1 µm in-plane, 2 µm out of plane, RMS over the field.
#[track_caller]
fn assert_measured(summary: &Value, commanded_mm: [f64; 3]) {
    let commanded = triple(&summary["commanded_um"]);
    let rms = triple(&summary["rms_um"]);
    eprintln!(
        "commanded {commanded:?} µm, measured {} µm, rms {rms:?} µm, profile {} µm, {} s",
        summary["measured_um"], summary["profile_rms_um"], summary["wall_s"]
    );
    for i in 0..3 {
        // a stage stands on whole steps of 1/6400 mm
        assert!((commanded[i] - 1e3 * commanded_mm[i]).abs() <= 0.5e3 / 6400.0 + 1e-9);
        assert!(rms[i] <= [1.0, 1.0, 2.0][i], "component {i}: {} µm", rms[i]);
    }
    let frames = &summary["frames"];
    assert_eq!(frames["paired"], 7, "{frames}");
    for other in ["missing", "extra", "ambiguous"] {
        assert_eq!(frames[other], 0, "{frames}");
    }
    assert_eq!(summary["edge_error_ticks_max"], 0);
    assert_eq!(summary["passed"], true);
}

#[test]
fn the_default_move_comes_back() {
    let demo = default_demo();
    assert_eq!(demo.run.code, Some(0), "{}", demo.run.stderr);
    assert_measured(&demo.run.json(), [0.050, -0.030, 0.200]);
}

#[test]
fn other_seeds_and_moves_come_back() {
    let cases = [("2", [-0.1, 0.05, -0.35]), ("31", [0.2, 0.2, 1.0]), ("444", [0.0, -0.25, 0.01])];
    for (seed, [x, y, z]) in cases {
        let demo = demo(&["--seed", seed, "--move", &format!("{x},{y},{z}")]);
        assert_eq!(demo.run.code, Some(0), "seed {seed}: {}\n{}", demo.run.stdout, demo.run.stderr);
        assert_measured(&demo.run.json(), [x, y, z]);
    }
}

/// With the pitch 0.1 % wrong and no calibration to take it up, heights are off by 0.1 % of the distance to
/// the grating, z, enlarged by 1 + z/(s cos³θ): from z = u s/(2 F t − u/cos³θ) that is 149.8 µm at z = 109 mm,
/// 1.7 µm less at the top of the specimen. The check must see it.
#[test]
fn a_wrong_pitch_is_caught() {
    let wrong = demo(&["--no-calibration", "--pitch-factor", "1.001"]);
    assert_eq!(wrong.run.code, Some(1), "{}\n{}", wrong.run.stdout, wrong.run.stderr);
    let summary = wrong.run.json();
    assert_eq!(summary["passed"], false);
    let error = summary["profile_rms_um"].as_f64().expect("a number");
    assert!((147.0..151.0).contains(&error), "{error} µm");

    let right = demo(&["--no-calibration"]);
    assert_eq!(right.run.code, Some(0), "{}\n{}", right.run.stdout, right.run.stderr);
}

#[test]
fn played_edges_are_those_of_an_independent_expansion() {
    let dataset = default_demo().dataset();
    let text = dataset.manifest().extra["program"].as_str().expect("the program as text").to_owned();
    let bytes: Vec<u8> =
        (0..text.len()).step_by(2).map(|i| u8::from_str_radix(&text[i..i + 2], 16).expect("hex")).collect();
    let program: Vec<_> =
        daic_protocol::program::decode(&bytes).map(|(_, i)| i.expect("an instruction")).collect();
    let events = dataset.events().expect("events").records;
    let begin = events.iter().find(|e| e.kind == "RunStarted").expect("a run").tick;
    let played: Vec<(u64, u32)> = dataset
        .edges()
        .expect("readable")
        .expect("recorded")
        .into_iter()
        .filter(|e| e.0 >= begin)
        .map(|(tick, word)| (tick - begin, word))
        .collect();
    let played = expansion::changes_only(&played);
    let mut expected = expansion::expand(&program);
    eprintln!("{} edges", expected.len());
    // the default sequence moves 9.8 mm in all, at 6400 steps/mm and two edges per step
    assert!(expected.len() > 100_000, "{}", expected.len());
    assert!(expected == played, "first difference: {:?}", expected.iter().zip(&played).find(|(a, b)| a != b));
    // and one tick would be seen
    let middle = expected.len() / 2;
    expected[middle].0 += 1;
    assert!(expected != played);
}

#[test]
fn every_strobe_lies_inside_its_exposure() {
    let dataset = default_demo().dataset();
    let paired: Vec<_> = dataset
        .frames()
        .expect("frames")
        .records
        .into_iter()
        .filter(|f| f.verdict == Verdict::Paired)
        .collect();
    assert_eq!(paired.len(), 7);
    for frame in &paired {
        let [strobe] = &frame.strobes[..] else { panic!("{}: {} strobes", frame.name, frame.strobes.len()) };
        let trigger = frame.trigger_tick.expect("paired");
        // template.toml: 1 ms after the trigger, 200 µs long, exposure 5 ms
        assert_eq!((strobe.on_tick - trigger, strobe.off_tick - strobe.on_tick), (125_000, 25_000));
    }
}

/// What the summary says must follow from the dataset alone: its tables, frames and events.
#[test]
fn the_summary_follows_from_the_dataset() {
    let demo = default_demo();
    let summary = demo.run.json();
    let dataset = demo.dataset();
    assert_eq!(
        dataset.summary::<Value>().expect("readable"),
        Some(summary.clone()),
        "summary.json is the answer"
    );

    let frames = dataset.frames().expect("frames").records;
    let of = |role| frames.iter().find(|f| f.role == role).expect("such a frame");
    let (reference, moved) = (of(FrameRole::Reference), of(FrameRole::Measurement));
    let (from, to) = (reference.commanded_um.expect("known"), moved.commanded_um.expect("known"));
    let commanded: [f64; 3] = std::array::from_fn(|i| to[i] - from[i]);
    assert_eq!(triple(&summary["commanded_um"]), commanded);

    let path = dataset.frame_results(moved.id).join("points.csv");
    let table = Table::read_csv(&path).expect("points");
    let status = table.texts("status", &path).expect("status");
    for (i, name) in ["u_mm", "v_mm", "w_mm"].into_iter().enumerate() {
        let values = table.numbers(name, &path).expect("numbers");
        let ok: Vec<f64> =
            values.iter().zip(&status).filter(|(_, s)| *s == "ok").map(|(v, _)| 1e3 * v).collect();
        let n = ok.len() as f64;
        let mean = ok.iter().sum::<f64>() / n;
        let rms = (ok.iter().map(|v| (v - commanded[i]).powi(2)).sum::<f64>() / n).sqrt();
        // the table holds numbers that read back exactly; only the order of summation could differ
        assert!((mean - triple(&summary["measured_um"])[i]).abs() < 1e-9, "{name}");
        assert!((rms - triple(&summary["rms_um"])[i]).abs() < 1e-9, "{name}");
    }

    let path = dataset.frame_results(reference.id).join("points.csv");
    let table = Table::read_csv(&path).expect("points");
    let [x, y, h] = ["x_mm", "y_mm", "h_mm"].map(|name| table.numbers(name, &path).expect("numbers"));
    let status = table.texts("status", &path).expect("status");
    let errors: Vec<f64> = (0..status.len())
        .filter(|&k| status[k] == "ok")
        // the demo's specimen: a sphere of 40 mm, its top 1 mm above the reference plane
        .map(|k| 1e3 * (h[k] - ((1600.0 - x[k].powi(2) - y[k].powi(2)).sqrt() - 39.0)))
        .collect();
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    assert!((rms - summary["profile_rms_um"].as_f64().expect("a number")).abs() < 1e-9);
}

fn without_wall_time(mut summary: Value) -> Value {
    summary.as_object_mut().expect("an object").remove("wall_s").expect("was there");
    summary
}

#[test]
fn the_same_seed_gives_the_same_numbers_with_one_thread() {
    let two = default_demo();
    let one = demo(&["--threads", "1"]);
    assert_eq!(without_wall_time(one.run.json()), without_wall_time(two.run.json()));
    let points = |demo: &Demo| {
        let dataset = demo.dataset();
        let id = dataset.frames().expect("frames").records.iter().map(|f| f.id).max().expect("frames");
        std::fs::read(dataset.frame_results(id).join("points.csv")).expect("points")
    };
    assert!(points(&one) == points(two), "points.csv differs");
}

/// Processing again finds everything done; with a result removed it does only that.
#[test]
fn processing_takes_up_where_it_was_interrupted() {
    let demo = default_demo();
    let folder = TempDir::new().expect("folder");
    let copy = folder.path().join("copy");
    copy_all(&demo.folder.path().join("demo"), &copy);
    let before = daic(folder.path(), ["process", "copy", "--json", "--quiet"]).expect_code(0);
    let dataset = Dataset::open(&copy).expect("a dataset");
    let moved = dataset.frames().expect("frames").records;
    let moved = moved.iter().find(|f| f.role == FrameRole::Measurement).expect("such a frame");
    let table = dataset.frame_results(moved.id).join("points.csv");
    let kept = std::fs::read(&table).expect("points");
    std::fs::remove_dir_all(dataset.frame_results(moved.id)).expect("removable");
    let after = daic(folder.path(), ["process", "copy", "--quiet"]).expect_code(0);
    assert!(after.stdout.contains("2 results were there already"), "{}", after.stdout);
    assert!(std::fs::read(&table).expect("points again") == kept);
    let again = daic(folder.path(), ["process", "copy", "--json", "--quiet"]).expect_code(0);
    assert_eq!(again.json(), before.json());
}

fn copy_all(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("folder");
    for entry in std::fs::read_dir(from).expect("readable") {
        let entry = entry.expect("readable");
        let target = to.join(entry.file_name());
        if entry.file_type().expect("known").is_dir() {
            copy_all(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).expect("copied");
        }
    }
}

#[test]
fn the_report_needs_nothing_else() {
    let page = std::fs::read_to_string(default_demo().dataset().report_path()).expect("a report");
    for outside in ["src=\"http", "href=\"http", "url(http", "@import"] {
        assert!(!page.contains(outside), "{outside}");
    }
    for part in ["Displacement u", "Displacement w", "Height", "Surface", "Timing", "Calibration", "+1 view"]
    {
        assert!(page.contains(part), "{part} is missing");
    }
}
