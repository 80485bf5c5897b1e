//! A step of a micro-kernel over the summed dimension, and its sums.

use super::SUM_PART;
use super::elements::Elements;
use crate::simd::Simd;
use crate::simd::bits::{Bits, cast};

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

/// One step of the micro-kernel `L` over `k`.
pub(crate) trait Step<L>: Elements {
    /// Consecutive `k` of a step.
    const DEPTH: usize;
    /// Groups of rows by which the largest tile of sums is smaller than it could be: a step takes registers,
    /// too.
    const FEWER_GROUPS: usize = 0;

    /// `sums += x W` over step number `step`, of which the first `count` of [`Self::DEPTH`] elements are
    /// there. `MR` counts groups of rows, `NV` vectors of sums.
    ///
    /// Loops, not closures: a closure is a function without the target features until it is inlined.
    ///
    /// # Safety
    /// `weights` points to the words of the step, each of `x` to a group of rows in which the step's first
    /// `count` elements can be read. `S` has the instructions that these elements need.
    unsafe fn multiply_add<S: Simd, const NV: usize, const MR: usize>(
        simd: S,
        sums: &mut [[SumVector<S, Self>; NV]; MR],
        x: &[*const u32; MR],
        step: usize,
        weights: *const u32,
        count: usize,
    );
}
