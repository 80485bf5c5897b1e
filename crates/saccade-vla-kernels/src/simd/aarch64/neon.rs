//! NEON: vectors of 128 bits, and the dot products that go with them.

use std::arch::aarch64::*;
// Operations that are one instruction.
use std::arch::aarch64::{
    vaddq_f32 as add, vaddq_s32 as add_i32, vaddvq_f32 as reduce_add, vcvtq_f32_s32 as to_f32,
    vdivq_f32 as div, vdupq_n_f32 as splat, vdupq_n_s32 as splat_i32, vmaxvq_f32 as reduce_max,
    vmulq_f32 as mul, vmulq_s32 as mul_i32, vrndnq_f32 as round, vsubq_f32 as sub, vsubq_s32 as sub_i32,
};
use std::arch::is_aarch64_feature_detected;

use super::instructions::{bfcvtn, bfdot, bfdot_lane, prefetch};
use crate::simd::bits::{Bits, are_bits, cast, write};
use crate::simd::{HIGH_NIBBLES, Kernel, Simd, forward, functions, token};

are_bits!(float32x4_t, int32x4_t, uint16x4_t, uint16x8_t);

/// A token of these vectors, with what it adds to NEON.
macro_rules! neon {
    ($(#[$doc:meta])* $name:ident: [$($feature:tt),*], { $($own:tt)* }) => {
        token! {
            $(#[$doc])*
            $name: is_aarch64_feature_detected["neon" $(, $feature)*], {
                const NAME: &'static str = "neon";
                const LANES: usize = 4;
                // The tile of attention alone: 20 sums, five factors by lane, four columns and what widens
                // them. Four vectors divide the usual widths of heads.
                const TILE_ROWS: usize = 5;
                const TILE_VECTORS: usize = 4;
                const BY_LANE: bool = true;
                const MAX_BYTE: u8 = 255;
                type F32 = float32x4_t;
                type I32 = int32x4_t;
                forward! {
                    fn fma_lane<const LANE: i32>(a: float32x4_t, b: float32x4_t, addend: float32x4_t) -> float32x4_t = fma_lane;
                    fn dot_int8(sum: int32x4_t, x: int32x4_t, w: int32x4_t) -> int32x4_t = dot_int8;
                }
                $($own)*
            }
        }
    };
}

neon! {
    /// NEON, which every 64-bit ARM has.
    Neon: [], {
        forward! { fn to_bf16_pairs(first: float32x4_t, second: float32x4_t) -> int32x4_t = to_bf16_pairs; }
    }
}

neon! {
    /// NEON with dot products of int8. [`gemm`](crate::gemm) has the products, which take a row's elements by
    /// lane.
    NeonDotprod: ["dotprod"], {
        forward! { fn to_bf16_pairs(first: float32x4_t, second: float32x4_t) -> int32x4_t = to_bf16_pairs; }
        const DOT_NAME: &'static str = "dotprod";
    }
}

neon! {
    /// NEON with products of matrices of int8. [`gemm`](crate::gemm) has the products, which are of two rows
    /// by two columns.
    NeonI8mm: ["i8mm"], {
        forward! { fn to_bf16_pairs(first: float32x4_t, second: float32x4_t) -> int32x4_t = to_bf16_pairs; }
        const DOT_NAME: &'static str = "i8mm";
    }
}

neon! {
    /// NEON with products of bfloat16.
    NeonBf16: ["bf16"], {
        const HAS_DOT_BF16: bool = true;
        const DOT_NAME: &'static str = "bf16";
        forward! {
            fn dot_bf16(sum: float32x4_t, a: int32x4_t, b: int32x4_t) -> float32x4_t = dot_bf16;
            fn dot_bf16_lane<const LANE: i32>(sum: float32x4_t, a: int32x4_t, b: int32x4_t) -> float32x4_t = dot_bf16_lane;
            fn to_bf16_pairs(first: float32x4_t, second: float32x4_t) -> int32x4_t = bfcvtn_pairs;
        }
    }
}

functions! {
    "neon,bf16":

    fn dot_bf16(sum: float32x4_t, a: int32x4_t, b: int32x4_t) -> float32x4_t {
        // SAFETY: the feature is on.
        unsafe { bfdot(sum, cast(a), cast(b)) }
    }

    fn dot_bf16_lane<const LANE: i32>(sum: float32x4_t, a: int32x4_t, b: int32x4_t) -> float32x4_t {
        // SAFETY: the feature is on.
        unsafe { bfdot_lane::<LANE>(sum, cast(a), cast(b)) }
    }

    fn bfcvtn_pairs(first: float32x4_t, second: float32x4_t) -> int32x4_t {
        // SAFETY: the feature is on.
        let (first, second) = unsafe { (bfcvtn(first), bfcvtn(second)) };
        cast(vcombine_u16(first, second))
    }
}

functions! {
    "neon":

    fn fma(a: float32x4_t, b: float32x4_t, addend: float32x4_t) -> float32x4_t {
        vfmaq_f32(addend, a, b)
    }

    fn fma_lane<const LANE: i32>(a: float32x4_t, b: float32x4_t, addend: float32x4_t) -> float32x4_t {
        vfmaq_laneq_f32::<LANE>(addend, a, b)
    }

    fn min(a: float32x4_t, b: float32x4_t) -> float32x4_t {
        // `fmin` gives NaN if either is, and `fminnm` the other: neither does what the trait wants.
        vbslq_f32(vcltq_f32(a, b), a, b)
    }

    fn max(a: float32x4_t, b: float32x4_t) -> float32x4_t {
        vbslq_f32(vcgtq_f32(a, b), a, b)
    }

    fn scale_by_power_of_two(x: float32x4_t, exponent: float32x4_t) -> float32x4_t {
        // In two steps, so that neither factor leaves the range of normal numbers.
        let exponent = vcvtnq_s32_f32(exponent);
        let half = vshrq_n_s32::<1>(exponent);
        let rest = vsubq_s32(exponent, half);
        let bias = vdupq_n_s32(127);
        let first = vreinterpretq_f32_s32(vshlq_n_s32::<23>(vaddq_s32(half, bias)));
        let second = vreinterpretq_f32_s32(vshlq_n_s32::<23>(vaddq_s32(rest, bias)));
        vmulq_f32(vmulq_f32(x, first), second)
    }

    fn low_bits_as_exponent(x: float32x4_t) -> float32x4_t {
        vreinterpretq_f32_s32(vshlq_n_s32::<23>(vreinterpretq_s32_f32(x)))
    }

    fn replace_where(x: float32x4_t, probe: float32x4_t, value: float32x4_t) -> float32x4_t {
        vbslq_f32(vceqq_f32(probe, value), value, x)
    }

    fn low_halves(pairs: int32x4_t) -> float32x4_t {
        vreinterpretq_f32_s32(vshlq_n_s32::<16>(pairs))
    }

    fn high_halves(pairs: int32x4_t) -> float32x4_t {
        vreinterpretq_f32_s32(vandq_s32(pairs, vdupq_n_s32(0xffff_0000_u32 as i32)))
    }

    fn low_nibbles(words: int32x4_t) -> int32x4_t {
        vreinterpretq_s32_s8(vshlq_n_s8::<4>(vreinterpretq_s8_s32(words)))
    }

    fn high_nibbles(words: int32x4_t) -> int32x4_t {
        vandq_s32(words, vdupq_n_s32(HIGH_NIBBLES))
    }

    fn round_to_bf16(x: float32x4_t) -> float32x4_t {
        // Half a unit of the last place is added, less one where that place is even; a NaN's payload could
        // overflow, so it becomes the quiet one.
        let bits = vreinterpretq_u32_f32(x);
        let even = vandq_u32(vshrq_n_u32::<16>(bits), vdupq_n_u32(1));
        let rounded = vaddq_u32(vaddq_u32(bits, vdupq_n_u32(0x7fff)), even);
        let rounded = vandq_u32(rounded, vdupq_n_u32(0xffff_0000));
        vbslq_f32(vceqq_f32(x, x), vreinterpretq_f32_u32(rounded), vdupq_n_f32(f32::NAN))
    }

    fn bf16_bits(x: float32x4_t) -> uint16x4_t {
        vshrn_n_u32::<16>(vreinterpretq_u32_f32(round_to_bf16(x)))
    }

    fn to_bf16_pairs(first: float32x4_t, second: float32x4_t) -> int32x4_t {
        cast(vcombine_u16(bf16_bits(first), bf16_bits(second)))
    }

    fn dot_int8(sum: int32x4_t, x: int32x4_t, w: int32x4_t) -> int32x4_t {
        // A product of 255 * 127 fits into 16 bits.
        let (x, w) = (vreinterpretq_u8_s32(x), vreinterpretq_s8_s32(w));
        let low = vmulq_s16(vreinterpretq_s16_u16(vmovl_u8(vget_low_u8(x))), vmovl_s8(vget_low_s8(w)));
        let high = vmulq_s16(vreinterpretq_s16_u16(vmovl_high_u8(x)), vmovl_high_s8(w));
        vaddq_s32(sum, vpaddq_s32(vpaddlq_s16(low), vpaddlq_s16(high)))
    }

    fn load_rest(from: &[f32]) -> float32x4_t {
        let zero = vdupq_n_f32(0.0);
        match *from {
            [] => zero,
            [a] => vsetq_lane_f32::<0>(a, zero),
            [a, b] => vsetq_lane_f32::<1>(b, vsetq_lane_f32::<0>(a, zero)),
            [a, b, c, ..] => vsetq_lane_f32::<2>(c, vsetq_lane_f32::<1>(b, vsetq_lane_f32::<0>(a, zero))),
        }
    }

    fn store_rest(x: float32x4_t, to: &mut [f32]) {
        for (element, lane) in to.iter_mut().zip(cast::<_, [f32; 4]>(x)) {
            *element = lane;
        }
    }

    fn store_bf16(x: float32x4_t, to: &mut [u16]) {
        write(bf16_bits(x), to);
    }

    fn store_bytes(x: float32x4_t, zero: int32x4_t, most: int32x4_t, to: &mut [u8]) {
        let integers = vminq_s32(vaddq_s32(vcvtnq_s32_f32(x), zero), most);
        let halves = vmovn_s32(integers);
        let bytes = vreinterpret_u32_s8(vmovn_s16(vcombine_s16(halves, halves)));
        write(vget_lane_u32::<0>(bytes), to);
    }
}
