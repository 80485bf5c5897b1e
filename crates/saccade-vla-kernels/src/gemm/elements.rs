//! What rows, weights and sums are made of, and how they are stored.

use super::{SUM_PART, odd_lines};
use crate::simd::Simd;
use crate::simd::bits::{Bits, cast};
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
        Element::Int4 => panic!("int8, in panels of nibbles"),
    };
    /// Whether panels may hold nibbles, which are unpacked to bytes.
    const ARE_BYTES: bool = matches!(Self::WEIGHTS, Element::Int8);

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

/// Numbers that products are summed in.
pub(crate) trait Sums: Send + Sync + 'static {
    /// A vector of sums.
    type Vector<S: Simd>: Bits;
    /// Products that are summed from zero; the sums of such parts are added in order.
    const PART: usize;

    fn add<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;

    #[inline(always)]
    fn zero<S: Simd>(simd: S) -> Self::Vector<S> {
        cast(simd.splat_i32(0))
    }
}

/// float32.
pub(crate) struct FloatSums;

impl Sums for FloatSums {
    type Vector<S: Simd> = S::F32;
    const PART: usize = SUM_PART;

    #[inline(always)]
    fn add<S: Simd>(simd: S, a: S::F32, b: S::F32) -> S::F32 {
        simd.add(a, b)
    }
}

/// int32, which loses nothing and is not cut into parts.
pub(crate) struct IntegerSums;

impl Sums for IntegerSums {
    type Vector<S: Simd> = S::I32;
    const PART: usize = usize::MAX / 2;

    #[inline(always)]
    fn add<S: Simd>(simd: S, a: S::I32, b: S::I32) -> S::I32 {
        simd.add_i32(a, b)
    }
}

/// A vector of the sums of `E`.
pub(crate) type SumVector<S, E> = <<E as Elements>::Sums as Sums>::Vector<S>;

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
