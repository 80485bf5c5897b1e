//! A linear layer in any arithmetic, packed and applied.

use saccade_vla_kernels::{Arithmetic, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, WeightRef};

use super::{rows, rows_mut};

/// A layer of these weights, packed on one thread.
pub fn pack(isa: Isa, arithmetic: Arithmetic, weight: &[f32], bias: &[f32]) -> PackedLinear {
    let inputs = weight.len() / bias.len().max(1);
    let weight = WeightRef::F32(Matrix::new(weight, inputs));
    PackedLinear::pack(isa, arithmetic, 1, &[(weight, Some(bias))]).unwrap()
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
