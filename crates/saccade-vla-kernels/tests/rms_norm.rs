//! RMSNorm against float64 on every instruction set, and the bits that must not change.

mod common;

use common::{ROUNDING, Strided, bits, isas, numbers, rows, rows_mut};
use proptest::prelude::*;
use saccade_vla_kernels::{Isa, rms_norm, rms_norm_in_place};

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn agrees_with_float64(
        row_count in 0..12_usize,
        num_heads in 1..5_usize,
        head_dim in 1..400_usize,
        scale in prop_oneof![Just(1e-3_f32), Just(1.0), Just(1e4)],
        gaps in (0..4_usize, 0..4_usize),
        threads in 1..4_usize,
        seed in 0..u64::MAX / 2,
    ) {
        let width = num_heads * head_dim;
        let values = numbers(seed, row_count * width, scale);
        let weight = numbers(seed + 1, head_dim, 2.0);
        let x = Strided::new(&values, row_count, width, gaps.0);
        for isa in isas() {
            let mut out = Strided::new(&vec![f32::NAN; values.len()], row_count, width, gaps.1);
            rms_norm(isa, threads, x.view(), 1e-6, &weight, out.view_mut());
            let out = out.values();
            for (head, given) in values.chunks_exact(head_dim).zip(out.chunks_exact(head_dim)) {
                let mean = head.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>() / head_dim as f64;
                for ((&x, &weight), &given) in head.iter().zip(&weight).zip(given) {
                    let exact = f64::from(x) / (mean + f64::from(1e-6_f32)).sqrt() * f64::from(weight);
                    let error = (f64::from(given) - exact).abs();
                    // Half of the sum's error, since its root is taken, and some roundings.
                    let bound = (head_dim as f64 / 8.0 + 12.0) * ROUNDING * exact.abs();
                    prop_assert!(error <= bound, "{isa}: {given} instead of {exact}, off by {error}");
                }
            }
            let mut in_place = x.clone();
            rms_norm_in_place(isa, threads, in_place.view_mut(), 1e-6, &weight);
            prop_assert_eq!(bits(&in_place.values()), bits(&out));
        }
    }
}

#[test]
fn bits_depend_on_the_head_alone() {
    for (row_count, num_heads, head_dim) in [(300, 1, 1536), (70, 16, 128), (2000, 3, 37)] {
        let width = num_heads * head_dim;
        let (x, weight) = (numbers(1, row_count * width, 3.0), numbers(2, head_dim, 2.0));
        let norm = |isa, threads, x: &[f32], columns| {
            let mut out = vec![0.0; x.len()];
            rms_norm(
                isa,
                threads,
                rows(x, columns),
                1e-6,
                &weight,
                rows_mut(&mut out, columns),
            );
            bits(&out)
        };
        for isa in isas() {
            let all = norm(isa, 1, &x, width);
            for threads in [2, 3, 8] {
                assert_eq!(norm(isa, threads, &x, width), all, "{isa}, {threads} threads");
            }
            assert_eq!(
                norm(isa, 2, &x, head_dim),
                all,
                "{isa}, each head as a row of its own"
            );
            let one = 41 * head_dim..42 * head_dim;
            assert_eq!(norm(isa, 1, &x[one.clone()], head_dim), all[one], "{isa}");
        }
    }
}

#[test]
fn zeros_stay_and_nan_stays_in_its_head() {
    for isa in isas() {
        let mut x = vec![2.5; 6 * 50];
        x[..50].fill(0.0);
        x[2 * 50 + 49] = f32::NAN;
        x[3 * 50] = f32::INFINITY;
        rms_norm_in_place(isa, 2, rows_mut(&mut x, 100), 1e-5, &[3.0; 50]);
        for (head, out) in x.as_chunks::<50>().0.iter().enumerate() {
            match head {
                0 => assert_eq!(out, &[0.0; 50], "{isa}"),
                2 => assert!(out.iter().all(|value| value.is_nan()), "{isa}: {out:?}"),
                3 => assert!(out[0].is_nan() && out[1] == 0.0, "{isa}: {out:?}"),
                _ => assert!(
                    out.iter().all(|value| (value - 3.0).abs() < 1e-5),
                    "{isa}: {out:?}"
                ),
            }
        }
    }
}

#[test]
#[should_panic(expected = "weight: expected 6 elements, or a divisor of that, got 4")]
fn a_weight_that_does_not_divide_the_width_panics() {
    rms_norm_in_place(Isa::best(), 1, rows_mut(&mut [0.0; 6], 6), 0.0, &[0.0; 4]);
}
