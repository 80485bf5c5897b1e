//! Weights in bf16, int8 and int4: stored or narrowed when they are packed, in what memory, and the rule of quantisation.

mod common;

use common::linear::{apply, int4, int4_bytes, pack};
use common::{bits, isas, numbers};
use half::bf16;
use saccade_vla_kernels::{
    Arithmetic, Element, Epilogue, KernelError, Matrix, PackedLinear, WeightRef, quantize_rows,
    quantize_rows_int4,
};

#[test]
fn packing_on_more_threads_gives_the_same_bits() {
    let (inputs, outputs) = (37, 311);
    let weight = numbers(23, outputs * inputs, 1.0);
    let x = numbers(24, 5 * inputs, 1.0);
    let parts = [(0, 100), (100, 101), (101, 311)].map(|(first, end): (usize, usize)| {
        let rows = Matrix::new(&weight[first * inputs..end * inputs], inputs);
        (WeightRef::F32(rows), None)
    });
    for isa in isas() {
        for arithmetic in [
            Arithmetic::Float32,
            Arithmetic::Bfloat16,
            Arithmetic::Int8,
            Arithmetic::Int4,
        ] {
            let out = |threads, parts: &[(WeightRef<'_>, Option<&[f32]>)]| {
                let layer = PackedLinear::pack(isa, arithmetic, threads, parts).unwrap();
                bits(&apply(&layer, 1, &x, Epilogue::Store))
            };
            let whole = WeightRef::F32(Matrix::new(&weight, inputs));
            let expected = out(1, &[(whole, None)]);
            for threads in [1, 2, 5] {
                assert_eq!(out(threads, &parts), expected, "{isa}, {arithmetic:?}");
            }
        }
    }
}

#[test]
fn stored_weights_give_the_bits_of_weights_narrowed_at_pack() {
    for (inputs, outputs) in [(1, 3), (63, 101), (640, 50)] {
        let weight = numbers(15, outputs * inputs, 1.0);
        let x = numbers(16, 20 * inputs, 1.0);
        let narrow: Vec<_> = weight.iter().map(|&value| bf16::from_f32(value)).collect();
        let (mut values, mut scales) = (vec![0; weight.len()], vec![0.0; outputs]);
        quantize_rows(
            WeightRef::F32(Matrix::new(&weight, inputs)),
            &mut values,
            &mut scales,
        );
        let bf16 = WeightRef::Bf16(Matrix::new(&narrow, inputs));
        let int8 = WeightRef::Int8 {
            values: Matrix::new(&values, inputs),
            scales: &scales,
        };
        let (pairs, pair_scales) = int4(&weight, inputs);
        let int4 = WeightRef::Int4 {
            values: Matrix::new(&pairs, inputs.div_ceil(2)),
            in_features: inputs,
            scales: &pair_scales,
        };
        let dequantized: Vec<f32> = values
            .iter()
            .enumerate()
            .map(|(index, &value)| f32::from(value) * scales[index / inputs])
            .collect();
        for isa in isas() {
            let zeros = vec![0.0; outputs];
            let out = |weight, arithmetic| {
                let layer = PackedLinear::pack(isa, arithmetic, 1, &[(weight, None)]).unwrap();
                bits(&apply(&layer, 1, &x, Epilogue::Store))
            };
            let expected = |weight: &[f32], arithmetic| {
                bits(&apply(
                    &pack(isa, arithmetic, weight, &zeros),
                    1,
                    &x,
                    Epilogue::Store,
                ))
            };
            assert_eq!(
                out(bf16, Arithmetic::Bfloat16),
                expected(&weight, Arithmetic::Bfloat16),
                "{isa}"
            );
            assert_eq!(
                out(int8, Arithmetic::Int8),
                expected(&weight, Arithmetic::Int8),
                "{isa}"
            );
            assert_eq!(
                out(int4, Arithmetic::Int4),
                expected(&weight, Arithmetic::Int4),
                "{isa}"
            );
            assert_eq!(
                out(int8, Arithmetic::Int4),
                expected(&dequantized, Arithmetic::Int4),
                "{isa}"
            );
            let wide = dequantized_int4(&pairs, &pair_scales, inputs);
            for arithmetic in [Arithmetic::Float32, Arithmetic::Bfloat16] {
                assert_eq!(
                    out(int4, arithmetic),
                    expected(&wide, arithmetic),
                    "{isa}, {arithmetic:?}"
                );
            }
            assert_eq!(
                out(int8, Arithmetic::Float32),
                expected(&dequantized, Arithmetic::Float32),
                "{isa}"
            );
            assert_eq!(
                out(int8, Arithmetic::Bfloat16),
                expected(&dequantized, Arithmetic::Bfloat16),
                "{isa}"
            );
        }
    }
}

/// The weights that `pairs` and the scales of their rows are.
fn dequantized_int4(pairs: &[u8], scales: &[f32], inputs: usize) -> Vec<f32> {
    let wide = int4_bytes(pairs, inputs).into_iter().enumerate();
    wide.map(|(index, value)| f32::from(value) * scales[index / inputs])
        .collect()
}

/// Weights of four bits are bytes with the same numbers: every result has the bits of int8, outliers and all.
#[test]
fn int4_has_the_bits_of_int8_with_the_same_weights() {
    for (inputs, outputs, row_count) in [
        (1, 1, 1),
        (7, 9, 3),
        (37, 25, 9),
        (130, 49, 50),
        (515, 101, 40),
        (4200, 50, 33),
    ] {
        let mut x = numbers(31, row_count * inputs, 3.0);
        x.iter_mut().step_by(97).for_each(|x| *x *= 500.0);
        let weight = numbers(32, outputs * inputs, 0.1);
        let bias = numbers(33, outputs, 1.0);
        let (pairs, scales) = int4(&weight, inputs);
        let of_pairs = WeightRef::Int4 {
            values: Matrix::new(&pairs, inputs.div_ceil(2)),
            in_features: inputs,
            scales: &scales,
        };
        let bytes = int4_bytes(&pairs, inputs);
        let of_bytes = WeightRef::Int8 {
            values: Matrix::new(&bytes, inputs),
            scales: &scales,
        };
        for isa in isas() {
            for keeps_outliers in [false, true] {
                let out = |arithmetic, weight, epilogue| {
                    let layer = PackedLinear::pack(isa, arithmetic, 2, &[(weight, Some(&bias))]).unwrap();
                    let layer = if keeps_outliers {
                        layer.keeping_outliers()
                    } else {
                        layer
                    };
                    bits(&apply(&layer, 2, &x, epilogue))
                };
                for epilogue in [Epilogue::Store, Epilogue::GeluTanh, Epilogue::Mul] {
                    let expected = out(Arithmetic::Int8, of_bytes, epilogue);
                    assert!(
                        out(Arithmetic::Int4, of_pairs, epilogue) == expected,
                        "{isa}, {inputs} x {outputs}"
                    );
                    // Narrowed or widened when they are packed.
                    let float = out(
                        Arithmetic::Int4,
                        WeightRef::F32(Matrix::new(&weight, inputs)),
                        epilogue,
                    );
                    assert!(float == expected, "{isa}, {inputs} x {outputs}, from float32");
                    assert!(
                        out(Arithmetic::Int8, of_pairs, epilogue) == expected,
                        "{isa}, {inputs} x {outputs}, in int8"
                    );
                }
            }
        }
    }
}

#[test]
fn weights_that_are_not_finite_give_nan() {
    for isa in isas() {
        for arithmetic in [Arithmetic::Int8, Arithmetic::Int4] {
            let mut weight = [1.0; 12];
            weight[5] = f32::INFINITY;
            let layer = pack(isa, arithmetic, &weight, &[0.0; 3]);
            let out = apply(&layer, 1, &[1.0; 4], Epilogue::Store);
            assert!(
                out[1].is_nan() && (out[0] - 4.0).abs() < 1e-6 && (out[2] - 4.0).abs() < 1e-6,
                "{isa}, {arithmetic:?}: {out:?}"
            );
        }
    }
}

#[test]
fn memory_is_what_the_element_takes() {
    let (inputs, outputs) = (256, 480);
    let weight = vec![1.0; outputs * inputs];
    for isa in isas() {
        let bytes = |arithmetic| pack(isa, arithmetic, &weight, &vec![0.0; outputs]).nbytes();
        let per_weight = |arithmetic| 8 * bytes(arithmetic) / (inputs * outputs);
        let all = [
            Arithmetic::Float32,
            Arithmetic::Bfloat16,
            Arithmetic::Int8,
            Arithmetic::Int4,
        ];
        assert_eq!(all.map(per_weight), [32, 16, 8, 4], "{isa}");
        let element = |arithmetic| pack(isa, arithmetic, &weight, &vec![0.0; outputs]).element();
        assert_eq!(
            all.map(element),
            [Element::F32, Element::Bf16, Element::Int8, Element::Int4]
        );
    }
}

#[test]
fn quantize_rows_keeps_to_half_a_step() {
    let (rows, inputs) = (30, 77);
    let weight = numbers(22, rows * inputs, 2.0);
    let (mut values, mut scales) = (vec![0; weight.len()], vec![0.0; rows]);
    let view = Matrix::new(&weight, inputs);
    quantize_rows(WeightRef::F32(view), &mut values, &mut scales);
    for (index, (&value, &w)) in values.iter().zip(&weight).enumerate() {
        let scale = f64::from(scales[index / inputs]);
        assert!((f64::from(value) * scale - f64::from(w)).abs() <= 0.500_001 * scale && value != i8::MIN);
    }
    for row in values.chunks_exact(inputs) {
        assert_eq!(row.iter().map(|value| value.unsigned_abs()).max(), Some(127));
    }
    // Any layout of the same weights gives the same bits.
    let transposed: Vec<f32> = (0..rows * inputs)
        .map(|i| weight[i % rows * inputs + i / rows])
        .collect();
    let (mut again, mut again_scales) = (vec![0; weight.len()], vec![0.0; rows]);
    let view = Matrix::new(&transposed, rows).transpose();
    quantize_rows(WeightRef::F32(view), &mut again, &mut again_scales);
    assert_eq!((again, bits(&again_scales)), (values, bits(&scales)));
}

/// Of the eight scales the one with the least squared error, and with it the nearest of fifteen steps.
#[test]
fn quantize_rows_int4_has_the_least_error() {
    let (rows, inputs) = (30, 77);
    let weight: Vec<f32> = numbers(22, rows * inputs, 2.0)
        .into_iter()
        .map(|value| value.powi(3))
        .collect();
    let (pairs, scales) = int4(&weight, inputs);
    let wide = dequantized_int4(&pairs, &scales, inputs);
    let mut ratios = std::collections::BTreeSet::new();
    for ((row, wide), &scale) in weight
        .chunks_exact(inputs)
        .zip(wide.chunks_exact(inputs))
        .zip(&scales)
    {
        let largest = row
            .iter()
            .fold(0.0_f64, |largest, &w| largest.max(f64::from(w).abs()));
        let error = |scale: f64| -> f64 {
            let nearest = |w: f64| (w / scale).round_ties_even().clamp(-7.0, 7.0) * scale;
            row.iter()
                .map(|&w| (nearest(f64::from(w)) - f64::from(w)).powi(2))
                .sum()
        };
        let candidates = (5..=12)
            .rev()
            .map(|twelfths| largest / 7.0 * f64::from(twelfths) / 12.0);
        let least = candidates.clone().map(error).fold(f64::INFINITY, f64::min);
        let ratio = candidates
            .clone()
            .position(|candidate| (candidate / f64::from(scale) - 1.0).abs() < 1e-6);
        ratios.insert(ratio.expect("one of the scales"));
        let found: f64 = row
            .iter()
            .zip(wide)
            .map(|(&w, &wide)| f64::from(w - wide).powi(2))
            .sum();
        assert!(found <= least * (1.0 + 1e-4), "{found} and {least}");
    }
    assert!(ratios.len() > 2, "rows differ in their scales: {ratios:?}");
    // Any layout of the same weights gives the same bits, and the high half of a last byte is zero.
    assert!(
        pairs
            .chunks_exact(inputs.div_ceil(2))
            .all(|row| row[inputs / 2] >> 4 == 0)
    );
    let transposed: Vec<f32> = (0..rows * inputs)
        .map(|i| weight[i % rows * inputs + i / rows])
        .collect();
    let (mut again, mut again_scales) = (vec![1; pairs.len()], vec![0.0; rows]);
    let view = Matrix::new(&transposed, rows).transpose();
    quantize_rows_int4(WeightRef::F32(view), &mut again, &mut again_scales);
    assert_eq!((again, bits(&again_scales)), (pairs, bits(&scales)));
}

#[test]
fn rows_of_zeros_and_of_what_is_not_finite_are_zeros_in_int4() {
    let (pairs, scales) = int4(
        &[0.0, -0.0, 1e-44, f32::NAN, 1.0, 1.0, f32::NEG_INFINITY, 1.0, 1.0],
        3,
    );
    assert_eq!(pairs, [0; 6]);
    assert!(scales[0] == 0.0 && scales[1].is_nan() && scales[2].is_nan());
}

#[test]
fn int4_that_is_not_whole_bytes_of_two_weights_is_refused() {
    let scales = [1.0, 1.0];
    let packed = |values: &[u8], bytes: usize, in_features: usize| {
        let weight = WeightRef::Int4 {
            values: Matrix::new(values, bytes),
            in_features,
            scales: &scales,
        };
        PackedLinear::pack(isas()[0], Arithmetic::Int4, 1, &[(weight, None)])
    };
    assert!(packed(&[0x11; 6], 3, 6).is_ok() && packed(&[0x01; 6], 3, 5).is_ok());
    for (bytes, in_features) in [(2, 5), (2, 6), (3, 4), (3, 7)] {
        let error = packed(&vec![0x01; 2 * bytes], bytes, in_features).err().unwrap();
        let expected = in_features.div_ceil(2);
        let message =
            format!("int4 weights of {in_features} in_features have rows of {expected} bytes, got {bytes}");
        assert_eq!(error.to_string(), message);
    }
    let error = packed(&[1, 1, 1, 1, 1, 0x21], 3, 5).err().unwrap();
    assert!(
        matches!(
            error,
            KernelError::Int4Padding {
                row: 1,
                in_features: 5
            }
        ),
        "{error}"
    );
}
