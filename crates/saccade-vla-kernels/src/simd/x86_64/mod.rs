//! The instruction sets of x86-64.

pub(crate) mod avx2;
pub(crate) mod avx512;

use std::arch::x86_64::{
    __m128i, __m256, __m256i, __m512, __m512bh, __m512i, _MM_FROUND_NO_EXC, _MM_FROUND_TO_NEAREST_INT,
    _MM_HINT_T1, _mm_prefetch,
};

use super::bits::{Bits, are_bits};

const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

are_bits!(__m128i, __m256, __m256i, __m512, __m512i, __m512bh);

/// Prefetches into the second-level cache.
#[inline(always)]
fn prefetch(at: *const u8) {
    // SAFETY: prefetching never faults, whatever the address.
    unsafe { _mm_prefetch::<_MM_HINT_T1>(at.cast()) }
}
