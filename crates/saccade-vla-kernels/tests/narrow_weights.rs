//! Weights in bf16 and int8: stored or narrowed when they are packed, in what memory, and the rule of quantisation.

mod common;

use common::linear::{apply, pack};
use common::{bits, isas, numbers};
use half::bf16;
use saccade_vla_kernels::{Arithmetic, Element, Epilogue, Matrix, PackedLinear, WeightRef, quantize_rows};

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
        for arithmetic in [Arithmetic::Float32, Arithmetic::Bfloat16, Arithmetic::Int8] {
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

#[test]
fn weights_that_are_not_finite_give_nan() {
    for isa in isas() {
        let mut weight = [1.0; 12];
        weight[5] = f32::INFINITY;
        let layer = pack(isa, Arithmetic::Int8, &weight, &[0.0; 3]);
        let out = apply(&layer, 1, &[1.0; 4], Epilogue::Store);
        assert!(
            out[1].is_nan() && (out[0] - 4.0).abs() < 1e-6 && (out[2] - 4.0).abs() < 1e-6,
            "{isa}: {out:?}"
        );
    }
}

#[test]
fn memory_is_what_the_element_takes() {
    let (inputs, outputs) = (256, 480);
    let weight = vec![1.0; outputs * inputs];
    for isa in isas() {
        let bytes = |arithmetic| pack(isa, arithmetic, &weight, &vec![0.0; outputs]).nbytes();
        let per_weight = |arithmetic| bytes(arithmetic) / (inputs * outputs);
        let all = [Arithmetic::Float32, Arithmetic::Bfloat16, Arithmetic::Int8];
        assert_eq!(all.map(per_weight), [4, 2, 1], "{isa}");
        assert_eq!(
            pack(isa, Arithmetic::Int8, &weight, &vec![0.0; outputs]).element(),
            Element::Int8
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
