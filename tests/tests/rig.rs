//! Two programs on one serial line: `hil-sim` as the box and camera, `daic` as the host.

use daic_dataset::{Dataset, Verdict};
use daic_tests::program::{Run, daic, program};
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use tempfile::TempDir;

/// A running `hil-sim`; ended when dropped.
struct Box {
    child: Child,
    port: String,
}

impl Box {
    fn start(folder: &Path, arguments: &[&str]) -> Self {
        let mut child = Command::new(program("hil-sim"))
            .args(arguments)
            .current_dir(folder)
            .stdout(Stdio::piped())
            .spawn()
            .expect("hil-sim starts");
        let mut line = String::new();
        BufReader::new(child.stdout.as_mut().expect("piped")).read_line(&mut line).expect("a line");
        let port = line.strip_prefix("port: ").unwrap_or_else(|| panic!("`{line}` names no port")).trim();
        Self { port: port.to_owned(), child }
    }
}

impl Drop for Box {
    fn drop(&mut self) {
        self.child.kill().expect("running");
        self.child.wait().expect("ends");
    }
}

/// A small sensor and specimen, so that the tests are quick; the same optics as the template.
const SCENE: &str = "
seed = 5
[scene.specimen]
half_width_mm = 7.5
half_height_mm = 7.5
surface = { kind = \"plane\" }
[camera]
exposure_ns = 5000000
trigger_delay_ns = 0
[light]
led_electrons_per_s = [4.0e7, 4.0e7]
";

fn experiment(folder: &Path) {
    daic(folder, ["init", "experiment.toml"]).expect_code(0);
}

#[test]
fn a_run_over_a_serial_line_is_recorded_and_measured() {
    let folder = TempDir::new().expect("folder");
    experiment(folder.path());
    // the plane stands at h = 0
    let text = std::fs::read_to_string(folder.path().join("experiment.toml")).expect("written");
    assert!(text.contains("axis_height = \"1 mm\""));
    std::fs::write(
        folder.path().join("experiment.toml"),
        text.replace("axis_height = \"1 mm\"", "axis_height = \"0 mm\""),
    )
    .expect("written");
    std::fs::write(folder.path().join("scene.toml"), SCENE).expect("written");
    let sim = Box::start(folder.path(), &["--pty", "--scene", "scene.toml", "--frames", "camera"]);
    let doctor = daic(folder.path(), ["doctor", "--json", "--port", &sim.port]).expect_code(0).json();
    assert_eq!(doctor["board"]["tick_hz"], 125_000_000);
    let arguments = [
        "run",
        "experiment.toml",
        "--quiet",
        "--json",
        "--port",
        &sim.port,
        "--frames",
        "camera",
        "--out",
        "data",
    ];
    let answer = daic(folder.path(), arguments).expect_code(0).json();
    assert_eq!(answer["frames"]["paired"], 7, "{answer}");
    assert_eq!(answer["frames"]["missing"], 0);
    let summary = daic(folder.path(), ["process", "data", "--quiet", "--json"]).expect_code(0).json();
    for (i, limit) in [1.0, 1.0, 2.0].into_iter().enumerate() {
        let rms = summary["rms_um"][i].as_f64().expect("a number");
        assert!(rms <= limit, "component {i}: {rms} µm");
    }
    // nobody recorded the edges of this box: the summary must not claim to have compared them
    assert!(summary["edge_error_ticks_max"].is_null());
}

#[test]
fn lost_and_doubled_frames_are_told() {
    let folder = TempDir::new().expect("folder");
    experiment(folder.path());
    let scene = format!("{SCENE}\n[faults]\ndrop_frames = [2]\nduplicate_frames = [4]\n");
    std::fs::write(folder.path().join("scene.toml"), scene).expect("written");
    let arguments =
        ["simulate", "experiment.toml", "--scene", "scene.toml", "--quiet", "--json", "--out", "data"];
    let answer = daic(folder.path(), arguments).expect_code(0).json();
    assert_eq!(answer["frames"]["paired"], 6, "{answer}");
    assert_eq!(answer["frames"]["missing"], 1, "{answer}");
    assert_eq!(
        answer["frames"]["extra"].as_u64().expect("n") + answer["frames"]["ambiguous"].as_u64().expect("n"),
        1
    );
    let records =
        Dataset::open(&folder.path().join("data")).expect("dataset").frames().expect("frames").records;
    let missing: Vec<_> = records.iter().filter(|f| f.verdict == Verdict::Missing).collect();
    // the third trigger of the template
    assert_eq!(missing.len(), 1);
    assert_eq!(missing[0].name, "cal_z_minus");
}

#[track_caller]
fn rig_error(run: Run, words: &[&str]) {
    let run = run.expect_code(3);
    let text = run.stderr.replace(['│', '×'], " ").split_whitespace().collect::<Vec<_>>().join(" ");
    for word in words {
        assert!(text.contains(word), "`{word}` is not in:\n{text}");
    }
    assert!(!text.contains("panicked"), "{text}");
}

#[test]
fn an_absent_port() {
    let folder = TempDir::new().expect("folder");
    rig_error(daic(folder.path(), ["doctor", "--port", "/dev/no-such-port"]), &["/dev/no-such-port"]);
}

#[test]
fn a_port_that_is_not_ours() {
    let folder = TempDir::new().expect("folder");
    // a line at which nobody answers
    let pty = nix::pty::openpty(None, None).expect("a pseudo-terminal");
    let name = nix::unistd::ttyname(&pty.slave).expect("a name").display().to_string();
    rig_error(daic(folder.path(), ["doctor", "--port", &name]), &[&name]);
}

#[test]
fn a_busy_port() {
    let folder = TempDir::new().expect("folder");
    let pty = nix::pty::openpty(None, None).expect("a pseudo-terminal");
    let name = nix::unistd::ttyname(&pty.slave).expect("a name").display().to_string();
    let held = daic_rig::link::open(&name, 115_200).expect("opens once");
    rig_error(daic(folder.path(), ["doctor", "--port", &name]), &[&name, "another program"]);
    drop(held);
}

#[test]
fn a_box_that_resets_or_falls_silent_in_the_middle() {
    for (fault, words) in
        [("reset_after_requests = 9", &["reset"][..]), ("silent_after_requests = 9", &["answer"][..])]
    {
        let folder = TempDir::new().expect("folder");
        experiment(folder.path());
        std::fs::write(folder.path().join("scene.toml"), format!("{SCENE}\n[faults]\n{fault}\n"))
            .expect("written");
        let arguments = ["simulate", "experiment.toml", "--scene", "scene.toml", "--quiet", "--out", "data"];
        rig_error(daic(folder.path(), arguments), words);
        // what was recorded until then is a dataset that reads
        if folder.path().join("data").exists() {
            Dataset::open(&folder.path().join("data")).expect("a dataset").frames().expect("readable");
        }
    }
}

/// More frames than the box keeps events for: none may be lost, whoever runs the clock.
#[test]
fn a_long_series_loses_no_event() {
    let folder = TempDir::new().expect("folder");
    experiment(folder.path());
    let text = std::fs::read_to_string(folder.path().join("experiment.toml")).expect("written");
    let sequence = text.find("[[sequence]]").expect("a sequence");
    let series = "[[sequence]]\nrepeat = { times = 90, steps = [{ settle = \"1 ms\" }, { frame = { name = \"run\", role = \"series\" } }] }\n";
    let small =
        text[..sequence].replace("width = 2592", "width = 324").replace("height = 1944", "height = 243");
    std::fs::write(folder.path().join("experiment.toml"), small + series).expect("written");
    let arguments = ["simulate", "experiment.toml", "--quiet", "--json", "--out", "data"];
    let answer = daic(folder.path(), arguments).expect_code(0).json();
    assert_eq!(answer["frames"]["paired"], 90, "{answer}");
}

/// A recording that never came to its verdicts is judged when it is processed.
#[test]
fn an_interrupted_recording_can_be_measured() {
    let folder = TempDir::new().expect("folder");
    experiment(folder.path());
    let arguments = ["simulate", "experiment.toml", "--quiet", "--json", "--out", "data"];
    daic(folder.path(), arguments).expect_code(0);
    let whole = daic(folder.path(), ["process", "data", "--quiet", "--json"]).expect_code(0).json();
    // the journal as it was before the run ended: the first line of every frame, and the last one torn
    let path = folder.path().join("data/frames.jsonl");
    let text = std::fs::read_to_string(&path).expect("a journal");
    let pending: Vec<&str> = text.lines().filter(|line| line.contains("\"pending\"")).collect();
    assert_eq!(pending.len(), 7, "{text}");
    std::fs::write(&path, pending.join("\n") + "\n{\"id\":7,\"na").expect("written");
    let summary =
        daic(folder.path(), ["process", "data", "--quiet", "--json", "--fresh"]).expect_code(0).json();
    for key in ["frames", "commanded_um", "measured_um", "rms_um", "calibration"] {
        assert_eq!(summary[key], whole[key], "{key}");
    }
    assert_eq!(summary["damage"].as_array().expect("a list").len(), 1, "the torn line is told");
}

#[test]
fn trigger_to_exposure_is_measured_and_corrected() {
    let folder = TempDir::new().expect("folder");
    experiment(folder.path());
    // 340 µs from trigger to exposure, of which the experiment knows nothing
    let scene = SCENE.replace("trigger_delay_ns = 0", "trigger_delay_ns = 340000")
        + "[board]\nexposure_active = true\nleds = [{}, {}]\naxes = [{}, {}, {}]\n";
    std::fs::write(folder.path().join("scene.toml"), scene).expect("written");
    let sim = Box::start(folder.path(), &["--pty", "--scene", "scene.toml"]);
    let arguments = ["rig", "calibrate-exposure", "experiment.toml", "--triggers", "20", "--json", "--port"];
    let found = daic(folder.path(), arguments.into_iter().chain([sim.port.as_str()])).expect_code(0).json();
    drop(sim);
    let number = |value: &serde_json::Value| value.as_f64().unwrap_or_else(|| panic!("{found}"));
    assert_eq!(number(&found["exposures"]), 20.0);
    assert!((number(&found["delay_us"]["mean"]) - 340.0).abs() < 0.0081, "{found}");
    assert!((number(&found["length_us"]["mean"]) - 5000.0).abs() < 0.0081, "{found}");
    assert_eq!(number(&found["stated_delay_us"]), 0.0);
    // a run notes when each frame was exposed, and says that a strobe came too early for its exposure
    let path = folder.path().join("experiment.toml");
    let text =
        std::fs::read_to_string(&path).expect("written").replace("delay = \"1 ms\"", "delay = \"0.2 ms\"");
    std::fs::write(&path, text).expect("written");
    let sim = Box::start(folder.path(), &["--pty", "--scene", "scene.toml", "--frames", "camera"]);
    let arguments =
        ["run", "experiment.toml", "--quiet", "--port", &sim.port, "--frames", "camera", "--out", "data"];
    daic(folder.path(), arguments).expect_code(0);
    let frames =
        Dataset::open(&folder.path().join("data")).expect("dataset").frames().expect("frames").records;
    let paired: Vec<_> = frames.iter().filter(|f| f.verdict == Verdict::Paired).collect();
    assert_eq!(paired.len(), 7);
    for frame in paired {
        let delay = frame.exposure_tick.zip(frame.trigger_tick).map(|(e, t)| e - t);
        // 340 µs are 42 500 ticks
        assert_eq!(delay, Some(42_500), "{frame:?}");
        assert!(frame.note.contains("340.000 to 5340.000 µs"), "{}", frame.note);
    }
}

#[test]
fn loops_are_streamed_as_if_they_were_stored() {
    let folder = TempDir::new().expect("folder");
    let program = r#"[
        {"LoopBegin": {"count": 2000}},
        {"Edge": {"mask": 4096, "value": 4096, "after": 30000}},
        {"LoopBegin": {"count": 2}},
        {"Edge": {"mask": 8192, "value": 8192, "after": 10000}},
        {"Edge": {"mask": 8192, "value": 0, "after": 1000}},
        "LoopEnd",
        {"Edge": {"mask": 4096, "value": 0, "after": 500}},
        "LoopEnd"
    ]"#;
    std::fs::write(folder.path().join("program.json"), program).expect("written");
    let sim = Box::start(folder.path(), &["--pty"]);
    let stream = ["rig", "stream", "program.json", "--json", "--port", &sim.port];
    let answer = daic(folder.path(), stream).expect_code(0).json();
    assert_eq!(answer["instructions"], 12_000);
    // begin, 12 000 edges, the smallest lead, end
    assert_eq!(answer["events"], 12_003, "{answer}");
    assert!(answer["min_lead_ms"].as_f64().is_some_and(|lead| lead > 0.0), "{answer}");
}
