//! The small kernels at the head's sizes, with criterion: norms, activations, packing.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use saccade_benches::random::Random;
use saccade_vla_kernels::{
    Arithmetic, Element, Isa, Matrix, PackedKeyValues, PackedLinear, Rows, RowsMut, WeightRef, gelu_erf,
    gelu_tanh, layer_norm, relu, silu,
};

const ROWS: usize = 49;
const WIDTH: usize = 1536;

fn norms(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("layer_norm 49 x 1536");
    group.throughput(Throughput::Elements((ROWS * WIDTH) as u64));
    let mut random = Random::new(3);
    let x = random.vec(ROWS * WIDTH, 1.0);
    let (scale, shift) = (random.vec(WIDTH, 1.0), random.vec(WIDTH, 1.0));
    let mut out = vec![0.0; ROWS * WIDTH];
    for isa in Isa::available() {
        for affine in [false, true] {
            let name = format!("{isa}{}", if affine { ", scale and shift" } else { "" });
            group.bench_function(name, |bencher| {
                bencher.iter(|| {
                    let x = Rows::new(&x, WIDTH);
                    let out = RowsMut::new(&mut out, WIDTH);
                    layer_norm(isa, 1, x, 1e-5, affine.then_some((&scale[..], &shift[..])), out);
                });
            });
        }
    }
}

fn activations(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("activations");
    group.throughput(Throughput::Elements((ROWS * WIDTH) as u64));
    // Outliers of trained models are large, and must not take longer.
    for (size, scale) in [("", 4.0), (" of large values", 200.0)] {
        let x = Random::new(4).vec(ROWS * WIDTH, scale);
        let mut values = x.clone();
        for isa in Isa::available() {
            for (name, activation) in [
                ("gelu_tanh", gelu_tanh as fn(Isa, &mut [f32])),
                ("gelu_erf", gelu_erf),
                ("silu", silu),
                ("relu", relu),
            ] {
                group.bench_function(format!("{name}{size}, {isa}"), |bencher| {
                    bencher.iter(|| {
                        values.copy_from_slice(&x);
                        activation(isa, black_box(&mut values));
                    });
                });
            }
        }
    }
}

fn packing(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("packing");
    group.sample_size(20);
    let weight = Random::new(5).vec(WIDTH * WIDTH, 0.05);
    let view = Matrix::new(&weight, WIDTH);
    let isa = Isa::best();
    group.throughput(Throughput::Bytes((4 * WIDTH * WIDTH) as u64));
    for (name, view) in [("out x in", view), ("in x out", view.transpose())] {
        group.bench_function(format!("PackedLinear 1536 x 1536, weights {name}"), |bencher| {
            bencher.iter(|| PackedLinear::pack(isa, Arithmetic::Float32, 1, &[(WeightRef::F32(view), None)]));
        });
    }
    let keys = Rows::new(&weight[..296 * WIDTH], WIDTH);
    let mut held = PackedKeyValues::new(isa, Element::F32, 32, WIDTH / 32);
    group.throughput(Throughput::Bytes((8 * 296 * WIDTH) as u64));
    group.bench_function("PackedKeyValues 296 x 1536", |bencher| {
        bencher.iter(|| held.pack(1, keys, keys))
    });
}

criterion_group!(benches, norms, activations, packing);
criterion_main!(benches);
