//! A linear layer in any arithmetic, packed and applied.

use saccade_vla_kernels::{
    Arithmetic, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, WeightRef, quantize_rows_int4,
};

use super::{rows, rows_mut};

/// A layer of these weights, packed on one thread.
pub fn pack(isa: Isa, arithmetic: Arithmetic, weight: &[f32], bias: &[f32]) -> PackedLinear {
    let inputs = weight.len() / bias.len().max(1);
    let weight = WeightRef::F32(Matrix::new(weight, inputs));
    PackedLinear::pack(isa, arithmetic, 1, &[(weight, Some(bias))]).unwrap()
}

/// Weights quantised to int4: two in a byte, and the scales of their rows.
#[allow(dead_code, reason = "not every test needs them")]
pub fn int4(weight: &[f32], inputs: usize) -> (Vec<u8>, Vec<f32>) {
    let rows = weight.len() / inputs;
    let (mut values, mut scales) = (vec![0; rows * inputs.div_ceil(2)], vec![0.0; rows]);
    quantize_rows_int4(
        WeightRef::F32(Matrix::new(weight, inputs)),
        &mut values,
        &mut scales,
    );
    (values, scales)
}

/// The whole numbers of weights of four bits, `inputs` in each row.
#[allow(dead_code, reason = "not every test needs them")]
pub fn int4_bytes(pairs: &[u8], inputs: usize) -> Vec<i8> {
    let mut bytes = Vec::new();
    for row in pairs.chunks_exact(inputs.div_ceil(2)) {
        let both = row
            .iter()
            .flat_map(|&pair| [(pair << 4).cast_signed() >> 4, pair.cast_signed() >> 4]);
        bytes.extend(both.take(inputs));
    }
    bytes
}

/// What a layer makes of `x`, in memory that holds 0.5.
pub fn apply(layer: &PackedLinear, threads: usize, x: &[f32], epilogue: Epilogue) -> Vec<f32> {
    let (inputs, outputs) = (layer.in_features(), layer.out_features());
    let mut out = vec![0.5; x.len() / inputs * outputs];
    let mut scratch = LinearScratch::new();
    layer
        .apply(
            threads,
            rows(x, inputs),
            epilogue,
            rows_mut(&mut out, outputs),
            &mut scratch,
        )
        .unwrap();
    out
}
