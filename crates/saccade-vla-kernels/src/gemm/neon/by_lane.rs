//! Steps whose instruction takes four `k`, or four words of them, of a row by lane.

use std::arch::aarch64::{uint32x4_t, vld1q_u32};

/// Vectors of sums of a row.
pub(super) const VECTORS: usize = 3;

/// An instruction that multiplies a word of every column of a vector by the word of a row in a lane.
pub(super) trait ByLane {
    /// A vector of sums.
    type Sum: Copy;

    /// # Safety
    /// Called within [`Simd::run`](crate::simd::Simd::run) of an instruction set that has the instruction.
    unsafe fn multiply_add<const LANE: i32>(sum: Self::Sum, weights: uint32x4_t, x: uint32x4_t) -> Self::Sum;
}

/// `sums += x W` over the four words of a step.
///
/// # Safety
/// As [`Step::multiply_add`](super::tile::Step::multiply_add), with 48 words of weights.
#[inline(always)]
pub(super) unsafe fn multiply_add<P: ByLane, const NV: usize, const MR: usize>(
    sums: &mut [[P::Sum; NV]; MR],
    x: &[*const u32; MR],
    beyond: usize,
    weights: *const u32,
) {
    // SAFETY: the caller's promise.
    unsafe {
        let mut rows = [vld1q_u32(x[0].add(beyond)); MR];
        for (row, x) in rows.iter_mut().zip(x).skip(1) {
            *row = vld1q_u32(x.add(beyond));
        }
        word::<P, NV, MR, 0>(sums, &rows, weights);
        word::<P, NV, MR, 1>(sums, &rows, weights);
        word::<P, NV, MR, 2>(sums, &rows, weights);
        word::<P, NV, MR, 3>(sums, &rows, weights);
    }
}

/// One word of it.
///
/// # Safety
/// As [`multiply_add`].
#[inline(always)]
unsafe fn word<P: ByLane, const NV: usize, const MR: usize, const LANE: i32>(
    sums: &mut [[P::Sum; NV]; MR],
    rows: &[uint32x4_t; MR],
    weights: *const u32,
) {
    // SAFETY: the caller's promise.
    unsafe {
        let weights = weights.add(LANE as usize * NV * 4);
        let mut w = [vld1q_u32(weights); NV];
        for (v, w) in w.iter_mut().enumerate().skip(1) {
            *w = vld1q_u32(weights.add(v * 4));
        }
        for r in 0..MR {
            for v in 0..NV {
                sums[r][v] = P::multiply_add::<LANE>(sums[r][v], w[v], rows[r]);
            }
        }
    }
}
