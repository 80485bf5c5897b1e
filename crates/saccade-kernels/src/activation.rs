//! Exponential and activations: vector forms for the epilogues of other kernels, and slices in place.

use crate::isa::Isa;
use crate::simd::{Kernel, Vector, dispatch};

/// `exp(x)`, within 2 ULP of the exact value where that is a normal number, and within one smallest denormal below.
///
/// Exactly 0 at `-inf` and below -104, infinity above 88.73, NaN at NaN.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
pub(crate) unsafe fn exp_vector<V: Vector>(x: V) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        // Beyond these the result is 0 or infinity, and the whole part stays small. The second operand wins if it is NaN.
        let x = V::splat(-105.0).max(V::splat(89.0).min(x));
        // x = n ln 2 + r, |r| <= ln 2 / 2; ln 2 in two parts, of which n times the first is exact (Cody and Waite).
        let n = x.mul(V::splat(std::f32::consts::LOG2_E)).round();
        let r = n.fma(V::splat(-0.693_359_4), x);
        let r = n.fma(V::splat(2.121_944_4e-4), r);
        // exp(r) = 1 + r + r^2 p(r), the polynomial of Cephes' expf.
        let p = V::splat(1.987_569_1e-4);
        let p = p.fma(r, V::splat(1.398_199_9e-3));
        let p = p.fma(r, V::splat(8.333_452e-3));
        let p = p.fma(r, V::splat(4.166_579_6e-2));
        let p = p.fma(r, V::splat(1.666_666_5e-1));
        let p = p.fma(r, V::splat(0.5));
        let p = p.fma(r.mul(r), r).add(V::splat(1.0));
        p.scale_by_power_of_two(n)
    }
}

/// `x / (1 + exp(-x))`.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
pub(crate) unsafe fn silu_vector<V: Vector>(x: V) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        // Below, the result is -0, as it is in the limit; -inf would give inf / inf.
        let x = V::splat(-200.0).max(x);
        let e = exp_vector(V::splat(0.0).sub(x));
        x.div(V::splat(1.0).add(e))
    }
}

/// `0.5 x (1 + tanh(u)) = x / (1 + exp(-2 u))` with `u = sqrt(2 / pi) (x + 0.044715 x^3)`.
///
/// The right form needs no difference of nearly equal numbers, so that it is exact to rounding for negative `x` too.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
pub(crate) unsafe fn gelu_tanh_vector<V: Vector>(x: V) -> V {
    // -2 sqrt(2 / pi), and the same times 0.044715.
    const LINEAR: f32 = -1.595_769_2;
    const CUBIC: f32 = -0.071_354_82;
    // SAFETY: the caller's promise.
    unsafe {
        // Below, the result is -0, as it is in the limit; -inf would give inf / inf.
        let x = V::splat(-30.0).max(x);
        let factor = x.mul(x).fma(V::splat(CUBIC), V::splat(LINEAR));
        let e = exp_vector(x.mul(factor));
        x.div(V::splat(1.0).add(e))
    }
}

/// A function of one vector, for [`Map`].
trait Activation {
    /// # Safety
    /// The CPU has the instruction set of `V`.
    unsafe fn of<V: Vector>(x: V) -> V;
}

struct GeluTanh;
struct Silu;
struct Relu;
struct Exp;

impl Activation for GeluTanh {
    #[inline(always)]
    unsafe fn of<V: Vector>(x: V) -> V {
        // SAFETY: the caller's promise.
        unsafe { gelu_tanh_vector(x) }
    }
}

impl Activation for Silu {
    #[inline(always)]
    unsafe fn of<V: Vector>(x: V) -> V {
        // SAFETY: the caller's promise.
        unsafe { silu_vector(x) }
    }
}

impl Activation for Relu {
    #[inline(always)]
    unsafe fn of<V: Vector>(x: V) -> V {
        // SAFETY: the caller's promise. The second operand wins if it is NaN.
        unsafe { V::splat(0.0).max(x) }
    }
}

impl Activation for Exp {
    #[inline(always)]
    unsafe fn of<V: Vector>(x: V) -> V {
        // SAFETY: the caller's promise.
        unsafe { exp_vector(x) }
    }
}

/// An activation over a slice, in place.
struct Map<'a, A> {
    x: &'a mut [f32],
    activation: std::marker::PhantomData<A>,
}

impl<A: Activation> Kernel for Map<'_, A> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<V: Vector>(self) {
        let mut chunks = self.x.chunks_exact_mut(V::LANES);
        for chunk in &mut chunks {
            // SAFETY: a chunk has LANES elements; the caller has the instruction set.
            unsafe { A::of(V::load(chunk.as_ptr())).store(chunk.as_mut_ptr()) }
        }
        let rest = chunks.into_remainder();
        // SAFETY: as many lanes as there are elements.
        unsafe {
            A::of(V::load_partial(rest.as_ptr(), rest.len())).store_partial(rest.as_mut_ptr(), rest.len())
        }
    }
}

fn map<A: Activation>(isa: Isa, x: &mut [f32]) {
    dispatch(
        isa,
        Map::<A> {
            x,
            activation: std::marker::PhantomData,
        },
    );
}

/// GELU in its tanh form, `0.5 x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3)))`, in place.
///
/// Within 4 ULP for `x >= -1`, and within `1e-7` of the exact value below; NaN stays, `-inf` gives `-0`.
///
/// ```
/// let mut x = [0.0, 1.0, f32::NEG_INFINITY];
/// saccade_kernels::gelu_tanh(saccade_kernels::Isa::best(), &mut x);
/// assert!((x[1] - 0.841_192).abs() < 1e-6 && x[0] == 0.0 && x[2] == 0.0);
/// ```
///
/// # Panics
/// If this CPU lacks `isa`.
pub fn gelu_tanh(isa: Isa, x: &mut [f32]) {
    map::<GeluTanh>(isa, x);
}

/// `x / (1 + exp(-x))`, in place.
///
/// Within 4 ULP down to `x = -87`; below, where `exp(-x)` overflows, within `1e-35`. NaN stays, `-inf` gives `-0`.
///
/// ```
/// let mut x = [0.0, 1.0];
/// saccade_kernels::silu(saccade_kernels::Isa::best(), &mut x);
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
/// saccade_kernels::relu(saccade_kernels::Isa::best(), &mut x);
/// assert_eq!(x, [0.0, 2.0]);
/// ```
///
/// # Panics
/// If this CPU lacks `isa`.
pub fn relu(isa: Isa, x: &mut [f32]) {
    map::<Relu>(isa, x);
}

/// `exp(x)`, in place, as the softmax of [`attention`](crate::attention()) computes it.
///
/// Within 2 ULP where the exact value is a normal number, within `3e-45` below. 0 at `-inf`, infinity above 88.73, NaN at NaN.
///
/// ```
/// let mut x = [0.0, f32::NEG_INFINITY];
/// saccade_kernels::exp(saccade_kernels::Isa::best(), &mut x);
/// assert_eq!(x, [1.0, 0.0]);
/// ```
///
/// # Panics
/// If this CPU lacks `isa`.
pub fn exp(isa: Isa, x: &mut [f32]) {
    map::<Exp>(isa, x);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values of the whole range: a coarse walk over the bits, a fine one over where it matters.
    fn sweep() -> Vec<f32> {
        let coarse = (0..=u32::MAX)
            .step_by(9973)
            .map(f32::from_bits)
            .filter(|x| x.is_finite());
        let fine = (-1_100_000..=1_000_000).map(|i| i as f32 * 1e-4);
        coarse.chain(fine).collect()
    }

    /// Distance in units of the last place of `exact` as a float32.
    fn ulps(given: f32, exact: f64) -> f64 {
        let exponent = exact.abs().max(f64::from(f32::MIN_POSITIVE)).log2().floor();
        (f64::from(given) - exact).abs() / (exponent - 23.0).exp2()
    }

    /// Worst distance over those inputs that `check` keeps, with the input.
    fn worst(
        f: fn(Isa, &mut [f32]),
        isa: Isa,
        exact: fn(f64) -> f64,
        distance: fn(f32, f64) -> f64,
        check: fn(f32) -> bool,
    ) -> (f64, f32) {
        let x = sweep();
        let mut y = x.clone();
        f(isa, &mut y);
        let mut worst = (0.0, 0.0);
        for (&x, &y) in x.iter().zip(&y).filter(|(x, _)| check(**x)) {
            let d = distance(y, exact(f64::from(x)));
            assert!(!d.is_nan(), "{isa}: NaN at {x}");
            if d > worst.0 {
                worst = (d, x);
            }
        }
        worst
    }

    fn absolute(given: f32, exact: f64) -> f64 {
        (f64::from(given) - exact).abs()
    }

    fn exact_gelu(x: f64) -> f64 {
        let u = (2.0 / std::f64::consts::PI).sqrt() * (x + 0.044715 * x * x * x);
        x / (1.0 + (-2.0 * u).exp())
    }

    fn exact_silu(x: f64) -> f64 {
        x / (1.0 + (-x).exp())
    }

    fn bound(what: &str, isa: Isa, (worst, at): (f64, f32), limit: f64) {
        println!("{isa} {what}: {worst:.3e} at {at}");
        assert!(
            worst <= limit,
            "{isa} {what}: {worst} at {at}, expected at most {limit}"
        );
    }

    #[test]
    fn accuracy_of_exp() {
        for isa in Isa::available() {
            let normal = |x| (-87.33..=88.72).contains(&x);
            bound("exp, ULP", isa, worst(exp, isa, f64::exp, ulps, normal), 2.0);
            bound(
                "exp, denormal",
                isa,
                worst(exp, isa, f64::exp, absolute, |x| x < -87.33),
                3e-45,
            );
        }
    }

    #[test]
    fn accuracy_of_gelu() {
        for isa in Isa::available() {
            bound(
                "GELU, ULP",
                isa,
                worst(gelu_tanh, isa, exact_gelu, ulps, |x| x >= -1.0),
                4.0,
            );
            bound(
                "GELU, absolute",
                isa,
                worst(gelu_tanh, isa, exact_gelu, absolute, |x| x < -1.0),
                1e-7,
            );
        }
    }

    #[test]
    fn accuracy_of_silu() {
        for isa in Isa::available() {
            bound(
                "SiLU, ULP",
                isa,
                worst(silu, isa, exact_silu, ulps, |x| x >= -87.0),
                4.0,
            );
            bound(
                "SiLU, absolute",
                isa,
                worst(silu, isa, exact_silu, absolute, |x| x < -87.0),
                1e-35,
            );
        }
    }

    #[test]
    fn the_ends_of_the_range() {
        let ends = [
            f32::NEG_INFINITY,
            f32::MIN,
            -104.1,
            89.0,
            f32::MAX,
            f32::INFINITY,
            f32::NAN,
        ];
        let of = |f: fn(Isa, &mut [f32]), isa| {
            let mut x = ends;
            f(isa, &mut x);
            assert!(x[6].is_nan());
            x
        };
        for isa in Isa::available() {
            let inf = f32::INFINITY;
            assert_eq!(of(exp, isa)[..6], [0.0, 0.0, 0.0, inf, inf, inf]);
            assert_eq!(of(gelu_tanh, isa)[..6], [0.0, 0.0, 0.0, 89.0, f32::MAX, inf]);
            assert_eq!(of(silu, isa)[..6], [0.0, 0.0, 0.0, 89.0, f32::MAX, inf]);
            assert_eq!(of(relu, isa)[..6], [0.0, 0.0, 0.0, 89.0, f32::MAX, inf]);
        }
    }

    #[test]
    fn a_value_does_not_depend_on_its_lane() {
        for isa in Isa::available() {
            for f in [exp, gelu_tanh, silu, relu] {
                let x: Vec<f32> = (0..67).map(|i| i as f32 * 0.37 - 12.0).collect();
                let mut all = x.clone();
                f(isa, &mut all);
                for (&x, &y) in x.iter().zip(&all) {
                    let mut one = [x];
                    f(isa, &mut one);
                    assert_eq!(one[0].to_bits(), y.to_bits());
                }
            }
        }
    }
}
