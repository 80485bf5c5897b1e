//! int8 and int4 layers that keep outliers apart: against float64 on every instruction set, and the bits that must not change.

mod common;

use common::{bits, numbers, rows, rows_mut};
use saccade_vla_kernels::{
    Arithmetic, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, WeightRef, quantize_rows,
};

const OUTPUTS: usize = 83;

/// A layer of these inputs on this instruction set, and the weights that it has after quantisation.
fn layer(isa: Isa, inputs: usize) -> (PackedLinear, Vec<f64>) {
    let weight = numbers(1, OUTPUTS * inputs, 1.0);
    let bias = numbers(2, OUTPUTS, 1.0);
    let matrix = WeightRef::F32(Matrix::new(&weight, inputs));
    let layer = PackedLinear::pack(isa, Arithmetic::Int8, 2, &[(matrix, Some(&bias))]).unwrap();
    let (mut values, mut scales) = (vec![0; weight.len()], vec![0.0; OUTPUTS]);
    quantize_rows(matrix, &mut values, &mut scales);
    let exact = values
        .iter()
        .enumerate()
        .map(|(index, &value)| f64::from(value) * f64::from(scales[index / inputs]));
    (layer, exact.collect())
}

fn apply(layer: &PackedLinear, threads: usize, x: &[f32], epilogue: Epilogue) -> Vec<f32> {
    let mut out = vec![0.5; x.len() / layer.in_features() * OUTPUTS];
    let scratch = &mut LinearScratch::new();
    let x = rows(x, layer.in_features());
    layer
        .apply(threads, x, epilogue, rows_mut(&mut out, OUTPUTS), scratch)
        .unwrap();
    out
}

/// Rows of ordinary numbers; every third has none, one or several elements that are far larger.
fn planted(count: usize, inputs: usize) -> Vec<f32> {
    let mut x = numbers(3, count * inputs, 1.0);
    for (row, x) in x.chunks_exact_mut(inputs).enumerate() {
        for number in 0..row % 3 * (row % 5) {
            x[(row * 31 + number * 97) % inputs] = 1000.0 * (number as f32 - 1.5);
        }
    }
    x
}

/// The norm of the difference from the product in float64, relative to that product, with the inputs of a row that are ordinary.
fn relative_error(out: &[f32], x: &[f32], weight: &[f64], inputs: usize) -> f64 {
    let bias = numbers(2, OUTPUTS, 1.0);
    let (mut errors, mut total) = (0.0, 0.0);
    for (x, out) in x.chunks_exact(inputs).zip(out.as_chunks::<OUTPUTS>().0) {
        let large: Vec<f64> = x
            .iter()
            .map(|&x| if x.abs() > 10.0 { f64::from(x) } else { 0.0 })
            .collect();
        for (output, out) in out.iter().enumerate() {
            let weight = &weight[output * inputs..][..inputs];
            let sum: f64 = weight.iter().zip(x).map(|(w, x)| w * f64::from(*x)).sum();
            let of_large: f64 = weight.iter().zip(&large).map(|(w, x)| w * x).sum();
            let exact = sum + f64::from(bias[output]);
            errors += (f64::from(*out) - exact).powi(2);
            total += (exact - of_large).powi(2);
        }
    }
    (errors / total).sqrt()
}

#[test]
fn outliers_do_not_spoil_the_rest_of_their_row() {
    for isa in Isa::available() {
        for inputs in [512, 515, 1154] {
            let (plain, weight) = layer(isa, inputs);
            let x = planted(40, inputs);
            let spoiled = relative_error(&apply(&plain, 2, &x, Epilogue::Store), &x, &weight, inputs);
            let kept = plain.keeping_outliers();
            let error = relative_error(&apply(&kept, 2, &x, Epilogue::Store), &x, &weight, inputs);
            assert!(spoiled > 0.5, "{isa}, {inputs}: {spoiled}");
            assert!(error < 0.02, "{isa}, {inputs}: {error}");
        }
    }
}

#[test]
fn rows_without_outliers_have_the_bits_of_a_plain_layer() {
    for isa in Isa::available() {
        let (plain, _) = layer(isa, 515);
        let (kept, _) = layer(isa, 515);
        let kept = kept.keeping_outliers();
        let x = numbers(3, 40 * 515, 1.0);
        for epilogue in [Epilogue::Store, Epilogue::GeluTanh, Epilogue::Add] {
            assert_eq!(
                bits(&apply(&kept, 1, &x, epilogue)),
                bits(&apply(&plain, 1, &x, epilogue))
            );
        }
    }
}

#[test]
fn a_row_has_its_bits_in_any_company_and_at_any_number_of_threads() {
    for isa in Isa::available() {
        let inputs = 515;
        let (kept, _) = layer(isa, inputs);
        let kept = kept.keeping_outliers();
        let x = planted(110, inputs);
        let all = apply(&kept, 1, &x, Epilogue::Silu);
        assert_eq!(bits(&apply(&kept, 3, &x, Epilogue::Silu)), bits(&all));
        for row in [0, 1, 2, 7, 50, 109] {
            let alone = apply(&kept, 2, &x[row * inputs..][..inputs], Epilogue::Silu);
            assert_eq!(
                bits(&alone),
                bits(&all[row * OUTPUTS..][..OUTPUTS]),
                "{isa}, row {row}"
            );
        }
    }
}

#[test]
fn rows_that_are_not_finite_and_rows_of_zeros() {
    for isa in Isa::available() {
        let (kept, _) = layer(isa, 512);
        let kept = kept.keeping_outliers();
        let mut x = vec![0.0; 4 * 512];
        (x[512 + 3], x[2 * 512 + 5], x[3 * 512]) = (f32::NAN, f32::INFINITY, f32::MAX);
        let out = apply(&kept, 1, &x, Epilogue::Store);
        let bias = numbers(2, OUTPUTS, 1.0);
        assert_eq!(bits(&out[..OUTPUTS]), bits(&bias));
        assert!(
            out[OUTPUTS..3 * OUTPUTS].iter().all(|value| value.is_nan()),
            "{isa}"
        );
        assert!(out[3 * OUTPUTS..].iter().all(|value| value.is_finite()), "{isa}");
    }
}
