//! CPU families on which kernels were measured: the table that chooses between kernels of one instruction
//! set.
//!
//! A table and no probe at load, so that two runs on one machine use the same kernels and give the same bits.

use std::ops::RangeInclusive;

use super::signature::{Signature, Vendor};

/// CPUs that are built alike, and what was measured on one of them.
#[derive(Debug)]
pub(crate) struct Family {
    pub name: &'static str,
    vendor: Vendor,
    family: u32,
    models: &'static [RangeInclusive<u32>],
    pub rates: Rates,
}

/// Best rates, in `1e9` multiply-accumulates a second on two threads.
#[derive(Debug)]
pub(crate) struct Rates {
    /// Fused multiply-adds of AVX-512.
    pub float32: f64,
    /// VDPBF16PS.
    pub bf16_dot: f64,
    /// Whether asking for weights as many streams of memory was faster than asking for them in their order.
    pub streams: bool,
}

/// Measured by a prototype, before saccade had tiles: `docs/cpus.md`. The others were measured by `make
/// bench-peers`, but for VDPBF16PS on Intel, where `avx512` does not use it.
const SAPPHIRE_RAPIDS: Rates = Rates {
    float32: 145.0,
    bf16_dot: 76.0,
    // Seen with tiles: 274 instead of 154 on one thread at 49 x 1536 x 6144. AVX-512, float32, on an Intel
    // with AMX whose model is hidden: 1.1 times as fast at 49 x 1536 x 6144, 1.4 times at 49 x 6144 x 1536,
    // 1.0 times at 296 x 2048 x 8192; int8 1.0. AVX2 asks in order.
    streams: true,
};

const EMERALD_RAPIDS: Rates = Rates {
    float32: 177.0,
    // A loop of 12 chains on each of two cores; float32 reached 182 in the same way.
    bf16_dot: 88.0,
    // As streams, AVX-512 without AMX, two threads, 49 x 1536 x 6144, 49 x 6144 x 1536, 296 x 2048 x 8192 and
    // 296 x 8192 x 2048: float32 1.05 to 1.09, 1.15 to 1.20, 1.0 and 1.1 times as fast, bfloat16 1.0, 1.09,
    // 1.0 and 1.03, int8 1.02, 1.06, 1.04 and 1.02.
    streams: true,
};

const ZEN_4: Rates = Rates {
    float32: 114.0,
    bf16_dot: 228.0,
    // As streams, AVX-512, 49 rows, two threads: int8 1.04 times as fast, bfloat16 1.02, float32 1.0; 296
    // rows 1.0. The whole head gains nothing, so in order.
    streams: false,
};

const ZEN_5: Rates = Rates {
    float32: 251.0,
    bf16_dot: 461.0,
    // As streams, AVX-512, two threads, at 49 x 1536 x 6144 and 49 x 6144 x 1536: int8 1.02 and 0.98 times as
    // fast, bfloat16 0.96 and 0.95, float32 1.01 and 0.96; at 296 x 2048 x 8192 and 296 x 8192 x 2048 all
    // 0.98 to 0.99.
    streams: false,
};

macro_rules! families {
    ($($name:literal: $vendor:ident $family:literal [$($models:expr),+], $rates:expr;)+) => {
        /// The newest of each vendor last.
        static FAMILIES: &[Family] = &[$(Family {
            name: $name,
            vendor: Vendor::$vendor,
            family: $family,
            models: &[$($models),+],
            rates: $rates,
        }),+];
    };
}

families! {
    "Sapphire Rapids": Intel 6 [0x8f..=0x8f], SAPPHIRE_RAPIDS;
    "Emerald Rapids": Intel 6 [0xcf..=0xcf], EMERALD_RAPIDS;
    "Zen 4": Amd 25 [0x10..=0x1f, 0x60..=0x7f, 0xa0..=0xaf], ZEN_4;
    "Zen 5": Amd 26 [0x00..=0x4f, 0x60..=0x7f], ZEN_5;
}

/// The family of a CPU, if it is in the table.
pub(super) fn of(signature: Signature) -> Option<&'static Family> {
    FAMILIES.iter().find(|family| {
        (family.vendor, family.family) == (signature.vendor, signature.family)
            && family
                .models
                .iter()
                .any(|models| models.contains(&signature.model))
    })
}

/// The newest measured family of a vendor.
pub(super) fn newest(vendor: Vendor) -> Option<&'static Family> {
    FAMILIES.iter().rev().find(|family| family.vendor == vendor)
}

#[cfg(test)]
mod tests {
    use super::super::signature::signature;
    use super::*;

    #[test]
    fn no_two_families_share_a_model() {
        for one in FAMILIES {
            for model in one.models.iter().cloned().flatten() {
                let found = of(signature(one.vendor, one.family, model));
                assert_eq!(
                    found.map(|family| family.name),
                    Some(one.name),
                    "model {model:#x}"
                );
            }
        }
    }
}
