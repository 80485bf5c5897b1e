//! Chains of multiply-adds from registers: the most that an instruction can do, which kernels are compared with.

use std::hint::black_box;

use crate::simd::{Dots, Kernel, Simd, Vector};

/// Links of each chain in one call: some milliseconds, next to which starting a thread is nothing.
const ITERATIONS: usize = 1 << 20;

/// The instruction of a product, as a link of a chain: each needs the result of the one before.
trait Link<S: Simd> {
    type Sum: Copy;
    /// Multiply-accumulates of a lane.
    const MACS: usize;

    /// # Safety
    /// Here and below: called within [`Simd::run`] of `S`.
    unsafe fn start() -> Self::Sum;

    /// # Safety
    /// As above.
    unsafe fn next(sum: Self::Sum) -> Self::Sum;
}

/// Independent chains hide the latency of the instructions: 4 to 7 cycles, two of them beginning in each.
///
/// # Safety
/// Called within [`Simd::run`] of `S`.
#[inline(always)]
unsafe fn chains<S: Simd, L: Link<S>, const COUNT: usize>() -> usize {
    // SAFETY: the caller's promise.
    unsafe {
        let mut sums = [L::start(); COUNT];
        for _ in 0..ITERATIONS {
            for sum in &mut sums {
                *sum = L::next(*sum);
            }
        }
        black_box(&sums);
        ITERATIONS * COUNT * S::Vector::LANES * L::MACS
    }
}

/// As many chains as the tiles of the instruction set have sums, twelve at most.
///
/// # Safety
/// As [`chains`].
#[inline(always)]
unsafe fn all_chains<S: Simd, L: Link<S>>() -> usize {
    // SAFETY: the caller's promise.
    unsafe {
        if S::Vector::TILE_ROWS * S::Vector::TILE_VECTORS < 12 {
            chains::<S, L, 6>()
        } else {
            chains::<S, L, 12>()
        }
    }
}

/// Of float32.
pub(super) struct FloatChains;

/// Of pairs of bfloat16.
pub(super) struct Bf16Chains;

/// Of quads of int8.
pub(super) struct Int8Chains;

impl<S: Simd<Vector = V>, V: Vector> Link<S> for FloatChains {
    type Sum = V;
    const MACS: usize = 1;

    #[inline(always)]
    unsafe fn start() -> V {
        // SAFETY: the caller's promise.
        unsafe { V::splat(black_box(1.0)) }
    }

    #[inline(always)]
    unsafe fn next(sum: V) -> V {
        // SAFETY: the caller's promise.
        unsafe { sum.fma(V::splat(0.5), V::splat(1.0)) }
    }
}

impl<S: Simd<Vector = V>, V: Vector> Link<S> for Bf16Chains {
    type Sum = V;
    const MACS: usize = 2;

    #[inline(always)]
    unsafe fn start() -> V {
        // SAFETY: the caller's promise.
        unsafe { V::splat(black_box(1.0)) }
    }

    #[inline(always)]
    unsafe fn next(sum: V) -> V {
        // One bf16 a lane, and zero.
        const ONE: i32 = 0x3f80;
        // SAFETY: the caller's promise.
        unsafe { S::Dots::bf16(sum, V::splat_int(ONE), V::splat_int(ONE)) }
    }
}

impl<S: Simd<Vector = V>, V: Vector> Link<S> for Int8Chains {
    type Sum = V::Ints;
    const MACS: usize = 4;

    #[inline(always)]
    unsafe fn start() -> V::Ints {
        // SAFETY: the caller's promise.
        unsafe { V::splat_int(black_box(1)) }
    }

    /// The bytes are those of the sum: products that do not change would be computed once.
    #[inline(always)]
    unsafe fn next(sum: V::Ints) -> V::Ints {
        // SAFETY: the caller's promise. Whether the products saturate does not matter here.
        unsafe { S::Dots::int8(sum, sum, V::splat_int(0x0102_0304)) }
    }
}

macro_rules! kernels {
    ($($chains:ty),+) => {$(
        impl Kernel for $chains {
            type Output = usize;

            #[inline(always)]
            fn run<S: Simd>(self, _: S) -> usize {
                // SAFETY: kernels are called within `Simd::run`.
                unsafe { all_chains::<S, Self>() }
            }
        }
    )+};
}
kernels!(FloatChains, Bf16Chains, Int8Chains);
