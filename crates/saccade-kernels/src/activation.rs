//! The exponential and the activations of slices, in place.

use std::marker::PhantomData;

use crate::isa::Isa;
use crate::simd::math::{Activation, Exp, GeluErf, GeluTanh, Relu, Silu};
use crate::simd::{Kernel, Simd, Vector};

/// An activation over a slice, in place.
struct Map<'a, A> {
    x: &'a mut [f32],
    activation: PhantomData<A>,
}

impl<A: Activation> Kernel for Map<'_, A> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self, _: S) {
        let mut chunks = self.x.chunks_exact_mut(S::Vector::LANES);
        for chunk in &mut chunks {
            // SAFETY: a chunk has LANES elements; the caller has the instruction set.
            unsafe { A::of(S::Vector::load(chunk.as_ptr())).store(chunk.as_mut_ptr()) }
        }
        let rest = chunks.into_remainder();
        // SAFETY: as many lanes as there are elements.
        unsafe {
            let last = S::Vector::load_partial(rest.as_ptr(), rest.len());
            A::of(last).store_partial(rest.as_mut_ptr(), rest.len());
        }
    }
}

fn map<A: Activation>(isa: Isa, x: &mut [f32]) {
    let activation = PhantomData::<A>;
    isa.run(Map { x, activation });
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

/// GELU by its definition, `x Phi(x) = 0.5 x (1 + erf(x / sqrt(2)))`, in place.
///
/// Within 8 ULP for `x >= -1`, and within `1e-7` of the exact value below; NaN stays, `-inf` gives 0.
///
/// ```
/// let mut x = [0.0, 1.0, f32::NEG_INFINITY];
/// saccade_kernels::gelu_erf(saccade_kernels::Isa::best(), &mut x);
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

    /// By `erfc(z) = (2 / sqrt(pi)) exp(-z^2) (z + z^3 2/3 + ...)` from 1 for small `z`, and its continued fraction for large ones.
    fn exact_gelu_erf(x: f64) -> f64 {
        let z = x.abs() / std::f64::consts::SQRT_2;
        let erfc = if z < 2.0 {
            let (mut term, mut sum) = (z, z);
            let mut n = 1.0;
            while term > 1e-17 * sum {
                term *= 2.0 * z * z / (2.0 * n + 1.0);
                sum += term;
                n += 1.0;
            }
            1.0 - std::f64::consts::FRAC_2_SQRT_PI * (-z * z).exp() * sum
        } else {
            let fraction = (1..60).rev().fold(z, |rest, n| z + f64::from(n) / 2.0 / rest);
            std::f64::consts::FRAC_2_SQRT_PI / 2.0 * (-z * z).exp() / fraction
        };
        x.max(0.0) - x.abs() * 0.5 * erfc
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
    fn accuracy_of_gelu_by_erf() {
        // From scipy.stats.norm.cdf.
        for (x, exact) in [
            (-4.0, -1.266_849_673_4e-4),
            (-1.0, -0.158_655_253_931_457),
            (0.5, 0.345_731_230_637_006_5),
            (3.0, 2.995_950_305_905_110_5),
        ] {
            assert!((exact_gelu_erf(x) - exact).abs() < 1e-13, "{x}");
        }
        for isa in Isa::available() {
            bound(
                "GELU by erf, ULP",
                isa,
                worst(gelu_erf, isa, exact_gelu_erf, ulps, |x| x >= -1.0),
                8.0,
            );
            bound(
                "GELU by erf, absolute",
                isa,
                worst(gelu_erf, isa, exact_gelu_erf, absolute, |x| x < -1.0),
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
            assert_eq!(of(gelu_erf, isa)[..6], [0.0, 0.0, 0.0, 89.0, f32::MAX, inf]);
            assert_eq!(of(silu, isa)[..6], [0.0, 0.0, 0.0, 89.0, f32::MAX, inf]);
            assert_eq!(of(relu, isa)[..6], [0.0, 0.0, 0.0, 89.0, f32::MAX, inf]);
        }
    }

    #[test]
    fn a_value_does_not_depend_on_its_lane() {
        for isa in Isa::available() {
            for f in [exp, gelu_tanh, gelu_erf, silu, relu] {
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
