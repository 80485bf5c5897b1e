//! The exponential and the activations of one vector.

use super::Vector;

/// `exp(x)`, within 2 ULP of the exact value where that is a normal number, and within one smallest denormal below.
///
/// Exactly 0 at `-inf` and below -104, infinity above 88.73, NaN at NaN.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn exp_vector<V: Vector>(x: V) -> V {
    // SAFETY: the caller's promise. At -105 the result is 0.
    unsafe { exp_from(x, -105.0) }
}

/// Where `exp(x)` is only added to 1, smaller `x` change nothing. From -87.34 on the exponential is a denormal: tanh-GELU of a vector with a 10.5
/// took 91 instead of 5.6 ns with AVX-512, 133 instead of 12 with AVX2 (Emerald Rapids).
const LEAST_BESIDE_ONE: f32 = -87.0;

/// Where the tail of [`gelu_erf_vector`] ends. It is below 1e-35 there, and still a product of normal numbers.
const END_OF_TAIL: f32 = 12.65;

/// `exp(max(x, least))`, as [`exp_vector`]; `least` is at least -105.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn exp_from<V: Vector>(x: V, least: f32) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        // Above 89 the result is infinity. The bounds keep the whole part small. The second operand wins if it is NaN.
        let x = V::splat(least).max(V::splat(89.0).min(x));
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
unsafe fn silu_vector<V: Vector>(x: V) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        // Below, the result is -0, as it is in the limit; -inf would give inf / inf.
        let x = V::splat(-200.0).max(x);
        let e = exp_from(V::splat(0.0).sub(x), LEAST_BESIDE_ONE);
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
unsafe fn gelu_tanh_vector<V: Vector>(x: V) -> V {
    // -2 sqrt(2 / pi), and the same times 0.044715.
    const LINEAR: f32 = -1.595_769_2;
    const CUBIC: f32 = -0.071_354_82;
    // SAFETY: the caller's promise.
    unsafe {
        // Below, the result is -0, as it is in the limit; -inf would give inf / inf.
        let x = V::splat(-30.0).max(x);
        let factor = x.mul(x).fma(V::splat(CUBIC), V::splat(LINEAR));
        let e = exp_from(x.mul(factor), LEAST_BESIDE_ONE);
        x.div(V::splat(1.0).add(e))
    }
}

/// `max(x, 0)`; NaN stays, because the second operand wins where the two do not compare.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn relu_vector<V: Vector>(x: V) -> V {
    // SAFETY: the caller's promise.
    unsafe { V::splat(0.0).max(x) }
}

/// `x Phi(x)`, with the distribution function of the normal distribution: `0.5 x (1 + erf(x / sqrt(2)))`.
///
/// As `max(x, 0) - |x| Phi(-|x|)`, which is no difference of nearly equal numbers, with `Phi(-a) = exp(-a^2 / 2) t p(t)` and
/// `t = 1 / (1 + 0.4 a)`. The polynomial has the least relative error on `0 <= a <= 5.5`, 1.5e-8; beyond, the product is below 1e-7. From
/// [`END_OF_TAIL`] on it is taken for 0.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn gelu_erf_vector<V: Vector>(x: V) -> V {
    const P: [f32; 9] = [
        9.238_899e-3,
        -8.646_613e-2,
        0.301_621_4,
        -0.493_916_2,
        0.336_652_73,
        -4.917_652_5e-2,
        0.167_292_8,
        0.154_891_67,
        0.159_861_37,
    ];
    // SAFETY: the caller's promise.
    unsafe {
        let zero = V::splat(0.0);
        // The second operand wins if it is NaN.
        let end = V::splat(END_OF_TAIL);
        let a = end.min(x.max(zero.sub(x)));
        let t = V::splat(1.0).div(a.fma(V::splat(0.4), V::splat(1.0)));
        let mut p = V::splat(P[0]);
        for &coefficient in &P[1..] {
            p = p.fma(t, V::splat(coefficient));
        }
        let e = exp_vector(a.mul(a).mul(V::splat(-0.5)));
        // 0 where `a` was limited.
        let e = e.replace_where(a.sub(end), zero);
        let tail = p.mul(t).mul(e);
        zero.sub(a).fma(tail, zero.max(x))
    }
}

/// `2^r` for `|r| <= 1/2`, highest power first: least relative error among the polynomials of this degree that are 1 at 0; 8e-8 evaluated in
/// float32.
pub(crate) const EXP2: [f32; 7] = [
    1.535_336_2e-4,
    1.339_887_5e-3,
    9.618_437e-3,
    5.550_332_4e-2,
    0.240_226_48,
    std::f32::consts::LN_2,
    1.0,
];

/// The same of degree 3; 1.02e-4, a fortieth of what rounding to bfloat16 may change.
pub(crate) const EXP2_FOR_BF16: [f32; 4] = [5.500_893_3e-2, 0.242_210_97, 0.693_282_9, 1.0];

/// `exp(x)` for `x <= 0` by a polynomial for `2^r`; 0 below -87.7 (-126.5 ln 2), NaN where it is NaN.
///
/// No step has a denormal result for a removed key, whose `x` is `-inf`. A vector with one takes some 200 cycles on Intel (AMX, 2 MB of L2 a
/// core): two such vectors in each row of scores took a third to half of the time of attention.
///
/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
pub(crate) unsafe fn exp_below_zero<V: Vector, const N: usize>(x: V, polynomial: &[f32; N]) -> V {
    /// Sums with it are rounded to whole numbers, whose low bits are an exponent with its bias of 127.
    const WHOLE: f32 = 12_582_912.0 + 127.0;
    // SAFETY: the caller's promise.
    unsafe {
        // From -126.5 ln 2 down to this bound, the whole part is -127, whose power of two has the bits of zero. The second operand wins if it
        // is NaN.
        let x = V::splat(-88.0).max(x);
        let log2_e = V::splat(std::f32::consts::LOG2_E);
        let whole = x.fma(log2_e, V::splat(WHOLE));
        let rest = x.fma(log2_e, V::splat(WHOLE).sub(whole));
        let mut power = V::splat(polynomial[0]);
        for &coefficient in &polynomial[1..] {
            power = power.fma(rest, V::splat(coefficient));
        }
        power.mul(whole.low_bits_as_exponent())
    }
}

/// A function of one vector.
pub(crate) trait Activation {
    /// # Safety
    /// The CPU has the instruction set of `V`.
    unsafe fn of<V: Vector>(x: V) -> V;
}

macro_rules! activations {
    ($($(#[$doc:meta])* $name:ident = $function:expr;)*) => {$(
        $(#[$doc])*
        pub(crate) struct $name;

        impl Activation for $name {
            #[inline(always)]
            unsafe fn of<V: Vector>(x: V) -> V {
                // SAFETY: the caller's promise.
                unsafe { $function(x) }
            }
        }
    )*};
}

activations! {
    /// [`exp_vector`].
    Exp = exp_vector;
    /// [`gelu_tanh_vector`].
    GeluTanh = gelu_tanh_vector;
    /// [`gelu_erf_vector`].
    GeluErf = gelu_erf_vector;
    /// [`silu_vector`].
    Silu = silu_vector;
    /// [`relu_vector`].
    Relu = relu_vector;
}
