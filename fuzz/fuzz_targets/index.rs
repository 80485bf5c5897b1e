//! A folder with an index and up to three shards, in one input: pieces between lines of `====`, the index first. Shards may be missing.

#![no_main]

use std::fs;
use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use saccade_fuzz::{folder, split, use_checkpoint};

const SHARDS: [&str; 3] = ["a.safetensors", "b.safetensors", "c.safetensors"];

static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| folder("index"));

fuzz_target!(|bytes: &[u8]| {
    let mut pieces = split(bytes, 1 + SHARDS.len()).into_iter();
    let index = pieces.next().unwrap_or_default();
    fs::write(FOLDER.join("model.safetensors.index.json"), index).expect("memory is not full");
    for shard in SHARDS {
        let path = FOLDER.join(shard);
        match pieces.next() {
            Some(bytes) => fs::write(path, bytes).expect("memory is not full"),
            None => drop(fs::remove_file(path)),
        }
    }
    use_checkpoint(&FOLDER);
});
