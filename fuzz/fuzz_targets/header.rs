//! A whole safetensors file: opened, compared with expected tensors, every tensor read in every way.

#![no_main]

use std::fs;
use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use saccade_fuzz::{folder, use_checkpoint};

static FILE: LazyLock<PathBuf> = LazyLock::new(|| folder("header").join("model.safetensors"));

fuzz_target!(|bytes: &[u8]| {
    fs::write(&*FILE, bytes).expect("memory is not full");
    use_checkpoint(&FILE);
});
