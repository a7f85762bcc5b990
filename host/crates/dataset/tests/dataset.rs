//! Dataset folders: recording, crashes, refusals, results.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use daic_dataset::{
    Damage, Dataset, DatasetError, EventRecord, Existing, FrameRecord, FrameRole, GreyImage, Manifest,
    StrobeRecord, Verdict, result_key,
};

fn image(seed: u16) -> GreyImage {
    let data = (0..12 * 7).map(|i| (i * 31 + seed) & 0xfff).collect();
    GreyImage { width: 12, height: 7, container_bits: 16, significant_bits: 12, data }
}

fn frame(id: u64) -> FrameRecord {
    FrameRecord {
        verdict: Verdict::Paired,
        camera_frame: Some(id + 7),
        camera_ns: Some(-5),
        time_error_ns: Some(0.1 + 0.2),
        commanded_um: Some([50.0, -30.0, 0.1]),
        trigger_tick: Some(u64::MAX),
        exposure_ns: Some(500_000),
        strobes: vec![StrobeRecord { led: 1, on_tick: 5, off_tick: 9, level: 1.0 / 3.0 }],
        note: "line\nbreak \"quoted\" µ".into(),
        ..FrameRecord::new(id, "reference", FrameRole::Reference)
    }
}

fn event(seq: u32) -> EventRecord {
    EventRecord { seq, tick: 1 << 60, kind: "mark".into(), data: serde_json::json!({"value": seq}) }
}

fn manifest() -> Manifest {
    let mut m = Manifest::new("daic", "0.1.0");
    m.seed = Some(u64::MAX);
    m.tick_hz = Some(125e6);
    m.plan = serde_json::json!({"move_um": [50, -30, 200]});
    m
}

fn record(root: &Path, frames: u64) -> Dataset {
    let mut recording = Dataset::create(root, manifest(), "# experiment\n", Existing::Refuse).unwrap();
    for id in 0..frames {
        recording.append_frame(frame(id), Some(&image(id as u16))).unwrap();
        recording.append_events(&[event(2 * id as u32), event(2 * id as u32 + 1)]).unwrap();
    }
    recording.finish().unwrap()
}

fn entries(dir: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn what_was_recorded_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    let mut recording = Dataset::create(&root, manifest(), "x = 1\n", Existing::Refuse).unwrap();
    let first = recording.append_frame(frame(0), Some(&image(0))).unwrap();
    assert_eq!(first.file.as_deref(), Some("frames/000000.tif"));
    let mut missing = recording.append_frame(frame(1), None).unwrap();
    recording.append_events(&[event(u32::MAX), event(0)]).unwrap();
    assert!(matches!(recording.append_frame(frame(1), None), Err(DatasetError::DuplicateFrame { id: 1 })));
    missing.verdict = Verdict::Missing;
    recording.revise_frame(&missing).unwrap();
    assert!(matches!(recording.revise_frame(&frame(9)), Err(DatasetError::UnknownFrame { id: 9 })));
    let edges = vec![(0, 1), (1_000_000_007, u32::MAX)];
    recording.dataset().write_edges(&edges).unwrap();
    // It can be read while it is being recorded.
    assert_eq!(Dataset::open(&root).unwrap().frames().unwrap().records.len(), 2);
    recording.finish().unwrap();

    let set = Dataset::open(&root).unwrap();
    assert_eq!(set.manifest().seed, Some(u64::MAX));
    assert_eq!(set.manifest().plan, manifest().plan);
    assert_eq!(set.experiment_toml().unwrap(), "x = 1\n");
    let frames = set.frames().unwrap();
    assert_eq!(frames.damage, []);
    assert_eq!(frames.records, [first.clone(), missing.clone()]);
    assert_eq!(set.read_frame(&first).unwrap(), image(0));
    assert!(matches!(set.read_frame(&missing), Err(DatasetError::NoImage { id: 1 })));
    let events = set.events().unwrap();
    assert_eq!((events.records, events.damage), (vec![event(u32::MAX), event(0)], vec![]));
    assert_eq!(set.edges().unwrap(), Some(edges));
    assert_eq!(set.summary::<serde_json::Value>().unwrap(), None);
    set.write_summary(&serde_json::json!({"rms_um": [0.1, 0.2, 0.3]})).unwrap();
    assert_eq!(set.summary::<serde_json::Value>().unwrap().unwrap()["rms_um"][2], 0.3);
    assert_eq!(
        entries(&root),
        [
            "dataset.json",
            "edges.csv",
            "events.jsonl",
            "experiment.toml",
            "frames",
            "frames.jsonl",
            "summary.json"
        ]
    );
}

#[test]
fn journals_cut_anywhere_lose_the_tail_only_and_recording_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole");
    record(&whole, 3);
    let journal = fs::read(whole.join("frames.jsonl")).unwrap();
    let line_ends: Vec<usize> = (0..journal.len()).filter(|&i| journal[i] == b'\n').map(|i| i + 1).collect();
    for cut in (0..journal.len()).step_by(7).chain(line_ends.clone()).chain(line_ends.iter().map(|e| e - 1)) {
        fs::write(whole.join("frames.jsonl"), &journal[..cut]).unwrap();
        let set = Dataset::open(&whole).unwrap();
        let frames = set.frames().unwrap();
        // A line without its line feed is whole all the same.
        let complete = line_ends.iter().filter(|&&e| e - 1 <= cut).count();
        assert_eq!(frames.records.len(), complete, "cut at {cut}");
        let torn = frames.damage.iter().any(|d| matches!(d, Damage::TornLine { .. }));
        let clean = cut == 0 || line_ends.contains(&cut) || line_ends.contains(&(cut + 1));
        assert_eq!(torn, !clean, "cut at {cut}");

        let mut again = Dataset::resume(&whole).unwrap();
        again.append_frame(frame(77), None).unwrap();
        let set = again.finish().unwrap();
        let frames = set.frames().unwrap();
        assert_eq!((frames.records.len(), frames.damage), (complete + 1, vec![]), "cut at {cut}");
    }
}

#[test]
fn damage_in_the_middle_is_an_error_with_file_line_and_field() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    let set = record(&root, 3);
    let path = root.join("frames.jsonl");
    let text = fs::read_to_string(&path).unwrap();
    let mut lines: Vec<&str> = text.lines().collect();
    let without = lines[1].replacen("\"role\":\"reference\",", "", 1);
    lines[1] = &without;
    fs::write(&path, lines.join("\n") + "\n").unwrap();
    let error = set.frames().unwrap_err();
    assert!(matches!(&error, DatasetError::Line { line: 2, .. }), "{error}");
    assert!(error.to_string().contains("role") && error.to_string().contains("frames.jsonl"), "{error}");
    // A wrong line at the very end that has its line feed was not torn by a crash.
    fs::write(&path, "{\"id\":}\n").unwrap();
    assert!(matches!(set.frames(), Err(DatasetError::Line { line: 1, .. })));
}

#[test]
fn files_outside_the_dataset_are_not_touched() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    let set = record(&root, 1);
    for evil in ["../secret.tif", "/etc/passwd", "frames/../../x", ""] {
        let mut record = frame(0);
        record.file = Some(evil.into());
        let line = serde_json::to_string(&record).unwrap() + "\n";
        fs::write(root.join("frames.jsonl"), line).unwrap();
        assert!(matches!(set.frames(), Err(DatasetError::FrameFile { line: 1, .. })), "{evil}");
        assert!(matches!(set.read_frame(&record), Err(DatasetError::FrameFile { .. })), "{evil}");
    }
}

#[test]
fn lost_events_and_files_are_reported() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    let mut recording = Dataset::create(&root, manifest(), "", Existing::Refuse).unwrap();
    recording.append_frame(frame(0), Some(&image(0))).unwrap();
    recording.append_events(&[event(4), event(7)]).unwrap();
    let set = recording.finish().unwrap();
    assert_eq!(set.events().unwrap().damage, [Damage::EventGap { expected: 5, found: 7 }]);
    fs::remove_file(root.join("frames/000000.tif")).unwrap();
    let frames = set.frames().unwrap();
    assert!(matches!(frames.damage[..], [Damage::FrameFileGone { id: 0, .. }]));
    let listed = serde_json::to_value(&frames.damage).unwrap();
    assert_eq!(listed, serde_json::json!([frames.damage[0].to_string()]));
    assert!(frames.damage[0].to_string().contains("restore the file to measure it"));
    let error = set.read_frame(&frames.records[0]).unwrap_err();
    assert!(matches!(error, DatasetError::FrameGone { id: 0, .. }), "{error}");
    assert!(error.to_string().contains("check that the dataset is complete"), "{error}");
    fs::remove_file(root.join("experiment.toml")).unwrap();
    let error = set.experiment_toml().unwrap_err();
    assert!(matches!(error, DatasetError::Experiment { .. }), "{error}");
    assert!(error.to_string().contains("check that the dataset is complete"), "{error}");
    fs::remove_file(root.join("events.jsonl")).unwrap();
    assert!(matches!(set.events().unwrap().damage[..], [Damage::JournalGone { .. }]));
}

#[test]
fn foreign_folders_and_newer_versions_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let create = |root: &Path, existing| Dataset::create(root, manifest(), "", existing).map(|_| ());
    let foreign = dir.path().join("foreign");
    fs::create_dir(&foreign).unwrap();
    fs::write(foreign.join("thesis.tex"), "years of work").unwrap();
    for existing in [Existing::Refuse, Existing::Replace] {
        assert!(matches!(create(&foreign, existing), Err(DatasetError::NotEmpty { .. })));
    }
    assert!(matches!(Dataset::open(&foreign), Err(DatasetError::NotADataset { .. })));
    assert!(matches!(Dataset::open(&foreign.join("none")), Err(DatasetError::NotADataset { .. })));
    assert!(matches!(Dataset::open(&foreign.join("thesis.tex")), Err(DatasetError::NotADataset { .. })));
    // Somebody else's dataset.json does not make it ours.
    fs::write(foreign.join("dataset.json"), "{\"name\": \"other tool\"}").unwrap();
    assert!(matches!(create(&foreign, Existing::Replace), Err(DatasetError::NotEmpty { .. })));
    assert!(matches!(create(&foreign, Existing::Refuse), Err(DatasetError::AlreadyThere { .. })));
    assert_eq!(fs::read_to_string(foreign.join("thesis.tex")).unwrap(), "years of work");

    let ours = dir.path().join("ours");
    let set = record(&ours, 2);
    fs::write(ours.join("notes.txt"), "mine").unwrap();
    set.begin_results(0).unwrap();
    assert!(matches!(create(&ours, Existing::Refuse), Err(DatasetError::AlreadyThere { .. })));
    create(&ours, Existing::Replace).unwrap();
    assert_eq!(Dataset::open(&ours).unwrap().frames().unwrap().records, []);
    assert_eq!(
        entries(&ours),
        ["dataset.json", "events.jsonl", "experiment.toml", "frames", "frames.jsonl", "notes.txt"]
    );
    assert!(entries(&ours.join("frames")).is_empty());

    let newer = r#"{"format":"daic-dataset","format_version":2,"shape":"unknown"}"#;
    fs::write(ours.join("dataset.json"), newer).unwrap();
    let error = Dataset::open(&ours).unwrap_err();
    assert!(matches!(error, DatasetError::NewerFormat { version: 2, .. }), "{error}");
    assert!(matches!(create(&ours, Existing::Replace), Err(DatasetError::NewerFormat { .. })));
    fs::write(ours.join("dataset.json"), "{\"format\":\"daic-dataset\",\n \"format_version\":1}").unwrap();
    let error = Dataset::open(&ours).unwrap_err();
    assert!(matches!(error, DatasetError::Manifest { line: 2, .. }), "{error}");
    assert!(error.to_string().contains("program"), "{error}");
}

#[test]
fn a_folder_with_an_unreadable_manifest_is_not_cleared() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("theirs");
    for sub in ["results", "frames"] {
        fs::create_dir_all(root.join(sub)).unwrap();
        fs::write(root.join(sub).join("precious.dat"), "1").unwrap();
    }
    fs::write(root.join("summary.json"), "{}").unwrap();
    let before = entries(&root);
    // No JSON, torn JSON, another type of JSON, and ours but without its fields.
    for text in ["not json", "{\"format\":\"daic-da", "[1, 2]", "{\"format\":\"daic-dataset\"}"] {
        fs::write(root.join("dataset.json"), text).unwrap();
        for existing in [Existing::Replace, Existing::ReplaceKind("demo")] {
            let error = Dataset::create(&root, manifest(), "", existing).unwrap_err();
            assert!(
                matches!(error, DatasetError::NotReplaced { .. } | DatasetError::NotEmpty { .. }),
                "{text}: {error}"
            );
            assert!(error.to_string().contains("choose a"), "{error}");
        }
        fs::remove_file(root.join("dataset.json")).unwrap();
        assert_eq!(entries(&root), before, "{text}");
        assert!(root.join("results/precious.dat").is_file() && root.join("frames/precious.dat").is_file());
    }
}

#[test]
fn only_a_dataset_of_the_kind_is_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let demo = Existing::ReplaceKind("demo");
    let recorded = dir.path().join("recorded");
    record(&recorded, 2);
    let error = Dataset::create(&recorded, manifest(), "", demo).unwrap_err();
    assert!(matches!(&error, DatasetError::OtherKind { kind: None, wanted: "demo", .. }), "{error}");
    assert!(
        error.to_string().contains("holds a recorded dataset")
            && error.to_string().contains("choose another folder"),
        "{error}"
    );
    assert_eq!(Dataset::open(&recorded).unwrap().frames().unwrap().records.len(), 2);

    // What was made as this kind is of this kind, and is replaced the next time.
    let ours = dir.path().join("ours");
    for _ in 0..2 {
        let mut recording = Dataset::create(&ours, manifest(), "", demo).unwrap();
        assert_eq!(recording.dataset().frames().unwrap().records, []);
        recording.append_frame(frame(0), None).unwrap();
    }
    assert_eq!(Dataset::open(&ours).unwrap().manifest().kind.as_deref(), Some("demo"));
    let error = Dataset::create(&ours, manifest(), "", Existing::ReplaceKind("test")).unwrap_err();
    assert!(matches!(&error, DatasetError::OtherKind { kind: Some(k), .. } if k == "demo"), "{error}");
    assert!(matches!(
        Dataset::create(&ours, manifest(), "", Existing::Refuse),
        Err(DatasetError::AlreadyThere { .. })
    ));
}

#[test]
fn results_are_done_only_for_the_same_settings_and_inputs() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    let set = record(&root, 2);
    let inputs = [root.join("frames/000000.tif"), root.join("frames/000001.tif")];
    let key = result_key("0.1.0", &serde_json::json!({"subset": 33}), &inputs).unwrap();
    assert!(!set.is_done(1, &key));
    let folder = set.begin_results(1).unwrap();
    fs::write(folder.join("points.csv"), "x\n").unwrap();
    assert!(!set.is_done(1, &key));
    set.mark_done(1, &key).unwrap();
    assert!(set.is_done(1, &key) && !set.is_done(0, &key));
    // A file that is gone, or has another length, has to be computed again.
    fs::remove_file(folder.join("points.csv")).unwrap();
    assert!(!set.is_done(1, &key));
    fs::write(folder.join("points.csv"), "x").unwrap();
    assert!(!set.is_done(1, &key));
    fs::write(folder.join("points.csv"), "x\n").unwrap();
    fs::write(folder.join("more.txt"), "of the user").unwrap();
    assert!(set.is_done(1, &key));
    // Marks without the list of files prove nothing.
    let mark = fs::read(folder.join("done.json")).unwrap();
    fs::write(folder.join("done.json"), format!("{{\"key\": \"{key}\"}}")).unwrap();
    assert!(!set.is_done(1, &key));
    fs::write(folder.join("done.json"), mark).unwrap();
    assert!(set.is_done(1, &key));
    let other = |version: &str, subset: u32, inputs: &[std::path::PathBuf]| {
        result_key(version, &serde_json::json!({"subset": subset}), inputs).unwrap()
    };
    assert_eq!(other("0.1.0", 33, &inputs), key);
    assert_ne!(other("0.1.1", 33, &inputs), key);
    assert_ne!(other("0.1.0", 31, &inputs), key);
    assert_ne!(other("0.1.0", 33, &inputs[..1]), key);
    let swapped = [inputs[1].clone(), inputs[0].clone()];
    assert_ne!(other("0.1.0", 33, &swapped), key);
    fs::OpenOptions::new().append(true).open(&inputs[1]).unwrap().write_all(b"!").unwrap();
    assert_ne!(other("0.1.0", 33, &inputs), key);
    // Beginning anew takes the old results away, done mark first.
    set.begin_results(1).unwrap();
    assert!(!set.is_done(1, &key) && entries(&folder).is_empty());
    fs::write(folder.join("done.json"), "{\"key\":\"torn").unwrap();
    assert!(!set.is_done(1, &key));
}

#[test]
fn random_damage_never_panics() {
    let seed: u64 = 0x0da1_c5ee_d000_0002;
    println!("seed {seed:#x}");
    let mut state = seed;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state
    };
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    let set = record(&root, 2);
    set.write_edges(&[(1, 2), (3, 4)]).unwrap();
    for name in ["dataset.json", "frames.jsonl", "events.jsonl", "edges.csv"] {
        let path = root.join(name);
        let whole = fs::read(&path).unwrap();
        for _ in 0..300 {
            let mut bytes = whole.clone();
            for _ in 0..=next() % 3 {
                let at = next() as usize % bytes.len();
                bytes[at] = next() as u8;
            }
            bytes.truncate(bytes.len() - (next() as usize % 20).min(bytes.len()));
            fs::write(&path, bytes).unwrap();
            if let Ok(set) = Dataset::open(&root) {
                for record in set.frames().map(|c| c.records).unwrap_or_default() {
                    let _ = set.read_frame(&record).is_ok();
                }
                let _ = (set.events().is_ok(), set.edges().is_ok());
            }
        }
        fs::write(&path, whole).unwrap();
    }
}
