//! The arithmetic of a tile: float32, with keys and values stored so or widened from bfloat16, or pairs of
//! bfloat16 in one instruction.

use std::marker::PhantomData;

use half::bf16;

use crate::simd::Simd;
use crate::simd::bits::Bits;
use crate::simd::math::{EXP2, EXP2_FOR_BF16, exp_below_zero};

/// How keys and values are stored, and what multiplies them. A word of them is met by one or two broadcast
/// factors, words too, that are made from queries and probabilities.
pub(super) trait TileArithmetic<S: Simd> {
    /// Elements of the summed dimension in a word of keys or values.
    const STEP: usize;
    /// Factors that meet it, one after the other.
    const FACTORS: usize;
    /// `2 * LANES` elements as factors: `2 * LANES * FACTORS / STEP` words.
    type Factors: Bits;
    /// A vector of factors, or of what they multiply.
    type Operand: Copy;

    /// Makes factors of `2 * LANES` elements.
    fn factors(simd: S, first: S::F32, second: S::F32) -> Self::Factors;
    /// Adds `2 * LANES` elements to `sum`, as they are in their factors.
    fn add(simd: S, sum: S::F32, first: S::F32, second: S::F32, factors: Self::Factors) -> S::F32;
    /// Element number `index` of the elements that `factors` were made of.
    fn element(factors: &[f32], index: usize) -> f32;
    /// Every lane the factor `word`.
    fn broadcast(simd: S, word: u32) -> Self::Operand;
    /// A vector of factors.
    fn operand(simd: S, factors: S::I32) -> Self::Operand;
    /// What factor number `part` multiplies of each word.
    fn column(simd: S, words: S::I32, part: usize) -> Self::Operand;
    /// `factor * column + sum`, or the sum of two products where a factor is a pair.
    fn multiply_add(simd: S, factor: Self::Operand, column: Self::Operand, sum: S::F32) -> S::F32;
    /// The same with the factor in lane `LANE`, where there is [`Simd::BY_LANE`].
    fn multiply_add_lane<const LANE: i32>(
        simd: S,
        factors: Self::Operand,
        column: Self::Operand,
        sum: S::F32,
    ) -> S::F32;
    /// Element number `part` of each word of values.
    fn widen(simd: S, words: S::I32, part: usize) -> S::F32;
    /// `exp(x)` for `x <= 0`, NaN where it is NaN.
    fn exp(simd: S, x: S::F32) -> S::F32;
}

/// How keys and values are stored where products are of float32.
pub(super) trait Stored {
    /// Elements of a word.
    const STEP: usize;

    /// Element number `part` of each word.
    fn widen<S: Simd>(simd: S, words: S::I32, part: usize) -> S::F32;
}

/// float32.
pub(super) struct StoredF32;

impl Stored for StoredF32 {
    const STEP: usize = 1;

    #[inline(always)]
    fn widen<S: Simd>(simd: S, words: S::I32, _: usize) -> S::F32 {
        simd.bits_to_f32(words)
    }
}

/// Pairs of bfloat16, widened in registers: the bits of float32 with the same keys and values.
pub(super) struct StoredBf16;

impl Stored for StoredBf16 {
    const STEP: usize = 2;

    #[inline(always)]
    fn widen<S: Simd>(simd: S, words: S::I32, part: usize) -> S::F32 {
        if part == 0 {
            simd.low_halves(words)
        } else {
            simd.high_halves(words)
        }
    }
}

/// Products of float32, of keys and values stored as `T`.
pub(super) struct Float32Products<T>(PhantomData<T>);

impl<S: Simd, T: Stored> TileArithmetic<S> for Float32Products<T> {
    const STEP: usize = T::STEP;
    const FACTORS: usize = T::STEP;
    type Factors = [S::F32; 2];
    type Operand = S::F32;

    #[inline(always)]
    fn factors(_: S, first: S::F32, second: S::F32) -> [S::F32; 2] {
        [first, second]
    }

    #[inline(always)]
    fn add(simd: S, sum: S::F32, first: S::F32, second: S::F32, _: [S::F32; 2]) -> S::F32 {
        simd.add(simd.add(sum, first), second)
    }

    #[inline(always)]
    fn element(factors: &[f32], index: usize) -> f32 {
        factors[index]
    }

    #[inline(always)]
    fn broadcast(simd: S, word: u32) -> S::F32 {
        simd.splat(f32::from_bits(word))
    }

    #[inline(always)]
    fn operand(simd: S, factors: S::I32) -> S::F32 {
        simd.bits_to_f32(factors)
    }

    #[inline(always)]
    fn column(simd: S, words: S::I32, part: usize) -> S::F32 {
        T::widen(simd, words, part)
    }

    #[inline(always)]
    fn multiply_add(simd: S, factor: S::F32, column: S::F32, sum: S::F32) -> S::F32 {
        simd.fma(factor, column, sum)
    }

    #[inline(always)]
    fn multiply_add_lane<const LANE: i32>(simd: S, factors: S::F32, column: S::F32, sum: S::F32) -> S::F32 {
        simd.fma_lane::<LANE>(column, factors, sum)
    }

    #[inline(always)]
    fn widen(simd: S, words: S::I32, part: usize) -> S::F32 {
        T::widen(simd, words, part)
    }

    #[inline(always)]
    fn exp(simd: S, x: S::F32) -> S::F32 {
        exp_below_zero(simd, x, &EXP2)
    }
}

/// Products of pairs of bfloat16 in one instruction, summed in float32: queries and probabilities are rounded
/// too.
pub(super) struct Bf16Products;

impl<S: Simd> TileArithmetic<S> for Bf16Products {
    const STEP: usize = 2;
    const FACTORS: usize = 1;
    type Factors = S::I32;
    type Operand = S::I32;

    #[inline(always)]
    fn factors(simd: S, first: S::F32, second: S::F32) -> S::I32 {
        simd.to_bf16_pairs(first, second)
    }

    #[inline(always)]
    fn add(simd: S, sum: S::F32, _: S::F32, _: S::F32, factors: S::I32) -> S::F32 {
        /// Two times 1 in bfloat16.
        const ONES: i32 = 0x3f80_3f80;
        simd.dot_bf16(sum, factors, simd.splat_i32(ONES))
    }

    #[inline(always)]
    fn element(factors: &[f32], index: usize) -> f32 {
        let bits = factors[index / 2].to_bits() >> (16 * (index % 2));
        bf16::from_bits(bits as u16).to_f32()
    }

    #[inline(always)]
    fn broadcast(simd: S, word: u32) -> S::I32 {
        simd.splat_i32(word.cast_signed())
    }

    #[inline(always)]
    fn operand(_: S, factors: S::I32) -> S::I32 {
        factors
    }

    #[inline(always)]
    fn column(_: S, words: S::I32, _: usize) -> S::I32 {
        words
    }

    #[inline(always)]
    fn multiply_add(simd: S, factor: S::I32, column: S::I32, sum: S::F32) -> S::F32 {
        simd.dot_bf16(sum, factor, column)
    }

    #[inline(always)]
    fn multiply_add_lane<const LANE: i32>(simd: S, factors: S::I32, column: S::I32, sum: S::F32) -> S::F32 {
        simd.dot_bf16_lane::<LANE>(sum, column, factors)
    }

    #[inline(always)]
    fn widen(simd: S, words: S::I32, part: usize) -> S::F32 {
        StoredBf16::widen(simd, words, part)
    }

    #[inline(always)]
    fn exp(simd: S, x: S::F32) -> S::F32 {
        exp_below_zero(simd, x, &EXP2_FOR_BF16)
    }
}
