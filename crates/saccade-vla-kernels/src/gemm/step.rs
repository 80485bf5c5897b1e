//! Micro-kernels, and the steps over the summed dimension that they are made of.

use std::mem::MaybeUninit;

use super::elements::{Elements, SumVector};
use super::{Block, Shape};
use crate::simd::Simd;

/// One step of the micro-kernel `L` over `k`.
pub(crate) trait Step<L>: Elements {
    /// Consecutive `k` of a step.
    const DEPTH: usize;
    /// Groups of rows by which the largest tile of sums is smaller than it could be: a step takes registers,
    /// too.
    const FEWER_GROUPS: usize = 0;
    /// Elements whose steps are the same, for the loops over them to be compiled once; or these themselves.
    type Loops: Step<L, Loops = Self::Loops>;

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

/// A loop over the rows of a block and the steps of a panel that is written once for all [`Step`]s.
///
/// # Safety
/// [`Self::multiply`] writes the sums that [`Gemm::multiply`] promises.
pub(crate) unsafe trait MicroKernel: Sized + Send + Sync + 'static {
    fn shape<S: Simd, E: Step<Self>>() -> Shape;

    /// What [`Gemm::multiply`] does, of int8 by panels that may have nibbles.
    ///
    /// # Safety
    /// [`Block::check`] was called with the sizes of this micro-kernel and these elements; `S` has the
    /// instructions that the elements need.
    unsafe fn multiply<S: Simd, E: Step<Self>>(
        simd: S,
        block: &Block<'_>,
        has_nibbles: bool,
        sums: &mut [MaybeUninit<u32>],
    );

    /// Steps of the largest tile for some milliseconds, as [`PeakLoop`](super::PeakLoop) has it.
    ///
    /// # Safety
    /// `S` has the instructions that the elements need.
    #[cfg(feature = "peak")]
    unsafe fn multiply_for_peak<S: Simd, E: Step<Self>>(simd: S) -> usize;
}

/// Elements whose instructions the CPU of a token has.
///
/// # Safety
/// That is so. It always is where the step uses operations of the token alone.
pub(crate) unsafe trait RunsOn<S, L>: Step<L> {}
