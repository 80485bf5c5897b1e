#![no_main]

use libfuzzer_sys::fuzz_target;

// With the tests' definitions and bounds.
#[path = "../../crates/saccade-vla-kernels/tests/common/mod.rs"]
mod common;

fuzz_target!(|bytes: &[u8]| common::random::attend(bytes));
