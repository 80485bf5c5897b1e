//! Fused attention at the head's sizes, compared with the same work as faer products with the scores in memory.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use saccade_benches::measure::{Contender, MULTIPLY_ACCUMULATES, measure};
use saccade_benches::options::Options;
use saccade_benches::random::Random;
use saccade_benches::report::Report;
use saccade_vla_kernels::{
    Arithmetic, Element, Isa, LogitBias, Mask, PackedKeyValues, Rows, RowsMut, attention,
};

/// `(queries, keys, num_heads, head_dim)`: cross- and self-attention of a DiT block, with one camera and with three, the same of the action
/// rows alone; self-attention of a VL block; a head of width 128.
const SHAPES: [(usize, usize, usize, usize); 9] = [
    (49, 296, 32, 48),
    (49, 822, 32, 48),
    (49, 49, 32, 48),
    (16, 296, 32, 48),
    (16, 49, 32, 48),
    (296, 296, 32, 64),
    (822, 822, 32, 64),
    (49, 296, 4, 32),
    (49, 49, 4, 32),
];

struct Shape {
    queries: usize,
    keys: usize,
    num_heads: usize,
    head_dim: usize,
    q: Vec<f32>,
    k: Vec<f32>,
    v: Vec<f32>,
}

impl Shape {
    fn width(&self) -> usize {
        self.num_heads * self.head_dim
    }
}

fn main() {
    let options = Options::from_args();
    let mut report = Report::begin("attention", MULTIPLY_ACCUMULATES, &options);
    for (queries, keys, num_heads, head_dim) in SHAPES {
        let name = format!("{queries} queries, {keys} keys, {num_heads} heads x {head_dim}");
        if !options.wants(&name) {
            continue;
        }
        let width = num_heads * head_dim;
        let mut random = Random::new(2);
        let (q, k, v) = (
            random.vec(queries * width, 1.0),
            random.vec(keys * width, 1.0),
            random.vec(keys * width, 1.0),
        );
        let shape = Shape {
            queries,
            keys,
            num_heads,
            head_dim,
            q,
            k,
            v,
        };
        let bias = random.vec(num_heads * queries * keys, 1.0);
        let mut contenders = Vec::new();
        for &threads in &options.threads {
            for isa in Isa::available() {
                contenders.push(Contender::peak(isa, Arithmetic::Float32, threads));
                contenders.push(Contender::peak(isa, Arithmetic::Bfloat16, threads));
                for element in [Element::F32, Element::Bf16] {
                    saccade(&shape, isa, element, threads, &bias, &mut contenders);
                }
            }
        }
        if options.threads.contains(&1) {
            plain(&shape, &mut contenders);
        }
        report.case(&name, &measure(&options, &mut contenders));
    }
    report.end(&options);
}

fn saccade<'a>(
    shape: &'a Shape,
    isa: Isa,
    element: Element,
    threads: usize,
    bias: &'a [f32],
    contenders: &mut Vec<Contender<'a>>,
) {
    let width = shape.width();
    let scale = 1.0 / (shape.head_dim as f32).sqrt();
    let mut held = PackedKeyValues::new(isa, element, shape.num_heads, shape.head_dim);
    let (k, v) = (Rows::new(&shape.k, width), Rows::new(&shape.v, width));
    held.pack(threads, k, v).expect("there is enough memory");
    let arithmetic = match element {
        Element::Bf16 => Arithmetic::Bfloat16,
        _ => Arithmetic::Float32,
    };
    let mut add = |what: &str, run: Box<dyn FnMut() + 'a>| {
        contenders.push(Contender {
            name: format!("saccade {isa} {element:?}{what}"),
            threads,
            work: macs(shape),
            relative_to: Some(Contender::peak_name(isa, arithmetic)),
            run,
        });
    };
    let biases = [
        ("", None),
        (
            ", with a bias",
            Some(LogitBias {
                values: bias,
                head_stride: shape.queries * shape.keys,
                query_stride: shape.keys,
            }),
        ),
    ];
    for (what, bias) in biases {
        let mut out = vec![0.0; shape.queries * width];
        let held = held.try_clone().expect("there is enough memory");
        add(
            what,
            Box::new(move || {
                attention(
                    threads,
                    Rows::new(&shape.q, width),
                    &held,
                    scale,
                    Mask::from(bias),
                    None,
                    RowsMut::new(&mut out, width),
                );
            }),
        );
    }
    let mut out = vec![0.0; shape.queries * width];
    add(
        ", packing too",
        Box::new(move || {
            held.pack(threads, k, v).expect("there is enough memory");
            attention(
                threads,
                Rows::new(&shape.q, width),
                &held,
                scale,
                Mask::None,
                None,
                RowsMut::new(&mut out, width),
            );
        }),
    );
}

/// Scores of a head as one product, rows of softmax with `exp` of the standard library, and a second product.
fn plain<'a>(shape: &'a Shape, contenders: &mut Vec<Contender<'a>>) {
    let width = shape.width();
    let scale = 1.0 / (shape.head_dim as f32).sqrt();
    let mut out = vec![0.0; shape.queries * width];
    let mut scores = vec![0.0; shape.queries * shape.keys];
    let run = move || {
        let mut out = rows_mut(&mut out, width);
        for head in 0..shape.num_heads {
            let columns = |data: &'a [f32]| rows(data, width).subcols(head * shape.head_dim, shape.head_dim);
            let view = rows_mut(&mut scores, shape.keys);
            matmul(
                view,
                Accum::Replace,
                columns(&shape.q),
                columns(&shape.k).transpose(),
                scale,
                Par::Seq,
            );
            for row in scores.chunks_exact_mut(shape.keys) {
                let max = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
                row.iter_mut().for_each(|score| *score = (*score - max).exp());
                let sum: f32 = row.iter().sum();
                row.iter_mut().for_each(|score| *score /= sum);
            }
            let part = out.as_mut().subcols_mut(head * shape.head_dim, shape.head_dim);
            matmul(
                part,
                Accum::Replace,
                rows(&scores, shape.keys),
                columns(&shape.v),
                1.0,
                Par::Seq,
            );
        }
    };
    contenders.push(Contender {
        name: "faer products, plain softmax".to_owned(),
        threads: 1,
        work: macs(shape),
        relative_to: Some(Contender::peak_name(Isa::best(), Arithmetic::Float32)),
        run: Box::new(run),
    });
}

/// Of both products; the softmax is what keeps attention from its peak.
fn macs(shape: &Shape) -> f64 {
    (2 * shape.queries * shape.keys * shape.width()) as f64
}

fn rows(data: &[f32], width: usize) -> MatRef<'_, f32> {
    MatRef::from_row_major_slice(data, data.len() / width, width)
}

fn rows_mut(data: &mut [f32], width: usize) -> MatMut<'_, f32> {
    let count = data.len() / width;
    MatMut::from_row_major_slice_mut(data, count, width)
}
