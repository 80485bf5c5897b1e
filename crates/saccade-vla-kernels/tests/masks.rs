//! Grouped keys, causal masks and appended keys: against float64 on every instruction set, and the bits that must not change.

mod common;

use common::attention::{Case, ELEMENTS, REMOVED, kinds, kinds_of};
use common::{assert_close, bits, numbers, rows, rows_mut};
use proptest::prelude::*;
use saccade_vla_kernels::{Element, Isa, LogitBias, Mask, PackedKeyValues, Rows, attention};

/// The logit of a causal mask, as a bias.
fn causal(offset: usize) -> impl Fn(usize, usize, usize) -> f32 + Copy {
    move |_, query, key| if key <= offset + query { 0.0 } else { REMOVED }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn agrees_with_float64(
        queries in 1..40_usize,
        keys in 1..400_usize,
        num_kv_heads in 1..4_usize,
        group in 1..4_usize,
        head_dim in prop_oneof![Just(48_usize), Just(64), 1..100_usize],
        gap in 0..4_usize,
        threads in 1..4_usize,
        mask in 0..3_usize,
        offset in 0..450_usize,
        seed in 0..u64::MAX / 2,
    ) {
        let num_heads = group * num_kv_heads;
        let case = Case::grouped(seed, [queries, keys], [num_heads, num_kv_heads], head_dim, gap);
        let values = numbers(seed + 4, num_heads * queries * keys, 3.0);
        let bias = LogitBias { values: &values, head_stride: queries * keys, query_stride: keys };
        let given = [Mask::None, Mask::Causal { offset }, Mask::Bias(bias)][mask];
        let at = |head: usize, query: usize, key: usize| match mask {
            0 => 0.0,
            1 => causal(offset)(head, query, key),
            _ => values[(head * queries + query) * keys + key],
        };
        for element in ELEMENTS {
            let (out, bounds, weights, weight_bounds) = case.exact(element, at);
            for kind in kinds_of(element) {
                let plain = case.run(kind, threads, given, None);
                assert_close(&format!("{kind}, output"), &plain, &out, &bounds);
                let mut with = vec![f32::NAN; num_heads * queries * keys];
                prop_assert_eq!(bits(&case.run(kind, threads, given, Some(&mut with))), bits(&plain));
                assert_close(&format!("{kind}, weight"), &with, &weights, &weight_bounds);
            }
        }
    }
}

#[test]
fn grouped_heads_have_the_bits_of_repeated_ones() {
    for (num_heads, num_kv_heads) in [(6, 2), (4, 1), (3, 3)] {
        let (head_dim, keys) = (40, 130);
        let case = Case::grouped(1, [9, keys], [num_heads, num_kv_heads], head_dim, 1);
        let repeated = |of: &common::Strided| {
            let group = num_heads / num_kv_heads;
            let head = |row: &[f32], head: usize| row[head / group * head_dim..][..head_dim].to_vec();
            let values: Vec<f32> = of
                .values()
                .chunks_exact(num_kv_heads * head_dim)
                .flat_map(|row| (0..num_heads).flat_map(move |index| head(row, index)))
                .collect();
            common::Strided::new(&values, keys, num_heads * head_dim, 0)
        };
        let mut plain = Case::new(1, 9, keys, num_heads, head_dim, 0);
        plain.queries = case.queries.clone();
        (plain.keys, plain.values) = (repeated(&case.keys), repeated(&case.values));
        for kind in kinds() {
            for mask in [Mask::None, Mask::Causal { offset: 121 }] {
                assert_eq!(
                    bits(&case.run(kind, 2, mask, None)),
                    bits(&plain.run(kind, 1, mask, None)),
                    "{kind}, {num_heads} heads of {num_kv_heads}"
                );
            }
        }
    }
}

/// The keys after a query's own may be there or not.
#[test]
fn a_causal_query_has_the_same_bits_whatever_follows() {
    for (queries, head_dim) in [(700, 48), (40, 7), (350, 300)] {
        let case = Case::new(2, queries, queries, 2, head_dim, 0);
        let width = 2 * head_dim;
        let (all_queries, keys, values) = (case.queries.values(), case.keys.values(), case.values.values());
        for kind in kinds() {
            let all = bits(&case.run(kind, 2, Mask::Causal { offset: 0 }, None));
            for (first, count) in [(0, 1), (5, 3), (queries - 1, 1), (queries / 2, 20)] {
                let until = first + count;
                let mut held = PackedKeyValues::new(kind.isa, kind.element, 2, head_dim);
                held.pack(
                    1,
                    rows(&keys[..until * width], width),
                    rows(&values[..until * width], width),
                )
                .unwrap();
                let mut out = vec![0.0; count * width];
                attention(
                    1,
                    rows(&all_queries[first * width..until * width], width),
                    &held,
                    case.scale,
                    Mask::Causal { offset: first },
                    None,
                    rows_mut(&mut out, width),
                );
                assert_eq!(
                    bits(&out),
                    all[first * width..until * width],
                    "{kind}, {count} queries from {first}"
                );
            }
        }
    }
}

#[test]
fn keys_that_come_later_have_no_influence_whatever_they_hold() {
    for poison in [f32::NAN, f32::INFINITY, f32::MAX] {
        let clean = Case::new(3, 30, 130, 2, 48, 0);
        let mut poisoned = Case::new(3, 30, 130, 2, 48, 0);
        for key in [110, 115, 129] {
            poisoned.keys.view_mut().row_mut(key).fill(poison);
            poisoned.values.view_mut().row_mut(key).fill(poison);
        }
        for kind in kinds() {
            let mask = Mask::Causal { offset: 95 };
            let (out, expected) = (poisoned.run(kind, 1, mask, None), clean.run(kind, 1, mask, None));
            // Query 14 is the last that does not see key 110.
            for (out, expected) in out[..15 * 96].iter().zip(&expected) {
                assert!(
                    (out - expected).abs() <= 1e-6,
                    "{kind}, {poison}: {out} instead of {expected}"
                );
            }
        }
    }
}

#[test]
fn appended_keys_are_as_if_packed_together() {
    for (keys, head_dim) in [(150, 48), (40, 7), (9, 300)] {
        let case = Case::grouped(4, [5, keys], [4, 2], head_dim, 0);
        let width = 2 * head_dim;
        let (all_keys, all_values) = (case.keys.values(), case.values.values());
        for kind in kinds() {
            let expected = bits(&case.run(kind, 1, Mask::None, None));
            for (reserved, step) in [(0, 1), (0, 7), (keys, 13), (keys / 2, keys)] {
                let mut held = PackedKeyValues::new(kind.isa, kind.element, 2, head_dim);
                held.reserve(reserved).unwrap();
                let bytes = held.nbytes();
                for first in (0..keys).step_by(step) {
                    let part = first * width..(first + step).min(keys) * width;
                    held.append(
                        2,
                        rows(&all_keys[part.clone()], width),
                        rows(&all_values[part], width),
                    )
                    .unwrap();
                }
                assert_eq!(held.len(), keys);
                assert!(
                    reserved < keys || held.nbytes() == bytes,
                    "what was reserved is enough"
                );
                let mut out = vec![0.0; 5 * 2 * width];
                let queries = case.queries.view();
                attention(
                    1,
                    queries,
                    &held,
                    case.scale,
                    Mask::None,
                    None,
                    rows_mut(&mut out, 2 * width),
                );
                assert_eq!(
                    bits(&out),
                    expected,
                    "{kind}, {step} at a time, {reserved} reserved"
                );
            }
        }
    }
}

/// Wider heads than one pass takes, without a single key.
#[test]
fn wide_heads_without_keys_give_zeros() {
    for kind in kinds() {
        for head_dim in [256, 257, 300, 600] {
            let empty = Case::new(5, 3, 0, 2, head_dim, 0);
            for mask in [Mask::None, Mask::Causal { offset: 0 }] {
                assert_eq!(
                    empty.run(kind, 1, mask, Some(&mut [])),
                    vec![0.0; 3 * 2 * head_dim]
                );
            }
        }
    }
}

#[test]
#[should_panic(
    expected = "queries: expected num_heads * 8 columns with a multiple of 2 as num_heads, got 24"
)]
fn heads_that_cannot_be_grouped_panic() {
    let case = Case::grouped(6, [1, 3], [3, 2], 8, 0);
    case.run(common::attention::best(), 1, Mask::None, None);
}

#[test]
fn more_keys_than_can_be_counted_are_refused() {
    let row = [1.0; 4];
    let mut held = PackedKeyValues::new(Isa::Portable, Element::F32, 1, 4);
    held.pack(1, Rows::new(&row, 4), Rows::new(&row, 4)).unwrap();
    let endless = Rows::strided(&row, usize::MAX, 4, 0);
    assert!(held.append(1, endless, endless).is_err());
    assert_eq!(held.len(), 1, "what was held stays");
}
