//! The hardware-in-the-loop cases on the targets that need nothing but this workspace. The emulated
//! Pico and real boards: `cargo xtask hil`.

use daic_tests::hil::inprocess::InProcess;
use daic_tests::hil::serial::Serial;
use daic_tests::hil::{Outcome, Target, run};

fn all_hold(target: Box<dyn Target>) {
    let failed: Vec<_> =
        run(target, false, "").into_iter().filter(|(_, o)| matches!(o, Outcome::Failed(_))).collect();
    assert!(failed.is_empty(), "{failed:?}");
}

#[test]
fn controller_in_process() {
    all_hold(Box::new(InProcess::default()));
}

#[test]
fn simulated_board_behind_a_pty() {
    all_hold(Box::new(Serial::simulated().expect("the simulated rig starts")));
}
