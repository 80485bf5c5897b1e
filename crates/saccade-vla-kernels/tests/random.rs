//! Linear layers and attention of random shapes, strides and thread counts on every instruction set: what `fuzz/` searches
//! for longer.

mod common;

use common::{is_emulated, random};
use proptest::collection::vec;
use proptest::prelude::*;

fn cases() -> ProptestConfig {
    ProptestConfig::with_cases(if is_emulated() { 10 } else { 600 })
}

proptest! {
    #![proptest_config(cases())]

    #[test]
    fn linear_layers(bytes in vec(any::<u8>(), 0..24)) {
        random::linear(&bytes);
    }

    #[test]
    fn attention(bytes in vec(any::<u8>(), 0..24)) {
        random::attend(&bytes);
    }
}
