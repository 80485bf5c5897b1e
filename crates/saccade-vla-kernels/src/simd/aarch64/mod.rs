//! The instruction sets of 64-bit ARM.

pub(crate) mod instructions;
pub(crate) mod neon;

/// A [`Simd`](crate::simd::Simd) type on NEON vectors: its name, its dot products, and the features that it needs and turns on.
macro_rules! simd_type {
    ($(#[$doc:meta])* $name:ident, $dots:ty, $($feature:tt),+) => {
        $(#[$doc])*
        #[derive(Clone, Copy)]
        pub(crate) struct $name(());

        // SAFETY: a value is made only on a CPU that has the features.
        unsafe impl Simd for $name {
            type Vector = float32x4_t;
            type Dots = $dots;

            #[inline]
            fn new() -> Option<Self> {
                ($(is_aarch64_feature_detected!($feature))&&+).then_some(Self(()))
            }

            #[inline]
            fn run<K: Kernel>(self, kernel: K) -> K::Output {
                /// # Safety
                /// The CPU has the features.
                $(#[target_feature(enable = $feature)])+
                unsafe fn run<K: Kernel>(simd: $name, kernel: K) -> K::Output {
                    // SAFETY: the caller's promise.
                    unsafe { kernel.run(simd) }
                }
                // SAFETY: there is a value, so the CPU has the features.
                unsafe { run(self, kernel) }
            }
        }
    };
}
use simd_type;
