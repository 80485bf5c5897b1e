//! Calls a linear layer so many times on one thread: what `.ci/aarch64/run.sh instructions` counts the instructions of.
//!
//! linear_calls ARITHMETIC ROWS INPUTS OUTPUTS CALLS
//!
//! `SACCADE_ISA` selects the instruction set.

use std::error::Error;

use saccade_vla_kernels::{
    Arithmetic, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, Rows, RowsMut, WeightRef,
};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [arithmetic, numbers @ ..] = arguments.as_slice() else {
        return Err("expected: ARITHMETIC ROWS INPUTS OUTPUTS CALLS".into());
    };
    let arithmetic = match arithmetic.as_str() {
        "float32" => Arithmetic::Float32,
        "bfloat16" => Arithmetic::Bfloat16,
        "int8" => Arithmetic::Int8,
        "int4" => Arithmetic::Int4,
        _ => return Err("ARITHMETIC: expected float32, bfloat16, int8 or int4".into()),
    };
    let numbers: Vec<usize> = numbers
        .iter()
        .map(|number| number.parse())
        .collect::<Result<_, _>>()?;
    let [rows, inputs, outputs, calls] = numbers[..] else {
        return Err("expected four numbers after ARITHMETIC".into());
    };
    let weight: Vec<f32> = (0..inputs * outputs).map(|index| (index % 17) as f32).collect();
    let x: Vec<f32> = (0..rows * inputs).map(|index| (index % 13) as f32).collect();
    let mut out = vec![0.0; rows * outputs];
    let weight = WeightRef::F32(Matrix::new(&weight, inputs));
    let layer = PackedLinear::pack(Isa::from_env()?, arithmetic, 1, &[(weight, None)])?;
    let mut scratch = LinearScratch::new();
    for _ in 0..calls {
        let (x, out) = (Rows::new(&x, inputs), RowsMut::new(&mut out, outputs));
        layer.apply(1, x, Epilogue::Store, out, &mut scratch)?;
    }
    Ok(())
}
