//! Arbitrary input: the function of the fuzz target, on a fixed number of cases.

#[path = "common/fuzzed.rs"]
mod fuzzed;
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use std::cell::Cell;

const CASES: u32 = 1600;
const SEED: u64 = 1;

#[test]
fn arbitrary_input_gives_errors_or_statuses() {
    let seed = std::env::var("DAIC_FUZZ_SEED").ok().and_then(|s| s.parse().ok()).unwrap_or(SEED);
    println!("seed {seed} (DAIC_FUZZ_SEED asks for another)");
    let mut bytes = [0; 32];
    bytes[..8].copy_from_slice(&u64::to_le_bytes(seed));
    let rng = TestRng::from_seed(RngAlgorithm::ChaCha, &bytes);
    let config = Config { cases: CASES, failure_persistence: None, ..Config::default() };
    let mut runner = TestRunner::new_with_rng(config, rng);
    let (ran, measured) = (Cell::new(0), Cell::new(0));
    let cases = proptest::collection::vec(any::<u8>(), 0..400);
    runner
        .run(&cases, |bytes| {
            if let Some((_, ok)) = fuzzed::drive(&bytes) {
                ran.set(ran.get() + 1);
                measured.set(measured.get() + u32::from(ok > 0));
            }
            Ok(())
        })
        .unwrap();
    println!("{CASES} cases: {} were correlated, {} gave points", ran.get(), measured.get());
    // of 1600 cases of seed 1 about one in nine has valid input and one in 24 gives points: a generator
    // that no longer reaches the solvers proves nothing
    assert!(ran.get() > CASES / 14 && measured.get() > CASES / 40);
}
