//! The light-field demo: beads in simulated frames come back where the stage put them.

use daic::lightfield_demo::run;
use daic::progress::Silent;

#[test]
fn beads_come_back_where_they_were_moved_to() {
    let dir = tempfile::tempdir().expect("folder");
    let out = dir.path().join("demo");
    let summary = run(&out, 1, &Silent).expect("runs");
    for bead in &summary.beads {
        eprintln!("{bead:?}");
    }
    for check in &summary.checks {
        eprintln!("{check:?}");
        assert!(check.passed, "{check:?}");
    }
    assert!(summary.passed && summary.beads.len() == 12);
    assert!(out.join("report.html").is_file() && out.join("results/lightfield/000002.tif").is_file());
}
