//! AVX2 with FMA: vectors of 256 bits, and the int8 dot products that go with them.

use std::arch::x86_64::*;
// Operations that are one instruction.
use std::arch::x86_64::{
    _mm256_add_epi32 as add_i32, _mm256_add_ps as add, _mm256_cvtepi32_ps as to_f32, _mm256_div_ps as div,
    _mm256_fmadd_ps as fma, _mm256_max_ps as max, _mm256_min_ps as min, _mm256_mul_ps as mul,
    _mm256_mullo_epi32 as mul_i32, _mm256_set1_epi32 as splat_i32, _mm256_set1_ps as splat,
    _mm256_sub_epi32 as sub_i32, _mm256_sub_ps as sub,
};

use super::{NEAREST, prefetch};
use crate::simd::bits::{read, write};
use crate::simd::{HIGH_NIBBLES, Kernel, Simd, forward, functions, token};

/// A token of these vectors, with what it adds to AVX2 and FMA.
macro_rules! avx2 {
    ($(#[$doc:meta])* $name:ident: [$($feature:tt),*], { $($own:tt)* }) => {
        token! {
            $(#[$doc])*
            $name: is_x86_feature_detected["avx2", "fma" $(, $feature)*], {
                const NAME: &'static str = "avx2";
                const LANES: usize = 8;
                const TILE_ROWS: usize = 6;
                const TILE_VECTORS: usize = 2;
                type F32 = __m256;
                type I32 = __m256i;
                forward! { fn to_bf16_pairs(first: __m256, second: __m256) -> __m256i = to_bf16_pairs; }
                $($own)*
            }
        }
    };
}

avx2! {
    /// AVX2 with FMA.
    Avx2: [], {
        // Two products of at most 129 * 127 are less than 2^15, where `maddubs` saturates. The other ways out
        // cost more: 7 bits in the weights lose as much (0.018 of the result instead of 0.011; this way,
        // 0.017), 16-bit products take the time of float32.
        const MAX_BYTE: u8 = 129;
        forward! { fn dot_int8(sum: __m256i, x: __m256i, w: __m256i) -> __m256i = maddubs; }
    }
}

avx2! {
    /// AVX2 with AVX-VNNI: the shorter encoding, of CPUs that may lack AVX-512.
    Avx2VexVnni: ["avxvnni"], {
        const MAX_BYTE: u8 = 255;
        const DOT_NAME: &'static str = "vnni";
        forward! { fn dot_int8(sum: __m256i, x: __m256i, w: __m256i) -> __m256i = _mm256_dpbusd_avx_epi32; }
    }
}

avx2! {
    /// AVX2 with the 256-bit form of AVX512-VNNI.
    Avx2EvexVnni: ["avx512f", "avx512vl", "avx512vnni"], {
        const MAX_BYTE: u8 = 255;
        const DOT_NAME: &'static str = "vnni";
        forward! { fn dot_int8(sum: __m256i, x: __m256i, w: __m256i) -> __m256i = _mm256_dpbusd_epi32; }
    }
}

functions! {
    "avx2,fma":

    fn round(x: __m256) -> __m256 {
        _mm256_round_ps::<NEAREST>(x)
    }

    fn scale_by_power_of_two(x: __m256, exponent: __m256) -> __m256 {
        // In two steps, so that neither factor leaves the range of normal numbers.
        let exponent = _mm256_cvtps_epi32(exponent);
        let half = _mm256_srai_epi32::<1>(exponent);
        let rest = _mm256_sub_epi32(exponent, half);
        let bias = _mm256_set1_epi32(127);
        let first = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(half, bias)));
        let second = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(rest, bias)));
        _mm256_mul_ps(_mm256_mul_ps(x, first), second)
    }

    fn low_bits_as_exponent(x: __m256) -> __m256 {
        _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_castps_si256(x)))
    }

    fn replace_where(x: __m256, probe: __m256, value: __m256) -> __m256 {
        _mm256_blendv_ps(x, value, _mm256_cmp_ps::<_CMP_EQ_OQ>(probe, value))
    }

    fn low_halves(pairs: __m256i) -> __m256 {
        _mm256_castsi256_ps(_mm256_slli_epi32::<16>(pairs))
    }

    fn high_halves(pairs: __m256i) -> __m256 {
        _mm256_castsi256_ps(_mm256_and_si256(pairs, _mm256_set1_epi32(0xffff_0000_u32 as i32)))
    }

    fn low_nibbles(words: __m256i) -> __m256i {
        high_nibbles(_mm256_slli_epi32::<4>(words))
    }

    fn high_nibbles(words: __m256i) -> __m256i {
        _mm256_and_si256(words, _mm256_set1_epi32(HIGH_NIBBLES))
    }

    fn round_to_bf16(x: __m256) -> __m256 {
        // Half a unit of the last place is added, less one where that place is even; a NaN's payload could
        // overflow, so it becomes the quiet one.
        let bits = _mm256_castps_si256(x);
        let even = _mm256_and_si256(_mm256_srli_epi32::<16>(bits), _mm256_set1_epi32(1));
        let rounded = _mm256_add_epi32(_mm256_add_epi32(bits, _mm256_set1_epi32(0x7fff)), even);
        let rounded = _mm256_and_si256(rounded, _mm256_set1_epi32(0xffff_0000_u32 as i32));
        let nan = _mm256_cmp_ps::<_CMP_UNORD_Q>(x, x);
        _mm256_blendv_ps(_mm256_castsi256_ps(rounded), _mm256_set1_ps(f32::NAN), nan)
    }

    fn to_bf16_pairs(first: __m256, second: __m256) -> __m256i {
        let high = |x| _mm256_srli_epi32::<16>(_mm256_castps_si256(round_to_bf16(x)));
        // Packing works within halves of the vectors, which are then put in order.
        _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_packus_epi32(high(first), high(second)))
    }

    fn maddubs(sum: __m256i, x: __m256i, w: __m256i) -> __m256i {
        let pairs = _mm256_maddubs_epi16(x, w);
        _mm256_add_epi32(sum, _mm256_madd_epi16(pairs, _mm256_set1_epi16(1)))
    }

    fn load_rest(from: &[f32]) -> __m256 {
        // SAFETY: lanes beyond the slice are masked, so they are not read.
        unsafe { _mm256_maskload_ps(from.as_ptr(), first_lanes(from.len())) }
    }

    fn store_rest(x: __m256, to: &mut [f32]) {
        // SAFETY: lanes beyond the slice are masked, so they are not written.
        unsafe { _mm256_maskstore_ps(to.as_mut_ptr(), first_lanes(to.len()), x) }
    }

    fn store_bf16(x: __m256, to: &mut [u16]) {
        // Packing works within halves of the vector, which are then put in order.
        let high = _mm256_srli_epi32::<16>(_mm256_castps_si256(round_to_bf16(x)));
        let packed = _mm256_permute4x64_epi64::<0b1000>(_mm256_packus_epi32(high, high));
        write(_mm256_castsi256_si128(packed), to);
    }

    fn store_bytes(x: __m256, zero: __m256i, most: __m256i, to: &mut [u8]) {
        let integers = _mm256_add_epi32(_mm256_cvtps_epi32(x), zero);
        let integers = _mm256_min_epi32(integers, most);
        let low = _mm256_castsi256_si128(integers);
        let halves = _mm_packus_epi32(low, _mm256_extracti128_si256::<1>(integers));
        write(_mm_cvtsi128_si64(_mm_packus_epi16(halves, halves)), to);
    }
}

/// A mask of the first `n` lanes.
#[inline(always)]
fn first_lanes(n: usize) -> __m256i {
    static LANES: [i32; 16] = [-1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0];
    read(&LANES[8 - n..])
}

/// Sum of the lanes.
#[inline]
#[target_feature(enable = "avx2")]
pub(super) fn reduce_add(x: __m256) -> f32 {
    let x = _mm_add_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps::<1>(x));
    let x = _mm_add_ps(x, _mm_movehl_ps(x, x));
    _mm_cvtss_f32(_mm_add_ss(x, _mm_shuffle_ps::<1>(x, x)))
}

/// Largest lane.
#[inline]
#[target_feature(enable = "avx2")]
pub(super) fn reduce_max(x: __m256) -> f32 {
    let x = _mm_max_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps::<1>(x));
    let x = _mm_max_ps(x, _mm_movehl_ps(x, x));
    _mm_cvtss_f32(_mm_max_ss(x, _mm_shuffle_ps::<1>(x, x)))
}
