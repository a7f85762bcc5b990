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
