//! Products of bytes, with the bits of every other instruction set that has eight of them: by `usmmla`, which multiplies two rows by two
//! columns over eight `k`; by `sdot` over four, by lane; or by widening multiplications, which every CPU has.

use std::arch::aarch64::*;
use std::ops::Range;

use super::by_lane::{self, ByLane};
use super::chains::{Chains, Link};
use super::pairs::{self, Pairwise};
use super::quantizing::Quantizing;
use super::tile::{COLUMNS, Step, multiply, panel_words, shape};
use crate::gemm::outliers::MultiplyOutliers;
use crate::gemm::{Block, Gemm, PanelMut, Shape, Source, odd_lines, panel};
use crate::simd::aarch64::instructions::{sdot_lane, usmmla};
use crate::simd::aarch64::neon::{Neon, NeonDotprod, NeonI8mm};
use crate::simd::{Kernel, Simd};
use crate::weights::WeightRef;

/// Unsigned rows by signed weights, `usmmla`.
pub(crate) struct Usmmla(NeonI8mm);

/// Signed rows by signed weights, `sdot`.
pub(crate) struct Sdot(NeonDotprod);

/// Signed rows by signed weights, `smull`, `smlal2` and `sadalp`.
pub(crate) struct Widening(Neon);

/// A product of signed rows, or of unsigned ones in pairs.
macro_rules! product {
    ($product:ident, $simd:ident, $step:ident, $vectors:expr, $pack:path, in_pairs: $in_pairs:literal, $run:ident) => {
        // SAFETY: the value holds the proof of its instruction set; `convert` and `multiply` keep to their rows and block.
        unsafe impl Gemm for $product {
            fn new() -> Option<Self> {
                $simd::new().map(Self)
            }

            fn shape(&self) -> Shape {
                shape::<$simd, $step>()
            }

            fn panel_words(&self, in_features: usize) -> usize {
                panel_words::<$simd, $step>(in_features)
            }

            fn pack(&self, weight: WeightRef<'_>, first: usize, panel: PanelMut<'_>) {
                $pack(weight, first, COLUMNS, panel);
            }

            fn converted_stride(&self, in_features: usize) -> Option<usize> {
                Some(odd_lines(in_features, 4))
            }

            unsafe fn convert(&self, source: &Source, rows: Range<usize>) {
                let in_pairs = $in_pairs;
                self.0.run(Quantizing { source, rows, in_pairs });
            }

            unsafe fn multiply(&self, block: &Block<'_>) {
                self.0.run($run(block));
            }

            fn multiply_outliers(&self, outliers: MultiplyOutliers<'_>) {
                let run = if $in_pairs { 2 } else { 1 };
                self.0.run(MultiplyOutliers { run, ..outliers });
            }

            fn chains(&self) -> usize {
                self.0.run(Chains::<$step>::new())
            }
        }

        /// The sums of a block.
        struct $run<'a>(&'a Block<'a>);

        impl Kernel for $run<'_> {
            type Output = ();

            #[inline(always)]
            fn run<S: Simd>(self, _: S) {
                // SAFETY: the contract of `Gemm::multiply`.
                unsafe { multiply::<S, $step, { $vectors }>(self.0) }
            }
        }
    };
}

product!(Usmmla, NeonI8mm, UsmmlaStep, pairs::VECTORS, panel::pack_int8_in_eights, in_pairs: true, UsmmlaRun);
product!(Sdot, NeonDotprod, SdotStep, by_lane::VECTORS, panel::pack_int8, in_pairs: false, SdotRun);
product!(Widening, Neon, WideningStep, by_lane::VECTORS, panel::pack_int8, in_pairs: false, WideningRun);

/// What sums of integers have in common.
macro_rules! integer_sums {
    () => {
        // Integers lose nothing.
        const PART_STEPS: usize = usize::MAX / 2;
        type Sum = int32x4_t;

        #[inline(always)]
        unsafe fn zero() -> int32x4_t {
            // SAFETY: the caller's promise; so throughout.
            unsafe { vdupq_n_s32(0) }
        }

        #[inline(always)]
        unsafe fn add(a: int32x4_t, b: int32x4_t) -> int32x4_t {
            // SAFETY: as above.
            unsafe { vaddq_s32(a, b) }
        }
    };
}

/// Sums of rows by lane, which are in memory as in registers.
macro_rules! sums_by_lane {
    () => {
        const DEPTH: usize = 16;
        const ROW_GROUP: usize = 1;
        const PANEL_WORDS: usize = 4 * COLUMNS;
        integer_sums!();

        #[inline(always)]
        unsafe fn load(from: *const u32, v: usize, _: usize) -> int32x4_t {
            // SAFETY: as above.
            unsafe { vld1q_s32(from.add(v * 4).cast()) }
        }

        #[inline(always)]
        unsafe fn store(sum: int32x4_t, to: *mut u32, v: usize, _: usize) {
            // SAFETY: as above.
            unsafe { vst1q_s32(to.add(v * 4).cast(), sum) }
        }
    };
}

struct UsmmlaStep;

impl Pairwise for UsmmlaStep {
    type Sum = int32x4_t;

    #[inline(always)]
    unsafe fn multiply_add(sum: int32x4_t, rows: uint32x4_t, columns: uint32x4_t) -> int32x4_t {
        // SAFETY: the caller's promise.
        unsafe { usmmla(sum, vreinterpretq_u8_u32(rows), vreinterpretq_s8_u32(columns)) }
    }
}

impl<S: Simd> Step<S> for UsmmlaStep {
    const DEPTH: usize = 8;
    const ROW_GROUP: usize = 2;
    const GROUPS: usize = 4;
    const PANEL_WORDS: usize = 2 * COLUMNS;
    integer_sums!();

    #[inline(always)]
    unsafe fn load(from: *const u32, v: usize, rows: usize) -> int32x4_t {
        // SAFETY: as above.
        unsafe { vreinterpretq_s32_u32(pairs::load(from, v, rows)) }
    }

    #[inline(always)]
    unsafe fn store(sum: int32x4_t, to: *mut u32, v: usize, rows: usize) {
        // SAFETY: as above.
        unsafe { pairs::store(vreinterpretq_u32_s32(sum), to, v, rows) }
    }

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[int32x4_t; NV]; MR],
        x: &[*const u32; MR],
        beyond: usize,
        weights: *const u32,
    ) {
        // SAFETY: the caller's promise.
        unsafe { pairs::multiply_add::<Self, NV, MR>(sums, x, beyond, weights) }
    }
}

struct SdotStep;

impl ByLane for SdotStep {
    type Sum = int32x4_t;

    #[inline(always)]
    unsafe fn multiply_add<const LANE: i32>(sum: int32x4_t, weights: uint32x4_t, x: uint32x4_t) -> int32x4_t {
        // SAFETY: the caller's promise.
        unsafe { sdot_lane::<LANE>(sum, vreinterpretq_s8_u32(weights), vreinterpretq_s8_u32(x)) }
    }
}

impl<S: Simd> Step<S> for SdotStep {
    // With seven rows, as of float32, compilers spill: 82 instead of 92 % of the throughput that llvm-mca predicts for the Cortex-A76.
    const GROUPS: usize = 6;
    sums_by_lane!();

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[int32x4_t; NV]; MR],
        x: &[*const u32; MR],
        beyond: usize,
        weights: *const u32,
    ) {
        // SAFETY: the caller's promise.
        unsafe { by_lane::multiply_add::<Self, NV, MR>(sums, x, beyond, weights) }
    }
}

struct WideningStep;

impl WideningStep {
    /// `sum` and four products of each lane, in two halves: of `k` 0 and 1 of a word with the low halves of `x` and `w`, of another word's
    /// with the high ones. Two products of at most 128 * 127 fit into 16 bits.
    ///
    /// # Safety
    /// The CPU has NEON.
    #[inline(always)]
    unsafe fn four(sum: int32x4_t, low_x: int8x16_t, high_x: int8x16_t, w: int8x16_t) -> int32x4_t {
        // SAFETY: the caller's promise.
        unsafe {
            let products = vmull_s8(vget_low_s8(low_x), vget_low_s8(w));
            vpadalq_s16(sum, vmlal_high_s8(products, high_x, w))
        }
    }

    /// Half a step: two words of each row, in lanes `4 * HALF ..` of 16 bits.
    ///
    /// # Safety
    /// As [`Step::multiply_add`], with half as many words of weights.
    #[inline(always)]
    unsafe fn two_words<
        const NV: usize,
        const MR: usize,
        const A: i32,
        const B: i32,
        const C: i32,
        const D: i32,
    >(
        sums: &mut [[int32x4_t; NV]; MR],
        rows: &[int16x8_t; MR],
        weights: *const u32,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let (mut even, mut odd) = ([vdupq_n_s8(0); NV], [vdupq_n_s8(0); NV]);
            for v in 0..NV {
                // `k` 0 and 1 of each column of the first word, then of the second; and 2 and 3.
                let first = vld1q_s16(weights.add(v * 4).cast());
                let second = vld1q_s16(weights.add((NV + v) * 4).cast());
                even[v] = vreinterpretq_s8_s16(vuzp1q_s16(first, second));
                odd[v] = vreinterpretq_s8_s16(vuzp2q_s16(first, second));
            }
            for r in 0..MR {
                let x = [
                    vdupq_laneq_s16::<A>(rows[r]),
                    vdupq_laneq_s16::<B>(rows[r]),
                    vdupq_laneq_s16::<C>(rows[r]),
                    vdupq_laneq_s16::<D>(rows[r]),
                ];
                let [a, b, c, d] = x.map(|x| vreinterpretq_s8_s16(x));
                for v in 0..NV {
                    let sum = Self::four(sums[r][v], a, c, even[v]);
                    sums[r][v] = Self::four(sum, b, d, odd[v]);
                }
            }
        }
    }
}

impl<S: Simd> Step<S> for WideningStep {
    // Products and pairs of the row take registers.
    const GROUPS: usize = 5;
    sums_by_lane!();

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[int32x4_t; NV]; MR],
        x: &[*const u32; MR],
        beyond: usize,
        weights: *const u32,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let mut rows = [vld1q_s16(x[0].add(beyond).cast()); MR];
            for (row, x) in rows.iter_mut().zip(x).skip(1) {
                *row = vld1q_s16(x.add(beyond).cast());
            }
            Self::two_words::<NV, MR, 0, 1, 2, 3>(sums, &rows, weights);
            Self::two_words::<NV, MR, 4, 5, 6, 7>(sums, &rows, weights.add(2 * COLUMNS));
        }
    }
}

/// Chains of the instructions.
macro_rules! link {
    ($step:ident, $macs:literal, |$sum:ident, $a:ident, $b:ident| $next:expr) => {
        impl Link for $step {
            type Sum = int32x4_t;
            const MACS: usize = $macs;

            #[inline(always)]
            unsafe fn start() -> int32x4_t {
                // SAFETY: the caller's promise.
                unsafe { vdupq_n_s32(0) }
            }

            #[inline(always)]
            unsafe fn next($sum: int32x4_t, $a: uint32x4_t, $b: uint32x4_t) -> int32x4_t {
                // SAFETY: the caller's promise.
                unsafe { $next }
            }
        }
    };
}

link!(UsmmlaStep, 32, |sum, a, b| <Self as Pairwise>::multiply_add(
    sum, a, b
));
link!(SdotStep, 16, |sum, a, b| <Self as ByLane>::multiply_add::<0>(
    sum, a, b
));
link!(WideningStep, 16, |sum, a, b| {
    let a = vreinterpretq_s8_u32(a);
    Self::four(sum, a, a, vreinterpretq_s8_u32(b))
});
