//! See `firmware/tests/fuzz/targets.rs`.
#![no_main]
#![allow(dead_code)]

#[path = "../../firmware/tests/fuzz/targets.rs"]
mod targets;

libfuzzer_sys::fuzz_target!(|data: &[u8]| targets::flash(data));
