//! The options of a processor as JSON, and after a line of `====` an instruction.

#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use saccade_fuzz::{folder, split, use_processor, use_processor_files};

static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| folder("processor"));

fuzz_target!(|bytes: &[u8]| {
    let pieces: Vec<_> = split(bytes, 2).into_iter().map(String::from_utf8_lossy).collect();
    use_processor(&pieces[0], pieces.get(1).map(|piece| &**piece));
    use_processor_files(&FOLDER, &pieces[0]);
});
