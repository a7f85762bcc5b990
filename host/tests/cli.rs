//! The program's own texts: help, version, schema, template.

use std::process::{Command, Output};

fn daic(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_daic")).args(arguments).output().expect("daic starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn help_names_every_command() {
    let help = text(&daic(&["--help"]).stdout);
    let commands = [
        "demo",
        "simulate",
        "run",
        "process",
        "correlate",
        "profile",
        "displacement",
        "calibrate",
        "align",
        "init",
        "schema",
        "doctor",
    ];
    for command in commands {
        assert!(help.contains(&format!("\n  {command} ")), "{command} is not in\n{help}");
        let own = daic(&[command, "--help"]);
        assert!(own.status.success());
        // every argument is explained, on its own line or the next
        let own = text(&own.stdout);
        let lines: Vec<&str> = own.lines().map(str::trim).collect();
        for pair in lines.windows(2).filter(|pair| pair[0].starts_with("--")) {
            let beside = pair[0].split_once("  ").is_some_and(|(_, words)| !words.trim().is_empty());
            let below = !pair[1].is_empty() && !pair[1].starts_with('-');
            assert!(beside || below, "{command}: {}", pair[0]);
        }
    }
}

#[test]
fn a_wrong_command_is_a_usage_error() {
    let output = daic(&["corelate", "a.png"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("correlate"), "the right name is offered");
}

#[test]
fn the_schema_is_json_and_knows_every_section() {
    let output = daic(&["schema"]);
    assert!(output.status.success());
    let schema: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    for section in ["rig", "optics", "processing", "sequence", "seed"] {
        assert!(schema["properties"][section].is_object(), "{section}");
    }
}

#[test]
fn the_template_is_written_whole_and_reads_back() {
    let folder = tempfile::TempDir::new().expect("folder");
    let file = folder.path().join("experiment.toml");
    let output = daic(&["init", file.to_str().expect("UTF-8"), "--json"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let written = std::fs::read_to_string(&file).expect("written");
    assert_eq!(written, daic_rig::experiment::template());
    daic_rig::experiment::Experiment::load(&file).expect("the template is valid");
}

/// Two images on which nothing but the start of a correlation can go wrong: 160 × 160 px of smoothed
/// hash noise, the second turned by 90°.
fn turned_pair(folder: &std::path::Path) -> (String, String) {
    const N: i64 = 160;
    let hash = |x: i64, y: i64| {
        let mut z =
            (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (y as u64).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 31)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 29)) % 256) as f64
    };
    let at = |x: i64, y: i64| {
        let (mut sum, mut weights) = (0.0, 0.0);
        for dy in -4..=4i64 {
            for dx in -4..=4i64 {
                let w = (-((dx * dx + dy * dy) as f64) / 5.0).exp();
                sum += w * hash(x + dx, y + dy);
                weights += w;
            }
        }
        (128.0 + 4.0 * (sum / weights - 127.5)).clamp(0.0, 255.0) as u8
    };
    let save = |name: &str, f: &dyn Fn(i64, i64) -> u8| {
        let path = folder.join(name);
        let grey = (0..N * N).map(|k| f(k % N, k / N)).collect();
        image::GrayImage::from_raw(N as u32, N as u32, grey).expect("size").save(&path).expect("written");
        path.to_str().expect("UTF-8").to_owned()
    };
    // the material at (x, y) goes to (N − 1 − y, x)
    (save("reference.png", &at), save("turned.png", &|x, y| at(y, N - 1 - x)))
}

#[test]
fn the_start_of_a_correlation_is_reported_and_can_be_given() {
    let folder = tempfile::TempDir::new().expect("folder");
    let (a, b) = turned_pair(folder.path());
    let run = |more: &[&str]| {
        let mut arguments = vec!["correlate", &a, &b, "--json", "--quiet", "--step", "16"];
        arguments.extend_from_slice(more);
        let output = daic(&arguments);
        assert!(output.status.success(), "{}", text(&output.stderr));
        serde_json::from_slice::<serde_json::Value>(&output.stdout).expect("JSON")
    };
    let found = run(&[]);
    assert_eq!(found["start"]["method"], "features");
    assert_eq!(found["converged"], found["points"]);
    let rotation = found["start"]["features"]["motions"][0]["rotation_deg"].as_f64().expect("number");
    assert!((rotation - 90.0).abs() < 0.5, "{rotation}");

    let found = run(&["--guess", "fft"]);
    assert_eq!(found["start"]["features"], serde_json::Value::Null);
    assert!(!found["start"]["warnings"].as_array().expect("list").is_empty(), "{found}");

    // (80, 80) goes to (79, 80)
    let found = run(&["--seed", "80,80,-1,0,-1,-1,1,-1"]);
    assert_eq!(found["start"]["method"], "seeds");
    assert_eq!(found["converged"], found["points"]);

    let output = daic(&["correlate", &a, &b, "--quiet", "--step", "16", "--seed", "80,80,30,0"]);
    let said = text(&output.stdout);
    assert!(said.contains("1 of 1 seeds were not confirmed") && said.contains("--seed"), "{said}");
    let output = daic(&["correlate", &a, &b, "--seed", "80,80,30"]);
    assert_eq!(output.status.code(), Some(2));
}
