//! Rows quantised to bytes, as the instructions of NEON take them.

use std::arch::aarch64::*;
use std::ops::Range;

use super::pairs::place;
use crate::gemm::dot_int8::{Quantization, row_quantization};
use crate::gemm::{Quantized, Source, odd_lines};
use crate::simd::{Kernel, NoDots, Simd, load};

/// What [`Quantized::zero`] is less by, and bytes with it, where an instruction takes signed ones: their products stay the same.
const SIGNED: i32 = 128;

/// Rows of bytes: signed, one row after the other; or unsigned, two rows alternating by eight bytes.
pub(super) struct Quantizing<'a> {
    pub source: &'a Source,
    pub rows: Range<usize>,
    pub in_pairs: bool,
}

impl Kernel for Quantizing<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (source, width) = (self.source, self.source.in_features);
        let stride = odd_lines(width, 4);
        for row in self.rows {
            // SAFETY: the contract of `Gemm::convert`: rows are in the source, and have room in whole pairs and lines; kernels are called
            // within `Simd::run`.
            unsafe {
                let x = source.x.offset(row as isize * source.x_stride);
                let apart = source.outliers.map(|outliers| outliers.add(row));
                let Quantization { quantized, inverse } =
                    row_quantization::<float32x4_t, NoDots>(x, width, apart);
                let outliers = || apart.into_iter().flat_map(|apart| (*apart).iter());
                let zero = quantized.zero;
                let to = source.words;
                if self.in_pairs {
                    source.quantized.add(row).write(quantized);
                    let pair = to.add((row & !1) * stride).cast();
                    for i in (0..width).step_by(4) {
                        let bytes = four_bytes(load(x.add(i), 4.min(width - i)), inverse, zero, 255);
                        place(pair, row, i).cast::<u32>().write_unaligned(bytes);
                    }
                    outliers().for_each(|(input, _)| place(pair, row, input).write(zero as u8));
                } else {
                    let zero = zero.wrapping_sub(SIGNED);
                    source.quantized.add(row).write(Quantized { zero, ..quantized });
                    let to = to.add(row * stride);
                    for i in (0..width).step_by(4) {
                        let bytes = four_bytes(load(x.add(i), 4.min(width - i)), inverse, zero, 255 - SIGNED);
                        to.add(i / 4).write(bytes);
                    }
                    outliers().for_each(|(input, _)| to.cast::<u8>().add(input).write(zero as u8));
                }
            }
        }
    }
}

/// `zero + round(x * inverse)`, ties to even, and `most` where that is more.
///
/// # Safety
/// The CPU has NEON.
#[inline(always)]
unsafe fn four_bytes(x: float32x4_t, inverse: f32, zero: i32, most: i32) -> u32 {
    // SAFETY: the caller's promise.
    unsafe {
        let steps = vcvtnq_s32_f32(vmulq_n_f32(x, inverse));
        let steps = vminq_s32(vaddq_s32(steps, vdupq_n_s32(zero)), vdupq_n_s32(most));
        let halves = vmovn_s32(steps);
        let bytes = vmovn_s16(vcombine_s16(halves, halves));
        vget_lane_u32::<0>(vreinterpret_u32_s8(bytes))
    }
}
