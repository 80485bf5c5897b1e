//! Fused attention against float64 on every instruction set; removed keys, weights, and the bits that must not change.

mod common;

use common::attention::{Case, ELEMENTS, Kind, REMOVED, best, kinds, kinds_of};
use common::{Strided, assert_close, bits, isas, numbers, rows, rows_mut};

use proptest::prelude::*;
use saccade_vla_kernels::{Element, Isa, LogitBias, Mask, PackedKeyValues, attention, bf16};

/// The three ways in which a bias is given.
#[derive(Clone, Copy, Debug)]
enum Rank {
    Keys,
    QueriesKeys,
    HeadsQueriesKeys,
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn agrees_with_float64(
        queries in 0..40_usize,
        keys in 0..220_usize,
        num_heads in 1..4_usize,
        head_dim in prop_oneof![Just(48_usize), Just(64), 1..100_usize],
        gap in 0..4_usize,
        threads in 1..4_usize,
        rank in prop_oneof![Just(None), Just(Some(Rank::Keys)), Just(Some(Rank::QueriesKeys)), Just(Some(Rank::HeadsQueriesKeys))],
        removed in 0.0..1.2_f32,
        seed in 0..u64::MAX / 2,
    ) {
        let case = Case::new(seed, queries, keys, num_heads, head_dim, gap);
        let (head_stride, query_stride, rows) = match rank {
            Some(Rank::HeadsQueriesKeys) => (queries * keys, keys, num_heads * queries),
            Some(Rank::QueriesKeys) => (0, keys, queries),
            _ => (0, 0, 1),
        };
        let chance = numbers(seed + 3, rows * keys, 1.0);
        let bias: Vec<f32> =
            numbers(seed + 4, rows * keys, 3.0).iter().zip(&chance).map(|(&bias, chance)| if chance.abs() < removed { REMOVED } else { bias }).collect();
        let at = |head: usize, query: usize, key: usize| match rank {
            None => 0.0,
            Some(_) => bias[head * head_stride + query * query_stride + key],
        };
        for element in ELEMENTS {
            let (out, bounds, weights, weight_bounds) = case.exact(element, at);
            for kind in kinds_of(element) {
                let bias = rank.map(|_| LogitBias { values: &bias, head_stride, query_stride });
                let plain = case.run(kind, threads, bias, None);
                assert_close(&format!("{kind}, output"), &plain, &out, &bounds);
                let mut given = vec![f32::NAN; num_heads * queries * keys];
                let with_weights = case.run(kind, threads, bias, Some(&mut given));
                prop_assert_eq!(bits(&with_weights), bits(&plain));
                assert_close(&format!("{kind}, weight"), &given, &weights, &weight_bounds);
            }
        }
    }
}

#[test]
fn agrees_with_float64_at_the_heads_sizes() {
    for (queries, keys, head_dim) in [(49, 296, 48), (49, 49, 48), (60, 296, 64), (5, 700, 300)] {
        let case = Case::new(1, queries, keys, 2, head_dim, 0);
        for element in ELEMENTS {
            let (out, bounds, _, _) = case.exact(element, |_, _, _| 0.0);
            for kind in kinds_of(element) {
                assert_close(&kind.to_string(), &case.run(kind, 2, None, None), &out, &bounds);
            }
        }
    }
}

#[test]
fn logits_that_would_overflow_are_stable() {
    let mut case = Case::new(2, 7, 150, 2, 48, 0);
    case.scale = 60.0;
    for element in ELEMENTS {
        let (out, bounds, _, _) = case.exact(element, |_, _, _| 0.0);
        for kind in kinds_of(element) {
            assert_close(&kind.to_string(), &case.run(kind, 1, None, None), &out, &bounds);
        }
    }
}

/// A native product of bfloat16 may take denormals for zero: what is lost is smaller than the smallest normal number.
#[test]
fn denormals_are_as_good_as_zero() {
    let scaled = |seed, rows: usize| Strided::new(&numbers(seed, rows * 96, 1e-39), rows, 96, 1);
    let mut case = Case::new(15, 5, 37, 2, 48, 0);
    case.queries = scaled(16, 5);
    case.keys = scaled(17, 37);
    for values in [
        scaled(18, 37),
        Strided::new(&numbers(19, 37 * 96, 1.0), 37, 96, 0),
    ] {
        case.values = values;
        for element in ELEMENTS {
            let (out, mut bounds, weights, weight_bounds) = case.exact(element, |_, _, _| 0.0);
            bounds
                .iter_mut()
                .for_each(|bound| *bound += f64::from(f32::MIN_POSITIVE));
            for kind in kinds_of(element) {
                let mut given = vec![f32::NAN; 2 * 5 * 37];
                let plain = case.run(kind, 1, None, Some(&mut given));
                assert_close(&format!("{kind}, output"), &plain, &out, &bounds);
                assert_close(&format!("{kind}, weight"), &given, &weights, &weight_bounds);
            }
        }
    }
}

#[test]
fn a_query_with_no_key_left_gets_zeros() {
    let case = Case::new(3, 9, 130, 2, 48, 0);
    let mut bias = vec![0.0; 9 * 130];
    for query in [0, 4, 8] {
        bias[query * 130..][..130].fill(REMOVED);
    }
    for kind in kinds() {
        let mut weights = vec![f32::NAN; 2 * 9 * 130];
        let bias = LogitBias {
            values: &bias,
            head_stride: 0,
            query_stride: 130,
        };
        let out = case.run(kind, 1, Some(bias), Some(&mut weights));
        let none = case.run(kind, 1, None, None);
        for query in 0..9 {
            let row = &out[query * 96..][..96];
            if query % 4 == 0 {
                assert_eq!(row, [0.0; 96]);
                assert_eq!(weights[query * 130..][..130], [0.0; 130]);
            } else {
                assert_eq!(bits(row), bits(&none[query * 96..][..96]));
            }
        }
    }
    let empty = Case::new(4, 3, 0, 2, 48, 0);
    for kind in kinds() {
        assert_eq!(empty.run(kind, 2, None, Some(&mut [])), [0.0; 3 * 96]);
    }
}

#[test]
fn a_removed_key_has_no_influence_whatever_it_holds() {
    // The largest float32 is infinite in bfloat16.
    for poison in [f32::NAN, f32::INFINITY, 3e38, f32::MAX] {
        let clean = Case::new(5, 9, 130, 2, 48, 0);
        let mut poisoned = Case::new(5, 9, 130, 2, 48, 0);
        let mut bias = vec![0.0; 130];
        for key in [0, 40, 95, 96, 129] {
            bias[key] = REMOVED;
            for column in 0..96 {
                poisoned.keys.view_mut().row_mut(key)[column] = poison;
                poisoned.values.view_mut().row_mut(key)[column] = poison;
            }
        }
        let bias = LogitBias {
            values: &bias,
            head_stride: 0,
            query_stride: 0,
        };
        for kind in kinds() {
            let mut weights = vec![f32::NAN; 2 * 9 * 130];
            let out = poisoned.run(kind, 1, Some(bias), Some(&mut weights));
            let expected = clean.run(kind, 1, Some(bias), None);
            for (out, expected) in out.iter().zip(&expected) {
                assert!(
                    (out - expected).abs() <= 1e-6,
                    "{kind}, {poison}: {out} instead of {expected}"
                );
            }
            for row in weights.as_chunks::<130>().0 {
                assert!(
                    [0, 40, 95, 96, 129].iter().all(|&key| row[key] == 0.0),
                    "{kind}, {poison}"
                );
            }
        }
    }
}

#[test]
fn nan_stays_with_its_query_and_head() {
    let clean = Case::new(6, 20, 100, 3, 48, 0);
    let mut case = Case::new(6, 20, 100, 3, 48, 0);
    case.queries.view_mut().row_mut(7)[50] = f32::NAN;
    for kind in kinds() {
        let (out, expected) = (case.run(kind, 2, None, None), clean.run(kind, 1, None, None));
        for (index, (out, expected)) in out.iter().zip(&expected).enumerate() {
            let (query, head) = (index / 144, index % 144 / 48);
            if (query, head) == (7, 1) {
                assert!(out.is_nan());
            } else {
                assert_eq!(out.to_bits(), expected.to_bits());
            }
        }
    }
}

#[test]
fn weights_are_the_probabilities_that_were_used() {
    // Values that bfloat16 holds exactly.
    let mut case = Case::new(7, 11, 405, 3, 40, 0);
    round(&mut case.values);
    for kind in kinds() {
        let mut weights = vec![f32::NAN; 3 * 11 * 405];
        let out = case.run(kind, 2, None, Some(&mut weights));
        for (index, row) in weights.as_chunks::<405>().0.iter().enumerate() {
            let (head, query) = (index / 11, index % 11);
            let sum: f64 = row.iter().map(|&weight| f64::from(weight)).sum();
            assert!((sum - 1.0).abs() < 1e-5, "{kind}: weights add up to {sum}");
            for column in head * 40..(head + 1) * 40 {
                let expected: f64 = row
                    .iter()
                    .enumerate()
                    .map(|(key, &weight)| f64::from(weight) * f64::from(case.values.view().row(key)[column]))
                    .sum();
                assert!((f64::from(out[query * 120 + column]) - expected).abs() < 1e-5);
            }
        }
    }
}

#[test]
fn bits_do_not_depend_on_threads_nor_on_other_queries() {
    for (queries, keys, num_heads, head_dim) in
        [(100, 296, 4, 64), (49, 97, 4, 48), (35, 40, 4, 20), (30, 5, 4, 7)]
    {
        let case = Case::new(8, queries, keys, num_heads, head_dim, 0);
        let all = case.queries.values();
        let width = num_heads * head_dim;
        for kind in kinds() {
            let held = case.held(kind);
            let mut weights = vec![0.0; num_heads * queries * keys];
            let expected = bits(&case.run(kind, 1, None, Some(&mut weights)));
            for threads in [2, 3, 8] {
                let mut other = vec![0.0; num_heads * queries * keys];
                assert_eq!(
                    bits(&case.run(kind, threads, None, Some(&mut other))),
                    expected,
                    "{kind}, {threads} threads"
                );
                assert_eq!(bits(&other), bits(&weights));
            }
            for (first, count) in [(0, 1), (17, 1), (3, 2), (1, 8), (2, 9), (10, 17)] {
                let mut out = vec![0.0; count * width];
                let part = rows(&all[first * width..][..count * width], width);
                attention(
                    1,
                    part,
                    &held,
                    case.scale,
                    Mask::None,
                    None,
                    rows_mut(&mut out, width),
                );
                assert_eq!(
                    bits(&out),
                    expected[first * width..][..count * width],
                    "{kind}, {count} from {first}"
                );
            }
        }
    }
}

/// Rounded to bfloat16 in place.
fn round(matrix: &mut Strided) {
    for row in 0..matrix.rows {
        for element in matrix.view_mut().row_mut(row) {
            *element = bf16::from_f32(*element).to_f32();
        }
    }
}

fn apply(held: &PackedKeyValues, case: &Case) -> Vec<f32> {
    let width = case.num_heads * case.head_dim;
    let mut out = vec![f32::NAN; case.queries.rows * width];
    attention(
        1,
        case.queries.view(),
        held,
        case.scale,
        Mask::None,
        None,
        rows_mut(&mut out, width),
    );
    out
}

/// Without an instruction for their products, bfloat16 keys and values are those numbers in float32.
#[test]
fn widened_bf16_has_the_bits_of_float32() {
    for (queries, keys, head_dim) in [(49, 296, 48), (3, 1, 1), (7, 35, 5), (10, 700, 33), (2, 3, 301)] {
        let case = Case::new(12, queries, keys, 3, head_dim, 2);
        let mut rounded = Case::new(12, queries, keys, 3, head_dim, 2);
        round(&mut rounded.keys);
        round(&mut rounded.values);
        for isa in isas() {
            // Where pairs are multiplied, by an instruction or in tiles, the other factor is rounded too.
            if isa == Isa::SoftwareTiles || isa.dot_products().contains(&"bf16") {
                continue;
            }
            let kind = |element| Kind { isa, element };
            let given = apply(&case.held(kind(Element::Bf16)), &case);
            let expected = apply(&rounded.held(kind(Element::F32)), &case);
            assert_eq!(bits(&given), bits(&expected), "{isa}, {keys} keys x {head_dim}");
        }
    }
}

#[test]
#[should_panic(expected = "queries: expected")]
fn queries_of_another_width_panic() {
    let case = Case::new(11, 2, 3, 2, 4, 0);
    attention(
        1,
        rows(&[0.0; 12], 6),
        &case.held(best()),
        1.0,
        Mask::None,
        None,
        rows_mut(&mut [0.0; 12], 6),
    );
}

#[test]
#[should_panic(expected = "bias: expected")]
fn a_bias_that_is_too_short_panics() {
    let case = Case::new(11, 2, 3, 2, 4, 0);
    let bias = LogitBias {
        values: &[0.0; 11],
        head_stride: 6,
        query_stride: 3,
    };
    case.run(best(), 1, Some(bias), None);
}

#[test]
#[should_panic(expected = "weights: expected")]
fn weights_of_another_shape_panic() {
    let case = Case::new(11, 2, 3, 2, 4, 0);
    case.run(best(), 1, None, Some(&mut [0.0; 11]));
}
