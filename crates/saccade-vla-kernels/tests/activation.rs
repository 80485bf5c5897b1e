//! Activations and the exponential compared with float64, on every instruction set.

mod common;

use saccade_vla_kernels::{Isa, exp, gelu_erf, gelu_tanh, relu, silu};

/// Values of the whole range: a coarse walk over the bits, a fine one over where it matters.
fn sweep() -> Vec<f32> {
    let coarse = (0..=u32::MAX)
        .step_by(9973)
        .map(f32::from_bits)
        .filter(|x| x.is_finite());
    let fine = (-1_100_000..=1_000_000).map(|i| i as f32 * 1e-4);
    coarse.chain(fine).collect()
}

/// How near a function is to the exact one: in units of the last place from `from` to `to`, in absolute
/// terms below `from`.
struct Bounds {
    from: f32,
    to: f32,
    ulps: f64,
    absolute: f64,
}

/// A unit of the last place of `exact` as a float32.
fn ulp(exact: f64) -> f64 {
    let normal = exact.abs().max(f64::from(f32::MIN_POSITIVE));
    // The exponent of a float64, 23 less, and no mantissa.
    f64::from_bits(((normal.to_bits() >> 52) - 23) << 52)
}

/// Compares a function with the exact one on all of [`sweep`], on every instruction set.
fn check(what: &str, f: fn(Isa, &mut [f32]), exact: fn(f64) -> f64, bounds: &Bounds) {
    let x: Vec<f32> = sweep().into_iter().filter(|x| *x <= bounds.to).collect();
    // Once for all instruction sets: this takes longer than the functions themselves.
    let exact: Vec<(f64, f64)> = x
        .iter()
        .map(|&x| {
            let exact = exact(f64::from(x));
            (exact, if x < bounds.from { 1.0 } else { ulp(exact) })
        })
        .collect();
    for isa in Isa::available() {
        let mut y = x.clone();
        f(isa, &mut y);
        let mut below = (0.0, 0.0);
        let mut within = (0.0, 0.0);
        for ((&x, &y), &(exact, unit)) in x.iter().zip(&y).zip(&exact) {
            let distance = (f64::from(y) - exact).abs() / unit;
            assert!(!distance.is_nan(), "{isa} {what}: NaN at {x}");
            let worst = if x < bounds.from { &mut below } else { &mut within };
            if distance > worst.0 {
                *worst = (distance, x);
            }
        }
        for ((worst, at), limit) in [(below, bounds.absolute), (within, bounds.ulps)] {
            println!("{isa} {what}: {worst:.3e} at {at}");
            assert!(
                worst <= limit,
                "{isa} {what}: {worst} at {at}, expected at most {limit}"
            );
        }
    }
}

#[test]
fn units_of_the_last_place() {
    for x in [1.0, 1.5, 3.0e38, -0.75, f32::MIN_POSITIVE] {
        let above = f32::from_bits(x.to_bits() + 1);
        assert_eq!(ulp(f64::from(x)), f64::from((above - x).abs()), "{x}");
    }
    assert_eq!(ulp(0.0), f64::from(f32::from_bits(1)));
}

#[test]
fn accuracy_of_exp() {
    let bounds = Bounds {
        from: -87.33,
        to: 88.72,
        ulps: 2.0,
        absolute: 3e-45,
    };
    check("exp", exp, f64::exp, &bounds);
}

#[test]
fn accuracy_of_gelu() {
    let bounds = Bounds {
        from: -1.0,
        to: f32::MAX,
        ulps: 4.0,
        absolute: 1e-7,
    };
    check("GELU", gelu_tanh, common::gelu_tanh, &bounds);
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
        assert!((common::gelu_erf(x) - exact).abs() < 1e-13, "{x}");
    }
    let bounds = Bounds {
        from: -1.0,
        to: f32::MAX,
        ulps: 8.0,
        absolute: 1e-7,
    };
    check("GELU by erf", gelu_erf, common::gelu_erf, &bounds);
}

#[test]
fn the_tail_of_gelu_by_erf_ends() {
    for isa in Isa::available() {
        // The second from erfc of the C library.
        let mut x = [-12.7, -12.0, -12.64];
        gelu_erf(isa, &mut x);
        assert_eq!(x[0], 0.0, "{isa}");
        assert!((x[1] / -2.131_779e-32 - 1.0).abs() < 0.01, "{isa}: {:e}", x[1]);
        assert!(x[2] < 0.0, "{isa}: {:e}", x[2]);
    }
}

/// No result is a denormal, but of inputs that nearly are.
#[test]
fn activations_make_no_denormals() {
    let x: Vec<f32> = sweep().into_iter().filter(|x| x.abs() > 1e-18).collect();
    for isa in Isa::available() {
        for f in [gelu_tanh, gelu_erf, silu] {
            let mut y = x.clone();
            f(isa, &mut y);
            let denormal = y.iter().position(|y| y.is_subnormal());
            assert_eq!(denormal.map(|at| x[at]), None, "{isa}");
        }
    }
}

#[test]
fn accuracy_of_silu() {
    let bounds = Bounds {
        from: -87.0,
        to: f32::MAX,
        ulps: 4.0,
        absolute: 1e-35,
    };
    check("SiLU", silu, common::silu, &bounds);
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
