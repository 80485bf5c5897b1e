//! Steps on NEON: of a row's elements by lane, or of two rows by two columns.

use std::arch::aarch64::*;

use super::micro_kernel::{Lanes, VECTOR};
use crate::gemm::elements::{
    Elements, F32, FloatSums, IntegerSums, RoundedBf16, RowElements, SumVector, WidenedBf16, elements,
};
use crate::gemm::step::{RunsOn, Step};
use crate::simd::Simd;
use crate::simd::aarch64::instructions::{bfmmla, sdot_lane, usmmla};
use crate::simd::aarch64::neon::{Neon, NeonBf16, NeonDotprod, NeonI8mm};
use crate::simd::bits::{Bits, cast};
use crate::weights::Element;

// SAFETY: a vector has no padding, and all bits are values of its lanes.
unsafe impl Bits for int8x16_t {}
// SAFETY: as of int8x16_t.
unsafe impl Bits for uint8x16_t {}
// SAFETY: as of int8x16_t.
unsafe impl Bits for int16x8_t {}

elements! {
    /// bfloat16 by `bfmmla`, which multiplies two rows by two columns over four `k`.
    MatrixBf16 = "bf16": Bf16 by Bf16 in groups of 2, FloatSums;
    /// By `usmmla`, which multiplies two rows by two columns over eight `k`.
    I8mmInt8 = "int8": UnsignedBytes by Int8 in groups of 2, IntegerSums;
    /// By `sdot`, over four `k` by lane.
    DotprodInt8 = "int8": SignedBytes by Int8, IntegerSums;
    /// By `smull`, `smlal2` and `sadalp`, which every CPU has.
    WideningInt8 = "int8": SignedBytes by Int8, IntegerSums;
}

// SAFETY: these steps use operations of the token alone, or instructions that all of NEON has.
unsafe impl RunsOn<Neon, Lanes> for F32 {}
// SAFETY: as of F32.
unsafe impl RunsOn<Neon, Lanes> for WidenedBf16 {}
// SAFETY: as of F32.
unsafe impl RunsOn<Neon, Lanes> for RoundedBf16 {}
// SAFETY: as of F32.
unsafe impl RunsOn<Neon, Lanes> for WideningInt8 {}
// SAFETY: the token proves `sdot`.
unsafe impl RunsOn<NeonDotprod, Lanes> for DotprodInt8 {}
// SAFETY: the token proves `usmmla`.
unsafe impl RunsOn<NeonI8mm, Lanes> for I8mmInt8 {}
// SAFETY: the token proves `bfmmla`.
unsafe impl RunsOn<NeonBf16, Lanes> for MatrixBf16 {}

/// Elements whose instruction multiplies a word of every column by the word of a row in a lane.
trait ByLane: Elements {
    /// # Safety
    /// `S` has the instruction.
    unsafe fn multiply_add<S: Simd, const LANE: i32>(
        simd: S,
        sum: SumVector<S, Self>,
        weights: S::I32,
        x: S::I32,
    ) -> SumVector<S, Self>;
}

impl ByLane for F32 {
    #[inline(always)]
    unsafe fn multiply_add<S: Simd, const LANE: i32>(
        simd: S,
        sum: S::F32,
        weights: S::I32,
        x: S::I32,
    ) -> S::F32 {
        simd.fma_lane::<LANE>(cast(weights), cast(x), sum)
    }
}

impl ByLane for DotprodInt8 {
    #[inline(always)]
    unsafe fn multiply_add<S: Simd, const LANE: i32>(
        _: S,
        sum: S::I32,
        weights: S::I32,
        x: S::I32,
    ) -> S::I32 {
        // SAFETY: the contract of this function.
        cast(unsafe { sdot_lane::<LANE>(cast(sum), cast(weights), cast(x)) })
    }
}

/// [`Step::multiply_add`] by lane: the four words of a vector of each row, by as many rows of the panel.
///
/// # Safety
/// As there.
#[inline(always)]
unsafe fn by_lane<S: Simd, E: ByLane, const NV: usize, const MR: usize>(
    simd: S,
    sums: &mut [[SumVector<S, E>; NV]; MR],
    x: &[*const u32; MR],
    step: usize,
    weights: *const u32,
) {
    // SAFETY: rows have a vector, and weights one for each of its lanes and of the sums of a row.
    unsafe {
        let mut rows = [simd.load_words_ptr(x[0].add(step * VECTOR)); MR];
        for (row, x) in rows.iter_mut().zip(x).skip(1) {
            *row = simd.load_words_ptr(x.add(step * VECTOR));
        }
        lane::<S, E, NV, MR, 0>(simd, sums, &rows, weights);
        lane::<S, E, NV, MR, 1>(simd, sums, &rows, weights);
        lane::<S, E, NV, MR, 2>(simd, sums, &rows, weights);
        lane::<S, E, NV, MR, 3>(simd, sums, &rows, weights);
    }
}

/// One lane of it.
///
/// # Safety
/// As [`by_lane`].
#[inline(always)]
unsafe fn lane<S: Simd, E: ByLane, const NV: usize, const MR: usize, const LANE: i32>(
    simd: S,
    sums: &mut [[SumVector<S, E>; NV]; MR],
    rows: &[S::I32; MR],
    weights: *const u32,
) {
    // SAFETY: the contract of this function.
    unsafe {
        let weights = weights.add(LANE as usize * NV * VECTOR);
        let mut w = [simd.load_words_ptr(weights); NV];
        for (v, w) in w.iter_mut().enumerate().skip(1) {
            *w = simd.load_words_ptr(weights.add(v * VECTOR));
        }
        for r in 0..MR {
            for v in 0..NV {
                sums[r][v] = E::multiply_add::<S, LANE>(simd, sums[r][v], w[v], rows[r]);
            }
        }
    }
}

/// Elements whose instruction multiplies two rows by two columns: `sums[2 i + j] += rows[i] . columns[j]`, of
/// eight bytes each.
trait ByMatrix: Elements {
    /// # Safety
    /// The CPU has the instruction.
    unsafe fn multiply_add<S: Simd>(
        sum: SumVector<S, Self>,
        rows: S::I32,
        columns: S::I32,
    ) -> SumVector<S, Self>;
}

impl ByMatrix for MatrixBf16 {
    #[inline(always)]
    unsafe fn multiply_add<S: Simd>(sum: S::F32, rows: S::I32, columns: S::I32) -> S::F32 {
        // SAFETY: the contract of this function.
        cast(unsafe { bfmmla(cast(sum), cast(rows), cast(columns)) })
    }
}

impl ByMatrix for I8mmInt8 {
    #[inline(always)]
    unsafe fn multiply_add<S: Simd>(sum: S::I32, rows: S::I32, columns: S::I32) -> S::I32 {
        // SAFETY: the contract of this function.
        cast(unsafe { usmmla(cast(sum), cast(rows), cast(columns)) })
    }
}

/// [`Step::multiply_add`] of two rows by two columns.
///
/// # Safety
/// As there.
#[inline(always)]
unsafe fn by_matrix<S: Simd, E: ByMatrix, const NV: usize, const MR: usize>(
    simd: S,
    sums: &mut [[SumVector<S, E>; NV]; MR],
    x: &[*const u32; MR],
    step: usize,
    weights: *const u32,
) {
    // SAFETY: pairs of rows have a vector, and weights one for each pair of columns.
    unsafe {
        let mut rows = [simd.load_words_ptr(x[0].add(step * VECTOR)); MR];
        for (row, x) in rows.iter_mut().zip(x).skip(1) {
            *row = simd.load_words_ptr(x.add(step * VECTOR));
        }
        for v in 0..NV {
            let columns = simd.load_words_ptr(weights.add(v * VECTOR));
            for (sums, &rows) in sums.iter_mut().zip(&rows) {
                sums[v] = E::multiply_add::<S>(sums[v], rows, columns);
            }
        }
    }
}

/// Steps that one of these functions makes.
macro_rules! steps {
    ($($elements:ident as $loops:ident by $step:ident of $instruction:ident, $depth:literal k, $fewer:literal groups fewer;)+) => {$(
        impl Step<Lanes> for $elements {
            const DEPTH: usize = $depth;
            const FEWER_GROUPS: usize = $fewer;
            type Loops = $loops;

            #[inline(always)]
            unsafe fn multiply_add<S: Simd, const NV: usize, const MR: usize>(
                simd: S,
                sums: &mut [[SumVector<S, Self>; NV]; MR],
                x: &[*const u32; MR],
                step: usize,
                weights: *const u32,
                _: usize,
            ) {
                // SAFETY: the contracts are the same.
                unsafe { $step::<S, $instruction, NV, MR>(simd, sums, x, step, weights) }
            }
        }
    )+};
}

steps! {
    F32 as F32 by by_lane of F32, 4 k, 0 groups fewer;
    WidenedBf16 as WidenedBf16 by by_lane of F32, 4 k, 0 groups fewer;
    RoundedBf16 as WidenedBf16 by by_lane of F32, 4 k, 0 groups fewer;
    MatrixBf16 as MatrixBf16 by by_matrix of MatrixBf16, 4 k, 3 groups fewer;
    I8mmInt8 as I8mmInt8 by by_matrix of I8mmInt8, 8 k, 3 groups fewer;
    // With seven rows, as of float32, compilers spill: 82 instead of 92 % of the throughput that llvm-mca
    // predicts for the Cortex-A76.
    DotprodInt8 as DotprodInt8 by by_lane of DotprodInt8, 16 k, 1 groups fewer;
}

impl Step<Lanes> for WideningInt8 {
    const DEPTH: usize = 16;
    // Products and pairs of the row take registers.
    const FEWER_GROUPS: usize = 2;
    type Loops = Self;

    #[inline(always)]
    unsafe fn multiply_add<S: Simd, const NV: usize, const MR: usize>(
        simd: S,
        sums: &mut [[S::I32; NV]; MR],
        x: &[*const u32; MR],
        step: usize,
        weights: *const u32,
        _: usize,
    ) {
        // SAFETY: rows have a vector, and weights one for each of its words and of the sums of a row.
        unsafe {
            let mut rows = [cast(simd.load_words_ptr(x[0].add(step * VECTOR))); MR];
            for (row, x) in rows.iter_mut().zip(x).skip(1) {
                *row = cast(simd.load_words_ptr(x.add(step * VECTOR)));
            }
            two_words::<S, NV, MR, 0, 1, 2, 3>(sums, &rows, weights);
            two_words::<S, NV, MR, 4, 5, 6, 7>(sums, &rows, weights.add(2 * NV * VECTOR));
        }
    }
}

/// Half a step: two words of each row, in lanes `A` to `D` of 16 bits.
///
/// # Safety
/// As [`Step::multiply_add`], with half as many words of weights.
#[inline(always)]
unsafe fn two_words<
    S: Simd,
    const NV: usize,
    const MR: usize,
    const A: i32,
    const B: i32,
    const C: i32,
    const D: i32,
>(
    sums: &mut [[S::I32; NV]; MR],
    rows: &[int16x8_t; MR],
    weights: *const u32,
) {
    // SAFETY: the contract of this function; every CPU has NEON.
    unsafe {
        let (mut even, mut odd) = ([vdupq_n_s8(0); NV], [vdupq_n_s8(0); NV]);
        for v in 0..NV {
            // `k` 0 and 1 of each column of the first word, then of the second; and 2 and 3.
            let first = vld1q_s16(weights.add(v * VECTOR).cast());
            let second = vld1q_s16(weights.add((NV + v) * VECTOR).cast());
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
                let sum = four(cast(sums[r][v]), a, c, even[v]);
                sums[r][v] = cast(four(sum, b, d, odd[v]));
            }
        }
    }
}

/// `sum` and four products of each lane, in two halves: of `k` 0 and 1 of a word with the low halves of `x`
/// and `w`, of another word's with the high ones. Two products of at most 128 * 127 fit into 16 bits.
#[inline]
#[target_feature(enable = "neon")]
fn four(sum: int32x4_t, low_x: int8x16_t, high_x: int8x16_t, w: int8x16_t) -> int32x4_t {
    let products = vmull_s8(vget_low_s8(low_x), vget_low_s8(w));
    vpadalq_s16(sum, vmlal_high_s8(products, high_x, w))
}
