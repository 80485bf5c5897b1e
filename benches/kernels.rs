//! The small kernels at the head's sizes: norms, activations, packing.

use std::hint::black_box;

use saccade_benches::measure::{Contender, measure};
use saccade_benches::options::Options;
use saccade_benches::random::Random;
use saccade_benches::report::Report;
use saccade_vla_kernels::{
    Arithmetic, Element, Isa, Matrix, PackedKeyValues, PackedLinear, Rows, RowsMut, WeightRef, gelu_erf,
    gelu_tanh, layer_norm, relu, silu,
};

const ROWS: usize = 49;
const WIDTH: usize = 1536;
const ELEMENTS: f64 = (ROWS * WIDTH) as f64;

fn norms(options: &Options, report: &mut Report) {
    let mut random = Random::new(3);
    let x = random.vec(ROWS * WIDTH, 1.0);
    let (scale, shift) = (random.vec(WIDTH, 1.0), random.vec(WIDTH, 1.0));
    let mut contenders = Vec::new();
    for isa in Isa::available() {
        for (name, affine) in [("", None), (", scale and shift", Some((&scale[..], &shift[..])))] {
            let (x, mut out) = (&x, vec![0.0; ROWS * WIDTH]);
            contenders.push(Contender::new(format!("{isa}{name}"), ELEMENTS, move || {
                let (x, out) = (Rows::new(x, WIDTH), RowsMut::new(&mut out, WIDTH));
                layer_norm(isa, 1, x, 1e-5, affine, out);
            }));
        }
    }
    report.case("layer_norm 49 x 1536", &measure(options, &mut contenders));
}

fn activations(options: &Options, report: &mut Report) {
    // Outliers of trained models are large, and must not take longer.
    for (size, scale) in [("", 4.0), (" of large values", 200.0)] {
        let x = Random::new(4).vec(ROWS * WIDTH, scale);
        for (name, activation) in [
            ("gelu_tanh", gelu_tanh as fn(Isa, &mut [f32])),
            ("gelu_erf", gelu_erf),
            ("silu", silu),
            ("relu", relu),
        ] {
            let mut contenders = Vec::new();
            for isa in Isa::available() {
                let (x, mut values) = (&x, x.clone());
                contenders.push(Contender::new(isa.to_string(), ELEMENTS, move || {
                    values.copy_from_slice(x);
                    activation(isa, black_box(&mut values));
                }));
            }
            report.case(&format!("{name}{size}"), &measure(options, &mut contenders));
        }
    }
}

fn packing(options: &Options, report: &mut Report) {
    const KEYS: usize = 296;
    let weight = Random::new(5).vec(WIDTH * WIDTH, 0.05);
    let view = Matrix::new(&weight, WIDTH);
    let isa = Isa::best();
    let mut contenders = Vec::new();
    for (name, view) in [("out x in", view), ("in x out", view.transpose())] {
        let name = format!("PackedLinear, weights {name}");
        let parts = [(WeightRef::F32(view), None)];
        contenders.push(Contender::new(name, (WIDTH * WIDTH) as f64, move || {
            black_box(
                PackedLinear::pack(isa, Arithmetic::Float32, 1, &parts).expect("there is enough memory"),
            );
        }));
    }
    let keys = Rows::new(&weight[..KEYS * WIDTH], WIDTH);
    let mut held = PackedKeyValues::new(isa, Element::F32, 32, WIDTH / 32);
    contenders.push(Contender::new(
        "PackedKeyValues",
        (2 * KEYS * WIDTH) as f64,
        move || {
            held.pack(1, keys, keys).expect("there is enough memory");
        },
    ));
    report.case(
        "packing 1536 x 1536, 296 keys",
        &measure(options, &mut contenders),
    );
}

fn main() {
    let options = Options::from_args();
    let mut report = Report::begin("kernels", "1e9 elements", &options);
    for (name, bench) in [
        ("norms", norms as fn(&Options, &mut Report)),
        ("activations", activations),
        ("packing", packing),
    ] {
        if options.wants(name) {
            bench(&options, &mut report);
        }
    }
    report.end(&options);
}
