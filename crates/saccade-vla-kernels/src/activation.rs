//! The exponential and the activations of slices, in place.
//!
//! Equations 33 and 34 of docs/equations.md.

use std::marker::PhantomData;

use crate::isa::Isa;
use crate::simd::math::{Activation, Exp, GeluErf, GeluTanh, Relu, Silu};
use crate::simd::{Kernel, Simd};

/// An activation over a slice, in place.
struct Map<'a, A> {
    x: &'a mut [f32],
    activation: PhantomData<A>,
}

impl<A: Activation> Kernel for Map<'_, A> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        let mut chunks = self.x.chunks_exact_mut(S::LANES);
        for x in &mut chunks {
            simd.store(A::of(simd, simd.load(x)), x);
        }
        let rest = chunks.into_remainder();
        simd.store_rest(A::of(simd, simd.load_rest(rest)), rest);
    }
}

fn map<A: Activation>(isa: Isa, x: &mut [f32]) {
    let activation = PhantomData::<A>;
    isa.run(&mut Map { x, activation });
}

/// GELU in its tanh form, `0.5 x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3)))`, in place.
///
/// Within 4 ULP for `x >= -1`, and within `1e-7` of the exact value below; NaN stays, `-inf` gives `-0`.
///
/// ```
/// let mut x = [0.0, 1.0, f32::NEG_INFINITY];
/// saccade_vla_kernels::gelu_tanh(saccade_vla_kernels::Isa::best(), &mut x);
/// assert!((x[1] - 0.841_192).abs() < 1e-6 && x[0] == 0.0 && x[2] == 0.0);
/// ```
///
/// # Panics
/// If this CPU lacks `isa`.
pub fn gelu_tanh(isa: Isa, x: &mut [f32]) {
    map::<GeluTanh>(isa, x);
}

/// GELU by its definition, `x Phi(x) = 0.5 x (1 + erf(x / sqrt(2)))`, in place.
///
/// Within 8 ULP for `x >= -1`, and within `1e-7` of the exact value below; NaN stays, `-inf` gives 0.
///
/// ```
/// let mut x = [0.0, 1.0, f32::NEG_INFINITY];
/// saccade_vla_kernels::gelu_erf(saccade_vla_kernels::Isa::best(), &mut x);
/// assert!((x[1] - 0.841_344_7).abs() < 1e-6 && x[0] == 0.0 && x[2] == 0.0);
/// ```
///
/// # Panics
/// If this CPU lacks `isa`.
pub fn gelu_erf(isa: Isa, x: &mut [f32]) {
    map::<GeluErf>(isa, x);
}

/// `x / (1 + exp(-x))`, in place.
///
/// Within 4 ULP down to `x = -87`; below, where `exp(-x)` overflows, within `1e-35`. NaN stays, `-inf` gives
/// `-0`.
///
/// ```
/// let mut x = [0.0, 1.0];
/// saccade_vla_kernels::silu(saccade_vla_kernels::Isa::best(), &mut x);
/// assert!((x[1] - 0.731_058_6).abs() < 1e-6 && x[0] == 0.0);
/// ```
///
/// # Panics
/// If this CPU lacks `isa`.
pub fn silu(isa: Isa, x: &mut [f32]) {
    map::<Silu>(isa, x);
}

/// `max(x, 0)`, in place; NaN stays.
///
/// ```
/// let mut x = [-1.0, 2.0];
/// saccade_vla_kernels::relu(saccade_vla_kernels::Isa::best(), &mut x);
/// assert_eq!(x, [0.0, 2.0]);
/// ```
///
/// # Panics
/// If this CPU lacks `isa`.
pub fn relu(isa: Isa, x: &mut [f32]) {
    map::<Relu>(isa, x);
}

/// `exp(x)`, in place, as the activations compute it.
///
/// Within 2 ULP where the exact value is a normal number, within `3e-45` below. 0 at `-inf`, infinity above
/// 88.73, NaN at NaN.
///
/// ```
/// let mut x = [0.0, f32::NEG_INFINITY];
/// saccade_vla_kernels::exp(saccade_vla_kernels::Isa::best(), &mut x);
/// assert_eq!(x, [1.0, 0.0]);
/// ```
///
/// # Panics
/// If this CPU lacks `isa`.
pub fn exp(isa: Isa, x: &mut [f32]) {
    map::<Exp>(isa, x);
}
