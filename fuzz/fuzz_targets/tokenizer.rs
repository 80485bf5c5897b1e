//! A `tokenizer.json`; or `vocab.json`, `merges.txt`, `added_tokens.json` and `tokenizer_config.json` between lines of `====`.

#![no_main]

use libfuzzer_sys::fuzz_target;
use saccade_fuzz::{split, use_tokenizer};

fuzz_target!(|bytes: &[u8]| {
    let pieces: Vec<_> = split(bytes, 4).into_iter().map(String::from_utf8_lossy).collect();
    let pieces: Vec<&str> = pieces.iter().map(|piece| &**piece).collect();
    use_tokenizer(&pieces);
});
