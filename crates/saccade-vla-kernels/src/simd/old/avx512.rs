//! AVX-512 F, VL, BW and DQ: vectors of 512 bits, and the dot products of bfloat16 and int8 that go with them.

use std::arch::x86_64::*;
use std::mem::transmute;

use super::{Dots, MAX_LANES, Vector};
const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

/// AVX512-VNNI.
pub(crate) struct Vnni;

// SAFETY: the caller has AVX512-VNNI.
unsafe impl Dots<__m512> for Vnni {
    const NAME: &'static str = "vnni";
    const MAX_BYTE: u8 = 255;

    #[inline(always)]
    unsafe fn int8(sum: __m512i, x: __m512i, w: __m512i) -> __m512i {
        // SAFETY: the caller's promise.
        unsafe { _mm512_dpbusd_epi32(sum, x, w) }
    }
}

/// AVX512-BF16.
pub(crate) struct Bf16;

// SAFETY: the caller has AVX512-BF16.
unsafe impl Dots<__m512> for Bf16 {
    const NAME: &'static str = "bf16";
    const HAS_BF16: bool = true;

    #[inline(always)]
    unsafe fn bf16(sum: __m512, a: __m512i, b: __m512i) -> __m512 {
        // SAFETY: the caller's promise; both types are 512 bits of which all values are valid.
        unsafe {
            _mm512_dpbf16_ps(
                sum,
                transmute::<__m512i, __m512bh>(a),
                transmute::<__m512i, __m512bh>(b),
            )
        }
    }

    #[inline(always)]
    unsafe fn store_bf16(first: __m512, second: __m512, to: *mut u16) {
        // SAFETY: as above.
        unsafe {
            let pairs = transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(second, first));
            _mm512_storeu_si512(to.cast(), pairs);
        }
    }
}

/// AVX512-VNNI, and AVX512-BF16 for conversions alone: the products of bfloat16 are those of tiles.
pub(crate) struct BesideTiles;

// SAFETY: the caller has AVX512-VNNI and AVX512-BF16.
unsafe impl Dots<__m512> for BesideTiles {
    const NAME: &'static str = "bf16";
    const MAX_BYTE: u8 = 255;

    #[inline(always)]
    unsafe fn store_bf16(first: __m512, second: __m512, to: *mut u16) {
        // SAFETY: the caller's promise.
        unsafe { Bf16::store_bf16(first, second, to) }
    }

    #[inline(always)]
    unsafe fn int8(sum: __m512i, x: __m512i, w: __m512i) -> __m512i {
        // SAFETY: as above.
        unsafe { Vnni::int8(sum, x, w) }
    }
}

#[inline(always)]
fn first_lanes_mask(n: usize) -> __mmask16 {
    debug_assert!(n <= 16);
    ((1_u32 << n) - 1) as __mmask16
}

// SAFETY: pointers are read and written for the lanes named only; masked lanes are not accessed.
unsafe impl Vector for __m512 {
    const LANES: usize = 16;
    const TILE_ROWS: usize = 8;
    const TILE_VECTORS: usize = 3;
    type Ints = __m512i;
    // As with AVX2.
    const MAX_BYTE: u8 = 129;

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        // SAFETY: the trait's caller has AVX-512; so throughout.
        unsafe { _mm512_set1_ps(x) }
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller gives sixteen elements.
        unsafe { _mm512_loadu_ps(from) }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller gives sixteen elements.
        unsafe { _mm512_storeu_ps(to, self) }
    }

    #[inline(always)]
    unsafe fn load_partial(from: *const f32, n: usize) -> Self {
        // SAFETY: the caller gives n elements; lanes beyond them are masked.
        unsafe { _mm512_maskz_loadu_ps(first_lanes_mask(n), from) }
    }

    #[inline(always)]
    unsafe fn store_partial(self, to: *mut f32, n: usize) {
        // SAFETY: the caller gives n elements; lanes beyond them are masked.
        unsafe { _mm512_mask_storeu_ps(to, first_lanes_mask(n), self) }
    }

    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_add_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_sub_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_mul_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn div(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_div_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn fma(self, factor: Self, addend: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_fmadd_ps(self, factor, addend) }
    }

    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_min_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_max_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn round(self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_roundscale_ps::<NEAREST>(self) }
    }

    #[inline(always)]
    unsafe fn scale_by_power_of_two(self, exponent: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_scalef_ps(self, exponent) }
    }

    #[inline(always)]
    unsafe fn low_bits_as_exponent(self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_castsi512_ps(_mm512_slli_epi32::<23>(_mm512_castps_si512(self))) }
    }

    #[inline(always)]
    unsafe fn replace_where(self, probe: Self, value: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_mask_mov_ps(self, _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(probe, value), value) }
    }

    #[inline(always)]
    unsafe fn reduce_add(self) -> f32 {
        // SAFETY: as in splat.
        unsafe {
            let low = _mm512_castps512_ps256(self);
            let high = _mm512_extractf32x8_ps::<1>(self);
            _mm256_add_ps(low, high).reduce_add()
        }
    }

    #[inline(always)]
    unsafe fn reduce_max(self) -> f32 {
        // SAFETY: as in splat.
        unsafe {
            let low = _mm512_castps512_ps256(self);
            let high = _mm512_extractf32x8_ps::<1>(self);
            _mm256_max_ps(low, high).reduce_max()
        }
    }

    #[inline(always)]
    unsafe fn low_halves(pairs: __m512i) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_castsi512_ps(_mm512_slli_epi32::<16>(pairs)) }
    }

    #[inline(always)]
    unsafe fn high_halves(pairs: __m512i) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_castsi512_ps(_mm512_and_si512(pairs, _mm512_set1_epi32(0xffff_0000_u32 as i32))) }
    }

    #[inline(always)]
    unsafe fn round_to_bf16(self) -> Self {
        // SAFETY: as in splat. As with AVX2.
        unsafe {
            let bits = _mm512_castps_si512(self);
            let even = _mm512_and_si512(_mm512_srli_epi32::<16>(bits), _mm512_set1_epi32(1));
            let rounded = _mm512_add_epi32(_mm512_add_epi32(bits, _mm512_set1_epi32(0x7fff)), even);
            let rounded = _mm512_and_si512(rounded, _mm512_set1_epi32(0xffff_0000_u32 as i32));
            let nan = _mm512_cmp_ps_mask::<_CMP_UNORD_Q>(self, self);
            _mm512_mask_mov_ps(_mm512_castsi512_ps(rounded), nan, _mm512_set1_ps(f32::NAN))
        }
    }

    #[inline(always)]
    unsafe fn store_bf16(self, to: *mut u16) {
        // SAFETY: the caller gives room for sixteen elements.
        unsafe {
            let high = _mm512_srli_epi32::<16>(_mm512_castps_si512(self.round_to_bf16()));
            _mm256_storeu_si256(to.cast(), _mm512_cvtepi32_epi16(high));
        }
    }

    #[inline(always)]
    unsafe fn store_bytes(self, zero: __m512i, most: __m512i, to: *mut u8) {
        // SAFETY: the caller gives room for sixteen elements.
        unsafe {
            let integers = _mm512_add_epi32(_mm512_cvtps_epi32(self), zero);
            let integers = _mm512_min_epi32(integers, most);
            _mm_storeu_si128(to.cast(), _mm512_cvtepi32_epi8(integers));
        }
    }

    #[inline(always)]
    unsafe fn splat_int(x: i32) -> __m512i {
        // SAFETY: as in splat.
        unsafe { _mm512_set1_epi32(x) }
    }

    #[inline(always)]
    unsafe fn load_ints(from: *const i32) -> __m512i {
        // SAFETY: the caller gives sixteen elements.
        unsafe { _mm512_loadu_si512(from.cast()) }
    }

    #[inline(always)]
    unsafe fn store_ints(integers: __m512i, to: *mut i32) {
        // SAFETY: the caller gives sixteen elements.
        unsafe { _mm512_storeu_si512(to.cast(), integers) }
    }

    #[inline(always)]
    unsafe fn add_ints(a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: as in splat.
        unsafe { _mm512_add_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn sub_ints(a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: as in splat.
        unsafe { _mm512_sub_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn mul_ints(a: __m512i, b: __m512i) -> __m512i {
        // SAFETY: as in splat.
        unsafe { _mm512_mullo_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn from_ints(integers: __m512i) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm512_cvtepi32_ps(integers) }
    }

    #[inline(always)]
    unsafe fn dot_bytes(sum: __m512i, x: __m512i, w: __m512i) -> __m512i {
        // SAFETY: as in splat.
        unsafe {
            let pairs = _mm512_maddubs_epi16(x, w);
            _mm512_add_epi32(sum, _mm512_madd_epi16(pairs, _mm512_set1_epi16(1)))
        }
    }

    #[inline(always)]
    unsafe fn transpose(square: &[[u32; MAX_LANES]; MAX_LANES], to: &mut [u32]) {
        assert_eq!(to.len(), 16 * 16);
        // SAFETY: as in splat; rows of both have sixteen words.
        unsafe {
            let mut rows = [_mm512_setzero_si512(); 16];
            for (row, from) in rows.iter_mut().zip(square) {
                *row = _mm512_loadu_si512(from.as_ptr().cast());
            }
            // Each quarter of four rows is a square of four by four, which is transposed: `quarters[4 * i + c]` holds, of rows 4 i to 4 i + 3,
            // columns c, 4 + c, 8 + c and 12 + c.
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
            for c in 0..4 {
                let [rows_0, rows_4, rows_8, rows_12] =
                    [quarters[c], quarters[4 + c], quarters[8 + c], quarters[12 + c]];
                let even = [
                    _mm512_shuffle_i32x4::<0x88>(rows_0, rows_4),
                    _mm512_shuffle_i32x4::<0x88>(rows_8, rows_12),
                ];
                let odd = [
                    _mm512_shuffle_i32x4::<0xdd>(rows_0, rows_4),
                    _mm512_shuffle_i32x4::<0xdd>(rows_8, rows_12),
                ];
                let columns = [
                    _mm512_shuffle_i32x4::<0x88>(even[0], even[1]),
                    _mm512_shuffle_i32x4::<0x88>(odd[0], odd[1]),
                    _mm512_shuffle_i32x4::<0xdd>(even[0], even[1]),
                    _mm512_shuffle_i32x4::<0xdd>(odd[0], odd[1]),
                ];
                for (quarter, column) in columns.into_iter().enumerate() {
                    let row = &mut to[16 * (4 * quarter + c)..][..16];
                    _mm512_storeu_si512(row.as_mut_ptr().cast(), column);
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn prefetch(at: *const u8) {
        // SAFETY: prefetching never faults, whatever the address.
        unsafe { _mm_prefetch::<_MM_HINT_T1>(at.cast()) }
    }
}
