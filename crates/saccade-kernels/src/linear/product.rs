//! How one step over `k` multiplies and adds, for each kind of weights and activations.

use std::marker::PhantomData;

use super::rows::Quantized;
use super::tile::Panel;
use crate::simd::{Dots, Vector};

/// One running float32 sum over the 8192 inputs of a feed-forward loses five times as much as parts of 512 do (measured on the full head).
const SUM_PART: usize = 512;

/// One way to multiply rows by a panel: a step takes vectors of 4-byte words of the panel, which are [`Self::STEP`] consecutive `k` of each
/// column, and as many `k` of each row.
pub(super) trait Product<V: Vector> {
    /// Consecutive `k` in a word of the panel.
    const STEP: usize;
    /// Steps that are summed from zero, at multiples of which the summed dimension is cut; their sums are added to those of the parts before.
    const PART_STEPS: usize;
    /// A vector of sums.
    type Sum: Copy;
    /// What is known of as many columns.
    type Columns: Copy;

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

    /// What [`Self::value`] needs to know of the `V::LANES` columns from `column` on.
    ///
    /// # Safety
    /// The columns are in the panel.
    unsafe fn columns(panel: &Panel<'_>, column: usize) -> Self::Columns;

    /// What the sums of row `row` stand for.
    ///
    /// # Safety
    /// `quantized` holds the row, if the product is one of quantised rows.
    unsafe fn value(sum: Self::Sum, columns: Self::Columns, quantized: &[Quantized], row: usize) -> V;
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
        type Columns = ();

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
        unsafe fn columns(_: &Panel<'_>, _: usize) {}

        #[inline(always)]
        unsafe fn value(sum: V, (): (), _: &[Quantized], _: usize) -> V {
            sum
        }
    };
}

impl<V: Vector> Product<V> for F32 {
    const STEP: usize = 1;
    const PART_STEPS: usize = SUM_PART / <Self as Product<V>>::STEP;
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
    const PART_STEPS: usize = SUM_PART / <Self as Product<V>>::STEP;
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
    const PART_STEPS: usize = SUM_PART / <Self as Product<V>>::STEP;
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
    // Integers lose nothing.
    const PART_STEPS: usize = usize::MAX / 2;
    type Sum = V::Ints;
    /// Scales, and the sums of the weights.
    type Columns = (V, V::Ints);

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
    unsafe fn columns(panel: &Panel<'_>, column: usize) -> (V, V::Ints) {
        // SAFETY: the caller's promise.
        unsafe {
            (
                V::load(panel.scales.as_ptr().add(column)),
                V::load_ints(panel.sums.as_ptr().add(column)),
            )
        }
    }

    #[inline(always)]
    unsafe fn value(sum: V::Ints, (scales, sums): (V, V::Ints), quantized: &[Quantized], row: usize) -> V {
        let Quantized { scale, zero } = quantized[row];
        // SAFETY: the caller's promise.
        unsafe {
            // Every byte of the row is `zero` too large.
            let sum = V::from_ints(V::sub_ints(sum, V::mul_ints(V::splat_int(zero), sums)));
            // The weights' scale first: a row of huge values would overflow before weights make it small again.
            sum.mul(scales).mul(V::splat(scale))
        }
    }
}
