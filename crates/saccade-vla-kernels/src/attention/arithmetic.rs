//! How a tile multiplies: float32, with keys and values held so or widened from bfloat16, or pairs of bfloat16 in one instruction.

use std::marker::PhantomData;

use half::bf16;

use crate::simd::old::math::{EXP2, EXP2_FOR_BF16, exp_below_zero};
use crate::simd::{Dots, Simd, Vector};

/// How keys and values are held, and what multiplies them. A word of them is met by one or two broadcast factors, words too, that are made
/// from queries and probabilities.
///
/// # Safety
/// Every method is called within [`Simd::run`] of `S`, with pointers that are valid for all that it names.
pub(super) trait TileArithmetic<S: Simd> {
    /// Elements of the summed dimension in a word of keys or values.
    const STEP: usize;
    /// Factors that meet it, one after the other.
    const FACTORS: usize;
    /// Keeps `2 * LANES` elements as factors.
    unsafe fn store_factors(first: S::Vector, second: S::Vector, to: *mut f32);
    /// Adds them to `sum`, as they are kept.
    unsafe fn add_factors(sum: S::Vector, first: S::Vector, second: S::Vector, kept: *const f32)
    -> S::Vector;
    /// Element number `index` of what [`Self::store_factors`] kept.
    unsafe fn element(factors: *const f32, index: usize) -> f32;
    /// A vector of factors, or of what they multiply.
    type Operand: Copy;
    /// Every lane the factor at `from`.
    unsafe fn broadcast(from: *const f32) -> Self::Operand;
    /// What factor number `part` of a word multiplies.
    unsafe fn column(from: *const u32, part: usize) -> Self::Operand;
    /// `sum` and the products of factor and column.
    unsafe fn multiply_add(factor: Self::Operand, column: Self::Operand, sum: S::Vector) -> S::Vector;
    /// Four factors, where there is [`Vector::BY_LANE`].
    unsafe fn four(from: *const f32) -> Self::Operand;
    /// `sum` and the products of the factor in lane `LANE` of four and column.
    unsafe fn multiply_add_lane<const LANE: i32>(
        factors: Self::Operand,
        column: Self::Operand,
        sum: S::Vector,
    ) -> S::Vector;
    /// Element number `part` of each word of values.
    unsafe fn widen(from: *const u32, part: usize) -> S::Vector;
    /// `exp(x)` for `x <= 0`, NaN where it is NaN.
    unsafe fn exp(x: S::Vector) -> S::Vector;
}

/// How keys and values are held where products are of float32.
pub(super) trait Stored {
    /// Elements of a word.
    const STEP: usize;

    /// Element number `part` of each word.
    ///
    /// # Safety
    /// A whole vector of words is there; the CPU has the instruction set of `V`.
    unsafe fn widen<V: Vector>(from: *const u32, part: usize) -> V;
}

/// float32.
pub(super) struct HeldF32;

impl Stored for HeldF32 {
    const STEP: usize = 1;

    #[inline(always)]
    unsafe fn widen<V: Vector>(from: *const u32, _: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { V::load(from.cast()) }
    }
}

/// Pairs of bfloat16, widened in registers: the bits of float32 with the same keys and values.
pub(super) struct HeldBf16;

impl Stored for HeldBf16 {
    const STEP: usize = 2;

    #[inline(always)]
    unsafe fn widen<V: Vector>(from: *const u32, part: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe {
            let words = V::load_ints(from.cast());
            if part == 0 {
                V::low_halves(words)
            } else {
                V::high_halves(words)
            }
        }
    }
}

/// Products of float32, of keys and values held as `H`.
pub(super) struct Float32<H>(PhantomData<H>);

impl<S: Simd<Vector = V>, V: Vector, H: Stored> TileArithmetic<S> for Float32<H> {
    const STEP: usize = H::STEP;
    const FACTORS: usize = H::STEP;
    type Operand = V;

    #[inline(always)]
    unsafe fn store_factors(first: V, second: V, to: *mut f32) {
        // SAFETY: the trait's contract; so throughout.
        unsafe {
            first.store(to);
            second.store(to.add(V::LANES));
        }
    }

    #[inline(always)]
    unsafe fn element(factors: *const f32, index: usize) -> f32 {
        // SAFETY: as above.
        unsafe { *factors.add(index) }
    }

    #[inline(always)]
    unsafe fn add_factors(sum: V, first: V, second: V, _: *const f32) -> V {
        // SAFETY: as above.
        unsafe { sum.add(first).add(second) }
    }

    #[inline(always)]
    unsafe fn broadcast(from: *const f32) -> V {
        // SAFETY: as above.
        unsafe { V::splat(*from) }
    }

    #[inline(always)]
    unsafe fn column(from: *const u32, part: usize) -> V {
        // SAFETY: as above.
        unsafe { H::widen(from, part) }
    }

    #[inline(always)]
    unsafe fn multiply_add(factor: V, column: V, sum: V) -> V {
        // SAFETY: as above.
        unsafe { factor.fma(column, sum) }
    }

    #[inline(always)]
    unsafe fn four(from: *const f32) -> V {
        // SAFETY: as above.
        unsafe { V::load(from) }
    }

    #[inline(always)]
    unsafe fn multiply_add_lane<const LANE: i32>(factors: V, column: V, sum: V) -> V {
        // SAFETY: as above.
        unsafe { column.fma_lane::<LANE>(factors, sum) }
    }

    #[inline(always)]
    unsafe fn widen(from: *const u32, part: usize) -> V {
        // SAFETY: as above.
        unsafe { H::widen(from, part) }
    }

    #[inline(always)]
    unsafe fn exp(x: V) -> V {
        // SAFETY: as above.
        unsafe { exp_below_zero(x, &EXP2) }
    }
}

/// Products of pairs of bfloat16 in one instruction, summed in float32: queries and probabilities are rounded too.
pub(super) struct Pairs;

impl<S: Simd<Vector = V>, V: Vector> TileArithmetic<S> for Pairs {
    const STEP: usize = 2;
    const FACTORS: usize = 1;
    type Operand = V::Ints;

    #[inline(always)]
    unsafe fn store_factors(first: V, second: V, to: *mut f32) {
        // SAFETY: the trait's contract; so throughout.
        unsafe { S::Dots::store_bf16(first, second, to.cast()) }
    }

    #[inline(always)]
    unsafe fn add_factors(sum: V, _: V, _: V, kept: *const f32) -> V {
        /// Two times 1 in bfloat16.
        const ONES: i32 = 0x3f80_3f80;
        // SAFETY: as above.
        unsafe { S::Dots::bf16(sum, V::load_ints(kept.cast()), V::splat_int(ONES)) }
    }

    #[inline(always)]
    unsafe fn element(factors: *const f32, index: usize) -> f32 {
        // SAFETY: as above.
        bf16::from_bits(unsafe { *factors.cast::<u16>().add(index) }).to_f32()
    }

    #[inline(always)]
    unsafe fn broadcast(from: *const f32) -> V::Ints {
        // SAFETY: as above.
        unsafe { V::splat_int(*from.cast()) }
    }

    #[inline(always)]
    unsafe fn column(from: *const u32, _: usize) -> V::Ints {
        // SAFETY: as above.
        unsafe { V::load_ints(from.cast()) }
    }

    #[inline(always)]
    unsafe fn multiply_add(factor: V::Ints, column: V::Ints, sum: V) -> V {
        // SAFETY: as above.
        unsafe { S::Dots::bf16(sum, factor, column) }
    }

    #[inline(always)]
    unsafe fn four(from: *const f32) -> V::Ints {
        // SAFETY: as above.
        unsafe { V::load_ints(from.cast()) }
    }

    #[inline(always)]
    unsafe fn multiply_add_lane<const LANE: i32>(factors: V::Ints, column: V::Ints, sum: V) -> V {
        // SAFETY: as above.
        unsafe { S::Dots::bf16_lane::<LANE>(sum, column, factors) }
    }

    #[inline(always)]
    unsafe fn widen(from: *const u32, part: usize) -> V {
        // SAFETY: as above.
        unsafe { HeldBf16::widen(from, part) }
    }

    #[inline(always)]
    unsafe fn exp(x: V) -> V {
        // SAFETY: as above.
        unsafe { exp_below_zero(x, &EXP2_FOR_BF16) }
    }
}
