//! What drives tiles, on tiles in software: shapes, remainders, epilogues and splitting, on every machine; and the same bits in hardware where
//! there is AMX.

mod common;

use std::io::Write;

use common::{bits, gamma, numbers, rows, rows_mut};
use half::bf16;
use saccade_vla_kernels::{
    Arithmetic, CpuReport, Element, Epilogue, Isa, LinearScratch, Mask, Matrix, PackedKeyValues,
    PackedLinear, WeightRef, attention,
};

const TILES: Isa = Isa::SoftwareTiles;

/// `(rows, inputs, outputs)`: within a tile, around its edges, of several parts of a panel, more rows than go through a panel together.
const SHAPES: [(usize, usize, usize); 9] = [
    (1, 1, 1),
    (3, 31, 47),
    (16, 64, 48),
    (17, 65, 49),
    (33, 200, 100),
    (49, 130, 95),
    (64, 2100, 20),
    (25, 4300, 50),
    (350, 40, 60),
];

const EPILOGUES: [Epilogue; 7] = [
    Epilogue::Store,
    Epilogue::GeluTanh,
    Epilogue::GeluErf,
    Epilogue::Relu,
    Epilogue::Silu,
    Epilogue::Add,
    Epilogue::Mul,
];

/// A layer, and rows for it.
struct Case {
    inputs: usize,
    outputs: usize,
    x: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Case {
    fn new((rows, inputs, outputs): (usize, usize, usize)) -> Self {
        Self {
            inputs,
            outputs,
            x: numbers(1, rows * inputs, 2.0),
            weight: numbers(2, outputs * inputs, 0.2),
            bias: numbers(3, outputs, 1.0),
        }
    }

    fn layer(&self, isa: Isa, arithmetic: Arithmetic) -> PackedLinear {
        let weight = WeightRef::F32(Matrix::new(&self.weight, self.inputs));
        PackedLinear::pack(isa, arithmetic, 1, &[(weight, Some(&self.bias))]).unwrap()
    }

    fn apply(&self, layer: &PackedLinear, threads: usize, x: &[f32], epilogue: Epilogue) -> Vec<f32> {
        let mut out = vec![0.5; x.len() / self.inputs * self.outputs];
        let scratch = &mut LinearScratch::new();
        layer
            .apply(
                threads,
                rows(x, self.inputs),
                epilogue,
                rows_mut(&mut out, self.outputs),
                scratch,
            )
            .unwrap();
        out
    }

    fn run(&self, isa: Isa, arithmetic: Arithmetic, epilogue: Epilogue) -> Vec<f32> {
        self.apply(&self.layer(isa, arithmetic), 2, &self.x, epilogue)
    }
}

#[test]
fn software_tiles_of_bytes_have_the_bits_of_portable() {
    for shape in SHAPES {
        let case = Case::new(shape);
        for epilogue in EPILOGUES {
            for arithmetic in [Arithmetic::Int8, Arithmetic::Int4] {
                let [tiles, portable] =
                    [TILES, Isa::Portable].map(|isa| bits(&case.run(isa, arithmetic, epilogue)));
                assert!(tiles == portable, "{shape:?}, {arithmetic:?}, {epilogue:?}");
            }
        }
    }
}

#[test]
fn software_tiles_of_bf16_agree_with_float64() {
    for shape in SHAPES {
        let case = Case::new(shape);
        let out = case.run(TILES, Arithmetic::Bfloat16, Epilogue::Store);
        let round = |value: &f32| bf16::from_f32(*value).to_f64();
        for (row, x) in case.x.chunks_exact(case.inputs).enumerate() {
            for (column, w) in case.weight.chunks_exact(case.inputs).enumerate() {
                let bias = f64::from(case.bias[column]);
                let products = x.iter().zip(w).map(|(x, w)| round(x) * round(w));
                let size = products.clone().map(f64::abs).sum::<f64>() + bias.abs();
                let exact = products.sum::<f64>() + bias;
                let error = (f64::from(out[row * case.outputs + column]) - exact).abs();
                // Sums of 32 products, and sums of these.
                let bound = gamma(20 + case.inputs / 32) * size + 1e-30;
                assert!(
                    error <= bound,
                    "{shape:?}, ({row}, {column}): off by {error}, allowed {bound}"
                );
            }
        }
    }
}

#[test]
fn software_tiles_give_equal_bits_in_any_batch_and_on_any_threads() {
    for shape in [(49, 130, 95), (37, 2100, 70), (340, 70, 50)] {
        let case = Case::new(shape);
        for arithmetic in [Arithmetic::Bfloat16, Arithmetic::Int8, Arithmetic::Int4] {
            let layer = case.layer(TILES, arithmetic);
            let whole = bits(&case.apply(&layer, 1, &case.x, Epilogue::Store));
            for threads in [2, 3, 7] {
                let again = bits(&case.apply(&layer, threads, &case.x, Epilogue::Store));
                assert!(again == whole, "{shape:?}, {arithmetic:?}, {threads} threads");
            }
            for (first, count) in [(0, 1), (5, 1), (3, 16), (7, 17), (1, 32), (2, 33)] {
                let part = &case.x[first * case.inputs..][..count * case.inputs];
                let alone = bits(&case.apply(&layer, 2, part, Epilogue::Store));
                let expected = &whole[first * case.outputs..][..count * case.outputs];
                assert!(
                    alone == expected,
                    "{shape:?}, {arithmetic:?}, {count} rows from {first} on"
                );
            }
        }
    }
}

/// How memory is asked for weights has no influence.
#[test]
fn software_tiles_give_equal_bits_with_and_without_streams() {
    let case = Case::new((49, 2100, 70));
    for isa in common::isas() {
        for arithmetic in [
            Arithmetic::Float32,
            Arithmetic::Bfloat16,
            Arithmetic::Int8,
            Arithmetic::Int4,
        ] {
            let [on, off] = [true, false].map(|streams| {
                let layer = case.layer(isa, arithmetic).with_streams(streams);
                bits(&case.apply(&layer, 2, &case.x, Epilogue::Store))
            });
            assert!(on == off, "{isa}, {arithmetic:?}");
        }
    }
}

/// A row may leave anything behind: padding is written anew.
#[test]
fn software_tiles_do_not_see_what_a_scratch_held() {
    let case = Case::new((20, 33, 50));
    let mut scratch = LinearScratch::new();
    for arithmetic in [Arithmetic::Bfloat16, Arithmetic::Int8, Arithmetic::Int4] {
        let layer = case.layer(TILES, arithmetic);
        let expected = bits(&case.apply(&layer, 1, &case.x, Epilogue::Store));
        let wide = Case::new((40, 97, 10));
        let poison = vec![f32::NAN; wide.x.len()];
        let mut out = vec![0.0; 40 * wide.outputs];
        let filled = wide.layer(TILES, arithmetic).apply(
            1,
            rows(&poison, wide.inputs),
            Epilogue::Store,
            rows_mut(&mut out, wide.outputs),
            &mut scratch,
        );
        filled.unwrap();
        let mut out = vec![0.0; 20 * case.outputs];
        let (x, to) = (rows(&case.x, case.inputs), rows_mut(&mut out, case.outputs));
        layer.apply(1, x, Epilogue::Store, to, &mut scratch).unwrap();
        assert_eq!(bits(&out), expected, "{arithmetic:?}");
    }
}

/// Attention over keys that follow others in the same memory, of which some were not numbers.
#[test]
fn software_tiles_do_not_see_what_keys_and_values_held() {
    let (heads, width) = (3, 20);
    let columns = heads * width;
    let (keys, values) = (numbers(1, 45 * columns, 1.0), numbers(2, 45 * columns, 1.0));
    let queries = numbers(3, 19 * columns, 1.0);
    let run = |kv: &PackedKeyValues| {
        let mut out = vec![0.0; queries.len()];
        attention(
            2,
            rows(&queries, columns),
            kv,
            0.3,
            Mask::None,
            None,
            rows_mut(&mut out, columns),
        );
        bits(&out)
    };
    let mut fresh = PackedKeyValues::new(TILES, Element::Bf16, heads, width);
    fresh
        .pack(1, rows(&keys, columns), rows(&values, columns))
        .unwrap();
    let mut used = PackedKeyValues::new(TILES, Element::Bf16, heads, width);
    let poison = vec![f32::NAN; 130 * columns];
    used.pack(1, rows(&poison, columns), rows(&poison, columns))
        .unwrap();
    used.pack(1, rows(&keys, columns), rows(&values, columns))
        .unwrap();
    assert_eq!(run(&used), run(&fresh));
    // One by one, with room made on the way.
    let mut grown = PackedKeyValues::new(TILES, Element::Bf16, heads, width);
    for (key, value) in keys.chunks_exact(columns).zip(values.chunks_exact(columns)) {
        grown.append(1, rows(key, columns), rows(value, columns)).unwrap();
    }
    assert_eq!(run(&grown), run(&fresh));
}

/// The same linear layers in hardware.
#[test]
fn hardware_tiles_have_the_bits_of_software_tiles() {
    if !Isa::Amx.is_available() {
        // Past the test runner, which keeps back what a test prints.
        let why = CpuReport::current().tiles;
        let _ = writeln!(
            std::io::stderr(),
            "SKIPPED: layers in the tiles of AMX are not compared: {why}"
        );
        return;
    }
    for shape in SHAPES {
        let case = Case::new(shape);
        for arithmetic in [Arithmetic::Bfloat16, Arithmetic::Int8, Arithmetic::Int4] {
            let [amx, software] =
                [Isa::Amx, TILES].map(|isa| bits(&case.run(isa, arithmetic, Epilogue::Store)));
            assert!(amx == software, "{shape:?}, {arithmetic:?}");
        }
    }
}
