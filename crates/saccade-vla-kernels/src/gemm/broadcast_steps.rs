//! The steps of the micro-kernel that broadcasts words of rows.

use super::broadcast::Broadcast;
use super::elements::{Bf16, Elements, F32, Int8, RoundedBf16, SumVector, WidenedBf16};
use super::step::Step;
use crate::simd::Simd;

impl Step<Broadcast> for F32 {
    const DEPTH: usize = 1;

    #[inline(always)]
    unsafe fn multiply_add<S: Simd, const NV: usize, const MR: usize>(
        simd: S,
        sums: &mut [[S::F32; NV]; MR],
        x: &[*const u32; MR],
        step: usize,
        weights: *const u32,
        _: usize,
    ) {
        // SAFETY: the contract names a vector of weights for each of the sums, and a word of each row.
        unsafe {
            let mut w = [simd.splat(0.0); NV];
            for (v, w) in w.iter_mut().enumerate() {
                *w = simd.load_ptr(weights.add(v * S::LANES).cast());
            }
            for r in 0..MR {
                let x = simd.splat(*x[r].add(step).cast());
                for v in 0..NV {
                    sums[r][v] = simd.fma(x, w[v], sums[r][v]);
                }
            }
        }
    }
}

/// Steps that widen weights.
macro_rules! widening_steps {
    ($($elements:ident),+) => {$(
        impl Step<Broadcast> for $elements {
            const DEPTH: usize = 2;
            // Shares of the FMA peak at 296 x 2048 x 1536 on Zen 4: 8 and 7 rows of AVX-512 0.77 and 0.97, 6
            // and 5 rows of AVX2 0.70 and 0.88.
            const FEWER_GROUPS: usize = 1;

            #[inline(always)]
            unsafe fn multiply_add<S: Simd, const NV: usize, const MR: usize>(
                simd: S,
                sums: &mut [[S::F32; NV]; MR],
                x: &[*const u32; MR],
                step: usize,
                weights: *const u32,
                count: usize,
            ) {
                for part in 0..count {
                    // SAFETY: the contract names a vector of weights for each of the sums, and `count` words
                    // of each row.
                    unsafe {
                        let mut w = [simd.splat(0.0); NV];
                        for (v, w) in w.iter_mut().enumerate() {
                            let pairs = simd.load_words_ptr(weights.add(v * S::LANES));
                            *w = if part == 0 {
                                simd.low_halves(pairs)
                            } else {
                                simd.high_halves(pairs)
                            };
                        }
                        for r in 0..MR {
                            let x = simd.splat(*x[r].add(2 * step + part).cast());
                            for v in 0..NV {
                                sums[r][v] = simd.fma(x, w[v], sums[r][v]);
                            }
                        }
                    }
                }
            }
        }
    )+};
}
widening_steps!(WidenedBf16, RoundedBf16);

/// Steps whose operation sums all products of a word of the row and of a word of each column.
macro_rules! step_of_dots {
    ($elements:ident, $dot:ident) => {
        impl Step<Broadcast> for $elements {
            const DEPTH: usize = Self::PER_WORD;

            #[inline(always)]
            unsafe fn multiply_add<S: Simd, const NV: usize, const MR: usize>(
                simd: S,
                sums: &mut [[SumVector<S, Self>; NV]; MR],
                x: &[*const u32; MR],
                step: usize,
                weights: *const u32,
                _: usize,
            ) {
                // SAFETY: the contract names a vector of weights for each of the sums, and a word of each
                // row.
                unsafe {
                    let mut w = [simd.splat_i32(0); NV];
                    for (v, w) in w.iter_mut().enumerate() {
                        *w = simd.load_words_ptr(weights.add(v * S::LANES));
                    }
                    for r in 0..MR {
                        let x = simd.splat_i32(*x[r].add(step).cast());
                        for v in 0..NV {
                            sums[r][v] = simd.$dot(sums[r][v], x, w[v]);
                        }
                    }
                }
            }
        }
    };
}
step_of_dots!(Bf16, dot_bf16);
step_of_dots!(Int8, dot_int8);
