//! Chains of multiply-adds from registers: the most that an instruction of NEON can do, which kernels are compared with.

use std::arch::aarch64::{uint32x4_t, vdupq_n_u32};
use std::hint::black_box;
use std::marker::PhantomData;

use crate::simd::{Kernel, Simd};

/// Links of each chain in one call: some milliseconds, next to which starting a thread is nothing.
const ITERATIONS: usize = 1 << 19;

/// Chains that do not wait for each other: four instructions begin in a cycle, and each takes four.
const CHAINS: usize = 24;

/// The instruction of a product, as a link of a chain: each needs the sum of the one before.
pub(super) trait Link {
    /// A vector of sums.
    type Sum: Copy;
    /// Multiply-accumulates of a link.
    const MACS: usize;

    /// # Safety
    /// Here and below: called within [`Simd::run`] of an instruction set that has the instruction.
    unsafe fn start() -> Self::Sum;

    /// # Safety
    /// As above.
    unsafe fn next(sum: Self::Sum, a: uint32x4_t, b: uint32x4_t) -> Self::Sum;
}

/// Runs them; the result is how many multiply-accumulates that were.
pub(super) struct Chains<L>(PhantomData<L>);

impl<L> Chains<L> {
    pub(super) fn new() -> Self {
        Self(PhantomData)
    }
}

impl<L: Link> Kernel for Chains<L> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> usize {
        // SAFETY: kernels are called within `Simd::run`, here of an instruction set with the product's instruction.
        unsafe {
            let (a, b) = (black_box(vdupq_n_u32(0)), black_box(vdupq_n_u32(0)));
            let mut sums = [L::start(); CHAINS];
            for _ in 0..ITERATIONS {
                for sum in &mut sums {
                    *sum = L::next(*sum, a, b);
                }
            }
            black_box(&sums);
        }
        ITERATIONS * CHAINS * L::MACS
    }
}
