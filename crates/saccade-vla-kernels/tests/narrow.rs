//! The packed linear layer in bf16, int8 and int4: against the exact product of the rounded or quantised operands, on every instruction set.

mod common;

use common::linear::{apply, int4, int4_bytes, pack};
use common::{Strided, assert_close, bits, gamma, is_emulated, isas, numbers, rows, rows_mut};
use half::bf16;
use proptest::prelude::*;
use saccade_vla_kernels::{
    Arithmetic, Epilogue, Isa, KernelError, LinearScratch, Matrix, PackedLinear, WeightRef,
};

const NARROW: [Arithmetic; 3] = [Arithmetic::Bfloat16, Arithmetic::Int8, Arithmetic::Int4];

/// Those whose sums are whole numbers.
const QUANTIZED: [Arithmetic; 2] = [Arithmetic::Int8, Arithmetic::Int4];

/// The values that an operand has after rounding or quantisation, in float64.
struct Operand {
    values: Vec<f64>,
}

impl Operand {
    fn rounded(values: &[f32]) -> Self {
        Self {
            values: values
                .iter()
                .map(|&value| bf16::from_f32(value).to_f64())
                .collect(),
        }
    }

    /// Weights in int8, by the definition.
    fn weight(values: &[f32], inputs: usize) -> Self {
        let mut all = Vec::with_capacity(values.len());
        for row in values.chunks_exact(inputs) {
            let scale = row.iter().fold(0.0f32, |max, value| max.max(value.abs())) / 127.0;
            all.extend(row.iter().map(|value| {
                let steps = if scale < f32::MIN_POSITIVE {
                    0.0
                } else {
                    (value / scale).round_ties_even()
                };
                f64::from(steps) * f64::from(scale)
            }));
        }
        Self { values: all }
    }

    /// Weights in int4, by the rule that `narrow_weights` tests.
    fn weight_int4(values: &[f32], inputs: usize) -> Self {
        let (pairs, scales) = int4(values, inputs);
        let wide = int4_bytes(&pairs, inputs).into_iter().enumerate();
        let values = wide.map(|(index, value)| f64::from(value) * f64::from(scales[index / inputs]));
        Self {
            values: values.collect(),
        }
    }

    /// Activations in bytes up to `steps`, by the definition.
    fn bytes(values: &[f32], inputs: usize, steps: f32) -> Self {
        let mut all = Vec::with_capacity(values.len());
        for row in values.chunks_exact(inputs) {
            let low = row.iter().fold(0.0f32, |low, &value| low.min(value));
            let high = row.iter().fold(0.0f32, |high, &value| high.max(value));
            let scale = high / steps - low / steps;
            if scale < f32::MIN_POSITIVE {
                all.extend(row.iter().map(|_| 0.0));
                continue;
            }
            let inverse = 1.0 / scale;
            let zero = (-low * inverse).round_ties_even();
            all.extend(row.iter().map(|value| {
                let byte = ((value * inverse).round_ties_even() + zero).clamp(0.0, steps);
                f64::from(byte - zero) * f64::from(scale)
            }));
        }
        Self { values: all }
    }
}

/// Largest byte of activations: 8 bits where the instruction set has what multiplies them without saturating.
fn steps(isa: Isa) -> f32 {
    let seven_bits = cfg!(target_arch = "x86_64") && !matches!(isa, Isa::Portable | Isa::SoftwareTiles);
    if seven_bits && !isa.dot_products().contains(&"vnni") {
        129.0
    } else {
        255.0
    }
}

/// What a layer has to agree with: the product of the rounded or quantised operands in float64.
struct Exact<'a> {
    x: &'a [f32],
    weight: &'a [f32],
    bias: &'a [f32],
    inputs: usize,
    /// By arithmetic and largest byte, the elements and how far they may be off. Most instruction sets share them.
    known: Vec<(Arithmetic, f32, Vec<f64>, Vec<f64>)>,
}

impl<'a> Exact<'a> {
    fn new(x: &'a [f32], weight: &'a [f32], bias: &'a [f32], inputs: usize) -> Self {
        Self {
            x,
            weight,
            bias,
            inputs,
            known: Vec::new(),
        }
    }

    /// Every element. bf16: each product and addition of the sum may be rounded once. int8: sums are exact, so only the scales and the bias
    /// round.
    fn compute(&self, arithmetic: Arithmetic, steps: f32) -> (Vec<f64>, Vec<f64>) {
        let (x, weight, operations) = match arithmetic {
            Arithmetic::Bfloat16 => (
                Operand::rounded(self.x),
                Operand::rounded(self.weight),
                2 * self.inputs + 2,
            ),
            Arithmetic::Int4 => (
                Operand::bytes(self.x, self.inputs, steps),
                Operand::weight_int4(self.weight, self.inputs),
                5,
            ),
            _ => (
                Operand::bytes(self.x, self.inputs, steps),
                Operand::weight(self.weight, self.inputs),
                5,
            ),
        };
        let (mut values, mut bounds) = (Vec::new(), Vec::new());
        for x in x.values.chunks_exact(self.inputs) {
            for (weight, &bias) in weight.values.chunks_exact(self.inputs).zip(self.bias) {
                let (mut sum, mut magnitude) = (0.0, 0.0);
                for (x, weight) in x.iter().zip(weight) {
                    sum += x * weight;
                    magnitude += (x * weight).abs();
                }
                if arithmetic != Arithmetic::Bfloat16 {
                    magnitude = sum.abs();
                }
                magnitude += f64::from(bias).abs();
                values.push(sum + f64::from(bias));
                // The float64 sum rounds too; results below the smallest normal number may be lost.
                bounds.push(gamma(operations) * magnitude + 1e-12 * magnitude + f64::from(f32::MIN_POSITIVE));
            }
        }
        (values, bounds)
    }

    fn check(&mut self, isa: Isa, arithmetic: Arithmetic, out: &[f32]) {
        let steps = steps(isa);
        let is_known = |(of, largest, ..): &(Arithmetic, f32, _, _)| *of == arithmetic && *largest == steps;
        let place = self.known.iter().position(is_known).unwrap_or_else(|| {
            let (values, bounds) = self.compute(arithmetic, steps);
            self.known.push((arithmetic, steps, values, bounds));
            self.known.len() - 1
        });
        let (.., values, bounds) = &self.known[place];
        assert_close(&format!("{isa}, {arithmetic:?}"), out, values, bounds);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(80))]

    #[test]
    fn agrees_with_the_exact_product(
        row_count in 1..=70_usize, inputs in 1..=300_usize, outputs in 1..=120_usize, threads in 1..4_usize, seed in 0..u64::MAX / 2,
    ) {
        let x = numbers(seed, row_count * inputs, 3.0);
        let weight = numbers(seed + 1, outputs * inputs, 0.1);
        let bias = numbers(seed + 2, outputs, 1.0);
        let mut exact = Exact::new(&x, &weight, &bias, inputs);
        for isa in isas() {
            for arithmetic in NARROW {
                let layer = pack(isa, arithmetic, &weight, &bias);
                prop_assert_eq!(layer.arithmetic(), arithmetic);
                exact.check(isa, arithmetic, &apply(&layer, threads, &x, Epilogue::Store));
            }
        }
    }
}

#[test]
fn every_small_size_agrees_with_the_exact_product() {
    let (x, weight) = (numbers(1, 70 * 70, 1.0), numbers(2, 70 * 70, 1.0));
    let bias = numbers(3, 70, 1.0);
    for size in 1..=70 {
        for (rows, inputs, outputs) in [(size, 7, 5), (3, size, 5), (3, 7, size)] {
            let (x, weight, bias) = (&x[..rows * inputs], &weight[..outputs * inputs], &bias[..outputs]);
            let mut exact = Exact::new(x, weight, bias, inputs);
            for isa in isas() {
                for arithmetic in NARROW {
                    let layer = pack(isa, arithmetic, weight, bias);
                    exact.check(isa, arithmetic, &apply(&layer, 1, x, Epilogue::Store));
                }
            }
        }
    }
}

#[test]
fn long_sums_agree_with_the_exact_product() {
    let inputs = 8192;
    let (x, weight) = (numbers(4, 9 * inputs, 1.0), numbers(5, 50 * inputs, 1.0));
    let bias = numbers(6, 50, 1.0);
    let mut exact = Exact::new(&x, &weight, &bias, inputs);
    for isa in isas() {
        for arithmetic in NARROW {
            let layer = pack(isa, arithmetic, &weight, &bias);
            exact.check(isa, arithmetic, &apply(&layer, 2, &x, Epilogue::Store));
        }
    }
}

/// All bytes and weights at their largest: sums reach what they can reach, and pairs of products what saturating instructions make of them.
#[test]
fn the_largest_sums_do_not_overflow() {
    let inputs = 1 << 16;
    for (sign, low) in [(1.0, 0.0), (-1.0, 0.0), (1.0, -1.0)] {
        let mut x = vec![1.0; inputs];
        x[0] = low;
        let weight = vec![sign; inputs];
        let mut exact = Exact::new(&x, &weight, &[0.0], inputs);
        for isa in isas() {
            for arithmetic in QUANTIZED {
                let layer = pack(isa, arithmetic, &weight, &[0.0]);
                exact.check(isa, arithmetic, &apply(&layer, 1, &x, Epilogue::Store));
            }
        }
    }
    let weight = vec![0.0; inputs + 1];
    let weight = WeightRef::F32(Matrix::new(&weight, inputs + 1));
    for arithmetic in QUANTIZED {
        let packed = PackedLinear::pack(Isa::best(), arithmetic, 1, &[(weight, None)]);
        assert!(matches!(packed, Err(KernelError::TooManyInputs { given }) if given == inputs + 1));
    }
}

#[test]
fn sums_of_bytes_have_the_bits_of_portable_where_bytes_are_as_large() {
    for (inputs, outputs, rows) in [(1, 1, 1), (37, 25, 9), (1030, 70, 30)] {
        let x = numbers(31, rows * inputs, 3.0);
        let weight = numbers(32, outputs * inputs, 0.1);
        let bias = numbers(33, outputs, 1.0);
        for arithmetic in QUANTIZED {
            let out = |isa| {
                let layer = pack(isa, arithmetic, &weight, &bias);
                bits(&apply(&layer, 1, &x, Epilogue::Add))
            };
            let expected = out(Isa::Portable);
            for isa in Isa::available() {
                assert!(
                    steps(isa) < 255.0 || out(isa) == expected,
                    "{isa}, {arithmetic:?}, {inputs} x {outputs}"
                );
            }
        }
    }
}

#[test]
fn bits_depend_neither_on_threads_nor_on_other_rows() {
    for (inputs, outputs) in [(70, 99), (1500, 230), (3001, 49)] {
        let x = numbers(9, 210 * inputs, 1.0);
        let weight = numbers(10, outputs * inputs, 0.1);
        let bias = numbers(11, outputs, 1.0);
        for isa in isas() {
            for arithmetic in NARROW {
                let layer = pack(isa, arithmetic, &weight, &bias);
                let all = bits(&apply(&layer, 1, &x, Epilogue::GeluTanh));
                // The last ones are those of many rows.
                let (threads, parts) = if is_emulated() { (1, 6) } else { (3, 8) };
                for &threads in &[3, 2, 8][..threads] {
                    assert_eq!(
                        bits(&apply(&layer, threads, &x, Epilogue::GeluTanh)),
                        all,
                        "{isa}, {arithmetic:?}"
                    );
                }
                for &(first, count) in &[
                    (0, 1),
                    (13, 1),
                    (209, 1),
                    (5, 2),
                    (40, 7),
                    (11, 49),
                    (96, 97),
                    (3, 200),
                ][..parts]
                {
                    let part = apply(
                        &layer,
                        2,
                        &x[first * inputs..][..count * inputs],
                        Epilogue::GeluTanh,
                    );
                    let expected = &all[first * outputs..][..count * outputs];
                    assert_eq!(
                        bits(&part),
                        expected,
                        "{isa}, {arithmetic:?}, {count} rows from {first}"
                    );
                }
            }
        }
    }
}

/// The scratch keeps what an earlier, larger call left in it; strided views, all epilogues.
#[test]
fn a_used_scratch_changes_nothing() {
    let (inputs, outputs) = (61, 53);
    let weight = numbers(12, outputs * inputs, 1.0);
    let bias = numbers(13, outputs, 1.0);
    let x = numbers(14, 20 * inputs, 1.0);
    let large = vec![f32::NAN; 200 * 100];
    for isa in isas() {
        for arithmetic in NARROW {
            let mut scratch = LinearScratch::new();
            let (bigger, layer) = (
                pack(isa, arithmetic, &[1.0; 100], &[0.0]),
                pack(isa, arithmetic, &weight, &bias),
            );
            let mut out = [0.0; 200];
            bigger
                .apply(
                    1,
                    rows(&large, 100),
                    Epilogue::Store,
                    rows_mut(&mut out, 1),
                    &mut scratch,
                )
                .unwrap();
            assert!(out.iter().all(|value| value.is_nan()), "{isa}, {arithmetic:?}");
            assert!(scratch.nbytes() > 0);
            for epilogue in [Epilogue::Store, Epilogue::Relu, Epilogue::Silu, Epilogue::Add] {
                let strided = Strided::new(&x, 20, inputs, 3);
                let mut out = Strided::new(&[0.5; 20 * 53], 20, outputs, 2);
                layer
                    .apply(2, strided.view(), epilogue, out.view_mut(), &mut scratch)
                    .unwrap();
                assert_eq!(
                    bits(&out.values()),
                    bits(&apply(&layer, 1, &x, epilogue)),
                    "{isa}, {arithmetic:?}"
                );
            }
        }
    }
}

#[test]
fn rows_of_any_size_keep_to_the_bound() {
    let inputs = 40;
    let weight = numbers(17, 21 * inputs, 1e-3);
    let bias = vec![0.0; 21];
    for scale in [0.0, 1e-45, 1e-38, 1e-36, 1e-30, 1e20, 3e38] {
        let mut x = numbers(18, 3 * inputs, scale);
        // One row of one sign, one of a single value.
        x[inputs..2 * inputs].iter_mut().for_each(|x| *x = -x.abs());
        x[2 * inputs..].fill(scale);
        let mut exact = Exact::new(&x, &weight, &bias, inputs);
        for isa in isas() {
            for arithmetic in NARROW {
                let layer = pack(isa, arithmetic, &weight, &bias);
                exact.check(isa, arithmetic, &apply(&layer, 1, &x, Epilogue::Store));
            }
        }
    }
    for isa in isas() {
        for arithmetic in QUANTIZED {
            let tiny = pack(isa, arithmetic, &vec![1e-44; 3 * inputs], &[1.0; 3]);
            assert_eq!(apply(&tiny, 1, &vec![5.0; inputs], Epilogue::Store), [1.0; 3]);
        }
    }
}

#[test]
fn nan_and_infinity_stay_in_their_row() {
    let (inputs, outputs) = (130, 70);
    let clean = numbers(19, 20 * inputs, 1.0);
    let weight = numbers(20, outputs * inputs, 1.0);
    let bias = numbers(21, outputs, 1.0);
    for isa in isas() {
        for arithmetic in NARROW {
            let layer = pack(isa, arithmetic, &weight, &bias);
            for epilogue in [
                Epilogue::Store,
                Epilogue::Relu,
                Epilogue::GeluTanh,
                Epilogue::Silu,
                Epilogue::Add,
            ] {
                let expected = bits(&apply(&layer, 1, &clean, epilogue));
                for poison in [
                    f32::NAN,
                    -f32::NAN,
                    f32::from_bits(0x7f80_0001),
                    f32::INFINITY,
                    f32::NEG_INFINITY,
                ] {
                    for place in [0, 77, 129] {
                        let mut x = clean.clone();
                        x[6 * inputs + place] = poison;
                        let out = apply(&layer, 2, &x, epilogue);
                        for (row, part) in out.chunks_exact(outputs).enumerate() {
                            if row != 6 {
                                assert_eq!(
                                    bits(part),
                                    expected[row * outputs..][..outputs],
                                    "{isa}, {arithmetic:?}"
                                );
                            } else if poison.is_nan() || QUANTIZED.contains(&arithmetic) {
                                assert!(
                                    part.iter().all(|value| value.is_nan()),
                                    "{isa}, {arithmetic:?}, {poison}"
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}
