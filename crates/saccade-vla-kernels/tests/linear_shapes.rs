//! Shapes of the packed linear layer: those that are refused, those without elements, and the memory that each takes.

mod common;

use common::linear::pack;
use common::{isas, rows, rows_mut};
use half::bf16;
use saccade_vla_kernels::{
    Arithmetic, Element, Epilogue, Isa, KernelError, LinearScratch, Matrix, PackedLinear, Rows, RowsMut,
    WeightRef, quantize_rows,
};

/// Four inputs, four outputs.
fn square_layer() -> PackedLinear {
    let weight = WeightRef::F32(Matrix::new(&[0.5; 16], 4));
    PackedLinear::pack(Isa::best(), Arithmetic::Float32, 1, &[(weight, None)]).unwrap()
}

#[test]
fn parts_that_do_not_fit_are_refused() {
    let weight = [0.0; 12];
    let weight =
        |outputs, inputs| WeightRef::F32(Matrix::from(Rows::strided(&weight, outputs, inputs, inputs)));
    let isa = Isa::best();
    assert!(matches!(
        PackedLinear::pack(isa, Arithmetic::Float32, 1, &[]),
        Err(KernelError::NoParts)
    ));
    let widths = PackedLinear::pack(
        isa,
        Arithmetic::Float32,
        1,
        &[(weight(3, 4), None), (weight(4, 3), None)],
    );
    assert!(matches!(
        widths,
        Err(KernelError::InFeatures {
            expected: 4,
            given: 3
        })
    ));
    let bias = PackedLinear::pack(isa, Arithmetic::Float32, 1, &[(weight(3, 4), Some(&[1.0; 4]))]);
    assert!(matches!(
        bias,
        Err(KernelError::Bias {
            expected: 3,
            given: 4
        })
    ));
}

#[test]
#[should_panic(expected = "x: expected")]
fn an_input_of_another_width_panics() {
    let layer = square_layer();
    layer
        .apply(
            1,
            rows(&[0.0; 6], 3),
            Epilogue::Store,
            rows_mut(&mut [0.0; 8], 4),
            &mut LinearScratch::new(),
        )
        .unwrap();
}

#[test]
#[should_panic(expected = "out: expected")]
fn an_output_of_another_shape_panics() {
    let layer = square_layer();
    layer
        .apply(
            1,
            rows(&[0.0; 8], 4),
            Epilogue::Store,
            rows_mut(&mut [0.0; 12], 4),
            &mut LinearScratch::new(),
        )
        .unwrap();
}

#[test]
fn the_size_of_a_packed_layer_is_known_before_packing() {
    for isa in isas() {
        for (outputs, inputs) in [(0, 5), (1, 0), (1, 1), (47, 33), (48, 64), (49, 515), (200, 7)] {
            let f32 = vec![0.5; outputs * inputs];
            let bf16 = vec![bf16::ONE; outputs * inputs];
            let f32 = WeightRef::F32(Matrix::from(Rows::strided(&f32, outputs, inputs, inputs)));
            let bf16 = WeightRef::Bf16(Matrix::from(Rows::strided(&bf16, outputs, inputs, inputs)));
            for arithmetic in [
                Arithmetic::Float32,
                Arithmetic::Bfloat16,
                Arithmetic::Int8,
                Arithmetic::Int4,
            ] {
                for (weight, element) in [(f32, Element::F32), (bf16, Element::Bf16)] {
                    let layer = PackedLinear::pack(isa, arithmetic, 1, &[(weight, None)]).unwrap();
                    let nbytes = PackedLinear::packed_nbytes(isa, arithmetic, element, (outputs, inputs));
                    let what = format!("{isa}, {arithmetic:?} of {element:?}, {outputs} x {inputs}");
                    assert_eq!(layer.nbytes(), nbytes.unwrap(), "{what}");
                }
            }
        }
        for arithmetic in [Arithmetic::Int8, Arithmetic::Int4] {
            let wide = PackedLinear::packed_nbytes(isa, arithmetic, Element::F32, (1, 65537));
            assert!(matches!(wide, Err(KernelError::TooManyInputs { given: 65537 })));
        }
    }
}

#[test]
fn a_layer_without_inputs_gives_its_bias() {
    let weight = WeightRef::F32(Matrix::from(Rows::strided(&[], 3, 0, 0)));
    // Rows without elements, as far apart as they like.
    let x = Rows::strided(&[], 4, 0, 1 << (usize::BITS * 5 / 8));
    for isa in isas() {
        for arithmetic in [
            Arithmetic::Float32,
            Arithmetic::Bfloat16,
            Arithmetic::Int8,
            Arithmetic::Int4,
        ] {
            let parts = [(weight, Some(&[1.0, 2.0, 3.0][..]))];
            let layer = PackedLinear::pack(isa, arithmetic, 1, &parts).unwrap();
            let mut out = vec![7.0; 12];
            let scratch = &mut LinearScratch::new();
            layer
                .apply(2, x, Epilogue::Store, rows_mut(&mut out, 3), scratch)
                .unwrap();
            assert_eq!(out, [1.0, 2.0, 3.0].repeat(4), "{isa}, {arithmetic:?}");
        }
    }
}

#[test]
fn inputs_whose_panel_wraps_are_refused() {
    // One element is all that these weights need: a column that is repeated.
    for inputs in [usize::MAX / 64 + 1, usize::MAX / 2, usize::MAX] {
        let weight = WeightRef::F32(Matrix::from(Rows::strided(&[1.0], inputs, 1, 0)).transpose());
        for isa in isas() {
            for arithmetic in [
                Arithmetic::Float32,
                Arithmetic::Bfloat16,
                Arithmetic::Int8,
                Arithmetic::Int4,
            ] {
                let packed = PackedLinear::pack(isa, arithmetic, 1, &[(weight, None)]);
                let size = PackedLinear::packed_nbytes(isa, arithmetic, Element::F32, (1, inputs));
                if matches!(arithmetic, Arithmetic::Int8 | Arithmetic::Int4) {
                    assert!(matches!(packed, Err(KernelError::TooManyInputs { .. })));
                    assert!(matches!(size, Err(KernelError::TooManyInputs { .. })));
                } else {
                    assert!(matches!(packed, Err(KernelError::Alloc(_))), "{inputs} {isa}");
                    assert_eq!(size.unwrap(), usize::MAX, "{inputs} {isa}");
                }
            }
        }
    }
}

#[test]
#[should_panic(expected = "values: expected the elements of weight")]
fn quantising_weights_whose_size_wraps_panics() {
    // Four rows of 2^62 elements on 64 bits: their product is 0 if it wraps.
    let inputs = usize::MAX / 4 + 1;
    let weight = WeightRef::F32(Matrix::from(Rows::strided(&[1.0; 4], inputs, 4, 0)).transpose());
    quantize_rows(weight, &mut [], &mut [0.0; 4]);
}

#[test]
fn sizes_of_zero_are_fine() {
    for isa in isas() {
        for arithmetic in [
            Arithmetic::Float32,
            Arithmetic::Bfloat16,
            Arithmetic::Int8,
            Arithmetic::Int4,
        ] {
            let weight =
                |outputs, inputs| WeightRef::F32(Matrix::from(Rows::strided(&[], outputs, inputs, inputs)));
            let no_inputs =
                PackedLinear::pack(isa, arithmetic, 1, &[(weight(3, 0), Some(&[1.0, 2.0, 3.0]))]).unwrap();
            let mut out = [0.0; 6];
            let x = Rows::strided(&[], 2, 0, 0);
            let mut scratch = LinearScratch::new();
            no_inputs
                .apply(1, x, Epilogue::Store, rows_mut(&mut out, 3), &mut scratch)
                .unwrap();
            assert_eq!(out, [1.0, 2.0, 3.0, 1.0, 2.0, 3.0], "{isa}, {arithmetic:?}");
            let no_outputs = PackedLinear::pack(isa, arithmetic, 1, &[(weight(0, 5), None)]).unwrap();
            let nowhere = RowsMut::strided(&mut [], 1, 0, 0);
            no_outputs
                .apply(1, rows(&[1.0; 5], 5), Epilogue::Store, nowhere, &mut scratch)
                .unwrap();
            let layer = pack(isa, arithmetic, &[1.0; 6], &[0.0; 2]);
            layer
                .apply(
                    1,
                    rows(&[], 3),
                    Epilogue::Store,
                    rows_mut(&mut [], 2),
                    &mut scratch,
                )
                .unwrap();
        }
    }
}
