//! `daic rig calibrate-stage` on the simulated rig, whose stage is not what the experiment says.

use daic_tests::program::daic;
use serde_json::Value;
use tempfile::TempDir;

/// Truth of the scene: steps per millimetre of the axes and the play of their drives.
const TRUTH: [(&str, f64, f64); 2] = [("x", 6430.0, 12.0), ("z", 6350.0, 25.0)];

fn scene(folder: &TempDir) {
    let text = "
[scene.specimen]
half_width_mm = 7.5
half_height_mm = 7.5
surface = { kind = \"sphere\", radius_mm = 40.0, apex_mm = 1.0 }
[stage]
steps_per_mm = [6430.0, 6400.0, 6350.0]
backlash_mm = [0.012, 0.0, 0.025]
[camera]
exposure_ns = 5000000
trigger_delay_ns = 0
[light]
led_electrons_per_s = [4.0e7]
";
    std::fs::write(folder.path().join("scene.toml"), text).expect("written");
    daic(folder.path(), ["init", "experiment.toml"]).expect_code(0);
    // fewer points: the mean over the field is what counts
    let path = folder.path().join("experiment.toml");
    let text = std::fs::read_to_string(&path).expect("read").replace("step = 10 ", "step = 60 ");
    std::fs::write(&path, text).expect("written");
}

#[test]
fn steps_and_backlash_come_out_of_what_the_camera_sees() {
    let folder = TempDir::new().expect("folder");
    scene(&folder);
    for (axis, steps_per_mm, backlash_um) in TRUTH {
        let arguments = [
            "rig",
            "calibrate-stage",
            "experiment.toml",
            "--axis",
            axis,
            "--out",
            axis,
            "--scene",
            "scene.toml",
            "--positions",
            "3",
            "--passes",
            "2",
            "--json",
        ];
        let run = daic(folder.path(), arguments).expect_code(0);
        let found: Value = serde_json::from_str(&run.stdout).expect("json");
        let number = |key: &str| found[key].as_f64().unwrap_or_else(|| panic!("{key}: {found}"));
        let (steps, sigma) = (number("steps_per_mm"), number("steps_per_mm_sigma"));
        let (play, play_sigma) = (number("backlash_um"), number("backlash_sigma_um"));
        eprintln!(
            "{axis}: {steps:.3} ± {sigma:.3} (truth {steps_per_mm}), {play:.4} ± {play_sigma:.4} µm (truth {backlash_um})"
        );
        assert!((steps - steps_per_mm).abs() < 4.0 * sigma, "{axis}: {steps} ± {sigma}");
        assert!((play - backlash_um).abs() < 0.5, "{axis}: {play} µm");
        assert!((play - backlash_um).abs() < 4.0 * play_sigma, "{axis}: {play} ± {play_sigma} µm");
        assert!(number("angle_deg") < 0.05, "{axis}: {}", number("angle_deg"));
        assert_eq!(number("frames"), 12.0);
        let file =
            std::fs::read_to_string(folder.path().join(axis).join("results/stage.json")).expect("result");
        assert_eq!(serde_json::from_str::<Value>(&file).expect("json"), found);
    }
}

#[test]
fn travel_beyond_the_axis_is_refused_before_anything_moves() {
    let folder = TempDir::new().expect("folder");
    scene(&folder);
    let run = daic(
        folder.path(),
        ["rig", "calibrate-stage", "experiment.toml", "--axis", "y", "--out", "y", "--travel", "9 mm"],
    )
    .expect_code(2);
    assert!(run.stderr.contains("-6.7500 to 6.7500 mm"), "{}", run.stderr);
    assert!(!folder.path().join("y").exists());
}
