//! What rows and weights are made of: how they are stored, and how the vectors of most instruction sets
//! multiply them.

use super::broadcast::Broadcast;
use super::odd_lines;
use super::step::{FloatSums, IntegerSums, Step, SumVector, Sums};
use crate::simd::Simd;
use crate::weights::Element;

/// Elements of rows and of packed weights that are multiplied with each other.
pub(crate) trait Elements: Send + Sync + Sized + 'static {
    /// Their part of a kernel's name.
    const NAME: &'static str;
    /// Elements of weights.
    const WEIGHTS: Element;
    /// Elements of rows.
    const ROWS: RowElements;
    /// Rows that alternate in memory by eight bytes, and words of a column that are next to each other in a
    /// panel: 2 for instructions that multiply two rows by two columns.
    const GROUP: usize = 1;
    /// What sums are.
    type Sums: Sums;
    /// Elements of a word of a panel.
    const PER_WORD: usize = match Self::WEIGHTS {
        Element::F32 => 1,
        Element::Bf16 => 2,
        Element::Int8 => 4,
    };

    /// Whether bfloat16 weights are widened to be multiplied in float32.
    #[cfg(any(feature = "peak", all(target_arch = "aarch64", not(saccade_portable))))]
    const IS_WIDENED: bool = matches!(
        (Self::WEIGHTS, Self::ROWS),
        (Element::Bf16, RowElements::F32 | RowElements::RoundedF32)
    );

    /// Words from one converted row to the next; `None` if rows are read where they are.
    fn converted_stride(in_features: usize) -> Option<usize> {
        match Self::ROWS {
            RowElements::F32 => None,
            RowElements::RoundedF32 => Some(odd_lines(in_features, 1)),
            RowElements::Bf16 => Some(odd_lines(in_features, 2)),
            RowElements::UnsignedBytes | RowElements::SignedBytes => Some(odd_lines(in_features, 4)),
        }
    }
}

/// Elements of rows.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum RowElements {
    /// float32, read where they are.
    F32,
    /// Rounded to bfloat16 and kept as float32, which saves widening them.
    RoundedF32,
    /// Rounded to bfloat16.
    Bf16,
    /// Quantised to `0 ..= Simd::MAX_BYTE`.
    UnsignedBytes,
    /// Quantised to -128 ..= 127: bytes and zero points are 128 less than unsigned ones, and products are the
    /// same.
    #[cfg_attr(
        not(all(target_arch = "aarch64", not(saccade_portable))),
        allow(dead_code, reason = "for instructions of NEON")
    )]
    SignedBytes,
}

/// Defines elements: their part of a kernel's name, rows by weights, and sums.
macro_rules! elements {
    ($($(#[$doc:meta])* $name:ident = $text:literal: $rows:ident by $weights:ident $(in groups of $group:literal)?, $sums:ident;)+) => {$(
        $(#[$doc])*
        pub(crate) struct $name;

        impl Elements for $name {
            const NAME: &'static str = $text;
            const WEIGHTS: Element = Element::$weights;
            const ROWS: RowElements = RowElements::$rows;
            $(const GROUP: usize = $group;)?
            type Sums = $sums;
        }
    )+};
}
#[cfg(all(target_arch = "aarch64", not(saccade_portable)))]
pub(super) use elements;

elements! {
    /// float32 rows by float32 weights.
    F32 = "f32": F32 by F32, FloatSums;
    /// float32 rows by bfloat16 weights, which are widened in registers.
    WidenedBf16 = "f32-bf16": F32 by Bf16, FloatSums;
    /// Rows rounded to bfloat16 by bfloat16 weights, in float32: for a CPU without an instruction for them.
    RoundedBf16 = "bf16-as-f32": RoundedF32 by Bf16, FloatSums;
    /// Pairs of bfloat16, by an instruction that multiplies and sums both of a pair.
    #[allow(dead_code, reason = "not every architecture and set of features has such an instruction")]
    Bf16 = "bf16": Bf16 by Bf16, FloatSums;
    /// Quads of bytes: rows of unsigned ones, weights of signed ones.
    Int8 = "int8": UnsignedBytes by Int8, IntegerSums;
}

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
