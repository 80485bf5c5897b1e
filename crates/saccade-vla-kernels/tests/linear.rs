//! The packed linear layer against float64, on every instruction set, with the bound that rounding allows; and the bits that must not change.

mod common;

use common::linear::apply;
use common::{Strided, assert_close, bits, gamma, is_emulated, isas, numbers};
use half::bf16;
use proptest::prelude::*;
use saccade_vla_kernels::{
    Arithmetic, Element, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, Rows, WeightRef,
};

const EPILOGUES: [Epilogue; 7] = [
    Epilogue::Store,
    Epilogue::GeluTanh,
    Epilogue::GeluErf,
    Epilogue::Relu,
    Epilogue::Silu,
    Epilogue::Add,
    Epilogue::Mul,
];

/// A part of a stacked layer.
#[derive(Clone, Debug)]
struct Part {
    outputs: usize,
    bf16: bool,
    /// Stored `(in_features, out_features)`, as the category-specific layers are.
    transposed: bool,
    bias: bool,
}

fn part() -> impl Strategy<Value = Part> {
    (0..120_usize, any::<bool>(), any::<bool>(), any::<bool>()).prop_map(
        |(outputs, bf16, transposed, bias)| Part {
            outputs,
            bf16,
            transposed,
            bias,
        },
    )
}

/// Weights of a part, always representable in bf16 where the part is.
struct Weights {
    f32: Vec<f32>,
    bf16: Vec<bf16>,
    bias: Vec<f32>,
}

fn weights(part: &Part, inputs: usize, seed: u64) -> Weights {
    let mut f32 = numbers(seed, part.outputs * inputs, 1.0);
    let bf16: Vec<_> = f32.iter().map(|&value| bf16::from_f32(value)).collect();
    if part.bf16 {
        f32 = bf16.iter().map(|value| value.to_f32()).collect();
    }
    Weights {
        f32,
        bf16,
        bias: numbers(seed + 1, part.outputs, 1.0),
    }
}

/// `data` as `(outputs, inputs)`: as stored, or transposed.
fn view<'a, T: Copy>(data: &'a [T], part: &Part, inputs: usize) -> Matrix<'a, T> {
    if part.transposed {
        Matrix::from(Rows::strided(data, inputs, part.outputs, part.outputs)).transpose()
    } else {
        Matrix::from(Rows::strided(data, part.outputs, inputs, inputs))
    }
}

fn pack(isa: Isa, parts: &[Part], weights: &[Weights], inputs: usize) -> PackedLinear {
    let views: Vec<_> = parts
        .iter()
        .zip(weights)
        .map(|(part, weights)| {
            let weight = if part.bf16 {
                WeightRef::Bf16(view(&weights.bf16, part, inputs))
            } else {
                WeightRef::F32(view(&weights.f32, part, inputs))
            };
            (weight, part.bias.then_some(&weights.bias[..]))
        })
        .collect();
    PackedLinear::pack(isa, Arithmetic::Float32, 1, &views).unwrap()
}

/// The function of an epilogue, and how far a change of its input can change it at most (its steepest slope).
fn exact_epilogue(epilogue: Epilogue, value: f64, before: f32) -> (f64, f64) {
    match epilogue {
        Epilogue::GeluTanh => (common::gelu_tanh(value), 1.13),
        Epilogue::GeluErf => (common::gelu_erf(value), 1.13),
        Epilogue::Relu => (value.max(0.0), 1.0),
        Epilogue::Silu => (common::silu(value), 1.1),
        Epilogue::Add => (value + f64::from(before), 1.0),
        Epilogue::Mul => (value * f64::from(before), f64::from(before).abs()),
        _ => (value, 1.0),
    }
}

/// Every element in float64, and how far it may be off: the sum by one rounding for each product and addition, the epilogue by a few more.
fn exact(
    parts: &[Part],
    weights: &[Weights],
    x: &Strided,
    before: &[f32],
    epilogue: Epilogue,
) -> (Vec<f64>, Vec<f64>) {
    let (mut values, mut bounds) = (Vec::new(), Vec::new());
    let (inputs, x) = (x.columns, x.view());
    for row in 0..x.num_rows() {
        for (part, weights) in parts.iter().zip(weights) {
            let weight = view(&weights.f32, part, inputs);
            for output in 0..part.outputs {
                let bias = if part.bias {
                    f64::from(weights.bias[output])
                } else {
                    0.0
                };
                let (mut sum, mut magnitude) = (bias, bias.abs());
                for k in 0..inputs {
                    let product = f64::from(x.row(row)[k]) * f64::from(weight.get(output, k));
                    sum += product;
                    magnitude += product.abs();
                }
                let before = before[values.len()];
                let (value, slope) = exact_epilogue(epilogue, sum, before);
                let bound = slope * gamma(inputs + 2) * magnitude
                    + gamma(16) * (value.abs() + f64::from(before).abs())
                    + 1e-7
                        * f64::from(u8::from(matches!(
                            epilogue,
                            Epilogue::GeluTanh | Epilogue::GeluErf
                        )));
                values.push(value);
                bounds.push(bound);
            }
        }
    }
    (values, bounds)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn agrees_with_float64(
        row_count in 0..60_usize,
        inputs in 0..300_usize,
        parts in proptest::collection::vec(part(), 1..4),
        gaps in (0..5_usize, 0..5_usize),
        threads in 1..4_usize,
        epilogue in 0..EPILOGUES.len(),
        seed in 0..u64::MAX / 2,
    ) {
        let epilogue = EPILOGUES[epilogue];
        let weights: Vec<_> = parts.iter().zip(0..).map(|(part, i)| weights(part, inputs, seed + 2 * i)).collect();
        let outputs = parts.iter().map(|part| part.outputs).sum();
        let x = Strided::new(&numbers(seed + 100, row_count * inputs, 1.0), row_count, inputs, gaps.0);
        let before = numbers(seed + 101, row_count * outputs, 1.0);
        let (values, bounds) = exact(&parts, &weights, &x, &before, epilogue);
        for isa in isas() {
            let layer = pack(isa, &parts, &weights, inputs);
            let stored = if parts.iter().all(|part| part.bf16) { Element::Bf16 } else { Element::F32 };
            prop_assert_eq!((layer.in_features(), layer.out_features(), layer.element(), layer.isa()), (inputs, outputs, stored, isa));
            let mut out = Strided::new(&before, row_count, outputs, gaps.1);
            layer.apply(threads, x.view(), epilogue, out.view_mut(), &mut LinearScratch::new()).unwrap();
            assert_close(&isa.to_string(), &out.values(), &values, &bounds);
        }
    }
}

/// A layer with sizes of the head, one per element type.
fn layers(isa: Isa, inputs: usize, outputs: usize) -> [PackedLinear; 2] {
    [false, true].map(|bf16| {
        let parts = [Part {
            outputs,
            bf16,
            transposed: false,
            bias: true,
        }];
        let weights = [weights(&parts[0], inputs, 7)];
        pack(isa, &parts, &weights, inputs)
    })
}

#[test]
fn long_sums_agree_with_float64() {
    let inputs = 6144;
    let parts = [Part {
        outputs: 50,
        bf16: false,
        transposed: false,
        bias: true,
    }];
    let weights = [weights(&parts[0], inputs, 3)];
    let x = Strided::new(&numbers(4, 9 * inputs, 1.0), 9, inputs, 0);
    let (values, bounds) = exact(&parts, &weights, &x, &[0.0; 9 * 50], Epilogue::Store);
    for isa in isas() {
        let layer = pack(isa, &parts, &weights, inputs);
        let out = apply(&layer, 1, &x.values(), Epilogue::Store);
        assert_close(&isa.to_string(), &out, &values, &bounds);
    }
}

/// The last panel of a layer computes only the vectors that have columns.
#[test]
fn bits_of_a_column_do_not_depend_on_how_many_follow() {
    let (inputs, outputs, row_count) = (67, 48, 9);
    let (weight, bias) = (numbers(1, inputs * outputs, 1.0), numbers(2, outputs, 1.0));
    let x = numbers(3, row_count * inputs, 1.0);
    for isa in isas() {
        for arithmetic in [
            Arithmetic::Float32,
            Arithmetic::Bfloat16,
            Arithmetic::Int8,
            Arithmetic::Int4,
        ] {
            let first = |count: usize| {
                let layer = common::linear::pack(isa, arithmetic, &weight[..count * inputs], &bias[..count]);
                apply(&layer, 1, &x, Epilogue::GeluTanh)
            };
            let all = first(outputs);
            for count in 1..outputs {
                let few = first(count);
                for (few, all) in few.chunks_exact(count).zip(all.chunks_exact(outputs)) {
                    assert_eq!(
                        bits(few),
                        bits(&all[..count]),
                        "{isa}, {arithmetic:?}, {count} columns"
                    );
                }
            }
        }
    }
}

#[test]
fn bits_do_not_depend_on_threads() {
    for (inputs, outputs, row_count) in [(96, 500, 49), (1100, 200, 49), (2048, 130, 300)] {
        let x = numbers(8, row_count * inputs, 1.0);
        // Long sums take minutes there: with all epilogues at the first size only.
        let few = is_emulated() && inputs > 96;
        let (epilogues, threads) = if few { (1, 1) } else { (EPILOGUES.len(), 3) };
        for isa in isas() {
            for layer in layers(isa, inputs, outputs) {
                for &epilogue in &EPILOGUES[..epilogues] {
                    let one = bits(&apply(&layer, 1, &x, epilogue));
                    for &threads in &[3, 2, 8][..threads] {
                        assert_eq!(
                            bits(&apply(&layer, threads, &x, epilogue)),
                            one,
                            "{isa}, {threads} threads"
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn bits_of_a_row_do_not_depend_on_the_others() {
    for (inputs, outputs) in [(70, 99), (1500, 50), (3001, 49)] {
        let x = numbers(9, 210 * inputs, 1.0);
        for isa in isas() {
            for layer in layers(isa, inputs, outputs) {
                let all = bits(&apply(&layer, 2, &x, Epilogue::GeluTanh));
                for (first, count) in [
                    (0, 1),
                    (13, 1),
                    (209, 1),
                    (5, 2),
                    (40, 7),
                    (11, 49),
                    (96, 97),
                    (3, 200),
                ] {
                    let part = &x[first * inputs..][..count * inputs];
                    let part = bits(&apply(&layer, 1, part, Epilogue::GeluTanh));
                    assert_eq!(
                        part,
                        all[first * outputs..][..count * outputs],
                        "{isa}, {count} rows from {first}"
                    );
                }
            }
        }
    }
}

#[test]
fn bits_do_not_depend_on_the_order_of_panels() {
    // Weights of 8 MB: blocks of 200 rows pass them in groups, one row passes all of them.
    let (inputs, outputs, row_count) = (3001, 700, 200);
    let x = numbers(10, row_count * inputs, 1.0);
    for isa in Isa::available() {
        for layer in layers(isa, inputs, outputs) {
            let all = bits(&apply(&layer, 2, &x, Epilogue::Store));
            for row in [0, 95, 96, 199] {
                let alone = bits(&apply(&layer, 1, &x[row * inputs..][..inputs], Epilogue::Store));
                assert_eq!(alone, all[row * outputs..][..outputs], "{isa}, row {row}");
            }
        }
    }
}

#[test]
fn bf16_storage_gives_the_bits_of_f32_storage() {
    for inputs in [1, 2, 63, 640, 1537] {
        let part = Part {
            outputs: 101,
            bf16: true,
            transposed: false,
            bias: true,
        };
        let weights = [weights(&part, inputs, 10)];
        let x = numbers(11, 20 * inputs, 1.0);
        for isa in isas() {
            let narrow = pack(isa, std::slice::from_ref(&part), &weights, inputs);
            let wide = pack(
                isa,
                &[Part {
                    bf16: false,
                    ..part.clone()
                }],
                &weights,
                inputs,
            );
            assert_eq!((narrow.element(), wide.element()), (Element::Bf16, Element::F32));
            assert!(narrow.nbytes() < wide.nbytes() || inputs == 1);
            assert_eq!(
                bits(&apply(&narrow, 1, &x, Epilogue::Silu)),
                bits(&apply(&wide, 1, &x, Epilogue::Silu))
            );
        }
    }
}

#[test]
fn nan_and_infinity_stay_in_their_row() {
    let (inputs, outputs) = (130, 70);
    let clean = numbers(12, 20 * inputs, 1.0);
    for isa in isas() {
        for layer in layers(isa, inputs, outputs) {
            for epilogue in EPILOGUES {
                let expected = bits(&apply(&layer, 1, &clean, epilogue));
                for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                    let mut x = clean.clone();
                    x[6 * inputs + 129] = poison;
                    let out = apply(&layer, 2, &x, epilogue);
                    for row in 0..20 {
                        let part = &out[row * outputs..][..outputs];
                        if row != 6 {
                            assert_eq!(
                                bits(part),
                                expected[row * outputs..][..outputs],
                                "{isa}, {epilogue:?}"
                            );
                        } else if poison.is_nan() {
                            assert!(part.iter().all(|value| value.is_nan()), "{isa}, {epilogue:?}");
                        } else {
                            // An infinite sum is NaN nowhere: the activations have limits.
                            assert!(
                                part.iter().all(|value| !value.is_nan()),
                                "{isa}, {epilogue:?}: {part:?}"
                            );
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn huge_and_tiny_values_survive() {
    for isa in isas() {
        let weight = [f32::MAX, 1.0, f32::MIN_POSITIVE / 4.0];
        let layer = PackedLinear::pack(
            isa,
            Arithmetic::Float32,
            1,
            &[(WeightRef::F32(Matrix::new(&weight, 1)), None)],
        )
        .unwrap();
        assert_eq!(
            apply(&layer, 1, &[2.0], Epilogue::Store),
            [f32::INFINITY, 2.0, f32::MIN_POSITIVE / 2.0]
        );
    }
}
