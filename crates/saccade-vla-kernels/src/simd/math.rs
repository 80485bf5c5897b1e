//! The exponential and the activations of one vector.

use super::Simd;

/// `exp(x)`, within 2 ULP of the exact value where that is a normal number, and within one smallest denormal
/// below.
///
/// Exactly 0 at `-inf` and below -104, infinity above 88.73, NaN at NaN.
#[inline(always)]
fn exp_vector<S: Simd>(simd: S, x: S::F32) -> S::F32 {
    // At -105 the result is 0.
    exp_from(simd, x, -105.0)
}

/// Where `exp(x)` is only added to 1, smaller `x` change nothing. From -87.34 on the exponential is a
/// denormal: tanh-GELU of a vector with a 10.5 took 91 instead of 5.6 ns with AVX-512, 133 instead of 12 with
/// AVX2 (Emerald Rapids).
const LEAST_BESIDE_ONE: f32 = -87.0;

/// Where the tail of [`gelu_erf_vector`] ends. It is below 1e-35 there, and still a product of normal
/// numbers.
const END_OF_TAIL: f32 = 12.65;

/// `exp(max(x, least))`, as [`exp_vector`]; `least` is at least -105.
#[inline(always)]
fn exp_from<S: Simd>(simd: S, x: S::F32, least: f32) -> S::F32 {
    // Above 89 the result is infinity. The bounds keep the whole part small. The second operand wins if it is
    // NaN.
    let x = simd.max(simd.splat(least), simd.min(simd.splat(89.0), x));
    // x = n ln 2 + r, |r| <= ln 2 / 2; ln 2 in two parts, of which n times the first is exact (Cody and
    // Waite).
    let n = simd.round(simd.mul(x, simd.splat(std::f32::consts::LOG2_E)));
    let r = simd.fma(n, simd.splat(-0.693_359_4), x);
    let r = simd.fma(n, simd.splat(2.121_944_4e-4), r);
    // exp(r) = 1 + r + r^2 p(r), the polynomial of Cephes' expf.
    const P: [f32; 6] = [
        1.987_569_1e-4,
        1.398_199_9e-3,
        8.333_452e-3,
        4.166_579_6e-2,
        1.666_666_5e-1,
        0.5,
    ];
    let p = simd.add(
        simd.fma(polynomial(simd, &P, r), simd.mul(r, r), r),
        simd.splat(1.0),
    );
    simd.scale_by_power_of_two(p, n)
}

/// The polynomial of these coefficients, highest power first.
#[inline(always)]
fn polynomial<S: Simd, const N: usize>(simd: S, coefficients: &[f32; N], x: S::F32) -> S::F32 {
    let mut sum = simd.splat(coefficients[0]);
    for &coefficient in &coefficients[1..] {
        sum = simd.fma(sum, x, simd.splat(coefficient));
    }
    sum
}

/// `x / (1 + exp(-x))`.
#[inline(always)]
fn silu_vector<S: Simd>(simd: S, x: S::F32) -> S::F32 {
    // Below, the result is -0, as it is in the limit; -inf would give inf / inf.
    let x = simd.max(simd.splat(-200.0), x);
    let e = exp_from(simd, simd.sub(simd.splat(0.0), x), LEAST_BESIDE_ONE);
    simd.div(x, simd.add(simd.splat(1.0), e))
}

/// `0.5 x (1 + tanh(u)) = x / (1 + exp(-2 u))` with `u = sqrt(2 / pi) (x + 0.044715 x^3)`.
///
/// The right form needs no difference of nearly equal numbers, so that it is exact to rounding for negative
/// `x` too.
#[inline(always)]
fn gelu_tanh_vector<S: Simd>(simd: S, x: S::F32) -> S::F32 {
    // -2 sqrt(2 / pi), and the same times 0.044715.
    const LINEAR: f32 = -1.595_769_2;
    const CUBIC: f32 = -0.071_354_82;
    // Below, the result is -0, as it is in the limit; -inf would give inf / inf.
    let x = simd.max(simd.splat(-30.0), x);
    let factor = simd.fma(simd.mul(x, x), simd.splat(CUBIC), simd.splat(LINEAR));
    let e = exp_from(simd, simd.mul(x, factor), LEAST_BESIDE_ONE);
    simd.div(x, simd.add(simd.splat(1.0), e))
}

/// `max(x, 0)`; NaN stays, because the second operand wins where the two do not compare.
#[inline(always)]
fn relu_vector<S: Simd>(simd: S, x: S::F32) -> S::F32 {
    simd.max(simd.splat(0.0), x)
}

/// `x Phi(x)`, with the distribution function of the normal distribution: `0.5 x (1 + erf(x / sqrt(2)))`.
///
/// As `max(x, 0) - |x| Phi(-|x|)`, which is no difference of nearly equal numbers, with
/// `Phi(-a) = exp(-a^2 / 2) t p(t)` and `t = 1 / (1 + 0.4 a)`. The polynomial has the least relative error on
/// `0 <= a <= 5.5`, 1.5e-8; beyond, the product is below 1e-7. From [`END_OF_TAIL`] on it is taken for 0.
#[inline(always)]
fn gelu_erf_vector<S: Simd>(simd: S, x: S::F32) -> S::F32 {
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
    let zero = simd.splat(0.0);
    // The second operand wins if it is NaN.
    let end = simd.splat(END_OF_TAIL);
    let a = simd.min(end, simd.max(x, simd.sub(zero, x)));
    let t = simd.div(simd.splat(1.0), simd.fma(a, simd.splat(0.4), simd.splat(1.0)));
    let p = polynomial(simd, &P, t);
    let e = exp_vector(simd, simd.mul(simd.mul(a, a), simd.splat(-0.5)));
    // 0 where `a` was limited.
    let e = simd.replace_where(e, simd.sub(a, end), zero);
    let tail = simd.mul(simd.mul(p, t), e);
    simd.fma(simd.sub(zero, a), tail, simd.max(zero, x))
}

/// `2^r` for `|r| <= 1/2`, highest power first: least relative error among the polynomials of this degree
/// that are 1 at 0; 8e-8 evaluated in float32.
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
/// No step has a denormal result for a removed key, whose `x` is `-inf`. A vector with one takes some 200
/// cycles on Intel (AMX, 2 MB of L2 a core): two such vectors in each row of scores took a third to half of
/// the time of attention.
#[inline(always)]
pub(crate) fn exp_below_zero<S: Simd, const N: usize>(simd: S, x: S::F32, exp2: &[f32; N]) -> S::F32 {
    /// Sums with it are rounded to whole numbers, whose low bits are an exponent with its bias of 127.
    const WHOLE: f32 = 12_582_912.0 + 127.0;
    // From -126.5 ln 2 down to this bound, the whole part is -127, whose power of two has the bits of zero.
    // The second operand wins if it is NaN.
    let x = simd.max(simd.splat(-88.0), x);
    let log2_e = simd.splat(std::f32::consts::LOG2_E);
    let whole = simd.fma(x, log2_e, simd.splat(WHOLE));
    let rest = simd.fma(x, log2_e, simd.sub(simd.splat(WHOLE), whole));
    simd.mul(polynomial(simd, exp2, rest), simd.low_bits_as_exponent(whole))
}

/// A function of one vector.
pub(crate) trait Activation {
    fn of<S: Simd>(simd: S, x: S::F32) -> S::F32;
}

macro_rules! activations {
    ($($(#[$doc:meta])* $name:ident = $function:expr;)*) => {$(
        $(#[$doc])*
        pub(crate) struct $name;

        impl Activation for $name {
            #[inline(always)]
            fn of<S: Simd>(simd: S, x: S::F32) -> S::F32 {
                $function(simd, x)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::isa::Isa;
    use crate::simd::{Kernel, MAX_LANES, Simd};

    /// The exponentials of a number below zero with the two polynomials, and the one that is added to 1, in
    /// all lanes.
    struct ExpBelowZero(f32);

    impl Kernel for ExpBelowZero {
        type Output = [Vec<f32>; 3];

        #[inline(always)]
        fn run<S: Simd>(&mut self, simd: S) -> Self::Output {
            let mut lanes = [[0.0; MAX_LANES]; 3];
            let x = simd.splat(self.0);
            simd.store(exp_below_zero(simd, x, &EXP2), &mut lanes[0]);
            simd.store(exp_below_zero(simd, x, &EXP2_FOR_BF16), &mut lanes[1]);
            simd.store(exp_from(simd, x, LEAST_BESIDE_ONE), &mut lanes[2]);
            lanes.map(|lanes| lanes[..S::LANES].to_vec())
        }
    }

    /// Otherwise activations of large values are slow, and results would not tell.
    #[test]
    fn exponentials_beside_one_are_nothing_and_no_denormals() {
        for isa in Isa::available() {
            for x in [
                -86.9,
                -87.0,
                -87.3,
                -87.4,
                -88.0,
                -104.0,
                -105.0,
                f32::MIN,
                f32::NEG_INFINITY,
            ] {
                let [_, _, beside_one] = isa.run(&mut ExpBelowZero(x));
                for lane in beside_one {
                    assert!(lane.is_normal() && 1.0 + lane == 1.0, "{isa}: {lane:e} at {x}");
                }
            }
        }
    }

    #[test]
    fn exponentials_below_zero_end_at_zero() {
        // Relative, of the two polynomials at zero; `x log2(e)` is rounded once or twice, and its whole part
        // is then lost.
        let errors = [3e-7, 1.1e-4];
        for isa in Isa::available() {
            for x in [
                0.0,
                -1.0,
                -40.3,
                -87.3,
                -87.5,
                -87.8,
                -88.0,
                -104.0,
                f32::MIN,
                f32::NEG_INFINITY,
            ] {
                let exact = if x < -87.7 { 0.0 } else { f64::from(x).exp() };
                for (lanes, error) in isa.run(&mut ExpBelowZero(x)).iter().zip(errors) {
                    let error = error + 1.5e-7 * f64::from(x.abs().min(88.0));
                    for &lane in lanes {
                        let distance = (f64::from(lane) - exact).abs();
                        assert!(
                            distance <= error * exact,
                            "{isa}: {lane} at {x}, expected {exact}"
                        );
                    }
                }
            }
            for lanes in isa.run(&mut ExpBelowZero(f32::NAN)) {
                assert!(lanes.iter().all(|lane| lane.is_nan()), "{isa}: {lanes:?}");
            }
        }
    }
}
