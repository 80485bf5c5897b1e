//! Rotary position embedding against float64 on every instruction set, and the bits that must not change.

mod common;

use common::{ROUNDING, Strided, bits, isas, numbers, rows, rows_mut};
use proptest::prelude::*;
use saccade_vla_kernels::{Isa, rotary_embedding};

/// `(rows, pairs)` cosines and sines of `position * 10000^(-pair / pairs)`.
fn tables(positions: &[usize], pairs: usize) -> [Vec<f32>; 2] {
    [f64::cos, f64::sin].map(|f| {
        let angle =
            |position: usize, pair: usize| position as f64 * 10_000_f64.powf(-(pair as f64) / pairs as f64);
        let all = positions
            .iter()
            .flat_map(|&position| (0..pairs).map(move |pair| (position, pair)));
        all.map(|(position, pair)| f(angle(position, pair)) as f32)
            .collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn agrees_with_float64(
        row_count in 1..12_usize,
        num_heads in 1..5_usize,
        pairs in 1..70_usize,
        rest in 0..5_usize,
        gap in 0..4_usize,
        threads in 1..4_usize,
        seed in 0..u64::MAX / 2,
    ) {
        let head_dim = 2 * pairs + rest;
        let width = num_heads * head_dim;
        let values = numbers(seed, row_count * width, 3.0);
        let positions: Vec<usize> = (0..row_count).map(|row| row * 7 + 3).collect();
        let [cos, sin] = tables(&positions, pairs);
        for isa in isas() {
            let mut x = Strided::new(&values, row_count, width, gap);
            rotary_embedding(isa, threads, x.view_mut(), head_dim, rows(&cos, pairs), rows(&sin, pairs));
            let out = x.values();
            for (index, (before, after)) in values.chunks_exact(head_dim).zip(out.chunks_exact(head_dim)).enumerate() {
                let row = index / num_heads;
                prop_assert_eq!(&after[2 * pairs..], &before[2 * pairs..]);
                for pair in 0..pairs {
                    let (a, b) = (f64::from(before[pair]), f64::from(before[pairs + pair]));
                    let (c, s) = (f64::from(cos[row * pairs + pair]), f64::from(sin[row * pairs + pair]));
                    for (given, exact) in [(after[pair], a * c - b * s), (after[pairs + pair], b * c + a * s)] {
                        let error = (f64::from(given) - exact).abs();
                        prop_assert!(error <= 3.0 * ROUNDING * (a.abs() + b.abs()), "{isa}: {given} instead of {exact}");
                    }
                }
            }
        }
    }
}

#[test]
fn bits_depend_on_the_pair_and_its_angle_alone() {
    let (row_count, num_heads, pairs) = (200, 16, 64);
    let width = num_heads * 2 * pairs;
    let positions: Vec<usize> = (0..row_count).collect();
    let [cos, sin] = tables(&positions, pairs);
    let x = numbers(1, row_count * width, 3.0);
    let part = |table: &[f32], first, count| table[first * pairs..][..count * pairs].to_vec();
    let rotated = |isa, threads, first: usize, count: usize| {
        let mut out = x[first * width..][..count * width].to_vec();
        let (cos, sin) = (part(&cos, first, count), part(&sin, first, count));
        let (cos, sin) = (rows(&cos, pairs), rows(&sin, pairs));
        rotary_embedding(isa, threads, rows_mut(&mut out, width), 2 * pairs, cos, sin);
        bits(&out)
    };
    for isa in isas() {
        let all = rotated(isa, 1, 0, row_count);
        for threads in [2, 3, 8] {
            assert_eq!(
                rotated(isa, threads, 0, row_count),
                all,
                "{isa}, {threads} threads"
            );
        }
        for (first, count) in [(0, 1), (77, 1), (5, 60)] {
            let expected = &all[first * width..][..count * width];
            assert_eq!(
                rotated(isa, 1, first, count),
                expected,
                "{isa}, {count} rows from {first}"
            );
        }
    }
}

#[test]
#[should_panic(expected = "cos: expected (1, at most 3), got (1, 4)")]
fn more_pairs_than_a_head_has_panic() {
    let angles = [0.0; 4];
    let (cos, sin) = (rows(&angles, 4), rows(&angles, 4));
    rotary_embedding(Isa::best(), 1, rows_mut(&mut [0.0; 6], 6), 6, cos, sin);
}
