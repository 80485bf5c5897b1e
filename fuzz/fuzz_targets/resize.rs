//! A checkpoint, and how many future tokens its copy is to have: the number (two bytes), `config.json`, the header of the weights and what
//! their bytes are, between lines of `====`.

#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use saccade_fuzz::{folder, split, use_resize};

static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| folder("resize"));

fuzz_target!(|bytes: &[u8]| {
    let Some((count, rest)) = bytes.split_first_chunk::<2>() else {
        return;
    };
    let pieces = split(rest, 3);
    if let [config, header, more @ ..] = &pieces[..] {
        let config = String::from_utf8_lossy(config);
        let count = usize::from(u16::from_le_bytes(*count));
        use_resize(
            &FOLDER,
            count,
            &config,
            header,
            more.first().copied().unwrap_or_default(),
        );
    }
});
