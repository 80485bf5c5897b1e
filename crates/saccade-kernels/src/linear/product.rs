//! How one step over `k` multiplies and adds, for each kind of weights and activations.

use std::marker::PhantomData;

use super::tile::{Job, Panel};
use crate::simd::{Dots, Vector};

/// One way to multiply rows by a panel: a step takes a vector of 4-byte words of the panel, which are [`Self::STEP`] consecutive `k` of each
/// column, and [`Self::ROW_WORDS`] words of each row.
pub(super) trait Product<V: Vector> {
    /// Consecutive `k` in a word of the panel.
    const STEP: usize;
    /// Words of a row that a step takes.
    const ROW_WORDS: usize;
    /// A vector of sums.
    type Sum: Copy;

    /// # Safety
    /// Here and below: the caller runs with `V`'s instruction set and the dot products that the implementation needs.
    unsafe fn zero() -> Self::Sum;

    /// # Safety
    /// `from` points to `V::LANES` words.
    unsafe fn load(from: *const u32) -> Self::Sum;

    /// # Safety
    /// `to` points to `V::LANES` words.
    unsafe fn store(sum: Self::Sum, to: *mut u32);

    /// # Safety
    /// As [`Self::zero`].
    unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum;

    /// `sums += x W` over step number `step`, of which the first `count` of [`Self::STEP`] elements are there.
    ///
    /// # Safety
    /// `weights` points to `NV` vectors of words, each of `x` to a row in which the step's first `count` elements can be read.
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[Self::Sum; NV]; MR],
        x: &[*const u32; MR],
        weights: *const u32,
        step: usize,
        count: usize,
    );

    /// What the sums of row `row` and the columns from `column` of the panel stand for.
    ///
    /// # Safety
    /// The row is in the job, and `V::LANES` columns are in the panel.
    unsafe fn value(sum: Self::Sum, job: &Job<'_>, row: usize, panel: &Panel<'_>, column: usize) -> V;
}

/// float32 by float32.
pub(super) struct F32;

/// float32 by pairs of bf16, which are widened in registers.
pub(super) struct WidenedBf16;

/// Pairs of bf16 by pairs of bf16.
pub(super) struct Bf16Pairs;

/// Unsigned quads of bytes by signed ones.
pub(super) struct Int8Quads;

/// A product that uses dot products `D`.
pub(super) struct With<P, D>(PhantomData<(P, D)>);

/// What products that sum in float32 have in common.
macro_rules! float_sums {
    () => {
        type Sum = V;

        #[inline(always)]
        unsafe fn zero() -> V {
            // SAFETY: the caller's promise; so throughout.
            unsafe { V::splat(0.0) }
        }

        #[inline(always)]
        unsafe fn load(from: *const u32) -> V {
            // SAFETY: the caller gives a vector of words.
            unsafe { V::load(from.cast()) }
        }

        #[inline(always)]
        unsafe fn store(sum: V, to: *mut u32) {
            // SAFETY: the caller gives a vector of words.
            unsafe { sum.store(to.cast()) }
        }

        #[inline(always)]
        unsafe fn add(a: V, b: V) -> V {
            // SAFETY: the caller's promise.
            unsafe { a.add(b) }
        }

        #[inline(always)]
        unsafe fn value(sum: V, _: &Job<'_>, _: usize, _: &Panel<'_>, _: usize) -> V {
            sum
        }
    };
}

impl<V: Vector> Product<V> for F32 {
    const STEP: usize = 1;
    const ROW_WORDS: usize = 1;
    float_sums!();

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[V; NV]; MR],
        x: &[*const u32; MR],
        weights: *const u32,
        step: usize,
        _: usize,
    ) {
        // SAFETY: the caller's promise. Loops, not closures: a closure is a function without `V`'s features until it is inlined.
        unsafe {
            let mut w = [V::splat(0.0); NV];
            for (v, w) in w.iter_mut().enumerate() {
                *w = V::load(weights.add(v * V::LANES).cast());
            }
            for r in 0..MR {
                let x = V::splat(*x[r].add(step).cast());
                for v in 0..NV {
                    sums[r][v] = x.fma(w[v], sums[r][v]);
                }
            }
        }
    }
}

impl<V: Vector> Product<V> for WidenedBf16 {
    const STEP: usize = 2;
    const ROW_WORDS: usize = 2;
    float_sums!();

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[V; NV]; MR],
        x: &[*const u32; MR],
        weights: *const u32,
        step: usize,
        count: usize,
    ) {
        for part in 0..count {
            // SAFETY: the caller's promise.
            unsafe {
                let mut w = [V::splat(0.0); NV];
                for (v, w) in w.iter_mut().enumerate() {
                    let pairs = V::load_ints(weights.add(v * V::LANES).cast());
                    *w = if part == 0 {
                        V::low_halves(pairs)
                    } else {
                        V::high_halves(pairs)
                    };
                }
                for r in 0..MR {
                    let x = V::splat(*x[r].add(2 * step + part).cast());
                    for v in 0..NV {
                        sums[r][v] = x.fma(w[v], sums[r][v]);
                    }
                }
            }
        }
    }
}

impl<V: Vector, D: Dots<V>> Product<V> for With<Bf16Pairs, D> {
    const STEP: usize = 2;
    const ROW_WORDS: usize = 1;
    float_sums!();

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[V; NV]; MR],
        x: &[*const u32; MR],
        weights: *const u32,
        step: usize,
        _: usize,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let mut w = [V::splat_int(0); NV];
            for (v, w) in w.iter_mut().enumerate() {
                *w = V::load_ints(weights.add(v * V::LANES).cast());
            }
            for r in 0..MR {
                let x = V::splat_int(*x[r].add(step).cast());
                for v in 0..NV {
                    sums[r][v] = D::bf16(sums[r][v], x, w[v]);
                }
            }
        }
    }
}

impl<V: Vector, D: Dots<V>> Product<V> for With<Int8Quads, D> {
    const STEP: usize = 4;
    const ROW_WORDS: usize = 1;
    type Sum = V::Ints;

    #[inline(always)]
    unsafe fn zero() -> V::Ints {
        // SAFETY: the caller's promise.
        unsafe { V::splat_int(0) }
    }

    #[inline(always)]
    unsafe fn load(from: *const u32) -> V::Ints {
        // SAFETY: the caller gives a vector of words.
        unsafe { V::load_ints(from.cast()) }
    }

    #[inline(always)]
    unsafe fn store(sum: V::Ints, to: *mut u32) {
        // SAFETY: the caller gives a vector of words.
        unsafe { V::store_ints(sum, to.cast()) }
    }

    #[inline(always)]
    unsafe fn add(a: V::Ints, b: V::Ints) -> V::Ints {
        // SAFETY: the caller's promise.
        unsafe { V::add_ints(a, b) }
    }

    #[inline(always)]
    unsafe fn multiply_add<const NV: usize, const MR: usize>(
        sums: &mut [[V::Ints; NV]; MR],
        x: &[*const u32; MR],
        weights: *const u32,
        step: usize,
        _: usize,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let mut w = [V::splat_int(0); NV];
            for (v, w) in w.iter_mut().enumerate() {
                *w = V::load_ints(weights.add(v * V::LANES).cast());
            }
            for r in 0..MR {
                let x = V::splat_int(*x[r].add(step).cast());
                for v in 0..NV {
                    sums[r][v] = D::int8(sums[r][v], x, w[v]);
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn value(sum: V::Ints, job: &Job<'_>, row: usize, panel: &Panel<'_>, column: usize) -> V {
        let quantized = &job.quantized[row];
        // SAFETY: the caller's promise.
        unsafe {
            // Every byte of the row is `zero` too large.
            let excess = V::mul_ints(
                V::splat_int(quantized.zero),
                V::load_ints(panel.sums.as_ptr().add(column)),
            );
            let sum = V::from_ints(V::sub_ints(sum, excess));
            // The weights' scale first: a row of huge values would overflow before weights make it small again.
            sum.mul(V::load(panel.scales.as_ptr().add(column)))
                .mul(V::splat(quantized.scale))
        }
    }
}
