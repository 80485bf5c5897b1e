//! AVX-512 F, VL, BW and DQ: vectors of 512 bits, and the dot products of bfloat16 and int8 that go with
//! them.

use std::arch::x86_64::*;
// Operations that are one instruction.
use std::arch::x86_64::{
    _mm512_add_epi32 as add_i32, _mm512_add_ps as add, _mm512_cvtepi32_ps as to_f32, _mm512_div_ps as div,
    _mm512_fmadd_ps as fma, _mm512_max_ps as max, _mm512_min_ps as min, _mm512_mul_ps as mul,
    _mm512_mullo_epi32 as mul_i32, _mm512_scalef_ps as scale_by_power_of_two, _mm512_set1_epi32 as splat_i32,
    _mm512_set1_ps as splat, _mm512_sub_epi32 as sub_i32, _mm512_sub_ps as sub,
};

use super::{NEAREST, avx2, prefetch};
use crate::simd::bits::{cast, read, write};
use crate::simd::{HIGH_NIBBLES, Kernel, MAX_LANES, Simd, forward, functions, token};

/// A token of these vectors, with what it adds to AVX-512 F, VL, BW and DQ.
macro_rules! avx512 {
    ($(#[$doc:meta])* $name:ident: [$($feature:tt),*], { $($own:tt)* }) => {
        token! {
            $(#[$doc])*
            $name: is_x86_feature_detected[
                "avx512f", "avx512vl", "avx512bw", "avx512dq", "avx2", "fma" $(, $feature)*
            ], {
                const NAME: &'static str = "avx512";
                const LANES: usize = 16;
                const TILE_ROWS: usize = 8;
                const TILE_VECTORS: usize = 3;
                type F32 = __m512;
                type I32 = __m512i;
                forward! { fn transpose(square: &[[u32; MAX_LANES]; MAX_LANES], to: &mut [u32]) = transpose; }
                $($own)*
            }
        }
    };
}

avx512! {
    /// AVX-512 F, VL, BW and DQ.
    Avx512: [], {
        // As with AVX2.
        const MAX_BYTE: u8 = 129;
        forward! {
            fn dot_int8(sum: __m512i, x: __m512i, w: __m512i) -> __m512i = maddubs;
            fn to_bf16_pairs(first: __m512, second: __m512) -> __m512i = to_bf16_pairs;
        }
    }
}

avx512! {
    /// AVX-512 with VNNI.
    Avx512Vnni: ["avx512vnni"], {
        const MAX_BYTE: u8 = 255;
        const DOT_NAME: &'static str = "vnni";
        forward! {
            fn dot_int8(sum: __m512i, x: __m512i, w: __m512i) -> __m512i = _mm512_dpbusd_epi32;
            fn to_bf16_pairs(first: __m512, second: __m512) -> __m512i = to_bf16_pairs;
        }
    }
}

avx512! {
    /// AVX-512 with BF16.
    Avx512Bf16: ["avx512bf16"], {
        const MAX_BYTE: u8 = 129;
        const HAS_DOT_BF16: bool = true;
        const DOT_NAME: &'static str = "bf16";
        forward! {
            fn dot_int8(sum: __m512i, x: __m512i, w: __m512i) -> __m512i = maddubs;
            fn dot_bf16(sum: __m512, a: __m512i, b: __m512i) -> __m512 = dpbf16;
            fn to_bf16_pairs(first: __m512, second: __m512) -> __m512i = cvtne2;
        }
    }
}

avx512! {
    /// AVX-512 with what works beside the tiles of AMX: VNNI, and BF16 for conversions alone, because
    /// products of bfloat16 are those of tiles.
    Avx512Amx: ["avx512bf16", "avx512vnni"], {
        const MAX_BYTE: u8 = 255;
        const DOT_NAME: &'static str = "bf16";
        forward! {
            fn dot_int8(sum: __m512i, x: __m512i, w: __m512i) -> __m512i = _mm512_dpbusd_epi32;
            fn to_bf16_pairs(first: __m512, second: __m512) -> __m512i = cvtne2;
        }
    }
}

functions! {
    "avx512f,avx512bf16":

    fn dpbf16(sum: __m512, a: __m512i, b: __m512i) -> __m512 {
        _mm512_dpbf16_ps(sum, cast(a), cast(b))
    }

    fn cvtne2(first: __m512, second: __m512) -> __m512i {
        cast(_mm512_cvtne2ps_pbh(second, first))
    }
}

functions! {
    "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma":

    fn round(x: __m512) -> __m512 {
        _mm512_roundscale_ps::<NEAREST>(x)
    }

    fn low_bits_as_exponent(x: __m512) -> __m512 {
        _mm512_castsi512_ps(_mm512_slli_epi32::<23>(_mm512_castps_si512(x)))
    }

    fn replace_where(x: __m512, probe: __m512, value: __m512) -> __m512 {
        _mm512_mask_mov_ps(x, _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(probe, value), value)
    }

    fn reduce_add(x: __m512) -> f32 {
        let (low, high) = (_mm512_castps512_ps256(x), _mm512_extractf32x8_ps::<1>(x));
        avx2::reduce_add(_mm256_add_ps(low, high))
    }

    fn reduce_max(x: __m512) -> f32 {
        let (low, high) = (_mm512_castps512_ps256(x), _mm512_extractf32x8_ps::<1>(x));
        avx2::reduce_max(_mm256_max_ps(low, high))
    }

    fn low_halves(pairs: __m512i) -> __m512 {
        _mm512_castsi512_ps(_mm512_slli_epi32::<16>(pairs))
    }

    fn high_halves(pairs: __m512i) -> __m512 {
        _mm512_castsi512_ps(_mm512_and_si512(pairs, _mm512_set1_epi32(0xffff_0000_u32 as i32)))
    }

    fn low_nibbles(words: __m512i) -> __m512i {
        high_nibbles(_mm512_slli_epi32::<4>(words))
    }

    fn high_nibbles(words: __m512i) -> __m512i {
        _mm512_and_si512(words, _mm512_set1_epi32(HIGH_NIBBLES))
    }

    fn round_to_bf16(x: __m512) -> __m512 {
        // As with AVX2.
        let bits = _mm512_castps_si512(x);
        let even = _mm512_and_si512(_mm512_srli_epi32::<16>(bits), _mm512_set1_epi32(1));
        let rounded = _mm512_add_epi32(_mm512_add_epi32(bits, _mm512_set1_epi32(0x7fff)), even);
        let rounded = _mm512_and_si512(rounded, _mm512_set1_epi32(0xffff_0000_u32 as i32));
        let nan = _mm512_cmp_ps_mask::<_CMP_UNORD_Q>(x, x);
        _mm512_mask_mov_ps(_mm512_castsi512_ps(rounded), nan, _mm512_set1_ps(f32::NAN))
    }

    fn to_bf16_pairs(first: __m512, second: __m512) -> __m512i {
        let high = |x| _mm512_cvtepi32_epi16(_mm512_srli_epi32::<16>(_mm512_castps_si512(round_to_bf16(x))));
        _mm512_inserti64x4::<1>(_mm512_castsi256_si512(high(first)), high(second))
    }

    fn maddubs(sum: __m512i, x: __m512i, w: __m512i) -> __m512i {
        let pairs = _mm512_maddubs_epi16(x, w);
        _mm512_add_epi32(sum, _mm512_madd_epi16(pairs, _mm512_set1_epi16(1)))
    }

    fn load_rest(from: &[f32]) -> __m512 {
        // SAFETY: lanes beyond the slice are masked, so they are not read.
        unsafe { _mm512_maskz_loadu_ps(first_lanes(from.len()), from.as_ptr()) }
    }

    fn store_rest(x: __m512, to: &mut [f32]) {
        // SAFETY: lanes beyond the slice are masked, so they are not written.
        unsafe { _mm512_mask_storeu_ps(to.as_mut_ptr(), first_lanes(to.len()), x) }
    }

    fn store_bf16(x: __m512, to: &mut [u16]) {
        let high = _mm512_srli_epi32::<16>(_mm512_castps_si512(round_to_bf16(x)));
        write(_mm512_cvtepi32_epi16(high), to);
    }

    fn store_bytes(x: __m512, zero: __m512i, most: __m512i, to: &mut [u8]) {
        let integers = _mm512_add_epi32(_mm512_cvtps_epi32(x), zero);
        write(_mm512_cvtepi32_epi8(_mm512_min_epi32(integers, most)), to);
    }

    fn transpose(square: &[[u32; MAX_LANES]; MAX_LANES], to: &mut [u32]) {
        let mut rows = [_mm512_setzero_si512(); 16];
        for (row, from) in rows.iter_mut().zip(square) {
            *row = read(from);
        }
        // Each quarter of four rows is a square of four by four, which is transposed: `quarters[4 * i + c]`
        // holds, of rows 4 i to 4 i + 3, columns c, 4 + c, 8 + c and 12 + c.
        let mut quarters = rows;
        for i in (0..16).step_by(4) {
            let [a, b, c, d] = [rows[i], rows[i + 1], rows[i + 2], rows[i + 3]];
            let (low_ab, high_ab) = (_mm512_unpacklo_epi32(a, b), _mm512_unpackhi_epi32(a, b));
            let (low_cd, high_cd) = (_mm512_unpacklo_epi32(c, d), _mm512_unpackhi_epi32(c, d));
            quarters[i] = _mm512_unpacklo_epi64(low_ab, low_cd);
            quarters[i + 1] = _mm512_unpackhi_epi64(low_ab, low_cd);
            quarters[i + 2] = _mm512_unpacklo_epi64(high_ab, high_cd);
            quarters[i + 3] = _mm512_unpackhi_epi64(high_ab, high_cd);
        }
        // Then the quarters change places: 0x88 takes the even ones of two vectors, 0xdd the odd ones.
        let even = |a, b| _mm512_shuffle_i32x4::<0x88>(a, b);
        let odd = |a, b| _mm512_shuffle_i32x4::<0xdd>(a, b);
        for c in 0..4 {
            let [rows_0, rows_4, rows_8, rows_12] = [quarters[c], quarters[4 + c], quarters[8 + c], quarters[12 + c]];
            let (even_low, even_high) = (even(rows_0, rows_4), even(rows_8, rows_12));
            let (odd_low, odd_high) = (odd(rows_0, rows_4), odd(rows_8, rows_12));
            write(even(even_low, even_high), &mut to[16 * c..]);
            write(even(odd_low, odd_high), &mut to[16 * (4 + c)..]);
            write(odd(even_low, even_high), &mut to[16 * (8 + c)..]);
            write(odd(odd_low, odd_high), &mut to[16 * (12 + c)..]);
        }
    }
}

/// A mask of the first `n` lanes.
#[inline(always)]
fn first_lanes(n: usize) -> __mmask16 {
    debug_assert!(n <= 16);
    ((1_u32 << n) - 1) as __mmask16
}
