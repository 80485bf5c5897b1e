//! The instruction sets of x86-64.

pub(crate) mod avx2;
pub(crate) mod avx512;

use std::arch::x86_64::{_MM_FROUND_NO_EXC, _MM_FROUND_TO_NEAREST_INT};

const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

/// A [`Simd`](crate::simd::Simd) type: its name, its vector, its dot products, the features that it needs and turns on, and what else must
/// be true.
macro_rules! simd_type {
    ($(#[$doc:meta])* $name:ident, $vector:ty, $dots:ty, $($feature:tt),+ $(; if $condition:expr)?) => {
        $(#[$doc])*
        #[derive(Clone, Copy)]
        pub(crate) struct $name(());

        // SAFETY: a value is made only on a CPU that has the features.
        unsafe impl Simd for $name {
            type Vector = $vector;
            type Dots = $dots;

            #[inline]
            fn new() -> Option<Self> {
                ($(is_x86_feature_detected!($feature))&&+ $(&& $condition)?).then_some(Self(()))
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
