//! NEON: vectors of 128 bits, and the dot products that go with them.

use std::arch::aarch64::*;

use super::{Dots, Vector};
use crate::simd::aarch64::instructions::{bfcvtn, bfdot, bfdot_lane, prefetch};

/// FEAT_DotProd. [`gemm`](crate::gemm) has the products, which take a row's elements by lane.
pub(crate) struct Dotprod;

// SAFETY: nothing is needed beyond the vector's own instruction set.
unsafe impl Dots<float32x4_t> for Dotprod {
    const NAME: &'static str = "dotprod";
}

/// FEAT_I8MM. [`gemm`](crate::gemm) has the products, which are of two rows by two columns.
pub(crate) struct I8mm;

// SAFETY: as above.
unsafe impl Dots<float32x4_t> for I8mm {
    const NAME: &'static str = "i8mm";
}

/// FEAT_BF16.
pub(crate) struct Bf16;

// SAFETY: the caller has FEAT_BF16.
unsafe impl Dots<float32x4_t> for Bf16 {
    const NAME: &'static str = "bf16";
    const HAS_BF16: bool = true;

    #[inline(always)]
    unsafe fn bf16(sum: float32x4_t, a: int32x4_t, b: int32x4_t) -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { bfdot(sum, vreinterpretq_u16_s32(a), vreinterpretq_u16_s32(b)) }
    }

    #[inline(always)]
    unsafe fn bf16_lane<const LANE: i32>(sum: float32x4_t, a: int32x4_t, b: int32x4_t) -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { bfdot_lane::<LANE>(sum, vreinterpretq_u16_s32(a), vreinterpretq_u16_s32(b)) }
    }

    #[inline(always)]
    unsafe fn store_bf16(first: float32x4_t, second: float32x4_t, to: *mut u16) {
        // SAFETY: the caller's promise, and room for eight elements.
        unsafe { vst1q_u16(to, vcombine_u16(bfcvtn(first), bfcvtn(second))) }
    }
}

// SAFETY: pointers are read and written for the lanes named only.
unsafe impl Vector for float32x4_t {
    const LANES: usize = 4;
    // The tile of attention alone: 20 sums, five factors by lane, four columns and what widens them. Four vectors divide the usual widths
    // of heads.
    const TILE_ROWS: usize = 5;
    const TILE_VECTORS: usize = 4;
    type Ints = int32x4_t;
    const MAX_BYTE: u8 = 255;

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        // SAFETY: the trait's caller has NEON; so throughout.
        unsafe { vdupq_n_f32(x) }
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller gives four elements.
        unsafe { vld1q_f32(from) }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller gives four elements.
        unsafe { vst1q_f32(to, self) }
    }

    #[inline(always)]
    unsafe fn load_partial(from: *const f32, n: usize) -> Self {
        // SAFETY: the caller gives n elements; no others are read.
        unsafe {
            let zero = vdup_n_f32(0.0);
            match n {
                0 => vdupq_n_f32(0.0),
                1 => vcombine_f32(vld1_lane_f32::<0>(from, zero), zero),
                2 => vcombine_f32(vld1_f32(from), zero),
                3 => vcombine_f32(vld1_f32(from), vld1_lane_f32::<0>(from.add(2), zero)),
                _ => vld1q_f32(from),
            }
        }
    }

    #[inline(always)]
    unsafe fn store_partial(self, to: *mut f32, n: usize) {
        // SAFETY: the caller gives n elements; no others are written.
        unsafe {
            match n {
                0 => {}
                1 => vst1q_lane_f32::<0>(to, self),
                2 => vst1_f32(to, vget_low_f32(self)),
                3 => {
                    vst1_f32(to, vget_low_f32(self));
                    vst1q_lane_f32::<2>(to.add(2), self);
                }
                _ => vst1q_f32(to, self),
            }
        }
    }

    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vaddq_f32(self, other) }
    }

    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vsubq_f32(self, other) }
    }

    #[inline(always)]
    unsafe fn mul(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vmulq_f32(self, other) }
    }

    #[inline(always)]
    unsafe fn div(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vdivq_f32(self, other) }
    }

    #[inline(always)]
    unsafe fn fma(self, factor: Self, addend: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vfmaq_f32(addend, self, factor) }
    }

    // `fmin` gives NaN if either is, and `fminnm` the other: neither does what the trait wants.
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vbslq_f32(vcltq_f32(self, other), self, other) }
    }

    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vbslq_f32(vcgtq_f32(self, other), self, other) }
    }

    #[inline(always)]
    unsafe fn round(self) -> Self {
        // SAFETY: as in splat.
        unsafe { vrndnq_f32(self) }
    }

    #[inline(always)]
    unsafe fn scale_by_power_of_two(self, exponent: Self) -> Self {
        // SAFETY: as in splat. In two steps, so that neither factor leaves the range of normal numbers.
        unsafe {
            let exponent = vcvtnq_s32_f32(exponent);
            let half = vshrq_n_s32::<1>(exponent);
            let rest = vsubq_s32(exponent, half);
            let bias = vdupq_n_s32(127);
            let first = vreinterpretq_f32_s32(vshlq_n_s32::<23>(vaddq_s32(half, bias)));
            let second = vreinterpretq_f32_s32(vshlq_n_s32::<23>(vaddq_s32(rest, bias)));
            vmulq_f32(vmulq_f32(self, first), second)
        }
    }

    #[inline(always)]
    unsafe fn low_bits_as_exponent(self) -> Self {
        // SAFETY: as in splat.
        unsafe { vreinterpretq_f32_s32(vshlq_n_s32::<23>(vreinterpretq_s32_f32(self))) }
    }

    #[inline(always)]
    unsafe fn replace_where(self, probe: Self, value: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vbslq_f32(vceqq_f32(probe, value), value, self) }
    }

    #[inline(always)]
    unsafe fn reduce_add(self) -> f32 {
        // SAFETY: as in splat. Two pairs, then their sums.
        unsafe { vaddvq_f32(self) }
    }

    #[inline(always)]
    unsafe fn reduce_max(self) -> f32 {
        // SAFETY: as in splat.
        unsafe { vmaxvq_f32(self) }
    }

    #[inline(always)]
    unsafe fn low_halves(pairs: int32x4_t) -> Self {
        // SAFETY: as in splat.
        unsafe { vreinterpretq_f32_s32(vshlq_n_s32::<16>(pairs)) }
    }

    #[inline(always)]
    unsafe fn high_halves(pairs: int32x4_t) -> Self {
        // SAFETY: as in splat.
        unsafe { vreinterpretq_f32_s32(vandq_s32(pairs, vdupq_n_s32(0xffff_0000_u32 as i32))) }
    }

    #[inline(always)]
    unsafe fn round_to_bf16(self) -> Self {
        // SAFETY: as in splat. Half a unit of the last place is added, less one where that place is even; a NaN's payload could
        // overflow, so it becomes the quiet one.
        unsafe {
            let bits = vreinterpretq_u32_f32(self);
            let even = vandq_u32(vshrq_n_u32::<16>(bits), vdupq_n_u32(1));
            let rounded = vaddq_u32(vaddq_u32(bits, vdupq_n_u32(0x7fff)), even);
            let rounded = vandq_u32(rounded, vdupq_n_u32(0xffff_0000));
            let number = vceqq_f32(self, self);
            vbslq_f32(number, vreinterpretq_f32_u32(rounded), vdupq_n_f32(f32::NAN))
        }
    }

    #[inline(always)]
    unsafe fn store_bf16(self, to: *mut u16) {
        // SAFETY: the caller gives room for four elements.
        unsafe { vst1_u16(to, vshrn_n_u32::<16>(vreinterpretq_u32_f32(self.round_to_bf16()))) }
    }

    #[inline(always)]
    unsafe fn store_bytes(self, zero: int32x4_t, most: int32x4_t, to: *mut u8) {
        // SAFETY: the caller gives room for four elements.
        unsafe {
            let integers = vminq_s32(vaddq_s32(vcvtnq_s32_f32(self), zero), most);
            let halves = vmovn_s32(integers);
            let bytes = vreinterpret_u32_s8(vmovn_s16(vcombine_s16(halves, halves)));
            to.cast::<u32>().write_unaligned(vget_lane_u32::<0>(bytes));
        }
    }

    #[inline(always)]
    unsafe fn splat_int(x: i32) -> int32x4_t {
        // SAFETY: as in splat.
        unsafe { vdupq_n_s32(x) }
    }

    #[inline(always)]
    unsafe fn load_ints(from: *const i32) -> int32x4_t {
        // SAFETY: the caller gives four elements.
        unsafe { vld1q_s32(from) }
    }

    #[inline(always)]
    unsafe fn store_ints(integers: int32x4_t, to: *mut i32) {
        // SAFETY: the caller gives four elements.
        unsafe { vst1q_s32(to, integers) }
    }

    #[inline(always)]
    unsafe fn add_ints(a: int32x4_t, b: int32x4_t) -> int32x4_t {
        // SAFETY: as in splat.
        unsafe { vaddq_s32(a, b) }
    }

    #[inline(always)]
    unsafe fn sub_ints(a: int32x4_t, b: int32x4_t) -> int32x4_t {
        // SAFETY: as in splat.
        unsafe { vsubq_s32(a, b) }
    }

    #[inline(always)]
    unsafe fn mul_ints(a: int32x4_t, b: int32x4_t) -> int32x4_t {
        // SAFETY: as in splat.
        unsafe { vmulq_s32(a, b) }
    }

    #[inline(always)]
    unsafe fn from_ints(integers: int32x4_t) -> Self {
        // SAFETY: as in splat.
        unsafe { vcvtq_f32_s32(integers) }
    }

    #[inline(always)]
    unsafe fn dot_bytes(sum: int32x4_t, x: int32x4_t, w: int32x4_t) -> int32x4_t {
        // SAFETY: as in splat. A product of 255 * 127 fits into 16 bits.
        unsafe {
            let (x, w) = (vreinterpretq_u8_s32(x), vreinterpretq_s8_s32(w));
            let low = vmulq_s16(
                vreinterpretq_s16_u16(vmovl_u8(vget_low_u8(x))),
                vmovl_s8(vget_low_s8(w)),
            );
            let high = vmulq_s16(vreinterpretq_s16_u16(vmovl_high_u8(x)), vmovl_high_s8(w));
            vaddq_s32(sum, vpaddq_s32(vpaddlq_s16(low), vpaddlq_s16(high)))
        }
    }

    #[inline(always)]
    unsafe fn prefetch(at: *const u8) {
        prefetch(at);
    }

    const BY_LANE: bool = true;

    #[inline(always)]
    unsafe fn fma_lane<const LANE: i32>(self, factors: Self, addend: Self) -> Self {
        // SAFETY: as in splat.
        unsafe { vfmaq_laneq_f32::<LANE>(addend, self, factors) }
    }
}
