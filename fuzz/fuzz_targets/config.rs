//! The text of a `config.json`; optionally, after a line of `====`, the header of the weights next to it.

#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use saccade_fuzz::{folder, split, use_config, use_published};

static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| folder("config"));

fuzz_target!(|bytes: &[u8]| {
    let pieces = split(bytes, 2);
    let config = String::from_utf8_lossy(pieces[0]);
    use_config(&config);
    if let Some(header) = pieces.get(1) {
        use_published(&FOLDER, &config, header);
    }
});
