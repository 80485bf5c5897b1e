//! LayerNorm against float64 on every instruction set, and the bits that must not change.

mod common;

use common::{ROUNDING, Strided, bits, isas, numbers, rows, rows_mut};
use proptest::prelude::*;
use saccade_vla_kernels::{Isa, layer_norm};

/// Rows in float64: `(x - mean) / sqrt(variance + eps)`.
fn exact(row: &[f32], eps: f32) -> Vec<f64> {
    let width = row.len() as f64;
    let mean = row.iter().map(|&x| f64::from(x)).sum::<f64>() / width;
    let variance = row.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / width;
    row.iter()
        .map(|&x| (f64::from(x) - mean) / (variance + f64::from(eps)).sqrt())
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn agrees_with_float64(
        row_count in 0..12_usize,
        width in 1..700_usize,
        offset in prop_oneof![Just(0.0_f32), Just(100.0), Just(-3000.0)],
        affine in any::<bool>(),
        gaps in (0..4_usize, 0..4_usize),
        threads in 1..4_usize,
        seed in 0..u64::MAX / 2,
    ) {
        let values: Vec<f32> = numbers(seed, row_count * width, 2.0).iter().map(|x| x + offset).collect();
        let (scale, shift) = (numbers(seed + 1, width, 2.0), numbers(seed + 2, width, 2.0));
        let x = Strided::new(&values, row_count, width, gaps.0);
        for isa in isas() {
            let mut out = Strided::new(&vec![0.0; values.len()], row_count, width, gaps.1);
            layer_norm(isa, threads, x.view(), 1e-5, affine.then_some((&scale[..], &shift[..])), out.view_mut());
            for (row, out) in values.chunks_exact(width).zip(out.values().chunks_exact(width)) {
                let normed = exact(row, 1e-5);
                let deviation = row.iter().zip(&normed).map(|(&x, n)| (f64::from(x) - f64::from(row[0])) / (n - normed[0])).find(|d| d.is_finite()).unwrap_or(1.0);
                // What the mean of large numbers can be off by, seen through the division; and some roundings of the rest.
                let bound = |value: f64| 40.0 * ROUNDING * (value.abs() + 1.0) + 4.0 * ROUNDING * f64::from(offset).abs() / deviation.abs();
                for (column, (&out, &value)) in out.iter().zip(&normed).enumerate() {
                    let (expected, factor) = if affine { (value * f64::from(scale[column]) + f64::from(shift[column]), f64::from(scale[column]).abs() + 1.0) } else { (value, 1.0) };
                    let error = (f64::from(out) - expected).abs();
                    prop_assert!(error <= bound(value) * factor + 4.0 * ROUNDING * expected.abs(), "{isa}, column {column}: {out} instead of {expected}, off by {error}");
                }
            }
        }
    }
}

#[test]
fn bits_do_not_depend_on_threads_nor_on_other_rows() {
    for (row_count, width) in [(300, 1536), (120, 1000), (2000, 37)] {
        let x = numbers(1, row_count * width, 3.0);
        let (scale, shift) = (numbers(2, width, 2.0), numbers(3, width, 2.0));
        let norm = |isa, threads, x: &[f32]| {
            let mut out = vec![0.0; x.len()];
            layer_norm(
                isa,
                threads,
                rows(x, width),
                1e-6,
                Some((&scale, &shift)),
                rows_mut(&mut out, width),
            );
            bits(&out)
        };
        for isa in isas() {
            let all = norm(isa, 1, &x);
            for threads in [2, 3, 8] {
                assert_eq!(norm(isa, threads, &x), all, "{isa}, {threads} threads");
            }
            for (first, count) in [(0, 1), (77, 1), (5, 60)] {
                let part = norm(isa, 1, &x[first * width..][..count * width]);
                assert_eq!(
                    part,
                    all[first * width..][..count * width],
                    "{isa}, {count} rows from {first}"
                );
            }
        }
    }
}

#[test]
fn a_constant_row_gives_the_shift_and_nan_stays_in_its_row() {
    for isa in isas() {
        let mut x = vec![2.5; 5 * 50];
        x[2 * 50 + 49] = f32::NAN;
        x[3 * 50 + 1] = f32::INFINITY;
        let mut out = vec![7.0; 5 * 50];
        layer_norm(
            isa,
            2,
            rows(&x, 50),
            1e-5,
            Some((&[3.0; 50], &[0.25; 50])),
            rows_mut(&mut out, 50),
        );
        for (row, out) in out.as_chunks::<50>().0.iter().enumerate() {
            if row == 2 || row == 3 {
                assert!(
                    out.iter().all(|value| value.is_nan()),
                    "{isa}, row {row}: {out:?}"
                );
            } else {
                assert_eq!(out, &[0.25; 50], "{isa}, row {row}");
            }
        }
    }
}

#[test]
#[should_panic(expected = "expected one element per column")]
fn a_scale_of_another_width_panics() {
    layer_norm(
        Isa::best(),
        1,
        rows(&[0.0; 6], 3),
        0.0,
        Some((&[0.0; 2], &[0.0; 3])),
        rows_mut(&mut [0.0; 6], 3),
    );
}
