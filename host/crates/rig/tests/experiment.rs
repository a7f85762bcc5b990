//! The experiment file: template, schema, units, unknown keys, ranges, each with its place.

use daic_rig::experiment::{
    ConfigError, Experiment, OpticsFile, Problem, ProblemKind, Role, Step, experiment_schema, optics_schema,
    template,
};
use daic_rig::units::Length;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(3).expect("workspace root").to_owned()
}

fn parse(text: &str) -> Result<Experiment, ConfigError> {
    Experiment::parse(text, Path::new("experiment.toml"))
}

/// The template with one piece of text replaced, and the problems this makes.
fn problems(from: &str, to: &str) -> (String, Vec<Problem>) {
    assert_eq!(template().matches(from).count(), 1, "{from:?} must be in the template once");
    let text = template().replace(from, to);
    let error = parse(&text).expect_err(to);
    (text, error.problems().to_vec())
}

#[test]
fn the_template_is_valid_and_describes_the_demo() {
    let e = parse(template()).unwrap_or_else(|e| panic!("{e}"));
    let names: Vec<(&str, Role)> = e
        .sequence
        .iter()
        .filter_map(|s| if let Step::Frame(f) = s { Some((f.name.as_str(), f.role)) } else { None })
        .collect();
    assert_eq!(
        names,
        [
            ("cal_home", Role::Calibration),
            ("cal_z_plus", Role::Calibration),
            ("cal_z_minus", Role::Calibration),
            ("cal_x", Role::Calibration),
            ("cal_y", Role::Calibration),
            ("reference", Role::Reference),
            ("moved", Role::Deformed),
        ]
    );
    let last =
        e.sequence.iter().rev().find_map(|s| if let Step::Move(m) = s { Some(m.targets()) } else { None });
    assert_eq!(last, Some([0.05, -0.03, 0.2].map(|mm| Some(Length::new(mm)))));
    let optics = e.optics.as_ref().expect("optics");
    assert_eq!(optics.wavelength.mm(), 0.000633);
    assert_eq!(optics.gratings().map(|g| g.map(|g| g.pitch_mm())), Some([Some(1.0 / 300.0); 2]));
}

#[test]
fn what_is_commented_out_in_the_template_is_valid_too() {
    let mut text = String::new();
    for line in template().lines() {
        let trimmed = line.trim_start_matches("# ");
        let commented =
            line.starts_with("# ") && (trimmed.contains(" = ") || trimmed.starts_with("[[sequence]]"));
        let continued = line.starts_with("#     {") || line == "# ] }";
        text.push_str(if commented || continued { trimmed } else { line });
        text.push('\n');
    }
    let e = parse(&text).unwrap_or_else(|e| panic!("{e}\n{text}"));
    assert!(e.optics.as_ref().is_some_and(|o| o.brown.is_some()));
    assert!(e.processing.noise == Some(2.0) && e.processing.roi.is_some());
    assert!(matches!(e.sequence.last(), Some(Step::Repeat(r)) if r.times == 20 && r.steps.len() == 2));
}

#[test]
fn an_experiment_survives_being_written() {
    let e = parse(template()).expect("template");
    let text = toml::to_string(&e).expect("toml");
    assert_eq!(parse(&text).unwrap_or_else(|e| panic!("{e}\n{text}")), e);
}

#[test]
fn unknown_keys_are_refused_with_file_line_and_column() {
    let (text, found) = problems("exposure = \"5 ms\"", "exposre = \"5 ms\"");
    let [p] = found.as_slice() else { panic!("{found:?}") };
    assert_eq!(p.kind, ProblemKind::Form);
    assert_eq!(&text[p.span.clone()], "exposre");
    let line = text.lines().position(|l| l.starts_with("exposre")).expect("line") + 1;
    assert_eq!((p.line, p.column), (line, 1));
    let shown = parse(&text).expect_err("unknown key").to_string();
    assert!(shown.starts_with(&format!("experiment.toml:{line}:1: unknown field `exposre`")), "{shown}");
    assert!(shown.contains("`exposure`"), "{shown}");

    for (from, to, key) in [
        ("[processing]\n", "[procesing]\n", "procesing"),
        ("move = { z = \"1.5 mm\" }", "moev = { z = \"1.5 mm\" }", "moev"),
        ("move = { z = \"1.5 mm\" }", "move = { w = \"1.5 mm\" }", "w"),
        ("subset = 59  ", "subsets = 33  ", "subsets"),
        ("lines = \"300 /mm\"", "line = \"300 /mm\"", "line"),
    ] {
        let (text, found) = problems(from, to);
        assert_eq!(&text[found[0].span.clone()], key, "{found:?}");
        assert!(found[0].help.is_some(), "{found:?}");
    }
}

#[test]
fn wrong_units_and_plain_numbers_are_refused_at_their_place() {
    for (from, to, value, needle) in [
        ("wavelength = \"633 nm\"", "wavelength = \"633 ms\"", "\"633 ms\"", "found the unit \"ms\""),
        ("wavelength = \"633 nm\"", "wavelength = 633", "633", "in quotes, such as \"307 mm\""),
        ("wavelength = \"633 nm\"", "wavelength = \"633\"", "\"633\"", "has no unit"),
        (
            "exposure = \"5 ms\"",
            "exposure = \"5 mm\"",
            "\"5 mm\"",
            "a time is measured in ns, us, ms, s, min",
        ),
        ("lines = \"300 /mm\"", "lines = \"300 mm\"", "\"300 mm\"", "a number per length is measured in /mm"),
        ("move = { z = \"1.5 mm\" }", "move = { z = 1.5 }", "1.5", "a length given as the plain number 1.5"),
    ] {
        let (text, found) = problems(from, to);
        assert_eq!(&text[found[0].span.clone()], value, "{found:?}");
        assert!(found[0].message.contains(needle), "{}", found[0].message);
    }
}

#[test]
fn values_that_break_a_rule_are_named_with_what_is_allowed() {
    for (from, to, field, underlined, needle) in [
        (
            "pinhole_to_grating = \"307 mm\"",
            "pinhole_to_grating = \"-307 mm\"",
            "optics.pinhole_to_grating",
            "\"-307 mm\"",
            "more than 0 mm",
        ),
        (
            "lines = \"300 /mm\"",
            "pitch = \"0.5 um\"",
            "optics.grating.pitch",
            "\"0.5 um\"",
            "above the wavelength",
        ),
        (
            "lines = \"300 /mm\"",
            "pitch = \"-3 um\"",
            "optics.grating.pitch",
            "\"-3 um\"",
            "above the wavelength",
        ),
        (
            "lines = \"300 /mm\"",
            "lines = \"0 /mm\"",
            "optics.grating.lines",
            "\"0 /mm\"",
            "above the wavelength",
        ),
        (
            "lines = \"300 /mm\"",
            "lines = \"2000 /mm\"",
            "optics.grating.lines",
            "\"2000 /mm\"",
            "above the wavelength",
        ),
        ("subset = 59  ", "subset = 32  ", "processing.subset", "32", "odd"),
        ("step = 10  ", "step = 0  ", "processing.step", "0", "1 to 1000"),
        (
            "move = { z = \"1.5 mm\" }",
            "move = { z = \"15 mm\" }",
            "sequence[1].move.z",
            "\"15 mm\"",
            "-5 mm to 5 mm",
        ),
        ("delay = \"1 ms\"", "delay = \"6 ms\"", "rig.strobe.width", "\"200 us\"", "inside the exposure"),
        ("width = \"200 us\"", "width = \"0 us\"", "rig.strobe.width", "\"0 us\"", "more than 0 ns"),
        ("bits = 12", "bits = 20", "rig.camera.bits", "20", "8 to 16"),
        (
            "name = \"moved\"",
            "name = \"reference\"",
            "sequence[18].frame.name",
            "\"reference\"",
            "a name of its own",
        ),
        (
            "name = \"moved\"",
            "name = \"../moved\"",
            "sequence[18].frame.name",
            "\"../moved\"",
            "letters, digits",
        ),
        (
            "focal = \"17956.216577540104 px\"",
            "focal = \"0 px\"",
            "optics.focal",
            "\"0 px\"",
            "more than 0 px",
        ),
        ("tilt = [\"0 mrad\", ", "tilt = [\"2 rad\", ", "optics.grating.tilt[0]", "\"2 rad\"", "45 deg"),
        ("level = 1.0  ", "level = 1.5  ", "rig.strobe.level", "1.5", "0 to 1"),
    ] {
        let (text, found) = problems(from, to);
        let p = found
            .iter()
            .find(|p| matches!(&p.kind, ProblemKind::Value { field: f, .. } if f == field))
            .unwrap_or_else(|| panic!("{field}: {found:?}"));
        assert_eq!(&text[p.span.clone()], underlined, "{field}");
        let ProblemKind::Value { allowed, .. } = &p.kind else { unreachable!() };
        assert!(allowed.contains(needle), "{field}: {allowed}");
        assert!(p.message.starts_with(field), "{}", p.message);
    }
    // More than one at a time, and no grating at all.
    let text = template().replace("subset = 59  ", "subset = 32  ").replace("step = 10  ", "step = 0  ");
    assert_eq!(parse(&text).expect_err("two").problems().len(), 2);
    let text = template().replace("[optics.grating]", "[optics.grating_minus]");
    let shown = parse(&text).expect_err("one grating of two").to_string();
    assert!(
        shown.contains("optics is given grating_minus") && shown.contains("both grating_minus and"),
        "{shown}"
    );
}

#[test]
fn files_that_are_none_are_refused() {
    let folder = tempfile::tempdir().expect("tempdir");
    let missing = Experiment::load(&folder.path().join("none.toml")).expect_err("missing");
    assert!(
        matches!(missing, ConfigError::Read { .. }) && missing.to_string().contains("none.toml"),
        "{missing}"
    );
    let binary = folder.path().join("binary.toml");
    std::fs::write(&binary, [0x61, 0xff, 0xfe, 0x00]).expect("write");
    let error = Experiment::load(&binary).expect_err("binary");
    assert!(error.to_string().contains("not UTF-8"), "{error}");
    assert!(parse("").expect_err("empty").to_string().contains("missing field `rig`"));
    assert!(parse("rig = [").is_err());
    assert!(parse("sequence = 5").is_err());
}

#[test]
fn the_golden_optics_fit_what_the_golden_frames_state() {
    let file = OpticsFile::load(&root().join("examples/golden-macro.toml")).unwrap_or_else(|e| panic!("{e}"));
    let shared = std::env::var_os("DAIC_SHARED").map_or_else(|| root().join("../shared"), PathBuf::from);
    let path = shared.join("golden/daic/cylinder.json");
    let Ok(text) = std::fs::read_to_string(&path) else {
        eprintln!(
            "SKIPPED the_golden_optics_fit_what_the_golden_frames_state: golden/daic/cylinder.json is not there"
        );
        return;
    };
    let truth: serde_json::Value = serde_json::from_str(&text).expect("json");
    let number = |key: &str| truth[key].as_f64().unwrap_or_else(|| panic!("{key}"));
    let o = &file.optics;
    assert_eq!(o.wavelength.mm(), number("wavelength_mm"));
    assert_eq!(o.pinhole_to_grating.mm(), number("pinhole_to_grating_mm"));
    assert_eq!(o.grating_to_reference.mm(), number("grating_to_reference_mm"));
    assert_eq!(o.focal.px(), number("focal_px"));
    assert_eq!(o.pixel.map(Length::mm), Some(number("pixel_mm")));
    for axis in 0..2 {
        assert_eq!(Some(o.principal_point[axis].px()), truth["principal_point_px"][axis].as_f64());
    }
    for grating in o.gratings().expect("gratings") {
        assert_eq!(grating.pitch_mm(), Some(number("grating_pitch_mm")));
        for axis in 0..3 {
            assert_eq!(Some(grating.tilt[axis].rad()), truth["grating_tilt_rad_xyz"][axis].as_f64());
        }
        assert_eq!(grating.substrate.map_or(0.0, |s| s.thickness.mm()), number("substrate_mm"));
    }
}

#[test]
fn optics_files_read_back_to_the_same_bits_and_refuse_other_formats() {
    let path = Path::new("optics.toml");
    let whole = OpticsFile::parse(template(), path).expect("an experiment will do");
    assert_eq!(Some(whole.optics.clone()), parse(template()).expect("template").optics);
    let mut file = OpticsFile {
        format: Some(OpticsFile::FORMAT.to_owned()),
        provenance: Some("test".to_owned()),
        ..whole
    };
    file.optics.focal = daic_rig::units::Pixels::new(17956.2 / 3.0);
    let text = file.to_toml().expect("toml");
    assert_eq!(OpticsFile::parse(&text, path).unwrap_or_else(|e| panic!("{e}")), file);
    let other = text.replace("daic-optics/1", "daic-optics/2");
    assert!(OpticsFile::parse(&other, path).expect_err("format").to_string().contains("daic-optics/1"));
    let negative = text.replace("pinhole_to_grating = \"307 mm\"", "pinhole_to_grating = \"-1 mm\"");
    assert!(OpticsFile::parse(&negative, path).is_err());
}

#[test]
fn the_schema_knows_every_key_of_the_template() {
    let schema: serde_json::Value = serde_json::from_str(&experiment_schema()).expect("json");
    assert_eq!(schema["$schema"], "https://json-schema.org/draft/2020-12/schema");
    assert_eq!(schema["additionalProperties"], false);
    let pattern = |name: &str| schema["$defs"][name]["pattern"].as_str().unwrap_or_else(|| panic!("{name}"));
    assert!(pattern("Length").contains("[uµμ]m"));
    let document: toml::Table = toml::from_str(template()).expect("template");
    follow(&serde_json::to_value(document).expect("json"), &schema, &schema, "");
    let optics: serde_json::Value = serde_json::from_str(&optics_schema()).expect("json");
    assert!(optics["properties"]["provenance"].is_object());
}

/// Every key of `value` must be among the properties its schema names.
fn follow(value: &serde_json::Value, schema: &serde_json::Value, root: &serde_json::Value, path: &str) {
    let mut candidates = vec![schema];
    let mut objects = Vec::new();
    while let Some(s) = candidates.pop() {
        if let Some(name) = s["$ref"].as_str() {
            candidates.push(&root["$defs"][name.trim_start_matches("#/$defs/")]);
        }
        candidates.extend(["anyOf", "oneOf"].iter().filter_map(|k| s[*k].as_array()).flatten());
        objects.push(s);
    }
    match value {
        serde_json::Value::Object(map) => {
            for (key, inner) in map {
                let found = objects.iter().find(|o| o["properties"].get(key).is_some());
                let found = found.unwrap_or_else(|| panic!("{path}.{key} is not in the schema"));
                follow(inner, &found["properties"][key], root, &format!("{path}.{key}"));
            }
        }
        serde_json::Value::Array(items) => {
            let found = objects
                .iter()
                .find(|o| o["items"].is_object())
                .unwrap_or_else(|| panic!("{path} is no array"));
            for item in items {
                follow(item, &found["items"], root, path);
            }
        }
        _ => {}
    }
}

proptest::proptest! {
    /// Whatever is done to a file, reading it ends in an experiment or in problems with a place.
    #[test]
    fn no_text_makes_reading_panic(cut in 0usize..6000, length in 0usize..40, insert in ".{0,20}") {
        let mut text: Vec<char> = template().chars().collect();
        let cut = cut.min(text.len());
        text.splice(cut..(cut + length).min(text.len()), insert.chars());
        let text: String = text.into_iter().collect();
        if let Err(error) = parse(&text) {
            assert!(!error.problems().is_empty());
            for p in error.problems() {
                assert!(text.get(p.span.clone()).is_some() && p.line >= 1 && p.column >= 1, "{p:?}");
            }
        }
        let _ = OpticsFile::parse(&text, Path::new("optics.toml"));
    }

    #[test]
    fn no_quantity_makes_reading_panic(text in "[-+0-9.eE]{0,8}\\PC{0,6}") {
        if let Ok(length) = text.parse::<Length>() {
            assert!(length.mm().is_finite());
        }
    }
}

#[test]
fn the_microscope_template_is_valid_and_needs_no_optics() {
    let text = daic_rig::experiment::microscope_template();
    let e = parse(text).expect("valid");
    let microscope = e.microscope.as_ref().expect("a microscope");
    assert_eq!((microscope.pixel.mm(), microscope.search.px()), (0.5e-3, 40.0));
    assert!(e.optics.is_none());
    let error = OpticsFile::parse(text, Path::new("scope.toml")).expect_err("no optics").to_string();
    assert!(error.contains("scope.toml") && error.contains("microscope"), "{error}");
    let both = format!("{}\n{text}", "[optics]\nwavelength = \"633 nm\"\npinhole_to_grating = \"307 mm\"\ngrating_to_reference = \"109 mm\"\nfocal = \"17000 px\"\nprincipal_point = [\"1 px\", \"1 px\"]\ngrating = { lines = \"300 /mm\" }\n").replacen("seed = 1\n", "", 1);
    for (text, words) in [
        (both, "one of [optics], [microscope] and [lightfield]"),
        (text.replace("[microscope]", "[other]"), "other"),
        (text.replace("\"40 px\"", "\"0 px\""), "microscope.search"),
    ] {
        let error = parse(&text).expect_err(words).to_string();
        assert!(error.contains(words), "{words}: {error}");
    }
}

/// Where the channel's first pixel lies in the cell, written out for every pattern and channel.
#[test]
fn bayer_channels_lie_where_the_pattern_says() {
    use daic_rig::experiment::Bayer;
    for (text, origin) in [
        ("rggb:r", [0, 0]),
        ("rggb:gr", [1, 0]),
        ("rggb:gb", [0, 1]),
        ("rggb:b", [1, 1]),
        ("grbg:r", [1, 0]),
        ("grbg:gr", [0, 0]),
        ("grbg:gb", [1, 1]),
        ("grbg:b", [0, 1]),
        ("gbrg:r", [0, 1]),
        ("gbrg:gr", [1, 1]),
        ("gbrg:gb", [0, 0]),
        ("gbrg:b", [1, 0]),
        ("bggr:r", [1, 1]),
        ("bggr:gr", [0, 1]),
        ("bggr:gb", [1, 0]),
        ("bggr:b", [0, 0]),
    ] {
        assert_eq!(text.parse::<Bayer>().expect(text).origin(), origin, "{text}");
    }
    for wrong in ["rggb", "rggb:g", "rgbg:r", ""] {
        assert!(wrong.parse::<Bayer>().expect_err(wrong).contains("rggb:r"));
    }
    let line = "bayer = { pattern = \"grbg\", channel = \"gb\" }\n";
    let text = template().replace("readout = \"35 ms\"", &format!("{line}readout = \"35 ms\""));
    assert_eq!(parse(&text).expect("valid").rig.camera.bayer.map(Bayer::origin), Some([1, 1]));
}

/// With a rolling shutter the strobe must lie where all rows are exposed: 1944 rows of 2 µs leave 3.886 ms of 5 ms.
#[test]
fn a_strobe_that_misses_rows_is_refused() {
    let with = |row: &str, delay: &str| {
        let text = template()
            .replace("readout = \"35 ms\"", &format!("row_time = \"{row}\"\nreadout = \"35 ms\""))
            .replace("delay = \"1 ms\"", &format!("delay = \"{delay}\""));
        parse(&text)
    };
    assert!(with("0.5 us", "1 ms").is_ok());
    let error = with("2 us", "1 ms").expect_err("rows are missed").to_string();
    assert!(error.contains("rig.strobe.delay") && error.contains("rolling shutter"), "{error}");
    assert!(with("2 us", "3.9 ms").is_ok());
    assert!(with("2 us", "4.9 ms").is_err());
    assert!(with("-1 us", "1 ms").is_err());
    assert_eq!(with("2 us", "3.9 ms").expect("valid").rig.camera.rolling().ns(), 1943.0 * 2000.0);
}
