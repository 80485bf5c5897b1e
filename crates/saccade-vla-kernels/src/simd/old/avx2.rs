//! AVX2 with FMA: vectors of 256 bits, and the int8 dot products that go with them.

use std::arch::x86_64::*;

use super::{Dots, Vector};
const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

/// AVX-VNNI: the shorter encoding, of CPUs that may lack AVX-512.
pub(crate) struct VexVnni;

// SAFETY: the caller has AVX-VNNI.
unsafe impl Dots<__m256> for VexVnni {
    const NAME: &'static str = "vnni";
    const MAX_BYTE: u8 = 255;

    #[inline(always)]
    unsafe fn int8(sum: __m256i, x: __m256i, w: __m256i) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_dpbusd_avx_epi32(sum, x, w) }
    }
}

/// AVX512-VNNI with VL, on vectors of 256 bits.
pub(crate) struct EvexVnni;

// SAFETY: the caller has AVX512-VNNI and VL.
unsafe impl Dots<__m256> for EvexVnni {
    const NAME: &'static str = "vnni";
    const MAX_BYTE: u8 = 255;

    #[inline(always)]
    unsafe fn int8(sum: __m256i, x: __m256i, w: __m256i) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_dpbusd_epi32(sum, x, w) }
    }
}

/// Eight lanes from element `8 - n` on have the top bit set in the first `n`.
static FIRST_LANES: [i32; 16] = [-1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0];

#[inline(always)]
unsafe fn first_lanes(n: usize) -> __m256i {
    debug_assert!(n <= 8);
    // SAFETY: n <= 8, so that eight elements are left; the trait's caller has AVX2.
    unsafe { _mm256_loadu_si256(FIRST_LANES.as_ptr().add(8 - n).cast()) }
}

// SAFETY: pointers are read and written for the lanes named only; masked lanes are not accessed.
unsafe impl Vector for __m256 {
    const LANES: usize = 8;
    const TILE_ROWS: usize = 6;
    const TILE_VECTORS: usize = 2;
    type Ints = __m256i;
    // Two products of at most 129 * 127 are less than 2^15, where `maddubs` saturates. The other ways out cost more: 7 bits in the weights
    // lose as much (0.018 of the result instead of 0.011; this way, 0.017), 16-bit products take the time of float32.
    const MAX_BYTE: u8 = 129;

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        // SAFETY: the trait's caller has AVX2 and FMA; so throughout.
        unsafe { _mm256_set1_ps(x) }
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller gives eight elements.
        unsafe { _mm256_loadu_ps(from) }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller gives eight elements.
        unsafe { _mm256_storeu_ps(to, self) }
    }

    #[inline(always)]
    unsafe fn load_partial(from: *const f32, n: usize) -> Self {
        // SAFETY: the caller gives n elements; lanes beyond them are masked.
        unsafe { _mm256_maskload_ps(from, first_lanes(n)) }
    }

    #[inline(always)]
    unsafe fn store_partial(self, to: *mut f32, n: usize) {
        // SAFETY: the caller gives n elements; lanes beyond them are masked.
        unsafe { _mm256_maskstore_ps(to, first_lanes(n), self) }
    }

    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_add_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_sub_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_mul_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn div(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_div_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn fma(self, factor: Self, addend: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_fmadd_ps(self, factor, addend) }
    }

    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_min_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_max_ps(self, other) }
    }

    #[inline(always)]
    unsafe fn round(self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_round_ps::<NEAREST>(self) }
    }

    #[inline(always)]
    unsafe fn scale_by_power_of_two(self, exponent: Self) -> Self {
        // SAFETY: as in splat. In two steps, so that neither factor leaves the range of normal numbers.
        unsafe {
            let exponent = _mm256_cvtps_epi32(exponent);
            let half = _mm256_srai_epi32::<1>(exponent);
            let rest = _mm256_sub_epi32(exponent, half);
            let bias = _mm256_set1_epi32(127);
            let first = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(half, bias)));
            let second = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(rest, bias)));
            _mm256_mul_ps(_mm256_mul_ps(self, first), second)
        }
    }

    #[inline(always)]
    unsafe fn low_bits_as_exponent(self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_castps_si256(self))) }
    }

    #[inline(always)]
    unsafe fn replace_where(self, probe: Self, value: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_blendv_ps(self, value, _mm256_cmp_ps::<_CMP_EQ_OQ>(probe, value)) }
    }

    #[inline(always)]
    unsafe fn reduce_add(self) -> f32 {
        // SAFETY: as in splat.
        unsafe {
            let x = _mm_add_ps(_mm256_castps256_ps128(self), _mm256_extractf128_ps::<1>(self));
            let x = _mm_add_ps(x, _mm_movehl_ps(x, x));
            _mm_cvtss_f32(_mm_add_ss(x, _mm_shuffle_ps::<1>(x, x)))
        }
    }

    #[inline(always)]
    unsafe fn reduce_max(self) -> f32 {
        // SAFETY: as in splat.
        unsafe {
            let x = _mm_max_ps(_mm256_castps256_ps128(self), _mm256_extractf128_ps::<1>(self));
            let x = _mm_max_ps(x, _mm_movehl_ps(x, x));
            _mm_cvtss_f32(_mm_max_ss(x, _mm_shuffle_ps::<1>(x, x)))
        }
    }

    #[inline(always)]
    unsafe fn low_halves(pairs: __m256i) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_castsi256_ps(_mm256_slli_epi32::<16>(pairs)) }
    }

    #[inline(always)]
    unsafe fn high_halves(pairs: __m256i) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_castsi256_ps(_mm256_and_si256(pairs, _mm256_set1_epi32(0xffff_0000_u32 as i32))) }
    }

    #[inline(always)]
    unsafe fn round_to_bf16(self) -> Self {
        // SAFETY: as in splat. Half a unit of the last place is added, less one where that place is even; a NaN's payload could
        // overflow, so it becomes the quiet one.
        unsafe {
            let bits = _mm256_castps_si256(self);
            let even = _mm256_and_si256(_mm256_srli_epi32::<16>(bits), _mm256_set1_epi32(1));
            let rounded = _mm256_add_epi32(_mm256_add_epi32(bits, _mm256_set1_epi32(0x7fff)), even);
            let rounded = _mm256_and_si256(rounded, _mm256_set1_epi32(0xffff_0000_u32 as i32));
            let nan = _mm256_cmp_ps::<_CMP_UNORD_Q>(self, self);
            _mm256_blendv_ps(_mm256_castsi256_ps(rounded), _mm256_set1_ps(f32::NAN), nan)
        }
    }

    #[inline(always)]
    unsafe fn store_bf16(self, to: *mut u16) {
        // SAFETY: the caller gives room for eight elements. Packing works within halves of the vector, which are then put in order.
        unsafe {
            let high = _mm256_srli_epi32::<16>(_mm256_castps_si256(self.round_to_bf16()));
            let packed = _mm256_permute4x64_epi64::<0b1000>(_mm256_packus_epi32(high, high));
            _mm_storeu_si128(to.cast(), _mm256_castsi256_si128(packed));
        }
    }

    #[inline(always)]
    unsafe fn store_bytes(self, zero: __m256i, most: __m256i, to: *mut u8) {
        // SAFETY: the caller gives room for eight elements.
        unsafe {
            let integers = _mm256_add_epi32(_mm256_cvtps_epi32(self), zero);
            let integers = _mm256_min_epi32(integers, most);
            let low = _mm256_castsi256_si128(integers);
            let halves = _mm_packus_epi32(low, _mm256_extracti128_si256::<1>(integers));
            _mm_storel_epi64(to.cast(), _mm_packus_epi16(halves, halves));
        }
    }

    #[inline(always)]
    unsafe fn splat_int(x: i32) -> __m256i {
        // SAFETY: as in splat.
        unsafe { _mm256_set1_epi32(x) }
    }

    #[inline(always)]
    unsafe fn load_ints(from: *const i32) -> __m256i {
        // SAFETY: the caller gives eight elements.
        unsafe { _mm256_loadu_si256(from.cast()) }
    }

    #[inline(always)]
    unsafe fn store_ints(integers: __m256i, to: *mut i32) {
        // SAFETY: the caller gives eight elements.
        unsafe { _mm256_storeu_si256(to.cast(), integers) }
    }

    #[inline(always)]
    unsafe fn add_ints(a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: as in splat.
        unsafe { _mm256_add_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn sub_ints(a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: as in splat.
        unsafe { _mm256_sub_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn mul_ints(a: __m256i, b: __m256i) -> __m256i {
        // SAFETY: as in splat.
        unsafe { _mm256_mullo_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn from_ints(integers: __m256i) -> Self {
        // SAFETY: as in splat.
        unsafe { _mm256_cvtepi32_ps(integers) }
    }

    #[inline(always)]
    unsafe fn dot_bytes(sum: __m256i, x: __m256i, w: __m256i) -> __m256i {
        // SAFETY: as in splat.
        unsafe {
            let pairs = _mm256_maddubs_epi16(x, w);
            _mm256_add_epi32(sum, _mm256_madd_epi16(pairs, _mm256_set1_epi16(1)))
        }
    }

    #[inline(always)]
    unsafe fn prefetch(at: *const u8) {
        // SAFETY: prefetching never faults, whatever the address.
        unsafe { _mm_prefetch::<_MM_HINT_T1>(at.cast()) }
    }
}
