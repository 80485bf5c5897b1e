//! Packed keys and values: packed again, replaced from a key on, and sizes that are refused.

mod common;

use common::attention::{Case, kinds};
use common::{Strided, bits, rows, rows_mut};
use saccade_vla_kernels::{Element, Isa, LogitBias, Mask, PackedKeyValues, attention};

#[test]
fn packing_again_replaces_everything() {
    let (long, short) = (Case::new(9, 5, 211, 2, 30, 1), Case::new(10, 5, 34, 2, 30, 0));
    for kind in kinds() {
        let mut held = long.held(kind);
        let nbytes = held.nbytes();
        held.pack(2, short.keys.view(), short.values.view()).unwrap();
        assert_eq!(
            (held.len(), held.num_kv_heads(), held.head_dim(), held.isa()),
            (34, 2, 30, kind.isa)
        );
        assert!(!held.is_empty() && held.nbytes() <= nbytes);
        for held in [&held, &held.try_clone().unwrap()] {
            let mut out = vec![0.0; 5 * 60];
            attention(
                1,
                short.queries.view(),
                held,
                short.scale,
                Mask::None,
                None,
                rows_mut(&mut out, 60),
            );
            assert_eq!(bits(&out), bits(&short.run(kind, 1, None, None)));
        }
    }
}

#[test]
fn packing_from_a_key_on_replaces_that_key_and_the_later_ones() {
    for (keys, head_dim) in [(49, 48), (40, 7), (3, 5)] {
        let (old, new) = (
            Case::new(11, 5, keys, 2, head_dim, 1),
            Case::new(12, 5, keys, 2, head_dim, 0),
        );
        let width = 2 * head_dim;
        for (kind, first) in kinds().flat_map(|kind| (0..=keys).map(move |first| (kind, first))) {
            let mut held = old.held(kind);
            let tail = |of: &Strided| of.values()[first * width..].to_vec();
            let (tail_keys, tail_values) = (tail(&new.keys), tail(&new.values));
            held.pack_from(2, first, rows(&tail_keys, width), rows(&tail_values, width));
            let joined = |old: &Strided, tail: &[f32]| {
                let whole = [&old.values()[..first * width], tail].concat();
                Strided::new(&whole, keys, width, 0)
            };
            let expected = Case {
                keys: joined(&old.keys, &tail_keys),
                values: joined(&old.values, &tail_values),
                ..Case::new(12, 5, keys, 2, head_dim, 0)
            };
            let mut out = vec![0.0; 5 * width];
            let queries = new.queries.view();
            attention(
                1,
                queries,
                &held,
                new.scale,
                Mask::None,
                None,
                rows_mut(&mut out, width),
            );
            assert_eq!(
                bits(&out),
                bits(&expected.run(kind, 1, None, None)),
                "{kind}, from {first}"
            );
        }
    }
}

#[test]
fn an_infinite_value_that_stays_is_remembered() {
    let (keys, mut values) = ([0.0; 6], [1.0; 6]);
    values[0] = f32::INFINITY;
    for kind in kinds() {
        let mut held = PackedKeyValues::new(kind.isa, kind.element, 1, 2);
        held.pack(1, rows(&keys, 2), rows(&values, 2)).unwrap();
        held.pack_from(1, 2, rows(&keys[4..], 2), rows(&values[4..], 2));
        let bias = LogitBias {
            values: &[f32::NEG_INFINITY, 0.0, 0.0],
            head_stride: 0,
            query_stride: 0,
        };
        let mut out = [0.0; 2];
        let query = [0.0; 2];
        attention(
            1,
            rows(&query, 2),
            &held,
            1.0,
            Mask::Bias(bias),
            None,
            rows_mut(&mut out, 2),
        );
        assert_eq!(out, [1.0, 1.0], "{kind}: the removed value has no influence");
    }
}

#[test]
#[should_panic(expected = "all that are held from number 2 on")]
fn packing_from_a_key_on_keeps_their_number() {
    let mut held = PackedKeyValues::new(Isa::Portable, Element::F32, 1, 2);
    held.pack(1, rows(&[0.0; 6], 2), rows(&[0.0; 6], 2)).unwrap();
    held.pack_from(1, 2, rows(&[0.0; 4], 2), rows(&[0.0; 4], 2));
}

#[test]
fn heads_whose_width_wraps_are_refused() {
    // Two of these have the width 2 in a product that wraps: keys of two columns would pass for them.
    for (num_kv_heads, head_dim) in [(usize::MAX / 2 + 2, 2), (2, usize::MAX / 2 + 2), (1, usize::MAX)] {
        let made = std::panic::catch_unwind(|| {
            PackedKeyValues::new(Isa::Portable, Element::F32, num_kv_heads, head_dim)
        });
        assert!(made.is_err(), "{num_kv_heads} heads of {head_dim}");
    }
}
