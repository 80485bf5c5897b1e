//! The steps of the micro-kernel that broadcasts words of rows.

use super::broadcast::Broadcast;
use super::elements::{Bf16, F32, Int8, RoundedBf16, SumVector, WidenedBf16};
use super::step::Step;
use crate::simd::Simd;
use crate::simd::bits::cast;

/// Steps over `k`, and the elements whose loops make them: how many of them a word of weights holds and how many
/// words of a row they are; what a vector of words of weights becomes for word number `part` of the row; and the
/// operation that sums the products.
macro_rules! steps {
    ($($elements:ident as $loops:ident: $depth:literal k in $words:literal words, $fewer:literal groups fewer,
       |$simd:ident, $weights:ident, $part:ident| $factors:expr, |$x:ident, $w:ident, $sum:ident| $product:expr;)+) => {$(
        impl Step<Broadcast> for $elements {
            const DEPTH: usize = $depth;
            const FEWER_GROUPS: usize = $fewer;
            type Loops = $loops;

            #[inline(always)]
            unsafe fn multiply_add<S: Simd, const NV: usize, const MR: usize>(
                $simd: S,
                sums: &mut [[SumVector<S, Self>; NV]; MR],
                x: &[*const u32; MR],
                step: usize,
                weights: *const u32,
                count: usize,
            ) {
                let words = if $words == 1 { 1 } else { count };
                for $part in 0..words {
                    // SAFETY: the contract names a vector of weights for each of the sums, and the words of
                    // `count` elements of each row.
                    unsafe {
                        let mut w = [cast($simd.splat_i32(0)); NV];
                        for (v, w) in w.iter_mut().enumerate() {
                            let $weights = $simd.load_words_ptr(weights.add(v * S::LANES));
                            *w = $factors;
                        }
                        for r in 0..MR {
                            let $x = cast($simd.splat_i32((*x[r].add($words * step + $part)).cast_signed()));
                            for v in 0..NV {
                                let ($w, $sum) = (w[v], sums[r][v]);
                                sums[r][v] = $product;
                            }
                        }
                    }
                }
            }
        }
    )+};
}

/// Element number `part` of pairs of bfloat16, as float32.
#[inline(always)]
fn widened<S: Simd>(simd: S, pairs: S::I32, part: usize) -> S::F32 {
    if part == 0 {
        simd.low_halves(pairs)
    } else {
        simd.high_halves(pairs)
    }
}

// Widening takes a register. Shares of the FMA peak at 296 x 2048 x 1536 on Zen 4: 8 and 7 rows of AVX-512
// 0.77 and 0.97, 6 and 5 rows of AVX2 0.70 and 0.88.
steps! {
    F32 as F32: 1 k in 1 words, 0 groups fewer,
        |simd, weights, part| simd.bits_to_f32(weights), |x, w, sum| simd.fma(x, w, sum);
    WidenedBf16 as WidenedBf16: 2 k in 2 words, 1 groups fewer,
        |simd, weights, part| widened(simd, weights, part), |x, w, sum| simd.fma(x, w, sum);
    RoundedBf16 as WidenedBf16: 2 k in 2 words, 1 groups fewer,
        |simd, weights, part| widened(simd, weights, part), |x, w, sum| simd.fma(x, w, sum);
    Bf16 as Bf16: 2 k in 1 words, 0 groups fewer,
        |simd, weights, part| weights, |x, w, sum| simd.dot_bf16(sum, x, w);
    Int8 as Int8: 4 k in 1 words, 0 groups fewer,
        |simd, weights, part| weights, |x, w, sum| simd.dot_int8(sum, x, w);
}
