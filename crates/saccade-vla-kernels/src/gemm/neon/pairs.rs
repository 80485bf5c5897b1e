//! Steps whose instruction multiplies two rows by two columns: `sums[2 i + j] += rows[i] . columns[j]`, of eight bytes each.

use std::arch::aarch64::{
    uint32x2_t, uint32x4_t, vcombine_u32, vdup_n_u32, vget_high_u32, vget_low_u32, vld1_u32, vld1q_u32,
    vst1_u32,
};

use super::tile::COLUMNS;

/// Vectors of sums of two rows: pairs of columns.
pub(super) const VECTORS: usize = COLUMNS / 2;

/// Such an instruction.
pub(super) trait Pairwise {
    /// A vector of sums.
    type Sum: Copy;

    /// # Safety
    /// Called within [`Simd::run`](crate::simd::Simd::run) of an instruction set that has the instruction.
    unsafe fn multiply_add(sum: Self::Sum, rows: uint32x4_t, columns: uint32x4_t) -> Self::Sum;
}

/// `sums += x W` over a step: eight bytes of each row and column.
///
/// # Safety
/// As [`Step::multiply_add`](super::tile::Step::multiply_add), with 24 words of weights.
#[inline(always)]
pub(super) unsafe fn multiply_add<P: Pairwise, const NV: usize, const MR: usize>(
    sums: &mut [[P::Sum; NV]; MR],
    x: &[*const u32; MR],
    beyond: usize,
    weights: *const u32,
) {
    // SAFETY: the caller's promise.
    unsafe {
        let mut rows = [vld1q_u32(x[0].add(beyond)); MR];
        for (rows, x) in rows.iter_mut().zip(x).skip(1) {
            *rows = vld1q_u32(x.add(beyond));
        }
        for v in 0..NV {
            let columns = vld1q_u32(weights.add(v * 4));
            for (sums, &rows) in sums.iter_mut().zip(&rows) {
                sums[v] = P::multiply_add(sums[v], rows, columns);
            }
        }
    }
}

/// The sums of pair number `v` of columns, of one row or two, from rows of [`COLUMNS`] words.
///
/// # Safety
/// `from` points to the rows.
#[inline(always)]
pub(super) unsafe fn load(from: *const u32, v: usize, rows: usize) -> uint32x4_t {
    // SAFETY: the caller's promise.
    unsafe {
        let low = vld1_u32(from.add(v * 2));
        let high: uint32x2_t = if rows > 1 {
            vld1_u32(from.add(COLUMNS + v * 2))
        } else {
            vdup_n_u32(0)
        };
        vcombine_u32(low, high)
    }
}

/// Stores them there.
///
/// # Safety
/// As [`load`].
#[inline(always)]
pub(super) unsafe fn store(sums: uint32x4_t, to: *mut u32, v: usize, rows: usize) {
    // SAFETY: the caller's promise.
    unsafe {
        vst1_u32(to.add(v * 2), vget_low_u32(sums));
        if rows > 1 {
            vst1_u32(to.add(COLUMNS + v * 2), vget_high_u32(sums));
        }
    }
}

/// Where byte `index` of the row is, of a pair of rows that alternate by eight bytes and begin at `pair`.
#[inline(always)]
pub(super) fn place(pair: *mut u8, row: usize, index: usize) -> *mut u8 {
    pair.wrapping_add(index / 8 * 16 + row % 2 * 8 + index % 8)
}
